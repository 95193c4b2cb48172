use crate::common::{CANARY, Random, Same, everywhere};
use sf_ops::conv::{conv_out, conv_transpose_rows};
use sf_ops::conv_s8::{
    ConvS8, ConvTransposeS8, band_lines, conv_rows_s8, conv_transpose_s8, conv2d_s8, conv2d_s8_sums,
    working_memory_conv_s8,
};
use sf_ops::gemm::{Act, PanelsS8, col_sums, pack_s8, padded_k, panel_len_s8};
use sf_ops::reference::{self, Window};
use sf_ops::{Ctx, Hwc, HwcMut, activation};

/// Quantized weights in panels.
struct Weights {
    n: usize,
    k: usize,
    /// Checkpoint order.
    plain: Vec<i8>,
    panels: Vec<i8>,
    scales: Vec<f32>,
    sums: Vec<i32>,
}

impl Weights {
    /// `rows` turns checkpoint order into rows of `k`.
    fn new(r: &mut Random, n: usize, k: usize, count: usize, rows: impl Fn(&[i8]) -> Vec<i8>) -> Weights {
        let plain: Vec<i8> = (0..count)
            .map(|_| if r.below(8) == 0 { [-127, 127][r.below(2)] } else { (r.below(255) as i32 - 127) as i8 })
            .collect();
        let mut panels = vec![77; panel_len_s8(n, k)];
        pack_s8(&rows(&plain), n, k, &mut panels);
        let sums = col_sums(&panels, n, k);
        let scales = r.vec(n).iter().map(|v| v.abs() * 1e-2).collect();
        Weights { n, k, plain, panels, scales, sums }
    }

    fn panels(&self) -> PanelsS8<'_> {
        PanelsS8 { n: self.n, k: self.k, data: &self.panels, scales: &self.scales, col_sums: &self.sums }
    }
}

struct Case {
    x: Vec<f32>,
    size: (usize, usize, usize),
    out: (usize, usize),
    window: Window,
    weights: Weights,
    bias: Vec<f32>,
    before: Vec<f32>,
}

impl Case {
    fn new(size: (usize, usize, usize), n: usize, (kernel, stride, pad): (usize, usize, usize)) -> Case {
        let (h, w, c) = size;
        let mut r = Random::new((h * 1_000_003 + w * 10_007 + c * 101 + n * 7 + kernel) as u64);
        // Pixels of every size, so that a wrong scale shows.
        let x: Vec<f32> = (0..h * w * c).map(|i| r.value() * [1.0, 0.1, 30.0][i / c.max(1) % 3]).collect();
        let k = kernel * kernel * padded_k(c);
        let weights = Weights::new(&mut r, n, k, n * c * kernel * kernel, |w| conv_rows_s8(w, n, c, kernel));
        let out = (conv_out(h, kernel, stride, pad), conv_out(w, kernel, stride, pad));
        let (bias, before) = (r.vec(n), r.vec(out.0 * out.1 * n));
        Case { x, size, out, window: Window { kernel, stride, pad }, weights, bias, before }
    }

    /// One of the epilogues, and whether there is a residual.
    fn layer(&self, kind: usize) -> (ConvS8<'_>, bool) {
        let relu = |yes| if yes { Act::Relu } else { Act::None };
        let conv = ConvS8 {
            weight: self.weights.panels(),
            bias: (!kind.is_multiple_of(3)).then_some(&self.bias[..]),
            kernel: self.window.kernel,
            stride: self.window.stride,
            pad: self.window.pad,
            relu_input: relu(kind % 2 == 1),
            act: [Act::None, Act::Relu, Act::Gelu][kind / 2 % 3],
            relu_sum: kind % 5 == 4,
        };
        (conv, kind % 4 >= 2)
    }

    fn image(&self) -> Hwc<'_> {
        Hwc::new(&self.x, self.size.0, self.size.1, self.size.2)
    }

    fn check(&self, kind: usize) {
        let (conv, residual) = self.layer(kind);
        let (oh, ow) = self.out;
        let n = self.weights.n;
        let (sums, scales) =
            reference::conv2d_s8(self.image(), &self.weights.plain, self.window, conv.relu_input == Act::Relu);
        let expected: Vec<f32> = (0..sums.len())
            .map(|i| {
                let bias = conv.bias.map_or(0.0, |b| b[i % n]);
                let y = reference::dequantize(sums[i], (scales[i / n], self.weights.scales[i % n]), bias);
                let y = match conv.act {
                    Act::None => y,
                    Act::Gelu => activation::gelu(y),
                    Act::Relu => reference::relu(y),
                };
                let y = if residual { self.before[i] + y } else { y };
                if conv.relu_sum { reference::relu(y) } else { y }
            })
            .collect();
        let what = format!("{:?} -> {n}, {:?}, epilogue {kind}", self.size, self.window);
        let mut same = Same::default();
        assert!(same.check(&expected, &what));
        everywhere(|ctx, name| {
            let mut y = vec![i32::MIN; sums.len() + 2];
            let end = y.len() - 1;
            conv2d_s8_sums(ctx, self.image(), &conv, &mut y[1..end]);
            assert!(y[1..end] == sums && y[0] == i32::MIN && y[end] == i32::MIN, "sums of {what}, {name}");
            let mut y = vec![CANARY; sums.len() + 2];
            let before = residual.then(|| Hwc::new(&self.before, oh, ow, n));
            conv2d_s8(ctx, self.image(), &conv, before, HwcMut::new(&mut y[1..end], oh, ow, n));
            assert!(y[0] == CANARY && y[end] == CANARY, "wrote beyond the output: {what}, {name}");
            same.check(&y[1..end], &format!("{what}, {name}"));
        });
    }
}

#[test]
fn windows_channels_and_tails() {
    let windows = [
        (1, 1, 0),
        (3, 1, 1),
        (3, 2, 1),
        (3, 1, 0),
        (7, 1, 3),
        (2, 2, 0),
        (14, 14, 0),
        (5, 3, 4),
        (1, 2, 0),
        (2, 3, 1),
    ];
    for (i, window) in windows.into_iter().enumerate() {
        for (j, (h, w, c, n)) in
            [(14, 28, 3, 20), (5, 6, 17, 33), (15, 14, 4, 1), (1, 1, 2, 16), (9, 31, 24, 48)].into_iter().enumerate()
        {
            Case::new((h, w, c), n, window).check(i * 5 + j * 7);
        }
    }
}

#[test]
fn every_width_of_a_line() {
    // Last tiles of every row count; windows that read on behind the last pixel.
    for w in 1..=27 {
        Case::new((3, w, 8), 17, (3, 1, 1)).check(w);
        Case::new((4, w, 5), 40, (1, 1, 0)).check(w + 3);
    }
}

#[test]
fn bands_and_blocks() {
    // Several bands; windows in blocks of lines and of parts of a line (more than 1024 values); one line of output.
    for (i, (size, n, window)) in [
        ((70, 5, 4), 3, (3, 1, 1)),
        ((67, 9, 8), 5, (3, 2, 1)),
        ((40, 7, 40), 16, (3, 1, 1)),
        ((6, 5, 200), 18, (3, 1, 1)),
        ((5, 4, 700), 9, (3, 1, 1)),
        ((4, 3, 1100), 7, (1, 1, 0)),
        ((1, 40, 12), 16, (3, 1, 1)),
    ]
    .into_iter()
    .enumerate()
    {
        Case::new(size, n, window).check(i + 1);
    }
    // 378 x 518 in the large network's widest map: the map of a band stays below its bound.
    assert_eq!(band_lines((378, 518, 128), 3, 1, 1), 4);
    assert_eq!(band_lines((189, 259, 32), 3, 1, 1), 16);
    assert!(working_memory_conv_s8((378, 518, 128), 3, 1, 1) * 4 < 900 << 10);
    assert!(working_memory_conv_s8((189, 259, 40), 3, 1, 1) * 4 < 600 << 10);
}

#[test]
fn values_that_are_not_finite_stay_seen() {
    // Bands of 3 and 2 output lines: the value, in line 1, is under the first. A 1 x 1 window is a pixel.
    for (window, touched) in [((3, 1, 1), 0..15), ((1, 1, 0), 7..8)] {
        let mut case = Case::new((5, 5, 4), 3, window);
        case.x[7 * 4 + 1] = f32::NAN;
        everywhere(|ctx, name| {
            let (conv, _) = case.layer(0);
            let mut y = vec![0.0; 75];
            conv2d_s8(ctx, case.image(), &conv, None, HwcMut::new(&mut y, 5, 5, 3));
            for (i, y) in y.iter().enumerate() {
                assert_eq!(y.is_nan(), touched.contains(&(i / 3)), "{name}: {window:?}, value {i}");
            }
        });
        // Zeros are exact: only the bias is left.
        case.x.fill(0.0);
        everywhere(|ctx, _| {
            let (conv, _) = case.layer(1);
            let mut y = vec![1.0; 75];
            conv2d_s8(ctx, case.image(), &conv, None, HwcMut::new(&mut y, 5, 5, 3));
            assert!(y.iter().enumerate().all(|(i, y)| *y == case.bias[i % 3]));
        });
    }
}

#[test]
fn transposed_convolutions() {
    for (kernel, h, w, c, n) in
        [(1, 2, 3, 4, 5), (2, 3, 5, 17, 32), (4, 2, 3, 8, 16), (4, 3, 2, 5, 3), (2, 1, 1, 3, 48), (2, 9, 14, 12, 8)]
    {
        let mut r = Random::new((kernel * 100 + c) as u64);
        let (x, bias) = (r.vec(h * w * c), r.vec(n));
        let outs = kernel * kernel * n;
        let area = kernel * kernel;
        let weights = Weights::new(&mut r, outs, c, n * c * area, |w| {
            let floats: Vec<f32> = w.iter().map(|&v| f32::from(v)).collect();
            conv_transpose_rows(&floats, c, n, kernel).into_iter().map(|v| v as i8).collect()
        });
        // Each output pixel sees one input pixel through one tap.
        let (oh, ow) = (h * kernel, w * kernel);
        let image = Hwc::new(&x, h, w, c);
        let mut expected = Vec::new();
        for y in 0..oh {
            for xx in 0..ow {
                let (q, scale) = reference::quantize(image.pixel(y / kernel, xx / kernel));
                let tap = y % kernel * kernel + xx % kernel;
                for o in 0..n {
                    let sum =
                        (0..c).map(|i| i32::from(q[i]) * i32::from(weights.plain[(i * n + o) * area + tap])).sum();
                    expected.push(reference::dequantize(sum, (scale, weights.scales[tap * n + o]), bias[o]));
                }
            }
        }
        let mut same = Same::default();
        assert!(same.check(&expected, "definition"));
        everywhere(|ctx: Ctx, name| {
            let mut y = vec![CANARY; expected.len()];
            let conv = ConvTransposeS8 { weight: weights.panels(), bias: Some(&bias), kernel };
            conv_transpose_s8(ctx, image, &conv, HwcMut::new(&mut y, oh, ow, n));
            same.check(&y, &format!("{h} x {w} x {c} -> {n}, kernel {kernel}, {name}"));
        });
    }
}

#[test]
#[should_panic(expected = "inputs of a 3 x 3 int8 convolution over 4 channels")]
fn a_wrong_shape_panics() {
    let case = Case::new((4, 4, 8), 3, (3, 1, 1));
    let (conv, _) = case.layer(0);
    let pool = sf_ops::par::Pool::new(1).unwrap();
    let ctx = Ctx { pool: &pool, kernels: sf_ops::Kernels::best() };
    conv2d_s8(ctx, Hwc::new(&case.x[..64], 4, 4, 4), &conv, None, HwcMut::new(&mut [0.0; 48], 4, 4, 3));
}
