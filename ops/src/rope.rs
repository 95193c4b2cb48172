//! Per-head norm of q and k and two-dimensional rotary position embedding (network.md 1.3).
//!
//! A head of width d is two halves of size D = d/2: the first turns with the row index, the second
//! with the column index. Inside a half, theta_m = position * base^(-2m/D), m = 0..D/2, and channel m pairs
//! with channel m + D/2 (half-rotate, not interleaved):
//! out_m = a_m cos - a_(m+D/2) sin, out_(m+D/2) = a_(m+D/2) cos + a_m sin.
//! Tables are computed in f64 with [`crate::trig`] and stored as f32.

use crate::attention::heads::{HeadNorm, HeadRows, MAX_D, Turn, by_vectors, padded_d, prepare};
use crate::cpu::Ctx;
use crate::mat::MatMut;
use crate::opclock::{self, Op, Work};
use crate::par::SharedMut;
use crate::simd::{LANES, Simd, Vector};
use crate::trig;

/// What happens to an angle before its sine and cosine are taken.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum AngleRound {
    /// f64 all the way.
    #[default]
    None,
    /// Rounded to bfloat16, as the released half-precision pipelines do (up to 0.058 rad at position 44);
    /// sines and cosines of the rounded angles stay f32.
    Bf16,
}

/// cos and sin for every token of a frame.
#[derive(Clone, Debug)]
pub struct RopeTable {
    /// `[tokens, d/2]`: row angles first, column angles second; then 16 zeros, so that a whole vector may be loaded
    /// from any angle on.
    cos: Vec<f32>,
    sin: Vec<f32>,
    tokens: usize,
    head_dim: usize,
}

/// Round to bfloat16, ties to even; finite input.
fn bf16(x: f32) -> f32 {
    half::bf16::from_f32(x).to_f32()
}

impl RopeTable {
    /// Table for tokens at `positions` (row, column); patches count from 1, special tokens stand at (0, 0) and
    /// are not turned.
    pub fn new(positions: &[(u32, u32)], head_dim: usize, base: f64, round: AngleRound) -> RopeTable {
        assert!(head_dim.is_multiple_of(4) && head_dim > 0, "head width {head_dim} is not a multiple of 4");
        let quarter = head_dim / 4;
        let inverse: Vec<f64> = (0..quarter).map(|m| trig::pow(base, -(m as f64) / quarter as f64)).collect();
        let values = positions.len() * 2 * quarter + LANES;
        let (mut cos, mut sin) = (Vec::with_capacity(values), Vec::with_capacity(values));
        for &(row, col) in positions {
            for position in [row, col] {
                for w in &inverse {
                    let angle = f64::from(position) * w;
                    let (s, c) = match round {
                        AngleRound::None => trig::sin_cos(angle),
                        AngleRound::Bf16 => trig::sin_cos(f64::from(bf16(angle as f32))),
                    };
                    cos.push(c as f32);
                    sin.push(s as f32);
                }
            }
        }
        cos.resize(cos.len() + LANES, 0.0);
        sin.resize(sin.len() + LANES, 0.0);
        RopeTable { cos, sin, tokens: positions.len(), head_dim }
    }

    /// Tokens in the table.
    pub fn len(&self) -> usize {
        self.tokens
    }

    /// Whether the table has no token.
    pub fn is_empty(&self) -> bool {
        self.tokens == 0
    }

    /// Head width d.
    pub fn head_dim(&self) -> usize {
        self.head_dim
    }

    /// (cos, sin) of one token and of what follows: d/2 values, and 16 more.
    #[inline]
    pub(crate) fn lanes(&self, token: usize) -> (&[f32], &[f32]) {
        let n = self.head_dim / 2;
        (&self.cos[token * n..][..n + LANES], &self.sin[token * n..][..n + LANES])
    }

    /// (cos, sin) of one token, d/2 values each: d/4 row angles, then d/4 column angles.
    pub fn entry(&self, token: usize) -> (&[f32], &[f32]) {
        let n = self.head_dim / 2;
        (&self.cos[token * n..][..n], &self.sin[token * n..][..n])
    }
}

/// Gains and offsets (each of head width d, shared by the heads) of the q and k norms.
#[derive(Clone, Copy, Debug)]
pub struct QkNorm<'a> {
    /// Gain of q.
    pub q_gain: &'a [f32],
    /// Offset of q.
    pub q_offset: &'a [f32],
    /// Gain of k.
    pub k_gain: &'a [f32],
    /// Offset of k.
    pub k_offset: &'a [f32],
    /// Added to the variance; 1e-5 in Pi3 while its block norms have 1e-6.
    pub eps: f32,
}

/// The q and k parts of one token.
pub(crate) struct RopeRow<'a> {
    /// q | k, `2 * heads * d` values.
    pub qk: &'a mut [f32],
    /// `2 * heads` rows of padded width and 16 values more.
    pub work: &'a mut [f32],
    /// Head width.
    pub d: usize,
    /// Norm of q and k.
    pub norm: Option<&'a QkNorm<'a>>,
    /// Table and token.
    pub turn: Option<(&'a RopeTable, usize)>,
}

/// a cos - b sin and b cos + a sin; the second product is rounded, the first fused.
#[inline(always)]
pub(crate) fn turn<V: Vector>(a: V, b: V, cos: V, sin: V, zero: V) -> (V, V) {
    (a.mul_add(cos, zero - b * sin), b.mul_add(cos, a * sin))
}

/// Norm, then rotation, of every head of one token.
#[inline(always)]
pub(crate) fn rope_row<S: Simd>(s: S, row: RopeRow) {
    by_vectors!(rope_row_of, s, row, row.d);
}

#[inline(always)]
fn rope_row_of<S: Simd>(s: S, row: RopeRow, n: usize) {
    let RopeRow { qk, work, d, norm, turn } = row;
    let (part, width) = (qk.len() / 2, n * LANES);
    let heads = part / d;
    let rope = turn.map(|(table, first)| Turn { table, first, step: 0 });
    for p in 0..2 {
        let norm = norm.map(|n| {
            let (gain, offset) = if p == 0 { (n.q_gain, n.q_offset) } else { (n.k_gain, n.k_offset) };
            HeadNorm { gain, offset, eps: n.eps }
        });
        let rows = HeadRows { x: &qk[p * part..], stride: d, rows: heads, d, norm, rope, rotation: None };
        prepare(s, &rows, n, &mut work[p * heads * width..]);
    }
    for (i, from) in work.chunks_exact(width).take(2 * heads).enumerate() {
        for (j, lanes) in from.as_chunks::<LANES>().0.iter().enumerate() {
            // What runs over into the next head is written again by it.
            let to = &mut qk[i * d + j * LANES..];
            match to.first_chunk_mut::<LANES>() {
                Some(to) => s.load(lanes).store(to),
                None => {
                    let left = to.len();
                    to.copy_from_slice(&lanes[..left]);
                }
            }
        }
    }
}

/// Rows of one task.
const TASK_ROWS: usize = 16;

/// Norm then rotation of the q and k parts of `qkv` `[rows, 3 * heads * d]`, d at most 256, in place; row r uses table entry
/// r modulo the table's length.
pub fn qk_norm_rope(ctx: Ctx, qkv: MatMut, heads: usize, norm: Option<QkNorm>, rope: Option<&RopeTable>) {
    let MatMut { data, rows, cols, stride } = qkv;
    assert!(heads > 0 && cols.is_multiple_of(3 * heads), "{cols} columns for {heads} heads");
    let d = cols / (3 * heads);
    if let Some(n) = &norm {
        for v in [n.q_gain, n.q_offset, n.k_gain, n.k_offset] {
            assert_eq!(v.len(), d, "gains and offsets of a head of width {d}");
        }
    }
    if let Some(t) = rope {
        assert!(t.head_dim() == d && !t.is_empty(), "a rotary table of width {} for heads of {d}", t.head_dim());
    }
    if d == 0 || norm.is_none() && rope.is_none() {
        return;
    }
    let _span = opclock::span(Op::Norm, || Work::values(rows * 2 * heads * d));
    assert!(d <= MAX_D, "head width {d}, {MAX_D} at most");
    let shared = SharedMut::new(data);
    let scratch = 2 * heads * padded_d(d) + LANES;
    ctx.pool.reserve_scratch(scratch);
    ctx.pool.run(rows.div_ceil(TASK_ROWS), &|task, worker| {
        ctx.pool.with_scratch(worker, scratch, |work| {
            for r in task * TASK_ROWS..((task + 1) * TASK_ROWS).min(rows) {
                // SAFETY: rows are disjoint and each belongs to one task.
                #[allow(unsafe_code)]
                let qk = unsafe { shared.slice(r * stride..r * stride + 2 * heads * d) };
                let turn = rope.map(|t| (t, r));
                ctx.kernels.rope(RopeRow { qk, work: &mut *work, d, norm: norm.as_ref(), turn });
            }
        });
    });
}
