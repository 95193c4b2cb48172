//! Street furniture: lamps, traffic lights, signs, bins, bollards, shelters, walls and fences.

use crate::body::{Body, Part, Shadow};
use crate::material::{SignFace, Skin};
use crate::math::{Rng, rot_x, rot_y};
use crate::motion::Motion;
use crate::shape::Shape;
use glam::{DVec3, Vec3};

const METAL: Vec3 = Vec3::new(0.20, 0.21, 0.22);

fn pole(radius: f32, height: f64, rgb: Vec3) -> Part {
    let shape = Shape::Cylinder { radius, half: (0.5 * height) as f32 };
    Part::new(shape, DVec3::new(0.0, 0.0, 0.5 * height), Skin::plain(rgb))
}

fn slab(half: [f32; 3], at: [f64; 3], skin: Skin) -> Part {
    Part::new(Shape::Box { half: Vec3::from(half) }, DVec3::from(at), skin)
}

fn body(rng: &mut Rng, at: DVec3, heading: f64, parts: Vec<Part>) -> Body {
    Body::fixed(Motion::fixed(at, heading), parts, rng.seed())
}

fn standing(radius: f32, height: f32) -> Shadow {
    Shadow::Box { half: [radius; 2], from: 0.0, to: height, contact: 0.3 }
}

/// Street lamp whose arm points along +x of `heading`.
pub(crate) fn lamp(rng: &mut Rng, at: DVec3, heading: f64) -> Body {
    let height = rng.range(6.0, 8.5);
    let arm = 0.9;
    let tube = Shape::Capsule { radius: 0.045, half: arm as f32 };
    let parts = vec![
        pole(0.075, height, METAL * 0.7),
        pole(0.13, 1.0, METAL * 0.7),
        Part::new(tube, DVec3::new(arm, 0.0, height), Skin::plain(METAL * 0.7))
            .turned(rot_y(std::f64::consts::FRAC_PI_2)),
        slab([0.32, 0.12, 0.06], [2.0 * arm, 0.0, height - 0.05], Skin::Lamp(Vec3::new(1.0, 0.86, 0.6), 0.0)),
    ];
    body(rng, at, heading, parts).shaded(standing(0.08, height as f32))
}

/// Traffic light that faces against `heading` (towards cars that travel along it).
pub(crate) fn signal(rng: &mut Rng, at: DVec3, heading: f64) -> Body {
    let height = 3.1;
    let mut parts = vec![
        pole(0.06, height, METAL),
        slab([0.12, 0.16, 0.42], [0.0, 0.0, height + 0.3], Skin::plain(Vec3::splat(0.02))),
    ];
    let lit = rng.below(3);
    let colours = [Vec3::new(1.0, 0.05, 0.03), Vec3::new(1.0, 0.6, 0.05), Vec3::new(0.08, 0.9, 0.4)];
    for (k, rgb) in colours.iter().enumerate() {
        let on = if k == lit { 1.0 } else { 0.0 };
        let shape = Shape::Cylinder { radius: 0.1, half: 0.03 };
        let at = DVec3::new(-0.12, 0.0, height + 0.56 - 0.26 * k as f64);
        let skin = if on > 0.0 { Skin::Lamp(*rgb, 1.3) } else { Skin::plain(*rgb * 0.08) };
        parts.push(Part::new(shape, at, skin).turned(rot_y(std::f64::consts::FRAC_PI_2)));
    }
    body(rng, at, heading, parts).shaded(standing(0.06, height as f32))
}

/// Road sign that faces against `heading`.
pub(crate) fn sign(rng: &mut Rng, at: DVec3, heading: f64) -> Body {
    let height = rng.range(2.1, 2.7);
    let mut parts = vec![pole(0.035, height + 0.3, METAL)];
    if rng.chance(0.65) {
        let (face, rgb) = if rng.chance(0.5) {
            (SignFace::Ring, Vec3::new(0.5, 0.03, 0.03))
        } else {
            (SignFace::Disc, Vec3::new(0.02, 0.09, 0.42))
        };
        let disc = Shape::Cylinder { radius: 0.32, half: 0.015 };
        let skin = Skin::Sign(face, rgb, [0.32, 0.32]);
        // A cylinder's axis is z; signs are drawn across x: swap the axes by a quarter turn and draw on a box
        // where the face is square.
        let part = if face == SignFace::Ring {
            Part::new(Shape::Ellipsoid { radii: Vec3::new(0.03, 0.32, 0.32) }, DVec3::new(-0.06, 0.0, height), skin)
        } else {
            let back = Part::new(disc, DVec3::new(-0.03, 0.0, height), Skin::plain(METAL))
                .turned(rot_y(std::f64::consts::FRAC_PI_2));
            parts.push(back);
            slab([0.01, 0.30, 0.30], [-0.06, 0.0, height], skin)
        };
        parts.push(part);
    } else {
        let rgb = rng.pick(&[Vec3::new(0.02, 0.10, 0.35), Vec3::new(0.02, 0.20, 0.09), Vec3::new(0.5, 0.42, 0.06)]);
        let half = [0.02, rng.range32(0.4, 0.8), rng.range32(0.25, 0.45)];
        parts.push(slab(half, [-0.06, 0.0, height], Skin::Sign(SignFace::Board, rgb, [half[1], half[2]])));
    }
    body(rng, at, heading, parts).shaded(standing(0.035, height as f32))
}

/// Something small on the pavement: litter bin, bollard, cabinet, bench, hydrant, planter.
pub(crate) fn small(rng: &mut Rng, at: DVec3, heading: f64) -> Body {
    let green = Vec3::new(0.03, 0.11, 0.06);
    let (parts, shadow) = match rng.below(6) {
        0 => {
            let drum = Shape::Cylinder { radius: 0.24, half: 0.45 };
            let lid = Shape::Ellipsoid { radii: Vec3::new(0.26, 0.26, 0.1) };
            (
                vec![
                    Part::new(drum, DVec3::new(0.0, 0.0, 0.45), Skin::plain(green)),
                    Part::new(lid, DVec3::new(0.0, 0.0, 0.92), Skin::plain(METAL * 0.5)),
                ],
                standing(0.24, 0.95),
            )
        }
        1 => (
            (0..3)
                .map(|k| {
                    let mut p = pole(0.06, 0.9, Vec3::splat(0.05));
                    p.t.x = 1.5 * f64::from(k);
                    p
                })
                .collect(),
            standing(0.06, 0.9),
        ),
        2 => (vec![slab([0.4, 0.2, 0.6], [0.0, 0.0, 0.6], Skin::plain(METAL * 1.6))], standing(0.3, 1.2)),
        3 => (
            vec![
                slab([0.8, 0.2, 0.03], [0.0, 0.0, 0.45], Skin::plain(Vec3::new(0.25, 0.14, 0.07))),
                slab([0.8, 0.03, 0.2], [0.0, 0.2, 0.72], Skin::plain(Vec3::new(0.25, 0.14, 0.07))),
                slab([0.05, 0.18, 0.22], [-0.6, 0.0, 0.22], Skin::plain(METAL * 0.4)),
                slab([0.05, 0.18, 0.22], [0.6, 0.0, 0.22], Skin::plain(METAL * 0.4)),
            ],
            Shadow::Box { half: [0.8, 0.2], from: 0.0, to: 0.5, contact: 0.4 },
        ),
        4 => {
            let red = Vec3::new(0.45, 0.04, 0.03);
            let cap = Shape::Ellipsoid { radii: Vec3::splat(0.13) };
            (
                vec![pole(0.11, 0.6, red), Part::new(cap, DVec3::new(0.0, 0.0, 0.62), Skin::plain(red))],
                standing(0.11, 0.7),
            )
        }
        _ => {
            let leaves = Shape::Crown { radii: Vec3::new(0.75, 0.35, 0.35), leaf: 0.16, open: 0.3, seed: rng.seed() };
            (
                vec![
                    slab([0.8, 0.35, 0.25], [0.0, 0.0, 0.25], Skin::plain(Vec3::splat(0.3))),
                    Part::new(leaves, DVec3::new(0.0, 0.0, 0.6), Skin::Leaves(Vec3::new(0.12, 0.2, 0.05), 0.16)),
                ],
                Shadow::Box { half: [0.8, 0.35], from: 0.0, to: 0.6, contact: 0.4 },
            )
        }
    };
    body(rng, at, heading, parts).shaded(shadow)
}

/// Bus shelter open to -y, with a poster at its end.
pub(crate) fn shelter(rng: &mut Rng, at: DVec3, heading: f64) -> Body {
    let dark = Skin::plain(Vec3::splat(0.06));
    let mut parts = vec![
        slab([2.0, 0.75, 0.06], [0.0, 0.0, 2.45], dark.clone()),
        slab([2.0, 0.02, 0.85], [0.0, 0.65, 1.35], Skin::Glass(Vec3::new(0.10, 0.13, 0.13))),
        slab([1.2, 0.2, 0.03], [-0.3, 0.45, 0.5], Skin::plain(Vec3::splat(0.3))),
        slab([0.06, 0.65, 0.95], [1.95, 0.0, 1.15], Skin::Sign(SignFace::Poster, Vec3::splat(0.5), [0.65, 0.95])),
    ];
    for x in [-1.95, 0.0, 1.95] {
        let mut post = pole(0.04, 2.45, Vec3::splat(0.06));
        post.t.x = x;
        post.t.y = 0.65;
        parts.push(post);
    }
    body(rng, at, heading, parts).shaded(Shadow::Box { half: [2.0, 0.75], from: 2.3, to: 2.5, contact: 0.0 })
}

/// Advertising column or board.
pub(crate) fn poster(rng: &mut Rng, at: DVec3, heading: f64) -> Body {
    let half = [0.08, rng.range32(0.6, 1.7), rng.range32(0.85, 1.2)];
    let skin = Skin::Sign(SignFace::Poster, Vec3::splat(0.5), [half[1], half[2]]);
    let z = 0.5 + f64::from(half[2]);
    let parts = vec![slab(half, [0.0, 0.0, z], skin), pole(0.08, 0.6, METAL)];
    body(rng, at, heading, parts).shaded(standing(0.5, 0.6 + 2.0 * half[2]))
}

/// Garden wall, fence or railing of a length along x.
pub(crate) fn wall(rng: &mut Rng, at: DVec3, heading: f64, length: f32) -> Body {
    let half = 0.5 * length;
    let parts = match rng.below(4) {
        0 => {
            let h = rng.range32(0.5, 1.2);
            let rgb = rng.pick(&[Vec3::new(0.34, 0.17, 0.11), Vec3::new(0.40, 0.37, 0.31), Vec3::new(0.3, 0.29, 0.28)]);
            vec![
                slab([half, 0.14, h], [0.0, 0.0, f64::from(h)], Skin::Blocks(rgb, 0.14)),
                slab([half, 0.18, 0.05], [0.0, 0.0, f64::from(2.0 * h) + 0.05], Skin::plain(Vec3::splat(0.4))),
            ]
        }
        1 => {
            let rgb = rng.pick(&[Vec3::splat(0.55), Vec3::new(0.22, 0.13, 0.07), Vec3::new(0.08, 0.14, 0.10)]);
            let quarter = crate::math::rot_z(std::f64::consts::FRAC_PI_2);
            let board = Shape::Box { half: Vec3::new(0.03, half, 0.55) };
            vec![Part::new(board, DVec3::new(0.0, 0.0, 0.6), Skin::Stripes(rgb, rgb * 0.55, 0.16)).turned(quarter)]
        }
        2 => {
            let mut parts: Vec<Part> = [0.45, 1.0]
                .iter()
                .map(|&z| {
                    let rail = Shape::Capsule { radius: 0.025, half };
                    Part::new(rail, DVec3::new(0.0, 0.0, z), Skin::plain(METAL))
                        .turned(rot_y(std::f64::consts::FRAC_PI_2))
                })
                .collect();
            let posts = (length / 2.0) as usize;
            parts.extend((0..=posts).map(|k| {
                let mut p = pole(0.03, 1.05, METAL);
                p.t.x = f64::from(-half) + 2.0 * k as f64;
                p
            }));
            parts
        }
        _ => {
            let h = rng.range32(0.9, 1.4);
            vec![slab(
                [half, 0.10, h],
                [0.0, 0.0, f64::from(h)],
                Skin::Plain { rgb: Vec3::splat(0.4), grain: 0.4, wave: 2.0 },
            )]
        }
    };
    let top = if parts.len() > 3 { 0.2 } else { 1.6 };
    body(rng, at, heading, parts).shaded(Shadow::Box { half: [half, 0.12], from: 0.0, to: top, contact: 0.3 })
}

/// Works barrier: red and white boards on feet.
pub(crate) fn barrier(rng: &mut Rng, at: DVec3, heading: f64) -> Body {
    let quarter = crate::math::rot_z(std::f64::consts::FRAC_PI_2);
    let stripes = Skin::Stripes(Vec3::new(0.55, 0.06, 0.03), Vec3::splat(0.65), 0.5);
    let board = Shape::Box { half: Vec3::new(0.02, 0.9, 0.12) };
    let mut parts = vec![
        Part::new(board.clone(), DVec3::new(0.0, 0.0, 0.9), stripes.clone()).turned(quarter),
        Part::new(board, DVec3::new(0.0, 0.0, 0.45), stripes).turned(quarter),
    ];
    for x in [-0.8, 0.8] {
        let mut post = pole(0.03, 1.05, METAL);
        post.t.x = x;
        parts.push(post);
        let foot = Shape::Capsule { radius: 0.04, half: 0.3 };
        let lie = rot_x(std::f64::consts::FRAC_PI_2);
        parts.push(Part::new(foot, DVec3::new(x, 0.0, 0.05), Skin::plain(Vec3::splat(0.04))).turned(lie));
    }
    body(rng, at, heading, parts).shaded(Shadow::Box { half: [0.9, 0.05], from: 0.3, to: 1.0, contact: 0.3 })
}
