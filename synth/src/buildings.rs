//! Houses: boxes with drawn façades ([`crate::facade`]), pitched or flat roofs, awnings,
//! balconies, chimneys.
//!
//! Building axes: x along the street, +y or -y towards it, z up, origin on the ground in the middle.

use crate::body::{Body, Part, Shadow};
use crate::facade::{Base, Facade, Windows};
use crate::material::Skin;
use crate::math::{Rng, rot_x, rot_z};
use crate::motion::Motion;
use crate::shape::{Plane, Shape};
use glam::{DVec3, Vec3};

/// A building before it has a place.
#[derive(Clone, Debug)]
pub(crate) struct House {
    /// Depth, metres.
    pub(crate) depth: f64,
    parts: Vec<Part>,
    height: f32,
    seed: u32,
}

const WALLS: [[f32; 3]; 12] = [
    [0.48, 0.42, 0.33],
    [0.55, 0.50, 0.42],
    [0.42, 0.24, 0.16],
    [0.33, 0.15, 0.10],
    [0.52, 0.36, 0.22],
    [0.36, 0.36, 0.36],
    [0.56, 0.55, 0.52],
    [0.30, 0.34, 0.38],
    [0.50, 0.44, 0.20],
    [0.46, 0.30, 0.28],
    [0.28, 0.36, 0.30],
    [0.22, 0.20, 0.19],
];

impl House {
    /// Draws a building of a length; `near` is its side of the street: +1 if the street lies at +y.
    pub(crate) fn draw(rng: &mut Rng, length: f64, near: f64) -> House {
        let windows = rng.pick(&[
            Windows::Punched,
            Windows::Punched,
            Windows::Shuttered,
            Windows::Ribbon,
            Windows::Curtain,
            Windows::Paired,
            Windows::Paired,
        ]);
        let modern = matches!(windows, Windows::Ribbon | Windows::Curtain);
        let floors = if modern { 1 + rng.below(5) } else { 1 + rng.below(3) };
        let base = rng.pick(&[Base::Shop, Base::Shop, Base::Home, Base::Home, Base::Blank]);
        let ground = rng.range32(3.3, 4.4);
        let floor = rng.range32(2.8, 3.5);
        let parapet = rng.range32(0.5, 1.3);
        let height = ground + floors as f32 * floor + parapet;
        let depth = rng.range(8.0, 14.0);
        let (hx, hy) = (0.5 * length as f32, 0.5 * depth as f32);
        let wall = Vec3::from(rng.pick(&WALLS)) * rng.range32(0.8, 1.15);
        let facade = Facade {
            windows,
            base,
            wall,
            trim: if rng.chance(0.7) { Vec3::splat(rng.range32(0.45, 0.62)) } else { wall * 0.45 },
            accent: {
                let mut c = Vec3::new(rng.range32(0.03, 0.6), rng.range32(0.03, 0.5), rng.range32(0.03, 0.5));
                c[rng.below(3)] *= 0.25;
                c
            },
            blocks: if modern { rng.pick(&[0.0, 1.2]) } else { rng.pick(&[0.0, 0.0, 0.16, 0.16, 0.3, 0.45]) },
            ground,
            floor,
            height,
            bay: if windows == Windows::Curtain { rng.range32(1.2, 1.8) } else { rng.range32(2.0, 3.6) },
            half: [hx, hy],
            open: [rng.range32(0.36, 0.62), rng.range32(0.48, 0.68)],
            cornice: rng.range32(0.2, 0.5),
            lit: rng.range32(0.15, 0.6),
        };
        let mut parts = vec![Part::new(
            Shape::Box { half: Vec3::new(hx, hy, 0.5 * height) },
            DVec3::new(0.0, 0.0, 0.5 * f64::from(height)),
            Skin::Facade(Box::new(facade.clone())),
        )];
        if modern || floors > 3 || rng.chance(0.35) {
            parts.extend(flat_roof(rng, &facade));
        } else {
            parts.extend(pitched_roof(rng, &facade));
        }
        parts.extend(extras(rng, &facade, floors, near));
        House { depth, parts, height, seed: rng.seed() }
    }

    /// Puts the building on its plot: the middle of its ground and the direction of its x axis.
    pub(crate) fn place(self, at: DVec3, heading: f64) -> Body {
        let half = self.parts[0].shape.bounds().1;
        Body::fixed(Motion::fixed(at, heading), self.parts, self.seed).shaded(Shadow::Box {
            half: [half.x, half.y],
            from: 0.0,
            to: self.height,
            contact: 0.35,
        })
    }
}

fn block(half: Vec3, at: Vec3, skin: Skin) -> Part {
    Part::new(Shape::Box { half }, at.as_dvec3(), skin)
}

/// Cornice slab and things on the roof.
fn flat_roof(rng: &mut Rng, f: &Facade) -> Vec<Part> {
    let [hx, hy] = f.half;
    let mut parts = vec![block(
        Vec3::new(hx + 0.12, hy + 0.25, 0.14),
        Vec3::new(0.0, 0.0, f.height - 0.05),
        Skin::plain(f.trim * 0.9),
    )];
    for _ in 0..rng.below(3) {
        let half = Vec3::new(rng.range32(0.6, 1.8), rng.range32(0.6, 1.5), rng.range32(0.4, 1.3));
        let at = Vec3::new(rng.range32(-0.7, 0.7) * hx, rng.range32(-0.4, 0.4) * hy, f.height + half.z);
        parts.push(block(half, at, Skin::plain(Vec3::splat(rng.range32(0.12, 0.4)))));
    }
    parts
}

/// Ridge along the street, with chimneys and dormers.
fn pitched_roof(rng: &mut Rng, f: &Facade) -> Vec<Part> {
    let [hx, hy] = [f.half[0] + 0.05, f.half[1] + 0.35];
    let rise = hy * rng.range32(0.55, 0.95);
    let base = f.height - 0.1;
    let tile = rng.pick(&[
        Vec3::new(0.30, 0.11, 0.06),
        Vec3::new(0.22, 0.08, 0.05),
        Vec3::new(0.09, 0.09, 0.10),
        Vec3::new(0.16, 0.13, 0.11),
    ]);
    let planes = vec![
        Plane::through(Vec3::new(0.0, hy, 0.0), Vec3::new(0.0, rise, hy)),
        Plane::through(Vec3::new(0.0, -hy, 0.0), Vec3::new(0.0, -rise, hy)),
        Plane::through(Vec3::new(hx, 0.0, 0.0), Vec3::X),
        Plane::through(Vec3::new(-hx, 0.0, 0.0), -Vec3::X),
        Plane::through(Vec3::ZERO, -Vec3::Z),
    ];
    let shape = Shape::Hull { planes, lo: Vec3::new(-hx, -hy, 0.0), hi: Vec3::new(hx, hy, rise) };
    let mut parts = vec![Part::new(shape, DVec3::new(0.0, 0.0, f64::from(base)), Skin::Tiles(tile))];
    for _ in 0..1 + rng.below(2) {
        let x = rng.range32(-0.85, 0.85) * hx;
        let half = Vec3::new(0.35, 0.28, 0.9);
        parts.push(block(half, Vec3::new(x, 0.15 * hy, base + rise), Skin::Blocks(Vec3::new(0.3, 0.16, 0.11), 0.1)));
    }
    for _ in 0..rng.below(3) {
        let x = rng.range32(-0.7, 0.7) * hx;
        for side in [1.0, -1.0] {
            let half = Vec3::new(0.75, 0.9, 0.75);
            let at = Vec3::new(x, side * 0.62 * hy, base + 0.34 * rise + 0.5);
            parts.push(block(half, at, Skin::Plain { rgb: f.wall * 0.9, grain: 0.1, wave: 0.5 }));
            let pane = Vec3::new(0.5, 0.02, 0.45);
            parts.push(block(pane, at + Vec3::new(0.0, side * 0.9, 0.05), Skin::Glass(Vec3::splat(0.03))));
        }
    }
    parts
}

/// Awnings over shops, balconies, hanging signs, on the street side.
fn extras(rng: &mut Rng, f: &Facade, floors: usize, near: f64) -> Vec<Part> {
    let side = near as f32;
    let face = f.half[1] * side;
    let mut parts = Vec::new();
    if f.base == Base::Shop && rng.chance(0.5) {
        let stripe = if rng.chance(0.5) { Vec3::splat(0.6) } else { f.accent * 0.8 };
        let half = Vec3::new(f.half[0] * rng.range32(0.4, 0.9), 0.65, 0.05);
        // Stripes run along y of the skin: turn the awning a quarter so that they alternate along the front.
        let turned = Part::new(
            Shape::Box { half: Vec3::new(half.y, half.x, half.z) },
            DVec3::new(0.0, f64::from(face + 0.6 * side), f64::from(f.ground * 0.72)),
            Skin::Stripes(f.accent, stripe, 0.7),
        );
        let tilt = rot_x(-0.35 * near) * rot_z(std::f64::consts::FRAC_PI_2);
        parts.push(turned.turned(tilt));
    }
    if f.base == Base::Shop && rng.chance(0.5) {
        let x = rng.range32(-0.8, 0.8) * f.half[0];
        let half = Vec3::new(0.04, 0.38, 0.38);
        parts.push(block(half, Vec3::new(x, face + 0.5 * side, f.ground * 0.9), Skin::plain(f.accent)));
    }
    if matches!(f.windows, Windows::Punched | Windows::Shuttered) && floors > 1 && rng.chance(0.4) {
        let columns = (2.0 * f.half[0] / f.bay) as usize;
        let every = 1 + rng.below(2);
        for row in 0..floors.min(5) {
            for column in (rng.below(2)..columns).step_by(every + 1) {
                let x = -f.half[0] + (column as f32 + 0.5) * f.bay + f.margin();
                let z = f.ground + row as f32 * f.floor + 0.1;
                let slab = Vec3::new(0.42 * f.bay, 0.5, 0.07);
                parts.push(block(slab, Vec3::new(x, face + 0.5 * side, z), Skin::plain(Vec3::splat(0.42))));
                let rail = Vec3::new(0.42 * f.bay, 0.03, 0.42);
                parts.push(block(rail, Vec3::new(x, face + 0.98 * side, z + 0.5), Skin::plain(f.accent * 0.5 + 0.05)));
            }
        }
    }
    parts
}

/// A far building: one box with a faint grid.
pub(crate) fn far_tower(rng: &mut Rng, at: DVec3, heading: f64) -> Body {
    let half = Vec3::new(rng.range32(5.0, 14.0), rng.range32(5.0, 10.0), rng.range32(3.5, 11.0));
    let rgb = Vec3::from(rng.pick(&WALLS)) * rng.range32(0.6, 1.0);
    let part = Part::new(Shape::Box { half }, DVec3::new(0.0, 0.0, f64::from(half.z)), Skin::Far(rgb));
    let seed = rng.seed();
    Body::fixed(Motion::fixed(at, heading), vec![part], seed)
}
