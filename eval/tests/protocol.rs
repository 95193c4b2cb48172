//! The protocol on a street so small that everything about it is known: a wall and a moving box.

use glam::DVec3;
use sf_eval::{
    EvalClip, EvalFrame, EvalOptions, EvalReport, Method, Metric, Part, Protocol, Subject, TargetPoses, evaluate,
    evaluate_subject, measure,
};
use sf_formats::clip::TruthFrame;
use sf_formats::image_io::Rgb8;
use sf_formats::scene::{Compose, Gaussians, Scene, SceneFrame, SplatSettings};
use sf_formats::{Camera, Intrinsics, Pose, Status};
use sf_splat::Renderer;

const SIZE: (u32, u32) = (84, 56);
const FRAMES: usize = 20;
const BOX_SPEED: f32 = 2.0;

/// A frame of the clip with its truth.
struct Frame {
    time: f64,
    camera: Camera,
    image: Rgb8,
    truth: TruthFrame,
}

/// The camera drives sideways and forward, 10 frames a second.
fn camera(time: f64) -> Camera {
    Camera {
        width: SIZE.0,
        height: SIZE.1,
        k: Intrinsics { fx: 70.0, fy: 70.0, cx: 42.0, cy: 28.0 },
        pose: Pose { t: DVec3::new(0.2 * time, 0.0, 0.5 * time), ..Pose::IDENTITY },
    }
}

/// What a ray sees: a patterned wall at z = 12, or the box's face at z = 7 that moves along x.
fn shade(camera: &Camera, x: u32, y: u32, time: f64) -> ([u8; 3], f32, bool) {
    let eye = camera.pose.t;
    let d = camera.unproject(f64::from(x) + 0.5, f64::from(y) + 0.5, 1.0) - eye;
    let at = |z: f64| eye + d * (z - eye.z);
    let byte = |v: f64| (128.0 + 100.0 * v).round() as u8;
    let p = at(7.0) - DVec3::new(f64::from(BOX_SPEED) * time - 2.0, 0.0, 0.0);
    if p.x.abs() < 1.4 && p.y.abs() < 1.1 {
        return ([byte((3.0 * p.x).sin()), byte((4.0 * p.y).cos()), 40], (7.0 - eye.z) as f32, true);
    }
    let p = at(12.0);
    ([60, byte((1.1 * p.x).sin()), byte((0.9 * p.y + 0.5 * p.x).cos())], (12.0 - eye.z) as f32, false)
}

fn frame(index: usize) -> Frame {
    let time = 0.1 * index as f64;
    let camera = camera(time);
    let pixels: Vec<_> = (0..SIZE.1).flat_map(|y| (0..SIZE.0).map(move |x| shade(&camera, x, y, time))).collect();
    Frame {
        time,
        camera,
        image: Rgb8::new(SIZE.0, SIZE.1, pixels.iter().flat_map(|p| p.0).collect()),
        truth: TruthFrame {
            width: SIZE.0,
            height: SIZE.1,
            depth: pixels.iter().map(|p| p.1).collect(),
            velocity: Some(pixels.iter().map(|p| [if p.2 { BOX_SPEED } else { 0.0 }, 0.0, 0.0]).collect()),
            dynamic: Some(pixels.iter().map(|p| p.2).collect()),
        },
    }
}

/// One Gaussian per pixel of the context frames, everything true.
fn perfect_scene(frames: &[Frame], context: &[usize]) -> Scene {
    let mut scene = Scene {
        gaussians: Gaussians::default(),
        v_fwd: Vec::new(),
        v_bwd: Vec::new(),
        dynamic: Vec::new(),
        source: Vec::new(),
        frames: Vec::new(),
        compose: Compose::default(),
        splat: SplatSettings::default(),
        notes: Vec::new(),
    };
    for (s, &c) in context.iter().enumerate() {
        let f = &frames[c];
        for y in 0..SIZE.1 {
            for x in 0..SIZE.0 {
                let i = (y * SIZE.0 + x) as usize;
                let z = f.truth.depth[i];
                let centre = f.camera.unproject(f64::from(x) + 0.5, f64::from(y) + 0.5, z.into());
                let v = f.truth.velocity.as_ref().unwrap()[i];
                scene.gaussians.mean.push(centre.as_vec3().to_array());
                scene.gaussians.scale.push([0.4 * z / f.camera.k.fx as f32; 3]);
                scene.gaussians.quat.push([1.0, 0.0, 0.0, 0.0]);
                scene.gaussians.opacity.push(0.95);
                scene.gaussians.colour.push(f.image.pixel(x, y).map(|b| f32::from(b) / 255.0));
                scene.v_fwd.push(v);
                scene.v_bwd.push(v.map(|v| -v));
                scene.dynamic.push(if v[0] > 0.0 { 1.0 } else { 0.0 });
                scene.source.push(s as u32);
            }
        }
        scene.frames.push(SceneFrame {
            time: f.time,
            camera: f.camera,
            source_size: SIZE,
            name: format!("{c:06}.png"),
        });
    }
    scene
}

fn clip(frames: &[Frame]) -> EvalClip<'_> {
    let frames = frames.iter().map(|f| EvalFrame {
        time: f.time,
        image: &f.image,
        pose: Some(f.camera.pose),
        truth: Some(&f.truth),
    });
    EvalClip { frames: frames.collect() }
}

fn run(frames: &[Frame], scene: &Scene, target_poses: TargetPoses) -> EvalReport {
    let options = EvalOptions { target_poses, ..EvalOptions::new(Protocol::storm20(frames.len()).unwrap()) };
    evaluate(&clip(frames), scene, &mut Renderer::new(2).unwrap(), &options).unwrap()
}

#[test]
fn a_true_scene_scores_high_and_its_ablations_lower() {
    let frames: Vec<Frame> = (0..FRAMES).map(frame).collect();
    let scene = perfect_scene(&frames, &[0, 5, 10, 15]);
    let report = run(&frames, &scene, TargetPoses::Predicted);
    println!("{}", report.to_markdown());
    assert_eq!(
        (report.context_frames, report.interpolation_frames, report.extrapolation_frames, report.clips),
        (4, 12, 4, 1)
    );
    let get = |method, part, metric| report.scores(method, part).get(metric).unwrap();
    let model = |metric| get(Method::Model, Part::All, metric);
    assert!(model(Metric::PsnrFull) > 25.0 && model(Metric::SsimFull) > 0.9);
    assert!(model(Metric::PsnrDynamic) > 25.0);
    // Only blurred edges are wrong: a mixed pixel's velocity is between the box's and 0.
    assert!(model(Metric::VelocityEpe) < 0.1 * f64::from(BOX_SPEED) && model(Metric::StaticSpeed) < 0.1);
    assert!((model(Metric::VelocitySpeed) - f64::from(BOX_SPEED)).abs() < 1e-6);
    assert!(model(Metric::DynamicIou) > 0.9);
    assert!(model(Metric::DepthAbsRel) < 0.02 && model(Metric::DepthDelta1) > 0.97);
    assert!(model(Metric::RotationDeg) < 1e-6 && model(Metric::TranslationError) < 1e-9);
    for part in [Part::Interpolation, Part::Extrapolation] {
        let gain = |other, metric| get(Method::Model, part, metric) - get(other, part, metric);
        // Without motion the box stands still between the frames.
        assert!(gain(Method::NoMotion, Metric::PsnrDynamic) > 6.0, "{part:?}");
        assert!(gain(Method::NoMotion, Metric::SsimDynamic) > 0.1, "{part:?}");
        assert!(gain(Method::CopyNearest, Metric::PsnrDynamic) > 6.0, "{part:?}");
        assert!(gain(Method::CopyNearest, Metric::PsnrFull) > 3.0, "{part:?}");
        let depth = |method| get(method, part, Metric::DepthRmseDynamic);
        assert!(depth(Method::NoMotion) > depth(Method::Model), "{part:?}");
    }
    // The box crosses the view.
    assert_eq!(model(Metric::VelocityEpeCrossing), model(Metric::VelocityEpe));
    assert_eq!(model(Metric::RotationIdentityDeg), 0.0);
    // Context frames at 0.5, 1.0 and 1.5 seconds.
    assert!((model(Metric::Travel) - 0.29f64.sqrt()).abs() < 1e-9);
    assert_eq!(report.scores(Method::CopyNearest, Part::All).get(Metric::DepthRmseFull), None);
}

#[test]
fn oracles_and_ablations_are_added() {
    let frames: Vec<Frame> = (0..FRAMES).map(frame).collect();
    let context = [0, 5, 10, 15];
    let scene = perfect_scene(&frames, &context);
    let options = EvalOptions::new(Protocol::storm20(FRAMES).unwrap());
    let renderer = &mut Renderer::new(2).unwrap();
    // The network's own depth is true, its sky covers the upper half; nothing is sky.
    let depth: Vec<f32> = context.iter().flat_map(|&c| frames[c].truth.depth.clone()).collect();
    let pixels = (SIZE.0 * SIZE.1) as usize;
    let sky: Vec<bool> = (0..4 * pixels).map(|i| i % pixels < pixels / 2).collect();
    let subject = Subject { scene: &scene, depth: Some(&depth), sky: Some(&sky) };
    let mut report = evaluate_subject(&clip(&frames), &subject, renderer, &options).unwrap();
    let plain = run(&frames, &scene, TargetPoses::Predicted);
    assert_eq!(report.get(Metric::PsnrFull), plain.get(Metric::PsnrFull));
    assert_eq!((report.get(Metric::ContextDepthAbsRel), report.get(Metric::SkyIou)), (Some(0.0), Some(0.0)));
    assert_eq!(plain.get(Metric::SkyIou), None);

    // A backward pass that is wrong does not hurt what looks forward only.
    let mut wrong = scene.clone();
    wrong.v_bwd.iter_mut().for_each(|v| *v = v.map(|x| -2.0 * x));
    for (method, scene) in [(Method::NoCausal, &wrong), (Method::ForwardOnly, &wrong), (Method::Oracle, &scene)] {
        measure(&mut report, method, &clip(&frames), &scene.into(), (renderer, &options)).unwrap();
    }
    let get = |m: Method, metric| report.scores(m, Part::Interpolation).get(metric).unwrap();
    // A box that flies off backwards leaves the place of the other one, which is drawn right.
    let full = |m| get(m, Metric::PsnrFull);
    assert!(full(Method::NoCausal) + 6.0 < full(Method::ForwardOnly), "{}", report.to_markdown());
    let dynamic = |m| get(m, Metric::PsnrDynamic);
    assert!(dynamic(Method::ForwardOnly) > dynamic(Method::NoMotion) + 6.0);
    assert!((dynamic(Method::Oracle) - dynamic(Method::Model)).abs() < 0.5);
    let json = report.to_json();
    assert!(json["bounds"]["oracle"]["interpolation"]["psnr_full_db"].is_number());
    assert!(json["ablations"]["forward_only"]["psnr_full_db"].is_number());
    assert_eq!(report.methods().count(), 6);
    assert_eq!(json["velocity_epe_crossing_ratio"], json["velocity_epe_ratio"]);
}

#[test]
fn a_copy_scores_what_the_two_frames_score() {
    let frames: Vec<Frame> = (0..6).map(frame).collect();
    let scene = perfect_scene(&frames, &[0, 5]);
    let report = run(&frames, &scene, TargetPoses::Predicted);
    let unit = |f: &Frame| f.image.data.iter().map(|&b| f32::from(b) / 255.0).collect::<Vec<_>>();
    // Frames 1 and 2 copy frame 0, 3 and 4 copy frame 5.
    let pairs = [(0, 1), (0, 2), (5, 3), (5, 4)];
    let want = pairs.map(|(a, b)| sf_eval::metrics::psnr(&unit(&frames[a]), &unit(&frames[b])).unwrap());
    let got = report.scores(Method::CopyNearest, Part::Interpolation).get(Metric::PsnrFull).unwrap();
    assert!((got - want.iter().sum::<f64>() / 4.0).abs() < 1e-12);
    assert_eq!(report.extrapolation_frames, 0);
    assert!(report.to_json()["extrapolation"]["psnr_full_db"].is_null());
}

#[test]
fn another_world_and_unit_are_aligned() {
    let frames: Vec<Frame> = (0..FRAMES).map(frame).collect();
    let scene = perfect_scene(&frames, &[0, 5, 10, 15]);
    let plain = run(&frames, &scene, TargetPoses::AlignedTruth);
    // The same prediction in a world that is turned, moved and a third as large.
    let turn = glam::DMat3::from_axis_angle(DVec3::new(0.3, 1.0, -0.2).normalize(), 1.1);
    let shift = DVec3::new(5.0, -3.0, 0.5);
    let scale = 1.0 / 3.0;
    let mut other = scene.clone();
    let turned = |v: [f32; 3]| (scale * (turn * DVec3::from_array(v.map(f64::from)))).as_vec3().to_array();
    let q = glam::DQuat::from_mat3(&turn);
    for i in 0..other.len() {
        let m = DVec3::from_array(other.gaussians.mean[i].map(f64::from));
        other.gaussians.mean[i] = (scale * (turn * m) + shift).as_vec3().to_array();
        other.gaussians.scale[i] = other.gaussians.scale[i].map(|s| s * scale as f32);
        other.gaussians.quat[i] = [q.w as f32, q.x as f32, q.y as f32, q.z as f32];
        (other.v_fwd[i], other.v_bwd[i]) = (turned(other.v_fwd[i]), turned(other.v_bwd[i]));
    }
    for f in &mut other.frames {
        let p = f.camera.pose;
        f.camera.pose = Pose { r: turn * p.r, t: scale * (turn * p.t) + shift };
    }
    let aligned = run(&frames, &other, TargetPoses::AlignedTruth);
    // Here the box's layers have exactly one depth and are drawn in frame order, there rounding shuffles them,
    // so its pixels differ a little.
    assert!((plain.get(Metric::PsnrDynamic).unwrap() - aligned.get(Metric::PsnrDynamic).unwrap()).abs() < 4.0);
    for metric in [Metric::PsnrFull, Metric::DepthRmseFullScaled, Metric::VelocityEpeScaled] {
        let (a, b) = (plain.get(metric).unwrap(), aligned.get(metric).unwrap());
        assert!((a - b).abs() < 0.02 * a.max(0.1), "{metric:?}: {a} and {b}");
    }
    // Raw numbers show the wrong unit.
    let third = 2.0 / 3.0;
    assert!((aligned.get(Metric::VelocityEpe).unwrap() - third * f64::from(BOX_SPEED)).abs() < 0.1);
    assert!((aligned.get(Metric::DepthAbsRel).unwrap() - third).abs() < 0.02);
    assert!(aligned.get(Metric::RotationDeg).unwrap() < 1e-6);
    assert!(aligned.get(Metric::TranslationErrorScaled).unwrap() < 1e-6);
}

#[test]
fn a_clip_without_truth_still_has_pictures() {
    let frames: Vec<Frame> = (0..6).map(frame).collect();
    let scene = perfect_scene(&frames, &[0, 5]);
    let mut bare = clip(&frames);
    for f in &mut bare.frames {
        (f.pose, f.truth) = (None, None);
    }
    let options = EvalOptions::new(Protocol::storm20(6).unwrap());
    let renderer = &mut Renderer::new(1).unwrap();
    let report = evaluate(&bare, &scene, renderer, &options).unwrap();
    assert!(report.get(Metric::PsnrFull).is_some() && report.get(Metric::SsimFull).is_some());
    for metric in [Metric::PsnrDynamic, Metric::DepthRmseFull, Metric::VelocityEpe, Metric::RotationDeg] {
        assert_eq!(report.get(metric), None);
    }
    let truth_poses = EvalOptions { target_poses: TargetPoses::AlignedTruth, ..options.clone() };
    assert_eq!(evaluate(&bare, &scene, renderer, &truth_poses).unwrap_err().status(), Status::Input);
    // A scene of other frames, and a clip that is too short.
    let mut late = scene.clone();
    late.frames[1].time += 0.05;
    assert_eq!(evaluate(&bare, &late, renderer, &options).unwrap_err().status(), Status::Input);
    bare.frames.pop();
    assert_eq!(evaluate(&bare, &scene, renderer, &options).unwrap_err().status(), Status::Input);
}

#[test]
fn pictures_of_another_size_are_resized_to_the_scene() {
    let frames: Vec<Frame> = (0..6).map(frame).collect();
    let mut scene = perfect_scene(&frames, &[0, 5]);
    for f in &mut scene.frames {
        f.camera = f.camera.resized(42, 28);
    }
    let report = run(&frames, &scene, TargetPoses::Predicted);
    assert!(report.get(Metric::PsnrFull).unwrap() > 20.0);
    assert!(report.get(Metric::DepthAbsRel).unwrap() < 0.05);
}
