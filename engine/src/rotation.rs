//! Nearest rotation to nine raw numbers (network specification 1.3, camera head).
//!
//! The nine numbers are read row-major as a 3x3 matrix, each row is L2-normalised, and the result M is
//! projected to SO(3): with M = A S B^T, R = A diag(1, 1, det(A B^T)) B^T, which is the rotation
//! nearest to M in the Frobenius norm. The determinant fix acts on the smallest singular value.
//!
//! Everything is f64 with a fixed sequence of operations and no library maths beyond `sqrt`, so the
//! same bits come out on every machine. B comes from cyclic Jacobi rotations of M^T M; A follows from
//! M B column by column, its third column as a cross product, which makes the determinant +1 by
//! construction and needs no division by the smallest singular value.

use glam::{DMat3, DQuat, DVec3};

/// Norm below which a row counts as zero, as in the public head (`normalize(..., eps = 1e-12)`).
const ROW_EPS: f64 = 1e-12;
/// Sweeps of the cyclic Jacobi method; 3x3 matrices converge to the last bit in five or six.
const SWEEPS: usize = 12;

/// Rotation nearest to the row-normalised matrix of `r` (row-major).
///
/// Zero rows are allowed; an all-zero input gives the identity.
pub(crate) fn from_nine(r: &[f32; 9]) -> DMat3 {
    let mut rows = [DVec3::ZERO; 3];
    for i in 0..3 {
        let v = DVec3::new(f64::from(r[3 * i]), f64::from(r[3 * i + 1]), f64::from(r[3 * i + 2]));
        rows[i] = v / v.length().max(ROW_EPS);
    }
    nearest(&DMat3::from_cols(rows[0], rows[1], rows[2]).transpose())
}

/// Rotation nearest to `m`; ties (repeated or zero singular values) are broken in a fixed way.
pub(crate) fn nearest(m: &DMat3) -> DMat3 {
    let b = right_vectors(m);
    // B must be a proper rotation so that A B^T is one; flipping its last column is free because A's
    // last column is the cross product of the first two.
    let b = if b.determinant() < 0.0 { DMat3::from_cols(b.x_axis, b.y_axis, -b.z_axis) } else { b };
    let mb = [*m * b.x_axis, *m * b.y_axis];
    let scale = mb[0].length();
    if scale <= ROW_EPS {
        return DMat3::IDENTITY;
    }
    let a0 = mb[0] / scale;
    let rest = mb[1] - a0 * a0.dot(mb[1]);
    let length = rest.length();
    let a1 = if length > 1e-14 * scale { rest / length } else { perpendicular(a0) };
    // A second projection removes what cancellation left in the first.
    let a1 = (a1 - a0 * a0.dot(a1)).normalize();
    let a = DMat3::from_cols(a0, a1, a0.cross(a1));
    a * b.transpose()
}

/// Any unit vector perpendicular to `v`, always the same one.
fn perpendicular(v: DVec3) -> DVec3 {
    let a = v.abs();
    let axis = if a.x <= a.y && a.x <= a.z {
        DVec3::X
    } else if a.y <= a.z {
        DVec3::Y
    } else {
        DVec3::Z
    };
    v.cross(axis).normalize()
}

/// Eigenvectors of M^T M as columns, largest eigenvalue first.
fn right_vectors(m: &DMat3) -> DMat3 {
    let g = m.transpose() * *m;
    let mut s: [[f64; 3]; 3] = std::array::from_fn(|i| std::array::from_fn(|j| g.col(j)[i]));
    let mut v = [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]];
    for _ in 0..SWEEPS {
        for (p, q) in [(0, 1), (0, 2), (1, 2)] {
            if s[p][q] == 0.0 {
                continue;
            }
            // Rutishauser's stable angle: t = sgn(theta) / (|theta| + sqrt(theta^2 + 1)).
            let theta = (s[q][q] - s[p][p]) / (2.0 * s[p][q]);
            let t = if theta.is_finite() { theta.signum() / (theta.abs() + (theta * theta + 1.0).sqrt()) } else { 0.0 };
            let c = 1.0 / (t * t + 1.0).sqrt();
            let d = t * c;
            let old = s;
            for k in 0..3 {
                s[k][p] = c * old[k][p] - d * old[k][q];
                s[k][q] = d * old[k][p] + c * old[k][q];
            }
            let old = s;
            for k in 0..3 {
                s[p][k] = c * old[p][k] - d * old[q][k];
                s[q][k] = d * old[p][k] + c * old[q][k];
            }
            s[p][q] = 0.0;
            s[q][p] = 0.0;
            let old = v;
            for k in 0..3 {
                v[k][p] = c * old[k][p] - d * old[k][q];
                v[k][q] = d * old[k][p] + c * old[k][q];
            }
        }
    }
    let mut order = [0usize, 1, 2];
    order.sort_by(|&i, &j| s[j][j].total_cmp(&s[i][i]));
    let col = |j: usize| DVec3::new(v[0][j], v[1][j], v[2][j]);
    DMat3::from_cols(col(order[0]), col(order[1]), col(order[2]))
}

/// Unit quaternion w, x, y, z of a rotation, with w >= 0.
pub(crate) fn quaternion(r: &DMat3) -> [f64; 4] {
    let q = DQuat::from_mat3(r).normalize();
    positive([q.w, q.x, q.y, q.z])
}

/// Hamilton product of quaternions w, x, y, z: the rotation `b`, then `a`.
pub(crate) fn multiply(a: [f64; 4], b: [f64; 4]) -> [f64; 4] {
    [
        a[0] * b[0] - a[1] * b[1] - a[2] * b[2] - a[3] * b[3],
        a[0] * b[1] + a[1] * b[0] + a[2] * b[3] - a[3] * b[2],
        a[0] * b[2] - a[1] * b[3] + a[2] * b[0] + a[3] * b[1],
        a[0] * b[3] + a[1] * b[2] - a[2] * b[1] + a[3] * b[0],
    ]
}

/// The same rotation with w >= 0.
pub(crate) fn positive(q: [f64; 4]) -> [f64; 4] {
    if q[0] < 0.0 { q.map(|v| -v) } else { q }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Small deterministic generator for test inputs, values in -1..1.
    fn noise(seed: &mut u64) -> f64 {
        *seed = seed.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
        ((*seed >> 11) as f64) / ((1u64 << 52) as f64) - 1.0
    }

    fn off(r: &DMat3) -> f64 {
        let e = *r * r.transpose() - DMat3::IDENTITY;
        e.to_cols_array().iter().fold((r.determinant() - 1.0).abs(), |a, v| a.max(v.abs()))
    }

    fn distance(a: &DMat3, b: &DMat3) -> f64 {
        (*a - *b).to_cols_array().iter().map(|v| v * v).sum::<f64>()
    }

    /// Self-check 7 of the network specification: random nine-vectors, both signs of the determinant.
    #[test]
    fn always_a_rotation_and_the_nearest_one() {
        let mut seed = 7;
        let mut negative = 0;
        for _ in 0..2000 {
            let nine: [f32; 9] = std::array::from_fn(|_| noise(&mut seed) as f32);
            let r = from_nine(&nine);
            assert!(off(&r) < 1e-12, "{nine:?}");
            let rows: [DVec3; 3] = std::array::from_fn(|i| {
                DVec3::new(f64::from(nine[3 * i]), f64::from(nine[3 * i + 1]), f64::from(nine[3 * i + 2])).normalize()
            });
            let m = DMat3::from_cols(rows[0], rows[1], rows[2]).transpose();
            negative += usize::from(m.determinant() < 0.0);
            // No small turn away from R comes nearer to M.
            let best = distance(&m, &r);
            for axis in [DVec3::X, DVec3::Y, DVec3::Z] {
                for angle in [-1e-3, 1e-3] {
                    assert!(distance(&m, &(DMat3::from_axis_angle(axis, angle) * r)) >= best - 1e-12);
                }
            }
        }
        assert!(negative > 500, "only {negative} inputs had a negative determinant");
    }

    #[test]
    fn rotations_stay_and_degenerate_inputs_are_defined() {
        let r = DMat3::from_axis_angle(DVec3::new(1.0, -2.0, 0.5).normalize(), 2.2);
        assert!(distance(&nearest(&r), &r) < 1e-28);
        // Reflection with three equal singular values: still a rotation.
        assert!(off(&nearest(&-DMat3::IDENTITY)) < 1e-14);
        assert_eq!(from_nine(&[0.0; 9]), DMat3::IDENTITY);
        // Zero rows, equal rows (rank one) and rank two.
        for nine in [
            [1.0, 2.0, 3.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0],
            [1.0, 2.0, 3.0, 1.0, 2.0, 3.0, 1.0, 2.0, 3.0],
            [1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 0.0],
            [1e-30, 0.0, 0.0, 0.0, 1e-30, 0.0, 0.0, 0.0, 1e-30],
        ] {
            let r = from_nine(&nine);
            assert!(off(&r) < 1e-12, "{nine:?}: {r:?}");
        }
        let r = from_nine(&[1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 0.0]);
        assert!(distance(&r, &DMat3::IDENTITY) < 1e-28, "{r:?}");
    }

    #[test]
    fn quaternions_compose_like_matrices() {
        let a = DMat3::from_axis_angle(DVec3::new(0.2, 1.0, -0.4).normalize(), 0.9);
        let b = DMat3::from_axis_angle(DVec3::new(-1.0, 0.3, 0.8).normalize(), -1.7);
        let q = positive(multiply(quaternion(&a), quaternion(&b)));
        let want = quaternion(&(a * b));
        assert!((0..4).all(|i| (q[i] - want[i]).abs() < 1e-14), "{q:?} {want:?}");
    }
}
