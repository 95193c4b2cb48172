//! Cars, estates, off-roaders, vans, buses and lorries: one generator for driving and parked ones alike.
//!
//! A body is a lower hull (bonnet, boot, bumpers) and an upper hull (pillars and glass) over turning wheels.
//! Vehicle axes: x forward, y left, z up, origin on the ground under the middle.

use crate::body::{Body, Part, Rig, Shadow};
use crate::material::Skin;
use crate::math::{Rng, rot_x, unit};
use crate::motion::{Path, Speed};
use crate::paint::{Class, Paint};
use crate::shape::{Plane, Shape};
use crate::texture::mix;
use glam::{DVec3, Vec3};

/// A vehicle without a place in the street.
#[derive(Clone, Debug)]
pub(crate) struct Model {
    /// Metres, along x.
    pub(crate) length: f64,
    /// Metres, along y.
    pub(crate) width: f64,
    /// Metres.
    pub(crate) height: f64,
    parts: Vec<Part>,
    axles: Vec<DVec3>,
    radius: f64,
    seed: u32,
}

/// Lengths of a two-box body, metres.
struct Body2 {
    length: f32,
    width: f32,
    height: f32,
    belt: f32,
    bonnet: f32,
    nose: f32,
    boot: f32,
    tail: f32,
    screen: f32,
    hatch: f32,
    radius: f32,
}

const COLOURS: [[f32; 3]; 14] = [
    [0.62, 0.62, 0.60],
    [0.62, 0.62, 0.60],
    [0.30, 0.31, 0.32],
    [0.12, 0.12, 0.13],
    [0.02, 0.02, 0.022],
    [0.02, 0.02, 0.022],
    [0.36, 0.035, 0.03],
    [0.04, 0.09, 0.32],
    [0.03, 0.05, 0.12],
    [0.05, 0.16, 0.09],
    [0.42, 0.33, 0.20],
    [0.48, 0.16, 0.04],
    [0.55, 0.44, 0.05],
    [0.16, 0.30, 0.42],
];

impl Model {
    /// Draws a vehicle; `heavy` is the share of buses and lorries.
    pub(crate) fn draw(rng: &mut Rng, heavy: f64) -> Model {
        let class = if rng.chance(heavy) {
            rng.pick(&[Class::Bus, Class::Bus, Class::Lorry])
        } else {
            rng.pick(&[
                Class::Saloon,
                Class::Saloon,
                Class::Hatch,
                Class::Hatch,
                Class::Hatch,
                Class::Suv,
                Class::Suv,
                Class::Van,
            ])
        };
        Model::of_class(rng, class)
    }

    /// Draws a vehicle of a kind.
    pub(crate) fn of_class(rng: &mut Rng, class: Class) -> Model {
        let mut u = |lo: f32, hi: f32| rng.range32(lo, hi);
        let b = match class {
            Class::Saloon => Body2 {
                length: u(4.4, 4.9),
                width: u(1.76, 1.86),
                height: u(1.40, 1.48),
                belt: u(0.86, 0.92),
                bonnet: u(1.05, 1.25),
                nose: u(0.66, 0.74),
                boot: u(0.7, 0.95),
                tail: u(0.80, 0.86),
                screen: u(0.65, 0.8),
                hatch: u(0.55, 0.75),
                radius: u(0.31, 0.34),
            },
            Class::Hatch => Body2 {
                length: u(3.7, 4.4),
                width: u(1.68, 1.80),
                height: u(1.43, 1.55),
                belt: u(0.88, 0.95),
                bonnet: u(0.8, 1.05),
                nose: u(0.68, 0.76),
                boot: 0.06,
                tail: u(0.84, 0.88),
                screen: u(0.6, 0.8),
                hatch: u(0.2, 0.5),
                radius: u(0.30, 0.32),
            },
            Class::Suv => Body2 {
                length: u(4.3, 4.8),
                width: u(1.82, 1.95),
                height: u(1.62, 1.78),
                belt: u(1.02, 1.10),
                bonnet: u(0.95, 1.15),
                nose: u(0.82, 0.92),
                boot: 0.06,
                tail: u(0.96, 1.0),
                screen: u(0.5, 0.65),
                hatch: u(0.2, 0.4),
                radius: u(0.35, 0.38),
            },
            Class::Van => Body2 {
                length: u(4.8, 5.8),
                width: u(1.95, 2.05),
                height: u(2.0, 2.6),
                belt: u(1.12, 1.22),
                bonnet: u(0.75, 0.95),
                nose: u(0.85, 0.95),
                boot: 0.02,
                tail: 1.1,
                screen: u(0.6, 0.8),
                hatch: 0.05,
                radius: u(0.33, 0.36),
            },
            Class::Bus => Body2 {
                length: u(9.5, 12.0),
                width: 2.5,
                height: u(2.95, 3.2),
                belt: u(1.0, 1.1),
                bonnet: 0.03,
                nose: 1.0,
                boot: 0.02,
                tail: 1.0,
                screen: 0.12,
                hatch: 0.03,
                radius: 0.47,
            },
            Class::Lorry => Body2 {
                length: u(6.8, 8.6),
                width: 2.4,
                height: u(2.5, 2.7),
                belt: 1.35,
                bonnet: 0.04,
                nose: 1.3,
                boot: 0.02,
                tail: 1.3,
                screen: 0.25,
                hatch: 0.02,
                radius: 0.45,
            },
        };
        let colour = Vec3::from(rng.pick(&COLOURS));
        let colour = match class {
            Class::Bus => rng.pick(&[
                Vec3::new(0.45, 0.04, 0.03),
                Vec3::new(0.05, 0.16, 0.36),
                Vec3::new(0.55, 0.45, 0.08),
                Vec3::new(0.07, 0.30, 0.16),
                Vec3::splat(0.6),
            ]),
            Class::Van if rng.chance(0.6) => Vec3::splat(0.6),
            _ => colour * rng.range32(0.8, 1.15),
        };
        let accent = Vec3::new(rng.range32(0.03, 0.5), rng.range32(0.03, 0.5), rng.range32(0.03, 0.5));
        let brake = if rng.chance(0.3) { 1.0 } else { 0.0 };
        let plate = rng.pick(&[Vec3::splat(0.6), Vec3::splat(0.6), Vec3::new(0.6, 0.5, 0.1)]);
        let seed = rng.seed();
        Model::build(class, &b, Colours { colour, accent, plate, brake }, seed)
    }

    fn build(class: Class, b: &Body2, c: Colours, seed: u32) -> Model {
        let (hl, hw) = (0.5 * b.length, 0.5 * b.width);
        let clearance = if matches!(class, Class::Bus | Class::Lorry) { 0.32 } else { 0.19 };
        let (front, rear) = match class {
            Class::Bus => (hl - 2.6, -hl + 2.9),
            Class::Lorry => (hl - 1.25, -hl + 1.6),
            _ => (hl - b.radius - 0.50, -hl + b.radius + 0.42),
        };
        // The lorry's cab is its whole two-box body; the box behind is a part of its own.
        let cab_rear = if class == Class::Lorry { hl - 2.1 } else { -hl };
        let (xf, xr) = (hl - b.bonnet, cab_rear + b.boot);
        let slant = if matches!(class, Class::Bus | Class::Lorry | Class::Van) { 0.05 } else { 0.19 };
        let rise = b.height - b.belt;
        let paint = Paint {
            class,
            half: [hl, hw],
            height: b.height,
            belt: b.belt,
            colour: c.colour,
            accent: c.accent,
            arches: [front, rear],
            radius: b.radius,
            glass: match class {
                Class::Van | Class::Lorry => [xf - b.screen - 0.75, xf - 0.12, 0.0, -b.screen / rise],
                Class::Bus => [xr + 0.35, xf - 0.2, 0.0, 0.0],
                _ => [xr + 0.14, xf - 0.16, b.hatch / rise, -b.screen / rise],
            },
            brake: c.brake,
            plate: c.plate,
        };
        let skin = || Skin::Paint(Box::new(paint.clone()));
        let lower = hull(
            vec![
                Plane::through(Vec3::new(hl, 0.0, b.nose), Vec3::new(1.0, 0.0, 0.08)),
                Plane::through(Vec3::new(hl, 0.0, 0.42), Vec3::new(0.8, 0.0, -0.5)),
                Plane::through(Vec3::new(cab_rear, 0.0, b.tail), Vec3::new(-1.0, 0.0, 0.06)),
                Plane::through(Vec3::new(cab_rear, 0.0, 0.40), Vec3::new(-0.8, 0.0, -0.5)),
                Plane::through(Vec3::new(hl, 0.0, b.nose), Vec3::new(b.belt - b.nose, 0.0, b.bonnet)),
                Plane::through(Vec3::new(cab_rear, 0.0, b.tail), Vec3::new(-(b.belt - b.tail), 0.0, b.boot)),
                Plane::through(Vec3::new(0.0, hw, 0.6), Vec3::new(0.0, 1.0, 0.06)),
                Plane::through(Vec3::new(0.0, -hw, 0.6), Vec3::new(0.0, -1.0, 0.06)),
                Plane::through(Vec3::new(0.0, 0.0, b.belt), Vec3::Z),
                Plane::through(Vec3::new(0.0, 0.0, clearance), -Vec3::Z),
            ],
            Vec3::new(cab_rear - 0.05, -hw - 0.03, clearance),
            Vec3::new(hl + 0.06, hw + 0.03, b.belt),
        );
        let upper = hull(
            vec![
                Plane::through(Vec3::new(xf, 0.0, b.belt), Vec3::new(rise, 0.0, b.screen)),
                Plane::through(Vec3::new(xr, 0.0, b.belt), Vec3::new(-rise, 0.0, b.hatch)),
                Plane::through(Vec3::new(0.0, hw - 0.03, b.belt), Vec3::new(0.0, rise, slant)),
                Plane::through(Vec3::new(0.0, -hw + 0.03, b.belt), Vec3::new(0.0, -rise, slant)),
                Plane::through(Vec3::new(0.0, 0.0, b.height), Vec3::Z),
                Plane::through(Vec3::new(0.0, 0.0, b.belt - 0.05), -Vec3::Z),
            ],
            Vec3::new(xr - 0.05, -hw, b.belt - 0.05),
            Vec3::new(xf + 0.05, hw, b.height),
        );
        let mut parts = vec![Part::new(lower, DVec3::ZERO, skin()), Part::new(upper, DVec3::ZERO, skin())];
        if class == Class::Lorry {
            let (x0, x1) = (-hl, hl - 2.25);
            let half = Vec3::new(0.5 * (x1 - x0), hw + 0.04, 1.15);
            let at = DVec3::new(f64::from(0.5 * (x0 + x1)), 0.0, 0.95 + 1.15);
            parts.push(Part::new(Shape::Box { half }, at, Skin::Stripes(c.accent, Vec3::splat(0.6), 9.0)));
            let frame = Shape::Box { half: Vec3::new(half.x, 0.45, 0.22) };
            parts.push(Part::new(frame, DVec3::new(at.x, 0.0, 0.72), Skin::plain(Vec3::splat(0.03))));
        } else if !matches!(class, Class::Bus) {
            for side in [1.0, -1.0] {
                let mirror = Shape::Box { half: Vec3::new(0.06, 0.10, 0.07) };
                let at = DVec3::new(f64::from(xf) - 0.35, side * (f64::from(hw) + 0.06), f64::from(b.belt) + 0.06);
                parts.push(Part::new(mirror, at, Skin::plain(c.colour * 0.7)));
            }
        }
        let rim = mix(Vec3::splat(0.12), Vec3::splat(0.42), unit(seed));
        let radius = f64::from(b.radius);
        let mut axles = Vec::new();
        for x in [front, rear] {
            for side in [1.0, -1.0] {
                axles.push(DVec3::new(f64::from(x), side * (f64::from(hw) - 0.11), radius));
                let tyre = Shape::Cylinder { radius: b.radius, half: 0.125 };
                let lie = rot_x(side * std::f64::consts::FRAC_PI_2);
                parts.push(Part::new(tyre, DVec3::ZERO, Skin::Wheel(b.radius, rim)).turned(lie).on(axles.len()));
            }
        }
        let height = if class == Class::Lorry { 3.25 } else { b.height };
        Model {
            length: f64::from(b.length),
            width: f64::from(b.width),
            height: f64::from(height),
            parts,
            axles,
            radius,
            seed,
        }
    }

    /// Puts the vehicle on a path; parked ones have speed zero.
    pub(crate) fn place(self, path: Path, speed: Speed) -> Body {
        let half = [0.5 * self.length as f32 - 0.12, 0.5 * self.width as f32 - 0.05];
        Body {
            shadow: Shadow::Box { half, from: 0.2, to: self.height as f32 * 0.94, contact: 0.75 },
            rig: Rig::Drive { path, speed, axles: self.axles, radius: self.radius, rider: None },
            parts: self.parts,
            seed: self.seed,
        }
    }
}

struct Colours {
    colour: Vec3,
    accent: Vec3,
    plate: Vec3,
    brake: f32,
}

fn hull(planes: Vec<Plane>, lo: Vec3, hi: Vec3) -> Shape {
    Shape::Hull { planes, lo, hi }
}
