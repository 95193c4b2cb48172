//! Speed of f32 and int8 attention against the measured peaks of this CPU:
//!
//! `cargo run --release -p sf-ops --example attention_rates [ROUNDS [THREADS [FRAMESxTOKENSxHEADSxWIDTH [MASK [KIND]]]]]`
//!
//! Masks: `frame` (a frame sees itself), `global` (all), `next` (itself and the next). Kinds: `f32`, `int8`, `f32+norm`, `int8+norm` (with q/k norm and
//! rotary embedding: a pass before in f32, inside in int8). int8 is checked against f32 first; times are the best of interleaved rounds. Operations are the
//! two products' (two for a multiply-add), for visible keys only; the peak of two threads is two threads running the probe.

use sf_ops::attention::{FrameMask, Heads, attention, attention_s8, scratch_len, scratch_len_s8};
use sf_ops::rope::{AngleRound, QkNorm, RopeTable, qk_norm_rope};
use sf_ops::{Ctx, Kernels, Mat, MatMut, par::Pool, peak};
use std::time::{Duration, Instant};

/// (frames, tokens, heads, width): four frames of 216 and 740 patches and five registers, 16 heads; a small network.
const SHAPES: [(usize, usize, usize, usize); 5] =
    [(4, 221, 16, 64), (4, 221, 16, 72), (4, 745, 16, 64), (4, 745, 16, 72), (4, 101, 2, 64)];
const MASKS: [(&str, i32, i32); 3] = [("frame", 0, 0), ("global", -3, 3), ("next", 0, 1)];
const KINDS: [&str; 4] = ["f32", "int8", "f32+norm", "int8+norm"];

struct Case {
    heads: usize,
    d: usize,
    mask: FrameMask,
    kind: &'static str,
    qkv: Vec<f32>,
    table: RopeTable,
    ones: Vec<f32>,
    scratch: Vec<f32>,
    out: Vec<f32>,
}

impl Case {
    fn new((frames, tokens, heads, d): (usize, usize, usize, usize), (lo, hi): (i32, i32), kind: &'static str) -> Case {
        let mask = FrameMask { frames, tokens, lo, hi };
        let (rows, c) = (frames * tokens, heads * d);
        let mut state = 7u64;
        let mut next = || {
            state = state.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
            (state >> 40) as f32 / (1u32 << 23) as f32 - 1.0
        };
        let qkv = (0..rows * 3 * c).map(|_| next() + next() + next()).collect();
        let positions: Vec<(u32, u32)> = (0..tokens as u32).map(|i| (i / 18, i % 18)).collect();
        let scratch = scratch_len(&mask, heads, d, 8).max(scratch_len_s8(&mask, heads, d, 8));
        Case {
            heads,
            d,
            mask,
            kind,
            qkv,
            table: RopeTable::new(&positions, d, 100.0, AngleRound::None),
            ones: vec![1.0; 2 * d],
            scratch: vec![0.0; scratch],
            out: vec![0.0; rows * c],
        }
    }

    /// Operations of both products.
    fn ops(&self) -> f64 {
        let pairs: usize =
            (0..self.mask.frames).map(|a| self.mask.keys(a).len()).sum::<usize>() * self.mask.tokens.pow(2);
        4.0 * (pairs * self.heads * self.d) as f64
    }

    /// Seconds of one call.
    fn time(&mut self, ctx: Ctx) -> f64 {
        let (rows, c, heads) = (self.mask.frames * self.mask.tokens, self.heads * self.d, self.heads);
        let (gain, offset) = self.ones.split_at(self.d);
        let norm = QkNorm { q_gain: gain, q_offset: offset, k_gain: gain, k_offset: offset, eps: 1e-5 };
        let (norm, rope) = if self.kind.ends_with("norm") { (Some(norm), Some(&self.table)) } else { (None, None) };
        let out = MatMut::new(&mut self.out, rows, c);
        let start = Instant::now();
        if self.kind.starts_with("int8") {
            let x = Heads { qkv: Mat::new(&self.qkv, rows, 3 * c), heads, norm, rope, rotation: None };
            attention_s8(ctx, x, self.mask, &mut self.scratch, out);
        } else {
            qk_norm_rope(ctx, MatMut::new(&mut self.qkv, rows, 3 * c), heads, norm, rope);
            attention(ctx, Mat::new(&self.qkv, rows, 3 * c), heads, self.mask, &mut self.scratch, out);
        }
        start.elapsed().as_secs_f64()
    }
}

/// int8 within 30 dB of f32, or the figures below mean nothing.
fn check(shape: (usize, usize, usize, usize), mask: (i32, i32)) {
    let pool = Pool::new(2).expect("two threads");
    let ctx = Ctx { pool: &pool, kernels: Kernels::best() };
    let [exact, y] = ["f32+norm", "int8+norm"].map(|kind| {
        let mut case = Case::new(shape, mask, kind);
        case.time(ctx);
        case.out
    });
    let power = |x: &mut dyn Iterator<Item = f32>| x.map(|v| f64::from(v).powi(2)).sum::<f64>();
    let error = power(&mut exact.iter().zip(&y).map(|(a, b)| a - b));
    let db = 10.0 * (power(&mut exact.iter().copied()) / error).log10();
    assert!(db > 30.0, "{shape:?}: {db:.1} dB between int8 and f32");
}

/// `FRAMESxTOKENSxHEADSxWIDTH`.
fn shape(text: &str) -> (usize, usize, usize, usize) {
    let n: Vec<usize> = text.split('x').map(|v| v.parse().expect("four numbers joined by x")).collect();
    (n[0], n[1], n[2], n[3])
}

/// Time of a peak probe.
const PROBE: Duration = Duration::from_millis(40);

fn main() {
    let word = |i| std::env::args().nth(i);
    let number = |i| word(i).and_then(|v| v.parse::<usize>().ok());
    let rounds = number(1).unwrap_or(5);
    let threads = number(2).map_or(vec![1, 2], |n| vec![n]);
    let wanted = |i: usize, name: &str| word(i).is_none_or(|w| w == name);
    let kernels = Kernels::best();
    println!("{}, {}, {}; {rounds} rounds", kernels.gemm_f32.name, kernels.gemm_s8.name, kernels.vector.name);
    println!("threads frames tokens heads width   mask       kind        ms    GOP/s  of peak");
    let mut cases = Vec::new();
    let shapes = word(3).map_or(SHAPES.to_vec(), |w| vec![shape(&w)]);
    for shape in shapes {
        for (mask, lo, hi) in MASKS {
            if wanted(4, mask) {
                if rounds > 1 {
                    check(shape, (lo, hi));
                }
                for kind in KINDS.into_iter().filter(|k| wanted(5, k)) {
                    cases.push((mask, Case::new(shape, (lo, hi), kind)));
                }
            }
        }
    }
    for threads in threads {
        let pool = Pool::new(threads).expect("threads");
        let ctx = Ctx { pool: &pool, kernels };
        let mut peaks = [0.0f64; 2];
        let mut best = vec![f64::INFINITY; cases.len()];
        for _ in 0..rounds {
            if rounds > 1 {
                peaks[0] = peaks[0].max(peak::together(threads, || peak::flops_per_second(Kernels::best(), PROBE)));
                peaks[1] = peaks[1].max(peak::together(threads, || peak::s8_ops_per_second(Kernels::best(), PROBE)));
            }
            for ((_, case), best) in cases.iter_mut().zip(&mut best) {
                *best = best.min(case.time(ctx));
            }
        }
        println!("{threads:7} peaks: f32 {:.0} GFLOP/s, int8 {:.0} GOP/s", peaks[0] * 1e-9, peaks[1] * 1e-9);
        for ((mask, case), best) in cases.iter().zip(&best) {
            let FrameMask { frames, tokens, .. } = case.mask;
            let rate = case.ops() / best;
            println!(
                "{threads:7} {frames:6} {tokens:6} {:5} {:5} {mask:>6} {:>10} {:9.3} {:8.1} {:6.1} %",
                case.heads,
                case.d,
                case.kind,
                best * 1e3,
                rate * 1e-9,
                100.0 * rate / peaks[usize::from(case.kind.starts_with("int8"))],
            );
        }
    }
}
