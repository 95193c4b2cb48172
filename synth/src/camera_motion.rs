//! How the camera car drives: path and speed, mounting of the camera, bounce on the road.

use crate::ground::{Direction, Ground};
use crate::math::{Rng, rot_x, rot_y, rot_z, sin_cos};
use crate::motion::{Arc, Path, Speed};
use glam::{DMat3, DVec3};

/// Camera to vehicle: camera x right, y down, z forward; vehicle x forward, y left, z up.
const MOUNT: DMat3 =
    DMat3::from_cols(DVec3::new(0.0, -1.0, 0.0), DVec3::new(0.0, 0.0, -1.0), DVec3::new(1.0, 0.0, 0.0));

/// One slow sine.
#[derive(Clone, Copy, Debug)]
struct Sway {
    amplitude: f64,
    rate: f64,
    phase: f64,
}

impl Sway {
    fn draw(rng: &mut Rng, sigma: f64, hertz: (f64, f64)) -> Sway {
        Sway {
            amplitude: rng.normal(0.0, sigma),
            rate: rng.range(hertz.0, hertz.1) * std::f64::consts::TAU,
            phase: rng.range(0.0, std::f64::consts::TAU),
        }
    }

    fn at(&self, t: f64) -> f64 {
        self.amplitude * sin_cos(self.rate * t + self.phase).0
    }
}

/// The camera car.
#[derive(Clone, Debug)]
pub(crate) struct Ego {
    /// Ground track.
    pub(crate) path: Path,
    /// Distance along it.
    pub(crate) speed: Speed,
    height: f64,
    yaw: f64,
    pitch: f64,
    roll: f64,
    sway: [Sway; 5],
    glance: Sway,
}

/// Which way the camera car leaves the crossing.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Turning {
    /// Straight on.
    No,
    /// To the left.
    Left,
    /// To the right.
    Right,
}

/// Mounting of the camera and liveliness of the ride.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) struct Ride {
    /// Camera height, metres, uniform.
    pub(crate) height: (f64, f64),
    /// Spread of the mounting pitch, radians.
    pub(crate) pitch: f64,
    /// Spread of the mounting yaw, radians.
    pub(crate) yaw: f64,
    /// Share of clips whose camera pans to the side.
    pub(crate) glance: f64,
}

impl Ego {
    /// Draws mounting and bounce for a car on a path.
    pub(crate) fn draw(rng: &mut Rng, path: Path, speed: Speed, ride: &Ride) -> Ego {
        let degree = std::f64::consts::PI / 180.0;
        // Bounce grows with speed; a standing car only trembles.
        let lively = if speed.v0 < 0.3 { 0.15 } else { 0.5 + 0.06 * speed.v0 };
        let mut glance = Sway::draw(rng, 4.0 * degree, (0.15, 0.35));
        if !rng.chance(ride.glance) {
            glance.amplitude = 0.0;
        }
        Ego {
            height: rng.range(ride.height.0, ride.height.1),
            yaw: rng.normal(0.0, ride.yaw),
            pitch: rng.normal(1.1 * degree, ride.pitch),
            roll: rng.normal(0.0, 0.4 * degree),
            sway: [
                Sway::draw(rng, 0.012 * lively, (0.8, 1.8)),
                Sway::draw(rng, 0.30 * degree * lively, (0.7, 1.6)),
                Sway::draw(rng, 0.25 * degree * lively, (0.6, 1.5)),
                Sway::draw(rng, 0.25 * degree * lively, (0.2, 0.6)),
                Sway::draw(rng, 0.06 * lively, (0.1, 0.3)),
            ],
            glance,
            path,
            speed,
        }
    }

    /// Camera-to-street rotation and camera centre at a time.
    pub(crate) fn pose(&self, t: f64) -> (DMat3, DVec3) {
        let [height, pitch, roll, yaw, weave] = &self.sway;
        let (s, _) = self.speed.at(t);
        let p = self.path.at(s);
        let (sin, cos) = sin_cos(p.heading);
        let r = rot_z(p.heading + self.yaw + yaw.at(t) + self.glance.at(t))
            * rot_y(self.pitch + pitch.at(t))
            * rot_x(self.roll + roll.at(t))
            * MOUNT;
        let side = weave.at(t);
        let at = DVec3::new(p.at.x - sin * side, p.at.y + cos * side, self.height + height.at(t));
        (r, at)
    }
}

/// Path of a car that starts on the main road at `s`, lane offset `n` (travelling with the axis), and turns
/// into the lane of the cross street at offset `lane` (metres from its axis) with a radius.
pub(crate) fn turning_path(ground: &Ground, from: (f64, f64), turning: Turning, lane: f64, radius: f64) -> Path {
    let (s, n) = from;
    let bend = ground.curvature / (1.0 - ground.curvature * n);
    let start = ground.point(s, n);
    let heading = ground.heading(s);
    let cross = match (&ground.cross, turning) {
        (Some(c), Turning::Left | Turning::Right) => c,
        _ => return ground.lane_path(s, n, Direction::With),
    };
    let (side, sign) = if turning == Turning::Left { (lane, 1.0) } else { (-lane, -1.0) };
    // Along the main lane until the arc that ends tangent to the cross lane.
    let straight = (cross.s + side - radius - s) * (1.0 - ground.curvature * n);
    let target = ground.heading(cross.s) + sign * std::f64::consts::FRAC_PI_2;
    let angle = target - (heading + bend * straight);
    Path::new(
        start,
        heading,
        vec![
            Arc { length: straight, curvature: bend },
            Arc { length: (angle * radius).abs(), curvature: sign / radius },
            Arc { length: 1e4, curvature: 0.0 },
        ],
    )
}
