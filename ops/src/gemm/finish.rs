//! The epilogue of tiles: bias, activation, gamma, residual, from sums in the cache to the output in one pass. Written once over [`Sums`]; what
//! an integer sum is before that stands in `s8/finish.rs`.

use super::{Act, MAX_NV};
use crate::activation::{Gelu, Relu, gelu_lanes, relu_lanes};
use crate::par::SharedMut;
use crate::simd::{LANES, Lanewise, Simd, Vector, padded};

/// What is added to an output when it is stored.
#[derive(Clone, Copy)]
pub(crate) enum Plus<'a> {
    Nothing,
    /// What the output holds.
    Output,
    /// The value at the same place of another matrix of the output's shape.
    Other(&'a [f32]),
}

/// Per-output values of the panels of a tile, zeros beyond n.
#[derive(Clone, Copy, Default)]
pub(crate) struct Columns {
    pub bias: [[f32; LANES]; MAX_NV],
    pub gamma: [[f32; LANES]; MAX_NV],
}

impl Columns {
    /// Of `panels` panels from `panel` on, of a matrix of `n` outputs; the bias repeats over the outputs with its length as period.
    pub(crate) fn of(
        n: usize,
        (panel, panels): (usize, usize),
        bias: Option<&[f32]>,
        gamma: Option<&[f32]>,
    ) -> Columns {
        let mut columns = Columns::default();
        for v in 0..panels {
            let col = (panel + v) * LANES;
            let cols = LANES.min(n - col);
            if let Some(bias) = bias {
                match bias.get(col..col + cols) {
                    Some(bias) => columns.bias[v] = sixteen(bias, cols),
                    None => {
                        for (i, b) in columns.bias[v][..cols].iter_mut().enumerate() {
                            *b = bias[(col + i) % bias.len()];
                        }
                    }
                }
            }
            if let Some(gamma) = gamma {
                columns.gamma[v] = sixteen(&gamma[col..], cols);
            }
        }
        columns
    }

    /// Panel `p` alone.
    pub(crate) fn panel(&self, p: usize) -> Columns {
        let mut columns = Columns::default();
        (columns.bias[0], columns.gamma[0]) = (self.bias[p], self.gamma[p]);
        columns
    }
}

/// The first `cols` values, zeros behind them. Sixteen as one copy of known size: of unknown size it is a call of the C library.
pub(crate) fn sixteen(x: &[f32], cols: usize) -> [f32; LANES] {
    match x.first_chunk::<LANES>() {
        Some(x) if cols == LANES => *x,
        _ => padded(&x[..cols], 0.0),
    }
}

/// The epilogue of one tile of sums.
#[derive(Clone, Copy)]
pub(crate) struct Finish<'a> {
    /// `[panel][row][16]`.
    pub acc: &'a [f32],
    /// Values from one panel's sums to the next.
    pub acc_stride: usize,
    /// Panels in use.
    pub panels: usize,
    /// Rows in use.
    pub rows: usize,
    /// What is fixed per output.
    pub columns: &'a Columns,
    /// Whether `columns.bias` applies.
    pub bias: bool,
    /// Activation.
    pub act: Act,
    /// Whether `columns.gamma` applies.
    pub gamma: bool,
    /// What is added.
    pub plus: Plus<'a>,
    /// The whole output.
    pub out: &'a SharedMut<'a, f32>,
    /// Place of the tile's first value in it.
    pub at: usize,
    /// Values from one row to the next.
    pub stride: usize,
    /// Columns in use.
    pub cols: usize,
}

impl Sums for Finish<'_> {
    #[inline(always)]
    fn y<S: Simd>(&self, s: S, row: usize, panel: usize) -> S::V {
        let sum = s.load(&self.acc[panel * self.acc_stride..].as_chunks().0[row]);
        if self.bias { sum + s.load(&self.columns.bias[panel]) } else { sum }
    }

    #[inline(always)]
    fn to(&self) -> To<'_> {
        let Finish { panels, rows, columns, act, gamma, plus, out, at, stride, cols, .. } = *self;
        To { panels, rows, act, gamma: gamma.then_some(columns), plus, relu_sum: false, out, at, stride, cols }
    }
}

/// A tile of sums on its way to the output, of f32 or of integers.
pub(crate) trait Sums {
    /// Sixteen sums of a row and panel, scaled and with the bias.
    fn y<S: Simd>(&self, s: S, row: usize, panel: usize) -> S::V;
    /// What happens to them then.
    fn to(&self) -> To<'_>;
}

/// The part of an epilogue behind scales and bias; fields as in [`Finish`].
pub(crate) struct To<'a> {
    pub panels: usize,
    pub rows: usize,
    pub act: Act,
    /// Factors, where there are any.
    pub gamma: Option<&'a Columns>,
    pub plus: Plus<'a>,
    /// Whether the output is rectified after what is added.
    pub relu_sum: bool,
    pub out: &'a SharedMut<'a, f32>,
    pub at: usize,
    pub stride: usize,
    pub cols: usize,
}

/// y = act(y) * gamma; out = out + y or y. Every step rounds once.
#[inline(always)]
pub(crate) fn finish<S: Simd>(s: S, t: &impl Sums) {
    let to = t.to();
    let whole = to.cols == to.panels * LANES && to.gamma.is_none() && !to.relu_sum && matches!(to.plus, Plus::Nothing);
    // Most tiles: nothing to decide for each vector.
    match (whole, to.panels, to.act) {
        (true, 2, Act::None) => finish_whole::<S, _, Same, 2>(s, t, &to),
        (true, 2, Act::Gelu) => finish_whole::<S, _, Gelu, 2>(s, t, &to),
        (true, 2, Act::Relu) => finish_whole::<S, _, Relu, 2>(s, t, &to),
        (true, 1, Act::None) => finish_whole::<S, _, Same, 1>(s, t, &to),
        (true, 1, Act::Gelu) => finish_whole::<S, _, Gelu, 1>(s, t, &to),
        (true, 1, Act::Relu) => finish_whole::<S, _, Relu, 1>(s, t, &to),
        _ => finish_any(s, t, &to),
    }
}

/// No activation.
struct Same;

impl Lanewise for Same {
    #[inline(always)]
    fn apply<S: Simd>(_: S, x: S::V) -> S::V {
        x
    }
}

/// Whole panels, activation `F`, nothing added.
#[inline(always)]
fn finish_whole<S: Simd, T: Sums, F: Lanewise, const NV: usize>(s: S, t: &T, to: &To) {
    let mut done = 0;
    while done < to.rows {
        done += if S::REGISTERS >= 32 && to.rows - done >= 4 {
            finish_lines::<S, T, F, NV, 4>(s, t, to, done);
            4
        } else {
            finish_lines::<S, T, F, NV, 1>(s, t, to, done);
            1
        };
    }
}

/// `M` rows of it.
#[inline(always)]
fn finish_lines<S: Simd, T: Sums, F: Lanewise, const NV: usize, const M: usize>(s: S, t: &T, to: &To, first: usize) {
    let mut y = [[s.splat(0.0); NV]; M];
    for r in 0..M {
        for v in 0..NV {
            y[r][v] = t.y(s, first + r, v);
        }
    }
    let y = F::apply_all(s, y);
    // SAFETY: every output belongs to one tile of one task, and the pieces live only in this function.
    #[allow(unsafe_code)]
    let out = unsafe { to.out.lines::<M>(to.at + first * to.stride, to.stride, NV * LANES) };
    for (r, out) in out.into_iter().enumerate() {
        let out = &mut out.as_chunks_mut::<LANES>().0[..NV];
        for v in 0..NV {
            y[r][v].store(&mut out[v]);
        }
    }
}

/// Any tile.
#[inline(always)]
fn finish_any<S: Simd>(s: S, t: &impl Sums, to: &To) {
    for p in 0..to.panels {
        let gamma = to.gamma.map(|columns| s.load(&columns.gamma[p]));
        let cols = LANES.min(to.cols - p * LANES);
        for r in 0..to.rows {
            store_last(s, t.y(s, r, p), (gamma, cols), to, to.at + r * to.stride + p * LANES);
        }
    }
}

/// The last steps of up to sixteen outputs, from `at` on.
#[inline(always)]
fn store_last<S: Simd>(s: S, mut y: S::V, (gamma, cols): (Option<S::V>, usize), to: &To, at: usize) {
    match to.act {
        Act::None => {}
        Act::Gelu => y = gelu_lanes(s, y),
        Act::Relu => y = relu_lanes(s, y),
    }
    if let Some(gamma) = gamma {
        y = y * gamma;
    }
    // SAFETY: every output belongs to one tile of one task, and a piece lives only in this function.
    #[allow(unsafe_code)]
    let out = unsafe { to.out.slice(at..at + cols) };
    let mut lanes = [0.0; LANES];
    match to.plus {
        Plus::Nothing => {}
        Plus::Output => y = load_some(s, out, &mut lanes) + y,
        Plus::Other(x) => y = load_some(s, &x[at..at + cols], &mut lanes) + y,
    }
    if to.relu_sum {
        y = relu_lanes(s, y);
    }
    match out.first_chunk_mut::<LANES>() {
        Some(out) => y.store(out),
        None => {
            y.store(&mut lanes);
            out.copy_from_slice(&lanes[..out.len()]);
        }
    }
}

/// Up to sixteen values, zeros beyond.
#[inline(always)]
fn load_some<S: Simd>(s: S, x: &[f32], lanes: &mut [f32; LANES]) -> S::V {
    match x.first_chunk::<LANES>() {
        Some(x) => s.load(x),
        None => {
            lanes[..x.len()].copy_from_slice(x);
            s.load(lanes)
        }
    }
}
