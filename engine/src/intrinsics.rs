//! Focal lengths from predicted rays (network specification 1.3, intrinsics).
//!
//! The network predicts local points (x, y, z) in camera axes. With X = x/z, Y = y/z and the principal
//! point at the image centre, least squares over all pixels gives
//!
//! fx = sum X (u + 0.5 - W/2) / sum X^2,   fy = sum Y (v + 0.5 - H/2) / sum Y^2.
//!
//! Sums are f64, pixel after pixel in memory order, one frame after the other: the same bits for any
//! number of threads.

use crate::dims::Dims;
use sf_formats::Intrinsics;
use sf_formats::config::{KSource, ModelConfig};
use sf_ops::trig;

/// What intrinsics can come from, strongest first: the user, the camera head, the rays.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Evidence<'a> {
    /// Given by the caller, at the network's size.
    pub(crate) user: Option<Intrinsics>,
    /// `[frames, 2]`: log(fx / W), log(fy / H).
    pub(crate) fov: Option<&'a [f32]>,
    /// `[frames, height, width, 3]`: local points.
    pub(crate) points: Option<&'a [f32]>,
}

/// Intrinsics of every frame into `out`; whether all of them were determined (see [`RayFit::solve`]).
pub(crate) fn choose(config: &ModelConfig, d: &Dims, evidence: Evidence, out: &mut [Intrinsics]) -> bool {
    let (h, w) = (d.height, d.width);
    if let Some(k) = evidence.user {
        out.fill(k);
        return true;
    }
    match (config.camera_k, evidence.fov, evidence.points) {
        (KSource::Fov, Some(fov), _) => {
            for (k, c) in out.iter_mut().zip(fov.chunks_exact(2)) {
                k.fx = w as f64 * trig::exp(f64::from(c[0]));
                k.fy = h as f64 * trig::exp(f64::from(c[1]));
                (k.cx, k.cy) = (w as f64 / 2.0, h as f64 / 2.0);
            }
            out.iter().all(|k| k.check("fov").is_ok())
        }
        (KSource::FitFrame, _, Some(points)) => {
            let mut determined = true;
            for (k, frame) in out.iter_mut().zip(points.chunks_exact(h * w * 3)) {
                let mut fit = RayFit::default();
                fit.add(frame, h, w);
                let (own, ok) = fit.solve(h, w);
                *k = own;
                determined &= ok;
            }
            determined
        }
        (_, _, Some(points)) => {
            let mut fit = RayFit::default();
            points.chunks_exact(h * w * 3).for_each(|frame| fit.add(frame, h, w));
            let (k, ok) = fit.solve(h, w);
            out.fill(k);
            ok
        }
        _ => unreachable!("a checked configuration has rays or a field of view"),
    }
}

/// Running sums of the fit.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub(crate) struct RayFit {
    xu: f64,
    xx: f64,
    yv: f64,
    yy: f64,
}

impl RayFit {
    /// Adds one frame's local points `[h, w, 3]`.
    pub(crate) fn add(&mut self, points: &[f32], h: usize, w: usize) {
        assert_eq!(points.len(), h * w * 3, "points of a {h}x{w} frame");
        for v in 0..h {
            // One row's sums first: shorter chains lose less, and the order stays fixed.
            let mut row = RayFit::default();
            let dv = v as f64 + 0.5 - h as f64 / 2.0;
            for u in 0..w {
                let p = &points[(v * w + u) * 3..][..3];
                let z = f64::from(p[2]);
                let (x, y) = (f64::from(p[0]) / z, f64::from(p[1]) / z);
                let du = u as f64 + 0.5 - w as f64 / 2.0;
                row.xu += x * du;
                row.xx += x * x;
                row.yv += y * dv;
                row.yy += y * y;
            }
            self.xu += row.xu;
            self.xx += row.xx;
            self.yv += row.yv;
            self.yy += row.yy;
        }
    }

    /// The fitted intrinsics, and whether the rays determined them.
    ///
    /// Rays that are all equal, mirrored or not finite give no usable focal length; then it is 0.8 of
    /// the longer side (a 64 degree view), and the second value is false.
    pub(crate) fn solve(&self, h: usize, w: usize) -> (Intrinsics, bool) {
        let centre = (w as f64 / 2.0, h as f64 / 2.0);
        let (fx, fy) = (self.xu / self.xx, self.yv / self.yy);
        let k = Intrinsics { fx, fy, cx: centre.0, cy: centre.1 };
        if k.check("fit").is_ok() {
            return (k, true);
        }
        let f = 0.8 * w.max(h) as f64;
        (Intrinsics { fx: f, fy: f, cx: centre.0, cy: centre.1 }, false)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn points(h: usize, w: usize, fx: f64, fy: f64) -> Vec<f32> {
        let mut out = Vec::new();
        for v in 0..h {
            for u in 0..w {
                let z = 2.0 + 0.1 * ((u * 7 + v * 3) % 11) as f64;
                let x = (u as f64 + 0.5 - w as f64 / 2.0) / fx * z;
                let y = (v as f64 + 0.5 - h as f64 / 2.0) / fy * z;
                out.extend([x as f32, y as f32, z as f32]);
            }
        }
        out
    }

    #[test]
    fn exact_rays_give_their_focal_lengths() {
        let mut fit = RayFit::default();
        fit.add(&points(28, 42, 51.0, 47.5), 28, 42);
        fit.add(&points(28, 42, 51.0, 47.5), 28, 42);
        let (k, ok) = fit.solve(28, 42);
        assert!(ok && (k.fx - 51.0).abs() < 1e-4 && (k.fy - 47.5).abs() < 1e-4, "{k:?}");
        assert_eq!((k.cx, k.cy), (21.0, 14.0));
    }

    #[test]
    fn useless_rays_are_reported() {
        for bad in [0.0, f32::NAN] {
            let mut fit = RayFit::default();
            fit.add(&[bad, bad, 1.0, bad, bad, 1.0], 1, 2);
            let (k, ok) = fit.solve(1, 2);
            assert!(!ok && k.fx == 1.6 && k.fy == 1.6);
        }
        let mut mirrored = RayFit::default();
        mirrored.add(&points(4, 4, -10.0, 10.0), 4, 4);
        assert!(!mirrored.solve(4, 4).1);
    }
}
