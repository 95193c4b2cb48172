//! softmax(q k^T / sqrt(d)) v with both products in int8: exact i32 sums, f32 between them.
//!
//! For each head and frame, before anything is multiplied:
//!
//! ```text
//! q, k   norm, rotary embedding, rotation (each optional)
//! k      k - mean key of the frame; s8 per key
//! q      s8 per query, 1/sqrt(d) in its scale
//! v      s8 per channel and 64 keys
//! ```
//!
//! For each 64 keys of a visible frame, for 32 queries:
//!
//! ```text
//! S = K q                      exact; score t = S * key scale
//! top = max t;  P = round(254 e^((t - top) * query scale) + dither), 0 to 254
//! den = sum P;  N = V^T P      exact
//! M' = max(M, top * query scale + shift);  w = e^(top .. - M'), k = e^(M - M')
//! D = D k + den w;  O = O k + N * value scale * w
//! ```
//!
//! and in the end O / D. The dither of a key is a constant of its place in the tile, so that small weights keep their sum
//! instead of vanishing (`softmax::DITHER`). A query that sees no key gives exactly 0. The mean key of a frame moves all scores of a query with
//! the keys of that frame by q . mean, which is added back as the shift of that frame, in f32 and from the query before it was
//! quantized. A query that sees one frame needs no shift: its softmax does not change when all its scores move. So a result
//! depends on visible frames only, and a frame is packed the same way whatever stands beside it.
//!
//! Weights are signed bytes P - 127 in the products, because the tiles take signed bytes on that side; 127 times the sum of the
//! values (and of the keys counted) is added back exactly.

use super::FrameMask;
use super::heads::{
    HeadNorm, HeadRows, KEYS, KeyPack, MAX_D, QueryPack, STAGE_ROWS, Turn, ValuePack, padded_bytes, padded_d,
    value_tile_len,
};
use super::integers::{Place, Watch};
use super::softmax::{MergeS8, Rows, WEIGHT_ZERO, WeightsS8};
use crate::cpu::{Ctx, Kernels};
use crate::gemm::ahead::Ahead;
use crate::gemm::pack::{Change, MAX_MR, RowPack, strided};
use crate::gemm::s8::pack::{QUAD, STEP};
use crate::gemm::s8::table::Activations;
use crate::gemm::s8::tile::{ColumnS8, MAX_NV, TileS8};
use crate::gemm::tile::Tile;
use crate::gemm::{NR, PanelData};
use crate::hadamard::Rotation;
use crate::mat::{Mat, MatMut};
use crate::opclock::{self, Op};
use crate::par::SharedMut;
use crate::prefetch::near_for_writing;
use crate::rope::{QkNorm, RopeTable};
use crate::simd::LANES;

/// Panels of queries of one task.
const PANELS: usize = 2;
/// Queries of one task.
const QUERIES: usize = PANELS * NR;
/// Rows of scores, with room for a tile that is rounded up.
const SCORE_ROWS: usize = KEYS + MAX_MR;
/// f32 values of a cache line.
const LINE: usize = 16;
/// One row of ones for so many steps, to sum panels with a tile.
static ONES: [i8; MAX_D] = [1; MAX_D];

/// q, k and v of a clip, and what happens to q and k before the scores.
#[derive(Clone, Copy, Debug)]
pub struct Heads<'a> {
    /// `[frames * tokens, 3 * heads * d]`: q | k | v, head h in columns h d.. of each part. d: 4..=256, a multiple of 4.
    pub qkv: Mat<'a>,
    /// Heads.
    pub heads: usize,
    /// Norm of q and k; none where they have none, or have it already.
    pub norm: Option<QkNorm<'a>>,
    /// Rotary embedding after the norm; row r uses entry r modulo the table's length.
    pub rope: Option<&'a RopeTable>,
    /// Random-sign Hadamard rotation of every head of q and k, of width d (a multiple of 16). Scores do not change with it, for
    /// it is orthogonal; it spreads outlier channels before the quantization.
    pub rotation: Option<Rotation<'a>>,
}

impl Heads<'_> {
    /// Head width.
    pub fn head_dim(&self) -> usize {
        self.qkv.cols / (3 * self.heads.max(1))
    }

    /// Checks everything against the mask; returns d.
    pub(crate) fn checked(&self, mask: &FrameMask) -> usize {
        let Heads { qkv, heads, norm, rope, rotation } = self;
        assert_eq!(qkv.rows, mask.frames * mask.tokens, "{} frames of {} tokens", mask.frames, mask.tokens);
        assert!(*heads > 0 && qkv.cols.is_multiple_of(3 * heads), "{} columns for {heads} heads", qkv.cols);
        let d = self.head_dim();
        assert!((4..=MAX_D).contains(&d) && d.is_multiple_of(4), "head width {d} is not a multiple of 4 in 4..=256");
        if let Some(n) = norm {
            for v in [n.q_gain, n.q_offset, n.k_gain, n.k_offset] {
                assert_eq!(v.len(), d, "gains and offsets of a head of width {d}");
            }
        }
        if let Some(t) = rope {
            assert!(t.head_dim() == d && !t.is_empty(), "a rotary table of width {} for heads of {d}", t.head_dim());
        }
        if let Some(r) = rotation {
            assert_eq!(r.width(), d, "width of the rotation of a head");
        }
        d
    }

    /// Factor of every score, beside the scales of query and key: 1/sqrt(d), and what the rotation of both sides leaves out.
    pub(crate) fn factor(&self, d: usize) -> f32 {
        let block = self.rotation.map_or(1, |r| r.block());
        (1.0 / ((d as f64).sqrt() * block as f64)) as f32
    }
}

/// Sizes of the parts of the scratch, in f32 values, each a multiple of a cache line.
struct Room {
    /// Packed keys of one frame and head.
    k: usize,
    /// Scales of the keys.
    scales: usize,
    /// Mean key.
    mean: usize,
    /// Packed values.
    v: usize,
    /// Steps and offsets of the values.
    columns: usize,
    /// Working memory of one thread.
    worker: usize,
}

/// Pieces of the working memory of a thread while it packs: prepared rows, bytes, quads.
fn packing_lens(tokens: usize, d: usize) -> [usize; 3] {
    let width = padded_d(d);
    let stage = (KEYS / QUAD * width + LINE).max(d / QUAD * STAGE_ROWS);
    [tokens * width + LINE, LANES * padded_bytes(d) / QUAD, stage].map(|n| n.next_multiple_of(LINE))
}

/// Pieces of the working memory of a thread while it multiplies: prepared rows, bytes, panels of queries, queries in f32,
/// scores, weights, sums, running sums.
fn block_lens(d: usize) -> [usize; 8] {
    let width = padded_d(d);
    [
        LANES * width + LINE,
        LANES * padded_bytes(d) / QUAD,
        QUERIES * d / QUAD,
        QUERIES * d,
        PANELS * SCORE_ROWS * NR,
        QUERIES * KEYS / QUAD,
        QUERIES * (d + MAX_MR),
        QUERIES * d,
    ]
    .map(|n| n.next_multiple_of(LINE))
}

/// The first pieces of `memory`, of these lengths.
fn pieces<const N: usize>(mut memory: &mut [f32], lens: [usize; N]) -> [&mut [f32]; N] {
    lens.map(|n| {
        let (piece, rest) = std::mem::take(&mut memory).split_at_mut(n);
        memory = rest;
        piece
    })
}

impl Room {
    fn new(tokens: usize, d: usize) -> Room {
        let width = padded_d(d);
        let tiles = tokens.div_ceil(KEYS);
        let line = |n: usize| n.next_multiple_of(LINE);
        let packing: usize = packing_lens(tokens, d).iter().sum();
        let block: usize = block_lens(d).iter().sum();
        Room {
            k: line((tokens + MAX_MR) * d / QUAD),
            scales: line(tokens),
            mean: line(width),
            // Whatever the kernel rounds the channels up to.
            v: line(tiles * (d + MAX_MR) * KEYS / QUAD),
            columns: line(tiles * 2 * width),
            worker: packing.max(block),
        }
    }

    fn unit(&self) -> usize {
        self.k + self.scales + self.mean + self.v + self.columns
    }
}

/// f32 values of scratch that [`attention_s8`] needs in a pool of `threads`.
pub fn scratch_len_s8(mask: &FrameMask, heads: usize, head_dim: usize, threads: usize) -> usize {
    let room = Room::new(mask.tokens, head_dim);
    LINE + mask.frames * heads * room.unit() + threads * room.worker
}

/// One frame and head of the clip, packed.
struct Unit<'a> {
    k: &'a [i8],
    scales: &'a [f32],
    mean: &'a [f32],
    v: &'a [i8],
    columns: &'a [f32],
}

/// One call, resolved.
struct Job<'a> {
    kernels: &'static Kernels,
    x: Heads<'a>,
    d: usize,
    mask: FrameMask,
    room: Room,
    watch: Option<&'a Watch>,
}

/// Which queries.
#[derive(Clone, Copy)]
struct Block {
    frame: usize,
    head: usize,
    first: usize,
}

/// State of 32 queries between the tiles of keys.
struct Running {
    /// Scale of each query, with the factor of the scores.
    scales: [[f32; LANES]; PANELS],
    /// Where score sums start.
    start: [[i32; LANES]; PANELS],
    /// q . mean key of the frame at hand.
    shift: [[f32; LANES]; PANELS],
    top: [[f32; LANES]; PANELS],
    total: [[f32; LANES]; PANELS],
}

impl<'a> Job<'a> {
    /// Rows of q (part 0) or k (part 1) of a head from a token on.
    fn head_rows(&self, part: usize, at: Block, rows: usize) -> HeadRows<'a> {
        let Heads { qkv, heads, norm, rope, rotation } = self.x;
        let row = at.frame * self.mask.tokens + at.first;
        let x = &qkv.data[row * qkv.stride + (part * heads + at.head) * self.d..];
        let norm = norm.map(|n| {
            let (gain, offset) = if part == 0 { (n.q_gain, n.q_offset) } else { (n.k_gain, n.k_offset) };
            HeadNorm { gain, offset, eps: n.eps }
        });
        HeadRows {
            x,
            stride: qkv.stride,
            rows,
            d: self.d,
            norm,
            rope: rope.map(|table| Turn { table, first: row, step: 1 }),
            rotation,
        }
    }

    /// Packs keys and values of a frame and head into its part of the scratch.
    fn pack(&self, frame: usize, head: usize, to: &mut [f32], memory: &mut [f32]) {
        let (d, tokens, room) = (self.d, self.mask.tokens, &self.room);
        let [k, scales, mean, v, columns] = pieces(to, [room.k, room.scales, room.mean, room.v, room.columns]);
        let [work, bytes, stage] = pieces(memory, packing_lens(tokens, d));
        let kernel = self.kernels.gemm_s8;
        self.kernels.pack_keys(KeyPack {
            rows: self.head_rows(1, Block { frame, head, first: 0 }, tokens),
            kernel,
            work,
            bytes,
            stage: bytemuck::cast_slice_mut(&mut *stage),
            mean: &mut mean[..padded_d(d)],
            scales: &mut scales[..tokens],
            out: bytemuck::cast_slice_mut(k),
        });
        let Heads { qkv, heads, .. } = self.x;
        self.kernels.pack_values(ValuePack {
            x: &qkv.data[frame * tokens * qkv.stride + (2 * heads + head) * d..],
            stride: qkv.stride,
            rows: tokens,
            d,
            kernel,
            stage: bytemuck::cast_slice_mut(stage),
            columns,
            out: bytemuck::cast_slice_mut(v),
        });
    }

    fn unit<'s>(&self, packed: &'s [f32], frame: usize, head: usize) -> Unit<'s> {
        let room = &self.room;
        let unit = &packed[(frame * self.x.heads + head) * room.unit()..][..room.unit()];
        let (k, rest) = unit.split_at(room.k);
        let (scales, rest) = rest.split_at(room.scales);
        let (mean, rest) = rest.split_at(room.mean);
        let (v, columns) = rest.split_at(room.v);
        Unit { k: bytemuck::cast_slice(k), scales, mean, v: bytemuck::cast_slice(v), columns }
    }

    /// Sums of the bytes of each output of some panels `[steps][16][4]`, times -128: where sums start in a kernel that takes
    /// activations as s8 + 128. Zeros for the others.
    fn starts(&self, sums: &[i32; LANES]) -> [i32; LANES] {
        match self.kernels.gemm_s8.activations {
            Activations::Signed => [0; LANES],
            Activations::Offset128 => sums.map(|v| v.wrapping_mul(-128)),
        }
    }

    /// Sums of the bytes of each output of one panel of `steps` steps.
    fn byte_sums(&self, panel: &[i8], steps: usize) -> [i32; LANES] {
        let mut sums = [0; LANES];
        self.kernels.tile_s8(TileS8 {
            rows: 1,
            panels: 1,
            steps,
            a: &ONES[..steps * QUAD],
            w: panel,
            w_stride: steps * STEP,
            start: None,
            acc: &mut sums,
            acc_stride: LANES,
            ahead: Ahead::nothing(panel),
        });
        sums
    }

    /// Attention of up to 32 queries of one head.
    fn block(&self, at: Block, packed: &[f32], memory: &mut [f32], (out, stride): (&SharedMut<f32>, usize)) {
        let (d, tokens) = (self.d, self.mask.tokens);
        let queries = QUERIES.min(tokens - at.first);
        let panels = queries.div_ceil(NR);
        let seen = self.mask.keys(at.frame);
        let first_out = (at.frame * tokens + at.first) * stride + at.head * d;
        if seen.is_empty() {
            for q in 0..queries {
                // SAFETY: the columns of one head in one row belong to one block.
                #[allow(unsafe_code)]
                unsafe { out.slice(first_out + q * stride..first_out + q * stride + d) }.fill(0.0);
            }
            return;
        }
        let [work, bytes, q, q_f32, scores, weights, sums, acc] = pieces(memory, block_lens(d));
        let (steps, room) = (d / QUAD, &self.room);
        let q: &mut [u32] = bytemuck::cast_slice_mut(q);
        let mut run = Running {
            scales: [[0.0; LANES]; PANELS],
            start: [[0; LANES]; PANELS],
            shift: [[0.0; LANES]; PANELS],
            top: [[f32::NEG_INFINITY; LANES]; PANELS],
            total: [[0.0; LANES]; PANELS],
        };
        let factor = self.x.factor(d);
        for p in 0..panels {
            let rows = NR.min(queries - p * NR);
            let panel = &mut q[p * steps * NR..][..steps * NR];
            self.kernels.pack_queries(QueryPack {
                rows: self.head_rows(0, Block { first: at.first + p * NR, ..at }, rows),
                work,
                bytes,
                factor,
                scales: &mut run.scales[p],
                out: &mut *panel,
            });
            if self.kernels.gemm_s8.activations == Activations::Offset128 {
                run.start[p] = self.starts(&self.byte_sums(bytemuck::cast_slice(panel), steps));
            }
            if seen.len() > 1 {
                let from = strided(work, padded_d(d), NR);
                let to = &mut q_f32[p * NR * d..];
                self.kernels.pack(RowPack { from, k: d, width: NR, change: Change::Scale(factor), out: to });
            }
        }
        let q: &[i8] = bytemuck::cast_slice(q);
        let scores: &mut [i32] = bytemuck::cast_slice_mut(scores);
        let weights: &mut [i8] = bytemuck::cast_slice_mut(weights);
        let sums: &mut [i32] = bytemuck::cast_slice_mut(sums);
        acc.fill(0.0);
        // The outputs' rows lie pages apart: some are asked for with each tile of keys.
        let asked = queries.div_ceil(seen.len() * tokens.div_ceil(KEYS));
        let mut ask = 0..queries;
        for frame in seen.clone() {
            let unit = self.unit(packed, frame, at.head);
            if seen.len() > 1 {
                self.shifts(&unit, q_f32, &mut run.shift[..panels]);
            }
            for first in (0..tokens).step_by(KEYS) {
                let keys = KEYS.min(tokens - first);
                for q in ask.by_ref().take(asked) {
                    for c in (0..d).step_by(LINE) {
                        near_for_writing(out.at(first_out + q * stride + c));
                    }
                }
                self.scores(&unit, (first, keys), (q, panels), &run.start, scores);
                if let Some(watch) = self.watch {
                    let place = Place { row: at.frame * tokens + at.first, head: at.head, queries };
                    watch.scores(place, scores, SCORE_ROWS, keys);
                }
                let mut tile_top = [[0.0; LANES]; PANELS];
                let mut weight_sums = [[0; LANES]; PANELS];
                let key_steps = keys.div_ceil(QUAD);
                for p in 0..panels {
                    let weights = &mut weights[p * KEYS * NR..][..key_steps * STEP];
                    self.kernels.weights_s8(WeightsS8 {
                        scores: &mut scores[p * SCORE_ROWS * NR..],
                        key_scales: &unit.scales[first..first + keys],
                        query_scales: &run.scales[p],
                        top: &mut tile_top[p],
                        weights,
                        totals: &mut weight_sums[p],
                    });
                }
                self.values(&unit, (first, keys), (weights, panels), &weight_sums, sums);
                let columns = &unit.columns[first / KEYS * 2 * padded_d(d)..][..2 * padded_d(d)];
                let (value_steps, offsets) = columns.split_at(padded_d(d));
                if let Some(watch) = self.watch {
                    let place = Place { row: at.frame * tokens + at.first, head: at.head, queries };
                    watch.sums(place, (weights, KEYS * NR, keys), &weight_sums, (sums, d + MAX_MR, &offsets[..d]));
                }
                for p in 0..panels {
                    self.kernels.merge_s8(MergeS8 {
                        sums: &sums[p * (d + MAX_MR) * NR..],
                        steps: &value_steps[..d],
                        offsets: &offsets[..d],
                        weights: &weight_sums[p],
                        weight_offset: (WEIGHT_ZERO as usize * key_steps * QUAD) as f32,
                        tile_top: &tile_top[p],
                        query_scales: &run.scales[p],
                        shift: &run.shift[p],
                        top: &mut run.top[p],
                        total: &mut run.total[p],
                        out: &mut acc[p * d * NR..][..d * NR],
                    });
                }
            }
        }
        debug_assert!(room.worker >= block_lens(d).iter().sum());
        for p in 0..panels {
            self.kernels.store_rows(Rows {
                sums: &mut acc[p * d * NR..][..d * NR],
                total: &run.total[p],
                queries: NR.min(queries - p * NR),
                out,
                at: first_out + p * NR * stride,
                stride,
            });
        }
    }

    /// q . mean key of a frame, per query, by the f32 tile.
    fn shifts(&self, unit: &Unit, q: &[f32], shift: &mut [[f32; LANES]]) {
        let nv = self.kernels.gemm_f32.nr / NR;
        for (p, shift) in (0..).step_by(nv).zip(shift.chunks_mut(nv)) {
            self.kernels.tile(Tile {
                rows: 1,
                panels: shift.len(),
                k: self.d,
                a: &unit.mean[..self.d],
                w: PanelData::F32(&q[p * NR * self.d..]),
                w_stride: NR * self.d,
                start: true,
                acc: shift.as_flattened_mut(),
                acc_stride: NR,
                ahead: Ahead::nothing(unit.mean),
            });
        }
    }

    /// Sums of keys times queries of one tile.
    fn scores(
        &self,
        unit: &Unit,
        (first, keys): (usize, usize),
        (q, panels): (&[i8], usize),
        start: &[[i32; LANES]; PANELS],
        out: &mut [i32],
    ) {
        let (steps, nv) = (self.d / QUAD, self.kernels.gemm_s8.nr / NR);
        for p in (0..panels).step_by(nv) {
            self.kernels.column_s8(ColumnS8 {
                rows: keys,
                panels: nv.min(panels - p),
                steps,
                a: &unit.k[first * steps * QUAD..],
                w: &q[p * steps * STEP..],
                w_stride: steps * STEP,
                start: &group(start, p),
                acc: &mut out[p * SCORE_ROWS * NR..],
                acc_stride: SCORE_ROWS * NR,
            });
        }
    }

    /// Sums of values times weights of one tile.
    fn values(
        &self,
        unit: &Unit,
        (first, keys): (usize, usize),
        (weights, panels): (&[i8], usize),
        weight_sums: &[[i32; LANES]; PANELS],
        out: &mut [i32],
    ) {
        let kernel = self.kernels.gemm_s8;
        let (d, nv) = (self.d, kernel.nr / NR);
        let start: [[i32; LANES]; PANELS] = std::array::from_fn(|p| self.starts(&weight_sums[p]));
        for p in (0..panels).step_by(nv) {
            self.kernels.column_s8(ColumnS8 {
                rows: d,
                panels: nv.min(panels - p),
                steps: keys.div_ceil(QUAD),
                a: &unit.v[first / KEYS * value_tile_len(kernel, d) * QUAD..],
                w: &weights[p * KEYS * NR..],
                w_stride: KEYS * NR,
                start: &group(&start, p),
                acc: &mut out[p * (d + MAX_MR) * NR..],
                acc_stride: (d + MAX_MR) * NR,
            });
        }
    }
}

/// The starts of the panels from `p` on.
fn group(start: &[[i32; LANES]; PANELS], p: usize) -> [[i32; LANES]; MAX_NV] {
    std::array::from_fn(|v| start[(p + v).min(PANELS - 1)])
}

/// `x` under the mask -> `out` `[frames * tokens, heads * d]`, as [`super::attention`] with q and k in int8 per row, values in int8 per
/// channel and 64 keys, weights of the softmax in 255 steps of the largest of 64 keys; sums exact. A query that sees no key gives
/// exactly 0; a NaN or an infinity in a q gives NaN for that query, in a k or v for the queries that see it. `scratch` has
/// [`scratch_len_s8`] values or more, contents unspecified.
pub fn attention_s8(ctx: Ctx, x: Heads, mask: FrameMask, scratch: &mut [f32], out: MatMut) {
    run(ctx, x, mask, scratch, out, None);
}

pub(crate) fn run(ctx: Ctx, x: Heads, mask: FrameMask, scratch: &mut [f32], out: MatMut, watch: Option<&Watch>) {
    let FrameMask { frames, tokens, .. } = mask;
    let d = x.checked(&mask);
    assert_eq!((out.rows, out.cols), (x.qkv.rows, x.heads * d), "output of attention");
    let need = scratch_len_s8(&mask, x.heads, d, ctx.pool.threads());
    assert!(scratch.len() >= need, "{} values of scratch, {need} needed", scratch.len());
    if x.qkv.rows == 0 {
        return;
    }
    let _span = opclock::span(Op::AttentionS8, || super::work(&mask, x.heads * d));
    let skip = scratch.as_ptr().align_offset(LINE * size_of::<f32>()).min(LINE);
    let job = Job { kernels: ctx.kernels, x, d, mask, room: Room::new(tokens, d), watch };
    let (unit_len, worker_len) = (job.room.unit(), job.room.worker);
    let units = frames * x.heads;
    let (packed, rest) = scratch[skip..].split_at_mut(units * unit_len);
    let memory = SharedMut::new(&mut rest[..ctx.pool.threads() * worker_len]);
    // SAFETY: a worker runs one task at a time, so its piece is borrowed once.
    #[allow(unsafe_code)]
    let own = |worker: usize| unsafe { memory.slice(worker * worker_len..(worker + 1) * worker_len) };

    let to = SharedMut::new(packed);
    ctx.pool.run(units, &|unit, worker| {
        // SAFETY: units are distinct, so their pieces are disjoint.
        #[allow(unsafe_code)]
        let to = unsafe { to.slice(unit * unit_len..(unit + 1) * unit_len) };
        job.pack(unit / x.heads, unit % x.heads, to, own(worker));
    });
    let packed = &*packed;

    let blocks = tokens.div_ceil(QUERIES);
    let stride = out.stride;
    let out = SharedMut::new(out.data);
    // Head by head, so that the blocks in flight share keys and values.
    ctx.pool.run(units * blocks, &|task, worker| {
        let (head, rest) = (task / (frames * blocks), task % (frames * blocks));
        let at = Block { frame: rest / blocks, head, first: rest % blocks * QUERIES };
        job.block(at, packed, own(worker), (&out, stride));
    });
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::cpu::{Features, Isa};
    use crate::gemm::s8::table::GemmS8Kernel;
    use crate::gemm::s8::tile::Dot8;
    use crate::par::Pool;

    /// Activations as s8 + 128 and tiles of two panels, in portable code: what AVX-512-VNNI does, on any CPU.
    #[derive(Clone, Copy)]
    struct Wide;

    impl Wide {
        fn new() -> Self {
            Wide
        }
    }

    impl Dot8 for Wide {
        type Elem = i8;
        type W = [i8; STEP];
        type A = [u8; QUAD];
        type Acc = [i32; LANES];

        fn zero(self) -> [i32; LANES] {
            [0; LANES]
        }

        fn load(self, _pass: usize, x: &[i32; LANES]) -> [i32; LANES] {
            *x
        }

        fn store(self, _pass: usize, acc: [i32; LANES], x: &mut [i32; LANES]) {
            *x = acc;
        }

        fn load_w(self, _pass: usize, x: &[i8; STEP]) -> [i8; STEP] {
            *x
        }

        fn prep_a(self, quad: &[i8; QUAD]) -> [u8; QUAD] {
            quad.map(|v| v as u8)
        }

        fn dot(self, acc: [i32; LANES], a: [u8; QUAD], w: [i8; STEP]) -> [i32; LANES] {
            std::array::from_fn(|l| (0..QUAD).fold(acc[l], |s, i| s + i32::from(a[i]) * i32::from(w[l * QUAD + i])))
        }
    }

    crate::gemm::s8::tile::gemm_s8_entries!(Wide, crate::simd::scalar::Scalar, rows [1, 2, 4, 6, 8, 10, 12], panels [1, 2], full 12 x 2);

    static WIDE: GemmS8Kernel = GemmS8Kernel {
        name: "gemm_s8_12x32_test",
        needs: Features::NONE,
        mr: 12,
        nr: 32,
        rows: &[1, 2, 4, 6, 8, 10, 12],
        activations: Activations::Offset128,
        bytes: 1,
        run: gemm_s8,
        windows: conv_s8,
        column: column_s8,
        product: product_s8,
        peak: peak_s8,
    };

    #[test]
    fn wide_tiles_of_unsigned_activations_give_the_same_bits() {
        let plain = Kernels::capped(Isa::Scalar).unwrap();
        let kernels: &'static Kernels = Box::leak(Box::new(Kernels { gemm_s8: &WIDE, ..*plain }));
        let pool = Pool::new(2).unwrap();
        for (frames, tokens, heads, d) in [
            (1, 1, 1, 4),
            (2, 3, 1, 8),
            (2, 17, 2, 12),
            (2, 65, 1, 20),
            (1, 100, 1, 64),
            (1, 133, 2, 40),
            (3, 33, 1, 72),
        ] {
            let (rows, c) = (frames * tokens, heads * d);
            let x: Vec<f32> = (0..rows * 3 * c).map(|i| ((i * 7919 % 4093) as f32 - 1900.0) * 0.0007).collect();
            let x = Heads { qkv: Mat::new(&x, rows, 3 * c), heads, norm: None, rope: None, rotation: None };
            let mask = FrameMask { frames, tokens, lo: -1, hi: 1 };
            let [a, b] = [plain, kernels].map(|kernels| {
                let mut scratch = vec![f32::NAN; scratch_len_s8(&mask, heads, d, 2)];
                let mut y = vec![0.0; rows * c];
                attention_s8(Ctx { pool: &pool, kernels }, x, mask, &mut scratch, MatMut::new(&mut y, rows, c));
                y.iter().map(|v| v.to_bits()).collect::<Vec<u32>>()
            });
            assert_eq!(a, b, "{frames} frames of {tokens} tokens, {heads} heads of {d}");
        }
    }
}
