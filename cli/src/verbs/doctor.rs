//! `doctor`: the machine as the engine sees it, to paste into a report.

use crate::args;
use crate::machine::{Machine, kernels_json};
use crate::output::{Console, human_bytes};
use serde_json::{Value, json};
use sf_formats::Result;
use sf_ops::Kernels;
use sf_ops::cpu::Isa;
use sf_ops::peak;
use std::time::Duration;

/// What to describe.
#[derive(clap::Args)]
pub(crate) struct Args {
    /// Highest instruction set to use: scalar, avx2, avxvnni, avx512, avx512vnni, neon, neondot
    #[arg(long, value_name = "ISA", value_parser = args::isa)]
    isa: Option<Isa>,
}

/// Time of each peak probe: long enough for a core to reach its clock, short enough to wait for.
const PROBE: Duration = Duration::from_millis(200);

/// Prints the report.
pub(crate) fn run(args: &Args, console: &Console) -> Result<()> {
    let chosen = args::kernels(args.isa)?;
    let m = Machine::probe();
    let (f32_peak, s8_peak) = (peak::flops_per_second(chosen, PROBE), peak::s8_ops_per_second(chosen, PROBE));
    let json = json!({
        "schema": "streetforward.doctor/1",
        "version": env!("CARGO_PKG_VERSION"),
        "os": std::env::consts::OS,
        "arch": std::env::consts::ARCH,
        "cpu": m.cpu,
        "logical_cpus": m.logical_cpus,
        "allowed_threads": m.allowed_threads,
        "memory_total_bytes": m.memory_total_bytes,
        "memory_available_bytes": m.memory_available_bytes,
        "memory_limit_bytes": m.memory_limit_bytes,
        "governor": m.governor,
        "kernels": kernels_json(chosen),
        "peak_f32_gflops_per_core": f32_peak / 1e9,
        "peak_s8_gops_per_core": s8_peak / 1e9,
        "available": Kernels::available().map(kernels_json).collect::<Value>(),
    });
    let size = |n: Option<u64>| n.map_or_else(|| "unknown".into(), human_bytes);
    let mut text = String::new();
    let mut row = |name: &str, value: String| text.push_str(&format!("{name:<12} {value}\n"));
    row("streetforward", env!("CARGO_PKG_VERSION").into());
    row("system", format!("{} {}", std::env::consts::OS, std::env::consts::ARCH));
    row("processor", m.cpu.unwrap_or_else(|| "unknown".into()));
    row(
        "threads",
        format!("{} allowed of {} logical", m.allowed_threads, m.logical_cpus.map_or("?".into(), |n| n.to_string())),
    );
    row("memory", format!("{} free of {}", size(m.memory_available_bytes), size(m.memory_total_bytes)));
    if let Some(limit) = m.memory_limit_bytes {
        row("limit", human_bytes(limit));
    }
    row("governor", m.governor.unwrap_or_else(|| "unknown".into()));
    let names: Vec<&str> = Kernels::available().map(|k| k.isa.name()).collect();
    row("isa", format!("{} of {}", chosen.isa.name(), names.join(", ")));
    for (family, name) in chosen.rows() {
        row(family, name.into());
    }
    row("peak", format!("{:.0} GFLOP/s f32, {:.0} GOP/s int8, one core", f32_peak / 1e9, s8_peak / 1e9));
    console.report(&json, &text)
}
