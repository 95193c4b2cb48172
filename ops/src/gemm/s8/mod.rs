//! out = epilogue(A W^T) with int8 activations and weights: exact i32 sums, then one f32 epilogue.
//!
//! y = fma(f32(sum), row scale * output scale, bias), the product of the scales rounded once; then activation, gamma and
//! residual as in [`Epilogue`]. Sums are exact whatever the kernel, the tiles and the threads, and the epilogue has one
//! order, so the bits are the same everywhere.
//!
//! | file | what |
//! |---|---|
//! | `pack.rs` | K4N16 panels, rows as they lie in memory |
//! | `rows.rs` | rows of activations in the order of a tile |
//! | `tile.rs` | the tile over `Dot8` |
//! | `product.rs` | full tiles below one another with their epilogue |
//! | `finish.rs` | the epilogue |
//! | `table.rs` | the kernels |
//! | `scalar.rs` `avx2.rs` `avx2wide.rs` `avxvnni.rs` `avx512vnni.rs` `neon.rs` `neondot.rs` | one `Dot8` each |

#[cfg(target_arch = "x86_64")]
pub(crate) mod avx2;
#[cfg(target_arch = "x86_64")]
pub(crate) mod avx2wide;
#[cfg(target_arch = "x86_64")]
pub(crate) mod avx512vnni;
#[cfg(target_arch = "x86_64")]
pub(crate) mod avxvnni;
pub(crate) mod finish;
#[cfg(target_arch = "aarch64")]
pub(crate) mod neon;
#[cfg(target_arch = "aarch64")]
pub(crate) mod neondot;
pub mod pack;
pub(crate) mod product;
pub(crate) mod rows;
pub(crate) mod scalar;
pub mod table;
pub(crate) mod tile;

use super::Epilogue;
use super::ahead::Ahead;
use super::finish::Plus;
use super::pack::{MAX_MR, NR};
use crate::cpu::Ctx;
use crate::mat::MatMut;
use crate::opclock::{self, Op, Work};
use crate::par::SharedMut;
use crate::quantize::{Before, QuantizeRow};
use finish::{ColumnsS8, FinishS8};
use pack::{PanelsS8, QUAD, RowsS8, RowsS8Mut, STEP, padded_k};
use product::ProductS8;
use rows::{QuadPack, WidePack};
use table::{Activations, GemmS8Kernel};
use tile::{MAX_NV, TileS8};

/// Packed activations of one task, in words of four bytes: at most 256 KiB, a quarter of a usual second-level cache, so that the
/// panels streaming past do not drive them out.
const PACKED: usize = 1 << 16;
/// Most tiles of rows per task. Weights beyond the second-level cache are read once per task: with 5 tiles a product of 868 x
/// 1024 x 3072 ran at 58 % of the peak, with 8 at 80 % (Zen 4).
const TILES: usize = 10;
/// Steps of four inputs between which sums stay in registers, for bytes: a pair of panels is then 32 KiB. Half as many for 16-bit
/// activations, of which a tile then takes 6 KiB beside 8 KiB of a panel.
pub(crate) const STEPS: usize = 256;
/// Tasks wanted, so that a few threads finish together.
const TASKS: usize = 8;
/// Fewest panels per task: packing a row again costs as much as the dot products of some 20 of 256 columns.
const GROUP: usize = 16;

/// f32-sized values of a cache line.
const LINE: usize = 16;

/// Most f32-sized values of working memory that each thread of the pool keeps after int8 products of up to `k` inputs,
/// whatever the kernel; for memory plans. (The tallest tile of bytes has 12 rows, of 16-bit activations 6.)
pub fn working_memory_s8(k: usize) -> usize {
    PACKED.max(MAX_MR * padded_k(k) / QUAD) + TILES * MAX_MR * MAX_NV * NR + LINE
}

/// Where sums go.
enum Sink<'a> {
    /// As they are, `[m, n]`.
    Sums(SharedMut<'a, i32>),
    /// Through the epilogue into rows `stride` apart, of which row `first` is the first.
    Values { ep: Epilogue<'a>, out: SharedMut<'a, f32>, stride: usize, first: usize },
}

struct Product<'a> {
    /// Few rows: `kernel` is the one of bytes.
    few: bool,
    kernel: &'static GemmS8Kernel,
    a: RowsS8<'a>,
    w: PanelsS8<'a>,
    sink: Sink<'a>,
}

/// Rows up to which products take bytes: widened values pay when many rows share the widened weights. With AVX2, 1024 x 1024, one
/// thread (Zen 3): 1 row 70 (bytes) against 41 GOP/s, 4 rows 118 and 104, 16 rows 123 and 120, 868 rows 125 and 135.
const FEW: usize = 16;

impl<'a> Product<'a> {
    fn new(ctx: Ctx, a: RowsS8<'a>, w: PanelsS8<'a>, sink: Sink<'a>) -> Product<'a> {
        let few = a.m <= FEW;
        Product { few, kernel: ctx.kernels.products_s8(few), a, w, sink }
    }
}

/// Rows and panels of one task.
#[derive(Clone, Copy)]
struct Part {
    first: usize,
    rows: usize,
    panel: usize,
    panels: usize,
}

/// Piece `i` of `total` cut into `pieces` as even as possible.
fn piece(total: usize, pieces: usize, i: usize) -> std::ops::Range<usize> {
    i * total / pieces..(i + 1) * total / pieces
}

/// Runs a product: tasks are blocks of row tiles times groups of panels, chosen by the shape alone.
fn product(ctx: Ctx, p: &Product) {
    let (m, n) = (p.a.m, p.w.n);
    if m == 0 || n == 0 {
        return;
    }
    let steps = padded_k(p.w.k) / QUAD;
    let (mr, nv) = (p.kernel.mr, p.kernel.nr / NR);
    // Words of a packed row.
    let words = steps * p.kernel.bytes;
    let row_tiles = m.div_ceil(mr);
    let most = (PACKED / (mr * words.max(1))).clamp(1, TILES);
    // Even shares of the rows; four or a multiple, so that two or four threads finish together.
    let row_tasks = row_tiles.div_ceil(most).next_multiple_of(4).min(row_tiles);
    // Whole groups of the kernel's panels.
    let groups = n.div_ceil(NR).div_ceil(nv);
    let col_tasks = TASKS.div_ceil(row_tasks).clamp(1, (groups * nv).div_ceil(GROUP));
    let block = row_tiles.div_ceil(row_tasks) * mr;

    let used = block * (words + nv * NR);
    let scratch = used + LINE;
    assert!(scratch <= working_memory_s8(p.w.k), "{scratch} values of working memory for {} inputs", p.w.k);
    ctx.pool.reserve_scratch(scratch);
    ctx.pool.run(row_tasks * col_tasks, &|task, worker| {
        let tiles = piece(row_tiles, row_tasks, task / col_tasks);
        let columns = piece(groups, col_tasks, task % col_tasks);
        let first = tiles.start * mr;
        let rows = (tiles.end * mr).min(m) - first;
        ctx.pool.with_scratch(worker, scratch, |memory| {
            // Sums first and on a cache line: a vector across two lines costs two accesses.
            let skip = memory.as_ptr().align_offset(LINE * size_of::<f32>()).min(LINE);
            let (acc, packed) = memory[skip..][..used].split_at_mut(block * nv * NR);
            let acc: &mut [i32] = bytemuck::cast_slice_mut(acc);
            pack_block(ctx, p, first..first + rows, packed);
            for g in columns {
                let panel = g * nv;
                let panels = nv.min(n.div_ceil(NR) - panel);
                block_of_panels(ctx, p, Part { first, rows, panel, panels }, (packed, acc));
            }
        });
    });
}

/// Rows of a task to tiles `[tile][step][row]`.
fn pack_block(ctx: Ctx, p: &Product, rows: std::ops::Range<usize>, packed: &mut [f32]) {
    let width = padded_k(p.w.k);
    let words = width / QUAD * p.kernel.bytes;
    let flip = match p.kernel.activations {
        Activations::Signed => 0,
        Activations::Offset128 => 0x8080_8080,
    };
    for r in (0..rows.len()).step_by(p.kernel.mr) {
        let here = p.kernel.mr.min(rows.len() - r);
        let mut from: [&[i8]; MAX_MR] = [&[]; MAX_MR];
        for (i, row) in from.iter_mut().enumerate().take(here) {
            *row = &p.a.data[(rows.start + r + i) * width..][..width];
        }
        let (steps, width) = (width / QUAD, p.kernel.fit(here));
        let out = &mut packed[r * words..][..p.kernel.mr * words];
        if p.kernel.bytes == 1 {
            ctx.kernels.pack_quads(QuadPack { from: &from, steps, width, flip, out: bytemuck::cast_slice_mut(out) });
        } else {
            ctx.kernels.pack_wide(WidePack { from: &from, steps, width, out: bytemuck::cast_slice_mut(out) });
        }
    }
}

/// Where the sums of a group of panels start, for activations whose integer `zero` stands for 0.0: so that sum (a - zero) w comes
/// out, whether the kernel takes a or a + 128.
pub(crate) fn starts(
    kernel: &GemmS8Kernel,
    w: PanelsS8,
    (panel, panels): (usize, usize),
    zero: i8,
) -> [[i32; NR]; MAX_NV] {
    let mut start = [[0i32; NR]; MAX_NV];
    let offset = i32::from(zero) + if kernel.activations == Activations::Offset128 { 128 } else { 0 };
    if offset != 0 {
        for (v, start) in start.iter_mut().enumerate().take(panels) {
            let col = (panel + v) * NR;
            for (s, sum) in start.iter_mut().zip(&w.col_sums[col..w.n.min(col + NR)]) {
                *s = -offset * sum;
            }
        }
    }
    start
}

/// One group of panels over the rows of a task.
fn block_of_panels(ctx: Ctx, p: &Product, part: Part, (packed, acc): (&[f32], &mut [i32])) {
    let steps = padded_k(p.w.k) / QUAD;
    let mr = p.kernel.mr;
    let packed: &[i8] = bytemuck::cast_slice(packed);
    let ep = match &p.sink {
        Sink::Sums(_) => Epilogue::default(),
        Sink::Values { ep, .. } => *ep,
    };
    let columns = ColumnsS8::of(p.w, (part.panel, part.panels), ep.bias, ep.gamma);
    let start = starts(p.kernel, p.w, (part.panel, part.panels), 0);
    let w = &p.w.data[part.panel * steps * STEP..];
    let size = mr * NR * part.panels;
    let block = STEPS / p.kernel.bytes;
    let quad = QUAD * p.kernel.bytes;
    // Bytes of the next panels for each step of each tile.
    let per_step = part.panels * STEP / part.rows.div_ceil(mr);
    let next_panels = w.as_ptr().wrapping_add(part.panels * steps * STEP);
    let mut s0 = 0;
    loop {
        let here = block.min(steps - s0);
        let next = next_panels.wrapping_add(s0 * part.panels * STEP);
        let last = s0 + here == steps;
        let start = if s0 == 0 { Some(&start) } else { None };
        let mut done = 0;
        if last && let Sink::Values { .. } = p.sink {
            // No block follows: whole tiles in one call.
            done = part.rows - part.rows % mr;
            ctx.kernels.product_tiles_s8(
                p.few,
                ProductS8 {
                    kernels: ctx.kernels,
                    panels: part.panels,
                    steps: here,
                    a: &packed[s0 * mr * quad..],
                    a_stride: steps * mr * quad,
                    w: &w[s0 * STEP..],
                    w_stride: steps * STEP,
                    start,
                    finish: epilogue(p, Part { rows: done, ..part }, (&columns, &[])),
                    acc: &mut *acc,
                    next,
                    per_step,
                },
            );
        }
        for r in (done..part.rows).step_by(mr) {
            let (tile, rows) = (r / mr, mr.min(part.rows - r));
            let width = p.kernel.fit(rows);
            let acc = &mut acc[tile * size..][..size];
            // A share of the next panels, which come from beyond the second-level cache, and after the last block the outputs.
            let mut ahead = Ahead::nothing(packed).with_weights(next.wrapping_add(tile * here * per_step), per_step);
            if last && let Sink::Values { out, stride, first, .. } = &p.sink {
                ahead = ahead.with_outputs(out.at((part.first + r - first) * stride + part.panel * NR), *stride);
            }
            let one = TileS8 {
                rows: width,
                panels: part.panels,
                steps: here,
                a: &packed[(r * steps + s0 * width) * quad..][..here * width * quad],
                w: &w[s0 * STEP..],
                w_stride: steps * STEP,
                start,
                acc: &mut *acc,
                acc_stride: mr * NR,
                ahead,
            };
            ctx.kernels.product_tile_s8(p.few, one);
            if last {
                finish_tile(ctx, p, Part { first: part.first + r, rows, ..part }, (&columns, acc));
            }
        }
        if last {
            return;
        }
        s0 += here;
    }
}

/// Sums of one tile to the output.
fn finish_tile(ctx: Ctx, p: &Product, part: Part, (columns, acc): (&ColumnsS8, &[i32])) {
    let Sink::Sums(out) = &p.sink else {
        ctx.kernels.finish_s8(epilogue(p, part, (columns, acc)));
        return;
    };
    let col = part.panel * NR;
    let cols = (part.panels * NR).min(p.w.n - col);
    for r in 0..part.rows {
        let at = (part.first + r) * p.w.n + col;
        // SAFETY: every output belongs to one tile of one task, and a piece lives only in this loop.
        #[allow(unsafe_code)]
        let out = unsafe { out.slice(at..at + cols) };
        for (v, out) in out.chunks_mut(NR).enumerate() {
            out.copy_from_slice(&acc[v * p.kernel.mr * NR + r * NR..][..out.len()]);
        }
    }
}

/// The epilogue of some rows of a group of panels, for a product that has one.
fn epilogue<'a>(p: &'a Product, part: Part, (columns, acc): (&'a ColumnsS8, &'a [i32])) -> FinishS8<'a> {
    let Sink::Values { ep, out, stride, first } = &p.sink else { panic!("sums have no epilogue") };
    let col = part.panel * NR;
    FinishS8 {
        acc,
        acc_stride: p.kernel.mr * NR,
        panels: part.panels,
        row_scales: &p.a.scales[part.first..part.first + part.rows],
        columns,
        act: ep.act,
        gamma: ep.gamma.is_some(),
        plus: if ep.residual { Plus::Output } else { Plus::Nothing },
        relu_sum: false,
        out,
        at: (part.first - first) * stride + col,
        stride: *stride,
        cols: (part.panels * NR).min(p.w.n - col),
    }
}

fn checked<'a>(a: RowsS8<'a>, w: PanelsS8<'a>) -> (RowsS8<'a>, PanelsS8<'a>) {
    let (a, w) = (a.checked(), w.checked());
    assert_eq!(a.k, w.k, "inputs of an int8 product");
    (a, w)
}

/// `a` `[m, k]` times the transpose of `w` `[n, k]` -> `out` `[m, n]`:
/// y = act(fma(f32(sum), row scale * output scale, bias)), y = y * gamma, out = out + y with `residual`, else y.
pub fn gemm_s8(ctx: Ctx, a: RowsS8, w: PanelsS8, ep: Epilogue, out: MatMut) {
    let (a, w) = checked(a, w);
    assert_eq!((out.rows, out.cols), (a.m, w.n), "outputs of an int8 product");
    for (what, v) in [("bias", ep.bias), ("gamma", ep.gamma)] {
        assert!(v.is_none_or(|v| v.len() == w.n), "{what} of {} outputs", w.n);
    }
    let stride = out.stride;
    let (macs, bytes) = (a.m * w.n * w.k, (a.m + w.n) * w.k + 4 * a.m * w.n);
    let _span = opclock::span(Op::GemmS8, || Work { macs: macs as u64, bytes: bytes as u64 });
    let sink = Sink::Values { ep, out: SharedMut::new(out.data), stride, first: 0 };
    product(ctx, &Product::new(ctx, a, w, sink));
}

/// f32 values of a block of rows that wait to be quantized: 256 KiB.
const WAITING: usize = 1 << 16;

/// Most f32-sized values of working memory that each thread of the pool keeps after [`gemm_s8_quantize`] of up to `k` inputs and
/// `n` outputs, whatever the kernel; for memory plans.
pub fn working_memory_s8_quantize(k: usize, n: usize) -> usize {
    working_memory_s8(k) + WAITING.max(MAX_MR * n) + n
}

/// [`gemm_s8`] and [`crate::quantize::quantize`] in one: the f32 outputs of a block of rows stay in the cache until they are quantized and
/// are never written to memory. `a` `[m, k]` times the transpose of `w` `[n, k]` through `ep` (without residual), then `before` and
/// quantization per row -> `out` `[m, n]`; the same bits as the two steps.
///
/// Blocks have some 65,536 outputs, so weights are read once per 65,536 / n rows: right up to n about 2048, while weights stay in the
/// caches; beyond that the two steps are faster.
pub fn gemm_s8_quantize(ctx: Ctx, a: RowsS8, w: PanelsS8, ep: Epilogue, before: Before, out: RowsS8Mut) {
    let (a, w) = checked(a, w);
    let (m, n) = (a.m, w.n);
    assert!(!ep.residual, "no residual where outputs are quantized");
    for (what, v) in [("bias", ep.bias), ("gamma", ep.gamma)] {
        assert!(v.is_none_or(|v| v.len() == n), "{what} of {n} outputs");
    }
    before.check(n);
    assert_eq!((out.m, out.k), (m, n), "size of quantized rows");
    let out_width = padded_k(n);
    assert!(out.data.len() == m * out_width && out.scales.len() == m, "bytes and scales of {m} rows of {out_width}");
    if m == 0 || n == 0 {
        out.scales.fill(0.0);
        return;
    }
    let _span = opclock::span(Op::GemmS8, || Work {
        macs: (m * w.n * w.k) as u64,
        bytes: (a.data.len() + w.data.len() + m * out_width) as u64,
    });
    let few = m <= FEW;
    let kernel = ctx.kernels.products_s8(few);
    let (mr, nv) = (kernel.mr, kernel.nr / NR);
    let words = padded_k(w.k) / QUAD * kernel.bytes;
    let tiles = (PACKED / (mr * words.max(1))).min(WAITING / (mr * n)).clamp(1, TILES);
    let row_tiles = m.div_ceil(mr);
    let tasks = row_tiles.div_ceil(tiles);
    let block = row_tiles.div_ceil(tasks) * mr;
    let scratch = LINE + block * (words + nv * NR) + block * n + n;
    let most = working_memory_s8_quantize(w.k, n);
    assert!(scratch <= most, "{scratch} values of working memory, {most} announced");
    ctx.pool.reserve_scratch(scratch);
    let (bytes, scales) = (SharedMut::new(out.data), SharedMut::new(out.scales));
    ctx.pool.run(tasks, &|task, worker| {
        let tiles = piece(row_tiles, tasks, task);
        let first = tiles.start * mr;
        let rows = (tiles.end * mr).min(m) - first;
        ctx.pool.with_scratch(worker, scratch, |memory| {
            let skip = memory.as_ptr().align_offset(LINE * size_of::<f32>()).min(LINE);
            let (acc, memory) = memory[skip..].split_at_mut(block * nv * NR);
            let (packed, memory) = memory.split_at_mut(block * words);
            let (values, work) = memory.split_at_mut(block * n);
            let acc: &mut [i32] = bytemuck::cast_slice_mut(acc);
            {
                let sink = Sink::Values { ep, out: SharedMut::new(values), stride: n, first };
                let p = Product { few, kernel, a, w, sink };
                pack_block(ctx, &p, first..first + rows, packed);
                for panel in (0..n.div_ceil(NR)).step_by(nv) {
                    let panels = nv.min(n.div_ceil(NR) - panel);
                    block_of_panels(ctx, &p, Part { first, rows, panel, panels }, (packed, acc));
                }
            }
            for (r, x) in values[..rows * n].chunks_exact(n).enumerate() {
                let row = first + r;
                // SAFETY: rows are disjoint and each belongs to one task.
                #[allow(unsafe_code)]
                let (out, scale) =
                    unsafe { (bytes.slice(row * out_width..(row + 1) * out_width), scales.slice(row..row + 1)) };
                scale[0] = ctx.kernels.quantize(QuantizeRow { x, before, work: &mut work[..n], out });
            }
        });
    });
}

/// The exact sums of [`gemm_s8`], `[m, n]`: what every kernel must agree on.
pub fn gemm_s8_sums(ctx: Ctx, a: RowsS8, w: PanelsS8, out: &mut [i32]) {
    let (a, w) = checked(a, w);
    assert_eq!(out.len(), a.m * w.n, "outputs of an int8 product");
    product(ctx, &Product::new(ctx, a, w, Sink::Sums(SharedMut::new(out))));
}
