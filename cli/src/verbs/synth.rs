//! `synth`: procedural street clips with exact depth, velocity and poses: one as a folder, or many as a
//! binary stream on standard output for a trainer (layout: `synth/src/stream.rs`).

use crate::args::{FolderArgs, Size, path_json};
use crate::folder::OutputFolder;
use crate::output::{Console, Stdout, files_json};
use clap::ValueEnum;
use serde_json::json;
use sf_formats::atomic::Overwrite;
use sf_formats::error::escape_path;
use sf_formats::{Error, Result};
use sf_synth::{Options, Split, Street, stream, write_clip};
use std::path::{Path, PathBuf};
use std::time::Instant;

/// Which street.
#[derive(clap::Args)]
pub(crate) struct Args {
    /// Folder to write; made where it does not exist
    #[arg(short, long, value_name = "DIR", required_unless_present = "stream")]
    output: Option<PathBuf>,
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
    match (&args.output, args.stream) {
        (_, Some(clips)) => write_stream(args, clips),
        (Some(output), None) => write_folder(args, output, console),
        (None, None) => Err(Error::usage("give a folder with -o, or --stream")),
    }
}

fn write_folder(args: &Args, output: &Path, console: &Console) -> Result<()> {
    let start = Instant::now();
    let options = args.options(args.frames.unwrap_or(Options::default().frames));
    let (frames, split) = (options.frames, Split::of(args.seed));
    let street = Street::new(args.seed, options)?;
    let folder = OutputFolder::create(&FolderArgs { output: output.to_path_buf(), force: args.force })?;
    write_clip(&street, folder.path(), Overwrite::Yes)?;
    let files = folder.commit()?;
    let ms = start.elapsed().as_secs_f64() * 1e3;
    let json = json!({
        "schema": "streetforward.synth/1",
        "output": path_json(output),
        "seed": args.seed,
        "split": if split == Split::Train { "train" } else { "held_out" },
        "frames": frames,
        "width": args.size.width,
        "height": args.size.height,
        "fps": args.fps,
        "total_ms": ms,
        "files": files_json(&files),
    });
    let text = format!(
        "{frames} frames of {} at {} Hz in {}: pictures, transforms.json, depth, velocity, dynamic; {ms:.0} ms\n",
        args.size,
        args.fps,
        escape_path(output),
    );
    console.report(&json, &text)
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
