//! The guided head: decoder, one linear layer to half resolution, 3x3 convolutions that also see the image,
//! pixel shuffle. Edges follow the image, and there are no seams between patches.
//!
//! | step | size | channels |
//! |---|---|---|
//! | `proj` of the patch tokens, shuffled | height/2 x width/2 | `hidden` |
//! | beside the image stem | | `hidden` + `guide.channels` |
//! | x = relu(conv.0) | | `features` |
//! | y = x + conv.2(relu(conv.1 x)) | | `features` |
//! | conv.3(relu y), shuffled by 2 | height x width | `out` |
//!
//! Row c (patch/2)^2 + dy patch/2 + dx of `proj` fills half-resolution pixel (dy, dx) of channel c, and row
//! 4 c + 2 dy + dx of conv.3 pixel (dy, dx) of output c. The last ReLU is applied where conv.3 reads its
//! rows, so that the residual add needs no pass of its own.

use super::decoder::{self, Job};
use crate::arena::{carve, carved_len};
use crate::dims::Dims;
use crate::model::Guided;
use crate::net::{ConvLayer, Net};
use crate::probe::Probe;
use crate::tables::Tables;
use sf_formats::Result;
use sf_ops::gemm::Act;
use sf_ops::mat::{Hwc, HwcMut, Mat, MatMut};
use sf_ops::shuffle::{pixel_shuffle, pixel_shuffle_beside};

/// Decoder output, then one area for the decoder's memory and later for one frame's maps.
fn lens(head: &Guided, d: &Dims, tokens: usize, threads: usize) -> [usize; 2] {
    let decoded = d.frames * tokens * head.decoder.linear_out.weight.n;
    let work = decoder::scratch_len(&head.decoder, d, tokens, threads).max(carved_len(map_lens(head, d)));
    [decoded, work]
}

/// Three maps at half resolution; what each holds stands in [`frame`].
fn map_lens(head: &Guided, d: &Dims) -> [usize; 3] {
    let pixels = d.pixels() / 4;
    let a = head.hidden.max(head.features);
    let b = (head.hidden + head.guide).max(head.features).max(4 * head.out);
    [pixels * a, pixels * b, pixels * head.features]
}

/// Values of working memory of [`prepare`] and [`frame`].
pub(crate) fn scratch_len(head: &Guided, d: &Dims, tokens: usize, threads: usize) -> usize {
    carved_len(lens(head, d, tokens, threads))
}

/// Decodes the tokens of all frames; they stay at the start of `scratch`.
pub(crate) fn prepare(
    net: Net,
    head: &Guided,
    (d, tables): (&Dims, &Tables),
    job: Job,
    scratch: &mut [f32],
    probe: &Probe,
) -> Result<()> {
    let [decoded, work] = carve(scratch, lens(head, d, job.per_frame(d), net.ctx.pool.threads()));
    decoder::run(net, &head.decoder, (d, tables), job, (work, decoded), probe)
}

/// One frame's map from its tokens and its image stem.
pub(crate) struct Paint<'a> {
    pub(crate) frame: usize,
    /// Tokens per frame that were decoded.
    pub(crate) per_frame: usize,
    /// `[frames, height/2, width/2, guide.channels]`.
    pub(crate) guide: &'a [f32],
    pub(crate) scratch: &'a mut [f32],
    /// `[height, width, out]`.
    pub(crate) out: &'a mut [f32],
}

/// The raw map of one frame.
pub(crate) fn frame(net: Net, head: &Guided, d: &Dims, job: Paint, probe: &Probe) -> Result<()> {
    let Paint { frame, per_frame, guide, scratch, out } = job;
    let [decoded, work] = carve(scratch, lens(head, d, per_frame, net.ctx.pool.threads()));
    let [a, b, c] = carve(work, map_lens(head, d));
    let (h, w) = (d.height / 2, d.width / 2);
    let (pixels, side) = (h * w, d.height / d.rows / 2);
    let (dim, wide) = (head.proj.weight.k, head.proj.weight.n);

    // a: the patches' half-resolution pixels; b: the same in place, beside the image.
    let patches = &decoded[((frame + 1) * per_frame - d.patches) * dim..][..d.patches * dim];
    let spread = &mut a[..d.patches * wide];
    net.linear(&head.proj, Act::None, Mat::new(patches, d.patches, dim), MatMut::new(spread, d.patches, wide));
    let guide = Hwc::new(&guide[frame * pixels * head.guide..][..pixels * head.guide], h, w, head.guide);
    let inputs = head.hidden + head.guide;
    let joined = HwcMut::new(&mut b[..pixels * inputs], h, w, inputs);
    pixel_shuffle_beside(net.ctx, Mat::new(spread, d.patches, wide), (d.rows, d.cols), side, guide, joined);

    // a: x; b: the hidden map; c: x + conv.2, whose ReLU conv.3 applies; b: its outputs.
    let f = head.features;
    let (a, c) = (&mut a[..pixels * f], &mut c[..pixels * f]);
    let [conv0, conv1, conv2, conv3] = head.convs.each_ref().map(|weights| ConvLayer::same(weights, 3));
    let joined = Hwc::new(&b[..pixels * inputs], h, w, inputs);
    net.conv(ConvLayer { act: Act::Relu, ..conv0 }, joined, None, HwcMut::new(a, h, w, f));
    probe.check(format_args!("the first convolution of a guided head"))?;
    let x = Hwc::new(a, h, w, f);
    // Both inputs are rectified already; saying so gives an int8 layer steps half as wide.
    let conv1 = ConvLayer { act: Act::Relu, ..conv1.on_rectified() };
    net.conv(conv1, x, None, HwcMut::new(&mut b[..pixels * f], h, w, f));
    net.conv(conv2.on_rectified(), Hwc::new(&b[..pixels * f], h, w, f), Some(x), HwcMut::new(c, h, w, f));
    probe.check(format_args!("the third convolution of a guided head"))?;
    let outputs = &mut b[..pixels * 4 * head.out];
    net.conv(conv3.on_rectified(), Hwc::new(c, h, w, f), None, HwcMut::new(outputs, h, w, 4 * head.out));
    let out = HwcMut::new(out, d.height, d.width, head.out);
    pixel_shuffle(net.ctx, Mat::new(outputs, pixels, 4 * head.out), (h, w), 2, out);
    Ok(())
}
