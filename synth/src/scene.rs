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
