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

/// Frames that layer `layer` of `layers` reads and frames whose output it must give, for a pass of this reach whose last
/// output is wanted for the frames `read`: its own and those that its later layers see.
pub(crate) fn span(
    reach: Reach,
    read: &Range<usize>,
    frames: usize,
    (layer, layers): (usize, usize),
) -> [Range<usize>; 2] {
    let widened = |times: usize| {
        let by = |step: i32| times as i64 * i64::from(step);
        let first = (read.start as i64 + by(reach.lo.min(0))).max(0);
        let end = (read.end as i64 + by(reach.hi.max(0))).min(frames as i64);
        if read.is_empty() { read.clone() } else { first as usize..end as usize }
    };
    [widened(layers - layer), widened(layers - layer - 1)]
}

/// Frames of `due` whose map a pass of this direction must give, as one run: the others mirror the other direction.
pub(crate) fn read(config: &ModelConfig, direction: Reach, due: &Range<usize>, frames: usize) -> Range<usize> {
    let read = |&f: &usize| is_read(config, direction, f, frames);
    match due.clone().find(read) {
        Some(first) => first..due.clone().rfind(read).map_or(first, |last| last + 1),
        None => due.start..due.start,
    }
}

/// The smallest range that holds both.
pub(crate) fn hull(a: Range<usize>, b: Range<usize>) -> Range<usize> {
    match (a.is_empty(), b.is_empty()) {
        (true, _) => b,
        (_, true) => a,
        _ => a.start.min(b.start)..a.end.max(b.end),
    }
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
    /// Frames whose motion is wanted.
    pub(crate) due: Range<usize>,
    /// Raw motion maps, `[passes, frames, height, width, out]`; those that nobody reads are left alone.
    pub(crate) raw: &'a mut [f32],
    pub(crate) scratch: &'a mut [f32],
}

/// Both passes (or the one) and the motion head on each; raw maps into `job.raw`.
pub(crate) fn run(net: Net, (d, tables): (&Dims, &Tables), job: Job, probe: &mut Probe) -> Result<()> {
    let (model, w) = (net.model, net.model.weights());
    let config = model.config();
    let (dim, per_frame) = (config.causal_dim() as usize, tokens(config, d));
    let [start, x, shared, tapped, scratch] = carve(job.scratch, lens(model, d, net.ctx.pool.threads()));
    gather(config, d, (job.last, job.times), start);
    let rope = tables.rope(dim / w.causal[0].heads, causal_tokens(config));
    let (fwd, bwd) = Reach::of(config);
    let (ahead, behind) = Reach::directions(config);
    let back = w.causal_back.as_ref().unwrap_or(&w.causal);
    // A tap wants to see maps that nobody reads, too.
    let wanted = |direction| match probe.tapped() {
        true => 0..d.frames,
        false => read(config, direction, &job.due, d.frames),
    };
    let passes = [
        ("fwd", Some((fwd, wanted(ahead))), &w.causal),
        ("bwd", bwd.zip(behind).map(|(reach, direction)| (reach, wanted(direction))), back),
    ];
    // The frames whose q|k|v of layer 0 a pass reads.
    let first = |pass: &Option<(Reach, Range<usize>)>| match pass {
        Some((reach, read)) => span(*reach, read, d.frames, (0, w.causal.len()))[0].clone(),
        None => 0..0,
    };
    if w.causal_back.is_none() {
        let frames = hull(first(&passes[0].1), first(&passes[1].1));
        let (from, n) = (frames.start * per_frame, frames.len() * per_frame);
        let x = Mat::new(&start[from * dim..][..n * dim], n, dim);
        let qkv = &mut shared[3 * from * dim..][..3 * n * dim];
        block::project(net, &w.causal[0], x, Some(rope), &mut scratch[..n * dim], qkv);
    }

    let map_len = d.frames * d.pixels() * config.motion.out as usize;
    for ((name, pass, blocks), raw) in passes.into_iter().zip(job.raw.chunks_exact_mut(map_len)) {
        let Some((reach, read)) = pass else { continue };
        if read.is_empty() {
            continue;
        }
        let seen = span(reach, &read, d.frames, (0, blocks.len()))[0].clone();
        let values = seen.start * per_frame * dim..seen.end * per_frame * dim;
        x[values.clone()].copy_from_slice(&start[values]);
        let pass = Pass { net, d, tables, guide: job.guide, reach, read, blocks, name };
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
    reach: Reach,
    /// Frames whose map is read.
    read: Range<usize>,
    blocks: &'a [Block],
    name: &'static str,
}

impl Pass<'_> {
    /// All causal layers in place on `x`; layer 0 from `shared` q|k|v where both passes have it. A layer runs on the frames that
    /// the wanted ones still depend on.
    fn layers(
        &self,
        shared: Option<&[f32]>,
        x: &mut [f32],
        tapped: &mut [f32],
        scratch: &mut [f32],
        probe: &mut Probe,
    ) -> Result<()> {
        let (kept, config) = (taps(self.net.model), self.net.model.config());
        let (dim, per_frame) = (self.blocks[0].dim, tokens(config, self.d));
        let row = per_frame * dim;
        for (i, block) in self.blocks.iter().enumerate() {
            let rope = self.tables.rope(dim / block.heads, causal_tokens(config));
            let [seen, out] = span(self.reach, &self.read, self.d.frames, (i, self.blocks.len()));
            let mask = FrameMask { frames: seen.len(), ..mask(config, self.d, self.reach) };
            let qkv = if i == 0 { shared.map(|s| &s[3 * seen.start * row..3 * seen.end * row]) } else { None };
            let keep = (out.start - seen.start) * per_frame..(out.end - seen.start) * per_frame;
            let part = (qkv, &mut x[seen.start * row..seen.end * row]);
            block::forward_part(self.net, block, part, Sight { mask, rope: Some(rope) }, keep, scratch);
            let values = out.start * row..out.end * row;
            probe.layer(format_args!("causal.{}.{i}", self.name), &x[values.clone()])?;
            if let Some(slot) = kept.iter().position(|&t| t == i) {
                tapped[slot * x.len()..][values.clone()].copy_from_slice(&x[values]);
            }
            if probe.tapped() {
                let features = Features::dense(x, dim, self.d, per_frame);
                for f in 0..self.d.frames {
                    let patches = &features.patches(f).data[..self.d.patches * dim];
                    probe.emit(format_args!("causal.{}.{i}", self.name), Some(f), &[self.d.patches, dim], patches);
                }
            }
        }
        Ok(())
    }

    /// The motion head on this pass's tokens or taps. It looks at one frame at a time, so that frames nobody reads
    /// are left out from its decoder on.
    fn motion(&self, x: &[f32], tapped: &[f32], scratch: &mut [f32], raw: &mut [f32], probe: &mut Probe) -> Result<()> {
        let dim = self.blocks[0].dim;
        let frames = self.read.clone();
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
        let tokens = tokens(self.net.model.config(), self.d);
        let read = frames.start * tokens * dim..frames.end * tokens * dim;
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
            dense.frame(source, f, (&mut *scratch, map), probe)?;
            probe.guard(format_args!("motion.{}", self.name), map)?;
            probe.emit(format_args!("motion.{}", self.name), Some(first + f), &[d.height, d.width, out], map);
        }
        Ok(())
    }
}
