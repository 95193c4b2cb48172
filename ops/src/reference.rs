//! The definition of every op: plain loops over slices, no dispatch, no threads, no tiles.
//!
//! Values are f32, sums are kept in f64 and rounded once, `exp`, `erf` and roots are the f64 ones of the
//! platform or of [`crate::trig`]; so these results are closer to the exact ones than any f32 kernel and
//! serve as oracle for all of them. Weights come in the order of a checkpoint (`[out, in]`,
//! `[out, in, kh, kw]`, `[in, out, k, k]`), so that packing is judged too. Not bit-equal to the fast ops.

use crate::attention::{FrameMask, QueryIntegers};
use crate::gemm::Act;
use crate::mat::{Hwc, Mat};
use crate::resize::Corners;
use crate::rope::{QkNorm, RopeTable};
use crate::trig;

/// x W^T + b: `x` `[rows, k]`, `w` `[n, k]`, `bias` `[n]` -> `[rows, n]`.
pub fn linear(x: Mat, w: &[f32], bias: Option<&[f32]>) -> Vec<f32> {
    let n = w.len().checked_div(x.cols).unwrap_or(bias.map_or(0, <[f32]>::len));
    assert_eq!(w.len(), n * x.cols, "weights of {} inputs", x.cols);
    let mut out = Vec::with_capacity(x.rows * n);
    for r in 0..x.rows {
        let row = x.row(r);
        for j in 0..n {
            let wj = &w[j * x.cols..][..x.cols];
            let mut sum = 0.0f64;
            for (a, b) in row.iter().zip(wj) {
                sum += f64::from(*a) * f64::from(*b);
            }
            out.push((sum + bias.map_or(0.0, |b| f64::from(b[j]))) as f32);
        }
    }
    out
}

/// a W^T in integers: `a` `[rows, k]`, `w` `[n, k]` -> `[rows, n]`.
pub fn gemm_s8(a: &[i8], w: &[i8], k: usize) -> Vec<i32> {
    let mut out = Vec::new();
    for row in a.chunks_exact(k) {
        for wj in w.chunks_exact(k) {
            out.push(row.iter().zip(wj).map(|(&x, &y)| i32::from(x) * i32::from(y)).sum());
        }
    }
    out
}

/// The epilogue of an int8 product with `f32` steps, each rounded once: act(fma(sum, row scale * output scale, bias)) * gamma,
/// added to `before` with `residual`. Up to the activation it is bit-equal to the fast one.
pub fn dequantize(sum: i32, scales: (f32, f32), bias: f32) -> f32 {
    (sum as f32).mul_add(scales.0 * scales.1, bias)
}

/// A row to int8: m = max |x|, (round(x * (127 / m)) clamped to [-127, 127], m / 127); zeros and 0 where 127 / m is not finite, zeros and
/// NaN where a value is not. Bit-equal to the fast one.
pub fn quantize(x: &[f32]) -> (Vec<i8>, f32) {
    if x.iter().any(|v| !v.is_finite()) {
        return (vec![0; x.len()], f32::NAN);
    }
    let max = x.iter().fold(0.0f32, |m, v| m.max(v.abs()));
    let inverse = 127.0 / max;
    if !inverse.is_finite() {
        return (vec![0; x.len()], 0.0);
    }
    (x.iter().map(|v| (v * inverse).clamp(-127.0, 127.0).round_ties_even() as i8).collect(), max / 127.0)
}

/// Values without a sign to 0..=255: m = max x, (round(x * (255 / m) - 128), at most 127, + 128, m / 255); with zeros and values that are
/// not finite as in [`quantize`].
fn quantize_rectified(x: &[f32]) -> (Vec<i32>, f32) {
    if x.iter().any(|v| !v.is_finite()) {
        return (vec![0; x.len()], f32::NAN);
    }
    let max = x.iter().fold(0.0f32, |m, v| m.max(*v));
    let inverse = 255.0 / max;
    if !inverse.is_finite() {
        return (vec![0; x.len()], 0.0);
    }
    let level = |v: f32| v.mul_add(inverse, -128.0).min(127.0).round_ties_even() as i32 + 128;
    (x.iter().map(|&v| level(v)).collect(), max / 255.0)
}

/// y_i = 1/sqrt(b) sum over j of (-1)^popcount(i & j) d_j x_j in each block of b values; d_j = -1 where bit j % 16 of
/// `signs[j / 16]` is set.
pub fn hadamard(x: &[f32], signs: &[u16], block: usize) -> Vec<f32> {
    let c = 1.0 / (block as f64).sqrt();
    (0..x.len())
        .map(|i| {
            let first = i / block * block;
            let term = |j: usize| {
                let negative = (i & (j - first) & (block - 1)).count_ones() + u32::from(signs[j / 16] >> (j % 16) & 1);
                if negative.is_multiple_of(2) { f64::from(x[j]) } else { -f64::from(x[j]) }
            };
            ((first..first + block).map(term).sum::<f64>() * c) as f32
        })
        .collect()
}

/// (x - mean) / sqrt(var + eps) * gain + offset per row, var with divisor `cols`; `[rows, cols]`.
pub fn layernorm(x: Mat, gain: &[f32], offset: &[f32], eps: f32) -> Vec<f32> {
    let mut out = Vec::with_capacity(x.rows * x.cols);
    for r in 0..x.rows {
        let row = x.row(r);
        let n = x.cols as f64;
        let mean = row.iter().map(|&v| f64::from(v)).sum::<f64>() / n;
        let var = row.iter().map(|&v| (f64::from(v) - mean).powi(2)).sum::<f64>() / n;
        let scale = 1.0 / (var + f64::from(eps)).sqrt();
        for c in 0..x.cols {
            out.push(((f64::from(row[c]) - mean) * scale * f64::from(gain[c]) + f64::from(offset[c])) as f32);
        }
    }
    out
}

/// max(x, 0); NaN stays.
pub fn relu(x: f32) -> f32 {
    if x < 0.0 { 0.0 } else { x }
}

/// 1 / (1 + e^-x).
pub fn sigmoid(x: f32) -> f32 {
    (1.0 / (1.0 + trig::exp(-f64::from(x)))) as f32
}

/// e^x.
pub fn exp(x: f32) -> f32 {
    trig::exp(f64::from(x)) as f32
}

/// Error function in f64: 2/sqrt(pi) times the integral of e^(-t^2) from 0 to x, by its power series below 3
/// and by the continued fraction of erfc above; about 1e-15 absolute.
pub fn erf(x: f64) -> f64 {
    1.0 - erfc(x)
}

/// 1 - erf(x), accurate relative to itself where x > 3.
pub fn erfc(x: f64) -> f64 {
    if x.is_nan() {
        return x;
    }
    let z = x.abs();
    let positive = if z < 3.0 {
        // erf(z) = 2/sqrt(pi) e^(-z^2) sum 2^n z^(2n+1) / (2n+1)!!, all terms positive.
        let (mut term, mut sum) = (z, z);
        let mut n = 1.0;
        while term > sum * 1e-18 {
            term *= 2.0 * z * z / (2.0 * n + 1.0);
            sum += term;
            n += 1.0;
        }
        1.0 - std::f64::consts::FRAC_2_SQRT_PI * trig::exp(-z * z) * sum
    } else {
        // erfc(z) = e^(-z^2)/sqrt(pi) / (z + (1/2)/(z + (2/2)/(z + (3/2)/...))).
        let mut tail = z;
        for k in (1..=60).rev() {
            tail = z + 0.5 * f64::from(k) / tail;
        }
        trig::exp(-z * z) * 0.5 * std::f64::consts::FRAC_2_SQRT_PI / tail
    };
    if x < 0.0 { 2.0 - positive } else { positive }
}

/// x Phi(x) with the exact normal distribution function (the erf form).
pub fn gelu(x: f32) -> f32 {
    let x = f64::from(x);
    if x == f64::NEG_INFINITY {
        return 0.0;
    }
    (0.5 * x * erfc(-x * std::f64::consts::FRAC_1_SQRT_2)) as f32
}

/// The activation of an epilogue.
pub fn activate(x: f32, act: Act) -> f32 {
    match act {
        Act::None => x,
        Act::Gelu => gelu(x),
        Act::Relu => relu(x),
    }
}

/// Per-head layer norm of q and k, then 2-D rotary embedding, in place. `qkv` is `[rows, 3 * heads * d]`;
/// row r uses table entry r modulo the table's length.
///
/// Each head's d channels are two halves, the first turned by the row position, the second by the column;
/// inside a half of size D channel m pairs with m + D/2.
pub fn qk_norm_rope(qkv: &mut [f32], rows: usize, heads: usize, norm: Option<&QkNorm>, rope: Option<&RopeTable>) {
    if rows == 0 {
        return;
    }
    let width = qkv.len() / rows;
    let d = width / (3 * heads);
    assert_eq!(qkv.len(), rows * 3 * heads * d, "{rows} rows of 3 x {heads} heads");
    for r in 0..rows {
        for part in 0..2 {
            for h in 0..heads {
                let x = &mut qkv[r * width + (part * heads + h) * d..][..d];
                if let Some(n) = norm {
                    let (gain, offset) = if part == 0 { (n.q_gain, n.q_offset) } else { (n.k_gain, n.k_offset) };
                    let y = layernorm(Mat::new(x, 1, d), gain, offset, n.eps);
                    x.copy_from_slice(&y);
                }
                if let Some(table) = rope {
                    let (cos, sin) = table.entry(r % table.len());
                    let quarter = d / 4;
                    for half in 0..2 {
                        for m in 0..quarter {
                            let (i, j, t) = (half * 2 * quarter + m, (half * 2 + 1) * quarter + m, half * quarter + m);
                            let (a, b) = (f64::from(x[i]), f64::from(x[j]));
                            let (c, s) = (f64::from(cos[t]), f64::from(sin[t]));
                            x[i] = (a * c - b * s) as f32;
                            x[j] = (b * c + a * s) as f32;
                        }
                    }
                }
            }
        }
    }
}

/// softmax(q k^T / sqrt(d)) v under a frame mask; `qkv` `[frames * tokens, 3 * heads * d]` ->
/// `[frames * tokens, heads * d]`. A query without any key gives exactly 0.
pub fn attention(qkv: Mat, heads: usize, mask: FrameMask) -> Vec<f32> {
    let rows = mask.frames * mask.tokens;
    assert_eq!(qkv.rows, rows, "{} frames of {} tokens", mask.frames, mask.tokens);
    let c = qkv.cols / 3;
    let d = c / heads;
    assert_eq!(qkv.cols, 3 * heads * d, "{} columns for {heads} heads", qkv.cols);
    let scale = 1.0 / (d as f64).sqrt();
    let mut out = vec![0.0; rows * c];
    for q in 0..rows {
        let frame = q / mask.tokens;
        for h in 0..heads {
            let qv = &qkv.row(q)[h * d..][..d];
            let keys: Vec<usize> = (0..rows).filter(|&k| mask.sees(frame, k / mask.tokens)).collect();
            let scores: Vec<f64> = keys
                .iter()
                .map(|&k| {
                    let kv = &qkv.row(k)[c + h * d..][..d];
                    qv.iter().zip(kv).map(|(a, b)| f64::from(*a) * f64::from(*b)).sum::<f64>() * scale
                })
                .collect();
            let top = scores.iter().copied().fold(f64::NEG_INFINITY, f64::max);
            let weights: Vec<f64> = scores.iter().map(|s| trig::exp(s - top)).collect();
            let total: f64 = weights.iter().sum();
            for i in 0..d {
                let sum: f64 =
                    keys.iter().zip(&weights).map(|(&k, w)| w * f64::from(qkv.row(k)[2 * c + h * d + i])).sum();
                out[q * c + h * d + i] = if keys.is_empty() { 0.0 } else { (sum / total) as f32 };
            }
        }
    }
    out
}

/// [`attention`] in int8 as [`crate::attention::attention_s8`] defines it, without norm, embedding and rotation, for finite values.
/// Returns the output and the integers inside, query by query and, inside, head by head. Its f32 steps are those of the definition,
/// each rounded once, so outputs are bit-equal to the fast ones.
pub fn attention_s8(qkv: Mat, heads: usize, mask: FrameMask) -> (Vec<f32>, Vec<QueryIntegers>) {
    const KEYS: usize = 64;
    const ROUND: f32 = 12_582_912.0;
    let FrameMask { frames, tokens, .. } = mask;
    let c = qkv.cols / 3;
    let d = c / heads;
    let factor = (1.0 / (d as f64).sqrt()) as f32;
    let head = |row: usize, part: usize, h: usize| &qkv.row(row)[part * c + h * d..][..d];
    let mut out = vec![0.0; qkv.rows * c];
    let mut integers = vec![QueryIntegers::default(); qkv.rows * heads];
    for h in 0..heads {
        // Keys of each frame less their mean, values of each frame's tiles.
        let mut means = Vec::new();
        let (mut keys, mut values, mut steps) = (Vec::new(), Vec::new(), Vec::new());
        for frame in 0..frames {
            let mut mean = vec![0.0f32; d];
            for t in 0..tokens {
                mean.iter_mut().zip(head(frame * tokens + t, 1, h)).for_each(|(m, k)| *m += k);
            }
            mean.iter_mut().for_each(|m| *m /= tokens as f32);
            for t in 0..tokens {
                let centred: Vec<f32> = head(frame * tokens + t, 1, h).iter().zip(&mean).map(|(k, m)| k - m).collect();
                keys.push(quantize(&centred));
            }
            means.push(mean);
            for first in (0..tokens).step_by(KEYS) {
                let rows: Vec<&[f32]> =
                    (first..tokens.min(first + KEYS)).map(|t| head(frame * tokens + t, 2, h)).collect();
                let columns: Vec<(Vec<i8>, f32)> =
                    (0..d).map(|i| quantize(&rows.iter().map(|r| r[i]).collect::<Vec<f32>>())).collect();
                steps.push(columns.iter().map(|(_, step)| *step).collect::<Vec<f32>>());
                values.push(columns);
            }
        }
        let tiles = tokens.div_ceil(KEYS);
        for row in 0..qkv.rows {
            let seen = mask.keys(row / tokens);
            let of = &mut integers[row * heads + h];
            let q = head(row, 0, h);
            let (q8, scale) = quantize(q);
            let scale = scale * factor;
            let (mut top, mut total, mut sums) = (f32::NEG_INFINITY, 0.0f32, vec![0.0f32; d]);
            for frame in seen.clone() {
                let mut shift = 0.0f32;
                if seen.len() > 1 {
                    for (m, q) in means[frame].iter().zip(q) {
                        shift = m.mul_add(q * factor, shift);
                    }
                }
                for tile in 0..tiles {
                    let first = tile * KEYS;
                    let keys = &keys[frame * tokens + first..frame * tokens + tokens.min(first + KEYS)];
                    let scores: Vec<i32> = keys
                        .iter()
                        .map(|(k, _)| k.iter().zip(&q8).map(|(&k, &q)| i32::from(k) * i32::from(q)).sum())
                        .collect();
                    let t: Vec<f32> = scores.iter().zip(keys).map(|(&s, (_, scale))| s as f32 * scale).collect();
                    let tile_top = t.iter().fold(t[0], |a, &b| if b > a { b } else { a });
                    let base2 = scale * std::f32::consts::LOG2_E;
                    let weights: Vec<u8> = t
                        .iter()
                        .enumerate()
                        .map(|(j, t)| {
                            let golden = (j * 40503 % 65536) as f32;
                            let floor = -20.0 / base2;
                            let x = t - tile_top;
                            let x = if floor > x { floor } else { x };
                            let shifted = x.mul_add(base2, ROUND + 127.0);
                            let n = shifted - (ROUND + 127.0);
                            let r = x.mul_add(-base2, n);
                            let p = (-13.972_243f32).mul_add(r, 61.521_637).mul_add(r, -176.093_87).mul_add(r, 254.0);
                            let dither = (golden - 32768.0) / 66000.0;
                            let y = p.mul_add(f32::from_bits(shifted.to_bits() << 23), dither) + (ROUND - 127.0);
                            (y - (ROUND - 127.0)) as u8
                        })
                        .collect();
                    let den: i32 = weights.iter().map(|&p| i32::from(p)).sum();
                    let columns = &values[frame * tiles + tile];
                    let n: Vec<i32> = columns
                        .iter()
                        .map(|(v, _)| v.iter().zip(&weights).map(|(&v, &p)| i32::from(v) * i32::from(p)).sum())
                        .collect();
                    let m = tile_top.mul_add(scale, shift);
                    let new = if m > top { m } else { top };
                    let (w, k) = (crate::activation::exp(m - new), crate::activation::exp(top - new));
                    top = new;
                    total = (den as f32).mul_add(w, total * k);
                    for ((sum, &n), step) in sums.iter_mut().zip(&n).zip(&steps[frame * tiles + tile]) {
                        *sum = (n as f32 * step).mul_add(w, *sum * k);
                    }
                    of.scores.extend(scores);
                    of.weights.extend(weights);
                    of.totals.push(den);
                    of.sums.extend(n);
                }
            }
            if !seen.is_empty() {
                let share = 1.0 / total;
                for (o, sum) in out[row * c + h * d..][..d].iter_mut().zip(sums) {
                    *o = sum * share;
                }
            }
        }
    }
    (out, integers)
}

/// Sizes of a convolution window.
#[derive(Clone, Copy, Debug)]
pub struct Window {
    /// Side of the square kernel.
    pub kernel: usize,
    /// Step between outputs.
    pub stride: usize,
    /// Zeros around the input.
    pub pad: usize,
}

/// Convolution with zero padding: `weight` `[out, in, kernel, kernel]` -> `[oh, ow, out]`.
pub fn conv2d(x: Hwc, weight: &[f32], bias: Option<&[f32]>, window: Window) -> Vec<f32> {
    let Window { kernel, stride, pad } = window;
    let per_out = x.c * kernel * kernel;
    let n = weight.len() / per_out;
    assert_eq!(weight.len(), n * per_out, "weights of {} channels, {kernel} x {kernel}", x.c);
    let oh = crate::conv::conv_out(x.h, kernel, stride, pad);
    let ow = crate::conv::conv_out(x.w, kernel, stride, pad);
    let mut out = Vec::with_capacity(oh * ow * n);
    for oy in 0..oh {
        for ox in 0..ow {
            for o in 0..n {
                let mut sum = bias.map_or(0.0, |b| f64::from(b[o]));
                for ky in 0..kernel {
                    for kx in 0..kernel {
                        // Row and column in the padded image.
                        let (y, xx) = (oy * stride + ky, ox * stride + kx);
                        if y < pad || xx < pad || y - pad >= x.h || xx - pad >= x.w {
                            continue;
                        }
                        let pixel = x.pixel(y - pad, xx - pad);
                        for (i, v) in pixel.iter().enumerate() {
                            let w = weight[((o * x.c + i) * kernel + ky) * kernel + kx];
                            sum += f64::from(*v) * f64::from(w);
                        }
                    }
                }
                out.push(sum as f32);
            }
        }
    }
    out
}

/// Convolution in integers, with the input scales of [`crate::conv_s8`]: `weight` `[out, in, kernel, kernel]` -> (sums `[oh, ow, out]`, the input
/// scale of each output pixel `[oh, ow]`). With `relu` the input is rectified first and has 255 steps.
pub fn conv2d_s8(x: Hwc, weight: &[i8], window: Window, relu: bool) -> (Vec<i32>, Vec<f32>) {
    let Window { kernel, stride, pad } = window;
    let n = weight.len() / (x.c * kernel * kernel);
    assert_eq!(weight.len(), n * x.c * kernel * kernel, "weights of {} channels, {kernel} x {kernel}", x.c);
    let oh = crate::conv::conv_out(x.h, kernel, stride, pad);
    let ow = crate::conv::conv_out(x.w, kernel, stride, pad);
    let band = crate::conv_s8::band_lines((x.h, x.w, x.c), kernel, stride, pad);
    let lines = |first: usize, count: usize| {
        let from = (first * stride).saturating_sub(pad).min(x.h);
        let to = ((first + count - 1) * stride + kernel).saturating_sub(pad).min(x.h);
        from..to.max(from)
    };
    let (mut sums, mut scales) = (Vec::new(), Vec::new());
    for oy in 0..oh {
        for ox in 0..ow {
            // Pixels that share a scale: all of the lines under the band, or the window's.
            let (ys, xs) = if kernel > stride {
                let first = oy / band * band;
                (lines(first, band.min(oh - first)), 0..x.w)
            } else {
                let from = (ox * stride).saturating_sub(pad).min(x.w);
                (lines(oy, 1), from..(ox * stride + kernel).saturating_sub(pad).clamp(from, x.w))
            };
            let mut values = Vec::new();
            for y in ys.clone() {
                for xx in xs.clone() {
                    values.extend(x.pixel(y, xx).iter().map(|&v| if relu { self::relu(v) } else { v }));
                }
            }
            let (q, scale) = if relu {
                quantize_rectified(&values)
            } else {
                let (q, scale) = quantize(&values);
                (q.into_iter().map(i32::from).collect(), scale)
            };
            scales.push(scale);
            for o in 0..n {
                let mut sum = 0;
                for t in 0..kernel * kernel {
                    let (y, xx) =
                        ((oy * stride + t / kernel).wrapping_sub(pad), (ox * stride + t % kernel).wrapping_sub(pad));
                    if !ys.contains(&y) || !xs.contains(&xx) {
                        continue;
                    }
                    let at = ((y - ys.start) * xs.len() + xx - xs.start) * x.c;
                    for i in 0..x.c {
                        let w = weight[(o * x.c + i) * kernel * kernel + t];
                        sum += q[at + i] * i32::from(w);
                    }
                }
                sums.push(sum);
            }
        }
    }
    (sums, scales)
}

/// Transposed convolution with stride = kernel: `weight` `[in, out, kernel, kernel]` ->
/// `[h * kernel, w * kernel, out]`.
pub fn conv_transpose(x: Hwc, weight: &[f32], bias: Option<&[f32]>, kernel: usize) -> Vec<f32> {
    let n = weight.len() / (x.c * kernel * kernel);
    assert_eq!(weight.len(), n * x.c * kernel * kernel, "weights of {} channels, {kernel} x {kernel}", x.c);
    let mut out = vec![0.0; x.h * x.w * kernel * kernel * n];
    for oy in 0..x.h * kernel {
        for ox in 0..x.w * kernel {
            let pixel = x.pixel(oy / kernel, ox / kernel);
            for o in 0..n {
                let mut sum = bias.map_or(0.0, |b| f64::from(b[o]));
                for (i, v) in pixel.iter().enumerate() {
                    let w = weight[((i * n + o) * kernel + oy % kernel) * kernel + ox % kernel];
                    sum += f64::from(*v) * f64::from(w);
                }
                out[(oy * x.w * kernel + ox) * n + o] = sum as f32;
            }
        }
    }
    out
}

/// Bilinear resize to `[h, w, c]`.
///
/// Source position of output i: `i (n-1)/(m-1)` with aligned corners (0 when m = 1), else
/// `max(0, (i + 1/2) n/m - 1/2)`; positions are computed in f32 as PyTorch does, and the right or lower
/// neighbour is clamped to the image.
pub fn bilinear(x: Hwc, corners: Corners, h: usize, w: usize) -> Vec<f32> {
    let mut out = Vec::with_capacity(h * w * x.c);
    for oy in 0..h {
        let (y0, y1, fy) = crate::resize::source(oy, x.h, h, corners);
        for ox in 0..w {
            let (x0, x1, fx) = crate::resize::source(ox, x.w, w, corners);
            for ch in 0..x.c {
                let at = |y: usize, xx: usize| f64::from(x.pixel(y, xx)[ch]);
                let (fx, fy) = (f64::from(fx), f64::from(fy));
                let top = at(y0, x0) * (1.0 - fx) + at(y0, x1) * fx;
                let bottom = at(y1, x0) * (1.0 - fx) + at(y1, x1) * fx;
                out.push((top * (1.0 - fy) + bottom * fy) as f32);
            }
        }
    }
    out
}

/// Column `ch * p * p + dy * p + dx` of patch (y, x) fills pixel (y p + dy, x p + dx) of channel ch:
/// `x` `[ph * pw, c * p * p]` -> `[ph * p, pw * p, c]`.
pub fn pixel_shuffle(x: Mat, grid: (usize, usize), p: usize) -> Vec<f32> {
    let (ph, pw) = grid;
    assert_eq!(x.rows, ph * pw, "{ph} x {pw} patches");
    let c = x.cols / (p * p);
    assert_eq!(x.cols, c * p * p, "{} columns for patches of {p} x {p}", x.cols);
    let mut out = vec![0.0; x.rows * x.cols];
    for oy in 0..ph * p {
        for ox in 0..pw * p {
            for ch in 0..c {
                let from = x.row((oy / p) * pw + ox / p)[(ch * p + oy % p) * p + ox % p];
                out[(oy * pw * p + ox) * c + ch] = from;
            }
        }
    }
    out
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn erf_known_values() {
        // Abramowitz and Stegun, table 7.1, and erfc(4), erfc(6) to 12 digits.
        for (x, y) in [(0.0, 0.0), (0.5, 0.520_499_877_813), (1.0, 0.842_700_792_950), (2.0, 0.995_322_265_019)] {
            assert!((erf(x) - y).abs() < 1e-12, "erf({x})");
            assert!((erf(-x) + y).abs() < 1e-12, "erf(-{x})");
        }
        assert!((erfc(4.0) / 1.541_725_790_03e-8 - 1.0).abs() < 1e-10);
        assert!((erfc(6.0) / 2.151_973_671_25e-17 - 1.0).abs() < 1e-10);
        assert!((erfc(3.0 - 1e-12) / erfc(3.0) - 1.0).abs() < 1e-9);
    }
}
