//! Rigid motions with their exact time derivatives, and the paths that vehicles and people follow.
//!
//! Street axes: x along the road at its origin, y to the left, z up; metres and seconds. A
//! [`Motion`] maps part coordinates to the street: X = R x + t, and its velocity field is
//! v(X) = v + w x (X - t).

use crate::math::{rot_y, rot_z, sin_cos};
use glam::{DMat3, DVec2, DVec3};

/// Pose of a rigid part at one time, and how it moves.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) struct Motion {
    /// Part to street rotation.
    pub(crate) r: DMat3,
    /// Part origin in the street, metres.
    pub(crate) t: DVec3,
    /// Velocity of the part origin, m/s.
    pub(crate) v: DVec3,
    /// Angular velocity, rad/s, street axes.
    pub(crate) w: DVec3,
}

/// Angle of a joint about its sideways axis (y) and its rate: wheels spin and limbs swing about it. A
/// positive angle rolls a wheel forward and swings a hanging limb backward.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) struct Turn {
    /// Radians.
    pub(crate) angle: f64,
    /// Radians per second: the exact derivative of `angle`.
    pub(crate) rate: f64,
}

impl Motion {
    /// A part that stands still.
    pub(crate) fn fixed(t: DVec3, heading: f64) -> Motion {
        Motion { r: rot_z(heading), t, v: DVec3::ZERO, w: DVec3::ZERO }
    }

    /// A child hinged at `offset` (in this part's coordinates).
    pub(crate) fn joint(&self, offset: DVec3, turn: Turn) -> Motion {
        let arm = self.r * offset;
        Motion {
            r: self.r * rot_y(turn.angle),
            t: self.t + arm,
            v: self.v + self.w.cross(arm),
            w: self.w + self.r.y_axis * turn.rate,
        }
    }

    /// The same part moved by an offset in its own coordinates that changes at `rate`.
    pub(crate) fn slide(&self, offset: DVec3, rate: DVec3) -> Motion {
        let arm = self.r * offset;
        Motion { t: self.t + arm, v: self.v + self.w.cross(arm) + self.r * rate, ..*self }
    }

    /// Velocity of the material point now at street position `p`, m/s.
    pub(crate) fn velocity_at(&self, p: DVec3) -> DVec3 {
        self.v + self.w.cross(p - self.t)
    }
}

/// A stretch of constant curvature.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) struct Arc {
    /// Metres.
    pub(crate) length: f64,
    /// 1/m, positive turns left.
    pub(crate) curvature: f64,
}

/// Ground track made of arcs; the first and last go on beyond the ends.
#[derive(Clone, Debug, PartialEq)]
pub(crate) struct Path {
    start: DVec2,
    heading: f64,
    arcs: Vec<Arc>,
}

/// A point of a path.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) struct Waypoint {
    /// Street x, y.
    pub(crate) at: DVec2,
    /// Direction of travel, radians from x to y.
    pub(crate) heading: f64,
    /// 1/m here.
    pub(crate) curvature: f64,
}

impl Path {
    /// Starts at a point with a heading; `arcs` must not be empty.
    pub(crate) fn new(start: DVec2, heading: f64, arcs: Vec<Arc>) -> Path {
        assert!(!arcs.is_empty(), "a path needs an arc");
        Path { start, heading, arcs }
    }

    /// The point `s` metres from the start, behind it for negative `s`.
    pub(crate) fn at(&self, s: f64) -> Waypoint {
        let mut here = Waypoint { at: self.start, heading: self.heading, curvature: self.arcs[0].curvature };
        let mut left = s;
        for (i, arc) in self.arcs.iter().enumerate() {
            here.curvature = arc.curvature;
            if left <= arc.length || i + 1 == self.arcs.len() {
                return along(here, left);
            }
            here = along(here, arc.length);
            left -= arc.length;
        }
        here
    }
}

/// Moves along an arc: the chord is s sinc(k s / 2) at the mean heading.
fn along(from: Waypoint, s: f64) -> Waypoint {
    let half = 0.5 * from.curvature * s;
    let sinc = if half.abs() < 1e-4 { 1.0 - half * half / 6.0 } else { sin_cos(half).0 / half };
    let (sin, cos) = sin_cos(from.heading + half);
    Waypoint {
        at: from.at + DVec2::new(cos, sin) * (s * sinc),
        heading: from.heading + 2.0 * half,
        curvature: from.curvature,
    }
}

/// Distance run along a path: constant acceleration until standstill or the speed cap, plus a gentle sway.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) struct Speed {
    /// Path position at time 0, metres.
    pub s0: f64,
    /// Speed at time 0, m/s, not negative.
    pub v0: f64,
    /// m/s^2.
    pub(crate) a: f64,
}

impl Speed {
    /// Fastest anything drives, m/s.
    pub(crate) const CAP: f64 = 20.0;

    /// Position and its derivative at a time (also before 0).
    pub(crate) fn at(&self, t: f64) -> (f64, f64) {
        let v = self.v0 + self.a * t;
        if self.a != 0.0 && !(0.0..=Self::CAP).contains(&v) {
            let edge = if v < 0.0 { 0.0 } else { Self::CAP };
            let te = (edge - self.v0) / self.a;
            return (self.s0 + (self.v0 + 0.5 * self.a * te) * te + edge * (t - te), edge);
        }
        (self.s0 + (self.v0 + 0.5 * self.a * t) * t, v)
    }
}

/// Pose and twist of something that follows a path on the ground.
pub(crate) fn follow(path: &Path, speed: &Speed, time: f64, height: f64) -> Motion {
    let (s, v) = speed.at(time);
    let p = path.at(s);
    let (sin, cos) = sin_cos(p.heading);
    Motion {
        r: rot_z(p.heading),
        t: DVec3::new(p.at.x, p.at.y, height),
        v: DVec3::new(cos, sin, 0.0) * v,
        w: DVec3::new(0.0, 0.0, p.curvature * v),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn twists_are_derivatives_of_poses() {
        let path = Path::new(
            DVec2::new(3.0, -2.0),
            0.4,
            vec![
                Arc { length: 5.0, curvature: 0.0 },
                Arc { length: 12.0, curvature: 0.12 },
                Arc { length: 9.0, curvature: -0.05 },
            ],
        );
        for (v0, a) in [(6.0, -2.0), (0.0, 1.5), (9.0, 0.0), (3.0, -3.0)] {
            let speed = Speed { s0: 1.0, v0, a };
            for time in [0.31, 0.9, 1.7, 2.3] {
                let at = |t: f64| {
                    follow(&path, &speed, t, 0.5)
                        .joint(DVec3::new(1.2, 0.4, 0.3), Turn { angle: 0.7 * t, rate: 0.7 })
                        .slide(DVec3::new(0.0, 0.2 * t, 0.1), DVec3::new(0.0, 0.2, 0.0))
                        .joint(DVec3::new(0.0, 0.0, -0.5), Turn { angle: t * t, rate: 2.0 * t })
                };
                let local = DVec3::new(0.1, -0.3, 0.2);
                let point = |t: f64| {
                    let m = at(t);
                    m.r * local + m.t
                };
                let h = 1e-5;
                let difference = (point(time + h) - point(time - h)) / (2.0 * h);
                let exact = at(time).velocity_at(point(time));
                assert!((difference - exact).length() < 1e-6, "{v0} {a} {time}: {difference} {exact}");
            }
        }
    }
}
