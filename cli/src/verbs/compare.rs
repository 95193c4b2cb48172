//! `compare`: what model B predicts against model A, on clips.

use crate::args::{EngineArgs, Precision, Size, path_json};
use crate::model;
use crate::output::Console;
use crate::versus;
use serde_json::{Value, json};
use sf_eval::Gate;
use sf_formats::clip::{Clip, ClipOptions};
use sf_formats::{Error, Result};
use sf_splat::Renderer;
use std::path::PathBuf;

/// Which models on which clips.
#[derive(clap::Args)]
pub(crate) struct Args {
    /// The reference: a weight blob (.sfw), or a checkpoint, which is converted to f32 for this run
    #[arg(value_name = "A")]
    a: PathBuf,
    /// The model in question; the same network
    #[arg(value_name = "B")]
    b: PathBuf,
    /// Clips: folders of pictures, transforms.json, or list files
    #[arg(short, long, value_name = "CLIP", required = true, num_args = 1..)]
    input: Vec<PathBuf>,
    /// Pictures of every clip to use, from 0, as 0,5,10,15; default: all
    #[arg(long, value_name = "LIST", value_delimiter = ',')]
    frames: Option<Vec<usize>>,
    /// Pictures per second, where a clip has no times of its own; default 10
    #[arg(long, value_name = "FPS")]
    fps: Option<f64>,
    /// Network size in pixels; default as in run
    #[arg(long, value_name = "WxH")]
    size: Option<Size>,
    /// Bounds whose breach is a failure (exit code 1): depth_absrel=0.01,render_psnr=45; `int8` stands for all that an
    /// int8 model has to keep
    #[arg(long, value_name = "KEY=LIMIT", value_delimiter = ',', value_parser = versus::parse_gate)]
    gate: Vec<Vec<Gate>>,
    /// Leave the stages of the network out
    #[arg(long)]
    outputs_only: bool,
    #[command(flatten)]
    engine: EngineArgs,
}

/// Runs both and reports.
pub(crate) fn run(args: &Args, console: &Console) -> Result<()> {
    let gates = args.gate.concat();
    let options = ClipOptions { frames: args.frames.clone(), fps: args.fps, ..ClipOptions::default() };
    let clips: Vec<Clip> = args.input.iter().map(|p| Clip::open(p, &options)).collect::<Result<_>>()?;
    let stages = !args.outputs_only;

    let a = model::load(Some(&args.a), &args.engine, Precision::F32, console)?;
    let b = model::load(Some(&args.b), &args.engine, Precision::F32, console)?;
    versus::check_same(&a.model, &b.model)?;
    let samples = versus::samples(&a.model, &clips, args.size)?;
    let answers_a = versus::answers(&a.model, &samples, &args.engine, stages)?;
    let answers_b = versus::answers(&b.model, &samples, &args.engine, stages)?;
    let mut renderer = Renderer::new(crate::args::threads(args.engine.threads))?;
    let verdict = versus::compare(&samples, (&a.model, &answers_a), (&b.model, &answers_b), &mut renderer)?;

    let mut json = json!({
        "schema": "streetforward.compare/1",
        "a": a.json(),
        "b": b.json(),
        "clips": args.input.iter().map(|p| path_json(p)).collect::<Value>(),
        "run_ms_a": answers_a.run_ms,
        "run_ms_b": answers_b.run_ms,
    });
    if let (Some(all), Value::Object(part)) = (json.as_object_mut(), versus::to_json(&gates, &verdict)) {
        all.extend(part);
    }
    console.report(&json, &versus::to_text(&gates, &verdict))?;
    let failures = versus::failures(&gates, &verdict);
    if failures.is_empty() { Ok(()) } else { Err(Error::CheckFailed(failures.join("; "))) }
}
