//! Which matrix gets which type, and what is folded into it.
//!
//! | matrix | at f16 | at int8 | why |
//! |---|---|---|---|
//! | camera head; last layer of every head | f32 | f32 | tiny, and their errors reach poses, log depth and velocities unweakened |
//! | but those of guided Gaussian and motion heads | f32 | int8 | a twentieth of the work each; what they give bears it: a tenth of a decibel of the render at most |
//! | patch embedding, time embedding | f16 | f16 | inputs of 588 and d_t values that no norm precedes; under 1 % of the work |
//! | first convolution of a guided depth head | f16 | f16 | reads features beside the image, of very different sizes under one scale: 3 dB of the render |
//! | input width that is no multiple of 16 | f16 | f16 | has no rotation |
//! | convolutions over channels that are no multiple of 4 | f16 | f16 | have no int8 form |
//! | everything else | f16 | int8 | |
//!
//! Folding ([`Sources`]) concerns int8 matrices: a norm's gain and offset go into every matrix that reads it when all
//! of them are int8, a layer scale into the matrix in front. The norm and the scale stay in the file as ones
//! and zeros, so that the network is the same for every reader. With a calibration the norm's offset is minus its mean value
//! instead, and the matrices' biases make up for it: tokens around zero have smaller steps.

use crate::convert::SCAN_REASON;
use crate::names::glob;
use crate::seeded::output_layer;
use sf_formats::arch::{Role, TensorSpec};
use sf_formats::config::HeadKind;
use sf_formats::panel_s8::{Int8Layout, QUAD, rotated_width, rotation_block};
use sf_formats::{Dtype, ModelConfig};
use std::collections::BTreeMap;

/// The type of one tensor, and why it is not the one asked for.
#[derive(Clone, Debug, PartialEq)]
pub(crate) struct Choice {
    pub(crate) dtype: Dtype,
    pub(crate) reason: Option<String>,
}

/// Whether an exception's pattern names a tensor: literal text, `*` and `?`, matched at the start.
pub(crate) fn names(pattern: &str, name: &str) -> bool {
    glob(&format!("{pattern}*"), name)
}

/// The type of a tensor; exceptions and what a scan promoted first.
pub(crate) fn choose(
    config: &ModelConfig,
    spec: &TensorSpec,
    asked: Dtype,
    (kept, promoted): (Option<&(String, Dtype)>, bool),
) -> Choice {
    let plain = |dtype| Choice { dtype, reason: None };
    let because = |dtype, why: &str| Choice { dtype, reason: Some(why.to_string()) };
    if spec.matrix().is_none() {
        return plain(Dtype::F32);
    }
    if let Some((pattern, dtype)) = kept {
        if *dtype != Dtype::Int8 {
            return because(*dtype, &format!("asked for: {pattern}"));
        }
        return match unfit(spec) {
            Some(why) => because(Dtype::F16, why),
            None => plain(Dtype::Int8),
        };
    }
    if promoted {
        return because(Dtype::F16, SCAN_REASON);
    }
    if spec.name.starts_with("camera_head.") {
        return because(Dtype::F32, "camera head");
    }
    let last = output_layer(config, &spec.name);
    let guided = match last {
        Some("gs") => config.gs.kind == HeadKind::Guided,
        Some("motion") => config.motion.kind == HeadKind::Guided,
        _ => false,
    };
    let bears_int8 = asked == Dtype::Int8 && guided;
    if last.is_some() && !bears_int8 {
        return because(Dtype::F32, "last layer of a head");
    }
    if asked != Dtype::Int8 {
        return plain(asked);
    }
    if spec.name == "point_head.conv.0.weight" {
        return because(Dtype::F16, "reads features beside the image for the depth");
    }
    let sensitive = [
        ("encoder.patch_embed.", "patch embedding"),
        ("image_stem.", "reads the image"),
        ("aa_time.", "time embedding"),
    ];
    if let Some((_, why)) = sensitive.iter().find(|(prefix, _)| spec.name.starts_with(prefix)) {
        return because(Dtype::F16, why);
    }
    match unfit(spec) {
        Some(why) => because(Dtype::F16, why),
        None => plain(Dtype::Int8),
    }
}

/// Whether a matrix multiplies tokens: linear layers, and the 1x1 convolutions that run as such.
fn is_linear(spec: &TensorSpec) -> bool {
    spec.role == Role::Linear || spec.name.contains("_head.projects.")
}

/// Whether the inputs of an int8 matrix are rotated: tokens are, maps are not.
pub(crate) fn is_rotated(spec: &TensorSpec) -> bool {
    is_linear(spec)
}

/// Why a matrix cannot be int8.
fn unfit(spec: &TensorSpec) -> Option<&'static str> {
    if !is_linear(spec) {
        let quads = rotated_width(spec)?.is_multiple_of(QUAD);
        return (!quads).then_some("convolution over channels that are no multiple of 4");
    }
    let width = rotated_width(spec)?;
    let fits = rotation_block(width).is_some() && Int8Layout::of(spec, true).is_some();
    (!fits).then_some("input width without a rotation")
}

/// Indices of the vectors that are folded into a matrix.
#[derive(Clone, Debug, Default, PartialEq)]
pub(crate) struct Sources {
    pub(crate) gain: Option<usize>,
    pub(crate) offset: Option<usize>,
    pub(crate) gamma: Option<usize>,
    /// The first matrix that reads the same norm: whose observed inputs give the mean.
    pub(crate) first: Option<usize>,
}

/// What becomes of every tensor beside its type.
#[derive(Clone, Debug, Default, PartialEq)]
pub(crate) struct Folding {
    /// Matrix to what is folded into it.
    pub(crate) into: BTreeMap<usize, Sources>,
    /// Bias to its matrix.
    pub(crate) bias_of: BTreeMap<usize, usize>,
    /// Vectors that are stored as ones (gains, layer scales) or zeros (offsets).
    pub(crate) neutral: BTreeMap<usize, f32>,
    /// Offset of a norm to the first matrix that reads it.
    pub(crate) offset_of: BTreeMap<usize, usize>,
}

/// Plans the folding for the chosen types.
pub(crate) fn fold(specs: &[TensorSpec], choices: &[Choice]) -> Folding {
    let index: BTreeMap<&str, usize> = specs.iter().enumerate().map(|(i, s)| (s.name.as_str(), i)).collect();
    let find = |name: String| index.get(name.as_str()).copied();
    let int8 = |i: &usize| choices[*i].dtype == Dtype::Int8;
    let mut folding = Folding::default();
    for (i, spec) in specs.iter().enumerate() {
        let Some((layer, _)) = spec.name.rsplit_once('.') else { continue };
        match spec.role {
            Role::NormGain => {
                let readers: Vec<usize> = readers(layer).into_iter().filter_map(&find).collect();
                let offset = find(format!("{layer}.bias"));
                if readers.is_empty() || !readers.iter().all(int8) {
                    continue;
                }
                folding.neutral.insert(i, 1.0);
                folding.neutral.extend(offset.map(|o| (o, 0.0)));
                let first = readers.first().copied();
                folding.offset_of.extend(offset.zip(first));
                for r in readers {
                    let into = folding.into.entry(r).or_default();
                    (into.gain, into.offset, into.first) = (Some(i), offset, offset.and(first));
                }
            }
            Role::LayerScale => {
                // `{block}.ls1.gamma` scales `{block}.attn.proj`, `ls2` scales `mlp.fc2`.
                let in_front = match layer.rsplit_once('.') {
                    Some((block, "ls1")) => find(format!("{block}.attn.proj.weight")),
                    Some((block, "ls2")) => find(format!("{block}.mlp.fc2.weight")),
                    _ => None,
                };
                if let Some(m) = in_front.filter(int8) {
                    folding.neutral.insert(i, 1.0);
                    folding.into.entry(m).or_default().gamma = Some(i);
                }
            }
            _ => {}
        }
    }
    for &m in folding.into.keys() {
        let bias = specs[m].name.strip_suffix("weight").and_then(|p| find(format!("{p}bias")));
        folding.bias_of.extend(bias.map(|b| (b, m)));
    }
    // An offset needs a bias to go into.
    debug_assert_eq!(folding.bias_of.len(), folding.into.len());
    folding
}

/// Matrices that read a norm, and nothing else does.
fn readers(norm: &str) -> Vec<String> {
    if let Some((block, "norm1")) = norm.rsplit_once('.') {
        return vec![format!("{block}.attn.qkv.weight")];
    }
    if let Some((block, "norm2")) = norm.rsplit_once('.') {
        return vec![format!("{block}.mlp.fc1.weight")];
    }
    // The token norm of a DPT head: four 1x1 convolutions.
    match norm.strip_suffix("_head.norm") {
        Some(head) => (0..4).map(|i| format!("{head}_head.projects.{i}.weight")).collect(),
        None => Vec::new(),
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use sf_formats::arch;

    fn planned(config: &ModelConfig, asked: Dtype) -> (Vec<TensorSpec>, Vec<Choice>, Folding) {
        let specs = arch::tensors(config);
        let choices: Vec<Choice> = specs.iter().map(|s| choose(config, s, asked, (None, false))).collect();
        let folding = fold(&specs, &choices);
        (specs, choices, folding)
    }

    /// Multiply-adds of the transformer are int8; what stays is named.
    #[test]
    fn the_bulk_is_int8() {
        for config in [ModelConfig::full().with_linear_heads(), ModelConfig::base().with_linear_heads()] {
            let (specs, choices, folding) = planned(&config, Dtype::Int8);
            let count = |d: Dtype| -> usize {
                specs
                    .iter()
                    .zip(&choices)
                    .filter(|(s, c)| s.matrix().is_some() && c.dtype == d)
                    .map(|(s, _)| s.len())
                    .sum()
            };
            let all = count(Dtype::Int8) + count(Dtype::F16) + count(Dtype::F32);
            assert!(count(Dtype::Int8) as f64 > 0.96 * all as f64, "{} of {all}", count(Dtype::Int8));
            for (s, c) in specs.iter().zip(&choices) {
                assert_eq!(c.reason.is_some(), s.matrix().is_some() && c.dtype != Dtype::Int8, "{}", s.name);
            }
            // Every block: two norms with gain and offset, two layer scales in trunks.
            let blocks = specs.iter().filter(|s| s.name.ends_with(".attn.qkv.weight")).count();
            let scales = specs.iter().filter(|s| s.role == Role::LayerScale).count();
            assert_eq!(folding.neutral.len(), 4 * blocks + scales);
            assert_eq!(folding.bias_of.len(), folding.into.len());
        }
        let (_, choices, folding) = planned(&ModelConfig::base(), Dtype::F16);
        assert!(folding.into.is_empty() && choices.iter().all(|c| c.dtype != Dtype::Int8));
    }

    #[test]
    fn a_norm_with_a_float_reader_stays() {
        let config = ModelConfig::base();
        let specs = arch::tensors(&config);
        let kept = ("gs_head.projects.2".to_string(), Dtype::F16);
        let choices: Vec<Choice> = specs
            .iter()
            .map(|s| choose(&config, s, Dtype::Int8, (names(&kept.0, &s.name).then_some(&kept), false)))
            .collect();
        let folding = fold(&specs, &choices);
        let at = |name: &str| specs.iter().position(|s| s.name == name).unwrap();
        assert!(!folding.neutral.contains_key(&at("gs_head.norm.weight")));
        assert!(folding.neutral.contains_key(&at("motion_head.norm.weight")));
        assert_eq!(choices[at("gs_head.projects.1.weight")].dtype, Dtype::Int8);
    }

    #[test]
    fn patterns_match_at_the_start() {
        assert!(names("gs_head.", "gs_head.norm.weight") && names("*.fc2", "decoder.3.mlp.fc2.weight"));
        assert!(names("decoder.?.attn", "decoder.3.attn.qkv.weight") && !names("head.", "gs_head.norm.weight"));
    }
}
