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
    /// z of the last Gaussian that was looked at `[height, width]`, 0 without one: what the slack may move in depth.
    pub far: Vec<f64>,
    /// Digest of all decisions: which Gaussian was composited, clamped to `a_max` or stopped which pixel, in which order.
    /// Where two pictures have the same, the numbers between them are smooth.
    pub decisions: u64,
}

/// One Gaussian, fields as in [`Gaussians`].
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Source {
    /// Centre.
    pub mean: DVec3,
    /// Standard deviations.
    pub scale: DVec3,
    /// w, x, y, z.
    pub quat: [f64; 4],
    /// Opacity.
    pub opacity: f64,
    /// Colour.
    pub rgb: [f64; 3],
}

impl Source {
    /// Gaussian `i` of a scene.
    pub fn of(scene: &Gaussians, i: usize) -> Source {
        Source {
            mean: DVec3::from_array(scene.mean[i].map(f64::from)),
            scale: DVec3::from_array(scene.scale[i].map(f64::from)),
            quat: scene.quat[i].map(f64::from),
            opacity: f64::from(scene.opacity[i]),
            rgb: scene.colour[i].map(f64::from),
        }
    }
}

/// How the picture is taken. The twelve numbers of the world-to-camera matrix are free here: p = r mean + t.
#[derive(Clone, Copy, Debug)]
pub struct View {
    /// World to camera.
    pub r: DMat3,
    /// World to camera.
    pub t: DVec3,
    /// Size and intrinsics; its pose is not used.
    pub camera: Camera,
    /// Conventions.
    pub settings: SplatSettings,
    /// Colour behind everything.
    pub background: [f32; 3],
}

impl View {
    /// A valid camera's.
    pub fn of(camera: &Camera, settings: &SplatSettings, background: [f32; 3]) -> View {
        let inverse = camera.pose.inverse();
        View { r: inverse.r, t: inverse.t, camera: *camera, settings: *settings, background }
    }
}

/// A Gaussian on the screen.
pub(crate) struct Splat {
    pub(crate) index: usize,
    pub(crate) z: f64,
    key: f32,
    pub(crate) mean: DVec2,
    pub(crate) inverse: DMat2,
    /// After antialiasing.
    pub(crate) opacity: f64,
    pub(crate) rgb: [f64; 3],
    pub(crate) projection: Projection,
}

/// What the projection went through.
pub(crate) struct Projection {
    /// Mean in camera axes.
    pub(crate) p: DVec3,
    /// Rotation of the principal axes.
    pub(crate) q: DMat3,
    /// Clamped.
    pub(crate) scale: DVec3,
    /// Covariance in the world.
    pub(crate) sigma: DMat3,
    /// Rows of d(u, v)/dp.
    pub(crate) jacobian: [DVec3; 2],
    /// On the screen, low-pass included.
    pub(crate) covariance: DMat2,
    /// Its determinant without the low-pass.
    pub(crate) before: f64,
}

/// Draws the scene. The camera must be valid.
pub fn render(scene: &Gaussians, camera: &Camera, settings: &SplatSettings, background: [f32; 3]) -> ReferenceImage {
    let sources: Vec<Source> = (0..scene.len()).map(|i| Source::of(scene, i)).collect();
    render_sources(&sources, &View::of(camera, settings, background))
}

/// The same picture, bit for bit, in a time that large scenes allow: a Gaussian is taken only to the pixels of a box outside of which its
/// alpha is under the cut and the slack around it.
pub fn render_boxed(
    scene: &Gaussians,
    camera: &Camera,
    settings: &SplatSettings,
    background: [f32; 3],
) -> ReferenceImage {
    let sources: Vec<Source> = (0..scene.len()).map(|i| Source::of(scene, i)).collect();
    let view = View::of(camera, settings, background);
    let mut pixels = vec![Pixel::default(); camera.width as usize * camera.height as usize];
    for s in project_all(&sources, &view) {
        // opacity exp(-sigma) >= least means a distance of at most reach standard deviations along either axis.
        let least = 1.0 / 255.0 - 2.0 * ALPHA_SLACK;
        let reach = (2.0 * (s.opacity / least).ln().max(0.0)).sqrt();
        let covariance = s.projection.covariance;
        let span = |centre: f64, variance: f64, size: u32| {
            let half = reach * variance.sqrt() + 1.0;
            ((centre - half).max(0.0) as u32)..((centre + half).clamp(0.0, f64::from(size)).ceil() as u32).min(size)
        };
        let columns = span(s.mean.x, covariance.x_axis.x, camera.width);
        for y in span(s.mean.y, covariance.y_axis.y, camera.height) {
            for x in columns.clone() {
                pixels[(y * camera.width + x) as usize].take(&s, x, y, &view);
            }
        }
    }
    ReferenceImage::of(&pixels, &view)
}

/// Draws Gaussians of f64, as a difference quotient needs.
pub fn render_sources(sources: &[Source], view: &View) -> ReferenceImage {
    let splats = project_all(sources, view);
    let mut pixels = Vec::new();
    for y in 0..view.camera.height {
        for x in 0..view.camera.width {
            let mut pixel = Pixel::default();
            for s in &splats {
                pixel.take(s, x, y, view);
            }
            pixels.push(pixel);
        }
    }
    ReferenceImage::of(&pixels, view)
}

/// Those in view, front to back.
pub(crate) fn project_all(sources: &[Source], view: &View) -> Vec<Splat> {
    let mut splats: Vec<Splat> = sources.iter().enumerate().filter_map(|(i, s)| project(i, s, view)).collect();
    // The sort is stable, so equal depths stay in index order.
    splats.sort_by(|a, b| a.key.total_cmp(&b.key));
    splats
}

fn project(index: usize, source: &Source, view: &View) -> Option<Splat> {
    let Source { mean, scale, quat, opacity, rgb } = *source;
    let View { camera, settings, .. } = view;
    let all = [mean.to_array(), scale.to_array(), rgb].concat();
    if all.iter().chain(&quat).chain([&opacity]).any(|v| !v.is_finite())
        || scale.min_element() < 0.0
        || quat == [0.0; 4]
    {
        return None;
    }
    let p = view.r * mean + view.t;
    let z = p.z;
    let key = z as f32;
    if !(key >= settings.near && key <= FAR) {
        return None;
    }
    let scale = scale.clamp(DVec3::splat(SCALE_RANGE.0.into()), DVec3::splat(SCALE_RANGE.1.into()));
    let [w, x, y, qz] = quat;
    let q = DMat3::from_quat(DQuat::from_xyzw(x, y, qz, w).normalize());
    let sigma = q * DMat3::from_diagonal(scale * scale) * q.transpose();
    let in_camera = view.r * sigma * view.r.transpose();

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
    let mut opacity = opacity.clamp(0.0, 1.0);
    if settings.aa {
        opacity *= ((sxx * syy - sxy * sxy) / s2.determinant()).max(AA_FLOOR * AA_FLOOR).sqrt();
    }
    Some(Splat {
        index,
        z,
        key,
        mean: DVec2::new(k.fx * p.x / z + k.cx, k.fy * p.y / z + k.cy),
        inverse: s2.inverse(),
        opacity,
        rgb,
        projection: Projection {
            p,
            q,
            scale,
            sigma,
            jacobian: [jx, jy],
            covariance: s2,
            before: sxx * syy - sxy * sxy,
        },
    })
}

/// A pixel on its way from front to back.
#[derive(Clone, Copy)]
struct Pixel {
    t: f64,
    finished: bool,
    rgb: [f64; 3],
    depth: f64,
    slack: f64,
    far: f64,
    /// Depth and alpha of the last Gaussian that took part. Equal depths are no matter of rounding: both sides order
    /// them by index.
    last: (f64, f64),
    decisions: u64,
}

impl Default for Pixel {
    fn default() -> Pixel {
        let (zero, last) = (0.0, (f64::NEG_INFINITY, 0.0));
        Pixel { t: 1.0, finished: false, rgb: [zero; 3], depth: zero, slack: zero, far: zero, last, decisions: 0 }
    }
}

impl Pixel {
    /// The next Gaussian.
    fn take(&mut self, s: &Splat, x: u32, y: u32, view: &View) {
        if self.finished {
            return;
        }
        let d = DVec2::new(f64::from(x) + 0.5, f64::from(y) + 0.5) - s.mean;
        let raw = s.opacity * (-0.5 * d.dot(s.inverse * d)).exp();
        if (raw - 1.0 / 255.0).abs() < ALPHA_SLACK {
            self.slack += self.t * raw;
        }
        if raw < 1.0 / 255.0 {
            return;
        }
        self.far = s.z;
        let a_max = f64::from(view.settings.a_max);
        let alpha = raw.min(a_max);
        let key = f64::from(s.key);
        if key > self.last.0 && key - self.last.0 <= DEPTH_SLACK * key {
            self.slack += self.t * alpha * self.last.1;
        }
        self.last = (key, alpha);
        let next = self.t * (1.0 - alpha);
        if (next / 1e-4 - 1.0).abs() < T_SLACK {
            self.slack += self.t;
        }
        self.finished = next <= 1e-4;
        let what = if self.finished { 3 } else { 1 + u64::from(raw >= a_max) };
        self.decisions = mix(self.decisions, s.index as u64 * 4 + what);
        if self.finished {
            return;
        }
        for c in 0..3 {
            self.rgb[c] += self.t * alpha * s.rgb[c];
        }
        self.depth += self.t * alpha * s.z;
        self.t = next;
    }
}

fn mix(digest: u64, value: u64) -> u64 {
    (digest ^ value).wrapping_mul(0x9e37_79b9_7f4a_7c15).rotate_left(29)
}

impl ReferenceImage {
    fn of(pixels: &[Pixel], view: &View) -> ReferenceImage {
        let mut image = ReferenceImage::default();
        for p in pixels {
            image.rgb.extend((0..3).map(|c| p.rgb[c] + p.t * f64::from(view.background[c])));
            image.depth.push(p.depth);
            image.alpha.push(1.0 - p.t);
            image.slack.push(p.slack);
            image.far.push(p.far);
            image.decisions = mix(image.decisions, p.decisions);
        }
        image
    }
}
