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

/// Operations per second of one thread.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Rates {
    /// In the best round, some 20 microseconds: what the CPU can do.
    pub best: f64,
    /// Over the whole time: what it had to give while others shared it.
    pub mean: f64,
}

/// Rounds of `round`, which does some operations and returns how many, for `time` or at least once.
fn rates(time: Duration, mut round: impl FnMut() -> f64) -> Rates {
    let start = Instant::now();
    let (mut best, mut all) = (0.0f64, 0.0);
    loop {
        let t = Instant::now();
        let ops = round();
        best = best.max(ops / t.elapsed().as_secs_f64().max(1e-9));
        all += ops;
        if start.elapsed() >= time {
            return Rates { best, mean: all / start.elapsed().as_secs_f64().max(1e-9) };
        }
    }
}

/// f32 operations per second (two per multiply-add) that one thread reaches in `time`, with these kernels.
pub fn flops(kernels: &Kernels, time: Duration) -> Rates {
    let mut seed = 0.25f32;
    // The sum feeds the next start, so no round can be dropped.
    let mut of = |width, vectors: f64, time| {
        rates(time, || {
            seed = kernels.peak(width, seed).clamp(0.125, 0.25);
            2.0 * 16.0 * vectors * STEPS as f64
        })
    };
    let (six, twelve) = (of(Width::Six, 6.0, time / 2), of(Width::Twelve, 12.0, time / 2));
    Rates { best: six.best.max(twelve.best), mean: six.mean.max(twelve.mean) }
}

/// int8 operations per second (two per multiply-add) that one thread reaches in `time`, with the dot product of these kernels.
pub fn s8_ops(kernels: &Kernels, time: Duration) -> Rates {
    let mut seed = 1;
    rates(time, || {
        seed = kernels.peak_s8(seed);
        // Four products for each output of the tile.
        2.0 * 4.0 * (kernels.product_s8.mr * kernels.product_s8.nr * PEAK_STEPS) as f64
    })
}

/// Most f32 operations per second of one thread in `time`.
pub fn flops_per_second(kernels: &Kernels, time: Duration) -> f64 {
    flops(kernels, time).best
}

/// Most int8 operations per second of one thread in `time`.
pub fn s8_ops_per_second(kernels: &Kernels, time: Duration) -> f64 {
    s8_ops(kernels, time).best
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
