//! Trees, hedges and bushes: trunks and shells of leaves with holes.

use crate::body::{Body, Part, Shadow};
use crate::material::Skin;
use crate::math::Rng;
use crate::motion::Motion;
use crate::shape::Shape;
use glam::{DVec3, Vec3};

/// A kind of tree that a row shares.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Species {
    leaf: Vec3,
    bark: Vec3,
    clump: f32,
    open: f32,
    /// Crown height over width.
    slender: f32,
    height: f32,
    bare: f32,
}

impl Species {
    /// Draws a species: summer greens, some autumn, some dark conifers.
    pub(crate) fn draw(rng: &mut Rng) -> Species {
        let leaf = rng.pick(&[
            Vec3::new(0.11, 0.19, 0.045),
            Vec3::new(0.16, 0.23, 0.05),
            Vec3::new(0.07, 0.14, 0.05),
            Vec3::new(0.19, 0.22, 0.07),
            Vec3::new(0.10, 0.17, 0.03),
            Vec3::new(0.34, 0.21, 0.04),
            Vec3::new(0.30, 0.10, 0.035),
        ]);
        Species {
            leaf,
            bark: rng.pick(&[Vec3::new(0.13, 0.10, 0.08), Vec3::new(0.09, 0.07, 0.055), Vec3::new(0.32, 0.31, 0.28)]),
            clump: rng.range32(0.22, 0.4),
            open: rng.range32(0.5, 0.95),
            slender: rng.range32(0.8, 1.9),
            height: rng.range32(5.0, 10.0),
            bare: rng.range32(0.28, 0.4),
        }
    }
}

/// A street tree.
pub(crate) fn tree(rng: &mut Rng, species: &Species, at: DVec3) -> Body {
    let height = species.height * rng.range32(0.75, 1.25);
    let stem = height * species.bare;
    let crown = height - stem * 0.85;
    let width = 0.5 * crown / species.slender;
    let seed = rng.seed();
    let mut parts = Vec::new();
    let girth = 0.018 * height + 0.04;
    let trunk = Shape::Cylinder { radius: girth, half: 0.5 * (stem + 0.35 * crown) };
    let lean = f64::from(rng.range32(-0.05, 0.05));
    let middle = DVec3::new(0.0, 0.0, 0.5 * f64::from(stem + 0.35 * crown));
    parts.push(Part::new(trunk, middle, Skin::Bark(species.bark)).turned(crate::math::rot_x(lean)));
    let mut blob = |radii: Vec3, at: Vec3, tone: f32, k: u32| {
        let shape = Shape::Crown { radii, leaf: species.clump, open: species.open, seed: seed.wrapping_add(k) };
        parts.push(Part::new(shape, at.as_dvec3(), Skin::Leaves(species.leaf * tone, species.clump)));
    };
    let top = stem * 0.85 + 0.5 * crown;
    blob(Vec3::new(0.8 * width, 0.8 * width, 0.5 * crown), Vec3::new(0.0, 0.0, top), 0.9, 0);
    let turn = rng.range(0.0, 1.0);
    for k in 0..7 {
        let (sin, cos) = crate::math::sin_cos(std::f64::consts::TAU * (turn + f64::from(k) / 7.0));
        let r = width * rng.range32(0.42, 0.72);
        let z = top + crown * rng.range32(-0.3, 0.26);
        let size = width * rng.range32(0.32, 0.58);
        let at = Vec3::new(cos as f32 * r, sin as f32 * r, z);
        blob(Vec3::new(size, size, size * rng.range32(0.75, 1.1)), at, rng.range32(0.85, 1.15), k as u32 + 1);
    }
    Body::fixed(Motion::fixed(at, rng.range(0.0, 6.0)), parts, seed)
        .shaded(Shadow::Ball { height: top, radii: [0.95 * width, 0.5 * crown] })
}

/// A clipped hedge along x.
pub(crate) fn hedge(rng: &mut Rng, species: &Species, at: DVec3, heading: f64, length: f32) -> Body {
    let half = Vec3::new(0.5 * length, rng.range32(0.3, 0.5), rng.range32(0.4, 0.9));
    let shape = Shape::Box { half };
    let part = Part::new(shape, DVec3::new(0.0, 0.0, f64::from(half.z)), Skin::Leaves(species.leaf * 0.85, 0.3));
    let shadow = Shadow::Box { half: [half.x, half.y], from: 0.0, to: 2.0 * half.z, contact: 0.4 };
    Body::fixed(Motion::fixed(at, heading), vec![part], rng.seed()).shaded(shadow)
}

/// A bush.
pub(crate) fn bush(rng: &mut Rng, species: &Species, at: DVec3) -> Body {
    let seed = rng.seed();
    let mut parts = Vec::new();
    for k in 0..3u32 {
        let r = rng.range32(0.45, 0.9);
        let shape = Shape::Crown { radii: Vec3::new(r, r, 0.8 * r), leaf: 0.25, open: 0.3, seed: seed ^ k };
        let at = DVec3::new(rng.range(-0.7, 0.7), rng.range(-0.5, 0.5), f64::from(r) * 0.55);
        parts.push(Part::new(shape, at, Skin::Leaves(species.leaf * rng.range32(0.8, 1.2), 0.25)));
    }
    Body::fixed(Motion::fixed(at, 0.0), parts, seed).shaded(Shadow::Box {
        half: [0.7, 0.6],
        from: 0.0,
        to: 0.8,
        contact: 0.5,
    })
}
