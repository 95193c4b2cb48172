//! Alternating attention: every frame for itself, then all frames together (network specification 1.3,
//! steps 5 to 7).
//!
//! The same learned registers stand before every frame's patches; no position tells frames apart, so
//! permuting the frames permutes the result. After a pair whose features a head reads, its two
//! outputs are kept side by side: `[frames * tokens, 2 dim]`, frame features left for frame-first order.

use crate::block::{self, Sight};
use crate::embed;
use crate::net::Net;
use crate::plan::Plan;
use crate::probe::Probe;
use crate::tables::{Tables, Tokens};
use sf_formats::Result;
use sf_formats::config::{ModelConfig, Order};
use sf_ops::gemm::Act;
use sf_ops::mat::{Mat, MatMut};
use sf_ops::opclock::{self, Op, Work};

/// Runs all layers in place on `x` `[frames * tokens, dim]` and fills `pairs` (see [`Pairs`](crate::features::Pairs)).
///
/// On entry the patch rows of `x` hold the encoder's features.
pub(crate) fn run(
    net: Net,
    plan: &Plan,
    tables: &Tables,
    times: &[f64],
    memory: Aggregate,
    probe: &mut Probe,
) -> Result<()> {
    let (model, w, d) = (net.model, net.model.weights(), &plan.dims);
    let config = model.config();
    let dim = config.aa.dim as usize;
    let Aggregate { x, pairs, scratch } = memory;
    if let Some(registers) = w.aa_registers {
        let values = model.values(registers);
        x.chunks_exact_mut(d.tokens * dim).for_each(|frame| frame[..values.len()].copy_from_slice(values));
    }
    if let Some(layer) = &w.aa_time {
        let time_dim = config.time_dim as usize;
        let (tau, rest) = scratch.split_at_mut(time_dim);
        let shift = &mut rest[..dim];
        for (frame, &t) in x.chunks_exact_mut(d.tokens * dim).zip(times) {
            embed::time((t - times[0]) / config.time_unit, config.time_base, tau);
            net.linear(layer, Act::None, Mat::new(tau, 1, time_dim), MatMut::new(shift, 1, dim));
            for token in frame.chunks_exact_mut(dim) {
                token.iter_mut().zip(shift.iter()).for_each(|(t, s)| *t += s);
            }
        }
    }
    let rope = tables.rope(dim / config.aa.heads as usize, Tokens::WithRegisters);
    let rows = d.frames * d.tokens;
    for (i, weights) in w.aa.iter().enumerate() {
        let global = is_global(config, i);
        let mask = if global { d.global_mask() } else { d.frame_mask(d.tokens) };
        block::forward(net, weights, x, Sight { mask, rope: Some(rope) }, scratch);
        probe.layer(format_args!("aa.{i}"), x)?;
        probe.emit(format_args!("aa.{i}"), None, &[d.frames, d.tokens, dim], x);
        if let Some(slot) = plan.pairs.iter().position(|&p| p == i / 2) {
            let _span = opclock::span(Op::Glue, || Work::values(x.len()));
            let pair = &mut pairs[slot * rows * 2 * dim..][..rows * 2 * dim];
            for (wide, token) in pair.chunks_exact_mut(2 * dim).zip(x.chunks_exact(dim)) {
                wide[(i % 2) * dim..][..dim].copy_from_slice(token);
            }
        }
        probe.lap(if global { "aa.global" } else { "aa.frame" });
    }
    Ok(())
}

/// Memory of [`run`].
pub(crate) struct Aggregate<'a> {
    pub(crate) x: &'a mut [f32],
    pub(crate) pairs: &'a mut [f32],
    pub(crate) scratch: &'a mut [f32],
}

/// Whether aggregator layer `i` attends over all frames.
pub(crate) fn is_global(config: &ModelConfig, i: usize) -> bool {
    (i % 2 == 1) == (config.aa_order == Order::FrameFirst)
}
