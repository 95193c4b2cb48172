//! Per-head norm of q and k and two-dimensional rotary position embedding (network.md 1.3).
//!
//! A head of width d is two halves of size D = d/2: the first turns with the row index, the second
//! with the column index. Inside a half, theta_m = position * base^(-2m/D), m = 0..D/2, and channel m pairs
//! with channel m + D/2 (half-rotate, not interleaved):
//! out_m = a_m cos - a_(m+D/2) sin, out_(m+D/2) = a_(m+D/2) cos + a_m sin.
//! Tables are computed in f64 with [`crate::trig`] and stored as f32.

use crate::cpu::Ctx;
use crate::mat::MatMut;
use crate::trig;

/// What happens to an angle before its sine and cosine are taken.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum AngleRound {
    /// f64 all the way.
    #[default]
    None,
    /// Rounded to bfloat16, as the released half-precision pipelines do (up to 0.058 rad at position 44);
    /// the sines and cosines are rounded to bfloat16 too.
    Bf16,
}

/// cos and sin for every token of a frame.
#[derive(Clone, Debug)]
pub struct RopeTable {
    /// `[tokens, d/2]`: row angles first, column angles second.
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
                    let (s, c) = (s as f32, c as f32);
                    cos.push(if round == AngleRound::Bf16 { bf16(c) } else { c });
                    sin.push(if round == AngleRound::Bf16 { bf16(s) } else { s });
                }
            }
        }
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

/// Norm then rotation of the q and k parts of `qkv` `[rows, 3 * heads * d]`, in place; row r uses table entry
/// r modulo the table's length.
pub fn qk_norm_rope(_ctx: Ctx, qkv: MatMut, heads: usize, norm: Option<QkNorm>, rope: Option<&RopeTable>) {
    let MatMut { data, rows, cols, stride } = qkv;
    for r in 0..rows {
        let row = &mut data[r * stride..][..cols];
        let one = rope.map(|t| t.single(r % t.len()));
        crate::reference::qk_norm_rope(row, 1, heads, norm.as_ref(), one.as_ref());
    }
}

impl RopeTable {
    fn single(&self, token: usize) -> RopeTable {
        let (cos, sin) = self.entry(token);
        RopeTable { cos: cos.to_vec(), sin: sin.to_vec(), tokens: 1, head_dim: self.head_dim }
    }
}
