//! The gradients of [`crate::reference`] by the chain rule, step by step with dense matrices in f64: the oracle of
//! [`crate::backward`], itself judged by difference quotients.
//!
//! Nothing is shared with the fast path: transmittances are kept per pixel, the sums behind a Gaussian are
//! formed anew, and the covariance goes back as J R Sigma R^T J^T and not through a root of it.

use glam::{DMat2, DMat3, DVec2, DVec3};

use crate::project::AA_FLOOR;
use crate::reference::{Source, Splat, View, project_all};

/// dL/d of the image, row-major, as [`crate::ImageGradients`].
#[derive(Clone, Debug, Default)]
pub struct ReferenceImageGradients {
    /// `[height, width, 3]`.
    pub rgb: Vec<f64>,
    /// `[height, width]`.
    pub depth: Vec<f64>,
    /// `[height, width]`.
    pub alpha: Vec<f64>,
}

/// dL/d of one Gaussian's fields.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct SourceGradient {
    /// Of the centre.
    pub mean: DVec3,
    /// Of the standard deviations.
    pub scale: DVec3,
    /// Of the quaternion as given.
    pub quat: [f64; 4],
    /// Of the opacity.
    pub opacity: f64,
    /// Of the colour.
    pub rgb: [f64; 3],
}

/// dL/d of a Gaussian on the screen.
#[derive(Clone, Copy, Debug)]
struct ScreenGradient {
    mean: DVec2,
    /// Of the four numbers of the inverse covariance.
    inverse: DMat2,
    opacity: f64,
    z: f64,
    rgb: [f64; 3],
}

/// Gradients of every Gaussian, and of the rotation and the translation of the view.
pub fn gradients(
    sources: &[Source],
    view: &View,
    image: &ReferenceImageGradients,
) -> (Vec<SourceGradient>, DMat3, DVec3) {
    let splats = project_all(sources, view);
    // The default of a matrix is the identity, so all zeros are spelt out.
    let zero = ScreenGradient { mean: DVec2::ZERO, inverse: DMat2::ZERO, opacity: 0.0, z: 0.0, rgb: [0.0; 3] };
    let mut screen = vec![zero; splats.len()];
    for y in 0..view.camera.height {
        for x in 0..view.camera.width {
            let centre = DVec2::new(f64::from(x) + 0.5, f64::from(y) + 0.5);
            let i = (y * view.camera.width + x) as usize;
            let rgb = [image.rgb[3 * i], image.rgb[3 * i + 1], image.rgb[3 * i + 2]];
            pixel(&splats, centre, view, (rgb, image.depth[i], image.alpha[i]), &mut screen);
        }
    }
    let mut out = vec![SourceGradient::default(); sources.len()];
    let (mut dr, mut dt) = (DMat3::ZERO, DVec3::ZERO);
    for (splat, gradient) in splats.iter().zip(&screen) {
        let (source, r, t) = project(&sources[splat.index], splat, gradient, view);
        out[splat.index] = source;
        dr += r;
        dt += t;
    }
    (out, dr, dt)
}

fn pixel(
    splats: &[Splat],
    centre: DVec2,
    view: &View,
    (rgb, depth, alpha): ([f64; 3], f64, f64),
    screen: &mut [ScreenGradient],
) {
    // Which, exp(-sigma), alpha before a_max, alpha, T in front.
    let mut seen: Vec<(usize, f64, f64, f64, f64)> = Vec::new();
    let mut t = 1.0;
    for (i, s) in splats.iter().enumerate() {
        let d = centre - s.mean;
        let falloff = (-0.5 * d.dot(s.inverse * d)).exp();
        let raw = s.opacity * falloff;
        if raw < 1.0 / 255.0 {
            continue;
        }
        let a = raw.min(f64::from(view.settings.a_max));
        if t * (1.0 - a) <= 1e-4 {
            break;
        }
        seen.push((i, falloff, raw, a, t));
        t *= 1.0 - a;
    }
    for (n, &(i, falloff, raw, a, in_front)) in seen.iter().enumerate() {
        let (s, g) = (&splats[i], &mut screen[i]);
        for c in 0..3 {
            g.rgb[c] += in_front * a * rgb[c];
        }
        g.z += in_front * a * depth;
        // L is a sum of T_j alpha_j v_j; those behind have the factor 1 - a.
        let value = |s: &Splat| rgb[0] * s.rgb[0] + rgb[1] * s.rgb[1] + rgb[2] * s.rgb[2] + depth * s.z;
        let mut da = in_front * value(s);
        for &(j, _, _, b, t) in &seen[n + 1..] {
            da -= t * b * value(&splats[j]) / (1.0 - a);
        }
        let behind: f64 = (0..3).map(|c| rgb[c] * f64::from(view.background[c])).sum::<f64>() - alpha;
        da -= t * behind / (1.0 - a);
        if raw < f64::from(view.settings.a_max) {
            g.opacity += da * falloff;
            let dsigma = -da * raw;
            let d = centre - s.mean;
            g.mean -= dsigma * (s.inverse * d);
            g.inverse += (0.5 * dsigma) * DMat2::from_cols(d * d.x, d * d.y);
        }
    }
}

fn project(source: &Source, splat: &Splat, g: &ScreenGradient, view: &View) -> (SourceGradient, DMat3, DVec3) {
    let way = &splat.projection;
    let k = view.camera.k;
    let (p, r) = (way.p, view.r);

    // Inverse, low-pass, antialiasing. s is dL/d of the covariance without the low-pass.
    let mut s = splat.inverse.transpose() * g.inverse * splat.inverse.transpose() * -1.0;
    let given = source.opacity.clamp(0.0, 1.0);
    let det = way.covariance.determinant();
    let ratio = way.before / det;
    let mut factor = 1.0;
    if view.settings.aa {
        factor = ratio.max(AA_FLOOR * AA_FLOOR).sqrt();
        if ratio > AA_FLOOR * AA_FLOOR {
            let dratio = g.opacity * given * 0.5 / factor;
            let eps = f64::from(view.settings.eps2d);
            let adjugate = |m: DMat2| DMat2::from_cols_array(&[m.y_axis.y, -m.x_axis.y, -m.y_axis.x, m.x_axis.x]);
            let without = way.covariance - DMat2::from_diagonal(DVec2::splat(eps));
            s += adjugate(without) * (dratio / det) - adjugate(way.covariance) * (dratio * ratio / det);
        }
    }
    let opacity = if source.opacity == given { g.opacity * factor } else { 0.0 };

    // S = J C J^T, C = R Sigma R^T, Sigma = Q D Q^T. s is symmetric.
    let [jx, jy] = way.jacobian;
    let c = r * way.sigma * r.transpose();
    let outer = |a: DVec3, b: DVec3| DMat3::from_cols(a * b.x, a * b.y, a * b.z);
    let dc = outer(jx, jx) * s.x_axis.x + (outer(jx, jy) + outer(jy, jx)) * s.x_axis.y + outer(jy, jy) * s.y_axis.y;
    let djx = 2.0 * (c * (jx * s.x_axis.x + jy * s.x_axis.y));
    let djy = 2.0 * (c * (jx * s.x_axis.y + jy * s.y_axis.y));
    let dsigma = r.transpose() * dc * r;
    let mut dr = (dc * r * way.sigma) * 2.0;
    let d = DMat3::from_diagonal(way.scale * way.scale);
    let dq = (dsigma * way.q * d) * 2.0;
    let dd = way.q.transpose() * dsigma * way.q;
    let diagonal = DVec3::new(dd.x_axis.x, dd.y_axis.y, dd.z_axis.z);
    let free = DVec3::from_array(std::array::from_fn(|i| f64::from(way.scale[i] == source.scale[i])));
    let scale = 2.0 * diagonal * way.scale * free;

    // J = [f/z, 0, -f t/z] with t the clamped ray, and the centre.
    let mut dp = DVec3::new(g.mean.x * k.fx / p.z, g.mean.y * k.fy / p.z, 0.0);
    dp.z = g.z - (g.mean.x * k.fx * p.x + g.mean.y * k.fy * p.y) / (p.z * p.z);
    for (i, (f, j, dj)) in [(k.fx, jx, djx), (k.fy, jy, djy)].into_iter().enumerate() {
        let ray = -j.z * p.z / f;
        dp.z += dj[i] * -f / (p.z * p.z) + dj.z * f * ray / (p.z * p.z);
        if (ray - p[i] / p.z).abs() < 1e-12 * (1.0 + ray.abs()) {
            let dray = -dj.z * f / p.z;
            dp[i] += dray / p.z;
            dp.z -= dray * p[i] / (p.z * p.z);
        }
    }
    dr += outer(dp, source.mean);

    let gradient =
        SourceGradient { mean: r.transpose() * dp, scale, quat: quaternion(source.quat, &dq), opacity, rgb: g.rgb };
    (gradient, dr, dp)
}

/// Through the matrix of the normalised quaternion, by its four derivatives.
fn quaternion(given: [f64; 4], dq: &DMat3) -> [f64; 4] {
    let norm = given.iter().map(|q| q * q).sum::<f64>().sqrt();
    let [w, x, y, z] = given.map(|q| q / norm);
    // dQ/dw .. dQ/dz, halved, by rows.
    let derivatives = [
        [[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]],
        [[0.0, y, z], [y, -2.0 * x, -w], [z, w, -2.0 * x]],
        [[-2.0 * y, x, w], [x, 0.0, z], [-w, z, -2.0 * y]],
        [[-2.0 * z, -w, x], [w, -2.0 * z, y], [x, y, 0.0]],
    ];
    let unit = derivatives.map(|rows| (0..9).map(|i| 2.0 * rows[i / 3][i % 3] * dq.col(i % 3)[i / 3]).sum::<f64>());
    let q = [w, x, y, z];
    // d(q / |q|) = (1 - q q^T) dq / |q|.
    std::array::from_fn(|i| (0..4).map(|j| (f64::from(i == j) - q[i] * q[j]) * unit[j]).sum::<f64>() / norm)
}
