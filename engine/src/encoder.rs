//! The image encoder: DINOv2 with registers, every frame for itself (network specification 1.3, steps 1
//! to 4).
//!
//! Token order of a frame: class, registers, patches (row-major). The resized position table is added to
//! class and patches; registers have none.

use crate::arena::carve;
use crate::block::{self, Sight};
use crate::dims::Dims;
use crate::net::Net;
use crate::plan::patch_lens;
use crate::preprocess::Normaliser;
use crate::probe::Probe;
use crate::tables::Tables;
use sf_formats::Result;
use sf_ops::conv::{self, Conv};
use sf_ops::gemm::Act;
use sf_ops::mat::{Hwc, HwcMut, Mat, MatMut};

/// Frames `[frames, height, width, 3]` to aggregator tokens: `tokens` receives the normed patch features,
/// its register rows are left alone. `x` holds the encoder's own tokens.
pub(crate) fn run(net: Net, d: &Dims, tables: &Tables, images: &[u8], to: Encode, probe: &mut Probe) -> Result<()> {
    let (model, w) = (net.model, net.model.weights());
    let config = model.config();
    let dim = config.encoder.dim as usize;
    let Encode { x, tokens, scratch } = to;
    let registers = d.encoder_tokens - d.patches - 1;
    probe.emit(format_args!("pos"), None, &[1 + d.patches, dim], &tables.positions);

    let normaliser = Normaliser::new(config);
    let embed = Conv {
        weight: model.panels(&w.patch.weight),
        bias: w.patch.bias.map(|b| model.values(b)),
        kernel: config.patch as usize,
        stride: config.patch as usize,
        pad: 0,
        relu_input: Act::None,
        act: Act::None,
    };
    let (first, places) = tables.positions.split_at(dim);
    for f in 0..d.frames {
        let [image, features] = carve(scratch, patch_lens(config, d));
        normaliser.apply_on(net.ctx.pool, &images[f * d.pixels() * 3..][..d.pixels() * 3], image);
        let out = HwcMut::new(features, d.rows, d.cols, dim);
        conv::conv2d(net.ctx, Hwc::new(image, d.height, d.width, 3), &embed, None, out);
        probe.emit(format_args!("patches"), Some(f), &[d.patches, dim], features);

        let frame = &mut x[f * d.encoder_tokens * dim..][..d.encoder_tokens * dim];
        let (class, rest) = frame.split_at_mut(dim);
        let (extra, patches) = rest.split_at_mut(registers * dim);
        sum(model.values(w.cls), first, class);
        if let Some(r) = w.registers {
            extra.copy_from_slice(model.values(r));
        }
        sum(features, places, patches);
    }
    probe.lap("preprocess");

    let mask = d.frame_mask(d.encoder_tokens);
    for (i, weights) in w.encoder.iter().enumerate() {
        block::forward(net, weights, x, Sight { mask, rope: None }, scratch);
        probe.layer(format_args!("encoder.{i}"), x)?;
    }
    for f in 0..d.frames {
        let from = &x[(f * d.encoder_tokens + 1 + registers) * dim..][..d.patches * dim];
        let out = &mut tokens[((f + 1) * d.tokens - d.patches) * dim..][..d.patches * dim];
        net.norm(&w.encoder_norm, Mat::new(from, d.patches, dim), MatMut::new(out, d.patches, dim));
        probe.emit(format_args!("encoder"), Some(f), &[d.patches, dim], out);
    }
    probe.lap("encoder");
    Ok(())
}

/// Memory of [`run`].
pub(crate) struct Encode<'a> {
    /// `[frames, encoder tokens, dim]`.
    pub(crate) x: &'a mut [f32],
    /// `[frames, aggregator tokens, dim]`.
    pub(crate) tokens: &'a mut [f32],
    pub(crate) scratch: &'a mut [f32],
}

fn sum(a: &[f32], b: &[f32], out: &mut [f32]) {
    assert!(a.len() == out.len() && b.len() == out.len(), "{} + {} into {}", a.len(), b.len(), out.len());
    out.iter_mut().zip(a.iter().zip(b)).for_each(|(o, (a, b))| *o = a + b);
}
