//! exp2, log2 and ln from own polynomials.
//!
//! The system's libm differs between machines; these are made of IEEE operations and explicit fused
//! multiply-adds, so they give the same bits everywhere.

use sf_ops::simd::{LANES, Simd, Vector};

/// 2^-x for x in -0.5..=126; relative error below 4e-7. Outside that range the value is meaningless.
///
/// -x = n - f with |f| <= 1/2, 2^-f by a polynomial of degree 5 that interpolates at the Chebyshev nodes
/// (1.6e-7 before rounding), 2^n by adding to the exponent of what the polynomial gave, 0.7 to 1.42.
#[inline(always)]
pub fn exp2_neg<S: Simd>(s: S, x: S::V) -> S::V {
    let (f, minus_n) = x.fraction(s);
    let p = s.splat(-1.339_086_3e-3);
    let p = p.mul_add(f, s.splat(9.676_032e-3));
    let p = p.mul_add(f, s.splat(-5.550_357e-2));
    let p = p.mul_add(f, s.splat(0.240_221_07));
    let p = p.mul_add(f, s.splat(-std::f32::consts::LN_2));
    let p = p.mul_add(f, s.splat(1.0));
    p.times_pow2(minus_n)
}

/// log2 of normal positive values, absolute error below 6e-7 for values in 1/255..=1.
///
/// x = 2^e m with m in [sqrt(1/2), sqrt(2)), log2 m = (m-1) q(m-1) with q of degree 8 (4e-8 before rounding).
#[inline(always)]
pub fn log2<S: Simd>(s: S, x: S::V) -> S::V {
    let mut bits = [0.0; LANES];
    x.store(&mut bits);
    let (mut mantissa, mut exponent) = ([0.0; LANES], [0.0; LANES]);
    for l in 0..LANES {
        // 0x3f3504f3 is sqrt(1/2): subtracting it makes the exponent change there.
        let shifted = bits[l].to_bits().wrapping_sub(0x3f35_04f3);
        exponent[l] = (shifted as i32 >> 23) as f32;
        mantissa[l] = f32::from_bits((shifted & 0x007f_ffff) + 0x3f35_04f3);
    }
    let t = s.load(&mantissa) - s.splat(1.0);
    let q = s.splat(0.123_109_68);
    let q = q.mul_add(t, s.splat(-0.205_861_88));
    let q = q.mul_add(t, s.splat(0.216_078_22));
    let q = q.mul_add(t, s.splat(-0.239_169_88));
    let q = q.mul_add(t, s.splat(0.287_903_25));
    let q = q.mul_add(t, s.splat(-0.360_693_28));
    let q = q.mul_add(t, s.splat(0.480_910_75));
    let q = q.mul_add(t, s.splat(-0.721_347_45));
    let q = q.mul_add(t, s.splat(std::f32::consts::LOG2_E));
    q.mul_add(t, s.load(&exponent))
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
    use sf_ops::Kernels;
    use sf_ops::simd::Body;

    /// One function over a slice of whole vectors.
    struct Apply<'a>(&'a mut [[f32; LANES]], bool);

    impl Body for Apply<'_> {
        type Output = ();
        #[inline(always)]
        fn run<S: Simd>(self, s: S) {
            for x in self.0 {
                let v = s.load(x);
                if self.1 { exp2_neg(s, v).store(x) } else { log2(s, v).store(x) }
            }
        }
    }

    /// Values and results on every instruction set, which must have the same bits.
    fn apply(values: &[f32], exp2: bool) -> Vec<f32> {
        let run = |kernels: &Kernels| {
            let mut x: Vec<[f32; LANES]> = values.chunks_exact(LANES).map(|c| c.try_into().unwrap()).collect();
            kernels.enter(Apply(&mut x, exp2));
            x.concat()
        };
        let results: Vec<Vec<f32>> = Kernels::available().map(run).collect();
        assert!(results.iter().all(|r| r.iter().zip(&results[0]).all(|(a, b)| a.to_bits() == b.to_bits())));
        results.into_iter().next().unwrap()
    }

    #[test]
    fn exp2_is_within_4e_7_of_the_true_value() {
        let x: Vec<f32> = (0..880_000).map(|i| i as f32 * 1e-4 - 0.5).collect();
        let worst = x
            .iter()
            .zip(apply(&x, true))
            .fold(0.0f64, |worst, (x, got)| worst.max((f64::from(got) / (-f64::from(*x)).exp2() - 1.0).abs()));
        assert!(worst < 4e-7, "relative error {worst:.2e}");
        assert_eq!(apply(&[0.0; LANES], true), [1.0; LANES]);
    }

    #[test]
    fn log2_is_within_6e_7_of_the_true_value() {
        let x: Vec<f32> = (0..800_000).map(|i| 1.0 / 255.0 + i as f32 * (254.0 / 255.0 / 800_000.0)).collect();
        let worst = x
            .iter()
            .zip(apply(&x, false))
            .fold(0.0f64, |worst, (x, got)| worst.max((f64::from(got) - f64::from(*x).log2()).abs()));
        assert!(worst < 6e-7, "absolute error {worst:.2e}");
        assert_eq!(apply(&[1.0; LANES], false), [0.0; LANES]);
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
