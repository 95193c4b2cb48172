//! Metrics of pictures, depth, velocity, masks and poses, all in f64.
//!
//! Pictures are `[pixels, 3]` in 0..1; values outside are clamped before they are compared. A mask has
//! one entry per pixel. A metric over no pixel is `None`.

use glam::{DMat3, DVec3};

/// PSNR of equal pictures is infinite; this is what is reported instead, the error of a picture that is
/// off by 1e-5.
pub const MAX_PSNR: f64 = 100.0;

/// Pixels of `mask` that are set.
pub fn count(mask: &[bool]) -> usize {
    mask.iter().filter(|&&m| m).count()
}

/// -10 log10 of the mean squared error over all channels of all pixels, at most [`MAX_PSNR`] dB.
pub fn psnr(a: &[f32], b: &[f32]) -> Option<f64> {
    psnr_where(a, b, |_| true)
}

/// [`psnr`] over the pixels of a mask.
pub fn psnr_masked(a: &[f32], b: &[f32], mask: &[bool]) -> Option<f64> {
    assert_eq!(a.len(), 3 * mask.len(), "values and mask pixels");
    psnr_where(a, b, |pixel| mask[pixel])
}

fn psnr_where(a: &[f32], b: &[f32], keep: impl Fn(usize) -> bool) -> Option<f64> {
    assert_eq!(a.len(), b.len(), "values of the two pictures");
    let (mut sum, mut n) = (0.0, 0u64);
    for (pixel, (a, b)) in a.chunks_exact(3).zip(b.chunks_exact(3)).enumerate() {
        if keep(pixel) {
            for c in 0..3 {
                let d = f64::from(a[c].clamp(0.0, 1.0)) - f64::from(b[c].clamp(0.0, 1.0));
                sum += d * d;
            }
            n += 3;
        }
    }
    (n > 0).then(|| (-10.0 * (sum / n as f64).log10()).min(MAX_PSNR))
}

/// Errors of a depth map.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct DepthErrors {
    /// Root of the mean squared difference, scene units.
    pub rmse: f64,
    /// Mean of |predicted - true| / true.
    pub abs_rel: f64,
    /// Share of pixels with max(predicted / true, true / predicted) < 1.25.
    pub delta1: f64,
}

/// Errors of `scale * predicted` where the mask holds; the true depth must be positive there.
pub fn depth_errors(predicted: &[f32], truth: &[f32], mask: &[bool], scale: f64) -> Option<DepthErrors> {
    assert!(predicted.len() == mask.len() && truth.len() == mask.len(), "pixels of depth maps and mask");
    let (mut square, mut relative, mut close, mut n) = (0.0, 0.0, 0u64, 0u64);
    for i in (0..mask.len()).filter(|&i| mask[i]) {
        let (p, t) = (scale * f64::from(predicted[i]), f64::from(truth[i]));
        square += (p - t) * (p - t);
        relative += (p - t).abs() / t;
        // A predicted 0 (nothing there) makes the ratio infinite, which is not close.
        close += u64::from((p / t).max(t / p) < 1.25);
        n += 1;
    }
    let of = |sum: f64| sum / n as f64;
    (n > 0).then(|| DepthErrors { rmse: of(square).sqrt(), abs_rel: of(relative), delta1: of(close as f64) })
}

/// The factor that brings the median of the predicted depth to the median of the true one, over pixels of
/// the mask that have a prediction.
pub fn median_scale(predicted: &[f32], truth: &[f32], mask: &[bool]) -> Option<f64> {
    let both = |i: &usize| mask[*i] && predicted[*i] > 0.0;
    let p = median((0..mask.len()).filter(both).map(|i| f64::from(predicted[i])).collect())?;
    let t = median((0..mask.len()).filter(both).map(|i| f64::from(truth[i])).collect())?;
    Some(t / p)
}

/// The median; of an even number the mean of the two in the middle.
pub fn median(mut values: Vec<f64>) -> Option<f64> {
    if values.is_empty() {
        return None;
    }
    values.sort_by(f64::total_cmp);
    let mid = values.len() / 2;
    Some(if values.len() % 2 == 1 { values[mid] } else { 0.5 * (values[mid - 1] + values[mid]) })
}

/// Sum over the pixels of a mask of |predicted - true| and their number.
pub fn velocity_error(predicted: &[[f32; 3]], truth: &[[f32; 3]], mask: &[bool]) -> (f64, u64) {
    assert!(predicted.len() == mask.len() && truth.len() == mask.len(), "pixels of velocity maps and mask");
    (0..mask.len()).filter(|&i| mask[i]).fold((0.0, 0), |(sum, n), i| {
        let d = vec3(predicted[i]) - vec3(truth[i]);
        (sum + d.length(), n + 1)
    })
}

/// f32 triple as a vector.
pub fn vec3(v: [f32; 3]) -> DVec3 {
    DVec3::from_array(v.map(f64::from))
}

/// Pixels in both masks and pixels in either.
pub fn overlap(a: &[bool], b: &[bool]) -> (u64, u64) {
    assert_eq!(a.len(), b.len(), "pixels of the two masks");
    a.iter().zip(b).fold((0, 0), |(both, either), (&a, &b)| (both + u64::from(a & b), either + u64::from(a | b)))
}

/// Angle of the rotation between two rotations, degrees.
pub fn rotation_error_deg(a: &DMat3, b: &DMat3) -> f64 {
    let d = a.transpose() * *b;
    // Sine and cosine together are accurate at every angle; the trace alone is not near 0.
    let sine = 0.5 * DVec3::new(d.y_axis.z - d.z_axis.y, d.z_axis.x - d.x_axis.z, d.x_axis.y - d.y_axis.x).length();
    let cosine = 0.5 * (d.x_axis.x + d.y_axis.y + d.z_axis.z - 1.0);
    sine.atan2(cosine).to_degrees()
}

/// Angle between two directions, degrees; `None` when one has no length.
pub fn direction_error_deg(a: DVec3, b: DVec3) -> Option<f64> {
    (a.length() > 0.0 && b.length() > 0.0).then(|| a.cross(b).length().atan2(a.dot(b)).to_degrees())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn psnr_of_a_known_error() {
        let a = [0.5f32; 12];
        let b = [0.6f32; 12];
        assert!((psnr(&a, &b).unwrap() - 20.0).abs() < 1e-5);
        assert_eq!(psnr(&a, &a), Some(MAX_PSNR));
        assert_eq!(psnr(&[], &[]), None);
        // Clamped: 1.7 is white.
        assert_eq!(psnr(&[1.7; 3], &[1.0; 3]), Some(MAX_PSNR));
        let mut b = a;
        b[3..6].fill(0.6);
        assert!((psnr_masked(&a, &b, &[false, true, false, false]).unwrap() - 20.0).abs() < 1e-5);
        assert!((psnr(&a, &b).unwrap() - (20.0 + 10.0 * 4.0f64.log10())).abs() < 1e-5);
        assert_eq!(psnr_masked(&a, &b, &[false; 4]), None);
    }

    #[test]
    fn depth_errors_by_hand() {
        let (p, t, all) = ([2.0, 5.0, 0.0], [4.0, 4.0, 10.0], [true, true, false]);
        let e = depth_errors(&p, &t, &all, 1.0).unwrap();
        assert_eq!((e.rmse, e.abs_rel, e.delta1), (2.5f64.sqrt(), 0.375, 0.0));
        assert_eq!(depth_errors(&p, &t, &[true; 3], 1.0).unwrap().abs_rel, (0.5 + 0.25 + 1.0) / 3.0);
        assert_eq!(depth_errors(&p, &t, &[false; 3], 1.0), None);
        // Medians 3.5 and 4 of the pixels that have a prediction.
        assert_eq!(median_scale(&p, &t, &[true; 3]), Some(4.0 / 3.5));
        let doubled: Vec<f32> = t.iter().map(|d| 2.0 * d).collect();
        let scale = median_scale(&doubled, &t, &[true; 3]).unwrap();
        let e = depth_errors(&doubled, &t, &[true; 3], scale).unwrap();
        assert_eq!((e.rmse, e.abs_rel, e.delta1), (0.0, 0.0, 1.0));
    }

    #[test]
    fn angles_are_accurate_when_small() {
        let turn = |a: f64| DMat3::from_axis_angle(DVec3::new(1.0, 2.0, -0.5).normalize(), a);
        for degrees in [0.0f64, 1e-6, 0.03, 90.0, 179.9] {
            let base = turn(0.4);
            let other = turn(0.4 + degrees.to_radians());
            assert!((rotation_error_deg(&base, &other) - degrees).abs() < 1e-9, "{degrees}");
        }
        assert!((direction_error_deg(DVec3::X, DVec3::new(1.0, 1.0, 0.0)).unwrap() - 45.0).abs() < 1e-12);
        assert_eq!(direction_error_deg(DVec3::ZERO, DVec3::X), None);
    }

    #[test]
    fn masks_and_velocities() {
        assert_eq!(overlap(&[true, true, false], &[true, false, false]), (1, 2));
        let (sum, n) =
            velocity_error(&[[1.0, 0.0, 0.0], [9.0, 9.0, 9.0]], &[[1.0, 3.0, 4.0], [0.0; 3]], &[true, false]);
        assert_eq!((sum, n), (5.0, 1));
    }
}
