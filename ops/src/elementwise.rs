//! Element-wise operations on whole buffers.

use crate::activation::Map;
use crate::cpu::Ctx;
use crate::opclock::{self, Op, Work};
use crate::simd::{Body, LANES, Simd, Vector, padded};
use std::sync::atomic::{AtomicBool, Ordering};

/// Values of one task: 64 KiB, so that a region pays for its microsecond.
const TASK: usize = 1 << 14;

fn map(ctx: Ctx, op: Map, x: &mut [f32]) {
    let _span = opclock::span(Op::Elementwise, || Work::values(x.len()));
    ctx.pool.chunks(x, TASK, &|_, piece, _| ctx.kernels.map(op, piece));
}

/// x = max(x, 0); NaN stays.
pub fn relu(ctx: Ctx, x: &mut [f32]) {
    map(ctx, Map::Relu, x);
}

/// x = e^x.
pub fn exp_in_place(ctx: Ctx, x: &mut [f32]) {
    map(ctx, Map::Exp, x);
}

/// x = 1 / (1 + e^-x).
pub fn sigmoid_in_place(ctx: Ctx, x: &mut [f32]) {
    map(ctx, Map::Sigmoid, x);
}

/// x = gelu(x), erf form.
pub fn gelu_in_place(ctx: Ctx, x: &mut [f32]) {
    map(ctx, Map::Gelu, x);
}

/// x += y.
#[inline(always)]
pub(crate) fn add_body<S: Simd>(s: S, x: &mut [f32], y: &[f32]) {
    let (xb, xt) = x.as_chunks_mut::<LANES>();
    let (yb, yt) = y.as_chunks::<LANES>();
    for (x, y) in xb.iter_mut().zip(yb) {
        (s.load(x) + s.load(y)).store(x);
    }
    if !xt.is_empty() {
        let mut sum = [0.0; LANES];
        (s.load(&padded(xt, 0.0)) + s.load(&padded(yt, 0.0))).store(&mut sum);
        xt.copy_from_slice(&sum[..xt.len()]);
    }
}

/// out = x + y.
pub fn add(ctx: Ctx, x: &[f32], y: &[f32], out: &mut [f32]) {
    assert!(x.len() == y.len() && x.len() == out.len(), "{} + {} -> {} values", x.len(), y.len(), out.len());
    let _span = opclock::span(Op::Elementwise, || Work::values(3 * x.len() / 2));
    ctx.pool.chunks(out, TASK, &|i, piece, _| {
        piece.copy_from_slice(&x[i * TASK..][..piece.len()]);
        ctx.kernels.add(piece, &y[i * TASK..][..piece.len()]);
    });
}

/// x = x + y.
pub fn add_assign(ctx: Ctx, x: &mut [f32], y: &[f32]) {
    assert_eq!(x.len(), y.len(), "lengths of a sum");
    let _span = opclock::span(Op::Elementwise, || Work::values(3 * x.len() / 2));
    ctx.pool.chunks(x, TASK, &|i, piece, _| ctx.kernels.add(piece, &y[i * TASK..][..piece.len()]));
}

/// Whether no value is NaN or infinite.
struct Finite<'a>(&'a [f32]);

impl Body for Finite<'_> {
    type Output = bool;

    /// x * 0 is NaN for NaN and infinities and stays so in a sum; four sums, because one waits four cycles for each.
    #[inline(always)]
    fn run<S: Simd>(self, s: S) -> bool {
        let (blocks, tail) = self.0.as_chunks::<LANES>();
        let (rounds, rest) = blocks.as_chunks::<4>();
        let zero = s.splat(0.0);
        let mut odd = [zero; 4];
        for round in rounds {
            for i in 0..4 {
                odd[i] = s.load(&round[i]).mul_add(zero, odd[i]);
            }
        }
        for block in rest {
            odd[0] = s.load(block).mul_add(zero, odd[0]);
        }
        odd[1] = s.load(&padded(tail, 0.0)).mul_add(zero, odd[1]);
        let mut lanes = [0.0; LANES];
        ((odd[0] + odd[1]) + (odd[2] + odd[3])).store(&mut lanes);
        lanes.iter().all(|v| *v == 0.0)
    }
}

/// Whether no value is NaN or infinite, by the threads of the pool.
pub fn all_finite(ctx: Ctx, x: &[f32]) -> bool {
    // 128 KiB, some five microseconds of one thread: less is not worth a region.
    const TASK: usize = 1 << 15;
    let _span = opclock::span(Op::Glue, || Work { macs: 0, bytes: 4 * x.len() as u64 });
    let bad = AtomicBool::new(false);
    ctx.pool.run(x.len().div_ceil(TASK), &|task, _| {
        let piece = &x[task * TASK..x.len().min((task + 1) * TASK)];
        if !ctx.kernels.enter(Finite(piece)) {
            bad.store(true, Ordering::Relaxed);
        }
    });
    !bad.into_inner()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::cpu::Kernels;
    use crate::par::Pool;

    #[test]
    fn only_nan_and_infinity_are_not_finite() {
        let pool = Pool::new(2).unwrap();
        for kernels in Kernels::available() {
            let ctx = Ctx { pool: &pool, kernels };
            // In every task, every chain, the last and shorter vector included.
            let mut x = vec![f32::MAX; 70_007];
            x[3] = f32::MIN_POSITIVE / 4.0;
            x[4] = f32::MIN;
            assert!(all_finite(ctx, &x));
            assert!(all_finite(ctx, &[]));
            for bad in [f32::NAN, -f32::NAN, f32::INFINITY, f32::NEG_INFINITY] {
                for at in [0, 16, 47, 63, 64, 32_767, 32_768, 69_990, 70_000, 70_006] {
                    let kept = std::mem::replace(&mut x[at], bad);
                    assert!(!all_finite(ctx, &x), "{bad} at {at}");
                    x[at] = kept;
                }
            }
        }
    }
}
