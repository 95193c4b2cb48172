//! Pi3's dense head: decoder, one linear layer, pixel shuffle (network specification 1.3, linear head).
//!
//! Row c patch^2 + dy patch + dx of the linear layer fills pixel (patch y + dy, patch x + dx) of channel c.

use super::decoder::{self, Job};
use crate::arena::{carve, carved_len};
use crate::dims::Dims;
use crate::model::LinearHead;
use crate::net::Net;
use crate::probe::Probe;
use crate::tables::Tables;
use sf_formats::Result;
use sf_ops::gemm::Act;
use sf_ops::mat::{HwcMut, Mat, MatMut};
use sf_ops::shuffle::pixel_shuffle;

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

/// Decodes the tokens of all frames; they stay at the start of `scratch`.
pub(crate) fn prepare(
    net: Net,
    head: &LinearHead,
    (d, tables): (&Dims, &Tables),
    job: Job,
    scratch: &mut [f32],
    probe: &Probe,
) -> Result<()> {
    let [decoded, work] = carve(scratch, lens(head, d, job.per_frame(d), net.ctx.pool.threads()));
    decoder::run(net, &head.decoder, (d, tables), job, (work, decoded), probe)
}

/// Patch pixels of one frame, shuffled into its raw map `[height, width, out]`; `per_frame` tokens were decoded.
pub(crate) fn frame(
    net: Net,
    head: &LinearHead,
    d: &Dims,
    per_frame: usize,
    (frame, scratch, out): (usize, &mut [f32], &mut [f32]),
) {
    let [decoded, work] = carve(scratch, lens(head, d, per_frame, net.ctx.pool.threads()));
    let width = head.decoder.linear_out.weight.n;
    let patches = &decoded[((frame + 1) * per_frame - d.patches) * width..][..d.patches * width];
    let pixels = &mut work[..d.patches * head.proj.weight.n];
    let wide = head.proj.weight.n;
    net.linear(&head.proj, Act::None, Mat::new(patches, d.patches, width), MatMut::new(pixels, d.patches, wide));
    let patch = d.height / d.rows;
    let out = HwcMut::new(out, d.height, d.width, head.out);
    pixel_shuffle(net.ctx, Mat::new(pixels, d.patches, wide), (d.rows, d.cols), patch, out);
}
