//! [`SceneSpec`]: the plan of a street, drawn from a seed. What stands where is in [`crate::frontage`], what
//! moves in [`crate::traffic`].

use crate::camera_motion::{Ego, Ride, Turning, turning_path};
use crate::frontage;
use crate::ground::{Direction, Ground, Road};
use crate::light::Light;
use crate::math::Rng;
use crate::motion::{Path, Speed};
use crate::raycast::Scene;
use crate::street::Style;
use crate::traffic;

/// Seconds for which every street is laid out, however short the clip: clips up to this length show the
/// same street at any frame count.
const LAID_OUT: f64 = 4.0;
/// Where the camera car's path begins, metres before the street's origin.
pub(crate) const RUN_UP: f64 = 30.0;

/// Everything a clip is rendered from.
#[derive(Clone, Debug)]
pub struct SceneSpec {
    pub(crate) scene: Scene,
    pub(crate) ego: Ego,
    pub(crate) hfov: f64,
}

/// What the planners share.
pub(crate) struct Plan<'a> {
    pub(crate) seed: u64,
    pub(crate) style: &'a Style,
    pub(crate) ground: &'a Ground,
    pub(crate) ego: &'a Ego,
    /// The camera car's lane offset.
    pub(crate) lane: f64,
    /// Seconds to plan for.
    pub(crate) seconds: f64,
    /// Metres the camera car drives in that time.
    pub(crate) travel: f64,
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

/// Route of the camera car, before there is ground under it.
struct Drive {
    curvature: f64,
    road: Road,
    /// Crossing street: where, and its cross-section.
    cross: Option<(f64, Road)>,
    crosswalks: Vec<f64>,
    turning: Turning,
    lane: f64,
    /// Offset of the lane turned into, and the radius.
    turn: (f64, f64),
    v0: f64,
    a: f64,
}

impl Drive {
    fn draw(rng: &mut Rng, style: &Style) -> Drive {
        let u = rng.unit();
        let lanes = if u < 0.5 {
            1
        } else if u < 0.92 {
            2
        } else {
            3
        };
        let road = Road::draw(rng, lanes);
        let other_lanes = 1 + rng.below(2) as u32;
        let other = Road::draw(rng, other_lanes);
        let turning = if rng.chance(style.turning) { rng.pick(&[Turning::Left, Turning::Right]) } else { Turning::No };
        let bend = rng.normal(0.0, style.curvature).clamp(-0.018, 0.018);
        let crossing = rng.chance(style.crossing);
        let pace = rng.unit();
        let (cruise, crawl) = (rng.range(style.speed.0, style.speed.1), rng.range(0.5, 4.0));
        let mut a = rng.normal(0.0, style.acceleration);
        let ahead = rng.range(7.0, 38.0);
        let walks = rng.chance(0.35).then(|| rng.range(10.0, 36.0));

        if turning != Turning::No {
            let v0 = rng.range(3.8, 7.2);
            a *= 0.5;
            // How far the turn's beginning lies ahead, in seconds of driving.
            let lead = v0 * rng.range(-0.5, 0.8);
            let left = turning == Turning::Left;
            let k = if left { 0 } else { lanes - 1 };
            let lane = road.lane_centre(k, Direction::With);
            let into = if left { rng.below(other_lanes as usize) as u32 } else { other_lanes - 1 };
            let w = f64::from(other.lane) * (f64::from(into) + 0.5);
            let radius = if left {
                rng.range(8.5, 12.5)
            } else {
                let gap = (f64::from(road.right) + lane).min(f64::from(other.left) - w);
                4.0 + gap + rng.range(0.0, 0.8)
            };
            let s = lead + radius + if left { -w } else { w };
            return Drive {
                curvature: 0.25 * bend,
                road,
                cross: Some((s, other)),
                crosswalks: vec![],
                turning,
                lane,
                turn: (w, radius),
                v0,
                a,
            };
        }
        let standing = pace < style.standing;
        let v0 = if standing {
            a = 0.0;
            0.0
        } else if pace < style.standing + style.slow {
            a *= 0.5;
            crawl
        } else {
            cruise
        };
        let lane = road.lane_centre(rng.below(lanes as usize) as u32, Direction::With);
        // Who stands mostly waits at a crossing.
        let crossing = crossing || (standing && rng.chance(0.6));
        let cross = crossing.then(|| {
            let s = if standing { f64::from(other.left) + 7.5 + 0.1 * ahead } else { f64::from(other.left) + ahead };
            (s, other)
        });
        let crosswalks = if cross.is_some() { vec![] } else { walks.into_iter().collect() };
        let curvature = if cross.is_some() { 0.25 * bend } else { bend };
        Drive { curvature, road, cross, crosswalks, turning, lane, turn: (0.0, 0.0), v0, a }
    }

    fn ground(&self, rng: &mut Rng) -> Ground {
        Ground::draw(rng, self.curvature, self.road, self.cross, self.crosswalks.clone())
    }

    fn route(&self, ground: &Ground) -> (Path, Speed) {
        let path = turning_path(ground, (-RUN_UP, self.lane), self.turning, self.turn.0, self.turn.1);
        let run_up = RUN_UP * (1.0 - self.curvature * self.lane);
        (path, Speed { s0: run_up, v0: self.v0, a: self.a })
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::body::{Body, Rig};
    use crate::raycast::ID_FIRST;
    use crate::street::{Options, Street};
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

    /// Pixels: the velocity of a frame is the field of a node of the object it shows, in the first camera's axes.
    #[test]
    fn pixels_show_the_velocity_of_their_part() {
        let options = Options { width: 126, height: 84, ..Options::default() };
        let mut moving = 0;
        for seed in 0..8 {
            let street = Street::new(seed, options.clone()).unwrap();
            let frame = street.frame(7);
            let bodies = &street.spec().scene.bodies;
            let (r0, t0) = street.spec().ego.pose(0.0);
            let mut nodes = Vec::new();
            for i in 0..frame.id.len() {
                if frame.id[i] < ID_FIRST {
                    continue;
                }
                let body = &bodies[usize::from(frame.id[i] - ID_FIRST)];
                let (x, y) = (i % 126, i / 126);
                let p = frame.camera.unproject(x as f64 + 0.5, y as f64 + 0.5, f64::from(frame.depth[i]));
                body.motions(frame.time, &mut nodes);
                let v = DVec3::from(frame.velocity[i].map(f64::from));
                let off = |m: &crate::motion::Motion| (r0.transpose() * m.velocity_at(r0 * p + t0) - v).length();
                let least = nodes.iter().map(off).fold(f64::INFINITY, f64::min);
                assert!(least < 1e-4, "seed {seed} pixel {i}: off by {least} m/s");
                moving += usize::from(v.length() > 1.0);
            }
        }
        assert!(moving > 1_000, "{moving}");
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
