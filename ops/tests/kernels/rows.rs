//! Layer norm, q/k norm, rotary embedding, pixel shuffle.

use crate::common::{CANARY, Random, Same, close, everywhere, same_bits};
use crate::tolerance::{self, NORM};
use sf_ops::rope::{AngleRound, QkNorm, RopeTable, qk_norm_rope};
use sf_ops::{Hwc, HwcMut, Mat, MatMut, layernorm, reference, shuffle};

#[test]
fn layernorm_matches_its_definition() {
    for cols in (1..=35).chain([63, 64, 65, 192, 224, 384, 1000, 1024, 1152, 2048]) {
        for rows in [0, 1, 2, 19] {
            let mut r = Random::new((rows * 4099 + cols) as u64);
            // A mean of 3 and one large value, as in residual streams.
            let mut x: Vec<f32> = r.vec(rows * cols).iter().map(|v| v + 3.0).collect();
            if let Some(v) = x.last_mut() {
                *v = 60.0;
            }
            let (gain, offset) = (r.vec(cols), r.vec(cols));
            let mut same = Same::default();
            everywhere(|ctx, name| {
                let stride = cols + 1;
                let mut y = vec![CANARY; rows * stride];
                let out = MatMut::with_stride(&mut y, rows, cols, stride);
                layernorm::layernorm(ctx, Mat::new(&x, rows, cols), &gain, &offset, 1e-6, out);
                assert!(y.iter().skip(cols).step_by(stride).all(|&v| v == CANARY), "{name}: wrote between rows");
                let dense: Vec<f32> = y.chunks(stride).flat_map(|row| &row[..cols]).copied().collect();
                let what = format!("{rows} x {cols}, {name}");
                if same.check(&dense, &what) && cols > 1 {
                    let expected = reference::layernorm(Mat::new(&x, rows, cols), &gain, &offset, 1e-6);
                    for ((y, e), x) in dense.chunks(cols).zip(expected.chunks(cols)).zip(x.chunks(cols)) {
                        let mean = x.iter().sum::<f32>() / cols as f32;
                        let var = x.iter().map(|v| (v - mean).powi(2)).sum::<f32>() / cols as f32;
                        let largest = |v: &[f32]| v.iter().fold(0.0f32, |m, v| m.max(v.abs()));
                        close(y, e, tolerance::norm(largest(e), largest(x), var.sqrt()), &what);
                    }
                }
            });
        }
    }
}

#[test]
fn layernorm_of_a_constant_row_is_the_offset() {
    let (gain, offset) = ([2.0f32; 40], [0.25f32; 40]);
    everywhere(|ctx, name| {
        let mut y = [0.0; 40];
        let x = [1.5f32; 40];
        layernorm::layernorm(ctx, Mat::new(&x, 1, 40), &gain, &offset, 1e-6, MatMut::new(&mut y, 1, 40));
        same_bits(&y, &offset, name);
    });
}

fn positions(rows: u32, cols: u32) -> Vec<(u32, u32)> {
    let mut p = vec![(0, 0); 5];
    p.extend((0..rows).flat_map(|r| (0..cols).map(move |c| (r + 1, c + 1))));
    p
}

#[test]
fn rope_and_norm_match_their_definition() {
    for d in [4, 8, 32, 56, 64, 68, 72, 80, 128, 256] {
        for heads in [1, 3] {
            let table = RopeTable::new(&positions(3, 4), d, 100.0, AngleRound::None);
            let rows = 2 * table.len() + 3;
            let cols = 3 * heads * d;
            let mut r = Random::new((d * 10 + heads) as u64);
            let (x, g) = (r.vec(rows * cols), r.vec(4 * d));
            let norm = QkNorm {
                q_gain: &g[..d],
                q_offset: &g[d..2 * d],
                k_gain: &g[2 * d..3 * d],
                k_offset: &g[3 * d..],
                eps: 1e-5,
            };
            for kind in 1..4 {
                let norm = (kind & 1 != 0).then_some(norm);
                let rope = (kind & 2 != 0).then_some(&table);
                let mut expected = x.clone();
                reference::qk_norm_rope(&mut expected, rows, heads, norm.as_ref(), rope);
                let mut same = Same::default();
                everywhere(|ctx, name| {
                    let stride = cols + 2;
                    let mut y = vec![CANARY; rows * stride];
                    for (to, from) in y.chunks_mut(stride).zip(x.chunks(cols)) {
                        to[..cols].copy_from_slice(from);
                    }
                    qk_norm_rope(ctx, MatMut::with_stride(&mut y, rows, cols, stride), heads, norm, rope);
                    assert!(y.chunks(stride).all(|row| row[cols..] == [CANARY; 2]), "{name}: wrote between rows");
                    let dense: Vec<f32> = y.chunks(stride).flat_map(|row| &row[..cols]).copied().collect();
                    let what = format!("width {d}, {heads} heads, case {kind}, {name}");
                    if same.check(&dense, &what) {
                        close(&dense, &expected, NORM * 8.0, &what);
                    }
                });
            }
        }
    }
}

#[test]
fn rope_leaves_registers_and_values_alone() {
    let (d, heads) = (64, 2);
    let table = RopeTable::new(&positions(2, 2), d, 100.0, AngleRound::None);
    let cols = 3 * heads * d;
    let x = Random::new(5).vec(table.len() * cols);
    everywhere(|ctx, name| {
        let mut y = x.clone();
        qk_norm_rope(ctx, MatMut::new(&mut y, table.len(), cols), heads, None, Some(&table));
        same_bits(&y[..5 * cols], &x[..5 * cols], &format!("{name}: registers at (0, 0)"));
        for r in 0..table.len() {
            let v = r * cols + 2 * heads * d..(r + 1) * cols;
            same_bits(&y[v.clone()], &x[v], &format!("{name}: values"));
        }
        assert!(y[5 * cols..] != x[5 * cols..], "{name}: patches are turned");
    });
}

#[test]
fn rope_products_depend_on_position_differences_only() {
    let d = 64;
    let mut r = Random::new(9);
    let (q, k) = (r.vec(d), r.vec(d));
    let dot = |pq: (u32, u32), pk: (u32, u32)| {
        let table = RopeTable::new(&[pq, pk], d, 100.0, AngleRound::None);
        let mut x = [q.clone(), k.clone(), vec![0.0; d]].concat();
        x.extend([q.clone(), k.clone(), vec![0.0; d]].concat());
        reference::qk_norm_rope(&mut x, 2, 1, None, Some(&table));
        (0..d).map(|i| f64::from(x[i]) * f64::from(x[3 * d + d + i])).sum::<f64>()
    };
    for (dr, dc) in [(0, 0), (1, 0), (0, 3), (5, 2), (20, 13)] {
        let base = dot((1, 1), (1 + dr, 1 + dc));
        for (r0, c0) in [(2, 1), (7, 11), (23, 4)] {
            let moved = dot((r0, c0), (r0 + dr, c0 + dc));
            assert!((base - moved).abs() < 2e-5, "difference ({dr}, {dc}) at ({r0}, {c0}): {base} and {moved}");
        }
    }
}

#[test]
fn rope_known_angles() {
    // d = 8: D = 4, frequencies 1 and 100^(-1/2) = 0.1, rows first.
    let t = RopeTable::new(&[(3, 7)], 8, 100.0, AngleRound::None);
    let (cos, sin) = t.entry(0);
    let angles = [3.0f64, 0.3, 7.0, 0.7];
    for i in 0..4 {
        assert!(
            (f64::from(cos[i]) - angles[i].cos()).abs() < 4e-8 && (f64::from(sin[i]) - angles[i].sin()).abs() < 4e-8
        );
    }
    // bfloat16 angles: 0.3 becomes 0.30078125.
    let t = RopeTable::new(&[(3, 7)], 8, 100.0, AngleRound::Bf16);
    let (_, sin) = t.entry(0);
    assert!((f64::from(sin[1]) - 0.300_781_25f64.sin()).abs() < 4e-8);
}

#[test]
fn pixel_shuffle_matches_its_definition() {
    for (grid, p, c) in [
        ((1, 1), 1, 1),
        ((2, 3), 14, 3),
        ((3, 2), 4, 11),
        ((4, 5), 2, 16),
        ((3, 4), 2, 11),
        ((2, 1), 2, 17),
        ((2, 3), 7, 24),
        ((1, 2), 4, 33),
        ((1, 2), 3, 20),
    ] {
        let cols = c * p * p;
        let x = Random::new(cols as u64).vec(grid.0 * grid.1 * cols);
        let expected = reference::pixel_shuffle(Mat::new(&x, grid.0 * grid.1, cols), grid, p);
        everywhere(|ctx, name| {
            let mut y = vec![CANARY; x.len()];
            let out = HwcMut::new(&mut y, grid.0 * p, grid.1 * p, c);
            shuffle::pixel_shuffle(ctx, Mat::new(&x, grid.0 * grid.1, cols), grid, p, out);
            same_bits(&y, &expected, name);
        });
    }
    // The same beside other channels.
    for (p, c, g) in [(7, 5, 3), (7, 24, 16), (2, 11, 5), (2, 3, 1)] {
        let grid = (2, 3);
        let (h, w, cols) = (grid.0 * p, grid.1 * p, c * p * p);
        let x = Random::new(1).vec(grid.0 * grid.1 * cols);
        let beside = Random::new(2).vec(h * w * g);
        let own = reference::pixel_shuffle(Mat::new(&x, grid.0 * grid.1, cols), grid, p);
        let pixels = own.chunks_exact(c).zip(beside.chunks_exact(g));
        let expected: Vec<f32> = pixels.flat_map(|(own, beside)| [own, beside].concat()).collect();
        everywhere(|ctx, name| {
            let mut y = vec![CANARY; expected.len()];
            let (x, out) = (Mat::new(&x, grid.0 * grid.1, cols), HwcMut::new(&mut y, h, w, c + g));
            shuffle::pixel_shuffle_beside(ctx, x, grid, p, Hwc::new(&beside, h, w, g), out);
            same_bits(&y, &expected, name);
        });
    }
    // Column c*p*p + dy*p + dx holds its own coordinates: pixel (y, x) of channel c must read (y % p, x % p).
    let p = 14;
    let row: Vec<f32> = (0..2 * p * p).map(|i| i as f32).collect();
    let y = reference::pixel_shuffle(Mat::new(&row, 1, 2 * p * p), (1, 1), p);
    assert_eq!(y[(5 * p + 9) * 2 + 1], (p * p + 5 * p + 9) as f32);
}
