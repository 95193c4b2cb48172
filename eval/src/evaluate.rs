//! How a reconstruction is measured on the test frames of a protocol.
//!
//! * Size: that of the scene's cameras. True pictures are resized with the network's bicubic filter; depth,
//!   velocity and masks are sampled at the nearest pixel, never averaged across an edge.
//! * Test cameras: a pose-free model has its own world, so either its own context poses are interpolated and
//!   carried on (default, nothing true is used), or the true poses are brought into its world by the
//!   similarity that fits the context poses ([`TargetPoses`]).
//! * Depth: D / alpha, compared where the true depth is in (0, `max_depth`]; a pixel where nothing was drawn counts
//!   with depth 0. Also after scaling each frame by the ratio of medians, as the model is up to scale.
//! * Dynamic pixels: true speed above 1 unit per second; without true velocity, the true mask.
//! * Depth of the network itself and sky: at the context frames, where the caller has them ([`Subject`]).
//! * Velocity and dynamic probability: rendered like colour at the context frames, divided by alpha. A Gaussian's
//!   velocity is v+ in the first frame, -v- in the last, (v+ - v-)/2 between, 0 when it is static.

use crate::align::Similarity;
use crate::metrics;
use crate::protocol::{EvalClip, EvalFrame, EvalOptions, Protocol, TargetPoses};
use crate::report::{EvalReport, Method, Metric, Part, Scores};
use crate::ssim::SsimMap;
use glam::{DMat3, DVec3};
use sf_formats::config::{SelfRule, Split};
use sf_formats::image_io::Rgb8;
use sf_formats::scene::{Compose, Scene};
use sf_formats::{Camera, Error, Gaussians, Pose, Result};
use sf_ops::resize::{Filter, resample_u8};
use sf_splat::{RenderOptions, Rendered, Renderer};

/// A scene that is measured, and what its network says of the context frames directly.
#[derive(Clone, Copy, Debug)]
pub struct Subject<'a> {
    /// The reconstruction.
    pub scene: &'a Scene,
    /// z-depth of the context frames at the size of the scene's cameras, scene units, frame after frame.
    pub depth: Option<&'a [f32]>,
    /// Whether each of these pixels is taken for sky.
    pub sky: Option<&'a [bool]>,
}

impl<'a> From<&'a Scene> for Subject<'a> {
    fn from(scene: &'a Scene) -> Subject<'a> {
        Subject { scene, depth: None, sky: None }
    }
}

/// Measures a scene that was reconstructed from the context frames of a clip, beside the same scene without motion
/// and copies of the context frames. More methods are added with [`measure`].
///
/// # Errors
/// Status 3 when the clip is shorter than the protocol, the scene's frames are not the context frames, or true
/// poses are asked for and missing; and whatever rendering returns.
pub fn evaluate(clip: &EvalClip, scene: &Scene, renderer: &mut Renderer, options: &EvalOptions) -> Result<EvalReport> {
    evaluate_subject(clip, &scene.into(), renderer, options)
}

/// [`evaluate`] with the network's own depth and sky.
pub fn evaluate_subject(
    clip: &EvalClip,
    subject: &Subject,
    renderer: &mut Renderer,
    options: &EvalOptions,
) -> Result<EvalReport> {
    let protocol = &options.protocol;
    check(clip, subject.scene, protocol)?;
    let mut report = EvalReport::empty(protocol.name, options.target_poses.name());
    (report.clips, report.context_frames) = (1, protocol.context.len());
    let camera = subject.scene.frames[0].camera;
    let size = (camera.width, camera.height);
    for target in protocol.targets() {
        let part = protocol.part(target);
        match part {
            Part::Extrapolation => report.extrapolation_frames += 1,
            Part::All | Part::Interpolation => report.interpolation_frames += 1,
        }
        let mut scores = Scores::default();
        let nearest = clip.frames[protocol.nearest(clip, target)].image;
        picture_scores(&picture(nearest, size), &Truth::new(&clip.frames[target], size, options), &mut scores);
        count(&mut report, Method::CopyNearest, part, &scores);
    }
    measure(&mut report, Method::Model, clip, subject, (&mut *renderer, options))?;
    measure(&mut report, Method::NoMotion, clip, &(&standing(subject.scene)).into(), (renderer, options))?;
    Ok(report)
}

/// Measures one more scene of the same clip into a report, under the name of `method`.
///
/// Oracles are seen by the true cameras; [`Method::ForwardOnly`] leaves out the dynamic Gaussians of the context
/// frame after each target (beyond the ends nothing changes).
///
/// # Errors
/// As [`evaluate`].
pub fn measure(
    report: &mut EvalReport,
    method: Method,
    clip: &EvalClip,
    subject: &Subject,
    (renderer, options): (&mut Renderer, &EvalOptions),
) -> Result<()> {
    let (protocol, scene) = (&options.protocol, subject.scene);
    check(clip, scene, protocol)?;
    let alignment = fit(clip, scene, protocol)?;
    let poses = match method {
        Method::Oracle | Method::OracleNoMotion => TargetPoses::AlignedTruth,
        _ => options.target_poses,
    };
    let mut bench = Bench { scene, renderer, options, gaussians: Gaussians::default(), out: Rendered::default() };
    for target in protocol.targets() {
        let frame = &clip.frames[target];
        let camera = match poses {
            TargetPoses::Predicted => scene.camera_at(frame.time)?,
            TargetPoses::AlignedTruth => {
                let Some((similarity, pose)) = alignment.as_ref().map(|a| a.0).zip(frame.pose) else {
                    return Err(Error::input(
                        "target poses",
                        "true poses are asked for, but the clip has not all of them",
                    ));
                };
                Camera { pose: similarity.to_predicted(&pose), ..scene.camera_at(frame.time)? }
            }
        };
        let truth = Truth::new(frame, (camera.width, camera.height), options);
        if method == Method::ForwardOnly {
            let forward = forward_only(scene, frame.time);
            bench.render_scene(&forward, (frame.time, &scene.compose), &camera, options.background)?;
        } else {
            bench.render_scene(scene, (frame.time, &scene.compose), &camera, options.background)?;
        }
        let mut scores = Scores::default();
        picture_scores(&bench.out.rgb, &truth, &mut scores);
        depth_scores(&bench.out.expected_depth(), &truth, &mut scores);
        count(report, method, protocol.part(target), &scores);
    }
    if matches!(method, Method::Model | Method::NoCausal | Method::Oracle) {
        if let Some((similarity, truth)) = &alignment {
            pose_errors(scene, truth, similarity, report.scores_mut(method, Part::All));
        }
        context_scores(clip, subject, options, report.scores_mut(method, Part::All));
        motion_scores(&mut bench, clip, alignment, report.scores_mut(method, Part::All))?;
    }
    Ok(())
}

/// The scene with every velocity zero.
pub fn standing(scene: &Scene) -> Scene {
    let still = vec![[0.0; 3]; scene.len()];
    Scene { v_fwd: still.clone(), v_bwd: still, ..scene.clone() }
}

/// The scene without the dynamic Gaussians of context frames after `time`, unless no frame is before.
fn forward_only(scene: &Scene, time: f64) -> Scene {
    let mut forward = scene.clone();
    if scene.frames.first().is_some_and(|f| f.time < time) {
        for i in 0..scene.len() {
            let later = scene.frames.get(scene.source[i] as usize).is_some_and(|f| f.time > time);
            if later && scene.dynamic[i] > scene.compose.tau {
                forward.gaussians.opacity[i] = 0.0;
            }
        }
    }
    forward
}

fn check(clip: &EvalClip, scene: &Scene, protocol: &Protocol) -> Result<()> {
    let needed = protocol.frames.max(protocol.context.last().map_or(0, |c| c + 1));
    if clip.frames.len() < needed {
        return Err(Error::input("clip", format!("{} frames; the protocol needs {needed}", clip.frames.len())));
    }
    if protocol.context.is_empty() || scene.frames.len() != protocol.context.len() {
        return Err(Error::input(
            "scene",
            format!(
                "made of {} frames, but the protocol gives {}: reconstruct from frames {:?}",
                scene.frames.len(),
                protocol.context.len(),
                protocol.context
            ),
        ));
    }
    for (frame, &c) in scene.frames.iter().zip(&protocol.context) {
        let (scene_time, clip_time) = (frame.time, clip.frames[c].time);
        if (scene_time - clip_time).abs() > 1e-6 {
            return Err(Error::input(
                "scene",
                format!("a frame is at {scene_time} s, but context frame {c} of the clip is at {clip_time} s"),
            ));
        }
    }
    Ok(())
}

/// The similarity of the worlds and the true context poses; `None` without them.
fn fit(clip: &EvalClip, scene: &Scene, protocol: &Protocol) -> Result<Option<(Similarity, Vec<Pose>)>> {
    let truth: Option<Vec<Pose>> = protocol.context.iter().map(|&c| clip.frames[c].pose).collect();
    let Some(truth) = truth else { return Ok(None) };
    let predicted: Vec<Pose> = scene.frames.iter().map(|f| f.camera.pose).collect();
    Ok(Some((Similarity::fit(&predicted, &truth)?, truth)))
}

fn pose_errors(scene: &Scene, truth: &[Pose], similarity: &Similarity, scores: &mut Scores) {
    let predicted = |i: usize| scene.frames[i].camera.pose;
    let (to_first_p, to_first_t) = (predicted(0).inverse(), truth[0].inverse());
    for i in 0..truth.len() {
        let aligned = similarity.to_truth(&predicted(i)).t - truth[i].t;
        scores.add(Metric::TranslationErrorScaled, Some(aligned.length()));
        if i > 0 {
            let (p, t) = (to_first_p.then(&predicted(i)), to_first_t.then(&truth[i]));
            scores.add(Metric::RotationDeg, Some(metrics::rotation_error_deg(&p.r, &t.r)));
            scores.add(Metric::RotationIdentityDeg, Some(metrics::rotation_error_deg(&DMat3::IDENTITY, &t.r)));
            scores.add(Metric::Travel, Some(t.t.length()));
            scores.add(Metric::TranslationDirectionDeg, metrics::direction_error_deg(p.t, t.t));
            scores.add(Metric::TranslationError, Some((p.t - t.t).length()));
        }
    }
}

/// The scene, the renderer and the memory they use.
struct Bench<'a> {
    scene: &'a Scene,
    renderer: &'a mut Renderer,
    options: &'a EvalOptions,
    gaussians: Gaussians,
    out: Rendered,
}

impl Bench<'_> {
    fn render_scene(
        &mut self,
        scene: &Scene,
        (time, rules): (f64, &Compose),
        camera: &Camera,
        background: [f32; 3],
    ) -> Result<()> {
        scene.at_into(time, rules, &mut self.gaussians)?;
        let options = RenderOptions { background, ..RenderOptions::default() };
        self.renderer.render_into(&self.gaussians, camera, &scene.splat, &options, &mut self.out)
    }

    /// A map of three values per Gaussian as seen by a context frame, divided by alpha, 0 where nothing is.
    fn context_map(&mut self, painted: &Scene, frame: usize) -> Result<Vec<[f32; 3]>> {
        let view = &self.scene.frames[frame];
        self.render_scene(painted, (view.time, &painted.compose), &view.camera, [0.0; 3])?;
        let values = self.out.rgb.chunks_exact(3).zip(&self.out.alpha);
        Ok(values.map(|(v, a)| [0, 1, 2].map(|c| v[c] / a.max(1e-10))).collect())
    }
}

fn count(report: &mut EvalReport, method: Method, part: Part, scores: &Scores) {
    report.scores_mut(method, Part::All).merge(scores);
    report.scores_mut(method, part).merge(scores);
}

/// What is true of a frame at the size of the rendering.
struct Truth {
    size: (u32, u32),
    rgb: Vec<f32>,
    depth: Vec<f32>,
    valid: Vec<bool>,
    /// No surface is seen.
    sky: Vec<bool>,
    velocity: Option<Vec<[f32; 3]>>,
    /// `None` when it is not known which pixels are dynamic.
    dynamic: Option<Vec<bool>>,
}

impl Truth {
    fn new(frame: &EvalFrame, size: (u32, u32), options: &EvalOptions) -> Truth {
        let rgb = picture(frame.image, size);
        let (depth, valid, sky) = (Vec::new(), Vec::new(), Vec::new());
        let mut truth = Truth { size, rgb, depth, valid, sky, velocity: None, dynamic: None };
        if let Some(known) = frame.truth {
            let pick = nearest_pixels((known.width, known.height), size);
            truth.depth = pick.iter().map(|&i| known.depth[i]).collect();
            truth.valid = truth.depth.iter().map(|&d| d > 0.0 && d <= options.max_depth).collect();
            truth.sky = truth.depth.iter().map(|&d| d <= 0.0).collect();
            truth.velocity = known.velocity.as_ref().map(|v| pick.iter().map(|&i| v[i]).collect());
            let fast = |v: &[f32; 3]| metrics::vec3(*v).length() > f64::from(options.dynamic_speed);
            truth.dynamic = match (&truth.velocity, &known.dynamic) {
                (Some(v), _) => Some(v.iter().map(fast).collect()),
                (None, Some(mask)) => Some(pick.iter().map(|&i| mask[i]).collect()),
                (None, None) => None,
            };
        }
        truth
    }
}

/// For every pixel of `to`, the pixel of `from` under its centre.
fn nearest_pixels(from: (u32, u32), to: (u32, u32)) -> Vec<usize> {
    let at = |i: u32, from: u32, to: u32| ((2 * u64::from(i) + 1) * u64::from(from) / (2 * u64::from(to))) as usize;
    (0..to.1)
        .flat_map(|y| (0..to.0).map(move |x| at(y, from.1, to.1) * from.0 as usize + at(x, from.0, to.0)))
        .collect()
}

/// A picture at a size, 0..1.
fn picture(image: &Rgb8, size: (u32, u32)) -> Vec<f32> {
    let sides = |(w, h): (u32, u32)| (w as usize, h as usize);
    let unit = |bytes: &[u8]| bytes.iter().map(|&b| f32::from(b) / 255.0).collect();
    if image.size() == size {
        return unit(&image.data);
    }
    unit(&resample_u8(&image.data, sides(image.size()), Filter::Bicubic, sides(size)))
}

fn picture_scores(rgb: &[f32], truth: &Truth, scores: &mut Scores) {
    scores.add(Metric::PsnrFull, metrics::psnr(rgb, &truth.rgb));
    let ssim = SsimMap::new(rgb, &truth.rgb, (truth.size.0 as usize, truth.size.1 as usize));
    scores.add(Metric::SsimFull, ssim.as_ref().map(SsimMap::mean));
    if let Some(mask) = &truth.dynamic {
        scores.add(Metric::PsnrDynamic, metrics::psnr_masked(rgb, &truth.rgb, mask));
        scores.add(Metric::SsimDynamic, ssim.and_then(|s| s.mean_masked(mask)));
    }
}

fn depth_scores(depth: &[f32], truth: &Truth, scores: &mut Scores) {
    if truth.depth.is_empty() {
        return;
    }
    let scale = metrics::median_scale(depth, &truth.depth, &truth.valid);
    let both = |dynamic: bool| -> Option<Vec<bool>> {
        let mask = truth.dynamic.as_ref()?;
        Some(truth.valid.iter().zip(mask).map(|(&v, &d)| v && d == dynamic).collect())
    };
    let errors = |mask: &[bool], scale: Option<f64>| metrics::depth_errors(depth, &truth.depth, mask, scale?);
    let full = [errors(&truth.valid, Some(1.0)), errors(&truth.valid, scale)];
    scores.add(Metric::DepthRmseFull, full[0].map(|e| e.rmse));
    scores.add(Metric::DepthAbsRel, full[0].map(|e| e.abs_rel));
    scores.add(Metric::DepthDelta1, full[0].map(|e| e.delta1));
    scores.add(Metric::DepthRmseFullScaled, full[1].map(|e| e.rmse));
    scores.add(Metric::DepthAbsRelScaled, full[1].map(|e| e.abs_rel));
    scores.add(Metric::DepthDelta1Scaled, full[1].map(|e| e.delta1));
    for (mask, raw, scaled) in [
        (both(false), Metric::DepthRmseStatic, Metric::DepthRmseStaticScaled),
        (both(true), Metric::DepthRmseDynamic, Metric::DepthRmseDynamicScaled),
    ] {
        if let Some(mask) = mask {
            scores.add(raw, errors(&mask, Some(1.0)).map(|e| e.rmse));
            scores.add(scaled, errors(&mask, scale).map(|e| e.rmse));
        }
    }
}

/// The network's own depth and sky at the context frames.
fn context_scores(clip: &EvalClip, subject: &Subject, options: &EvalOptions, scores: &mut Scores) {
    let frames = subject.scene.frames.len();
    for (f, &c) in options.protocol.context.iter().enumerate() {
        let camera = subject.scene.frames[f].camera;
        let truth = Truth::new(&clip.frames[c], (camera.width, camera.height), options);
        let pixels = truth.depth.len();
        if pixels == 0 {
            continue;
        }
        if let Some(depth) = subject.depth {
            assert_eq!(depth.len(), frames * pixels, "depth of the context frames");
            let depth = &depth[f * pixels..][..pixels];
            let errors = |scale: f64| metrics::depth_errors(depth, &truth.depth, &truth.valid, scale);
            let scaled = metrics::median_scale(depth, &truth.depth, &truth.valid).and_then(errors);
            scores.add(Metric::ContextDepthAbsRel, errors(1.0).map(|e| e.abs_rel));
            scores.add(Metric::ContextDepthRmse, errors(1.0).map(|e| e.rmse));
            scores.add(Metric::ContextDepthAbsRelScaled, scaled.map(|e| e.abs_rel));
        }
        if let Some(sky) = subject.sky {
            assert_eq!(sky.len(), frames * pixels, "sky of the context frames");
            let (both, either) = metrics::overlap(&sky[f * pixels..][..pixels], &truth.sky);
            scores.add_sum(Metric::SkyIou, both as f64, either as f64);
        }
    }
}

/// Velocity and mask at the context frames.
fn motion_scores(
    bench: &mut Bench,
    clip: &EvalClip,
    alignment: Option<(Similarity, Vec<Pose>)>,
    scores: &mut Scores,
) -> Result<()> {
    let scene = bench.scene;
    let (velocity, probability) = painted(scene);
    for (f, &c) in bench.options.protocol.context.iter().enumerate() {
        let camera = scene.frames[f].camera;
        let truth = Truth::new(&clip.frames[c], (camera.width, camera.height), bench.options);
        let Some(dynamic) = &truth.dynamic else { continue };
        let predicted: Vec<bool> =
            bench.context_map(&probability, f)?.iter().map(|p| p[0] > scene.compose.tau).collect();
        let (both, either) = metrics::overlap(&predicted, dynamic);
        scores.add_sum(Metric::DynamicIou, both as f64, either as f64);
        // Without true poses the axes of the true velocity are unknown.
        let (Some(true_velocity), Some((similarity, poses))) = (&truth.velocity, &alignment) else { continue };
        let map: Vec<DVec3> =
            bench.context_map(&velocity, f)?.into_iter().map(|v| similarity.r * metrics::vec3(v)).collect();
        let single = |scale: f64| map.iter().map(|v| (*v * scale).as_vec3().to_array()).collect::<Vec<_>>();
        let nothing = vec![[0.0; 3]; map.len()];
        let fixed: Vec<bool> = truth.valid.iter().zip(dynamic).map(|(v, d)| *v && !d).collect();
        let across = |v: &[f32; 3]| {
            let v = poses[f].r.transpose() * metrics::vec3(*v);
            v.x.abs() > v.z.abs()
        };
        let crossing: Vec<bool> = dynamic.iter().zip(true_velocity).map(|(d, v)| *d && across(v)).collect();
        let (raw, scaled) = (single(1.0), single(similarity.scale));
        for (metric, map, truth, mask) in [
            (Metric::VelocityEpe, &raw, true_velocity, dynamic),
            (Metric::VelocityEpeScaled, &scaled, true_velocity, dynamic),
            (Metric::VelocitySpeed, &nothing, true_velocity, dynamic),
            (Metric::VelocityEpeCrossing, &raw, true_velocity, &crossing),
            (Metric::VelocitySpeedCrossing, &nothing, true_velocity, &crossing),
            (Metric::StaticSpeed, &raw, &nothing, &fixed),
        ] {
            let (sum, n) = metrics::velocity_error(map, truth, mask);
            scores.add_sum(metric, sum, n as f64);
        }
    }
    Ok(())
}

/// The scene with velocity, and with dynamic probability, in the place of colour.
fn painted(scene: &Scene) -> (Scene, Scene) {
    let last = scene.frames.len().saturating_sub(1);
    // Every Gaussian at its own frame only: a map shows what that frame predicted.
    let compose = Compose { own: SelfRule::Own, split: Split::Hard, ..scene.compose };
    let base = Scene { compose, ..scene.clone() };
    let colour = |i: usize| {
        let (f, b) = (scene.v_fwd[i], scene.v_bwd[i]);
        if scene.dynamic[i] <= scene.compose.tau {
            return [0.0; 3];
        }
        match scene.source[i] as usize {
            0 => f,
            s if s == last => b.map(|v| -v),
            _ => [0, 1, 2].map(|a| 0.5 * (f[a] - b[a])),
        }
    };
    let mut velocity = base.clone();
    velocity.gaussians.colour = (0..scene.len()).map(colour).collect();
    let mut probability = base;
    probability.gaussians.colour = scene.dynamic.iter().map(|&p| [p; 3]).collect();
    (velocity, probability)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn truth_is_sampled_under_pixel_centres() {
        assert_eq!(nearest_pixels((4, 2), (4, 2)), [0, 1, 2, 3, 4, 5, 6, 7]);
        assert_eq!(nearest_pixels((4, 2), (2, 1)), [5, 7]);
        assert_eq!(nearest_pixels((2, 1), (4, 1)), [0, 0, 1, 1]);
    }
}
