//! The epilogue of f32 tiles: bias, activation, gamma, residual, from sums in the cache to the output in one pass; and the steps
//! that the int8 epilogue (`s8/finish.rs`) has in common with it.

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

/// y = act(acc + bias) * gamma; out = out + y or y. Every step rounds once.
#[inline(always)]
pub(crate) fn finish<S: Simd>(s: S, t: Finish) {
    let whole = t.cols == t.panels * LANES && t.bias && !t.gamma && matches!(t.plus, Plus::Nothing);
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

/// No activation.
pub(crate) struct Same;

impl Lanewise for Same {
    #[inline(always)]
    fn apply<S: Simd>(_: S, x: S::V) -> S::V {
        x
    }
}

/// Whole panels with a bias, activation `F`, nothing added.
#[inline(always)]
fn finish_whole<S: Simd, F: Lanewise, const NV: usize>(s: S, t: &Finish) {
    let mut acc: [&[[f32; LANES]]; NV] = [&[]; NV];
    let mut bias = [s.splat(0.0); NV];
    for v in 0..NV {
        acc[v] = &t.acc[v * t.acc_stride..].as_chunks::<LANES>().0[..t.rows];
        bias[v] = s.load(&t.columns.bias[v]);
    }
    let mut done = 0;
    while done < t.rows {
        let lines = Lines { first: done, acc: &acc, bias: &bias };
        done += if S::REGISTERS >= 32 && t.rows - done >= 4 {
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
    acc: &'a [&'a [[f32; LANES]]; NV],
    bias: &'a [V; NV],
}

/// `M` rows of it.
#[inline(always)]
fn finish_lines<S: Simd, F: Lanewise, const NV: usize, const M: usize>(s: S, t: &Finish, lines: Lines<S::V, NV>) {
    let Lines { first, acc, bias } = lines;
    let mut y = [[s.splat(0.0); NV]; M];
    for r in 0..M {
        for v in 0..NV {
            y[r][v] = s.load(&acc[v][first + r]) + bias[v];
        }
    }
    put_lines(t.out, (t.at + first * t.stride, t.stride), F::apply_all(s, y));
}

/// Whole vectors of some rows to the output, from a place on, rows so many values apart.
#[inline(always)]
pub(crate) fn put_lines<V: Vector, const NV: usize, const M: usize>(
    out: &SharedMut<f32>,
    (at, stride): (usize, usize),
    y: [[V; NV]; M],
) {
    // SAFETY: every output belongs to one tile of one task, and the pieces live only in this function.
    #[allow(unsafe_code)]
    let out = unsafe { out.lines::<M>(at, stride, NV * LANES) };
    for (r, out) in out.into_iter().enumerate() {
        let out = &mut out.as_chunks_mut::<LANES>().0[..NV];
        for v in 0..NV {
            y[r][v].store(&mut out[v]);
        }
    }
}

/// Any tile.
#[inline(always)]
fn finish_any<S: Simd>(s: S, t: &Finish) {
    for p in 0..t.panels {
        let acc = &t.acc[p * t.acc_stride..].as_chunks::<LANES>().0[..t.rows];
        let bias = s.load(&t.columns.bias[p]);
        let last = Last {
            act: t.act,
            gamma: t.gamma.then(|| s.load(&t.columns.gamma[p])),
            plus: t.plus,
            relu_sum: false,
            cols: LANES.min(t.cols - p * LANES),
        };
        for (r, acc) in acc.iter().enumerate() {
            let sum = s.load(acc);
            let y = if t.bias { sum + bias } else { sum };
            last.store(s, y, t.out, t.at + r * t.stride + p * LANES);
        }
    }
}

/// The last steps of up to sixteen outputs.
pub(crate) struct Last<'a, V> {
    /// Activation.
    pub act: Act,
    /// Factors, where there are any.
    pub gamma: Option<V>,
    /// What is added.
    pub plus: Plus<'a>,
    /// Whether the output is rectified after that.
    pub relu_sum: bool,
    /// Outputs in use.
    pub cols: usize,
}

impl<V: Vector> Last<'_, V> {
    /// y = act(y) * gamma; out = out + y or y, from `at` on.
    #[inline(always)]
    pub(crate) fn store<S: Simd<V = V>>(&self, s: S, mut y: V, out: &SharedMut<f32>, at: usize) {
        match self.act {
            Act::None => {}
            Act::Gelu => y = gelu_lanes(s, y),
            Act::Relu => y = relu_lanes(s, y),
        }
        if let Some(gamma) = self.gamma {
            y = y * gamma;
        }
        // SAFETY: every output belongs to one tile of one task, and a piece lives only in this function.
        #[allow(unsafe_code)]
        let out = unsafe { out.slice(at..at + self.cols) };
        let mut lanes = [0.0; LANES];
        match self.plus {
            Plus::Nothing => {}
            Plus::Output => y = load_some(s, out, &mut lanes) + y,
            Plus::Other(x) => y = load_some(s, &x[at..at + self.cols], &mut lanes) + y,
        }
        if self.relu_sum {
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
