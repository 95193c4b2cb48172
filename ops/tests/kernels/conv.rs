use crate::common::{CANARY, Random, Same, everywhere};
use crate::tolerance;
use sf_ops::conv::{Conv, ConvTranspose, conv_out, conv_rows, conv_transpose, conv_transpose_rows, conv2d};
use sf_ops::gemm::{Act, Panels, pack_f16, pack_f32, panel_len, unpack};
use sf_ops::reference::{self, Window};
use sf_ops::{Hwc, HwcMut};

fn close(y: &[f32], expected: &[f32], k: usize, what: &str) {
    let size = expected.iter().fold(1.0f32, |m, v| m.max(v.abs())) * (k as f32).sqrt();
    for (i, (a, b)) in y.iter().zip(expected).enumerate() {
        assert!((a - b).abs() <= tolerance::dot(k, size), "{what}: value {i} is {a}, expected {b}");
    }
}

#[test]
fn convolutions() {
    let windows = [(1, 1, 0), (3, 1, 1), (3, 2, 1), (3, 1, 0), (7, 1, 3), (2, 2, 0), (14, 14, 0), (5, 3, 4)];
    for (i, (kernel, stride, pad)) in windows.into_iter().enumerate() {
        // The last: several bands, and windows in blocks of parts of a line.
        for (h, w, c, n) in [(14, 28, 3, 20), (5, 6, 17, 33), (15, 14, 4, 1), (1, 1, 2, 16), (21, 5, 130, 35)] {
            let (oh, ow) = (conv_out(h, kernel, stride, pad), conv_out(w, kernel, stride, pad));
            let mut r = Random::new((i * 1000 + h * 10 + c) as u64);
            let (x, weight, bias) = (r.vec(h * w * c), r.vec(n * c * kernel * kernel), r.vec(n));
            let k = kernel * kernel * c;
            let rows = conv_rows(&weight, n, c, kernel);
            let mut panels = vec![0.0; panel_len(n, k)];
            pack_f32(&rows, n, k, &mut panels);
            let relu_in = (i + c) % 2 == 0;
            let before = r.vec(oh * ow * n);
            let conv = Conv {
                weight: Panels::f32(&panels, n, k),
                bias: (i % 3 != 0).then_some(&bias[..]),
                kernel,
                stride,
                pad,
                relu_input: if relu_in { Act::Relu } else { Act::None },
                act: if i % 2 == 0 { Act::None } else { Act::Relu },
            };
            let input: Vec<f32> = x.iter().map(|&v| if relu_in { reference::relu(v) } else { v }).collect();
            let window = Window { kernel, stride, pad };
            let mut expected = reference::conv2d(Hwc::new(&input, h, w, c), &weight, conv.bias, window);
            expected.iter_mut().for_each(|v| *v = reference::activate(*v, conv.act));
            let residual = (h == 5).then(|| Hwc::new(&before, oh, ow, n));
            if residual.is_some() {
                expected.iter_mut().zip(&before).for_each(|(v, b)| *v += b);
            }
            let mut same = Same::default();
            everywhere(|ctx, name| {
                let what = format!("{h} x {w} x {c} -> {n}, window {window:?}, {name}");
                let mut y = vec![CANARY; oh * ow * n];
                conv2d(ctx, Hwc::new(&x, h, w, c), &conv, residual, HwcMut::new(&mut y, oh, ow, n));
                if same.check(&y, &what) {
                    close(&y, &expected, k, &what);
                }
            });
        }
    }
}

#[test]
fn transposed_convolutions() {
    for (kernel, h, w, c, n) in
        [(1, 2, 3, 4, 5), (2, 3, 5, 17, 32), (4, 2, 3, 8, 16), (4, 3, 2, 5, 3), (2, 1, 1, 3, 48)]
    {
        let mut r = Random::new((kernel * 100 + c) as u64);
        let (x, weight, bias) = (r.vec(h * w * c), r.vec(c * n * kernel * kernel), r.vec(n));
        let rows = conv_transpose_rows(&weight, c, n, kernel);
        let outs = kernel * kernel * n;
        let (mut full, mut half) = (vec![0.0; panel_len(outs, c)], vec![0; panel_len(outs, c)]);
        pack_f32(&rows, outs, c, &mut full);
        pack_f16(&rows, outs, c, &mut half);
        for panels in [Panels::f32(&full, outs, c), Panels::f16(&half, outs, c)] {
            // Back to the checkpoint's order, after the rounding of the panels.
            let stored = unpack(panels);
            let mut rounded = vec![0.0; weight.len()];
            for t in 0..kernel * kernel {
                for o in 0..n {
                    for i in 0..c {
                        rounded[(i * n + o) * kernel * kernel + t] = stored[(t * n + o) * c + i];
                    }
                }
            }
            let expected = reference::conv_transpose(Hwc::new(&x, h, w, c), &rounded, Some(&bias), kernel);
            let mut same = Same::default();
            everywhere(|ctx, name| {
                let what = format!("{h} x {w} x {c} -> {n}, kernel {kernel}, {name}");
                let mut y = vec![CANARY; expected.len()];
                let conv = ConvTranspose { weight: panels, bias: Some(&bias), kernel };
                conv_transpose(ctx, Hwc::new(&x, h, w, c), &conv, HwcMut::new(&mut y, h * kernel, w * kernel, n));
                if same.check(&y, &what) {
                    close(&y, &expected, c, &what);
                }
            });
        }
    }
}

#[test]
fn output_sizes() {
    assert_eq!(conv_out(20, 3, 1, 1), 20);
    assert_eq!(conv_out(20, 3, 2, 1), 10);
    assert_eq!(conv_out(21, 3, 2, 1), 11);
    assert_eq!(conv_out(252, 14, 14, 0), 18);
    assert_eq!(conv_out(1, 3, 1, 0), 0);
}

#[test]
fn relu_on_the_fly_keeps_nan() {
    let pool = sf_ops::par::Pool::new(1).unwrap();
    let ctx = sf_ops::Ctx { pool: &pool, kernels: sf_ops::Kernels::best() };
    let mut panels = vec![0.0; 16];
    pack_f32(&[1.0], 1, 1, &mut panels);
    let conv = Conv {
        weight: Panels::f32(&panels, 1, 1),
        bias: None,
        kernel: 1,
        stride: 1,
        pad: 0,
        relu_input: Act::Relu,
        act: Act::Relu,
    };
    let mut y = [0.0; 3];
    conv2d(ctx, Hwc::new(&[f32::NAN, -2.0, 3.0], 1, 3, 1), &conv, None, HwcMut::new(&mut y, 1, 3, 1));
    assert!(y[0].is_nan() && y[1] == 0.0 && y[2] == 3.0);
}
