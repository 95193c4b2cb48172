//! Convolution and transposed convolution through the matrix panels.
//!
//! Images are channels-last. A convolution is a matrix product whose row for output pixel (y, x) is the
//! input window in the order `[ky][kx][in]`. Windows that overlap are read in place from a padded map of a band of lines
//! (`conv_map.rs`); others are gathered while the rows are packed for the tile. No column buffer exists in either case. A
//! transposed convolution with stride = kernel is one product whose outputs `[ky][kx][out]` are scattered while they are stored.

use crate::conv_map::{Shape, Step, TILES, sweep};
use crate::cpu::{Ctx, Kernels};
use crate::gemm::ahead::Ahead;
use crate::gemm::finish::{Columns, Plus};
use crate::gemm::pack::{Change, MAX_MR, RowPack};
use crate::gemm::tile::Tile;
use crate::gemm::{
    Act, Finished, KC, MAX_NV, NR, Out, PanelData, Panels, Product, Rows, Sink, Source, WeightType, finish_tile,
    product,
};
use crate::mat::{Hwc, HwcMut};
use crate::opclock::{self, Op, Work};
use crate::par::SharedMut;

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

/// Values of the map of a band: 512 KiB.
const BUDGET: usize = 1 << 17;
/// Fewest lines of a band.
const FEWEST: usize = 2;
/// Most inputs of a window whose f16 weights are widened for a band: a group of panels is then 72 KiB of f32.
const WIDEN: usize = 576;

/// Values of a group of panels that is widened.
fn wide(k: usize) -> usize {
    if k <= WIDEN { k * MAX_NV * NR } else { 0 }
}

fn shape((h, w, c): (usize, usize, usize), kernel: usize, stride: usize, pad: usize) -> Shape {
    let (oh, ow) = (conv_out(h, kernel, stride, pad), conv_out(w, kernel, stride, pad));
    Shape { h, w, c, kernel, stride, pad, oh, ow }
}

/// Most f32 values of working memory that each thread of the pool keeps after [`conv2d`] with windows that overlap, `x` being (height,
/// width, channels) of the input, whatever the kernel; for memory plans. Up to 512 KiB of map (more only where two lines of output
/// need more) beside at most 96 KiB. For other windows see [`crate::gemm::working_memory`].
pub fn working_memory_conv(x: (usize, usize, usize), kernel: usize, stride: usize, pad: usize) -> usize {
    let shape = shape(x, kernel, stride, pad);
    if shape.oh * shape.ow == 0 {
        return 0;
    }
    shape.map(shape.band(BUDGET, FEWEST)) + TILES * MAX_MR * MAX_NV * NR + wide(kernel * kernel * x.2)
}

/// Convolution whose windows overlap: bands of a padded map, windows in place.
fn overlapping(ctx: Ctx, x: Hwc, conv: &Conv, p: &Product) {
    let weight = conv.weight;
    let shape = shape((x.h, x.w, x.c), conv.kernel, conv.stride, conv.pad);
    if shape.oh * shape.ow * weight.n == 0 {
        return;
    }
    let kernel = ctx.kernels.gemm(weight.data.weights());
    let band = shape.band(BUDGET, FEWEST);
    let wide = if kernel.weights == WeightType::F16 { wide(weight.k) } else { 0 };
    let scratch = shape.map(band) + TILES * kernel.mr * kernel.nr + wide;
    let most = working_memory_conv((x.h, x.w, x.c), conv.kernel, conv.stride, conv.pad);
    assert!(scratch <= most, "{scratch} values of working memory, {most} announced");
    ctx.pool.reserve_scratch(scratch);
    ctx.pool.run(shape.oh.div_ceil(band), &|task, worker| {
        let rows = task * band..((task + 1) * band).min(shape.oh);
        ctx.pool.with_scratch(worker, scratch, |memory| {
            let (wide, memory) = memory.split_at_mut(wide);
            let (acc, map) = memory.split_at_mut(TILES * kernel.mr * kernel.nr);
            fill(ctx, x, &shape, conv.relu_input == Act::Relu, rows.start, &mut map[..shape.map(rows.len())]);
            multiply(ctx, p, &shape, rows, (map, acc, wide));
        });
    });
}

/// The input lines under a band to its map, zeros around.
fn fill(ctx: Ctx, x: Hwc, shape: &Shape, relu: bool, first: usize, map: &mut [f32]) {
    let (side, inside) = (shape.pad * shape.c, shape.w * shape.c);
    for (j, line) in map.chunks_mut(shape.line()).enumerate() {
        match shape.source(first, j) {
            // What is behind the last line is read but not used.
            Some(y) if line.len() == shape.line() => {
                line[..side].fill(0.0);
                line[side..][..inside].copy_from_slice(&x.data[y * inside..][..inside]);
                line[side + inside..].fill(0.0);
            }
            _ => line.fill(0.0),
        }
    }
    if relu {
        ctx.kernels.map(crate::activation::Map::Relu, map);
    }
}

/// Every output of a band.
fn multiply(
    ctx: Ctx,
    p: &Product,
    shape: &Shape,
    rows: std::ops::Range<usize>,
    (map, acc, wide): (&[f32], &mut [f32], &mut [f32]),
) {
    let Panels { n, k, data } = p.w;
    let kernel = ctx.kernels.gemm(data.weights());
    let (mr, nv) = (kernel.mr, kernel.nr / NR);
    for panel in (0..n.div_ceil(NR)).step_by(nv) {
        let panels = nv.min(n.div_ceil(NR) - panel);
        let columns = Columns::of(n, (panel, panels), p.bias, None);
        let w = match data.from(panel * k * NR) {
            // Once for all tiles of the band.
            PanelData::F16(w) if !wide.is_empty() => {
                ctx.kernels.widen(&w[..panels * k * NR], wide);
                PanelData::F32(&*wide)
            }
            w => w,
        };
        let near = Ahead::nothing(map);
        let ahead_of = |step: &Step| match (&p.out, step.done) {
            (Out::Rows { out, stride, .. }, Some(row)) => near.with_outputs(out.at(row * stride + panel * NR), *stride),
            _ => near,
        };
        sweep(shape, rows.clone(), mr, KC, |step: Step| {
            let acc = &mut acc[step.tile * mr * kernel.nr..][..mr * NR * panels];
            let tile = Tile {
                rows: kernel.fit(step.pixels),
                panels,
                k: step.run,
                a: &map[step.at..],
                w: w.from(step.k * NR),
                w_stride: k * NR,
                start: step.start,
                acc: &mut *acc,
                acc_stride: mr * NR,
                ahead: ahead_of(&step),
            };
            ctx.kernels.windows(tile, step.windows);
            if let Some(row) = step.done {
                let to = Finished { row, rows: step.pixels, panel, panels };
                finish_tile(ctx.kernels, p, to, (&columns, acc, mr * NR));
            }
        });
    }
}

/// Rows of a product that are windows of an image.
struct Windows<'a> {
    x: Hwc<'a>,
    ow: usize,
    kernel: usize,
    stride: usize,
    pad: usize,
    relu: bool,
}

impl Source for Windows<'_> {
    fn pack(&self, kernels: &Kernels, first: usize, rows: usize, width: usize, out: &mut [f32]) {
        let Windows { x, ow, kernel, stride, pad, relu } = *self;
        let change = if relu { Change::Relu } else { Change::Keep };
        // Without padding a line of the kernel is one run of neighbours in memory; with it, each pixel may be
        // inside or outside.
        let (steps, run) = if pad == 0 { (1, kernel * x.c) } else { (kernel, x.c) };
        // Corner of each window in the padded image; divisions are dear, so once per row and not per tap.
        let corner: [(usize, usize); MAX_MR] =
            std::array::from_fn(|r| ((first + r) / ow * stride, (first + r) % ow * stride));
        for ky in 0..kernel {
            for kx in 0..steps {
                let mut from: [&[f32]; MAX_MR] = [&[]; MAX_MR];
                for (r, from) in from.iter_mut().enumerate().take(rows) {
                    let (py, px) = (corner[r].0 + ky, corner[r].1 + kx);
                    if py >= pad && py - pad < x.h && px >= pad && px - pad < x.w {
                        *from = &x.data[((py - pad) * x.w + px - pad) * x.c..];
                    }
                }
                let out = &mut out[(ky * kernel + kx) * x.c * width..];
                kernels.pack(RowPack { from, k: run, width, change, out });
            }
        }
    }
}

/// `x` `[h, w, in]` -> `out` `[conv_out(h), conv_out(w), out]`, zero padding; then `residual + output` when there is
/// a residual, of the output's size.
pub fn conv2d(ctx: Ctx, x: Hwc, conv: &Conv, residual: Option<Hwc>, out: HwcMut) {
    let Conv { weight, kernel, stride, pad, .. } = *conv;
    let weight = weight.checked();
    assert!(stride > 0, "a convolution of stride 0");
    assert_eq!(weight.k, kernel * kernel * x.c, "inputs of a {kernel} x {kernel} convolution over {} channels", x.c);
    let (oh, ow) = (conv_out(x.h, kernel, stride, pad), conv_out(x.w, kernel, stride, pad));
    assert_eq!((out.h, out.w, out.c), (oh, ow, weight.n), "output of a convolution");
    assert!(conv.bias.is_none_or(|b| b.len() == weight.n), "bias of {} outputs", weight.n);
    assert!(conv.relu_input != Act::Gelu, "only relu is applied to inputs on the fly");
    if let Some(r) = residual {
        assert_eq!((r.h, r.w, r.c), (oh, ow, weight.n), "residual of a convolution");
    }
    let plus = residual.map_or(Plus::Nothing, |r| Plus::Other(r.data));
    let _span = opclock::span(Op::Conv, || Work::product(oh * ow, &weight, x.h * x.w * x.c));
    let source = Windows { x, ow, kernel, stride, pad, relu: conv.relu_input == Act::Relu };
    let p = Product {
        m: oh * ow,
        source: &source,
        w: weight,
        bias: conv.bias,
        act: conv.act,
        gamma: None,
        out: Out::Rows { out: SharedMut::new(out.data), stride: weight.n, plus },
    };
    if kernel > stride { overlapping(ctx, x, conv, &p) } else { product(ctx, &p) }
}

/// Outputs `[ky][kx][out]` of input pixel (y, x) go to pixels (y k + ky, x k + kx).
pub(crate) struct Scatter<'a> {
    pub out: SharedMut<'a, f32>,
    /// Input width.
    pub w: usize,
    pub kernel: usize,
    /// Outputs of one line of the kernel: kernel * out.
    pub line: usize,
}

impl Sink for Scatter<'_> {
    fn put(&self, row: usize, col: usize, cols: usize, values: &[f32]) {
        for (r, v) in values.as_chunks::<NR>().0.iter().enumerate() {
            let (y, x) = ((row + r) / self.w, (row + r) % self.w);
            let mut c = 0;
            // A run of columns may cross from one line of the kernel to the next.
            while c < cols {
                let (ky, within) = ((col + c) / self.line, (col + c) % self.line);
                let len = (self.line - within).min(cols - c);
                let at = ((y * self.kernel + ky) * self.w + x) * self.line + within;
                // SAFETY: the map from (row, column) to outputs is one to one and each is put once.
                #[allow(unsafe_code)]
                let out = unsafe { self.out.slice(at..at + len) };
                out.copy_from_slice(&v[c..c + len]);
                c += len;
            }
        }
    }
}

/// `x` `[h, w, in]` -> `out` `[h * kernel, w * kernel, out]`.
pub fn conv_transpose(ctx: Ctx, x: Hwc, conv: &ConvTranspose, out: HwcMut) {
    let ConvTranspose { weight, bias, kernel } = *conv;
    let weight = weight.checked();
    assert_eq!(weight.k, x.c, "inputs of a transposed convolution");
    assert_eq!(weight.n, kernel * kernel * out.c, "outputs of a {kernel} x {kernel} transposed convolution");
    assert_eq!((out.h, out.w), (x.h * kernel, x.w * kernel), "size of a transposed convolution");
    assert!(bias.is_none_or(|b| b.len() == out.c), "bias of {} outputs", out.c);
    let (m, act) = (x.h * x.w, Act::None);
    let source = Rows(x.as_mat());
    let _span = opclock::span(Op::Conv, || Work::product(m, &weight, m * x.c));
    let sink = Scatter { w: x.w, kernel, line: kernel * out.c, out: SharedMut::new(out.data) };
    product(ctx, &Product { m, source: &source, w: weight, bias, act, gamma: None, out: Out::Sink(&sink) });
}
