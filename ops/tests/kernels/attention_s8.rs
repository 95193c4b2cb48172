//! int8 attention: integers against the plain loops with `==`, outputs bit for bit, accuracy against softmax in f64.

use crate::common::{CANARY, Random, Same, everywhere, same_bits};
use sf_ops::attention::{FrameMask, Heads, attention_s8, attention_s8_integers, scratch_len_s8};
use sf_ops::hadamard::Rotation;
use sf_ops::rope::{AngleRound, QkNorm, RopeTable, qk_norm_rope};
use sf_ops::{Ctx, Mat, MatMut, reference};

fn plain(qkv: Mat, heads: usize) -> Heads {
    Heads { qkv, heads, norm: None, rope: None, rotation: None }
}

/// Runs with NaN in the scratch and canaries around the output rows.
fn run(ctx: Ctx, x: Heads, mask: FrameMask, name: &str) -> Vec<f32> {
    let c = x.heads * x.head_dim();
    let mut scratch = vec![f32::NAN; scratch_len_s8(&mask, x.heads, x.head_dim(), ctx.pool.threads())];
    let stride = c + 3;
    let mut y = vec![CANARY; x.qkv.rows * stride];
    attention_s8(ctx, x, mask, &mut scratch, MatMut::with_stride(&mut y, x.qkv.rows, c, stride));
    assert!(y.chunks(stride).all(|row| row[c..] == [CANARY; 3]), "{name}: wrote between rows");
    y.chunks(stride).flat_map(|row| &row[..c]).copied().collect()
}

fn values(r: &mut Random, mask: FrameMask, c: usize, spread: f32) -> Vec<f32> {
    let mut x = r.vec(mask.frames * mask.tokens * 3 * c);
    for row in x.chunks_mut(3 * c) {
        row[..2 * c].iter_mut().for_each(|v| *v = *v * spread + 0.3);
    }
    x
}

fn check(mask: FrameMask, heads: usize, d: usize, spread: f32) {
    let (rows, c) = (mask.frames * mask.tokens, heads * d);
    let x = values(&mut Random::new((rows * 131 + c) as u64 ^ mask.hi as u64), mask, c, spread);
    let qkv = Mat::new(&x, rows, 3 * c);
    let (expected, integers) = reference::attention_s8(qkv, heads, mask);
    everywhere(|ctx, name| {
        let what = format!("{mask:?}, {heads} heads of {d}, {name}");
        let got = attention_s8_integers(ctx, plain(qkv, heads), mask);
        for (i, (got, expected)) in got.iter().zip(&integers).enumerate() {
            assert_eq!(got, expected, "row {}, head {} of {what}", i / heads, i % heads);
        }
        let y = run(ctx, plain(qkv, heads), mask, &what);
        same_bits(&y, &expected, &what);
        for a in (0..mask.frames).filter(|&a| mask.keys(a).is_empty()) {
            let block = &y[a * mask.tokens * c..][..mask.tokens * c];
            assert!(block.iter().all(|v| v.to_bits() == 0), "{what}: frame {a} sees nothing and must give 0");
        }
    });
}

/// One key far above many whose weights are below half a step each: what they say together must not be lost.
#[test]
fn small_weights_keep_their_sum() {
    let (tokens, d) = (128, 16);
    // Every query meets key 0 with a score of ln 850, the others with 0: weights 254 and 0.3, 127 of which make 13 % of all.
    let mut x = vec![0.0f32; tokens * 3 * d];
    for (i, row) in x.chunks_mut(3 * d).enumerate() {
        row[0] = 4.0;
        row[d] = if i == 0 { 850f32.ln() } else { 0.0 };
        row[2 * d..].fill(if i == 0 { -1.0 } else { 1.0 });
    }
    let expected = (127.0 - 850.0) / (127.0 + 850.0);
    everywhere(|ctx, name| {
        let y = run(ctx, plain(Mat::new(&x, tokens, 3 * d), 1), mask(1, tokens, 0, 0), name);
        for v in y {
            assert!((v - expected).abs() < 0.03, "{name}: {v} instead of {expected}");
        }
    });
}

fn mask(frames: usize, tokens: usize, lo: i32, hi: i32) -> FrameMask {
    FrameMask { frames, tokens, lo, hi }
}

#[test]
fn head_widths() {
    for d in [4, 8, 12, 16, 20, 32, 36, 40, 44, 48, 52, 56, 60, 64, 68, 72, 76, 80, 128, 256] {
        check(mask(2, 37, -1, 1), 2, d, 1.0);
    }
}

#[test]
fn token_counts_around_tiles() {
    for tokens in (1..=34).chain([47, 48, 49, 60, 61, 62, 63, 64, 65, 66, 67, 68, 76, 77, 127, 128, 129, 193]) {
        check(mask(1, tokens, 0, 0), 1, 8, 2.0);
    }
}

#[test]
fn horizons() {
    for k in [1, 2] {
        for (lo, hi) in [(0, k), (1, k), (-k, 0), (-k, -1), (-k, k)] {
            check(mask(4, 9, lo, hi), 2, 12, 1.0);
        }
    }
    check(mask(3, 70, -2, 2), 1, 16, 1.0);
    check(mask(3, 20, 0, 0), 1, 16, 1.0);
    // No frame sees any; no rows.
    check(mask(2, 5, 5, 9), 1, 4, 1.0);
    check(mask(2, 5, 2, 1), 1, 4, 1.0);
    check(mask(0, 5, 0, 0), 1, 4, 1.0);
}

#[test]
fn random_layouts() {
    let mut r = Random::new(77);
    for _ in 0..25 {
        let frames = 1 + r.below(5);
        let lo = r.below(2 * frames + 1) as i32 - frames as i32;
        let hi = lo + r.below(frames + 1) as i32 - 1;
        check(mask(frames, 1 + r.below(140), lo, hi), 1 + r.below(3), 4 * (1 + r.below(8)), 1.5);
    }
}

#[test]
fn large_scores_do_not_overflow() {
    for spread in [12.0, 1e3, 1e6] {
        check(mask(1, 150, 0, 0), 1, 16, spread);
        check(mask(3, 70, -1, 1), 1, 16, spread);
    }
}

#[test]
fn zeros_and_equal_keys() {
    let (m, heads, d) = (mask(2, 70, -1, 1), 2, 16);
    let (rows, c) = (140, heads * d);
    let mut x = values(&mut Random::new(5), m, c, 1.0);
    // Queries of zeros, then equal keys (nothing left of them without their mean): plain means of the values.
    for part in [0, 1] {
        let mut x = x.clone();
        for row in x.chunks_mut(3 * c) {
            row[part * c..][..c].fill(if part == 0 { 0.0 } else { 0.75 });
        }
        let (expected, _) = reference::attention_s8(Mat::new(&x, rows, 3 * c), heads, m);
        let exact = reference::attention(Mat::new(&x, rows, 3 * c), heads, m);
        everywhere(|ctx, name| same_bits(&run(ctx, plain(Mat::new(&x, rows, 3 * c), heads), m, name), &expected, name));
        assert!(expected.iter().zip(&exact).all(|(a, b)| (a - b).abs() < 0.01), "part {part}");
    }
    // Values of zeros, and of one sign at the ends of the range.
    for v in [0.0, 1.0, -1.0, 1e-42] {
        for row in x.chunks_mut(3 * c) {
            row[2 * c..].fill(v);
        }
        everywhere(|ctx, name| {
            let y = run(ctx, plain(Mat::new(&x, rows, 3 * c), heads), m, name);
            let v = if v.abs() < 1e-40 { 0.0 } else { v };
            assert!(y.iter().all(|y| (y - v).abs() <= 1e-6), "{name}: constant values {v} must stay");
        });
    }
}

#[test]
fn norm_and_embedding_inside_have_the_bits_of_those_outside() {
    for d in [4, 8, 20, 32, 40, 48, 56, 64, 72, 80, 128] {
        let (m, heads) = (mask(2, 33, -1, 0), 3);
        let (rows, c) = (66, heads * d);
        let mut r = Random::new(d as u64);
        let x = values(&mut r, m, c, 1.0);
        let g: Vec<Vec<f32>> = (0..4).map(|_| r.vec(d)).collect();
        let norm = QkNorm { q_gain: &g[0], q_offset: &g[1], k_gain: &g[2], k_offset: &g[3], eps: 1e-5 };
        let positions: Vec<(u32, u32)> = (0..33).map(|i| (i / 6, i % 6)).collect();
        let table = RopeTable::new(&positions, d, 100.0, AngleRound::None);
        for (norm, rope) in [(Some(norm), None), (None, Some(&table)), (Some(norm), Some(&table))] {
            everywhere(|ctx, name| {
                let mut turned = x.clone();
                qk_norm_rope(ctx, MatMut::new(&mut turned, rows, 3 * c), heads, norm, rope);
                let outside = run(ctx, plain(Mat::new(&turned, rows, 3 * c), heads), m, name);
                let inside = run(ctx, Heads { norm, rope, ..plain(Mat::new(&x, rows, 3 * c), heads) }, m, name);
                same_bits(&inside, &outside, &format!("width {d}, {name}"));
            });
        }
    }
}

#[test]
fn results_depend_on_visible_frames_only() {
    // Frame 3's keys and values change; frames that do not see it keep their bits.
    let (m, heads, d) = (mask(4, 40, 0, 1), 2, 24);
    let (rows, c) = (160, heads * d);
    let x = values(&mut Random::new(9), m, c, 1.0);
    let mut other = x.clone();
    for row in other[120 * 3 * c..].chunks_mut(3 * c) {
        row[c..].iter_mut().for_each(|v| *v = *v * 3.0 - 1.0);
    }
    everywhere(|ctx, name| {
        let a = run(ctx, plain(Mat::new(&x, rows, 3 * c), heads), m, name);
        let b = run(ctx, plain(Mat::new(&other, rows, 3 * c), heads), m, name);
        same_bits(&a[..80 * c], &b[..80 * c], name);
        assert_ne!(a[80 * c..120 * c], b[80 * c..120 * c], "{name}: frame 2 sees frame 3");
    });
}

#[test]
fn nan_and_infinity_stay_seen() {
    let (m, heads, d) = (mask(3, 20, 0, 1), 2, 16);
    let (rows, c) = (60, heads * d);
    for bad in [f32::NAN, f32::INFINITY, f32::NEG_INFINITY] {
        for part in 0..3 {
            // Frame 1, token 5, head 1.
            let mut x = values(&mut Random::new(3), m, c, 1.0);
            x[25 * 3 * c + part * c + d + 3] = bad;
            everywhere(|ctx, name| {
                let y = run(ctx, plain(Mat::new(&x, rows, 3 * c), heads), m, name);
                for row in 0..rows {
                    for col in 0..c {
                        let hit = match part {
                            0 => row == 25 && col >= d,
                            1 => row < 40 && col >= d,
                            _ => row < 40 && col == d + 3,
                        };
                        let v = y[row * c + col];
                        assert_eq!(v.is_nan(), hit, "{name}: {bad} in part {part}: {v} at {row}, {col}");
                    }
                }
            });
        }
    }
}

/// Signal to error in decibels.
fn decibels(y: &[f32], exact: &[f32]) -> f64 {
    let signal: f64 = exact.iter().map(|v| f64::from(*v).powi(2)).sum();
    let error: f64 = y.iter().zip(exact).map(|(a, b)| (f64::from(*a) - f64::from(*b)).powi(2)).sum();
    10.0 * (signal / error).log10()
}

/// A value of a bell shape: twelve uniform ones.
fn bell(r: &mut Random) -> f32 {
    (0..12).map(|_| r.value()).sum::<f32>() * 0.5
}

#[test]
fn accuracy_against_exact_softmax() {
    // Flat: independent q and k. Peaky: every query looks for one key, whose weight is near 1. Outliers: k has two channels far off
    // and five tokens three times as long, q two large channels, v one large channel and five large tokens.
    let (m, heads, d) = (mask(1, 370, 0, 0), 1, 64);
    let mut reached = Vec::new();
    let signs = [0x5a3c, 0x96e1, 0x0ff7, 0x2b4d];
    // Each kind without and with the rotation.
    for (kind, least) in [("flat", [38.0, 38.0]), ("peaky", [42.0, 42.0]), ("outliers", [26.5, 33.0])] {
        let mut r = Random::new(1);
        let n = m.tokens;
        let mut x: Vec<f32> = (0..n * 3 * d).map(|_| bell(&mut r)).collect();
        if kind != "flat" {
            let keys: Vec<Vec<f32>> = x.chunks(3 * d).map(|row| row[d..2 * d].to_vec()).collect();
            for (t, row) in x.chunks_mut(3 * d).enumerate() {
                let (q, rest) = row.split_at_mut(d);
                for (q, k) in q.iter_mut().zip(&keys[t * 53 % n]) {
                    *q = 1.5 * k + 0.7 * *q;
                }
                if kind == "outliers" {
                    let (k, v) = rest.split_at_mut(d);
                    k[5] += 14.0;
                    k[40] -= 9.0;
                    q[9] += 6.0;
                    q[33] *= 4.0;
                    v[7] *= 12.0;
                    if t < 5 {
                        k.iter_mut().for_each(|k| *k *= 3.0);
                        v.iter_mut().for_each(|v| *v *= 8.0);
                    }
                }
            }
        }
        let qkv = Mat::new(&x, n, 3 * d);
        let exact = reference::attention(qkv, heads, m);
        for (rotation, least) in [None, Some(Rotation::new(d, &signs))].into_iter().zip(least) {
            let mut same = Same::default();
            everywhere(|ctx, name| {
                let y = run(ctx, Heads { rotation, ..plain(qkv, heads) }, m, name);
                if same.check(&y, name) {
                    let db = decibels(&y, &exact);
                    reached.push(format!("{kind}{} {db:.1} dB", if rotation.is_some() { " rotated" } else { "" }));
                    assert!(db >= least, "{kind}: {db:.1} dB, {least} wanted");
                }
            });
        }
    }
    println!("int8 attention: {}", reached.join(", "));
}
