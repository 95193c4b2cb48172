//! The tile: acc[r][n] += sum over k of a[k][r] * w[k][n], in order of k with fused multiply-adds.
//!
//! `w` is read in place from the panels. Rows of activations come in one of two ways: packed (`a` holds for each k the tile's rows
//! side by side), or as windows of a map, read in place. Sums live in memory as `[panel][row][16]` between calls, so blocking over k continues them and the
//! bits never depend on the blocking. Written once; every instruction set instantiates it.

use super::ahead::{Ahead, EARLY};
use super::{PanelData, WeightType};
use crate::prefetch::near_l1;
use crate::simd::{LANES, Simd, Vector};

/// Where the windows of a tile lie in a map, in values.
#[derive(Clone, Copy, Default)]
pub(crate) struct Windows {
    /// Lines of a window in this block.
    pub lines: usize,
    /// From one line of the map to the next.
    pub line: usize,
    /// From one window to the next.
    pub pixel: usize,
}

/// One step of a product.
pub(crate) struct Tile<'a> {
    /// Rows, one of the kernel's counts.
    pub rows: usize,
    /// Panels, up to the kernel's nr / 16.
    pub panels: usize,
    /// Steps (of each line, where rows are windows).
    pub k: usize,
    /// `[k][rows]`, or the map from the first window on.
    pub a: &'a [f32],
    /// First panel at its first step.
    pub w: PanelData<'a>,
    /// Values from one panel to the next.
    pub w_stride: usize,
    /// Whether sums start at zero; else at `acc`.
    pub start: bool,
    /// Row 0 of panel 0.
    pub acc: &'a mut [f32],
    /// Values from one panel's sums to the next.
    pub acc_stride: usize,
    /// What is asked for meanwhile.
    pub ahead: Ahead,
}

impl PanelData<'_> {
    pub(crate) fn weights(&self) -> WeightType {
        match self {
            PanelData::F32(_) => WeightType::F32,
            PanelData::F16(_) => WeightType::F16,
        }
    }
}

/// A weight as stored.
pub(crate) trait Weight: Copy {
    fn load<S: Simd>(s: S, x: &[Self; LANES]) -> S::V;
}

impl Weight for f32 {
    #[inline(always)]
    fn load<S: Simd>(s: S, x: &[f32; LANES]) -> S::V {
        s.load(x)
    }
}

impl Weight for u16 {
    #[inline(always)]
    fn load<S: Simd>(s: S, x: &[u16; LANES]) -> S::V {
        s.load_f16(x)
    }
}

/// Sums of a tile in registers, from zero or from where the last block left them.
#[inline(always)]
fn begin<S: Simd, const MR: usize, const NV: usize>(s: S, t: &Tile) -> [[S::V; NV]; MR] {
    let mut acc = [[s.splat(0.0); NV]; MR];
    if t.start {
        return acc;
    }
    for v in 0..NV {
        let sums = &t.acc[v * t.acc_stride..][..MR * LANES].as_chunks::<LANES>().0[..MR];
        for r in 0..MR {
            acc[r][v] = s.load(&sums[r]);
        }
    }
    acc
}

/// Sums of a tile to memory.
#[inline(always)]
fn end<V: Vector, const MR: usize, const NV: usize>(acc: [[V; NV]; MR], t: Tile) {
    for v in 0..NV {
        let sums = &mut t.acc[v * t.acc_stride..][..MR * LANES].as_chunks_mut::<LANES>().0[..MR];
        for r in 0..MR {
            acc[r][v].store(&mut sums[r]);
        }
    }
}

/// The tile of packed rows with `MR` rows and `NV` panels; all sums stay in registers.
#[inline(always)]
pub(crate) fn packed<S: Simd, W: Weight, const MR: usize, const NV: usize>(s: S, w: &[W], t: Tile, (): ()) {
    let k = t.k;
    let a = &t.a.as_chunks::<MR>().0[..k];
    let mut panels: [&[[W; LANES]]; NV] = [&[]; NV];
    for v in 0..NV {
        panels[v] = &w[v * t.w_stride..][..k * LANES].as_chunks::<LANES>().0[..k];
    }
    let mut acc = begin::<S, MR, NV>(s, &t);
    let mut asking = t.ahead.over::<NV>(MR, k);
    let mut done = 0;
    while done < k {
        let here = asking.next(S::AHEAD, done);
        for i in done..done + here {
            if S::AHEAD {
                near_l1(a.as_ptr().wrapping_add(i + EARLY));
                for v in 0..NV {
                    near_l1(panels[v].as_ptr().wrapping_add(i + EARLY));
                }
            }
            let mut wv = [s.splat(0.0); NV];
            for v in 0..NV {
                wv[v] = W::load(s, &panels[v][i]);
            }
            let row = &a[i];
            for r in 0..MR {
                let x = s.splat(row[r]);
                for v in 0..NV {
                    acc[r][v] = x.mul_add(wv[v], acc[r][v]);
                }
            }
        }
        done += here;
    }
    end(acc, t);
}

/// The tile whose rows are windows of a map, read in place: line after line of the window, each one run of neighbours.
#[inline(always)]
pub(crate) fn windows<S: Simd, W: Weight, const MR: usize, const NV: usize>(s: S, w: &[W], t: Tile, at: Windows) {
    let Windows { lines, line, pixel } = at;
    let run = t.k;
    let mut acc = begin::<S, MR, NV>(s, &t);
    for l in 0..lines {
        let mut rows: [&[f32]; MR] = [&[]; MR];
        for r in 0..MR {
            rows[r] = &t.a[l * line + r * pixel..][..run];
        }
        let mut panels: [&[[W; LANES]]; NV] = [&[]; NV];
        for v in 0..NV {
            panels[v] = &w[v * t.w_stride + l * run * LANES..][..run * LANES].as_chunks::<LANES>().0[..run];
        }
        // The outputs while the last line runs.
        let mut asking = t.ahead.over::<NV>(MR, run);
        let mut done = 0;
        while done < run {
            let here = asking.next(S::AHEAD && l + 1 == lines, done);
            for i in done..done + here {
                if S::AHEAD {
                    for v in 0..NV {
                        near_l1(panels[v].as_ptr().wrapping_add(i + EARLY));
                    }
                }
                let mut wv = [s.splat(0.0); NV];
                for v in 0..NV {
                    wv[v] = W::load(s, &panels[v][i]);
                }
                for r in 0..MR {
                    let x = s.splat(rows[r][i]);
                    for v in 0..NV {
                        acc[r][v] = x.mul_add(wv[v], acc[r][v]);
                    }
                }
            }
            done += here;
        }
    }
    end(acc, t);
}

/// `gemm_*` and `conv_*` with f32 and f16 weights of one instruction set: one body per row count and panel count.
macro_rules! gemm_entries {
    ($token:ident, rows $rows:tt, panels $panels:tt $(, $features:literal)?) => {
        crate::gemm::tile::gemm_entry!(gemm_f32, packed, (), F32, $token, $rows, $panels $(, $features)?);
        crate::gemm::tile::gemm_entry!(gemm_f16, packed, (), F16, $token, $rows, $panels $(, $features)?);
        crate::gemm::tile::gemm_entry!(conv_f32, windows, crate::gemm::tile::Windows, F32, $token, $rows, $panels $(, $features)?);
        crate::gemm::tile::gemm_entry!(conv_f16, windows, crate::gemm::tile::Windows, F16, $token, $rows, $panels $(, $features)?);
    };
}
pub(crate) use gemm_entries;

macro_rules! gemm_entry {
    (
        $name:ident, $body:ident, $places:ty, $weights:ident, $token:ident, $rows:tt, [$($panels:literal),*]
        $(, $features:literal)?
    ) => {
        /// Tile of the rows and weights in its name.
        $(#[target_feature(enable = $features)])?
        pub(crate) fn $name(t: crate::gemm::tile::Tile, at: $places) {
            let crate::gemm::PanelData::$weights(w) = t.w else { panic!(concat!(stringify!($name), " on other weights")) };
            match t.panels {
                $($panels => crate::gemm::tile::by_rows!($body, ($token::new(), w, t, at), $panels, t.rows, $rows),)*
                other => panic!("a tile of {other} panels"),
            }
        }
    };
}
pub(crate) use gemm_entry;

macro_rules! by_rows {
    ($body:ident, $arguments:tt, $panels:literal, $count:expr, [$($rows:literal),*]) => {
        match $count {
            $($rows => crate::gemm::tile::call!($body, $rows, $panels, $arguments),)*
            other => panic!("a tile of {other} rows"),
        }
    };
}
pub(crate) use by_rows;

macro_rules! call {
    ($body:ident, $rows:literal, $panels:literal, ($s:expr, $w:ident, $t:ident, $at:ident)) => {
        crate::gemm::tile::$body::<_, _, $rows, $panels>($s, $w, $t, $at)
    };
}
pub(crate) use call;
