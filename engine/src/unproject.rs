//! World gauge and the centres of the Gaussians (network specification, items 17 to 19 and 32).
//!
//! mu = R_c (K^-1 (u + 0.5, v + 0.5, 1) z) + t_c with the camera-to-world pose (R_c, t_c) of the frame,
//! re-anchored so that the first frame's camera is the world, translations and depths times
//! `world.scale`. Computed in f64 per pixel, stored as f32.

use crate::rotation;
use glam::{DMat3, DVec3};
use sf_formats::config::{Anchor, ModelConfig, PixelCentre};
use sf_formats::{Intrinsics, Pose};

/// Poses in the network's gauge to poses in the world's: anchored, translations scaled.
///
/// A pose is replaced by pose_0^-1 pose, with the first frame exactly the identity.
pub(crate) fn anchor(config: &ModelConfig, raw: &[Pose], out: &mut [Pose]) {
    assert_eq!(raw.len(), out.len(), "one output pose per input pose");
    for (f, (pose, world)) in raw.iter().zip(out).enumerate() {
        *world = match config.world_anchor {
            Anchor::First if f == 0 => Pose::IDENTITY,
            Anchor::First => raw[0].inverse().then(pose),
            Anchor::Raw => *pose,
        };
        world.t *= config.world_scale;
    }
}

/// Pose from the camera head's raw outputs: translation and nine rotation numbers.
pub(crate) fn raw_pose(t: &[f32; 3], nine: &[f32; 9]) -> Pose {
    Pose { r: rotation::from_nine(nine), t: DVec3::new(f64::from(t[0]), f64::from(t[1]), f64::from(t[2])) }
}

/// What places the pixels of one frame in the world.
#[derive(Clone, Copy, Debug)]
pub(crate) struct View {
    /// Camera to world, scaled.
    pub pose: Pose,
    /// Intrinsics at the network's size.
    pub k: Intrinsics,
    /// Where in the pixel the ray passes.
    pub pixel: PixelCentre,
}

impl View {
    /// Rotation to world axes as f32 rows, for directions.
    pub(crate) fn rotation(&self) -> [[f32; 3]; 3] {
        let m: DMat3 = self.pose.r;
        std::array::from_fn(|i| std::array::from_fn(|j| m.col(j)[i] as f32))
    }

    /// Local point of pixel `(u, v)` at z-depth `z`.
    pub(crate) fn local(&self, u: usize, v: usize, z: f32) -> DVec3 {
        let offset = match self.pixel {
            PixelCentre::Half => 0.5,
            PixelCentre::Integer => 0.0,
        };
        let z = f64::from(z);
        let x = (u as f64 + offset - self.k.cx) / self.k.fx * z;
        let y = (v as f64 + offset - self.k.cy) / self.k.fy * z;
        DVec3::new(x, y, z)
    }

    /// Centres of row `v`; `depth` and `out` hold one row, depth already in scene units.
    pub(crate) fn mean_row(&self, v: usize, depth: &[f32], out: &mut [[f32; 3]]) {
        for (u, (&z, mean)) in depth.iter().zip(out).enumerate() {
            let p = self.pose.apply(self.local(u, v, z));
            *mean = [p.x as f32, p.y as f32, p.z as f32];
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Self-check 9 of the network specification: a centre projects back to its own pixel.
    #[test]
    fn centres_project_back_to_their_pixels() {
        let k = Intrinsics { fx: 51.0, fy: 49.0, cx: 21.0, cy: 14.0 };
        let r = DMat3::from_axis_angle(DVec3::new(0.1, 1.0, -0.3).normalize(), 0.8);
        let pose = Pose { r, t: DVec3::new(3.0, -1.0, 7.0) };
        for (pixel, offset) in [(PixelCentre::Half, 0.5), (PixelCentre::Integer, 0.0)] {
            let view = View { pose, k, pixel };
            let depth: Vec<f32> = (0..42).map(|u| 2.0 + u as f32 * 0.25).collect();
            let mut means = vec![[0.0; 3]; 42];
            view.mean_row(9, &depth, &mut means);
            let camera = sf_formats::Camera { width: 42, height: 28, k, pose };
            for (u, m) in means.iter().enumerate() {
                let (pu, pv, pz) = camera.project(DVec3::new(f64::from(m[0]), f64::from(m[1]), f64::from(m[2])));
                assert!((pu - u as f64 - offset).abs() < 1e-4, "{u}: {pu}");
                assert!((pv - 9.0 - offset).abs() < 1e-4 && (pz - f64::from(depth[u])).abs() < 1e-5);
            }
        }
    }

    #[test]
    fn the_first_camera_is_the_world() {
        let mut config = ModelConfig::base();
        config.world_scale = 2.0;
        let a = Pose { r: DMat3::from_rotation_y(0.4), t: DVec3::new(1.0, 2.0, 3.0) };
        let b = Pose { r: DMat3::from_rotation_x(0.2), t: DVec3::new(1.0, 2.0, 4.0) };
        let mut out = [Pose::IDENTITY; 2];
        anchor(&config, &[a, b], &mut out);
        assert_eq!(out[0], Pose::IDENTITY);
        let p = DVec3::new(0.3, -0.2, 5.0);
        assert!((out[1].apply(p * 2.0) - a.inverse().apply(b.apply(p)) * 2.0).length() < 1e-12);
        config.world_anchor = Anchor::Raw;
        anchor(&config, &[a, b], &mut out);
        assert_eq!(out[0].t, a.t * 2.0);
    }
}
