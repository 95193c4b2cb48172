//! out = epilogue(A W^T): f32 activations, f32 or f16 weights in K1N16 panels. The int8 family is in `s8/`.

pub(crate) mod ahead;
pub(crate) mod finish;
pub mod pack;
pub mod s8;
pub mod table;
pub(crate) mod tile;

use crate::cpu::{Ctx, Kernels};
use crate::mat::{Mat, MatMut};
use crate::opclock::{self, Op, Work};
use crate::par::SharedMut;
use finish::{Columns, Finish, Plus};
use pack::{Change, MAX_MR, RowPack, strided};
use tile::Tile;

pub use pack::{NR, PanelData, Panels, pack_f16, pack_f32, panel_len, unpack};
pub use s8::pack::{PanelsS8, RowsS8, RowsS8Mut, col_sums, pack_s8, padded_k, panel_len_s8, unpack_s8};
pub use s8::table::{GEMM_S8, GemmS8Kernel};
pub use s8::{gemm_s8, gemm_s8_quantize, gemm_s8_sums, working_memory_s8, working_memory_s8_quantize};
pub use table::{GEMM_F, GemmKernel, WeightType};

/// Activation of an epilogue.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum Act {
    /// None.
    #[default]
    None,
    /// x Phi(x), exact erf form.
    Gelu,
    /// max(x, 0).
    Relu,
}

/// What happens to a finished sum, in this order: y = act(acc + bias); y = y * gamma;
/// out = out + y with `residual`, else y. Each step rounds once; nothing is fused.
#[derive(Clone, Copy, Debug, Default)]
pub struct Epilogue<'a> {
    /// `[n]`.
    pub bias: Option<&'a [f32]>,
    /// Activation.
    pub act: Act,
    /// Layer scale `[n]`.
    pub gamma: Option<&'a [f32]>,
    /// Whether to add to what `out` holds.
    pub residual: bool,
}

/// Where the rows of a product come from: a matrix, or windows of an image.
pub(crate) trait Source: Sync {
    /// Packs rows `first..first + rows` whole (`[k][width]`, rows beyond `rows` zero) into `out`.
    fn pack(&self, kernels: &Kernels, first: usize, rows: usize, width: usize, out: &mut [f32]);
}

/// Where finished outputs go that are no rows of a matrix.
pub(crate) trait Sink: Sync {
    /// Takes `values[r * 16..][..cols]` as row `row + r`, columns `col..col + cols`, for every whole 16 in `values`.
    /// Called once for each output.
    fn put(&self, row: usize, col: usize, cols: usize, values: &[f32]);
}

/// Where finished outputs go.
pub(crate) enum Out<'a> {
    /// Rows of a matrix, so many values apart, on top of something or not.
    Rows { out: SharedMut<'a, f32>, stride: usize, plus: Plus<'a> },
    /// Through a sink, panel by panel.
    Sink(&'a dyn Sink),
}

/// Rows of a matrix.
pub(crate) struct Rows<'a>(pub Mat<'a>);

impl Source for Rows<'_> {
    fn pack(&self, kernels: &Kernels, first: usize, rows: usize, width: usize, out: &mut [f32]) {
        let Mat { data, cols, stride, .. } = self.0;
        let x = &data[(first * stride).min(data.len())..];
        kernels.pack(RowPack { from: strided(x, stride, rows), k: cols, width, change: Change::Keep, out });
    }
}

/// A matrix product with everything around it.
pub(crate) struct Product<'a> {
    /// Rows.
    pub m: usize,
    /// Rows of activations.
    pub source: &'a dyn Source,
    /// Weights.
    pub w: Panels<'a>,
    /// `[n]`, or shorter: repeated over the outputs with this period.
    pub bias: Option<&'a [f32]>,
    /// Activation.
    pub act: Act,
    /// `[n]`.
    pub gamma: Option<&'a [f32]>,
    /// Outputs.
    pub out: Out<'a>,
}

/// Packed activations of one task: at most 256 KiB, a quarter of a usual second-level cache, so that the panels
/// streaming past do not drive them out.
const PACKED: usize = 1 << 16;
/// Most tiles of rows per task.
const TILES: usize = 8;
/// Steps of k between which a panel pair stays in the first-level cache: 256 * 32 columns = 32 KiB of f32.
pub(crate) const KC: usize = 256;
/// A block of a group of f16 panels as f32.
const WIDE: usize = KC * MAX_NV * NR;
/// Fewest tiles of rows for which f16 panels are widened once instead of in each tile, where that takes two of 26 vector instructions a step
/// and their places in both pipes.
const WIDEN: usize = 3;
/// Tasks wanted, so that a few threads finish together.
const TASKS: usize = 16;
/// Fewest panels per task: packing the rows again costs about 2 % of 64 columns' multiply-adds.
const GROUP: usize = 4;
/// Panels of the widest kernel.
pub(crate) const MAX_NV: usize = 2;

/// Most f32 values of working memory that each thread of the pool keeps after products (or convolutions whose windows do not
/// overlap) of up to `k` inputs, whatever the kernel; for memory plans.
pub fn working_memory(k: usize) -> usize {
    PACKED.max(MAX_MR * k) + TILES * MAX_MR * MAX_NV * NR + WIDE
}

/// Runs a product: tasks are blocks of rows times groups of panels, chosen by the shape alone.
pub(crate) fn product(ctx: Ctx, p: &Product) {
    let (m, n, k) = (p.m, p.w.n, p.w.k);
    if m == 0 || n == 0 {
        return;
    }
    let kernel = ctx.kernels.gemm(p.w.data.weights());
    let (mr, nv) = (kernel.mr, kernel.nr / NR);
    let tiles = (PACKED / (mr * k.max(1))).clamp(1, TILES);
    let block = tiles * mr;
    let row_tasks = m.div_ceil(block);
    let panels = n.div_ceil(NR);
    let wanted = TASKS.div_ceil(row_tasks).clamp(1, panels.div_ceil(GROUP));
    // A whole number of the kernel's panel groups per task.
    let group = panels.div_ceil(wanted).next_multiple_of(nv);
    let col_tasks = panels.div_ceil(group);

    let wide = if kernel.weights == WeightType::F16 { WIDE } else { 0 };
    let scratch = block * (k + nv * NR) + wide;
    assert!(scratch <= working_memory(k), "{scratch} values of working memory for {k} inputs");
    ctx.pool.reserve_scratch(scratch);
    ctx.pool.run(row_tasks * col_tasks, &|task, worker| {
        let first = task / col_tasks * block;
        let rows = block.min(m - first);
        let from = task % col_tasks * group;
        let to = (from + group).min(panels);
        ctx.pool.with_scratch(worker, scratch, |memory| {
            let (packed, rest) = memory.split_at_mut(block * k);
            let (acc, wide) = rest.split_at_mut(block * nv * NR);
            let mut r = 0;
            while r < rows {
                let here = mr.min(rows - r);
                p.source.pack(ctx.kernels, first + r, here, kernel.fit(here), &mut packed[r * k..]);
                r += mr;
            }
            let mut panel = from;
            while panel < to {
                let here = nv.min(to - panel);
                block_of_panels(ctx.kernels, p, Part { first, rows, panel, panels: here }, packed, (acc, wide));
                panel += here;
            }
        });
    });
}

/// One group of panels over the rows of a task.
struct Part {
    first: usize,
    rows: usize,
    panel: usize,
    panels: usize,
}

fn block_of_panels(kernels: &Kernels, p: &Product, c: Part, packed: &[f32], (acc, wide): (&mut [f32], &mut [f32])) {
    let kernel = kernels.gemm(p.w.data.weights());
    let (k, mr) = (p.w.k, kernel.mr);
    let size = mr * NR * c.panels;
    let columns = Columns::of(p.w.n, (c.panel, c.panels), p.bias, p.gamma);
    // Values of the next panels for each step of each tile.
    let per_step = c.panels * NR / c.rows.div_ceil(mr);
    let mut k0 = 0;
    loop {
        let steps = KC.min(k - k0);
        let last = k0 + steps == k;
        let (w, w_stride) = match p.w.data.from((c.panel * k + k0) * NR) {
            PanelData::F16(w) if c.rows > (WIDEN - 1) * mr => {
                for (v, wide) in wide.chunks_mut(KC * NR).enumerate().take(c.panels) {
                    kernels.widen(&w[v * k * NR..][..steps * NR], wide);
                }
                (PanelData::F32(&*wide), KC * NR)
            }
            w => (w, k * NR),
        };
        for r in (0..c.rows).step_by(mr) {
            let (tile, here) = (r / mr, mr.min(c.rows - r));
            let rows = kernel.fit(here);
            let acc = &mut acc[tile * size..][..size];
            let next = ((c.panel + c.panels) * k + k0 * c.panels) * NR + tile * steps * per_step;
            let mut ahead = p.w.data.ahead(next, per_step);
            if last && let Out::Rows { out, stride, .. } = &p.out {
                ahead = ahead.with_outputs(out.at((c.first + r) * stride + c.panel * NR), *stride);
            }
            kernels.tile(Tile {
                rows,
                panels: c.panels,
                k: steps,
                a: &packed[r * k + k0 * rows..][..steps * rows],
                w,
                w_stride,
                start: k0 == 0,
                acc: &mut *acc,
                acc_stride: mr * NR,
                ahead,
            });
            if last {
                let to = Finished { row: c.first + r, rows: here, panel: c.panel, panels: c.panels };
                finish_tile(kernels, p, to, (&columns, acc, mr * NR));
            }
        }
        if last {
            return;
        }
        k0 += steps;
    }
}

/// Which outputs a tile holds.
pub(crate) struct Finished {
    pub row: usize,
    pub rows: usize,
    pub panel: usize,
    pub panels: usize,
}

/// Sums of one tile, `acc` `[panel][acc_stride]`, to the output.
pub(crate) fn finish_tile(
    kernels: &Kernels,
    p: &Product,
    t: Finished,
    (columns, acc, acc_stride): (&Columns, &[f32], usize),
) {
    let (n, col) = (p.w.n, t.panel * NR);
    let (bias, gamma) = (p.bias.is_some(), p.gamma.is_some());
    match &p.out {
        Out::Rows { out, stride, plus } => kernels.finish(Finish {
            acc,
            acc_stride,
            panels: t.panels,
            rows: t.rows,
            columns,
            bias,
            act: p.act,
            gamma,
            plus: *plus,
            out,
            at: t.row * stride + col,
            stride: *stride,
            cols: (t.panels * NR).min(n - col),
        }),
        Out::Sink(sink) => {
            for panel in 0..t.panels {
                let mut values = [0.0; MAX_MR * NR];
                let values = &mut values[..t.rows * NR];
                kernels.finish(Finish {
                    acc: &acc[panel * acc_stride..],
                    acc_stride,
                    panels: 1,
                    rows: t.rows,
                    columns: &columns.panel(panel),
                    bias,
                    act: p.act,
                    gamma,
                    plus: Plus::Nothing,
                    out: &SharedMut::new(values),
                    at: 0,
                    stride: NR,
                    cols: NR,
                });
                let col = col + panel * NR;
                sink.put(t.row, col, NR.min(n - col), values);
            }
        }
    }
}

/// `a` `[m, k]` times the transpose of `w` `[n, k]` -> `out` `[m, n]`.
///
/// Each output accumulates over k in order with fused multiply-adds from 0, so its bits do not depend on
/// the kernel, the tiles or the threads.
pub fn gemm(ctx: Ctx, a: Mat, w: Panels, ep: Epilogue, out: MatMut) {
    let w = w.checked();
    assert_eq!(a.cols, w.k, "inputs of a matrix product");
    assert_eq!((out.rows, out.cols), (a.rows, w.n), "outputs of a matrix product");
    for (what, v) in [("bias", ep.bias), ("gamma", ep.gamma)] {
        assert!(v.is_none_or(|v| v.len() == w.n), "{what} of {} outputs", w.n);
    }
    let plus = if ep.residual { Plus::Output } else { Plus::Nothing };
    let out = Out::Rows { stride: out.stride, out: SharedMut::new(out.data), plus };
    let source = Rows(a);
    let _span = opclock::span(Op::Gemm, || Work::product(a.rows, &w, a.rows * a.cols));
    product(ctx, &Product { m: a.rows, source: &source, w, bias: ep.bias, act: ep.act, gamma: ep.gamma, out });
}
