//! What stands along the streets: houses, gardens, trees, lamps, signs, parked cars, the skyline.

use crate::body::Body;
use crate::buildings::{House, far_tower};
use crate::furniture;
use crate::ground::{Cross, Ground, KERB, Road};
use crate::math::{Rng, sin_cos};
use crate::motion::{Arc, Path, Speed};
use crate::plan::Plan;
use crate::raycast::FAR;
use crate::vegetation::{Species, bush, hedge, tree};
use crate::vehicles::Model;
use glam::{DVec2, DVec3, Vec4};

/// How far behind the camera car the street begins, metres.
const BEHIND: f64 = 45.0;

/// A side of a street in its own coordinates: x along, y outward from the kerb.
struct Side<'a> {
    ground: &'a Ground,
    cross: Option<&'a Cross>,
    /// +1 left of the axis, -1 right of it.
    sign: f64,
    kerb: f64,
    pavement: f64,
    parking: f64,
    range: (f64, f64),
    /// Stretches that stay free of houses and of small things.
    gaps: Vec<(f64, f64)>,
}

impl<'a> Side<'a> {
    fn of_main(plan: &'a Plan, sign: f64) -> Side<'a> {
        let r = &plan.ground.road;
        let mut gaps = Vec::new();
        if let Some(c) = &plan.ground.cross {
            let wide = f64::from(r.pavement);
            gaps.push((c.s - f64::from(c.road.left) - wide, c.s + f64::from(c.road.right) + wide));
        }
        Side::new(plan.ground, None, r, sign, ((-BEHIND, plan.travel + FAR as f64), gaps))
    }

    fn of_cross(plan: &'a Plan, cross: &'a Cross, sign: f64, arm: f64) -> Side<'a> {
        let main = &plan.ground.road;
        let kerb = f64::from(if arm > 0.0 { main.left } else { main.right });
        // Behind the corner houses of the main road.
        let from = kerb + f64::from(main.pavement);
        let reach = 110.0 + plan.travel;
        let range = if arm > 0.0 { (from, reach) } else { (-reach, -from) };
        let block = if arm > 0.0 { (from, from + 15.5) } else { (-from - 15.5, -from) };
        Side::new(plan.ground, Some(cross), &cross.road, sign, (range, vec![block]))
    }

    fn new(
        ground: &'a Ground,
        cross: Option<&'a Cross>,
        road: &Road,
        sign: f64,
        (range, gaps): ((f64, f64), Vec<(f64, f64)>),
    ) -> Side<'a> {
        let (kerb, parking) = if sign > 0.0 { (road.left, road.parking[0]) } else { (road.right, road.parking[1]) };
        Side {
            ground,
            cross,
            sign,
            kerb: f64::from(kerb),
            pavement: f64::from(ground.road.pavement),
            parking: f64::from(parking),
            range,
            gaps,
        }
    }

    /// Street point and heading of the street at `s` along and `d` metres behind the kerb.
    fn at(&self, s: f64, d: f64) -> (DVec2, f64) {
        let n = self.sign * (self.kerb + d);
        match self.cross {
            None => (self.ground.point(s, n), self.ground.heading(s)),
            Some(c) => (self.ground.cross_point(c, -n, s), self.ground.heading(c.s) + std::f64::consts::FRAC_PI_2),
        }
    }

    fn place(&self, s: f64, d: f64) -> (DVec3, f64) {
        let (p, heading) = self.at(s, d);
        (DVec3::new(p.x, p.y, f64::from(KERB)), heading)
    }

    /// Whether a stretch keeps clear of the gaps widened by `margin`.
    fn free(&self, from: f64, to: f64, margin: f64) -> bool {
        self.gaps.iter().all(|&(a, b)| to <= a - margin || from >= b + margin)
    }

    /// First position from `s` on where a stretch of a length is free.
    fn next_free(&self, s: f64, length: f64) -> f64 {
        let mut s = s;
        for &(a, b) in &self.gaps {
            if s < b && s + length > a {
                s = b;
            }
        }
        s
    }

    /// Whether a point is behind every kerb by a margin: nothing of one street may stand on the other.
    fn clear(&self, p: DVec3, margin: f32) -> bool {
        self.ground.kerb_distance(Vec4::splat(p.x as f32), Vec4::splat(p.y as f32)).x > margin
    }
}

/// All objects that stand.
pub(crate) fn build(plan: &Plan) -> Vec<Body> {
    let mut bodies = Vec::new();
    let mut look = Rng::new(plan.seed, "species");
    let species = [Species::draw(&mut look), Species::draw(&mut look)];
    let mut line = |side: &Side, name: &str| {
        houses(plan, side, &mut Rng::new(plan.seed, &format!("houses {name}")), &species, &mut bodies);
        greenery(plan, side, &mut Rng::new(plan.seed, &format!("trees {name}")), &species, &mut bodies);
        pavement(side, &mut Rng::new(plan.seed, &format!("pavement {name}")), &mut bodies);
        parked(plan, side, &mut Rng::new(plan.seed, &format!("parked {name}")), &mut bodies);
    };
    for (sign, name) in [(1.0, "left"), (-1.0, "right")] {
        line(&Side::of_main(plan, sign), name);
    }
    if let Some(cross) = &plan.ground.cross {
        for (sign, arm, name) in
            [(1.0, 1.0, "near left"), (-1.0, 1.0, "far left"), (1.0, -1.0, "near right"), (-1.0, -1.0, "far right")]
        {
            line(&Side::of_cross(plan, cross, sign, arm), name);
        }
        signals(plan, cross, &mut bodies);
    }
    skyline(plan, &mut Rng::new(plan.seed, "skyline"), &mut bodies);
    bodies
}

fn houses(plan: &Plan, side: &Side, rng: &mut Rng, species: &[Species; 2], bodies: &mut Vec<Body>) {
    let setback = if rng.chance(0.6) { rng.range(0.0, 0.5) } else { rng.range(2.0, 5.0) };
    let terraced = rng.chance(0.55);
    let front = side.pavement + setback;
    let mut s = side.range.0;
    while s < side.range.1 {
        let length = rng.range(7.0, 21.0);
        let start = side.next_free(s, length);
        let mut own = Rng::new(rng.bits(), "plot");
        if own.chance(plan.style.built) {
            let house = House::draw(&mut own, length, -side.sign);
            let (at, heading) = side.place(start + 0.5 * length, front + 0.5 * house.depth);
            // The corner of a deep house must not reach over another street.
            if side.clear(at, 0.5 * house.depth as f32) {
                bodies.push(house.place(at, heading));
            }
        } else {
            open_plot(side, &mut own, (start, length, side.pavement + 0.3), species, bodies);
        }
        if setback > 1.5 && own.chance(0.6) {
            let (at, heading) = side.place(start + 0.5 * length, side.pavement + 0.25);
            if side.clear(at, 0.4 * length as f32) || side.cross.is_none() {
                let body = if own.chance(0.4) {
                    hedge(&mut own, &species[0], at, heading, 0.8 * length as f32)
                } else {
                    furniture::wall(&mut own, at, heading, 0.8 * length as f32)
                };
                bodies.push(body);
            }
        }
        s = start + length + if terraced && own.chance(0.8) { 0.0 } else { own.range(0.8, 6.0) };
    }
}

/// A plot without a house: wall or hedge in front, trees and bushes behind.
fn open_plot(
    side: &Side,
    rng: &mut Rng,
    (s, length, front): (f64, f64, f64),
    species: &[Species; 2],
    bodies: &mut Vec<Body>,
) {
    let (at, heading) = side.place(s + 0.5 * length, front);
    if rng.chance(0.75) {
        bodies.push(furniture::wall(rng, at, heading, length as f32));
    } else {
        bodies.push(hedge(rng, &species[1], at, heading, length as f32));
    }
    for _ in 0..1 + rng.below(3) {
        let (at, _) = side.place(s + rng.range(0.1, 0.9) * length, front + rng.range(2.0, 9.0));
        let kind = &species[rng.below(2)];
        bodies.push(if rng.chance(0.75) { tree(rng, kind, at) } else { bush(rng, kind, at) });
    }
}

fn greenery(plan: &Plan, side: &Side, rng: &mut Rng, species: &[Species; 2], bodies: &mut Vec<Body>) {
    if !rng.chance(plan.style.trees) {
        return;
    }
    let spacing = rng.range(8.0, 17.0);
    let kind = &species[rng.below(2)];
    let mut s = side.range.0 + rng.range(0.0, spacing);
    while s < side.range.1 {
        let here = s + rng.range(-0.8, 0.8);
        if side.free(here, here, 5.0) && rng.chance(0.85) {
            let (at, _) = side.place(here, 0.75);
            if side.clear(at, 0.4) {
                bodies.push(tree(rng, kind, at));
            }
        }
        s += spacing;
    }
}

/// Lamps, signs, bins, shelters along the kerb.
fn pavement(side: &Side, rng: &mut Rng, bodies: &mut Vec<Body>) {
    let inward = -std::f64::consts::FRAC_PI_2 * side.sign;
    // Traffic on the right side of an axis runs with it, on the left side against it.
    let travel = if side.sign > 0.0 { std::f64::consts::PI } else { 0.0 };
    let spacing = rng.range(22.0, 34.0);
    let mut s = side.range.0 + rng.range(0.0, spacing);
    while s < side.range.1 {
        let (at, heading) = side.place(s, 0.5);
        if side.free(s, s, 1.0) && side.clear(at, 0.3) {
            bodies.push(furniture::lamp(rng, at, heading + inward));
        }
        s += spacing;
    }
    let mut s = side.range.0 + rng.range(0.0, 8.0);
    while s < side.range.1 {
        let mut own = Rng::new(rng.bits(), "thing");
        let close = own.chance(0.5);
        let (at, heading) = side.place(s, if close { 0.45 } else { side.pavement - 0.35 });
        if side.free(s - 1.5, s + 1.5, 1.0) && side.clear(at, 0.3) {
            let along = heading + if side.sign > 0.0 { 0.0 } else { std::f64::consts::PI };
            match own.below(12) {
                0..=2 => bodies.push(furniture::sign(&mut own, at, heading + travel)),
                3 => {
                    let (at, _) = side.place(s, 1.6);
                    bodies.push(furniture::shelter(&mut own, at, along));
                }
                4 => bodies.push(furniture::poster(&mut own, at, heading + travel)),
                5 => bodies.push(furniture::barrier(&mut own, at, heading)),
                _ => bodies.push(furniture::small(&mut own, at, along)),
            }
        }
        s += own.range(4.0, 14.0);
    }
}

/// Cars along the kerb: the same generator as the traffic's, with speed zero.
fn parked(plan: &Plan, side: &Side, rng: &mut Rng, bodies: &mut Vec<Body>) {
    if side.parking <= 0.0 {
        return;
    }
    let share = plan.style.parked * rng.range(0.5, 1.5);
    let mut s = side.range.0;
    while s < side.range.1.min(plan.travel + 95.0) {
        let mut own = Rng::new(rng.bits(), "parked");
        let model = Model::draw(&mut own, 0.02);
        let (from, to) = (s, s + model.length);
        let walk = side.cross.is_none() && plan.ground.crosswalks.iter().any(|&c| to > c - 5.0 && from < c + 5.0);
        let step = model.length + own.range(0.6, 2.2);
        if own.chance(share) && side.free(from, to, 9.0) && !walk {
            let middle = 0.5 * (from + to);
            let (at, heading) = side.at(middle, -1.08 + own.normal(0.0, 0.06));
            // Mostly with the traffic of that side; a few the other way round.
            let against = (side.sign > 0.0) != own.chance(0.06);
            let heading = heading + if against { std::f64::consts::PI } else { 0.0 } + own.normal(0.0, 0.015);
            let path = Path::new(at, heading, vec![Arc { length: 1.0, curvature: 0.0 }]);
            bodies.push(model.place(path, Speed { s0: 0.0, v0: 0.0, a: 0.0 }));
        }
        s += step;
    }
}

fn signals(plan: &Plan, cross: &Cross, bodies: &mut Vec<Body>) {
    let mut rng = Rng::new(plan.seed, "signals");
    if !rng.chance(0.7) {
        return;
    }
    let (r, c) = (&plan.ground.road, &cross.road);
    let main = plan.ground.heading(cross.s);
    let quarter = std::f64::consts::FRAC_PI_2;
    let corner = |m: f64, q: f64| {
        let p = plan.ground.cross_point(cross, m, q);
        DVec3::new(p.x, p.y, f64::from(KERB))
    };
    let (near, far) = (-f64::from(c.left) - 4.4, f64::from(c.right) + 4.4);
    let (left, right) = (f64::from(r.left) + 0.6, -f64::from(r.right) - 0.6);
    for (at, heading) in [
        (corner(near, right), main),
        (corner(far, right), main),
        (corner(far, left), main + 2.0 * quarter),
        (corner(near + 3.8, left + 4.0), main - quarter),
        (corner(far - 3.8, right - 4.0), main + quarter),
    ] {
        if plan.ground.kerb_distance(Vec4::splat(at.x as f32), Vec4::splat(at.y as f32)).x > 0.15 {
            bodies.push(furniture::signal(&mut rng, at, heading));
        }
    }
}

/// Far buildings all around, off the roads.
fn skyline(plan: &Plan, rng: &mut Rng, bodies: &mut Vec<Body>) {
    let (_, mid) = plan.ego.pose(0.5 * plan.seconds.min(4.0));
    let count = 34;
    for k in 0..count {
        let angle = std::f64::consts::TAU * (f64::from(k) + rng.range(-0.4, 0.4)) / f64::from(count);
        let radius = rng.range(82.0, 128.0) + 0.5 * plan.travel;
        let (sin, cos) = sin_cos(angle);
        let at = DVec3::new(mid.x + cos * radius, mid.y + sin * radius, f64::from(KERB));
        let mut own = Rng::new(rng.bits(), "tower");
        if plan.ground.kerb_distance(Vec4::splat(at.x as f32), Vec4::splat(at.y as f32)).x > 16.0 {
            bodies.push(far_tower(&mut own, at, angle));
        }
    }
    // Ends of the streets: a row across the axis where the road leaves the sight.
    let s = plan.travel + f64::from(FAR) - 12.0;
    let at = plan.ground.point(s, rng.range(-9.0, 9.0));
    bodies.push(far_tower(rng, DVec3::new(at.x, at.y, 0.0), plan.ground.heading(s)));
}
