//! The whole network again, as plainly as it can be said: f32 values, naive ops, no arena, no threads, no
//! dispatch, weights straight from a checkpoint.
//!
//! This is the definition that the fast path is judged against, and it is judged itself against the
//! PyTorch model's golden tensors. It shares with the fast path only what is scalar code already: sizes and
//! the order of layers, embeddings and position tables, and the geometry after the heads (rotation,
//! intrinsics, activation maps).
//!
//! | file | what |
//! |---|---|
//! | `mod.rs` | weights by name, recorded stages, the order of things |
//! | `layers.rs` | transformer block, decoder, dense heads |

mod layers;

use crate::aggregator::is_global;
use crate::dims::Dims;
use crate::embed;
use crate::gaussians;
use crate::intrinsics;
use crate::motion::{self, Reach};
use crate::tables;
use crate::unproject::{self, View};
use crate::{Input, preprocess};
use layers::{Attention, Kind};
use sf_formats::checkpoint::Checkpoint;
use sf_formats::config::{Concat, DepthMap, Head, HeadKind, ModelConfig, MotionLayout, Trunk};
use sf_formats::{Error, Intrinsics, Pose, Result, arch};
use sf_ops::mat::{Hwc, Mat};
use sf_ops::reference as naive;
use std::borrow::Cow;
use std::collections::BTreeMap;

/// Tensors by public name, in checkpoint order and f32.
pub struct Weights {
    tensors: BTreeMap<String, Vec<f32>>,
    change: Option<Change>,
}

/// Changes the input rows `[.., k]` of the linear layer of a name; see [`Weights::with_inputs`].
pub type Change = Box<dyn Fn(&str, &mut [f32], usize) + Send + Sync>;

impl Weights {
    /// Reads every tensor the configuration asks for; `Model` when one is missing or misshapen.
    pub fn load(checkpoint: &dyn Checkpoint, config: &ModelConfig) -> Result<Weights> {
        let mut map = BTreeMap::new();
        for spec in arch::tensors(config) {
            let found = checkpoint.tensors().iter().position(|t| t.name == spec.name);
            let index = found.ok_or_else(|| Error::model(&spec.name, "tensor is missing in the checkpoint"))?;
            let shape = &checkpoint.tensors()[index].shape;
            if *shape != spec.shape {
                return Err(Error::model(&spec.name, format!("shape {shape:?} must be {:?}", spec.shape)));
            }
            let mut values = Vec::new();
            checkpoint.read_f32(index, &mut values)?;
            map.insert(spec.name, values);
        }
        Ok(Weights { tensors: map, change: None })
    }

    /// From tensors in memory; `Model` when one is missing or has the wrong length.
    pub fn from_map(tensors: BTreeMap<String, Vec<f32>>, config: &ModelConfig) -> Result<Weights> {
        for spec in arch::tensors(config) {
            let len = tensors.get(&spec.name).map(Vec::len);
            if len != Some(spec.len()) {
                return Err(Error::model(&spec.name, format!("{len:?} values must be {}", spec.len())));
            }
        }
        Ok(Weights { tensors, change: None })
    }

    /// The same weights, with the inputs of every linear layer of a transformer block changed before it is applied: how
    /// a quantizer would round them, for judging recipes.
    pub fn with_inputs(self, change: Change) -> Weights {
        Weights { change: Some(change), ..self }
    }

    /// The input of a layer as it is computed with.
    fn input<'x>(&self, name: &str, x: &'x [f32], k: usize) -> Cow<'x, [f32]> {
        let Some(change) = &self.change else { return Cow::Borrowed(x) };
        let mut x = x.to_vec();
        change(name, &mut x, k);
        Cow::Owned(x)
    }

    fn get(&self, name: &str) -> &[f32] {
        self.tensors.get(name).unwrap_or_else(|| panic!("{name} is in the tensor list that was loaded"))
    }

    fn optional(&self, name: &str) -> Option<&[f32]> {
        self.tensors.get(name).map(Vec::as_slice)
    }
}

/// A recorded intermediate result.
#[derive(Clone, Debug, PartialEq)]
pub struct Stage {
    /// Row-major shape.
    pub shape: Vec<usize>,
    /// Values.
    pub data: Vec<f32>,
}

/// Every stage under its name (`patches`, `pos`, `encoder`, `aa.{i}`, `camera.t`, ... `out.dynamic`).
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Stages(pub BTreeMap<String, Stage>);

impl Stages {
    fn put(&mut self, name: impl Into<String>, shape: &[usize], data: Vec<f32>) {
        let name = name.into();
        assert_eq!(shape.iter().product::<usize>(), data.len(), "shape of stage {name}");
        self.0.insert(name, Stage { shape: shape.to_vec(), data });
    }

    /// A stage that is known to be there.
    pub fn get(&self, name: &str) -> &Stage {
        self.0.get(name).unwrap_or_else(|| panic!("stage {name} was not recorded"))
    }
}

/// Runs the network on a clip at the network's size.
pub fn run(weights: &Weights, config: &ModelConfig, input: &Input) -> Result<Stages> {
    let d = Dims::new(config, input.shape)?;
    input.check()?;
    let net = Network { w: weights, config, d, input };
    let mut s = Stages::default();
    net.encoder(&mut s);
    net.aggregator(&mut s);
    net.camera(&mut s);
    net.depth(&mut s);
    let ks = net.intrinsics(&mut s);
    let motion = net.motion(&mut s);
    net.outputs(&ks, motion.as_ref(), &mut s);
    Ok(s)
}

struct Network<'a> {
    w: &'a Weights,
    config: &'a ModelConfig,
    d: Dims,
    input: &'a Input<'a>,
}

/// Raw motion maps per frame.
struct RawMotion {
    fwd: Vec<f32>,
    bwd: Option<Vec<f32>>,
}

impl Network<'_> {
    fn encoder(&self, s: &mut Stages) {
        let (c, d) = (self.config, &self.d);
        let dim = c.encoder.dim as usize;
        let positions = tables::positions(c, self.w.get("encoder.pos_embed"), d.rows, d.cols);
        let registers = self.w.optional("encoder.register_tokens").unwrap_or(&[]);
        let window = naive::Window { kernel: c.patch as usize, stride: c.patch as usize, pad: 0 };
        let (mut patches, mut out) = (Vec::new(), Vec::new());
        for f in 0..d.frames {
            let mut image = vec![0.0; d.pixels() * 3];
            preprocess::Normaliser::new(c).apply(self.input.frame(f), &mut image);
            let proj = self.w.get("encoder.patch_embed.proj.weight");
            let bias = self.w.get("encoder.patch_embed.proj.bias");
            let features = naive::conv2d(Hwc::new(&image, d.height, d.width, 3), proj, Some(bias), window);

            let mut x: Vec<f32> = self.w.get("encoder.cls_token").to_vec();
            x.iter_mut().zip(&positions).for_each(|(x, p)| *x += p);
            x.extend_from_slice(registers);
            x.extend(features.iter().zip(&positions[dim..]).map(|(x, p)| x + p));
            patches.extend(features);
            for i in 0..c.encoder.depth {
                let p = format!("encoder.blocks.{i}");
                layers::block(self.w, &p, &mut x, Attention::own_frame(&c.encoder, Kind::Encoder, d.encoder_tokens));
            }
            let from = &x[dim + registers.len()..];
            let (gain, offset) = (self.w.get("encoder.norm.weight"), self.w.get("encoder.norm.bias"));
            out.extend(naive::layernorm(Mat::new(from, d.patches, dim), gain, offset, c.encoder.eps as f32));
        }
        s.put("pos", &[1 + d.patches, dim], positions);
        s.put("patches", &[d.frames, d.patches, dim], patches);
        s.put("encoder", &[d.frames, d.patches, dim], out);
    }

    fn aggregator(&self, s: &mut Stages) {
        let (c, d) = (self.config, &self.d);
        let dim = c.aa.dim as usize;
        let registers = self.w.optional("register_token").unwrap_or(&[]);
        let mut x = Vec::new();
        for f in 0..d.frames {
            x.extend_from_slice(registers);
            x.extend_from_slice(&s.get("encoder").data[f * d.patches * dim..][..d.patches * dim]);
        }
        if c.time_dim > 0 {
            let n = c.time_dim as usize;
            let mut time = vec![0.0; d.frames * n];
            for (tau, t) in time.chunks_exact_mut(n).zip(self.input.times) {
                embed::time((t - self.input.times[0]) / c.time_unit, c.time_base, tau);
            }
            if c.aa_time {
                let (w, b) = (self.w.get("aa_time.weight"), self.w.get("aa_time.bias"));
                let shift = naive::linear(Mat::new(&time, d.frames, n), w, Some(b));
                for (row, x) in x.chunks_exact_mut(dim).enumerate() {
                    let f = row / d.tokens;
                    x.iter_mut().zip(&shift[f * dim..]).for_each(|(x, s)| *x += s);
                }
            }
            s.put("time", &[d.frames, n], time);
        }
        let places = tables::rope_table(c, c.aa.registers as usize, (d.rows, d.cols), dim / c.aa.heads as usize);
        for i in 0..c.aa.depth as usize {
            let own = d.frame_mask(d.tokens);
            let mask = if is_global(c, i) { d.global_mask() } else { own };
            let attention = Attention { mask, rope: Some(&places), ..Attention::own_frame(&c.aa, self.aa(), 0) };
            layers::block(self.w, &format!("decoder.{i}"), &mut x, attention);
            s.put(format!("aa.{i}"), &[d.frames, d.tokens, dim], x.clone());
        }
    }

    fn aa(&self) -> Kind {
        Kind::Aa { qk_eps: self.config.qk_eps as f32 }
    }

    /// Outputs of aggregator layers side by side, `[frames, tokens, layers * dim]`.
    fn features(&self, s: &Stages, layers: &[usize]) -> Vec<f32> {
        let dim = self.config.aa.dim as usize;
        let mut out = Vec::new();
        for token in 0..self.d.frames * self.d.tokens {
            for i in layers {
                out.extend_from_slice(&s.get(&format!("aa.{i}")).data[token * dim..][..dim]);
            }
        }
        out
    }

    /// What the camera and linear heads read, by a configured choice.
    fn last(&self, s: &Stages, concat: Concat) -> Vec<f32> {
        let n = self.config.aa.depth as usize;
        match concat {
            Concat::FrameGlobal => self.features(s, &[n - 2, n - 1]),
            Concat::Last => self.features(s, &[n - 1]),
        }
    }

    fn camera(&self, s: &mut Stages) {
        let (c, d) = (self.config, &self.d);
        let trunk = layers::decoder_trunk(c.camera_dim, c.camera_depth, c.camera_heads, c.aa.eps);
        let x = self.last(s, c.head_concat);
        let registers = c.aa.registers as usize;
        let decoded = layers::decoder(self, "camera_decoder", &x, &trunk, registers);
        let width = c.camera_width as usize;
        let linear = |name: &str, x: &[f32]| {
            let (w, b) = (self.w.get(&format!("{name}.weight")), self.w.get(&format!("{name}.bias")));
            let k = w.len() / b.len();
            naive::linear(Mat::new(x, x.len() / k, k), w, Some(b))
        };
        let relu = |x: Vec<f32>| -> Vec<f32> { x.into_iter().map(naive::relu).collect() };
        let (mut ts, mut nines, mut fovs, mut poses) = (Vec::new(), Vec::new(), Vec::new(), Vec::new());
        for f in 0..d.frames {
            let mut x = decoded[f * d.patches * width..][..d.patches * width].to_vec();
            for unit in 0..2 {
                let mut h = x.clone();
                for conv in 1..=3 {
                    h = relu(linear(&format!("camera_head.res_conv.{unit}.res_conv{conv}"), &h));
                }
                x.iter_mut().zip(&h).for_each(|(x, h)| *x += h);
            }
            let mean: Vec<f32> = (0..width)
                .map(|j| x.iter().skip(j).step_by(width).map(|&v| f64::from(v)).sum::<f64>() / d.patches as f64)
                .map(|m| m as f32)
                .collect();
            let h = relu(linear("camera_head.more_mlps.0", &mean));
            let h = relu(linear("camera_head.more_mlps.2", &h));
            let t: [f32; 3] = linear("camera_head.fc_t", &h).try_into().expect("three numbers");
            let nine: [f32; 9] = linear("camera_head.fc_rot", &h).try_into().expect("nine numbers");
            if self.w.optional("camera_head.fc_fov.weight").is_some() {
                fovs.extend(linear("camera_head.fc_fov", &h));
            }
            ts.extend(t);
            nines.extend(nine);
            poses.extend(unproject::raw_pose(&t, &nine).to_rows().as_flattened().iter().map(|&v| v as f32));
        }
        s.put("camera.t", &[d.frames, 3], ts);
        s.put("camera.rot9", &[d.frames, 9], nines);
        s.put("pose", &[d.frames, 4, 4], poses);
        if !fovs.is_empty() {
            s.put("camera.fov", &[d.frames, 2], fovs);
        }
    }

    /// The raw map of a dense head on the aggregator, `[frames, height, width, out]`.
    fn head(&self, s: &Stages, name: &str, head: &Head) -> Vec<f32> {
        let registers = self.config.aa.registers as usize;
        match head.kind {
            HeadKind::XdecLinear => {
                let x = self.last(s, self.config.head_concat);
                layers::linear_head(self, name, &x, head, registers)
            }
            HeadKind::Guided => {
                let x = self.last(s, self.config.head_concat);
                layers::guided_head(self, name, (&x, &s.get("guide").data), head, registers)
            }
            HeadKind::Dpt => {
                let taps: Vec<Vec<f32>> = head
                    .taps
                    .iter()
                    .map(|&t| {
                        let t = t as usize;
                        self.patches(&self.features(s, &[2 * t, 2 * t + 1]), registers)
                    })
                    .collect();
                layers::dpt(self, name, &taps, head)
            }
            HeadKind::None | HeadKind::XdecConv => unreachable!("{name} head is not executed"),
        }
    }

    /// Drops the registers of every frame.
    fn patches(&self, x: &[f32], registers: usize) -> Vec<f32> {
        let d = &self.d;
        let per_frame = d.patches + registers;
        let cols = x.len() / (d.frames * per_frame);
        x.chunks_exact(per_frame * cols).flat_map(|f| f[registers * cols..].to_vec()).collect()
    }

    fn depth(&self, s: &mut Stages) {
        let (c, d) = (self.config, &self.d);
        if c.guide_channels > 0 {
            let size = [d.frames, d.height / 2, d.width / 2, c.guide_channels as usize];
            s.put("guide", &size, layers::image_stem(self));
        }
        let raw = self.head(s, "point", &c.depth);
        let (points, channels) = match c.depth_map {
            DepthMap::Pi3Point => {
                let points = raw.chunks_exact(3).flat_map(|p| {
                    let z = naive::exp(p[2]);
                    [p[0] * z, p[1] * z, z]
                });
                (points.collect(), 3)
            }
            DepthMap::ExpZ => (raw.iter().map(|&l| naive::exp(l)).collect::<Vec<f32>>(), 1),
            DepthMap::ExpZConf => {
                let conf = raw.chunks_exact(2).map(|p| p[1]).collect();
                s.put("conf", &[d.frames, d.height, d.width], conf);
                (raw.chunks_exact(2).map(|p| naive::exp(p[0])).collect(), 1)
            }
        };
        s.put("point", &[d.frames, d.height, d.width, channels], points);
        if c.conf.exists() {
            let conf = self.head(s, "conf", &c.conf);
            s.put("conf", &[d.frames, d.height, d.width], conf);
        }
        if c.gs.exists() {
            let gs = self.head(s, "gs", &c.gs);
            s.put("gs.raw", &[d.frames, d.height, d.width, gaussians::CHANNELS], gs);
        }
    }

    fn intrinsics(&self, s: &mut Stages) -> Vec<Intrinsics> {
        let d = &self.d;
        let points = (self.config.depth_map == DepthMap::Pi3Point).then(|| s.get("point").data.as_slice());
        let fov = s.0.get("camera.fov").map(|f| f.data.as_slice());
        let mut ks = vec![Intrinsics { fx: 1.0, fy: 1.0, cx: 0.0, cy: 0.0 }; d.frames];
        intrinsics::choose(self.config, d, intrinsics::Evidence { points, fov, user: self.input.k }, &mut ks);
        let flat = ks.iter().flat_map(|k| [k.fx, k.fy, k.cx, k.cy].map(|v| v as f32)).collect();
        s.put("k", &[d.frames, 4], flat);
        ks
    }

    fn motion(&self, s: &mut Stages) -> Option<RawMotion> {
        let (c, d) = (self.config, &self.d);
        if !c.has_motion() || d.frames == 1 {
            return None;
        }
        let (fwd, bwd) = Reach::of(c);
        let raw_fwd = self.pass(s, "fwd", "causal", fwd);
        let set = if c.causal_share { "causal" } else { "causal_back" };
        let raw_bwd = bwd.map(|reach| self.pass(s, "bwd", set, reach));
        let shape = [d.frames, d.height, d.width, c.motion.out as usize];
        s.put("motion.fwd", &shape, raw_fwd.clone());
        if let Some(raw) = &raw_bwd {
            s.put("motion.bwd", &shape, raw.clone());
        }
        Some(RawMotion { fwd: raw_fwd, bwd: raw_bwd })
    }

    /// One causal pass and the motion head on it.
    fn pass(&self, s: &mut Stages, direction: &str, set: &str, reach: Reach) -> Vec<f32> {
        let (c, d) = (self.config, &self.d);
        let registers = if c.causal_registers { c.aa.registers as usize } else { 0 };
        let per_frame = d.patches + registers;
        let mut from = self.last(s, c.causal_in);
        if !c.causal_registers {
            from = self.patches(&from, c.aa.registers as usize);
        }
        let (dim, time_dim) = (c.causal_dim() as usize, c.time_dim as usize);
        let mut x = Vec::new();
        for (row, token) in from.chunks_exact(dim - time_dim).enumerate() {
            x.extend_from_slice(token);
            if time_dim > 0 {
                x.extend_from_slice(&s.get("time").data[row / per_frame * time_dim..][..time_dim]);
            }
        }
        let trunk =
            Trunk { depth: c.causal_depth, ..layers::decoder_trunk(c.causal_dim(), 0, c.causal_heads, c.aa.eps) };
        let places = tables::rope_table(c, registers, (d.rows, d.cols), dim / c.causal_heads as usize);
        let mask = sf_ops::attention::FrameMask { frames: d.frames, tokens: per_frame, lo: reach.lo, hi: reach.hi };
        let attention = Attention { mask, rope: Some(&places), ..Attention::own_frame(&trunk, self.aa(), 0) };
        let mut taps = Vec::new();
        for i in 0..c.causal_depth {
            layers::block(self.w, &format!("{set}.{i}"), &mut x, attention);
            let tap = self.patches(&x, registers);
            s.put(format!("causal.{direction}.{i}"), &[d.frames, d.patches, dim], tap.clone());
            taps.push(tap);
        }
        match c.motion.kind {
            HeadKind::Dpt => {
                let taps: Vec<Vec<f32>> = c.motion.taps.iter().map(|&t| taps[t as usize].clone()).collect();
                layers::dpt(self, "motion", &taps, &c.motion)
            }
            HeadKind::Guided => {
                let x = self.patches(&x, registers);
                layers::guided_head(self, "motion", (&x, &s.get("guide").data), &c.motion, 0)
            }
            _ => layers::linear_head(self, "motion", &self.patches(&x, registers), &c.motion, 0),
        }
    }

    fn outputs(&self, ks: &[Intrinsics], motion: Option<&RawMotion>, s: &mut Stages) {
        let (c, d) = (self.config, &self.d);
        let (n, px, w) = (d.frames, d.pixels(), d.width);
        let raw: Vec<Pose> = (0..n)
            .map(|f| {
                let t = s.get("camera.t").data[3 * f..][..3].try_into().expect("three numbers");
                let nine = s.get("camera.rot9").data[9 * f..][..9].try_into().expect("nine numbers");
                unproject::raw_pose(t, nine)
            })
            .collect();
        let mut poses = vec![Pose::IDENTITY; n];
        unproject::anchor(c, &raw, &mut poses);

        let channels = if c.depth_map == DepthMap::Pi3Point { 3 } else { 1 };
        let scale = c.world_scale as f32;
        let depth: Vec<f32> = s.get("point").data.chunks_exact(channels).map(|p| p[channels - 1] * scale).collect();
        let mut o = Planes::new(n * px);
        for f in 0..n {
            let view = View { pose: poses[f], k: ks[f], pixel: c.camera_pixel };
            let map = gaussians::Map::new(c, &view);
            let moves = motion::Map::new(c, self.input.times, f, view.rotation());
            for v in 0..d.height {
                let row = f * px + v * w..f * px + (v + 1) * w;
                let channel = |name: &str, k: usize| s.0.get(name).map(|stage| &stage.data[row.start * k..row.end * k]);
                let raw = match channel("gs.raw", gaussians::CHANNELS) {
                    Some(raw) => gaussians::Raw::Head(raw),
                    None => gaussians::Raw::Priors(channel("conf", 1)),
                };
                let z = &depth[row.clone()];
                let image = &self.input.images[3 * row.start..3 * row.end];
                view.mean_row(v, z, &mut o.mean[row.clone()]);
                map.scale_row(raw, z, &mut o.scale[row.clone()]);
                map.quat_row(raw, &mut o.quat[row.clone()]);
                map.opacity_row(raw, &mut o.opacity[row.clone()]);
                map.colour_row(raw, image, &mut o.colour[row.clone()]);
                if let Some(m) = motion {
                    let out = c.motion.out as usize;
                    let part = |v: &'_ Vec<f32>| v[row.start * out..row.end * out].to_vec();
                    let (fwd, bwd) = (part(&m.fwd), m.bwd.as_ref().map(part));
                    let raw = match (&bwd, c.motion_layout) {
                        (Some(bwd), MotionLayout::PerDirection) => motion::Raw::Passes(&fwd, bwd),
                        _ => motion::Raw::Single(&fwd),
                    };
                    moves.forward_row(raw, &mut o.v_fwd[row.clone()]);
                    moves.backward_row(raw, &mut o.v_bwd[row.clone()]);
                    moves.dynamic_row(raw, &mut o.dynamic[row.clone()]);
                }
            }
        }
        let rows = poses.iter().flat_map(|p| p.to_rows().as_flattened().iter().map(|&v| v as f32).collect::<Vec<_>>());
        s.put("out.pose", &[n, 4, 4], rows.collect());
        let size = [n, d.height, d.width];
        let vectors = [n, d.height, d.width, 3];
        s.put("out.depth", &size, depth);
        s.put("out.mean", &vectors, o.mean.into_flattened());
        s.put("out.scale", &vectors, o.scale.into_flattened());
        s.put("out.quat", &[n, d.height, d.width, 4], o.quat.into_flattened());
        s.put("out.opacity", &size, o.opacity);
        s.put("out.colour", &vectors, o.colour.into_flattened());
        s.put("out.v_fwd", &vectors, o.v_fwd.into_flattened());
        s.put("out.v_bwd", &vectors, o.v_bwd.into_flattened());
        s.put("out.dynamic", &size, o.dynamic);
    }
}

/// One value or vector per pixel of the clip.
struct Planes {
    mean: Vec<[f32; 3]>,
    scale: Vec<[f32; 3]>,
    quat: Vec<[f32; 4]>,
    opacity: Vec<f32>,
    colour: Vec<[f32; 3]>,
    v_fwd: Vec<[f32; 3]>,
    v_bwd: Vec<[f32; 3]>,
    dynamic: Vec<f32>,
}

impl Planes {
    fn new(n: usize) -> Planes {
        let vectors = || vec![[0.0; 3]; n];
        Planes {
            mean: vectors(),
            scale: vectors(),
            quat: vec![[0.0; 4]; n],
            opacity: vec![0.0; n],
            colour: vectors(),
            v_fwd: vectors(),
            v_bwd: vectors(),
            dynamic: vec![0.0; n],
        }
    }
}
