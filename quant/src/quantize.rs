//! One matrix to int8: folded, rotated, scaled and rounded in f64, row by row.
//!
//! Row o of the stored matrix is round(w / s), w = R (gamma_o * W_o * gain), s the step that gives the smallest
//! squared error (`best_scale`). Rounding is to nearest, ties to even; values stay in [-127, 127].

use crate::calibrate::{Calibration, Metric};
use crate::rng::Stream;
use rayon::prelude::*;
use sf_formats::arch::TensorSpec;
use sf_formats::panel::{LANES, Order};
use sf_formats::panel_s8::{MAX_SCALE, rotate, rotated_width, rotation_block};

/// Largest magnitude of a value.
const TOP: f64 = 127.0;
/// Steps tried, as shares of max / 127. At k = 1024 normal values the best is about 0.97; heavy tails pull it down.
const SHARES: [f64; 12] = [1.0, 0.97, 0.94, 0.91, 0.88, 0.85, 0.8, 0.75, 0.7, 0.6, 0.5, 0.4];
/// Rounds of "quantize, then the best step for these integers" after the search.
const REFINEMENTS: usize = 3;

/// What is multiplied into a matrix before it is quantized.
#[derive(Clone, Debug, Default)]
pub struct Fold {
    /// Gain of the norm in front, one per input.
    pub gain: Option<Vec<f32>>,
    /// Offset of the norm in front; goes into the bias.
    pub offset: Option<Vec<f32>>,
    /// Layer scale behind, one per output.
    pub gamma: Option<Vec<f32>>,
}

impl Fold {
    /// Whether there is nothing to do.
    pub fn is_empty(&self) -> bool {
        self.gain.is_none() && self.offset.is_none() && self.gamma.is_none()
    }
}

/// A quantized matrix.
#[derive(Clone, Debug, PartialEq)]
pub struct Quantized {
    /// `[n][k]`, k in the order of [`TensorSpec::matrix`], in [-127, 127].
    pub values: Vec<i8>,
    /// `[n]`.
    pub scales: Vec<f32>,
    /// One bit per rotated channel, 16 a word.
    pub signs: Vec<u16>,
    /// Sum of the squared weights (folded).
    pub signal: f64,
    /// Sum of the squared errors.
    pub noise: f64,
    /// `[n]`: what the bias gains; zeros without calibration.
    pub shift: Vec<f64>,
}

impl Quantized {
    /// Signal to error in dB, at most [`EXACT_DB`].
    pub fn sqnr_db(&self) -> f64 {
        sqnr_db(self.signal, self.noise)
    }
}

/// Stands for "no error".
pub const EXACT_DB: f64 = 300.0;

/// 10 log10(signal / noise), at most [`EXACT_DB`].
pub fn sqnr_db(signal: f64, noise: f64) -> f64 {
    if noise == 0.0 { EXACT_DB } else { (10.0 * (signal / noise).log10()).clamp(-EXACT_DB, EXACT_DB) }
}

/// Signs of the rotation over `width` channels. The same for every layer of that width, so that layers which
/// read one input can share its quantized form.
pub fn signs(width: usize) -> Vec<u16> {
    let stream = Stream::new(0, &format!("rotation {width}"));
    (0..width / LANES).map(|w| (stream.bits(w as u64) >> 48) as u16).collect()
}

/// Row `o` of a matrix in the order of its inputs, folded.
pub fn folded_row(values: &[f32], order: &Order, fold: &Fold, o: usize, row: &mut [f64]) {
    let gamma = fold.gamma.as_ref().map_or(1.0, |g| f64::from(g[o]));
    for (i, v) in row.iter_mut().enumerate() {
        let gain = fold.gain.as_ref().map_or(1.0, |g| f64::from(g[i]));
        *v = f64::from(values[order.at(o, i)]) * gain * gamma;
    }
}

/// A folded matrix in checkpoint order, not quantized.
pub fn folded(spec: &TensorSpec, values: &[f32], fold: &Fold) -> Vec<f32> {
    let order = Order::of(spec).unwrap_or_else(|| panic!("{} is no matrix", spec.name));
    let (n, k) = spec.matrix().expect("as above");
    let (mut out, mut row) = (vec![0.0; n * k], vec![0.0; k]);
    for o in 0..n {
        folded_row(values, &order, fold, o, &mut row);
        row.iter().enumerate().for_each(|(i, &v)| out[order.at(o, i)] = v as f32);
    }
    out
}

/// The bias that goes with a folded linear layer: gamma * (b + W offset).
pub fn folded_bias(spec: &TensorSpec, weight: &[f32], fold: &Fold, bias: &[f32]) -> Vec<f32> {
    let order = Order::of(spec).unwrap_or_else(|| panic!("{} is no matrix", spec.name));
    let (n, k) = spec.matrix().expect("as above");
    assert_eq!(bias.len(), n, "bias of {}", spec.name);
    let folded = |o: usize| {
        let shift = fold.offset.as_ref().map_or(0.0, |offset| {
            (0..k).map(|i| f64::from(weight[order.at(o, i)]) * f64::from(offset[i])).sum::<f64>()
        });
        let gamma = fold.gamma.as_ref().map_or(1.0, |g| f64::from(g[o]));
        (gamma * (f64::from(bias[o]) + shift)) as f32
    };
    (0..n).map(folded).collect()
}

/// Quantizes a matrix; `values` in checkpoint order. With a rotation its input width must have one
/// ([`rotation_block`]). A calibration that has seen the layer rounds for the smallest error of its outputs.
///
/// Rows are independent: any number of threads gives the same result.
pub fn quantize(
    spec: &TensorSpec,
    values: &[f32],
    fold: &Fold,
    rotated: bool,
    calibration: Option<&Calibration>,
) -> Quantized {
    let order = Order::of(spec).unwrap_or_else(|| panic!("{} is no matrix", spec.name));
    let (n, k) = spec.matrix().expect("as above");
    let width = rotated_width(spec).expect("a matrix has inputs");
    assert!(!rotated || rotation_block(width).is_some(), "a rotation of the inputs of {} {:?}", spec.name, spec.shape);
    let signs = if rotated { signs(width) } else { Vec::new() };
    // What is rotated is seen before the rotation, which a convolution's window of many pixels would need for each of them.
    let metric = calibration.filter(|_| k == width || !rotated).and_then(|c| c.metric(&spec.name, fold, &signs));
    let (mut out, mut scales) = (vec![0i8; n * k], vec![0.0f32; n]);
    let sums: Vec<(f64, f64, f64)> = (out.par_chunks_exact_mut(k), scales.par_iter_mut())
        .into_par_iter()
        .enumerate()
        .map_init(
            || (vec![0.0f64; k], vec![0.0f64; k]),
            |(row, left), (o, (to, scale))| {
                folded_row(values, &order, fold, o, row);
                if rotated {
                    row.chunks_exact_mut(width).for_each(|channels| rotate(channels, &signs));
                }
                let (best, signal, noise) = quantize_row(row, to);
                *scale = best;
                match &metric {
                    Some(metric) if noise < signal => {
                        let (noise, shift) = calibrated_row(metric, row, (to, scale), left);
                        (signal, noise, shift)
                    }
                    _ => (signal, noise, 0.0),
                }
            },
        )
        .collect();
    // In order: the sum does not depend on the threads.
    let (signal, noise) = sums.iter().fold((0.0, 0.0), |(s, e), (a, b, _)| (s + a, e + b));
    Quantized { values: out, scales, signs, signal, noise, shift: sums.into_iter().map(|s| s.2).collect() }
}

/// Shares of a row's least-squares step that are tried with the inputs in mind: rounding that makes up for errors may use
/// a finer or coarser grid.
const STEPS: [f64; 3] = [1.0, 0.9, 1.1];

/// Replaces a row's integers and step by those of the smallest error of the outputs; (squared error of the weights, what
/// the bias gains).
fn calibrated_row(metric: &Metric, row: &[f64], (to, scale): (&mut [i8], &mut f32), left: &mut [f64]) -> (f64, f64) {
    let first = *scale;
    let mut best = f64::INFINITY;
    for share in STEPS {
        let step = (f64::from(first) * share) as f32;
        let error = metric.round(row, f64::from(step), |v| round(v.clamp(-TOP, TOP)), to, left);
        if error < best {
            (best, *scale) = (error, step);
        }
    }
    metric.round(row, f64::from(*scale), |v| round(v.clamp(-TOP, TOP)), to, left);
    (left.iter().map(|e| e * e).sum(), metric.shift(left))
}

/// Rounds to nearest, ties to even, without the library: |x| must be below 2^51.
fn round(x: f64) -> f64 {
    const MAGIC: f64 = 1.5 * (1u64 << 52) as f64;
    (x + MAGIC) - MAGIC
}

/// Value of `w` in steps of 1 / inverse.
fn level(w: f64, inverse: f64) -> f64 {
    round((w * inverse).clamp(-TOP, TOP))
}

/// Sum of the squared errors with a step.
fn noise(row: &[f64], step: f64) -> f64 {
    let inverse = 1.0 / step;
    // Four sums, so that additions do not wait for each other.
    let mut sums = [0.0f64; 4];
    let (chunks, rest) = row.as_chunks::<4>();
    for chunk in chunks {
        for (sum, &w) in sums.iter_mut().zip(chunk) {
            let e = w - step * level(w, inverse);
            *sum += e * e;
        }
    }
    let rest: f64 = rest.iter().map(|&w| (w - step * level(w, inverse)).powi(2)).sum();
    sums.iter().sum::<f64>() + rest
}

/// The step with the smallest squared error among [`SHARES`] of max / 127, refined: for given integers the best
/// step is <w, q> / <q, q>, for a given step the best integers are the rounded ones.
fn best_scale(row: &[f64], max: f64) -> f64 {
    let first = max / TOP;
    let mut best = (noise(row, first), first);
    for share in &SHARES[1..] {
        let step = first * share;
        let error = noise(row, step);
        if error < best.0 {
            best = (error, step);
        }
    }
    for _ in 0..REFINEMENTS {
        let inverse = 1.0 / best.1;
        let (wq, qq) = row.iter().fold((0.0, 0.0), |(wq, qq), &w| {
            let q = level(w, inverse);
            (wq + w * q, qq + q * q)
        });
        let step = wq / qq;
        let error = noise(row, step);
        if error.is_nan() || error >= best.0 {
            break;
        }
        best = (error, step);
    }
    best.1
}

/// Quantizes a row; (scale, signal, noise). A row of zeros (or of values below 2^-50 of anything in use) is
/// zeros with scale 1.
fn quantize_row(row: &[f64], to: &mut [i8]) -> (f32, f64, f64) {
    let max = row.iter().fold(0.0f64, |m, v| m.max(v.abs()));
    let signal: f64 = row.iter().map(|v| v * v).sum();
    let limits = 1.0 / f64::from(MAX_SCALE)..=f64::from(MAX_SCALE);
    if !limits.contains(&(0.25 * max / TOP)) {
        to.fill(0);
        return (1.0, signal, signal);
    }
    let scale = best_scale(row, max) as f32;
    let (step, inverse) = (f64::from(scale), 1.0 / f64::from(scale));
    let mut error = 0.0;
    for (to, &w) in to.iter_mut().zip(row) {
        let q = level(w, inverse);
        error += (w - step * q).powi(2);
        *to = q as i8;
    }
    (scale, signal, error)
}

#[cfg(test)]
mod tests {
    use super::*;
    use sf_formats::arch::Role;

    fn spec(shape: &[usize], role: Role) -> TensorSpec {
        TensorSpec { name: "t".into(), shape: shape.to_vec(), role }
    }

    fn random(n: usize, name: &str) -> Vec<f32> {
        let s = Stream::new(3, name);
        (0..n).map(|i| s.normal(i as u64) as f32).collect()
    }

    /// The stored matrix times the rotated input is the folded layer on the plain input.
    #[test]
    fn products_are_those_of_the_layer() {
        for (shape, role) in
            [(vec![5, 48], Role::Linear), (vec![4, 32, 3, 3], Role::Conv), (vec![64, 3, 2, 2], Role::ConvTranspose)]
        {
            let spec = spec(&shape, role);
            let (n, k) = spec.matrix().unwrap();
            let width = rotated_width(&spec).unwrap();
            let w = random(n * k, "w");
            let (gain, offset, gamma) = (random(k, "gain"), random(k, "offset"), random(n, "gamma"));
            let fold = Fold { gain: Some(gain.clone()), offset: Some(offset.clone()), gamma: Some(gamma.clone()) };
            let q = quantize(&spec, &w, &fold, true, None);
            let bias = random(n, "bias");
            let folded = folded_bias(&spec, &w, &fold, &bias);
            let order = Order::of(&spec).unwrap();
            let x: Vec<f64> = random(k, "x").into_iter().map(f64::from).collect();
            let mut rotated = x.clone();
            rotated.chunks_exact_mut(width).for_each(|c| rotate(c, &q.signs));
            let mut power = (0.0, 0.0);
            for o in 0..n {
                let want: f64 = (0..k)
                    .map(|i| f64::from(w[order.at(o, i)]) * (x[i] * f64::from(gain[i]) + f64::from(offset[i])))
                    .sum::<f64>();
                let want = f64::from(gamma[o]) * (want + f64::from(bias[o]));
                let sum: f64 = (0..k).map(|i| f64::from(q.values[o * k + i]) * rotated[i]).sum();
                let have = sum * f64::from(q.scales[o]) + f64::from(folded[o]);
                power = (power.0 + want * want, power.1 + (want - have).powi(2));
            }
            let db = 10.0 * (power.0 / power.1).log10();
            // 8-bit normal weights: 40 dB and more.
            assert!(db > 36.0, "{role:?} {db}");
            assert!((q.sqnr_db() - db).abs() < 8.0, "{role:?} {} {db}", q.sqnr_db());
        }
    }

    /// No step of a fine grid is better by more than a quarter of a decibel.
    #[test]
    fn the_step_is_the_best_one() {
        for tail in [0.0, 4.0, 40.0] {
            let mut row: Vec<f64> = random(512, "row").into_iter().map(f64::from).collect();
            row[7] += tail;
            let max = row.iter().fold(0.0f64, |m, v| m.max(v.abs()));
            let found = noise(&row, best_scale(&row, max));
            let least = (200..=1000).map(|i| noise(&row, max / TOP * f64::from(i) / 1000.0)).fold(f64::MAX, f64::min);
            assert!(found <= least * 1.06, "{tail}: {found} {least}");
        }
    }

    #[test]
    fn zeros_ties_and_extremes() {
        let mut to = [9i8; 4];
        assert_eq!(quantize_row(&[0.0; 4], &mut to), (1.0, 0.0, 0.0));
        assert_eq!(to, [0; 4]);
        quantize_row(&[127.0, -127.0, 2.5, -0.5], &mut to);
        assert_eq!(to[..2], [127, -127]);
        assert_eq!([0.5, 1.5, 2.5, -0.5, -1.5].map(round), [0.0, 2.0, 2.0, 0.0, -2.0]);
        // Far outside of f32: nothing that a network computes with.
        assert_eq!(quantize_row(&[1e-40, 0.0, 0.0, 0.0], &mut to).0, 1.0);
    }

    #[test]
    fn signs_are_those_of_the_format() {
        assert_eq!(signs(64).len(), 4);
        assert_ne!(signs(64), signs(128)[..4]);
        let ones: u32 = signs(4096).iter().map(|w| w.count_ones()).sum();
        assert!((1900..2200).contains(&ones), "{ones}");
    }
}
