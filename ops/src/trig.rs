//! f64 sine, cosine, exponential and logarithm from our own polynomials, for tables.
//!
//! The platform's libm differs between systems in the last bits, and rotary tables, time embeddings
//! and position terms must be the same everywhere. Only IEEE basic operations and fused
//! multiply-adds are used. Errors stay below 2 units in the last place (tests) over the ranges given.

// Coefficients and split constants carry every digit they were derived with.
#![allow(clippy::excessive_precision)]

/// Nearest integer, ties to even, by adding and subtracting 1.5 * 2^52; |x| < 2^51.
#[inline]
fn nearest(x: f64) -> f64 {
    const BIG: f64 = 6_755_399_441_055_744.0;
    (x + BIG) - BIG
}

// pi/2 in three parts of 53 bits (Cody and Waite); with fused products the reduction is exact to
// about 2^-110 for |x| up to 2^20 or so.
const PI_2_HI: f64 = std::f64::consts::FRAC_PI_2;
const PI_2_MID: f64 = 6.123_233_995_736_766_036e-17;
const PI_2_LO: f64 = -1.497_384_904_859_169_777e-33;
const TWO_OVER_PI: f64 = std::f64::consts::FRAC_2_PI;

/// (sin x, cos x). |x| up to 2^20; NaN for anything that is not finite.
pub fn sin_cos(x: f64) -> (f64, f64) {
    if !x.is_finite() {
        return (f64::NAN, f64::NAN);
    }
    let n = nearest(x * TWO_OVER_PI);
    // r + e = x - n pi/2, |r| <= pi/4.
    let a = n.mul_add(-PI_2_HI, x);
    let w = n * PI_2_MID;
    let w_err = n.mul_add(PI_2_MID, -w);
    let r = a - w;
    let e = ((a - r) - w) - n.mul_add(PI_2_LO, w_err);
    let z = r * r;
    // Taylor terms to r^17 and r^16: the first one left out is below 2^-58 at pi/4.
    let mut s: f64 = 2.811_457_254_345_520_8e-15;
    for c in [
        -7.647_163_731_819_816_5e-13,
        1.605_904_383_682_161_5e-10,
        -2.505_210_838_544_171_9e-8,
        2.755_731_922_398_589_1e-6,
        -1.984_126_984_126_984_1e-4,
        8.333_333_333_333_333_2e-3,
        -1.666_666_666_666_666_6e-1,
    ] {
        s = s.mul_add(z, c);
    }
    let mut c: f64 = 4.779_477_332_387_385_3e-14;
    for k in [
        -1.147_074_559_772_972_5e-11,
        2.087_675_698_786_809_9e-9,
        -2.755_731_922_398_589_1e-7,
        2.480_158_730_158_730_2e-5,
        -1.388_888_888_888_888_9e-3,
        4.166_666_666_666_666_4e-2,
    ] {
        c = c.mul_add(z, k);
    }
    let sin = r + (z * r).mul_add(s, e);
    let half = 0.5 * z;
    let one = 1.0 - half;
    let cos = one + (((1.0 - one) - half) + z.mul_add(z * c, -r * e));
    match (n as i64).rem_euclid(4) {
        0 => (sin, cos),
        1 => (cos, -sin),
        2 => (-sin, -cos),
        _ => (-cos, sin),
    }
}

const LN2_HI: f64 = 6.931_471_803_691_238_164e-1;
const LN2_LO: f64 = 1.908_214_929_270_587_700e-10;

/// 2^n for n in -1022..=1023.
#[inline]
fn pow2(n: i64) -> f64 {
    f64::from_bits(((1023 + n) as u64) << 52)
}

/// e^x; 0 below -745.2, infinity above 709.8.
pub fn exp(x: f64) -> f64 {
    if x.is_nan() {
        return x;
    }
    if x > 709.9 {
        return f64::INFINITY;
    }
    if x < -745.2 {
        return 0.0;
    }
    let n = nearest(x * std::f64::consts::LOG2_E);
    let hi = n.mul_add(-LN2_HI, x);
    let lo = n * LN2_LO;
    let r = hi - lo;
    let e = (hi - r) - lo;
    // e^r = 1 + r + r^2 q(r), Taylor to r^14: the next term is below 2^-62 at ln(2)/2.
    let mut q: f64 = 1.147_074_559_772_972_5e-11;
    for c in [
        1.605_904_383_682_161_5e-10,
        2.087_675_698_786_809_9e-9,
        2.505_210_838_544_171_9e-8,
        2.755_731_922_398_589_1e-7,
        2.755_731_922_398_589_1e-6,
        2.480_158_730_158_730_2e-5,
        1.984_126_984_126_984_1e-4,
        1.388_888_888_888_888_9e-3,
        8.333_333_333_333_333_2e-3,
        4.166_666_666_666_666_4e-2,
        1.666_666_666_666_666_6e-1,
        0.5,
    ] {
        q = q.mul_add(r, c);
    }
    let p = 1.0 + (r + (r * r).mul_add(q, e));
    // Two factors, because 2^n itself may be out of range while the product is not.
    let n = n as i64;
    let half = n / 2;
    p * pow2(half) * pow2(n - half)
}

/// Natural logarithm; minus infinity at 0, NaN below.
pub fn ln(x: f64) -> f64 {
    if x.is_nan() || x < 0.0 {
        return f64::NAN;
    }
    if x == 0.0 {
        return f64::NEG_INFINITY;
    }
    if x == f64::INFINITY {
        return x;
    }
    // x = m 2^n with m in [sqrt(1/2), sqrt(2)); subnormals are scaled up first.
    let (x, shift) = if x < f64::MIN_POSITIVE { (x * pow2(54), -54) } else { (x, 0) };
    let bits = x.to_bits();
    let mut n = ((bits >> 52) & 0x7ff) as i64 - 1023 + shift;
    let mut m = f64::from_bits((bits & 0x000f_ffff_ffff_ffff) | 0x3ff0_0000_0000_0000);
    if m >= std::f64::consts::SQRT_2 {
        m *= 0.5;
        n += 1;
    }
    // ln(1 + f) = f - f^2/2 + s (f^2/2 + R), s = f/(2+f), R = s^2 (2/3 + 2/5 s^2 + ...).
    let f = m - 1.0;
    let s = f / (2.0 + f);
    let z = s * s;
    let mut r = 0.0;
    for k in (1..=11).rev() {
        r = r * z + 2.0 / (2 * k + 1) as f64;
    }
    let r = r * z;
    let h = 0.5 * f * f;
    let n = n as f64;
    n * LN2_HI - ((h - (s * (h + r) + n * LN2_LO)) - f)
}

/// x^y = e^(y ln x) for x > 0; relative error about 2^-52 * (1 + |y ln x|).
pub fn pow(x: f64, y: f64) -> f64 {
    exp(y * ln(x))
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Distance in units in the last place of `b`.
    fn ulps(a: f64, b: f64) -> f64 {
        let unit = f64::from_bits(b.abs().max(f64::MIN_POSITIVE).to_bits() + 1) - b.abs().max(f64::MIN_POSITIVE);
        (a - b).abs() / unit
    }

    fn sweep(lo: f64, hi: f64) -> impl Iterator<Item = f64> {
        const N: usize = 200_001;
        (0..N).map(move |i| lo + (hi - lo) * (i as f64 + 0.37) / N as f64)
    }

    #[test]
    fn within_two_ulps_of_the_platform() {
        for x in sweep(-3000.0, 3000.0).chain(sweep(-7.0, 7.0)).chain(sweep(-1e-6, 1e-6)) {
            let (s, c) = sin_cos(x);
            assert!(ulps(s, x.sin()) <= 2.0 && ulps(c, x.cos()) <= 2.0, "sin_cos({x}) = {s}, {c}");
        }
        for x in sweep(-700.0, 700.0).chain(sweep(-1.0, 1.0)) {
            assert!(ulps(exp(x), x.exp()) <= 2.0, "exp({x})");
        }
        for x in sweep(1e-9, 4.0).chain(sweep(0.9, 1.1)).chain(sweep(1.0, 1e12)) {
            assert!(ulps(ln(x), x.ln()) <= 2.0, "ln({x}) = {} {}", ln(x), x.ln());
        }
    }

    #[test]
    fn exact_values_and_ends() {
        assert_eq!(sin_cos(0.0), (0.0, 1.0));
        assert_eq!(exp(0.0), 1.0);
        assert_eq!(exp(-1e4), 0.0);
        assert_eq!(exp(1e4), f64::INFINITY);
        assert_eq!(exp(f64::NEG_INFINITY), 0.0);
        assert_eq!(ln(1.0), 0.0);
        assert_eq!(ln(0.0), f64::NEG_INFINITY);
        assert!(ln(-1.0).is_nan() && exp(f64::NAN).is_nan() && sin_cos(f64::INFINITY).0.is_nan());
        assert!(ulps(ln(1e-310), 1e-310f64.ln()) <= 2.0);
        assert!(ulps(pow(100.0, 0.5), 10.0) <= 4.0);
    }
}
