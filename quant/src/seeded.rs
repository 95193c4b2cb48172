//! [`Seeded`]: the random network of a configuration and a seed, as a checkpoint without a file.
//!
//! Weights have deviation 1 / sqrt(inputs), so activations keep their size; norms start neutral, layer
//! scales at 1 in the encoder and 0.1 elsewhere (training starts at 0.01, where layers would hardly
//! mix). Output layers are small, so that depth, colours and motion stay in a sensible range:
//!
//! | layer | deviation x sqrt(inputs) | bias |
//! |---|---|---|
//! | depth, log z | 0.5 | ln 5: some units away |
//! | depth, ray channels a and b | 0.005 | a ramp over the patch: a focal length of 14 patches |
//! | confidence of its own head | 0.5 | 0 |
//! | confidence beside the depth | 0.5 | 2: no sky |
//! | Gaussians (residuals on priors) | 0.1 | 0 |
//! | motion: velocity, dynamic logit | 0.5 | 0 |
//! | camera translation, rotation, field of view | 0.1 | rotation: identity |

use crate::rng::Stream;
use sf_formats::arch::{self, Role, TensorSpec};
use sf_formats::checkpoint::{Checkpoint, CheckpointTensor, SourceDtype};
use sf_formats::config::{DepthMap, HeadKind, ModelConfig};
use sf_formats::digest::{Digest, sha256};
use sf_formats::{Error, Result};

/// Metadata key under which checkpoints carry their configuration as JSON.
pub const CONFIG_KEY: &str = "streetforward.config";

/// ln 5 in f32: the usual depth of an untrained network.
const LOG_DEPTH: f32 = 1.609_438;
/// Logit of the confidence that stands beside the depth: everything is land, whose depth is then seen.
const LAND: f32 = 2.0;
/// Focal length in patches of an untrained network: 53 degrees for 14 patches across.
const FOCAL_PATCHES: f32 = 14.0;

/// What the output layers of the Gaussian and motion heads start with.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Outputs {
    /// Small random values: visible structure.
    Random,
    /// Zero: Gaussians exactly at their priors, nothing moves; for parts that a checkpoint lacks.
    Neutral,
}

/// A seeded random network.
#[derive(Clone, Debug)]
pub struct Seeded {
    config: ModelConfig,
    config_json: String,
    seed: u64,
    outputs: Outputs,
    specs: Vec<TensorSpec>,
    tensors: Vec<CheckpointTensor>,
}

impl Seeded {
    /// The network of a valid configuration.
    pub fn new(config: &ModelConfig, seed: u64, outputs: Outputs) -> Result<Seeded> {
        config.check("configuration")?;
        let specs = arch::tensors(config);
        let tensors = specs
            .iter()
            .map(|s| CheckpointTensor { name: s.name.clone(), shape: s.shape.clone(), dtype: SourceDtype::F32 })
            .collect();
        let config_json = config.to_json().to_string();
        Ok(Seeded { config: config.clone(), config_json, seed, outputs, specs, tensors })
    }

    /// Its configuration.
    pub fn config(&self) -> &ModelConfig {
        &self.config
    }

    /// Names, shapes and roles, in the order of [`arch::tensors`].
    pub fn specs(&self) -> &[TensorSpec] {
        &self.specs
    }

    fn fill(&self, spec: &TensorSpec, out: &mut Vec<f32>) {
        let n = spec.len();
        out.clear();
        match spec.role {
            Role::NormGain => out.resize(n, 1.0),
            Role::NormOffset => out.resize(n, 0.0),
            Role::LayerScale => out.resize(n, if spec.name.starts_with("encoder.") { 1.0 } else { 0.1 }),
            Role::Bias => {
                out.resize(n, 0.0);
                self.fill_bias(&spec.name, out);
            }
            Role::Table => self.random(spec, n, |_| 0.02, out),
            Role::Linear | Role::Conv | Role::ConvTranspose => {
                let inputs = spec.matrix().map_or(1, |(_, k)| k);
                let unit = 1.0 / (inputs as f64).sqrt();
                // The first axis is the output, but in transposed convolutions, where all factors are 1.
                self.random(spec, n / spec.shape[0], |o| unit * self.gain(&spec.name, o), out);
            }
        }
    }

    /// Random values in runs of `run` with one deviation each.
    fn random(&self, spec: &TensorSpec, run: usize, deviation: impl Fn(usize) -> f64, out: &mut Vec<f32>) {
        let stream = Stream::new(self.seed, &spec.name);
        for (r, start) in (0..spec.len()).step_by(run).enumerate() {
            let deviation = deviation(r);
            out.extend((start..start + run).map(|i| (stream.normal(i as u64) * deviation) as f32));
        }
    }

    /// Factor on the deviation of output `o` of a weight; 1 except in output layers.
    fn gain(&self, name: &str, o: usize) -> f64 {
        let Some(head) = output_layer(&self.config, name) else { return 1.0 };
        match head {
            "camera" => 0.1,
            "gs" | "motion" if self.outputs == Outputs::Neutral => 0.0,
            "gs" => 0.1,
            "point" if self.config.depth_map == DepthMap::Pi3Point && self.point_channel(o) < 2 => 0.005,
            _ => 0.5,
        }
    }

    fn fill_bias(&self, name: &str, out: &mut [f32]) {
        match (output_layer(&self.config, name), name) {
            (Some("point"), _) => {
                let side = self.config.patch as usize;
                for (o, value) in out.iter_mut().enumerate() {
                    let channel = self.point_channel(o);
                    let (y, x) = (o % (side * side) / side, o % side);
                    let ramp = |p: usize| (p as f32 + 0.5 - side as f32 / 2.0) / (FOCAL_PATCHES * side as f32);
                    *value = match (self.config.depth_map, self.config.depth.kind, channel) {
                        (DepthMap::ExpZConf, _, 1) => LAND,
                        (DepthMap::ExpZ | DepthMap::ExpZConf, ..) | (_, _, 2) => LOG_DEPTH,
                        (_, HeadKind::XdecLinear, 0) => ramp(x),
                        (_, HeadKind::XdecLinear, _) => ramp(y),
                        _ => 0.0,
                    };
                }
            }
            (_, "camera_head.fc_rot.bias") => {
                for i in 0..3 {
                    out[4 * i] = 1.0;
                }
            }
            _ => {}
        }
    }

    /// Channel (a, b, l; or l; or l, c) of output `o` of the depth head's last layer.
    fn point_channel(&self, o: usize) -> usize {
        match self.config.depth.kind {
            HeadKind::XdecLinear => o / (self.config.patch * self.config.patch) as usize,
            HeadKind::Guided => o / 4,
            _ => o,
        }
    }
}

/// The head (`point`, `conf`, `gs`, `motion`, `camera`) whose output layer a weight or bias belongs to.
pub(crate) fn output_layer<'a>(config: &ModelConfig, name: &'a str) -> Option<&'a str> {
    let (layer, _) = name.rsplit_once('.')?;
    if let Some((head, layer)) = layer.split_once("_head.") {
        let kind = match head {
            "point" => config.depth.kind,
            "conf" => config.conf.kind,
            "gs" => config.gs.kind,
            "motion" => config.motion.kind,
            "camera" => return ["fc_t", "fc_rot", "fc_fov"].contains(&layer).then_some(head),
            _ => return None,
        };
        let last = match kind {
            HeadKind::XdecLinear => "proj",
            HeadKind::Dpt => "scratch.output_conv2.2",
            HeadKind::Guided => "conv.3",
            HeadKind::None | HeadKind::XdecConv => return None,
        };
        return (layer == last).then_some(head);
    }
    None
}

impl Checkpoint for Seeded {
    fn tensors(&self) -> &[CheckpointTensor] {
        &self.tensors
    }

    fn read_f32(&self, index: usize, out: &mut Vec<f32>) -> Result<()> {
        let spec = self.specs.get(index).ok_or_else(|| Error::Internal(format!("no tensor {index}")))?;
        self.fill(spec, out);
        Ok(())
    }

    fn metadata(&self, key: &str) -> Option<&str> {
        (key == CONFIG_KEY).then_some(self.config_json.as_str())
    }

    fn describe(&self) -> String {
        format!("seeded random network, seed {}, {} tensors", self.seed, self.tensors.len())
    }

    /// Of the recipe: seed, kind of outputs, configuration.
    fn digest(&self) -> Result<Digest> {
        let recipe = format!("streetforward.init/1 {} {:?} {}", self.seed, self.outputs, self.config_json);
        Ok(sha256(recipe.as_bytes()))
    }
}
