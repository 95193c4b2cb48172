//! [`Cost`]: the multiply-adds of a run, stage by stage, known before it.
//!
//! Every weight matrix `[n, k]` meets a number of rows that its name tells: tokens of all frames, patches, pixels of
//! a pyramid's level. Attention adds two products over the keys that each query sees. What is counted is what a
//! run executes: a q|k|v that both causal passes share counts once, and motion maps that nobody reads do not count, nor do the
//! rows of causal layers that only they would depend on.
//! Norms, activations, resizes and other work per value are not in it.

use crate::aggregator::is_global;
use crate::causal;
use crate::dims::{ClipShape, Dims};
use crate::heads::dpt;
use crate::model::Model;
use crate::motion::Reach;
use crate::probe::STAGES;
use sf_formats::Result;
use sf_formats::arch::{self, Role};
use sf_formats::blob::Dtype;
use sf_formats::config::ModelConfig;
use sf_ops::attention::FrameMask;
use std::ops::Range;

/// Multiply-adds of one stage.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct StageCost {
    /// Stage, as the session's clock names it.
    pub name: &'static str,
    /// In matrix products.
    pub gemm: u64,
    /// In convolutions.
    pub conv: u64,
    /// In attention.
    pub attention: u64,
    /// Those of them that run in int8.
    pub int8: u64,
}

impl StageCost {
    /// All of them.
    pub fn macs(&self) -> u64 {
        self.gemm + self.conv + self.attention
    }
}

/// Multiply-adds of a run.
///
/// ```
/// use sf_formats::ModelConfig;
/// use streetforward::{ClipShape, Cost};
///
/// # fn main() -> sf_formats::Result<()> {
/// let cost = Cost::of(&ModelConfig::nano(), ClipShape { frames: 4, height: 168, width: 252 })?;
/// println!("{:.1} GFLOP", 2e-9 * cost.macs() as f64);
/// # Ok(())
/// # }
/// ```
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Cost {
    stages: [StageCost; STAGES.len()],
}

impl Cost {
    /// Of a clip through the network of `config`, in floats; errors as [`Plan::new`](crate::Plan::new) for shapes
    /// that do not fit it.
    pub fn of(config: &ModelConfig, shape: ClipShape) -> Result<Cost> {
        Self::count(config, shape, &|_| false)
    }

    /// Of a clip through a model, whose weights tell what runs in int8.
    pub fn of_model(model: &Model, shape: ClipShape) -> Result<Cost> {
        let blob = model.blob();
        let int8 = |name: &str| blob.find(name).is_some_and(|i| blob.tensors()[i].dtype == Dtype::Int8);
        Self::count(model.config(), shape, &int8)
    }

    fn count(config: &ModelConfig, shape: ClipShape, int8: &dyn Fn(&str) -> bool) -> Result<Cost> {
        let d = Dims::new(config, shape)?;
        let stage = |name| StageCost { name, gemm: 0, conv: 0, attention: 0, int8: 0 };
        let mut cost = Cost { stages: STAGES.map(stage) };
        for tensor in arch::tensors(config) {
            let name = &tensor.name;
            let Some((n, k)) = tensor.matrix() else { continue };
            let (stage, rows) = rows(config, &d, name);
            let stage = cost.stages.iter_mut().find(|s| s.name == stage).expect("a stage of the clock");
            let macs = (rows * n * k) as u64;
            // The 1x1 convolutions on a pyramid's taps are products over tokens.
            if tensor.role == Role::Linear || name.contains("_head.projects.") {
                stage.gemm += macs;
            } else {
                stage.conv += macs;
            }
            stage.int8 += if int8(name) { macs } else { 0 };
            if let Some(block) = name.strip_suffix(".attn.qkv.weight") {
                let macs = masks(config, &d, name).iter().map(products).sum::<u64>() * k as u64;
                stage.attention += macs;
                // As the layers around it.
                let both = int8(name) && int8(&format!("{block}.attn.proj.weight"));
                stage.int8 += if both { macs } else { 0 };
            }
        }
        Ok(cost)
    }

    /// Every stage of the session's clock, in order.
    pub fn stages(&self) -> &[StageCost] {
        &self.stages
    }

    /// All multiply-adds.
    pub fn macs(&self) -> u64 {
        self.stages.iter().map(StageCost::macs).sum()
    }

    /// Those of them that run in int8.
    pub fn int8(&self) -> u64 {
        self.stages.iter().map(|s| s.int8).sum()
    }
}

/// Both products of every query with the keys that it sees, for one channel.
fn products(mask: &FrameMask) -> u64 {
    let frames: usize = (0..mask.frames).map(|a| mask.keys(a).len()).sum();
    2 * frames as u64 * (mask.tokens as u64).pow(2)
}

/// Stage of aggregator layer `i`.
fn aa_stage(config: &ModelConfig, i: usize) -> &'static str {
    if is_global(config, i) { "aa.global" } else { "aa.frame" }
}

/// The passes over time that run: none, one, or forward and backward.
fn passes(config: &ModelConfig, d: &Dims) -> Vec<Reach> {
    if !config.has_motion() || d.frames == 1 {
        return Vec::new();
    }
    let (first, second) = Reach::of(config);
    [Some(first), second].into_iter().flatten().collect()
}

/// Frames of every pass whose motion map is read.
fn read_frames(c: &ModelConfig, d: &Dims) -> Vec<usize> {
    let (ahead, behind) = Reach::directions(c);
    let directions = [Some(ahead), behind].into_iter().flatten().take(passes(c, d).len());
    let read = |direction: Reach| (0..d.frames).filter(|&i| causal::is_read(c, direction, i, d.frames)).count();
    directions.map(read).collect()
}

/// A pass over time: its reach, and the frames whose motion map is read.
type Pass = (Reach, Range<usize>);

/// The passes that run with the weights of `part`.
fn passes_of(c: &ModelConfig, d: &Dims, part: &str) -> Vec<Pass> {
    let (ahead, behind) = Reach::directions(c);
    let directions = [Some(ahead), behind].into_iter().flatten();
    let read = directions.map(|direction| causal::read(c, direction, &(0..d.frames), d.frames));
    let passes: Vec<Pass> = passes(c, d).into_iter().zip(read).collect();
    let second = passes.len().min(1);
    match (part, c.causal_share) {
        ("causal", true) => passes,
        ("causal", false) => passes[..second].to_vec(),
        _ => passes[second..].to_vec(),
    }
}

/// Frames that causal layer `i` reads, and frames that it gives.
fn causal_span(c: &ModelConfig, d: &Dims, (reach, read): &Pass, i: usize) -> [Range<usize>; 2] {
    causal::span(*reach, read, d.frames, (i, c.causal_depth as usize))
}

/// What the queries of a block see, once for every time that it runs; `name` is a tensor of the block.
fn masks(c: &ModelConfig, d: &Dims, name: &str) -> Vec<FrameMask> {
    let part = name.split('.').next().unwrap_or_default();
    match part {
        "encoder" => vec![d.frame_mask(d.encoder_tokens)],
        "decoder" if is_global(c, layer(name)) => vec![d.global_mask()],
        "motion_decoder" => {
            let read = |frames| FrameMask { frames, ..d.frame_mask(d.patches) };
            read_frames(c, d).into_iter().map(read).collect()
        }
        "causal" | "causal_back" => {
            let mask = |pass: &Pass| {
                let [seen, _] = causal_span(c, d, pass, layer(name));
                FrameMask { frames: seen.len(), ..causal::mask(c, d, pass.0) }
            };
            passes_of(c, d, part).iter().map(mask).collect()
        }
        _ => vec![d.frame_mask(d.tokens)],
    }
}

/// Number of an aggregator or causal layer, `decoder.{i}`.
fn layer(name: &str) -> usize {
    name.split('.').nth(1).and_then(|i| i.parse().ok()).expect("a layer's number")
}

/// Stage of a weight matrix, and the rows that go through it in a run.
fn rows(c: &ModelConfig, d: &Dims, name: &str) -> (&'static str, usize) {
    let f = d.frames;
    let (part, rest) = name.split_once('.').unwrap_or((name, ""));
    match part {
        "encoder" if rest.starts_with("patch_embed") => ("preprocess", f * d.patches),
        "image_stem" => ("preprocess", f * d.pixels() / 4),
        "encoder" => ("encoder", f * d.encoder_tokens),
        "aa_time" => (aa_stage(c, 0), f),
        "decoder" => (aa_stage(c, layer(name)), f * d.tokens),
        "camera_decoder" => ("camera", f * d.tokens),
        "camera_head" if rest.starts_with("res_conv") => ("camera", f * d.patches),
        "camera_head" => ("camera", f),
        "causal" | "causal_back" => {
            let spans =
                passes_of(c, d, part).iter().map(|pass| causal_span(c, d, pass, layer(name))).collect::<Vec<_>>();
            let frames = match rest.contains(".attn.qkv") {
                true if part == "causal" && c.causal_share && rest.starts_with("0.") => {
                    spans.into_iter().map(|[seen, _]| seen).fold(0..0, causal::hull).len()
                }
                true => spans.iter().map(|[seen, _]| seen.len()).sum(),
                false => spans.iter().map(|[_, out]| out.len()).sum(),
            };
            ("causal", frames * causal::tokens(c, d))
        }
        "motion_decoder" => ("motion", read_frames(c, d).iter().sum::<usize>() * d.patches),
        "motion_head" => ("motion", read_frames(c, d).iter().sum::<usize>() * head_rows(d, rest)),
        _ => {
            let stage = match part.split('_').next() {
                Some("point") => "depth",
                Some("conf") => "conf",
                Some("gs") => "gaussians",
                _ => unreachable!("tensor {name} belongs to no stage"),
            };
            (stage, if part.ends_with("_decoder") { f * d.tokens } else { f * head_rows(d, rest) })
        }
    }
}

/// Rows per frame of a weight matrix of a dense head, its decoder apart.
fn head_rows(d: &Dims, rest: &str) -> usize {
    let levels = dpt::levels(d).map(dpt::area);
    let numbered = |prefix: &str| rest.strip_prefix(prefix).and_then(|t| t[..1].parse::<usize>().ok());
    if let Some(level) = numbered("scratch.layer").or_else(|| numbered("scratch.refinenet")) {
        return levels[level - 1];
    }
    match rest {
        _ if rest.starts_with("resize_layers.3") => levels[3],
        _ if rest.starts_with("scratch.output_conv1") => 64 * d.patches,
        _ if rest.starts_with("scratch.output_conv2") => d.pixels(),
        _ if rest.starts_with("conv.") => d.pixels() / 4,
        // The linear layer, the taps' projections, and transposed convolutions on the patch grid.
        _ => d.patches,
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use sf_formats::config::{Head, HeadKind, MotionLayout, Trunk};

    /// Frame sizes of the network specification's table 5.2.
    const SIZES: [(usize, usize); 3] = [(168, 252), (280, 518), (378, 518)];

    /// GFLOP of a stage, as the specification counts: two passes with a q|k|v each, every motion map.
    fn table(config: &ModelConfig, (height, width): (usize, usize)) -> Vec<f64> {
        let cost = Cost::of(config, ClipShape { frames: 4, height, width }).unwrap();
        let of = |names: &[&str]| {
            2e-9 * cost.stages.iter().filter(|s| names.contains(&s.name)).map(StageCost::macs).sum::<u64>() as f64
        };
        let (p, dim) = ((height / 14 * (width / 14)) as f64, f64::from(config.causal_dim()));
        // One q|k|v; and of one frame in each of two passes, the last layer behind its attention.
        let shared = 2e-9 * p * (4.0 * 3.0 + 2.0 * 9.0) * dim * dim;
        let unread = match config.motion.kind {
            HeadKind::XdecLinear => {
                // Of one frame in each of two passes: the last layer, both projections, and the decoder's blocks.
                let (m, out) = (f64::from(config.motion.dim), f64::from(config.motion.out));
                let blocks = f64::from(config.motion.depth) * (12.0 * m * m + 2.0 * p * m);
                2e-9 * 2.0 * p * (196.0 * out * m + dim * m + m * m + blocks)
            }
            _ => 0.0,
        };
        vec![
            of(&["preprocess", "encoder"]),
            of(&["aa.frame"]),
            of(&["aa.global"]),
            of(&["depth"]),
            of(&["conf"]),
            of(&["gaussians"]),
            of(&["camera"]),
            of(&["causal"]) + shared,
            of(&["motion"]) + unread,
            of(&STAGES) + shared + unread,
        ]
    }

    /// Table 5.2 of the network specification, with linear heads; rows as [`table`].
    #[test]
    fn linear_networks_cost_what_the_specification_says() {
        let want: [(ModelConfig, [[f64; 10]; 3]); 3] = [
            (
                ModelConfig::full(),
                [
                    [554.2, 414.8, 458.1, 121.8, 121.1, 124.6, 122.6, 232.2, 235.6, 2385.0],
                    [2021.7, 1513.6, 2004.6, 442.8, 440.4, 452.3, 445.4, 895.5, 870.5, 9087.0],
                    [2826.8, 2116.5, 3008.3, 618.0, 614.8, 630.8, 621.5, 1275.7, 1217.6, 12930.0],
                ],
            ),
            (
                ModelConfig::base(),
                [
                    [41.5, 41.1, 51.9, 14.9, 14.6, 15.9, 15.1, 38.0, 28.9, 262.0],
                    [168.8, 167.5, 290.2, 59.8, 58.9, 63.4, 60.5, 169.0, 118.1, 1156.0],
                    [246.7, 244.9, 467.8, 87.0, 85.8, 91.8, 87.9, 254.1, 172.1, 1738.0],
                ],
            ),
            (
                small(),
                [
                    [5.8, 3.7, 5.5, 1.3, 0.0, 1.8, 1.3, 10.7, 2.6, 32.8],
                    [26.7, 17.4, 37.8, 5.7, 0.0, 7.5, 5.5, 56.0, 11.3, 167.9],
                    [40.8, 26.6, 63.8, 8.4, 0.0, 10.8, 8.2, 88.6, 16.9, 264.1],
                ],
            ),
        ];
        for (config, rows) in want {
            for (size, want) in SIZES.into_iter().zip(rows) {
                let have = table(&config.clone().with_linear_heads(), size);
                for (i, (have, want)) in have.iter().zip(want).enumerate() {
                    // Printed with one digit after the point, thousands without.
                    let round = if i == 9 && want > 260.0 { 0.5 } else { 0.05 };
                    assert!((have - want).abs() <= round, "{size:?} column {i}: {have} is not {want}");
                }
            }
        }
    }

    /// The sizes that the specification's table calls nano.
    fn small() -> ModelConfig {
        let base = ModelConfig::base();
        ModelConfig {
            encoder: Trunk { dim: 192, depth: 6, heads: 3, ..base.encoder },
            aa: Trunk { dim: 192, depth: 8, heads: 3, ..base.aa },
            camera_dim: 192,
            camera_depth: 1,
            camera_heads: 3,
            camera_width: 128,
            depth: Head::xdec_linear(3, 192, 1, 3),
            conf: Head::none(),
            time_dim: 32,
            causal_heads: 4,
            ..base
        }
    }

    /// The specification's totals for pyramid heads and for public Pi3.
    #[test]
    fn pyramids_and_pi3_cost_what_the_specification_says() {
        let total = |config: &ModelConfig, (height, width): (usize, usize)| {
            2e-9 * Cost::of(config, ClipShape { frames: 4, height, width }).unwrap().macs() as f64
        };
        for (size, want) in SIZES.into_iter().zip([1793.0, 6868.0, 9806.0]) {
            let have = total(&ModelConfig::pi3(), size);
            assert!((have - want).abs() < 0.6, "pi3 {size:?}: {have} is not {want}");
        }
        assert!((total(&ModelConfig::pi3(), (406, 616)) - 13261.0).abs() < 1.0);
        // 109 M multiply-adds per patch and head (specification 5.2), taken over 4 frames of 216 patches for the
        // Gaussian head; the 1x1 layers before instead of after the resize save some.
        let full = Cost::of(&ModelConfig::full(), ClipShape { frames: 4, height: 168, width: 252 }).unwrap();
        let gs = full.stages().iter().find(|s| s.name == "gaussians").unwrap().macs() as f64;
        let per_patch = gs / (4.0 * 216.0);
        assert!((per_patch - 109e6).abs() < 5e6, "{per_patch} multiply-adds per patch");
    }

    /// A pyramid by hand: 2x3 patches, two frames of a network with one-channel levels.
    #[test]
    fn a_pyramid_by_hand() {
        let gs = Head::dpt(11, [0, 0, 0, 0], [1, 2, 3, 4], 6);
        let config = ModelConfig { gs, ..ModelConfig::nano() };
        let cost = Cost::of(&config, ClipShape { frames: 2, height: 28, width: 42 }).unwrap();
        let stage = cost.stages().iter().find(|s| s.name == "gaussians").unwrap();
        let inputs = 2 * config.aa.dim as usize;
        let (p, hidden) = (6, config.gs.hidden as usize);
        // Levels 8x12, 4x6, 2x3, 1x2.
        let level = [96, 24, 6, 2];
        let gemm = p * inputs * (1 + 2 + 3 + 4);
        let resize = p * 16 + p * 4 * 2 * 2 + level[3] * 9 * 4 * 4;
        let lateral: usize = (0..4).map(|i| level[i] * 9 * (i + 1) * 6).sum();
        let unit = 2 * 9 * 6 * 6;
        let fusion = (level[0] + level[1] + level[2]) * (2 * unit + 36) + level[3] * (unit + 36);
        let last = 64 * p * 9 * 6 * 3 + 28 * 42 * (9 * 3 * hidden + hidden * 11);
        assert_eq!(stage.gemm, 2 * gemm as u64);
        assert_eq!(stage.conv, 2 * (resize + lateral + fusion + last) as u64);
        assert_eq!(stage.attention, 0);
    }

    #[test]
    fn one_frame_has_no_motion_and_one_pass_costs_half() {
        let at = |config: &ModelConfig, frames| {
            let cost = Cost::of(config, ClipShape { frames, height: 28, width: 28 }).unwrap();
            let of = |name: &str| cost.stages.iter().find(|s| s.name == name).unwrap().macs();
            (of("causal"), of("motion"))
        };
        let nano = ModelConfig::nano();
        assert_eq!(at(&nano, 1), (0, 0));
        let (causal, motion) = at(&nano, 3);
        let own = ModelConfig { causal_share: false, ..nano.clone() };
        let qkv = 3 * 4 * 3 * u64::from(nano.causal_dim()).pow(2);
        assert_eq!(at(&own, 3), (causal + qkv, motion), "a set of weights per pass shares no q|k|v");
        let motion7 = Head { out: 7, ..nano.motion.clone() };
        let single = ModelConfig { motion_layout: MotionLayout::SinglePass, motion: motion7, ..nano.clone() };
        assert!(at(&single, 3).0 < causal);
        let e = Cost::of(&nano, ClipShape { frames: 1, height: 29, width: 28 }).unwrap_err();
        assert_eq!(e.status() as i32, 3);
    }
}
