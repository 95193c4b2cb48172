//! Seeded scenes and cameras for the rasterizer's tests.
#![allow(dead_code, reason = "each test file uses its part")]

use glam::{DMat3, DQuat, DVec3};
use sf_formats::scene::Gaussians;
use sf_formats::{Camera, Intrinsics, Pose};

/// SplitMix64.
pub(crate) struct Rng(pub(crate) u64);

impl Rng {
    pub(crate) fn next(&mut self) -> u64 {
        self.0 = self.0.wrapping_add(0x9e37_79b9_7f4a_7c15);
        let z = (self.0 ^ (self.0 >> 30)).wrapping_mul(0xbf58_476d_1ce4_e5b9);
        let z = (z ^ (z >> 27)).wrapping_mul(0x94d0_49bb_1331_11eb);
        z ^ (z >> 31)
    }

    /// Uniform in `lo..hi`.
    pub(crate) fn f(&mut self, lo: f32, hi: f32) -> f32 {
        lo + (hi - lo) * (self.next() >> 40) as f32 / (1 << 24) as f32
    }

    pub(crate) fn below(&mut self, n: usize) -> usize {
        (self.next() % n as u64) as usize
    }

    /// Log-uniform in `lo..hi`.
    pub(crate) fn log(&mut self, lo: f32, hi: f32) -> f32 {
        self.f(lo.ln(), hi.ln()).exp()
    }

    /// Not normalised.
    pub(crate) fn quat(&mut self) -> [f32; 4] {
        std::array::from_fn(|_| self.f(-1.0, 1.0))
    }
}

/// A camera that looks roughly along z from near the origin.
pub(crate) fn camera(rng: &mut Rng, width: u32, height: u32) -> Camera {
    let axis = DVec3::new(rng.f(-1.0, 1.0).into(), rng.f(-1.0, 1.0).into(), rng.f(-1.0, 1.0).into());
    let r = DMat3::from_quat(DQuat::from_axis_angle(axis.normalize(), rng.f(-0.3, 0.3).into()));
    let f = f64::from(width) * f64::from(rng.f(0.6, 1.2));
    Camera {
        width,
        height,
        k: Intrinsics {
            fx: f,
            fy: f * f64::from(rng.f(0.9, 1.1)),
            cx: 0.5 * f64::from(width),
            cy: 0.5 * f64::from(height),
        },
        pose: Pose { r, t: DVec3::new(rng.f(-1.0, 1.0).into(), rng.f(-1.0, 1.0).into(), rng.f(-1.0, 1.0).into()) },
    }
}

/// The camera at the origin, looking along z.
pub(crate) fn straight(width: u32, height: u32) -> Camera {
    Camera {
        width,
        height,
        k: Intrinsics { fx: 50.0, fy: 50.0, cx: 0.5 * f64::from(width), cy: 0.5 * f64::from(height) },
        pose: Pose::IDENTITY,
    }
}

pub(crate) struct Splat {
    pub(crate) mean: [f32; 3],
    pub(crate) scale: [f32; 3],
    pub(crate) quat: [f32; 4],
    pub(crate) opacity: f32,
    pub(crate) colour: [f32; 3],
}

impl Default for Splat {
    fn default() -> Self {
        Splat {
            mean: [0.0, 0.0, 4.0],
            scale: [0.2; 3],
            quat: [1.0, 0.0, 0.0, 0.0],
            opacity: 0.8,
            colour: [0.9, 0.5, 0.1],
        }
    }
}

pub(crate) fn scene(splats: impl IntoIterator<Item = Splat>) -> Gaussians {
    let mut g = Gaussians::default();
    for s in splats {
        g.mean.push(s.mean);
        g.scale.push(s.scale);
        g.quat.push(s.quat);
        g.opacity.push(s.opacity);
        g.colour.push(s.colour);
    }
    g
}

/// A scene of everything at once: ordinary splats, and one in two of the kinds that break rasterizers.
pub(crate) fn hard_scene(rng: &mut Rng, camera: &Camera, n: usize) -> Gaussians {
    // A world point at a pixel and depth.
    let at = |rng: &mut Rng, z: f32, spread: f32| {
        let (w, h) = (camera.width as f32, camera.height as f32);
        let (u, v) = (rng.f(-spread, 1.0 + spread) * w, rng.f(-spread, 1.0 + spread) * h);
        camera.unproject(u.into(), v.into(), z.into()).as_vec3().to_array()
    };
    let mut splats: Vec<Splat> = Vec::with_capacity(n);
    for i in 0..n {
        let z = rng.log(1.0, 40.0);
        let size = z / camera.k.fx as f32 * rng.log(0.3, 6.0);
        let mut s = Splat {
            mean: at(rng, z, 0.15),
            scale: std::array::from_fn(|_| size * rng.log(0.3, 1.5)),
            quat: rng.quat(),
            opacity: rng.f(0.0, 1.0),
            colour: std::array::from_fn(|_| rng.f(0.0, 1.0)),
        };
        match i % 24 {
            0 => s.mean = at(rng, -z, 0.15),
            // Few that fill the screen, so that the rest is seen.
            1 if i < 24 => s.scale = [rng.log(5.0, 50.0); 3],
            2 => s.scale = [1e-9; 3],
            3 => s.mean[rng.below(3)] = f32::NAN,
            4 => s.quat = [0.0; 4],
            // Coincident with the one before, which may be a special one itself.
            5 | 6 => s.mean = splats[i - 3].mean.map(|v| if v.is_nan() { 3.0 } else { v }),
            // Needle of ratio 1e4.
            7 => s.scale = [size * 100.0, size * 0.01, size * 0.01],
            // Near plane and just inside it, off to the side.
            8 if i < 24 => s.mean = at(rng, 0.011, 2.0),
            9 if i < 48 => s.mean = at(rng, 0.01, 0.5),
            // Opaque, and large enough to finish pixels.
            10 | 11 => (s.opacity, s.scale) = (1.0, [size * 4.0; 3]),
            12 => s.opacity = 1.0 / 255.0,
            13 => s.opacity = f32::INFINITY,
            14 => s.scale = [0.0; 3],
            _ => {}
        }
        splats.push(s);
    }
    scene(splats)
}

pub(crate) fn psnr(a: &[f32], b: &[f64]) -> f64 {
    assert_eq!(a.len(), b.len());
    let mse: f64 = a.iter().zip(b).map(|(a, b)| (f64::from(*a) - b).powi(2)).sum::<f64>() / a.len() as f64;
    -10.0 * mse.max(1e-30).log10()
}
