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

pub use crate::setting::*;

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
    /// `xdec_linear`, `guided`: decoder width.
    pub dim: u32,
    /// `xdec_linear`, `guided`: decoder blocks.
    pub depth: u32,
    /// `xdec_linear`, `guided`: attention heads.
    pub heads: u32,
    /// `dpt`: the four layers read, 0-based alternating-attention pairs (or causal layers).
    pub taps: Vec<u32>,
    /// `dpt`: channels of the four tap projections.
    pub channels: Vec<u32>,
    /// `dpt`: width of the fusion pyramid; `guided`: width of the convolutions.
    pub features: u32,
    /// `dpt`: channels before the last 1x1 convolution; `guided`: channels per half-resolution pixel of the
    /// linear layer.
    pub hidden: u32,
    /// `dpt`: skip path of the residual units.
    pub rcu_skip: RcuSkip,
    /// Epsilon of the norms: `dpt` of the token norm, others of the decoder's blocks.
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
    /// Width and height the network was trained at; pictures are brought to about as many pixels.
    pub image_size: Option<[u32; 2]>,

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

    /// Channels of the image stem that all `guided` heads share; 0 without such heads.
    pub guide_channels: u32,

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
    /// Confidence (sigmoid) under which a pixel counts as sky: `sky.mode`, and the opacity without a Gaussian head.
    pub sky_conf: f64,

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

    /// A decoder, then convolutions guided by the image: `hidden` channels per half-resolution pixel, `features` wide.
    pub fn guided(out: u32, (dim, depth, heads): (u32, u32, u32), hidden: u32, features: u32) -> Head {
        Head { kind: HeadKind::Guided, out, dim, depth, heads, hidden, features, eps: 1e-6, ..Head::none() }
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
        v.field("image.size", &mut self.image_size)?;
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
        v.field("guide.channels", &mut self.guide_channels)?;
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
        v.field("sky.conf", &mut self.sky_conf)?;
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

    /// The depth, confidence, Gaussian and motion head with their key prefixes.
    pub fn dense_heads(&self) -> [(&'static str, &Head); 4] {
        [("depth", &self.depth), ("conf", &self.conf), ("gs", &self.gs), ("motion", &self.motion)]
    }

    /// Whether the network predicts confidences, by a head of their own or beside the depth.
    pub fn has_conf(&self) -> bool {
        self.conf.exists() || self.depth_map == DepthMap::ExpZConf
    }

    /// Whether the network predicts motion.
    pub fn has_motion(&self) -> bool {
        self.causal_depth > 0 && self.motion.exists()
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
    fn guided_heads_and_their_stem_go_together() {
        let refused = |why: &str, change: &dyn Fn(&mut ModelConfig)| {
            let mut config = ModelConfig::nano();
            change(&mut config);
            let e = config.check("f").unwrap_err().to_string();
            assert!(e.contains(why), "{e}");
        };
        refused("guide.channels = 0 must be 1..256", &|c| c.guide_channels = 0);
        refused("patch = 7 must be even", &|c| c.patch = 7);
        refused("gs.hidden = 0", &|c| c.gs.hidden = 0);
        refused("motion.features = 2000", &|c| c.motion.features = 2000);
        refused("depth.out = 1 must be 2", &|c| c.depth.out = 1);
        refused("camera.k must be fov", &|c| c.camera_k = KSource::FitShared);
        refused("conf.kind must be none", &|c| c.conf = Head::xdec_linear(1, 16, 1, 1));
        let e = ModelConfig { guide_channels: 8, ..ModelConfig::base() }.check("f").unwrap_err();
        assert!(e.to_string().contains("no head is guided"), "{e}");
        let e = ModelConfig { image_size: Some([168, 111]), ..ModelConfig::base() }.check("f").unwrap_err();
        assert!(e.to_string().contains("image.size = [168, 111]"), "{e}");
        let e = ModelConfig { sky_conf: 1.5, ..ModelConfig::base() }.check("f").unwrap_err();
        assert!(e.to_string().contains("sky.conf"), "{e}");
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
