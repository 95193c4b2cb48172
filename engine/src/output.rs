//! [`Output`]: what the network says about one clip; and the [`Scene`] made of it.

use crate::arena::filled;
use crate::dims::ClipShape;
use sf_formats::config::{ModelConfig, Sky};
use sf_formats::scene::{Compose, SceneFrame, SplatSettings};
use sf_formats::{Camera, Gaussians, Intrinsics, Pose, Result, Scene};
use sf_ops::activation::sigmoid;
use std::ops::Range;

/// f32 values of an [`Output`] per pixel of the clip: points, depth, centre, scale, quaternion, opacity, colour,
/// two velocities, dynamic probability; and the confidence where there is one.
pub(crate) fn values_per_pixel(config: &ModelConfig) -> usize {
    3 + 1 + 3 + 3 + 4 + 1 + 3 + 3 + 3 + 1 + usize::from(config.has_conf())
}

/// What a caller should know about a result.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Flags {
    /// One frame, or a network without motion: velocities and dynamic probabilities are zero.
    pub no_motion: bool,
    /// The predicted rays did not determine the focal length; a 64 degree view was assumed.
    pub intrinsics_assumed: bool,
}

/// Result of one run. Per-pixel vectors hold frame after frame, row-major.
#[derive(Clone, Debug, PartialEq)]
pub struct Output {
    /// Frames and their size.
    pub shape: ClipShape,
    /// Seconds.
    pub times: Vec<f64>,
    /// Camera to world, world = first camera (by default), scene units.
    pub poses: Vec<Pose>,
    /// Intrinsics of every frame at the network's size.
    pub k: Vec<Intrinsics>,
    /// Local points in camera axes as predicted, scene units.
    pub points: Vec<[f32; 3]>,
    /// z-depth, scene units.
    pub depth: Vec<f32>,
    /// Confidence logits; empty where the network has none.
    pub conf: Vec<f32>,
    /// Centres of the Gaussians, world axes.
    pub mean: Vec<[f32; 3]>,
    /// Standard deviations, scene units.
    pub scale: Vec<[f32; 3]>,
    /// Rotations w, x, y, z to world axes.
    pub quat: Vec<[f32; 4]>,
    /// Opacities.
    pub opacity: Vec<f32>,
    /// Linear RGB, nominally 0..1.
    pub colour: Vec<[f32; 3]>,
    /// Velocity towards later times, world axes, scene units per second.
    pub v_fwd: Vec<[f32; 3]>,
    /// Velocity towards earlier times (points backward).
    pub v_bwd: Vec<[f32; 3]>,
    /// Dynamic probability.
    pub dynamic: Vec<f32>,
    /// Whether each frame has a neighbour to see in the forward and in the backward direction; without
    /// one, its velocity in that direction is the other one mirrored (or the raw, untrained value).
    pub neighbours: Vec<(bool, bool)>,
    /// Frames that this result is about: all of them, but after [`Session::push_newest`](crate::Session::push_newest) the last
    /// one alone. Then the values of other frames are unspecified, but for their times and the first one's pose.
    pub due: Range<usize>,
    /// What to know about this result.
    pub flags: Flags,
}

/// Name and size of a frame's source image, for a scene.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct FrameSource {
    /// File name.
    pub name: String,
    /// Pixels before the resize.
    pub size: (u32, u32),
}

impl Output {
    /// Room for the results of a clip shape.
    pub(crate) fn new(shape: ClipShape, with_conf: bool) -> Result<Output> {
        let n = shape.frames * shape.height * shape.width;
        let scalars = |len: usize| filled("results", len, 0.0);
        let vectors = || filled("results", n, [0.0; 3]);
        Ok(Output {
            shape,
            times: vec![0.0; shape.frames],
            poses: vec![Pose::IDENTITY; shape.frames],
            k: vec![Intrinsics { fx: 1.0, fy: 1.0, cx: 0.0, cy: 0.0 }; shape.frames],
            points: vectors()?,
            depth: scalars(n)?,
            conf: scalars(if with_conf { n } else { 0 })?,
            mean: vectors()?,
            scale: vectors()?,
            quat: filled("results", n, [1.0, 0.0, 0.0, 0.0])?,
            opacity: scalars(n)?,
            colour: vectors()?,
            v_fwd: vectors()?,
            v_bwd: vectors()?,
            dynamic: scalars(n)?,
            neighbours: vec![(false, false); shape.frames],
            due: 0..shape.frames,
            flags: Flags::default(),
        })
    }

    /// Camera of frame `f` at the network's size.
    pub fn camera(&self, f: usize) -> Camera {
        let (width, height) = (self.shape.width as u32, self.shape.height as u32);
        Camera { width, height, k: self.k[f], pose: self.poses[f] }
    }

    /// What is said about frame `f`, as a result of one frame.
    ///
    /// # Panics
    /// When the frame is not [`Output::due`].
    pub fn of_frame(&self, f: usize) -> Output {
        assert!(self.due.contains(&f), "frame {f} of a result about the frames {:?}", self.due);
        let n = self.shape.height * self.shape.width;
        let pixels = f * n..(f + 1) * n;
        Output {
            shape: ClipShape { frames: 1, ..self.shape },
            times: vec![self.times[f]],
            poses: vec![self.poses[f]],
            k: vec![self.k[f]],
            points: self.points[pixels.clone()].to_vec(),
            depth: self.depth[pixels.clone()].to_vec(),
            conf: if self.conf.is_empty() { Vec::new() } else { self.conf[pixels.clone()].to_vec() },
            mean: self.mean[pixels.clone()].to_vec(),
            scale: self.scale[pixels.clone()].to_vec(),
            quat: self.quat[pixels.clone()].to_vec(),
            opacity: self.opacity[pixels.clone()].to_vec(),
            colour: self.colour[pixels.clone()].to_vec(),
            v_fwd: self.v_fwd[pixels.clone()].to_vec(),
            v_bwd: self.v_bwd[pixels.clone()].to_vec(),
            dynamic: self.dynamic[pixels].to_vec(),
            neighbours: vec![self.neighbours[f]],
            due: 0..1,
            flags: self.flags,
        }
    }

    /// Every pixel as a Gaussian, with cameras and the configured conventions.
    ///
    /// `sources` has one entry per frame, or is empty: then frames are numbered and have the network's
    /// size. `sky.mode` and `static.voxel` of the configuration are applied here.
    ///
    /// # Panics
    /// When the result is about some of the frames only ([`Output::due`]).
    pub fn to_scene(&self, config: &ModelConfig, sources: &[FrameSource]) -> Scene {
        assert!(self.due == (0..self.shape.frames), "a scene of a result about the frames {:?}", self.due);
        let own = (self.shape.width as u32, self.shape.height as u32);
        let frames = (0..self.shape.frames)
            .map(|f| {
                let source = sources.get(f);
                SceneFrame {
                    time: self.times[f],
                    camera: self.camera(f),
                    source_size: source.map_or(own, |s| s.size),
                    name: source.map_or_else(|| format!("{f:06}"), |s| s.name.clone()),
                }
            })
            .collect();
        let pixels = self.shape.height * self.shape.width;
        let mut scene = Scene {
            gaussians: Gaussians {
                mean: self.mean.clone(),
                scale: self.scale.clone(),
                quat: self.quat.clone(),
                opacity: self.opacity.clone(),
                colour: self.colour.clone(),
            },
            v_fwd: self.v_fwd.clone(),
            v_bwd: self.v_bwd.clone(),
            dynamic: self.dynamic.clone(),
            source: (0..self.depth.len()).map(|i| (i / pixels) as u32).collect(),
            frames,
            compose: Compose::of(config),
            splat: SplatSettings::of(config),
            notes: Vec::new(),
        };
        if config.sky == Sky::FarShell {
            self.push_sky(&mut scene, pixels, config.sky_conf as f32);
        }
        if config.static_voxel > 0.0 {
            merge_static(&mut scene, config.static_voxel, config.motion_tau as f32);
        }
        scene
    }

    /// Pixels of low confidence go to a shell at twice the largest confident depth, along their rays, and
    /// stand still there; without confidences nothing happens.
    fn push_sky(&self, scene: &mut Scene, pixels: usize, least: f32) {
        let sky = |i: usize| self.conf.get(i).is_some_and(|&c| sigmoid(c) < least);
        let land = (0..self.depth.len()).filter(|&i| !sky(i)).map(|i| self.depth[i]).fold(0.0, f32::max);
        if land <= 0.0 {
            return;
        }
        for i in (0..self.depth.len()).filter(|&i| sky(i)) {
            let grow = 2.0 * land / self.depth[i];
            if !(grow.is_finite() && grow > 1.0) {
                continue;
            }
            let eye = self.poses[i / pixels].t;
            let eye = [eye.x as f32, eye.y as f32, eye.z as f32];
            let g = &mut scene.gaussians;
            g.mean[i] = std::array::from_fn(|a| eye[a] + (g.mean[i][a] - eye[a]) * grow);
            g.scale[i] = g.scale[i].map(|s| s * grow);
            scene.v_fwd[i] = [0.0; 3];
            scene.v_bwd[i] = [0.0; 3];
            scene.dynamic[i] = 0.0;
        }
    }
}

/// Replaces the static Gaussians of every voxel of side `voxel` by one: opacity-weighted mean, scale and
/// colour, the rotation and source of the most opaque one, the largest opacity. Dynamic ones stay.
fn merge_static(scene: &mut Scene, voxel: f64, tau: f32) {
    let n = scene.len();
    let key = |m: [f32; 3]| m.map(|v| (f64::from(v) / voxel).floor().clamp(-9e15, 9e15) as i64);
    let mut order: Vec<([i64; 3], u32)> = (0..n as u32)
        .filter(|&i| scene.dynamic[i as usize] <= tau)
        .map(|i| (key(scene.gaussians.mean[i as usize]), i))
        .collect();
    // Equal voxels stand together, in order of index: the same sums on every machine.
    order.sort_unstable();
    let mut keep: Vec<bool> = scene.dynamic.iter().map(|&p| p > tau).collect();
    for group in order.chunk_by(|a, b| a.0 == b.0) {
        let index = |g: &([i64; 3], u32)| g.1 as usize;
        let g = &mut scene.gaussians;
        let first =
            group.iter().map(index).fold(index(&group[0]), |a, b| if g.opacity[b] > g.opacity[a] { b } else { a });
        keep[first] = true;
        if group.len() == 1 {
            continue;
        }
        let (mut sum, mut total) = ([0.0f64; 9], 0.0f64);
        for i in group.iter().map(index) {
            // A floor keeps voxels of invisible Gaussians defined.
            let w = f64::from(g.opacity[i]).max(1e-6);
            total += w;
            for a in 0..3 {
                sum[a] += w * f64::from(g.mean[i][a]);
                sum[3 + a] += w * f64::from(g.scale[i][a]);
                sum[6 + a] += w * f64::from(g.colour[i][a]);
            }
        }
        let part = |from: usize| std::array::from_fn(|a| (sum[from + a] / total) as f32);
        (g.mean[first], g.scale[first], g.colour[first]) = (part(0), part(3), part(6));
    }
    fn retain<T>(v: &mut Vec<T>, keep: &[bool]) {
        let mut flags = keep.iter();
        v.retain(|_| *flags.next().expect("one flag per Gaussian"));
    }
    let g = &mut scene.gaussians;
    retain(&mut g.mean, &keep);
    retain(&mut g.scale, &keep);
    retain(&mut g.quat, &keep);
    retain(&mut g.opacity, &keep);
    retain(&mut g.colour, &keep);
    retain(&mut scene.v_fwd, &keep);
    retain(&mut scene.v_bwd, &keep);
    retain(&mut scene.dynamic, &keep);
    retain(&mut scene.source, &keep);
}

#[cfg(test)]
mod tests {
    use super::*;

    fn output() -> Output {
        let mut o = Output::new(ClipShape { frames: 1, height: 1, width: 4 }, true).unwrap();
        o.mean = vec![[0.1, 0.1, 1.0], [0.3, 0.3, 1.2], [0.2, 0.2, 1.1], [0.0, 1.0, 2.0]];
        o.depth = vec![1.0, 1.2, 1.1, 2.0];
        o.scale = vec![[0.1; 3], [0.3; 3], [0.1; 3], [0.1; 3]];
        o.opacity = vec![0.25, 0.75, 0.5, 0.9];
        o.dynamic = vec![0.0, 0.1, 0.9, 0.0];
        o.conf = vec![3.0, 3.0, 3.0, -5.0];
        o
    }

    #[test]
    fn all_pixels_become_gaussians() {
        let scene = output().to_scene(&ModelConfig::base(), &[]);
        assert_eq!((scene.len(), scene.frames.len(), scene.frames[0].source_size), (4, 1, (4, 1)));
        let source = FrameSource { name: "a.png".into(), size: (40, 10) };
        let scene = output().to_scene(&ModelConfig::base(), &[source]);
        assert_eq!((scene.frames[0].name.as_str(), scene.frames[0].source_size), ("a.png", (40, 10)));
    }

    #[test]
    fn static_gaussians_of_a_voxel_merge_and_dynamic_ones_stay() {
        let config = ModelConfig { static_voxel: 1.0, ..ModelConfig::base() };
        let scene = output().to_scene(&config, &[]);
        // Two static ones share the voxel (0, 0, 1): one is left; the dynamic one there stays.
        assert_eq!(scene.dynamic, [0.1, 0.9, 0.0]);
        let m = scene.gaussians.mean[0];
        assert!((m[0] - 0.25).abs() < 1e-6 && (m[2] - 1.15).abs() < 1e-6, "{m:?}");
        assert_eq!((scene.gaussians.opacity[0], scene.source.len(), scene.v_fwd.len()), (0.75, 3, 3));
    }

    #[test]
    fn sky_goes_to_the_shell() {
        let config = ModelConfig { sky: Sky::FarShell, ..ModelConfig::base() };
        let scene = output().to_scene(&config, &[]);
        // Largest confident depth 1.2, shell at 2.4, sky was at 2.
        let m = scene.gaussians.mean[3];
        assert!((m[1] - 1.2).abs() < 1e-6 && (m[2] - 2.4).abs() < 1e-6, "{m:?}");
        assert!((scene.gaussians.scale[3][0] - 0.12).abs() < 1e-6);
        assert_eq!(scene.gaussians.mean[0], [0.1, 0.1, 1.0]);
        // The threshold is a setting: sigmoid(3) is 0.953.
        let nothing = ModelConfig { sky_conf: 0.001, ..config.clone() };
        assert_eq!(output().to_scene(&nothing, &[]).gaussians.mean[3], output().mean[3]);
        let most = ModelConfig { sky_conf: 0.96, ..config };
        assert_eq!(output().to_scene(&most, &[]).gaussians.mean, output().mean, "no land to measure the shell by");
    }
}
