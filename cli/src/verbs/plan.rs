//! `plan`: what a clip takes in memory, operations and time, before it runs.
//!
//! Memory is exact: a session's plan, the mapped weights, and what this process holds anyway. Operations are counted
//! from the configuration. Time is an estimate from the measured arithmetic peak.

use crate::args::{self, EngineArgs, Precision, Size, path_json};
use crate::machine::{self, Machine, Peak};
use crate::model;
use crate::network::{self, Heads, Preset};
use crate::output::{Console, human_bytes, human_count};
use serde_json::{Value, json};
use sf_formats::error::escape_path;
use sf_formats::{Error, Result};
use std::path::PathBuf;
use std::time::Duration;
use streetforward::{ClipShape, Cost, DEFAULT_MAX_BYTES, Plan};

/// Time of each peak probe.
const PROBE: Duration = Duration::from_millis(200);
/// Shares of the peak that whole networks have reached: small ones on narrow layers, large ones on wide ones.
const REACHED: (f64, f64) = (0.45, 0.85);

/// Which clip through which network.
#[derive(clap::Args)]
pub(crate) struct Args {
    /// Weight blob (.sfw) or checkpoint; without it a network with random weights
    #[arg(short, long, value_name = "MODEL", conflicts_with_all = ["preset", "heads"])]
    model: Option<PathBuf>,
    /// The network with random weights
    #[arg(long, value_enum, default_value_t = Preset::Nano)]
    preset: Preset,
    /// Kind of the dense heads of --preset
    #[arg(long, value_enum)]
    heads: Option<Heads>,
    /// Precision of a converted checkpoint and of the random network
    #[arg(long, value_enum, default_value_t = Precision::F32)]
    precision: Precision,
    /// Frames of the clip
    #[arg(long, value_name = "N", default_value_t = 4)]
    frames: usize,
    /// Size of the frames, multiples of the patch
    #[arg(long, value_name = "WxH", default_value = "252x168")]
    size: Size,
    #[command(flatten)]
    engine: EngineArgs,
}

/// Prints the plan; fails when the memory is not there.
pub(crate) fn run(args: &Args, console: &Console) -> Result<()> {
    let kernels = args::kernels(args.engine.isa)?;
    let threads = args::threads(args.engine.threads);
    let loaded = match &args.model {
        Some(path) => model::load(Some(path), &args.engine, args.precision, console)?,
        None => {
            let config = network::with_heads(network::preset(args.preset), args.heads);
            model::random(&config, args.precision, console)?
        }
    };
    let shape = ClipShape { frames: args.frames, height: args.size.height as usize, width: args.size.width as usize };
    // The budget is judged below, beside everything else.
    let plan = Plan::new(&loaded.model, shape, threads, u64::MAX)?;
    let cost = Cost::of_model(&loaded.model, shape)?;
    let peak = Peak::measure(kernels, threads, PROBE);

    let weights = loaded.model.blob().file_bytes() as u64;
    // What this program holds beside the weights, which were all read for their digests: code, tables, the allocator.
    let own = machine::rss_bytes().unwrap_or(0).saturating_sub(weights);
    let network = weights + plan.session_bytes() + plan.input_bytes() + own;
    let total = network + plan.scene_bytes();
    let budget = args.engine.max_mem.unwrap_or(DEFAULT_MAX_BYTES);
    let session = plan.session_bytes();
    let free = Machine::probe().free_bytes();
    let fits_budget = session <= budget;
    // The process and the weights are in memory already.
    let fits_memory = free.is_none_or(|free| total - own - weights <= free);
    let ops = 2.0 * cost.macs() as f64;
    // Floats and bytes each at their own peak.
    let at_peak = (ops - 2.0 * cost.int8() as f64) / peak.f32 + 2.0 * cost.int8() as f64 / peak.s8;
    let (fast, slow) = (at_peak / REACHED.1, at_peak / REACHED.0);

    let precision = loaded.precision().map_or("f32", |p| p.dtype().name());
    let stages = cost.stages().iter().map(|s| {
        json!({
            "name": s.name, "gop": 2e-9 * s.macs() as f64, "gemm_gop": 2e-9 * s.gemm as f64,
            "conv_gop": 2e-9 * s.conv as f64, "attention_gop": 2e-9 * s.attention as f64,
            "int8_gop": 2e-9 * s.int8 as f64,
        })
    });
    let areas = |list: &[(&'static str, u64)]| -> Value {
        list.iter().map(|(name, bytes)| json!({ "name": name, "bytes": bytes })).collect()
    };
    let json = json!({
        "schema": "streetforward.plan/1",
        "model": args.model.as_deref().map(path_json),
        "random_weights": args.model.is_none(),
        "precision": precision,
        "parameters": loaded.model.parameters(),
        "frames": shape.frames,
        "width": shape.width,
        "height": shape.height,
        "threads": threads,
        "isa": kernels.isa.name(),
        "weights_bytes": weights,
        "arena_bytes": plan.arena_bytes(),
        "arena": areas(&plan.areas_bytes()),
        "work": areas(&plan.work_bytes()),
        "threads_bytes": plan.threads_bytes(),
        "tables_bytes": plan.tables_bytes(),
        "output_bytes": plan.output_bytes(),
        "input_bytes": plan.input_bytes(),
        "process_bytes": own,
        "scene_bytes": plan.scene_bytes(),
        "network_peak_bytes": network,
        "peak_bytes": total,
        "max_mem_bytes": budget,
        "free_bytes": free,
        "fits_max_mem": fits_budget,
        "fits_memory": fits_memory,
        "gop": ops * 1e-9,
        "stages": stages.collect::<Value>(),
        "int8_gop": 2e-9 * cost.int8() as f64,
        "peak_f32_gops_per_s": peak.f32 * 1e-9,
        "peak_s8_gops_per_s": peak.s8 * 1e-9,
        "estimate_s": [fast, slow],
    });

    let mut text = String::new();
    let name = args.model.as_deref().map_or_else(|| "random weights".into(), escape_path);
    text.push_str(&format!(
        "model       {name}, {precision}, {} parameters, {} mapped\n{plan}\n",
        human_count(loaded.model.parameters()),
        human_bytes(weights)
    ));
    let mib = |bytes: u64| bytes as f64 / f64::from(1 << 20);
    for (name, bytes) in [
        ("weights", weights),
        ("pictures", plan.input_bytes()),
        ("process", own),
        ("network", network),
        ("scene", plan.scene_bytes()),
        ("peak", total),
    ] {
        let sum = match name {
            "network" => " = arena + threads + tables + results + weights + pictures + process",
            "peak" => " = network + scene",
            _ => "",
        };
        text.push_str(&format!("{name:<11} {:9.2} MiB{sum}\n", mib(bytes)));
    }
    let answer = |fits: bool| if fits { "fits" } else { "DOES NOT FIT" };
    text.push_str(&format!(
        "budget      {}: arena, threads, tables and results take {} of {} (--max-mem)\n",
        answer(fits_budget),
        human_bytes(session),
        human_bytes(budget)
    ));
    if let Some(free) = free {
        text.push_str(&format!("memory      {}: {} are free\n", answer(fits_memory), human_bytes(free)));
    }
    text.push_str(&format!("operations  {:9.2} GOP, two per multiply-add\n", ops * 1e-9));
    for stage in cost.stages().iter().filter(|s| s.macs() > 0) {
        let share = 100.0 * stage.macs() as f64 / cost.macs() as f64;
        text.push_str(&format!("  {:<11} {:7.2} GOP  {share:4.1} %\n", stage.name, 2e-9 * stage.macs() as f64));
    }
    text.push_str(&format!(
        "time        about {fast:.2} to {slow:.2} s on {threads} threads: an estimate, {:.0} to {:.0} % of what they reach \
         now ({:.0} GFLOP/s f32, {:.0} GOP/s int8, {}); bench measures\n",
        100.0 * REACHED.0,
        100.0 * REACHED.1,
        peak.f32 * 1e-9,
        peak.s8 * 1e-9,
        kernels.isa.name()
    ));
    console.report(&json, &text)?;
    if !fits_budget {
        let why = format!("needs {}, the budget is {}", human_bytes(session), human_bytes(budget));
        return Err(Error::resource("plan", format!("{why}: use fewer or smaller frames, or run the clip in windows")));
    }
    match free {
        Some(free) if !fits_memory => {
            let why = format!("needs {} more, {} are free", human_bytes(total - own - weights), human_bytes(free));
            Err(Error::resource("plan", format!("{why}: use fewer or smaller frames, or run the clip in windows")))
        }
        _ => Ok(()),
    }
}
