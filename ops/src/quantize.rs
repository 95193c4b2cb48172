//! Rows of f32 to int8, symmetric per row (token), optionally after a layer norm and a random-sign Hadamard rotation.
//!
//! For each row: m = max |x|, scale = m / 127, value = round(clamp(x * (127 / m), -127, 127)), ties to even; the inverse is
//! one true division. A row of zeros (or of values so small that 127 / m overflows, m below 3.8e-37) gives zeros and scale 0.
//! A row with a NaN or an infinity gives zeros and scale NaN, so that every product with it is NaN and cannot pass unseen.
//!
//! The rotation's factor 1/sqrt(block) multiplies the scale instead of the values: the integers do not change with it.
//! Everything happens in one pass over a row that stays in the first-level cache.

use crate::activation::relu_lanes;
use crate::cpu::Ctx;
use crate::gemm::s8::pack::{QUAD, RowsS8Mut, padded_k};
use crate::hadamard::{Plain, Rotation, Vectors, rotate_into};
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

impl Before<'_> {
    /// Checks the widths against rows of `cols` values.
    pub(crate) fn check(&self, cols: usize) {
        if let Some(Norm { affine: Some((gain, offset)), .. }) = self.norm {
            let (g, o) = (gain.len(), offset.len());
            assert!(g == cols && o == cols, "{g} gains, {o} offsets, {cols} columns");
        }
        if let Some(rotation) = self.rotation {
            assert_eq!(rotation.width(), cols, "width of a rotation");
        }
    }
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

/// Whole vectors of a row.
type Whole<'a> = &'a [[f32; LANES]];

/// (x - mean) / sqrt(var + eps), times gain, plus offset where there are any; whole vectors.
struct Normed<'a, V> {
    x: Whole<'a>,
    mean: V,
    scale: V,
    /// Gain and offset.
    affine: Option<(Whole<'a>, Whole<'a>)>,
}

impl<S: Simd> Vectors<S> for Normed<'_, S::V> {
    #[inline(always)]
    fn at(&self, s: S, i: usize, _out: &[f32; LANES]) -> S::V {
        let v = (s.load(&self.x[i]) - self.mean) * self.scale;
        match self.affine {
            Some((gain, offset)) => v.mul_add(s.load(&gain[i]), s.load(&offset[i])),
            None => v,
        }
    }
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

/// Vectors looked at together: their maxima are chains of a few cycles a vector, where two could be read in one.
const TOGETHER: usize = 4;

/// (max |x|, whether every value is finite); of the rectified values with `relu`.
#[inline(always)]
fn largest<S: Simd>(s: S, x: &[f32], relu: bool) -> (f32, bool) {
    let (blocks, tail) = x.as_chunks::<LANES>();
    let (rounds, rest) = blocks.as_chunks::<TOGETHER>();
    let mut seen = [s.splat(0.0); TOGETHER];
    for round in rounds {
        for i in 0..TOGETHER {
            seen[i] = look(s, s.load(&round[i]), relu, seen[i]);
        }
    }
    for b in rest {
        seen[0] = look(s, s.load(b), relu, seen[0]);
    }
    if !tail.is_empty() {
        seen[0] = look(s, s.load(&padded(tail, 0.0)), relu, seen[0]);
    }
    let max = seen[0].max_magnitude(seen[1]).max_magnitude(seen[2].max_magnitude(seen[3]));
    largest_number(max)
}

/// The largest of magnitudes by their bits, and whether it is finite.
#[inline(always)]
pub(crate) fn largest_number<V: Vector>(v: V) -> (f32, bool) {
    let v = v.max_magnitude(v.swap::<8>());
    let v = v.max_magnitude(v.swap::<4>());
    let v = v.max_magnitude(v.swap::<2>());
    let v = v.max_magnitude(v.swap::<1>());
    let mut lanes = [0.0f32; LANES];
    v.store(&mut lanes);
    (lanes[0], lanes[0].is_finite())
}

/// The larger magnitude, of the rectified value with `relu`: minus infinity is then 0, NaN stays.
#[inline(always)]
fn look<S: Simd>(s: S, v: S::V, relu: bool, max: S::V) -> S::V {
    if relu { relu_lanes(s, v).max_magnitude(max) } else { v.max_magnitude(max) }
}

/// Quantizes one row; returns its scale.
#[inline(always)]
pub(crate) fn quantize_row<S: Simd>(s: S, row: QuantizeRow) -> f32 {
    let QuantizeRow { x, before, work, out } = row;
    let work = &mut work[..x.len()];
    let mut factor = 1.0;
    let changed = before.norm.is_some() || before.rotation.is_some();
    let (max, finite) = match before {
        // One pass from the row to its rotated self: blocks of up to 128 values stay in registers.
        Before { norm, rotation: Some(rotation) } => {
            factor = rotation.normalizer();
            let (signs, block) = (rotation.signs(), rotation.block());
            let x_blocks = x.as_chunks::<LANES>().0;
            largest_number(match norm {
                None => rotate_into(s, Plain(x_blocks), work, signs, block),
                Some(Norm { affine, eps }) => {
                    let (mean, scale) = moments(s, x, eps);
                    let (mean, scale) = (s.splat(mean), s.splat(scale));
                    let affine = affine.map(|(g, o)| (g.as_chunks::<LANES>().0, o.as_chunks::<LANES>().0));
                    rotate_into(s, Normed { x: x_blocks, mean, scale, affine }, work, signs, block)
                }
            })
        }
        Before { norm: Some(Norm { affine, eps }), rotation: None } => {
            match affine {
                Some((gain, offset)) => norm_row(s, NormRow { x, gain, offset, eps, out: work }),
                None => standardize(s, x, eps, work),
            }
            largest(s, work, false)
        }
        Before { norm: None, rotation: None } => largest(s, x, false),
    };
    let x = if changed { &*work } else { x };
    let inverse = 127.0 / max;
    if !finite || !inverse.is_finite() {
        out.fill(0);
        return if finite { 0.0 } else { f32::NAN };
    }
    // No clamp: |x| k is at most 127 (1 + 2^-23).
    let k = s.splat(inverse);
    let (xb, xt) = x.as_chunks::<LANES>();
    let (yb, yt) = out.as_chunks_mut::<LANES>();
    for (x, y) in xb.iter().zip(yb.iter_mut()) {
        (s.load(x) * k).store_s8(y);
    }
    if !xt.is_empty() {
        // What is left of the padded row: less than 16 values, or a whole 16 of which x has 13 to 15.
        let mut bytes = [0i8; LANES];
        (s.load(&padded(xt, 0.0)) * k).store_s8(&mut bytes);
        match yb.get_mut(xb.len()) {
            Some(y) => *y = bytes,
            None => few(&bytes, yt),
        }
    }
    max / 127.0 * factor
}

/// The first of sixteen values to fewer than sixteen, in pieces of known size: a copy of unknown size is a call of the C library.
#[inline(always)]
fn few<T: Copy>(values: &[T; LANES], out: &mut [T]) {
    let mut at = 0;
    macro_rules! piece {
        ($n:literal) => {
            if let (Some(to), Some(from)) = (out[at..].first_chunk_mut::<$n>(), values[at..].first_chunk::<$n>()) {
                *to = *from;
                at += $n;
            }
        };
    }
    piece!(8);
    piece!(4);
    piece!(2);
    piece!(1);
    debug_assert!(at == out.len());
}

/// max |x|, of the rectified values with `relu`; NaN when a value is not finite.
#[inline(always)]
pub(crate) fn largest_body<S: Simd>(s: S, x: &[f32], relu: bool) -> f32 {
    let (max, finite) = largest(s, x, relu);
    if finite { max } else { f32::NAN }
}

/// The larger of two maxima; NaN stays.
pub(crate) fn larger(a: f32, b: f32) -> f32 {
    if a.is_nan() || a > b { a } else { b }
}

/// The integer that stands for 0.0 in a map of rectified values, whose 255 steps all lie above it: half the step of a map
/// with both signs, for no other instruction in the products.
pub(crate) const RECTIFIED_ZERO: i8 = -128;

/// The integer that stands for 0.0 in a map.
pub(crate) fn zero_of(relu: bool) -> i8 {
    if relu { RECTIFIED_ZERO } else { 0 }
}

/// (steps / max, max / steps) for values up to `max`, 127 steps, or 255 when they are rectified; 0 and the scale 0 where that cannot
/// be divided, 0 and NaN for NaN.
#[inline(always)]
pub(crate) fn inverse_and_scale(max: f32, relu: bool) -> (f32, f32) {
    let steps = if relu { 255.0 } else { 127.0 };
    let inverse = steps / max;
    if inverse.is_finite() { (inverse, max / steps) } else { (0.0, if max.is_nan() { max } else { 0.0 }) }
}

/// Where quantized pixels go, in the form that an int8 kernel takes.
pub(crate) enum MapOut<'a> {
    /// Bytes, after an exclusive-or: 0x80 turns s8 into s8 + 128 as u8, 0 keeps.
    Bytes(&'a mut [i8], u8),
    /// Widened to sixteen bits.
    Wide(&'a mut [i16]),
}

impl MapOut<'_> {
    /// A piece.
    pub(crate) fn slice(&mut self, range: std::ops::Range<usize>) -> MapOut<'_> {
        match self {
            MapOut::Bytes(out, flip) => MapOut::Bytes(&mut out[range], *flip),
            MapOut::Wide(out) => MapOut::Wide(&mut out[range]),
        }
    }

    /// One value everywhere.
    pub(crate) fn fill(&mut self, value: i8) {
        match self {
            MapOut::Bytes(out, flip) => out.fill(value ^ *flip as i8),
            MapOut::Wide(out) => out.fill(i16::from(value)),
        }
    }
}

/// Steps of pixels that go into a map.
pub(crate) enum MapScale<'a> {
    /// Steps / max of all of them ([`inverse_and_scale`]); 0 for zeros.
    Inverse(f32),
    /// Each pixel's own, to be written here.
    PerPixel(&'a mut [f32]),
}

/// Pixels of a line to be quantized into a map.
pub(crate) struct ToMap<'a> {
    /// `[pixels][c]`.
    pub x: &'a [f32],
    /// Channels.
    pub c: usize,
    /// Whether values are rectified first, and so are counted from [`RECTIFIED_ZERO`] on.
    pub relu: bool,
    /// Their steps.
    pub scale: MapScale<'a>,
    /// `[pixels][c padded to four]`.
    pub out: MapOut<'a>,
}

/// A value of a map. Functions, not closures: those lose the instruction set where they are not inlined.
trait MapValue: Copy {
    /// Of sixteen bytes.
    fn of(bytes: &[i8; LANES], flip: u8) -> [Self; LANES];
}

impl MapValue for i8 {
    #[inline(always)]
    fn of(bytes: &[i8; LANES], flip: u8) -> [i8; LANES] {
        let mut values = *bytes;
        for v in &mut values {
            *v ^= flip as i8;
        }
        values
    }
}

impl MapValue for i16 {
    #[inline(always)]
    fn of(bytes: &[i8; LANES], _flip: u8) -> [i16; LANES] {
        let mut values = [0; LANES];
        for i in 0..LANES {
            values[i] = i16::from(bytes[i]);
        }
        values
    }
}

/// Quantizes the pixels of a line.
#[inline(always)]
pub(crate) fn to_map<S: Simd>(s: S, t: ToMap) {
    let ToMap { x, c, relu, scale, out } = t;
    match out {
        MapOut::Bytes(out, flip) => pixels(s, (x, c, relu), scale, out, flip),
        MapOut::Wide(out) => pixels(s, (x, c, relu), scale, out, 0),
    }
}

/// Quantizes pixels.
#[inline(always)]
fn pixels<S: Simd, T: MapValue>(s: S, (x, c, relu): (&[f32], usize, bool), scale: MapScale, out: &mut [T], flip: u8) {
    let width = padded_k(c);
    match scale {
        // Nothing between the pixels: one run.
        MapScale::Inverse(inverse) if width == c => quantize_run(s, x, relu, inverse, out, flip),
        MapScale::Inverse(inverse) if c < QUAD => quantize_few(s, (x, c, relu), inverse, out, flip),
        MapScale::Inverse(inverse) => {
            for (x, out) in x.chunks_exact(c).zip(out.chunks_exact_mut(width)) {
                quantize_run(s, x, relu, inverse, out, flip);
            }
        }
        MapScale::PerPixel(scales) => {
            for ((x, out), scale) in x.chunks_exact(c).zip(out.chunks_exact_mut(width)).zip(scales) {
                let (inverse, step) = inverse_and_scale(largest_body(s, x, relu), relu);
                *scale = step;
                quantize_run(s, x, relu, inverse, out, flip);
            }
        }
    }
}

/// Sixteen quantized values, round(v * inverse), or round(relu(v) * inverse - 128) rectified; an inverse of 0 gives zeros. No clamp: the
/// inverse is that of the largest of them.
#[inline(always)]
fn quantized<S: Simd>(s: S, v: S::V, relu: bool, inverse: f32) -> [i8; LANES] {
    let mut bytes = [zero_of(relu); LANES];
    if inverse == 0.0 {
        return bytes;
    }
    if relu {
        relu_lanes(s, v).mul_add(s.splat(inverse), s.splat(f32::from(RECTIFIED_ZERO))).store_s8(&mut bytes);
    } else {
        (v * s.splat(inverse)).store_s8(&mut bytes);
    }
    bytes
}

/// Quantizes values side by side; `out` may be up to three values longer, which become zeros.
#[inline(always)]
fn quantize_run<S: Simd, T: MapValue>(s: S, x: &[f32], relu: bool, inverse: f32, out: &mut [T], flip: u8) {
    let (xb, xt) = x.as_chunks::<LANES>();
    let (yb, yt) = out.as_chunks_mut::<LANES>();
    for (x, y) in xb.iter().zip(yb.iter_mut()) {
        *y = T::of(&quantized(s, s.load(x), relu, inverse), flip);
    }
    // What is left: less than 16 values, or a whole 16 of which x has 13 to 15.
    let rest = yb.get_mut(xb.len());
    if xt.is_empty() && rest.is_none() && yt.is_empty() {
        return;
    }
    let tail = T::of(&quantized(s, s.load(&padded(xt, 0.0)), relu, inverse), flip);
    match rest {
        Some(y) => *y = tail,
        None => few(&tail, yt),
    }
}

/// Quantizes pixels of up to three channels: sixteen values at a time, whatever pixels they belong to.
#[inline(always)]
fn quantize_few<S: Simd, T: MapValue>(
    s: S,
    (x, c, relu): (&[f32], usize, bool),
    inverse: f32,
    out: &mut [T],
    flip: u8,
) {
    let zero = T::of(&[0; LANES], flip)[0];
    // Sixteen pixels are c whole vectors.
    for (x, out) in x.chunks(LANES * c).zip(out.chunks_mut(LANES * QUAD)) {
        let mut values = [[zero; LANES]; QUAD];
        for (x, values) in x.chunks(LANES).zip(&mut values) {
            let v = match x.first_chunk::<LANES>() {
                Some(x) => s.load(x),
                None => s.load(&padded(x, 0.0)),
            };
            *values = T::of(&quantized(s, v, relu, inverse), flip);
        }
        let values = values.as_flattened();
        for (i, pixel) in out.as_chunks_mut::<QUAD>().0.iter_mut().enumerate() {
            for ch in 0..QUAD {
                pixel[ch] = if ch < c { values[i * c + ch] } else { zero };
            }
        }
    }
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
    before.check(cols);
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
