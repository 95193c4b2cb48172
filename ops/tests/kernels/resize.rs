use crate::common::{CANARY, Random, Same, close, everywhere, same_bits};
use crate::tolerance::BILINEAR;
use sf_ops::resize::{Corners, Filter, bilinear, position_table, resample_u8};
use sf_ops::{Hwc, HwcMut, reference};

#[test]
fn bilinear_matches_its_definition() {
    let sizes = [
        ((1, 1), (3, 4)),
        ((5, 7), (5, 7)),
        ((5, 7), (10, 14)),
        ((6, 9), (3, 4)),
        ((4, 4), (1, 1)),
        ((2, 3), (28, 42)),
    ];
    for ((h, w), (oh, ow)) in sizes {
        for c in [1, 3, 15, 16, 17, 48] {
            for corners in [Corners::Aligned, Corners::Half] {
                let x = Random::new((h * 100 + c) as u64).vec(h * w * c);
                let expected = reference::bilinear(Hwc::new(&x, h, w, c), corners, oh, ow);
                let mut same = Same::default();
                everywhere(|ctx, name| {
                    let what = format!("{h} x {w} x {c} -> {oh} x {ow}, {corners:?}, {name}");
                    let mut y = vec![CANARY; oh * ow * c];
                    bilinear(ctx, Hwc::new(&x, h, w, c), corners, HwcMut::new(&mut y, oh, ow, c));
                    if same.check(&y, &what) {
                        close(&y, &expected, BILINEAR, &what);
                    }
                });
            }
        }
    }
}

#[test]
fn bilinear_corners() {
    // Aligned: ends coincide. Half: the outer quarter of a doubled line repeats the end values.
    let pool = sf_ops::par::Pool::new(1).unwrap();
    let ctx = sf_ops::Ctx { pool: &pool, kernels: sf_ops::Kernels::best() };
    let mut y = [0.0; 5];
    bilinear(ctx, Hwc::new(&[0.0, 4.0, 8.0], 1, 3, 1), Corners::Aligned, HwcMut::new(&mut y, 1, 5, 1));
    assert_eq!(y, [0.0, 2.0, 4.0, 6.0, 8.0]);
    let mut y = [0.0; 4];
    bilinear(ctx, Hwc::new(&[0.0, 4.0], 1, 2, 1), Corners::Half, HwcMut::new(&mut y, 1, 4, 1));
    assert_eq!(y, [0.0, 1.0, 3.0, 4.0]);
}

/// `resample.txt`, written by `resample.py` with Pillow: one case per two lines, `filter w h dw dh` and hex RGB;
/// the source image is the fixed pattern below.
#[test]
fn resample_has_the_bits_of_pillow() {
    let text = include_str!("../data/resample.txt");
    let mut cases = 0;
    let mut lines = text.lines().filter(|l| !l.starts_with('#'));
    while let (Some(head), Some(hex)) = (lines.next(), lines.next()) {
        let f: Vec<&str> = head.split(' ').collect();
        let filter = match f[0] {
            "bicubic" => Filter::Bicubic,
            "lanczos" => Filter::Lanczos3,
            "bilinear" => Filter::Bilinear,
            other => panic!("filter {other}"),
        };
        let n: Vec<usize> = f[1..].iter().map(|v| v.parse().unwrap()).collect();
        let expected: Vec<u8> =
            (0..hex.len()).step_by(2).map(|i| u8::from_str_radix(&hex[i..i + 2], 16).unwrap()).collect();
        let y = resample_u8(&pattern(n[0], n[1]), (n[0], n[1]), filter, (n[2], n[3]));
        assert_eq!(y, expected, "{head}");
        cases += 1;
    }
    assert_eq!(cases, 24, "cases in the fixture");
}

/// A multiplicative hash of the index, with hard black and white edges mixed in so that filters overshoot.
fn pattern(w: usize, h: usize) -> Vec<u8> {
    (0..w * h * 3)
        .map(|i| {
            let v = (i as u32).wrapping_mul(2_654_435_761) >> 24;
            match v % 4 {
                0 => 0,
                1 => 255,
                _ => v as u8,
            }
        })
        .collect()
}

#[test]
fn position_table_of_its_own_size_is_untouched() {
    let table = Random::new(3).vec(37 * 37 * 5);
    same_bits(&position_table(&table, 37, 5, (37, 37)), &table, "37 x 37");
}

#[test]
fn position_table_weights_sum_to_one() {
    // A constant table stays constant; a table with one channel per row index shows the weights of that axis.
    let ones = vec![1.0f32; 37 * 37];
    for size in [(20, 37), (12, 18), (27, 37), (44, 29), (1, 1)] {
        let y = position_table(&ones, 37, 1, size);
        assert_eq!(y.len(), size.0 * size.1);
        assert!(y.iter().all(|v| (v - 1.0).abs() < 2e-7), "{size:?}");
    }
    let mut rows = vec![0.0f32; 37 * 37 * 37];
    for y in 0..37 {
        for x in 0..37 {
            rows[(y * 37 + x) * 37 + y] = 1.0;
        }
    }
    let y = position_table(&rows, 37, 37, (20, 37));
    for i in 0..20 {
        let w = &y[i * 37 * 37..][..37];
        assert!((w.iter().sum::<f32>() - 1.0).abs() < 4e-7, "weights of row {i}");
        assert!(w.iter().filter(|v| **v != 0.0).count() <= 9, "support of row {i}");
    }
    // The columns were not resized.
    assert_eq!(y[..37], y[36 * 37..37 * 37]);
}

/// `position.txt`, written by `position.py` with Pillow's float cubic: a 7 x 7 table resized to several sizes.
#[test]
fn position_table_agrees_with_pillow_float() {
    let text = include_str!("../data/position.txt");
    let mut lines = text.lines().filter(|l| !l.starts_with('#'));
    let table: Vec<f32> = (0..49u32).map(|i| (i.wrapping_mul(2_654_435_761) >> 24) as f32 / 64.0 - 2.0).collect();
    let mut cases = 0;
    while let (Some(head), Some(values)) = (lines.next(), lines.next()) {
        let n: Vec<usize> = head.split(' ').map(|v| v.parse().unwrap()).collect();
        let expected: Vec<f32> = values.split(' ').map(|v| v.parse().unwrap()).collect();
        close(&position_table(&table, 7, 1, (n[0], n[1])), &expected, 1e-6, head);
        cases += 1;
    }
    assert_eq!(cases, 4);
}
