//! What a tile asks the caches for while it multiplies: its outputs, which would else be missed when they are stored, and the weights
//! that come after its own.

use crate::prefetch::{near_for_writing, near_l2};
use crate::simd::LANES;

/// Memory that a tile asks for while it multiplies. Hints: no effect on results, any address is safe.
#[derive(Clone, Copy)]
pub(crate) struct Ahead {
    /// First output of the tile.
    out: *const u8,
    /// Bytes from one row of outputs to the next.
    stride: usize,
    /// Weights that are read after these.
    next: *const u8,
    /// Bytes of them for each step.
    per_step: usize,
    /// Whether there is anything to ask for.
    any: bool,
}

/// Most cache lines of the next weights to ask for at a time.
const NEXT_LINES: usize = 8;
/// Fewest steps between two times: the loop around them costs a third of a tile of 32 steps when it runs for every one.
const AT_LEAST: usize = 8;
/// Steps between asking for operands and their use: some 100 cycles, more than the second-level cache takes.
pub(crate) const EARLY: usize = 8;

impl Ahead {
    /// Nothing: points at operands that are near anyway.
    pub(crate) fn nothing<T>(near: &[T]) -> Ahead {
        Ahead { out: near.as_ptr().cast(), stride: 0, next: near.as_ptr().cast(), per_step: 0, any: false }
    }

    /// With the outputs from `first` on, rows `stride` values apart.
    pub(crate) fn with_outputs(self, first: *const f32, stride: usize) -> Ahead {
        Ahead { out: first.cast(), stride: stride * size_of::<f32>(), any: true, ..self }
    }

    /// With the weights `next` that come after these, `per_step` of them for each step of the tile.
    pub(crate) fn with_weights<T>(self, next: *const T, per_step: usize) -> Ahead {
        Ahead { next: next.cast(), per_step: per_step * size_of::<T>(), any: true, ..self }
    }

    /// For a loop of `steps` steps of a tile of `rows` x `NV` panels.
    #[inline(always)]
    pub(crate) fn over<const NV: usize>(self, rows: usize, steps: usize) -> Asking<NV> {
        let each = (steps / rows).max(AT_LEAST);
        let at_once = rows.div_ceil((steps / each).max(1));
        let next_lines = (each * self.per_step).div_ceil(64).min(NEXT_LINES);
        Asking { ahead: self, each, at_once, next_lines, rows, steps }
    }
}

/// Asks for some rows of outputs and a share of the next weights now and then.
pub(crate) struct Asking<const NV: usize> {
    ahead: Ahead,
    /// Steps between two times.
    each: usize,
    /// Rows of outputs at a time.
    at_once: usize,
    /// Cache lines of the next weights at a time.
    next_lines: usize,
    /// Rows not yet asked for.
    rows: usize,
    steps: usize,
}

impl<const NV: usize> Asking<NV> {
    /// Steps until the next time; those left if `ask` is false or no row is left.
    #[inline(always)]
    pub(super) fn next(&mut self, ask: bool, done: usize) -> usize {
        let left = self.steps - done;
        if !ask || !self.ahead.any || self.rows == 0 {
            return left;
        }
        for _ in 0..self.at_once.min(self.rows) {
            for v in 0..NV {
                near_for_writing(self.ahead.out.wrapping_add(v * LANES * size_of::<f32>()));
            }
            self.ahead.out = self.ahead.out.wrapping_add(self.ahead.stride);
        }
        self.rows -= self.at_once.min(self.rows);
        for i in 0..self.next_lines {
            near_l2(self.ahead.next.wrapping_add(i * 64));
        }
        self.ahead.next = self.ahead.next.wrapping_add(self.each * self.ahead.per_step);
        self.each.min(left)
    }
}
