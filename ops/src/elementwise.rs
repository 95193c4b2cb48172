//! Element-wise operations on whole buffers, and the pixel shuffle.

use crate::cpu::Ctx;
use crate::mat::{HwcMut, Mat};

/// x = max(x, 0); NaN stays.
pub fn relu(_ctx: Ctx, x: &mut [f32]) {
    for v in x {
        *v = crate::reference::relu(*v);
    }
}

/// x = e^x.
pub fn exp_in_place(_ctx: Ctx, x: &mut [f32]) {
    for v in x {
        *v = crate::activation::exp(*v);
    }
}

/// x = 1 / (1 + e^-x).
pub fn sigmoid_in_place(_ctx: Ctx, x: &mut [f32]) {
    for v in x {
        *v = crate::activation::sigmoid(*v);
    }
}

/// x = gelu(x), erf form.
pub fn gelu_in_place(_ctx: Ctx, x: &mut [f32]) {
    for v in x {
        *v = crate::activation::gelu(*v);
    }
}

/// out = x + y.
pub fn add(_ctx: Ctx, x: &[f32], y: &[f32], out: &mut [f32]) {
    assert!(x.len() == y.len() && x.len() == out.len(), "{} + {} -> {} values", x.len(), y.len(), out.len());
    for i in 0..x.len() {
        out[i] = x[i] + y[i];
    }
}

/// x = x + y.
pub fn add_assign(_ctx: Ctx, x: &mut [f32], y: &[f32]) {
    assert_eq!(x.len(), y.len(), "lengths of a sum");
    for i in 0..x.len() {
        x[i] += y[i];
    }
}

/// Column `ch * p * p + dy * p + dx` of patch (y, x) fills pixel (y p + dy, x p + dx) of channel ch:
/// `x` `[ph * pw, c * p * p]` -> `out` `[ph * p, pw * p, c]`.
pub fn pixel_shuffle(_ctx: Ctx, x: Mat, grid: (usize, usize), p: usize, out: HwcMut) {
    out.data.copy_from_slice(&crate::reference::pixel_shuffle(x, grid, p));
}
