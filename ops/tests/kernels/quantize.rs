use crate::common::{CANARY, Random, Same, close, everywhere, same_bits};
use crate::tolerance;
use sf_ops::gemm::{RowsS8Mut, padded_k};
use sf_ops::hadamard::{Rotation, block, rotate_rows};
use sf_ops::quantize::{Before, Norm, quantize};
use sf_ops::{Ctx, Mat, MatMut, layernorm, reference};

/// Never written by a correct kernel.
const MARK: i8 = -128;

/// Bytes (padding included) and scales of `x` `[rows, cols]`, written between marks.
fn run(ctx: Ctx, x: Mat, before: Before) -> (Vec<i8>, Vec<f32>) {
    let bytes = x.rows * padded_k(x.cols);
    let mut data = vec![MARK; bytes + 8];
    let mut scales = vec![CANARY; x.rows + 2];
    let end = x.rows + 1;
    let out = RowsS8Mut { m: x.rows, k: x.cols, data: &mut data[4..4 + bytes], scales: &mut scales[1..end] };
    quantize(ctx, x, before, out);
    assert!(data[..4].iter().chain(&data[4 + bytes..]).all(|v| *v == MARK), "wrote beyond the rows");
    assert!(scales[0] == CANARY && scales[end] == CANARY, "wrote beyond the scales");
    let data = data[4..4 + bytes].to_vec();
    assert!(data.iter().all(|v| *v != MARK), "-128, or a byte left out");
    (data, scales[1..end].to_vec())
}

/// Rows of the definition, padded.
fn expected(x: Mat) -> (Vec<i8>, Vec<f32>) {
    let (mut data, mut scales) = (Vec::new(), Vec::new());
    for r in 0..x.rows {
        let (mut q, scale) = reference::quantize(x.row(r));
        q.resize(padded_k(x.cols), 0);
        data.extend(q);
        scales.push(scale);
    }
    (data, scales)
}

fn signs(width: usize) -> Vec<u16> {
    let mut r = Random::new(width as u64);
    (0..width / 16).map(|_| r.bits() as u16).collect()
}

#[test]
fn quantizer_has_the_bits_of_its_definition() {
    for (rows, cols) in (1..=70).map(|c| (3, c)).chain([(50, 1024), (300, 257), (0, 16), (2, 0)]) {
        let mut r = Random::new(cols as u64);
        let mut x = r.vec(rows * cols);
        // Rows of every size, and an exact tie in some.
        for (i, v) in x.iter_mut().enumerate() {
            *v *= [1.0, 1e-20, 3e30, 127.0][i / cols.max(1) % 4];
        }
        if rows > 3 {
            x[3 * cols] = 127.0;
            x[3 * cols + 1] = 2.5;
        }
        let x = Mat::new(&x, rows, cols);
        let (data, scales) = expected(x);
        everywhere(|ctx, name| {
            let (d, s) = run(ctx, x, Before::default());
            assert!(d == data, "{rows} x {cols}, {name}");
            same_bits(&s, &scales, name);
        });
    }
}

#[test]
fn ties_ends_zeros_and_nothing_finite() {
    let mut x = vec![0.0f32; 5 * 20];
    // Scale 1: ties go to even, both ends are reached.
    x[..10].copy_from_slice(&[127.0, -127.0, 0.5, 1.5, 2.5, -0.5, -1.5, 126.5, 125.5, -0.0]);
    // Row 1 zeros; row 2 below what can be divided; rows 3 and 4 not finite, the last in the tail.
    x[40..44].copy_from_slice(&[1e-38, -3e-37, 0.0, 1e-45]);
    x[60] = f32::INFINITY;
    x[99] = f32::NAN;
    everywhere(|ctx, name| {
        let (d, s) = run(ctx, Mat::new(&x, 5, 20), Before::default());
        assert_eq!(d[..10], [127, -127, 0, 2, 2, 0, -2, 126, 126, 0], "{name}");
        assert!(d[20..].iter().all(|v| *v == 0), "{name}");
        assert!(s[..3] == [1.0, 0.0, 0.0] && s[3].is_nan() && s[4].is_nan(), "{name}: {s:?}");
    });
    // Largest and smallest rows that are divided.
    for max in [f32::MAX, 3.8e-37] {
        let (d, s) = (reference::quantize(&[max, -max, max * 0.5]), max / 127.0);
        assert_eq!(d, (vec![127, -127, 64], s), "{max:e}");
        everywhere(|ctx, name| {
            let (d, got) = run(ctx, Mat::new(&[max, -max, max * 0.5], 1, 3), Before::default());
            assert!(d == [127, -127, 64, 0] && got == [s], "{max:e}, {name}");
        });
    }
}

#[test]
fn rotation_matches_its_definition() {
    for width in [16, 32, 48, 64, 96, 128, 192, 384, 1024, 1040, 1088] {
        let (rows, stride) = (5, width + 3);
        let b = block(width);
        assert!(width % b == 0 && (b == 128 || width % (2 * b) != 0), "block {b} of {width}");
        let signs = signs(width);
        let rotation = Rotation::new(width, &signs);
        let x = Random::new(width as u64).vec(rows * stride);
        let mut same = Same::default();
        everywhere(|ctx, name| {
            let mut y = x.clone();
            rotate_rows(ctx, rotation, MatMut::with_stride(&mut y, rows, width, stride));
            for r in 0..rows {
                let row = &x[r * stride..][..width];
                let expected = reference::hadamard(row, &signs, b);
                close(&y[r * stride..][..width], &expected, tolerance::HADAMARD, &format!("{width}, {name}"));
                same_bits(&y[r * stride + width..(r + 1) * stride], &x[r * stride + width..(r + 1) * stride], name);
            }
            same.check(&y, name);
        });
    }
}

#[test]
fn rotation_keeps_products() {
    // (H x) . (H w) = x . w, which is why weights are rotated offline.
    let width = 384;
    let signs = signs(width);
    let (x, w) = (Random::new(1).vec(width), Random::new(2).vec(width));
    let dot = |a: &[f32], b: &[f32]| a.iter().zip(b).map(|(a, b)| f64::from(*a) * f64::from(*b)).sum::<f64>();
    let b = block(width);
    let (hx, hw) = (reference::hadamard(&x, &signs, b), reference::hadamard(&w, &signs, b));
    assert!((dot(&x, &w) - dot(&hx, &hw)).abs() < 1e-5);
    // A single outlier is spread over its block evenly.
    let mut x = vec![0.0; width];
    x[130] = 8.0;
    let y = reference::hadamard(&x, &signs, b);
    assert!(y[128..256].iter().all(|v| (v.abs() - 8.0 / 128f32.sqrt()).abs() < 1e-6));
    assert!(y[..128].iter().chain(&y[256..]).all(|v| *v == 0.0));
}

#[test]
fn fused_norm_rotation_and_quantization_equal_the_steps() {
    for width in [16, 48, 192, 256, 1024] {
        let rows = 9;
        let mut r = Random::new(width as u64);
        let x = r.vec(rows * width);
        let (gain, offset) = (r.vec(width), r.vec(width));
        let signs = signs(width);
        let rotation = Rotation::new(width, &signs);
        let ones = (vec![1.0; width], vec![0.0; width]);
        for affine in [Some((&gain[..], &offset[..])), None] {
            for rotate in [None, Some(rotation)] {
                let mut same = Same::default();
                everywhere(|ctx, name| {
                    let what = format!("{width}, affine {}, rotated {}, {name}", affine.is_some(), rotate.is_some());
                    let (g, o) = affine.unwrap_or((&ones.0, &ones.1));
                    let mut y = vec![0.0; rows * width];
                    let out = MatMut::new(&mut y, rows, width);
                    layernorm::layernorm(ctx, Mat::new(&x, rows, width), g, o, 1e-6, out);
                    if rotate.is_some() {
                        rotate_rows(ctx, rotation, MatMut::new(&mut y, rows, width));
                    }
                    let norm = Some(Norm { affine, eps: 1e-6 });
                    let (d, s) = run(ctx, Mat::new(&x, rows, width), Before { norm, rotation: rotate });
                    // The factor of the rotation is applied to the scale instead of the values, so integers may differ
                    // by one where a value lies at a tie, and scales by roundings.
                    let (data, scales) = expected(Mat::new(&y, rows, width));
                    let far = d.iter().zip(&data).filter(|(a, b)| a.abs_diff(**b) > u8::from(rotate.is_some())).count();
                    assert_eq!(far, 0, "{what}");
                    close(&s, &scales, tolerance::SCALE * scales[0], &what);
                    let all: Vec<f32> = d.iter().map(|v| f32::from(*v)).chain(s).collect();
                    same.check(&all, &what);
                });
            }
        }
    }
}

#[test]
#[should_panic(expected = "rotation of 24 values")]
fn a_width_off_sixteen_is_refused() {
    Rotation::new(24, &[0; 2]);
}
