//! Steps of the streaming softmax: between two products, and after the last.

use super::heads::{KEYS, ROUND};
use crate::activation::exp_lanes;
use crate::gemm::s8::pack::QUAD;
use crate::par::SharedMut;
use crate::simd::{LANES, Simd, Vector};

/// Scores of up to [`super::KEYS`] keys for 16 queries, and the running state of those queries.
pub(crate) struct SoftmaxTile<'a> {
    /// `[keys][16]`: scores in, weights e^(score - top) out.
    pub scores: &'a mut [f32],
    /// Largest score so far.
    pub top: &'a mut [f32; LANES],
    /// Sum of weights so far.
    pub total: &'a mut [f32; LANES],
    /// `[d][16]`: sums of weighted values so far, rescaled to the new top.
    pub sums: &'a mut [f32],
}

/// One step of the streaming softmax. Weights are added in four interleaved chains, folded in a fixed order.
#[inline(always)]
pub(crate) fn softmax_tile<S: Simd>(s: S, t: SoftmaxTile) {
    let keys = t.scores.as_chunks_mut::<LANES>().0;
    let old = s.load(t.top);
    let mut top = old;
    for k in keys.iter() {
        top = s.load(k).max(top);
    }
    top.store(t.top);
    let shrink = exp_lanes(s, old - top);
    let mut chains = [s.splat(0.0); 4];
    let mut quads = keys.chunks_exact_mut(4);
    for quad in &mut quads {
        for i in 0..4 {
            let w = exp_lanes(s, s.load(&quad[i]) - top);
            w.store(&mut quad[i]);
            chains[i] = chains[i] + w;
        }
    }
    for (i, k) in quads.into_remainder().iter_mut().enumerate() {
        let w = exp_lanes(s, s.load(k) - top);
        w.store(k);
        chains[i] = chains[i] + w;
    }
    let sum = (chains[0] + chains[1]) + (chains[2] + chains[3]);
    s.load(t.total).mul_add(shrink, sum).store(t.total);
    for row in t.sums.as_chunks_mut::<LANES>().0 {
        (s.load(row) * shrink).store(row);
    }
}

/// Taken off every weight, an integer from 0 to 254, so that it is a signed byte.
pub(crate) const WEIGHT_ZERO: i32 = 127;

/// 2^-r for |r| <= 1/2, times 254: 254 at 0, elsewhere within 1.02e-4 of itself (a fortieth of a step).
#[inline(always)]
fn weight_polynomial<S: Simd>(s: S, r: S::V) -> S::V {
    // 254 times the minimax coefficients 0.693282961, 0.242211170, 0.0550088309 of 2^u, u = -r.
    let p = s.splat(-13.972_243);
    let p = p.mul_add(r, s.splat(61.521_637));
    let p = p.mul_add(r, s.splat(-176.093_87));
    p.mul_add(r, s.splat(254.0))
}

/// Added to the weight of each key of a tile before it is rounded, between -0.4965 and 0.4965: multiples of the golden ratio, spread
/// evenly over any run of keys. The largest weight stays 254.
///
/// Rounded alike, all weights below 1/508 of the tile's largest vanish, and a softmax with one peak over many small weights becomes
/// sharper: an error of the same sign in every query, which adds up where tokens are pooled, in the poses. With these offsets, of weights
/// of 0.3 three in ten become one, and their sum stays.
static DITHER: [f32; KEYS] = {
    let mut d = [0.0; KEYS];
    let mut j = 0;
    while j < KEYS {
        let golden = (j as u32 * 40503) as u16;
        d[j] = (golden as f32 - 32768.0) / 66000.0;
        j += 1;
    }
    d
};

/// Integer scores of one tile for 16 queries, to weights.
pub(crate) struct WeightsS8<'a> {
    /// `[keys][16]` sums; overwritten.
    pub scores: &'a mut [i32],
    /// Scale of each key; as many as keys.
    pub key_scales: &'a [f32],
    /// Scale of each query.
    pub query_scales: &'a [f32; LANES],
    /// Largest score * key scale, `[16]`.
    pub top: &'a mut [f32; LANES],
    /// `[keys/4][16][4]`: weight - 127; weight 0 behind the last key.
    pub weights: &'a mut [i8],
    /// Sums of weight - 127, those behind the last key included, `[16]`.
    pub totals: &'a mut [i32; LANES],
}

/// t = score * key scale, top = max t, weight = round(254 * 2^((t - top) * query scale * log2 e) + dither of the key), the power 0 below
/// 2^-20.
#[inline(always)]
pub(crate) fn weights_tile<S: Simd>(s: S, t: WeightsS8) {
    let n = t.key_scales.len();
    let scores = &mut t.scores.as_chunks_mut::<LANES>().0[..n];
    // From keys on, not from minus infinity, so that NaN stays (a NaN in a key is one in the mean, and so in every key). Four chains: one
    // waits four cycles for each maximum.
    let mut tops = [s.splat(0.0); 4];
    for (i, top) in tops.iter_mut().enumerate() {
        let i = i.min(n - 1);
        *top = s.load_i32(&scores[i]) * s.splat(t.key_scales[i]);
    }
    for (scores, scales) in scores.chunks_mut(4).zip(t.key_scales.chunks(4)) {
        for ((score, &scale), top) in scores.iter_mut().zip(scales).zip(&mut tops) {
            let v = s.load_i32(score) * s.splat(scale);
            *top = v.max(*top);
            v.store(bytemuck::cast_mut(score));
        }
    }
    let top = tops[0].max(tops[1]).max(tops[2].max(tops[3]));
    top.store(t.top);
    let scale = s.load(t.query_scales) * s.splat(std::f32::consts::LOG2_E);
    let negative = s.splat(0.0) - scale;
    let floor = s.splat(-20.0) / scale;
    // The low bits of a number moved here hold n + 127: shifted, they are 2^n.
    let shift = s.splat(ROUND + 127.0);
    let none = s.splat(ROUND - WEIGHT_ZERO as f32);
    let quads = t.weights.as_chunks_mut::<{ QUAD * LANES }>().0;
    // A weight is the number ROUND + (weight - 127): its bits are those of ROUND plus the integer, and so are sums of bits.
    let mut bits = [s.splat(0.0); 2];
    for ((scores, dither), out) in scores.chunks(QUAD).zip(DITHER.as_chunks::<QUAD>().0).zip(quads) {
        let mut quad = [none; QUAD];
        if let Some(four) = scores.first_chunk::<QUAD>() {
            for i in 0..QUAD {
                let (t, d) = (s.load(bytemuck::cast_ref(&four[i])), s.splat(dither[i]));
                quad[i] = weight(s, (t, d), (top, floor), (scale, negative), (shift, none));
            }
        } else {
            for ((v, d), y) in scores.iter().zip(dither).zip(&mut quad) {
                let (t, d) = (s.load(bytemuck::cast_ref(v)), s.splat(*d));
                *y = weight(s, (t, d), (top, floor), (scale, negative), (shift, none));
            }
        }
        bits[0] = bits[0].add_bits(quad[0].add_bits(quad[1]));
        bits[1] = bits[1].add_bits(quad[2].add_bits(quad[3]));
        S::V::store_low_bytes(quad, out);
    }
    bits[0].add_bits(bits[1]).store(bytemuck::cast_mut(t.totals));
    let many = (n.next_multiple_of(QUAD) as u32).wrapping_mul(ROUND.to_bits()) as i32;
    for total in t.totals.iter_mut() {
        *total = total.wrapping_sub(many);
    }
}

/// One weight, its integer minus 127 in the low byte.
#[inline(always)]
fn weight<S: Simd>(
    s: S,
    (t, dither): (S::V, S::V),
    (top, floor): (S::V, S::V),
    (scale, negative): (S::V, S::V),
    (shift, none): (S::V, S::V),
) -> S::V {
    let x = floor.max(t - top);
    let shifted = x.mul_add(scale, shift);
    let n = shifted - shift;
    let r = x.mul_add(negative, n);
    weight_polynomial(s, r).mul_add(shifted.pow2_of_low_bits(0), dither) + none
}

/// Sums of one tile for 16 queries, to be added to the running ones.
pub(crate) struct MergeS8<'a> {
    /// `[d][16]`: sums of (weight - 127) * value.
    pub sums: &'a [i32],
    /// Step of each channel, `[d]`.
    pub steps: &'a [f32],
    /// 127 times the sum of each channel's integers, `[d]`.
    pub offsets: &'a [f32],
    /// Sums of (weight - 127), `[16]`.
    pub weights: &'a [i32; LANES],
    /// 127 times the keys of the tile, rounded up to four.
    pub weight_offset: f32,
    /// Largest score * key scale of the tile, `[16]`.
    pub tile_top: &'a [f32; LANES],
    /// Scale of each query.
    pub query_scales: &'a [f32; LANES],
    /// Added to every score of the tile's frame, `[16]`.
    pub shift: &'a [f32; LANES],
    /// Largest score so far.
    pub top: &'a mut [f32; LANES],
    /// Sum of weights so far, in units of 254 at the largest score.
    pub total: &'a mut [f32; LANES],
    /// `[d][16]`: sums of weighted values so far.
    pub out: &'a mut [f32],
}

/// m = fma(tile top, query scale, shift); M' = max(m, M); w = e^(m - M'), k = e^(M - M'); total = fma(weights, w, total * k); out
/// = fma((sums + offset) * step, w, out * k). Integers below 2^24, so their conversion and the sum with the offset are exact.
#[inline(always)]
pub(crate) fn merge_tile<S: Simd>(s: S, t: MergeS8) {
    let old = s.load(t.top);
    let m = s.load(t.tile_top).mul_add(s.load(t.query_scales), s.load(t.shift));
    let top = m.max(old);
    top.store(t.top);
    let (w, k) = (exp_lanes(s, m - top), exp_lanes(s, old - top));
    let total = s.load_i32(t.weights) + s.splat(t.weight_offset);
    total.mul_add(w, s.load(t.total) * k).store(t.total);
    let d = t.steps.len();
    let sums = &t.sums.as_chunks::<LANES>().0[..d];
    let out = &mut t.out.as_chunks_mut::<LANES>().0[..d];
    let offsets = &t.offsets[..d];
    for c in 0..d {
        let y = (s.load_i32(&sums[c]) + s.splat(offsets[c])) * s.splat(t.steps[c]);
        y.mul_add(w, s.load(&out[c]) * k).store(&mut out[c]);
    }
}

/// Finished sums of up to 16 queries, to rows.
pub(crate) struct Rows<'a> {
    /// `[d][16]`; overwritten.
    pub sums: &'a mut [f32],
    /// Sum of weights, `[16]`.
    pub total: &'a [f32; LANES],
    /// Queries in use.
    pub queries: usize,
    /// The whole output.
    pub out: &'a SharedMut<'a, f32>,
    /// Place of the first query's first channel in it.
    pub at: usize,
    /// Values from one row to the next.
    pub stride: usize,
}

/// out = sums / total, transposed: the quotient is a product with 1 / total.
#[inline(always)]
pub(crate) fn store_rows<S: Simd>(s: S, t: Rows) {
    let share = s.splat(1.0) / s.load(t.total);
    let channels = t.sums.as_chunks::<LANES>().0;
    for (b, from) in channels.chunks(LANES).enumerate() {
        let mut block = [[0.0f32; LANES]; LANES];
        for (to, x) in block.iter_mut().zip(from) {
            (s.load(x) * share).store(to);
        }
        s.transpose(&mut block);
        for (q, row) in block.iter().enumerate().take(t.queries) {
            let at = t.at + q * t.stride + b * LANES;
            // SAFETY: the columns of one head in one row belong to one task, and a piece lives only in this loop.
            #[allow(unsafe_code)]
            let out = unsafe { t.out.slice(at..at + from.len()) };
            match out.first_chunk_mut::<LANES>() {
                Some(out) => s.load(row).store(out),
                None => out.copy_from_slice(&row[..from.len()]),
            }
        }
    }
}
