//! Per-head norm of q and k and two-dimensional rotary position embedding (network.md 1.3).
//!
//! A head of width d is two halves of size D = d/2: the first turns with the row index, the second
//! with the column index. Inside a half, theta_m = position * base^(-2m/D), m = 0..D/2, and channel m pairs
//! with channel m + D/2 (half-rotate, not interleaved):
//! out_m = a_m cos - a_(m+D/2) sin, out_(m+D/2) = a_(m+D/2) cos + a_m sin.
//! Tables are computed in f64 with [`crate::trig`] and stored as f32.

use crate::cpu::Ctx;
use crate::layernorm::moments;
use crate::mat::MatMut;
use crate::opclock::{self, Op, Work};
use crate::par::SharedMut;
use crate::simd::{LANES, Simd, Vector, padded};
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
        let mut cos = Vec::with_capacity(positions.len() * 2 * quarter);
        let mut sin = Vec::with_capacity(positions.len() * 2 * quarter);
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
    /// Head width.
    pub d: usize,
    /// Norm of q and k.
    pub norm: Option<&'a QkNorm<'a>>,
    /// cos and sin of the token, d/2 values each.
    pub turn: Option<(&'a [f32], &'a [f32])>,
}

/// a cos - b sin and b cos + a sin; the second product is rounded, the first fused.
#[inline(always)]
pub(crate) fn turn<V: Vector>(a: V, b: V, cos: V, sin: V, zero: V) -> (V, V) {
    (a.mul_add(cos, zero - b * sin), b.mul_add(cos, a * sin))
}

/// Norm, then rotation, of every head of one token.
#[inline(always)]
pub(crate) fn rope_row<S: Simd>(s: S, row: RopeRow) {
    let RopeRow { qk, d, norm, turn: table } = row;
    let half = qk.len() / 2;
    let zero = s.splat(0.0);
    let quarter = d / 4;
    for (i, x) in qk.chunks_exact_mut(d).enumerate() {
        if let Some(n) = norm {
            let (gain, offset) = if i * d < half { (n.q_gain, n.q_offset) } else { (n.k_gain, n.k_offset) };
            let (mean, scale) = moments(s, x, n.eps);
            let (m, k) = (s.splat(mean), s.splat(scale));
            let (xb, xt) = x.as_chunks_mut::<LANES>();
            let (gb, gt) = gain.as_chunks::<LANES>();
            let (ob, ot) = offset.as_chunks::<LANES>();
            for ((x, g), o) in xb.iter_mut().zip(gb).zip(ob) {
                ((s.load(x) - m) * k).mul_add(s.load(g), s.load(o)).store(x);
            }
            if !xt.is_empty() {
                let mut y = [0.0; LANES];
                let v = (s.load(&padded(xt, mean)) - m) * k;
                v.mul_add(s.load(&padded(gt, 0.0)), s.load(&padded(ot, 0.0))).store(&mut y);
                xt.copy_from_slice(&y[..xt.len()]);
            }
        }
        let Some((cos, sin)) = table else { continue };
        for h in 0..2 {
            let (a, b) = x[2 * h * quarter..][..2 * quarter].split_at_mut(quarter);
            let (cos, sin) = (&cos[h * quarter..][..quarter], &sin[h * quarter..][..quarter]);
            let (ab, at) = a.as_chunks_mut::<LANES>();
            let (bb, bt) = b.as_chunks_mut::<LANES>();
            let (cb, ct) = cos.as_chunks::<LANES>();
            let (sb, st) = sin.as_chunks::<LANES>();
            for (((a, b), c), sn) in ab.iter_mut().zip(bb).zip(cb).zip(sb) {
                let (p, q) = turn(s.load(a), s.load(b), s.load(c), s.load(sn), zero);
                p.store(a);
                q.store(b);
            }
            if !at.is_empty() {
                let at_lanes = s.load(&padded(at, 0.0));
                let bt_lanes = s.load(&padded(bt, 0.0));
                let (p, q) = turn(at_lanes, bt_lanes, s.load(&padded(ct, 0.0)), s.load(&padded(st, 0.0)), zero);
                let mut y = [0.0; LANES];
                p.store(&mut y);
                at.copy_from_slice(&y[..at.len()]);
                q.store(&mut y);
                bt.copy_from_slice(&y[..bt.len()]);
            }
        }
    }
}

/// Rows of one task.
const TASK_ROWS: usize = 16;

/// Norm then rotation of the q and k parts of `qkv` `[rows, 3 * heads * d]`, in place; row r uses table entry
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
    let shared = SharedMut::new(data);
    ctx.pool.run(rows.div_ceil(TASK_ROWS), &|task, _| {
        for r in task * TASK_ROWS..((task + 1) * TASK_ROWS).min(rows) {
            // SAFETY: rows are disjoint and each belongs to one task.
            #[allow(unsafe_code)]
            let qk = unsafe { shared.slice(r * stride..r * stride + 2 * heads * d) };
            let turn = rope.map(|t| t.entry(r % t.len()));
            ctx.kernels.rope(RopeRow { qk, d, norm: norm.as_ref(), turn });
        }
    });
}
