//! What each choice of int8 attention is worth: signal to error, in decibels, against softmax in f64, for one head.
//!
//! `cargo run --release -p sf-ops --example attention_accuracy`
//!
//! A simulation in f64 of the roundings only, with each choice changed alone; `sf_ops::attention::attention_s8` is the first row.

/// Head width, keys, queries.
const D: usize = 64;
const N: usize = 740;
const QUERIES: usize = 48;

struct Random(u64);

impl Random {
    fn uniform(&mut self) -> f64 {
        self.0 ^= self.0 >> 12;
        self.0 ^= self.0 << 25;
        self.0 ^= self.0 >> 27;
        (self.0.wrapping_mul(0x2545_f491_4f6c_dd1d) >> 11) as f64 / (1u64 << 53) as f64
    }

    fn bell(&mut self) -> f64 {
        let (a, b) = (self.uniform().max(1e-300), self.uniform());
        (-2.0 * a.ln()).sqrt() * (std::f64::consts::TAU * b).cos()
    }

    fn rows(&mut self, n: usize) -> Vec<Vec<f64>> {
        (0..n).map(|_| (0..D).map(|_| self.bell()).collect()).collect()
    }
}

#[derive(Clone, Copy)]
struct Choice {
    name: &'static str,
    /// Steps of the largest weight.
    levels: f64,
    /// Keys with one largest weight.
    tile: usize,
    /// Keys with one step per channel of v.
    value_tile: usize,
    /// Keys less their mean.
    centred: bool,
    /// Random-sign Hadamard rotation of q and k.
    rotated: bool,
    /// q and k, and v, in int8; else exact.
    int8_scores: bool,
    int8_values: bool,
    /// Denominators from the quantized weights.
    integer_total: bool,
}

fn quantize(x: &[f64]) -> Vec<f64> {
    let step = x.iter().fold(0.0f64, |m, v| m.max(v.abs())) / 127.0;
    x.iter().map(|v| if step > 0.0 { (v / step).round_ties_even() * step } else { 0.0 }).collect()
}

fn rotate(x: &[f64], signs: &[f64]) -> Vec<f64> {
    let mut y: Vec<f64> = x.iter().zip(signs).map(|(a, b)| a * b / (D as f64).sqrt()).collect();
    let mut h = 1;
    while h < D {
        for i in (0..D).filter(|i| i & h == 0) {
            (y[i], y[i + h]) = (y[i] + y[i + h], y[i] - y[i + h]);
        }
        h *= 2;
    }
    y
}

struct Data {
    q: Vec<Vec<f64>>,
    k: Vec<Vec<f64>>,
    v: Vec<Vec<f64>>,
    signs: Vec<f64>,
}

/// flat: independent q and k. peaky: every query looks for one key. outliers: two large channels in k and q, one in v, five
/// large tokens, all keys moved alike.
fn data(kind: &str) -> Data {
    let mut r = Random(88_172_645_463_325_252);
    let moved: Vec<f64> = (0..D).map(|_| 1.5 * r.bell()).collect();
    let (mut k, mut v, mut q) = (r.rows(N), r.rows(N), r.rows(QUERIES));
    let signs = (0..D).map(|_| if r.uniform() < 0.5 { 1.0 } else { -1.0 }).collect();
    for (i, row) in q.iter_mut().enumerate().filter(|_| kind != "flat") {
        for c in 0..D {
            row[c] = (1.2 * k[i * 53 % N][c] + 0.6 * row[c]) * if kind == "peaky" { 1.3 } else { 1.0 };
        }
    }
    if kind == "outliers" {
        for (t, (k, v)) in k.iter_mut().zip(&mut v).enumerate() {
            k.iter_mut().zip(&moved).for_each(|(k, m)| *k += m);
            k[5] += 14.0;
            k[40] -= 9.0;
            v[7] *= 12.0;
            if t < 5 {
                k.iter_mut().for_each(|k| *k *= 3.0);
                v.iter_mut().for_each(|v| *v *= 8.0);
            }
        }
        for q in &mut q {
            q[9] += 6.0;
            q[33] *= 4.0;
        }
    }
    Data { q, k, v, signs }
}

fn dot(a: &[f64], b: &[f64]) -> f64 {
    a.iter().zip(b).map(|(a, b)| a * b).sum()
}

/// Softmax of scores times values, with one largest weight per tile and weights rounded to steps of it; none: exact.
fn attend(scores: &[f64], v: &[Vec<f64>], rounding: Option<(f64, usize, bool)>) -> Vec<f64> {
    let top = |s: &[f64]| s.iter().copied().fold(f64::MIN, f64::max);
    let all = top(scores);
    let (mut sums, mut total) = (vec![0.0; D], 0.0);
    let (levels, tile, integer) = rounding.unwrap_or((0.0, scores.len(), false));
    for (scores, v) in scores.chunks(tile).zip(v.chunks(tile)) {
        let here = top(scores);
        for (s, v) in scores.iter().zip(v) {
            let exact = (s - here).exp();
            let weight = if levels > 0.0 { (exact * levels).round_ties_even() / levels } else { exact };
            let w = (here - all).exp();
            total += w * if integer { weight } else { exact };
            sums.iter_mut().zip(v).for_each(|(sum, v)| *sum += w * weight * v);
        }
    }
    sums.iter().map(|s| s / total).collect()
}

fn decibels(d: &Data, choice: &Choice) -> f64 {
    let turn = |x: &[f64]| if choice.rotated { rotate(x, &d.signs) } else { x.to_vec() };
    let round = |x: Vec<f64>| if choice.int8_scores { quantize(&x) } else { x };
    let mean: Vec<f64> = (0..D).map(|c| d.k.iter().map(|k| k[c]).sum::<f64>() / N as f64).collect();
    let off =
        |k: &[f64]| -> Vec<f64> { k.iter().zip(&mean).map(|(k, m)| if choice.centred { k - m } else { *k }).collect() };
    let k: Vec<Vec<f64>> = d.k.iter().map(|k| round(turn(&off(k)))).collect();
    let mut v = d.v.clone();
    for tile in v.chunks_mut(choice.value_tile).filter(|_| choice.int8_values) {
        for c in 0..D {
            let column = quantize(&tile.iter().map(|v| v[c]).collect::<Vec<f64>>());
            tile.iter_mut().zip(column).for_each(|(v, x)| v[c] = x);
        }
    }
    let (mut signal, mut error) = (0.0, 0.0);
    for q in &d.q {
        let scores =
            |q: &[f64], k: &[Vec<f64>]| -> Vec<f64> { k.iter().map(|k| dot(q, k) / (D as f64).sqrt()).collect() };
        let exact = attend(&scores(q, &d.k), &d.v, None);
        let y = attend(&scores(&round(turn(q)), &k), &v, Some((choice.levels, choice.tile, choice.integer_total)));
        signal += dot(&exact, &exact);
        error += exact.iter().zip(&y).map(|(a, b)| (a - b).powi(2)).sum::<f64>();
    }
    10.0 * (signal / error).log10()
}

fn main() {
    let base = Choice {
        name: "as it is",
        levels: 254.0,
        tile: 64,
        value_tile: 64,
        centred: true,
        rotated: false,
        int8_scores: true,
        int8_values: true,
        integer_total: true,
    };
    let choices = [
        base,
        Choice { name: "q and k rotated", rotated: true, ..base },
        Choice { name: "weights 0 to 127", levels: 127.0, ..base },
        Choice { name: "32 keys a tile", tile: 32, value_tile: 32, ..base },
        Choice { name: "96 keys a tile", tile: 96, value_tile: 96, ..base },
        Choice { name: "128 keys a tile", tile: 128, value_tile: 128, ..base },
        Choice { name: "one largest weight a query", tile: N, ..base },
        Choice { name: "v per channel and frame", value_tile: N, ..base },
        Choice { name: "keys with their mean", centred: false, ..base },
        Choice { name: "total before rounding", integer_total: false, ..base },
        Choice { name: "only weights rounded", int8_scores: false, int8_values: false, ..base },
        Choice { name: "only q, k rounded", levels: 0.0, int8_values: false, ..base },
        Choice { name: "only v rounded", levels: 0.0, int8_scores: false, ..base },
    ];
    let kinds = ["flat", "peaky", "outliers"].map(data);
    println!("{:28} {:>9} {:>9} {:>9}   dB", "", "flat", "peaky", "outliers");
    for choice in &choices {
        let db = kinds.each_ref().map(|d| decibels(d, choice));
        println!("{:28} {:9.1} {:9.1} {:9.1}", choice.name, db[0], db[1], db[2]);
    }
}
