//! The epilogue of int8 tiles: integer sums to f32 with scales and bias; the rest is that of every tile.

use super::pack::PanelsS8;
use super::tile::MAX_NV;
use crate::gemm::Act;
use crate::gemm::finish::{Columns, Plus, Sums, To, sixteen};
use crate::par::SharedMut;
use crate::simd::{LANES, Simd, Vector};

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

/// y = act(fma(acc, row scale * output scale, bias)), then as [`crate::gemm::finish`].
impl Sums for FinishS8<'_> {
    #[inline(always)]
    fn y<S: Simd>(&self, s: S, row: usize, panel: usize) -> S::V {
        let sum = s.load_i32(&self.acc[panel * self.acc_stride..].as_chunks().0[row]);
        let scale = s.splat(self.row_scales[row]) * s.load(&self.columns.scales[panel]);
        sum.mul_add(scale, s.load(&self.columns.rest.bias[panel]))
    }

    #[inline(always)]
    fn to(&self) -> To<'_> {
        let FinishS8 { panels, row_scales, columns, act, gamma, plus, relu_sum, out, at, stride, cols, .. } = *self;
        let (rows, gamma) = (row_scales.len(), gamma.then_some(&columns.rest));
        To { panels, rows, act, gamma, plus, relu_sum, out, at, stride, cols }
    }
}
