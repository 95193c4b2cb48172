//! The int8 tile: acc[r][n] += sum over k of a[r][k] * w[n][k], exact in i32.
//!
//! `w` is read in place from the panels. Rows of activations come in one of two ways: packed (for each four inputs the tile's
//! rows side by side, `rows.rs`), or as windows of a quantized map, read in place. Written once over [`Dot8`]; every instruction set
//! instantiates it. Sums are exact, so neither the order nor the blocking can show.

use super::pack::{QUAD, STEP};
use crate::gemm::ahead::{Ahead, EARLY};
use crate::gemm::tile::Windows;
use crate::prefetch::near_l1;
use crate::simd::LANES;

/// Panels of the widest kernel.
pub(crate) const MAX_NV: usize = 2;

/// An activation in memory.
pub(crate) trait Elem: bytemuck::Pod + Default {}
impl Elem for i8 {}
impl Elem for i16 {}

/// Token of an instruction set's dot product of four inputs over sixteen outputs.
pub(crate) trait Dot8: Copy {
    /// An activation in memory.
    type Elem: Elem;
    /// Four weights of the outputs of one pass.
    type W: Copy;
    /// One row's four activations, in every output.
    type A: Copy;
    /// The i32 sums of the outputs of one pass.
    type Acc: Copy;
    /// Passes over a panel: 1, or 2 of eight outputs each where sixteen would need too many registers.
    const PASSES: usize = 1;
    /// Sums of zero.
    fn zero(self) -> Self::Acc;
    /// Sums of a pass from memory.
    fn load(self, pass: usize, x: &[i32; LANES]) -> Self::Acc;
    /// Sums of a pass to memory.
    fn store(self, pass: usize, acc: Self::Acc, x: &mut [i32; LANES]);
    /// One step of a panel, the outputs of a pass.
    fn load_w(self, pass: usize, x: &[i8; STEP]) -> Self::W;
    /// One row's activations, in the form that the instruction wants.
    fn prep_a(self, quad: &[Self::Elem; QUAD]) -> Self::A;
    /// acc + the four products of each output.
    fn dot(self, acc: Self::Acc, a: Self::A, w: Self::W) -> Self::Acc;
    /// Whether the tile asks for memory ahead of its use; pays where dot products outrun the caches.
    const AHEAD: bool = false;
    /// One step of the whole tile. An instruction set that takes several rows from one register has its own.
    #[inline(always)]
    fn step<const MR: usize, const NV: usize>(
        self,
        acc: &mut [[Self::Acc; NV]; MR],
        rows: &[[Self::Elem; QUAD]; MR],
        w: &[Self::W; NV],
    ) {
        for r in 0..MR {
            let a = self.prep_a(&rows[r]);
            for v in 0..NV {
                acc[r][v] = self.dot(acc[r][v], a, w[v]);
            }
        }
    }
    /// The same with rows apart in memory. Each is loaded where it is used: sixteen broadcasts loaded first push sums out of registers.
    #[inline(always)]
    fn step_apart<const MR: usize, const NV: usize>(
        self,
        acc: &mut [[Self::Acc; NV]; MR],
        rows: &[&[Self::Elem; QUAD]; MR],
        w: &[Self::W; NV],
    ) {
        for r in 0..MR {
            let a = self.prep_a(rows[r]);
            for v in 0..NV {
                acc[r][v] = self.dot(acc[r][v], a, w[v]);
            }
        }
    }
}

/// One block of steps of a tile.
pub(crate) struct TileS8<'a> {
    /// Rows, one of the kernel's counts.
    pub rows: usize,
    /// Panels, up to the kernel's nr / 16.
    pub panels: usize,
    /// Steps of four inputs (of each line, where rows are windows).
    pub steps: usize,
    /// `[step][rows][4]`, or the map from the first window on: the bytes of the kernel's values.
    pub a: &'a [i8],
    /// First panel at its first step.
    pub w: &'a [i8],
    /// Bytes from one panel to the next.
    pub w_stride: usize,
    /// Where every row's sums start, per panel; none continues `acc`.
    pub start: Option<&'a [[i32; LANES]; MAX_NV]>,
    /// Row 0 of panel 0, `[panel][row][16]`.
    pub acc: &'a mut [i32],
    /// Values from one panel's sums to the next.
    pub acc_stride: usize,
    /// What is asked for meanwhile.
    pub ahead: Ahead,
}

/// Tiles below one another: one call for all packed rows that share some panels.
pub(crate) struct ColumnS8<'a> {
    /// Rows.
    pub rows: usize,
    /// Panels, up to the kernel's nr / 16.
    pub panels: usize,
    /// Steps of four inputs.
    pub steps: usize,
    /// Full tiles and a last one of fewer rows, each `[step][rows of the tile][4]`: the bytes of the kernel's values.
    pub a: &'a [i8],
    /// First panel at its first step.
    pub w: &'a [i8],
    /// Bytes from one panel to the next.
    pub w_stride: usize,
    /// Where every row's sums start, per panel.
    pub start: &'a [[i32; LANES]; MAX_NV],
    /// `[panel][row][16]`.
    pub acc: &'a mut [i32],
    /// Values from one panel's sums to the next.
    pub acc_stride: usize,
}

impl ColumnS8<'_> {
    /// The tile of so many rows from a row on, values of so many bytes.
    #[inline(always)]
    pub(crate) fn tile(&mut self, first: usize, rows: usize, bytes: usize) -> TileS8<'_> {
        let row = self.steps * QUAD * bytes;
        TileS8 {
            rows,
            panels: self.panels,
            steps: self.steps,
            a: &self.a[first * row..][..rows * row],
            w: self.w,
            w_stride: self.w_stride,
            start: Some(self.start),
            acc: &mut self.acc[first * LANES..],
            acc_stride: self.acc_stride,
            ahead: Ahead::nothing(self.a),
        }
    }
}

/// Sums of a tile in registers: from `start`, or from where the last block left them.
#[inline(always)]
pub(super) fn begin<D: Dot8, const MR: usize, const NV: usize>(d: D, pass: usize, t: &TileS8) -> [[D::Acc; NV]; MR] {
    let mut acc = [[d.zero(); NV]; MR];
    for v in 0..NV {
        let sums = &t.acc[v * t.acc_stride..][..MR * LANES].as_chunks::<LANES>().0[..MR];
        for r in 0..MR {
            acc[r][v] = d.load(pass, t.start.map_or(&sums[r], |start| &start[v]));
        }
    }
    acc
}

/// Sums of a tile to memory.
#[inline(always)]
pub(super) fn end<D: Dot8, const MR: usize, const NV: usize>(
    d: D,
    pass: usize,
    acc: &[[D::Acc; NV]; MR],
    t: &mut TileS8,
) {
    for v in 0..NV {
        let sums = &mut t.acc[v * t.acc_stride..][..MR * LANES].as_chunks_mut::<LANES>().0[..MR];
        for r in 0..MR {
            d.store(pass, acc[r][v], &mut sums[r]);
        }
    }
}

/// The sums of a pass and on top the products of packed rows; by value, or they would pass through the stack.
#[inline(always)]
pub(super) fn multiply<D: Dot8, const MR: usize, const NV: usize>(
    d: D,
    pass: usize,
    t: &TileS8,
    mut acc: [[D::Acc; NV]; MR],
) -> [[D::Acc; NV]; MR] {
    let steps = t.steps;
    let a: &[D::Elem] = bytemuck::cast_slice(t.a);
    let a = &a.as_chunks::<QUAD>().0.as_chunks::<MR>().0[..steps];
    let mut panels: [&[[i8; STEP]]; NV] = [&[]; NV];
    for v in 0..NV {
        panels[v] = &t.w[v * t.w_stride..].as_chunks::<STEP>().0[..steps];
    }
    let mut asking = t.ahead.over::<NV>(MR, steps);
    let mut done = 0;
    while done < steps {
        let here = asking.next(D::AHEAD, done);
        let a = &a[done..][..here];
        let mut now: [&[[i8; STEP]]; NV] = [&[]; NV];
        for v in 0..NV {
            now[v] = &panels[v][done..][..here];
        }
        for i in 0..here {
            if D::AHEAD {
                near_l1(a.as_ptr().wrapping_add(i + EARLY));
                for v in 0..NV {
                    near_l1(now[v].as_ptr().wrapping_add(i + EARLY));
                }
            }
            let mut w = [d.load_w(pass, &now[0][i]); NV];
            for v in 1..NV {
                w[v] = d.load_w(pass, &now[v][i]);
            }
            d.step(&mut acc, &a[i], &w);
        }
        done += here;
    }
    acc
}

/// The tile of packed rows with `MR` rows and `NV` panels.
#[inline(always)]
pub(crate) fn packed<D: Dot8, const MR: usize, const NV: usize>(d: D, mut t: TileS8, (): ()) {
    for pass in 0..D::PASSES {
        let acc = multiply(d, pass, &t, begin::<D, MR, NV>(d, pass, &t));
        end(d, pass, &acc, &mut t);
    }
}

/// The tile whose rows are windows of a map, read in place: line after line of the window, each one run of neighbours.
#[inline(always)]
pub(crate) fn windows<D: Dot8, const MR: usize, const NV: usize>(d: D, mut t: TileS8, at: Windows) {
    let Windows { lines, line, pixel } = at;
    let run = t.steps;
    let a: &[D::Elem] = bytemuck::cast_slice(t.a);
    for pass in 0..D::PASSES {
        let mut acc = begin::<D, MR, NV>(d, pass, &t);
        for l in 0..lines {
            let mut rows: [&[[D::Elem; QUAD]]; MR] = [&[]; MR];
            for r in 0..MR {
                rows[r] = &a[l * line + r * pixel..].as_chunks::<QUAD>().0[..run];
            }
            let mut panels: [&[[i8; STEP]]; NV] = [&[]; NV];
            for v in 0..NV {
                panels[v] = &t.w[v * t.w_stride + l * run * STEP..].as_chunks::<STEP>().0[..run];
            }
            // The outputs while the last line runs.
            let mut asking = t.ahead.over::<NV>(MR, run);
            let mut done = 0;
            while done < run {
                let here = asking.next(D::AHEAD && l + 1 == lines, done);
                for i in done..done + here {
                    if D::AHEAD {
                        for v in 0..NV {
                            near_l1(panels[v].as_ptr().wrapping_add(i + EARLY));
                        }
                    }
                    let mut w = [d.load_w(pass, &panels[0][i]); NV];
                    for v in 1..NV {
                        w[v] = d.load_w(pass, &panels[v][i]);
                    }
                    let mut quads = [&rows[0][i]; MR];
                    for r in 1..MR {
                        quads[r] = &rows[r][i];
                    }
                    d.step_apart(&mut acc, &quads, &w);
                }
                done += here;
            }
        }
        end(d, pass, &acc, &mut t);
    }
}

/// Steps of the peak probe between two looks at the clock.
pub(crate) const PEAK_STEPS: usize = 1 << 12;
/// The full tile on operands in the first-level cache. Both are read anew at each step, so that no part of a composed dot
/// product leaves the loop.
#[inline(always)]
pub(crate) fn peak_body<D: Dot8, const MR: usize, const NV: usize>(d: D, seed: i32) -> i32 {
    let mut sums = [[[seed; LANES]; NV]; MR];
    let mut weights = [[1i8; STEP]; NV];
    for v in 0..NV {
        weights[v] = [(v as i8) + (seed as i8 | 1); STEP];
        for r in 0..MR {
            sums[r][v][0] = (r * NV + v) as i32;
        }
    }
    let rows = [[D::Elem::default(); QUAD]; MR];
    for pass in 0..D::PASSES {
        let mut acc = [[d.zero(); NV]; MR];
        for r in 0..MR {
            for v in 0..NV {
                acc[r][v] = d.load(pass, &sums[r][v]);
            }
        }
        for _ in 0..PEAK_STEPS {
            let weights = std::hint::black_box(&weights);
            let mut w = [d.load_w(pass, &weights[0]); NV];
            for v in 1..NV {
                w[v] = d.load_w(pass, &weights[v]);
            }
            d.step(&mut acc, std::hint::black_box(&rows), &w);
        }
        for r in 0..MR {
            for v in 0..NV {
                d.store(pass, acc[r][v], &mut sums[r][v]);
            }
        }
    }
    sums.as_flattened().as_flattened().iter().fold(0, |x, y| x ^ y)
}

/// `gemm_s8`, `conv_s8`, `column_s8`, `product_s8` and `peak_s8` of one instruction set: one body per row count and panel count.
/// The second name is the token of its vectors.
macro_rules! gemm_s8_entries {
    ($token:ident, $vector:path, rows $rows:tt, panels $panels:tt, full $mr:literal x $nv:literal $(, $features:literal)?) => {
        crate::gemm::s8::tile::s8_entry!(gemm_s8, packed, (), $token, $rows, $panels $(, $features)?);
        crate::gemm::s8::tile::s8_entry!(conv_s8, windows, crate::gemm::tile::Windows, $token, $rows, $panels $(, $features)?);
        crate::gemm::s8::tile::s8_column!($token, $rows, $panels, $mr $(, $features)?);
        crate::gemm::s8::product::s8_product!($token, $vector, $panels, $mr $(, $features)?);

        /// Peak probe.
        $(#[target_feature(enable = $features)])?
        pub(crate) fn peak_s8(seed: i32) -> i32 {
            crate::gemm::s8::tile::peak_body::<_, $mr, $nv>($token::new(), seed)
        }
    };
}
pub(crate) use gemm_s8_entries;

macro_rules! s8_entry {
    ($name:ident, $body:ident, $places:ty, $token:ident, $rows:tt, [$($panels:literal),*] $(, $features:literal)?) => {
        /// Tile of the rows in its name.
        $(#[target_feature(enable = $features)])?
        pub(crate) fn $name(t: crate::gemm::s8::tile::TileS8, at: $places) {
            match t.panels {
                $($panels => crate::gemm::s8::tile::s8_by_rows!($body, ($token::new(), t, at), $panels, t.rows, $rows),)*
                other => panic!("a tile of {other} panels"),
            }
        }
    };
}
pub(crate) use s8_entry;

macro_rules! s8_column {
    ($token:ident, $rows:tt, [$($panels:literal),*], $mr:literal $(, $features:literal)?) => {
        /// Tiles of packed rows below one another.
        $(#[target_feature(enable = $features)])?
        pub(crate) fn column_s8(mut t: crate::gemm::s8::tile::ColumnS8) {
            let bytes = size_of::<<$token as crate::gemm::s8::tile::Dot8>::Elem>();
            let full = t.rows - t.rows % $mr;
            match t.panels {
                $($panels => {
                    for first in (0..full).step_by($mr) {
                        let tile = t.tile(first, $mr, bytes);
                        crate::gemm::s8::tile::packed::<_, $mr, $panels>($token::new(), tile, ());
                    }
                })*
                other => panic!("tiles of {other} panels"),
            }
            if full < t.rows {
                let left = t.rows - full;
                let rows = *$rows.iter().find(|r| **r >= left).expect("at most the full rows");
                gemm_s8(t.tile(full, rows, bytes), ());
            }
        }
    };
}
pub(crate) use s8_column;

macro_rules! s8_by_rows {
    ($body:ident, $arguments:tt, $panels:literal, $count:expr, [$($rows:literal),*]) => {
        match $count {
            $($rows => crate::gemm::s8::tile::s8_call!($body, $rows, $panels, $arguments),)*
            other => panic!("a tile of {other} rows"),
        }
    };
}
pub(crate) use s8_by_rows;

macro_rules! s8_call {
    ($body:ident, $rows:literal, $panels:literal, ($d:expr, $t:ident, $at:ident)) => {
        crate::gemm::s8::tile::$body::<_, $rows, $panels>($d, $t, $at)
    };
}
pub(crate) use s8_call;
