//! Gaussians to the screen.
//!
//! The record keeps the quadratic form as a sum of squares in units of powers of two,
//!
//! ```text
//! x = d^2 + e^2 + nlo,  alpha = 2^-x
//! d = cx (X - u) + dy (Y - v)     cx = sqrt(log2(e) Syy / (2 det)),  dy = -cx Sxy / Syy
//! e = ar (Y - v)                  ar = sqrt(log2(e) / (2 Syy)),      nlo = -log2(opacity)
//! ```
//!
//! which equals opacity exp(-sigma) of the inverse covariance but cannot cancel and is never negative. d and e
//! are stored at the first pixel of the record's box, so that a centre far outside the image costs no precision.
//!
//! Two paths. Means, depths and centres are f64 in both: the order depends on them. The covariance is f32, sixteen
//! at a time, where that is enough: a trace of at most [`EASY_TRACE`] pixels squared and a determinant that the low-pass
//! keeps away from zero. Then Cauchy-Binet in f32 has a relative error below 4e-5 in the determinant. Anything
//! else, and any field that needs a rule (not finite, clamped, denormal), takes [`Projector::project`], which is f64:
//! a needle of 1000 x 0.5 pixels has a small eigenvalue that is the difference of numbers a million
//! times larger. The choice is made by bits that are equal everywhere.

use glam::{DMat3, DVec3};
use sf_formats::scene::{Gaussians, SplatSettings};
use sf_formats::{Camera, Error, Result};

use crate::math;
use crate::screen::{Projected, Record};

/// Alphas below this leave no trace: 1/255.
pub const ALPHA_CUT: f32 = 1.0 / 255.0;
/// Farthest z that is drawn (gsplat).
pub const FAR: f32 = 1e10;
/// Floor of the antialiasing factor (gsplat 1.6).
pub const AA_FLOOR: f64 = 0.005;
/// Standard deviations are clamped to this range, scene units. The low end keeps a zero scale a point;
/// the high end keeps the fourth powers in the determinant finite.
pub const SCALE_RANGE: (f32, f32) = (1e-20, 1e10);
/// Added to the radius of the box in sigma units and to runs in pixels, so that rounding never
/// excludes a pixel that the alpha test would keep.
pub const MARGIN: f64 = 1e-3;

/// Largest trace of a covariance that is computed in f32, pixels squared: a sigma of 100 pixels.
pub const EASY_TRACE: f32 = 1e4;

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
    pub(crate) world_to_camera: DMat3,
    pub(crate) centre: DVec3,
    pub(crate) camera: Camera,
    pub(crate) settings: SplatSettings,
    /// Limits of x/z in the Jacobian.
    pub(crate) clamp_x: (f64, f64),
    /// Limits of y/z in the Jacobian.
    pub(crate) clamp_y: (f64, f64),
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

    /// Gaussian `i` on the screen by the f64 path; `None` when it leaves no trace in the image.
    pub fn project(&self, scene: &Gaussians, i: usize, counts: &mut Counts) -> Option<Projected> {
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
        let half_log2e = 0.5 * std::f64::consts::LOG2_E;
        let (cx, ar) = ((half_log2e * syy / det).sqrt(), (half_log2e / syy).sqrt());
        let dy = -cx * (sxy / syy);
        let (du, dv) = (f64::from(x[0]) + 0.5 - u, f64::from(y[0]) + 0.5 - v);
        let record = Record {
            d: (cx * du + dy * dv) as f32,
            cx: cx as f32,
            dy: dy as f32,
            e: (ar * dv) as f32,
            ar: ar as f32,
            nlo: (-std::f64::consts::LOG2_E * math::ln(f64::from(opacity))) as f32,
            rgb,
            index: i as u32,
            first: [x[0], y[0]],
            unused: 0,
        };
        Some(Projected { record, z, x, y })
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
fn pixel_span(centre: f64, half: f64, size: u32) -> Option<[u16; 2]> {
    if centre.is_nan() || half.is_nan() {
        return None;
    }
    // Size <= 16384 fits.
    let lo = (centre - half - 0.5).ceil().max(0.0);
    let hi = (centre + half - 0.5).floor().min(f64::from(size) - 1.0);
    (lo <= hi).then(|| [lo as u16, hi as u16 + 1])
}

#[cfg(test)]
mod tests {
    use super::*;
    use sf_formats::{Intrinsics, Pose};

    #[test]
    fn spans_hold_exactly_the_pixel_centres_inside() {
        assert_eq!(pixel_span(4.5, 0.0, 8), Some([4, 5]));
        assert_eq!(pixel_span(4.4, 0.05, 8), None);
        assert_eq!(pixel_span(0.0, 1e30, 8), Some([0, 8]));
        assert_eq!(pixel_span(-3.0, 3.4, 8), None);
        assert_eq!(pixel_span(-3.0, 3.5, 8), Some([0, 1]));
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
        let p = Projector::new(&camera, &SplatSettings::default()).project(&scene, 0, &mut counts).unwrap();
        let r = p.record;
        let unit = (0.5 * std::f64::consts::LOG2_E / 25.3).sqrt() as f32;
        assert_eq!((p.z, r.nlo), (4.0, 0.0));
        assert!((r.cx - unit).abs() < 1e-7 && (r.ar - unit).abs() < 1e-7 && r.dy.abs() < 1e-7);
        assert!(
            (r.d - unit * (15.5 - 32.0)).abs() < 1e-6
                && (r.e - unit * (f32::from(r.first[1]) + 0.5 - 24.0)).abs() < 1e-6
        );
        // Radius sqrt(2 ln 255) * sqrt(25.3) = 16.74 pixels: centres 15.5..=48.5.
        assert_eq!((p.x, r.first[0]), ([15, 49], 15));
        assert_eq!(counts, Counts::default());
    }
}
