//! [`Plan`]: what everything is laid out along; [`Drive`]: the route of the camera car.

use crate::camera_motion::{Ego, Turning, turning_path};
use crate::ground::{Direction, Ground, Road};
use crate::math::Rng;
use crate::motion::{Path, Speed};
use crate::style::Style;

/// Where the camera car's path begins, metres before the street's origin.
const RUN_UP: f64 = 30.0;

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

/// Route of the camera car, before there is ground under it.
pub(crate) struct Drive {
    curvature: f64,
    road: Road,
    /// Crossing street: where, and its cross-section.
    cross: Option<(f64, Road)>,
    crosswalks: Vec<f64>,
    turning: Turning,
    pub(crate) lane: f64,
    /// Offset of the lane turned into, and the radius.
    turn: (f64, f64),
    v0: f64,
    a: f64,
}

impl Drive {
    /// Draws lanes, crossing, turn and pace.
    pub(crate) fn draw(rng: &mut Rng, style: &Style) -> Drive {
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

    /// The roads it drives on.
    pub(crate) fn ground(&self, rng: &mut Rng) -> Ground {
        Ground::draw(rng, self.curvature, self.road, self.cross, self.crosswalks.clone())
    }

    /// Path and speed on them.
    pub(crate) fn route(&self, ground: &Ground) -> (Path, Speed) {
        let path = turning_path(ground, (-RUN_UP, self.lane), self.turning, self.turn.0, self.turn.1);
        let run_up = RUN_UP * (1.0 - self.curvature * self.lane);
        (path, Speed { s0: run_up, v0: self.v0, a: self.a })
    }
}
