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
    /// Behind and above the input cameras, looking where they look.
    Chase {
        /// Scene units behind, a third of it above; none takes a tenth of the distance to what is seen.
        back: Option<f64>,
    },
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
        (None, Rig::Follow | Rig::Chase { .. }) => scene.frames.iter().map(|f| f.time).collect(),
        (None, Rig::Frame(i)) => vec![frame(i)?.time],
        (None, Rig::Orbit { frame: i, .. }) => vec![frame(i)?.time; ORBIT_VIEWS],
    };
    if let Some(t) = times.iter().find(|t| !t.is_finite()) {
        return Err(Error::input("--times", format!("{t} is not a time in seconds")));
    }
    let n = times.len();
    // One distance for all views, so that the camera does not swing back and forth.
    let chased = match rig {
        Rig::Chase { back: None } => typical_depth(scene, &frame(0)?.camera),
        _ => 0.0,
    };
    let view = |(i, &time): (usize, &f64)| {
        let camera = match rig {
            Rig::Follow => along(scene, time)?,
            Rig::Chase { back } => {
                let camera = along(scene, time)?;
                chase(&camera, back.unwrap_or(0.1 * chased))
            }
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

/// The input camera at a time.
fn along(scene: &Scene, time: f64) -> Result<Camera> {
    // Exactly at a frame its own camera, without the interpolation's rounding.
    match scene.frames.iter().find(|f| f.time == time) {
        Some(f) => Ok(f.camera),
        None => scene.camera_at(time),
    }
}

/// The camera moved back and up, turned to a point four times as far ahead as it moved back.
fn chase(camera: &Camera, back: f64) -> Camera {
    let offset = glam::DVec3::new(0.0, -back / 3.0, -back);
    let forward = (glam::DVec3::new(0.0, 0.0, 4.0 * back) - offset).normalize();
    let down = forward.cross(glam::DVec3::X);
    let step = Pose { r: glam::DMat3::from_cols(glam::DVec3::X, down, forward), t: offset };
    Camera { pose: camera.pose.then(&step), ..*camera }
}

/// The camera turned in its place to a point of the world; it keeps its horizon.
pub(crate) fn aimed(camera: &Camera, point: glam::DVec3) -> Camera {
    let forward = (point - camera.pose.t).normalize_or_zero();
    let right = (camera.pose.r * glam::DVec3::Y).cross(forward).normalize_or_zero();
    if right == glam::DVec3::ZERO {
        // The point is in the camera, or straight above or below it.
        return *camera;
    }
    let pose = Pose { r: glam::DMat3::from_cols(right, forward.cross(right), forward), t: camera.pose.t };
    Camera { pose, ..*camera }
}

/// Where one moving thing is at any time: [`Track::of`] finds it, [`Track::at`] tells.
#[derive(Clone, Debug)]
pub(crate) struct Track(Vec<(f64, glam::DVec3)>);

impl Track {
    /// Follows what source frame `frame` sees at a pixel. The thing is the dynamic Gaussian that is nearest to
    /// the pixel; from its frame to the next it moves with the mean v+ of its frame's dynamic Gaussians around it (a
    /// tenth of its depth), to the frame before with their v-, and so on from frame to frame.
    ///
    /// # Errors
    /// Status 3 when the frame does not exist, or nothing dynamic is within a tenth of its width of the pixel.
    pub(crate) fn of(scene: &Scene, frame: usize, pixel: (f64, f64)) -> Result<Track> {
        let Some(source) = scene.frames.get(frame) else {
            let why = format!("frame {frame} does not exist: the scene has {} frames", scene.frames.len());
            return Err(Error::input("--look-at", why));
        };
        let moves = |i: &usize| scene.dynamic[*i] > scene.compose.tau;
        let place = |i: usize| glam::DVec3::from_array(scene.gaussians.mean[i].map(f64::from));
        let off = |i: usize| {
            let (u, v, z) = source.camera.project(place(i));
            if z > 1e-3 { (u - pixel.0).hypot(v - pixel.1) } else { f64::INFINITY }
        };
        let own = (0..scene.len()).filter(|&i| scene.source[i] as usize == frame).filter(moves);
        let nearest = own.map(|i| (i, off(i))).min_by(|a, b| a.1.total_cmp(&b.1));
        let Some((start, _)) = nearest.filter(|n| n.1 <= 0.1 * f64::from(source.camera.width)) else {
            let why = format!("nothing that moves is near pixel {},{} of frame {frame}", pixel.0, pixel.1);
            return Err(Error::input("--look-at", why));
        };
        let radius = 0.1 * source.camera.project(place(start)).2;
        // Mean velocity around a point in one frame; none where nothing moves there.
        let drift = |f: usize, at: glam::DVec3, list: &[[f32; 3]]| {
            let near = (0..scene.len()).filter(|&i| scene.source[i] as usize == f).filter(moves);
            let near: Vec<usize> = near.filter(|&i| (place(i) - at).length() <= radius).collect();
            let sum: glam::DVec3 = near.iter().map(|&i| glam::DVec3::from_array(list[i].map(f64::from))).sum();
            (!near.is_empty()).then(|| sum / near.len() as f64)
        };
        let n = scene.frames.len();
        let mut path = vec![(source.time, place(start))];
        for (list, frames) in
            [(&scene.v_fwd, (frame + 1..n).collect::<Vec<_>>()), (&scene.v_bwd, (0..frame).rev().collect::<Vec<_>>())]
        {
            let (mut at, mut time, mut here, mut v) = (place(start), source.time, frame, glam::DVec3::ZERO);
            for next in frames {
                v = drift(here, at, list).unwrap_or(v);
                let dt = (scene.frames[next].time - time).abs();
                (at, time, here) = (at + v * dt, scene.frames[next].time, next);
                path.push((time, at));
            }
        }
        path.sort_by(|a, b| a.0.total_cmp(&b.0));
        Ok(Track(path))
    }

    /// Its place at a time: straight between the frames, and on beyond them.
    pub(crate) fn at(&self, time: f64) -> glam::DVec3 {
        let n = self.0.len();
        if n == 1 {
            return self.0[0].1;
        }
        let hi = self.0.iter().position(|p| p.0 >= time).unwrap_or(n - 1).max(1);
        let (a, b) = (self.0[hi - 1], self.0[hi]);
        a.1 + (b.1 - a.1) * ((time - a.0) / (b.0 - a.0))
    }
}

/// Median z-depth of the Gaussians in front of a camera; 10 where there are none.
pub(crate) fn typical_depth(scene: &Scene, camera: &Camera) -> f64 {
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
    fn chasing_stays_behind_and_above_and_looks_ahead() {
        let s = street();
        let v = views(&s, Rig::Chase { back: Some(3.0) }, Some(&[0.5])).unwrap();
        let ego = s.camera_at(0.5).unwrap();
        let step = ego.pose.inverse().then(&v[0].camera.pose);
        assert!((step.t - DVec3::new(0.0, -1.0, -3.0)).length() < 1e-12, "{}", step.t);
        v[0].camera.check("view").unwrap();
        let (u, w, z) = v[0].camera.project(ego.pose.apply(DVec3::new(0.0, 0.0, 12.0)));
        assert!((u - 20.0).abs() < 1e-9 && (w - 10.0).abs() < 1e-9 && z > 15.0, "{u} {w} {z}");
        // A tenth of 8 units without a number.
        let v = views(&s, Rig::Chase { back: None }, None).unwrap();
        assert_eq!(v.len(), 3);
        let step = s.frames[1].camera.pose.inverse().then(&v[1].camera.pose);
        assert!((step.t.z + 0.8).abs() < 1e-6, "{}", step.t);
    }

    #[test]
    fn a_track_goes_with_the_velocities_and_an_aimed_camera_sees_it_in_the_middle() {
        let mut s = street();
        // One thing in frame 1 that moves by (1, 0, 0) a second there and (2, 0, 0) in frame 2.
        let p = s.frames[1].camera.pose.apply(DVec3::new(0.0, 0.0, 8.0));
        s.gaussians.mean = vec![p.as_vec3().to_array(), (p + DVec3::X).as_vec3().to_array()];
        let g = &mut s.gaussians;
        (g.scale, g.quat, g.opacity, g.colour) =
            (vec![[0.1; 3]; 2], vec![[1.0, 0.0, 0.0, 0.0]; 2], vec![0.8; 2], vec![[0.5; 3]; 2]);
        (s.v_fwd, s.v_bwd) = (vec![[1.0, 0.0, 0.0], [2.0, 0.0, 0.0]], vec![[-1.0, 0.0, 0.0], [-2.0, 0.0, 0.0]]);
        (s.dynamic, s.source) = (vec![0.9; 2], vec![1, 2]);
        let track = Track::of(&s, 1, (21.0, 9.0)).unwrap();
        for (time, x) in [(0.0, -1.0), (0.5, -0.5), (1.0, 0.0), (1.5, 0.5), (2.0, 1.0), (2.5, 1.5)] {
            assert!((track.at(time) - p - DVec3::new(x, 0.0, 0.0)).length() < 1e-5, "{time}: {}", track.at(time));
        }
        let camera = aimed(&s.frames[0].camera, track.at(2.0));
        camera.check("aimed").unwrap();
        let (u, v, z) = camera.project(track.at(2.0));
        assert!((u - 20.0).abs() < 1e-9 && (v - 10.0).abs() < 1e-9 && z > 0.0);
        assert_eq!(aimed(&camera, camera.pose.t), camera);
        for (frame, pixel, why) in
            [(7, (20.0, 10.0), "3 frames"), (0, (20.0, 10.0), "nothing"), (1, (0.0, 0.0), "nothing")]
        {
            let e = Track::of(&s, frame, pixel).unwrap_err();
            assert!(e.status() as i32 == 3 && e.to_string().contains(why), "{e}");
        }
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
