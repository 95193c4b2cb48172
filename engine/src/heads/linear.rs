//! Pi3's dense head: decoder, one linear layer, pixel shuffle (network specification 1.3, linear head).
//!
//! Row c patch^2 + dy patch + dx of the linear layer fills pixel (patch y + dy, patch x + dx) of channel c.

use super::{Dense, decoder};
use crate::aggregator::Features;
use crate::arena::{carve, carved_len};
use crate::model::LinearHead;
use crate::plan::Dims;
use crate::probe::Probe;
use crate::tables::Tokens;
use sf_formats::Result;
use sf_ops::elementwise::pixel_shuffle;
use sf_ops::gemm::Act;
use sf_ops::mat::{HwcMut, Mat, MatMut};

/// Decoder output, then one area for the decoder's memory and later for one frame's patch pixels.
fn lens(head: &LinearHead, d: &Dims, tokens: usize, threads: usize) -> [usize; 2] {
    let decoded = d.frames * tokens * head.decoder.linear_out.weight.n;
    let work = decoder::scratch_len(&head.decoder, d, tokens, threads).max(d.patches * head.proj.weight.n);
    [decoded, work]
}

/// Values of working memory of [`prepare`] and [`frame`].
pub(crate) fn scratch_len(head: &LinearHead, d: &Dims, tokens: usize, threads: usize) -> usize {
    carved_len(lens(head, d, tokens, threads))
}

/// Decoder tokens per frame.
fn per_frame(dense: &Dense, x: &Features) -> usize {
    match dense.tokens {
        Tokens::WithRegisters => x.tokens(),
        Tokens::Patches => dense.dims.patches,
    }
}

/// Decodes the tokens of all frames; they stay at the start of `scratch`.
pub(crate) fn prepare(
    dense: &Dense,
    head: &LinearHead,
    x: Features,
    scratch: &mut [f32],
    probe: &mut Probe,
) -> Result<()> {
    let [decoded, work] = carve(scratch, lens(head, dense.dims, per_frame(dense, &x), dense.net.ctx.pool.threads()));
    let job = decoder::Job { name: dense.name, x, tokens: dense.tokens };
    decoder::run(dense.net, &head.decoder, (dense.dims, dense.tables), job, (work, decoded), probe)
}

/// Patch pixels of one frame, shuffled into its raw map `[height, width, out]`.
pub(crate) fn frame(
    dense: &Dense,
    head: &LinearHead,
    x: Features,
    (frame, scratch, out): (usize, &mut [f32], &mut [f32]),
) {
    let d = dense.dims;
    let per_frame = per_frame(dense, &x);
    let [decoded, work] = carve(scratch, lens(head, d, per_frame, dense.net.ctx.pool.threads()));
    let width = head.decoder.linear_out.weight.n;
    let patches = &decoded[((frame + 1) * per_frame - d.patches) * width..][..d.patches * width];
    let pixels = &mut work[..d.patches * head.proj.weight.n];
    let wide = head.proj.weight.n;
    dense.net.linear(&head.proj, Act::None, Mat::new(patches, d.patches, width), MatMut::new(pixels, d.patches, wide));
    let patch = d.height / d.rows;
    let out = HwcMut::new(out, d.height, d.width, head.out);
    pixel_shuffle(dense.net.ctx, Mat::new(pixels, d.patches, wide), (d.rows, d.cols), patch, out);
}
