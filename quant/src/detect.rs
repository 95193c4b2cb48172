//! The configuration of a checkpoint that carries none, read from names and shapes.
//!
//! Sizes are read; conventions (axes and units of motion, mask, activation maps) cannot be, and keep
//! their defaults. Where heads are not visible (no per-head norm) they are taken to be 64 wide, as in
//! every public network of the family.

use crate::names::Names;
use sf_formats::checkpoint::CheckpointTensor;
use sf_formats::config::{Concat, DepthMap, Head, HeadKind, KSource, ModelConfig, MotionLayout, Trunk};
use sf_formats::{Error, Result};

/// Channels per attention head where a checkpoint does not tell.
const HEAD_WIDTH: u32 = 64;

struct Shapes<'a> {
    tensors: &'a [CheckpointTensor],
    names: &'a Names,
    at: &'a str,
}

/// Reads a configuration from names and shapes; `at` is for messages.
pub(crate) fn detect(tensors: &[CheckpointTensor], names: &Names, at: &str) -> Result<ModelConfig> {
    let s = Shapes { tensors, names, at };
    let complete = s.has("gs_head.") || s.has("causal.");
    let base = if complete { ModelConfig::full() } else { ModelConfig::pi3() };
    let patch = s.size("encoder.patch_embed.proj.weight", 2)?;
    let dim = s.size("encoder.patch_embed.proj.weight", 0)?;
    let encoder = Trunk {
        dim,
        depth: s.blocks("encoder.blocks."),
        heads: dim / HEAD_WIDTH,
        registers: s.optional("encoder.register_tokens", 1).unwrap_or(0),
        mlp_ratio: s.size("encoder.blocks.0.mlp.fc1.weight", 0)? / dim.max(1),
        ..base.encoder.clone()
    };
    let wide = s.size("decoder.0.norm1.weight", 0)?;
    let aa = Trunk {
        dim: wide,
        depth: s.blocks("decoder."),
        heads: wide / s.size("decoder.0.attn.q_norm.weight", 0)?.max(1),
        registers: s.optional("register_token", 2).unwrap_or(0),
        mlp_ratio: s.size("decoder.0.mlp.fc1.weight", 0)? / wide.max(1),
        ..base.aa.clone()
    };
    let pairs = aa.depth / 2;
    let camera_dim = s.size("camera_decoder.projects.weight", 0)?;
    let depth = s.head("point", patch, pairs)?;
    let causal_depth = s.blocks("causal.");
    let (mut causal_in, mut time_dim, mut causal_heads) = (base.causal_in, 0, 0);
    if causal_depth > 0 {
        let width = s.size("causal.0.norm1.weight", 0)?;
        (causal_in, time_dim) = match width.checked_sub(wide.saturating_mul(2)) {
            Some(rest) => (Concat::FrameGlobal, rest),
            None => (Concat::Last, width.saturating_sub(wide)),
        };
        causal_heads = width / s.size("causal.0.attn.q_norm.weight", 0)?.max(1);
    }
    let motion = s.head("motion", patch, causal_depth)?;
    let config = ModelConfig {
        patch,
        pos_grid: s.size("encoder.pos_embed", 1)?.saturating_sub(1).isqrt(),
        aa_time: s.has("aa_time."),
        head_concat: if s.size("camera_decoder.projects.weight", 1)? == wide {
            Concat::Last
        } else {
            Concat::FrameGlobal
        },
        camera_dim,
        camera_depth: s.blocks("camera_decoder.blocks."),
        camera_heads: camera_dim / HEAD_WIDTH,
        camera_width: s.size("camera_decoder.linear_out.weight", 0)?,
        camera_k: if s.has("camera_head.fc_fov.") { KSource::Fov } else { base.camera_k },
        depth_map: match depth.out {
            1 => DepthMap::ExpZ,
            2 => DepthMap::ExpZConf,
            _ => DepthMap::Pi3Point,
        },
        guide_channels: s.optional("image_stem.weight", 0).unwrap_or(0),
        depth,
        conf: s.head("conf", patch, pairs)?,
        gs: s.head("gs", patch, pairs)?,
        time_dim: if s.has("aa_time.") { s.size("aa_time.weight", 1)? } else { time_dim },
        causal_depth,
        causal_heads,
        causal_in,
        causal_share: !s.has("causal_back."),
        motion_layout: if motion.out == 7 { MotionLayout::SinglePass } else { MotionLayout::PerDirection },
        motion,
        encoder,
        aa,
        ..base
    };
    config.check(at)?;
    Ok(config)
}

impl Shapes<'_> {
    fn has(&self, prefix: &str) -> bool {
        self.names.index.range(prefix.to_string()..).next().is_some_and(|(n, _)| n.starts_with(prefix))
    }

    fn optional(&self, name: &str, axis: usize) -> Option<u32> {
        let shape = &self.tensors[*self.names.index.get(name)?].shape;
        shape.get(axis).and_then(|&d| u32::try_from(d).ok())
    }

    fn size(&self, name: &str, axis: usize) -> Result<u32> {
        self.optional(name, axis).ok_or_else(|| {
            Error::model(
                self.at,
                format!("no configuration inside and none can be read from the shapes ({name} is missing): give one"),
            )
        })
    }

    /// Number of consecutive blocks `PREFIX{i}.norm1.weight`.
    fn blocks(&self, prefix: &str) -> u32 {
        (0..=256).find(|i| !self.names.index.contains_key(&format!("{prefix}{i}.norm1.weight"))).unwrap_or(257)
    }

    /// A dense head; `layers`: how many there are to tap.
    fn head(&self, name: &str, patch: u32, layers: u32) -> Result<Head> {
        let (dec, head) = (format!("{name}_decoder"), format!("{name}_head"));
        if self.has(&format!("{head}.scratch.")) {
            let size = |n: &str| self.size(&format!("{head}.{n}.weight"), 0);
            let mut channels = [0; 4];
            for (i, c) in channels.iter_mut().enumerate() {
                *c = size(&format!("projects.{i}"))?;
            }
            // Evenly spread, the last layer last: 3, 8, 12, 17 of 18.
            let taps = [1, 2, 3, 4].map(|i| (i * layers / 4).saturating_sub(1));
            let dpt = Head::dpt(size("scratch.output_conv2.2")?, taps, channels, size("scratch.layer1_rn")?);
            return Ok(Head { hidden: size("scratch.output_conv2.0")?, ..dpt });
        }
        if !self.has(&format!("{head}.")) {
            return Ok(Head::none());
        }
        if !self.has(&format!("{head}.proj.")) {
            return Ok(Head { kind: HeadKind::XdecConv, ..Head::none() });
        }
        let dim = self.size(&format!("{dec}.projects.weight"), 0)?;
        let blocks = self.blocks(&format!("{dec}.blocks."));
        if self.has(&format!("{head}.conv.")) {
            let half = patch / 2;
            let hidden = self.size(&format!("{head}.proj.weight"), 0)? / half.saturating_mul(half).max(1);
            let features = self.size(&format!("{head}.conv.0.weight"), 0)?;
            let out = self.size(&format!("{head}.conv.3.weight"), 0)? / 4;
            return Ok(Head::guided(out, (dim, blocks, dim / HEAD_WIDTH), hidden, features));
        }
        let out = self.size(&format!("{head}.proj.weight"), 0)? / patch.saturating_mul(patch).max(1);
        Ok(Head::xdec_linear(out, dim, blocks, dim / HEAD_WIDTH))
    }
}
