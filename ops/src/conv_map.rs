//! Convolution over a padded map whose windows the tiles read in place.
//!
//! A task takes a band of output lines. It writes the input lines under them into a map with the zeros around already in
//! it (here the input is also rectified or quantized), each value once; a window of output pixel (y, x) is then `kernel` runs
//! of neighbours in the map, and windows of neighbouring pixels lie `stride` pixels apart. The tile takes one pointer per
//! output pixel and line: no value is gathered once per tap, which for few channels cost a third of the time.

use crate::gemm::pack::MAX_MR;
use crate::gemm::tile::Windows;
use std::ops::Range;

/// Sizes of a convolution over one image.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Shape {
    /// Input height.
    pub h: usize,
    /// Input width.
    pub w: usize,
    /// Values of a pixel in the map.
    pub c: usize,
    /// Side of the square kernel.
    pub kernel: usize,
    /// Step between outputs.
    pub stride: usize,
    /// Zeros around the input.
    pub pad: usize,
    /// Output height.
    pub oh: usize,
    /// Output width.
    pub ow: usize,
}

/// Most output lines of a band: with a 3 x 3 kernel an eighth of the map's lines is then written twice.
const LINES: usize = 16;
/// Bands wanted, so that a few threads finish together.
const BANDS: usize = 4;
/// Tiles whose sums wait between two blocks of the window.
pub(crate) const TILES: usize = 8;

impl Shape {
    /// Values of a line of the map.
    pub(crate) fn line(&self) -> usize {
        (self.w + 2 * self.pad) * self.c
    }

    /// Lines of the map under `rows` output lines.
    pub(crate) fn lines(&self, rows: usize) -> usize {
        (rows - 1) * self.stride + self.kernel
    }

    /// Values of the map under `rows` output lines. Tiles with more rows than pixels left read on behind the last line.
    pub(crate) fn map(&self, rows: usize) -> usize {
        self.lines(rows) * self.line() + MAX_MR * self.stride * self.c
    }

    /// Output lines of a band: as many as fit `budget` values, from `fewest` to 16, in even shares. Depends on the shape alone.
    pub(crate) fn band(&self, budget: usize, fewest: usize) -> usize {
        if self.oh == 0 {
            return 0;
        }
        let fit = (budget / self.line().max(1)).saturating_sub(self.kernel) / self.stride + 1;
        let most = fit.min(LINES).min(self.oh.div_ceil(BANDS)).max(fewest.min(self.oh));
        self.oh.div_ceil(self.oh.div_ceil(most))
    }

    /// The input line of line `j` of the map of a band from output line `first` on, if it is inside the image.
    pub(crate) fn source(&self, first: usize, j: usize) -> Option<usize> {
        (first * self.stride + j).checked_sub(self.pad).filter(|y| *y < self.h)
    }
}

/// One block of steps of one tile.
pub(crate) struct Step {
    /// First value of the first window's block in the map.
    pub at: usize,
    /// Input of the window that it starts with.
    pub k: usize,
    /// Values of each line.
    pub run: usize,
    /// Where the windows lie.
    pub windows: Windows,
    /// Pixels.
    pub pixels: usize,
    /// The tile's number among those whose sums wait.
    pub tile: usize,
    /// Whether sums start here.
    pub start: bool,
    /// Set on the last block: the number of the first output pixel in the image.
    pub done: Option<usize>,
}

/// Goes over the output lines `rows` (the band's first is the map's first) in tiles of `mr` pixels, windows in blocks of up to
/// `block` inputs so that a block of the weights stays in the first-level cache.
pub(crate) fn sweep(shape: &Shape, rows: Range<usize>, mr: usize, block: usize, mut step: impl FnMut(Step)) {
    let (line, full) = (shape.line(), shape.kernel * shape.c);
    let lines = (block / full.max(1)).clamp(1, shape.kernel);
    // Whole quads.
    let run = full.min(block.max(4) & !3);
    for (j, oy) in rows.enumerate() {
        for from in (0..shape.ow).step_by(mr * TILES) {
            let to = shape.ow.min(from + mr * TILES);
            for l in (0..shape.kernel).step_by(lines) {
                let lines = lines.min(shape.kernel - l);
                for r in (0..full).step_by(run) {
                    let run = run.min(full - r);
                    let last = l + lines == shape.kernel && r + run == full;
                    for (tile, x) in (from..to).step_by(mr).enumerate() {
                        step(Step {
                            at: (j * shape.stride + l) * line + x * shape.stride * shape.c + r,
                            k: l * full + r,
                            run,
                            windows: Windows { lines, line, pixel: shape.stride * shape.c },
                            pixels: mr.min(to - x),
                            tile,
                            start: l == 0 && r == 0,
                            done: last.then_some(oy * shape.ow + x),
                        });
                    }
                }
            }
        }
    }
}
