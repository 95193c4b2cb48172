//! Consistency and caps of a configuration, so that nothing later divides by zero or overflows.

use crate::config::ModelConfig;
use crate::error::{Error, Result};
use crate::setting::{DepthMap, HeadKind, KSource, MotionLayout};

impl ModelConfig {
    /// Consistency and caps: nothing later divides by zero, overflows or allocates absurdly.
    pub fn check(&self, at: &str) -> Result<()> {
        let bad = |why: String| Err(Error::model(at, why));
        let range = |key: &str, v: u32, lo: u32, hi: u32| {
            if v < lo || v > hi { Err(Error::model(at, format!("{key} = {v} must be {lo}..{hi}"))) } else { Ok(()) }
        };
        range("patch", self.patch, 1, 64)?;
        if let Some([w, h]) = self.image_size
            && [w, h].iter().any(|&side| side == 0 || side > 1 << 14 || !side.is_multiple_of(self.patch))
        {
            return bad(format!("image.size = [{w}, {h}] must be two multiples of the patch, at most 16384"));
        }
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
        if !self.aa.depth.is_multiple_of(2) {
            return bad(format!("aa.depth = {} must be even (frame and global layers alternate)", self.aa.depth));
        }
        range("camera.dim", self.camera_dim, 4, 8192)?;
        range("camera.depth", self.camera_depth, 0, 64)?;
        range("camera.width", self.camera_width, 4, 8192)?;
        self.heads(at, "camera", self.camera_dim, self.camera_heads)?;
        for (p, h) in self.dense_heads() {
            match h.kind {
                HeadKind::None => {}
                HeadKind::XdecLinear | HeadKind::Guided => {
                    range(&format!("{p}.out"), h.out, 1, 64)?;
                    range(&format!("{p}.dim"), h.dim, 4, 8192)?;
                    range(&format!("{p}.depth"), h.depth, 0, 64)?;
                    self.heads(at, p, h.dim, h.heads)?;
                    if h.kind == HeadKind::Guided {
                        range(&format!("{p}.hidden"), h.hidden, 1, 1024)?;
                        range(&format!("{p}.features"), h.features, 1, 1024)?;
                    }
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
                        format!(
                            "{p}.kind = xdec_conv (Pi3X) is known but not executed; supported: xdec_linear, dpt, guided"
                        ),
                    ));
                }
            }
        }
        if self.dense_heads().iter().any(|(_, h)| h.kind == HeadKind::Guided) {
            range("guide.channels", self.guide_channels, 1, 256)?;
            if !self.patch.is_multiple_of(2) {
                return bad(format!("patch = {} must be even: guided heads work at half resolution", self.patch));
            }
        } else if self.guide_channels != 0 {
            return bad(format!("guide.channels = {} must be 0: no head is guided", self.guide_channels));
        }
        if !self.depth.exists() {
            return bad("depth.kind = none: a network without depth has no scene".into());
        }
        let want = match self.depth_map {
            DepthMap::Pi3Point => 3,
            DepthMap::ExpZ => 1,
            DepthMap::ExpZConf => 2,
        };
        if self.depth.out != want {
            return bad(format!("depth.out = {} must be {want} for this depth.out_map", self.depth.out));
        }
        if self.depth_map != DepthMap::Pi3Point && self.camera_k != KSource::Fov {
            return bad("depth.out_map = exp_z or exp_z_conf has no rays to fit K from: camera.k must be fov".into());
        }
        if self.depth_map == DepthMap::ExpZConf && self.conf.exists() {
            return bad("depth.out_map = exp_z_conf predicts the confidence: conf.kind must be none".into());
        }
        if self.conf.exists() && self.conf.out != 1 {
            return bad(format!("conf.out = {} must be 1", self.conf.out));
        }
        if self.gs.exists() && self.gs.out != 11 {
            return bad(format!("gs.out = {} must be 11 (colour 3, opacity 1, scale 3, quaternion 4)", self.gs.out));
        }
        range("time.d_t", self.time_dim, 0, 1024)?;
        if !self.time_dim.is_multiple_of(2) {
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
            range("mask.k", self.mask_k, 0, 1024)?;
            if self.mask_k == 0 && !self.mask_self {
                return bad("mask.k = 0 leaves nothing to see: mask.self must be true".into());
            }
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
            ("sky.conf", self.sky_conf, 0.0, 1.0),
            ("splat.a_max", self.splat_a_max, 0.1, 0.9999),
            ("splat.eps2d", self.splat_eps2d, 0.0, 16.0),
            ("splat.near", self.splat_near, 1e-6, 1e3),
        ] {
            if !(v >= lo && v <= hi) {
                return bad(format!("{key} = {v} must be between {lo} and {hi}"));
            }
        }
        if self.image_std.iter().any(|s| !(1e-6..1e3).contains(s))
            || self.image_mean.iter().any(|m| m.is_nan() || m.abs() >= 1e3)
        {
            return bad("image.mean or image.std is out of range".into());
        }
        Ok(())
    }

    fn heads(&self, at: &str, key: &str, dim: u32, heads: u32) -> Result<()> {
        if heads == 0 || !dim.is_multiple_of(heads) {
            return Err(Error::model(at, format!("{key}: width {dim} does not divide into {heads} heads")));
        }
        let d = dim / heads;
        if !d.is_multiple_of(4) || d > 256 {
            return Err(Error::model(
                at,
                format!("{key}: head width {d} must be a multiple of 4 (rotary halves) and at most 256"),
            ));
        }
        Ok(())
    }
}
