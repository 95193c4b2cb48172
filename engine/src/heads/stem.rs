//! The image stem: what every guided head sees of the frames, at half resolution.
//!
//! One 3x3 convolution with stride 2 on the normalised image, then ReLU. All guided heads share it, so it is
//! computed once per clip: `[frames, height/2, width/2, channels]`, a byte per channel and pixel of the clip, for
//! a hundredth of one head's work.

use crate::dims::Dims;
use crate::model::Linear;
use crate::net::Net;
use crate::preprocess::Normaliser;
use crate::probe::Probe;
use sf_formats::Result;
use sf_ops::conv::{self, Conv};
use sf_ops::gemm::Act;
use sf_ops::mat::{Hwc, HwcMut};
use std::ops::Range;

/// Values of [`run`]'s result.
pub(crate) fn values(stem: Option<&Linear>, d: &Dims) -> usize {
    stem.map_or(0, |stem| d.frames * d.pixels() / 4 * stem.weight.n)
}

/// Values of working memory of [`run`]: one normalised image.
pub(crate) fn scratch_len(d: &Dims) -> usize {
    3 * d.pixels()
}

/// The stem of the frames `due` into their places in `guide`; `images` are bytes, `[frames, height, width, 3]`.
pub(crate) fn run(
    net: Net,
    d: &Dims,
    (images, due): (&[u8], Range<usize>),
    (scratch, guide): (&mut [f32], &mut [f32]),
    probe: &mut Probe,
) -> Result<()> {
    let Some(stem) = &net.model.weights().stem else { return Ok(()) };
    let (h, w, channels) = (d.height / 2, d.width / 2, stem.weight.n);
    let normaliser = Normaliser::new(net.model.config());
    let conv = Conv {
        weight: net.model.panels(&stem.weight),
        bias: stem.bias.map(|b| net.model.values(b)),
        kernel: 3,
        stride: 2,
        pad: 1,
        relu_input: Act::None,
        act: Act::Relu,
    };
    let image = &mut scratch[..scratch_len(d)];
    for (f, out) in guide.chunks_exact_mut(h * w * channels).enumerate().take(due.end).skip(due.start) {
        normaliser.apply_on(net.ctx.pool, &images[f * d.pixels() * 3..][..d.pixels() * 3], image);
        let image = Hwc::new(image, d.height, d.width, 3);
        conv::conv2d(net.ctx, image, &conv, None, HwcMut::new(out, h, w, channels));
        probe.guard(format_args!("guide"), out)?;
        probe.emit(format_args!("guide"), Some(f), &[h, w, channels], out);
    }
    probe.lap("preprocess");
    Ok(())
}
