//! [`ModelConfig`]: every size and every convention of the network.
//!
//! The network is described completely by this record: no size and no convention is a constant of
//! the engine. It travels as flat dotted keys (`encoder.dim`, `mask.k`, ...) with the same names in a
//! checkpoint's JSON metadata, in a `config.json` and in the weight blob.
//!
//! Conventions that public code or the paper leave open are fields with the most faithful reading as
//! default; `docs/network.md` lists them with their reasons.

use crate::error::{Error, Result};
use std::collections::BTreeMap;

/// One configuration value.
#[derive(Clone, Debug, PartialEq)]
pub enum Value {
    /// Integers and sizes.
    Int(i64),
    /// Real numbers.
    Float(f64),
    /// Switches.
    Bool(bool),
    /// Names of alternatives.
    Text(String),
    /// Lists of integers.
    Ints(Vec<i64>),
    /// Lists of reals.
    Floats(Vec<f64>),
}

/// A type that can stand as one configuration value.
pub trait Setting: Sized {
    /// As a value.
    fn to_value(&self) -> Value;
    /// From a value of the right type and range.
    fn from_value(v: &Value) -> Option<Self>;
}

impl Setting for u32 {
    fn to_value(&self) -> Value {
        Value::Int(i64::from(*self))
    }
    fn from_value(v: &Value) -> Option<Self> {
        match v {
            Value::Int(i) => u32::try_from(*i).ok(),
            _ => None,
        }
    }
}

impl Setting for i32 {
    fn to_value(&self) -> Value {
        Value::Int(i64::from(*self))
    }
    fn from_value(v: &Value) -> Option<Self> {
        match v {
            Value::Int(i) => i32::try_from(*i).ok(),
            _ => None,
        }
    }
}

impl Setting for f64 {
    fn to_value(&self) -> Value {
        Value::Float(*self)
    }
    fn from_value(v: &Value) -> Option<Self> {
        match v {
            Value::Float(f) if f.is_finite() => Some(*f),
            Value::Int(i) => Some(*i as f64),
            _ => None,
        }
    }
}

impl Setting for bool {
    fn to_value(&self) -> Value {
        Value::Bool(*self)
    }
    fn from_value(v: &Value) -> Option<Self> {
        match v {
            Value::Bool(b) => Some(*b),
            _ => None,
        }
    }
}

impl Setting for Vec<u32> {
    fn to_value(&self) -> Value {
        Value::Ints(self.iter().map(|&i| i64::from(i)).collect())
    }
    fn from_value(v: &Value) -> Option<Self> {
        match v {
            Value::Ints(l) => l.iter().map(|&i| u32::try_from(i).ok()).collect(),
            // An empty list carries no element type in JSON.
            Value::Floats(l) if l.is_empty() => Some(Vec::new()),
            _ => None,
        }
    }
}

impl Setting for [f64; 3] {
    fn to_value(&self) -> Value {
        Value::Floats(self.to_vec())
    }
    fn from_value(v: &Value) -> Option<Self> {
        match v {
            Value::Floats(l) if l.iter().all(|f| f.is_finite()) => <[f64; 3]>::try_from(&l[..]).ok(),
            Value::Ints(l) => <[i64; 3]>::try_from(&l[..]).ok().map(|a| a.map(|i| i as f64)),
            _ => None,
        }
    }
}

macro_rules! choice {
    ($(#[$doc:meta])* $name:ident { $($(#[$vdoc:meta])* $variant:ident = $text:literal),* $(,)? }) => {
        $(#[$doc])*
        #[derive(Clone, Copy, Debug, PartialEq, Eq)]
        pub enum $name { $($(#[$vdoc])* $variant),* }
        impl Setting for $name {
            fn to_value(&self) -> Value {
                Value::Text(match self { $($name::$variant => $text),* }.to_string())
            }
            fn from_value(v: &Value) -> Option<Self> {
                match v {
                    Value::Text(t) => match t.as_str() { $($text => Some($name::$variant),)* _ => None },
                    _ => None,
                }
            }
        }
    };
}

choice! {
    /// How frames are resized to the network's size (Pillow-compatible window filters, 8-bit).
    Resample {
        /// Cubic convolution, a = -0.5, window widened when shrinking.
        Bicubic = "bicubic",
        /// Lanczos with three lobes, as Pi3's public loader.
        Lanczos = "lanczos",
        /// Triangle filter.
        Bilinear = "bilinear",
    }
}
choice! {
    /// Which alternating-attention layers come first.
    Order {
        /// Even layers inside a frame, odd layers over all frames (Pi3).
        FrameFirst = "frame_first",
        /// The other way round.
        GlobalFirst = "global_first",
    }
}
choice! {
    /// Rounding of the rotary angles before sine and cosine.
    AngleRound {
        /// Full precision.
        None = "none",
        /// To bfloat16, as the released half-precision pipelines do.
        Bf16 = "bf16",
    }
}
choice! {
    /// Which alternating-attention features a consumer reads.
    Concat {
        /// Last frame layer then last global layer, 2 x width.
        FrameGlobal = "frame_global",
        /// Last layer of the pair only, 1 x width.
        Last = "last",
    }
}
choice! {
    /// Kind of a dense head.
    HeadKind {
        /// The head does not exist.
        None = "none",
        /// Transformer decoder, one linear layer, pixel shuffle (Pi3).
        XdecLinear = "xdec_linear",
        /// Transformer decoder with convolutional output (Pi3X); known, not executed.
        XdecConv = "xdec_conv",
        /// Four-tap convolutional pyramid (VGGT's DPT head).
        Dpt = "dpt",
    }
}
choice! {
    /// What the skip path of a DPT residual unit adds.
    RcuSkip {
        /// `relu(x)`: what VGGT's in-place activation executes.
        Relu = "relu",
        /// `x`: the textbook unit (Depth-Anything-3).
        Raw = "raw",
    }
}
choice! {
    /// From raw depth-head channels to depth.
    DepthMap {
        /// Channels (a, b, l): z = exp(l), local point (a z, b z, z) (Pi3).
        Pi3Point = "pi3_point",
        /// One channel l: z = exp(l), rays from K.
        ExpZ = "exp_z",
    }
}
choice! {
    /// From raw Gaussian-head channels to parameters.
    GsMap {
        /// Residuals on priors: colour = image + d, opacity = sigmoid(o + 2),
        /// scale = 0.7 (z / f) exp(clamp(d, -4, 4)), quaternion + identity in camera axes.
        Residual = "residual",
        /// DGGT: colour sigmoid, opacity sigmoid, scale 0.1 softplus, quaternion in world axes.
        Dggt = "dggt",
    }
}
choice! {
    /// Where the intrinsics come from.
    KSource {
        /// Least squares on the predicted rays, shared over the clip, centred principal point.
        FitShared = "fit_shared",
        /// The same, each frame for itself.
        FitFrame = "fit_frame",
        /// Two field-of-view channels of the camera head (`camera_head.fc_fov`): log(fx/W), log(fy/W).
        Fov = "fov",
    }
}
choice! {
    /// Where a pixel's ray passes.
    PixelCentre {
        /// (u + 0.5, v + 0.5) with the principal point at W/2, H/2.
        Half = "half",
        /// (u, v) against W/2, H/2, VGGT's convention with its half-pixel offset.
        Integer = "integer",
    }
}
choice! {
    /// Reading of the causal mask.
    Orientation {
        /// Forward pass: frame f sees f..f+k (the paper's equation).
        Equation = "equation",
        /// Forward pass: frame f sees f-k..f (the figure read row = query).
        Figure = "figure",
    }
}
choice! {
    /// Output channels of the motion head.
    MotionLayout {
        /// One pass gives one direction: velocity 3, dynamic logit 1.
        PerDirection = "per_direction",
        /// One pass gives both: v+ 3, v- 3, dynamic logit 1.
        SinglePass = "single_pass",
    }
}
choice! {
    /// Axes of the predicted velocity.
    MotionFrame {
        /// The source camera's axes; rotated to world.
        Camera = "camera",
        /// World axes.
        World = "world",
    }
}
choice! {
    /// Unit of time of the predicted velocity.
    MotionPer {
        /// Scene units per second.
        Second = "second",
        /// Scene units per step between sampled frames.
        Step = "step",
    }
}
choice! {
    /// How the two passes' dynamic probabilities become one.
    Combine {
        /// Mean over the directions that have a neighbour.
        Mean = "mean",
        /// Maximum over those directions.
        Max = "max",
    }
}
choice! {
    /// World gauge.
    Anchor {
        /// The first frame's camera is the world.
        First = "first",
        /// The network's own gauge.
        Raw = "raw",
    }
}
choice! {
    /// What happens to a frame's own dynamic Gaussians when rendering exactly at its time.
    SelfRule {
        /// Only the frame's own dynamic set (inference default).
        Own = "own",
        /// Only its neighbours' (the paper's training rule).
        Neighbours = "neighbours",
    }
}
choice! {
    /// Velocity used before the first and after the last frame.
    Extrapolate {
        /// The trained direction of that frame, mirrored: -v- after the end, -v+ before the start.
        Mirror = "mirror",
        /// The untrained direction itself.
        Direct = "direct",
    }
}
choice! {
    /// Static/dynamic separation.
    Split {
        /// Dynamic iff the probability exceeds tau (the paper's indicator).
        Hard = "hard",
        /// Every Gaussian twice, opacity weighted by probability (DGGT).
        Soft = "soft",
    }
}
choice! {
    /// Treatment of the sky.
    Sky {
        /// Ordinary static Gaussians.
        None = "none",
        /// Pixels with confidence under 0.1 are pushed to a far shell.
        FarShell = "far_shell",
    }
}
choice! {
    /// An extra image shortcut before a DPT head's last layer.
    ImageMerger {
        /// None.
        None = "none",
    }
}

/// A transformer trunk: the image encoder or the alternating-attention stack.
#[derive(Clone, Debug, PartialEq)]
pub struct Trunk {
    /// Channels.
    pub dim: u32,
    /// Blocks.
    pub depth: u32,
    /// Attention heads; `dim / heads` is the head width.
    pub heads: u32,
    /// Register tokens per frame (the encoder's class token not counted).
    pub registers: u32,
    /// Hidden width of the MLP over `dim`.
    pub mlp_ratio: u32,
    /// Layer-norm epsilon of the blocks.
    pub eps: f64,
}

/// A dense head: one output vector per pixel.
#[derive(Clone, Debug, PartialEq)]
pub struct Head {
    /// Kind.
    pub kind: HeadKind,
    /// Output channels per pixel.
    pub out: u32,
    /// `xdec_linear`: decoder width.
    pub dim: u32,
    /// `xdec_linear`: decoder blocks.
    pub depth: u32,
    /// `xdec_linear`: attention heads.
    pub heads: u32,
    /// `dpt`: the four layers read, 0-based alternating-attention pairs (or causal layers).
    pub taps: Vec<u32>,
    /// `dpt`: channels of the four tap projections.
    pub channels: Vec<u32>,
    /// `dpt`: width of the fusion pyramid.
    pub features: u32,
    /// `dpt`: channels before the last 1x1 convolution.
    pub hidden: u32,
    /// `dpt`: skip path of the residual units.
    pub rcu_skip: RcuSkip,
    /// `dpt`: epsilon of the token norm.
    pub eps: f64,
    /// `dpt`: image shortcut.
    pub image_merger: ImageMerger,
}

/// Every size and convention of one network.
#[derive(Clone, Debug, PartialEq)]
pub struct ModelConfig {
    /// Pixels per patch side.
    pub patch: u32,
    /// RGB mean subtracted from images in 0..1.
    pub image_mean: [f64; 3],
    /// RGB deviation divided by.
    pub image_std: [f64; 3],
    /// How frames are resized to the network's size.
    pub image_resample: Resample,

    /// Image encoder (DINOv2 with registers).
    pub encoder: Trunk,
    /// Side of the square position table.
    pub pos_grid: u32,

    /// Alternating-attention stack; `depth` counts frame and global layers.
    pub aa: Trunk,
    /// Epsilon of the per-head query and key norms.
    pub qk_eps: f64,
    /// Which layers come first.
    pub aa_order: Order,
    /// Whether a linear map of the time embedding is added to the input tokens (`aa_time`).
    pub aa_time: bool,
    /// Rotary base frequency.
    pub rope_base: f64,
    /// Rounding of rotary angles.
    pub rope_round: AngleRound,

    /// Features the camera and the `xdec_linear` heads read.
    pub head_concat: Concat,
    /// Camera decoder width.
    pub camera_dim: u32,
    /// Camera decoder blocks.
    pub camera_depth: u32,
    /// Camera decoder heads.
    pub camera_heads: u32,
    /// Width of the camera head itself.
    pub camera_width: u32,
    /// Where intrinsics come from.
    pub camera_k: KSource,
    /// Pixel-centre convention of unprojection.
    pub camera_pixel: PixelCentre,

    /// Depth (point) head.
    pub depth: Head,
    /// From its channels to depth.
    pub depth_map: DepthMap,
    /// Confidence head, optional.
    pub conf: Head,
    /// Gaussian head, optional: without it priors make the splats.
    pub gs: Head,
    /// From its channels to Gaussian parameters.
    pub gs_map: GsMap,

    /// Width of the sinusoidal time embedding; 0 without causal module and `aa_time`.
    pub time_dim: u32,
    /// Base of its frequencies.
    pub time_base: f64,
    /// Seconds per unit of its phase.
    pub time_unit: f64,

    /// Causal layers; 0 without motion.
    pub causal_depth: u32,
    /// Their heads.
    pub causal_heads: u32,
    /// Features they read.
    pub causal_in: Concat,
    /// Whether register tokens take part.
    pub causal_registers: bool,
    /// Whether both passes use the same weights.
    pub causal_share: bool,
    /// Reading of the mask.
    pub mask_orientation: Orientation,
    /// Whether a frame sees itself.
    pub mask_self: bool,
    /// Frames seen ahead (or behind).
    pub mask_k: u32,

    /// Motion head, optional.
    pub motion: Head,
    /// Its channels.
    pub motion_layout: MotionLayout,
    /// Axes of its velocity.
    pub motion_frame: MotionFrame,
    /// Time unit of its velocity.
    pub motion_per: MotionPer,
    /// Sign of the backward pass's velocity: -1 when both passes predict the same velocity.
    pub motion_back_sign: i32,
    /// Factor on the raw velocity channels.
    pub motion_scale: f64,
    /// Offset on the raw dynamic logit.
    pub motion_bias: f64,
    /// How the two probabilities combine.
    pub motion_combine: Combine,
    /// Dynamic iff probability > tau.
    pub motion_tau: f64,

    /// World gauge.
    pub world_anchor: Anchor,
    /// Scene units per network unit.
    pub world_scale: f64,

    /// Source frames used either side of a rendered time.
    pub render_window: u32,
    /// Own-frame rule at an input time.
    pub render_self: SelfRule,
    /// Rule beyond the ends of the clip.
    pub render_extrapolate: Extrapolate,
    /// Static/dynamic separation.
    pub render_split: Split,
    /// Side of the voxels in which static Gaussians are merged, scene units; 0 is off.
    pub static_voxel: f64,
    /// Sky treatment.
    pub sky: Sky,

    /// Rasterizer: antialiased opacity compensation.
    pub splat_aa: bool,
    /// Rasterizer: largest alpha of one splat at a pixel.
    pub splat_a_max: f64,
    /// Rasterizer: added to the diagonal of the 2-D covariance, pixels squared.
    pub splat_eps2d: f64,
    /// Rasterizer: nearest z drawn.
    pub splat_near: f64,
}

/// Walks every field once; the one list that reading and writing share.
trait Visitor {
    fn field<T: Setting>(&mut self, key: &str, slot: &mut T) -> Result<()>;
}

impl Trunk {
    fn visit(&mut self, p: &str, v: &mut impl Visitor) -> Result<()> {
        v.field(&format!("{p}.dim"), &mut self.dim)?;
        v.field(&format!("{p}.depth"), &mut self.depth)?;
        v.field(&format!("{p}.heads"), &mut self.heads)?;
        v.field(&format!("{p}.registers"), &mut self.registers)?;
        v.field(&format!("{p}.mlp_ratio"), &mut self.mlp_ratio)?;
        v.field(&format!("{p}.eps"), &mut self.eps)
    }
}

impl Head {
    fn visit(&mut self, p: &str, v: &mut impl Visitor) -> Result<()> {
        v.field(&format!("{p}.kind"), &mut self.kind)?;
        v.field(&format!("{p}.out"), &mut self.out)?;
        v.field(&format!("{p}.dim"), &mut self.dim)?;
        v.field(&format!("{p}.depth"), &mut self.depth)?;
        v.field(&format!("{p}.heads"), &mut self.heads)?;
        v.field(&format!("{p}.taps"), &mut self.taps)?;
        v.field(&format!("{p}.channels"), &mut self.channels)?;
        v.field(&format!("{p}.features"), &mut self.features)?;
        v.field(&format!("{p}.hidden"), &mut self.hidden)?;
        v.field(&format!("{p}.rcu_skip"), &mut self.rcu_skip)?;
        v.field(&format!("{p}.eps"), &mut self.eps)?;
        v.field(&format!("{p}.image_merger"), &mut self.image_merger)
    }

    /// No head.
    pub fn none() -> Head {
        Head {
            kind: HeadKind::None,
            out: 0,
            dim: 0,
            depth: 0,
            heads: 0,
            taps: Vec::new(),
            channels: Vec::new(),
            features: 0,
            hidden: 0,
            rcu_skip: RcuSkip::Relu,
            eps: 1e-5,
            image_merger: ImageMerger::None,
        }
    }

    /// Pi3's kind: decoder of `depth` blocks, one linear layer, pixel shuffle.
    pub fn xdec_linear(out: u32, dim: u32, depth: u32, heads: u32) -> Head {
        Head { kind: HeadKind::XdecLinear, out, dim, depth, heads, eps: 1e-6, ..Head::none() }
    }

    /// VGGT's kind: a pyramid over four taps.
    pub fn dpt(out: u32, taps: [u32; 4], channels: [u32; 4], features: u32) -> Head {
        Head {
            kind: HeadKind::Dpt,
            out,
            taps: taps.to_vec(),
            channels: channels.to_vec(),
            features,
            hidden: 32,
            ..Head::none()
        }
    }

    /// Whether the head exists.
    pub fn exists(&self) -> bool {
        self.kind != HeadKind::None
    }
}

impl ModelConfig {
    fn visit(&mut self, v: &mut impl Visitor) -> Result<()> {
        v.field("patch", &mut self.patch)?;
        v.field("image.mean", &mut self.image_mean)?;
        v.field("image.std", &mut self.image_std)?;
        v.field("image.resample", &mut self.image_resample)?;
        self.encoder.visit("encoder", v)?;
        v.field("encoder.pos_grid", &mut self.pos_grid)?;
        self.aa.visit("aa", v)?;
        v.field("aa.qk_eps", &mut self.qk_eps)?;
        v.field("aa.order", &mut self.aa_order)?;
        v.field("aa.time", &mut self.aa_time)?;
        v.field("rope.base", &mut self.rope_base)?;
        v.field("rope.angle_round", &mut self.rope_round)?;
        v.field("head.concat", &mut self.head_concat)?;
        v.field("camera.dim", &mut self.camera_dim)?;
        v.field("camera.depth", &mut self.camera_depth)?;
        v.field("camera.heads", &mut self.camera_heads)?;
        v.field("camera.width", &mut self.camera_width)?;
        v.field("camera.k", &mut self.camera_k)?;
        v.field("camera.pixel", &mut self.camera_pixel)?;
        self.depth.visit("depth", v)?;
        v.field("depth.out_map", &mut self.depth_map)?;
        self.conf.visit("conf", v)?;
        self.gs.visit("gs", v)?;
        v.field("gs.out_map", &mut self.gs_map)?;
        v.field("time.d_t", &mut self.time_dim)?;
        v.field("time.base", &mut self.time_base)?;
        v.field("time.unit", &mut self.time_unit)?;
        v.field("causal.depth", &mut self.causal_depth)?;
        v.field("causal.heads", &mut self.causal_heads)?;
        v.field("causal.in", &mut self.causal_in)?;
        v.field("causal.registers", &mut self.causal_registers)?;
        v.field("causal.share", &mut self.causal_share)?;
        v.field("mask.orientation", &mut self.mask_orientation)?;
        v.field("mask.self", &mut self.mask_self)?;
        v.field("mask.k", &mut self.mask_k)?;
        self.motion.visit("motion", v)?;
        v.field("motion.layout", &mut self.motion_layout)?;
        v.field("motion.frame", &mut self.motion_frame)?;
        v.field("motion.per", &mut self.motion_per)?;
        v.field("motion.back_sign", &mut self.motion_back_sign)?;
        v.field("motion.scale", &mut self.motion_scale)?;
        v.field("motion.bias", &mut self.motion_bias)?;
        v.field("motion.combine", &mut self.motion_combine)?;
        v.field("motion.tau", &mut self.motion_tau)?;
        v.field("world.anchor", &mut self.world_anchor)?;
        v.field("world.scale", &mut self.world_scale)?;
        v.field("render.window", &mut self.render_window)?;
        v.field("render.self", &mut self.render_self)?;
        v.field("render.extrapolate", &mut self.render_extrapolate)?;
        v.field("render.split", &mut self.render_split)?;
        v.field("static.voxel", &mut self.static_voxel)?;
        v.field("sky.mode", &mut self.sky)?;
        v.field("splat.aa", &mut self.splat_aa)?;
        v.field("splat.a_max", &mut self.splat_a_max)?;
        v.field("splat.eps2d", &mut self.splat_eps2d)?;
        v.field("splat.near", &mut self.splat_near)
    }

    /// Every field as `(key, value)`, in a fixed order.
    pub fn to_pairs(&self) -> Vec<(String, Value)> {
        struct Collect(Vec<(String, Value)>);
        impl Visitor for Collect {
            fn field<T: Setting>(&mut self, key: &str, slot: &mut T) -> Result<()> {
                self.0.push((key.to_string(), slot.to_value()));
                Ok(())
            }
        }
        let mut collect = Collect(Vec::new());
        self.clone().visit(&mut collect).expect("collecting cannot fail");
        collect.0
    }

    /// Reads fields from key-value pairs on top of `base`; unknown keys and wrong types are errors.
    ///
    /// With `complete`, every key must be there (the blob); without, missing keys keep `base`'s value.
    pub fn from_pairs(base: ModelConfig, pairs: &BTreeMap<String, Value>, complete: bool, at: &str) -> Result<Self> {
        struct Read<'a> {
            pairs: &'a BTreeMap<String, Value>,
            complete: bool,
            at: &'a str,
            seen: usize,
        }
        impl Visitor for Read<'_> {
            fn field<T: Setting>(&mut self, key: &str, slot: &mut T) -> Result<()> {
                match self.pairs.get(key) {
                    Some(v) => {
                        self.seen += 1;
                        *slot = T::from_value(v).ok_or_else(|| {
                            Error::model(self.at, format!("configuration {key} = {v:?} is not valid"))
                        })?;
                        Ok(())
                    }
                    None if self.complete => Err(Error::model(self.at, format!("configuration {key} is missing"))),
                    None => Ok(()),
                }
            }
        }
        let mut config = base;
        let mut read = Read { pairs, complete, at, seen: 0 };
        config.visit(&mut read)?;
        if read.seen != pairs.len() {
            let known: Vec<String> = config.to_pairs().into_iter().map(|p| p.0).collect();
            let unknown = pairs.keys().find(|k| !known.contains(k)).map_or("?", |k| k.as_str());
            return Err(Error::model(
                at,
                format!("configuration key {} is unknown", crate::error::escape(unknown.as_bytes())),
            ));
        }
        Ok(config)
    }

    /// As a flat JSON object.
    pub fn to_json(&self) -> serde_json::Value {
        let map = self
            .to_pairs()
            .into_iter()
            .map(|(k, v)| {
                let v = match v {
                    Value::Int(i) => i.into(),
                    Value::Float(f) => f.into(),
                    Value::Bool(b) => b.into(),
                    Value::Text(t) => t.into(),
                    Value::Ints(l) => l.into(),
                    Value::Floats(l) => l.into(),
                };
                (k, v)
            })
            .collect::<serde_json::Map<_, _>>();
        serde_json::Value::Object(map)
    }

    /// From a flat JSON object; missing keys keep the defaults of [`ModelConfig::base`].
    pub fn from_json(text: &str, at: &str) -> Result<Self> {
        let json: serde_json::Value =
            serde_json::from_str(text).map_err(|e| Error::model(at, format!("configuration is not JSON: {e}")))?;
        let map = json.as_object().ok_or_else(|| Error::model(at, "configuration is not a JSON object"))?;
        let mut pairs = BTreeMap::new();
        for (k, v) in map {
            let value = match v {
                serde_json::Value::Bool(b) => Value::Bool(*b),
                serde_json::Value::String(t) => Value::Text(t.clone()),
                serde_json::Value::Number(n) => match n.as_i64() {
                    Some(i) => Value::Int(i),
                    None => Value::Float(n.as_f64().unwrap_or(f64::NAN)),
                },
                serde_json::Value::Array(l) => {
                    if let Some(ints) = l.iter().map(|x| x.as_i64()).collect::<Option<Vec<_>>>() {
                        Value::Ints(ints)
                    } else if let Some(floats) = l.iter().map(|x| x.as_f64()).collect::<Option<Vec<_>>>() {
                        Value::Floats(floats)
                    } else {
                        return Err(Error::model(at, format!("configuration {k} is not a list of numbers")));
                    }
                }
                _ => return Err(Error::model(at, format!("configuration {k} has no usable value"))),
            };
            pairs.insert(k.clone(), value);
        }
        let config = Self::from_pairs(Self::base(), &pairs, false, at)?;
        config.check(at)?;
        Ok(config)
    }

    /// The faithful size: ViT-L encoder, 36 alternating layers (Pi3 large), 1.09 B parameters.
    pub fn full() -> ModelConfig {
        ModelConfig {
            patch: 14,
            image_mean: [0.485, 0.456, 0.406],
            image_std: [0.229, 0.224, 0.225],
            image_resample: Resample::Bicubic,
            encoder: Trunk { dim: 1024, depth: 24, heads: 16, registers: 4, mlp_ratio: 4, eps: 1e-6 },
            pos_grid: 37,
            aa: Trunk { dim: 1024, depth: 36, heads: 16, registers: 5, mlp_ratio: 4, eps: 1e-6 },
            qk_eps: 1e-5,
            aa_order: Order::FrameFirst,
            aa_time: false,
            rope_base: 100.0,
            rope_round: AngleRound::None,
            head_concat: Concat::FrameGlobal,
            camera_dim: 1024,
            camera_depth: 5,
            camera_heads: 16,
            camera_width: 512,
            camera_k: KSource::FitShared,
            camera_pixel: PixelCentre::Half,
            depth: Head::xdec_linear(3, 1024, 5, 16),
            depth_map: DepthMap::Pi3Point,
            conf: Head::xdec_linear(1, 1024, 5, 16),
            gs: Head::dpt(11, [3, 8, 12, 17], [256, 512, 1024, 1024], 256),
            gs_map: GsMap::Residual,
            time_dim: 128,
            time_base: 10_000.0,
            time_unit: 0.1,
            causal_depth: 4,
            causal_heads: 16,
            causal_in: Concat::Last,
            causal_registers: false,
            causal_share: true,
            mask_orientation: Orientation::Equation,
            mask_self: true,
            mask_k: 1,
            motion: Head::dpt(4, [0, 1, 2, 3], [256, 512, 1024, 1024], 256),
            motion_layout: MotionLayout::PerDirection,
            motion_frame: MotionFrame::Camera,
            motion_per: MotionPer::Second,
            motion_back_sign: 1,
            motion_scale: 1.0,
            motion_bias: 0.0,
            motion_combine: Combine::Mean,
            motion_tau: 0.5,
            world_anchor: Anchor::First,
            world_scale: 1.0,
            render_window: 1,
            render_self: SelfRule::Own,
            render_extrapolate: Extrapolate::Mirror,
            render_split: Split::Hard,
            static_voxel: 0.0,
            sky: Sky::None,
            splat_aa: false,
            splat_a_max: 0.999,
            splat_eps2d: 0.3,
            splat_near: 0.01,
        }
    }

    /// ViT-S encoder, 24 alternating layers, about 110 M parameters.
    pub fn base() -> ModelConfig {
        ModelConfig {
            encoder: Trunk { dim: 384, depth: 12, heads: 6, ..Self::full().encoder },
            aa: Trunk { dim: 384, depth: 24, heads: 6, ..Self::full().aa },
            camera_dim: 384,
            camera_depth: 4,
            camera_heads: 6,
            camera_width: 256,
            depth: Head::xdec_linear(3, 384, 4, 6),
            conf: Head::xdec_linear(1, 384, 4, 6),
            gs: Head::dpt(11, [2, 5, 8, 11], [48, 96, 192, 384], 64),
            time_dim: 64,
            causal_heads: 7,
            motion: Head::dpt(4, [0, 1, 2, 3], [48, 96, 192, 384], 64),
            ..Self::full()
        }
    }

    /// 12 M parameters, for demonstrations, tests and small machines.
    pub fn nano() -> ModelConfig {
        ModelConfig {
            encoder: Trunk { dim: 192, depth: 6, heads: 3, ..Self::full().encoder },
            pos_grid: 16,
            aa: Trunk { dim: 192, depth: 8, heads: 3, ..Self::full().aa },
            camera_dim: 192,
            camera_depth: 1,
            camera_heads: 3,
            camera_width: 128,
            depth: Head::xdec_linear(3, 192, 1, 3),
            conf: Head::none(),
            gs: Head::dpt(11, [0, 1, 2, 3], [32, 64, 96, 192], 48),
            time_dim: 32,
            causal_heads: 4,
            motion: Head::dpt(4, [0, 1, 2, 3], [32, 64, 96, 192], 48),
            ..Self::full()
        }
    }

    /// Public Pi3: `full` without Gaussian head, causal module and motion.
    pub fn pi3() -> ModelConfig {
        ModelConfig {
            image_resample: Resample::Lanczos,
            gs: Head::none(),
            time_dim: 0,
            causal_depth: 0,
            causal_heads: 0,
            motion: Head::none(),
            ..Self::full()
        }
    }

    /// The preset of a name: `nano`, `base`, `full` or `pi3`.
    pub fn preset(name: &str) -> Option<ModelConfig> {
        match name {
            "nano" => Some(Self::nano()),
            "base" => Some(Self::base()),
            "full" => Some(Self::full()),
            "pi3" => Some(Self::pi3()),
            _ => None,
        }
    }

    /// The same network with every dense head of the `xdec_linear` kind.
    pub fn with_linear_heads(mut self) -> ModelConfig {
        for head in [&mut self.gs, &mut self.motion] {
            if head.exists() {
                *head = Head::xdec_linear(head.out, self.depth.dim, self.depth.depth, self.depth.heads);
            }
        }
        self
    }

    /// Channels of the features the camera and dense heads read.
    pub fn head_in(&self) -> u32 {
        match self.head_concat {
            Concat::FrameGlobal => 2 * self.aa.dim,
            Concat::Last => self.aa.dim,
        }
    }

    /// Channels D' inside the causal module.
    pub fn causal_dim(&self) -> u32 {
        self.time_dim
            + match self.causal_in {
                Concat::FrameGlobal => 2 * self.aa.dim,
                Concat::Last => self.aa.dim,
            }
    }

    /// Whether the network predicts motion.
    pub fn has_motion(&self) -> bool {
        self.causal_depth > 0 && self.motion.exists()
    }

    /// Consistency and caps: nothing later divides by zero, overflows or allocates absurdly.
    pub fn check(&self, at: &str) -> Result<()> {
        let bad = |why: String| Err(Error::model(at, why));
        let range = |key: &str, v: u32, lo: u32, hi: u32| {
            if v < lo || v > hi { Err(Error::model(at, format!("{key} = {v} must be {lo}..{hi}"))) } else { Ok(()) }
        };
        range("patch", self.patch, 1, 64)?;
        range("encoder.pos_grid", self.pos_grid, 1, 256)?;
        for (p, t) in [("encoder", &self.encoder), ("aa", &self.aa)] {
            range(&format!("{p}.dim"), t.dim, 4, 8192)?;
            range(&format!("{p}.depth"), t.depth, 1, 256)?;
            range(&format!("{p}.registers"), t.registers, 0, 64)?;
            range(&format!("{p}.mlp_ratio"), t.mlp_ratio, 1, 16)?;
            self.heads(at, p, t.dim, t.heads)?;
        }
        if self.encoder.dim != self.aa.dim {
            return bad(format!(
                "encoder.dim = {} and aa.dim = {} must be equal: there is no projection between them",
                self.encoder.dim, self.aa.dim
            ));
        }
        if self.aa.depth % 2 != 0 {
            return bad(format!("aa.depth = {} must be even (frame and global layers alternate)", self.aa.depth));
        }
        range("camera.dim", self.camera_dim, 4, 8192)?;
        range("camera.depth", self.camera_depth, 0, 64)?;
        range("camera.width", self.camera_width, 4, 8192)?;
        self.heads(at, "camera", self.camera_dim, self.camera_heads)?;
        for (p, h) in [("depth", &self.depth), ("conf", &self.conf), ("gs", &self.gs), ("motion", &self.motion)] {
            match h.kind {
                HeadKind::None => {}
                HeadKind::XdecLinear => {
                    range(&format!("{p}.out"), h.out, 1, 64)?;
                    range(&format!("{p}.dim"), h.dim, 4, 8192)?;
                    range(&format!("{p}.depth"), h.depth, 0, 64)?;
                    self.heads(at, p, h.dim, h.heads)?;
                }
                HeadKind::Dpt => {
                    range(&format!("{p}.out"), h.out, 1, 64)?;
                    range(&format!("{p}.features"), h.features, 8, 1024)?;
                    range(&format!("{p}.hidden"), h.hidden, 1, 1024)?;
                    if h.features % 8 != 0 || h.channels.iter().any(|c| c % 4 != 0) {
                        return bad(format!("{p}: DPT widths must be multiples of 4 (features of 8)"));
                    }
                    if h.channels.len() != 4 || h.taps.len() != 4 {
                        return bad(format!("{p}: a DPT head needs four taps and four channel counts"));
                    }
                    for &c in &h.channels {
                        range(&format!("{p}.channels"), c, 4, 4096)?;
                    }
                    let layers = if p == "motion" { self.causal_depth } else { self.aa.depth / 2 };
                    if h.taps.iter().any(|&t| t >= layers) {
                        return bad(format!("{p}.taps = {:?} must all be below {layers}", h.taps));
                    }
                }
                HeadKind::XdecConv => {
                    return Err(Error::unsupported(
                        at,
                        format!("{p}.kind = xdec_conv (Pi3X) is known but not executed; supported: xdec_linear, dpt"),
                    ));
                }
            }
        }
        if !self.depth.exists() {
            return bad("depth.kind = none: a network without depth has no scene".into());
        }
        let want = match self.depth_map {
            DepthMap::Pi3Point => 3,
            DepthMap::ExpZ => 1,
        };
        if self.depth.out != want {
            return bad(format!("depth.out = {} must be {want} for this depth.out_map", self.depth.out));
        }
        if self.depth_map == DepthMap::ExpZ && self.camera_k != KSource::Fov {
            return bad("depth.out_map = exp_z has no rays to fit K from: camera.k must be fov".into());
        }
        if self.conf.exists() && self.conf.out != 1 {
            return bad(format!("conf.out = {} must be 1", self.conf.out));
        }
        if self.gs.exists() && self.gs.out != 11 {
            return bad(format!("gs.out = {} must be 11 (colour 3, opacity 1, scale 3, quaternion 4)", self.gs.out));
        }
        range("time.d_t", self.time_dim, 0, 1024)?;
        if self.time_dim % 2 != 0 {
            return bad(format!("time.d_t = {} must be even", self.time_dim));
        }
        if self.aa_time && self.time_dim == 0 {
            return bad("aa.time needs time.d_t".into());
        }
        range("causal.depth", self.causal_depth, 0, 64)?;
        if (self.causal_depth > 0) != self.motion.exists() {
            return bad("causal module and motion head must both be there or both be absent".into());
        }
        if self.causal_depth > 0 {
            self.heads(at, "causal", self.causal_dim(), self.causal_heads)?;
            range("mask.k", self.mask_k, 1, 1024)?;
            let want = match self.motion_layout {
                MotionLayout::PerDirection => 4,
                MotionLayout::SinglePass => 7,
            };
            if self.motion.out != want {
                return bad(format!("motion.out = {} must be {want} for this motion.layout", self.motion.out));
            }
            if self.motion_back_sign.abs() != 1 {
                return bad(format!("motion.back_sign = {} must be 1 or -1", self.motion_back_sign));
            }
        }
        for (key, v, lo, hi) in [
            ("encoder.eps", self.encoder.eps, 1e-12, 1.0),
            ("aa.eps", self.aa.eps, 1e-12, 1.0),
            ("aa.qk_eps", self.qk_eps, 1e-12, 1.0),
            ("depth.eps", self.depth.eps, 1e-12, 1.0),
            ("conf.eps", self.conf.eps, 1e-12, 1.0),
            ("gs.eps", self.gs.eps, 1e-12, 1.0),
            ("motion.eps", self.motion.eps, 1e-12, 1.0),
            ("rope.base", self.rope_base, 1.0, 1e9),
            ("time.base", self.time_base, 1.0, 1e9),
            ("time.unit", self.time_unit, 1e-6, 1e6),
            ("motion.scale", self.motion_scale, 1e-6, 1e6),
            ("motion.bias", self.motion_bias, -1e3, 1e3),
            ("motion.tau", self.motion_tau, 0.0, 1.0),
            ("world.scale", self.world_scale, 1e-9, 1e9),
            ("static.voxel", self.static_voxel, 0.0, 1e6),
            ("splat.a_max", self.splat_a_max, 0.1, 0.9999),
            ("splat.eps2d", self.splat_eps2d, 0.0, 16.0),
            ("splat.near", self.splat_near, 1e-6, 1e3),
        ] {
            if !(v >= lo && v <= hi) {
                return bad(format!("{key} = {v} must be between {lo} and {hi}"));
            }
        }
        if self.image_std.iter().any(|&s| !(s > 1e-6 && s < 1e3)) || self.image_mean.iter().any(|m| !(m.abs() < 1e3)) {
            return bad("image.mean or image.std is out of range".into());
        }
        Ok(())
    }

    fn heads(&self, at: &str, key: &str, dim: u32, heads: u32) -> Result<()> {
        if heads == 0 || dim % heads != 0 {
            return Err(Error::model(at, format!("{key}: width {dim} does not divide into {heads} heads")));
        }
        let d = dim / heads;
        if d % 4 != 0 || d > 256 {
            return Err(Error::model(
                at,
                format!("{key}: head width {d} must be a multiple of 4 (rotary halves) and at most 256"),
            ));
        }
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn presets_are_consistent_and_survive_json() {
        for name in ["nano", "base", "full", "pi3"] {
            let config = ModelConfig::preset(name).unwrap();
            config.check(name).unwrap();
            let back = ModelConfig::from_json(&config.to_json().to_string(), name).unwrap();
            assert_eq!(config, back);
        }
    }

    #[test]
    fn unknown_and_wrong_settings_are_named() {
        let e = ModelConfig::from_json(r#"{"encoder.dmi": 3}"#, "f").unwrap_err();
        assert!(e.to_string().contains("encoder.dmi is unknown"), "{e}");
        let e = ModelConfig::from_json(r#"{"mask.self": 3}"#, "f").unwrap_err();
        assert!(e.to_string().contains("mask.self"), "{e}");
        let e = ModelConfig::from_json(r#"{"aa.heads": 5}"#, "f").unwrap_err();
        assert!(e.to_string().contains("does not divide"), "{e}");
        let e = ModelConfig::from_json(r#"{"patch": 0}"#, "f").unwrap_err();
        assert_eq!(e.status() as i32, 4);
        let e = ModelConfig::from_json(r#"{"depth.kind": "xdec_conv"}"#, "f").unwrap_err();
        assert_eq!(e.status() as i32, 7);
    }

    #[test]
    fn every_field_is_required_in_a_blob() {
        let mut pairs: BTreeMap<String, Value> = ModelConfig::nano().to_pairs().into_iter().collect();
        assert_eq!(ModelConfig::from_pairs(ModelConfig::base(), &pairs, true, "b").unwrap(), ModelConfig::nano());
        pairs.remove("mask.k");
        let e = ModelConfig::from_pairs(ModelConfig::base(), &pairs, true, "b").unwrap_err();
        assert!(e.to_string().contains("mask.k is missing"));
    }
}
