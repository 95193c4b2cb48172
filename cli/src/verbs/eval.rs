//! `eval`: a model against clips with ground truth, beside the trivial alternatives.

use crate::args::{EngineArgs, Precision, Size, path_json};
use crate::model::{self, Loaded};
use crate::output::Console;
use crate::reconstruct;
use clap::ValueEnum;
use serde_json::{Value, json};
use sf_eval::{EvalClip, EvalOptions, EvalReport, Protocol, TargetPoses, evaluate};
use sf_formats::clip::{Clip, ClipOptions, GroundTruth};
use sf_formats::{Result, Scene};
use sf_splat::Renderer;
use std::path::{Path, PathBuf};
use std::time::Instant;

/// Which model on which clips.
#[derive(clap::Args)]
pub(crate) struct Args {
    /// Weight blob (.sfw), or a checkpoint, which is converted for this run; without it a random nano network
    #[arg(short, long, value_name = "MODEL")]
    model: Option<PathBuf>,
    /// Clips with ground truth, as synth writes them
    #[arg(long, value_name = "DIR", required = true, num_args = 1..)]
    data: Vec<PathBuf>,
    /// Which frames are given and which are tested
    #[arg(long, value_enum, default_value_t = Rules::Storm20)]
    protocol: Rules,
    /// Cameras of the tested frames
    #[arg(long, value_enum, default_value_t = Poses::Predicted)]
    target_poses: Poses,
    /// Network size in pixels; default as in run
    #[arg(long, value_name = "WxH")]
    size: Option<Size>,
    /// Precision of a converted checkpoint and of the random network
    #[arg(long, value_enum, default_value_t = Precision::F32)]
    precision: Precision,
    #[command(flatten)]
    engine: EngineArgs,
}

/// Evaluation protocol.
#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum)]
enum Rules {
    /// 20 frames, 0, 5, 10, 15 given, the others tested
    Storm20,
}

/// Cameras of the tested frames.
#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum)]
enum Poses {
    /// The predicted context poses, interpolated in time
    Predicted,
    /// The true poses, brought into the predicted world by a similarity
    AlignedTruth,
}

/// Evaluates and reports.
pub(crate) fn run(args: &Args, console: &Console) -> Result<()> {
    let loaded = model::load(args.model.as_deref(), &args.engine, args.precision, console)?;
    let mut renderer = Renderer::new(crate::args::threads(args.engine.threads))?;
    let mut total: Option<EvalReport> = None;
    let mut clips = Vec::new();
    let progress = console.progress(args.data.len() as u64, "eval");
    for path in &args.data {
        let (report, run_ms) = judge(path, &loaded, args, &mut renderer)?;
        clips.push(json!({ "path": path_json(path), "run_ms": run_ms, "scores": report.to_json() }));
        match &mut total {
            Some(t) => t.merge(&report)?,
            None => total = Some(report),
        }
        progress.step();
    }
    drop(progress);
    let Some(total) = total else { unreachable!("the parser asks for at least one clip") };
    let mut json = total.to_json();
    json["model"] = loaded.json();
    json["data"] = clips.into_iter().collect::<Value>();
    console.report(&json, &total.to_markdown())
}

/// One clip's scores and the milliseconds of the network.
fn judge(path: &Path, loaded: &Loaded, args: &Args, renderer: &mut Renderer) -> Result<(EvalReport, f64)> {
    let clip = Clip::open(path, &ClipOptions::default())?;
    let protocol = Protocol::storm20(clip.total)?;
    let (scene, run_ms) = context_scene(&clip, &protocol, loaded, args)?;
    let target_poses = match args.target_poses {
        Poses::Predicted => TargetPoses::Predicted,
        Poses::AlignedTruth => TargetPoses::AlignedTruth,
    };
    let truth = GroundTruth::load(&clip.folder, &clip.indices)?;
    let options = EvalOptions { target_poses, ..EvalOptions::new(protocol) };
    let report = evaluate(&EvalClip::new(&clip, truth.as_ref()), &scene, renderer, &options)?;
    Ok((report, run_ms))
}

/// The scene of a clip's context frames.
fn context_scene(clip: &Clip, protocol: &Protocol, loaded: &Loaded, args: &Args) -> Result<(Scene, f64)> {
    let config = loaded.model.config();
    let context = reconstruct::context_clip(clip, protocol);
    let size = reconstruct::network_size(config, &context, args.size);
    let prepared = reconstruct::prepare_clip(config, &context, None, size)?;
    let mut session = reconstruct::session(loaded, prepared.shape, &args.engine)?;
    let start = Instant::now();
    session.run(&prepared.input())?;
    let run_ms = start.elapsed().as_secs_f64() * 1e3;
    loaded.model.blob().unchanged()?;
    Ok((session.output().to_scene(config, &reconstruct::sources(&context)), run_ms))
}
