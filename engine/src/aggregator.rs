//! Alternating attention: every frame for itself, then all frames together (network specification 1.3,
//! steps 5 to 7).
//!
//! The same learned registers stand before every frame's patches; no position tells frames apart, so
//! permuting the frames permutes the result. After a pair whose features a head reads, its two
//! outputs are kept side by side: `[frames * tokens, 2 dim]`, frame features left for frame-first order.

use crate::block::{self, Net, Sight};
use crate::embed;
use crate::plan::{Dims, Plan, is_global};
use crate::probe::Probe;
use crate::tables::{Tables, Tokens};
use sf_formats::Result;
use sf_ops::gemm::Act;
use sf_ops::mat::{Mat, MatMut};

/// Runs all layers in place on `x` `[frames * tokens, dim]` and fills `pairs` (see [`Pairs`]).
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
        probe.guard(format_args!("aa.{i}"), x)?;
        probe.emit(format_args!("aa.{i}"), None, &[d.frames, d.tokens, dim], x);
        if let Some(slot) = plan.pairs.iter().position(|&p| p == i / 2) {
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

/// Tokens that a head reads: `[frames * tokens, columns]` inside wider rows, registers first.
#[derive(Clone, Copy)]
pub(crate) struct Features<'a> {
    data: &'a [f32],
    /// Width of a stored row; the features are its last `cols` values.
    stride: usize,
    cols: usize,
    tokens: usize,
    patches: usize,
    frames: usize,
}

impl<'a> Features<'a> {
    /// Rows of exactly their width.
    pub(crate) fn dense(data: &'a [f32], cols: usize, d: &Dims, tokens: usize) -> Features<'a> {
        Features { data, stride: cols, cols, tokens, patches: d.patches, frames: d.frames }
    }

    /// The last `cols` columns.
    pub(crate) fn last(self, cols: usize) -> Features<'a> {
        assert!(cols <= self.cols, "{cols} of {} columns", self.cols);
        Features { cols, ..self }
    }

    fn rows_from(&self, row: usize, rows: usize) -> Mat<'a> {
        Mat::with_stride(&self.data[row * self.stride + self.stride - self.cols..], rows, self.cols, self.stride)
    }

    /// All tokens of all frames.
    pub(crate) fn all(&self) -> Mat<'a> {
        self.rows_from(0, self.frames * self.tokens)
    }

    /// The patch tokens of one frame.
    pub(crate) fn patches(&self, frame: usize) -> Mat<'a> {
        self.rows_from((frame + 1) * self.tokens - self.patches, self.patches)
    }

    /// Tokens per frame.
    pub(crate) fn tokens(&self) -> usize {
        self.tokens
    }
}

/// The kept pairs.
#[derive(Clone, Copy)]
pub(crate) struct Pairs<'a> {
    data: &'a [f32],
    plan: &'a Plan,
    dim: usize,
}

impl<'a> Pairs<'a> {
    pub(crate) fn new(data: &'a [f32], plan: &'a Plan, dim: usize) -> Pairs<'a> {
        Pairs { data, plan, dim }
    }

    /// Both outputs of pair `index`, side by side.
    pub(crate) fn get(&self, index: usize) -> Features<'a> {
        let slot = self.plan.pairs.iter().position(|&p| p == index).expect("the plan keeps every tapped pair");
        let d = &self.plan.dims;
        let len = d.frames * d.tokens * 2 * self.dim;
        Features::dense(&self.data[slot * len..][..len], 2 * self.dim, d, d.tokens)
    }

    /// Both outputs of the last pair.
    pub(crate) fn final_pair(&self) -> Features<'a> {
        self.get(*self.plan.pairs.last().expect("the last pair is always kept"))
    }
}
