//! `doctor`: the machine as the engine sees it, to paste into a report.

use crate::args;
use crate::output::{Console, human_bytes};
use serde_json::{Value, json};
use sf_formats::Result;
use sf_ops::Kernels;
use sf_ops::cpu::Isa;
use sf_ops::peak;
use std::fs;
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

/// Name and kernels of one instruction set.
fn kernels_json(k: &Kernels) -> Value {
    json!({
        "isa": k.isa.name(),
        "gemm_f32": k.gemm_f32.name,
        "gemm_f16": k.gemm_f16.name,
        "gemm_s8": k.gemm_s8.name,
        "vector": k.vector.name,
    })
}

/// What the operating system tells about the machine; unknown where it tells nothing.
struct Machine {
    cpu: Option<String>,
    logical_cpus: Option<usize>,
    allowed_threads: usize,
    memory_total_bytes: Option<u64>,
    memory_available_bytes: Option<u64>,
    memory_limit_bytes: Option<u64>,
    governor: Option<String>,
}

/// The value after the first `key : value` line of a text like `/proc/cpuinfo`.
fn field<'a>(text: &'a str, key: &str) -> Option<&'a str> {
    text.lines().find_map(|l| l.split_once(':').filter(|(k, _)| k.trim() == key).map(|(_, v)| v.trim()))
}

/// A `/proc/meminfo` amount, which is in KiB.
fn meminfo(text: &str, key: &str) -> Option<u64> {
    field(text, key)?.split_whitespace().next()?.parse::<u64>().ok()?.checked_mul(1024)
}

impl Machine {
    fn probe() -> Machine {
        let read = |path: &str| fs::read_to_string(path).ok();
        let cpuinfo = read("/proc/cpuinfo").unwrap_or_default();
        let memory = read("/proc/meminfo").unwrap_or_default();
        let cpus = cpuinfo.lines().filter(|l| l.split(':').next().is_some_and(|k| k.trim() == "processor")).count();
        let name = ["model name", "Model", "Hardware", "CPU part"].iter().find_map(|k| field(&cpuinfo, k));
        Machine {
            cpu: name.map(str::to_string),
            logical_cpus: (cpus > 0).then_some(cpus),
            allowed_threads: std::thread::available_parallelism().map_or(1, usize::from),
            memory_total_bytes: meminfo(&memory, "MemTotal"),
            memory_available_bytes: meminfo(&memory, "MemAvailable"),
            memory_limit_bytes: read("/sys/fs/cgroup/memory.max").and_then(|t| t.trim().parse().ok()),
            governor: read("/sys/devices/system/cpu/cpu0/cpufreq/scaling_governor").map(|t| t.trim().to_string()),
        }
    }
}

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
    let names = [chosen.gemm_f32.name, chosen.gemm_f16.name, chosen.gemm_s8.name, chosen.vector.name];
    row("kernels", names.join(", "));
    row("peak", format!("{:.0} GFLOP/s f32, {:.0} GOP/s int8, one core", f32_peak / 1e9, s8_peak / 1e9));
    console.report(&json, &text)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn proc_texts_are_read() {
        let text = "processor\t: 0\nmodel name\t: Some CPU: 3 GHz\nprocessor\t: 1\n";
        assert_eq!(field(text, "model name"), Some("Some CPU: 3 GHz"));
        assert_eq!(field(text, "missing"), None);
        assert_eq!(meminfo("MemTotal:       16 kB\nMemAvailable: x kB\n", "MemTotal"), Some(16384));
        assert_eq!(meminfo("MemTotal:       16 kB\nMemAvailable: x kB\n", "MemAvailable"), None);
    }
}
