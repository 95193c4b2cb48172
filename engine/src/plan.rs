//! [`Plan`]: every size of a run, known before the first frame.
//!
//! | area | lives | holds |
//! |---|---|---|
//! | pairs | from the aggregator to the end | the frame and global features that heads read |
//! | guide | the image stem to the motion passes | what guided heads see of the images |
//! | motion | motion passes to the end | raw motion maps |
//! | work | one stage | working memory of the stage in progress |
//! | rows | one layer | quantized input rows of the int8 layer in progress |
//!
//! Stages never overlap in time, so `work` is as large as the largest one. The same functions that size
//! an area also carve it.

use crate::arena::carved_len;
use crate::block::BlockShape;
use crate::causal;
use crate::dims::{ClipShape, Dims};
use crate::gaussians;
use crate::heads;
use crate::held;
use crate::model::{Block, Decoder, DenseHead, Model};
use crate::net::Rows;
use sf_formats::config::{DepthMap, Head, HeadKind, ModelConfig, MotionLayout};
use sf_formats::{Error, Result};
use sf_ops::attention::FrameMask;
use std::fmt;

/// Memory a session may take unless the caller says otherwise.
pub const DEFAULT_MAX_BYTES: u64 = 8 << 30;

/// Sizes of a run and the memory it takes; printable.
#[derive(Clone, Debug)]
pub struct Plan {
    pub(crate) dims: Dims,
    /// Aggregator pairs whose features are kept, ascending.
    pub(crate) pairs: Vec<usize>,
    /// Values of all kept pairs, of the image stem, of the raw motion maps, of the working memory.
    pub(crate) areas: [usize; 4],
    /// Values of the quantized rows of an int8 layer.
    pub(crate) rows: usize,
    stages: Vec<(&'static str, usize)>,
    output_values: usize,
    /// Values of working memory of each thread.
    pub(crate) thread_values: usize,
    table_values: usize,
    /// Values kept of a frame that was pushed.
    pub(crate) frame_values: usize,
    layers: u32,
    threads: usize,
}

impl Plan {
    /// Sizes of `shape` for a model; `Input` when the shape does not fit the network, `Resource` when
    /// it is over `max_bytes` or over a cap.
    pub fn new(model: &Model, shape: ClipShape, threads: usize, max_bytes: u64) -> Result<Plan> {
        let config = model.config();
        let dims = Dims::new(config, shape)?;
        let w = model.weights();
        let n = dims.frames;

        let mut pairs: Vec<usize> = vec![config.aa.depth as usize / 2 - 1];
        for head in [Some(&w.depth), w.conf.as_ref(), w.gs.as_ref()].into_iter().flatten() {
            if let DenseHead::Dpt(dpt) = head {
                pairs.extend(dpt.taps);
            }
        }
        pairs.sort_unstable();
        pairs.dedup();

        let dim = config.aa.dim as usize;
        let mut stages = vec![("encoder + aggregator", carved_len(trunk_lens(model, &dims, threads)))];
        stages.push(("camera", heads::camera::scratch_len(&w.camera, &dims, threads)));
        if w.stem.is_some() {
            stages.push(("image stem", heads::stem::scratch_len(&dims)));
        }
        let raw = dims.pixels() * gaussians::CHANNELS;
        let both = if config.depth_map == DepthMap::ExpZConf { 2 * dims.pixels() } else { 0 };
        let dense = [("depth", Some(&w.depth), both), ("conf", w.conf.as_ref(), 0), ("gaussians", w.gs.as_ref(), raw)];
        for (name, head, raw) in dense {
            if let Some(head) = head {
                stages.push((name, carved_len([raw, heads::scratch_len(head, &dims, dims.tokens, threads)])));
            }
        }
        let mut motion = 0;
        if config.has_motion() && n > 1 {
            stages.push(("motion", causal::scratch_len(model, &dims, threads)));
            motion = causal::raw_values(config, &dims);
        }
        let work = stages.iter().map(|s| s.1).max().unwrap_or(0);
        let guide = heads::stem::values(w.stem.as_ref(), &dims);
        let areas = [pairs.len() * n * dims.tokens * 2 * dim, guide, motion, work];
        let plan = Plan {
            dims,
            pairs,
            areas,
            rows: rows(model, &dims),
            stages,
            output_values: n * dims.pixels() * crate::output::values_per_pixel(config),
            thread_values: held::thread_values(model, &dims),
            table_values: held::table_values(model, &dims),
            frame_values: dims.tokens * dim,
            layers: layers(config, n),
            threads,
        };
        let need = plan.session_bytes();
        if need > max_bytes {
            return Err(Error::resource(
                "plan",
                format!(
                    "{n} frames of {}x{} need {} MiB, the budget is {} MiB: use fewer or smaller frames, or run \
                     the clip in windows",
                    dims.width,
                    dims.height,
                    need >> 20,
                    max_bytes >> 20
                ),
            ));
        }
        Ok(plan)
    }

    /// The clip it is made for.
    pub fn shape(&self) -> ClipShape {
        ClipShape { frames: self.dims.frames, height: self.dims.height, width: self.dims.width }
    }

    /// Transformer blocks of a run, for progress.
    pub fn layers(&self) -> u32 {
        self.layers
    }

    /// Bytes of working memory.
    pub fn arena_bytes(&self) -> u64 {
        4 * (carved_len(self.areas) + self.rows) as u64
    }

    /// Bytes of working memory of all threads.
    pub fn threads_bytes(&self) -> u64 {
        4 * (self.threads * self.thread_values) as u64
    }

    /// Bytes of the tables of the shape: positions and angles.
    pub fn tables_bytes(&self) -> u64 {
        4 * self.table_values as u64
    }

    /// Bytes that a session holds from its creation on: arena, working memory of the threads, tables, results.
    pub fn session_bytes(&self) -> u64 {
        self.arena_bytes() + self.threads_bytes() + self.tables_bytes() + self.output_bytes()
    }

    /// Bytes of the results a session holds.
    pub fn output_bytes(&self) -> u64 {
        4 * self.output_values as u64
    }

    /// Bytes of the frames that a run reads.
    pub fn input_bytes(&self) -> u64 {
        3 * (self.dims.frames * self.dims.pixels()) as u64
    }

    /// Bytes that frames pushed one by one take beside: the pictures of the window, what is kept of them, the newest one's.
    pub fn stream_bytes(&self) -> u64 {
        let frames = self.dims.frames as u64;
        self.input_bytes() + 8 * frames + 4 * (frames + 1) * self.frame_values as u64
    }

    /// Bytes of the scene made of the results, one Gaussian per pixel: centre, scale, quaternion, opacity, colour,
    /// two velocities, dynamic probability, source frame.
    pub fn scene_bytes(&self) -> u64 {
        4 * (3 + 3 + 4 + 1 + 3 + 3 + 3 + 1 + 1) * (self.dims.frames * self.dims.pixels()) as u64
    }

    /// Bytes of the arena's areas by name.
    pub fn areas_bytes(&self) -> Vec<(&'static str, u64)> {
        let [pairs, guide, motion, work] = self.areas;
        let areas = [("pairs", pairs), ("guide", guide), ("motion", motion), ("work", work), ("rows", self.rows)];
        areas.into_iter().map(|(name, values)| (name, 4 * values as u64)).collect()
    }

    /// Bytes of working memory that each stage asks for; the area holds the largest.
    pub fn work_bytes(&self) -> Vec<(&'static str, u64)> {
        self.stages.iter().map(|&(name, values)| (name, 4 * values as u64)).collect()
    }
}

/// Transformer blocks that a run of `frames` frames goes through; a causal block counts once per pass.
fn layers(config: &ModelConfig, frames: usize) -> u32 {
    let head = |h: &Head| if matches!(h.kind, HeadKind::XdecLinear | HeadKind::Guided) { h.depth } else { 0 };
    let passes = if config.motion_layout == MotionLayout::PerDirection { 2 } else { 1 };
    let motion =
        if config.has_motion() && frames > 1 { passes * (config.causal_depth + head(&config.motion)) } else { 0 };
    let heads = head(&config.depth) + head(&config.conf) + head(&config.gs);
    config.encoder.depth + config.aa.depth + config.camera_depth + heads + motion
}

impl fmt::Display for Plan {
    fn fmt(&self, f: &mut fmt::Formatter) -> fmt::Result {
        let d = &self.dims;
        let mib = |values: usize| values as f64 * 4.0 / f64::from(1 << 20);
        writeln!(f, "clip        {} frames of {}x{}, {} threads", d.frames, d.width, d.height, self.threads)?;
        writeln!(
            f,
            "tokens      {} per frame ({}x{} patches), {} in all",
            d.tokens,
            d.cols,
            d.rows,
            d.frames * d.tokens
        )?;
        writeln!(f, "arena       {:9.2} MiB", self.arena_bytes() as f64 / f64::from(1 << 20))?;
        writeln!(f, "  pairs     {:9.2} MiB (kept: {:?})", mib(self.areas[0]), self.pairs)?;
        writeln!(f, "  guide     {:9.2} MiB", mib(self.areas[1]))?;
        writeln!(f, "  motion    {:9.2} MiB", mib(self.areas[2]))?;
        writeln!(f, "  work      {:9.2} MiB, the largest of", mib(self.areas[3]))?;
        for (name, values) in &self.stages {
            writeln!(f, "    {:9.2} MiB {name}", mib(*values))?;
        }
        if self.rows > 0 {
            writeln!(f, "  rows      {:9.2} MiB (input of an int8 layer)", mib(self.rows))?;
        }
        writeln!(f, "threads     {:9.2} MiB of working memory", mib(self.threads * self.thread_values))?;
        writeln!(f, "tables      {:9.2} MiB", mib(self.table_values))?;
        write!(f, "results     {:9.2} MiB", mib(self.output_values))
    }
}

/// Values of quantized rows: the most that any int8 layer needs.
fn rows(model: &Model, d: &Dims) -> usize {
    let (w, config) = (model.weights(), model.config());
    let blocks = |blocks: &[Block], m: usize| -> usize {
        let layers = blocks.iter().flat_map(|b| [&b.qkv, &b.proj, &b.fc1, &b.fc2]);
        let pairs = blocks.iter().map(|b| Rows::len_of_pair(&b.fc1.weight, &b.fc2.weight, m));
        layers.map(|l| Rows::len(&l.weight, m)).chain(pairs).max().unwrap_or(0)
    };
    let decoder = |x: &Decoder, m: usize| {
        blocks(&x.blocks, m).max(Rows::len(&x.projects.weight, m)).max(Rows::len(&x.linear_out.weight, m))
    };
    let head = |head: &DenseHead, m: usize| match head {
        DenseHead::Linear(h) => decoder(&h.decoder, m).max(Rows::len(&h.proj.weight, d.patches)),
        DenseHead::Guided(h) => decoder(&h.decoder, m).max(Rows::len(&h.proj.weight, d.patches)),
        DenseHead::Dpt(h) => h.projects.iter().map(|l| Rows::len(&l.weight, d.patches)).max().unwrap_or(0),
    };
    let all = d.frames * d.tokens;
    let mut most = blocks(&w.encoder, d.frames * d.encoder_tokens).max(blocks(&w.aa, all));
    most = most.max(w.aa_time.map_or(0, |l| Rows::len(&l.weight, 1)));
    let camera = w.camera.units.iter().flatten().chain(&w.camera.mlps).chain([&w.camera.t, &w.camera.rot]);
    let camera = camera.chain(&w.camera.fov).map(|l| Rows::len(&l.weight, d.patches)).max().unwrap_or(0);
    most = most.max(decoder(&w.camera.decoder, all)).max(camera);
    for dense in [Some(&w.depth), w.conf.as_ref(), w.gs.as_ref()].into_iter().flatten() {
        most = most.max(head(dense, all));
    }
    if config.has_motion() && d.frames > 1 {
        let m = d.frames * causal::tokens(config, d);
        most = most.max(blocks(&w.causal, m)).max(w.causal_back.as_ref().map_or(0, |b| blocks(b, m)));
        most = most.max(w.motion.as_ref().map_or(0, |h| head(h, m)));
    }
    most
}

/// Encoder tokens, aggregator tokens, block scratch (also the patch embedding's image and scratch).
pub(crate) fn trunk_lens(model: &Model, dims: &Dims, threads: usize) -> [usize; 3] {
    let (w, dim) = (model.weights(), model.config().aa.dim as usize);
    let most = |blocks: &[Block], mask: FrameMask| BlockShape::most(blocks, &mask, threads);
    let scratch = most(&w.encoder, dims.frame_mask(dims.encoder_tokens))
        .max(most(&w.aa, dims.frame_mask(dims.tokens)))
        .max(most(&w.aa, dims.global_mask()))
        .max(carved_len(patch_lens(model.config(), dims)));
    [dims.frames * dims.encoder_tokens * dim, dims.frames * dims.tokens * dim, scratch]
}

/// Normalised image, its patch features.
pub(crate) fn patch_lens(config: &ModelConfig, dims: &Dims) -> [usize; 2] {
    [dims.pixels() * 3, dims.patches * config.encoder.dim as usize]
}
