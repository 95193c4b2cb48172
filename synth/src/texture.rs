//! Procedural textures with their own low-pass filter.
//!
//! Value noise on an integer lattice hashed by [`crate::math::hash3`]; an octave is faded out when its
//! wavelength falls under two pixel footprints, so far surfaces do not flicker. Stripes and pulse
//! trains are box-filtered analytically over the footprint. Every function takes texture
//! coordinates in metres and the footprint in metres per pixel.

use crate::math::{clamp01, floor, hash2, hash3, unit};
use glam::Vec3;

/// Weight of detail of a wavelength under a footprint: 0 at two footprints, 1 from four on.
#[inline(always)]
pub(crate) fn fade(wavelength: f32, footprint: f32) -> f32 {
    clamp01(wavelength / (2.0 * footprint + 1e-9) - 1.0)
}

#[inline(always)]
fn smooth(t: f32) -> f32 {
    t * t * (3.0 - 2.0 * t)
}

/// Value noise of wavelength 1, in 0..1.
#[inline]
pub(crate) fn noise2(x: f32, y: f32, seed: u32) -> f32 {
    let (fx, fy) = (floor(x), floor(y));
    let (ix, iy) = (fx as i32, fy as i32);
    let (u, v) = (smooth(x - fx), smooth(y - fy));
    let a = unit(hash2(ix, iy, seed));
    let b = unit(hash2(ix.wrapping_add(1), iy, seed));
    let c = unit(hash2(ix, iy.wrapping_add(1), seed));
    let d = unit(hash2(ix.wrapping_add(1), iy.wrapping_add(1), seed));
    let (p, q) = (a + (b - a) * u, c + (d - c) * u);
    p + (q - p) * v
}

/// Value noise of wavelength 1 in space, in 0..1.
#[inline]
pub(crate) fn noise3(p: Vec3, seed: u32) -> f32 {
    let (fx, fy, fz) = (floor(p.x), floor(p.y), floor(p.z));
    let (ix, iy, iz) = (fx as i32, fy as i32, fz as i32);
    let (u, v, w) = (smooth(p.x - fx), smooth(p.y - fy), smooth(p.z - fz));
    let mut layer = [0.0; 2];
    for (k, l) in layer.iter_mut().enumerate() {
        let z = iz.wrapping_add(k as i32);
        let a = unit(hash3(ix, iy, z, seed));
        let b = unit(hash3(ix.wrapping_add(1), iy, z, seed));
        let c = unit(hash3(ix, iy.wrapping_add(1), z, seed));
        let d = unit(hash3(ix.wrapping_add(1), iy.wrapping_add(1), z, seed));
        let (p, q) = (a + (b - a) * u, c + (d - c) * u);
        *l = p + (q - p) * v;
    }
    layer[0] + (layer[1] - layer[0]) * w
}

/// Sum of `octaves` of noise from `wavelength` down, halved each time; 0 on average, within +-1.
#[inline]
pub(crate) fn fbm2(x: f32, y: f32, octaves: Octaves, footprint: f32) -> f32 {
    let (mut sum, mut amplitude, mut wavelength) = (0.0, 0.5, octaves.wavelength);
    for k in 0..octaves.count {
        let w = fade(wavelength, footprint);
        if w <= 0.0 {
            break;
        }
        let inv = 1.0 / wavelength;
        sum += w
            * amplitude
            * (2.0 * noise2(x * inv, y * inv, octaves.seed.wrapping_add(k.wrapping_mul(0x51ED_270B))) - 1.0);
        amplitude *= 0.55;
        wavelength *= 0.47;
    }
    sum
}

/// [`fbm2`] in space.
#[inline]
pub(crate) fn fbm3(p: Vec3, octaves: Octaves, footprint: f32) -> f32 {
    let (mut sum, mut amplitude, mut wavelength) = (0.0, 0.5, octaves.wavelength);
    for k in 0..octaves.count {
        let w = fade(wavelength, footprint);
        if w <= 0.0 {
            break;
        }
        sum += w
            * amplitude
            * (2.0 * noise3(p / wavelength, octaves.seed.wrapping_add(k.wrapping_mul(0x51ED_270B))) - 1.0);
        amplitude *= 0.55;
        wavelength *= 0.47;
    }
    sum
}

/// A band of noise octaves.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) struct Octaves {
    /// Longest wavelength, metres.
    pub(crate) wavelength: f32,
    /// Number of octaves.
    pub(crate) count: u32,
    /// Which noise.
    pub(crate) seed: u32,
}

/// Shorthand for [`Octaves`].
pub(crate) fn octaves(wavelength: f32, count: u32, seed: u32) -> Octaves {
    Octaves { wavelength, count, seed }
}

/// Share of the footprint around `x` that lies in lo..hi.
#[inline(always)]
pub(crate) fn band(x: f32, lo: f32, hi: f32, footprint: f32) -> f32 {
    let h = 0.5 * footprint + 1e-6;
    let (a, b) = (if x - h > lo { x - h } else { lo }, if x + h < hi { x + h } else { hi });
    if b > a { (b - a) / (2.0 * h) } else { 0.0 }
}

/// Share of the footprint around `x` above `edge`.
#[inline(always)]
pub(crate) fn step(x: f32, edge: f32, footprint: f32) -> f32 {
    clamp01((x - edge) / (footprint + 2e-6) + 0.5)
}

/// Share of the footprint inside a repeated pulse: lo..hi of every `period`.
///
/// The integral of the pulse train at both ends of the footprint, so it is exact at any width.
#[inline]
pub(crate) fn pulses(x: f32, period: f32, lo: f32, hi: f32, footprint: f32) -> f32 {
    let inv = 1.0 / period;
    let h = 0.5 * footprint + 1e-6;
    let integral = |x: f32| {
        let n = floor(x * inv);
        let f = x - n * period;
        n * (hi - lo) + if f > lo { if f < hi { f - lo } else { hi - lo } } else { 0.0 }
    };
    clamp01((integral(x + h) - integral(x - h)) / (2.0 * h))
}

/// Linear blend of colours.
#[inline(always)]
pub(crate) fn mix(a: Vec3, b: Vec3, t: f32) -> Vec3 {
    a + (b - a) * t
}

/// Masonry: courses with offset joints and a tone per block.
pub(crate) fn masonry(u: f32, z: f32, fu: f32, fz: f32, size: f32, seed: u32) -> f32 {
    let row = floor(z / size);
    let long = 2.2 * size;
    let shifted = u + if row as i32 & 1 == 0 { 0.0 } else { 0.5 * long };
    let tone = unit(hash2(floor(shifted / long) as i32, row as i32, seed)) - 0.5;
    let joint = pulses(z, size, 0.0, 0.13 * size, fz).max(pulses(shifted, long, 0.0, 0.11 * size, fu));
    1.0 + 0.34 * tone * fade(1.4 * size, fu.max(fz)) + 0.20 * joint
}

#[cfg(test)]
mod tests {
    use super::*;

    /// The analytic pulse filter against many point samples.
    #[test]
    fn pulse_filter_is_the_mean_of_samples() {
        for i in 0..200 {
            let x = i as f32 * 0.173 - 11.0;
            for footprint in [0.05f32, 0.7, 3.3] {
                let n = 4_000;
                let inside = (0..n)
                    .filter(|&k| {
                        let s = x + footprint * ((k as f32 + 0.5) / n as f32 - 0.5);
                        let f = s - (s / 2.5).floor() * 2.5;
                        f > 0.4 && f < 1.1
                    })
                    .count();
                let want = inside as f32 / n as f32;
                assert!((pulses(x, 2.5, 0.4, 1.1, footprint) - want).abs() < 4e-3, "{x} {footprint}");
                let lone = band(x, 0.4, 1.1, footprint);
                assert!((0.0..=1.0).contains(&lone));
            }
        }
    }

    #[test]
    fn octaves_vanish_before_they_alias() {
        let o = octaves(1.0, 4, 9);
        assert_eq!(fbm2(3.3, 4.4, o, 0.5), 0.0);
        let near: f32 = (0..500).map(|i| fbm2(i as f32 * 0.37, 0.2, o, 0.01).abs()).sum();
        let far: f32 = (0..500).map(|i| fbm2(i as f32 * 0.37, 0.2, o, 0.35).abs()).sum();
        assert!(near > 50.0 && far < 0.8 * near);
    }
}
