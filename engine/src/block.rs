//! The one transformer block of encoder, alternating attention, decoders and causal module.
//!
//! ```text
//! x += ls1 * proj(attention(rope(qk_norm(qkv(norm1 x)))))
//! x += ls2 * fc2(gelu(fc1(norm2 x)))
//! ```
//!
//! In blocks whose q|k|v and output projections are int8, attention is int8, too. Optional parts (q/k norms, layer scale, rotary embedding) are absent where the weights or the caller
//! have none. x is `[rows, dim]`, dense, rows = frames * tokens of the mask.

use crate::arena::{carve, carved_len};
use crate::model::Block;
use crate::net::Net;
use sf_ops::attention::{self, FrameMask, Heads};
use sf_ops::gemm::Act;
use sf_ops::mat::{Mat, MatMut};
use sf_ops::rope::{QkNorm, RopeTable, qk_norm_rope};
use std::ops::Range;

/// Sizes that decide the working memory of a block.
#[derive(Clone, Copy, Debug)]
pub(crate) struct BlockShape {
    pub(crate) dim: usize,
    pub(crate) heads: usize,
    pub(crate) hidden: usize,
    /// Whether attention is int8.
    pub(crate) attention_s8: bool,
    /// Whether normed tokens exist as floats: int8 layers take them quantized in the same pass.
    pub(crate) normed: bool,
    pub(crate) threads: usize,
}

impl BlockShape {
    pub(crate) fn of(block: &Block, threads: usize) -> BlockShape {
        let normed = !(block.qkv.weight.is_int8() && block.fc1.weight.is_int8());
        let attention_s8 = block.int8_attention();
        BlockShape { dim: block.dim, heads: block.heads, hidden: block.hidden, attention_s8, normed, threads }
    }

    /// Most working memory of [`forward`] with any of the blocks.
    pub(crate) fn most(blocks: &[Block], mask: &FrameMask, threads: usize) -> usize {
        blocks.iter().map(|b| BlockShape::of(b, threads).scratch_len(mask)).max().unwrap_or(0)
    }

    /// Normed tokens, then one area that is first q|k|v and the mixed values, later the MLP's hidden
    /// layer, and the attention's own scratch.
    fn lens(&self, mask: &FrameMask) -> [usize; 3] {
        let rows = mask.frames * mask.tokens;
        let wide = carved_len(self.attention_lens(rows)).max(rows * self.hidden);
        let len = if self.attention_s8 { attention::scratch_len_s8 } else { attention::scratch_len };
        let scratch = len(mask, self.heads, self.dim / self.heads, self.threads);
        [if self.normed { rows * self.dim } else { 0 }, wide, scratch]
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
    let rows = sight.mask.frames * sight.mask.tokens;
    forward_part(net, block, (None, x), sight, 0..rows, scratch);
}

/// [`forward`] for the rows `keep` alone, which have its bits; the others stay as they were. A q|k|v of all rows may have
/// been computed before: two passes over the same input share it.
pub(crate) fn forward_part(
    net: Net,
    block: &Block,
    (shared, x): (Option<&[f32]>, &mut [f32]),
    sight: Sight,
    keep: Range<usize>,
    scratch: &mut [f32],
) {
    let (rows, dim) = (sight.mask.frames * sight.mask.tokens, block.dim);
    let shape = BlockShape::of(block, net.ctx.pool.threads());
    let [normed, wide, heads] = carve(scratch, shape.lens(&sight.mask));
    {
        let [own, mixed] = carve(wide, shape.attention_lens(rows));
        let qkv = match shared {
            Some(qkv) => qkv,
            None => {
                project(net, block, Mat::new(x, rows, dim), sight.rope, normed, own);
                own
            }
        };
        attend(net, block, qkv, sight, Attend { x, mixed, heads, keep: keep.clone() });
    }
    mlp(net, block, &mut x[keep.start * dim..keep.end * dim], keep.len(), normed, wide);
}

/// q|k|v of x, `[rows, 3 dim]`, normed and with positions unless attention is int8, which does that itself. `normed` is working memory as large as x, or none for an int8 layer.
pub(crate) fn project(net: Net, block: &Block, x: Mat, rope: Option<&RopeTable>, normed: &mut [f32], qkv: &mut [f32]) {
    let (rows, dim) = (x.rows, block.dim);
    net.normed_linear(&block.norm1, &block.qkv, Act::None, (x, normed), MatMut::new(qkv, rows, 3 * dim));
    let norm = head_norm(net, block);
    if !block.int8_attention() && (norm.is_some() || rope.is_some()) {
        qk_norm_rope(net.ctx, MatMut::new(qkv, rows, 3 * dim), block.heads, norm, rope);
    }
}

fn head_norm<'a>(net: Net<'a>, block: &Block) -> Option<QkNorm<'a>> {
    block.qk.as_ref().map(|(q, k)| QkNorm {
        q_gain: net.model.values(q.gain),
        q_offset: net.model.values(q.offset),
        k_gain: net.model.values(k.gain),
        k_offset: net.model.values(k.offset),
        eps: q.eps,
    })
}

struct Attend<'a> {
    x: &'a mut [f32],
    mixed: &'a mut [f32],
    heads: &'a mut [f32],
    /// Rows of x that are wanted.
    keep: Range<usize>,
}

/// x += ls1 * proj(attention(qkv)).
fn attend(net: Net, block: &Block, qkv: &[f32], sight: Sight, to: Attend) {
    let Sight { mask, rope } = sight;
    let (rows, dim) = (mask.frames * mask.tokens, block.dim);
    let (qkv, mixed) = (Mat::new(qkv, rows, 3 * dim), MatMut::new(to.mixed, rows, dim));
    if block.int8_attention() {
        let rotation = net.model.head_rotation(&block.proj.weight, dim / block.heads);
        let x = Heads { qkv, heads: block.heads, norm: head_norm(net, block), rope, rotation };
        attention::attention_s8(net.ctx, x, mask, to.heads, mixed);
    } else {
        attention::attention(net.ctx, qkv, block.heads, mask, to.heads, mixed);
    }
    let (values, n) = (to.keep.start * dim..to.keep.end * dim, to.keep.len());
    let (mixed, x) = (&to.mixed[values.clone()], &mut to.x[values]);
    net.linear_onto(&block.proj, Act::None, block.ls1, Mat::new(mixed, n, dim), MatMut::new(x, n, dim));
}

/// x += ls2 * fc2(gelu(fc1(norm2 x))).
fn mlp(net: Net, block: &Block, x: &mut [f32], rows: usize, normed: &mut [f32], wide: &mut [f32]) {
    let (dim, hidden) = (block.dim, block.hidden);
    if net.pair_onto(&block.norm2, (&block.fc1, Act::Gelu), (&block.fc2, block.ls2), x) {
        return;
    }
    let wide = &mut wide[..rows * hidden];
    let from = (Mat::new(x, rows, dim), normed);
    net.normed_linear(&block.norm2, &block.fc1, Act::Gelu, from, MatMut::new(wide, rows, hidden));
    net.linear_onto(&block.fc2, Act::None, block.ls2, Mat::new(wide, rows, hidden), MatMut::new(x, rows, dim));
}
