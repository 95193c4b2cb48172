//! exp and ln from own polynomials, in plain multiplications and additions.
//!
//! The system's libm differs between machines; these give the same bits wherever f32 and f64 follow
//! IEEE 754. Neither fuses a multiplication with an addition.

/// exp(x) for x in -87..=0, relative error below 2e-7; below -87 the value at -87.
///
/// x = n ln2 + r with |r| <= ln2/2, exp(x) = 2^n exp(r), exp(r) = 1 + r + r^2 q(r) with q the minimax
/// polynomial of degree 4 for the relative error (3e-9 before rounding).
#[inline(always)]
pub fn exp_neg(x: f32) -> f32 {
    // Adding 1.5 * 2^23 leaves the rounded integer in the low mantissa bits.
    const MAGIC: f32 = 12_582_912.0;
    // ln2 in two parts: the high one has 9 zero bits at its end, so n * LN2_HI is exact.
    const LN2_HI: f32 = 0.693_359_4;
    const LN2_LO: f32 = -2.121_944_4e-4;
    let x = if x > -87.0 { x } else { -87.0 };
    let shifted = x * std::f32::consts::LOG2_E + MAGIC;
    let n = shifted - MAGIC;
    let r = (x - n * LN2_HI) - n * LN2_LO;
    let q = 1.381_446_7e-3;
    let q = q * r + 8.368_781e-3;
    let q = q * r + 4.166_839_3e-2;
    let q = q * r + 0.166_665_2;
    let q = q * r + 0.499_999_94;
    let p = r * r * q + r + 1.0;
    // n is in -126..=0, so the exponent of p (about 1) stays normal.
    f32::from_bits(p.to_bits().wrapping_add(shifted.to_bits() << 23))
}

/// ln(x) for a normal positive x, absolute error below 1e-14 times max(1, |ln x|).
///
/// x = 2^e m with m in [sqrt(1/2), sqrt(2)), ln m = 2 atanh((m-1)/(m+1)); the series of atanh stops at
/// the 17th power: the next term is below 0.1716^19 / 19 = 2e-16.
pub fn ln(x: f64) -> f64 {
    debug_assert!(x.is_normal() && x > 0.0, "ln of {x}");
    let bits = x.to_bits();
    let mut e = ((bits >> 52) as i64) - 1023;
    let mut m = f64::from_bits((bits & 0x000f_ffff_ffff_ffff) | 0x3ff0_0000_0000_0000);
    if m >= std::f64::consts::SQRT_2 {
        m *= 0.5;
        e += 1;
    }
    let s = (m - 1.0) / (m + 1.0);
    let s2 = s * s;
    let mut sum = 1.0 / 17.0;
    for k in [15.0, 13.0, 11.0, 9.0, 7.0, 5.0, 3.0, 1.0] {
        sum = sum * s2 + 1.0 / k;
    }
    e as f64 * std::f64::consts::LN_2 + 2.0 * s * sum
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn exp_is_within_2e_7_of_the_true_value() {
        let mut worst = 0.0f64;
        for i in 0..=870_000 {
            let x = -(i as f32) * 1e-4;
            let (got, want) = (f64::from(exp_neg(x)), f64::from(x).exp());
            worst = worst.max((got / want - 1.0).abs());
        }
        assert!(worst < 2e-7, "relative error {worst:.2e}");
        assert_eq!(exp_neg(0.0), 1.0);
        assert_eq!(exp_neg(-1e30), exp_neg(-87.0));
    }

    #[test]
    fn ln_is_within_1e_14() {
        for i in 1..200_000 {
            let x = f64::from(i) * 0.37e-2;
            let want = x.ln();
            assert!((ln(x) - want).abs() <= 1e-14 * want.abs().max(1.0), "ln({x}) = {} not {want}", ln(x));
        }
        assert_eq!(ln(1.0), 0.0);
    }
}
