//! The configurations that have names.

use crate::config::{Head, ModelConfig, Trunk};
use crate::setting::*;

impl ModelConfig {
    /// The faithful size: ViT-L encoder, 36 alternating layers (Pi3 large), 1.09 B parameters.
    pub fn full() -> ModelConfig {
        ModelConfig {
            patch: 14,
            image_mean: [0.485, 0.456, 0.406],
            image_std: [0.229, 0.224, 0.225],
            image_resample: Resample::Bicubic,
            image_size: None,
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
            guide_channels: 0,
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
            sky_conf: 0.1,
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

    /// 4.4 M parameters, for demonstrations, tests and small machines: the network that is trained on synthetic
    /// streets. All heads are guided; depth comes with a sky confidence, intrinsics from the camera head, and
    /// both motion passes predict the same metric velocity. Splats of 0.4 source pixels need a low-pass filter
    /// narrower than gsplat's: true geometry renders 1 dB better with 0.1 square pixels than with 0.3.
    pub fn nano() -> ModelConfig {
        let head = |out| Head::guided(out, (128, 1, 2), 24, 32);
        ModelConfig {
            image_size: Some([168, 112]),
            encoder: Trunk { dim: 128, depth: 4, heads: 2, ..Self::full().encoder },
            pos_grid: 16,
            aa: Trunk { dim: 128, depth: 6, heads: 2, ..Self::full().aa },
            aa_time: true,
            camera_dim: 128,
            camera_depth: 1,
            camera_heads: 2,
            camera_width: 128,
            camera_k: KSource::Fov,
            guide_channels: 16,
            depth: head(2),
            depth_map: DepthMap::ExpZConf,
            conf: Head::none(),
            gs: head(11),
            time_dim: 32,
            causal_depth: 2,
            causal_heads: 4,
            motion: head(4),
            motion_back_sign: -1,
            motion_scale: 5.0,
            motion_bias: -2.0,
            sky: Sky::FarShell,
            sky_conf: 0.5,
            splat_eps2d: 0.1,
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

    /// The same network with every dense head of the `xdec_linear` kind, of the depth head's sizes.
    pub fn with_linear_heads(mut self) -> ModelConfig {
        let (dim, depth, heads) = (self.depth.dim, self.depth.depth, self.depth.heads);
        for head in [&mut self.depth, &mut self.conf, &mut self.gs, &mut self.motion] {
            if head.exists() && head.kind != HeadKind::XdecLinear {
                *head = Head::xdec_linear(head.out, dim, depth, heads);
            }
        }
        self.guide_channels = 0;
        self
    }
}
