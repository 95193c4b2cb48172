//! Alternating attention: every frame for itself, then all frames together (network specification 1.3,
//! steps 5 to 7).
//!
//! The same learned registers stand before every frame's patches; no position tells frames apart, so
//! permuting the frames permutes the result. After a pair whose features a head reads, its two
//! outputs are kept side by side: `[frames * tokens, 2 dim]`, frame features left for frame-first order.

use crate::block::{self, Sight};
use crate::dims::Dims;
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
/// On entry the patch rows of `x` hold the encoder's features; or, when `known` says that layer 0 is done, all of `x` its
/// output.
pub(crate) fn run(
    net: Net,
    plan: &Plan,
    tables: &Tables,
    (times, known): (&[f64], bool),
    memory: Aggregate,
    probe: &mut Probe,
) -> Result<()> {
    let (w, d) = (net.model.weights(), &plan.dims);
    let config = net.model.config();
    let dim = config.aa.dim as usize;
    let Aggregate { x, pairs, scratch } = memory;
    if !known {
        enter(net, d, times, x, scratch);
    }
    let rope = tables.rope(dim / config.aa.heads as usize, Tokens::WithRegisters);
    let rows = d.frames * d.tokens;
    for (i, weights) in w.aa.iter().enumerate() {
        let global = is_global(config, i);
        if i > 0 || !known {
            let mask = if global { d.global_mask() } else { d.frame_mask(d.tokens) };
            block::forward(net, weights, x, Sight { mask, rope: Some(rope) }, scratch);
            probe.layer(format_args!("aa.{i}"), x)?;
        }
        probe.emit(format_args!("aa.{i}"), None, &[d.frames, d.tokens, dim], x);
        if let Some(slot) = plan.pairs.iter().position(|&p| p == i / 2) {
            let _span = opclock::span(Op::Glue, || Work::values(x.len()));
            let pair = &mut pairs[slot * rows * 2 * dim..][..rows * 2 * dim];
            // Rows of a task: 64 KiB of what is copied.
            let task = ((1 << 14) / dim).max(1);
            net.ctx.pool.chunks(pair, task * 2 * dim, &|t, pair, _| {
                for (wide, token) in pair.chunks_exact_mut(2 * dim).zip(x[t * task * dim..].chunks_exact(dim)) {
                    wide[(i % 2) * dim..][..dim].copy_from_slice(token);
                }
            });
        }
        probe.lap(if global { "aa.global" } else { "aa.frame" });
    }
    Ok(())
}

/// Whether layer 0 of a frame depends on nothing but that frame, so that a stream may keep its output.
pub(crate) fn first_is_own(config: &ModelConfig) -> bool {
    !is_global(config, 0) && !config.aa_time
}

/// Layer 0 of one frame alone, from the encoder's features, where [`first_is_own`]: the same bits as among others.
pub(crate) fn first(
    net: Net,
    one: &Dims,
    tables: &Tables,
    (x, scratch): (&mut [f32], &mut [f32]),
    probe: &mut Probe,
) -> Result<()> {
    let config = net.model.config();
    let rope = tables.rope((config.aa.dim / config.aa.heads) as usize, Tokens::WithRegisters);
    enter(net, one, &[0.0], x, scratch);
    let sight = Sight { mask: one.frame_mask(one.tokens), rope: Some(rope) };
    block::forward(net, &net.model.weights().aa[0], x, sight, scratch);
    probe.layer(format_args!("aa.0"), x)?;
    probe.lap("aa.frame");
    Ok(())
}

/// What stands in front of layer 0: the registers, and the time where the network has it.
fn enter(net: Net, d: &Dims, times: &[f64], x: &mut [f32], scratch: &mut [f32]) {
    let (model, w) = (net.model, net.model.weights());
    let config = model.config();
    let dim = config.aa.dim as usize;
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
