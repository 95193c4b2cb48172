//! One Gaussian to the screen.
//!
//! Everything up to the record is f64: a needle of 1000 x 0.5 pixels has a covariance whose small
//! eigenvalue is the difference of numbers a million times larger, which f32 does not hold.
//!
//! The record keeps the quadratic form as a sum of squares,
//!
//! ```text
//! sigma = row_k dy^2 + col_k (dx - slope dy)^2      row_k = 1 / (2 Syy), slope = Sxy / Syy,
//!                                                   col_k = Syy / (2 det)
//! ```
//!
//! which equals (A dx^2 + C dy^2)/2 + B dx dy of the inverse covariance but cannot cancel, is never
//! negative, and gives the exact run of pixels that a row needs.

use glam::{DMat3, DVec3};
use sf_formats::scene::{Gaussians, SplatSettings};
use sf_formats::{Camera, Error, Result};

use crate::math;

/// Alphas below this leave no trace: 1/255.
pub const ALPHA_CUT: f32 = 1.0 / 255.0;
/// Farthest z that is drawn (gsplat).
pub const FAR: f32 = 1e10;
/// Floor of the antialiasing factor (gsplat 1.6).
pub const AA_FLOOR: f64 = 0.005;
/// Side of a tile in pixels.
pub const TILE: u32 = 32;
/// Standard deviations are clamped to this range, scene units. The low end keeps a zero scale a point;
/// the high end keeps the fourth powers in the determinant finite.
pub const SCALE_RANGE: (f32, f32) = (1e-20, 1e10);
/// Added to the radius of the box in sigma units and to runs in pixels, so that rounding never
/// excludes a pixel that the alpha test would keep.
pub const MARGIN: f64 = 1e-3;

/// A visible Gaussian on the screen.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Record {
    /// Centre in pixel coordinates.
    pub u: f64,
    /// Centre in pixel coordinates.
    pub v: f64,
    /// Sxy / Syy: how far the middle of a row moves per row.
    pub slope: f64,
    /// 1 / (2 Syy).
    pub row_k: f64,
    /// Syy / (2 det S2), 1 / pixels squared.
    pub col_k: f32,
    /// 1 / sqrt(col_k).
    pub col_width: f32,
    /// ln(255 opacity): sigma above this gives an alpha below 1/255.
    pub cut: f32,
    /// Opacity after antialiasing, 1/255..=1.
    pub opacity: f32,
    /// Camera z, the sort key and the depth.
    pub z: f32,
    /// Colour.
    pub rgb: [f32; 3],
    /// Which Gaussian of the scene.
    pub index: u32,
    /// Pixels touched: columns `x.0..x.1`, not empty, inside the image.
    pub x: (u16, u16),
    /// Pixels touched: rows `y.0..y.1`, not empty, inside the image.
    pub y: (u16, u16),
}

impl Record {
    /// Number of tiles that the pixel box meets.
    pub fn tiles(&self) -> u64 {
        let (x, y) = self.tile_box();
        u64::from(x.1 - x.0) * u64::from(y.1 - y.0)
    }

    /// Tile columns and rows of the pixel box, half open.
    #[inline]
    pub fn tile_box(&self) -> ((u32, u32), (u32, u32)) {
        let span = |p: (u16, u16)| (u32::from(p.0) / TILE, (u32::from(p.1) - 1) / TILE + 1);
        (span(self.x), span(self.y))
    }
}

/// Why a Gaussian is not drawn, or what was changed to draw it.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Counts {
    /// NaN or infinity in a field.
    pub nonfinite: u64,
    /// Negative scale.
    pub negative_scale: u64,
    /// Quaternion of length zero.
    pub zero_quaternion: u64,
    /// Covariance without a positive determinant.
    pub singular: u64,
    /// Scale clamped to [`SCALE_RANGE`].
    pub clamped_scale: u64,
    /// Opacity outside 0..=1, clamped.
    pub clamped_opacity: u64,
}

impl Counts {
    /// Adds those of another part of the scene.
    pub fn add(&mut self, other: &Counts) {
        self.nonfinite += other.nonfinite;
        self.negative_scale += other.negative_scale;
        self.zero_quaternion += other.zero_quaternion;
        self.singular += other.singular;
        self.clamped_scale += other.clamped_scale;
        self.clamped_opacity += other.clamped_opacity;
    }
}

/// Refuses settings under which the formulas have no value.
pub fn check_settings(s: &SplatSettings) -> Result<()> {
    let bad =
        |name: &str, v: f32, want: &str| Err(Error::input("splat settings", format!("{name} = {v} must be {want}")));
    if !(s.a_max > 0.0 && s.a_max < 1.0) {
        return bad("a_max", s.a_max, "between 0 and 1, both excluded");
    }
    if !(s.eps2d >= 0.0 && s.eps2d <= 100.0) {
        return bad("eps2d", s.eps2d, "0 to 100 pixels squared");
    }
    if !(s.near >= 1e-6 && s.near <= FAR) {
        return bad("near", s.near, "1e-6 to 1e10 scene units");
    }
    Ok(())
}

/// A camera with its settings, ready to project.
#[derive(Clone, Copy, Debug)]
pub struct Projector {
    world_to_camera: DMat3,
    centre: DVec3,
    camera: Camera,
    settings: SplatSettings,
    /// Limits of x/z in the Jacobian.
    clamp_x: (f64, f64),
    /// Limits of y/z in the Jacobian.
    clamp_y: (f64, f64),
}

impl Projector {
    /// Both must have been checked.
    pub fn new(camera: &Camera, settings: &SplatSettings) -> Projector {
        let clamp = |size: u32, f: f64, c: f64| {
            let size = f64::from(size);
            let margin = 0.3 * 0.5 * size / f;
            (-(c / f + margin), (size - c) / f + margin)
        };
        Projector {
            world_to_camera: camera.pose.r.transpose(),
            centre: camera.pose.t,
            camera: *camera,
            settings: *settings,
            clamp_x: clamp(camera.width, camera.k.fx, camera.k.cx),
            clamp_y: clamp(camera.height, camera.k.fy, camera.k.cy),
        }
    }

    /// Gaussian `i` on the screen; `None` when it leaves no trace in the image.
    pub fn project(&self, scene: &Gaussians, i: usize, counts: &mut Counts) -> Option<Record> {
        let (mean, scale, quat) = (scene.mean[i], scene.scale[i], scene.quat[i]);
        let (opacity, rgb) = (scene.opacity[i], scene.colour[i]);
        let finite = |v: &[f32]| v.iter().all(|x| x.is_finite());
        if !(finite(&mean) && finite(&scale) && finite(&quat) && finite(&rgb) && opacity.is_finite()) {
            counts.nonfinite += 1;
            return None;
        }
        if scale.iter().any(|&s| s < 0.0) {
            counts.negative_scale += 1;
            return None;
        }
        let norm2 = quat.iter().fold(0.0, |a, &q| a + f64::from(q) * f64::from(q));
        if norm2 == 0.0 {
            counts.zero_quaternion += 1;
            return None;
        }
        let (lo, hi) = SCALE_RANGE;
        counts.clamped_scale += u64::from(scale.iter().any(|&s| s < lo || s > hi));
        counts.clamped_opacity += u64::from(!(0.0..=1.0).contains(&opacity));
        let mut opacity = opacity.clamp(0.0, 1.0);
        // Antialiasing only lowers it, so most invisible ones leave here.
        if opacity < ALPHA_CUT {
            return None;
        }

        let p = self.world_to_camera * (DVec3::from_array(mean.map(f64::from)) - self.centre);
        let z = p.z as f32;
        if !(z >= self.settings.near && z <= FAR) {
            return None;
        }
        let scale = scale.map(|s| f64::from(s.clamp(lo, hi)));
        let quat = quat.map(|q| f64::from(q) / norm2.sqrt());
        let Covariance { xx, xy: sxy, yy, det: before } = self.covariance(p, scale, quat);
        let eps = f64::from(self.settings.eps2d);
        let (sxx, syy) = (xx + eps, yy + eps);
        let det = before + eps * (xx + yy) + eps * eps;
        if det.is_nan() || det <= 0.0 {
            counts.singular += 1;
            return None;
        }
        if self.settings.aa {
            opacity *= (before / det).max(AA_FLOOR * AA_FLOOR).sqrt() as f32;
            if opacity < ALPHA_CUT {
                return None;
            }
        }

        let cut = math::ln(255.0 * f64::from(opacity));
        let radius = (2.0 * cut.max(0.0) + MARGIN).sqrt();
        let k = &self.camera.k;
        let (u, v) = (k.fx * (p.x / p.z) + k.cx, k.fy * (p.y / p.z) + k.cy);
        let x = pixel_span(u, radius * sxx.sqrt(), self.camera.width)?;
        let y = pixel_span(v, radius * syy.sqrt(), self.camera.height)?;
        let col_k = 0.5 * syy / det;
        Some(Record {
            u,
            v,
            slope: sxy / syy,
            row_k: 0.5 / syy,
            col_k: col_k as f32,
            col_width: (1.0 / col_k).sqrt() as f32,
            cut: cut as f32,
            opacity,
            z,
            rgb,
            index: i as u32,
            x,
            y,
        })
    }

    /// The projected covariance before the low-pass of a scale and a unit quaternion.
    ///
    /// S = M M^T with M = J R^T Q diag(s), two rows of three numbers; its determinant is the sum of the
    /// squares of M's three 2x2 minors (Cauchy-Binet), which is never negative.
    fn covariance(&self, p: DVec3, scale: [f64; 3], [w, x, y, z]: [f64; 4]) -> Covariance {
        let columns = [
            DVec3::new(1.0 - 2.0 * (y * y + z * z), 2.0 * (x * y + w * z), 2.0 * (x * z - w * y)),
            DVec3::new(2.0 * (x * y - w * z), 1.0 - 2.0 * (x * x + z * z), 2.0 * (y * z + w * x)),
            DVec3::new(2.0 * (x * z + w * y), 2.0 * (y * z - w * x), 1.0 - 2.0 * (x * x + y * y)),
        ];
        let k = &self.camera.k;
        let (fx, fy) = (k.fx / p.z, k.fy / p.z);
        let tx = (p.x / p.z).clamp(self.clamp_x.0, self.clamp_x.1);
        let ty = (p.y / p.z).clamp(self.clamp_y.0, self.clamp_y.1);
        let (mut a, mut b) = ([0.0; 3], [0.0; 3]);
        for i in 0..3 {
            let axis = self.world_to_camera * columns[i];
            a[i] = fx * (axis.x - tx * axis.z) * scale[i];
            b[i] = fy * (axis.y - ty * axis.z) * scale[i];
        }
        let minor = |i: usize, j: usize| {
            let m = a[i] * b[j] - a[j] * b[i];
            m * m
        };
        Covariance {
            xx: a[0] * a[0] + a[1] * a[1] + a[2] * a[2],
            xy: a[0] * b[0] + a[1] * b[1] + a[2] * b[2],
            yy: b[0] * b[0] + b[1] * b[1] + b[2] * b[2],
            det: minor(0, 1) + minor(0, 2) + minor(1, 2),
        }
    }
}

/// Symmetric 2x2 matrix with its determinant, pixels squared.
struct Covariance {
    xx: f64,
    xy: f64,
    yy: f64,
    det: f64,
}

/// Pixels `lo..hi` of `0..size` whose centres lie within `half` of `centre`; `None` when empty.
fn pixel_span(centre: f64, half: f64, size: u32) -> Option<(u16, u16)> {
    if centre.is_nan() || half.is_nan() {
        return None;
    }
    // Size <= 16384 fits.
    let lo = (centre - half - 0.5).ceil().max(0.0);
    let hi = (centre + half - 0.5).floor().min(f64::from(size) - 1.0);
    (lo <= hi).then(|| (lo as u16, hi as u16 + 1))
}

#[cfg(test)]
mod tests {
    use super::*;
    use sf_formats::{Intrinsics, Pose};

    #[test]
    fn spans_hold_exactly_the_pixel_centres_inside() {
        assert_eq!(pixel_span(4.5, 0.0, 8), Some((4, 5)));
        assert_eq!(pixel_span(4.4, 0.05, 8), None);
        assert_eq!(pixel_span(0.0, 1e30, 8), Some((0, 8)));
        assert_eq!(pixel_span(-3.0, 3.4, 8), None);
        assert_eq!(pixel_span(-3.0, 3.5, 8), Some((0, 1)));
        assert_eq!(pixel_span(f64::NAN, 1.0, 8), None);
        assert_eq!(pixel_span(3.0, f64::NAN, 8), None);
    }

    #[test]
    fn a_sphere_on_the_axis_is_a_disc_of_focal_over_z() {
        // s = 0.2 at z = 4 with f = 100: sigma 5 pixels, low-pass 0.3.
        let camera = Camera {
            width: 64,
            height: 48,
            k: Intrinsics { fx: 100.0, fy: 100.0, cx: 32.0, cy: 24.0 },
            pose: Pose::IDENTITY,
        };
        let scene = Gaussians {
            mean: vec![[0.0, 0.0, 4.0]],
            scale: vec![[0.2; 3]],
            quat: vec![[0.5, 0.5, -0.5, 0.5]],
            opacity: vec![1.0],
            colour: vec![[1.0, 0.0, 0.0]],
        };
        let mut counts = Counts::default();
        let r = Projector::new(&camera, &SplatSettings::default()).project(&scene, 0, &mut counts).unwrap();
        assert_eq!((r.u, r.v, r.z), (32.0, 24.0, 4.0));
        assert!((r.row_k - 0.5 / 25.3).abs() < 1e-9 && (f64::from(r.col_k) - 0.5 / 25.3).abs() < 1e-8);
        assert!(r.slope.abs() < 1e-9);
        // Radius sqrt(2 ln 255) * sqrt(25.3) = 16.74 pixels: centres 15.5..=48.5.
        assert_eq!(r.x, (15, 49));
        assert_eq!(counts, Counts::default());
    }
}
