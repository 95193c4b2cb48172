//! One head of q, k or v on its way into the int8 tiles: norm, rotary embedding, rotation, quantization, packing.
//!
//! Rows of a head are worked on at a width of d rounded up to 16, zeros behind d, so that everything runs in whole
//! vectors. The norm and the turn have the bits of [`crate::rope::qk_norm_rope`].

use crate::gemm::pack::MAX_MR;
use crate::gemm::s8::pack::QUAD;
use crate::gemm::s8::table::{Activations, GemmS8Kernel};
use crate::gemm::s8::tile::{QuadPack, pack_quads};
use crate::hadamard::{Rotation, rotate};
use crate::quantize::clamp;
use crate::rope::{RopeTable, turn};
use crate::simd::{LANES, Simd, Vector, fold_add};

/// Widest head.
pub(crate) const MAX_D: usize = 256;
/// Keys of one tile: the softmax has one maximum and the values one scale per channel for so many.
pub(crate) const KEYS: usize = 64;
/// 1.5 * 2^23: added to a small number it leaves the nearest integer in the low bits.
pub(crate) const ROUND: f32 = 12_582_912.0;

/// Width of a head's rows in working memory.
pub(crate) fn padded_d(d: usize) -> usize {
    d.next_multiple_of(LANES)
}

/// Gain, offset and eps of the norm of q or of k.
#[derive(Clone, Copy)]
pub(crate) struct HeadNorm<'a> {
    pub gain: &'a [f32],
    pub offset: &'a [f32],
    pub eps: f32,
}

/// Rows of one head of q or k, and what happens to them.
#[derive(Clone, Copy)]
pub(crate) struct HeadRows<'a> {
    /// From the head's first value in the first row on.
    pub x: &'a [f32],
    /// Values from one row to the next.
    pub stride: usize,
    /// Rows.
    pub rows: usize,
    /// Head width.
    pub d: usize,
    /// Norm.
    pub norm: Option<HeadNorm<'a>>,
    /// Table, and the row that counts as its token 0 modulo its length.
    pub rope: Option<(&'a RopeTable, usize)>,
    /// Rotation without its factor.
    pub rotation: Option<Rotation<'a>>,
}

/// Sixteen values from `at` on; beyond the end of `x` zeros.
#[inline(always)]
fn lanes<S: Simd>(s: S, x: &[f32], at: usize) -> S::V {
    match x[at..].first_chunk::<LANES>() {
        Some(v) => s.load(v),
        None => {
            let mut v = [0.0; LANES];
            v[..x.len() - at].copy_from_slice(&x[at..]);
            s.load(&v)
        }
    }
}

/// 1 in the lanes of a head's last vector that belong to it, 0 behind.
#[inline(always)]
fn last_lanes(d: usize) -> [f32; LANES] {
    let used = d - (d - 1) / LANES * LANES;
    std::array::from_fn(|i| if i < used { 1.0 } else { 0.0 })
}

/// Norm, turn and rotation of rows -> `out` `[rows, padded d]` and 16 values more.
#[inline(always)]
pub(crate) fn prepare<S: Simd>(s: S, t: &HeadRows, out: &mut [f32]) {
    let HeadRows { x, stride, rows, d, norm, rope, rotation } = *t;
    let (width, quarter) = (padded_d(d), d / 4);
    let vectors = width / LANES;
    let used = last_lanes(d);
    let (mut gain, mut offset) = ([[0.0f32; LANES]; MAX_D / LANES], [[0.0f32; LANES]; MAX_D / LANES]);
    if let Some(n) = norm {
        gain.as_flattened_mut()[..d].copy_from_slice(n.gain);
        offset.as_flattened_mut()[..d].copy_from_slice(n.offset);
    }
    let mut row = [0.0f32; MAX_D + LANES];
    for r in 0..rows {
        let x = &x[r * stride..];
        let (v, _) = row.as_chunks_mut::<LANES>();
        for i in 0..vectors {
            lanes(s, x, i * LANES).store(&mut v[i]);
        }
        let (half, zero) = (s.splat(0.5), s.splat(0.0));
        let last = &mut v[vectors - 1];
        s.load(&used).select_gt(half, s.load(last), zero).store(last);
        if let Some(n) = norm {
            standardize(s, &mut v[..vectors], (d, &used, n.eps));
            for i in 0..vectors {
                s.load(&v[i]).mul_add(s.load(&gain[i]), s.load(&offset[i])).store(&mut v[i]);
            }
        }
        let out = &mut out[r * width..][..width + LANES];
        match rope {
            None => out[..width].copy_from_slice(&row[..width]),
            Some((table, first)) => {
                let (cos, sin) = table.lanes((first + r) % table.len());
                for h in 0..2 {
                    let base = 2 * h * quarter;
                    // All of the first outputs, then all of the second: what a store writes too far is written again.
                    for side in 0..2 {
                        for j in (0..quarter).step_by(LANES) {
                            let (a, b) = (lanes(s, &row, base + j), lanes(s, &row, base + quarter + j));
                            let (c, n) = (lanes(s, cos, h * quarter + j), lanes(s, sin, h * quarter + j));
                            let (p, q) = turn(a, b, c, n, zero);
                            let to = out[base + side * quarter + j..].first_chunk_mut().expect("a vector of slack");
                            if side == 0 { p } else { q }.store(to);
                        }
                    }
                }
                if d < width {
                    zero.store(out[d..].first_chunk_mut().expect("a vector of slack"));
                }
            }
        }
        if let Some(rotation) = rotation {
            rotate(s, &mut out[..d], rotation.signs(), rotation.block());
        }
    }
}

/// (x - mean) / sqrt(var + eps) over d values in whole vectors, in place, with the bits of `layernorm::moments`.
#[inline(always)]
fn standardize<S: Simd>(s: S, v: &mut [[f32; LANES]], (d, used, eps): (usize, &[f32; LANES], f32)) {
    let n = d as f32;
    let mut sum = s.splat(0.0);
    for x in v.iter() {
        sum = sum + s.load(x);
    }
    let mean = s.splat(fold_add(sum) / n);
    let mut squares = s.splat(0.0);
    let last = v.len() - 1;
    let inside = s.load(used);
    for (i, x) in v.iter_mut().enumerate() {
        let mut x_i = s.load(x);
        if i == last {
            x_i = inside.select_gt(s.splat(0.5), x_i, mean);
        }
        let e = x_i - mean;
        squares = e.mul_add(e, squares);
        e.store(x);
    }
    let k = s.splat(1.0 / (fold_add(squares) / n + eps).sqrt());
    for x in v.iter_mut() {
        (s.load(x) * k).store(x);
    }
}

/// Sums over the rows of `N` vectors of columns, in the order of the rows.
#[inline(always)]
fn column_sums<S: Simd, const N: usize>(s: S, x: &[f32], width: usize, out: &mut [[f32; LANES]; N]) {
    let mut sums = [s.splat(0.0); N];
    for row in x.chunks(width) {
        let row = row.as_chunks::<LANES>().0.first_chunk::<N>().expect("whole rows");
        for i in 0..N {
            sums[i] = sums[i] + s.load(&row[i]);
        }
    }
    for i in 0..N {
        sums[i].store(&mut out[i]);
    }
}

/// Mean over the rows of `x` `[rows, width]`, each column summed in the order of the rows.
#[inline(always)]
fn column_means<S: Simd>(s: S, x: &[f32], rows: usize, mean: &mut [f32]) {
    let width = mean.len();
    let x = &x[..rows * width];
    let mut c = 0;
    while c < width {
        let left = mean[c..].as_chunks_mut::<LANES>().0;
        if let Some(four) = left.first_chunk_mut::<4>() {
            column_sums(s, &x[c..], width, four);
            c += 4 * LANES;
        } else {
            column_sums(s, &x[c..], width, left.first_chunk_mut::<1>().expect("whole vectors"));
            c += LANES;
        }
    }
    let n = s.splat(rows as f32);
    for m in mean.as_chunks_mut::<LANES>().0 {
        (s.load(m) / n).store(m);
    }
}

/// x - mean to int8, with the bits of [`crate::reference::quantize`]; returns the scale.
#[inline(always)]
fn quantize_centred<S: Simd>(s: S, x: &[f32], mean: &[f32], out: &mut [i8]) -> f32 {
    let zero = s.splat(0.0);
    let (x, mean) = (x.as_chunks::<LANES>().0, mean.as_chunks::<LANES>().0);
    let (mut max, mut odd) = (zero, zero);
    for (x, m) in x.iter().zip(mean) {
        let v = s.load(x) - s.load(m);
        max = v.abs().max(max);
        // NaN for NaN and infinities, and stays so.
        odd = v.mul_add(zero, odd);
    }
    let max = max.max(max.swap::<8>());
    let max = max.max(max.swap::<4>());
    let max = max.max(max.swap::<2>());
    let max = max.max(max.swap::<1>());
    let mut m = [0.0; LANES];
    max.store(&mut m);
    let finite = s.splat(1.0).gt_bits(odd) == u16::MAX;
    let inverse = 127.0 / m[0];
    if !finite || !inverse.is_finite() {
        out.fill(0);
        return if finite { 0.0 } else { f32::NAN };
    }
    let k = s.splat(inverse);
    for ((x, m), y) in x.iter().zip(mean).zip(out.as_chunks_mut::<LANES>().0) {
        clamp(s, (s.load(x) - s.load(m)) * k).store_s8(y);
    }
    m[0] / 127.0
}

/// Flips a byte quad of activations to the form that a kernel wants.
pub(crate) fn flip(kernel: &GemmS8Kernel) -> u32 {
    match kernel.activations {
        Activations::Signed => 0,
        Activations::Offset128 => 0x8080_8080,
    }
}

/// Keys of one frame and head, to be packed as activations of the score tiles.
pub(crate) struct KeyPack<'a> {
    /// All keys of the frame.
    pub rows: HeadRows<'a>,
    /// Whose tiles.
    pub kernel: &'static GemmS8Kernel,
    /// `[rows, padded d]` and 16 more.
    pub work: &'a mut [f32],
    /// `[16, padded d]`.
    pub bytes: &'a mut [i8],
    /// Mean key, `[padded d]`.
    pub mean: &'a mut [f32],
    /// Scale of each key, `[rows]`.
    pub scales: &'a mut [f32],
    /// For each 64 keys, for each tile of rows: `[d/4][rows of the tile]` quads.
    pub out: &'a mut [u32],
}

/// Prepares keys, takes their mean off and packs them.
#[inline(always)]
pub(crate) fn pack_keys<S: Simd>(s: S, t: KeyPack) {
    let KeyPack { rows: head, kernel, work, bytes, mean, scales, out } = t;
    let (width, steps, rows) = (padded_d(head.d), head.d / QUAD, head.rows);
    prepare(s, &head, work);
    column_means(s, work, rows, mean);
    let flip = flip(kernel);
    for first in (0..rows).step_by(KEYS) {
        let keys = KEYS.min(rows - first);
        for r in (0..keys).step_by(kernel.mr) {
            let here = kernel.mr.min(keys - r);
            let at = first + r;
            for i in 0..here {
                let x = &work[(at + i) * width..][..width];
                scales[at + i] = quantize_centred(s, x, mean, &mut bytes[i * width..][..width]);
            }
            let mut from: [&[i8]; MAX_MR] = [&[]; MAX_MR];
            for (i, row) in from.iter_mut().enumerate().take(here) {
                *row = &bytes[i * width..][..width];
            }
            let out = &mut out[at * steps..];
            pack_quads(s, QuadPack { from, steps, width: kernel.fit(here), flip, out });
        }
    }
}

/// Up to sixteen queries of one head, to be packed as a panel of the score tiles.
pub(crate) struct QueryPack<'a> {
    /// Queries.
    pub rows: HeadRows<'a>,
    /// `[16, padded d]` and 16 more; holds the prepared queries afterwards, zeros where there are none.
    pub work: &'a mut [f32],
    /// `[16, padded d]`.
    pub bytes: &'a mut [i8],
    /// Zeros, `[padded d]`.
    pub zeros: &'a [f32],
    /// Scale of each query times this; 0 where there is none.
    pub factor: f32,
    /// Scales.
    pub scales: &'a mut [f32; LANES],
    /// `[d/4][16]` quads.
    pub out: &'a mut [u32],
}

/// Prepares queries and packs them.
#[inline(always)]
pub(crate) fn pack_queries<S: Simd>(s: S, t: QueryPack) {
    let QueryPack { rows: head, work, bytes, zeros, factor, scales, out } = t;
    let width = padded_d(head.d);
    prepare(s, &head, work);
    work[head.rows * width..LANES * width].fill(0.0);
    let mut from: [&[i8]; MAX_MR] = [&[]; MAX_MR];
    for (i, scale) in scales.iter_mut().enumerate() {
        *scale = if i < head.rows {
            let y = &mut bytes[i * width..][..width];
            quantize_centred(s, &work[i * width..][..width], zeros, y) * factor
        } else {
            0.0
        };
    }
    for (i, row) in from.iter_mut().enumerate().take(head.rows) {
        *row = &bytes[i * width..][..width];
    }
    pack_quads(s, QuadPack { from, steps: head.d / QUAD, width: LANES, flip: 0, out });
}

/// Values of one frame and head, to be packed as activations of the tiles that sum them.
pub(crate) struct ValuePack<'a> {
    /// From the head's first value in the first row on.
    pub x: &'a [f32],
    /// Values from one row to the next.
    pub stride: usize,
    /// Rows.
    pub rows: usize,
    /// Head width.
    pub d: usize,
    /// Whose tiles.
    pub kernel: &'static GemmS8Kernel,
    /// `[16, padded d]` quads and 16 more.
    pub stage: &'a mut [u32],
    /// For each 64 keys: the step of each channel, then 127 times the sum of its integers; `[padded d]` each.
    pub columns: &'a mut [f32],
    /// For each 64 keys, for each tile of channels: `[keys/4][rows of the tile]` quads.
    pub out: &'a mut [u32],
}

/// Quads of values of one head and 64 keys: channels rounded up to what the tiles take, 16 steps.
pub(crate) fn value_tile_len(kernel: &GemmS8Kernel, d: usize) -> usize {
    let left = d % kernel.mr;
    (d - left + if left > 0 { kernel.fit(left) } else { 0 }) * KEYS / QUAD
}

/// Quantizes values per channel and 64 keys and packs them, transposed.
#[inline(always)]
pub(crate) fn pack_values<S: Simd>(s: S, t: ValuePack) {
    let ValuePack { x, stride, rows, d, kernel, stage, columns, out } = t;
    let width = padded_d(d);
    let flip = flip(kernel);
    let tile_len = value_tile_len(kernel, d);
    let (zero, round) = (s.splat(0.0), s.splat(ROUND));
    for (tile, first) in (0..rows).step_by(KEYS).enumerate() {
        let keys = KEYS.min(rows - first);
        let steps = keys.div_ceil(QUAD);
        let x = &x[first * stride..];
        let (scales, sums) = columns[tile * 2 * width..][..2 * width].split_at_mut(width);
        for c in (0..d).step_by(LANES) {
            let (mut max, mut odd) = (zero, zero);
            for r in 0..keys {
                let v = lanes(s, x, r * stride + c);
                max = v.abs().max(max);
                odd = v.mul_add(zero, odd);
            }
            // As in `quantize`: a true division; nothing to scale where it overflows. NaN where a value is not finite.
            let inverse = s.splat(127.0) / max;
            let inverse = inverse.select_gt(s.splat(f32::MAX), zero, inverse);
            (max / s.splat(127.0) + odd).store(scales[c..].first_chunk_mut().expect("whole vectors"));
            let mut sum = zero;
            for q in 0..steps {
                let mut quad = [round; 4];
                for (i, y) in quad.iter_mut().enumerate().take(keys - q * QUAD) {
                    // NaN becomes -127 here, for the scale is NaN.
                    let v = (lanes(s, x, (q * QUAD + i) * stride + c) * inverse).max(s.splat(-127.0));
                    *y = v.select_gt(s.splat(127.0), s.splat(127.0), v) + round;
                    sum = sum + (*y - round);
                }
                let to = stage[q * width + c..].first_chunk_mut::<LANES>().expect("whole vectors");
                S::V::store_low_bytes(quad, bytemuck::cast_mut(to));
            }
            (sum * s.splat(127.0)).store(sums[c..].first_chunk_mut().expect("whole vectors"));
        }
        let out = &mut out[tile * tile_len..][..tile_len];
        for r in (0..d).step_by(kernel.mr) {
            let tile_rows = kernel.fit(kernel.mr.min(d - r));
            let out = &mut out[r * steps..][..tile_rows * steps];
            for q in 0..steps {
                let from = stage[q * width + r..].first_chunk::<LANES>().expect("a vector of slack");
                let quads = from.map(|v| v ^ flip);
                // Sixteen at once where there is room: what runs over is written again by the next step.
                match out[q * tile_rows..].first_chunk_mut::<LANES>() {
                    Some(to) => *to = quads,
                    None => out[q * tile_rows..][..tile_rows].copy_from_slice(&quads[..tile_rows]),
                }
            }
        }
    }
}
