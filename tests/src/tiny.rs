//! Tiny random networks and clips for the tests of the engine: every part there, a few thousand parameters.

use sf_formats::ModelConfig;
use sf_formats::arch::{self, Role};
use sf_formats::blob::{Blob, Dtype};
use sf_formats::blob_writer::{BlobWriter, fits_f16};
use sf_formats::config::{Head, Trunk};
use sf_formats::meta::Meta;
use std::collections::BTreeMap;
use std::sync::Arc;
use streetforward::{ClipShape, Input, Model, Options, Output, Session, Tap};

/// Tensors by name.
pub type Tensors = BTreeMap<String, Vec<f32>>;

/// Uniform values in -1..1, the same on every machine.
pub struct Noise(u64);

impl Noise {
    /// A stream of its own per seed.
    pub fn new(seed: u64) -> Noise {
        Noise(seed.wrapping_mul(0x9e37_79b9_7f4a_7c15) | 1)
    }

    /// The next value.
    pub fn draw(&mut self) -> f32 {
        self.0 = self.0.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
        ((self.0 >> 40) as f32) / ((1u32 << 23) as f32) - 1.0
    }
}

/// Every part of the network, a few thousand parameters each.
pub fn tiny() -> ModelConfig {
    ModelConfig {
        encoder: Trunk { dim: 32, depth: 2, heads: 2, registers: 2, mlp_ratio: 2, eps: 1e-6 },
        pos_grid: 4,
        aa: Trunk { dim: 32, depth: 4, heads: 2, registers: 3, mlp_ratio: 2, eps: 1e-6 },
        camera_dim: 16,
        camera_depth: 1,
        camera_heads: 2,
        camera_width: 16,
        depth: Head::xdec_linear(3, 16, 1, 2),
        conf: Head::xdec_linear(1, 16, 1, 2),
        gs: Head::dpt(11, [0, 0, 1, 1], [8, 8, 8, 8], 16),
        time_dim: 8,
        causal_depth: 3,
        causal_heads: 2,
        motion: Head::dpt(4, [0, 1, 2, 2], [8, 8, 8, 8], 16),
        ..ModelConfig::base()
    }
}

/// [`tiny`] with guided heads and everything else that the nano preset has: confidence beside the depth, time in
/// the tokens, the field of view from the camera head, one velocity for both passes.
pub fn tiny_guided() -> ModelConfig {
    let head = |out| Head::guided(out, (16, 1, 2), 6, 12);
    let tiny = tiny();
    ModelConfig {
        encoder: tiny.encoder,
        pos_grid: tiny.pos_grid,
        aa: tiny.aa,
        camera_dim: tiny.camera_dim,
        camera_heads: tiny.camera_heads,
        camera_width: tiny.camera_width,
        guide_channels: 5,
        depth: head(2),
        gs: head(11),
        motion: head(4),
        time_dim: tiny.time_dim,
        causal_heads: tiny.causal_heads,
        ..ModelConfig::nano()
    }
}

/// Random tensors with nothing trivial in them.
pub fn tensors(config: &ModelConfig, seed: u64) -> Tensors {
    config.check("test").unwrap();
    let mut noise = Noise::new(seed);
    let mut map = Tensors::new();
    for spec in arch::tensors(config) {
        let (shift, scale) = match spec.role {
            Role::Linear | Role::Conv | Role::ConvTranspose => {
                (0.0, (3.0 / spec.matrix().expect("a matrix").1 as f32).sqrt())
            }
            Role::NormGain => (1.0, 0.2),
            Role::LayerScale => (0.3, 0.1),
            Role::Bias | Role::NormOffset => (0.0, 0.1),
            Role::Table => (0.0, 0.5),
        };
        map.insert(spec.name.clone(), (0..spec.len()).map(|_| shift + scale * noise.draw()).collect());
    }
    map
}

/// A model of these tensors.
pub fn model(config: &ModelConfig, tensors: &Tensors, dtype: Dtype) -> Arc<Model> {
    let mut writer = BlobWriter::in_memory(config, &Meta::default()).unwrap();
    for spec in writer.specs().to_vec() {
        let values = &tensors[&spec.name];
        writer.write(values, if fits_f16(values) { dtype } else { Dtype::F32 }).unwrap();
    }
    Arc::new(Model::from_blob(Blob::from_bytes(&writer.finish_bytes().unwrap()).unwrap()).unwrap())
}

/// Frames of smooth noise, a tenth of a second apart.
pub struct Frames {
    /// Frames and their size.
    pub shape: ClipShape,
    /// RGB bytes.
    pub images: Vec<u8>,
    /// Seconds.
    pub times: Vec<f64>,
}

impl Frames {
    /// A clip of its own per seed.
    pub fn new(frames: usize, height: usize, width: usize, seed: u64) -> Frames {
        let mut noise = Noise::new(seed);
        let mut images = Vec::with_capacity(frames * height * width * 3);
        for f in 0..frames {
            for y in 0..height {
                for x in 0..width {
                    for c in 0..3 {
                        let wave = ((x * (c + 2) + 5 * f) as f32 * 0.11).sin() + (y as f32 * 0.17 + c as f32).cos();
                        images.push((128.0 + 45.0 * wave + 20.0 * noise.draw()).clamp(0.0, 255.0) as u8);
                    }
                }
            }
        }
        let shape = ClipShape { frames, height, width };
        Frames { shape, images, times: (0..frames).map(|f| f as f64 * 0.1).collect() }
    }

    /// As input, intrinsics unknown.
    pub fn input(&self) -> Input<'_> {
        Input { shape: self.shape, images: &self.images, times: &self.times, k: None }
    }

    /// Bytes of one frame.
    pub fn frame_mut(&mut self, f: usize) -> &mut [u8] {
        let len = self.shape.height * self.shape.width * 3;
        &mut self.images[f * len..][..len]
    }
}

/// A session of two threads.
pub fn session(model: &Arc<Model>, shape: ClipShape) -> Session {
    Session::new(Arc::clone(model), shape, Options { threads: 2, ..Options::default() }).unwrap()
}

/// Every stage of a run, frames joined.
pub fn stages(model: &Arc<Model>, input: &Input) -> BTreeMap<String, Vec<f32>> {
    let mut map: BTreeMap<String, Vec<f32>> = BTreeMap::new();
    let mut tap = |tap: &Tap| map.entry(tap.name.to_string()).or_default().extend_from_slice(tap.data);
    session(model, input.shape).run_watched(input, None, Some(&mut tap)).unwrap();
    map
}

/// Everything that a run predicts for pixels and cameras, as bits.
pub fn bits(out: &Output) -> Vec<u32> {
    let lists = [&out.points, &out.mean, &out.scale, &out.colour, &out.v_fwd, &out.v_bwd];
    let all = lists.into_iter().flat_map(|l| l.as_flattened()).chain(out.quat.as_flattened());
    let all = all.chain(&out.depth).chain(&out.conf).chain(&out.opacity).chain(&out.dynamic);
    let cameras = out.poses.iter().zip(&out.k).flat_map(|(pose, k)| {
        let k = [k.fx, k.fy, k.cx, k.cy];
        pose.to_rows().into_iter().flatten().chain(k).flat_map(|v| [v.to_bits() as u32, (v.to_bits() >> 32) as u32])
    });
    all.map(|v| v.to_bits()).chain(cameras).collect()
}
