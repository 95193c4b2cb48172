//! What moves: vehicles in their lanes and across, people on pavements and crosswalks, cyclists.
//!
//! Candidates are drawn one by one and dropped when their track would touch the camera car or something
//! already accepted at any time of the clip.

use crate::body::Body;
use crate::camera_motion::{Turning, turning_path};
use crate::ground::{Cross, Direction};
use crate::math::Rng;
use crate::motion::{Arc, Path, Speed, follow};
use crate::people::{cyclist, pedestrian};
use crate::plan::Plan;
use crate::vehicles::Model;
use glam::{DVec2, DVec3};

/// Outline of something on the ground at a time: discs along its length.
struct Track {
    path: Path,
    speed: Speed,
    half_length: f64,
    radius: f64,
}

impl Track {
    fn discs(&self, t: f64) -> [DVec2; 3] {
        let m = follow(&self.path, &self.speed, t, 0.0);
        let (c, d) = (m.t.truncate(), m.r.x_axis.truncate() * (self.half_length - 0.6 * self.radius).max(0.0));
        [c - d, c, c + d]
    }

    fn touches(&self, other: &Track, seconds: f64) -> bool {
        let reach = self.radius + other.radius;
        let steps = (seconds * 8.0) as usize;
        (0..=steps).any(|i| {
            let t = i as f64 / 8.0;
            let others = other.discs(t);
            self.discs(t).iter().any(|a| others.iter().any(|b| (*a - *b).length_squared() < reach * reach))
        })
    }
}

/// Adds everything that moves to the objects that stand.
pub(crate) fn add(plan: &Plan, bodies: &mut Vec<Body>) {
    let mut tracks = vec![Track { path: plan.ego.path.clone(), speed: plan.ego.speed, half_length: 2.6, radius: 1.35 }];
    vehicles(plan, &mut Rng::new(plan.seed, "vehicles"), &mut tracks, bodies);
    people(plan, &mut Rng::new(plan.seed, "people"), &mut tracks, bodies);
}

fn vehicles(plan: &Plan, rng: &mut Rng, tracks: &mut Vec<Track>, bodies: &mut Vec<Body>) {
    let style = plan.style;
    if !rng.chance(style.traffic) {
        return;
    }
    let wanted = style.vehicles.0 + rng.below(style.vehicles.1 - style.vehicles.0 + 1);
    let mut placed = 0;
    for _ in 0..6 * wanted {
        if placed == wanted {
            break;
        }
        let mut own = Rng::new(rng.bits(), "vehicle");
        let bicycle = own.chance(0.12 * style.cyclists / 0.25);
        let model = Model::draw(&mut own, style.heavy);
        let (path, speed) = route(plan, &mut own, &model, bicycle);
        let (half_length, radius) = if bicycle { (0.9, 0.6) } else { (0.5 * model.length + 0.4, 0.55 * model.width) };
        let track = Track { path: path.clone(), speed, half_length, radius };
        if tracks.iter().any(|t| t.touches(&track, plan.seconds)) {
            continue;
        }
        bodies.push(if bicycle { cyclist(&mut own, path, speed) } else { model.place(path, speed) });
        tracks.push(track);
        placed += 1;
    }
}

/// Path and speed of one vehicle.
fn route(plan: &Plan, rng: &mut Rng, model: &Model, bicycle: bool) -> (Path, Speed) {
    let ground = plan.ground;
    let road = &ground.road;
    let lanes = road.lanes as usize;
    let cruise = if bicycle { rng.range(3.0, 6.5) } else { rng.range(3.5, 15.0) };
    let a = if bicycle { 0.0 } else { rng.normal(0.0, 0.7) };
    let kind = rng.unit();
    let kerbside = |n: f64| if bicycle { n.signum() * (f64::from(road.lanes as f32 * road.lane) - 0.7) } else { n };
    let ego = plan.ego.speed;
    match &ground.cross {
        Some(cross) if kind > 0.62 => return crossing(plan, rng, cross, (cruise, a)),
        _ => {}
    }
    if kind < 0.36 {
        let n = kerbside(road.lane_centre(rng.below(lanes) as u32, Direction::With));
        let same = (n - plan.lane).abs() < 1.0;
        let gap = 2.3 + 0.5 * model.length;
        let ahead = if same { gap + rng.range(2.5, 24.0) } else { rng.range(-2.0, 34.0) };
        let path = if !same && !bicycle && rng.chance(0.25) {
            lane_change(plan, ahead, n)
        } else {
            ground.lane_path(ahead, n, Direction::With)
        };
        let v0 = if same { (ego.v0 * rng.range(0.8, 1.35) + rng.range(0.0, 2.0)).min(16.0) } else { cruise };
        let a = if same { ego.a } else { a };
        return (path, Speed { s0: 0.0, v0, a });
    }
    let n = kerbside(road.lane_centre(rng.below(lanes) as u32, Direction::Against));
    // Near enough to be seen for most of the clip: both drive towards each other.
    let ahead = rng.range(5.0, 42.0) + 0.5 * ego.v0;
    (ground.lane_path(ahead, n, Direction::Against), Speed { s0: 0.0, v0: cruise, a })
}

/// From lane offset `n` towards the camera car's lane and on: an S-bend of 24 m.
fn lane_change(plan: &Plan, s: f64, n: f64) -> Path {
    let ground = plan.ground;
    let bend = ground.curvature / (1.0 - ground.curvature * n);
    let side = if plan.lane > n { 1.0 } else { -1.0 };
    // Offset of an S of two arcs of length l is about k l^2.
    let (l, k) = (12.0, side * 2.6 / (12.0 * 12.0));
    Path::new(
        ground.point(s, n),
        ground.heading(s),
        vec![
            Arc { length: 6.0, curvature: bend },
            Arc { length: l, curvature: bend + k },
            Arc { length: l, curvature: bend - k },
            Arc { length: 1e4, curvature: bend },
        ],
    )
}

/// Across the main road, or turning between the two streets.
fn crossing(plan: &Plan, rng: &mut Rng, cross: &Cross, (cruise, a): (f64, f64)) -> (Path, Speed) {
    let ground = plan.ground;
    let speed = cruise.min(11.0);
    let k = rng.below(cross.road.lanes as usize) as u32;
    let w = f64::from(cross.road.lane) * (f64::from(k) + 0.5);
    if rng.chance(0.45) {
        // From the main road ahead, with or against the camera car, into the cross street.
        let left = rng.chance(0.5);
        let (turning, radius) = if left { (Turning::Left, 10.5) } else { (Turning::Right, 7.0) };
        let lane = ground.road.lane_centre(if left { 0 } else { ground.road.lanes - 1 }, Direction::With);
        let start = cross.s - rng.range(9.0, 26.0);
        let v0 = rng.range(3.0, 6.5);
        return (turning_path(ground, (start, lane), turning, w, radius), Speed { s0: 0.0, v0, a: 0.0 });
    }
    let leftward = rng.chance(0.5);
    let sign = if leftward { 1.0 } else { -1.0 };
    let heading = ground.heading(cross.s) + sign * std::f64::consts::FRAC_PI_2;
    // Timed to pass the camera car's axis during the clip.
    let lead = speed * rng.range(0.0, 2.6) + 2.0;
    let start = ground.cross_point(cross, sign * w, -sign * lead);
    (Path::new(start, heading, vec![Arc { length: 1e4, curvature: 0.0 }]), Speed { s0: 0.0, v0: speed, a: 0.3 * a })
}

fn people(plan: &Plan, rng: &mut Rng, tracks: &mut Vec<Track>, bodies: &mut Vec<Body>) {
    let wanted = (plan.style.people * rng.range(0.2, 1.8) + 0.5) as usize;
    for _ in 0..wanted {
        let mut own = Rng::new(rng.bits(), "person");
        let (path, speed, height) = stroll(plan, &mut own);
        let track = Track { path: path.clone(), speed, half_length: 0.3, radius: 0.3 };
        if tracks.iter().any(|t| t.touches(&track, plan.seconds)) {
            continue;
        }
        bodies.push(pedestrian(&mut own, path, speed, height));
        tracks.push(track);
    }
}

/// Path, speed and ground height of somebody on foot.
fn stroll(plan: &Plan, rng: &mut Rng) -> (Path, Speed, f64) {
    let ground = plan.ground;
    let road = &ground.road;
    let kerb_top = f64::from(crate::ground::KERB);
    let pace = if rng.chance(0.08) { rng.range(2.4, 3.4) } else { rng.range(0.8, 1.8) };
    let standing = rng.chance(0.18);
    let speed = Speed { s0: 0.0, v0: if standing { 0.0 } else { pace }, a: 0.0 };
    let (left, right) = (f64::from(road.left), f64::from(road.right));
    // Across the road: on a crosswalk if there is one.
    let walk = match (&ground.cross, ground.crosswalks.first()) {
        (Some(c), _) if plan.ego.speed.v0 < 8.0 => Some(c.s - f64::from(c.road.left) - 3.2 + rng.range(-1.0, 1.0)),
        (None, Some(&c)) => Some(c + rng.range(-1.0, 1.0)),
        _ => None,
    };
    if let Some(s) = walk
        && !standing
        && rng.chance(0.4)
    {
        let from_left = rng.chance(0.5);
        let n = rng.range(-right, left);
        let heading = ground.heading(s) + if from_left { -1.0 } else { 1.0 } * std::f64::consts::FRAC_PI_2;
        let path = Path::new(ground.point(s, n), heading, vec![Arc { length: 1e4, curvature: 0.0 }]);
        // Who would step up the kerb during the clip walks on at road height: feet may sink into it.
        return (path, speed, 0.0);
    }
    let inward = rng.range(0.9, (f64::from(road.pavement) - 0.7).max(1.0));
    let n = if rng.chance(0.5) { left + inward } else { -right - inward };
    let s = rng.range(3.0, 34.0) + 0.4 * plan.travel * rng.unit();
    let direction = if rng.chance(0.5) { Direction::With } else { Direction::Against };
    let mut path = ground.lane_path(s, n, direction);
    if standing {
        let at: DVec3 = follow(&path, &speed, 0.0, 0.0).t;
        let heading = rng.range(0.0, std::f64::consts::TAU);
        path = Path::new(at.truncate(), heading, vec![Arc { length: 1.0, curvature: 0.0 }]);
    }
    (path, speed, kerb_top)
}
