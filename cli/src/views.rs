//! Which camera sees the scene at which time: the views that `render` and `demo` draw.

use crate::args::{Shift, Size};
use sf_formats::camera_json::TimedCamera;
use sf_formats::image_io::Rgb8;
use sf_formats::{Camera, Error, Pose, Result, Scene};
use sf_splat::Rendered;

/// Where the cameras of a list of times come from.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) enum Rig {
    /// The input cameras, interpolated at the time.
    Follow,
    /// The camera of one input frame.
    Frame(usize),
    /// One input frame's camera, moved once around a circle of this radius (scene units; half up and
    /// down) while it looks at the same point.
    Orbit {
        /// Input frame.
        frame: usize,
        /// Scene units; none takes 5 % of the distance to the point.
        radius: Option<f64>,
    },
}

/// Views of an orbit when no times are asked for.
const ORBIT_VIEWS: usize = 36;

/// The views of a rig at some times (none: the input frames' times, or one turn of an orbit).
pub(crate) fn views(scene: &Scene, rig: Rig, times: Option<&[f64]>) -> Result<Vec<TimedCamera>> {
    let frame = |index: usize| {
        scene.frames.get(index).ok_or_else(|| {
            Error::input("--frame", format!("{index} does not exist: the scene has {} frames", scene.frames.len()))
        })
    };
    let times: Vec<f64> = match (times, rig) {
        (Some(t), _) => t.to_vec(),
        (None, Rig::Follow) => scene.frames.iter().map(|f| f.time).collect(),
        (None, Rig::Frame(i)) => vec![frame(i)?.time],
        (None, Rig::Orbit { frame: i, .. }) => vec![frame(i)?.time; ORBIT_VIEWS],
    };
    if let Some(t) = times.iter().find(|t| !t.is_finite()) {
        return Err(Error::input("--times", format!("{t} is not a time in seconds")));
    }
    let n = times.len();
    let view = |(i, &time): (usize, &f64)| {
        let camera = match rig {
            // Exactly at a frame its own camera, without the interpolation's rounding.
            Rig::Follow => match scene.frames.iter().find(|f| f.time == time) {
                Some(f) => f.camera,
                None => scene.camera_at(time)?,
            },
            Rig::Frame(f) => frame(f)?.camera,
            Rig::Orbit { frame: f, radius } => {
                let camera = frame(f)?.camera;
                let distance = typical_depth(scene, &camera);
                let turn = std::f64::consts::TAU * i as f64 / n as f64;
                orbit(&camera, distance, radius.unwrap_or(0.05 * distance), turn)
            }
        };
        Ok(TimedCamera { time, camera })
    };
    times.iter().enumerate().map(view).collect()
}

/// Median z-depth of the Gaussians in front of a camera; 10 where there are none.
fn typical_depth(scene: &Scene, camera: &Camera) -> f64 {
    let to_camera = camera.pose.inverse();
    // A few thousand give the median well enough.
    let step = (scene.len() / 4096).max(1);
    let mut depths: Vec<f64> = scene
        .gaussians
        .mean
        .iter()
        .step_by(step)
        .map(|m| to_camera.apply(glam::DVec3::new(m[0].into(), m[1].into(), m[2].into())).z)
        .filter(|z| z.is_finite() && *z > 1e-3)
        .collect();
    depths.sort_by(f64::total_cmp);
    depths.get(depths.len() / 2).copied().unwrap_or(10.0)
}

/// The camera displaced on an ellipse in its image plane, turned to the point `distance` ahead.
fn orbit(camera: &Camera, distance: f64, radius: f64, turn: f64) -> Camera {
    let offset = glam::DVec3::new(radius * turn.sin(), -0.5 * radius * turn.cos(), 0.0);
    let forward = (glam::DVec3::new(0.0, 0.0, distance) - offset).normalize();
    let right = glam::DVec3::Y.cross(forward).normalize();
    let down = forward.cross(right);
    let step = Pose { r: glam::DMat3::from_cols(right, down, forward), t: offset };
    Camera { pose: camera.pose.then(&step), ..*camera }
}

/// The camera displaced and turned in its own axes (x right, y down, z forward).
pub(crate) fn shifted(camera: &Camera, shift: &Shift) -> Camera {
    let t = glam::DVec3::new(shift.right, -shift.up, shift.forward);
    // About y down a positive angle turns z towards x: to the right. About x right a positive angle
    // turns y (down) towards z: upwards. About z forward a positive angle is clockwise.
    let r = glam::DMat3::from_rotation_y(shift.yaw.to_radians())
        * glam::DMat3::from_rotation_x(shift.pitch.to_radians())
        * glam::DMat3::from_rotation_z(shift.roll.to_radians());
    Camera { pose: camera.pose.then(&Pose { r, t }), ..*camera }
}

/// The camera at another size: the shorter fit of the field of view is kept, so nothing is stretched.
pub(crate) fn sized(camera: &Camera, size: Size) -> Result<Camera> {
    let (w, h) = (size.width, size.height);
    let mut out = Camera { width: w, height: h, ..*camera };
    if w == 0 || h == 0 {
        out.check("--size")?;
    }
    let scale = (f64::from(w) / f64::from(camera.width)).min(f64::from(h) / f64::from(camera.height));
    let k = camera.k;
    out.k.fx = k.fx * scale;
    out.k.fy = k.fy * scale;
    // The principal point keeps its place relative to the image centre.
    out.k.cx = f64::from(w) / 2.0 + (k.cx - f64::from(camera.width) / 2.0) * scale;
    out.k.cy = f64::from(h) / 2.0 + (k.cy - f64::from(camera.height) / 2.0) * scale;
    out.check("--size")?;
    Ok(out)
}

/// The colours of a drawn view as bytes.
pub(crate) fn rgb8(drawn: &Rendered) -> Rgb8 {
    let data = drawn.rgb.iter().map(|v| (v.clamp(0.0, 1.0) * 255.0).round() as u8).collect();
    Rgb8::new(drawn.width as u32, drawn.height as u32, data)
}

#[cfg(test)]
mod tests {
    use super::*;
    use glam::{DMat3, DVec3};
    use sf_formats::{Gaussians, Intrinsics, scene};

    fn camera(t: DVec3) -> Camera {
        Camera {
            width: 40,
            height: 20,
            k: Intrinsics { fx: 30.0, fy: 30.0, cx: 20.0, cy: 10.0 },
            pose: Pose { r: DMat3::from_rotation_y(0.3), t },
        }
    }

    fn street() -> Scene {
        let frame = |f: u32| scene::SceneFrame {
            time: f64::from(f),
            camera: camera(DVec3::new(0.0, 0.0, f64::from(f))),
            source_size: (40, 20),
            name: String::new(),
        };
        // One point 8 units in front of the first camera.
        let p = camera(DVec3::ZERO).pose.apply(DVec3::new(0.0, 0.0, 8.0));
        Scene {
            gaussians: Gaussians {
                mean: vec![p.as_vec3().to_array()],
                scale: vec![[0.1; 3]],
                quat: vec![[1.0, 0.0, 0.0, 0.0]],
                opacity: vec![0.8],
                colour: vec![[0.5; 3]],
            },
            v_fwd: vec![[0.0; 3]],
            v_bwd: vec![[0.0; 3]],
            dynamic: vec![0.0],
            source: vec![0],
            frames: (0..3).map(frame).collect(),
            compose: scene::Compose::default(),
            splat: scene::SplatSettings::default(),
            notes: Vec::new(),
        }
    }

    #[test]
    fn following_takes_the_input_cameras_and_goes_between_them() {
        let s = street();
        let all = views(&s, Rig::Follow, None).unwrap();
        assert_eq!(all.iter().map(|v| v.time).collect::<Vec<_>>(), [0.0, 1.0, 2.0]);
        assert_eq!(all[0].camera, s.frames[0].camera);
        let between = views(&s, Rig::Follow, Some(&[0.5, 3.0])).unwrap();
        assert!((between[0].camera.pose.t - DVec3::new(0.0, 0.0, 0.5)).length() < 1e-12);
        assert!((between[1].camera.pose.t - DVec3::new(0.0, 0.0, 3.0)).length() < 1e-12);
    }

    #[test]
    fn a_fixed_frame_keeps_its_camera_while_time_passes() {
        let s = street();
        let v = views(&s, Rig::Frame(2), Some(&[0.0, 0.7])).unwrap();
        assert!(v.iter().all(|v| v.camera == s.frames[2].camera));
        assert_eq!(views(&s, Rig::Frame(1), None).unwrap()[0].time, 1.0);
        let e = views(&s, Rig::Frame(3), None).unwrap_err();
        assert_eq!(e.status() as i32, 3);
        assert!(e.to_string().contains("3 frames"));
    }

    #[test]
    fn s14_a_time_that_is_no_number_is_refused() {
        for t in [f64::NAN, f64::INFINITY] {
            for rig in [Rig::Follow, Rig::Frame(0)] {
                assert_eq!(views(&street(), rig, Some(&[0.0, t])).unwrap_err().status() as i32, 3);
            }
        }
    }

    #[test]
    fn an_orbit_looks_at_one_point_from_a_circle() {
        let s = street();
        let v = views(&s, Rig::Orbit { frame: 0, radius: None }, None).unwrap();
        assert_eq!(v.len(), 36);
        let m = s.gaussians.mean[0];
        let target = DVec3::new(m[0].into(), m[1].into(), m[2].into());
        for view in &v {
            view.camera.check("view").unwrap();
            let (u, w, z) = view.camera.project(target);
            assert!((u - 20.0).abs() < 1e-4 && (w - 10.0).abs() < 1e-4 && z > 7.9, "{u} {w} {z}");
            let r = (view.camera.pose.t - s.frames[0].camera.pose.t).length();
            assert!(r < 0.41 && r > 0.19, "{r}");
        }
        // A quarter turn stands to the right.
        let right = s.frames[0].camera.pose.inverse().apply(v[9].camera.pose.t);
        assert!((right - DVec3::new(0.4, 0.0, 0.0)).length() < 1e-6, "{right}");
    }

    #[test]
    fn shifts_go_where_they_say() {
        let c = camera(DVec3::new(1.0, 2.0, 3.0));
        let local = |s: &str| {
            let moved = shifted(&c, &s.parse().unwrap());
            moved.check("moved").unwrap();
            let step = c.pose.inverse().then(&moved.pose);
            (step.t, step.r * DVec3::Z, step.r * DVec3::X)
        };
        let near = |a: DVec3, b: DVec3| assert!((a - b).length() < 1e-12, "{a} {b}");
        near(local("right=1.5,up=0.3,forward=2").0, DVec3::new(1.5, -0.3, 2.0));
        near(local("yaw=90").1, DVec3::X);
        near(local("pitch=90").1, -DVec3::Y);
        near(local("roll=90").2, DVec3::Y);
    }

    #[test]
    fn s12_sizes_keep_the_view_and_bad_ones_are_refused() {
        let c = camera(DVec3::ZERO);
        let twice = sized(&c, Size { width: 80, height: 40 }).unwrap();
        assert_eq!((twice.k.fx, twice.k.cx, twice.k.cy), (60.0, 40.0, 20.0));
        let tall = sized(&c, Size { width: 40, height: 80 }).unwrap();
        assert_eq!((tall.k.fx, tall.k.fy, tall.k.cx, tall.k.cy), (30.0, 30.0, 20.0, 40.0));
        sized(&c, Size { width: 1, height: 1 }).unwrap();
        for (w, h, status) in [(0, 5, 3), (5, 0, 3), (65_536, 65_536, 5)] {
            let e = sized(&c, Size { width: w, height: h }).unwrap_err();
            assert_eq!(e.status() as i32, status, "{w}x{h}");
        }
    }
}
