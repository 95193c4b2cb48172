//! `run`: a clip of pictures to a scene.
//!
//! ```text
//! DIR/run.json                       the report
//! DIR/scene.ply, scene.json          the scene
//! DIR/overview.png                   per frame: picture, depth, motion, dynamic probability
//! DIR/depth.npy                      [N, H, W] z-depth, scene units
//! DIR/depth/000000.png               16 bit, depth x 256, 0 = none; 000000_colour.png to look at
//! DIR/conf.npy                       [N, H, W] confidence logits
//! DIR/points.npy                     [N, H, W, 3] points in camera axes
//! DIR/poses.npy, transforms.json     [N, 4, 4] camera to world; the same for other tools
//! DIR/velocity.npy, velocity/*.png   [N, H, W, 6] v+ and v-, world axes, scene units per second
//! DIR/dynamic.npy, dynamic/*.png     [N, H, W] dynamic probability
//! ```

use crate::args::{ClipArgs, EngineArgs, FolderArgs, Precision, Size, path_json};
use crate::output::{Console, OutputFolder, files_json, human_count, json_text};
use crate::reconstruct::{self, Loaded};
use clap::ValueEnum;
use serde_json::{Value, json};
use sf_formats::atomic::{self, Overwrite};
use sf_formats::clip::{Clip, TruthFrame};
use sf_formats::digest::hex;
use sf_formats::error::escape_path;
use sf_formats::image_io::{self, Rgb8};
use sf_formats::picture::{self, DepthScale};
use sf_formats::poses_io::{self, PoseFormat};
use sf_formats::{Error, Intrinsics, Result, Scene, npy};
use std::collections::BTreeMap;
use std::path::{Path, PathBuf};
use std::time::Instant;
use streetforward::{Output, Prepared, Session, Tap};

/// Which clip through which model to where.
#[derive(clap::Args)]
pub(crate) struct Args {
    #[command(flatten)]
    clip: ClipArgs,
    #[command(flatten)]
    folder: FolderArgs,
    /// Weight blob (.sfw), or a checkpoint, which is converted for this run; without it a random nano network
    #[arg(short, long, value_name = "MODEL")]
    model: Option<PathBuf>,
    /// Network size in pixels, multiples of the patch; default: the pictures', shrunk to what the network
    /// was made for
    #[arg(long, value_name = "WxH")]
    size: Option<Size>,
    /// Intrinsics of the pictures in place of the predicted ones: FX,FY,CX,CY in pixels, or `clip` for
    /// those of its transforms.json
    #[arg(long, value_name = "K", value_parser = intrinsics)]
    intrinsics: Option<Given>,
    /// Precision of a converted checkpoint and of the random network
    #[arg(long, value_enum, default_value_t = Precision::F32)]
    precision: Precision,
    /// What to write
    #[arg(long, value_enum, value_delimiter = ',', value_name = "LIST", default_value = "scene,overview")]
    emit: Vec<Emit>,
    /// Also write every stage of the network, and all results, as .npy into this folder
    #[arg(long, value_name = "DIR")]
    dump_stages: Option<PathBuf>,
    #[command(flatten)]
    engine: EngineArgs,
}

/// Intrinsics that override the predicted ones.
#[derive(Clone, Copy, Debug, PartialEq)]
enum Given {
    /// Those of the clip.
    Clip,
    /// In pixels of the first picture.
    Pixels(Intrinsics),
}

fn intrinsics(text: &str) -> Result<Given, String> {
    if text == "clip" {
        return Ok(Given::Clip);
    }
    let numbers: Vec<f64> = text.split(',').filter_map(|t| t.trim().parse().ok()).collect();
    match numbers[..] {
        [fx, fy, cx, cy] if text.split(',').count() == 4 => Ok(Given::Pixels(Intrinsics { fx, fy, cx, cy })),
        _ => Err("give FX,FY,CX,CY in pixels, or clip".into()),
    }
}

/// One kind of result.
#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum)]
enum Emit {
    /// The scene that render and export read
    Scene,
    /// Depth: array, 16-bit pictures, coloured pictures
    Depth,
    /// Confidence logits, where the network has them
    Conf,
    /// Points in camera axes
    Points,
    /// Camera poses
    Poses,
    /// Velocities: array and pictures
    Velocity,
    /// Dynamic probability: array and pictures
    Dynamic,
    /// One picture to look at first
    Overview,
}

/// Runs the network and writes what was asked for.
pub(crate) fn run(args: &Args, console: &Console) -> Result<()> {
    let start = Instant::now();
    let clip = args.clip.open()?;
    let clip_ms = start.elapsed().as_secs_f64() * 1e3;
    for note in &clip.notes {
        console.note(format!("{}: {note}", escape_path(&args.clip.input)));
    }
    let k = match args.intrinsics {
        None => None,
        Some(Given::Pixels(k)) => {
            k.check("--intrinsics")?;
            Some(k)
        }
        Some(Given::Clip) => Some(clip.intrinsics.ok_or_else(|| {
            Error::input(escape_path(&args.clip.input), "has no intrinsics: give --intrinsics FX,FY,CX,CY")
        })?),
    };
    let loaded = reconstruct::load(args.model.as_deref(), &args.engine, args.precision, console)?;
    let config = loaded.model.config();
    if args.emit.contains(&Emit::Conf) && !config.conf.exists() {
        return Err(Error::usage("--emit conf: this network has no confidence head"));
    }
    let size = reconstruct::network_size(config, &clip, args.size);
    let prepared = reconstruct::prepare_clip(config, &clip, k, size)?;
    let mut session = reconstruct::session(&loaded, prepared.shape, &args.engine)?;
    // Both output folders are claimed before the long part.
    let folder = OutputFolder::create(&args.folder)?;
    let stages = match &args.dump_stages {
        Some(dir) => Some(OutputFolder::create(&FolderArgs { output: dir.clone(), force: args.folder.force })?),
        None => None,
    };
    console.note(format!(
        "network: {} frames of {}x{}, {} threads, {}",
        prepared.shape.frames,
        size.0,
        size.1,
        session.threads(),
        session.kernels().isa.name()
    ));
    let start = Instant::now();
    match &stages {
        Some(stages) => run_tapped(&mut session, &prepared, stages)?,
        None => {
            session.run(&prepared.input())?;
        }
    }
    let run_ms = start.elapsed().as_secs_f64() * 1e3;
    // A blob overwritten while it was used has not been the one that was verified.
    loaded.model.blob().unchanged()?;
    let out = session.output();
    if out.flags.no_motion {
        console.note("no motion: one frame, or a network without a motion head; velocities are zero");
    }
    if out.flags.intrinsics_assumed {
        console.warn("the predicted rays fix no focal length: a 64 degree view is assumed; see --intrinsics");
    }
    if let Some(folder) = &stages {
        Array::ALL.into_iter().try_for_each(|a| a.write(out, folder.path()))?;
    }
    let mut scene = out.to_scene(config, &reconstruct::sources(&clip));
    scene.notes = notes(&loaded, &args.clip.input);
    write_results(args, &folder, &Results { out, scene: &scene, prepared: &prepared, truth: &[] })?;

    let mut report = json!({
        "schema": "streetforward.run/1",
        "version": env!("CARGO_PKG_VERSION"),
        "output": path_json(&args.folder.output),
        "model": loaded.json(),
        "clip": clip_json(&args.clip.input, &clip),
        "width": size.0,
        "height": size.1,
        "session": reconstruct::session_json(&session),
        "clip_ms": clip_ms,
        "run_ms": run_ms,
        "peak_rss_bytes": reconstruct::peak_rss_bytes(),
        "gaussians": scene.len(),
        "no_motion": out.flags.no_motion,
        "intrinsics_assumed": out.flags.intrinsics_assumed,
        "intrinsics": out.k.iter().map(|k| json!([k.fx, k.fy, k.cx, k.cy])).collect::<Value>(),
        "depth_png_steps_per_unit": DEPTH_STEPS,
        "output_digest": hex(&reconstruct::output_digest(out)),
    });
    atomic::write(&folder.path().join("run.json"), json_text(&report)?.as_bytes(), Overwrite::Yes)?;
    let files = folder.commit()?;
    let stage_files = stages.map(OutputFolder::commit).transpose()?;
    report["files"] = files_json(&files);
    if let Some(list) = &stage_files {
        report["stage_files"] = files_json(list);
    }
    console.report(&report, &summary(args, &session, &scene, run_ms))
}

/// For people.
fn summary(args: &Args, session: &Session, scene: &Scene, run_ms: f64) -> String {
    let s = session.plan().shape();
    let mut text = format!(
        "{} frames of {}x{} -> {} Gaussians in {}\nnetwork {run_ms:.0} ms:",
        s.frames,
        s.width,
        s.height,
        human_count(scene.len()),
        escape_path(&args.folder.output),
    );
    for stage in session.stage_times().filter(|s| !s.time.is_zero()) {
        text.push_str(&format!(" {} {:.0}", stage.name, stage.time.as_secs_f64() * 1e3));
    }
    text.push('\n');
    text
}

fn clip_json(path: &Path, clip: &Clip) -> Value {
    json!({
        "path": path_json(path),
        "frames": clip.frames.len(),
        "total_frames": clip.total,
        "indices": clip.indices,
        "times_s": clip.times(),
        "names": clip.frames.iter().map(|f| f.name.as_str()).collect::<Value>(),
        "source_sizes": clip.frames.iter().map(|f| json!([f.image.width, f.image.height])).collect::<Value>(),
        "notes": clip.notes,
    })
}

/// Provenance that stays with the scene.
pub(crate) fn notes(loaded: &Loaded, clip: &Path) -> Vec<(String, String)> {
    let blob = loaded.model.blob();
    let random = loaded.json()["random_weights"] == true;
    vec![
        ("generator".into(), format!("streetforward {}", env!("CARGO_PKG_VERSION"))),
        ("model_digest".into(), hex(blob.digest())),
        ("random_weights".into(), random.to_string()),
        ("clip".into(), clip.to_string_lossy().into_owned()),
    ]
}

/// Steps of a 16-bit depth picture per scene unit, as KITTI's depth maps: value 0 is no depth.
const DEPTH_STEPS: f32 = 256.0;

/// What the network said about a clip.
pub(crate) struct Results<'a> {
    pub(crate) out: &'a Output,
    pub(crate) scene: &'a Scene,
    pub(crate) prepared: &'a Prepared,
    /// Ground truth of the frames, where it is known at the network's size.
    pub(crate) truth: &'a [TruthFrame],
}

impl Results<'_> {
    fn size(&self) -> (u32, u32) {
        (self.out.shape.width as u32, self.out.shape.height as u32)
    }

    fn pixels(&self) -> usize {
        self.out.shape.width * self.out.shape.height
    }

    /// Motion of every pixel: the mean of v+ and -v-.
    fn velocity(&self) -> Vec<[f32; 3]> {
        let both = self.out.v_fwd.iter().zip(&self.out.v_bwd);
        both.map(|(f, b)| std::array::from_fn(|a| 0.5 * (f[a] - b[a]))).collect()
    }

    /// A row per frame: picture, depth, true depth, motion, true motion, dynamic probability; without ground
    /// truth four of them. Predicted and true depth have scales of their own, since a clip without poses
    /// is known up to scale; motion has one, since it is to be compared.
    pub(crate) fn overview(&self) -> Rgb8 {
        let (out, size, n) = (self.out, self.size(), self.pixels());
        let (scale, velocity) = (DepthScale::of(&out.depth), self.velocity());
        let moving: Vec<[f32; 3]> =
            self.truth.iter().filter_map(|t| t.velocity.as_deref()).flatten().copied().collect();
        let top = picture::top_speed(if moving.is_empty() { &velocity } else { &moving }, 1.0);
        let truth: Vec<f32> = self.truth.iter().flat_map(|t| &t.depth).copied().collect();
        let true_scale = DepthScale::of(&truth);
        let mut cells = Vec::new();
        for f in 0..out.shape.frames {
            let range = f * n..(f + 1) * n;
            cells.push(Rgb8::new(size.0, size.1, self.prepared.images[3 * f * n..3 * (f + 1) * n].to_vec()));
            let truth = self.truth.get(f).filter(|t| (t.width, t.height) == size);
            cells.push(picture::depth_colours(&out.depth[range.clone()], size, scale));
            cells.extend(truth.map(|t| picture::depth_colours(&t.depth, size, true_scale)));
            cells.push(picture::velocity_wheel(&velocity[range.clone()], size, top));
            cells.extend(truth.and_then(|t| t.velocity.as_ref()).map(|v| picture::velocity_wheel(v, size, top)));
            cells.push(picture::gray(&out.dynamic[range], size, (0.0, 1.0)));
        }
        let columns = cells.len() / out.shape.frames;
        picture::grid(&cells.iter().collect::<Vec<_>>(), columns)
    }
}

/// A result as one `.npy` file.
#[derive(Clone, Copy)]
enum Array {
    Depth,
    Conf,
    Points,
    Poses,
    Velocity,
    Dynamic,
}

impl Array {
    const ALL: [Array; 6] = [Array::Depth, Array::Conf, Array::Points, Array::Poses, Array::Velocity, Array::Dynamic];

    /// Writes it into `folder`; a confidence that the network lacks is left out.
    fn write(self, out: &Output, folder: &Path) -> Result<()> {
        let s = out.shape;
        let save = |name: &str, last: &[usize], values: &[f32]| {
            let shape = [&[s.frames, s.height, s.width], last].concat();
            npy::write_f32(&folder.join(name), &shape, values, Overwrite::Yes)
        };
        match self {
            Array::Depth => save("depth.npy", &[], &out.depth),
            Array::Conf if out.conf.is_empty() => Ok(()),
            Array::Conf => save("conf.npy", &[], &out.conf),
            Array::Points => save("points.npy", &[3], out.points.as_flattened()),
            Array::Poses => {
                let rows: Vec<f64> = out.poses.iter().flat_map(|p| p.to_rows()).flatten().collect();
                npy::write_f64(&folder.join("poses.npy"), &[s.frames, 4, 4], &rows, Overwrite::Yes)
            }
            Array::Velocity => {
                let pairs = out.v_fwd.iter().zip(&out.v_bwd);
                let both: Vec<f32> = pairs.flat_map(|(f, b)| [f[0], f[1], f[2], b[0], b[1], b[2]]).collect();
                save("velocity.npy", &[6], &both)
            }
            Array::Dynamic => save("dynamic.npy", &[], &out.dynamic),
        }
    }
}

fn write_results(args: &Args, folder: &OutputFolder, r: &Results) -> Result<()> {
    let (out, size, n) = (r.out, r.size(), r.pixels());
    let array = |a: Array| a.write(out, folder.path());
    let frames = || (0..out.shape.frames).map(|f| (f, f * n..(f + 1) * n));
    for emit in &args.emit {
        match emit {
            Emit::Scene => r.scene.save(folder.path(), Overwrite::Yes)?,
            Emit::Depth => {
                array(Array::Depth)?;
                let (pictures, scale) = (folder.subfolder("depth")?, DepthScale::of(&out.depth));
                for (f, range) in frames() {
                    let depth = &out.depth[range];
                    // `as` saturates: what is too far for 16 bits is white.
                    let steps: Vec<u16> = depth.iter().map(|d| (d * DEPTH_STEPS).round() as u16).collect();
                    image_io::write_gray16(&pictures.join(format!("{f:06}.png")), size, &steps, Overwrite::Yes)?;
                    let colours = picture::depth_colours(depth, size, scale);
                    image_io::write_png(&pictures.join(format!("{f:06}_colour.png")), &colours, Overwrite::Yes)?;
                }
            }
            Emit::Conf => array(Array::Conf)?,
            Emit::Points => array(Array::Points)?,
            Emit::Poses => {
                array(Array::Poses)?;
                let views = poses_io::views(r.scene);
                poses_io::export(&views, PoseFormat::Nerfstudio, folder.path(), Overwrite::Yes)?;
            }
            Emit::Velocity => {
                array(Array::Velocity)?;
                let (pictures, velocity) = (folder.subfolder("velocity")?, r.velocity());
                let top = picture::top_speed(&velocity, 1.0);
                for (f, range) in frames() {
                    let wheel = picture::velocity_wheel(&velocity[range], size, top);
                    image_io::write_png(&pictures.join(format!("{f:06}.png")), &wheel, Overwrite::Yes)?;
                }
            }
            Emit::Dynamic => {
                array(Array::Dynamic)?;
                let pictures = folder.subfolder("dynamic")?;
                for (f, range) in frames() {
                    let gray: Vec<u8> = out.dynamic[range].iter().map(|p| (p * 255.0).round() as u8).collect();
                    image_io::write_gray8(&pictures.join(format!("{f:06}.png")), size, &gray, Overwrite::Yes)?;
                }
            }
            Emit::Overview => {
                image_io::write_png(&folder.path().join("overview.png"), &r.overview(), Overwrite::Yes)?;
            }
        }
    }
    Ok(())
}

/// Runs with every stage written as it appears. Stages that come frame by frame are gathered until the
/// last frame is there.
fn run_tapped(session: &mut Session, prepared: &Prepared, folder: &OutputFolder) -> Result<()> {
    let frames = prepared.shape.frames;
    let mut parts: BTreeMap<String, (usize, Vec<f32>)> = BTreeMap::new();
    // A tap cannot fail, so the first fault waits here until the run is over.
    let mut fault: Option<Error> = None;
    let mut tap = |t: &Tap| {
        if fault.is_some() {
            return;
        }
        let file = folder.path().join(format!("{}.npy", t.name));
        let written = match t.frame {
            None => npy::write_f32(&file, t.shape, t.data, Overwrite::Yes),
            Some(_) => {
                let (count, values) = parts.entry(t.name.to_string()).or_default();
                *count += 1;
                values.extend_from_slice(t.data);
                if *count < frames {
                    return;
                }
                let shape = [&[frames], t.shape].concat();
                let values = std::mem::take(values);
                npy::write_f32(&file, &shape, &values, Overwrite::Yes)
            }
        };
        fault = written.err();
    };
    session.run_watched(&prepared.input(), None, Some(&mut tap))?;
    fault.map_or(Ok(()), Err)
}
