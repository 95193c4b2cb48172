//! The causal motion module: two masked passes over time, one towards later frames, one towards earlier
//! ones (network specification 5.1, 6 items 4 to 14, 6.1).
//!
//! Tokens are the last aggregator features with the time embedding appended. A query sees whole frames
//! within its pass's reach: block-sparse attention, never an (F P)^2 matrix. Both passes start from the
//! same tokens; where they also share weights, layer 0's norm, q|k|v, q/k norms and rotation are computed
//! once, which is exact because only the mask differs.

use crate::arena::{carve, carved_len};
use crate::block::{self, BlockShape, Sight};
use crate::dims::Dims;
use crate::embed;
use crate::features::Features;
use crate::heads::{self, Dense, Source};
use crate::model::{Block, DenseHead, Model};
use crate::motion::Reach;
use crate::net::Net;
use crate::probe::Probe;
use crate::tables::{Tables, Tokens, causal_tokens};
use sf_formats::Result;
use sf_formats::config::{Concat, Extrapolate, ModelConfig, MotionLayout};
use sf_ops::attention::FrameMask;
use sf_ops::mat::Mat;
use std::ops::Range;

/// Tokens per frame.
pub(crate) fn tokens(config: &ModelConfig, d: &Dims) -> usize {
    match causal_tokens(config) {
        Tokens::WithRegisters => d.tokens,
        Tokens::Patches => d.patches,
    }
}

/// What each query of a pass sees.
pub(crate) fn mask(config: &ModelConfig, d: &Dims, reach: Reach) -> FrameMask {
    FrameMask { frames: d.frames, tokens: tokens(config, d), lo: reach.lo, hi: reach.hi }
}

/// Causal layers whose output the motion head reads; a layer's slot is its first place in the list.
fn taps(model: &Model) -> &[usize] {
    match &model.weights().motion {
        Some(DenseHead::Dpt(dpt)) => &dpt.taps,
        _ => &[],
    }
}

/// Input tokens, tokens at work, layer 0's q|k|v, tapped layers, scratch of blocks or motion head.
fn lens(model: &Model, d: &Dims, threads: usize) -> [usize; 5] {
    let (config, w) = (model.config(), model.weights());
    let values = d.frames * tokens(config, d) * config.causal_dim() as usize;
    let (fwd, bwd) = Reach::of(config);
    let most = |r, blocks| BlockShape::most(blocks, &mask(config, d, r), threads);
    let back = w.causal_back.as_ref().unwrap_or(&w.causal);
    let block = [Some(most(fwd, &w.causal)), bwd.map(|r| most(r, back))].into_iter().flatten().max();
    let motion = w.motion.as_ref().map_or(0, |head| heads::scratch_len(head, d, d.patches, threads));
    let scratch = block.unwrap_or(0).max(motion).max(values);
    let shared = if w.causal_back.is_none() { 3 * values } else { 0 };
    [values, values, shared, taps(model).len() * values, scratch]
}

/// Values of working memory of [`run`].
pub(crate) fn scratch_len(model: &Model, d: &Dims, threads: usize) -> usize {
    carved_len(lens(model, d, threads))
}

/// Values of the raw motion maps of all passes.
pub(crate) fn raw_values(config: &ModelConfig, d: &Dims) -> usize {
    let passes = if config.motion_layout == MotionLayout::PerDirection { 2 } else { 1 };
    passes * d.frames * d.pixels() * config.motion.out as usize
}

/// What the module reads and writes.
pub(crate) struct Job<'a> {
    /// The last aggregator pair.
    pub(crate) last: Features<'a>,
    pub(crate) times: &'a [f64],
    /// The image stem, for a guided motion head.
    pub(crate) guide: &'a [f32],
    /// Raw motion maps, `[passes, frames, height, width, out]`.
    pub(crate) raw: &'a mut [f32],
    pub(crate) scratch: &'a mut [f32],
}

/// Both passes (or the one) and the motion head on each; raw maps into `job.raw`.
pub(crate) fn run(net: Net, (d, tables): (&Dims, &Tables), job: Job, probe: &mut Probe) -> Result<()> {
    let (model, w) = (net.model, net.model.weights());
    let config = model.config();
    let (dim, per_frame) = (config.causal_dim() as usize, tokens(config, d));
    let rows = d.frames * per_frame;
    let [start, x, shared, tapped, scratch] = carve(job.scratch, lens(model, d, net.ctx.pool.threads()));
    gather(config, d, (job.last, job.times), start);
    let rope = tables.rope(dim / w.causal[0].heads, causal_tokens(config));
    if w.causal_back.is_none() {
        block::project(net, &w.causal[0], Mat::new(start, rows, dim), Some(rope), &mut scratch[..rows * dim], shared);
    }

    let (fwd, bwd) = Reach::of(config);
    let (ahead, behind) = Reach::directions(config);
    let back = w.causal_back.as_ref().unwrap_or(&w.causal);
    let passes = [("fwd", Some((fwd, ahead)), &w.causal), ("bwd", bwd.zip(behind), back)];
    let map_len = d.frames * d.pixels() * config.motion.out as usize;
    for ((name, reach, blocks), raw) in passes.into_iter().zip(job.raw.chunks_exact_mut(map_len)) {
        let Some((reach, direction)) = reach else { continue };
        x.copy_from_slice(start);
        let mask = mask(config, d, reach);
        let pass = Pass { net, d, tables, guide: job.guide, mask, blocks, direction, name };
        let shared = w.causal_back.is_none().then_some(&*shared);
        pass.layers(shared, x, tapped, scratch, probe)?;
        probe.lap("causal");
        pass.motion(x, tapped, scratch, raw, probe)?;
        probe.lap("motion");
    }
    Ok(())
}

/// Whether the map of frame `f` in the pass of this direction is read: a direction without a neighbour mirrors the
/// other one, where there is another.
pub(crate) fn is_read(config: &ModelConfig, direction: Reach, f: usize, frames: usize) -> bool {
    let mirrored = config.render_extrapolate == Extrapolate::Mirror && Reach::of(config).1.is_some();
    !mirrored || direction.has_neighbour(f, frames)
}

/// Features and time embedding side by side.
fn gather(config: &ModelConfig, d: &Dims, (last, times): (Features, &[f64]), out: &mut [f32]) {
    let (dim, time_dim) = (config.causal_dim() as usize, config.time_dim as usize);
    let width = dim - time_dim;
    let from = match config.causal_in {
        Concat::FrameGlobal => last,
        Concat::Last => last.last(width),
    };
    let all = from.all();
    let per_frame = tokens(config, d);
    for (f, frame) in out.chunks_exact_mut(per_frame * dim).enumerate() {
        for (t, token) in frame.chunks_exact_mut(dim).enumerate() {
            let row = (f + 1) * d.tokens - per_frame + t;
            token[..width].copy_from_slice(all.row(row));
        }
        if time_dim > 0 {
            // Computed once into the first token, copied to the frame's others.
            let phase = (times[f] - times[0]) / config.time_unit;
            embed::time(phase, config.time_base, &mut frame[width..dim]);
            let (first, others) = frame.split_at_mut(dim);
            others.chunks_exact_mut(dim).for_each(|token| token[width..].copy_from_slice(&first[width..]));
        }
    }
}

/// One pass over time.
struct Pass<'a> {
    net: Net<'a>,
    d: &'a Dims,
    tables: &'a Tables,
    guide: &'a [f32],
    mask: FrameMask,
    blocks: &'a [Block],
    direction: Reach,
    name: &'static str,
}

impl Pass<'_> {
    /// All causal layers in place on `x`; layer 0 from `shared` q|k|v where both passes have it.
    fn layers(
        &self,
        shared: Option<&[f32]>,
        x: &mut [f32],
        tapped: &mut [f32],
        scratch: &mut [f32],
        probe: &mut Probe,
    ) -> Result<()> {
        let kept = taps(self.net.model);
        let dim = self.blocks[0].dim;
        for (i, block) in self.blocks.iter().enumerate() {
            let rope = self.tables.rope(dim / block.heads, causal_tokens(self.net.model.config()));
            let sight = Sight { mask: self.mask, rope: Some(rope) };
            match (i, shared) {
                (0, Some(qkv)) => block::forward_from(self.net, block, qkv, x, sight, scratch),
                _ => block::forward(self.net, block, x, sight, scratch),
            }
            probe.layer(format_args!("causal.{}.{i}", self.name), x)?;
            if let Some(slot) = kept.iter().position(|&t| t == i) {
                tapped[slot * x.len()..][..x.len()].copy_from_slice(x);
            }
            if probe.tapped() {
                let features = Features::dense(x, dim, self.d, self.mask.tokens);
                for f in 0..self.d.frames {
                    let patches = &features.patches(f).data[..self.d.patches * dim];
                    probe.emit(format_args!("causal.{}.{i}", self.name), Some(f), &[self.d.patches, dim], patches);
                }
            }
        }
        Ok(())
    }

    /// Frames whose map is read: the others mirror the other direction, and only a tap wants to see them.
    fn read(&self, tapped: bool) -> Range<usize> {
        let (config, n) = (self.net.model.config(), self.d.frames);
        let read = |f: usize| tapped || is_read(config, self.direction, f, n);
        let first = (0..n).find(|&f| read(f)).unwrap_or(n);
        first..(first..n).rfind(|&f| read(f)).map_or(first, |last| last + 1)
    }

    /// The motion head on this pass's tokens or taps. It looks at one frame at a time, so that frames nobody reads
    /// are left out from its decoder on.
    fn motion(&self, x: &[f32], tapped: &[f32], scratch: &mut [f32], raw: &mut [f32], probe: &mut Probe) -> Result<()> {
        let dim = self.blocks[0].dim;
        let frames = self.read(probe.tapped());
        let d = &Dims { frames: frames.len(), ..*self.d };
        let head = self.net.model.weights().motion.as_ref().expect("a causal module has a motion head");
        let dense = Dense {
            net: self.net,
            dims: d,
            tables: self.tables,
            dpt: self.tables.motion.as_ref(),
            guide: &self.guide[frames.start * self.guide.len() / self.d.frames..],
            head,
            tokens: Tokens::Patches,
            name: "motion",
        };
        let row = self.mask.tokens * dim;
        let (read, tokens) = (frames.start * row..frames.end * row, self.mask.tokens);
        let source = match head {
            DenseHead::Linear(_) | DenseHead::Guided(_) => Source::Tokens(Features::dense(&x[read], dim, d, tokens)),
            DenseHead::Dpt(dpt) => {
                let kept = taps(self.net.model);
                Source::Taps(dpt.taps.map(|t| {
                    let slot = kept.iter().position(|&k| k == t).expect("every tap is kept");
                    Features::dense(&tapped[slot * x.len()..][read.clone()], dim, d, tokens)
                }))
            }
        };
        dense.prepare(source, scratch, probe)?;
        let (out, first) = (heads::channels(head), frames.start);
        let maps = raw.chunks_exact_mut(d.pixels() * out).skip(first).take(frames.len());
        for (f, map) in maps.enumerate() {
            dense.frame(source, f, scratch, map);
            probe.guard(format_args!("motion.{}", self.name), map)?;
            probe.emit(format_args!("motion.{}", self.name), Some(first + f), &[d.height, d.width, out], map);
        }
        Ok(())
    }
}
