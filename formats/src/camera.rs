//! Pinhole cameras in OpenCV axes (x right, y down, z forward).
//!
//! Pixel (i, j) has its centre at (i + 0.5, j + 0.5); u = fx x/z + cx. Poses are camera-to-world:
//! X_world = R X_cam + t, so t is the camera centre. Everything is f64 and free of SIMD, so the
//! same bits come out on every CPU.

use crate::error::{Error, Result};
use glam::{DMat3, DQuat, DVec3};

/// Rigid camera-to-world transform.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Pose {
    /// Rotation, camera to world; columns are the camera's axes in world coordinates.
    pub r: DMat3,
    /// Camera centre in world coordinates, scene units.
    pub t: DVec3,
}

impl Pose {
    /// The world frame itself.
    pub const IDENTITY: Pose = Pose { r: DMat3::IDENTITY, t: DVec3::ZERO };

    /// Largest deviation of R^T R from the identity that [`Pose::from_rows`] accepts.
    pub const ORTHO_TOLERANCE: f64 = 1e-3;
    /// Largest absolute coordinate of a camera centre.
    pub const MAX_TRANSLATION: f64 = 1e7;

    /// World to camera.
    pub fn inverse(&self) -> Pose {
        let r = self.r.transpose();
        Pose { r, t: -(r * self.t) }
    }

    /// `self` after `other`: maps x to self(other(x)).
    pub fn then(&self, other: &Pose) -> Pose {
        Pose { r: self.r * other.r, t: self.r * other.t + self.t }
    }

    /// Maps a point.
    pub fn apply(&self, p: DVec3) -> DVec3 {
        self.r * p + self.t
    }

    /// Row-major 4x4, bottom row 0 0 0 1.
    pub fn to_rows(&self) -> [[f64; 4]; 4] {
        let mut m = [[0.0; 4]; 4];
        for i in 0..3 {
            for j in 0..3 {
                m[i][j] = self.r.col(j)[i];
            }
            m[i][3] = self.t[i];
        }
        m[3][3] = 1.0;
        m
    }

    /// Reads a row-major 4x4 and checks that it is a rigid transform.
    pub fn from_rows(m: &[[f64; 4]; 4], at: &str) -> Result<Pose> {
        if m.iter().flatten().any(|v| !v.is_finite()) {
            return Err(Error::input(at, "pose holds a value that is not finite"));
        }
        if (0..4).any(|j| (m[3][j] - if j == 3 { 1.0 } else { 0.0 }).abs() > 1e-6) {
            return Err(Error::input(at, "bottom row of the pose must be 0 0 0 1"));
        }
        let col = |j: usize| DVec3::new(m[0][j], m[1][j], m[2][j]);
        let pose = Pose { r: DMat3::from_cols(col(0), col(1), col(2)), t: col(3) };
        pose.check(at)?;
        Ok(pose)
    }

    /// Refuses reflections, skewed rotations and absurd centres.
    pub fn check(&self, at: &str) -> Result<()> {
        if !self.r.is_finite() || !self.t.is_finite() {
            return Err(Error::input(at, "pose holds a value that is not finite"));
        }
        let e = self.r.transpose() * self.r - DMat3::IDENTITY;
        let worst = e.to_cols_array().iter().fold(0.0f64, |a, v| a.max(v.abs()));
        if worst > Self::ORTHO_TOLERANCE {
            return Err(Error::input(
                at,
                format!("rotation is not orthonormal (off by {worst:.2e}, limit {:.0e})", Self::ORTHO_TOLERANCE),
            ));
        }
        if self.r.determinant() < 0.0 {
            return Err(Error::input(at, "rotation is a reflection (determinant -1): check the axes"));
        }
        let far = self.t.abs().max_element();
        if far > Self::MAX_TRANSLATION {
            return Err(Error::input(
                at,
                format!("camera centre {far:.1e} is beyond {:.0e} scene units", Self::MAX_TRANSLATION),
            ));
        }
        Ok(())
    }

    /// Between two poses: slerp of the rotation, straight line of the camera centre.
    ///
    /// `s` outside 0..1 goes on with the same relative motion (network specification, target poses at
    /// novel times).
    pub fn interpolate(&self, other: &Pose, s: f64) -> Pose {
        let (a, b) = (DQuat::from_mat3(&self.r), DQuat::from_mat3(&other.r));
        let mut d = (b * a.inverse()).normalize();
        if d.w < 0.0 {
            d = -d;
        }
        let (axis, angle) = d.to_axis_angle();
        let r = DQuat::from_axis_angle(axis, angle * s) * a;
        Pose { r: DMat3::from_quat(r.normalize()), t: self.t + (other.t - self.t) * s }
    }
}

/// Pinhole intrinsics in pixels, for pixel centres at +0.5.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Intrinsics {
    /// Horizontal focal length.
    pub fx: f64,
    /// Vertical focal length.
    pub fy: f64,
    /// Principal point, horizontal; the image centre is `width / 2`.
    pub cx: f64,
    /// Principal point, vertical.
    pub cy: f64,
}

impl Intrinsics {
    /// The same camera when the image is resized from `(w0, h0)` to `(w1, h1)`.
    pub fn resized(&self, from: (u32, u32), to: (u32, u32)) -> Intrinsics {
        let (sx, sy) = (f64::from(to.0) / f64::from(from.0), f64::from(to.1) / f64::from(from.1));
        Intrinsics { fx: self.fx * sx, fy: self.fy * sy, cx: self.cx * sx, cy: self.cy * sy }
    }

    /// Refuses zero, negative, absurd and non-finite values.
    pub fn check(&self, at: &str) -> Result<()> {
        for (name, v) in [("fx", self.fx), ("fy", self.fy)] {
            if !(v.is_finite() && v > 1e-2 && v < 1e7) {
                return Err(Error::input(at, format!("{name} = {v} must be between 0.01 and 1e7 pixels")));
            }
        }
        for (name, v) in [("cx", self.cx), ("cy", self.cy)] {
            if !(v.is_finite() && v.abs() < 1e7) {
                return Err(Error::input(at, format!("{name} = {v} must be within +-1e7 pixels")));
            }
        }
        Ok(())
    }
}

/// A view: size, intrinsics and pose.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Camera {
    /// Image width in pixels.
    pub width: u32,
    /// Image height in pixels.
    pub height: u32,
    /// Intrinsics at that size.
    pub k: Intrinsics,
    /// Camera to world.
    pub pose: Pose,
}

impl Camera {
    /// Largest width or height that is rendered or read.
    pub const MAX_SIDE: u32 = 16_384;

    /// Refuses unusable sizes, intrinsics and poses.
    pub fn check(&self, at: &str) -> Result<()> {
        if self.width == 0 || self.height == 0 {
            return Err(Error::input(at, format!("image size {}x{} has no pixels", self.width, self.height)));
        }
        if self.width > Self::MAX_SIDE || self.height > Self::MAX_SIDE {
            return Err(Error::resource(
                at,
                format!("image size {}x{} is over {} pixels a side", self.width, self.height, Self::MAX_SIDE),
            ));
        }
        self.k.check(at)?;
        self.pose.check(at)
    }

    /// The same view at another size.
    pub fn resized(&self, width: u32, height: u32) -> Camera {
        Camera { width, height, k: self.k.resized((self.width, self.height), (width, height)), pose: self.pose }
    }

    /// World point of pixel coordinates `(u, v)` at z-depth `z`.
    pub fn unproject(&self, u: f64, v: f64, z: f64) -> DVec3 {
        self.pose.apply(DVec3::new((u - self.k.cx) / self.k.fx * z, (v - self.k.cy) / self.k.fy * z, z))
    }

    /// Pixel coordinates and z-depth of a world point.
    pub fn project(&self, p: DVec3) -> (f64, f64, f64) {
        let c = self.pose.inverse().apply(p);
        (self.k.fx * c.x / c.z + self.k.cx, self.k.fy * c.y / c.z + self.k.cy, c.z)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn pose(axis: DVec3, angle: f64, t: DVec3) -> Pose {
        Pose { r: DMat3::from_axis_angle(axis.normalize(), angle), t }
    }

    #[test]
    fn both_conventions_give_the_same_point() {
        // Network specification, item 17: mu = R^T (K^-1 u D - t) with (R, t) world-to-camera, and
        // mu = R_c (K^-1 u D) + t_c with camera-to-world, are the same point, which projects back
        // to its own pixel.
        let c2w = pose(DVec3::new(0.3, -1.0, 0.2), 0.7, DVec3::new(4.0, -2.0, 9.0));
        let camera =
            Camera { width: 252, height: 168, k: Intrinsics { fx: 210.0, fy: 205.0, cx: 126.0, cy: 84.0 }, pose: c2w };
        let (u, v, d) = (30.5, 77.5, 12.25);
        let ray = DVec3::new((u - 126.0) / 210.0, (v - 84.0) / 205.0, 1.0) * d;
        let w2c = c2w.inverse();
        let by_w2c = w2c.r.transpose() * (ray - w2c.t);
        let by_c2w = camera.unproject(u, v, d);
        assert!((by_w2c - by_c2w).length() < 1e-12);
        let (pu, pv, pz) = camera.project(by_c2w);
        assert!((pu - u).abs() < 1e-10 && (pv - v).abs() < 1e-10 && (pz - d).abs() < 1e-12);
    }

    #[test]
    fn interpolation_hits_the_ends_and_goes_on() {
        let a = pose(DVec3::Y, 0.1, DVec3::new(1.0, 0.0, 0.0));
        let b = pose(DVec3::Y, 0.3, DVec3::new(2.0, 0.0, 4.0));
        for (s, angle) in [(0.0, 0.1), (0.5, 0.2), (1.0, 0.3), (2.0, 0.5)] {
            let p = a.interpolate(&b, s);
            assert!((p.r - DMat3::from_rotation_y(angle)).to_cols_array().iter().all(|e| e.abs() < 1e-12));
            assert!((p.t - (a.t + (b.t - a.t) * s)).length() < 1e-12);
        }
    }

    #[test]
    fn rows_round_trip_and_bad_poses_are_refused() {
        let p = pose(DVec3::new(1.0, 2.0, 3.0), 1.1, DVec3::new(-5.0, 0.25, 7.0));
        assert_eq!(Pose::from_rows(&p.to_rows(), "pose").unwrap(), p);
        let mut m = p.to_rows();
        m[0][0] = f64::NAN;
        assert!(Pose::from_rows(&m, "pose").is_err());
        let mut m = p.to_rows();
        (0..3).for_each(|i| m[i][0] = -m[i][0]);
        assert!(Pose::from_rows(&m, "pose").unwrap_err().to_string().contains("reflection"));
        let mut m = p.to_rows();
        m[3][0] = 0.1;
        assert!(Pose::from_rows(&m, "pose").unwrap_err().to_string().contains("bottom row"));
        let mut m = p.to_rows();
        m[0][3] = 1e30;
        assert!(Pose::from_rows(&m, "pose").is_err());
    }
}
