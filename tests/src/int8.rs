//! Networks for the tests of int8: blobs converted from tensors in memory, and the network that breaks naive
//! quantization.

use crate::tiny::{Noise, Tensors, tensors};
use sf_formats::ModelConfig;
use sf_formats::Result;
use sf_formats::arch::{self, Role};
use sf_formats::blob::Blob;
use sf_formats::checkpoint::{Checkpoint, CheckpointTensor, SourceDtype};
use sf_formats::config::{Head, Trunk};
use sf_formats::digest::{Digest, sha256};
use sf_quant::{Options, convert_to_bytes};
use std::sync::Arc;
use streetforward::Model;

/// Tensors as a checkpoint.
pub struct Memory<'a> {
    list: Vec<CheckpointTensor>,
    tensors: &'a Tensors,
}

impl<'a> Memory<'a> {
    /// All of them.
    pub fn new(config: &ModelConfig, tensors: &'a Tensors) -> Memory<'a> {
        let list = arch::tensors(config)
            .into_iter()
            .map(|s| CheckpointTensor { name: s.name, shape: s.shape, dtype: SourceDtype::F32 })
            .collect();
        Memory { list, tensors }
    }
}

impl Checkpoint for Memory<'_> {
    fn tensors(&self) -> &[CheckpointTensor] {
        &self.list
    }

    fn read_f32(&self, index: usize, out: &mut Vec<f32>) -> Result<()> {
        out.clone_from(&self.tensors[&self.list[index].name]);
        Ok(())
    }

    fn metadata(&self, _: &str) -> Option<&str> {
        None
    }

    fn describe(&self) -> String {
        "tensors of a test".into()
    }

    fn digest(&self) -> Result<Digest> {
        Ok(sha256(b"test"))
    }
}

/// The bytes of these tensors as a blob.
pub fn blob(config: &ModelConfig, tensors: &Tensors, options: Options) -> Vec<u8> {
    convert_to_bytes(&Memory::new(config, tensors), &Options { config: Some(config.clone()), ..options }).unwrap()
}

/// A model of these tensors.
pub fn converted(config: &ModelConfig, tensors: &Tensors, options: Options) -> Arc<Model> {
    Arc::new(Model::from_blob(Blob::from_bytes(&blob(config, tensors, options)).unwrap()).unwrap())
}

/// [`crate::tiny::tiny`] with widths that can be rotated.
pub fn tiny() -> ModelConfig {
    ModelConfig { time_dim: 16, ..crate::tiny::tiny() }
}

/// [`crate::tiny::tiny_guided`] with channels in fours, so that its convolutions are int8, too.
pub fn guided() -> ModelConfig {
    let head = |out| Head::guided(out, (16, 1, 2), 8, 12);
    let tiny = crate::tiny::tiny_guided();
    ModelConfig { guide_channels: 4, depth: head(2), gs: head(11), motion: head(4), time_dim: 16, ..tiny }
}

/// A network of a preset's widths but few layers, with linear heads.
pub fn shallow(of: ModelConfig, encoder: u32, aa: u32) -> ModelConfig {
    let linear = |head: &Head| {
        if head.exists() { Head::xdec_linear(head.out, of.depth.dim, 1, of.depth.heads) } else { Head::none() }
    };
    ModelConfig {
        encoder: Trunk { depth: encoder, ..of.encoder.clone() },
        aa: Trunk { depth: aa, ..of.aa.clone() },
        camera_depth: 1,
        depth: linear(&of.depth),
        conf: linear(&of.conf),
        gs: linear(&of.gs),
        causal_depth: 1,
        motion: linear(&of.motion),
        ..of
    }
}

/// What makes trained vision transformers hard to quantize, planted into random weights:
///
/// | what | where |
/// |---|---|
/// | outlier channels | one in 64 channels of every norm's gain is 16 times larger |
/// | massive tokens | the learned registers hold values 40 times larger in two channels |
/// | heavy-tailed weights | every weight is a product of two random numbers, kurtosis about 10 |
/// | sparse, large hidden values | one in 64 rows of every first MLP layer is six times larger |
pub fn adversarial(config: &ModelConfig, seed: u64) -> Tensors {
    let mut map = tensors(config, seed);
    let mut noise = Noise::new(seed ^ 0xad7e);
    for spec in arch::tensors(config) {
        let values = map.get_mut(&spec.name).expect("all are there");
        match spec.role {
            Role::Linear => {
                let k = spec.shape[1];
                // Uniform times uniform^2 has heavier tails; the factor keeps the deviation.
                values.iter_mut().for_each(|v| *v *= 2.236 * noise.draw().powi(2));
                if spec.name.ends_with("mlp.fc1.weight") {
                    let rows = values.chunks_exact_mut(k).skip(5).step_by(64);
                    rows.for_each(|row| row.iter_mut().for_each(|v| *v *= 6.0));
                }
            }
            Role::NormGain if !spec.name.contains("q_norm") && !spec.name.contains("k_norm") => {
                values.iter_mut().skip(11).step_by(64).for_each(|v| *v *= 16.0);
            }
            Role::Table if spec.name.contains("register") => {
                let width = *spec.shape.last().expect("not a scalar");
                for token in values.chunks_exact_mut(width) {
                    token[7] *= 40.0;
                    token[width / 2 + 3] *= 40.0;
                }
            }
            Role::LayerScale => values.iter_mut().for_each(|v| *v = 0.1 + 0.02 * noise.draw()),
            _ => {}
        }
    }
    map
}

/// Relative error of `have` against `want`, both as a whole.
pub fn relative_error(have: &[f32], want: &[f32]) -> f64 {
    assert_eq!(have.len(), want.len(), "values");
    let (mut error, mut power) = (0.0, 0.0);
    for (&h, &w) in have.iter().zip(want) {
        error += (f64::from(h) - f64::from(w)).powi(2);
        power += f64::from(w).powi(2);
    }
    (error / power).sqrt()
}
