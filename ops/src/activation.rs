//! exp, sigmoid, erf and gelu: 16-lane bodies, and scalar functions with the same bits.
//!
//! exp: n = round(x / ln 2), r = x - n ln 2 in two fused steps, e^r = 1 + r + r^2 q(r) with q of degree 4, fitted to
//! 2^-28; scaled by 2^(n-1) * 2 so that n = 128 works. Results below 2^-125 are 0.
//! gelu: x Phi(x) in the erf form. For u = |x| the tail Phi(-u) = e^(-u^2/2) t Q(t), t = 1 / (1 + 0.3 u), Q of
//! degree 9 fitted to 2^-28 for u up to 14; then gelu = x - x tail for x > 0 and x tail below. The negative side
//! keeps its relative accuracy, unlike 0.5 x (1 + erf).

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

/// Phi(-u) for u >= 0: the upper tail of the normal distribution.
#[inline(always)]
fn tail<S: Simd>(s: S, u: S::V) -> S::V {
    const Q: [f32; 10] = [
        -0.020_611_741,
        0.112_369_992,
        -0.228_054_152,
        0.191_564_138,
        -0.079_232_903,
        0.096_050_138,
        0.078_428_228,
        0.110_226_757,
        0.119_572_909,
        0.119_686_631,
    ];
    let one = s.splat(1.0);
    let t = one / u.mul_add(s.splat(0.3), one);
    let mut q = s.splat(Q[0]);
    for c in &Q[1..] {
        q = q.mul_add(t, s.splat(*c));
    }
    exp_lanes(s, (u * u) * s.splat(-0.5)) * (q * t)
}

/// x Phi(x).
#[inline(always)]
pub(crate) fn gelu_lanes<S: Simd>(s: S, x: S::V) -> S::V {
    let zero = s.splat(0.0);
    let side = x * tail(s, x.abs());
    // Minus infinity times a tail of 0 is 0 here, not NaN.
    let below = s.splat(-15.0).select_gt(x, zero, side);
    let above = s.splat(15.0).select_gt(x, x - side, x);
    x.select_gt(zero, above, below)
}

/// erf(x) = sign(x) (1 - 2 Phi(-|x| sqrt 2)); about 1e-7 absolute.
#[inline(always)]
fn erf_lanes<S: Simd>(s: S, x: S::V) -> S::V {
    let zero = s.splat(0.0);
    let t = tail(s, x.abs() * s.splat(std::f32::consts::SQRT_2));
    let y = s.splat(1.0) - (t + t);
    x.select_gt(zero, y, zero.select_gt(x, zero - y, x))
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
struct Gelu;
struct Relu;
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
