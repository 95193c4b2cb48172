//! Every tolerance of the kernel tests, with its reason. Bits across instruction sets and thread counts compare
//! with `==` and need none.

/// Half a unit in the last place of f32: the relative error of one rounding.
pub(crate) const HALF_ULP: f32 = 5.96e-8;

/// A sum of k products accumulated with k roundings errs by at most k half-ulps of the sum of magnitudes; one
/// more for the result itself and two for the epilogue's steps.
pub(crate) fn dot(k: usize, magnitude: f32) -> f32 {
    (k as f32 + 3.0) * HALF_ULP * magnitude + 1e-38
}

/// exp: 2^-28 fit, one rounding in r q + r, one in the sum with 1; measured maximum 1.04 ulp over a sweep of all
/// exponents.
pub(crate) const EXP_ULPS: f32 = 1.1;

/// gelu relative to |x|: the fit, the last roundings of its polynomial, times z, plus 1/2.
pub(crate) const GELU_OF_X: f32 = 4.0 * HALF_ULP;

/// sigmoid: one exp, one sum, one quotient, each a rounding or so.
pub(crate) const SIGMOID: f32 = 4.0 * HALF_ULP;

/// erf: twice z P, absolute; fit and last roundings.
pub(crate) const ERF: f32 = 5.0 * HALF_ULP;

/// A norm's output errs by the roundings of mean and scale, relative to the largest output, ...
pub(crate) const NORM: f32 = 2e-6;

/// ... and by the rounding of x - mean, four half-ulps of the largest |x| over the deviation, times the gain (below 1 in
/// the tests).
pub(crate) fn norm(largest_y: f32, largest_x: f32, deviation: f32) -> f32 {
    NORM * largest_y.max(1.0) + 4.0 * HALF_ULP * largest_x / deviation
}

/// Attention: a convex combination of values; the weights' relative error is that of scores of size up to 30
/// (30 half-ulps in the exponent) and of the sums over keys.
pub(crate) const ATTENTION: f32 = 6e-6;

/// Two fused interpolations of values of unit size.
pub(crate) const BILINEAR: f32 = 4.0 * HALF_ULP;

/// A Hadamard block of 128 values of unit size: seven levels of sums up to 128, then the factor 1/sqrt(128). Seven half-ulps of
/// 128 over 11.3, rarely a fifth of it.
pub(crate) const HADAMARD: f32 = 7.0 * HALF_ULP * 128.0 / 11.3;

/// Scales of two ways to the same row, relative: the roundings of a rotation's sums and factor.
pub(crate) const SCALE: f32 = 4e-6;
