//! Layer norm: y = (x - mean) / sqrt(var + eps) * gain + offset over each row, biased variance.
//!
//! Two passes over the row (mean, then squared distances). Sums run in four chains of 16 lanes and fold in one fixed tree, so the
//! bits are the same on every CPU; rows are independent.

use crate::cpu::Ctx;
use crate::mat::{Mat, MatMut};
use crate::opclock::{self, Op, Work};
use crate::par::SharedMut;
use crate::simd::{LANES, Simd, Vector, fold_add, padded};

/// One row of a layer norm.
pub(crate) struct NormRow<'a> {
    /// Values.
    pub x: &'a [f32],
    /// As long as `x`.
    pub gain: &'a [f32],
    /// As long as `x`.
    pub offset: &'a [f32],
    /// Added to the variance.
    pub eps: f32,
    /// As long as `x`.
    pub out: &'a mut [f32],
}

/// Chains of a sum: one alone takes an addition's latency per vector, four cycles where two vectors could be read in one.
const CHAINS: usize = 4;

/// Sum of the values, or with `SQUARES` of their squared distances from `m`: four chains over whole vectors, on the first of them
/// also what is left over and a last vector padded with `pad`.
#[inline(always)]
fn chained<S: Simd, const SQUARES: bool>(s: S, x: &[f32], m: S::V, pad: f32) -> f32 {
    let (blocks, tail) = x.as_chunks::<LANES>();
    let (rounds, rest) = blocks.as_chunks::<CHAINS>();
    let mut sums = [s.splat(0.0); CHAINS];
    for round in rounds {
        for c in 0..CHAINS {
            sums[c] = term::<S, SQUARES>(s.load(&round[c]), m, sums[c]);
        }
    }
    for b in rest {
        sums[0] = term::<S, SQUARES>(s.load(b), m, sums[0]);
    }
    if !tail.is_empty() {
        sums[0] = term::<S, SQUARES>(s.load(&padded(tail, pad)), m, sums[0]);
    }
    fold_add((sums[0] + sums[1]) + (sums[2] + sums[3]))
}

/// One more value on a sum.
#[inline(always)]
fn term<S: Simd, const SQUARES: bool>(v: S::V, m: S::V, sum: S::V) -> S::V {
    if SQUARES {
        let d = v - m;
        d.mul_add(d, sum)
    } else {
        sum + v
    }
}

/// (mean, 1 / sqrt(var + eps)) of a row.
#[inline(always)]
pub(crate) fn moments<S: Simd>(s: S, x: &[f32], eps: f32) -> (f32, f32) {
    let n = x.len() as f32;
    let mean = chained::<S, false>(s, x, s.splat(0.0), 0.0) / n;
    let squares = chained::<S, true>(s, x, s.splat(mean), mean);
    (mean, 1.0 / (squares / n + eps).sqrt())
}

/// Normalises one row.
#[inline(always)]
pub(crate) fn norm_row<S: Simd>(s: S, row: NormRow) {
    let NormRow { x, gain, offset, eps, out } = row;
    let (mean, scale) = moments(s, x, eps);
    let (m, k) = (s.splat(mean), s.splat(scale));
    let (xb, xt) = x.as_chunks::<LANES>();
    let (gb, gt) = gain.as_chunks::<LANES>();
    let (ob, ot) = offset.as_chunks::<LANES>();
    let (yb, yt) = out.as_chunks_mut::<LANES>();
    for (((x, g), o), y) in xb.iter().zip(gb).zip(ob).zip(yb) {
        ((s.load(x) - m) * k).mul_add(s.load(g), s.load(o)).store(y);
    }
    if !xt.is_empty() {
        let mut y = [0.0; LANES];
        let x = s.load(&padded(xt, mean));
        ((x - m) * k).mul_add(s.load(&padded(gt, 0.0)), s.load(&padded(ot, 0.0))).store(&mut y);
        yt.copy_from_slice(&y[..yt.len()]);
    }
}

/// Values of one task: about 64 KiB.
const TASK: usize = 1 << 14;

/// Normalises every row of `x` `[rows, cols]` into `out` of the same size; `gain` and `offset` have `cols`
/// values.
pub fn layernorm(ctx: Ctx, x: Mat, gain: &[f32], offset: &[f32], eps: f32, out: MatMut) {
    let (rows, cols) = (x.rows, x.cols);
    assert_eq!((out.rows, out.cols), (rows, cols), "output of a layer norm");
    assert!(
        gain.len() == cols && offset.len() == cols,
        "{} gains, {} offsets, {cols} columns",
        gain.len(),
        offset.len()
    );
    if cols == 0 {
        return;
    }
    let _span = opclock::span(Op::Norm, || Work::values(rows * cols));
    let per_task = (TASK / cols).max(1);
    let stride = out.stride;
    let shared = SharedMut::new(out.data);
    ctx.pool.run(rows.div_ceil(per_task), &|task, _| {
        for r in task * per_task..((task + 1) * per_task).min(rows) {
            // SAFETY: rows are disjoint (stride >= cols) and each belongs to one task.
            #[allow(unsafe_code)]
            let y = unsafe { shared.slice(r * stride..r * stride + cols) };
            ctx.kernels.norm(NormRow { x: x.row(r), gain, offset, eps, out: y });
        }
    });
}
