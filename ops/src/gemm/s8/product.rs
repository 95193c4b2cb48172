//! Full tiles below one another, each with its epilogue: a block of rows times a group of panels in one call, in the last block of steps.
//!
//! A narrow layer's tile is some 400 cycles of dot products. Called tile by tile, with sums through memory and an epilogue of its own, it
//! took as many again. Here the usual epilogues, `y` and `out + y`, take sums from the registers where they are; the others read one
//! tile of sums from memory, as everywhere. The arithmetic is that of `finish.rs`, so the bits are the same.

use super::finish::FinishS8;
use super::pack::QUAD;
use super::tile::{Dot8, MAX_NV, TileS8, begin, end, multiply};
use crate::cpu::Kernels;
use crate::gemm::Act;
use crate::gemm::ahead::Ahead;
use crate::gemm::finish::Plus;
use crate::simd::{LANES, Simd, Vector};

/// Full tiles of a product.
pub(crate) struct ProductS8<'a> {
    /// Vector kernels, for the epilogues that read sums from memory.
    pub kernels: &'static Kernels,
    /// Panels, up to the kernel's nr / 16.
    pub panels: usize,
    /// Steps of four inputs, up to the last.
    pub steps: usize,
    /// `[tile][step][row][4]`, from the first of these steps on: the bytes of the kernel's values.
    pub a: &'a [i8],
    /// Bytes from one tile to the next.
    pub a_stride: usize,
    /// First panel at its first step.
    pub w: &'a [i8],
    /// Bytes from one panel to the next.
    pub w_stride: usize,
    /// Where every row's sums start, per panel; none continues `acc`.
    pub start: Option<&'a [[i32; LANES]; MAX_NV]>,
    /// The epilogue of all rows, of which there are whole tiles; its own `acc` is not looked at.
    pub finish: FinishS8<'a>,
    /// Sums of the steps before, `[tile][panel][row][16]`; room for one tile where there are none.
    pub acc: &'a mut [i32],
    /// Weights that are read after these.
    pub next: *const i8,
    /// Bytes of them for each step of each tile.
    pub per_step: usize,
}

/// How sums become outputs while they are in registers.
#[derive(Clone, Copy, PartialEq, Eq)]
enum InRegisters {
    /// Not at all.
    No,
    /// out = y.
    Set,
    /// out = out + y * gamma.
    Add,
}

impl InRegisters {
    fn of(t: &FinishS8) -> InRegisters {
        if t.cols != t.panels * LANES || t.act != Act::None || t.relu_sum {
            return InRegisters::No;
        }
        match t.plus {
            Plus::Nothing if !t.gamma => InRegisters::Set,
            Plus::Output => InRegisters::Add,
            _ => InRegisters::No,
        }
    }
}

/// All tiles, of `MR` rows and `NV` panels.
#[inline(always)]
pub(crate) fn product<D: Dot8, S: Simd, const MR: usize, const NV: usize>(d: D, s: S, t: ProductS8) {
    let ProductS8 { kernels, steps, a, a_stride, w, w_stride, start, finish, acc, next, per_step, .. } = t;
    let how = if D::PASSES == 1 { InRegisters::of(&finish) } else { InRegisters::No };
    let (bytes, size) = (MR * steps * QUAD * size_of::<D::Elem>(), NV * MR * LANES);
    for first in (0..finish.row_scales.len()).step_by(MR) {
        let here = FinishS8 {
            row_scales: &finish.row_scales[first..first + MR],
            at: finish.at + first * finish.stride,
            acc_stride: MR * LANES,
            ..finish
        };
        let share = next.wrapping_add(first / MR * steps * per_step);
        let acc = &mut acc[if start.is_some() { 0 } else { first / MR * size }..][..size];
        let mut tile = TileS8 {
            rows: MR,
            panels: NV,
            steps,
            a: &a[first / MR * a_stride..][..bytes],
            w,
            w_stride,
            start,
            acc: &mut *acc,
            acc_stride: MR * LANES,
            ahead: Ahead::nothing(a).with_weights(share, per_step).with_outputs(here.out.at(here.at), here.stride),
        };
        for pass in 0..D::PASSES {
            let sums = multiply(d, pass, &tile, begin::<D, MR, NV>(d, pass, &tile));
            match how {
                InRegisters::Set => put::<D, S, MR, NV, false>(d, s, &sums, &here),
                InRegisters::Add => put::<D, S, MR, NV, true>(d, s, &sums, &here),
                InRegisters::No => end(d, pass, &sums, &mut tile),
            }
        }
        if how == InRegisters::No {
            kernels.finish_s8(FinishS8 { acc, ..here });
        }
    }
}

/// out = fma(sum, row scale * output scale, bias), or with `ADD` that times gamma on top of what is there.
#[inline(always)]
fn put<D: Dot8, S: Simd, const MR: usize, const NV: usize, const ADD: bool>(
    d: D,
    s: S,
    sums: &[[D::Acc; NV]; MR],
    t: &FinishS8,
) {
    let (mut scale, mut bias, mut gamma) = ([s.splat(0.0); NV], [s.splat(0.0); NV], [s.splat(1.0); NV]);
    for v in 0..NV {
        scale[v] = s.load(&t.columns.scales[v]);
        bias[v] = s.load(&t.columns.rest.bias[v]);
        if ADD && t.gamma {
            gamma[v] = s.load(&t.columns.rest.gamma[v]);
        }
    }
    let row_scales = t.row_scales.first_chunk::<MR>().expect("a whole tile");
    // SAFETY: every output belongs to one tile of one task, and the pieces live only in this loop.
    #[allow(unsafe_code)]
    let out = unsafe { t.out.lines::<MR>(t.at, t.stride, NV * LANES) };
    for (r, out) in out.into_iter().enumerate() {
        let out = &mut out.as_chunks_mut::<LANES>().0[..NV];
        let row = s.splat(row_scales[r]);
        for v in 0..NV {
            // Stays a register: stored and loaded as the same sixteen values.
            let mut lanes = [0; LANES];
            d.store(0, sums[r][v], &mut lanes);
            let mut y = s.load_i32(&lanes).mul_add(row * scale[v], bias[v]);
            if ADD {
                y = s.load(&out[v]) + y * gamma[v];
            }
            y.store(&mut out[v]);
        }
    }
}

macro_rules! s8_product {
    ($token:ident, $vector:path, [$($panels:literal),*], $mr:literal $(, $features:literal)?) => {
        /// Full tiles of a product with their epilogue.
        $(#[target_feature(enable = $features)])?
        pub(crate) fn product_s8(t: crate::gemm::s8::product::ProductS8) {
            use $vector as Vectors;
            match t.panels {
                $($panels => crate::gemm::s8::product::product::<_, _, $mr, $panels>($token::new(), Vectors::new(), t),)*
                other => panic!("tiles of {other} panels"),
            }
        }
    };
}
pub(crate) use s8_product;
