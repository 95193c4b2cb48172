//! One model's predictions against another's on the same clips: what quantization (or any other change) costs.
//!
//! A is the reference. Nothing is aligned: both see the same frames, and their worlds start at the same camera.
//!
//! | output | meaning |
//! |---|---|
//! | `depth_absrel`, `depth_absrel_p99` | \|b - a\| / a of the depth, mean and 99th percentile over pixels |
//! | `depth_log_rmse` | root of the mean squared difference of ln depth |
//! | `rotation_deg_median`, `rotation_deg_p99` | angle between the poses of a frame relative to the first frame, over frames |
//! | `translation_deg_median` | angle between the directions of translation from the first frame |
//! | `translation_scale` | median of \|ln\| of the ratio of those translations' lengths |
//! | `focal_rel` | largest \|b - a\| / a of the focal lengths |
//! | `velocity_epe`, `velocity_epe_rel` | \|b - a\| of the velocity on pixels that are dynamic in A, units per second; and over the mean \|a\| there |
//! | `velocity_gate` | the smaller of `velocity_epe` / 0.10 and `velocity_epe_rel` / 0.02 |
//! | `dynamic_flip_fraction` | share of pixels whose dynamic probability crosses the threshold |
//! | `false_motion_fraction` | share of the pixels static in A that B moves by more than 0.1 units per second |
//! | `opacity_p99`, `colour_p99`, `scale_log_p99` | 99th percentiles of the differences of the Gaussians |
//! | `render_psnr_db`, `render_psnr_dynamic_db`, `render_psnr_worst_db` | pictures of both scenes, each with its own cameras (as they are evaluated), at the frames' times and halfway between: all pixels, pixels dynamic in A (at the frames), the worst picture |
//! | `render_psnr_fixed_db` | the same with A's cameras for both: errors of B's poses show as shifts |
//! | `truth_psnr_fall`, `truth_psnr_dynamic_fall` | dB that B's pictures are farther than A's from the clip's own ones, mean over the frames: all pixels, pixels dynamic in A; below 0 where B is nearer |

use crate::metrics;
use glam::DVec3;
use sf_formats::scene::{Compose, Gaussians, Scene};
use sf_formats::{Camera, Intrinsics, Pose, Result};
use sf_splat::{RenderOptions, Rendered, Renderer};

/// What a model says about a clip. Per-pixel values hold frame after frame.
#[derive(Clone, Copy, Debug)]
pub struct Side<'a> {
    /// Camera to world.
    pub poses: &'a [Pose],
    /// Intrinsics of every frame.
    pub k: &'a [Intrinsics],
    /// z-depth.
    pub depth: &'a [f32],
    /// Velocity towards later times.
    pub v_fwd: &'a [[f32; 3]],
    /// Velocity towards earlier times.
    pub v_bwd: &'a [[f32; 3]],
    /// Dynamic probability.
    pub dynamic: &'a [f32],
    /// Opacity.
    pub opacity: &'a [f32],
    /// Linear RGB.
    pub colour: &'a [[f32; 3]],
    /// Standard deviations.
    pub scale: &'a [[f32; 3]],
    /// The scene made of it.
    pub scene: &'a Scene,
}

/// Bins of a histogram of magnitudes: 64 per factor of ten from 1e-9 to 1e3.
const BINS: usize = 12 * 64;

/// Mean and percentiles of many magnitudes in little memory; a percentile is exact to 4 %.
#[derive(Clone, Debug)]
struct Magnitudes {
    sum: f64,
    squares: f64,
    count: u64,
    bins: Vec<u64>,
}

impl Default for Magnitudes {
    fn default() -> Self {
        Magnitudes { sum: 0.0, squares: 0.0, count: 0, bins: vec![0; BINS + 1] }
    }
}

impl Magnitudes {
    fn add(&mut self, v: f64) {
        self.sum += v;
        self.squares += v * v;
        self.count += 1;
        let bin = if v > 1e-9 { ((v.log10() + 9.0) * 64.0).ceil().clamp(1.0, BINS as f64) as usize } else { 0 };
        self.bins[bin] += 1;
    }

    fn mean(&self) -> Option<f64> {
        (self.count > 0).then(|| self.sum / self.count as f64)
    }

    fn rms(&self) -> Option<f64> {
        (self.count > 0).then(|| (self.squares / self.count as f64).sqrt())
    }

    /// The smallest bin's upper end with at least `share` of the values at or below it.
    fn percentile(&self, share: f64) -> Option<f64> {
        let mut seen = 0;
        let bin = self.bins.iter().position(|n| {
            seen += n;
            seen as f64 >= share * self.count as f64
        })?;
        (self.count > 0).then(|| if bin == 0 { 0.0 } else { 10f64.powf(bin as f64 / 64.0 - 9.0) })
    }
}

/// A sum of squared errors of colours and their number.
#[derive(Clone, Copy, Debug, Default)]
struct Picture {
    squares: f64,
    count: u64,
}

impl Picture {
    /// Over the pixels that `keep` takes.
    fn of(a: &Rendered, b: &Rendered, keep: impl Fn(usize) -> bool) -> Picture {
        let mut sum = Picture::default();
        for (i, (a, b)) in a.rgb.as_chunks::<3>().0.iter().zip(b.rgb.as_chunks::<3>().0).enumerate() {
            if keep(i) {
                for c in 0..3 {
                    let d = f64::from(a[c].clamp(0.0, 1.0)) - f64::from(b[c].clamp(0.0, 1.0));
                    sum.squares += d * d;
                }
                sum.count += 3;
            }
        }
        sum
    }

    fn add(&mut self, other: Picture) {
        self.squares += other.squares;
        self.count += other.count;
    }

    fn db(&self) -> Option<f64> {
        (self.count > 0).then(|| (-10.0 * (self.squares / self.count as f64).log10()).min(metrics::MAX_PSNR))
    }
}

/// Differences gathered over clips.
#[derive(Clone, Debug, Default)]
pub struct Comparison {
    depth: Magnitudes,
    log_depth: Magnitudes,
    rotation: Vec<f64>,
    direction: Vec<f64>,
    length: Vec<f64>,
    focal: f64,
    velocity: Magnitudes,
    speed: Magnitudes,
    flips: u64,
    still: u64,
    moved: u64,
    pixels: u64,
    opacity: Magnitudes,
    colour: Magnitudes,
    scale: Magnitudes,
    full: Picture,
    dynamic: Picture,
    worst: Option<f64>,
    fixed: Picture,
    /// dB to the clip's pictures, A's minus B's, one per frame: all pixels, dynamic ones.
    fall: [Vec<f64>; 2],
}

impl Comparison {
    /// Takes a clip in; both sides have the same frames and sizes. `pictures`: the clip's own, RGB bytes of all frames at
    /// that size.
    pub fn add(&mut self, a: &Side, b: &Side, pictures: &[u8], renderer: &mut Renderer) -> Result<()> {
        assert!(a.depth.len() == b.depth.len() && a.poses.len() == b.poses.len(), "sizes of the two sides");
        for (&a, &b) in a.depth.iter().zip(b.depth) {
            let (a, b) = (f64::from(a), f64::from(b));
            // Depths are exponentials or clipped sky: positive on both sides.
            if a > 0.0 && b > 0.0 {
                self.depth.add((b - a).abs() / a);
                self.log_depth.add((b / a).ln());
            }
        }
        self.add_cameras(a, b);
        self.add_motion(a, b);
        for (a, b) in a.opacity.iter().zip(b.opacity) {
            self.opacity.add(f64::from(a - b).abs());
        }
        for (a, b) in a.colour.as_flattened().iter().zip(b.colour.as_flattened()) {
            self.colour.add(f64::from(a - b).abs());
        }
        for (&a, &b) in a.scale.as_flattened().iter().zip(b.scale.as_flattened()) {
            if a > 0.0 && b > 0.0 {
                self.scale.add((f64::from(b) / f64::from(a)).ln().abs());
            }
        }
        self.add_pictures(a, b, pictures, renderer)
    }

    fn add_cameras(&mut self, a: &Side, b: &Side) {
        let (first_a, first_b) = (a.poses[0].inverse(), b.poses[0].inverse());
        for (a, b) in a.poses.iter().zip(b.poses).skip(1) {
            let (a, b) = (first_a.then(a), first_b.then(b));
            self.rotation.push(metrics::rotation_error_deg(&a.r, &b.r));
            self.direction.extend(metrics::direction_error_deg(b.t, a.t));
            let ratio = b.t.length() / a.t.length();
            if ratio.is_finite() && ratio > 0.0 {
                self.length.push(ratio.ln().abs());
            }
        }
        for (a, b) in a.k.iter().zip(b.k) {
            for (a, b) in [(a.fx, b.fx), (a.fy, b.fy)] {
                self.focal = self.focal.max((b - a).abs() / a);
            }
        }
    }

    fn add_motion(&mut self, a: &Side, b: &Side) {
        let tau = a.scene.compose.tau;
        let vector = |v: [f32; 3]| DVec3::from_array(v.map(f64::from));
        for i in 0..a.dynamic.len() {
            let (moves_a, moves_b) = (a.dynamic[i] >= tau, b.dynamic[i] >= tau);
            self.pixels += 1;
            self.flips += u64::from(moves_a != moves_b);
            if moves_a {
                for (a, b) in [(a.v_fwd[i], b.v_fwd[i]), (a.v_bwd[i], b.v_bwd[i])] {
                    self.velocity.add((vector(b) - vector(a)).length());
                    self.speed.add(vector(a).length());
                }
            } else {
                self.still += 1;
                let fast = [b.v_fwd[i], b.v_bwd[i]].into_iter().any(|v| vector(v).length() > 0.1);
                self.moved += u64::from(moves_b && fast);
            }
        }
    }

    fn add_pictures(&mut self, a: &Side, b: &Side, pictures: &[u8], renderer: &mut Renderer) -> Result<()> {
        let frames = &a.scene.frames;
        let mut times: Vec<(f64, Option<usize>)> = frames.iter().enumerate().map(|(f, s)| (s.time, Some(f))).collect();
        times.extend(frames.windows(2).map(|pair| (0.5 * (pair[0].time + pair[1].time), None)));
        let mut gaussians = Gaussians::default();
        let mut drawn = [Rendered::default(), Rendered::default(), Rendered::default()];
        for (time, frame) in times {
            let camera = |scene: &Scene| -> Result<Camera> {
                match frame {
                    Some(f) => Ok(scene.frames[f].camera),
                    None => scene.camera_at(time),
                }
            };
            let (camera_a, camera_b) = (camera(a.scene)?, camera(b.scene)?);
            for ((side, camera), drawn) in [(a, camera_a), (b, camera_b), (b, camera_a)].into_iter().zip(&mut drawn) {
                let rules: &Compose = &side.scene.compose;
                side.scene.at_into(time, rules, &mut gaussians)?;
                let options = RenderOptions::default();
                renderer.render_into(&gaussians, &camera, &side.scene.splat, &options, drawn)?;
            }
            let pixels = camera_a.width as usize * camera_a.height as usize;
            let known = a.dynamic.len() == frames.len() * pixels;
            let moving = |i: usize| known && frame.is_some_and(|f| a.dynamic[f * pixels + i] >= a.scene.compose.tau);
            let [own, fixed] = [1, 2].map(|of| Picture::of(&drawn[0], &drawn[of], |_| true));
            self.dynamic.add(Picture::of(&drawn[0], &drawn[1], moving));
            self.full.add(own);
            self.fixed.add(fixed);
            if let Some(truth) = frame.and_then(|f| pictures.get(3 * f * pixels..3 * (f + 1) * pixels)) {
                let falls =
                    [fall((&drawn[0], &drawn[1]), truth, |_| true), fall((&drawn[0], &drawn[1]), truth, moving)];
                self.fall.iter_mut().zip(falls).for_each(|(all, fall)| all.extend(fall));
            }
            let db = own.db().unwrap_or(metrics::MAX_PSNR);
            self.worst = Some(self.worst.map_or(db, |w| w.min(db)));
        }
        Ok(())
    }

    /// Every output under its key; `None` where there is nothing to measure, as the velocity without a dynamic
    /// pixel.
    pub fn outputs(&self) -> Vec<(&'static str, Option<f64>)> {
        let share = |part: u64, whole: u64| (whole > 0).then(|| part as f64 / whole as f64);
        let epe = self.velocity.mean();
        let relative = self.speed.mean().filter(|&s| s > 0.0).and_then(|s| Some(epe? / s));
        vec![
            ("depth_absrel", self.depth.mean()),
            ("depth_absrel_p99", self.depth.percentile(0.99)),
            ("depth_log_rmse", self.log_depth.rms()),
            ("rotation_deg_median", metrics::median(self.rotation.clone())),
            ("rotation_deg_p99", percentile(&self.rotation, 0.99)),
            ("translation_deg_median", metrics::median(self.direction.clone())),
            ("translation_scale", metrics::median(self.length.clone())),
            ("focal_rel", Some(self.focal)),
            ("velocity_epe", epe),
            ("velocity_epe_rel", relative),
            ("velocity_gate", epe.map(|e| (e / 0.10).min(relative.map_or(f64::INFINITY, |r| r / 0.02)))),
            ("dynamic_flip_fraction", share(self.flips, self.pixels)),
            ("false_motion_fraction", share(self.moved, self.still)),
            ("opacity_p99", self.opacity.percentile(0.99)),
            ("colour_p99", self.colour.percentile(0.99)),
            ("scale_log_p99", self.scale.percentile(0.99)),
            ("render_psnr_db", self.full.db()),
            ("render_psnr_dynamic_db", self.dynamic.db()),
            ("render_psnr_worst_db", self.worst),
            ("render_psnr_fixed_db", self.fixed.db()),
            ("truth_psnr_fall", mean(&self.fall[0])),
            ("truth_psnr_dynamic_fall", mean(&self.fall[1])),
        ]
    }
}

/// dB to the true picture, A's minus B's, over the pixels that `keep` takes.
fn fall((a, b): (&Rendered, &Rendered), truth: &[u8], keep: impl Fn(usize) -> bool) -> Option<f64> {
    let error = |drawn: &Rendered| {
        let pairs = drawn.rgb.as_chunks::<3>().0.iter().zip(truth.as_chunks::<3>().0);
        pairs.enumerate().filter(|(i, _)| keep(*i)).fold((0.0, 0u64), |(sum, n), (_, (have, want))| {
            let of = |c: usize| (f64::from(have[c].clamp(0.0, 1.0)) - f64::from(want[c]) / 255.0).powi(2);
            (sum + of(0) + of(1) + of(2), n + 3)
        })
    };
    let db = |(sum, n): (f64, u64)| (n > 0).then(|| (-10.0 * (sum / n as f64).log10()).min(metrics::MAX_PSNR));
    Some(db(error(a))? - db(error(b))?)
}

fn mean(values: &[f64]) -> Option<f64> {
    (!values.is_empty()).then(|| values.iter().sum::<f64>() / values.len() as f64)
}

/// The value with at least `share` of the list at or below it.
fn percentile(values: &[f64], share: f64) -> Option<f64> {
    let mut sorted = values.to_vec();
    sorted.sort_by(f64::total_cmp);
    let rank = (share * sorted.len() as f64).ceil() as usize;
    sorted.get(rank.clamp(1, sorted.len().max(1)) - 1).copied()
}

/// A bound on an output.
#[derive(Clone, Debug, PartialEq)]
pub struct Gate {
    /// Key of the output.
    pub key: String,
    /// Smallest value of a `_db` output, largest of any other.
    pub limit: f64,
}

/// What an int8 model has to keep against its own f32 form.
pub const INT8_GATES: [(&str, f64); 14] = [
    ("depth_absrel", 0.01),
    ("depth_log_rmse", 0.015),
    ("rotation_deg_median", 0.06),
    ("rotation_deg_p99", 0.3),
    ("translation_deg_median", 0.3),
    ("translation_scale", 0.006),
    ("velocity_gate", 1.0),
    ("dynamic_flip_fraction", 0.003),
    ("false_motion_fraction", 0.002),
    ("render_psnr_db", 45.0),
    ("render_psnr_dynamic_db", 42.0),
    ("render_psnr_worst_db", 38.0),
    ("truth_psnr_fall", 0.10),
    ("truth_psnr_dynamic_fall", 0.15),
];

impl Gate {
    /// Whether more is better.
    fn at_least(&self) -> bool {
        self.key.ends_with("_db")
    }

    /// The outputs' value over the limit (for decibels as a ratio of amplitudes): at most 1 passes. 0 where there is
    /// nothing to measure or B is the better one; infinite for a value that is no number.
    pub fn load(&self, outputs: &[(&'static str, Option<f64>)]) -> f64 {
        let Some(value) = outputs.iter().find(|(k, _)| *k == self.key).and_then(|(_, v)| *v) else { return 0.0 };
        let load = if self.at_least() { 10f64.powf((self.limit - value) / 20.0) } else { value / self.limit };
        if load.is_nan() { f64::INFINITY } else { load.max(0.0) }
    }

    /// As text: `depth_absrel <= 0.01`.
    pub fn describe(&self) -> String {
        format!("{} {} {}", self.key, if self.at_least() { ">=" } else { "<=" }, self.limit)
    }
}

/// Agreement of one stage.
#[derive(Clone, Copy, Debug, Default)]
pub struct StageMatch {
    ab: f64,
    aa: f64,
    bb: f64,
    error: f64,
    lowest: Option<f64>,
}

impl StageMatch {
    /// Takes values in; rows of `width` are tokens.
    pub fn add(&mut self, a: &[f32], b: &[f32], width: usize) {
        assert_eq!(a.len(), b.len(), "values of a stage");
        for (a, b) in a.chunks(width.max(1)).zip(b.chunks(width.max(1))) {
            let (mut ab, mut aa, mut bb, mut error) = (0.0, 0.0, 0.0, 0.0);
            for (&a, &b) in a.iter().zip(b) {
                let (a, b) = (f64::from(a), f64::from(b));
                ab += a * b;
                aa += a * a;
                bb += b * b;
                error += (a - b) * (a - b);
            }
            if width >= 16 && aa > 0.0 && bb > 0.0 {
                let cosine = ab / (aa * bb).sqrt();
                self.lowest = Some(self.lowest.map_or(cosine, |l| l.min(cosine)));
            }
            (self.ab, self.aa, self.bb, self.error) = (self.ab + ab, self.aa + aa, self.bb + bb, self.error + error);
        }
    }

    /// Cosine between the two, over all values; 1 for two zeros.
    pub fn cosine(&self) -> f64 {
        let norms = (self.aa * self.bb).sqrt();
        if norms > 0.0 { self.ab / norms } else { f64::from(u8::from(self.aa == self.bb)) }
    }

    /// The lowest cosine of a token; `None` for stages that have none.
    pub fn lowest_cosine(&self) -> Option<f64> {
        self.lowest
    }

    /// Signal to error in dB, at most 300.
    pub fn sqnr_db(&self) -> f64 {
        if self.error == 0.0 { 300.0 } else { (10.0 * (self.aa / self.error).log10()).clamp(-300.0, 300.0) }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn percentiles_are_exact_to_a_bin() {
        let mut m = Magnitudes::default();
        (1..=1000).for_each(|i| m.add(f64::from(i) / 1000.0));
        m.add(0.0);
        for share in [0.5, 0.9, 0.99] {
            let p = m.percentile(share).unwrap();
            assert!((p / share - 1.0).abs() < 0.04, "{share} {p}");
        }
        assert!((m.mean().unwrap() - 0.5).abs() < 1e-3);
        assert_eq!(Magnitudes::default().percentile(0.5), None);
        assert_eq!(percentile(&[3.0, 1.0, 2.0], 0.99), Some(3.0));
        assert_eq!(percentile(&[], 0.99), None);
    }

    #[test]
    fn gates_know_their_direction() {
        let outputs = [
            ("depth_absrel", Some(0.005)),
            ("render_psnr_db", Some(51.0)),
            ("velocity_epe", None),
            ("focal_rel", Some(f64::NAN)),
            ("truth_psnr_fall", Some(-0.2)),
        ];
        let load = |key: &str, limit| Gate { key: key.into(), limit }.load(&outputs);
        assert_eq!(load("depth_absrel", 0.01), 0.5);
        assert!((load("render_psnr_db", 45.0) - 0.501).abs() < 1e-3);
        assert!(load("render_psnr_db", 57.1) > 1.99);
        assert_eq!((load("velocity_epe", 0.1), load("focal_rel", 0.1)), (0.0, f64::INFINITY));
        assert_eq!(load("truth_psnr_fall", 0.1), 0.0);
        for (key, _) in INT8_GATES {
            assert!(Comparison::default().outputs().iter().any(|(k, _)| *k == key), "{key}");
        }
    }

    #[test]
    fn a_picture_farther_from_the_truth_falls() {
        let drawn = |v: f32| Rendered { rgb: vec![v; 6], ..Rendered::default() };
        // Errors of 0.1 and 0.2 on a truth of 51 / 255 = 0.2: a factor of two is 6.02 dB.
        let (a, b, truth) = (drawn(0.3), drawn(0.4), [51; 6]);
        assert!((fall((&a, &b), &truth, |_| true).unwrap() - 6.0206).abs() < 1e-4);
        assert!((fall((&b, &a), &truth, |i| i == 1).unwrap() + 6.0206).abs() < 1e-4);
        assert_eq!(fall((&a, &b), &truth, |_| false), None);
    }

    #[test]
    fn stages_are_matched() {
        let mut s = StageMatch::default();
        let a: Vec<f32> = (0..32).map(|i| i as f32 - 10.0).collect();
        let b: Vec<f32> = a.iter().enumerate().map(|(i, v)| if i < 16 { *v } else { 1.01 * v }).collect();
        s.add(&a, &b, 16);
        assert!(s.cosine() > 0.9999 && s.cosine() < 1.0);
        assert!((s.lowest_cosine().unwrap() - 1.0).abs() < 1e-9);
        let want =
            10.0 * (a.iter().map(|v| v * v).sum::<f32>() / a[16..].iter().map(|v| 1e-4 * v * v).sum::<f32>()).log10();
        assert!((s.sqnr_db() - f64::from(want)).abs() < 1e-3, "{} {want}", s.sqnr_db());
        let mut zero = StageMatch::default();
        zero.add(&[0.0; 4], &[0.0; 4], 4);
        assert_eq!((zero.cosine(), zero.sqnr_db(), zero.lowest_cosine()), (1.0, 300.0, None));
    }
}
