//! From raw Gaussian-head channels to splat parameters (network specification, item 15).
//!
//! Channel order of a pixel: colour 3, opacity 1, scale 3, quaternion 4 (w, x, y, z). Two maps:
//!
//! | | `residual` | `dggt` |
//! |---|---|---|
//! | colour | image + d | sigmoid d |
//! | opacity | sigmoid(o + 2) | sigmoid o |
//! | scale | 0.7 (z / f) exp(clamp(d, -4, 4)), f = (fx + fy) / 2 | 0.1 softplus d |
//! | rotation | q_camera * normalise(q + (1, 0, 0, 0)) | normalise q, already world axes |
//!
//! Without a Gaussian head the residuals are zero, and where a confidence is under `sky.conf` the opacity is
//! zero. Every function maps one row of one frame, so rows can be shared out freely.

use crate::rotation;
use crate::unproject::View;
use sf_formats::config::{GsMap, ModelConfig};
use sf_ops::{activation, trig};

/// Channels of the Gaussian head.
pub(crate) const CHANNELS: usize = 11;

/// One row of the head's output, or the priors.
#[derive(Clone, Copy, Debug)]
pub(crate) enum Raw<'a> {
    /// `[w, 11]`.
    Head(&'a [f32]),
    /// No head: zero residuals; the confidence logits `[w]` where the network has them.
    Priors(Option<&'a [f32]>),
}

impl Raw<'_> {
    fn pixel(&self, u: usize) -> [f32; CHANNELS] {
        match self {
            Raw::Head(raw) => raw[u * CHANNELS..][..CHANNELS].try_into().expect("eleven channels"),
            Raw::Priors(_) => [0.0; CHANNELS],
        }
    }
}

/// The activation map of one frame.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Map {
    kind: GsMap,
    /// Scale prior per unit of depth: 0.7 / f.
    footprint: f32,
    /// Confidence under which a pixel is left out where there is no Gaussian head.
    conf_min: f32,
    /// Factor on scales that are not tied to the depth.
    world_scale: f32,
    /// Rotation of the frame's camera, w, x, y, z.
    camera: [f32; 4],
}

impl Map {
    /// For a frame seen through `view`; without a Gaussian head the residual map holds.
    pub(crate) fn new(config: &ModelConfig, view: &View) -> Map {
        Map {
            kind: if config.gs.exists() { config.gs_map } else { GsMap::Residual },
            footprint: (0.7 / ((view.k.fx + view.k.fy) / 2.0)) as f32,
            conf_min: config.sky_conf as f32,
            world_scale: config.world_scale as f32,
            camera: rotation::quaternion(&view.pose.r).map(|v| v as f32),
        }
    }

    /// Colours; `image` is the row's RGB bytes.
    pub(crate) fn colour_row(&self, raw: Raw, image: &[u8], out: &mut [[f32; 3]]) {
        for (u, colour) in out.iter_mut().enumerate() {
            let d = raw.pixel(u);
            *colour = match self.kind {
                GsMap::Residual => std::array::from_fn(|c| f32::from(image[3 * u + c]) / 255.0 + d[c]),
                GsMap::Dggt => std::array::from_fn(|c| activation::sigmoid(d[c])),
            };
        }
    }

    /// Opacities.
    pub(crate) fn opacity_row(&self, raw: Raw, out: &mut [f32]) {
        for (u, opacity) in out.iter_mut().enumerate() {
            let o = raw.pixel(u)[3];
            *opacity = match self.kind {
                GsMap::Residual => activation::sigmoid(o + 2.0),
                GsMap::Dggt => activation::sigmoid(o),
            };
            if let Raw::Priors(Some(conf)) = raw
                && activation::sigmoid(conf[u]) < self.conf_min
            {
                *opacity = 0.0;
            }
        }
    }

    /// Whether scales are an exponential and opacities a sigmoid of what [`Map::start_row`] writes: then whole maps
    /// go through the vector kernels, which have the bits of the scalar functions here.
    pub(crate) fn in_steps(&self) -> bool {
        self.kind == GsMap::Residual
    }

    /// The arguments of the exponential of a row.
    pub(crate) fn start_row(&self, raw: Raw, scale: &mut [[f32; 3]]) {
        for (u, scale) in scale.iter_mut().enumerate() {
            let d = raw.pixel(u);
            *scale = std::array::from_fn(|c| d[4 + c].clamp(-4.0, 4.0));
        }
    }

    /// The argument of the sigmoid of a row.
    pub(crate) fn start_opacity_row(&self, raw: Raw, opacity: &mut [f32]) {
        opacity.iter_mut().enumerate().for_each(|(u, o)| *o = raw.pixel(u)[3] + 2.0);
    }

    /// From the exponentials to scales; `depth` as in [`Map::scale_row`].
    pub(crate) fn finish_row(&self, depth: &[f32], scale: &mut [[f32; 3]]) {
        for (scale, &z) in scale.iter_mut().zip(depth) {
            let prior = self.footprint * z;
            *scale = scale.map(|e| prior * e);
        }
    }

    /// Hides what [`Map::opacity_row`] hides.
    pub(crate) fn finish_opacity_row(&self, raw: Raw, opacity: &mut [f32]) {
        if let Raw::Priors(Some(conf)) = raw {
            for (o, &c) in opacity.iter_mut().zip(conf) {
                if activation::sigmoid(c) < self.conf_min {
                    *o = 0.0;
                }
            }
        }
    }

    /// Scales; `depth` is the row's z-depth in scene units.
    pub(crate) fn scale_row(&self, raw: Raw, depth: &[f32], out: &mut [[f32; 3]]) {
        for (u, scale) in out.iter_mut().enumerate() {
            let d = raw.pixel(u);
            let prior = self.footprint * depth[u];
            *scale = std::array::from_fn(|c| match self.kind {
                GsMap::Residual => prior * activation::exp(d[4 + c].clamp(-4.0, 4.0)),
                GsMap::Dggt => 0.1 * softplus(d[4 + c]) * self.world_scale,
            });
        }
    }

    /// Rotations to world axes, normalised, w >= 0.
    pub(crate) fn quat_row(&self, raw: Raw, out: &mut [[f32; 4]]) {
        for (u, quat) in out.iter_mut().enumerate() {
            let d = raw.pixel(u);
            let mut q = [d[7], d[8], d[9], d[10]];
            if self.kind == GsMap::Residual {
                q[0] += 1.0;
            }
            let norm = (q[0] * q[0] + q[1] * q[1] + q[2] * q[2] + q[3] * q[3]).sqrt();
            q = if norm > 1e-12 { q.map(|v| v / norm) } else { [1.0, 0.0, 0.0, 0.0] };
            if self.kind == GsMap::Residual {
                let (a, b) = (self.camera.map(f64::from), q.map(f64::from));
                q = rotation::multiply(a, b).map(|v| v as f32);
            }
            *quat = if q[0] < 0.0 { q.map(|v| -v) } else { q };
        }
    }
}

/// ln(1 + e^x) without overflow.
fn softplus(x: f32) -> f32 {
    if x > 20.0 { x } else { trig::ln(1.0 + trig::exp(f64::from(x.max(-80.0)))) as f32 }
}

#[cfg(test)]
mod tests {
    use super::*;
    use glam::DMat3;
    use sf_formats::config::PixelCentre;
    use sf_formats::{Intrinsics, Pose};

    fn view() -> View {
        let pose = Pose { r: DMat3::from_rotation_y(0.6), t: glam::DVec3::ZERO };
        View { pose, k: Intrinsics { fx: 40.0, fy: 60.0, cx: 1.0, cy: 1.0 }, pixel: PixelCentre::Half }
    }

    #[test]
    fn zero_residuals_are_the_priors() {
        let map = Map::new(&ModelConfig::base(), &view());
        let raw = Raw::Head(&[0.0; CHANNELS]);
        let (mut colour, mut opacity) = ([[9.0; 3]], [9.0]);
        let (mut scale, mut quat) = ([[9.0; 3]], [[9.0; 4]]);
        map.colour_row(raw, &[0, 51, 255], &mut colour);
        map.opacity_row(raw, &mut opacity);
        map.scale_row(raw, &[5.0], &mut scale);
        map.quat_row(raw, &mut quat);
        assert_eq!(colour, [[0.0, 0.2, 1.0]]);
        assert!((opacity[0] - 0.880_797).abs() < 1e-6);
        assert!((scale[0][1] - 0.7 * 5.0 / 50.0).abs() < 1e-7);
        assert!((quat[0][0] - 0.3f32.cos()).abs() < 1e-6 && (quat[0][2] - 0.3f32.sin()).abs() < 1e-6);
    }

    /// The steps that whole maps go through give the bits of the row functions that define them.
    #[test]
    fn steps_have_the_bits_of_the_rows() {
        use sf_ops::elementwise::{exp_in_place, sigmoid_in_place};
        let map = Map::new(&ModelConfig::base(), &view());
        assert!(map.in_steps());
        let n = 37;
        let raw: Vec<f32> = (0..n * CHANNELS).map(|i| ((i * 71 % 203) as f32 - 101.0) / 17.0).collect();
        let depth: Vec<f32> = (0..n).map(|u| 0.5 + u as f32).collect();
        let conf: Vec<f32> = (0..n).map(|u| u as f32 / 4.0 - 5.0).collect();
        let pool = sf_ops::par::Pool::new(1).unwrap();
        for raw in [Raw::Head(&raw), Raw::Priors(None), Raw::Priors(Some(&conf))] {
            for kernels in sf_ops::Kernels::available() {
                let ctx = sf_ops::Ctx { pool: &pool, kernels };
                let (mut scale, mut opacity) = (vec![[9.0; 3]; n], vec![9.0; n]);
                map.start_row(raw, &mut scale);
                exp_in_place(ctx, scale.as_flattened_mut());
                map.finish_row(&depth, &mut scale);
                map.start_opacity_row(raw, &mut opacity);
                sigmoid_in_place(ctx, &mut opacity);
                map.finish_opacity_row(raw, &mut opacity);
                let (mut want_scale, mut want_opacity) = (vec![[9.0; 3]; n], vec![9.0; n]);
                map.scale_row(raw, &depth, &mut want_scale);
                map.opacity_row(raw, &mut want_opacity);
                assert_eq!((scale, opacity), (want_scale, want_opacity));
            }
        }
    }

    #[test]
    fn without_a_head_low_confidence_hides_a_pixel() {
        let map = Map::new(&ModelConfig::pi3(), &view());
        let mut opacity = [9.0; 2];
        map.opacity_row(Raw::Priors(Some(&[-2.3, -2.1])), &mut opacity);
        assert_eq!(opacity[0], 0.0);
        assert!(opacity[1] > 0.8);
    }

    #[test]
    fn softplus_meets_its_definition() {
        for x in [-100.0f32, -30.0, -1.0, 0.0, 1.5, 19.9, 20.1, 88.0] {
            let want = if x > 50.0 { f64::from(x) } else { f64::from(x).exp().ln_1p() };
            assert!((f64::from(softplus(x)) - want).abs() <= 1e-6 * want.max(1e-9) + 1e-15, "{x}");
        }
    }

    #[test]
    fn dggt_quaternions_are_world_axes_and_zero_is_guarded() {
        let mut config = ModelConfig::base();
        config.gs_map = GsMap::Dggt;
        let map = Map::new(&config, &view());
        let mut raw = [0.0; 2 * CHANNELS];
        raw[7..11].copy_from_slice(&[-2.0, 0.0, 0.0, 0.0]);
        let mut quat = [[9.0; 4]; 2];
        map.quat_row(Raw::Head(&raw), &mut quat);
        assert_eq!(quat, [[1.0, 0.0, 0.0, 0.0]; 2].map(|q| q.map(|v: f32| v + 0.0)));
    }
}
