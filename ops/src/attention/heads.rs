//! One head of q, k or v on its way into the int8 tiles: norm, rotary embedding, rotation, quantization, packing.
//!
//! Rows of a head are worked on at a width of d rounded up to 16, zeros behind d, so that everything runs in whole
//! vectors. Norm and embedding are also those of [`crate::rope::qk_norm_rope`].

use crate::gemm::s8::pack::QUAD;
use crate::gemm::s8::rows::cut;
use crate::gemm::s8::table::{Activations, GemmS8Kernel};
use crate::hadamard::{Rotation, rotate};
use crate::prefetch::near_l1;
use crate::quantize::largest_number;
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

/// Bytes of a quantized row in working memory: blocks of 16 quads.
pub(crate) fn padded_bytes(d: usize) -> usize {
    padded_d(d).next_multiple_of(LANES * QUAD)
}

/// Rows of a stage, with room for a vector that runs over.
pub(crate) const STAGE_ROWS: usize = KEYS + LANES;

/// Rows asked for before they are read: heads lie side by side, so a head's rows are whole pages apart and no hardware prefetcher follows
/// them. From a third-level cache 140 ns away, unasked, they took a third of the time of attention.
const ROWS_AHEAD: usize = 8;

/// Asks for one row of `d` values, also beyond the end of `x`.
#[inline(always)]
fn ask_row(x: &[f32], at: usize, d: usize) {
    let row = x.as_ptr().wrapping_add(at);
    for i in (0..d).step_by(LANES) {
        near_l1(row.wrapping_add(i));
    }
    near_l1(row.wrapping_add(d - 1));
}

/// Most vectors of a head.
const MAX_N: usize = MAX_D / LANES;

/// Calls a body with the vectors of a row. The usual widths, 64 and 68 to 80, have code of their own, where rows stay in registers;
/// the others share one with loops.
macro_rules! by_vectors {
    ($body:ident, $s:ident, $t:ident, $d:expr) => {
        match crate::attention::heads::padded_d($d) / crate::simd::LANES {
            4 => $body($s, $t, 4),
            5 => $body($s, $t, 5),
            n => $body($s, $t, n),
        }
    };
}

pub(crate) use by_vectors;

/// Gain, offset and eps of the norm of q or of k.
#[derive(Clone, Copy)]
pub(crate) struct HeadNorm<'a> {
    pub gain: &'a [f32],
    pub offset: &'a [f32],
    pub eps: f32,
}

/// Rotary embedding of rows: row r turns as token first + r * step of the table, modulo its length.
#[derive(Clone, Copy)]
pub(crate) struct Turn<'a> {
    pub table: &'a RopeTable,
    pub first: usize,
    pub step: usize,
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
    /// Rotary embedding.
    pub rope: Option<Turn<'a>>,
    /// Rotation without its factor.
    pub rotation: Option<Rotation<'a>>,
}

/// Norm, turn and rotation of rows -> `out` `[rows, 16 n]` and 16 values more; zeros behind d.
#[inline(always)]
pub(crate) fn prepare<S: Simd>(s: S, t: &HeadRows, n: usize, out: &mut [f32]) {
    let HeadRows { x, stride, rows, d, norm, rope, rotation } = *t;
    let width = n * LANES;
    let quarter = d / 4;
    let (zero, half) = (s.splat(0.0), s.splat(0.5));
    let mut used = [[0.0f32; LANES]; MAX_N];
    used.as_flattened_mut()[..d].fill(1.0);
    let (gain, offset) = norm.map_or((&[][..], &[][..]), |n| (n.gain, n.offset));
    let (mut padded_gain, mut padded_offset) = ([[0.0f32; LANES]; MAX_N], [[0.0f32; LANES]; MAX_N]);
    let (gain, offset) = if d == width {
        (gain.as_chunks::<LANES>().0, offset.as_chunks::<LANES>().0)
    } else {
        padded_gain.as_flattened_mut()[..gain.len()].copy_from_slice(gain);
        padded_offset.as_flattened_mut()[..offset.len()].copy_from_slice(offset);
        (&padded_gain[..n], &padded_offset[..n])
    };
    let count = d as f32;
    let eps = norm.map_or(0.0, |n| n.eps);
    let mut row = [0.0f32; MAX_D + LANES];
    for r in 0..rows {
        let mut v = [zero; MAX_N];
        ask_row(x, (r + ROWS_AHEAD) * stride, d);
        let x = &x[r * stride..];
        if let Some(x) = x.as_chunks::<LANES>().0.get(..n) {
            for i in 0..n {
                v[i] = s.load(&x[i]);
            }
        } else {
            // The last rows of q | k | v, where less than a padded row follows.
            row[..d].copy_from_slice(&x[..d]);
            for i in 0..n {
                v[i] = s.load(&row.as_chunks::<LANES>().0[i]);
            }
        }
        if d < width {
            for i in 0..n {
                v[i] = s.load(&used[i]).select_gt(half, v[i], zero);
            }
        }
        if norm.is_some() {
            // One chain: a head is few vectors, and another row's chain runs beside it. Lanes that are not used add 0.
            let mut sum = zero;
            for i in 0..n {
                sum = sum + v[i];
            }
            // Quotients and the root as numbers: sixteen equal lanes take the divider four times as long.
            let mean = s.splat(fold_add(sum) / count);
            let mut squares = zero;
            for i in 0..n {
                v[i] = v[i] - mean;
                if d < width {
                    v[i] = s.load(&used[i]).select_gt(half, v[i], zero);
                }
                squares = v[i].mul_add(v[i], squares);
            }
            let k = s.splat(1.0 / (fold_add(squares) / count + eps).sqrt());
            for i in 0..n {
                v[i] = (v[i] * k).mul_add(s.load(&gain[i]), s.load(&offset[i]));
            }
        }
        let out = &mut out[r * width..][..width + LANES];
        match rope {
            Some(Turn { table, first, step }) if n == 4 && d == 4 * LANES => {
                // Halves of two whole vectors.
                let (cos, sin) = table.lanes((first + r * step) % table.len());
                let (cos, sin) = (cos.as_chunks::<LANES>().0, sin.as_chunks::<LANES>().0);
                for h in 0..2 {
                    (v[2 * h], v[2 * h + 1]) = turn(v[2 * h], v[2 * h + 1], s.load(&cos[h]), s.load(&sin[h]), zero);
                }
            }
            Some(Turn { table, first, step }) => {
                let (cos, sin) = table.lanes((first + r * step) % table.len());
                let at = |x: &[f32], i: usize| s.load(x[i..].first_chunk().expect("a vector of slack"));
                for i in 0..n {
                    v[i].store(row[i * LANES..].first_chunk_mut().expect("a vector of slack"));
                }
                for h in 0..2 {
                    let base = 2 * h * quarter;
                    // All of the first outputs, then all of the second: what a store writes too far is written again.
                    for side in 0..2 {
                        for j in (0..quarter).step_by(LANES) {
                            let (a, b) = (at(&row, base + j), at(&row, base + quarter + j));
                            let (p, q) = turn(a, b, at(cos, h * quarter + j), at(sin, h * quarter + j), zero);
                            let to = out[base + side * quarter + j..].first_chunk_mut().expect("a vector of slack");
                            if side == 0 { p } else { q }.store(to);
                        }
                    }
                }
                for i in 0..n {
                    v[i] = at(out, i * LANES);
                    if d < width {
                        v[i] = s.load(&used[i]).select_gt(half, v[i], zero);
                    }
                }
            }
            None => {}
        }
        for i in 0..n {
            v[i].store(out[i * LANES..].first_chunk_mut().expect("whole vectors"));
        }
        if let Some(rotation) = rotation {
            rotate(s, &mut out[..d], rotation.signs(), rotation.block());
        }
    }
}

/// Mean over the rows of `x` `[rows, 16 n]`, each column summed in the order of the rows.
#[inline(always)]
fn column_means<S: Simd>(s: S, x: &[f32], n: usize, mean: &mut [[f32; LANES]]) {
    let mut sums = [s.splat(0.0); MAX_N];
    let mut rows = 0.0;
    for row in x.as_chunks::<LANES>().0.chunks_exact(n) {
        for i in 0..n {
            sums[i] = sums[i] + s.load(&row[i]);
        }
        rows += 1.0;
    }
    let rows = s.splat(rows);
    for i in 0..n {
        (sums[i] / rows).store(&mut mean[i]);
    }
}

/// x - mean to int8, with the bits of [`crate::reference::quantize`]; returns the scale.
#[inline(always)]
fn quantize_centred<S: Simd>(s: S, x: &[[f32; LANES]], mean: Option<&[[f32; LANES]]>, out: &mut [[i8; LANES]]) -> f32 {
    let n = x.len();
    let zero = s.splat(0.0);
    let mut v = [zero; MAX_N];
    let mut max = zero;
    for i in 0..n {
        v[i] = s.load(&x[i]);
        if let Some(mean) = mean {
            v[i] = v[i] - s.load(&mean[i]);
        }
        max = v[i].max_magnitude(max);
    }
    let (max, finite) = largest_number(max);
    let out = &mut out[..n];
    let inverse = 127.0 / max;
    if !finite || !inverse.is_finite() {
        out.fill([0; LANES]);
        return if finite { 0.0 } else { f32::NAN };
    }
    let k = s.splat(inverse);
    for i in 0..n {
        (v[i] * k).store_s8(&mut out[i]);
    }
    max / 127.0
}

/// Bytes of up to 16 rows `[16, blocks of 64]` -> quads `[steps][stride]` from `out` on, transposed; rows beyond `rows` are zeros.
#[inline(always)]
fn transpose_quads<S: Simd>(s: S, bytes: &[f32], (blocks, steps): (usize, usize), out: &mut [u32], stride: usize) {
    let rows = bytes.as_chunks::<LANES>().0;
    for b in 0..blocks {
        let mut block = [[0.0f32; LANES]; LANES];
        for r in 0..LANES {
            // Through a register: copied as arrays, these 64 bytes become calls of memcpy.
            s.load(&rows[r * blocks + b]).store(&mut block[r]);
        }
        s.transpose(&mut block);
        for (i, quads) in block.iter().enumerate().take(steps - b * LANES) {
            let to = out[(b * LANES + i) * stride..].first_chunk_mut::<LANES>().expect("a vector of slack");
            s.load(quads).store(bytemuck::cast_mut(to));
        }
    }
}

/// Quads `[steps][stride]` of `rows` rows, cut into the tiles of a kernel: for each tile `[steps][rows of the tile]`.
#[inline(always)]
fn cut_tiles<S: Simd>(
    s: S,
    stage: &[u32],
    stride: usize,
    (steps, rows): (usize, usize),
    kernel: &GemmS8Kernel,
    out: &mut [u32],
) {
    let flip = flip(kernel);
    for r in (0..rows).step_by(kernel.mr) {
        let width = kernel.fit(kernel.mr.min(rows - r));
        let out = &mut out[r * steps..][..width * steps];
        let from = stage[r..].chunks(stride).take(steps);
        cut(s, from, (width, flip), out);
    }
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
    /// `[16, padded bytes]`.
    pub bytes: &'a mut [f32],
    /// `[d/4, STAGE_ROWS]` quads.
    pub stage: &'a mut [u32],
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
    by_vectors!(pack_keys_of, s, t, t.rows.d);
}

#[inline(always)]
fn pack_keys_of<S: Simd>(s: S, t: KeyPack, n: usize) {
    let KeyPack { rows: head, kernel, work, bytes, stage, mean, scales, out } = t;
    let (steps, rows) = (head.d / QUAD, head.rows);
    prepare(s, &head, n, work);
    let mean = &mut mean.as_chunks_mut::<LANES>().0[..n];
    column_means(s, &work[..rows * n * LANES], n, mean);
    let blocks = n.div_ceil(QUAD);
    for first in (0..rows).step_by(KEYS) {
        let keys = KEYS.min(rows - first);
        let work = &work.as_chunks::<LANES>().0[first * n..(first + keys) * n];
        for r in (0..keys).step_by(LANES) {
            let to: &mut [i8] = bytemuck::cast_slice_mut(&mut *bytes);
            let to = to.as_chunks_mut::<LANES>().0.chunks_mut(blocks * QUAD);
            for ((x, to), scale) in work[r * n..].chunks_exact(n).zip(to).zip(&mut scales[first + r..]) {
                *scale = quantize_centred(s, x, Some(mean), to);
            }
            transpose_quads(s, bytes, (blocks, steps), &mut stage[r..], STAGE_ROWS);
        }
        cut_tiles(s, stage, STAGE_ROWS, (steps, keys), kernel, &mut out[first * steps..]);
    }
}

/// Up to sixteen queries of one head, to be packed as a panel of the score tiles.
pub(crate) struct QueryPack<'a> {
    /// Queries.
    pub rows: HeadRows<'a>,
    /// `[16, padded d]` and 16 more; holds the prepared queries afterwards, zeros where there are none.
    pub work: &'a mut [f32],
    /// `[16, padded bytes]`.
    pub bytes: &'a mut [f32],
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
    by_vectors!(pack_queries_of, s, t, t.rows.d);
}

#[inline(always)]
fn pack_queries_of<S: Simd>(s: S, t: QueryPack, n: usize) {
    let QueryPack { rows: head, work, bytes, factor, scales, out } = t;
    prepare(s, &head, n, work);
    work[head.rows * n * LANES..LANES * n * LANES].fill(0.0);
    let blocks = n.div_ceil(QUAD);
    let to: &mut [i8] = bytemuck::cast_slice_mut(&mut *bytes);
    let to = to.as_chunks_mut::<LANES>().0.chunks_mut(blocks * QUAD);
    for ((x, to), scale) in work.as_chunks::<LANES>().0.chunks_exact(n).zip(to).zip(scales.iter_mut()) {
        *scale = quantize_centred(s, x, None, to) * factor;
    }
    transpose_quads(s, bytes, (blocks, head.d / QUAD), out, LANES);
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
    let tile_len = value_tile_len(kernel, d);
    // Sixteen channels of the keys, in memory of their own: rows are far apart, and the last may end early.
    let mut block = [[0.0f32; LANES]; KEYS];
    for (tile, first) in (0..rows).step_by(KEYS).enumerate() {
        let keys = KEYS.min(rows - first);
        let steps = keys.div_ceil(QUAD);
        block[keys..].fill([0.0; LANES]);
        let (scales, sums) = columns[tile * 2 * width..][..2 * width].split_at_mut(width);
        for c in (0..d).step_by(LANES) {
            let x = &x[first * stride + c..];
            for (r, (to, row)) in block.iter_mut().zip(x.chunks(stride)).take(keys).enumerate() {
                if c == 0 {
                    ask_row(x, (r + ROWS_AHEAD) * stride, d);
                }
                match row.first_chunk::<LANES>() {
                    Some(row) => s.load(row).store(to),
                    None => to[..row.len()].copy_from_slice(row),
                }
            }
            let (scale, sum) = (scales[c..].first_chunk_mut(), sums[c..].first_chunk_mut());
            let columns = (scale.expect("whole vectors"), sum.expect("whole vectors"));
            quantize_columns(s, (&block, keys), columns, (&mut stage[c..], width));
        }
        cut_tiles(s, stage, width, (steps, d), kernel, &mut out[tile * tile_len..][..tile_len]);
    }
}

/// Sixteen columns of up to 64 rows to int8 -> quads of four rows, `[keys/4][stride]`; scales and 127 times the sums.
#[inline(always)]
fn quantize_columns<S: Simd>(
    s: S,
    (x, rows): (&[[f32; LANES]; KEYS], usize),
    (scales, sums): (&mut [f32; LANES], &mut [f32; LANES]),
    (out, stride): (&mut [u32], usize),
) {
    let zero = s.splat(0.0);
    // Two chains: a maximum does not depend on order, nor does whether something is not finite.
    let (mut max, mut odd) = ([zero; 2], [zero; 2]);
    for pair in x[..rows.next_multiple_of(2)].as_chunks::<2>().0 {
        for i in 0..2 {
            let v = s.load(&pair[i]);
            max[i] = v.abs().max(max[i]);
            odd[i] = v.mul_add(zero, odd[i]);
        }
    }
    let max = max[0].max(max[1]);
    let (top, bottom, round) = (s.splat(127.0), s.splat(-127.0), s.splat(ROUND));
    // As in `quantize`: a true division; nothing to scale where it overflows. NaN where a value is not finite.
    let inverse = top / max;
    let inverse = inverse.select_gt(s.splat(f32::MAX), zero, inverse);
    (max / top + (odd[0] + odd[1])).store(scales);
    let mut sum = zero;
    // Rows behind the last are zeros.
    for (quad, out) in x.as_chunks::<QUAD>().0[..rows.div_ceil(QUAD)].iter().zip(out.chunks_mut(stride)) {
        let mut y = [zero; QUAD];
        for i in 0..QUAD {
            // NaN becomes -127 here, for the scale is NaN.
            let v = (s.load(&quad[i]) * inverse).max(bottom);
            y[i] = v.select_gt(top, top, v) + round;
            sum = sum + (y[i] - round);
        }
        let to = out.first_chunk_mut::<LANES>().expect("whole vectors");
        S::V::store_low_bytes(y, bytemuck::cast_mut(to));
    }
    (sum * top).store(sums);
}
