//! Element-wise operations on whole buffers, and the pixel shuffle.

use crate::activation::Map;
use crate::cpu::Ctx;
use crate::mat::{Hwc, HwcMut, Mat};
use crate::opclock::{self, Op, Work};
use crate::simd::{LANES, Simd, Vector, padded};

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

/// Column `ch * p * p + dy * p + dx` of patch (y, x) fills pixel (y p + dy, x p + dx) of channel ch:
/// `x` `[ph * pw, c * p * p]` -> `out` `[ph * p, pw * p, c]`.
pub fn pixel_shuffle(ctx: Ctx, x: Mat, grid: (usize, usize), p: usize, out: HwcMut) {
    let nothing = Hwc::new(&[], out.h, out.w, 0);
    pixel_shuffle_beside(ctx, x, grid, p, nothing, out);
}

/// [`pixel_shuffle`] of `x` `[ph * pw, c * p * p]` to the first c channels of every pixel, those of `beside`
/// `[ph * p, pw * p, g]` after them: `out` `[ph * p, pw * p, c + g]`.
pub fn pixel_shuffle_beside(ctx: Ctx, x: Mat, grid: (usize, usize), p: usize, beside: Hwc, out: HwcMut) {
    let (ph, pw) = grid;
    let (all, g) = (out.c, beside.c);
    let c = all.checked_sub(g).unwrap_or_else(|| panic!("{g} channels beside others do not fit {all}"));
    assert_eq!((beside.h, beside.w), (out.h, out.w), "size of what stands beside");
    assert_eq!((x.rows, x.cols), (ph * pw, c * p * p), "{ph} x {pw} patches of {p} x {p} x {c}");
    assert_eq!((out.h, out.w), (ph * p, pw * p), "shuffled size");
    let (line, width) = (out.w * all, out.w);
    if line == 0 {
        return;
    }
    let _span = opclock::span(Op::Resize, || Work::values(out.data.len()));
    // One task per output line.
    ctx.pool.chunks(out.data, line, &|oy, piece, _| {
        for (px, patch) in piece.chunks_exact_mut(p * all).enumerate() {
            let row = &x.row(oy / p * pw + px)[oy % p * p..];
            for (dx, pixel) in patch.chunks_exact_mut(all).enumerate() {
                let (own, others) = pixel.split_at_mut(c);
                for (ch, v) in own.iter_mut().enumerate() {
                    *v = row[ch * p * p + dx];
                }
                others.copy_from_slice(&beside.data[(oy * width + px * p + dx) * g..][..g]);
            }
        }
    });
}
