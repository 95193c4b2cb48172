//! The arithmetic peak of one core: a loop of independent fused multiply-adds (or byte dot products) in registers.
//!
//! `doctor` and `bench` state kernel speeds as a share of it.

use crate::cpu::Kernels;
use crate::gemm::s8::tile::PEAK_STEPS;
use crate::simd::{Simd, Vector, fold_add};
use std::time::{Duration, Instant};

/// Steps between two looks at the clock: some 50 microseconds.
const STEPS: usize = 1 << 13;

/// `STEPS` fused multiply-adds in each of `N` independent vectors. Starts differ, so that no two are merged.
#[inline(always)]
fn chains<S: Simd, const N: usize>(s: S, seed: f32) -> f32 {
    let mut acc = [s.splat(seed); N];
    for (i, a) in acc.iter_mut().enumerate() {
        *a = s.splat(seed * i as f32);
    }
    let (x, y) = (s.splat(seed), s.splat(0.5));
    for _ in 0..STEPS {
        for a in &mut acc {
            *a = a.mul_add(y, x);
        }
    }
    acc.iter().map(|a| fold_add(*a)).sum()
}

/// Six vectors (twelve registers with AVX2, its limit) or twelve (enough for two 512-bit units of latency 4).
#[inline(always)]
pub(crate) fn peak_body<S: Simd>(s: S, wide: Width, seed: f32) -> f32 {
    match wide {
        Width::Six => chains::<S, 6>(s, seed),
        Width::Twelve => chains::<S, 12>(s, seed),
    }
}

/// Independent vectors in the loop.
#[derive(Clone, Copy, Debug)]
pub(crate) enum Width {
    Six,
    Twelve,
}

/// Most f32 operations per second (two per multiply-add) that one thread reached in `time`, with these kernels.
pub fn flops_per_second(kernels: &Kernels, time: Duration) -> f64 {
    let start = Instant::now();
    let mut best = 0.0f64;
    let mut seed = 0.25f32;
    while best == 0.0 || start.elapsed() < time {
        for (width, vectors) in [(Width::Six, 6.0), (Width::Twelve, 12.0)] {
            let t = Instant::now();
            // The sum feeds the next start, so no round can be dropped.
            seed = kernels.peak(width, seed).clamp(0.125, 0.25);
            let ops = 2.0 * 16.0 * vectors * STEPS as f64;
            best = best.max(ops / t.elapsed().as_secs_f64().max(1e-9));
        }
    }
    best
}

/// Most int8 operations per second (two per multiply-add) that one thread reached in `time`, with the dot product of these
/// kernels.
pub fn s8_ops_per_second(kernels: &Kernels, time: Duration) -> f64 {
    let start = Instant::now();
    let mut best = 0.0f64;
    let mut seed = 1;
    while best == 0.0 || start.elapsed() < time {
        let t = Instant::now();
        seed = kernels.peak_s8(seed);
        // Four products for each output of the tile.
        let ops = 2.0 * 4.0 * (kernels.product_s8.mr * kernels.product_s8.nr * PEAK_STEPS) as f64;
        best = best.max(ops / t.elapsed().as_secs_f64().max(1e-9));
    }
    best
}

/// Sum of what `probe` ([`flops_per_second`] or [`s8_ops_per_second`]) gives on `threads` threads at once, operations per second: cores
/// share clock and power.
pub fn together(threads: usize, probe: impl Fn() -> f64 + Sync) -> f64 {
    std::thread::scope(|s| {
        let others: Vec<_> = (1..threads).map(|_| s.spawn(&probe)).collect();
        probe() + others.into_iter().map(|t| t.join().unwrap_or(0.0)).sum::<f64>()
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_set_has_a_peak() {
        for k in Kernels::available() {
            let peak = flops_per_second(k, Duration::from_millis(1));
            println!("{}: {:.1} GFLOP/s", k.vector.name, peak * 1e-9);
            assert!(peak > 1e6 && peak < 1e13, "{peak} operations per second");
            let peak = s8_ops_per_second(k, Duration::from_millis(1));
            println!("{}: {:.1} GOP/s", k.product_s8.name, peak * 1e-9);
            assert!(peak > 1e6 && peak < 1e13, "{peak} operations per second");
        }
    }

    #[test]
    fn threads_add_up() {
        for threads in [1, 2, 5] {
            assert_eq!(together(threads, || 2.5), 2.5 * threads as f64);
        }
    }
}
