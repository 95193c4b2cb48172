//! The similarity transform between the world of predicted poses and the world of true ones.
//!
//! A pose-free model chooses its own world and, without metric training, its own unit. Rotation from the
//! rotations, unit and shift from the camera centres: unlike a fit to the centres alone this has one
//! answer when the camera drives straight or stands still.

use glam::{DMat3, DQuat, DVec3};
use sf_formats::Error;
use sf_formats::{Pose, Result};

/// X_true = scale * r * X_predicted + t.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Similarity {
    /// True units per predicted unit, positive.
    pub scale: f64,
    /// Rotation from the predicted to the true world.
    pub r: DMat3,
    /// Shift, true units.
    pub t: DVec3,
}

/// Centres closer to their mean than this share of a scene unit do not tell a scale.
const STANDING: f64 = 1e-3;

impl Similarity {
    /// The transform that brings predicted poses to the true poses of the same frames.
    ///
    /// Rotation: the mean of R_true R_predicted^T (as quaternions, of one sign). Scale: least squares of
    /// the rotated centres about their means, 1 when the cameras stand or the fit is not positive.
    pub fn fit(predicted: &[Pose], truth: &[Pose]) -> Result<Similarity> {
        let n = predicted.len();
        if n == 0 || n != truth.len() {
            return Err(Error::input(
                "alignment",
                format!("{n} predicted and {} true poses: the same number, at least one, is wanted", truth.len()),
            ));
        }
        let turns: Vec<DQuat> =
            predicted.iter().zip(truth).map(|(p, t)| DQuat::from_mat3(&(t.r * p.r.transpose()))).collect();
        let mean = turns
            .iter()
            .fold(DQuat::from_xyzw(0.0, 0.0, 0.0, 0.0), |sum, &q| sum + if q.dot(turns[0]) < 0.0 { -q } else { q });
        let r = DMat3::from_quat(mean.normalize());
        let centre = |poses: &[Pose]| poses.iter().map(|p| p.t).sum::<DVec3>() / n as f64;
        let (cp, ct) = (centre(predicted), centre(truth));
        let (mut along, mut square) = (0.0, 0.0);
        for (p, t) in predicted.iter().zip(truth) {
            let d = r * (p.t - cp);
            along += d.dot(t.t - ct);
            square += d.length_squared();
        }
        let moves = square > n as f64 * STANDING * STANDING && along > 0.0;
        let scale = if moves { along / square } else { 1.0 };
        Ok(Similarity { scale, r, t: ct - scale * (r * cp) })
    }

    /// A true pose in the predicted world.
    pub fn to_predicted(&self, truth: &Pose) -> Pose {
        let back = self.r.transpose();
        Pose { r: back * truth.r, t: back * (truth.t - self.t) / self.scale }
    }

    /// A predicted pose in the true world.
    pub fn to_truth(&self, predicted: &Pose) -> Pose {
        Pose { r: self.r * predicted.r, t: self.scale * (self.r * predicted.t) + self.t }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn pose(axis: DVec3, angle: f64, t: DVec3) -> Pose {
        Pose { r: DMat3::from_axis_angle(axis.normalize(), angle), t }
    }

    #[test]
    fn a_straight_drive_is_recovered() {
        let known = Similarity { scale: 2.5, r: pose(DVec3::new(1.0, -2.0, 0.3), 2.0, DVec3::ZERO).r, t: DVec3::ONE };
        let predicted: Vec<Pose> =
            (0..4).map(|i| pose(DVec3::Y, 0.02 * f64::from(i), DVec3::Z * f64::from(i))).collect();
        let truth: Vec<Pose> = predicted.iter().map(|p| known.to_truth(p)).collect();
        let fit = Similarity::fit(&predicted, &truth).unwrap();
        assert!((fit.scale - 2.5).abs() < 1e-12);
        assert!((fit.r - known.r).to_cols_array().iter().all(|e| e.abs() < 1e-12));
        for (p, t) in predicted.iter().zip(&truth) {
            assert!((fit.to_predicted(t).t - p.t).length() < 1e-12);
            assert!((fit.to_truth(p).t - t.t).length() < 1e-12);
        }
    }

    #[test]
    fn a_standing_camera_has_scale_one() {
        let poses = [pose(DVec3::Y, 0.1, DVec3::ONE); 3];
        let fit = Similarity::fit(&poses, &poses).unwrap();
        assert_eq!(fit.scale, 1.0);
        assert!(Similarity::fit(&poses, &poses[..2]).is_err() && Similarity::fit(&[], &[]).is_err());
    }
}
