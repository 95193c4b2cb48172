//! Resizing: bilinear feature maps, 8-bit images as Pillow does, and the encoder's position table.

use crate::cpu::Ctx;
use crate::mat::{Hwc, HwcMut};
use crate::opclock::{self, Op, Work};
use crate::simd::{LANES, Simd, Vector, padded};

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

/// One output line of a bilinear resize.
pub(crate) struct BilinearRow<'a> {
    /// Upper input line `[w, c]`.
    pub top: &'a [f32],
    /// Lower input line `[w, c]`.
    pub bottom: &'a [f32],
    /// Weight of the lower line.
    pub fy: f32,
    /// Channels.
    pub c: usize,
    /// Which points coincide.
    pub corners: Corners,
    /// Output line `[ow, c]`.
    pub out: &'a mut [f32],
}

/// One output line: t = a (1-fx) + b fx on both lines, then t (1-fy) + u fy; the second product of each is fused.
#[inline(always)]
pub(crate) fn bilinear_row<S: Simd>(s: S, row: BilinearRow) {
    let BilinearRow { top, bottom, fy, c, corners, out } = row;
    let (w, ow) = (top.len() / c, out.len() / c);
    let (y1, y0) = (s.splat(fy), s.splat(1.0 - fy));
    for (i, pixel) in out.chunks_exact_mut(c).enumerate() {
        let (left, right, fx) = source(i, w, ow, corners);
        let (x1, x0) = (s.splat(fx), s.splat(1.0 - fx));
        let mix = |a: S::V, b: S::V, e: S::V, f: S::V| {
            let t = b.mul_add(x1, a * x0);
            let u = f.mul_add(x1, e * x0);
            u.mul_add(y1, t * y0)
        };
        let (ab, at) = top[left * c..][..c].as_chunks::<LANES>();
        let (bb, bt) = top[right * c..][..c].as_chunks::<LANES>();
        let (eb, et) = bottom[left * c..][..c].as_chunks::<LANES>();
        let (fb, ft) = bottom[right * c..][..c].as_chunks::<LANES>();
        let (ob, ot) = pixel.as_chunks_mut::<LANES>();
        for ((((a, b), e), f), o) in ab.iter().zip(bb).zip(eb).zip(fb).zip(ob) {
            mix(s.load(a), s.load(b), s.load(e), s.load(f)).store(o);
        }
        if !at.is_empty() {
            let mut y = [0.0; LANES];
            let (a, b) = (s.load(&padded(at, 0.0)), s.load(&padded(bt, 0.0)));
            mix(a, b, s.load(&padded(et, 0.0)), s.load(&padded(ft, 0.0))).store(&mut y);
            ot.copy_from_slice(&y[..ot.len()]);
        }
    }
}

/// Bilinear resize of `x` to the size of `out` (same channels).
pub fn bilinear(ctx: Ctx, x: Hwc, corners: Corners, out: HwcMut) {
    let c = x.c;
    assert_eq!(out.c, c, "channels of a resize");
    let (oh, line) = (out.h, out.w * c);
    if oh * line == 0 {
        return;
    }
    assert!(x.h > 0 && x.w > 0, "resize of an empty {} x {} image", x.h, x.w);
    let _span = opclock::span(Op::Resize, || Work::values((x.h * x.w * c + oh * line) / 2));
    ctx.pool.chunks(out.data, line, &|oy, piece, _| {
        let (y0, y1, fy) = source(oy, x.h, oh, corners);
        let at = |y: usize| &x.data[y * x.w * c..][..x.w * c];
        ctx.kernels.bilinear(BilinearRow { top: at(y0), bottom: at(y1), fy, c, corners, out: piece });
    });
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
