//! The int8 tile: acc[r][n] += sum over k of a[r][k] * w[n][k], exact in i32.
//!
//! Operands are packed: `a` holds for each four inputs the tile's rows, four bytes each; `w` is read in place from the
//! panels. Written once over [`Dot8`]; every instruction set instantiates it. Sums are exact, so neither the order nor
//! the blocking can show.

use super::pack::{QUAD, STEP};
use crate::activation::{gelu_lanes, relu_lanes};
use crate::gemm::Act;
use crate::gemm::pack::MAX_MR;
use crate::par::SharedMut;
use crate::simd::{LANES, Simd, Vector};

/// Panels of the widest kernel.
pub(crate) const MAX_NV: usize = 2;

/// Token of an instruction set's byte dot product over sixteen outputs.
pub(crate) trait Dot8: Copy {
    /// Sixteen outputs of four weights.
    type W: Copy;
    /// One row's four activations, in every output.
    type A: Copy;
    /// Sixteen i32 sums.
    type Acc: Copy;
    /// Sums of zero.
    fn zero(self) -> Self::Acc;
    /// Sums from memory.
    fn load(self, x: &[i32; LANES]) -> Self::Acc;
    /// Sums to memory.
    fn store(self, acc: Self::Acc, x: &mut [i32; LANES]);
    /// One step of a panel.
    fn load_w(self, x: &[i8; STEP]) -> Self::W;
    /// One row's activations, in the form that the instruction wants.
    fn prep_a(self, quad: &[i8; QUAD]) -> Self::A;
    /// acc + the four products of each output.
    fn dot(self, acc: Self::Acc, a: Self::A, w: Self::W) -> Self::Acc;
    /// One step of the whole tile. An instruction set that takes several rows from one register has its own.
    #[inline(always)]
    fn step<const MR: usize, const NV: usize>(
        self,
        acc: &mut [[Self::Acc; NV]; MR],
        rows: &[[i8; QUAD]; MR],
        w: &[Self::W; NV],
    ) {
        for r in 0..MR {
            let a = self.prep_a(&rows[r]);
            for v in 0..NV {
                acc[r][v] = self.dot(acc[r][v], a, w[v]);
            }
        }
    }
}

/// One step of a product.
pub(crate) struct TileS8<'a> {
    /// Rows, one of the kernel's counts.
    pub rows: usize,
    /// Panels, up to the kernel's nr / 16.
    pub panels: usize,
    /// Steps of four inputs.
    pub steps: usize,
    /// `[step][rows][4]`.
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
}

/// The tile with `MR` rows and `NV` panels; all sums stay in registers.
#[inline(always)]
pub(crate) fn body<D: Dot8, const MR: usize, const NV: usize>(d: D, t: TileS8) {
    let steps = t.steps;
    let a = &t.a.as_chunks::<QUAD>().0.as_chunks::<MR>().0[..steps];
    let mut panels: [&[[i8; STEP]]; NV] = [&[]; NV];
    let mut acc = [[d.zero(); NV]; MR];
    for v in 0..NV {
        panels[v] = &t.w[v * t.w_stride..].as_chunks::<STEP>().0[..steps];
        let sums = &t.acc[v * t.acc_stride..][..MR * LANES].as_chunks::<LANES>().0[..MR];
        for r in 0..MR {
            acc[r][v] = d.load(t.start.map_or(&sums[r], |start| &start[v]));
        }
    }
    for i in 0..steps {
        let mut w = [d.load_w(&panels[0][i]); NV];
        for v in 1..NV {
            w[v] = d.load_w(&panels[v][i]);
        }
        d.step(&mut acc, &a[i], &w);
    }
    for v in 0..NV {
        let sums = &mut t.acc[v * t.acc_stride..][..MR * LANES].as_chunks_mut::<LANES>().0[..MR];
        for r in 0..MR {
            d.store(acc[r][v], &mut sums[r]);
        }
    }
}

/// Steps of the peak probe between two looks at the clock.
pub(crate) const PEAK_STEPS: usize = 1 << 12;
/// The full tile with weights that stay in registers. Activations are read anew at each step, so that no part of a
/// composed dot product leaves the loop.
#[inline(always)]
pub(crate) fn peak_body<D: Dot8, const MR: usize, const NV: usize>(d: D, seed: i32) -> i32 {
    let mut sums = [[[seed; LANES]; NV]; MR];
    let mut acc = [[d.zero(); NV]; MR];
    let mut w = [d.load_w(&[1; STEP]); NV];
    for v in 0..NV {
        w[v] = d.load_w(&[(v as i8) + (seed as i8 | 1); STEP]);
        for r in 0..MR {
            sums[r][v][0] = (r * NV + v) as i32;
            acc[r][v] = d.load(&sums[r][v]);
        }
    }
    let mut rows = [[1i8, 2, 3, 4]; MR];
    for (r, quad) in rows.iter_mut().enumerate() {
        quad[0] = r as i8;
    }
    for _ in 0..PEAK_STEPS {
        d.step(&mut acc, std::hint::black_box(&rows), &w);
    }
    for r in 0..MR {
        for v in 0..NV {
            d.store(acc[r][v], &mut sums[r][v]);
        }
    }
    sums.as_flattened().as_flattened().iter().fold(0, |x, y| x ^ y)
}

/// `gemm_s8` and `peak_s8` of one instruction set: one body per row count and panel count.
macro_rules! gemm_s8_entries {
    ($token:ident, rows $rows:tt, panels [$($panels:literal),*], full $mr:literal x $nv:literal $(, $features:literal)?) => {
        /// Tile.
        $(#[target_feature(enable = $features)])?
        pub(crate) fn gemm_s8(t: crate::gemm::s8::tile::TileS8) {
            match t.panels {
                $($panels => crate::gemm::s8::tile::s8_by_rows!($token, t, $panels, $rows),)*
                other => panic!("a tile of {other} panels"),
            }
        }

        /// Peak probe.
        $(#[target_feature(enable = $features)])?
        pub(crate) fn peak_s8(seed: i32) -> i32 {
            crate::gemm::s8::tile::peak_body::<_, $mr, $nv>($token::new(), seed)
        }
    };
}
pub(crate) use gemm_s8_entries;

macro_rules! s8_by_rows {
    ($token:ident, $t:ident, $panels:literal, [$($rows:literal),*]) => {
        match $t.rows {
            $($rows => crate::gemm::s8::tile::body::<_, $rows, $panels>($token::new(), $t),)*
            other => panic!("a tile of {other} rows"),
        }
    };
}
pub(crate) use s8_by_rows;

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

/// Packs rows in blocks of 16 x 16 quads, transposed in registers (a quad moves like the bits of one f32).
#[inline(always)]
pub(crate) fn pack_quads<S: Simd>(s: S, t: QuadPack) {
    let QuadPack { from, steps, width, flip, out } = t;
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
            for (b, quad) in block[r].iter_mut().zip(row.as_chunks::<QUAD>().0) {
                *b = f32::from_bits(u32::from_ne_bytes(quad.map(|v| v as u8)) ^ flip);
            }
        }
        s.transpose(&mut block);
        for (i, lanes) in block[..len].iter().enumerate() {
            let at = (q0 + i) * width;
            let lanes = lanes.map(f32::to_bits);
            // Sixteen at once where there is room: what runs over is written again by the next step.
            match out[at..].first_chunk_mut::<LANES>() {
                Some(to) => *to = lanes,
                None => out[at..at + width].copy_from_slice(&lanes[..width]),
            }
        }
        q0 += len;
    }
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
    /// Whether to add to what the output holds.
    pub residual: bool,
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

/// y = act(fma(acc, row scale * output scale, bias)) * gamma; out = out + y or y. Every step rounds once.
#[inline(always)]
pub(crate) fn finish<S: Simd>(s: S, t: FinishS8) {
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
            match out.first_chunk_mut::<LANES>() {
                Some(out) => {
                    if t.residual {
                        y = s.load(out) + y;
                    }
                    y.store(out);
                }
                None => {
                    let mut lanes = crate::simd::padded(out, 0.0);
                    if t.residual {
                        y = s.load(&lanes) + y;
                    }
                    y.store(&mut lanes);
                    out.copy_from_slice(&lanes[..out.len()]);
                }
            }
        }
    }
}
