//! Objects of the street: rigid parts on a rig that moves them.

use crate::material::Skin;
use crate::math::sin_cos;
use crate::motion::{Motion, Path, Speed, Turn, follow};
use crate::shape::Shape;
use glam::{DMat3, DVec3};

/// One primitive of an object.
#[derive(Clone, Debug)]
pub(crate) struct Part {
    /// Geometry around the part's origin.
    pub(crate) shape: Shape,
    /// Which node of the rig carries it.
    pub(crate) node: usize,
    /// Part to node rotation.
    pub(crate) r: DMat3,
    /// Part origin in node coordinates, metres.
    pub(crate) t: DVec3,
    /// Appearance.
    pub(crate) skin: Skin,
}

impl Part {
    /// A part of node 0 with the node's axes.
    pub(crate) fn new(shape: Shape, t: DVec3, skin: Skin) -> Part {
        Part { shape, node: 0, r: DMat3::IDENTITY, t, skin }
    }

    /// The same part on another node.
    pub(crate) fn on(self, node: usize) -> Part {
        Part { node, ..self }
    }

    /// The same part turned.
    pub(crate) fn turned(self, r: DMat3) -> Part {
        Part { r, ..self }
    }
}

/// What an object throws on the ground.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) enum Shadow {
    /// Nothing worth drawing.
    None,
    /// A box from height `from` to `to`; `contact` darkens the ground close around it.
    Box {
        /// Half extents along x and y of node 0.
        half: [f32; 2],
        /// Underside, metres.
        from: f32,
        /// Top, metres.
        to: f32,
        /// Depth of the contact shadow, 0..1.
        contact: f32,
    },
    /// An ellipsoid above the origin.
    Ball {
        /// Height of its centre, metres.
        height: f32,
        /// Horizontal and vertical radius.
        radii: [f32; 2],
    },
}

/// How an object moves.
#[derive(Clone, Debug)]
pub(crate) enum Rig {
    /// Stands still; one node.
    Fixed(Motion),
    /// Follows a path; node 0 is the chassis, the others are wheels.
    Drive {
        /// Ground track of the chassis origin.
        path: Path,
        /// Distance along it.
        speed: Speed,
        /// Axle centres in chassis coordinates.
        axles: Vec<DVec3>,
        /// Wheel radius, metres.
        radius: f64,
        /// Person that pedals, if any: nodes after the wheels.
        rider: Option<Gait>,
    },
    /// Walks along a path.
    Walk {
        /// Ground track.
        path: Path,
        /// Distance along it.
        speed: Speed,
        /// Limbs.
        gait: Gait,
        /// Height of the ground underfoot, metres.
        ground: f64,
    },
}

/// Sizes and phase of a person's swinging limbs.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) struct Gait {
    /// Body height, metres.
    pub(crate) height: f64,
    /// Phase at distance 0, radians.
    pub(crate) phase: f64,
    /// Forward swing of the thighs, radians; 0 for somebody who stands.
    pub(crate) swing: f64,
    /// Distance of a full cycle (two steps), metres.
    pub(crate) stride: f64,
}

/// Nodes of a person: trunk, head, then (upper, lower) arm left and right, (thigh, shin) left and right.
pub(crate) const PERSON_NODES: usize = 10;

/// A whole object.
#[derive(Clone, Debug)]
pub(crate) struct Body {
    /// Primitives.
    pub(crate) parts: Vec<Part>,
    /// Motion.
    pub(crate) rig: Rig,
    /// Texture seed.
    pub(crate) seed: u32,
    /// Shadow on the ground.
    pub(crate) shadow: Shadow,
}

impl Body {
    /// A body that never moves.
    pub(crate) fn fixed(at: Motion, parts: Vec<Part>, seed: u32) -> Body {
        Body { parts, rig: Rig::Fixed(at), seed, shadow: Shadow::None }
    }

    /// The same body with a shadow.
    pub(crate) fn shaded(self, shadow: Shadow) -> Body {
        Body { shadow, ..self }
    }

    /// Pose and twist of every node of the rig, into `out`.
    pub(crate) fn motions(&self, time: f64, out: &mut Vec<Motion>) {
        out.clear();
        match &self.rig {
            Rig::Fixed(m) => out.push(*m),
            Rig::Drive { path, speed, axles, radius, rider } => {
                let chassis = follow(path, speed, time, 0.0);
                let (s, v) = speed.at(time);
                out.push(chassis);
                let spin = Turn { angle: s / radius, rate: v / radius };
                out.extend(axles.iter().map(|&a| chassis.joint(a, spin)));
                if let Some(gait) = rider {
                    pedal(&chassis, gait, s, v, out);
                }
            }
            Rig::Walk { path, speed, gait, ground } => {
                let (s, v) = speed.at(time);
                walk(&follow(path, speed, time, *ground), gait, s, v, out);
            }
        }
    }

    /// Whether a node is a wheel. Its spin is a matter of looks: what a straight-line velocity can say about it is
    /// where its vehicle takes it, and the rim's own speed (0 to twice the vehicle's) would tear it apart.
    pub(crate) fn spins(&self, node: usize) -> bool {
        matches!(&self.rig, Rig::Drive { axles, .. } if (1..=axles.len()).contains(&node))
    }

    /// Whether it can have a velocity at some time.
    pub(crate) fn moves(&self) -> bool {
        match &self.rig {
            Rig::Fixed(_) => false,
            Rig::Drive { speed, .. } | Rig::Walk { speed, .. } => speed.v0 != 0.0 || speed.a != 0.0,
        }
    }
}

/// `offset + amplitude sin(phase + shift)` about the sideways axis, with its derivative. A negative angle
/// swings a hanging limb forward.
fn swing(phase: (f64, f64), shift: f64, offset: f64, amplitude: f64) -> Turn {
    let (sin, cos) = sin_cos(phase.0 + shift);
    Turn { angle: offset + amplitude * sin, rate: amplitude * cos * phase.1 }
}

/// Limbs of somebody walking: thighs in opposition, knees bent in the forward swing, arms against legs,
/// trunk bobbing twice a cycle.
fn walk(ground: &Motion, g: &Gait, s: f64, v: f64, out: &mut Vec<Motion>) {
    let turn = std::f64::consts::TAU / g.stride;
    let phase = (g.phase + s * turn, v * turn);
    let h = g.height;
    let (sin, cos) = sin_cos(2.0 * phase.0);
    let bob = 0.012 * h * g.swing;
    let hip = DVec3::new(0.0, 0.0, 0.5 * h);
    let trunk = ground.slide(hip + DVec3::Z * (bob * sin), DVec3::Z * (2.0 * bob * cos * phase.1));
    out.push(trunk);
    out.push(trunk.slide(DVec3::new(0.01 * h, 0.0, 0.40 * h), DVec3::ZERO));
    for side in [1.0, -1.0] {
        let shift = if side > 0.0 { 0.0 } else { std::f64::consts::PI };
        let shoulder = DVec3::new(0.0, side * 0.125 * h, 0.31 * h);
        let upper = trunk.joint(shoulder, swing(phase, shift, 0.05, 0.8 * g.swing));
        out.push(upper);
        out.push(
            upper.joint(DVec3::new(0.0, 0.0, -0.17 * h), swing(phase, shift, -0.3 - 0.4 * g.swing, 0.3 * g.swing)),
        );
    }
    for side in [1.0, -1.0] {
        let shift = if side > 0.0 { std::f64::consts::PI } else { 0.0 };
        let thigh = trunk.joint(DVec3::new(0.0, side * 0.055 * h, 0.0), swing(phase, shift, -0.1 * g.swing, g.swing));
        out.push(thigh);
        out.push(
            thigh.joint(DVec3::new(0.0, 0.0, -0.245 * h), swing(phase, shift + 2.2, 0.7 * g.swing, 0.7 * g.swing)),
        );
    }
}

/// Limbs of somebody cycling: hands on the bar, thighs and shins cranking.
fn pedal(bike: &Motion, g: &Gait, s: f64, v: f64, out: &mut Vec<Motion>) {
    let turn = std::f64::consts::TAU / g.stride;
    let phase = (g.phase + s * turn, v * turn);
    let h = g.height;
    let lean = |angle: f64| Turn { angle, rate: 0.0 };
    let trunk = bike.joint(DVec3::new(-0.22, 0.0, 0.53 * h), lean(0.45));
    out.push(trunk);
    out.push(trunk.joint(DVec3::new(0.01 * h, 0.0, 0.40 * h), lean(-0.35)));
    for side in [1.0, -1.0] {
        let upper = trunk.joint(DVec3::new(0.0, side * 0.12 * h, 0.31 * h), lean(-1.25));
        out.push(upper);
        out.push(upper.joint(DVec3::new(0.0, 0.0, -0.17 * h), lean(-0.25)));
    }
    for side in [1.0, -1.0] {
        let shift = if side > 0.0 { 0.0 } else { std::f64::consts::PI };
        let thigh = trunk.joint(DVec3::new(0.0, side * 0.055 * h, 0.0), swing(phase, shift, -1.55, 0.42));
        out.push(thigh);
        out.push(thigh.joint(DVec3::new(0.0, 0.0, -0.245 * h), swing(phase, shift - 0.9, 1.15, 0.45)));
    }
}
