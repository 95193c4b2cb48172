//! Layers with known sizes, checked against their definitions before anything is timed.
//!
//! `cargo bench --manifest-path bench/Cargo.toml` times them with criterion and prints a Markdown table; `scripts/bench-kernels.sh`
//! does that with the settings of the documentation.
#![forbid(unsafe_code)]
#![warn(missing_docs)]

use sf_ops::attention::{FrameMask, Heads, attention_s8, scratch_len, scratch_len_s8};
use sf_ops::conv::{Conv, conv_out, conv_rows, conv2d};
use sf_ops::conv_s8::{ConvS8, conv_rows_s8, conv2d_s8, conv2d_s8_sums};
use sf_ops::gemm::{
    Act, Epilogue, Panels, PanelsS8, RowsS8, RowsS8Mut, col_sums, gemm, gemm_s8, gemm_s8_quantize, gemm_s8_sums,
    pack_f16, pack_f32, pack_s8, padded_k, panel_len, panel_len_s8, unpack,
};
use sf_ops::hadamard::{Rotation, rotate_rows};
use sf_ops::quantize::{Before, Norm, quantize};
use sf_ops::reference::{self, Window};
use sf_ops::resize::{Corners, bilinear};
use sf_ops::rope::{AngleRound, QkNorm, RopeTable, qk_norm_rope};
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

/// Values on a cache line, as in a weight file and in the engine's working memory: vectors across two lines cost two accesses, and outputs
/// that start anywhere made narrow products several times slower.
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

    fn get_mut(&mut self) -> &mut [T] {
        &mut self.data[self.at..self.at + self.len]
    }

    fn zeros(len: usize) -> Aligned<T> {
        Aligned::new(len, |_| {})
    }

    fn of(values: &[T]) -> Aligned<T> {
        Aligned::new(values.len(), |to| to.copy_from_slice(values))
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

/// What follows an int8 product in the same pass.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum After {
    /// Bias only, f32 out.
    Bias,
    /// Bias and GELU, f32 out.
    Gelu,
    /// Bias, GELU, rotation and quantization for the next product.
    Quantized,
}

/// An int8 product.
pub fn product_s8(ctx: Ctx, (m, k, n): (usize, usize, usize), after: After) -> Layer {
    let (a, rows) = (Aligned::of(&bytes(1, m * padded_k(k))), bytes(2, n * k));
    assert_eq!(k, padded_k(k), "inputs in fours");
    let (w, scales, bias) = (WeightsS8::new(&rows, n, k), vec![0.01; m], values(3, n));
    let mut sums = vec![0; m * n];
    gemm_s8_sums(ctx, RowsS8 { m, k, data: a.get(), scales: &scales }, w.get(), &mut sums);
    for r in some_rows(m) {
        assert_eq!(
            sums[r * n..][..n],
            reference::gemm_s8(&a.get()[r * k..][..k], &rows, k),
            "{m} x {k} x {n}, row {r}"
        );
    }
    let fused = after == After::Quantized;
    let mut y = Aligned::zeros(if fused { 0 } else { m * n });
    let (mut q, mut steps) = (Aligned::zeros(m * padded_k(n)), vec![0.0; m]);
    let signs = vec![0x5a5a; n / 16];
    Layer {
        kind: match after {
            After::Bias => "product s8",
            After::Gelu => "product s8, gelu",
            After::Quantized => "product s8, gelu, rotate, quantize",
        },
        size: format!("{m}x{k}x{n}"),
        ops: 2.0 * (m * k * n) as f64,
        bytes: (m * k + n * k + if fused { m * n } else { 4 * m * n }) as f64,
        peak: Peak::S8,
        run: Box::new(move |ctx| {
            let a = RowsS8 { m, k, data: a.get(), scales: &scales };
            let act = if after == After::Bias { Act::None } else { Act::Gelu };
            let ep = Epilogue { bias: Some(&bias), act, ..Epilogue::default() };
            if fused {
                let before = Before { norm: None, rotation: Some(Rotation::new(n, &signs)) };
                let out = RowsS8Mut { m, k: n, data: q.get_mut(), scales: &mut steps };
                gemm_s8_quantize(ctx, a, w.get(), ep, before, out);
            } else {
                gemm_s8(ctx, a, w.get(), ep, MatMut::new(y.get_mut(), m, n));
            }
        }),
    }
}

/// An int8 layer from f32 rows: rotated, quantized per row, multiplied.
pub fn linear_s8(ctx: Ctx, (m, k, n): (usize, usize, usize)) -> Layer {
    let (l, x, mut y) = (Linear::new(2, n, k), Aligned::of(&values(1, m * k)), Aligned::zeros(m * n));
    let (mut q, mut steps) = (Aligned::zeros(m * padded_k(k)), vec![0.0; m]);
    // The definition in f32, on the weights' integers.
    let expected = some_rows(m).map(|r| {
        let mut row = x.get()[r * k..][..k].to_vec();
        rotate_rows(ctx, Rotation::new(k, &l.signs), MatMut::new(&mut row, 1, k));
        (r, reference::linear(Mat::new(&row, 1, k), &l.exact, Some(&l.bias)))
    });
    let mut one = move |ctx: Ctx, y: &mut [f32]| {
        let before = Before { norm: None, rotation: Some(Rotation::new(k, &l.signs)) };
        let rows = RowsS8Mut { m, k, data: q.get_mut(), scales: &mut steps };
        quantize(ctx, Mat::new(x.get(), m, k), before, rows);
        let a = RowsS8 { m, k, data: q.get(), scales: &steps };
        let ep = Epilogue { bias: Some(&l.bias), ..Epilogue::default() };
        gemm_s8(ctx, a, l.w.get(), ep, MatMut::new(y, m, n));
    };
    one(ctx, y.get_mut());
    for (r, exact) in expected {
        let db = snr(&exact, &y.get()[r * n..][..n]);
        assert!(db > 30.0, "{db:.1} dB between int8 and f32, {m} x {k} x {n}, row {r}");
    }
    Layer {
        kind: "linear s8",
        size: format!("{m}x{k}x{n}"),
        ops: 2.0 * (m * k * n) as f64,
        bytes: (4 * m * k + n * k + 4 * m * n) as f64,
        peak: Peak::S8,
        run: Box::new(move |ctx| one(ctx, y.get_mut())),
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
    let mut timed = Aligned::zeros(m * n);
    Layer {
        kind: if f16 { "product f16" } else { "product f32" },
        size: format!("{m}x{k}x{n}"),
        ops: 2.0 * (m * k * n) as f64,
        bytes: (4 * m * k + if f16 { 2 } else { 4 } * n * k + 4 * m * n) as f64,
        peak: Peak::F32,
        run: Box::new(move |ctx| {
            let panels = if f16 { Panels::f16(half.get(), n, k) } else { Panels::f32(full.get(), n, k) };
            let ep = Epilogue { bias: Some(&bias), ..Epilogue::default() };
            gemm(ctx, Mat::new(&a, m, k), panels, ep, MatMut::new(timed.get_mut(), m, n));
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
    let (x, mut y) = (Aligned::of(&x), Aligned::zeros(oh * ow * n));
    Layer {
        kind: "convolution s8",
        size: conv_size(size),
        ops: 2.0 * (oh * ow * n * c * kernel * kernel) as f64,
        bytes: (4 * h * w * c + n * c * kernel * kernel + 4 * oh * ow * n) as f64,
        peak: Peak::S8,
        run: Box::new(move |ctx| {
            let conv = layer(weights.get(), &bias, (kernel, stride, pad));
            conv2d_s8(ctx, Hwc::new(x.get(), h, w, c), &conv, None, HwcMut::new(y.get_mut(), oh, ow, n));
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
    let (x, mut y) = (Aligned::of(&x), Aligned::zeros(oh * ow * n));
    Layer {
        kind: "convolution f16",
        size: conv_size(size),
        ops: 2.0 * (oh * ow * n * k) as f64,
        bytes: (4 * h * w * c + 2 * n * k + 4 * oh * ow * n) as f64,
        peak: Peak::F32,
        run: Box::new(move |ctx| {
            let conv = layer(Panels::f16(panels.get(), n, k), &bias, (kernel, stride, pad));
            conv2d(ctx, Hwc::new(x.get(), h, w, c), &conv, None, HwcMut::new(y.get_mut(), oh, ow, n));
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

/// (frames, tokens, heads, head width).
pub type HeadsSize = (usize, usize, usize, usize);

/// Which frames a query's frame sees: those from frame + `lo` to frame + `hi`.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Sees {
    /// Smallest difference of frames.
    pub lo: i32,
    /// Largest.
    pub hi: i32,
}

impl Sees {
    /// Its own frame.
    pub const OWN: Sees = Sees { lo: 0, hi: 0 };
    /// The next frame only; the last sees none.
    pub const NEXT: Sees = Sees { lo: 1, hi: 1 };
    /// All frames.
    pub const ALL: Sees = Sees { lo: -64, hi: 64 };

    fn mask(self, frames: usize, tokens: usize) -> FrameMask {
        FrameMask { frames, tokens, lo: self.lo, hi: self.hi }
    }

    fn name(self) -> String {
        match self {
            Sees::OWN => "own frame".into(),
            Sees::NEXT => "next frame".into(),
            Sees::ALL => "all frames".into(),
            Sees { lo, hi } => format!("frames {lo:+} to {hi:+}"),
        }
    }
}

/// Signal over error in dB.
fn snr(exact: &[f32], y: &[f32]) -> f64 {
    let power = |x: &mut dyn Iterator<Item = f32>| x.map(|v| f64::from(v).powi(2)).sum::<f64>();
    let error = power(&mut exact.iter().zip(y).map(|(a, b)| a - b));
    10.0 * (power(&mut exact.iter().copied()) / error).log10()
}

fn positions(tokens: usize) -> Vec<(u32, u32)> {
    (0..tokens as u32).map(|i| (i / 18, i % 18)).collect()
}

/// Attention with q/k norm and rotary embedding, int8 or f32; operations of the keys that are seen.
pub fn attention(ctx: Ctx, (frames, tokens, heads, d): HeadsSize, sees: Sees, int8: bool) -> Layer {
    let (mask, rows, c) = (sees.mask(frames, tokens), frames * tokens, heads * d);
    let qkv = Aligned::of(&values(1, rows * 3 * c).iter().map(|v| 2.0 * v).collect::<Vec<_>>());
    let table = RopeTable::new(&positions(tokens), d, 100.0, AngleRound::None);
    let (ones, zeros) = (vec![1.0; d], vec![0.0; d]);
    let threads = ctx.pool.threads();
    let need = scratch_len(&mask, heads, d, threads).max(scratch_len_s8(&mask, heads, d, threads));
    let (mut scratch, mut work) = (Aligned::zeros(need), Aligned::of(qkv.get()));
    let mut one = move |ctx: Ctx, int8: bool, y: &mut [f32]| {
        let norm = QkNorm { q_gain: &ones, q_offset: &zeros, k_gain: &ones, k_offset: &zeros, eps: 1e-5 };
        let (norm, rope, out) = (Some(norm), Some(&table), MatMut::new(y, rows, c));
        if int8 {
            let x = Heads { qkv: Mat::new(qkv.get(), rows, 3 * c), heads, norm, rope, rotation: None };
            attention_s8(ctx, x, mask, scratch.get_mut(), out);
        } else {
            work.get_mut().copy_from_slice(qkv.get());
            qk_norm_rope(ctx, MatMut::new(work.get_mut(), rows, 3 * c), heads, norm, rope);
            sf_ops::attention::attention(ctx, Mat::new(work.get(), rows, 3 * c), heads, mask, scratch.get_mut(), out);
        }
    };
    let (mut y, mut exact) = (Aligned::zeros(rows * c), vec![0.0; rows * c]);
    one(ctx, true, y.get_mut());
    one(ctx, false, &mut exact);
    let db = snr(&exact, y.get());
    assert!(db > 30.0, "{db:.1} dB between int8 and f32 attention");
    let pairs = (0..frames).map(|a| mask.keys(a).len()).sum::<usize>() * tokens * tokens;
    Layer {
        kind: if int8 { "attention s8" } else { "attention f32" },
        size: format!("{frames}x{tokens}, {heads} heads of {d}, {}", sees.name()),
        ops: 4.0 * (pairs * c) as f64,
        bytes: 16.0 * (rows * c) as f64,
        peak: if int8 { Peak::S8 } else { Peak::F32 },
        run: Box::new(move |ctx| one(ctx, int8, y.get_mut())),
    }
}

/// An int8 linear layer with a rotation before it.
struct Linear {
    w: WeightsS8,
    bias: Vec<f32>,
    signs: Vec<u16>,
    /// What the integers stand for, `[n, k]`, for the f32 twin.
    exact: Vec<f32>,
}

impl Linear {
    /// Weights of a size that keeps unit variance.
    fn new(seed: u64, n: usize, k: usize) -> Linear {
        let rows = bytes(seed, n * k);
        let mut w = WeightsS8::new(&rows, n, k);
        let step = (3.0 / k as f64).sqrt() as f32 / 127.0;
        w.scales.fill(step);
        let exact = rows.iter().map(|v| f32::from(*v) * step).collect();
        Linear { w, bias: vec![0.01; n], signs: vec![0x5a5a; k / 16], exact }
    }
}

/// One transformer block of width 1024 or so with everything in it: norms, rotations, quantizations, rotary embedding, GELU,
/// residuals. Operations of products and attention.
pub fn block(ctx: Ctx, (frames, tokens, heads, d): HeadsSize, sees: Sees) -> Layer {
    let (mask, m, c) = (sees.mask(frames, tokens), frames * tokens, heads * d);
    let layers = [(3 * c, c), (c, c), (4 * c, c), (c, 4 * c)];
    let [qkv, proj, fc1, fc2] = std::array::from_fn(|i| Linear::new(10 + i as u64, layers[i].0, layers[i].1));
    let start = values(5, m * c);
    let table = RopeTable::new(&positions(tokens), d, 100.0, AngleRound::None);
    let mut scratch = Aligned::zeros(scratch_len_s8(&mask, heads, d, ctx.pool.threads()));
    let (mut wide, mut mixed) = (Aligned::zeros(m * 4 * c), Aligned::zeros(m * c));
    let (mut q, mut steps) = (Aligned::zeros(m * 4 * c), vec![0.0; m]);
    let mut x = Aligned::of(&start);
    let exact = block_f32(ctx, &start, [&qkv, &proj, &fc1, &fc2], (&table, mask, heads));
    let mut one = move |ctx: Ctx, x: &mut [f32]| {
        let mut linear = |l: &Linear, norm: bool, act: Act, residual: bool, x: &[f32], y: &mut [f32]| {
            let (n, k) = (l.w.n, l.w.k);
            let norm = norm.then_some(Norm { eps: 1e-6, affine: None });
            let before = Before { norm, rotation: Some(Rotation::new(k, &l.signs)) };
            let bytes = &mut q.get_mut()[..m * k];
            quantize(ctx, Mat::new(x, m, k), before, RowsS8Mut { m, k, data: bytes, scales: &mut steps });
            let ep = Epilogue { bias: Some(&l.bias), act, residual, ..Epilogue::default() };
            gemm_s8(ctx, RowsS8 { m, k, data: bytes, scales: &steps }, l.w.get(), ep, MatMut::new(y, m, n));
        };
        let wide = wide.get_mut();
        linear(&qkv, true, Act::None, false, x, &mut wide[..m * 3 * c]);
        let three = Mat::new(&wide[..m * 3 * c], m, 3 * c);
        let h = Heads { qkv: three, heads, norm: None, rope: Some(&table), rotation: None };
        attention_s8(ctx, h, mask, scratch.get_mut(), MatMut::new(mixed.get_mut(), m, c));
        linear(&proj, false, Act::None, true, mixed.get(), x);
        linear(&fc1, true, Act::Gelu, false, x, wide);
        linear(&fc2, false, Act::None, true, wide, x);
    };
    one(ctx, x.get_mut());
    let db = snr(&exact, x.get());
    assert!(db > 25.0, "{db:.1} dB between an int8 and an f32 block");
    let pairs = (0..frames).map(|a| mask.keys(a).len()).sum::<usize>() * tokens * tokens;
    Layer {
        kind: "block s8",
        size: format!("{m}x{c}, {heads} heads, {}", sees.name()),
        ops: 24.0 * (m * c * c) as f64 + 4.0 * (pairs * c) as f64,
        bytes: (12 * c * c + 8 * m * c) as f64,
        peak: Peak::S8,
        // From the same tokens each time: sums onto sums would grow without bound.
        run: Box::new(move |ctx| {
            x.get_mut().copy_from_slice(&start);
            one(ctx, x.get_mut());
        }),
    }
}

/// The same block in f32.
fn block_f32(
    ctx: Ctx,
    x: &[f32],
    [qkv, proj, fc1, fc2]: [&Linear; 4],
    (table, mask, heads): (&RopeTable, FrameMask, usize),
) -> Vec<f32> {
    let (m, c) = (mask.frames * mask.tokens, proj.w.n);
    let d = c / heads;
    let linear = |l: &Linear, norm: bool, act: Act, x: &[f32]| {
        let (n, k) = (l.w.n, l.w.k);
        let mut normed = x.to_vec();
        if norm {
            let (gain, offset) = (vec![1.0; k], vec![0.0; k]);
            layernorm::layernorm(ctx, Mat::new(x, m, k), &gain, &offset, 1e-6, MatMut::new(&mut normed, m, k));
        }
        rotate_rows(ctx, Rotation::new(k, &l.signs), MatMut::new(&mut normed, m, k));
        let mut panels = vec![0.0; panel_len(n, k)];
        pack_f32(&l.exact, n, k, &mut panels);
        let mut y = vec![0.0; m * n];
        let ep = Epilogue { bias: Some(&l.bias), act, ..Epilogue::default() };
        gemm(ctx, Mat::new(&normed, m, k), Panels::f32(&panels, n, k), ep, MatMut::new(&mut y, m, n));
        y
    };
    let mut x = x.to_vec();
    let mut three = linear(qkv, true, Act::None, &x);
    qk_norm_rope(ctx, MatMut::new(&mut three, m, 3 * c), heads, None, Some(table));
    let mut scratch = vec![0.0; scratch_len(&mask, heads, d, ctx.pool.threads())];
    let mut mixed = vec![0.0; m * c];
    let out = MatMut::new(&mut mixed, m, c);
    sf_ops::attention::attention(ctx, Mat::new(&three, m, 3 * c), heads, mask, &mut scratch, out);
    x.iter_mut().zip(linear(proj, false, Act::None, &mixed)).for_each(|(x, y)| *x += y);
    let hidden = linear(fc1, true, Act::Gelu, &x);
    x.iter_mut().zip(linear(fc2, false, Act::None, &hidden)).for_each(|(x, y)| *x += y);
    x
}

/// The list: a large transformer (4 frames of 217, 221 and 745 tokens, 1024 wide), small networks, convolutions, attention, whole
/// blocks, few rows, passes over memory. Made one at a time: weights of all of them would not fit the caches or small machines.
pub fn layers() -> Vec<Box<dyn Fn(Ctx) -> Layer>> {
    let mut list: Vec<Box<dyn Fn(Ctx) -> Layer>> = Vec::new();
    let large = [(1024, 3072), (1024, 1024), (1024, 4096), (4096, 1024), (1152, 3456)];
    let small = [(192, 192), (192, 576), (192, 768), (768, 192), (384, 384)];
    let products = [868, 884, 2980].iter().flat_map(|m| large.map(|(k, n)| (*m, k, n)));
    let products = products.chain(small.map(|(k, n)| (884, k, n)));
    let products = products.chain([(1956, 128, 384), (1956, 128, 512), (1956, 512, 128)]);
    for size in products.chain([1, 4, 16, 64].map(|m| (m, 1024, 1024))) {
        list.push(Box::new(move |ctx| product_s8(ctx, size, After::Bias)));
    }
    for size in [(868, 1024, 4096), (884, 192, 768), (1956, 128, 512)] {
        list.push(Box::new(move |ctx| product_s8(ctx, size, After::Gelu)));
    }
    for size in [(884, 192, 768), (1956, 128, 512), (868, 1024, 1024)] {
        list.push(Box::new(move |ctx| product_s8(ctx, size, After::Quantized)));
    }
    for size in [(868, 1024, 1024), (884, 192, 768)] {
        list.push(Box::new(move |ctx| linear_s8(ctx, size)));
    }
    for (frames, tokens, sees) in [(4, 217, Sees::OWN), (4, 217, Sees::ALL), (4, 745, Sees::OWN), (4, 745, Sees::ALL)] {
        list.push(Box::new(move |ctx| block(ctx, (frames, tokens, 16, 64), sees)));
    }
    for tokens in [221, 745] {
        for sees in [Sees::OWN, Sees::NEXT, Sees::ALL] {
            for int8 in [true, false] {
                list.push(Box::new(move |ctx| attention(ctx, (4, tokens, 16, 72), sees, int8)));
            }
        }
    }
    for size in [(868, 1024, 1024), (1956, 128, 384)] {
        for f16 in [false, true] {
            list.push(Box::new(move |ctx| product(ctx, size, f16)));
        }
    }
    let same = (3, 1, 1);
    let convs = [
        ((96, 144, 256), 256, same),
        ((160, 296, 256), 256, same),
        ((189, 259, 40), 32, same),
        ((189, 259, 32), 32, same),
        ((189, 259, 32), 44, same),
        ((378, 518, 3), 16, (3, 2, 1)),
    ];
    for size in convs {
        list.push(Box::new(move |ctx| conv_s8(ctx, size)));
        list.push(Box::new(move |ctx| conv_f16(ctx, size)));
    }
    list.push(Box::new(|ctx| quantize_rows(ctx, (868, 1024))));
    list.push(Box::new(|ctx| norm(ctx, (868, 1024))));
    list.push(Box::new(|ctx| upsample(ctx, (108, 148, 64))));
    list
}
