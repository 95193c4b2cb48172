//! Elementary functions, hashes and random numbers that give the same bits on every CPU.
//!
//! No libm: sine, cosine, arctangent and exponential are polynomials over +, -, x, / alone, and
//! every sum is written in a fixed order. `sqrt` is exact in IEEE 754 and used as it is.

use glam::{DMat3, DVec3};

/// Sine and cosine, |error| < 1e-15 for |x| < 1e5 rad.
///
/// Reduction by multiples of pi/2 split in two, then Taylor polynomials on |r| <= pi/4.
pub(crate) fn sin_cos(x: f64) -> (f64, f64) {
    const HI: f64 = std::f64::consts::FRAC_PI_2;
    const LO: f64 = 6.123_233_995_736_766e-17;
    let q = floor64(x / HI + 0.5);
    let r = (x - q * HI) - q * LO;
    let z = r * r;
    let s = r
        * (1.0
            + z * (-1.0 / 6.0
                + z * (1.0 / 120.0
                    + z * (-1.0 / 5_040.0
                        + z * (1.0 / 362_880.0
                            + z * (-1.0 / 39_916_800.0
                                + z * (1.0 / 6_227_020_800.0 + z * (-1.0 / 1_307_674_368_000.0))))))));
    let c = 1.0
        + z * (-0.5
            + z * (1.0 / 24.0
                + z * (-1.0 / 720.0
                    + z * (1.0 / 40_320.0
                        + z * (-1.0 / 3_628_800.0
                            + z * (1.0 / 479_001_600.0
                                + z * (-1.0 / 87_178_291_200.0 + z * (1.0 / 20_922_789_888_000.0))))))));
    match (q as i64) & 3 {
        0 => (s, c),
        1 => (c, -s),
        2 => (-s, -c),
        _ => (-c, s),
    }
}

/// Tangent of an angle well inside +-pi/2.
pub(crate) fn tan(x: f64) -> f64 {
    let (s, c) = sin_cos(x);
    s / c
}

fn floor64(x: f64) -> f64 {
    let i = x as i64 as f64;
    if x < i { i - 1.0 } else { i }
}

/// Largest whole number not above x, for |x| < 2^31. Baseline x86-64 has no rounding instruction and
/// would call a library; this is a conversion and a compare.
#[inline(always)]
pub(crate) fn floor(x: f32) -> f32 {
    let i = x as i32 as f32;
    if x < i { i - 1.0 } else { i }
}

/// Distance above [`floor`], in 0..1.
#[inline(always)]
pub(crate) fn fract(x: f32) -> f32 {
    x - floor(x)
}

/// e^x for x <= 0, relative error < 3e-5; 0 below -80.
#[inline]
pub(crate) fn exp_neg(x: f32) -> f32 {
    if x < -80.0 {
        return 0.0;
    }
    let y = x * std::f32::consts::LOG2_E;
    let n = floor(y);
    let r = (y - n) * std::f32::consts::LN_2;
    let p = 1.0 + r * (1.0 + r * (0.5 + r * (1.0 / 6.0 + r * (1.0 / 24.0 + r * (1.0 / 120.0 + r / 720.0)))));
    p * f32::from_bits(((n as i32 + 127) as u32) << 23)
}

/// Angle of (x, y), |error| < 3e-6 rad; 0 at the origin.
///
/// Reduced to |t| <= tan(pi/8) by the half-range identity, then an odd polynomial.
#[inline]
pub(crate) fn atan2(y: f32, x: f32) -> f32 {
    use std::f32::consts::{FRAC_PI_2, FRAC_PI_4, PI};
    let (ax, ay) = (x.abs(), y.abs());
    let (lo, hi) = if ax < ay { (ax, ay) } else { (ay, ax) };
    if hi == 0.0 {
        return 0.0;
    }
    let t = lo / hi;
    let (t, base) = if t > 0.414_213_56 { ((t - 1.0) / (t + 1.0), FRAC_PI_4) } else { (t, 0.0) };
    let z = t * t;
    let a = base + t * (1.0 + z * (-1.0 / 3.0 + z * (0.2 + z * (-1.0 / 7.0 + z * (1.0 / 9.0 - z / 11.0)))));
    let a = if ax < ay { FRAC_PI_2 - a } else { a };
    let a = if x < 0.0 { PI - a } else { a };
    if y < 0.0 { -a } else { a }
}

/// 0 below `lo`, 1 above `hi`, smooth between.
#[inline]
pub(crate) fn smoothstep(lo: f32, hi: f32, x: f32) -> f32 {
    let t = clamp01((x - lo) / (hi - lo));
    t * t * (3.0 - 2.0 * t)
}

/// x limited to 0..1.
#[inline(always)]
pub(crate) fn clamp01(x: f32) -> f32 {
    if x > 0.0 { if x < 1.0 { x } else { 1.0 } } else { 0.0 }
}

/// Rotation by `angle` about x.
pub(crate) fn rot_x(angle: f64) -> DMat3 {
    let (s, c) = sin_cos(angle);
    DMat3::from_cols(DVec3::X, DVec3::new(0.0, c, s), DVec3::new(0.0, -s, c))
}

/// Rotation by `angle` about y.
pub(crate) fn rot_y(angle: f64) -> DMat3 {
    let (s, c) = sin_cos(angle);
    DMat3::from_cols(DVec3::new(c, 0.0, -s), DVec3::Y, DVec3::new(s, 0.0, c))
}

/// Rotation by `angle` about z.
pub(crate) fn rot_z(angle: f64) -> DMat3 {
    let (s, c) = sin_cos(angle);
    DMat3::from_cols(DVec3::new(c, s, 0.0), DVec3::new(-s, c, 0.0), DVec3::Z)
}

/// Well-mixed 32 bits of three lattice coordinates and a seed.
#[inline(always)]
pub(crate) fn hash3(x: i32, y: i32, z: i32, seed: u32) -> u32 {
    let mut h = (x as u32).wrapping_mul(0x9E37_79B1)
        ^ (y as u32).wrapping_mul(0x85EB_CA77)
        ^ (z as u32).wrapping_mul(0xC2B2_AE3D)
        ^ seed;
    h ^= h >> 15;
    h = h.wrapping_mul(0x2C1B_3C6D);
    h ^= h >> 13;
    h = h.wrapping_mul(0x297A_2D39);
    h ^ (h >> 16)
}

/// Well-mixed 32 bits of two lattice coordinates and a seed.
#[inline(always)]
pub(crate) fn hash2(x: i32, y: i32, seed: u32) -> u32 {
    hash3(x, y, 0, seed)
}

/// A hash as a number in 0..1.
#[inline(always)]
pub(crate) fn unit(h: u32) -> f32 {
    (h >> 8) as f32 * (1.0 / 16_777_216.0)
}

/// 64 mixed bits of a 64-bit number (splitmix64's finaliser).
pub(crate) fn mix64(x: u64) -> u64 {
    let mut z = x.wrapping_add(0x9E37_79B9_7F4A_7C15);
    z = (z ^ (z >> 30)).wrapping_mul(0xBF58_476D_1CE4_E5B9);
    z = (z ^ (z >> 27)).wrapping_mul(0x94D0_49BB_1331_11EB);
    z ^ (z >> 31)
}

/// Small seeded generator: a counter through [`mix64`].
#[derive(Clone, Debug)]
pub(crate) struct Rng(u64);

impl Rng {
    /// A stream of its own for each (seed, purpose) pair, so that adding a draw to one part of the
    /// street never changes another part.
    pub(crate) fn new(seed: u64, purpose: &str) -> Rng {
        let mut h = mix64(seed);
        for &b in purpose.as_bytes() {
            h = mix64(h ^ u64::from(b));
        }
        Rng(h)
    }

    /// Next 64 bits.
    pub(crate) fn bits(&mut self) -> u64 {
        self.0 = self.0.wrapping_add(0x9E37_79B9_7F4A_7C15);
        mix64(self.0)
    }

    /// Next 32 bits, as a texture seed.
    pub(crate) fn seed(&mut self) -> u32 {
        (self.bits() >> 32) as u32
    }

    /// Uniform in 0..1.
    pub(crate) fn unit(&mut self) -> f64 {
        (self.bits() >> 11) as f64 * (1.0 / 9_007_199_254_740_992.0)
    }

    /// Uniform in lo..hi.
    pub(crate) fn range(&mut self, lo: f64, hi: f64) -> f64 {
        lo + (hi - lo) * self.unit()
    }

    /// Uniform in lo..hi, single precision.
    pub(crate) fn range32(&mut self, lo: f32, hi: f32) -> f32 {
        self.range(f64::from(lo), f64::from(hi)) as f32
    }

    /// Normal deviate as the sum of twelve uniforms (tails end at 6 sigma).
    pub(crate) fn normal(&mut self, mean: f64, sigma: f64) -> f64 {
        let mut sum = -6.0;
        for _ in 0..12 {
            sum += self.unit();
        }
        mean + sigma * sum
    }

    /// True with probability p.
    pub(crate) fn chance(&mut self, p: f64) -> bool {
        self.unit() < p
    }

    /// Uniform in 0..n.
    pub(crate) fn below(&mut self, n: usize) -> usize {
        (((self.bits() >> 32) * n as u64) >> 32) as usize
    }

    /// One of a list.
    pub(crate) fn pick<T: Copy>(&mut self, list: &[T]) -> T {
        list[self.below(list.len())]
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn polynomials_agree_with_the_library() {
        for i in -40_000..40_000 {
            let x = f64::from(i) * 0.001_7;
            let (s, c) = sin_cos(x);
            assert!((s - x.sin()).abs() < 2e-14 && (c - x.cos()).abs() < 2e-14, "{x}");
            let e = exp_neg(-(x.abs() as f32));
            let want = (-x.abs()).exp();
            assert!((f64::from(e) - want).abs() <= 3e-5 * want + 1e-34, "exp({x}) {e} {want}");
            let (ys, xs) = ((x * 3.1).sin() as f32, (x * 1.7).cos() as f32);
            assert!((atan2(ys, xs) - ys.atan2(xs)).abs() < 5e-6, "{ys} {xs}");
            assert_eq!(floor(x as f32), (x as f32).floor());
        }
    }

    #[test]
    fn rotations_are_right_handed() {
        let quarter = std::f64::consts::FRAC_PI_2;
        assert!((rot_x(quarter) * DVec3::Y - DVec3::Z).length() < 1e-15);
        assert!((rot_y(quarter) * DVec3::Z - DVec3::X).length() < 1e-15);
        assert!((rot_z(quarter) * DVec3::X - DVec3::Y).length() < 1e-15);
    }

    #[test]
    fn random_numbers_have_their_moments() {
        let mut rng = Rng::new(7, "moments");
        let n = 20_000;
        let (mut sum, mut square, mut counts) = (0.0, 0.0, [0usize; 5]);
        for _ in 0..n {
            let x = rng.normal(1.0, 2.0);
            sum += x;
            square += (x - 1.0) * (x - 1.0);
            counts[rng.below(5)] += 1;
        }
        assert!((sum / f64::from(n) - 1.0).abs() < 0.05);
        assert!((square / f64::from(n) - 4.0).abs() < 0.15);
        assert!(counts.iter().all(|&c| c.abs_diff(4_000) < 250), "{counts:?}");
        assert_ne!(Rng::new(1, "a").bits(), Rng::new(1, "b").bits());
    }
}
