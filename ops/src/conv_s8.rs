//! Convolution with int8 weights: the map is quantized band by band, sums are exact, the epilogue is one.
//!
//! real input = integer * scale. A 3 x 3 window mixes pixels, so all pixels that a window touches need one scale:
//!
//! | kernel | scale of the input |
//! |---|---|
//! | windows that overlap (kernel > stride) | one per band of output lines, from the input lines under it ([`band_lines`]) |
//! | windows that do not (1 x 1, patches, transposed) | one per window |
//!
//! It is max |x| / 127 over those values, with the rules of [`crate::quantize`]: zeros give scale 0, a value that is not finite gives
//! scale NaN and so NaN outputs. A rectified input has no negative values, so its integers run from 0 to 255 and the scale is max / 255:
//! they lie as -128 to 127 in the map, and sums start at 128 times the weights' sum (x86 takes them as unsigned bytes and starts at
//! zero). Bands follow from the shape alone, so results depend neither on threads nor on the instruction set. In the map a pixel's
//! channels are padded to four; the weights there are zeros.
//!
//! y = act(fma(f32(sum), input scale * output scale, bias)); y = residual + y; rectified again with `relu_sum`.

use crate::conv::conv_out;
use crate::conv_map::{Shape, Step, TILES, sweep};
use crate::cpu::Ctx;
use crate::gemm::ahead::Ahead;
use crate::gemm::finish::Plus;
use crate::gemm::pack::{MAX_MR, NR};
use crate::gemm::s8::finish::{ColumnsS8, FinishS8};
use crate::gemm::s8::pack::{PanelsS8, QUAD, STEP, padded_k};
use crate::gemm::s8::table::GemmS8Kernel;
use crate::gemm::s8::tile::{MAX_NV, TileS8};
use crate::gemm::s8::{STEPS, starts};
use crate::gemm::{Act, Sink};
use crate::mat::{Hwc, HwcMut};
use crate::opclock::{self, Op, Work};
use crate::par::SharedMut;
use crate::quantize::{MapOut, MapScale, ToMap, inverse_and_scale, larger, zero_of};
use std::ops::Range;

/// A convolution layer with int8 weights.
#[derive(Clone, Copy, Debug)]
pub struct ConvS8<'a> {
    /// n = out, k = kernel * kernel * in, inputs in the order `[ky][kx][in]` with `in` padded to four by zeros
    /// ([`conv_rows_s8`]).
    pub weight: PanelsS8<'a>,
    /// `[out]`.
    pub bias: Option<&'a [f32]>,
    /// Side of the square kernel.
    pub kernel: usize,
    /// Step between outputs.
    pub stride: usize,
    /// Zeros around the input.
    pub pad: usize,
    /// Applied to the input on the fly: `None` or `Relu`. An input without negative values should say `Relu` too: its steps are
    /// then half as wide.
    pub relu_input: Act,
    /// Applied to the sum with the bias.
    pub act: Act,
    /// Rectifies after the residual is added.
    pub relu_sum: bool,
}

/// A transposed convolution layer with stride = kernel and int8 weights.
#[derive(Clone, Copy, Debug)]
pub struct ConvTransposeS8<'a> {
    /// n = kernel * kernel * out in the order `[ky][kx][out]`, k = in.
    pub weight: PanelsS8<'a>,
    /// `[out]`.
    pub bias: Option<&'a [f32]>,
    /// Side of the square kernel = stride.
    pub kernel: usize,
}

/// Checkpoint order `[out, in, k, k]` of quantized weights to the row order `[out, k*k*padded in]` of the panels; values of
/// padding are 0.
pub fn conv_rows_s8(weight: &[i8], out: usize, inp: usize, kernel: usize) -> Vec<i8> {
    let area = kernel * kernel;
    assert_eq!(weight.len(), out * inp * area, "{out} x {inp} x {kernel} x {kernel} weights");
    let mut rows = Vec::with_capacity(out * area * padded_k(inp));
    for o in 0..out {
        for t in 0..area {
            rows.extend((0..inp).map(|i| weight[(o * inp + i) * area + t]));
            rows.resize(rows.len().next_multiple_of(QUAD), 0);
        }
    }
    rows
}

/// Values of the map of a band: 256 KiB of bytes.
const BUDGET: usize = 1 << 18;
/// Fewest lines of a band: half of a 3 x 3 convolution's lines are then quantized twice.
const FEWEST: usize = 4;

/// Output lines that share one input scale where windows overlap: as many as keep the quantized lines under them below 256 KiB, from 4 to
/// 16, in even shares. `x` is (height, width, channels) of the input.
pub fn band_lines(x: (usize, usize, usize), kernel: usize, stride: usize, pad: usize) -> usize {
    shape(x, kernel, stride, pad).band(BUDGET, FEWEST)
}

/// Most f32-sized values of working memory that each thread of the pool keeps after [`conv2d_s8`] with these sizes, whatever the
/// kernel; for memory plans. Up to 512 KiB of map (more only where four lines need more) beside some 30 KiB.
pub fn working_memory_conv_s8(x: (usize, usize, usize), kernel: usize, stride: usize, pad: usize) -> usize {
    let shape = shape(x, kernel, stride, pad);
    if shape.oh * shape.ow == 0 {
        return 0;
    }
    let rows = shape.band(BUDGET, FEWEST);
    // Sixteen-bit maps are the largest.
    shape.map(rows).div_ceil(2).next_multiple_of(2) + rows * shape.ow + TILES * MAX_MR * MAX_NV * NR + 2 * LINE
}

/// f32-sized values of a cache line.
const LINE: usize = 16;

fn shape((h, w, c): (usize, usize, usize), kernel: usize, stride: usize, pad: usize) -> Shape {
    let (oh, ow) = (conv_out(h, kernel, stride, pad), conv_out(w, kernel, stride, pad));
    Shape { h, w, c: padded_k(c), kernel, stride, pad, oh, ow }
}

/// Where finished tiles go.
enum Out<'a> {
    /// `[oh, ow, out]`.
    Image { out: SharedMut<'a, f32>, residual: Option<&'a [f32]> },
    /// Through a sink, panel by panel.
    Sink(&'a dyn Sink),
    /// The sums as they are, `[oh, ow, out]`.
    Sums(SharedMut<'a, i32>),
}

/// `x` `[h, w, in]` -> `out` `[conv_out(h), conv_out(w), out]`, zero padding; then `residual + output` when there is a residual, of the
/// output's size.
pub fn conv2d_s8(ctx: Ctx, x: Hwc, conv: &ConvS8, residual: Option<Hwc>, out: HwcMut) {
    let (oh, ow) = sizes(x, conv);
    assert_eq!((out.h, out.w, out.c), (oh, ow, conv.weight.n), "output of a convolution");
    if let Some(r) = residual {
        assert_eq!((r.h, r.w, r.c), (oh, ow, conv.weight.n), "residual of a convolution");
    }
    run(ctx, x, conv, &Out::Image { out: SharedMut::new(out.data), residual: residual.map(|r| r.data) });
}

/// The exact sums of [`conv2d_s8`], `[oh, ow, out]`: what every kernel must agree on.
pub fn conv2d_s8_sums(ctx: Ctx, x: Hwc, conv: &ConvS8, out: &mut [i32]) {
    let (oh, ow) = sizes(x, conv);
    assert_eq!(out.len(), oh * ow * conv.weight.n, "output of a convolution");
    run(ctx, x, conv, &Out::Sums(SharedMut::new(out)));
}

/// `x` `[h, w, in]` -> `out` `[h * kernel, w * kernel, out]`; every input pixel has its own scale.
pub fn conv_transpose_s8(ctx: Ctx, x: Hwc, conv: &ConvTransposeS8, out: HwcMut) {
    let ConvTransposeS8 { weight, bias, kernel } = *conv;
    assert_eq!(weight.k, x.c, "inputs of a transposed convolution");
    assert_eq!(weight.n, kernel * kernel * out.c, "outputs of a {kernel} x {kernel} transposed convolution");
    assert_eq!((out.h, out.w), (x.h * kernel, x.w * kernel), "size of a transposed convolution");
    assert!(bias.is_none_or(|b| b.len() == out.c), "bias of {} outputs", out.c);
    let pixels = ConvS8 {
        weight: PanelsS8 { k: padded_k(weight.k), ..weight },
        bias,
        kernel: 1,
        stride: 1,
        pad: 0,
        relu_input: Act::None,
        act: Act::None,
        relu_sum: false,
    };
    let sink = crate::conv::Scatter { w: x.w, kernel, line: kernel * out.c, out: SharedMut::new(out.data) };
    run(ctx, x, &pixels, &Out::Sink(&sink));
}

/// Checks a layer; the size of its output.
fn sizes(x: Hwc, conv: &ConvS8) -> (usize, usize) {
    let ConvS8 { weight, kernel, stride, pad, bias, relu_input, .. } = *conv;
    assert!(stride > 0 && kernel > 0, "a convolution of kernel {kernel}, stride {stride}");
    let k = kernel * kernel * padded_k(x.c);
    assert_eq!(weight.k, k, "inputs of a {kernel} x {kernel} int8 convolution over {} channels", x.c);
    assert!(bias.is_none_or(|b| b.len() == weight.n), "bias of {} outputs", weight.n);
    assert!(relu_input != Act::Gelu, "only relu is applied to inputs on the fly");
    (conv_out(x.h, kernel, stride, pad), conv_out(x.w, kernel, stride, pad))
}

/// One layer over one image.
struct Layer<'a> {
    ctx: Ctx<'a>,
    kernel: &'static GemmS8Kernel,
    x: Hwc<'a>,
    shape: Shape,
    weight: PanelsS8<'a>,
    conv: &'a ConvS8<'a>,
}

fn run(ctx: Ctx, x: Hwc, conv: &ConvS8, out: &Out) {
    let weight = conv.weight.checked();
    let shape = shape((x.h, x.w, x.c), conv.kernel, conv.stride, conv.pad);
    if shape.oh * shape.ow * weight.n == 0 {
        return;
    }
    let _span = opclock::span(Op::ConvS8, || {
        let pixels = shape.oh * shape.ow;
        let bytes = weight.data.len() + 4 * (x.h * x.w * x.c + pixels * weight.n);
        Work { macs: (pixels * weight.n * weight.k) as u64, bytes: bytes as u64 }
    });
    let kernel = ctx.kernels.product_s8;
    let layer = Layer { ctx, kernel, x, shape, weight, conv };
    let band = shape.band(BUDGET, FEWEST);
    let tiles = TILES * kernel.mr * kernel.nr;
    let map = (shape.map(band) * kernel.bytes).div_ceil(size_of::<f32>()).next_multiple_of(2);
    let scratch = tiles + map + band * shape.ow + 2 * LINE;
    let most = working_memory_conv_s8((x.h, x.w, x.c), conv.kernel, conv.stride, conv.pad);
    assert!(scratch <= most, "{scratch} values of working memory, {most} announced");
    ctx.pool.reserve_scratch(scratch);
    ctx.pool.run(shape.oh.div_ceil(band), &|task, worker| {
        let rows = task * band..((task + 1) * band).min(shape.oh);
        ctx.pool.with_scratch(worker, scratch, |memory| {
            // Sums first and on a cache line: a vector across two lines costs two accesses.
            let skip = memory.as_ptr().align_offset(LINE * size_of::<f32>()).min(LINE);
            let (acc, memory) = memory[skip..].split_at_mut(tiles);
            let (map, scales) = memory.split_at_mut(map);
            let acc: &mut [i32] = bytemuck::cast_slice_mut(acc);
            layer.quantize(rows.clone(), map, scales);
            layer.multiply(rows, (&*map, &*scales, acc), out);
        });
    });
}

impl Layer<'_> {
    /// Writes the input lines under a band into the map, quantized, and for each output pixel the scale of its window.
    fn quantize(&self, rows: Range<usize>, map: &mut [f32], scales: &mut [f32]) {
        let Shape { kernel, stride, pad, ow, .. } = self.shape;
        let lines = self.shape.lines(rows.len());
        let mut map = self.kernel.map(map);
        let scales = &mut scales[..rows.len() * ow];
        if kernel == 1 && stride == 1 && pad == 0 {
            // Pixels of the image are those of the map.
            for (j, y) in rows.enumerate() {
                let scale = MapScale::PerPixel(&mut scales[j * ow..][..ow]);
                self.pixels(y, 0..self.x.w, scale, map.slice(j * self.shape.line()..(j + 1) * self.shape.line()));
            }
            return;
        }
        let relu = self.rectified();
        map.fill(zero_of(relu));
        if kernel > stride {
            let mut max = 0.0f32;
            for y in (0..lines).filter_map(|j| self.shape.source(rows.start, j)) {
                max = larger(max, self.largest(y, 0..self.x.w));
            }
            let (inverse, scale) = inverse_and_scale(max, relu);
            scales.fill(scale);
            for j in 0..lines {
                if let Some(y) = self.shape.source(rows.start, j) {
                    let at = j * self.shape.line() + pad * self.shape.c;
                    let out = map.slice(at..at + self.x.w * self.shape.c);
                    self.pixels(y, 0..self.x.w, MapScale::Inverse(inverse), out);
                }
            }
            return;
        }
        for (i, scale) in scales.iter_mut().enumerate() {
            let (j, x) = (i / ow * stride, i % ow * stride);
            // The window without what lies outside.
            let inside = x.max(pad) - pad..(x + kernel).saturating_sub(pad).min(self.x.w);
            if inside.is_empty() {
                *scale = 0.0;
                continue;
            }
            let mut max = 0.0f32;
            for y in (j..j + kernel).filter_map(|j| self.shape.source(rows.start, j)) {
                max = larger(max, self.largest(y, inside.clone()));
            }
            let (inverse, s) = inverse_and_scale(max, relu);
            *scale = s;
            for j in j..j + kernel {
                if let Some(y) = self.shape.source(rows.start, j) {
                    let at = j * self.shape.line() + (inside.start + pad) * self.shape.c;
                    let out = map.slice(at..at + inside.len() * self.shape.c);
                    self.pixels(y, inside.clone(), MapScale::Inverse(inverse), out);
                }
            }
        }
    }

    /// Pixels `xs` of input line `y`.
    fn line(&self, y: usize, xs: Range<usize>) -> &[f32] {
        &self.x.data[(y * self.x.w + xs.start) * self.x.c..(y * self.x.w + xs.end) * self.x.c]
    }

    fn rectified(&self) -> bool {
        self.conv.relu_input == Act::Relu
    }

    fn largest(&self, y: usize, xs: Range<usize>) -> f32 {
        self.ctx.kernels.largest(self.line(y, xs), self.rectified())
    }

    fn pixels(&self, y: usize, xs: Range<usize>, scale: MapScale, out: MapOut) {
        self.ctx.kernels.to_map(ToMap { x: self.line(y, xs), c: self.x.c, relu: self.rectified(), scale, out });
    }

    /// Every output of a band.
    fn multiply(&self, rows: Range<usize>, (map, scales, acc): (&[f32], &[f32], &mut [i32]), out: &Out) {
        let Layer { ctx, kernel, weight, conv, shape, .. } = self;
        let (mr, nv) = (kernel.mr, kernel.nr / NR);
        let map: &[i8] = bytemuck::cast_slice(map);
        let w_stride = weight.k / QUAD * STEP;
        for panel in (0..weight.n.div_ceil(NR)).step_by(nv) {
            let panels = nv.min(weight.n.div_ceil(NR) - panel);
            let columns = ColumnsS8::of(*weight, (panel, panels), conv.bias, None);
            let start = starts(kernel, *weight, (panel, panels), zero_of(self.rectified()));
            let w = &weight.data[panel * w_stride..];
            let size = mr * NR * panels;
            let first = rows.start * shape.ow;
            let near = Ahead::nothing(map);
            let ahead_of = |step: &Step| match (out, step.done) {
                (Out::Image { out, .. }, Some(row)) => near.with_outputs(out.at(row * weight.n + panel * NR), weight.n),
                _ => near,
            };
            sweep(shape, rows.clone(), mr, STEPS * QUAD / kernel.bytes, |step: Step| {
                let acc = &mut acc[step.tile * size..][..size];
                let tile = TileS8 {
                    rows: kernel.fit(step.pixels),
                    panels,
                    steps: step.run / QUAD,
                    a: &map[step.at * kernel.bytes..],
                    w: &w[step.k / QUAD * STEP..],
                    w_stride,
                    start: step.start.then_some(&start),
                    acc: &mut *acc,
                    acc_stride: mr * NR,
                    ahead: ahead_of(&step),
                };
                ctx.kernels.windows_s8(tile, step.windows);
                if let Some(row) = step.done {
                    let scales = &scales[row - first..][..step.pixels];
                    self.finish(Tile { row, panel, panels, scales, columns: &columns, acc }, out);
                }
            });
        }
    }

    /// Sums of a tile to the output.
    fn finish(&self, tile: Tile, out: &Out) {
        let n = self.weight.n;
        let (acc_stride, col) = (self.kernel.mr * NR, tile.panel * NR);
        let rows = tile.scales.len();
        let finish = |panel: usize,
                      panels: usize,
                      columns: &ColumnsS8,
                      out: &SharedMut<f32>,
                      at: usize,
                      stride: usize,
                      cols: usize,
                      plus| {
            self.ctx.kernels.finish_s8(FinishS8 {
                acc: &tile.acc[panel * acc_stride..],
                acc_stride,
                panels,
                row_scales: tile.scales,
                columns,
                act: self.conv.act,
                gamma: false,
                plus,
                relu_sum: self.conv.relu_sum,
                out,
                at,
                stride,
                cols,
            });
        };
        match out {
            Out::Image { out, residual } => {
                let plus = residual.map_or(Plus::Nothing, Plus::Other);
                let cols = (tile.panels * NR).min(n - col);
                finish(0, tile.panels, tile.columns, out, tile.row * n + col, n, cols, plus);
            }
            Out::Sink(sink) => {
                for panel in 0..tile.panels {
                    let mut values = [0.0; MAX_MR * NR];
                    let values = &mut values[..rows * NR];
                    finish(panel, 1, &tile.columns.panel(panel), &SharedMut::new(values), 0, NR, NR, Plus::Nothing);
                    let col = col + panel * NR;
                    sink.put(tile.row, col, NR.min(n - col), values);
                }
            }
            Out::Sums(out) => {
                for r in 0..rows {
                    for v in 0..tile.panels {
                        let at = (tile.row + r) * n + col + v * NR;
                        let cols = NR.min(n - col - v * NR);
                        // SAFETY: every output belongs to one tile of one task, and a piece lives only in this loop.
                        #[allow(unsafe_code)]
                        let out = unsafe { out.slice(at..at + cols) };
                        out.copy_from_slice(&tile.acc[v * acc_stride + r * NR..][..cols]);
                    }
                }
            }
        }
    }
}

/// A finished tile.
struct Tile<'a> {
    /// First output pixel.
    row: usize,
    panel: usize,
    panels: usize,
    /// Of each pixel.
    scales: &'a [f32],
    columns: &'a ColumnsS8,
    acc: &'a [i32],
}
