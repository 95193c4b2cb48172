//! [`Net`]: weights, the machine to run them on, and the linear layers and convolutions of every precision.
//!
//! An int8 layer quantizes its input rows (per token, after the norm in front and the rotation, in one pass) into
//! [`Rows`], then multiplies. One layer runs at a time, so one area serves all of them. An int8 convolution quantizes its
//! map band by band, in the pool's own memory.

use crate::arena::Arena;
use crate::model::{Linear, Model, Norm, PanelRef, VecRef, Weight};
use sf_formats::Result;
use sf_ops::conv::{self, Conv, ConvTranspose, conv_out};
use sf_ops::conv_s8::{self, ConvS8, ConvTransposeS8};
use sf_ops::cpu::Ctx;
use sf_ops::gemm::{Act, Epilogue, PanelsS8, RowsS8, RowsS8Mut, gemm, gemm_s8, gemm_s8_quantize, padded_k};
use sf_ops::hadamard::Rotation;
use sf_ops::mat::{Hwc, HwcMut, Mat, MatMut};
use sf_ops::quantize::{self, Before, quantize};
use std::cell::RefCell;

/// Quantized rows of the layer in progress.
#[derive(Debug)]
pub(crate) struct Rows(RefCell<Arena>);

/// Values of [`Rows`] for `m` rows of `k` inputs: four bytes each, then the scales from a new line on.
fn rows_len(m: usize, k: usize) -> [usize; 2] {
    [m * padded_k(k) / 4, m]
}

impl Rows {
    /// Room for `len` values, the largest [`Rows::len`] of all layers.
    pub(crate) fn new(len: usize) -> Result<Rows> {
        Ok(Rows(RefCell::new(Arena::new(len)?)))
    }

    /// Values that a layer on `m` rows needs: none unless it is int8.
    pub(crate) fn len(weight: &PanelRef, m: usize) -> usize {
        if weight.is_int8() { crate::arena::carved_len(rows_len(m, weight.k)) } else { 0 }
    }

    /// Values that two layers on `m` rows need, the first of which writes the quantized input of the second.
    pub(crate) fn len_of_pair(first: &PanelRef, second: &PanelRef, m: usize) -> usize {
        if is_pair(first, second) { crate::arena::carved_len(pair_len(m, first.k, second.k)) } else { 0 }
    }
}

/// Inputs and outputs of [`Rows`] for a pair of layers.
fn pair_len(m: usize, k: usize, n: usize) -> [usize; 4] {
    let ([a, b], [c, d]) = (rows_len(m, k), rows_len(m, n));
    [a, b, c, d]
}

/// Most outputs of the first of two layers that run as a pair: its weights are read once for every block of rows, and beyond this they
/// leave the caches in between.
const PAIR: usize = 2048;

/// Whether the outputs of one layer may be quantized for the next while they are in the cache.
pub(crate) fn is_pair(first: &PanelRef, second: &PanelRef) -> bool {
    first.is_int8() && second.is_int8() && first.n <= PAIR
}

/// Who looks at the input rows of layers, by the number of the weight's tensor.
pub(crate) type Seen<'a> = &'a dyn Fn(usize, &[f32]);

/// Weights and the machine to run them on.
#[derive(Clone, Copy)]
pub(crate) struct Net<'a> {
    pub(crate) ctx: Ctx<'a>,
    pub(crate) model: &'a Model,
    pub(crate) rows: &'a Rows,
    /// Who looks at the input rows of layers; the number is that of the weight's tensor.
    pub(crate) seen: Option<Seen<'a>>,
}

/// A convolution with its surroundings.
#[derive(Clone, Copy)]
pub(crate) struct ConvLayer<'a> {
    pub(crate) weights: &'a Linear,
    pub(crate) kernel: usize,
    pub(crate) stride: usize,
    pub(crate) act: Act,
    pub(crate) relu_input: Act,
}

impl<'a> ConvLayer<'a> {
    /// Stride 1, nothing before or after.
    pub(crate) fn same(weights: &'a Linear, kernel: usize) -> ConvLayer<'a> {
        ConvLayer { weights, kernel, stride: 1, act: Act::None, relu_input: Act::None }
    }

    /// Of an input that is rectified on the fly, or is already.
    pub(crate) fn on_rectified(self) -> ConvLayer<'a> {
        ConvLayer { relu_input: Act::Relu, ..self }
    }
}

/// Windows of one image that are shown, at most: neighbours say much the same.
const WINDOWS: usize = 1024;

/// Shows windows of a convolution's input, `[ky][kx][in]`, rectified where the layer does that: those of every third output line and
/// column, or farther apart in large images. Three, because patches are 14 or 7 pixels wide: every place in a patch comes in turn.
fn windows(x: Hwc, (kernel, stride, pad): (usize, usize, usize), relu: Act, seen: &dyn Fn(&[f32])) {
    let (oh, ow) = (conv_out(x.h, kernel, stride, pad), conv_out(x.w, kernel, stride, pad));
    let step = (3..).step_by(2).find(|s| oh.div_ceil(*s) * ow.div_ceil(*s) <= WINDOWS).unwrap_or(3);
    let mut row = vec![0.0; kernel * kernel * x.c];
    for oy in (0..oh).step_by(step) {
        for ox in (0..ow).step_by(step) {
            row.fill(0.0);
            for (tap, to) in row.chunks_exact_mut(x.c).enumerate() {
                let (y, xx) = (oy * stride + tap / kernel, ox * stride + tap % kernel);
                if (pad..x.h + pad).contains(&y) && (pad..x.w + pad).contains(&xx) {
                    to.copy_from_slice(x.pixel(y - pad, xx - pad));
                }
            }
            if relu == Act::Relu {
                row.iter_mut().for_each(|v| *v = v.max(0.0));
            }
            seen(&row);
        }
    }
}

impl Net<'_> {
    /// out = act(conv(x)) + residual, padded by half the kernel.
    pub(crate) fn conv(&self, layer: ConvLayer, x: Hwc, residual: Option<Hwc>, out: HwcMut) {
        let ConvLayer { weights, kernel, stride, act, relu_input } = layer;
        let bias = weights.bias.map(|b| self.model.values(b));
        let pad = kernel / 2;
        if let Some(seen) = self.seen {
            windows(x, (kernel, stride, pad), relu_input, &|row| seen(weights.weight.tensor, row));
        }
        match self.model.weight(&weights.weight) {
            Weight::Float(weight) => {
                conv::conv2d(self.ctx, x, &Conv { weight, bias, kernel, stride, pad, relu_input, act }, residual, out);
            }
            Weight::Int8(weight, _) => {
                let conv = ConvS8 { weight, bias, kernel, stride, pad, relu_input, act, relu_sum: false };
                conv_s8::conv2d_s8(self.ctx, x, &conv, residual, out);
            }
        }
    }

    /// Transposed convolution with stride = kernel.
    pub(crate) fn up(&self, weights: &Linear, kernel: usize, x: Hwc, out: HwcMut) {
        let bias = weights.bias.map(|b| self.model.values(b));
        match self.model.weight(&weights.weight) {
            Weight::Float(weight) => {
                conv::conv_transpose(self.ctx, x, &ConvTranspose { weight, bias, kernel }, out);
            }
            Weight::Int8(weight, _) => {
                conv_s8::conv_transpose_s8(self.ctx, x, &ConvTransposeS8 { weight, bias, kernel }, out);
            }
        }
    }

    /// out = act(x W^T + b).
    pub(crate) fn linear(&self, l: &Linear, act: Act, x: Mat, out: MatMut) {
        self.layer(l, None, x, Epilogue { act, ..Epilogue::default() }, out);
    }

    /// out += gamma * act(x W^T + b).
    pub(crate) fn linear_onto(&self, l: &Linear, act: Act, gamma: Option<VecRef>, x: Mat, out: MatMut) {
        let gamma = gamma.map(|g| self.model.values(g));
        self.layer(l, None, x, Epilogue { act, gamma, residual: true, ..Epilogue::default() }, out);
    }

    /// out = act(norm(x) W^T + b). `normed` has as many values as x, or none for an int8 layer, which needs no
    /// normed tokens.
    pub(crate) fn normed_linear(&self, n: &Norm, l: &Linear, act: Act, (x, normed): (Mat, &mut [f32]), out: MatMut) {
        let ep = Epilogue { act, ..Epilogue::default() };
        if l.weight.is_int8() {
            self.layer(l, Some(n), x, ep, out);
        } else {
            let normed = &mut normed[..x.rows * x.cols];
            self.norm(n, x, MatMut::new(normed, x.rows, x.cols));
            self.layer(l, None, Mat::new(normed, x.rows, x.cols), ep, out);
        }
    }

    /// out = norm(x).
    pub(crate) fn norm(&self, n: &Norm, x: Mat, out: MatMut) {
        sf_ops::layernorm::layernorm(self.ctx, x, self.model.values(n.gain), self.model.values(n.offset), n.eps, out);
    }

    /// A layer of any precision; the norm in front only for int8.
    fn layer(&self, l: &Linear, norm: Option<&Norm>, x: Mat, ep: Epilogue, out: MatMut) {
        let ep = Epilogue { bias: l.bias.map(|b| self.model.values(b)), ..ep };
        if let Some(seen) = self.seen {
            (0..x.rows).for_each(|r| seen(l.weight.tensor, &x.data[r * x.stride..][..x.cols]));
        }
        match self.model.weight(&l.weight) {
            Weight::Float(panels) => {
                assert!(norm.is_none(), "a norm fused with a float layer");
                gemm(self.ctx, x, panels, ep, out);
            }
            Weight::Int8(panels, rotation) => self.int8((panels, rotation), norm, x, ep, out),
        }
    }

    /// x += gamma * second(act(first(norm(x)))); the values between the layers are quantized while they are in the cache and never
    /// written. False, with nothing done, where the layers are no pair ([`is_pair`]) or somebody wants to see what they read.
    pub(crate) fn pair_onto(
        &self,
        norm: &Norm,
        (first, act): (&Linear, Act),
        (second, gamma): (&Linear, Option<VecRef>),
        x: &mut [f32],
    ) -> bool {
        let (Weight::Int8(w1, r1), Weight::Int8(w2, r2)) =
            (self.model.weight(&first.weight), self.model.weight(&second.weight))
        else {
            return false;
        };
        if !is_pair(&first.weight, &second.weight) || self.seen.is_some() {
            return false;
        }
        let (k, n) = (first.weight.k, first.weight.n);
        let m = x.len() / k;
        let mut area = self.rows.0.borrow_mut();
        let [read, read_scales, made, made_scales] = crate::arena::carve(area.all(), pair_len(m, k, n));
        let (read, made): (&mut [i8], &mut [i8]) = (bytemuck::cast_slice_mut(read), bytemuck::cast_slice_mut(made));
        let before = Before { norm: Some(self.quantized_norm(norm)), rotation: r1 };
        quantize(self.ctx, Mat::new(x, m, k), before, RowsS8Mut { m, k, data: read, scales: read_scales });
        let bias = |l: &Linear| l.bias.map(|b| self.model.values(b));
        let ep = Epilogue { bias: bias(first), act, ..Epilogue::default() };
        let rows = RowsS8 { m, k, data: read, scales: read_scales };
        let before = Before { norm: None, rotation: r2 };
        gemm_s8_quantize(self.ctx, rows, w1, ep, before, RowsS8Mut { m, k: n, data: made, scales: made_scales });
        let gamma = gamma.map(|g| self.model.values(g));
        let ep = Epilogue { bias: bias(second), gamma, residual: true, ..Epilogue::default() };
        gemm_s8(self.ctx, RowsS8 { m, k: n, data: made, scales: made_scales }, w2, ep, MatMut::new(x, m, k));
        true
    }

    fn quantized_norm(&self, n: &Norm) -> quantize::Norm<'_> {
        let affine = (!n.plain).then(|| (self.model.values(n.gain), self.model.values(n.offset)));
        quantize::Norm { affine, eps: n.eps }
    }

    fn int8(
        &self,
        (w, rotation): (PanelsS8, Option<Rotation>),
        norm: Option<&Norm>,
        x: Mat,
        ep: Epilogue,
        out: MatMut,
    ) {
        let norm = norm.map(|n| self.quantized_norm(n));
        let mut area = self.rows.0.borrow_mut();
        let [bytes, scales] = crate::arena::carve(area.all(), rows_len(x.rows, x.cols));
        let bytes: &mut [i8] = bytemuck::cast_slice_mut(bytes);
        let (m, k) = (x.rows, x.cols);
        quantize(self.ctx, x, Before { norm, rotation }, RowsS8Mut { m, k, data: bytes, scales });
        gemm_s8(self.ctx, RowsS8 { m, k, data: bytes, scales }, w, ep, out);
    }
}
