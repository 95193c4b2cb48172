//! [`SceneSpec`]: the plan of a street, drawn from a seed. What stands where is in [`crate::frontage`], what
//! moves in [`crate::traffic`].

use crate::camera_motion::{Ego, Ride};
use crate::frontage;
use crate::light::Light;
use crate::math::Rng;
use crate::plan::{Drive, Plan};
use crate::raycast::Scene;
use crate::style::Style;
use crate::traffic;

/// Seconds for which every street is laid out, however short the clip: clips up to this length show the
/// same street at any frame count.
const LAID_OUT: f64 = 4.0;
/// Everything a clip is rendered from.
#[derive(Clone, Debug)]
pub struct SceneSpec {
    pub(crate) scene: Scene,
    pub(crate) ego: Ego,
    pub(crate) hfov: f64,
}

impl SceneSpec {
    /// The street of a seed, for clips of up to four seconds.
    pub fn from_seed(seed: u64, style: &Style) -> SceneSpec {
        SceneSpec::lasting(seed, style, LAID_OUT)
    }

    /// The street of a seed, long enough for a clip.
    pub fn lasting(seed: u64, style: &Style, seconds: f64) -> SceneSpec {
        let seconds = if seconds > LAID_OUT { seconds } else { LAID_OUT };
        let light = Light::draw(&mut Rng::new(seed, "light"), style.dim, style.sunny);
        let drive = Drive::draw(&mut Rng::new(seed, "drive"), style);
        let ground = drive.ground(&mut Rng::new(seed, "ground"));
        let (path, speed) = drive.route(&ground);
        let degree = std::f64::consts::PI / 180.0;
        let ride = Ride {
            height: style.camera_height,
            pitch: style.pitch * degree,
            yaw: style.yaw * degree,
            glance: style.glance,
        };
        let ego = Ego::draw(&mut Rng::new(seed, "ego"), path, speed, &ride);
        let travel = speed.at(seconds).0 - speed.s0;
        let plan = Plan { seed, style, ground: &ground, ego: &ego, lane: drive.lane, seconds, travel };
        let mut bodies = frontage::build(&plan);
        traffic::add(&plan, &mut bodies);
        let hfov = Rng::new(seed, "lens").range(style.hfov.0, style.hfov.1);
        SceneSpec { scene: Scene { ground, light, bodies }, ego, hfov }
    }

    /// Number of objects besides ground and sky.
    pub fn objects(&self) -> usize {
        self.scene.bodies.len()
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::body::{Body, Rig};
    use glam::DVec3;

    fn spec(seed: u64) -> SceneSpec {
        SceneSpec::from_seed(seed, &Style::default())
    }

    /// Every node of everything that moves: stored twist against the difference of its poses.
    #[test]
    fn velocities_are_derivatives_of_poses() {
        let h = 1e-5;
        let (mut checked, mut fastest) = (0, 0.0f64);
        for seed in 0..16 {
            for body in spec(seed).scene.bodies.iter().filter(|b| b.moves()) {
                for time in [0.23, 1.37] {
                    let at = |t: f64| {
                        let mut nodes = Vec::new();
                        body.motions(t, &mut nodes);
                        nodes
                    };
                    let (before, now, after) = (at(time - h), at(time), at(time + h));
                    for k in 0..now.len() {
                        let local = DVec3::new(0.21, -0.13, 0.17);
                        let point = |m: &crate::motion::Motion| m.r * local + m.t;
                        let difference = (point(&after[k]) - point(&before[k])) / (2.0 * h);
                        let exact = now[k].velocity_at(point(&now[k]));
                        assert!((difference - exact).length() < 1e-5, "seed {seed} node {k}: {difference} {exact}");
                        fastest = fastest.max(exact.length());
                        checked += 1;
                    }
                }
            }
        }
        assert!(checked > 1_000 && fastest > 10.0, "{checked} nodes, fastest {fastest} m/s");
    }

    /// Parked and driving vehicles come from one generator: same structure, told apart by speed alone.
    #[test]
    fn parked_and_moving_vehicles_look_alike() {
        let (mut parked, mut moving) = ([0usize; 32], [0usize; 32]);
        for seed in 0..30 {
            for body in spec(seed).scene.bodies {
                if let Body { rig: Rig::Drive { rider: None, .. }, .. } = body {
                    let sort = if body.moves() { &mut moving } else { &mut parked };
                    sort[body.parts.len()] += 1;
                }
            }
        }
        let (p, m) = (parked.iter().sum::<usize>(), moving.iter().sum::<usize>());
        assert!(p > 200 && m > 60, "{p} parked, {m} moving");
        // Cars (8 parts) dominate both; buses and lorries mostly drive.
        let share = |count: &[usize; 32], n: usize| count[8] as f64 / n as f64;
        assert!(share(&parked, p) > 0.9 && share(&moving, m) > 0.7);
    }

    #[test]
    fn nothing_drives_through_the_camera_car() {
        for seed in 0..40 {
            let s = spec(seed);
            let mut nodes = Vec::new();
            for body in s.scene.bodies.iter().filter(|b| b.moves()) {
                for k in 0..=20 {
                    let t = f64::from(k) * 0.1;
                    body.motions(t, &mut nodes);
                    let (_, eye) = s.ego.pose(t);
                    let gap = (nodes[0].t - eye).truncate().length();
                    assert!(gap > 1.6, "seed {seed} at {t} s: {gap} m");
                }
            }
        }
    }
}
