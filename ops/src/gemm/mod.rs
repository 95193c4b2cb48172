//! out = epilogue(A W^T): f32 activations, f32 or f16 weights in K1N16 panels. The int8 family is in `s8/`.

pub mod pack;
pub mod s8;
pub mod table;
pub(crate) mod tile;

use crate::cpu::{Ctx, Kernels};
use crate::mat::{Mat, MatMut};
use crate::opclock::{self, Op, Work};
use crate::par::SharedMut;
use pack::{Change, MAX_MR, RowPack, strided};
use tile::{Finish, Tile};

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

/// Where finished outputs go.
pub(crate) trait Sink: Sync {
    /// Takes `values[r * 16..][..cols]` as row `row + r`, columns `col..col + cols`, for every whole 16 in `values`.
    /// Called once for each output.
    fn put(&self, row: usize, col: usize, cols: usize, values: &[f32]);
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

/// What is added to an output when it is stored.
#[derive(Clone, Copy)]
pub(crate) enum AddTo<'a> {
    Nothing,
    /// What the output holds.
    Output,
    /// The same element of another matrix.
    Other(Mat<'a>),
}

/// Row-major output.
pub(crate) struct RowSink<'a> {
    pub out: SharedMut<'a, f32>,
    pub stride: usize,
    pub add: AddTo<'a>,
}

impl Sink for RowSink<'_> {
    fn put(&self, row: usize, col: usize, cols: usize, values: &[f32]) {
        for (r, y) in values.as_chunks::<NR>().0.iter().enumerate() {
            let at = (row + r) * self.stride + col;
            // SAFETY: every output belongs to one tile of one task, and a piece lives only in this loop.
            #[allow(unsafe_code)]
            let out = unsafe { self.out.slice(at..at + cols) };
            let other = match self.add {
                AddTo::Other(x) => &x.row(row + r)[col..][..cols],
                _ => &[],
            };
            match (self.add, out.as_chunks_mut::<NR>().0, other.as_chunks::<NR>().0) {
                // Whole vectors of 16: the compiler keeps them in registers.
                (AddTo::Nothing, [out], _) => *out = *y,
                (AddTo::Output, [out], _) => (0..NR).for_each(|i| out[i] += y[i]),
                (AddTo::Other(_), [out], [x]) => (0..NR).for_each(|i| out[i] = x[i] + y[i]),
                _ => put_narrow(self.add, y, other, out),
            }
        }
    }
}

/// Less than sixteen columns. Apart, or the compiler merges its copy with that of whole vectors into a call of the C library.
#[inline(never)]
fn put_narrow(add: AddTo, y: &[f32; NR], other: &[f32], out: &mut [f32]) {
    match add {
        AddTo::Nothing => out.copy_from_slice(&y[..out.len()]),
        AddTo::Output => out.iter_mut().zip(y).for_each(|(o, y)| *o += y),
        AddTo::Other(_) => out.iter_mut().zip(other).zip(y).for_each(|((o, x), y)| *o = x + y),
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
    pub sink: &'a dyn Sink,
}

/// Packed activations of one task: at most 256 KiB, a quarter of a usual second-level cache, so that the panels
/// streaming past do not drive them out.
const PACKED: usize = 1 << 16;
/// Most tiles of rows per task.
const TILES: usize = 8;
/// Steps of k between which a panel pair stays in the first-level cache: 256 * 32 columns = 32 KiB of f32.
pub(crate) const KC: usize = 256;
/// Tasks wanted, so that a few threads finish together.
const TASKS: usize = 16;
/// Fewest panels per task: packing the rows again costs about 2 % of 64 columns' multiply-adds.
const GROUP: usize = 4;
/// Panels of the widest kernel.
pub(crate) const MAX_NV: usize = 2;

/// Most f32 values of working memory that each thread of the pool keeps after products (or convolutions whose windows do not
/// overlap) of up to `k` inputs, whatever the kernel; for memory plans.
pub fn working_memory(k: usize) -> usize {
    PACKED.max(MAX_MR * k) + TILES * MAX_MR * MAX_NV * NR
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

    let scratch = block * (k + nv * NR);
    assert!(scratch <= working_memory(k), "{scratch} values of working memory for {k} inputs");
    ctx.pool.reserve_scratch(scratch);
    ctx.pool.run(row_tasks * col_tasks, &|task, worker| {
        let first = task / col_tasks * block;
        let rows = block.min(m - first);
        let from = task % col_tasks * group;
        let to = (from + group).min(panels);
        ctx.pool.with_scratch(worker, scratch, |memory| {
            let (packed, acc) = memory.split_at_mut(block * k);
            let mut r = 0;
            while r < rows {
                let here = mr.min(rows - r);
                p.source.pack(ctx.kernels, first + r, here, kernel.fit(here), &mut packed[r * k..]);
                r += mr;
            }
            let mut panel = from;
            while panel < to {
                let here = nv.min(to - panel);
                columns(ctx.kernels, p, Columns { first, rows, panel, panels: here }, packed, acc);
                panel += here;
            }
        });
    });
}

/// One group of panels over the rows of a task.
struct Columns {
    first: usize,
    rows: usize,
    panel: usize,
    panels: usize,
}

/// Values of the columns of a group of panels, zeros beyond n; they repeat with their length as period.
pub(crate) fn per_column(values: Option<&[f32]>, panel: usize, n: usize) -> [[f32; NR]; MAX_NV] {
    let mut lanes = [[0.0f32; NR]; MAX_NV];
    if let Some(values) = values {
        for (i, lane) in lanes.as_flattened_mut().iter_mut().enumerate() {
            if panel * NR + i < n {
                *lane = values[(panel * NR + i) % values.len()];
            }
        }
    }
    lanes
}

fn columns(kernels: &Kernels, p: &Product, c: Columns, packed: &[f32], acc: &mut [f32]) {
    let kernel = kernels.gemm(p.w.data.weights());
    let (n, k, mr) = (p.w.n, p.w.k, kernel.mr);
    let stride = c.rows.next_multiple_of(mr) * NR;
    let acc = &mut acc[..c.panels * stride];
    acc.fill(0.0);
    for k0 in (0..k).step_by(KC) {
        let steps = KC.min(k - k0);
        let at = (c.panel * k + k0) * NR;
        let w = match p.w.data {
            PanelData::F32(d) => PanelData::F32(&d[at..]),
            PanelData::F16(d) => PanelData::F16(&d[at..]),
        };
        for r in (0..c.rows).step_by(mr) {
            let rows = kernel.fit(mr.min(c.rows - r));
            kernels.tile(Tile {
                rows,
                panels: c.panels,
                k: steps,
                a: &packed[r * k + k0 * rows..][..steps * rows],
                w,
                w_stride: k * NR,
                acc: &mut acc[r * NR..],
                acc_stride: stride,
            });
        }
    }
    let bias = per_column(p.bias, c.panel, n);
    let gamma = per_column(p.gamma, c.panel, n);
    kernels.finish(Finish {
        acc: &mut *acc,
        acc_stride: stride,
        rows: c.rows,
        bias: p.bias.map(|_| &bias[..]),
        act: p.act,
        gamma: p.gamma.map(|_| &gamma[..]),
        panels: c.panels,
    });
    for v in 0..c.panels {
        let col = (c.panel + v) * NR;
        p.sink.put(c.first, col, NR.min(n - col), &acc[v * stride..][..c.rows * NR]);
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
    let add = if ep.residual { AddTo::Output } else { AddTo::Nothing };
    let stride = out.stride;
    let sink = RowSink { out: SharedMut::new(out.data), stride, add };
    let source = Rows(a);
    let _span = opclock::span(Op::Gemm, || Work::product(a.rows, &w, a.rows * a.cols));
    product(ctx, &Product { m: a.rows, source: &source, w, bias: ep.bias, act: ep.act, gamma: ep.gamma, sink: &sink });
}
