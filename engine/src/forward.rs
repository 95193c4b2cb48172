//! The order of the network: encoder, alternating attention, camera, depth, intrinsics, Gaussians, motion.
//!
//! One file per stage does the work; this one hands them their memory. Stages never overlap in time, so all
//! of them use the same working area.

use crate::aggregator;
use crate::arena::carve;
use crate::dims::{ClipShape, Dims};
use crate::features::{Features, Pairs};
use crate::heads::camera::{self, RawCamera};
use crate::heads::{self, Dense, Source};
use crate::input::Input;
use crate::intrinsics::{self, Evidence};
use crate::model::{DenseHead, Model};
use crate::motion::Direction;
use crate::net::Net;
use crate::output::{Flags, Output};
use crate::plan::{Plan, trunk_lens};
use crate::probe::Probe;
use crate::tables::{DptTables, Tables, Tokens};
use crate::unproject::{self, View};
use crate::{causal, encoder, gaussians, motion};
use sf_formats::config::{Concat, DepthMap, KSource, ModelConfig, MotionLayout};
use sf_formats::{Pose, Result};
use sf_ops::elementwise::{exp_in_place, sigmoid_in_place};
use sf_ops::opclock::{self, Op, Work};
use std::ops::Range;

/// Results and small per-frame records of a session.
pub(crate) struct Memory {
    pub(crate) output: Output,
    cameras: Vec<RawCamera>,
    raw_poses: Vec<Pose>,
    /// `[frames, 2]`.
    fov: Vec<f32>,
    gaussians: Vec<gaussians::Map>,
    motion: Vec<motion::Map>,
    views: Vec<View>,
}

impl Memory {
    pub(crate) fn new(model: &Model, shape: ClipShape) -> Result<Memory> {
        let n = shape.frames;
        Ok(Memory {
            output: Output::new(shape, model.config().has_conf())?,
            cameras: vec![RawCamera::default(); n],
            raw_poses: vec![Pose::IDENTITY; n],
            fov: vec![0.0; 2 * n],
            gaussians: Vec::with_capacity(n),
            motion: Vec::with_capacity(n),
            views: Vec::with_capacity(n),
        })
    }
}

/// The arena's areas (see [`Plan`]).
pub(crate) struct Areas<'a> {
    /// Kept features.
    pub(crate) pairs: &'a mut [f32],
    /// The image stem; empty where no head is guided.
    pub(crate) guide: &'a mut [f32],
    /// Raw motion maps; empty where the clip or the network has no motion.
    pub(crate) motion: &'a mut [f32],
    /// Working memory of the stage in progress.
    pub(crate) work: &'a mut [f32],
}

/// What dense heads on the aggregator read.
#[derive(Clone, Copy)]
struct Seen<'a> {
    pairs: Pairs<'a>,
    /// The image stem of all frames.
    guide: &'a [f32],
}

/// Encodes one frame alone into `out`, `[tokens, dim]`: the same bits as among others, because the encoder never looks across
/// frames. The aggregator's layer 0 is part of it where that does not, either
/// ([`aggregator::first_is_own`]); else the register rows are unset.
pub(crate) fn encode_frame(
    net: Net,
    plan: &Plan,
    tables: &Tables,
    image: &[u8],
    (work, out): (&mut [f32], &mut [f32]),
    probe: &mut Probe,
) -> Result<()> {
    let one = Dims { frames: 1, ..plan.dims };
    let [x, tokens, scratch] = carve(work, trunk_lens(net.model, &one, net.ctx.pool.threads()));
    encoder::run(net, &one, tables, image, encoder::Encode { x, tokens: &mut *tokens, scratch: &mut *scratch }, probe)?;
    if aggregator::first_is_own(net.model.config()) {
        aggregator::first(net, &one, tables, (&mut *tokens, scratch), probe)?;
    }
    out.copy_from_slice(tokens);
    Ok(())
}

/// One run.
pub(crate) struct Forward<'a> {
    pub(crate) net: Net<'a>,
    pub(crate) config: &'a ModelConfig,
    pub(crate) plan: &'a Plan,
    pub(crate) tables: &'a Tables,
    pub(crate) input: &'a Input<'a>,
    /// Frames whose results are wanted: all of them, or the newest.
    pub(crate) due: Range<usize>,
}

impl Forward<'_> {
    /// The whole network; on success `memory.output` is complete for the frames that are due.
    ///
    /// `encoded` holds what [`encode_frame`] made of all frames where that is known already.
    pub(crate) fn run(
        &self,
        areas: Areas,
        encoded: Option<&[f32]>,
        memory: &mut Memory,
        probe: &mut Probe,
    ) -> Result<()> {
        let d = &self.plan.dims;
        let Areas { pairs, guide, motion, work } = areas;
        memory.output.times.copy_from_slice(self.input.times);
        memory.output.due = self.due.clone();
        memory.output.flags = Flags { no_motion: motion.is_empty(), intrinsics_assumed: false };
        {
            let [x, tokens, scratch] = carve(work, trunk_lens(self.net.model, d, self.net.ctx.pool.threads()));
            match encoded {
                Some(known) => tokens.copy_from_slice(known),
                None => {
                    let to = encoder::Encode { x, tokens, scratch };
                    encoder::run(self.net, d, self.tables, self.input.images, to, probe)?;
                }
            }
            let to = aggregator::Aggregate { x: tokens, pairs, scratch };
            let known = encoded.is_some() && aggregator::first_is_own(self.config);
            aggregator::run(self.net, self.plan, self.tables, (self.input.times, known), to, probe)?;
        }
        let pairs =
            Pairs { data: pairs, kept: &self.plan.pairs, dims: &self.plan.dims, dim: self.config.aa.dim as usize };
        heads::stem::run(self.net, d, (self.input.images, self.due.clone()), (&mut *work, &mut *guide), probe)?;
        let from = Seen { pairs, guide };
        self.poses(pairs, work, memory, probe)?;
        self.depth(from, work, &mut memory.output, probe)?;
        self.confidence(from, work, &mut memory.output, probe)?;
        self.place(memory, probe)?;
        self.gaussians(from, work, memory, probe)?;
        if !motion.is_empty() {
            let (last, times) = (pairs.final_pair(), self.input.times);
            let due = self.due.clone();
            let job = causal::Job { last, times, guide, due, raw: motion, scratch: work };
            causal::run(self.net, (d, self.tables), job, probe)?;
            self.velocities(motion, memory);
        }
        self.show(&memory.output, probe)?;
        probe.lap("motion");
        Ok(())
    }

    /// What camera and linear heads read.
    fn last<'p>(&self, pairs: Pairs<'p>) -> Features<'p> {
        match self.config.head_concat {
            Concat::FrameGlobal => pairs.final_pair(),
            Concat::Last => pairs.final_pair().last(self.config.aa.dim as usize),
        }
    }

    /// Raw poses, then the world's gauge.
    fn poses(&self, pairs: Pairs, work: &mut [f32], memory: &mut Memory, probe: &mut Probe) -> Result<()> {
        let d = &self.plan.dims;
        // The first camera is the world, so it is always needed.
        let parts = if self.due.start == 0 { [self.due.clone(), 0..0] } else { [0..1, self.due.clone()] };
        for frames in parts.iter().filter(|frames| !frames.is_empty()).cloned() {
            let some = Dims { frames: frames.len(), ..*d };
            let (x, out) = ((self.last(pairs).of(frames.clone()), frames.start), &mut memory.cameras[frames]);
            camera::run(self.net, (&some, self.tables), x, work, out, probe)?;
        }
        for f in parts.into_iter().flatten() {
            let raw = &memory.cameras[f];
            memory.raw_poses[f] = unproject::raw_pose(&raw.t, &raw.nine);
            memory.fov[2 * f..2 * f + 2].copy_from_slice(&raw.fov);
            let rows = memory.raw_poses[f].to_rows().map(|r| r.map(|v| v as f32));
            probe.emit(format_args!("pose"), Some(f), &[4, 4], rows.as_flattened());
        }
        unproject::anchor(self.config, &memory.raw_poses, &mut memory.output.poses);
        probe.lap("camera");
        Ok(())
    }

    /// A dense head on the aggregator and what it reads, for the frames that `dims` counts, from `first` on.
    fn dense<'p>(
        &'p self,
        name: &'static str,
        head: &'p DenseHead,
        dpt: Option<&'p DptTables>,
        (from, dims, first): (Seen<'p>, &'p Dims, usize),
    ) -> (Dense<'p>, Source<'p>) {
        let Seen { pairs, guide } = from;
        let frames = first..first + dims.frames;
        let guide = &guide[first * (guide.len() / self.plan.dims.frames)..];
        let source = match head {
            DenseHead::Linear(_) | DenseHead::Guided(_) => Source::Tokens(self.last(pairs).of(frames)),
            DenseHead::Dpt(dpt) => Source::Taps(dpt.taps.map(|t| pairs.get(t).of(frames.clone()))),
        };
        let (net, tables) = (self.net, self.tables);
        (Dense { net, dims, tables, dpt, guide, head, tokens: Tokens::WithRegisters, name }, source)
    }

    /// The frames that are due.
    fn some(&self) -> Dims {
        Dims { frames: self.due.len(), ..self.plan.dims }
    }

    /// Pixels of the frames that are due.
    fn pixels(&self) -> Range<usize> {
        let pixels = self.plan.dims.pixels();
        self.due.start * pixels..self.due.end * pixels
    }

    /// Frames whose depth is needed: those that are due, and all of them where one camera is fitted to the rays of the clip.
    fn seen_by_camera(&self) -> Range<usize> {
        let fitted = self.input.k.is_none() && self.config.depth_map == DepthMap::Pi3Point;
        match self.config.camera_k {
            KSource::FitShared if fitted => 0..self.plan.dims.frames,
            _ => self.due.clone(),
        }
    }

    /// Local points and depth, in the network's units until [`Forward::place`].
    fn depth(&self, from: Seen, work: &mut [f32], out: &mut Output, probe: &mut Probe) -> Result<()> {
        let frames = self.seen_by_camera();
        let d = &Dims { frames: frames.len(), ..self.plan.dims };
        let head = &self.net.model.weights().depth;
        let (dense, source) = self.dense("depth", head, self.tables.depth.as_ref(), (from, d, frames.start));
        // Depth and confidence lie side by side in a map of their own.
        let both = if self.config.depth_map == DepthMap::ExpZConf { 2 * d.pixels() } else { 0 };
        let need = heads::scratch_len(head, d, d.tokens, self.net.ctx.pool.threads());
        let [raw, work] = carve(work, [both, need]);
        dense.prepare(source, work, probe)?;
        let pool = self.net.ctx.pool;
        for (i, f) in frames.enumerate() {
            let pixels = f * d.pixels()..(f + 1) * d.pixels();
            let depth = &mut out.depth[pixels.clone()];
            match self.config.depth_map {
                DepthMap::Pi3Point => {
                    let points = &mut out.points[pixels];
                    dense.frame(source, i, (&mut *work, points.as_flattened_mut()), probe)?;
                    depth.iter_mut().zip(&*points).for_each(|(z, p)| *z = p[2]);
                    exp_in_place(self.net.ctx, depth);
                    let z = &*depth;
                    pool.chunks(points, d.width, &|v, row, _| {
                        for (p, &z) in row.iter_mut().zip(&z[v * d.width..]) {
                            *p = [p[0] * z, p[1] * z, z];
                        }
                    });
                    probe.guard(format_args!("depth"), points.as_flattened())?;
                    probe.emit(format_args!("point"), Some(f), &[d.height, d.width, 3], points.as_flattened());
                }
                DepthMap::ExpZ => {
                    dense.frame(source, i, (&mut *work, &mut *depth), probe)?;
                    exp_in_place(self.net.ctx, depth);
                    probe.guard(format_args!("depth"), depth)?;
                    probe.emit(format_args!("point"), Some(f), &[d.height, d.width, 1], depth);
                }
                DepthMap::ExpZConf => {
                    let conf = &mut out.conf[pixels];
                    dense.frame(source, i, (&mut *work, &mut *raw), probe)?;
                    for ((z, c), p) in depth.iter_mut().zip(&mut *conf).zip(raw.chunks_exact(2)) {
                        (*z, *c) = (p[0], p[1]);
                    }
                    exp_in_place(self.net.ctx, depth);
                    probe.guard(format_args!("depth"), depth)?;
                    probe.guard(format_args!("conf"), conf)?;
                    probe.emit(format_args!("point"), Some(f), &[d.height, d.width, 1], depth);
                    probe.emit(format_args!("conf"), Some(f), &[d.height, d.width], conf);
                }
            }
        }
        probe.lap("depth");
        Ok(())
    }

    fn confidence(&self, from: Seen, work: &mut [f32], out: &mut Output, probe: &mut Probe) -> Result<()> {
        let d = &self.some();
        if let Some(head) = &self.net.model.weights().conf {
            let (dense, source) = self.dense("conf", head, self.tables.conf.as_ref(), (from, d, self.due.start));
            dense.prepare(source, work, probe)?;
            for (i, conf) in out.conf[self.pixels()].chunks_exact_mut(d.pixels()).enumerate() {
                let f = self.due.start + i;
                dense.frame(source, i, (&mut *work, &mut *conf), probe)?;
                probe.guard(format_args!("conf"), conf)?;
                probe.emit(format_args!("conf"), Some(f), &[d.height, d.width], conf);
            }
        }
        probe.lap("conf");
        Ok(())
    }

    /// Intrinsics; then everything in scene units, and the centres.
    fn place(&self, memory: &mut Memory, probe: &mut Probe) -> Result<()> {
        let (c, d) = (self.config, &self.plan.dims);
        let (due, pixels) = (self.due.clone(), self.pixels());
        let _span = opclock::span(Op::Elementwise, || Work::values(2 * pixels.len()));
        let Memory { output: out, fov, views, gaussians, motion, .. } = memory;
        let seen = self.seen_by_camera();
        let points = (c.depth_map == DepthMap::Pi3Point)
            .then(|| out.points[seen.start * d.pixels()..seen.end * d.pixels()].as_flattened());
        let evidence = Evidence { user: self.input.k, fov: Some(&fov[2 * due.start..2 * due.end]), points };
        out.flags.intrinsics_assumed = !intrinsics::choose(c, d, evidence, &mut out.k[due.clone()]);
        for f in due.clone() {
            let k = &out.k[f];
            probe.emit(format_args!("k"), Some(f), &[4], &[k.fx, k.fy, k.cx, k.cy].map(|v| v as f32));
        }
        views.clear();
        views.extend(out.poses.iter().zip(&out.k).map(|(&pose, &k)| View { pose, k, pixel: c.camera_pixel }));
        gaussians.clear();
        gaussians.extend(views.iter().map(|view| gaussians::Map::new(c, view)));
        motion.clear();
        motion.extend(views.iter().enumerate().map(|(f, v)| motion::Map::new(c, self.input.times, f, v.rotation())));

        if !out.flags.no_motion {
            out.neighbours.iter_mut().zip(&*motion).for_each(|(seen, map)| *seen = map.neighbours());
        }

        let scale = c.world_scale as f32;
        if scale != 1.0 {
            out.depth[pixels.clone()].iter_mut().for_each(|z| *z *= scale);
            out.points[pixels.clone()].as_flattened_mut().iter_mut().for_each(|p| *p *= scale);
        }
        let (pool, depth) = (self.net.ctx.pool, &out.depth[pixels.clone()]);
        let view = |row: usize| &views[due.start + row / d.height];
        pool.chunks(&mut out.mean[pixels.clone()], d.width, &|row, mean, _| {
            view(row).mean_row(row % d.height, &depth[row * d.width..][..d.width], mean);
        });
        if c.depth_map != DepthMap::Pi3Point {
            pool.chunks(&mut out.points[pixels.clone()], d.width, &|row, points, _| {
                let depth = &depth[row * d.width..][..d.width];
                for (u, (p, &z)) in points.iter_mut().zip(depth).enumerate() {
                    let local = view(row).local(u, row % d.height, z);
                    *p = [local.x as f32, local.y as f32, local.z as f32];
                }
            });
        }
        probe.guard(format_args!("centres"), out.mean[pixels].as_flattened())?;
        probe.lap("depth");
        Ok(())
    }

    fn gaussians(&self, from: Seen, work: &mut [f32], memory: &mut Memory, probe: &mut Probe) -> Result<()> {
        let d = &self.some();
        let Some(head) = &self.net.model.weights().gs else {
            for f in self.due.clone() {
                self.map_gaussians(f, None, memory);
            }
            probe.lap("gaussians");
            return Ok(());
        };
        let (dense, source) = self.dense("gs", head, self.tables.gs.as_ref(), (from, d, self.due.start));
        let need = heads::scratch_len(head, d, d.tokens, self.net.ctx.pool.threads());
        let [raw, work] = carve(work, [d.pixels() * gaussians::CHANNELS, need]);
        dense.prepare(source, work, probe)?;
        for (i, f) in self.due.clone().enumerate() {
            dense.frame(source, i, (&mut *work, &mut *raw), probe)?;
            probe.guard(format_args!("gs"), raw)?;
            probe.emit(format_args!("gs.raw"), Some(f), &[d.height, d.width, gaussians::CHANNELS], raw);
            self.map_gaussians(f, Some(raw), memory);
        }
        probe.lap("gaussians");
        Ok(())
    }

    /// Activations of one frame; `raw` is its `[height, width, 11]`, or priors are used.
    fn map_gaussians(&self, f: usize, raw: Option<&[f32]>, memory: &mut Memory) {
        let d = &self.plan.dims;
        // Eleven raw channels in, eleven values out.
        let _span = opclock::span(Op::Elementwise, || Work::values(gaussians::CHANNELS * d.pixels()));
        let (w, pixels) = (d.width, f * d.pixels()..(f + 1) * d.pixels());
        let (out, map, pool) = (&mut memory.output, &memory.gaussians[f], self.net.ctx.pool);
        let conf = (!out.conf.is_empty()).then(|| &out.conf[pixels.clone()]);
        let row = |v: usize| match raw {
            Some(raw) => gaussians::Raw::Head(&raw[v * w * gaussians::CHANNELS..][..w * gaussians::CHANNELS]),
            None => gaussians::Raw::Priors(conf.map(|c| &c[v * w..][..w])),
        };
        let (image, depth) = (self.input.frame(f), &out.depth[pixels.clone()]);
        let (scale, opacity) = (&mut out.scale[pixels.clone()], &mut out.opacity[pixels.clone()]);
        if map.in_steps() {
            pool.chunks(scale, w, &|v, s, _| map.start_row(row(v), s));
            exp_in_place(self.net.ctx, scale.as_flattened_mut());
            pool.chunks(scale, w, &|v, s, _| map.finish_row(&depth[v * w..][..w], s));
            pool.chunks(opacity, w, &|v, o, _| map.start_opacity_row(row(v), o));
            sigmoid_in_place(self.net.ctx, opacity);
            if raw.is_none() {
                pool.chunks(opacity, w, &|v, o, _| map.finish_opacity_row(row(v), o));
            }
        } else {
            pool.chunks(scale, w, &|v, s, _| map.scale_row(row(v), &depth[v * w..][..w], s));
            pool.chunks(opacity, w, &|v, o, _| map.opacity_row(row(v), o));
        }
        pool.chunks(&mut out.quat[pixels.clone()], w, &|v, q, _| map.quat_row(row(v), q));
        pool.chunks(&mut out.colour[pixels], w, &|v, c, _| map.colour_row(row(v), &image[3 * v * w..][..3 * w], c));
    }

    /// Velocities and dynamic probabilities from the raw maps of the passes.
    fn velocities(&self, raw: &[f32], memory: &mut Memory) {
        let (c, d) = (self.config, &self.plan.dims);
        let (w, channels) = (d.width, c.motion.out as usize);
        let (pixels, first) = (self.pixels(), self.due.start * d.height);
        let _span = opclock::span(Op::Elementwise, || Work::values(7 * pixels.len()));
        let (fwd, bwd) = match c.motion_layout {
            MotionLayout::PerDirection => raw.split_at(raw.len() / 2),
            MotionLayout::SinglePass => (raw, &raw[..0]),
        };
        // Rows are counted from the first frame that is due.
        let row = |r: usize| {
            let r = first + r;
            let part = |map: &'_ [f32]| r * w * channels..(r * w * channels + w * channels).min(map.len());
            match c.motion_layout {
                MotionLayout::PerDirection => motion::Raw::Passes(&fwd[part(fwd)], &bwd[part(bwd)]),
                MotionLayout::SinglePass => motion::Raw::Single(&fwd[part(fwd)]),
            }
        };
        let (out, ctx) = (&mut memory.output, self.net.ctx);
        let map = |r: usize| &memory.motion[(first + r) / d.height];
        let pool = ctx.pool;
        let dynamic = &mut out.dynamic[pixels.clone()];
        let (v_fwd, v_bwd) = (&mut out.v_fwd[pixels.clone()], &mut out.v_bwd[pixels]);
        // Probabilities first: those of the second pass wait where the backward velocities will be.
        let second = &mut v_bwd.as_flattened_mut()[..dynamic.len()];
        pool.chunks(dynamic, w, &|r, p, _| map(r).logit_row(row(r), Direction::Forward, p));
        pool.chunks(second, w, &|r, p, _| map(r).logit_row(row(r), Direction::Backward, p));
        sigmoid_in_place(ctx, dynamic);
        sigmoid_in_place(ctx, second);
        let (second, single) = (&*second, bwd.is_empty());
        pool.chunks(dynamic, w, &|r, p, _| map(r).combine_row(&second[r * w..][..w], p, single));
        pool.chunks(v_fwd, w, &|r, v, _| map(r).forward_row(row(r), v));
        pool.chunks(v_bwd, w, &|r, v, _| map(r).backward_row(row(r), v));
    }

    /// The last guard, and the outputs as stages.
    fn show(&self, out: &Output, probe: &mut Probe) -> Result<()> {
        let d = &self.plan.dims;
        let (size, vectors) = ([d.frames, d.height, d.width], [d.frames, d.height, d.width, 3]);
        let quats = [d.frames, d.height, d.width, 4];
        let planes: [(&str, &[usize], &[f32]); 9] = [
            ("out.depth", &size, &out.depth),
            ("out.mean", &vectors, out.mean.as_flattened()),
            ("out.scale", &vectors, out.scale.as_flattened()),
            ("out.quat", &quats, out.quat.as_flattened()),
            ("out.opacity", &size, &out.opacity),
            ("out.colour", &vectors, out.colour.as_flattened()),
            ("out.v_fwd", &vectors, out.v_fwd.as_flattened()),
            ("out.v_bwd", &vectors, out.v_bwd.as_flattened()),
            ("out.dynamic", &size, &out.dynamic),
        ];
        for (f, pose) in out.poses.iter().enumerate() {
            let rows = pose.to_rows().map(|r| r.map(|v| v as f32));
            probe.emit(format_args!("out.pose"), Some(f), &[4, 4], rows.as_flattened());
        }
        for (name, shape, data) in planes {
            let frame = data.len() / d.frames;
            probe.guard(format_args!("{name}"), &data[self.due.start * frame..self.due.end * frame])?;
            probe.emit(format_args!("{name}"), None, shape, data);
        }
        Ok(())
    }
}
