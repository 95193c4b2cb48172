//! The epilogue of int8 tiles: sums to f32, bias, activation, gamma, residual, while they are in the cache.

use super::pack::PanelsS8;
use super::tile::MAX_NV;
use crate::activation::{Gelu, Relu};
use crate::gemm::Act;
use crate::gemm::finish::{Columns, Last, Plus, Same, put_lines, sixteen};
use crate::par::SharedMut;
use crate::simd::{LANES, Lanewise, Simd, Vector};

/// The epilogue of one tile of sums.
#[derive(Clone, Copy)]
pub(crate) struct FinishS8<'a> {
    /// `[panel][row][16]`.
    pub acc: &'a [i32],
    /// Values from one panel's sums to the next.
    pub acc_stride: usize,
    /// Panels in use.
    pub panels: usize,
    /// Scale of each row in use.
    pub row_scales: &'a [f32],
    /// What is fixed per output.
    pub columns: &'a ColumnsS8,
    /// Activation.
    pub act: Act,
    /// Whether `columns.gamma` applies.
    pub gamma: bool,
    /// What is added.
    pub plus: Plus<'a>,
    /// Whether the output is rectified after that.
    pub relu_sum: bool,
    /// The whole output.
    pub out: &'a SharedMut<'a, f32>,
    /// Place of the tile's first value in it.
    pub at: usize,
    /// Values from one row to the next.
    pub stride: usize,
    /// Columns in use.
    pub cols: usize,
}

/// Per-output values of the panels of a tile, zeros beyond n.
#[derive(Clone, Copy, Default)]
pub(crate) struct ColumnsS8 {
    pub scales: [[f32; LANES]; MAX_NV],
    pub rest: Columns,
}

impl ColumnsS8 {
    /// Of `panels` panels from `panel` on; the bias repeats over the outputs with its length as period.
    pub(crate) fn of(
        w: PanelsS8,
        (panel, panels): (usize, usize),
        bias: Option<&[f32]>,
        gamma: Option<&[f32]>,
    ) -> ColumnsS8 {
        let rest = Columns::of(w.n, (panel, panels), bias, gamma);
        let mut columns = ColumnsS8 { scales: [[0.0; LANES]; MAX_NV], rest };
        for v in 0..panels {
            let col = (panel + v) * LANES;
            columns.scales[v] = sixteen(&w.scales[col..], LANES.min(w.n - col));
        }
        columns
    }

    /// Panel `p` alone.
    pub(crate) fn panel(&self, p: usize) -> ColumnsS8 {
        let mut columns = ColumnsS8 { rest: self.rest.panel(p), ..ColumnsS8::default() };
        columns.scales[0] = self.scales[p];
        columns
    }
}

/// y = act(fma(acc, row scale * output scale, bias)) * gamma; out = out + y or y. Every step rounds once.
#[inline(always)]
pub(crate) fn finish<S: Simd>(s: S, t: FinishS8) {
    let whole = t.cols == t.panels * LANES && !t.gamma && !t.relu_sum && matches!(t.plus, Plus::Nothing);
    // Most tiles: nothing to decide for each vector.
    match (whole, t.panels, t.act) {
        (true, 2, Act::None) => finish_whole::<S, Same, 2>(s, &t),
        (true, 2, Act::Gelu) => finish_whole::<S, Gelu, 2>(s, &t),
        (true, 2, Act::Relu) => finish_whole::<S, Relu, 2>(s, &t),
        (true, 1, Act::None) => finish_whole::<S, Same, 1>(s, &t),
        (true, 1, Act::Gelu) => finish_whole::<S, Gelu, 1>(s, &t),
        (true, 1, Act::Relu) => finish_whole::<S, Relu, 1>(s, &t),
        _ => finish_any(s, &t),
    }
}

/// Whole panels, activation `F`, nothing added.
#[inline(always)]
fn finish_whole<S: Simd, F: Lanewise, const NV: usize>(s: S, t: &FinishS8) {
    let rows = t.row_scales.len();
    let mut acc: [&[[i32; LANES]]; NV] = [&[]; NV];
    let mut scale = [s.splat(0.0); NV];
    let mut bias = [s.splat(0.0); NV];
    for v in 0..NV {
        acc[v] = &t.acc[v * t.acc_stride..].as_chunks::<LANES>().0[..rows];
        scale[v] = s.load(&t.columns.scales[v]);
        bias[v] = s.load(&t.columns.rest.bias[v]);
    }
    let mut done = 0;
    while done < rows {
        let lines = Lines { first: done, acc: &acc, scale: &scale, bias: &bias };
        done += if S::REGISTERS >= 32 && rows - done >= 4 {
            finish_lines::<S, F, NV, 4>(s, t, lines);
            4
        } else {
            finish_lines::<S, F, NV, 1>(s, t, lines);
            1
        };
    }
}

/// Some rows of whole panels.
struct Lines<'a, V, const NV: usize> {
    first: usize,
    acc: &'a [&'a [[i32; LANES]]; NV],
    scale: &'a [V; NV],
    bias: &'a [V; NV],
}

/// `M` rows of it.
#[inline(always)]
fn finish_lines<S: Simd, F: Lanewise, const NV: usize, const M: usize>(s: S, t: &FinishS8, lines: Lines<S::V, NV>) {
    let Lines { first, acc, scale, bias } = lines;
    let mut y = [[s.splat(0.0); NV]; M];
    for r in 0..M {
        let row = s.splat(t.row_scales[first + r]);
        for v in 0..NV {
            y[r][v] = s.load_i32(&acc[v][first + r]).mul_add(row * scale[v], bias[v]);
        }
    }
    put_lines(t.out, (t.at + first * t.stride, t.stride), F::apply_all(s, y));
}

/// Any tile.
#[inline(always)]
fn finish_any<S: Simd>(s: S, t: &FinishS8) {
    let rows = t.row_scales.len();
    for p in 0..t.panels {
        let acc = &t.acc[p * t.acc_stride..][..rows * LANES].as_chunks::<LANES>().0[..rows];
        let scale = s.load(&t.columns.scales[p]);
        let bias = s.load(&t.columns.rest.bias[p]);
        let last = Last {
            act: t.act,
            gamma: t.gamma.then(|| s.load(&t.columns.rest.gamma[p])),
            plus: t.plus,
            relu_sum: t.relu_sum,
            cols: LANES.min(t.cols - p * LANES),
        };
        for r in 0..rows {
            let y = s.load_i32(&acc[r]).mul_add(s.splat(t.row_scales[r]) * scale, bias);
            last.store(s, y, t.out, t.at + r * t.stride + p * LANES);
        }
    }
}
