//! Rounding that knows the inputs: second moments of what a linear layer reads ([`Calibration`]), and integers chosen for
//! the smallest error of the layer's outputs instead of its weights ([`Metric`]).
//!
//! The error of an output is e x, e = w - s q. Its mean e E\[x\] is constant and goes into the bias; what is left has the square
//! e C e^T, C the covariance of the folded and rotated inputs. With C = R^T R (R upper triangular) that is |R e|^2, and
//! walking from the last input to the first, each integer is rounded around the value that makes up for the errors behind
//! it: Babai's nearest plane, which is what GPTQ does.

use crate::quantize::Fold;
use rayon::prelude::*;
use sf_formats::digest::{Digest, sha256};
use sf_formats::panel_s8::rotate;
use std::collections::BTreeMap;

/// Share of the mean variance that is added to every input's: error of the quantized inputs, which is about white, and what
/// the clips did not show.
const DAMPING: f64 = 0.01;

/// Sums over the input rows of one layer.
#[derive(Clone, Debug)]
struct Moments {
    rows: u64,
    sum: Vec<f64>,
    /// `[k][k]`, the upper triangle.
    squares: Vec<f64>,
    /// Rows not yet in the sums.
    waiting: Vec<f64>,
}

/// Rows that are added at once.
const BATCH: usize = 64;

impl Moments {
    fn new(k: usize) -> Moments {
        Moments { rows: 0, sum: vec![0.0; k], squares: vec![0.0; k * k], waiting: Vec::with_capacity(BATCH * k) }
    }

    fn add(&mut self, row: &[f32]) {
        self.waiting.extend(row.iter().map(|&v| f64::from(v)));
        if self.waiting.len() == BATCH * row.len() {
            self.settle();
        }
    }

    /// Takes the waiting rows in. Each sum runs over the rows in their order, whatever the number of threads.
    fn settle(&mut self) {
        let k = self.sum.len();
        let rows = std::mem::take(&mut self.waiting);
        for row in rows.chunks_exact(k) {
            self.sum.iter_mut().zip(row).for_each(|(s, v)| *s += v);
        }
        self.squares.par_chunks_exact_mut(k).enumerate().for_each(|(i, to)| {
            for row in rows.chunks_exact(k) {
                let x = row[i];
                to[i..].iter_mut().zip(&row[i..]).for_each(|(s, v)| *s += x * v);
            }
        });
        self.rows += (rows.len() / k) as u64;
        self.waiting = rows;
        self.waiting.clear();
    }
}

/// Second moments of the inputs of linear layers, by the name of the weight.
#[derive(Clone, Debug, Default)]
pub struct Calibration {
    layers: BTreeMap<String, Moments>,
}

impl Calibration {
    /// Takes an input row of a layer in: what the network multiplies with the weight of that name, not rotated.
    pub fn add(&mut self, weight: &str, row: &[f32]) {
        if let Some(layer) = self.layers.get_mut(weight) {
            assert_eq!(layer.sum.len(), row.len(), "inputs of {weight}");
            return layer.add(row);
        }
        let mut layer = Moments::new(row.len());
        layer.add(row);
        self.layers.insert(weight.to_string(), layer);
    }

    /// To be called after the last row.
    pub fn finish(&mut self) {
        self.layers.values_mut().filter(|m| !m.waiting.is_empty()).for_each(Moments::settle);
    }

    /// Layers seen.
    pub fn layers(&self) -> usize {
        self.layers.len()
    }

    /// Over names, counts and sums: the same clips give the same digest.
    pub fn digest(&self) -> Digest {
        let mut all = Vec::new();
        for (name, m) in &self.layers {
            all.extend_from_slice(name.as_bytes());
            all.extend_from_slice(&m.rows.to_le_bytes());
            let values: Vec<u8> = m.sum.iter().chain(&m.squares).flat_map(|v| v.to_le_bytes()).collect();
            all.extend_from_slice(&sha256(&values));
        }
        sha256(&all)
    }

    /// Mean input of the matrix `weight` without the gain and offset in `fold`; none for a layer that was not seen.
    pub(crate) fn mean(&self, weight: &str, fold: &Fold) -> Option<Vec<f32>> {
        let m = self.layers.get(weight)?;
        let inverse = inverse_gains(fold, m.sum.len());
        let mean = m.sum.iter().enumerate().map(|(i, s)| (s / m.rows as f64 - at(&fold.offset, i, 0.0)) * inverse[i]);
        Some(mean.map(|v| v as f32).collect())
    }

    /// What rounding the matrix `weight` needs to know, for inputs with `fold` taken out and rotated by `signs`; none for
    /// a layer that was not seen.
    pub(crate) fn metric(&self, weight: &str, fold: &Fold, signs: &[u16]) -> Option<Metric> {
        let m = self.layers.get(weight)?;
        let (k, n) = (m.sum.len(), m.rows as f64);
        let inverse = inverse_gains(fold, k);
        let mean: Vec<f64> = m.sum.iter().map(|s| s / n).collect();
        let mut folded: Vec<f64> = (0..k).map(|i| (mean[i] - at(&fold.offset, i, 0.0)) * inverse[i]).collect();
        let mut c = vec![0.0; k * k];
        for i in 0..k {
            for j in i..k {
                let v = (m.squares[i * k + j] / n - mean[i] * mean[j]) * inverse[i] * inverse[j];
                (c[i * k + j], c[j * k + i]) = (v, v);
            }
        }
        if !signs.is_empty() {
            rotate(&mut folded, signs);
            c.par_chunks_exact_mut(k).for_each(|row| rotate(row, signs));
            transpose(&mut c, k);
            c.par_chunks_exact_mut(k).for_each(|row| rotate(row, signs));
        }
        let spread = (0..k).map(|i| c[i * k + i].max(0.0)).sum::<f64>() / k as f64;
        if spread.is_nan() || spread <= 0.0 {
            return None;
        }
        (0..k).for_each(|i| c[i * k + i] += DAMPING * spread);
        cholesky(&mut c, k).then_some(Metric { mean: folded, r: c })
    }
}

/// Value `i` of a vector, or what stands for one that is not there.
fn at(v: &Option<Vec<f32>>, i: usize, otherwise: f64) -> f64 {
    v.as_ref().map_or(otherwise, |v| f64::from(v[i]))
}

/// 1 / gain of `k` inputs: the norm's gain and offset are in the weights, and inputs are those before them. An input of no gain does
/// nothing.
fn inverse_gains(fold: &Fold, k: usize) -> Vec<f64> {
    let gains: Vec<f64> = (0..k).map(|i| at(&fold.gain, i, 1.0)).collect();
    let least = 1e-6 * gains.iter().fold(0.0f64, |m, g| m.max(g.abs()));
    gains.iter().map(|g| if g.abs() > least { 1.0 / g } else { 0.0 }).collect()
}

fn transpose(c: &mut [f64], k: usize) {
    for i in 0..k {
        for j in 0..i {
            c.swap(i * k + j, j * k + i);
        }
    }
}

/// C = R^T R in place: R in the upper triangle, nothing of use below. Whether C was positive definite.
fn cholesky(c: &mut [f64], k: usize) -> bool {
    for i in 0..k {
        let (done, rest) = c.split_at_mut((i + 1) * k);
        let row = &mut done[i * k..];
        let pivot = row[i];
        if pivot.is_nan() || pivot <= 0.0 {
            return false;
        }
        let root = pivot.sqrt();
        row[i..].iter_mut().for_each(|v| *v /= root);
        let row = &*row;
        rest.par_chunks_exact_mut(k).enumerate().for_each(|(below, to)| {
            let j = i + 1 + below;
            let f = row[j];
            to[j..].iter_mut().zip(&row[j..]).for_each(|(t, v)| *t -= f * v);
        });
    }
    true
}

/// Sum of products in four running sums.
fn dot(a: &[f64], b: &[f64]) -> f64 {
    let mut sums = [0.0f64; 4];
    let ((a4, a_rest), (b4, b_rest)) = (a.as_chunks::<4>(), b.as_chunks::<4>());
    for (a, b) in a4.iter().zip(b4) {
        for i in 0..4 {
            sums[i] += a[i] * b[i];
        }
    }
    let rest: f64 = a_rest.iter().zip(b_rest).map(|(a, b)| a * b).sum();
    (sums[0] + sums[1]) + (sums[2] + sums[3]) + rest
}

/// Mean and covariance of the inputs of a matrix, folded and rotated.
#[derive(Clone, Debug)]
pub struct Metric {
    mean: Vec<f64>,
    /// The factor of the covariance, `[k][k]`.
    r: Vec<f64>,
}

impl Metric {
    /// Integers for a row with step `scale`, by the nearest plane; e gets what is left of the row. The squared error |R e|^2.
    pub(crate) fn round(
        &self,
        row: &[f64],
        scale: f64,
        level: impl Fn(f64) -> f64,
        q: &mut [i8],
        e: &mut [f64],
    ) -> f64 {
        let k = row.len();
        let mut error = 0.0;
        for i in (0..k).rev() {
            let r = &self.r[i * k + i..(i + 1) * k];
            let behind = dot(&r[1..], &e[i + 1..k]);
            let value = level((row[i] + behind / r[0]) / scale);
            q[i] = value as i8;
            e[i] = row[i] - scale * value;
            error += (r[0] * e[i] + behind).powi(2);
        }
        error
    }

    /// |R e|^2.
    #[cfg(test)]
    pub(crate) fn error(&self, e: &[f64]) -> f64 {
        let k = e.len();
        (0..k).map(|i| dot(&self.r[i * k + i..(i + 1) * k], &e[i..]).powi(2)).sum()
    }

    /// What the bias must gain for an error e of the row.
    pub(crate) fn shift(&self, e: &[f64]) -> f64 {
        dot(e, &self.mean)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::rng::Stream;

    /// Rows whose channels lean on each other, around a mean.
    fn rows(n: usize, k: usize) -> Vec<Vec<f32>> {
        let s = Stream::new(5, "inputs");
        let draw = |i: usize| s.normal(i as u64);
        let row = |r: usize| -> Vec<f32> {
            let common = draw(r * 2 * k);
            (0..k)
                .map(|i| (0.5 + common * (1.0 + i as f64 / k as f64) + 0.3 * draw((2 * r + 1) * k + i)) as f32)
                .collect()
        };
        (0..n).map(row).collect()
    }

    fn seen(rows: &[Vec<f32>]) -> Calibration {
        let mut c = Calibration::default();
        rows.iter().for_each(|r| c.add("w", r));
        c.finish();
        c
    }

    #[test]
    fn a_metric_is_the_error_of_the_outputs() {
        let (k, n) = (32, 300);
        let rows = rows(n, k);
        let calibration = seen(&rows);
        assert_eq!((calibration.layers(), calibration.layers["w"].rows), (1, n as u64));
        let metric = calibration.metric("w", &Fold::default(), &[]).unwrap();
        assert!(calibration.metric("other", &Fold::default(), &[]).is_none());
        let s = Stream::new(9, "error");
        let e: Vec<f64> = (0..k).map(|i| s.normal(i as u64)).collect();
        let of = |row: &Vec<f32>| row.iter().zip(&e).map(|(&x, e)| f64::from(x) * e).sum::<f64>();
        let mean = rows.iter().map(of).sum::<f64>() / n as f64;
        let variance = rows.iter().map(|r| (of(r) - mean).powi(2)).sum::<f64>() / n as f64;
        assert!((metric.shift(&e) - mean).abs() < 1e-9 * mean.abs().max(1.0));
        // The damping adds one in a hundred of the mean variance.
        let spread: f64 = (0..k)
            .map(|i| {
                let m = rows.iter().map(|r| f64::from(r[i])).sum::<f64>() / n as f64;
                rows.iter().map(|r| (f64::from(r[i]) - m).powi(2)).sum::<f64>() / n as f64
            })
            .sum::<f64>()
            / k as f64;
        let want = variance + DAMPING * spread * e.iter().map(|e| e * e).sum::<f64>();
        assert!((metric.error(&e) / want - 1.0).abs() < 1e-9, "{} {want}", metric.error(&e));
    }

    /// The same error after a rotation of inputs and weights, and with a norm's gain and offset taken out.
    #[test]
    fn folding_and_rotation_do_not_change_it() {
        let k = 32;
        let rows = rows(200, k);
        let s = Stream::new(2, "fold");
        let gain: Vec<f32> = (0..k).map(|i| 1.5 + 0.5 * s.normal(i as u64) as f32).map(|g| g.max(0.2)).collect();
        let offset: Vec<f32> = (0..k).map(|i| 0.3 * s.normal((k + i) as u64) as f32).collect();
        let fold = Fold { gain: Some(gain.clone()), offset: Some(offset.clone()), gamma: None };
        // Inputs before the norm's gain and offset, observed on their own.
        let before: Vec<Vec<f32>> = rows
            .iter()
            .map(|r| (0..k).map(|i| ((f64::from(r[i]) - f64::from(offset[i])) / f64::from(gain[i])) as f32).collect())
            .collect();
        let signs = [0x5a3c, 0x0ff1];
        let (a, b) = (
            seen(&rows).metric("w", &fold, &signs).unwrap(),
            seen(&before).metric("w", &Fold::default(), &[]).unwrap(),
        );
        let plain: Vec<f64> = (0..k).map(|i| s.normal((2 * k + i) as u64)).collect();
        let mut turned = plain.clone();
        rotate(&mut turned, &signs);
        assert!((a.error(&turned) / b.error(&plain) - 1.0).abs() < 1e-4);
        assert!((a.shift(&turned) - b.shift(&plain)).abs() < 1e-4);
    }

    /// Better outputs than rounding to nearest, by far where inputs lean on each other; and the error it reports.
    #[test]
    fn rounding_knows_the_inputs() {
        let k = 64;
        let metric = seen(&rows(400, k)).metric("w", &Fold::default(), &[]).unwrap();
        let s = Stream::new(4, "weights");
        let level = |v: f64| v.round_ties_even().clamp(-127.0, 127.0);
        let (mut ours, mut nearest) = (0.0, 0.0);
        for o in 0..16 {
            let row: Vec<f64> = (0..k).map(|i| s.normal((o * k + i) as u64)).collect();
            let (scale, mut q, mut e) = (0.2, vec![0i8; k], vec![0.0; k]);
            let error = metric.round(&row, scale, level, &mut q, &mut e);
            assert!((error / metric.error(&e) - 1.0).abs() < 1e-9);
            assert!((0..k).all(|i| (row[i] - scale * f64::from(q[i]) - e[i]).abs() < 1e-12));
            ours += error;
            nearest += metric.error(&row.iter().map(|w| w - scale * level(w / scale)).collect::<Vec<_>>());
        }
        assert!(ours < 0.5 * nearest, "{ours} {nearest}");
    }

    #[test]
    fn the_digest_is_that_of_the_rows() {
        let rows = rows(70, 16);
        assert_eq!(seen(&rows).digest(), seen(&rows).digest());
        assert_ne!(seen(&rows).digest(), seen(&rows[1..]).digest());
    }
}
