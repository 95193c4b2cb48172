//! [`Scene`]: moving Gaussians with their cameras, and the composition at any time.

use crate::camera::Camera;
use crate::config::{Extrapolate, ModelConfig, SelfRule, Split};
use crate::error::{Error, Result};

/// Gaussians as structure of arrays; all vectors have the same length.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Gaussians {
    /// Centres, world axes, scene units.
    pub mean: Vec<[f32; 3]>,
    /// Standard deviations along the principal axes, scene units.
    pub scale: Vec<[f32; 3]>,
    /// Rotation w, x, y, z from principal to world axes; the rasterizer normalises.
    pub quat: Vec<[f32; 4]>,
    /// Opacity, 0..1.
    pub opacity: Vec<f32>,
    /// Linear RGB, nominally 0..1.
    pub colour: Vec<[f32; 3]>,
}

impl Gaussians {
    /// Number of Gaussians.
    pub fn len(&self) -> usize {
        self.mean.len()
    }

    /// Whether there are none.
    pub fn is_empty(&self) -> bool {
        self.mean.is_empty()
    }

    /// Forgets all, keeps the memory.
    pub fn clear(&mut self) {
        self.mean.clear();
        self.scale.clear();
        self.quat.clear();
        self.opacity.clear();
        self.colour.clear();
    }

    /// Makes room for `n` more.
    pub fn reserve(&mut self, n: usize) {
        self.mean.reserve(n);
        self.scale.reserve(n);
        self.quat.reserve(n);
        self.opacity.reserve(n);
        self.colour.reserve(n);
    }

    /// Appends Gaussian `i` of `other`, its centre moved by `shift` and its opacity times `weight`.
    pub fn push_from(&mut self, other: &Gaussians, i: usize, shift: [f32; 3], weight: f32) {
        let m = other.mean[i];
        self.mean.push([m[0] + shift[0], m[1] + shift[1], m[2] + shift[2]]);
        self.scale.push(other.scale[i]);
        self.quat.push(other.quat[i]);
        self.opacity.push(other.opacity[i] * weight);
        self.colour.push(other.colour[i]);
    }
}

/// Rasterizer conventions that belong to the weights, not to the view.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct SplatSettings {
    /// Antialiased opacity compensation.
    pub aa: bool,
    /// Largest alpha of one splat at a pixel.
    pub a_max: f32,
    /// Added to the diagonal of the 2-D covariance, pixels squared.
    pub eps2d: f32,
    /// Nearest z drawn.
    pub near: f32,
}

impl Default for SplatSettings {
    fn default() -> Self {
        SplatSettings { aa: false, a_max: 0.999, eps2d: 0.3, near: 0.01 }
    }
}

/// How the Gaussians that exist at a time are chosen (network specification, items 22 to 28).
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Compose {
    /// Source frames used either side of the time.
    pub window: u32,
    /// Own-frame rule exactly at an input time.
    pub own: SelfRule,
    /// Rule beyond the ends of the clip.
    pub extrapolate: Extrapolate,
    /// Static/dynamic separation.
    pub split: Split,
    /// Dynamic iff probability > tau.
    pub tau: f32,
}

impl Default for Compose {
    fn default() -> Self {
        Compose { window: 1, own: SelfRule::Own, extrapolate: Extrapolate::Mirror, split: Split::Hard, tau: 0.5 }
    }
}

impl Compose {
    /// The conventions of a model.
    pub fn of(config: &ModelConfig) -> Compose {
        Compose {
            window: config.render_window,
            own: config.render_self,
            extrapolate: config.render_extrapolate,
            split: config.render_split,
            tau: config.motion_tau as f32,
        }
    }
}

impl SplatSettings {
    /// The conventions of a model.
    pub fn of(config: &ModelConfig) -> SplatSettings {
        SplatSettings {
            aa: config.splat_aa,
            a_max: config.splat_a_max as f32,
            eps2d: config.splat_eps2d as f32,
            near: config.splat_near as f32,
        }
    }
}

/// One input frame of a scene.
#[derive(Clone, Debug, PartialEq)]
pub struct SceneFrame {
    /// Seconds.
    pub time: f64,
    /// The frame's camera at the network's size.
    pub camera: Camera,
    /// Size of the source image before it was resized.
    pub source_size: (u32, u32),
    /// File name of the source image.
    pub name: String,
}

/// The result of one clip: Gaussians, where they came from and how they move.
#[derive(Clone, Debug, PartialEq)]
pub struct Scene {
    /// All Gaussians at the time of their source frame.
    pub gaussians: Gaussians,
    /// Velocity towards later times, world axes, scene units per second.
    pub v_fwd: Vec<[f32; 3]>,
    /// Velocity towards earlier times (points backward in time: about -`v_fwd`).
    pub v_bwd: Vec<[f32; 3]>,
    /// Dynamic probability, 0..1.
    pub dynamic: Vec<f32>,
    /// Index of the source frame.
    pub source: Vec<u32>,
    /// The input frames in time order.
    pub frames: Vec<SceneFrame>,
    /// Composition rules.
    pub compose: Compose,
    /// Rasterizer conventions.
    pub splat: SplatSettings,
    /// Free text: model digest, settings, provenance; kept in `scene.json`.
    pub notes: Vec<(String, String)>,
}

/// A source frame that takes part at a time.
#[derive(Clone, Copy, Debug, PartialEq)]
struct Source {
    frame: usize,
    /// Seconds on `v_fwd` (first) and `v_bwd` (second); at most one is not zero.
    dt: (f64, f64),
    /// Share of the dynamic opacity, 1 unless blended.
    weight: f32,
}

impl Scene {
    /// Times closer than this, in seconds, are the same time.
    pub const SAME_TIME: f64 = 1e-6;

    /// Number of Gaussians.
    pub fn len(&self) -> usize {
        self.gaussians.len()
    }

    /// Whether there are none.
    pub fn is_empty(&self) -> bool {
        self.gaussians.is_empty()
    }

    /// How Gaussian `i` moves as its own frame knows it, towards later times: v+ in the first frame, which sees
    /// nothing earlier, -v- in the last, the mean of both in the others.
    pub fn velocity(&self, i: usize) -> [f32; 3] {
        let (f, b) = (self.v_fwd[i], self.v_bwd[i]);
        match self.source[i] as usize {
            0 => f,
            s if s + 1 >= self.frames.len() => b.map(|v| -v),
            _ => [0, 1, 2].map(|a| 0.5 * (f[a] - b[a])),
        }
    }

    /// First and last input time, seconds.
    pub fn time_range(&self) -> (f64, f64) {
        (self.frames.first().map_or(0.0, |f| f.time), self.frames.last().map_or(0.0, |f| f.time))
    }

    /// Which frames' dynamic Gaussians exist at `time`, and how far each is moved.
    ///
    /// `window` frames on either side of the time take part; exactly at an input time (within a
    /// microsecond) the own-frame rule decides. Beyond the ends only the last (first) `window` frames
    /// take part.
    fn sources(&self, time: f64, rules: &Compose) -> Vec<Source> {
        let n = self.frames.len();
        let last = n.saturating_sub(1);
        let w = rules.window.max(1) as usize;
        let own = self.frames.iter().position(|f| (f.time - time).abs() <= Self::SAME_TIME);
        // Frames strictly before the time.
        let before = self.frames.iter().take_while(|f| f.time < time - Self::SAME_TIME).count();
        let (lo, hi) = match own {
            Some(f) if rules.own == SelfRule::Own || n == 1 => (f, f + 1),
            Some(f) => (f.saturating_sub(w), (f + w + 1).min(n)),
            None => (before.saturating_sub(w), (before + w).min(n)),
        };
        let mut list = Vec::new();
        for frame in lo..hi {
            if Some(frame) == own && rules.own == SelfRule::Neighbours && n > 1 {
                continue;
            }
            let tau = time - self.frames[frame].time;
            let mirror = rules.extrapolate == Extrapolate::Mirror && n > 1;
            let dt = if own == Some(frame) {
                (0.0, 0.0)
            } else if tau > 0.0 {
                // The last frame has no trained forward direction.
                if frame == last && mirror { (0.0, -tau) } else { (tau, 0.0) }
            } else if frame == 0 && mirror {
                (tau, 0.0)
            } else {
                (0.0, -tau)
            };
            list.push(Source { frame, dt, weight: 1.0 });
        }
        list
    }

    /// The Gaussians that exist at `time`, moved to it: all static ones, and the dynamic ones of the
    /// window. `time` must be finite.
    pub fn at(&self, time: f64, rules: &Compose) -> Result<Gaussians> {
        let mut out = Gaussians::default();
        self.at_into(time, rules, &mut out)?;
        Ok(out)
    }

    /// [`Scene::at`] into memory that is kept between calls.
    pub fn at_into(&self, time: f64, rules: &Compose, out: &mut Gaussians) -> Result<()> {
        if !time.is_finite() {
            return Err(Error::input("time", format!("{time} is not a time in seconds")));
        }
        out.clear();
        out.reserve(self.len());
        let mut active: Vec<Option<Source>> = vec![None; self.frames.len()];
        for s in self.sources(time, rules) {
            active[s.frame] = Some(s);
        }
        for i in 0..self.len() {
            let p = self.dynamic[i];
            let (static_w, dynamic_w) = match rules.split {
                Split::Hard if p > rules.tau => (0.0, 1.0),
                Split::Hard => (1.0, 0.0),
                Split::Soft => (1.0 - p, p),
            };
            if static_w > 0.0 {
                out.push_from(&self.gaussians, i, [0.0; 3], static_w);
            }
            if dynamic_w > 0.0
                && let Some(Some(s)) = active.get(self.source[i] as usize)
            {
                let (f, b) = (s.dt.0 as f32, s.dt.1 as f32);
                let (vf, vb) = (self.v_fwd[i], self.v_bwd[i]);
                let shift = [0, 1, 2].map(|a| f * vf[a] + b * vb[a]);
                out.push_from(&self.gaussians, i, shift, dynamic_w * s.weight);
            }
        }
        Ok(())
    }

    /// Camera at a time: interpolated between input frames, carried on beyond the ends.
    pub fn camera_at(&self, time: f64) -> Result<Camera> {
        if !time.is_finite() {
            return Err(Error::input("time", format!("{time} is not a time in seconds")));
        }
        let n = self.frames.len();
        if n == 0 {
            return Err(Error::input("scene", "has no frames, so no camera at a time"));
        }
        if n == 1 {
            return Ok(self.frames[0].camera);
        }
        let hi = self.frames.iter().position(|f| f.time >= time).unwrap_or(n - 1).max(1);
        let (a, b) = (&self.frames[hi - 1], &self.frames[hi]);
        let s = (time - a.time) / (b.time - a.time);
        let near = if s < 0.5 { a } else { b };
        Ok(Camera { pose: a.camera.pose.interpolate(&b.camera.pose, s), ..near.camera })
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::camera::{Intrinsics, Pose};

    /// Three frames a second apart, one dynamic Gaussian each (frame index as its x), one static.
    fn scene() -> Scene {
        let camera =
            Camera { width: 8, height: 8, k: Intrinsics { fx: 8.0, fy: 8.0, cx: 4.0, cy: 4.0 }, pose: Pose::IDENTITY };
        let frames = (0..3)
            .map(|f| SceneFrame { time: f64::from(f), camera, source_size: (8, 8), name: String::new() })
            .collect();
        Scene {
            gaussians: Gaussians {
                mean: (0..4).map(|f| [100.0 * f as f32, 0.0, 5.0]).collect(),
                scale: vec![[0.1; 3]; 4],
                quat: vec![[1.0, 0.0, 0.0, 0.0]; 4],
                opacity: vec![0.8; 4],
                colour: vec![[0.5; 3]; 4],
            },
            v_fwd: vec![[1.0, 0.0, 0.0]; 4],
            v_bwd: vec![[-2.0, 0.0, 0.0]; 4],
            dynamic: vec![0.9, 0.9, 0.9, 0.1],
            source: vec![0, 1, 2, 0],
            frames,
            compose: Compose::default(),
            splat: SplatSettings::default(),
            notes: Vec::new(),
        }
    }

    fn xs(g: &Gaussians) -> Vec<f32> {
        g.mean.iter().map(|m| m[0]).collect()
    }

    #[test]
    fn between_frames_both_neighbours_move_to_the_time() {
        let g = scene().at(0.25, &Compose::default()).unwrap();
        // Frame 0 by +0.25 v+, frame 1 by +0.75 v-, and the static one.
        assert_eq!(xs(&g), [0.25, 100.0 - 1.5, 300.0]);
    }

    #[test]
    fn exactly_at_a_frame_the_own_rule_decides() {
        let s = scene();
        assert_eq!(xs(&s.at(1.0, &Compose::default()).unwrap()), [100.0, 300.0]);
        let paper = Compose { own: SelfRule::Neighbours, ..Compose::default() };
        assert_eq!(xs(&s.at(1.0, &paper).unwrap()), [1.0, 198.0, 300.0]);
    }

    #[test]
    fn beyond_the_ends_the_trained_direction_is_mirrored() {
        let s = scene();
        assert_eq!(xs(&s.at(2.5, &Compose::default()).unwrap()), [200.0 + 1.0, 300.0]);
        assert_eq!(xs(&s.at(-0.5, &Compose::default()).unwrap()), [-0.5, 300.0]);
        let direct = Compose { extrapolate: Extrapolate::Direct, ..Compose::default() };
        assert_eq!(xs(&s.at(2.5, &direct).unwrap()), [200.5, 300.0]);
        assert_eq!(xs(&s.at(-0.5, &direct).unwrap()), [-1.0, 300.0]);
    }

    #[test]
    fn a_wide_window_takes_more_frames_and_soft_split_weighs() {
        let s = scene();
        let wide = Compose { window: 2, ..Compose::default() };
        assert_eq!(xs(&s.at(1.5, &wide).unwrap()), [1.5, 100.5, 200.0 - 1.0, 300.0]);
        let soft = Compose { split: Split::Soft, ..Compose::default() };
        let g = s.at(1.0, &soft).unwrap();
        let total: f32 = g.opacity.iter().sum();
        // Four static shares (3 x 0.1 + 0.9) and frame 1's dynamic share 0.9.
        assert!((total - 0.8 * (0.3 + 0.9 + 0.9)).abs() < 1e-6);
    }

    #[test]
    fn the_ends_of_a_clip_know_one_direction_of_motion() {
        let s = scene();
        assert_eq!([0, 1, 2].map(|i| s.velocity(i)[0]), [1.0, 1.5, 2.0]);
    }

    #[test]
    fn one_frame_stands_still_and_nan_is_refused() {
        let mut s = scene();
        s.frames.truncate(1);
        s.source = vec![0; 4];
        s.v_fwd = vec![[0.0; 3]; 4];
        assert_eq!(s.at(7.0, &Compose::default()).unwrap().len(), 4);
        assert_eq!(s.at(f64::NAN, &Compose::default()).unwrap_err().status() as i32, 3);
        assert_eq!(s.camera_at(9.0).unwrap(), s.frames[0].camera);
    }
}
