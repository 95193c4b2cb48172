//! Times every layer of the list with criterion, then prints a Markdown table: median time, operations and bytes a second, and the
//! share of the peak that the same threads reached in the same run.
//!
//! `STREETFORWARD_THREADS` sets the threads (1 by default), `STREETFORWARD_CPU` the kernels, `STREETFORWARD_BENCH=all` times every kernel
//! set of this CPU.

use criterion::{Criterion, Throughput};
use sf_bench::{Layer, Peak, layers};
use sf_ops::{Ctx, Kernels, par::Pool, peak};
use std::path::{Path, PathBuf};
use std::time::{Duration, Instant};

/// The median, in seconds, that criterion left for a bench; none when it was filtered out.
fn median(root: &Path, group: &str, id: &str) -> Option<f64> {
    // Criterion replaces what file names cannot hold.
    let safe = |s: &str| s.replace(['?', '"', '/', '\\', '*', '<', '>', ':', '|', '^'], "_");
    let path = root.join(safe(group)).join(safe(id)).join("new/estimates.json");
    let text = std::fs::read_to_string(path).ok()?;
    let after = text.split("\"median\"").nth(1)?.split("\"point_estimate\":").nth(1)?;
    let number = after.split(['}', ',']).next()?;
    number.trim().parse::<f64>().ok().map(|nanoseconds| nanoseconds * 1e-9)
}

struct Row {
    kind: &'static str,
    size: String,
    kernel: &'static str,
    seconds: f64,
    ops: f64,
    bytes: f64,
    share: Option<f64>,
}

/// Time of a probe of the peak.
const PROBE: Duration = Duration::from_millis(8);
/// Runs between two probes take so long or longer.
const RUNS: f64 = 8e-3;
/// Pairs of probe and runs.
const ROUNDS: usize = 9;

/// Median over rounds of the rate over the peak that the same threads reach right before and after, both as means over some milliseconds:
/// clocks and what neighbours leave drift by a quarter within seconds on shared machines. None for passes over memory.
fn share(layer: &mut Layer, ctx: Ctx) -> Option<f64> {
    let probe = || {
        let threads = ctx.pool.threads();
        match layer.peak {
            Peak::F32 => Some(peak::together(threads, || peak::flops(ctx.kernels, PROBE).mean)),
            Peak::S8 => Some(peak::together(threads, || peak::s8_ops(ctx.kernels, PROBE).mean)),
            Peak::Memory => None,
        }
    };
    let mut shares = Vec::new();
    let mut before = probe()?;
    for _ in 0..ROUNDS {
        let start = Instant::now();
        let mut runs = 0;
        while runs == 0 || start.elapsed().as_secs_f64() < RUNS {
            (layer.run)(ctx);
            runs += 1;
        }
        let rate = f64::from(runs) * layer.ops / start.elapsed().as_secs_f64();
        let after = probe()?;
        shares.push(rate / ((before + after) / 2.0));
        before = after;
    }
    shares.sort_by(f64::total_cmp);
    Some(shares[ROUNDS / 2])
}

fn main() {
    let root = PathBuf::from(env!("CARGO_MANIFEST_DIR")).join("target/criterion");
    // Only results of this run go into the table.
    let _ = std::fs::remove_dir_all(&root);
    let threads = std::env::var("STREETFORWARD_THREADS").ok().and_then(|v| v.parse().ok()).unwrap_or(1);
    let pool = Pool::new(threads).expect("threads");
    let sets: Vec<&'static Kernels> = match std::env::var("STREETFORWARD_BENCH").as_deref() {
        Ok("all") => Kernels::available().collect(),
        _ => vec![Kernels::best()],
    };
    let mut criterion = Criterion::default()
        .output_directory(&root)
        .sample_size(15)
        .warm_up_time(Duration::from_millis(100))
        .measurement_time(Duration::from_millis(500))
        .configure_from_args();
    let mut rows = Vec::new();
    for kernels in sets {
        let ctx = Ctx { pool: &pool, kernels };
        for make in layers() {
            let mut layer = make(ctx);
            let group = format!("{} ({})", layer.kind, kernels.isa.name());
            let mut g = criterion.benchmark_group(&group);
            if layer.ops > 0.0 {
                g.throughput(Throughput::Elements(layer.ops as u64));
            } else {
                g.throughput(Throughput::Bytes(layer.bytes as u64));
            }
            g.bench_function(&layer.size, |b| b.iter(|| (layer.run)(ctx)));
            g.finish();
            let Some(seconds) = median(&root, &group, &layer.size) else { continue };
            let share = share(&mut layer, ctx);
            let kernel = match layer.peak {
                Peak::F32 if layer.kind.ends_with("f32") => kernels.gemm_f32.name,
                Peak::F32 => kernels.gemm_f16.name,
                Peak::S8 => kernels.product_s8.name,
                Peak::Memory => kernels.vector.name,
            };
            let Layer { kind, size, ops, bytes, .. } = layer;
            rows.push(Row { kind, size, kernel, seconds, ops, bytes, share });
        }
    }
    println!("\n| layer | size | kernel | ms | GOP/s | GB/s | of peak |\n|---|---|---|---|---|---|---|");
    for Row { kind, size, kernel, seconds, ops, bytes, share } in rows {
        let rate = if ops > 0.0 { format!("{:.1}", ops / seconds * 1e-9) } else { String::new() };
        let share = share.map_or(String::new(), |s| format!("{:.0} %", 100.0 * s));
        let gigabytes = bytes / seconds * 1e-9;
        println!("| {kind} | {size} | {kernel} | {:.3} | {rate} | {gigabytes:.1} | {share} |", seconds * 1e3);
    }
}
