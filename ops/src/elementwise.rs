//! Element-wise operations on whole buffers, and the pixel shuffle.

use crate::activation::Map;
use crate::cpu::Ctx;
use crate::mat::{HwcMut, Mat};
use crate::simd::{LANES, Simd, Vector, padded};

/// Values of one task: 64 KiB, so that a region pays for its microsecond.
const TASK: usize = 1 << 14;

fn map(ctx: Ctx, op: Map, x: &mut [f32]) {
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
    ctx.pool.chunks(out, TASK, &|i, piece, _| {
        piece.copy_from_slice(&x[i * TASK..][..piece.len()]);
        ctx.kernels.add(piece, &y[i * TASK..][..piece.len()]);
    });
}

/// x = x + y.
pub fn add_assign(ctx: Ctx, x: &mut [f32], y: &[f32]) {
    assert_eq!(x.len(), y.len(), "lengths of a sum");
    ctx.pool.chunks(x, TASK, &|i, piece, _| ctx.kernels.add(piece, &y[i * TASK..][..piece.len()]));
}

/// Column `ch * p * p + dy * p + dx` of patch (y, x) fills pixel (y p + dy, x p + dx) of channel ch:
/// `x` `[ph * pw, c * p * p]` -> `out` `[ph * p, pw * p, c]`.
pub fn pixel_shuffle(ctx: Ctx, x: Mat, grid: (usize, usize), p: usize, out: HwcMut) {
    let (ph, pw) = grid;
    let c = out.c;
    assert_eq!((x.rows, x.cols), (ph * pw, c * p * p), "{ph} x {pw} patches of {p} x {p} x {c}");
    assert_eq!((out.h, out.w), (ph * p, pw * p), "shuffled size");
    let line = out.w * c;
    if line == 0 {
        return;
    }
    // One task per output line.
    ctx.pool.chunks(out.data, line, &|oy, piece, _| {
        for (px, patch) in piece.chunks_exact_mut(p * c).enumerate() {
            let row = &x.row(oy / p * pw + px)[oy % p * p..];
            for (dx, pixel) in patch.chunks_exact_mut(c).enumerate() {
                for (ch, v) in pixel.iter_mut().enumerate() {
                    *v = row[ch * p * p + dx];
                }
            }
        }
    });
}
