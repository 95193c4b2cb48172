//! Rows of f32 to int8, symmetric per row (token), optionally after a layer norm and a random-sign Hadamard rotation.
//!
//! For each row: m = max |x|, scale = m / 127, value = round(clamp(x * (127 / m), -127, 127)), ties to even; the inverse is
//! one true division. A row of zeros (or of values so small that 127 / m overflows, m below 3.8e-37) gives zeros and scale 0.
//! A row with a NaN or an infinity gives zeros and scale NaN, so that every product with it is NaN and cannot pass unseen.
//!
//! The rotation's factor 1/sqrt(block) multiplies the scale instead of the values: the integers do not change with it.
//! Everything happens in one pass over a row that stays in the first-level cache.

use crate::cpu::Ctx;
use crate::gemm::s8::pack::{RowsS8Mut, padded_k};
use crate::hadamard::{Rotation, rotate};
use crate::layernorm::{NormRow, moments, norm_row};
use crate::mat::Mat;
use crate::opclock::{self, Op, Work};
use crate::par::SharedMut;
use crate::simd::{LANES, Simd, Vector, padded};

/// Layer norm in front of a quantization.
#[derive(Clone, Copy, Debug)]
pub struct Norm<'a> {
    /// Gain and offset, one each per value; none when they are folded into the weights that follow.
    pub affine: Option<(&'a [f32], &'a [f32])>,
    /// Added to the variance.
    pub eps: f32,
}

/// What happens to a row before it is quantized, in this order.
#[derive(Clone, Copy, Debug, Default)]
pub struct Before<'a> {
    /// Layer norm.
    pub norm: Option<Norm<'a>>,
    /// Rotation.
    pub rotation: Option<Rotation<'a>>,
}

/// One row to be quantized.
pub(crate) struct QuantizeRow<'a> {
    pub x: &'a [f32],
    pub before: Before<'a>,
    /// As long as `x`.
    pub work: &'a mut [f32],
    /// `padded_k` values; those beyond `x` become zeros.
    pub out: &'a mut [i8],
}

/// (x - mean) / sqrt(var + eps).
#[inline(always)]
fn standardize<S: Simd>(s: S, x: &[f32], eps: f32, out: &mut [f32]) {
    let (mean, scale) = moments(s, x, eps);
    let (m, k) = (s.splat(mean), s.splat(scale));
    let (xb, xt) = x.as_chunks::<LANES>();
    let (yb, yt) = out.as_chunks_mut::<LANES>();
    for (x, y) in xb.iter().zip(yb) {
        ((s.load(x) - m) * k).store(y);
    }
    if !xt.is_empty() {
        let mut y = [0.0; LANES];
        ((s.load(&padded(xt, mean)) - m) * k).store(&mut y);
        yt.copy_from_slice(&y[..yt.len()]);
    }
}

/// (max |x|, whether every value is finite).
#[inline(always)]
fn largest<S: Simd>(s: S, x: &[f32]) -> (f32, bool) {
    let (blocks, tail) = x.as_chunks::<LANES>();
    let zero = s.splat(0.0);
    // x * 0 is NaN for NaN and infinities and stays so; the maximum drops NaN.
    let (mut max, mut odd) = (zero, zero);
    for b in blocks {
        let v = s.load(b);
        max = v.abs().max(max);
        odd = v.mul_add(zero, odd);
    }
    if !tail.is_empty() {
        let v = s.load(&padded(tail, 0.0));
        max = v.abs().max(max);
        odd = v.mul_add(zero, odd);
    }
    let (mut m, mut o) = ([0.0f32; LANES], [0.0f32; LANES]);
    max.store(&mut m);
    odd.store(&mut o);
    let m = m.into_iter().fold(0.0, |a, b| if b > a { b } else { a });
    (m, o.iter().all(|v| *v == 0.0))
}

/// To [-127, 127] by compare and select.
#[inline(always)]
pub(crate) fn clamp<S: Simd>(s: S, v: S::V) -> S::V {
    let top = s.splat(127.0);
    let v = s.splat(-127.0).max(v);
    v.select_gt(top, top, v)
}

/// Quantizes one row; returns its scale.
#[inline(always)]
pub(crate) fn quantize_row<S: Simd>(s: S, row: QuantizeRow) -> f32 {
    let QuantizeRow { x, before, work, out } = row;
    let work = &mut work[..x.len()];
    let mut factor = 1.0;
    let changed = before.norm.is_some() || before.rotation.is_some();
    match before.norm {
        Some(Norm { affine: Some((gain, offset)), eps }) => norm_row(s, NormRow { x, gain, offset, eps, out: work }),
        Some(Norm { affine: None, eps }) => standardize(s, x, eps, work),
        None if before.rotation.is_some() => work.copy_from_slice(x),
        None => {}
    }
    if let Some(rotation) = before.rotation {
        rotate(s, work, rotation.signs(), rotation.block());
        factor = rotation.normalizer();
    }
    let x = if changed { &*work } else { x };
    let (max, finite) = largest(s, x);
    let inverse = 127.0 / max;
    if !finite || !inverse.is_finite() {
        out.fill(0);
        return if finite { 0.0 } else { f32::NAN };
    }
    let k = s.splat(inverse);
    let (xb, xt) = x.as_chunks::<LANES>();
    let (yb, yt) = out.as_chunks_mut::<LANES>();
    for (x, y) in xb.iter().zip(yb.iter_mut()) {
        clamp(s, s.load(x) * k).store_s8(y);
    }
    // What is left of the padded row: less than 16 values, or a whole 16 of which x has 13 to 15.
    let mut bytes = [0i8; LANES];
    clamp(s, s.load(&padded(xt, 0.0)) * k).store_s8(&mut bytes);
    match yb.get_mut(xb.len()) {
        Some(y) => *y = bytes,
        None => yt.copy_from_slice(&bytes[..yt.len()]),
    }
    max / 127.0 * factor
}

/// Values of one task: about 64 KiB.
const TASK: usize = 1 << 14;

/// Quantizes every row of `x` `[m, k]` into `out`, after what `before` asks for.
pub fn quantize(ctx: Ctx, x: Mat, before: Before, out: RowsS8Mut) {
    let (rows, cols) = (x.rows, x.cols);
    let width = padded_k(cols);
    assert_eq!((out.m, out.k), (rows, cols), "size of quantized rows");
    assert!(
        out.data.len() == rows * width && out.scales.len() == rows,
        "{} bytes, {} scales for {rows} rows of {width}",
        out.data.len(),
        out.scales.len()
    );
    if let Some(Norm { affine: Some((gain, offset)), .. }) = before.norm {
        let (g, o) = (gain.len(), offset.len());
        assert!(g == cols && o == cols, "{g} gains, {o} offsets, {cols} columns");
    }
    if let Some(rotation) = before.rotation {
        assert_eq!(rotation.width(), cols, "width of a rotation");
    }
    if cols == 0 {
        out.scales.fill(0.0);
        return;
    }
    let _span = opclock::span(Op::Quantize, || Work { macs: 0, bytes: (5 * rows * cols) as u64 });
    let per_task = (TASK / cols).max(1);
    let (bytes, scales) = (SharedMut::new(out.data), SharedMut::new(out.scales));
    ctx.pool.reserve_scratch(cols);
    ctx.pool.run(rows.div_ceil(per_task), &|task, worker| {
        ctx.pool.with_scratch(worker, cols, |work| {
            for r in task * per_task..((task + 1) * per_task).min(rows) {
                // SAFETY: rows are disjoint and each belongs to one task.
                #[allow(unsafe_code)]
                let (out, scale) = unsafe { (bytes.slice(r * width..(r + 1) * width), scales.slice(r..r + 1)) };
                scale[0] = ctx.kernels.quantize(QuantizeRow { x: x.row(r), before, work: &mut *work, out });
            }
        });
    });
}
