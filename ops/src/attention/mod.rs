//! softmax(q k^T / sqrt(d)) v under a block mask of frames, with streaming softmax over key tiles.

pub(crate) mod heads;
mod int8;
mod integers;
pub(crate) mod softmax;

pub use int8::{Heads, attention_s8, scratch_len_s8};
pub use integers::{QueryIntegers, attention_s8_integers};

use crate::cpu::{Ctx, Kernels};
use crate::gemm::ahead::Ahead;
use crate::gemm::pack::{Change, MAX_MR, RowPack, strided};
use crate::gemm::tile::Tile;
use crate::gemm::{NR, PanelData};
use crate::mat::{Mat, MatMut};
use crate::opclock::{self, Op, Work};
use crate::par::SharedMut;
use softmax::{Rows, SoftmaxTile};

/// Which frames a frame may look at: a query in frame a sees the keys of frame b iff lo <= b - a <= hi.
///
/// Frame attention is lo = hi = 0; global attention lo = -(frames - 1), hi = frames - 1; the causal module's
/// forward pass 0..=k, its backward pass -k..=0.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct FrameMask {
    /// Frames.
    pub frames: usize,
    /// Tokens per frame.
    pub tokens: usize,
    /// Smallest b - a.
    pub lo: i32,
    /// Largest b - a.
    pub hi: i32,
}

impl FrameMask {
    /// Whether queries of frame `a` see keys of frame `b`.
    pub fn sees(&self, a: usize, b: usize) -> bool {
        self.keys(a).contains(&b)
    }

    /// Frames whose keys frame `a` sees.
    pub fn keys(&self, a: usize) -> std::ops::Range<usize> {
        let at = |offset: i64| (a as i64 + offset).clamp(0, self.frames as i64) as usize;
        let (first, end) = (at(i64::from(self.lo)), at(i64::from(self.hi) + 1));
        first..end.max(first)
    }
}

/// Queries of one work unit: two panels.
const QUERIES: usize = 2 * NR;
/// Keys between two rescalings, a multiple of every kernel's tile height (4, 6, 12). 96 keys x 32 queries of scores
/// are 12 KiB, which stay in the first-level cache together with the sums.
const KEYS: usize = 96;

/// f32 values of scratch that [`attention`] needs in a pool of `threads`.
pub fn scratch_len(mask: &FrameMask, heads: usize, head_dim: usize, threads: usize) -> usize {
    let room = Room::new(mask.tokens, head_dim);
    mask.frames * heads * (room.k + room.v) + threads * room.worker
}

/// Sizes of the parts of the scratch.
struct Room {
    /// Packed keys of one frame and head.
    k: usize,
    /// Packed values of one frame and head.
    v: usize,
    /// Working memory of one thread.
    worker: usize,
    /// Rows of the sums.
    d: usize,
}

impl Room {
    fn new(tokens: usize, d: usize) -> Room {
        let pad = MAX_MR - 1;
        let worker = QUERIES * (d + KEYS + pad + d + pad);
        Room { k: (tokens + pad) * d, v: tokens * (d + pad), worker, d: d + pad }
    }
}

/// One call, resolved: shapes and the packed operands.
struct Job<'a> {
    kernels: &'static Kernels,
    qkv: Mat<'a>,
    heads: usize,
    d: usize,
    mask: FrameMask,
}

impl Job<'_> {
    /// Packs the keys of a frame and head as tiles `[d][rows]` and the values as `[tokens][rows of d]`.
    fn pack(&self, frame: usize, head: usize, k: &mut [f32], v: &mut [f32]) {
        let (d, tokens, c) = (self.d, self.mask.tokens, self.heads * self.d);
        let kernel = self.kernels.gemm_f32;
        let stride = self.qkv.stride;
        let base = frame * tokens * stride + head * d;
        for t in (0..tokens).step_by(kernel.mr) {
            let rows = kernel.mr.min(tokens - t);
            let x = &self.qkv.data[base + c + t * stride..];
            let width = kernel.fit(rows);
            let from = strided(x, stride, rows);
            self.kernels.pack(RowPack { from, k: d, width, change: Change::Keep, out: &mut k[t * d..] });
        }
        for r in (0..d).step_by(kernel.mr) {
            let rows = kernel.mr.min(d - r);
            let width = kernel.fit(rows);
            for (t, out) in v[r * tokens..].chunks_exact_mut(width).take(tokens).enumerate() {
                out[..rows].copy_from_slice(&self.qkv.data[base + 2 * c + t * stride + r..][..rows]);
                out[rows..].fill(0.0);
            }
        }
    }

    /// Attention of up to 32 queries from token `first` of a frame for one head; `out` receives d values per query
    /// through `put(query, values by channel)`.
    fn block(&self, at: Block, k: &[f32], v: &[f32], memory: &mut [f32], out: &SharedMut<f32>, out_stride: usize) {
        let Block { frame, head, first } = at;
        let (d, tokens) = (self.d, self.mask.tokens);
        let kernel = self.kernels.gemm_f32;
        let nv = kernel.nr / NR;
        let room = Room::new(tokens, d);
        let queries = QUERIES.min(tokens - first);
        let (q, memory) = memory.split_at_mut(QUERIES * d);
        let score_rows = KEYS + MAX_MR - 1;
        let (scores, sums) = memory.split_at_mut(QUERIES * score_rows);
        let stride = self.qkv.stride;
        let scale = 1.0 / (d as f32).sqrt();
        for p in 0..QUERIES / NR {
            let rows = NR.min(queries.saturating_sub(p * NR));
            let row = frame * tokens + first + p * NR;
            let x = &self.qkv.data[(row * stride + head * d).min(self.qkv.data.len())..];
            let (from, out) = (strided(x, stride, rows), &mut q[p * NR * d..]);
            self.kernels.pack(RowPack { from, k: d, width: NR, change: Change::Scale(scale), out });
        }
        sums.fill(0.0);
        let mut top = [[f32::NEG_INFINITY; NR]; QUERIES / NR];
        let mut total = [[0.0f32; NR]; QUERIES / NR];
        for b in self.mask.keys(frame) {
            let unit = b * self.heads + head;
            let (k, v) = (&k[unit * room.k..][..room.k], &v[unit * room.v..][..room.v]);
            for t in (0..tokens).step_by(KEYS) {
                let keys = KEYS.min(tokens - t);
                for p in (0..QUERIES / NR).step_by(nv) {
                    for r in (0..keys).step_by(kernel.mr) {
                        let rows = kernel.fit(kernel.mr.min(keys - r));
                        self.kernels.tile(Tile {
                            rows,
                            panels: nv,
                            k: d,
                            a: &k[(t + r) * d..][..rows * d],
                            w: PanelData::F32(&q[p * NR * d..]),
                            w_stride: NR * d,
                            start: true,
                            acc: &mut scores[(p * score_rows + r) * NR..],
                            acc_stride: score_rows * NR,
                            ahead: Ahead::nothing(k),
                        });
                    }
                }
                for p in 0..QUERIES / NR {
                    self.kernels.softmax(SoftmaxTile {
                        scores: &mut scores[p * score_rows * NR..][..keys * NR],
                        top: &mut top[p],
                        total: &mut total[p],
                        sums: &mut sums[p * room.d * NR..][..d * NR],
                    });
                }
                for p in (0..QUERIES / NR).step_by(nv) {
                    for r in (0..d).step_by(kernel.mr) {
                        let rows = kernel.fit(kernel.mr.min(d - r));
                        self.kernels.tile(Tile {
                            rows,
                            panels: nv,
                            k: keys,
                            a: &v[r * tokens + t * rows..][..keys * rows],
                            w: PanelData::F32(&scores[p * score_rows * NR..]),
                            w_stride: score_rows * NR,
                            start: false,
                            acc: &mut sums[(p * room.d + r) * NR..],
                            acc_stride: room.d * NR,
                            ahead: Ahead::nothing(v),
                        });
                    }
                }
            }
        }
        let at = (frame * tokens + first) * out_stride + head * d;
        if self.mask.keys(frame).is_empty() {
            for q in 0..queries {
                // SAFETY: the columns of one head in one row belong to one block.
                #[allow(unsafe_code)]
                unsafe { out.slice(at + q * out_stride..at + q * out_stride + d) }.fill(0.0);
            }
            return;
        }
        for p in 0..queries.div_ceil(NR) {
            self.kernels.store_rows(Rows {
                sums: &mut sums[p * room.d * NR..][..d * NR],
                total: &total[p],
                queries: NR.min(queries - p * NR),
                out,
                at: at + p * NR * out_stride,
                stride: out_stride,
            });
        }
    }
}

/// Both products of every query with every key that it sees; q, k, v and the result once.
fn work(mask: &FrameMask, dim: usize) -> Work {
    let pairs: usize = (0..mask.frames).map(|a| mask.keys(a).len() * mask.tokens * mask.tokens).sum();
    Work { macs: (2 * pairs * dim) as u64, bytes: (16 * mask.frames * mask.tokens * dim) as u64 }
}

/// Which queries.
struct Block {
    frame: usize,
    head: usize,
    first: usize,
}

/// `qkv` `[frames * tokens, 3 * heads * d]` holds q | k | v, head h in columns h d.. of each part ->
/// `out` `[frames * tokens, heads * d]`. Head widths 4..=256, multiples of 4. A query that sees no key gives
/// exactly 0. `scratch` has [`scratch_len`] values or more, contents unspecified.
pub fn attention(ctx: Ctx, qkv: Mat, heads: usize, mask: FrameMask, scratch: &mut [f32], out: MatMut) {
    let FrameMask { frames, tokens, .. } = mask;
    assert_eq!(qkv.rows, frames * tokens, "{frames} frames of {tokens} tokens");
    assert!(heads > 0 && qkv.cols.is_multiple_of(3 * heads), "{} columns for {heads} heads", qkv.cols);
    let d = qkv.cols / (3 * heads);
    assert!((4..=256).contains(&d) && d.is_multiple_of(4), "head width {d} is not a multiple of 4 in 4..=256");
    assert_eq!((out.rows, out.cols), (qkv.rows, heads * d), "output of attention");
    let need = scratch_len(&mask, heads, d, ctx.pool.threads());
    assert!(scratch.len() >= need, "{} values of scratch, {need} needed", scratch.len());
    if qkv.rows == 0 {
        return;
    }
    let _span = opclock::span(Op::Attention, || work(&mask, heads * d));
    let room = Room::new(tokens, d);
    let units = frames * heads;
    let (k, rest) = scratch.split_at_mut(units * room.k);
    let (v, rest) = rest.split_at_mut(units * room.v);
    let job = Job { kernels: ctx.kernels, qkv, heads, d, mask };

    let (k_shared, v_shared) = (SharedMut::new(k), SharedMut::new(v));
    ctx.pool.run(units, &|unit, _| {
        // SAFETY: units are distinct, so their pieces are disjoint.
        #[allow(unsafe_code)]
        let (k, v) = unsafe {
            (k_shared.slice(unit * room.k..(unit + 1) * room.k), v_shared.slice(unit * room.v..(unit + 1) * room.v))
        };
        job.pack(unit / heads, unit % heads, k, v);
    });
    let (k, v) = (&*k, &*v);

    let blocks = tokens.div_ceil(QUERIES);
    let memory = SharedMut::new(&mut rest[..ctx.pool.threads() * room.worker]);
    let stride = out.stride;
    let out = SharedMut::new(out.data);
    // Head by head, so that the blocks in flight share keys and values.
    ctx.pool.run(units * blocks, &|task, worker| {
        let (head, rest) = (task / (frames * blocks), task % (frames * blocks));
        let at = Block { frame: rest / blocks, head, first: rest % blocks * QUERIES };
        // SAFETY: a worker runs one task at a time and this is its own piece.
        #[allow(unsafe_code)]
        let memory = unsafe { memory.slice(worker * room.worker..(worker + 1) * room.worker) };
        job.block(at, k, v, memory, &out, stride);
    });
}
