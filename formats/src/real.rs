//! Exponential and logarithm for files.
//!
//! The system library's may differ in the last bit from platform to platform, and then so would the
//! bytes of every saved scene. These use +, -, *, / alone. Relative error below 1e-15, far inside the
//! rounding to f32 that follows.

/// ln 2, split so that `k * LN2_HI` is exact for |k| < 2^20.
const LN2_HI: f64 = f64::from_bits(0x3fe6_2e42_fee0_0000);
const LN2_LO: f64 = 1.908_214_929_270_587_7e-10;

/// e^x; 0 below -745, infinite above 709.
pub(crate) fn exp(x: f64) -> f64 {
    if x.is_nan() {
        return x;
    }
    if x < -745.0 {
        return 0.0;
    }
    if x > 709.0 {
        return f64::INFINITY;
    }
    let k = (x / std::f64::consts::LN_2).round();
    // |r| <= ln 2 / 2: the Taylor term of degree 14 is 4e-18.
    let r = (x - k * LN2_HI) - k * LN2_LO;
    let e = (1..=14).rev().fold(1.0, |tail, i| 1.0 + r / f64::from(i) * tail);
    // In two steps, because 2^-1074 is no normal number.
    let half = k as i32 / 2;
    e * power_of_two(half) * power_of_two(k as i32 - half)
}

/// 2^k for -1022 <= k <= 1023.
fn power_of_two(k: i32) -> f64 {
    f64::from_bits(((k + 1023) as u64) << 52)
}

/// Natural logarithm of a positive normal number.
pub(crate) fn ln(x: f64) -> f64 {
    debug_assert!(x.is_normal() && x > 0.0, "ln of {x}");
    let bits = x.to_bits();
    let mut k = (bits >> 52) as i32 - 1023;
    let mut m = f64::from_bits(bits & 0x000f_ffff_ffff_ffff | 0x3ff0_0000_0000_0000);
    if m > std::f64::consts::SQRT_2 {
        m *= 0.5;
        k += 1;
    }
    // ln m = 2 artanh s with |s| <= 0.1716: the first term left out, s^25 / 25, is 3e-21.
    let s = (m - 1.0) / (m + 1.0);
    let s2 = s * s;
    let series = (0..12).rev().fold(0.0, |tail, i| 1.0 / f64::from(2 * i + 1) + s2 * tail);
    f64::from(k) * LN2_HI + (2.0 * s * series + f64::from(k) * LN2_LO)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn they_agree_with_the_library_and_invert_each_other() {
        for i in -7000..7000 {
            let x = f64::from(i) * 0.1;
            assert!((exp(x) / x.exp() - 1.0).abs() < 1e-15, "exp {x}");
            let y = x.exp();
            assert!((ln(y) - x).abs() <= 4e-16 * (1.0 + x.abs()), "ln {y}");
        }
        assert_eq!(exp(0.0), 1.0);
        assert_eq!(ln(1.0), 0.0);
        assert_eq!(exp(-1e9), 0.0);
        assert_eq!(exp(1e9), f64::INFINITY);
        assert!(exp(f64::NAN).is_nan());
        for x in [1e-30, 0.999_999, 1.000_001, 3e8] {
            assert!((ln(x) - x.ln()).abs() <= 1e-15 * x.ln().abs(), "ln {x}");
        }
    }
}
