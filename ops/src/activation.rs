//! exp, sigmoid, erf and gelu: 16-lane bodies, and scalar functions with the same bits.
//!
//! exp: n = round(x / ln 2), r = x - n ln 2 in two fused steps, e^r = 1 + r + r^2 q(r) with q of degree 4, fitted to
//! 2^-28; scaled by 2^(n-1) * 2 so that n = 128 works. Results below 2^-125 are 0.
//! gelu: x Phi(x) in the erf form. With z = x clamped to +-5.4, Phi(x) - 1/2 = z P(z^2 mapped to [-1, 1]), P of degree 15 fitted (weighted
//! minimax) to 4e-9 of Phi: no exponential and no division, 22 instructions for a register of values where the form e^(-x^2/2) Q(1 / (1 + 0.3 x))
//! took 50. Below -5.4, where x Phi(x) is above -1.8e-7, the result is 0.

// Coefficients and split constants carry every digit they were fitted with.
#![allow(clippy::excessive_precision)]

use crate::simd::scalar::Single;
use crate::simd::{Lanewise, Simd, Vector, map};

/// Above: infinity. ln(2^128).
const EXP_MAX: f32 = 88.722_839;
/// Below: 0. Results there are under 2^-125.
const EXP_MIN: f32 = -86.643_4;
/// 1.5 * 2^23: adding it rounds to an integer and leaves that integer in the low bits.
const ROUND: f32 = 12_582_912.0;
const LOG2_E: f32 = std::f32::consts::LOG2_E;
/// ln 2 = HI + LO; HI has 9 trailing zero bits, so n * HI is exact.
const LN2_HI: f32 = 0.693_359_375;
const LN2_LO: f32 = -2.121_944_4e-4;

/// e^x for every lane; NaN stays NaN.
#[inline(always)]
pub(crate) fn exp_lanes<S: Simd>(s: S, x: S::V) -> S::V {
    let shifted = x.mul_add(s.splat(LOG2_E), s.splat(ROUND));
    let n = shifted - s.splat(ROUND);
    let r = n.mul_add(s.splat(-LN2_HI), x);
    let r = n.mul_add(s.splat(-LN2_LO), r);
    let q = s.splat(1.395_297_2e-3);
    let q = q.mul_add(r, s.splat(8.370_321e-3));
    let q = q.mul_add(r, s.splat(4.166_616_9e-2));
    let q = q.mul_add(r, s.splat(1.666_650_6e-1));
    let q = q.mul_add(r, s.splat(0.5));
    let p = (r * r).mul_add(q, r) + s.splat(1.0);
    let y = (p + p) * shifted.pow2_of_low_bits(126);
    let y = x.select_gt(s.splat(EXP_MAX), s.splat(f32::INFINITY), y);
    s.splat(EXP_MIN).select_gt(x, s.splat(0.0), y)
}

/// 1 / (1 + e^-x).
#[inline(always)]
pub(crate) fn sigmoid_lanes<S: Simd>(s: S, x: S::V) -> S::V {
    let one = s.splat(1.0);
    one / (one + exp_lanes(s, s.splat(0.0) - x))
}

/// Beyond, Phi is 0 or 1 to 3.4e-8.
const PHI_MAX: f32 = 5.4;
/// Coefficients of P, highest first.
const PHI: [f32; 16] = [
    -1.703_154_85e-4,
    4.623_555_87e-4,
    -4.251_080_39e-4,
    6.496_891_73e-4,
    -2.038_438_8e-3,
    3.944_015_13e-3,
    -6.104_658_36e-3,
    9.473_515_67e-3,
    -1.419_679_26e-2,
    1.970_151_63e-2,
    -2.570_084_3e-2,
    3.210_816_53e-2,
    -3.921_072_19e-2,
    4.850_005_73e-2,
    -6.532_795_73e-2,
    1.309_281_14e-1,
];

/// P(z) of several vectors z in [-5.4, 5.4]: the normal distribution function is 1/2 + z P.
#[inline(always)]
fn phi<S: Simd, const N: usize, const M: usize>(s: S, z: &[[S::V; N]; M]) -> [[S::V; N]; M] {
    let (mut t, mut p) = ([[s.splat(0.0); N]; M], [[s.splat(PHI[0]); N]; M]);
    for m in 0..M {
        for n in 0..N {
            t[m][n] = (z[m][n] * z[m][n]).mul_add(s.splat(2.0 / (PHI_MAX * PHI_MAX)), s.splat(-1.0));
        }
    }
    for c in &PHI[1..] {
        let c = s.splat(*c);
        for m in 0..M {
            for n in 0..N {
                p[m][n] = p[m][n].mul_add(t[m][n], c);
            }
        }
    }
    p
}

/// x Phi(x); NaN stays NaN.
#[inline(always)]
pub(crate) fn gelu_lanes<S: Simd>(s: S, x: S::V) -> S::V {
    gelu_all(s, [[x]])[0][0]
}

/// The same of several vectors: eight at a time take 0.93 of the time of an int8 product whose outputs go through it one by one (AVX-512).
#[inline(always)]
fn gelu_all<S: Simd, const N: usize, const M: usize>(s: S, mut x: [[S::V; N]; M]) -> [[S::V; N]; M] {
    let mut z = x;
    for m in 0..M {
        for n in 0..N {
            // Minus infinity is cut too: times a Phi of 0 it would be NaN.
            x[m][n] = s.splat(-PHI_MAX).max(x[m][n]);
            z[m][n] = s.splat(PHI_MAX).min(x[m][n]);
        }
    }
    let p = phi(s, &z);
    for m in 0..M {
        for n in 0..N {
            // At the lower end 1/2 + z P is -3e-8.
            x[m][n] = x[m][n] * s.splat(0.0).max(z[m][n].mul_add(p[m][n], s.splat(0.5)));
        }
    }
    x
}

/// erf(x) = 2 (Phi(x sqrt 2) - 1/2); about 1e-7 absolute.
#[inline(always)]
fn erf_lanes<S: Simd>(s: S, x: S::V) -> S::V {
    let x = x * s.splat(std::f32::consts::SQRT_2);
    let z = s.splat(PHI_MAX).min(s.splat(-PHI_MAX).max(x));
    let [[p]] = phi(s, &[[z]]);
    z * (p + p)
}

/// x < 0 ? 0 : x, which keeps NaN.
#[inline(always)]
pub(crate) fn relu_lanes<S: Simd>(s: S, x: S::V) -> S::V {
    s.splat(0.0).max(x)
}

/// Which function a vector kernel applies.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Map {
    Exp,
    Sigmoid,
    Gelu,
    Relu,
}

struct Exp;
struct Sigmoid;
pub(crate) struct Gelu;
pub(crate) struct Relu;
struct Erf;

impl Lanewise for Exp {
    #[inline(always)]
    fn apply<S: Simd>(s: S, x: S::V) -> S::V {
        exp_lanes(s, x)
    }
}

impl Lanewise for Sigmoid {
    #[inline(always)]
    fn apply<S: Simd>(s: S, x: S::V) -> S::V {
        sigmoid_lanes(s, x)
    }
}

impl Lanewise for Gelu {
    #[inline(always)]
    fn apply<S: Simd>(s: S, x: S::V) -> S::V {
        gelu_lanes(s, x)
    }

    #[inline(always)]
    fn apply_all<S: Simd, const N: usize, const M: usize>(s: S, x: [[S::V; N]; M]) -> [[S::V; N]; M] {
        gelu_all(s, x)
    }
}

impl Lanewise for Relu {
    #[inline(always)]
    fn apply<S: Simd>(s: S, x: S::V) -> S::V {
        relu_lanes(s, x)
    }
}

impl Lanewise for Erf {
    #[inline(always)]
    fn apply<S: Simd>(s: S, x: S::V) -> S::V {
        erf_lanes(s, x)
    }
}

/// x = op(x).
#[inline(always)]
pub(crate) fn map_body<S: Simd>(s: S, op: Map, x: &mut [f32]) {
    match op {
        Map::Exp => map::<S, Exp>(s, x),
        Map::Sigmoid => map::<S, Sigmoid>(s, x),
        Map::Gelu => map::<S, Gelu>(s, x),
        Map::Relu => map::<S, Relu>(s, x),
    }
}

/// The body on a vector of one lane.
#[inline(always)]
fn one<F: Lanewise>(x: f32) -> f32 {
    F::apply(Single, Single.splat(x)).value()
}

/// e^x; 0 below -86.64, infinity above 88.72. About 1 unit in the last place.
pub fn exp(x: f32) -> f32 {
    one::<Exp>(x)
}

/// 1 / (1 + e^-x).
pub fn sigmoid(x: f32) -> f32 {
    one::<Sigmoid>(x)
}

/// Error function, about 1e-7 absolute.
pub fn erf(x: f32) -> f32 {
    one::<Erf>(x)
}

/// x Phi(x), erf form.
pub fn gelu(x: f32) -> f32 {
    one::<Gelu>(x)
}
