//! `synth`: procedural street clips with exact depth, velocity and poses: one as a folder (and its true scene), or many as a
//! binary stream on standard output for a trainer (layout: `synth/src/stream.rs`).

use crate::args::{FolderArgs, Size, path_json};
use crate::folder::OutputFolder;
use crate::output::{Console, Stdout, files_json, human_count};
use clap::ValueEnum;
use serde_json::json;
use sf_eval::{OracleFrame, OracleOptions, Protocol, oracle_scene};
use sf_formats::atomic::Overwrite;
use sf_formats::clip::TruthFrame;
use sf_formats::error::escape_path;
use sf_formats::image_io::Rgb8;
use sf_formats::{Camera, Error, Result, Scene};
use sf_synth::{DYNAMIC, Options, Split, Street, stream, write_clip};
use std::path::PathBuf;
use std::time::Instant;

/// Which street.
#[derive(clap::Args)]
pub(crate) struct Args {
    /// Folder to write; made where it does not exist
    #[arg(short, long, value_name = "DIR", required_unless_present_any = ["stream", "scene"])]
    output: Option<PathBuf>,
    /// Also, or only, write the true scene as a folder for render and export: one Gaussian per pixel of frames
    /// 0, 5, 10 and 15 (all frames of a clip shorter than three), from true depth, pose and velocity
    #[arg(long, value_name = "DIR", conflicts_with = "stream")]
    scene: Option<PathBuf>,
    /// Write into a folder that is not empty, replacing files of the same names
    #[arg(long)]
    force: bool,
    /// The street; the same seed gives the same bytes everywhere
    #[arg(long, value_name = "N", default_value_t = 1)]
    seed: u64,
    /// Pictures [default: 20]
    #[arg(long, value_name = "N")]
    frames: Option<usize>,
    /// Picture size in pixels
    #[arg(long, value_name = "WxH", default_value = "252x168")]
    size: Size,
    /// Pictures per second
    #[arg(long, value_name = "FPS", default_value_t = 10.0)]
    fps: f64,
    /// Write this many clips to standard output as binary records instead of a folder; without --frames
    /// they are training clips of four pictures up to half a second apart
    #[arg(long, value_name = "CLIPS", conflicts_with_all = ["output", "force", "json"])]
    stream: Option<usize>,
    /// Seeds that --stream takes from --seed on
    #[arg(long, value_enum, default_value_t = Seeds::Train, requires = "stream")]
    split: Seeds,
}

/// Which seeds a stream takes.
#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum)]
enum Seeds {
    /// Those that models may be trained on
    Train,
    /// Those that only evaluation may see
    HeldOut,
}

impl Args {
    fn options(&self, frames: usize) -> Options {
        Options { frames, width: self.size.width, height: self.size.height, fps: self.fps, ..Options::default() }
    }
}

/// Writes the clip, or the stream.
pub(crate) fn run(args: &Args, console: &Console) -> Result<()> {
    match (args.stream, &args.output, &args.scene) {
        (Some(clips), _, _) => write_stream(args, clips),
        (None, None, None) => Err(Error::usage("give a folder with -o, --scene, or --stream")),
        (None, _, _) => write_folders(args, console),
    }
}

fn write_folders(args: &Args, console: &Console) -> Result<()> {
    let start = Instant::now();
    let options = args.options(args.frames.unwrap_or(Options::default().frames));
    let (frames, split) = (options.frames, Split::of(args.seed));
    let street = Street::new(args.seed, options)?;
    // Both folders are claimed before the long part.
    let claim = |path: &Option<PathBuf>| -> Result<Option<OutputFolder>> {
        let folder = |p: &PathBuf| OutputFolder::create(&FolderArgs { output: p.clone(), force: args.force });
        path.as_ref().map(folder).transpose()
    };
    let (clip, scene) = (claim(&args.output)?, claim(&args.scene)?);
    let mut json = json!({
        "schema": "streetforward.synth/1",
        "output": args.output.as_deref().map(path_json),
        "seed": args.seed,
        "split": if split == Split::Train { "train" } else { "held_out" },
        "frames": frames,
        "width": args.size.width,
        "height": args.size.height,
        "fps": args.fps,
    });
    let mut text = String::new();
    if let (Some(clip), Some(output)) = (clip, &args.output) {
        write_clip(&street, clip.path(), Overwrite::Yes)?;
        json["files"] = files_json(&clip.commit()?);
        text.push_str(&format!(
            "{frames} frames of {} at {} Hz in {}: pictures, transforms.json, depth, velocity, dynamic\n",
            args.size,
            args.fps,
            escape_path(output),
        ));
    }
    if let (Some(folder), Some(output)) = (scene, &args.scene) {
        let scene = true_scene(&street)?;
        scene.save(folder.path(), Overwrite::Yes)?;
        json["scene"] = path_json(output);
        json["scene_gaussians"] = scene.len().into();
        json["scene_files"] = files_json(&folder.commit()?);
        text.push_str(&format!(
            "{} Gaussians of {} frames, from ground truth, in {}\n",
            human_count(scene.len()),
            scene.frames.len(),
            escape_path(output)
        ));
    }
    json["total_ms"] = (start.elapsed().as_secs_f64() * 1e3).into();
    console.report(&json, &text)
}

/// The scene of a perfect network that is given the protocol's context frames.
fn true_scene(street: &Street) -> Result<Scene> {
    let (frames, size) = (street.options().frames, (street.options().width, street.options().height));
    let context = Protocol::storm20(frames).map_or((0..frames).collect(), |p| p.context);
    let drawn: Vec<(String, Rgb8, TruthFrame, Camera, f64)> = context
        .iter()
        .map(|&i| {
            let frame = street.frame(i);
            let truth = TruthFrame {
                width: size.0,
                height: size.1,
                dynamic: Some(frame.dynamic(DYNAMIC).iter().map(|&m| m != 0).collect()),
                depth: frame.depth,
                velocity: Some(frame.velocity),
            };
            (format!("{i:06}.png"), Rgb8::new(size.0, size.1, frame.rgb), truth, frame.camera, frame.time)
        })
        .collect();
    let frames: Vec<OracleFrame> = drawn
        .iter()
        .map(|(name, image, truth, camera, time)| OracleFrame { time: *time, camera: *camera, image, truth, name })
        .collect();
    let mut scene = oracle_scene(&frames, &OracleOptions::default())?;
    scene.notes.push(("clip".into(), format!("synthetic street {}", street.seed())));
    Ok(scene)
}

fn write_stream(args: &Args, clips: usize) -> Result<()> {
    let split = match args.split {
        Seeds::Train => Split::Train,
        Seeds::HeldOut => Split::HeldOut,
    };
    let options = |seed: u64| match args.frames {
        Some(frames) => args.options(frames),
        None => Options { fps: args.fps, ..Options::training(seed, args.size.width, args.size.height) },
    };
    stream(split.seeds(args.seed).take(clips), options, &mut Stdout::open()?)?;
    Ok(())
}
