//! People on foot and on bicycles: ten rigid limbs on the joints of [`crate::body`].

use crate::body::{Body, Gait, PERSON_NODES, Part, Rig, Shadow};
use crate::material::Skin;
use crate::math::{Rng, rot_x, rot_y};
use crate::motion::{Path, Speed};
use crate::shape::Shape;
use glam::{DVec3, Vec3};

const SKINS: [[f32; 3]; 5] =
    [[0.52, 0.34, 0.25], [0.45, 0.28, 0.19], [0.32, 0.18, 0.11], [0.18, 0.095, 0.055], [0.09, 0.05, 0.03]];
const HAIRS: [[f32; 3]; 5] =
    [[0.02, 0.015, 0.012], [0.06, 0.035, 0.02], [0.18, 0.11, 0.05], [0.35, 0.26, 0.12], [0.3, 0.3, 0.3]];

/// Clothes and build.
struct Person {
    height: f64,
    girth: f32,
    skin: Vec3,
    hair: Vec3,
    coat: Vec3,
    trousers: Vec3,
    shoes: Vec3,
    bag: Option<Vec3>,
    helmet: bool,
}

fn cloth(rng: &mut Rng) -> Vec3 {
    if rng.chance(0.45) {
        return Vec3::splat(rng.range32(0.015, 0.12)) * Vec3::new(1.0, 1.0, rng.range32(0.9, 1.4));
    }
    let mut c = Vec3::new(rng.range32(0.02, 0.55), rng.range32(0.02, 0.5), rng.range32(0.02, 0.5));
    c[rng.below(3)] *= 0.3;
    c
}

impl Person {
    fn draw(rng: &mut Rng) -> Person {
        let child = rng.chance(0.1);
        Person {
            height: if child { rng.range(1.1, 1.45) } else { rng.range(1.55, 1.92) },
            girth: rng.range32(0.88, 1.18),
            skin: Vec3::from(rng.pick(&SKINS)),
            hair: Vec3::from(rng.pick(&HAIRS)),
            coat: cloth(rng),
            trousers: if rng.chance(0.5) { Vec3::new(0.03, 0.05, 0.11) } else { cloth(rng) * 0.6 },
            shoes: Vec3::splat(rng.range32(0.01, 0.3)),
            bag: rng.chance(0.35).then(|| cloth(rng)),
            helmet: false,
        }
    }

    /// Limbs on ten nodes from `first` on.
    fn parts(&self, first: usize) -> Vec<Part> {
        let h = self.height;
        let k = h as f32;
        let fabric = |rgb: Vec3| Skin::Plain { rgb, grain: 0.35, wave: 0.35 };
        let limb = |node: usize, radius: f32, length: f64, rgb: Vec3| {
            let half = (0.5 * length) as f32 - radius * 0.6;
            Part::new(Shape::Capsule { radius, half }, DVec3::new(0.0, 0.0, -0.5 * length), fabric(rgb))
                .on(first + node)
        };
        let chest = Vec3::new(0.066 * k * self.girth, 0.112 * k * self.girth, 0.155 * k);
        let hips = Vec3::new(0.062 * k * self.girth, 0.092 * k * self.girth, 0.09 * k);
        let hair = if self.helmet { Vec3::new(0.55, 0.55, 0.5) } else { self.hair };
        let head = Shape::Ellipsoid { radii: Vec3::new(0.056 * k, 0.045 * k, 0.069 * k) };
        let mut parts = vec![
            Part::new(Shape::Ellipsoid { radii: chest }, DVec3::new(0.0, 0.0, 0.20 * h), fabric(self.coat)).on(first),
            Part::new(Shape::Ellipsoid { radii: hips }, DVec3::new(0.0, 0.0, 0.03 * h), fabric(self.trousers))
                .on(first),
            Part::new(
                Shape::Cylinder { radius: 0.026 * k, half: 0.03 * k },
                DVec3::new(0.0, 0.0, 0.35 * h),
                Skin::plain(self.skin),
            )
            .on(first),
            Part::new(head, DVec3::new(0.0, 0.0, 0.025 * h), Skin::Head(self.skin, hair)).on(first + 1),
        ];
        if let Some(rgb) = self.bag {
            let bag = Shape::Box { half: Vec3::new(0.05 * k, 0.075 * k, 0.10 * k) };
            parts.push(Part::new(bag, DVec3::new(-0.1 * h, 0.0, 0.22 * h), fabric(rgb)).on(first));
        }
        for arm in [2, 4] {
            parts.push(limb(arm, 0.028 * k * self.girth, 0.18 * h, self.coat));
            parts.push(limb(arm + 1, 0.022 * k * self.girth, 0.16 * h, self.coat * 0.92));
            let hand = Shape::Ellipsoid { radii: Vec3::splat(0.024 * k) };
            parts.push(Part::new(hand, DVec3::new(0.0, 0.0, -0.17 * h), Skin::plain(self.skin)).on(first + arm + 1));
        }
        for leg in [6, 8] {
            parts.push(limb(leg, 0.045 * k * self.girth, 0.26 * h, self.trousers));
            parts.push(limb(leg + 1, 0.033 * k * self.girth, 0.25 * h, self.trousers * 0.95));
            let shoe = Shape::Ellipsoid { radii: Vec3::new(0.075 * k, 0.028 * k, 0.026 * k) };
            let at = DVec3::new(0.03 * h, 0.0, -0.232 * h);
            parts.push(Part::new(shoe, at, Skin::plain(self.shoes)).on(first + leg + 1));
        }
        debug_assert!(parts.iter().all(|p| p.node < first + PERSON_NODES));
        parts
    }
}

/// Somebody walking along a path on ground of a height, or standing where its speed is zero.
pub(crate) fn pedestrian(rng: &mut Rng, path: Path, speed: Speed, ground: f64) -> Body {
    let person = Person::draw(rng);
    let swing = if speed.v0 == 0.0 { 0.0 } else { 0.22 + 0.17 * speed.v0.min(2.4) };
    // A cycle is two steps, each longer with speed.
    let stride = person.height * (0.55 + 0.26 * speed.v0.min(3.0));
    let gait = Gait { height: person.height, phase: rng.range(0.0, std::f64::consts::TAU), swing, stride };
    Body {
        parts: person.parts(0),
        rig: Rig::Walk { path, speed, gait, ground },
        seed: rng.seed(),
        shadow: Shadow::Box { half: [0.14, 0.2], from: 0.0, to: person.height as f32, contact: 0.55 },
    }
}

/// Somebody cycling: frame, two spinning wheels, a pedalling rider.
pub(crate) fn cyclist(rng: &mut Rng, path: Path, speed: Speed) -> Body {
    let person = Person { helmet: rng.chance(0.6), bag: None, ..Person::draw(rng) };
    let h = person.height;
    let axles = vec![DVec3::new(0.52, 0.0, 0.34), DVec3::new(-0.52, 0.0, 0.34)];
    let mut parts = person.parts(1 + axles.len());
    let paint = Skin::plain(cloth(rng));
    let tube = |from: DVec3, to: DVec3, skin: &Skin| {
        let d = to - from;
        let length = d.length();
        // Tubes lie in the frame's plane: tilt z towards x.
        let (sin, cos) = (d.x / length, d.z / length);
        let tilt = glam::DMat3::from_cols(DVec3::new(cos, 0.0, -sin), DVec3::Y, DVec3::new(sin, 0.0, cos));
        let shape = Shape::Capsule { radius: 0.022, half: (0.5 * length) as f32 };
        Part::new(shape, (from + to) * 0.5, skin.clone()).turned(tilt)
    };
    let (crank, seat, head) =
        (DVec3::new(-0.05, 0.0, 0.30), DVec3::new(-0.22, 0.0, 0.50 * h), DVec3::new(0.38, 0.0, 0.46 * h));
    for (a, b) in [(crank, seat), (crank, head), (seat, head), (axles[1], crank), (axles[1], seat), (axles[0], head)] {
        parts.push(tube(a, b, &paint));
    }
    let bar = Shape::Capsule { radius: 0.018, half: 0.25 };
    let across = rot_x(std::f64::consts::FRAC_PI_2) * rot_y(0.0);
    parts.push(Part::new(bar, head + DVec3::Z * 0.10, Skin::plain(Vec3::splat(0.03))).turned(across));
    for node in 1..=axles.len() {
        let wheel = Shape::Cylinder { radius: 0.34, half: 0.018 };
        let lie = rot_x(std::f64::consts::FRAC_PI_2);
        parts.push(Part::new(wheel, DVec3::ZERO, Skin::Spokes(0.34)).turned(lie).on(node));
    }
    let gait = Gait { height: h, phase: rng.range(0.0, std::f64::consts::TAU), swing: 0.4, stride: 4.6 };
    Body {
        parts,
        rig: Rig::Drive { path, speed, axles, radius: 0.34, rider: Some(gait) },
        seed: rng.seed(),
        shadow: Shadow::Box { half: [0.75, 0.12], from: 0.0, to: h as f32, contact: 0.5 },
    }
}
