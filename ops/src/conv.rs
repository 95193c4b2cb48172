//! Convolution and transposed convolution through the matrix panels.
//!
//! Images are channels-last. A convolution is a matrix product whose row for output pixel (y, x) is the
//! input window in the order `[ky][kx][in]`; windows are gathered while the rows are packed for the tile, so
//! no column buffer exists. A transposed convolution with stride = kernel is one product whose
//! outputs `[ky][kx][out]` are scattered while they are stored.

use crate::cpu::Ctx;
use crate::gemm::{Act, Epilogue, Panels, gemm};
use crate::mat::{Hwc, HwcMut, Mat, MatMut};

/// A convolution layer.
#[derive(Clone, Copy, Debug)]
pub struct Conv<'a> {
    /// n = out, k = kernel * kernel * in, inputs in the order `[ky][kx][in]`.
    pub weight: Panels<'a>,
    /// `[out]`.
    pub bias: Option<&'a [f32]>,
    /// Side of the square kernel.
    pub kernel: usize,
    /// Step between outputs.
    pub stride: usize,
    /// Zeros around the input.
    pub pad: usize,
    /// Applied to the input on the fly: `None` or `Relu`.
    pub relu_input: Act,
    /// Applied to the sum with the bias.
    pub act: Act,
}

/// A transposed convolution layer with stride = kernel.
#[derive(Clone, Copy, Debug)]
pub struct ConvTranspose<'a> {
    /// n = kernel * kernel * out in the order `[ky][kx][out]`, k = in.
    pub weight: Panels<'a>,
    /// `[out]`.
    pub bias: Option<&'a [f32]>,
    /// Side of the square kernel = stride.
    pub kernel: usize,
}

/// Outputs along one side: floor((size + 2 pad - kernel) / stride) + 1, or 0 when the kernel does not fit.
pub fn conv_out(size: usize, kernel: usize, stride: usize, pad: usize) -> usize {
    (size + 2 * pad).checked_sub(kernel).map_or(0, |room| room / stride + 1)
}

/// Checkpoint order `[out, in, k, k]` to the row order `[out, k*k*in]` of the panels.
pub fn conv_rows(weight: &[f32], out: usize, inp: usize, kernel: usize) -> Vec<f32> {
    let area = kernel * kernel;
    assert_eq!(weight.len(), out * inp * area, "{out} x {inp} x {kernel} x {kernel} weights");
    let mut rows = Vec::with_capacity(weight.len());
    for o in 0..out {
        for t in 0..area {
            rows.extend((0..inp).map(|i| weight[(o * inp + i) * area + t]));
        }
    }
    rows
}

/// Checkpoint order `[in, out, k, k]` to the row order `[k*k*out, in]` of the panels.
pub fn conv_transpose_rows(weight: &[f32], inp: usize, out: usize, kernel: usize) -> Vec<f32> {
    let area = kernel * kernel;
    assert_eq!(weight.len(), out * inp * area, "{inp} x {out} x {kernel} x {kernel} weights");
    let mut rows = Vec::with_capacity(weight.len());
    for t in 0..area {
        for o in 0..out {
            rows.extend((0..inp).map(|i| weight[(i * out + o) * area + t]));
        }
    }
    rows
}

/// `x` `[h, w, in]` -> `out` `[conv_out(h), conv_out(w), out]`, zero padding; then `out + residual` when there is one
/// of the output's size.
pub fn conv2d(ctx: Ctx, x: Hwc, conv: &Conv, residual: Option<Hwc>, out: HwcMut) {
    let Conv { weight, kernel, stride, pad, .. } = *conv;
    let k = kernel * kernel * x.c;
    let mut cols = vec![0.0f32; out.h * out.w * k];
    for oy in 0..out.h {
        for ox in 0..out.w {
            for t in 0..kernel * kernel {
                let (y, xx) = (oy * stride + t / kernel, ox * stride + t % kernel);
                if y < pad || xx < pad || y - pad >= x.h || xx - pad >= x.w {
                    continue;
                }
                for (i, v) in x.pixel(y - pad, xx - pad).iter().enumerate() {
                    cols[(oy * out.w + ox) * k + t * x.c + i] = crate::reference::activate(*v, conv.relu_input);
                }
            }
        }
    }
    let HwcMut { data, h, w, c } = out;
    let ep = Epilogue { bias: conv.bias, act: conv.act, ..Epilogue::default() };
    gemm(ctx, Mat::new(&cols, h * w, k), weight, ep, MatMut::new(data, h * w, c));
    if let Some(r) = residual {
        crate::elementwise::add_assign(ctx, data, r.data);
    }
}

/// `x` `[h, w, in]` -> `out` `[h * kernel, w * kernel, out]`.
pub fn conv_transpose(ctx: Ctx, x: Hwc, conv: &ConvTranspose, out: HwcMut) {
    let n = conv.weight.n;
    let c = out.c;
    let kernel = conv.kernel;
    let mut y = vec![0.0f32; x.h * x.w * n];
    gemm(ctx, x.as_mat(), conv.weight, Epilogue::default(), MatMut::new(&mut y, x.h * x.w, n));
    for oy in 0..out.h {
        for ox in 0..out.w {
            for o in 0..c {
                let from = y[((oy / kernel) * x.w + ox / kernel) * n + ((oy % kernel) * kernel + ox % kernel) * c + o];
                out.data[(oy * out.w + ox) * c + o] = from + conv.bias.map_or(0.0, |b| b[o]);
            }
        }
    }
}
