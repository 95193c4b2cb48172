//! Times every layer of the list with criterion, then prints a Markdown table: median time, operations and bytes a second, and the
//! share of the peak that the same threads reached in the same run.
//!
//! `STREETFORWARD_THREADS` sets the threads (1 by default), `STREETFORWARD_CPU` the kernels, `STREETFORWARD_BENCH=all` times every kernel
//! set of this CPU.

use criterion::{Criterion, Throughput};
use sf_bench::{Layer, Peak, layers};
use sf_ops::{Ctx, Kernels, par::Pool, peak};
use std::path::{Path, PathBuf};
use std::time::Duration;

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
    group: String,
    layer: Layer,
    kernel: &'static str,
    peak: f64,
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
        .sample_size(20)
        .warm_up_time(Duration::from_millis(200))
        .measurement_time(Duration::from_millis(800))
        .configure_from_args();
    let mut rows = Vec::new();
    for kernels in sets {
        let ctx = Ctx { pool: &pool, kernels };
        for mut layer in layers(ctx) {
            let group = format!("{} ({})", layer.kind, kernels.isa.name());
            let time = Duration::from_millis(20);
            let probe = || match layer.peak {
                Peak::F32 => peak::together(threads, || peak::flops_per_second(kernels, time)),
                Peak::S8 => peak::together(threads, || peak::s8_ops_per_second(kernels, time)),
                Peak::Memory => 0.0,
            };
            let before = probe();
            let mut g = criterion.benchmark_group(&group);
            if layer.ops > 0.0 {
                g.throughput(Throughput::Elements(layer.ops as u64));
            } else {
                g.throughput(Throughput::Bytes(layer.bytes as u64));
            }
            g.bench_function(&layer.size, |b| b.iter(|| (layer.run)(ctx)));
            g.finish();
            let peak = before.max(match layer.peak {
                Peak::F32 => peak::together(threads, || peak::flops_per_second(kernels, time)),
                Peak::S8 => peak::together(threads, || peak::s8_ops_per_second(kernels, time)),
                Peak::Memory => 0.0,
            });
            let kernel = match layer.peak {
                Peak::F32 if layer.kind.ends_with("f32") => kernels.gemm_f32.name,
                Peak::F32 => kernels.gemm_f16.name,
                Peak::S8 => kernels.product_s8.name,
                Peak::Memory => kernels.vector.name,
            };
            rows.push(Row { group, layer, kernel, peak });
        }
    }
    println!("\n| layer | size | kernel | ms | GOP/s | GB/s | of peak |\n|---|---|---|---|---|---|---|");
    for Row { group, layer, kernel, peak } in rows {
        let Some(seconds) = median(&root, &group, &layer.size) else { continue };
        let rate = layer.ops / seconds;
        let (rate, share) = if layer.ops > 0.0 {
            (format!("{:.1}", rate * 1e-9), format!("{:.0} %", 100.0 * rate / peak))
        } else {
            (String::new(), String::new())
        };
        let Layer { kind, size, bytes, .. } = layer;
        println!(
            "| {kind} | {size} | {kernel} | {:.3} | {rate} | {:.1} | {share} |",
            seconds * 1e3,
            bytes / seconds * 1e-9
        );
    }
}
