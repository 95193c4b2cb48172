//! From the pixels' sums of a Gaussian to the gradients of its fields and of the camera.
//!
//! With L = [[cx, dy], [0, ar]] of the record, (d, e) = L (X - u, Y - v) and L^T L = log2(e)/2 S2^-1, so
//!
//! ```text
//! dL/d(u, v) = 2 ln 2 L^T (sum h d, sum h e)         dL/dS2 = 2 ln^2 2 L^T [sum h (d, e)(d, e)^T] L
//! dL/do      = (sum h) / o                           dL/dz  = sum w dL/dD
//! ```
//!
//! and on through S = M M^T, M = J R^T Q diag(s), as in [`crate::project`]. f64, one Gaussian at a time: it runs once per
//! Gaussian that is seen, not per pixel.

use std::f64::consts::LN_2;

use glam::DVec3;
use sf_formats::scene::Gaussians;

use crate::blend_back::SUMS;
use crate::project::{AA_FLOOR, Projector, SCALE_RANGE};

/// dL/d of one Gaussian's fields.
pub(crate) struct Gradient {
    pub(crate) mean: DVec3,
    pub(crate) scale: [f64; 3],
    pub(crate) quat: [f64; 4],
    pub(crate) opacity: f64,
    pub(crate) colour: [f64; 3],
    /// dL/d(camera coordinates of the mean).
    camera: DVec3,
    /// dL/d(world to camera rotation) through the covariance, by rows.
    rotation: [DVec3; 3],
}

impl Gradient {
    /// Adds what moves the camera to dL/d(rows of the world-to-camera matrix).
    pub(crate) fn add_view(&self, mean: [f32; 3], view: &mut [[f64; 4]; 3]) {
        for (row, to) in view.iter_mut().enumerate() {
            for j in 0..3 {
                to[j] += self.camera[row] * f64::from(mean[j]) + self.rotation[row][j];
            }
            to[3] += self.camera[row];
        }
    }
}

impl Projector {
    /// Gaussian `i`, which was drawn, from its sums over the image.
    pub(crate) fn backward(&self, scene: &Gaussians, i: usize, sums: &[f64; SUMS]) -> Gradient {
        let [h, hd, hdd, he, hde, hee, red, green, blue, depth] = *sums;
        let p = self.world_to_camera * (DVec3::from_array(scene.mean[i].map(f64::from)) - self.centre);
        let given = scene.scale[i].map(f64::from);
        let scale = given.map(|s| s.clamp(SCALE_RANGE.0.into(), SCALE_RANGE.1.into()));
        let norm = scene.quat[i].iter().map(|&q| f64::from(q) * f64::from(q)).sum::<f64>().sqrt();
        let [w, x, y, z] = scene.quat[i].map(|q| f64::from(q) / norm);

        // Forward once more.
        let columns = [
            DVec3::new(1.0 - 2.0 * (y * y + z * z), 2.0 * (x * y + w * z), 2.0 * (x * z - w * y)),
            DVec3::new(2.0 * (x * y - w * z), 1.0 - 2.0 * (x * x + z * z), 2.0 * (y * z + w * x)),
            DVec3::new(2.0 * (x * z + w * y), 2.0 * (y * z - w * x), 1.0 - 2.0 * (x * x + y * y)),
        ];
        let over_z = 1.0 / p.z;
        let k = &self.camera.k;
        let (fx, fy) = (k.fx * over_z, k.fy * over_z);
        let ray = (p.x * over_z, p.y * over_z);
        let tx = ray.0.clamp(self.clamp_x.0, self.clamp_x.1);
        let ty = ray.1.clamp(self.clamp_y.0, self.clamp_y.1);
        let rows = [0, 1, 2].map(|r| self.world_to_camera.row(r));
        let jx = fx * (rows[0] - tx * rows[2]);
        let jy = fy * (rows[1] - ty * rows[2]);
        let (jq, kq) = (columns.map(|q| jx.dot(q)), columns.map(|q| jy.dot(q)));
        let a = DVec3::new(jq[0] * scale[0], jq[1] * scale[1], jq[2] * scale[2]);
        let b = DVec3::new(kq[0] * scale[0], kq[1] * scale[1], kq[2] * scale[2]);
        let eps = f64::from(self.settings.eps2d);
        let (xx, xy, yy, before) = (a.dot(a), a.dot(b), b.dot(b), a.cross(b).length_squared());
        let det = before + eps * (xx + yy) + eps * eps;
        let (sxx, syy) = (xx + eps, yy + eps);
        let half_log2e = 0.5 * std::f64::consts::LOG2_E;
        let (cx, ar) = ((half_log2e * syy / det).sqrt(), (half_log2e / syy).sqrt());
        let dy = -cx * (xy / syy);

        // dL/dS2 as the symmetric matrix G with dL = sum of G_ij dS_ij, and dL/d(u, v).
        let form = 2.0 * LN_2 * LN_2;
        let mut gxx = form * (hdd * cx * cx);
        let mut gxy = form * cx * (hdd * dy + hde * ar);
        let mut gyy = form * (hdd * dy * dy + 2.0 * hde * dy * ar + hee * ar * ar);
        let (du, dv) = (2.0 * LN_2 * cx * hd, 2.0 * LN_2 * (dy * hd + ar * he));
        // h is dL/d ln(opacity). Antialiasing multiplies it by sqrt(det S / det S2), down to a floor.
        if self.settings.aa && before > AA_FLOOR * AA_FLOOR * det {
            let (s, s2) = (0.5 * h / before, 0.5 * h / det);
            gxx += s * yy - s2 * syy;
            gyy += s * xx - s2 * sxx;
            gxy -= s * xy - s2 * xy;
        }
        let opacity = f64::from(scene.opacity[i]);

        // S = M M^T, rows a and b.
        let da = 2.0 * (gxx * a + gxy * b);
        let db = 2.0 * (gxy * a + gyy * b);
        let (mut djx, mut djy) = (DVec3::ZERO, DVec3::ZERO);
        let mut dq = [DVec3::ZERO; 3];
        let mut dscale = [0.0; 3];
        for c in 0..3 {
            dscale[c] = if given[c] == scale[c] { da[c] * jq[c] + db[c] * kq[c] } else { 0.0 };
            djx += scale[c] * da[c] * columns[c];
            djy += scale[c] * db[c] * columns[c];
            dq[c] = scale[c] * (da[c] * jx + db[c] * jy);
        }

        // J and the centre.
        let mut dp = DVec3::new(du * fx, dv * fy, 0.0);
        dp.z = depth - (dp.x * ray.0 + dp.y * ray.1) - (djx.dot(jx) + djy.dot(jy)) * over_z;
        let (dtx, dty) = (-fx * djx.dot(rows[2]), -fy * djy.dot(rows[2]));
        if tx == ray.0 {
            dp.x += dtx * over_z;
            dp.z -= dtx * ray.0 * over_z;
        }
        if ty == ray.1 {
            dp.y += dty * over_z;
            dp.z -= dty * ray.1 * over_z;
        }

        Gradient {
            mean: self.world_to_camera.transpose() * dp,
            scale: dscale,
            quat: quaternion([w, x, y, z], norm, &dq),
            opacity: if (0.0..=1.0).contains(&opacity) { h / opacity } else { 0.0 },
            colour: [red, green, blue],
            camera: dp,
            rotation: [fx * djx, fy * djy, -(fx * tx) * djx - (fy * ty) * djy],
        }
    }
}

/// dL/d of a quaternion of length `norm` and direction `q` from dL/d(columns of its matrix).
fn quaternion(q: [f64; 4], norm: f64, dq: &[DVec3; 3]) -> [f64; 4] {
    let [w, x, y, z] = q;
    let [a, b, c] = *dq;
    let unit = [
        2.0 * (x * (b.z - c.y) + y * (c.x - a.z) + z * (a.y - b.x)),
        2.0 * (y * (a.y + b.x) + z * (a.z + c.x) + w * (b.z - c.y)) - 4.0 * x * (b.y + c.z),
        2.0 * (x * (a.y + b.x) + z * (b.z + c.y) + w * (c.x - a.z)) - 4.0 * y * (a.x + c.z),
        2.0 * (x * (a.z + c.x) + y * (b.z + c.y) + w * (a.y - b.x)) - 4.0 * z * (a.x + b.y),
    ];
    // The length does not matter: only what turns the direction does.
    let along: f64 = (0..4).map(|i| unit[i] * q[i]).sum();
    std::array::from_fn(|i| (unit[i] - along * q[i]) / norm)
}
