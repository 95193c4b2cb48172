//! Layers with known sizes, checked against their definitions before anything is timed.
//!
//! `cargo bench --manifest-path bench/Cargo.toml` times them with criterion and prints a Markdown table; `scripts/bench-kernels.sh`
//! does that with the settings of the documentation.
#![forbid(unsafe_code)]
#![warn(missing_docs)]

use sf_ops::conv::{Conv, conv_out, conv_rows, conv2d};
use sf_ops::conv_s8::{ConvS8, conv_rows_s8, conv2d_s8, conv2d_s8_sums};
use sf_ops::gemm::{
    Act, Epilogue, Panels, PanelsS8, RowsS8, RowsS8Mut, col_sums, gemm, gemm_s8, gemm_s8_quantize, gemm_s8_sums,
    pack_f16, pack_f32, pack_s8, padded_k, panel_len, panel_len_s8, unpack,
};
use sf_ops::hadamard::Rotation;
use sf_ops::quantize::{Before, quantize};
use sf_ops::reference::{self, Window};
use sf_ops::resize::{Corners, bilinear};
use sf_ops::{Ctx, Hwc, HwcMut, Mat, MatMut, layernorm};

/// Which peak a layer's operations are held against.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Peak {
    /// f32 multiply-adds.
    F32,
    /// int8 multiply-adds.
    S8,
    /// None: a pass over memory.
    Memory,
}

/// Something to be timed.
pub struct Layer {
    /// Kind, which is also the group of the bench.
    pub kind: &'static str,
    /// Sizes.
    pub size: String,
    /// Operations (two per multiply-add) of a run.
    pub ops: f64,
    /// Bytes that a run has to read and write once: operands, weights, result.
    pub bytes: f64,
    /// Peak to compare with.
    pub peak: Peak,
    /// One run.
    pub run: Box<dyn FnMut(Ctx)>,
}

/// Values in [-1, 1) from a linear congruential generator.
fn values(seed: u64, n: usize) -> Vec<f32> {
    let mut state = seed;
    let mut next = || {
        state = state.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
        (state >> 40) as f32 / (1u32 << 23) as f32 - 1.0
    };
    (0..n).map(|_| next()).collect()
}

fn bytes(seed: u64, n: usize) -> Vec<i8> {
    values(seed, n).iter().map(|v| (v * 127.0) as i8).collect()
}

/// Weights on a cache line, as in a weight file.
struct Aligned<T> {
    data: Vec<T>,
    at: usize,
    len: usize,
}

impl<T: Copy + Default> Aligned<T> {
    fn new(len: usize, fill: impl FnOnce(&mut [T])) -> Aligned<T> {
        let mut data = vec![T::default(); len + 64];
        let at = data.as_ptr().align_offset(64).min(64);
        fill(&mut data[at..at + len]);
        Aligned { data, at, len }
    }

    fn get(&self) -> &[T] {
        &self.data[self.at..self.at + self.len]
    }
}

/// int8 weights `[n, k]`.
struct WeightsS8 {
    n: usize,
    k: usize,
    panels: Aligned<i8>,
    scales: Vec<f32>,
    sums: Vec<i32>,
}

impl WeightsS8 {
    fn new(rows: &[i8], n: usize, k: usize) -> WeightsS8 {
        let panels = Aligned::new(panel_len_s8(n, k), |p| pack_s8(rows, n, k, p));
        let sums = col_sums(panels.get(), n, k);
        WeightsS8 { n, k, panels, scales: vec![0.01; n], sums }
    }

    fn get(&self) -> PanelsS8<'_> {
        PanelsS8 { n: self.n, k: self.k, data: self.panels.get(), scales: &self.scales, col_sums: &self.sums }
    }
}

/// Rows that are checked against the definition: the first and the last.
fn some_rows(m: usize) -> [usize; 2] {
    [0, m - 1]
}

fn close(y: f32, expected: f32, k: usize) {
    let most = 1e-6 * k as f32;
    assert!((y - expected).abs() <= most, "{y} instead of {expected}, {most} allowed");
}

/// An int8 product with GELU; with `fused` its outputs rotated and quantized for the next product.
pub fn product_s8(ctx: Ctx, (m, k, n): (usize, usize, usize), fused: bool) -> Layer {
    let (a, rows) = (bytes(1, m * padded_k(k)), bytes(2, n * k));
    assert_eq!(k, padded_k(k), "inputs in fours");
    let (w, scales, bias) = (WeightsS8::new(&rows, n, k), vec![0.01; m], values(3, n));
    let mut sums = vec![0; m * n];
    gemm_s8_sums(ctx, RowsS8 { m, k, data: &a, scales: &scales }, w.get(), &mut sums);
    for r in some_rows(m) {
        assert_eq!(sums[r * n..][..n], reference::gemm_s8(&a[r * k..][..k], &rows, k), "{m} x {k} x {n}, row {r}");
    }
    let mut y = vec![0.0; m * n];
    let (mut q, mut steps) = (vec![0; m * padded_k(n)], vec![0.0; m]);
    let signs = vec![0x5a5a; n / 16];
    Layer {
        kind: if fused { "product s8, gelu, rotate, quantize" } else { "product s8, gelu" },
        size: format!("{m}x{k}x{n}"),
        ops: 2.0 * (m * k * n) as f64,
        bytes: (m * k + n * k + if fused { m * n } else { 4 * m * n }) as f64,
        peak: Peak::S8,
        run: Box::new(move |ctx| {
            let a = RowsS8 { m, k, data: &a, scales: &scales };
            let ep = Epilogue { bias: Some(&bias), act: Act::Gelu, ..Epilogue::default() };
            if fused {
                let before = Before { norm: None, rotation: Some(Rotation::new(n, &signs)) };
                let out = RowsS8Mut { m, k: n, data: &mut q, scales: &mut steps };
                gemm_s8_quantize(ctx, a, w.get(), ep, before, out);
            } else {
                gemm_s8(ctx, a, w.get(), ep, MatMut::new(&mut y, m, n));
            }
        }),
    }
}

/// A product with f16 or f32 weights.
pub fn product(ctx: Ctx, (m, k, n): (usize, usize, usize), f16: bool) -> Layer {
    let (a, rows, bias) = (values(1, m * k), values(2, n * k), values(3, n));
    let full = Aligned::new(if f16 { 0 } else { panel_len(n, k) }, |p| {
        if !f16 {
            pack_f32(&rows, n, k, p);
        }
    });
    let half = Aligned::new(if f16 { panel_len(n, k) } else { 0 }, |p| {
        if f16 {
            pack_f16(&rows, n, k, p);
        }
    });
    let mut y = vec![0.0; m * n];
    let panels = if f16 { Panels::f16(half.get(), n, k) } else { Panels::f32(full.get(), n, k) };
    gemm(
        ctx,
        Mat::new(&a, m, k),
        panels,
        Epilogue { bias: Some(&bias), ..Epilogue::default() },
        MatMut::new(&mut y, m, n),
    );
    let stored = unpack(panels);
    for r in some_rows(m) {
        let expected = reference::linear(Mat::new(&a[r * k..][..k], 1, k), &stored, Some(&bias));
        y[r * n..][..n].iter().zip(&expected).for_each(|(y, e)| close(*y, *e, k));
    }
    Layer {
        kind: if f16 { "product f16" } else { "product f32" },
        size: format!("{m}x{k}x{n}"),
        ops: 2.0 * (m * k * n) as f64,
        bytes: (4 * m * k + if f16 { 2 } else { 4 } * n * k + 4 * m * n) as f64,
        peak: Peak::F32,
        run: Box::new(move |ctx| {
            let panels = if f16 { Panels::f16(half.get(), n, k) } else { Panels::f32(full.get(), n, k) };
            let ep = Epilogue { bias: Some(&bias), ..Epilogue::default() };
            gemm(ctx, Mat::new(&a, m, k), panels, ep, MatMut::new(&mut y, m, n));
        }),
    }
}

/// Sizes of a convolution: (height, width, in), out, (kernel, stride, pad).
pub type ConvSize = ((usize, usize, usize), usize, (usize, usize, usize));

fn conv_size(((h, w, c), n, (kernel, stride, _)): ConvSize) -> String {
    format!("{h}x{w}x{c}->{n}, {kernel}x{kernel}/{stride}")
}

/// Lines of an image that the definition of a convolution is asked for: enough for one output line.
fn first_lines(x: &[f32], (h, w, c): (usize, usize, usize), kernel: usize) -> Hwc<'_> {
    let lines = kernel.min(h);
    Hwc::new(&x[..lines * w * c], lines, w, c)
}

/// An int8 convolution.
pub fn conv_s8(ctx: Ctx, size: ConvSize) -> Layer {
    let ((h, w, c), n, (kernel, stride, pad)) = size;
    let (oh, ow) = (conv_out(h, kernel, stride, pad), conv_out(w, kernel, stride, pad));
    let (x, weight, bias) = (values(1, h * w * c), bytes(2, n * c * kernel * kernel), values(3, n));
    let weights = WeightsS8::new(&conv_rows_s8(&weight, n, c, kernel), n, kernel * kernel * padded_k(c));
    fn layer<'a>(weight: PanelsS8<'a>, bias: &'a [f32], (kernel, stride, pad): (usize, usize, usize)) -> ConvS8<'a> {
        let (relu_input, act) = (Act::None, Act::Relu);
        ConvS8 { weight, bias: Some(bias), kernel, stride, pad, relu_input, act, relu_sum: false }
    }
    // A small image of the same layer, whole.
    let small = Hwc::new(&x[..6.min(h) * w * c], 6.min(h), w, c);
    let (sums, _) = reference::conv2d_s8(small, &weight, Window { kernel, stride, pad }, false);
    let mut got = vec![0; sums.len()];
    conv2d_s8_sums(ctx, small, &layer(weights.get(), &bias, (kernel, stride, pad)), &mut got);
    assert!(got == sums, "sums of {}", conv_size(size));
    let mut y = vec![0.0; oh * ow * n];
    Layer {
        kind: "convolution s8",
        size: conv_size(size),
        ops: 2.0 * (oh * ow * n * c * kernel * kernel) as f64,
        bytes: (4 * h * w * c + n * c * kernel * kernel + 4 * oh * ow * n) as f64,
        peak: Peak::S8,
        run: Box::new(move |ctx| {
            let conv = layer(weights.get(), &bias, (kernel, stride, pad));
            conv2d_s8(ctx, Hwc::new(&x, h, w, c), &conv, None, HwcMut::new(&mut y, oh, ow, n));
        }),
    }
}

/// A convolution with f16 weights.
pub fn conv_f16(ctx: Ctx, size: ConvSize) -> Layer {
    let ((h, w, c), n, (kernel, stride, pad)) = size;
    let (oh, ow) = (conv_out(h, kernel, stride, pad), conv_out(w, kernel, stride, pad));
    let k = kernel * kernel * c;
    let (x, weight, bias) = (values(1, h * w * c), values(2, n * k), values(3, n));
    // Half precision, so that panels and definition have the same weights.
    let weight: Vec<f32> = weight.iter().map(|v| (v * 256.0).round() / 256.0).collect();
    let panels = Aligned::new(panel_len(n, k), |p| pack_f16(&conv_rows(&weight, n, c, kernel), n, k, p));
    fn layer<'a>(weight: Panels<'a>, bias: &'a [f32], (kernel, stride, pad): (usize, usize, usize)) -> Conv<'a> {
        Conv { weight, bias: Some(bias), kernel, stride, pad, relu_input: Act::None, act: Act::None }
    }
    let part = first_lines(&x, (h, w, c), kernel);
    let expected = reference::conv2d(part, &weight, Some(&bias), Window { kernel, stride, pad });
    let mut got = vec![0.0; expected.len()];
    let (ph, conv) =
        (conv_out(part.h, kernel, stride, pad), layer(Panels::f16(panels.get(), n, k), &bias, (kernel, stride, pad)));
    conv2d(ctx, part, &conv, None, HwcMut::new(&mut got, ph, ow, n));
    got.iter().zip(&expected).for_each(|(y, e)| close(*y, *e, k));
    let mut y = vec![0.0; oh * ow * n];
    Layer {
        kind: "convolution f16",
        size: conv_size(size),
        ops: 2.0 * (oh * ow * n * k) as f64,
        bytes: (4 * h * w * c + 2 * n * k + 4 * oh * ow * n) as f64,
        peak: Peak::F32,
        run: Box::new(move |ctx| {
            let conv = layer(Panels::f16(panels.get(), n, k), &bias, (kernel, stride, pad));
            conv2d(ctx, Hwc::new(&x, h, w, c), &conv, None, HwcMut::new(&mut y, oh, ow, n));
        }),
    }
}

/// Rows rotated and quantized.
pub fn quantize_rows(ctx: Ctx, (m, k): (usize, usize)) -> Layer {
    let x = values(1, m * k);
    let signs = vec![0x5a5a; k / 16];
    let (mut q, mut steps) = (vec![0; m * k], vec![0.0; m]);
    quantize(ctx, Mat::new(&x, m, k), Before::default(), RowsS8Mut { m, k, data: &mut q, scales: &mut steps });
    for r in some_rows(m) {
        assert_eq!((q[r * k..][..k].to_vec(), steps[r]), reference::quantize(&x[r * k..][..k]), "row {r}");
    }
    Layer {
        kind: "rotate, quantize",
        size: format!("{m}x{k}"),
        ops: 0.0,
        bytes: (5 * m * k) as f64,
        peak: Peak::Memory,
        run: Box::new(move |ctx| {
            let before = Before { norm: None, rotation: Some(Rotation::new(k, &signs)) };
            quantize(ctx, Mat::new(&x, m, k), before, RowsS8Mut { m, k, data: &mut q, scales: &mut steps });
        }),
    }
}

/// Layer norm.
pub fn norm(ctx: Ctx, (m, k): (usize, usize)) -> Layer {
    let (x, gain, offset) = (values(1, m * k), values(2, k), values(3, k));
    let mut y = vec![0.0; m * k];
    layernorm::layernorm(ctx, Mat::new(&x, m, k), &gain, &offset, 1e-6, MatMut::new(&mut y, m, k));
    for r in some_rows(m) {
        let expected = reference::layernorm(Mat::new(&x[r * k..][..k], 1, k), &gain, &offset, 1e-6);
        y[r * k..][..k].iter().zip(&expected).for_each(|(y, e)| close(*y, *e, 10));
    }
    Layer {
        kind: "layer norm",
        size: format!("{m}x{k}"),
        ops: 0.0,
        bytes: (8 * m * k) as f64,
        peak: Peak::Memory,
        run: Box::new(move |ctx| {
            layernorm::layernorm(ctx, Mat::new(&x, m, k), &gain, &offset, 1e-6, MatMut::new(&mut y, m, k));
        }),
    }
}

/// Bilinear resize to twice the size, aligned corners.
pub fn upsample(ctx: Ctx, (h, w, c): (usize, usize, usize)) -> Layer {
    let x = values(1, h * w * c);
    let (oh, ow) = (2 * h, 2 * w);
    let mut y = vec![0.0; oh * ow * c];
    bilinear(ctx, Hwc::new(&x, h, w, c), Corners::Aligned, HwcMut::new(&mut y, oh, ow, c));
    let expected = reference::bilinear(Hwc::new(&x, h, w, c), Corners::Aligned, oh, ow);
    y.iter().zip(&expected).for_each(|(y, e)| close(*y, *e, 4));
    Layer {
        kind: "bilinear x2",
        size: format!("{h}x{w}x{c}"),
        ops: 0.0,
        bytes: (4 * (h * w + oh * ow) * c) as f64,
        peak: Peak::Memory,
        run: Box::new(move |ctx| {
            bilinear(ctx, Hwc::new(&x, h, w, c), Corners::Aligned, HwcMut::new(&mut y, oh, ow, c));
        }),
    }
}

/// The list: a large transformer (4 frames of 217 tokens, 1024 wide), the shipped network (128 wide, half-resolution convolutions),
/// and few rows.
pub fn layers(ctx: Ctx) -> Vec<Layer> {
    let mut list = Vec::new();
    for size in
        [(868, 1024, 1024), (868, 1024, 4096), (868, 4096, 1024), (1956, 128, 384), (1956, 128, 512), (1956, 512, 128)]
    {
        list.push(product_s8(ctx, size, false));
    }
    for m in [1, 4, 16, 64] {
        list.push(product_s8(ctx, (m, 1024, 1024), false));
    }
    for size in [(1956, 128, 512), (868, 1024, 1024)] {
        list.push(product_s8(ctx, size, true));
    }
    for size in [(868, 1024, 1024), (1956, 128, 384)] {
        list.push(product(ctx, size, false));
        list.push(product(ctx, size, true));
    }
    let same = (3, 1, 1);
    let convs = [
        ((189, 259, 40), 32, same),
        ((189, 259, 32), 32, same),
        ((189, 259, 32), 44, same),
        ((378, 518, 3), 16, (3, 2, 1)),
        ((96, 144, 256), 256, same),
    ];
    for size in convs {
        list.push(conv_s8(ctx, size));
        list.push(conv_f16(ctx, size));
    }
    list.push(quantize_rows(ctx, (868, 1024)));
    list.push(norm(ctx, (868, 1024)));
    list.push(upsample(ctx, (108, 148, 64)));
    list
}
