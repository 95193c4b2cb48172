//! Resizing: bilinear feature maps, 8-bit images as Pillow does, and the encoder's position table.

use crate::cpu::Ctx;
use crate::mat::{Hwc, HwcMut};

/// Which points of the two grids coincide.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Corners {
    /// The centres of the corner pixels (PyTorch's align_corners true).
    Aligned,
    /// The outer edges of the images (align_corners false).
    Half,
}

/// Source of output `i` when n values become m: (left, right, weight of the right one).
pub(crate) fn source(i: usize, n: usize, m: usize, corners: Corners) -> (usize, usize, f32) {
    let at = match corners {
        Corners::Aligned if m > 1 => i as f32 * ((n - 1) as f32 / (m - 1) as f32),
        Corners::Aligned => 0.0,
        Corners::Half => ((i as f32 + 0.5) * (n as f32 / m as f32) - 0.5).max(0.0),
    };
    let left = (at as usize).min(n - 1);
    (left, (left + 1).min(n - 1), at - left as f32)
}

/// Bilinear resize of `x` to the size of `out` (same channels).
pub fn bilinear(_ctx: Ctx, x: Hwc, corners: Corners, out: HwcMut) {
    let y = crate::reference::bilinear(x, corners, out.h, out.w);
    out.data.copy_from_slice(&y);
}

/// Kernel of [`resample_u8`].
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Filter {
    /// Cubic with a = -0.5, support 2.
    Bicubic,
    /// Windowed sinc, support 3.
    Lanczos3,
    /// Triangle, support 1.
    Bilinear,
}

impl Filter {
    fn support(self) -> f64 {
        match self {
            Filter::Bicubic => 2.0,
            Filter::Lanczos3 => 3.0,
            Filter::Bilinear => 1.0,
        }
    }

    fn at(self, x: f64) -> f64 {
        let x = x.abs();
        match self {
            Filter::Bilinear if x < 1.0 => 1.0 - x,
            Filter::Bicubic if x < 1.0 => (1.5 * x - 2.5) * x * x + 1.0,
            Filter::Bicubic if x < 2.0 => -0.5 * (((x - 5.0) * x + 8.0) * x - 4.0),
            Filter::Lanczos3 if x < 3.0 => sinc(x) * sinc(x / 3.0),
            _ => 0.0,
        }
    }
}

/// sin(pi x) / (pi x).
fn sinc(x: f64) -> f64 {
    if x == 0.0 {
        return 1.0;
    }
    let a = x * std::f64::consts::PI;
    crate::trig::sin_cos(a).0 / a
}

/// Weights of one axis: for each output the first input and the weights of its run, which sum to 1.
///
/// Antialiased: the kernel widens by s = n/m when shrinking; runs are cut at the border and renormalised.
pub(crate) fn axis_weights(n: usize, m: usize, filter: Filter) -> Vec<(usize, Vec<f64>)> {
    let scale = n as f64 / m as f64;
    let stretch = scale.max(1.0);
    let support = filter.support() * stretch;
    (0..m)
        .map(|i| {
            let centre = (i as f64 + 0.5) * scale;
            let lo = (centre - support + 0.5).max(0.0) as usize;
            let hi = ((centre + support + 0.5) as usize).min(n);
            let w: Vec<f64> = (lo..hi).map(|j| filter.at((j as f64 - centre + 0.5) * (1.0 / stretch))).collect();
            let sum: f64 = w.iter().sum();
            (lo, if sum == 0.0 { w } else { w.iter().map(|v| v / sum).collect() })
        })
        .collect()
}

/// Fraction bits of the 8-bit resampler's coefficients.
const BITS: u32 = 22;

fn fixed(weights: &[(usize, Vec<f64>)]) -> Vec<(usize, Vec<i32>)> {
    let one = f64::from(1u32 << BITS);
    let round = |w: f64| if w < 0.0 { (w * one - 0.5) as i32 } else { (w * one + 0.5) as i32 };
    weights.iter().map(|(lo, w)| (*lo, w.iter().map(|&v| round(v)).collect())).collect()
}

/// Resizes an 8-bit RGB image `[h, w, 3]` to `dst` (w, h) with the bits of Pillow's 8-bit resize.
///
/// Coefficients are normalised in f64 and rounded to 22 fraction bits; the horizontal pass comes first;
/// each pass adds one half, shifts and clamps to 0..=255. A pass that keeps its size is skipped.
pub fn resample_u8(src: &[u8], size: (usize, usize), filter: Filter, dst: (usize, usize)) -> Vec<u8> {
    let ((w, h), (dw, dh)) = (size, dst);
    assert_eq!(src.len(), w * h * 3, "a {w} x {h} RGB image");
    assert!(w > 0 && h > 0 && dw > 0 && dh > 0, "resize of {w} x {h} to {dw} x {dh}");
    let store = |sum: i32| (sum >> BITS).clamp(0, 255) as u8;
    let across = if dw == w {
        src.to_vec()
    } else {
        let plan = fixed(&axis_weights(w, dw, filter));
        let mut out = Vec::with_capacity(h * dw * 3);
        for row in src.chunks_exact(w * 3) {
            for (lo, k) in &plan {
                let mut sum = [1i32 << (BITS - 1); 3];
                for (px, k) in row[lo * 3..].chunks_exact(3).zip(k) {
                    for c in 0..3 {
                        sum[c] += i32::from(px[c]) * k;
                    }
                }
                out.extend(sum.map(store));
            }
        }
        out
    };
    if dh == h {
        return across;
    }
    let line = dw * 3;
    let mut out = Vec::with_capacity(dh * line);
    let mut sums = vec![0i32; line];
    for (lo, k) in &fixed(&axis_weights(h, dh, filter)) {
        sums.fill(1 << (BITS - 1));
        for (row, k) in across[lo * line..].chunks_exact(line).zip(k) {
            for (s, v) in sums.iter_mut().zip(row) {
                *s += i32::from(*v) * k;
            }
        }
        out.extend(sums.iter().map(|&s| store(s)));
    }
    out
}

/// Resizes a position table `[grid * grid, c]` to `(rows, cols)` patches: separable antialiased cubic
/// (a = -0.5) with truncated, renormalised windows, weights and sums in f64, stored as f32. The table's own size
/// returns it bit for bit.
pub fn position_table(table: &[f32], grid: usize, c: usize, size: (usize, usize)) -> Vec<f32> {
    let (rows, cols) = size;
    assert_eq!(table.len(), grid * grid * c, "a table of {grid} x {grid} x {c}");
    if (rows, cols) == (grid, grid) {
        return table.to_vec();
    }
    let across = axis_weights(grid, cols, Filter::Bicubic);
    let down = axis_weights(grid, rows, Filter::Bicubic);
    // [grid, cols, c] in f64.
    let mut wide = vec![0.0f64; grid * cols * c];
    for y in 0..grid {
        for (x, (lo, w)) in across.iter().enumerate() {
            let out = &mut wide[(y * cols + x) * c..][..c];
            for (j, w) in w.iter().enumerate() {
                for (o, v) in out.iter_mut().zip(&table[(y * grid + lo + j) * c..][..c]) {
                    *o += w * f64::from(*v);
                }
            }
        }
    }
    let mut out = Vec::with_capacity(rows * cols * c);
    let mut sums = vec![0.0f64; cols * c];
    for (lo, w) in &down {
        sums.fill(0.0);
        for (j, w) in w.iter().enumerate() {
            for (s, v) in sums.iter_mut().zip(&wide[(lo + j) * cols * c..][..cols * c]) {
                *s += w * v;
            }
        }
        out.extend(sums.iter().map(|&s| s as f32));
    }
    out
}
