//! The same picture by brute force: the oracle of the tests, readable as the definition.
//!
//! f64 throughout, every Gaussian at every pixel, dense matrices, one global sort, the standard
//! library's `exp`. Nothing is shared with the fast path but the input rules' constants.

use glam::{DMat2, DMat3, DQuat, DVec2, DVec3};
use sf_formats::Camera;
use sf_formats::scene::{Gaussians, SplatSettings};

use crate::project::{AA_FLOOR, FAR, SCALE_RANGE};

/// An alpha this close to 1/255 may be kept or skipped by f32 arithmetic.
pub const ALPHA_SLACK: f64 = 2e-4;
/// A next T whose ratio to 1e-4 is this close to one may stop or go on.
pub const T_SLACK: f64 = 2e-3;
/// Depths this close, relative, may change places.
pub const DEPTH_SLACK: f64 = 4e-6;

/// The oracle's image, row-major.
#[derive(Clone, Debug, Default)]
pub struct ReferenceImage {
    /// Colour `[height, width, 3]`.
    pub rgb: Vec<f64>,
    /// sum T alpha z `[height, width]`.
    pub depth: Vec<f64>,
    /// 1 - T `[height, width]`.
    pub alpha: Vec<f64>,
    /// Weight that may move because a decision is within rounding of its threshold `[height, width]`.
    pub slack: Vec<f64>,
}

/// A Gaussian on the screen.
struct Splat {
    z: f64,
    key: f32,
    mean: DVec2,
    inverse: DMat2,
    opacity: f64,
    rgb: [f64; 3],
}

/// Draws the scene. The camera must be valid.
pub fn render(scene: &Gaussians, camera: &Camera, settings: &SplatSettings, background: [f32; 3]) -> ReferenceImage {
    let mut splats: Vec<Splat> = (0..scene.len()).filter_map(|i| project(scene, i, camera, settings)).collect();
    // The sort is stable, so equal depths stay in index order.
    splats.sort_by(|a, b| a.key.total_cmp(&b.key));
    let mut image = ReferenceImage::default();
    for y in 0..camera.height {
        for x in 0..camera.width {
            let centre = DVec2::new(f64::from(x) + 0.5, f64::from(y) + 0.5);
            pixel(&splats, centre, f64::from(settings.a_max), background, &mut image);
        }
    }
    image
}

fn project(scene: &Gaussians, i: usize, camera: &Camera, settings: &SplatSettings) -> Option<Splat> {
    let (mean, scale, quat) = (scene.mean[i], scene.scale[i], scene.quat[i]);
    let (opacity, rgb) = (scene.opacity[i], scene.colour[i]);
    let all: Vec<f32> = mean.into_iter().chain(scale).chain(quat).chain(rgb).chain([opacity]).collect();
    if all.iter().any(|v| !v.is_finite()) || scale.iter().any(|&s| s < 0.0) || quat == [0.0; 4] {
        return None;
    }
    let p = camera.pose.inverse().apply(DVec3::from_array(mean.map(f64::from)));
    let z = p.z;
    let key = z as f32;
    if !(key >= settings.near && key <= FAR) {
        return None;
    }
    let scale = DVec3::from_array(scale.map(|s| f64::from(s.clamp(SCALE_RANGE.0, SCALE_RANGE.1))));
    let [w, x, y, qz] = quat.map(f64::from);
    let q = DMat3::from_quat(DQuat::from_xyzw(x, y, qz, w).normalize());
    let sigma = q * DMat3::from_diagonal(scale * scale) * q.transpose();
    let r = camera.pose.r.transpose();
    let in_camera = r * sigma * r.transpose();

    let k = camera.k;
    let (width, height) = (f64::from(camera.width), f64::from(camera.height));
    let (tan_x, tan_y) = (0.5 * width / k.fx, 0.5 * height / k.fy);
    let tx = z * (p.x / z).clamp(-(k.cx / k.fx + 0.3 * tan_x), (width - k.cx) / k.fx + 0.3 * tan_x);
    let ty = z * (p.y / z).clamp(-(k.cy / k.fy + 0.3 * tan_y), (height - k.cy) / k.fy + 0.3 * tan_y);
    let jx = DVec3::new(k.fx / z, 0.0, -k.fx * tx / (z * z));
    let jy = DVec3::new(0.0, k.fy / z, -k.fy * ty / (z * z));
    let cov = |a: DVec3, b: DVec3| a.dot(in_camera * b);
    let (sxx, sxy, syy) = (cov(jx, jx), cov(jx, jy), cov(jy, jy));
    let eps = f64::from(settings.eps2d);
    let s2 = DMat2::from_cols(DVec2::new(sxx + eps, sxy), DVec2::new(sxy, syy + eps));
    if s2.determinant().is_nan() || s2.determinant() <= 0.0 {
        return None;
    }
    let mut opacity = f64::from(opacity.clamp(0.0, 1.0));
    if settings.aa {
        opacity *= ((sxx * syy - sxy * sxy) / s2.determinant()).max(AA_FLOOR * AA_FLOOR).sqrt();
    }
    Some(Splat {
        z: f64::from(key),
        key,
        mean: DVec2::new(k.fx * p.x / z + k.cx, k.fy * p.y / z + k.cy),
        inverse: s2.inverse(),
        opacity,
        rgb: rgb.map(f64::from),
    })
}

fn pixel(splats: &[Splat], centre: DVec2, a_max: f64, background: [f32; 3], image: &mut ReferenceImage) {
    let (mut t, mut depth, mut slack) = (1.0, 0.0, 0.0);
    let mut rgb = [0.0; 3];
    // Depth and alpha of the last Gaussian that took part. Equal depths are no matter of rounding:
    // both sides order them by index.
    let mut last = (f64::NEG_INFINITY, 0.0);
    for s in splats {
        let d = centre - s.mean;
        let raw = s.opacity * (-0.5 * d.dot(s.inverse * d)).exp();
        if (raw - 1.0 / 255.0).abs() < ALPHA_SLACK {
            slack += t * raw;
        }
        if raw < 1.0 / 255.0 {
            continue;
        }
        let alpha = raw.min(a_max);
        if s.z > last.0 && s.z - last.0 <= DEPTH_SLACK * s.z {
            slack += t * alpha * last.1;
        }
        last = (s.z, alpha);
        let next = t * (1.0 - alpha);
        if (next / 1e-4 - 1.0).abs() < T_SLACK {
            slack += t;
        }
        if next <= 1e-4 {
            break;
        }
        for c in 0..3 {
            rgb[c] += t * alpha * s.rgb[c];
        }
        depth += t * alpha * s.z;
        t = next;
    }
    image.rgb.extend((0..3).map(|c| rgb[c] + t * f64::from(background[c])));
    image.depth.push(depth);
    image.alpha.push(1.0 - t);
    image.slack.push(slack);
}
