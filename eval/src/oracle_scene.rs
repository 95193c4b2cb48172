//! [`oracle_scene`]: the scene that a perfect network would predict, from ground truth.
//!
//! One Gaussian per pixel, round, [`OracleOptions::size`] pixels wide where it stands: what the paper's network
//! does with its own depth, pose, velocity and mask. It is the upper bound of what the representation can
//! reach (occlusions and mixed pixels remain), and a scene with true geometry where no trained weights are.

use sf_formats::clip::{Clip, GroundTruth, TruthFrame};
use sf_formats::image_io::Rgb8;
use sf_formats::scene::{Compose, Gaussians, Scene, SceneFrame, SplatSettings};
use sf_formats::{Camera, Error, Result};

/// One true frame.
#[derive(Clone, Copy, Debug)]
pub struct OracleFrame<'a> {
    /// Seconds; ascending over the frames.
    pub time: f64,
    /// Camera at the picture's size, any world that is the same for all frames.
    pub camera: Camera,
    /// The picture.
    pub image: &'a Rgb8,
    /// Depth at the picture's size; velocity in that world and mask, nothing moves without them.
    pub truth: &'a TruthFrame,
    /// Name of the picture.
    pub name: &'a str,
}

/// What a Gaussian per pixel looks like.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct OracleOptions {
    /// Standard deviation, pixels of its own frame.
    pub size: f64,
    /// Opacity, 0..1.
    pub opacity: f32,
    /// z-depth given to pixels where no surface is seen (sky), scene units; none leaves them out.
    pub sky: Option<f64>,
    /// True speed above which a pixel without a mask is dynamic, scene units per second.
    pub dynamic_speed: f32,
    /// How the Gaussians that exist at a time are chosen.
    pub compose: Compose,
    /// Rasterizer conventions.
    pub splat: SplatSettings,
}

impl Default for OracleOptions {
    /// 0.4 pixels, opacity 0.95, sky 400 units away, 1 unit per second.
    fn default() -> OracleOptions {
        OracleOptions {
            size: 0.4,
            opacity: 0.95,
            sky: Some(400.0),
            dynamic_speed: 1.0,
            compose: Compose::default(),
            splat: SplatSettings::default(),
        }
    }
}

/// The true scene of some frames; its world is the first one's camera.
///
/// # Errors
/// Status 3 for no frames, times that do not ascend, a depth map of another size than its picture, and bad cameras.
pub fn oracle_scene(frames: &[OracleFrame], options: &OracleOptions) -> Result<Scene> {
    let first = frames.first().ok_or_else(|| Error::input("oracle scene", "no frames"))?;
    let to_world = first.camera.pose.inverse();
    let mut scene = Scene {
        gaussians: Gaussians::default(),
        v_fwd: Vec::new(),
        v_bwd: Vec::new(),
        dynamic: Vec::new(),
        source: Vec::new(),
        frames: Vec::with_capacity(frames.len()),
        compose: options.compose,
        splat: options.splat,
        notes: vec![("oracle".into(), "made from ground truth, not by a network".into())],
    };
    for (index, frame) in frames.iter().enumerate() {
        let at = format!("oracle scene, frame {index}");
        frame.camera.check(&at)?;
        let (w, h) = frame.image.size();
        let (truth, size) = (frame.truth, (frame.camera.width, frame.camera.height));
        if (truth.width, truth.height) != (w, h) || size != (w, h) {
            let why = format!(
                "picture {w}x{h}, camera {}x{}, depth {}x{}: one size is wanted",
                size.0, size.1, truth.width, truth.height
            );
            return Err(Error::input(at, why));
        }
        if scene.frames.last().is_some_and(|f| f.time >= frame.time) {
            return Err(Error::input(at, format!("time {} s does not ascend", frame.time)));
        }
        let camera = Camera { pose: to_world.then(&frame.camera.pose), ..frame.camera };
        push_pixels(&mut scene, index as u32, &camera, &to_world.r, frame, options);
        scene.frames.push(SceneFrame { time: frame.time, camera, source_size: (w, h), name: frame.name.to_owned() });
    }
    Ok(scene)
}

/// Adds the pixels of one frame.
fn push_pixels(
    scene: &mut Scene,
    index: u32,
    camera: &Camera,
    to_world: &glam::DMat3,
    frame: &OracleFrame,
    options: &OracleOptions,
) {
    let focal = 0.5 * (camera.k.fx + camera.k.fy);
    let truth = frame.truth;
    for y in 0..camera.height {
        for x in 0..camera.width {
            let i = y as usize * camera.width as usize + x as usize;
            let surface = truth.depth[i] > 0.0;
            let z = if surface {
                f64::from(truth.depth[i])
            } else if let Some(sky) = options.sky {
                sky
            } else {
                continue;
            };
            let v = truth.velocity.as_ref().map_or([0.0; 3], |v| v[i]);
            let v = *to_world * glam::DVec3::new(v[0].into(), v[1].into(), v[2].into());
            let fast = v.length() > f64::from(options.dynamic_speed);
            let moves = surface && truth.dynamic.as_ref().map_or(fast, |m| m[i]);
            let v = if moves { v.as_vec3() } else { glam::Vec3::ZERO };
            let centre = camera.unproject(f64::from(x) + 0.5, f64::from(y) + 0.5, z);
            let g = &mut scene.gaussians;
            g.mean.push(centre.as_vec3().to_array());
            g.scale.push([(options.size * z / focal) as f32; 3]);
            g.quat.push([1.0, 0.0, 0.0, 0.0]);
            g.opacity.push(options.opacity);
            g.colour.push(frame.image.pixel(x, y).map(|b| f32::from(b) / 255.0));
            scene.v_fwd.push(v.to_array());
            scene.v_bwd.push((-v).to_array());
            scene.dynamic.push(if moves { 1.0 } else { 0.0 });
            scene.source.push(index);
        }
    }
}

/// [`oracle_scene`] of some frames of a clip that was read from disk. `context`: positions in `clip.frames`.
///
/// # Errors
/// Status 3 when the clip has no poses, no intrinsics or no ground truth for a frame; and those of [`oracle_scene`].
pub fn oracle_of_clip(clip: &Clip, truth: &GroundTruth, context: &[usize], options: &OracleOptions) -> Result<Scene> {
    let missing = |what: &str| Error::input("oracle scene", format!("the clip has no {what}"));
    let poses = clip.poses.as_ref().ok_or_else(|| missing("poses"))?;
    let k = clip.intrinsics.ok_or_else(|| missing("intrinsics"))?;
    let mut frames = Vec::with_capacity(context.len());
    for &c in context {
        let frame = clip.frames.get(c).ok_or_else(|| missing(&format!("frame {c}")))?;
        let truth = truth.frames.get(c).ok_or_else(|| missing(&format!("ground truth of frame {c}")))?;
        let (width, height) = frame.image.size();
        // The intrinsics belong to the first picture.
        let k = k.resized(clip.frames[0].image.size(), (width, height));
        let camera = Camera { width, height, k, pose: poses[c] };
        frames.push(OracleFrame { time: frame.time, camera, image: &frame.image, truth, name: &frame.name });
    }
    oracle_scene(&frames, options)
}

#[cfg(test)]
mod tests {
    use super::*;
    use glam::{DMat3, DVec3};
    use sf_formats::{Intrinsics, Pose};

    const SIZE: (u32, u32) = (6, 4);

    fn truth() -> TruthFrame {
        let n = (SIZE.0 * SIZE.1) as usize;
        let mut t = TruthFrame {
            width: SIZE.0,
            height: SIZE.1,
            depth: vec![8.0; n],
            velocity: Some(vec![[0.0; 3]; n]),
            dynamic: Some(vec![false; n]),
        };
        t.depth[0] = 0.0;
        if let (Some(v), Some(d)) = (&mut t.velocity, &mut t.dynamic) {
            v[7] = [3.0, 0.0, 0.0];
            d[7] = true;
        }
        t
    }

    fn camera() -> Camera {
        // Stands at x = 5 and looks along -x of its world.
        let r = DMat3::from_rotation_y(-std::f64::consts::FRAC_PI_2);
        let k = Intrinsics { fx: 5.0, fy: 5.0, cx: 3.0, cy: 2.0 };
        Camera { width: SIZE.0, height: SIZE.1, k, pose: Pose { r, t: DVec3::new(5.0, 0.0, 0.0) } }
    }

    fn build(truth: &TruthFrame, options: &OracleOptions) -> Result<Scene> {
        let image = Rgb8::new(SIZE.0, SIZE.1, (0..3 * SIZE.0 * SIZE.1).map(|i| i as u8).collect());
        let camera = camera();
        let mut second = camera;
        second.pose.t.x = 4.0;
        let frame = |time, camera| OracleFrame { time, camera, image: &image, truth, name: "a.png" };
        oracle_scene(&[frame(0.0, camera), frame(0.5, second)], options)
    }

    #[test]
    fn pixels_become_points_of_the_first_cameras_world() {
        let scene = build(&truth(), &OracleOptions::default()).unwrap();
        assert_eq!(scene.len(), 48);
        assert_eq!(scene.frames[0].camera.pose, Pose::IDENTITY);
        // The second camera went one unit along its view.
        assert!((scene.frames[1].camera.pose.t - DVec3::Z).length() < 1e-12);
        let near = |a: [f32; 3], b: [f32; 3]| (0..3).all(|k| (a[k] - b[k]).abs() < 1e-4 * (1.0 + b[k].abs()));
        // Pixel 7 is column 1, row 1: ((1.5 - 3) / 5, (1.5 - 2) / 5, 1) * 8.
        assert!(near(scene.gaussians.mean[7], [-2.4, -0.8, 8.0]), "{:?}", scene.gaussians.mean[7]);
        assert!(near(scene.gaussians.mean[24 + 7], [-2.4, -0.8, 9.0]));
        assert!(near(scene.gaussians.scale[7], [0.4 * 8.0 / 5.0; 3]));
        assert_eq!((scene.source[7], scene.source[24 + 7]), (0, 1));
        assert_eq!(scene.gaussians.colour[7], [21, 22, 23].map(|b| b as f32 / 255.0));
        // World x is behind this camera: its z falls.
        assert!(near(scene.v_fwd[7], [0.0, 0.0, -3.0]), "{:?}", scene.v_fwd[7]);
        assert!(near(scene.v_bwd[7], [0.0, 0.0, 3.0]));
        assert_eq!(scene.dynamic.iter().filter(|&&p| p == 1.0).count(), 2);
        // Sky.
        assert!((scene.gaussians.mean[0][2] - 400.0).abs() < 1e-3);
        assert_eq!(build(&truth(), &OracleOptions { sky: None, ..OracleOptions::default() }).unwrap().len(), 46);
    }

    #[test]
    fn without_a_mask_speed_decides_and_bad_frames_are_refused() {
        let mut t = truth();
        t.dynamic = None;
        let moving = |o: &OracleOptions| build(&t, o).unwrap().dynamic.iter().filter(|&&p| p > 0.5).count();
        assert_eq!(moving(&OracleOptions::default()), 2);
        assert_eq!(moving(&OracleOptions { dynamic_speed: 4.0, ..OracleOptions::default() }), 0);
        let mut t = truth();
        (t.width, t.height) = (t.height, t.width);
        let e = build(&t, &OracleOptions::default()).unwrap_err();
        assert!(e.status() as i32 == 3 && e.to_string().contains("one size"), "{e}");
        assert_eq!(oracle_scene(&[], &OracleOptions::default()).unwrap_err().status() as i32, 3);
    }
}
