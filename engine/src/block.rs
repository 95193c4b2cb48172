//! The one transformer block of encoder, alternating attention, decoders and causal module.
//!
//! ```text
//! x += ls1 * proj(attention(rope(qk_norm(qkv(norm1 x)))))
//! x += ls2 * fc2(gelu(fc1(norm2 x)))
//! ```
//!
//! Optional parts (q/k norms, layer scale, rotary embedding) are absent where the weights or the caller
//! have none. x is `[rows, dim]`, dense, rows = frames * tokens of the mask.

use crate::arena::{carve, carved_len};
use crate::model::{Block, Linear, Model, Norm};
use sf_ops::attention::{self, FrameMask};
use sf_ops::cpu::Ctx;
use sf_ops::gemm::{Act, Epilogue, gemm};
use sf_ops::mat::{Mat, MatMut};
use sf_ops::rope::{QkNorm, RopeTable, qk_norm_rope};

/// Weights and the machine to run them on.
#[derive(Clone, Copy)]
pub(crate) struct Net<'a> {
    pub(crate) ctx: Ctx<'a>,
    pub(crate) model: &'a Model,
}

impl<'a> Net<'a> {
    /// out = act(x W^T + b).
    pub(crate) fn linear(&self, l: &Linear, act: Act, x: Mat, out: MatMut) {
        let bias = l.bias.map(|b| self.model.values(b));
        gemm(self.ctx, x, self.model.panels(&l.weight), Epilogue { bias, act, ..Epilogue::default() }, out);
    }

    /// out += gamma * act(x W^T + b).
    pub(crate) fn linear_onto(&self, l: &Linear, act: Act, gamma: Option<&[f32]>, x: Mat, out: MatMut) {
        let bias = l.bias.map(|b| self.model.values(b));
        gemm(self.ctx, x, self.model.panels(&l.weight), Epilogue { bias, act, gamma, residual: true }, out);
    }

    pub(crate) fn norm(&self, n: &Norm, x: Mat, out: MatMut) {
        sf_ops::layernorm::layernorm(self.ctx, x, self.model.values(n.gain), self.model.values(n.offset), n.eps, out);
    }
}

/// Sizes that decide the working memory of a block.
#[derive(Clone, Copy, Debug)]
pub(crate) struct BlockShape {
    pub(crate) dim: usize,
    pub(crate) heads: usize,
    pub(crate) hidden: usize,
    pub(crate) threads: usize,
}

impl BlockShape {
    pub(crate) fn of(block: &Block, threads: usize) -> BlockShape {
        BlockShape { dim: block.dim, heads: block.heads, hidden: block.hidden, threads }
    }

    /// Normed tokens, then one area that is first q|k|v and the mixed values, later the MLP's hidden
    /// layer, and the attention's own scratch.
    fn lens(&self, mask: &FrameMask) -> [usize; 3] {
        let rows = mask.frames * mask.tokens;
        let wide = carved_len(self.attention_lens(rows)).max(rows * self.hidden);
        let scratch = attention::scratch_len(mask, self.heads, self.dim / self.heads, self.threads);
        [rows * self.dim, wide, scratch]
    }

    fn attention_lens(&self, rows: usize) -> [usize; 2] {
        [rows * 3 * self.dim, rows * self.dim]
    }

    /// Values of working memory of [`forward`].
    pub(crate) fn scratch_len(&self, mask: &FrameMask) -> usize {
        carved_len(self.lens(mask))
    }
}

/// Where a block's attention looks, and its positions.
#[derive(Clone, Copy)]
pub(crate) struct Sight<'a> {
    pub(crate) mask: FrameMask,
    pub(crate) rope: Option<&'a RopeTable>,
}

/// One block in place on x.
pub(crate) fn forward(net: Net, block: &Block, x: &mut [f32], sight: Sight, scratch: &mut [f32]) {
    let (rows, dim) = (sight.mask.frames * sight.mask.tokens, block.dim);
    let shape = BlockShape::of(block, net.ctx.pool.threads());
    let [normed, wide, heads] = carve(scratch, shape.lens(&sight.mask));
    {
        let [qkv, mixed] = carve(wide, shape.attention_lens(rows));
        project(net, block, Mat::new(x, rows, dim), sight.rope, normed, qkv);
        attend(net, block, qkv, sight.mask, Attend { x, mixed, heads });
    }
    mlp(net, block, x, rows, normed, wide);
}

/// [`forward`] from a q|k|v that was computed before: two passes over the same input share it.
pub(crate) fn forward_from(net: Net, block: &Block, qkv: &[f32], x: &mut [f32], mask: FrameMask, scratch: &mut [f32]) {
    let rows = mask.frames * mask.tokens;
    let shape = BlockShape::of(block, net.ctx.pool.threads());
    let [normed, wide, heads] = carve(scratch, shape.lens(&mask));
    attend(net, block, qkv, mask, Attend { x, mixed: &mut wide[..rows * block.dim], heads });
    mlp(net, block, x, rows, normed, wide);
}

/// q|k|v of x, `[rows, 3 dim]`, normed and rotated.
pub(crate) fn project(net: Net, block: &Block, x: Mat, rope: Option<&RopeTable>, normed: &mut [f32], qkv: &mut [f32]) {
    let (rows, dim) = (x.rows, block.dim);
    net.norm(&block.norm1, x, MatMut::new(normed, rows, dim));
    net.linear(&block.qkv, Act::None, Mat::new(normed, rows, dim), MatMut::new(qkv, rows, 3 * dim));
    let norm = block.qk.as_ref().map(|(q, k)| QkNorm {
        q_gain: net.model.values(q.gain),
        q_offset: net.model.values(q.offset),
        k_gain: net.model.values(k.gain),
        k_offset: net.model.values(k.offset),
        eps: q.eps,
    });
    if norm.is_some() || rope.is_some() {
        qk_norm_rope(net.ctx, MatMut::new(qkv, rows, 3 * dim), block.heads, norm, rope);
    }
}

struct Attend<'a> {
    x: &'a mut [f32],
    mixed: &'a mut [f32],
    heads: &'a mut [f32],
}

/// x += ls1 * proj(attention(qkv)).
fn attend(net: Net, block: &Block, qkv: &[f32], mask: FrameMask, to: Attend) {
    let (rows, dim) = (mask.frames * mask.tokens, block.dim);
    let mixed = MatMut::new(to.mixed, rows, dim);
    attention::attention(net.ctx, Mat::new(qkv, rows, 3 * dim), block.heads, mask, to.heads, mixed);
    let gamma = block.ls1.map(|g| net.model.values(g));
    net.linear_onto(&block.proj, Act::None, gamma, Mat::new(to.mixed, rows, dim), MatMut::new(to.x, rows, dim));
}

/// x += ls2 * fc2(gelu(fc1(norm2 x))).
fn mlp(net: Net, block: &Block, x: &mut [f32], rows: usize, normed: &mut [f32], wide: &mut [f32]) {
    let (dim, hidden) = (block.dim, block.hidden);
    net.norm(&block.norm2, Mat::new(x, rows, dim), MatMut::new(normed, rows, dim));
    let wide = &mut wide[..rows * hidden];
    net.linear(&block.fc1, Act::Gelu, Mat::new(normed, rows, dim), MatMut::new(wide, rows, hidden));
    let gamma = block.ls2.map(|g| net.model.values(g));
    net.linear_onto(&block.fc2, Act::None, gamma, Mat::new(wide, rows, hidden), MatMut::new(x, rows, dim));
}
