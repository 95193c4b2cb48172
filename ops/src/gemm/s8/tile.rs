//! The int8 tile: acc[r][n] += sum over k of a[r][k] * w[n][k], exact in i32.
//!
//! `w` is read in place from the panels. Rows of activations come in one of two ways: packed (for each four inputs the tile's
//! rows side by side), or as windows of a quantized map, read in place. Written once over [`Dot8`]; every instruction set
//! instantiates it. Sums are exact, so neither the order nor the blocking can show.

use super::pack::{PanelsS8, QUAD, STEP};
use crate::activation::{Gelu, Relu, gelu_lanes, relu_lanes};
use crate::gemm::Act;
use crate::gemm::pack::MAX_MR;
use crate::gemm::tile::Windows;
use crate::par::SharedMut;
use crate::prefetch::{near_for_writing, near_l1, near_l2};
use crate::simd::{LANES, Lanewise, Simd, Vector};

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
    /// Cache lines of them to ask for at a time.
    next_lines: usize,
    /// Whether there is anything to ask for.
    any: bool,
}

/// Most cache lines of the next weights to ask for at a time.
const NEXT_LINES: usize = 4;
/// Steps between asking for operands and their use: some 100 cycles, more than the second-level cache takes.
const EARLY: usize = 8;

impl Ahead {
    /// Nothing: points at operands that are near anyway.
    pub(crate) fn nothing<T>(near: &[T]) -> Ahead {
        Ahead {
            out: near.as_ptr().cast(),
            stride: 0,
            next: near.as_ptr().cast(),
            per_step: 0,
            next_lines: 0,
            any: false,
        }
    }

    /// With the outputs from `first` on, rows `stride` values apart.
    pub(crate) fn with_outputs(self, first: *const f32, stride: usize) -> Ahead {
        Ahead { out: first.cast(), stride: stride * size_of::<f32>(), any: true, ..self }
    }

    /// With the weights `next` that come after these, `per_step` bytes for each of `steps` steps of a tile of `lines` lines of outputs.
    pub(crate) fn with_weights(self, next: *const i8, per_step: usize, lines: usize, steps: usize) -> Ahead {
        let next_lines = (per_step * (steps / lines).max(1)).div_ceil(64).min(NEXT_LINES);
        Ahead { next: next.cast(), per_step, next_lines, any: true, ..self }
    }

    /// For a loop of `steps` steps of a tile of `rows` x `NV` panels.
    #[inline(always)]
    fn over<const NV: usize>(self, rows: usize, steps: usize) -> Asking<NV> {
        let each = (steps / (rows * NV)).max(1);
        Asking { ahead: self, each, step: each * self.per_step, line: 0, lines: rows * NV, steps }
    }
}

/// Asks for a line of outputs and a share of the next weights now and then.
struct Asking<const NV: usize> {
    ahead: Ahead,
    /// Steps between two lines.
    each: usize,
    /// Bytes of the next weights in so many.
    step: usize,
    line: usize,
    lines: usize,
    steps: usize,
}

impl<const NV: usize> Asking<NV> {
    /// Steps until the next line; those left if `ask` is false or no line is left.
    #[inline(always)]
    fn next(&mut self, ask: bool, done: usize) -> usize {
        let left = self.steps - done;
        if !ask || !self.ahead.any || self.line == self.lines {
            return left;
        }
        near_for_writing(self.ahead.out.wrapping_add(self.line % NV * (LANES * size_of::<f32>())));
        self.line += 1;
        if self.line.is_multiple_of(NV) {
            self.ahead.out = self.ahead.out.wrapping_add(self.ahead.stride);
        }
        for i in 0..self.ahead.next_lines {
            near_l2(self.ahead.next.wrapping_add(i * 64));
        }
        self.ahead.next = self.ahead.next.wrapping_add(self.step);
        self.each.min(left)
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
fn begin<D: Dot8, const MR: usize, const NV: usize>(d: D, pass: usize, t: &TileS8) -> [[D::Acc; NV]; MR] {
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
fn end<D: Dot8, const MR: usize, const NV: usize>(d: D, pass: usize, acc: &[[D::Acc; NV]; MR], t: &mut TileS8) {
    for v in 0..NV {
        let sums = &mut t.acc[v * t.acc_stride..][..MR * LANES].as_chunks_mut::<LANES>().0[..MR];
        for r in 0..MR {
            d.store(pass, acc[r][v], &mut sums[r]);
        }
    }
}

/// The tile of packed rows with `MR` rows and `NV` panels; all sums of a pass stay in registers.
#[inline(always)]
pub(crate) fn packed<D: Dot8, const MR: usize, const NV: usize>(d: D, mut t: TileS8, (): ()) {
    let steps = t.steps;
    let a: &[D::Elem] = bytemuck::cast_slice(t.a);
    let a = &a.as_chunks::<QUAD>().0.as_chunks::<MR>().0[..steps];
    for pass in 0..D::PASSES {
        let mut acc = begin::<D, MR, NV>(d, pass, &t);
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

/// `gemm_s8`, `conv_s8`, `column_s8` and `peak_s8` of one instruction set: one body per row count and panel count.
macro_rules! gemm_s8_entries {
    ($token:ident, rows $rows:tt, panels $panels:tt, full $mr:literal x $nv:literal $(, $features:literal)?) => {
        crate::gemm::s8::tile::s8_entry!(gemm_s8, packed, (), $token, $rows, $panels $(, $features)?);
        crate::gemm::s8::tile::s8_entry!(conv_s8, windows, crate::gemm::tile::Windows, $token, $rows, $panels $(, $features)?);
        crate::gemm::s8::tile::s8_column!($token, $rows, $panels, $mr $(, $features)?);

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

/// Rows of int8 activations to be packed for a tile: `out[step][r] = from[r][4 step..][..4] ^ flip`.
pub(crate) struct QuadPack<'a> {
    /// At least `4 * steps` values each; an empty row is zeros.
    pub from: [&'a [i8]; MAX_MR],
    /// Steps of four values.
    pub steps: usize,
    /// Rows of the tile.
    pub width: usize,
    /// 0x80808080 turns s8 into s8 + 128 as u8; 0 keeps.
    pub flip: u32,
    /// `[steps][width]`, four bytes each.
    pub out: &'a mut [u32],
}

/// Rows of int8 activations to be packed for a tile of 16-bit activations: `out[step][r] = from[r][4 step..][..4]`.
pub(crate) struct WidePack<'a> {
    /// At least `4 * steps` values each; an empty row is zeros.
    pub from: [&'a [i8]; MAX_MR],
    /// Steps of four values.
    pub steps: usize,
    /// Rows of the tile.
    pub width: usize,
    /// `[steps][width]`.
    pub out: &'a mut [[i16; QUAD]],
}

/// Packs rows of bytes.
#[inline(always)]
pub(crate) fn pack_quads<S: Simd>(s: S, t: QuadPack) {
    transposed(s, &t.from, (t.steps, t.width), t.out, t.flip);
}

/// Packs rows of bytes as 16-bit values.
#[inline(always)]
pub(crate) fn pack_wide<S: Simd>(s: S, t: WidePack) {
    transposed(s, &t.from, (t.steps, t.width), t.out, 0);
}

/// A packed quad. Functions, not closures: those lose the instruction set where they are not inlined.
trait Quad: Copy {
    /// Of sixteen quads of bytes.
    fn of(quads: &[f32; LANES], flip: u32) -> [Self; LANES];
}

impl Quad for u32 {
    #[inline(always)]
    fn of(quads: &[f32; LANES], flip: u32) -> [u32; LANES] {
        let mut out = [0; LANES];
        for i in 0..LANES {
            out[i] = quads[i].to_bits() ^ flip;
        }
        out
    }
}

impl Quad for [i16; QUAD] {
    #[inline(always)]
    fn of(quads: &[f32; LANES], _flip: u32) -> [[i16; QUAD]; LANES] {
        let bytes: &[[i8; QUAD]; LANES] = bytemuck::cast_ref(quads);
        let mut out = [[0; QUAD]; LANES];
        for i in 0..LANES {
            for j in 0..QUAD {
                out[i][j] = i16::from(bytes[i][j]);
            }
        }
        out
    }
}

/// Bytes of a row asked for before they are packed.
const ROW_AHEAD: usize = 4 * LANES * QUAD;

/// Rows to quads in blocks of 16 x 16, transposed in registers (a quad moves like the bits of one f32).
#[inline(always)]
fn transposed<S: Simd, Q: Quad>(
    s: S,
    from: &[&[i8]; MAX_MR],
    (steps, width): (usize, usize),
    out: &mut [Q],
    flip: u32,
) {
    let out = &mut out[..steps * width];
    let mut q0 = 0;
    while q0 < steps {
        let len = LANES.min(steps - q0);
        let mut block = [[0.0f32; LANES]; LANES];
        for r in 0..width.min(MAX_MR) {
            if from[r].is_empty() {
                continue;
            }
            let row = &from[r][q0 * QUAD..(q0 + len) * QUAD];
            // Rows are far apart: more streams than the hardware follows.
            near_l1(row.as_ptr().wrapping_add(ROW_AHEAD));
            // Sixteen at once as one copy of known size: of unknown size it is a call of the C library.
            match row.first_chunk::<{ LANES * QUAD }>() {
                Some(row) => block[r] = bytemuck::cast(*row),
                None => {
                    for (b, quad) in block[r].iter_mut().zip(row.as_chunks::<QUAD>().0) {
                        *b = f32::from_bits(u32::from_ne_bytes(quad.map(|v| v as u8)));
                    }
                }
            }
        }
        s.transpose(&mut block);
        for (i, lanes) in block[..len].iter().enumerate() {
            let at = (q0 + i) * width;
            let quads = Q::of(lanes, flip);
            // Sixteen at once where there is room: what runs over is written again by the next step.
            match out[at..].first_chunk_mut::<LANES>() {
                Some(to) => *to = quads,
                None => out[at..at + width].copy_from_slice(&quads[..width]),
            }
        }
        q0 += len;
    }
}

/// What is added to an output when it is stored.
#[derive(Clone, Copy)]
pub(crate) enum Plus<'a> {
    Nothing,
    /// What the output holds.
    Output,
    /// The value at the same place of another matrix of the output's shape.
    Other(&'a [f32]),
}

/// The epilogue of one tile of sums.
pub(crate) struct FinishS8<'a> {
    /// `[panel][row][16]`.
    pub acc: &'a [i32],
    /// Values from one panel's sums to the next.
    pub acc_stride: usize,
    /// Panels in use.
    pub panels: usize,
    /// Scale of each row in use.
    pub row_scales: &'a [f32],
    /// What is fixed per output.
    pub columns: &'a ColumnsS8,
    /// Activation.
    pub act: Act,
    /// Whether `columns.gamma` applies.
    pub gamma: bool,
    /// What is added.
    pub plus: Plus<'a>,
    /// Whether the output is rectified after that.
    pub relu_sum: bool,
    /// The whole output.
    pub out: &'a SharedMut<'a, f32>,
    /// Place of the tile's first value in it.
    pub at: usize,
    /// Values from one row to the next.
    pub stride: usize,
    /// Columns in use.
    pub cols: usize,
}

/// Per-output values of the panels of a tile, zeros beyond n.
#[derive(Clone, Copy, Default)]
pub(crate) struct ColumnsS8 {
    pub scales: [[f32; LANES]; MAX_NV],
    pub bias: [[f32; LANES]; MAX_NV],
    pub gamma: [[f32; LANES]; MAX_NV],
}

impl ColumnsS8 {
    /// Of `panels` panels from `panel` on; the bias repeats over the outputs with its length as period.
    pub(crate) fn of(
        w: PanelsS8,
        (panel, panels): (usize, usize),
        bias: Option<&[f32]>,
        gamma: Option<&[f32]>,
    ) -> ColumnsS8 {
        let mut columns = ColumnsS8::default();
        for v in 0..panels {
            let col = (panel + v) * LANES;
            let cols = LANES.min(w.n - col);
            columns.scales[v][..cols].copy_from_slice(&w.scales[col..col + cols]);
            if let Some(bias) = bias {
                for (i, b) in columns.bias[v][..cols].iter_mut().enumerate() {
                    *b = bias[(col + i) % bias.len()];
                }
            }
            if let Some(gamma) = gamma {
                columns.gamma[v][..cols].copy_from_slice(&gamma[col..col + cols]);
            }
        }
        columns
    }

    /// Without the first `panels` panels.
    pub(crate) fn from(&self, panels: usize) -> ColumnsS8 {
        let mut columns = *self;
        columns.scales.rotate_left(panels);
        columns.bias.rotate_left(panels);
        columns.gamma.rotate_left(panels);
        columns
    }
}

/// y = act(fma(acc, row scale * output scale, bias)) * gamma; out = out + y or y. Every step rounds once.
#[inline(always)]
pub(crate) fn finish<S: Simd>(s: S, t: FinishS8) {
    let whole = t.cols == t.panels * LANES && !t.gamma && !t.relu_sum && matches!(t.plus, Plus::Nothing);
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
struct Same;

impl Lanewise for Same {
    #[inline(always)]
    fn apply<S: Simd>(_: S, x: S::V) -> S::V {
        x
    }
}

/// Whole panels, activation `F`, nothing added.
#[inline(always)]
fn finish_whole<S: Simd, F: Lanewise, const NV: usize>(s: S, t: &FinishS8) {
    let rows = t.row_scales.len();
    let mut acc: [&[[i32; LANES]]; NV] = [&[]; NV];
    let mut scale = [s.splat(0.0); NV];
    let mut bias = [s.splat(0.0); NV];
    for v in 0..NV {
        acc[v] = &t.acc[v * t.acc_stride..].as_chunks::<LANES>().0[..rows];
        scale[v] = s.load(&t.columns.scales[v]);
        bias[v] = s.load(&t.columns.bias[v]);
    }
    for r in 0..rows {
        let at = t.at + r * t.stride;
        // SAFETY: every output belongs to one tile of one task, and a piece lives only in this loop.
        #[allow(unsafe_code)]
        let out = unsafe { t.out.slice(at..at + NV * LANES) };
        let out = &mut out.as_chunks_mut::<LANES>().0[..NV];
        let row = s.splat(t.row_scales[r]);
        for v in 0..NV {
            F::apply(s, s.load_i32(&acc[v][r]).mul_add(row * scale[v], bias[v])).store(&mut out[v]);
        }
    }
}

/// Any tile.
#[inline(always)]
fn finish_any<S: Simd>(s: S, t: &FinishS8) {
    let rows = t.row_scales.len();
    for p in 0..t.panels {
        let acc = &t.acc[p * t.acc_stride..][..rows * LANES].as_chunks::<LANES>().0[..rows];
        let scale = s.load(&t.columns.scales[p]);
        let bias = s.load(&t.columns.bias[p]);
        let gamma = s.load(&t.columns.gamma[p]);
        let cols = LANES.min(t.cols - p * LANES);
        for r in 0..rows {
            let mut y = s.load_i32(&acc[r]).mul_add(s.splat(t.row_scales[r]) * scale, bias);
            match t.act {
                Act::None => {}
                Act::Gelu => y = gelu_lanes(s, y),
                Act::Relu => y = relu_lanes(s, y),
            }
            if t.gamma {
                y = y * gamma;
            }
            let at = t.at + r * t.stride + p * LANES;
            // SAFETY: every output belongs to one tile of one task, and a piece lives only in this loop.
            #[allow(unsafe_code)]
            let out = unsafe { t.out.slice(at..at + cols) };
            let mut lanes = [0.0; LANES];
            match t.plus {
                Plus::Nothing => {}
                Plus::Output => y = load_some(s, out, &mut lanes) + y,
                Plus::Other(x) => y = load_some(s, &x[at..at + cols], &mut lanes) + y,
            }
            if t.relu_sum {
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
