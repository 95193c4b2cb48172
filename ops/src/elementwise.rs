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
    // One task per line of patches: p output lines.
    ctx.pool.chunks(out.data, p * line, &|py, piece, _| {
        for px in 0..pw {
            let row = x.row(py * pw + px);
            match p {
                2 => spread::<2>(row, piece, (line, px, all)),
                7 => spread::<7>(row, piece, (line, px, all)),
                14 => spread::<14>(row, piece, (line, px, all)),
                _ => {
                    for (i, &v) in row.iter().enumerate() {
                        piece[i / p % p * line + (px * p + i % p) * all + i / (p * p)] = v;
                    }
                }
            }
        }
        if g > 0 {
            let beside = &beside.data[py * p * width * g..][..p * width * g];
            for (pixel, others) in piece.chunks_exact_mut(all).zip(beside.chunks_exact(g)) {
                pixel[c..].copy_from_slice(others);
            }
        }
    });
}

/// One patch of [`pixel_shuffle_beside`] with `P` pixels a side into its P output lines of `line` values: the usual sides
/// are known at compile time, so that the inner loops are straight runs.
fn spread<const P: usize>(row: &[f32], lines: &mut [f32], (line, px, all): (usize, usize, usize)) {
    for dy in 0..P {
        let patch = &mut lines[dy * line + px * P * all..][..P * all];
        for (ch, values) in row.chunks_exact(P * P).enumerate() {
            let from: &[f32; P] = values[dy * P..].first_chunk().expect("a line of a patch");
            let to = &mut patch[ch..][..(P - 1) * all + 1];
            for dx in 0..P {
                to[dx * all] = from[dx];
            }
        }
    }
}
