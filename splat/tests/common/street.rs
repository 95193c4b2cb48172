//! A procedural street.
//!
//! Four source frames 4.5 m apart look down a street of ground, house fronts, parked boxes and a far end; every source
//! pixel is one Gaussian with a sigma of 0.6 source pixels across and 0.22 along the normal, 1 % are larger, 3 % nearly
//! transparent, depth carries noise.

use sf_formats::scene::Gaussians;
use sf_formats::{Camera, Intrinsics, Pose};

/// Distance between source frames, metres.
pub(crate) const STEP: f64 = 4.5;

/// SplitMix64.
struct Rng(u64);

impl Rng {
    fn unit(&mut self) -> f64 {
        self.0 = self.0.wrapping_add(0x9e37_79b9_7f4a_7c15);
        let z = (self.0 ^ (self.0 >> 30)).wrapping_mul(0xbf58_476d_1ce4_e5b9);
        let z = (z ^ (z >> 27)).wrapping_mul(0x94d0_49bb_1331_11eb);
        ((z ^ (z >> 31)) >> 11) as f64 / (1u64 << 53) as f64
    }
}

/// A camera at `along` metres down the street with a horizontal view of 64 degrees.
pub(crate) fn camera(width: u32, height: u32, along: f64) -> Camera {
    let f = 0.8 * f64::from(width);
    Camera {
        width,
        height,
        k: Intrinsics { fx: f, fy: f, cx: 0.5 * f64::from(width), cy: 0.5 * f64::from(height) },
        pose: Pose { t: glam::DVec3::new(0.0, 0.0, along), ..Pose::IDENTITY },
    }
}

/// Distance along a ray and the axis of the surface it hits (0: x, 1: y, 2: z); `None` in the sky.
fn street(from: f64, ray: [f64; 3]) -> Option<(f64, usize)> {
    let mut best: Option<(f64, usize)> = None;
    let mut hit = |t: f64, axis: usize| {
        if t > 0.1 && best.is_none_or(|(b, _)| t < b) {
            best = Some((t, axis));
        }
    };
    if ray[1] > 0.0 {
        hit(1.6 / ray[1], 1);
    }
    let front = 8.0 / ray[0].abs();
    // Houses of 9 m with a gap of 3 m, 6 to 11 m high.
    let z = from + front * ray[2];
    let house = (z / 12.0).floor();
    if (z / 12.0 - house) < 0.75 && front * ray[1] > -(6.0 + 5.0 * ((house * 0.37).sin().abs())) {
        hit(front, 0);
    }
    // Boxes of 4 m by 1.5 m parked at 3 m on either side every 8 m.
    let side = 3.0 / ray[0].abs();
    let z = from + side * ray[2];
    if z.rem_euclid(8.0) < 4.0 && side * ray[1] > 0.1 {
        hit(side, 0);
    }
    let end = 90.0 - from;
    if end * ray[1] > -7.0 && ray[0].abs() * end < 20.0 {
        hit(end, 2);
    }
    best
}

/// Four frames of `width` x `height`, one Gaussian per pixel.
pub(crate) fn scene(width: u32, height: u32) -> Gaussians {
    let mut rng = Rng(7);
    let mut g = Gaussians::default();
    for frame in 0..4 {
        let view = camera(width, height, STEP * f64::from(frame));
        for y in 0..height {
            for x in 0..width {
                let (u, v) = (f64::from(x) + 0.5, f64::from(y) + 0.5);
                let ray = [(u - view.k.cx) / view.k.fx, (v - view.k.cy) / view.k.fy, 1.0];
                let (mut depth, axis) = street(view.pose.t.z, ray).unwrap_or((400.0, 2));
                let sky = depth == 400.0;
                depth *= 1.0 + 0.01 * (rng.unit() - 0.5);
                if rng.unit() < 0.002 {
                    depth *= 0.5 + rng.unit();
                }
                let pixel = depth / view.k.fx * if rng.unit() < 0.01 { 4.0 } else { 1.0 };
                let mut scale = [(0.6 * pixel) as f32; 3];
                scale[axis] = (0.22 * pixel) as f32;
                let opacity = match rng.unit() {
                    r if r < 0.03 => 0.02 * rng.unit(),
                    _ if sky => 0.1 * rng.unit(),
                    _ => 1.0 - 0.15 * rng.unit() * rng.unit(),
                };
                g.mean.push(view.unproject(u, v, depth).as_vec3().to_array());
                g.scale.push(scale);
                g.quat.push([1.0, 0.05, -0.03, 0.04].map(|q: f32| q + 0.1 * (rng.unit() - 0.5) as f32));
                g.opacity.push(opacity as f32);
                g.colour.push(std::array::from_fn(|_| rng.unit() as f32));
            }
        }
    }
    g
}
