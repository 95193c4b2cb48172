//! [`Skin`]: the material of a part, and what it looks like at a point.

use crate::facade::Facade;
use crate::light::Light;
use crate::math::{clamp01, floor, fract, hash2, unit};
use crate::paint::Paint;
use crate::surface::{Look, Spot};
use crate::texture::{band, fade, fbm2, fbm3, masonry, mix, octaves, pulses, step};
use glam::Vec3;

/// Kinds of sign face.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum SignFace {
    /// Red ring on white.
    Ring,
    /// Blue disc with a white mark.
    Disc,
    /// Board with lines of lettering.
    Board,
    /// Advertisement: blocks of colour.
    Poster,
}

/// Material of a part.
#[derive(Clone, Debug)]
pub(crate) enum Skin {
    /// One colour with grain of a given strength and wavelength.
    Plain {
        /// Albedo.
        rgb: Vec3,
        /// Relative strength of the grain.
        grain: f32,
        /// Longest wavelength, metres.
        wave: f32,
    },
    /// Wall of a building.
    Facade(Box<Facade>),
    /// Roof tiles in rows.
    Tiles(Vec3),
    /// Masonry blocks: colour and block height, metres.
    Blocks(Vec3, f32),
    /// Vehicle body.
    Paint(Box<Paint>),
    /// Wheel: cylinder along z; radius and rim colour.
    Wheel(f32, Vec3),
    /// Bicycle wheel: cylinder along z; radius.
    Spokes(f32),
    /// Foliage: colour and clump size, metres.
    Leaves(Vec3, f32),
    /// Bark.
    Bark(Vec3),
    /// Stripes along y of two colours and a period, metres (awnings, barriers).
    Stripes(Vec3, Vec3, f32),
    /// Head: skin and hair.
    Head(Vec3, Vec3),
    /// Sign on the faces across x: kind, ground colour, half size of the face.
    Sign(SignFace, Vec3, [f32; 2]),
    /// Lamp: colour, lit by day.
    Lamp(Vec3, f32),
    /// Window glass of shelters and showrooms.
    Glass(Vec3),
    /// Far building: a faint window grid.
    Far(Vec3),
}

impl Skin {
    /// Plain with little grain.
    pub(crate) fn plain(rgb: Vec3) -> Skin {
        Skin::Plain { rgb, grain: 0.12, wave: 0.5 }
    }

    /// Appearance at a point.
    pub(crate) fn look(&self, at: &Spot, light: &Light) -> Look {
        match self {
            Skin::Plain { rgb, grain, wave } => {
                Look::matt(*rgb * (1.0 + grain * fbm3(at.p, octaves(*wave, 2, at.seed), at.width())))
            }
            Skin::Facade(f) => f.look(at, light),
            Skin::Tiles(rgb) => tiles(at, *rgb),
            Skin::Blocks(rgb, size) => blocks(at, *rgb, *size),
            Skin::Paint(p) => p.look(at, light),
            Skin::Wheel(radius, rim) => wheel(at, *radius, *rim),
            Skin::Spokes(radius) => {
                // Thin tyre; spokes and the view between them as one middle grey.
                let f = at.fp.x.max(at.fp.y);
                let r = (at.p.x * at.p.x + at.p.y * at.p.y).sqrt();
                let tyre = band(r, 0.90 * radius, 2.0 * radius, f).max(band(r, -1.0, 0.08 * radius, f));
                Look::matt(Vec3::splat(0.13 - 0.11 * tyre))
            }
            Skin::Leaves(rgb, size) => leaves(at, *rgb, *size),
            Skin::Bark(rgb) => {
                let p = Vec3::new(at.p.x * 6.0, at.p.y * 6.0, at.p.z * 0.8);
                Look::matt(*rgb * (1.0 + 0.8 * fbm3(p, octaves(0.6, 3, at.seed), 5.0 * at.fp.x)))
            }
            Skin::Stripes(a, b, period) => Look::matt(mix(*a, *b, pulses(at.p.y, *period, 0.0, 0.5 * period, at.fp.y))),
            Skin::Head(skin, hair) => {
                // Hair on top and behind; eyes as a dark band in front.
                let cap = step(at.p.z + 0.55 * -at.p.x, 0.03, at.width());
                let eyes = band(at.p.z, 0.0, 0.025, at.fp.z) * step(at.p.x, 0.05, at.fp.x) * 0.6;
                Look::matt(mix(mix(*skin, *hair, cap), Vec3::splat(0.03), eyes))
            }
            Skin::Sign(face, rgb, half) => sign(at, *face, *rgb, *half),
            Skin::Lamp(rgb, by_day) => {
                let on = if light.lamps > 0.0 { 1.6 * light.lamps } else { *by_day };
                Look { albedo: *rgb * 0.6, glow: *rgb * on, mirror: 0.1 }
            }
            Skin::Glass(rgb) => Look { albedo: *rgb, glow: Vec3::ZERO, mirror: 0.4 },
            Skin::Far(rgb) => {
                let u = at.p.x * at.n.y.abs() + at.p.y * at.n.x.abs();
                let fu = at.fp.x.max(at.fp.y);
                let w = pulses(u, 3.4, 0.9, 2.5, fu) * pulses(at.p.z, 3.2, 0.8, 2.3, at.fp.z) * (1.0 - at.n.z.abs());
                Look::matt(*rgb * (1.0 - 0.45 * w) * (1.0 + 0.15 * fbm2(u, at.p.z, octaves(9.0, 2, at.seed), fu)))
            }
        }
    }
}

/// Rows of tiles down a slope: each row darker at its lower edge, tones per tile.
fn tiles(at: &Spot, rgb: Vec3) -> Look {
    let (u, v) = (at.p.x + at.p.y, at.p.z * 1.6);
    let (fu, fv) = (at.fp.x + at.fp.y, at.fp.z * 1.6);
    let row = floor(v / 0.34);
    let shifted = u + if row as i32 & 1 == 0 { 0.0 } else { 0.14 };
    let tone = unit(hash2(floor(shifted / 0.28) as i32, row as i32, at.seed)) - 0.5;
    let edge = pulses(v, 0.34, 0.0, 0.06, fv);
    let shade = 1.0 + 0.35 * tone * fade(0.3, fu.max(fv)) - 0.35 * edge
        + 0.3 * fbm2(u, v, octaves(2.2, 3, at.seed ^ 1), fu.max(fv));
    Look::matt(rgb * shade)
}

fn blocks(at: &Spot, rgb: Vec3, size: f32) -> Look {
    if at.n.z.abs() > 0.7 {
        return Look::matt(rgb * (1.15 + 0.2 * fbm2(at.p.x, at.p.y, octaves(0.8, 2, at.seed), at.fp.x.max(at.fp.y))));
    }
    let along_x = at.n.y.abs() > at.n.x.abs();
    let (u, fu) = if along_x { (at.p.x, at.fp.x) } else { (at.p.y, at.fp.y) };
    let stain = 1.0 + 0.3 * fbm2(u, at.p.z, octaves(1.9, 3, at.seed ^ 3), fu.max(at.fp.z));
    Look::matt(rgb * (masonry(u, at.p.z, fu, at.fp.z, size, at.seed) * stain))
}

/// Tyre, rim with five spokes, hub.
fn wheel(at: &Spot, radius: f32, rim: Vec3) -> Look {
    let tyre = Vec3::splat(0.022);
    if at.n.z.abs() < 0.5 {
        return Look::matt(tyre);
    }
    let f = at.fp.x.max(at.fp.y);
    let r = (at.p.x * at.p.x + at.p.y * at.p.y).sqrt();
    // Unit vectors every 72 degrees; the spoke nearest to the point has the largest cosine.
    const SPOKES: [[f32; 2]; 5] = [
        [1.0, 0.0],
        [0.309_017, 0.951_056_5],
        [-0.809_017, 0.587_785_3],
        [-0.809_017, -0.587_785_3],
        [0.309_017, -0.951_056_5],
    ];
    let mut across = r;
    for [c, s] in SPOKES {
        if at.p.x * c + at.p.y * s > 0.0 {
            let d = (at.p.y * c - at.p.x * s).abs();
            across = if d < across { d } else { across };
        }
    }
    let spoke = band(across, -1.0, 0.16 * radius, f).max(band(r, -1.0, 0.2 * radius, f));
    let ring = band(r, 0.60 * radius, 0.70 * radius, f);
    let inside = band(r, -1.0, 0.66 * radius, f);
    let metal = clamp01(ring + spoke * inside);
    Look { albedo: mix(tyre, rim, metal), glow: Vec3::ZERO, mirror: 0.12 * metal }
}

/// Clumps of leaves: strong contrast, darker below and inside, a touch of yellow in the light.
fn leaves(at: &Spot, rgb: Vec3, size: f32) -> Look {
    let w = at.width();
    let clump = fbm3(at.p, octaves(size * 2.4, 2, at.seed), w);
    let fine = fbm3(at.p, octaves(size * 0.5, 3, at.seed ^ 7), w);
    let tone = clamp01(0.58 + 0.45 * clump + 1.05 * fine + 0.22 * at.n.z);
    Look::matt(rgb * (0.28 + 1.05 * tone) * mix(Vec3::new(0.75, 0.9, 1.1), Vec3::new(1.25, 1.06, 0.7), tone))
}

fn sign(at: &Spot, face: SignFace, rgb: Vec3, half: [f32; 2]) -> Look {
    let back = Look::matt(Vec3::splat(0.25));
    if at.n.x.abs() < 0.5 {
        return back;
    }
    let (u, v, fu, fv) = (at.p.y / half[0], at.p.z / half[1], at.fp.y / half[0], at.fp.z / half[1]);
    let f = fu.max(fv);
    let white = Vec3::splat(0.72);
    let r = (u * u + v * v).sqrt();
    let albedo = match face {
        SignFace::Ring => {
            let ring = step(r, 0.68, f);
            let bar = band(v, -0.14, 0.14, fv) * band(u, -0.45, 0.45, fu);
            mix(mix(white, Vec3::splat(0.03), bar), rgb, ring)
        }
        SignFace::Disc => {
            let mark = band(u, -0.13, 0.13, fu) * band(v, -0.55, 0.4, fv)
                + band(v - (0.65 - u.abs()), -0.3, 0.0, f) * band(u, -0.5, 0.5, fu);
            mix(rgb, white, clamp01(mark))
        }
        SignFace::Board => {
            let line = pulses(v + 0.8, 0.5, 0.12, 0.36, fv);
            let row = floor((v + 0.8) / 0.5) as i32;
            let cell = floor((u + 1.0) / 0.16) as i32;
            let ink = if unit(hash2(cell, row, at.seed)) < 0.72 { 1.0 } else { 0.0 };
            let soft = ink * fade(0.16, fu) + 0.6 * (1.0 - fade(0.16, fu));
            let inside = band(u, -0.86, 0.86, fu) * band(v, -0.8, 0.8, fv);
            let rim = 1.0 - band(u, -0.95, 0.95, fu) * band(v, -0.93, 0.93, fv);
            mix(rgb, white, clamp01(line * soft * inside * 0.95 + rim))
        }
        SignFace::Poster => {
            let (a, b) = (at.seed, at.seed.rotate_left(11));
            let tone = |h: u32| Vec3::new(unit(h), unit(h.rotate_left(9)), unit(h.rotate_left(17))) * 0.7 + 0.05;
            let split = step(v, 0.6 * (unit(a.rotate_left(3)) - 0.5) + 0.25 * u, f);
            let x = u - 0.8 * (unit(b) - 0.5);
            let spot = 1.0 - step((x * x + v * v).sqrt(), 0.25 + 0.35 * unit(a.rotate_left(5)), f);
            let text = band(v, -0.82, -0.6, fv)
                * (0.6 + 0.4 * (unit(hash2(floor(u * 9.0) as i32, 3, a)) - 0.5) * fade(0.11, fu));
            let mut c = mix(tone(crate::math::hash2(1, 2, a)), tone(crate::math::hash2(3, 4, a)), split);
            c = mix(c, tone(crate::math::hash2(5, 6, a)), spot);
            mix(c, white, clamp01(text))
        }
    };
    let lit = fract(unit(at.seed) * 7.0);
    Look { albedo: albedo * (0.9 + 0.1 * lit), glow: Vec3::ZERO, mirror: 0.03 }
}
