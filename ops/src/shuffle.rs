//! The pixel shuffle: channels of a patch to its pixels.
//!
//! A patch of p x p pixels and c channels lies channel by channel, its pixels are wanted pixel by pixel: a transposition. Sixteen channels
//! by sixteen pixels go through registers at a time; two by two pixels of up to sixteen channels are four vectors of one load.

use crate::cpu::Ctx;
use crate::mat::{Hwc, HwcMut, Mat};
use crate::opclock::{self, Op, Work};
use crate::simd::{Body, LANES, Simd, Vector};

/// Column `ch * p * p + dy * p + dx` of patch (y, x) fills pixel (y p + dy, x p + dx) of channel ch:
/// `x` `[ph * pw, c * p * p]` -> `out` `[ph * p, pw * p, c]`.
pub fn pixel_shuffle(ctx: Ctx, x: Mat, grid: (usize, usize), p: usize, out: HwcMut) {
    let nothing = Hwc::new(&[], out.h, out.w, 0);
    pixel_shuffle_beside(ctx, x, grid, p, nothing, out);
}

/// [`pixel_shuffle`] of `x` `[ph * pw, c * p * p]` to the first c channels of every pixel, those of `beside`
/// `[ph * p, pw * p, g]` after them: `out` `[ph * p, pw * p, c + g]`.
pub fn pixel_shuffle_beside(ctx: Ctx, x: Mat, grid: (usize, usize), p: usize, beside: Hwc, out: HwcMut) {
    let (ph, pw) = grid;
    let (all, g) = (out.c, beside.c);
    let c = all.checked_sub(g).unwrap_or_else(|| panic!("{g} channels beside others do not fit {all}"));
    assert_eq!((beside.h, beside.w), (out.h, out.w), "size of what stands beside");
    assert_eq!((x.rows, x.cols), (ph * pw, c * p * p), "{ph} x {pw} patches of {p} x {p} x {c}");
    assert_eq!((out.h, out.w), (ph * p, pw * p), "shuffled size");
    let (line, width) = (out.w * all, out.w);
    if line == 0 {
        return;
    }
    let _span = opclock::span(Op::Resize, || Work::values(out.data.len()));
    // One task per line of patches: p output lines.
    ctx.pool.chunks(out.data, p * line, &|py, piece, _| {
        let beside = &beside.data[py * p * width * g..][..p * width * g];
        ctx.kernels.enter(Lines { x, first: py * pw, pw, p, channels: (c, g), beside, out: piece });
    });
}

/// One line of patches.
struct Lines<'a> {
    x: Mat<'a>,
    /// Row of the first patch.
    first: usize,
    /// Patches.
    pw: usize,
    /// Pixels of a side of a patch.
    p: usize,
    /// Channels of the patches, and beside them.
    channels: (usize, usize),
    /// `[p, pw * p, g]`.
    beside: &'a [f32],
    /// `[p, pw * p, c + g]`.
    out: &'a mut [f32],
}

impl Body for Lines<'_> {
    type Output = ();

    #[inline(always)]
    fn run<S: Simd>(self, s: S) {
        let Lines { x, first, pw, p, channels: (c, g), beside, out } = self;
        let all = c + g;
        for px in 0..pw {
            let row = x.row(first + px);
            match p {
                2 if c <= LANES => quads(s, &x.data[(first + px) * x.stride..], out, (pw * p, px), (c, all)),
                // The side as a constant: divisions by it are many.
                7 => patch(s, row, out, (pw, px), (7, c, all)),
                14 => patch(s, row, out, (pw, px), (14, c, all)),
                _ => patch(s, row, out, (pw, px), (p, c, all)),
            }
        }
        if g == 0 {
            return;
        }
        for (pixel, others) in out.chunks_exact_mut(all).zip(beside.chunks_exact(g)) {
            match (pixel[c..].as_chunks_mut::<8>(), others.as_chunks::<8>()) {
                // Whole runs of eight, without a call.
                ((to, []), (from, [])) => to.iter_mut().zip(from).for_each(|(to, from)| *to = *from),
                _ => pixel[c..].copy_from_slice(others),
            }
        }
    }
}

/// Two by two pixels of up to sixteen channels: each channel is four values side by side, one for each pixel. `row` is the patch and what
/// follows it in memory.
#[inline(always)]
fn quads<S: Simd>(s: S, row: &[f32], out: &mut [f32], (width, px): (usize, usize), (c, all): (usize, usize)) {
    let pixels = match row.as_chunks::<4>().0.first_chunk::<LANES>() {
        Some(channels) => s.load4(channels),
        None => {
            let mut channels = [[0.0f32; 4]; LANES];
            channels[..c].as_flattened_mut().copy_from_slice(&row[..4 * c]);
            s.load4(&channels)
        }
    };
    for (i, v) in pixels.into_iter().enumerate() {
        let line = &mut out[i / 2 * width * all..][..width * all];
        let pixel = &mut line[(2 * px + i % 2) * all..];
        // Sixteen at once where there is room: what runs over is written again by the next pixel, or by what stands beside.
        match pixel.first_chunk_mut::<LANES>() {
            Some(pixel) => v.store(pixel),
            None => {
                let mut lanes = [0.0; LANES];
                v.store(&mut lanes);
                pixel[..c].copy_from_slice(&lanes[..c]);
            }
        }
    }
}

/// One patch: sixteen channels by sixteen pixels at a time, or value by value where there are fewer of either.
#[inline(always)]
fn patch<S: Simd>(s: S, row: &[f32], out: &mut [f32], (pw, px): (usize, usize), (p, c, all): (usize, usize, usize)) {
    let pixels = p * p;
    let at = |q: usize| ((q / p) * pw * p + px * p + q % p) * all;
    if pixels < LANES || c < LANES {
        for (i, &v) in row.iter().enumerate() {
            out[at(i % pixels) + i / pixels] = v;
        }
        return;
    }
    for b in 0..c.div_ceil(LANES) {
        // The last sixteen channels overlap those before, as the last sixteen pixels do.
        let c0 = (b * LANES).min(c - LANES);
        let mut q0 = 0;
        while q0 < pixels {
            let first = q0.min(pixels - LANES);
            let mut block = [[0.0f32; LANES]; LANES];
            for (i, to) in block.iter_mut().enumerate() {
                *to = *row[(c0 + i) * pixels + first..].first_chunk().expect("sixteen pixels of a channel");
            }
            s.transpose(&mut block);
            for (i, from) in block.iter().enumerate().skip(q0 - first) {
                *out[at(first + i) + c0..].first_chunk_mut().expect("sixteen channels of a pixel") = *from;
            }
            q0 = first + LANES;
        }
    }
}
