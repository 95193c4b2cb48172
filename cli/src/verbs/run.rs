//! `run`: a clip of pictures to a scene. Writes `DIR/run.json`, the report, and the files of [`crate::results`].

use crate::args::{ClipArgs, EngineArgs, FolderArgs, Precision, Size, path_json};
use crate::folder::OutputFolder;
use crate::machine;
use crate::model;
use crate::output::{Console, files_json, human_count, json_text};
use crate::reconstruct;
use crate::results::{DEPTH_STEPS, Emit, Results};
use clap::ValueEnum;
use serde_json::{Value, json};
use sf_formats::atomic::{self, Overwrite};
use sf_formats::clip::Clip;
use sf_formats::digest::hex;
use sf_formats::error::escape_path;
use sf_formats::{Error, Intrinsics, Result, Scene, npy};
use sf_splat::Renderer;
use std::collections::BTreeMap;
use std::path::{Path, PathBuf};
use std::time::Instant;
use streetforward::{Prepared, Session, Tap};

/// Which clip through which model to where.
#[derive(clap::Args)]
pub(crate) struct Args {
    #[command(flatten)]
    clip: ClipArgs,
    #[command(flatten)]
    folder: FolderArgs,
    /// Weight blob (.sfw), or a checkpoint, which is converted for this run; without it the trained nano network
    /// inside the binary
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
    let loaded = model::load(args.model.as_deref(), &args.engine, args.precision, console)?;
    let config = loaded.model.config();
    if args.emit.contains(&Emit::Conf) && !config.has_conf() {
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
    let bar = console.follow(&session);
    let start = Instant::now();
    match &stages {
        Some(stages) => run_tapped(&mut session, &prepared, stages)?,
        None => {
            session.run(&prepared.input())?;
        }
    }
    let run_ms = start.elapsed().as_secs_f64() * 1e3;
    drop(bar);
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
        Emit::value_variants().iter().try_for_each(|e| e.write_array(out, folder.path()))?;
    }
    let mut scene = out.to_scene(config, &reconstruct::sources(&clip));
    scene.notes = loaded.notes(&args.clip.input);
    let mut renderer = Renderer::new(session.threads())?;
    Results { out, scene: &scene, prepared: &prepared, truth: &[] }.write(&args.emit, &folder, &mut renderer)?;

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
        "peak_rss_bytes": machine::peak_rss_bytes(),
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
