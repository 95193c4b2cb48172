//! [`Features`]: the tokens that a head reads, where the aggregator or the causal module left them; and
//! [`Pairs`], all that the aggregator keeps.

use crate::dims::Dims;
use sf_ops::mat::Mat;
use std::ops::Range;

/// Tokens that a head reads: `[frames * tokens, columns]` inside wider rows, registers first.
#[derive(Clone, Copy)]
pub(crate) struct Features<'a> {
    data: &'a [f32],
    /// Width of a stored row; the features are its last `cols` values.
    stride: usize,
    cols: usize,
    tokens: usize,
    patches: usize,
    frames: usize,
}

impl<'a> Features<'a> {
    /// Rows of exactly their width.
    pub(crate) fn dense(data: &'a [f32], cols: usize, d: &Dims, tokens: usize) -> Features<'a> {
        Features { data, stride: cols, cols, tokens, patches: d.patches, frames: d.frames }
    }

    /// The last `cols` columns.
    pub(crate) fn last(self, cols: usize) -> Features<'a> {
        assert!(cols <= self.cols, "{cols} of {} columns", self.cols);
        Features { cols, ..self }
    }

    fn rows_from(&self, row: usize, rows: usize) -> Mat<'a> {
        Mat::with_stride(&self.data[row * self.stride + self.stride - self.cols..], rows, self.cols, self.stride)
    }

    /// Those of some frames.
    pub(crate) fn of(self, frames: Range<usize>) -> Features<'a> {
        let frame = self.tokens * self.stride;
        Features { data: &self.data[frames.start * frame..frames.end * frame], frames: frames.len(), ..self }
    }

    /// All tokens of all frames.
    pub(crate) fn all(&self) -> Mat<'a> {
        self.rows_from(0, self.frames * self.tokens)
    }

    /// The patch tokens of one frame.
    pub(crate) fn patches(&self, frame: usize) -> Mat<'a> {
        self.rows_from((frame + 1) * self.tokens - self.patches, self.patches)
    }

    /// Tokens per frame.
    pub(crate) fn tokens(&self) -> usize {
        self.tokens
    }
}

/// The kept pairs of aggregator outputs, one after the other, each `[frames * tokens, 2 dim]`.
#[derive(Clone, Copy)]
pub(crate) struct Pairs<'a> {
    pub(crate) data: &'a [f32],
    /// Their indices, in order of their place in `data`.
    pub(crate) kept: &'a [usize],
    pub(crate) dims: &'a Dims,
    /// Width of one output.
    pub(crate) dim: usize,
}

impl<'a> Pairs<'a> {
    /// Both outputs of pair `index`, side by side.
    pub(crate) fn get(&self, index: usize) -> Features<'a> {
        let slot = self.kept.iter().position(|&p| p == index).expect("the plan keeps every tapped pair");
        let d = self.dims;
        let len = d.frames * d.tokens * 2 * self.dim;
        Features::dense(&self.data[slot * len..][..len], 2 * self.dim, d, d.tokens)
    }

    /// Both outputs of the last pair.
    pub(crate) fn final_pair(&self) -> Features<'a> {
        self.get(*self.kept.last().expect("the last pair is always kept"))
    }
}
