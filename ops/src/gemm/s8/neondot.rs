//! NEON with the signed byte dot product: sixteen outputs are four 128-bit registers.
//!
//! `sdot` takes one 32-bit lane of a register as the activations, so four rows come with one load and no broadcast.
//! Tile 6 x 16: 24 sums, 4 weights, 2 registers of rows of 32.
#![allow(unsafe_code)]

use super::neon::{load_bytes, load_sums, store_sums};
use super::pack::{QUAD, STEP};
use super::tile::Dot8;
use crate::simd::LANES;
use std::arch::aarch64::*;

/// Token: this CPU has neon and dotprod.
#[derive(Clone, Copy)]
pub(crate) struct NeonDot(());

impl NeonDot {
    /// The token; safe to call where the features are enabled.
    #[inline]
    #[target_feature(enable = "neon,dotprod")]
    pub(crate) fn new() -> Self {
        NeonDot(())
    }
}

/// acc + w . lane `LANE` of a. The intrinsic is younger than this crate's minimum compiler.
///
/// # Safety
/// The CPU has dotprod.
#[inline(always)]
unsafe fn sdot<const LANE: usize>(acc: int32x4_t, w: int8x16_t, a: int8x16_t) -> int32x4_t {
    let mut acc = acc;
    // SAFETY: the caller's promise; touches only its operands.
    unsafe {
        std::arch::asm!(
            "sdot {acc:v}.4s, {w:v}.16b, {a:v}.4b[{lane}]",
            acc = inout(vreg) acc,
            w = in(vreg) w,
            a = in(vreg) a,
            lane = const LANE,
            options(pure, nomem, nostack, preserves_flags)
        );
    }
    acc
}

/// Sixteen outputs: acc + w . lane `LANE` of a.
///
/// # Safety
/// The CPU has dotprod.
#[inline(always)]
unsafe fn dot16<const LANE: usize>(acc: [int32x4_t; 4], w: [int8x16_t; 4], a: int8x16_t) -> [int32x4_t; 4] {
    // SAFETY: the caller's promise.
    unsafe {
        [
            sdot::<LANE>(acc[0], w[0], a),
            sdot::<LANE>(acc[1], w[1], a),
            sdot::<LANE>(acc[2], w[2], a),
            sdot::<LANE>(acc[3], w[3], a),
        ]
    }
}

// Every SAFETY line below: the token proves the features; array references give the bounds.
impl Dot8 for NeonDot {
    type Elem = i8;
    type W = [int8x16_t; 4];
    type A = int8x16_t;
    type Acc = [int32x4_t; 4];

    #[inline(always)]
    fn zero(self) -> Self::Acc {
        // SAFETY: the token proves neon.
        unsafe { [vdupq_n_s32(0); 4] }
    }

    #[inline(always)]
    fn load(self, _pass: usize, x: &[i32; LANES]) -> Self::Acc {
        // SAFETY: the token proves neon; 16 values are readable.
        unsafe { load_sums(x.as_ptr()) }
    }

    #[inline(always)]
    fn store(self, _pass: usize, acc: Self::Acc, x: &mut [i32; LANES]) {
        // SAFETY: the token proves neon; 16 values are writable.
        unsafe { store_sums(acc, x.as_mut_ptr()) }
    }

    #[inline(always)]
    fn load_w(self, _pass: usize, x: &[i8; STEP]) -> Self::W {
        // SAFETY: the token proves neon; 64 bytes are readable.
        unsafe { load_bytes(x.as_ptr()) }
    }

    #[inline(always)]
    fn prep_a(self, quad: &[i8; QUAD]) -> int8x16_t {
        // SAFETY: the token proves neon.
        unsafe { vreinterpretq_s8_s32(vdupq_n_s32(i32::from_ne_bytes(quad.map(|v| v as u8)))) }
    }

    #[inline(always)]
    fn dot(self, acc: Self::Acc, a: int8x16_t, w: Self::W) -> Self::Acc {
        // SAFETY: the token proves dotprod.
        unsafe { dot16::<0>(acc, w, a) }
    }

    /// Four rows from one load, then two, then one.
    #[inline(always)]
    fn step<const MR: usize, const NV: usize>(
        self,
        acc: &mut [[Self::Acc; NV]; MR],
        rows: &[[i8; QUAD]; MR],
        w: &[Self::W; NV],
    ) {
        let mut r = 0;
        while let Some(four) = rows[r..].first_chunk::<4>() {
            // SAFETY: the token proves neon and dotprod; 16 bytes are readable.
            unsafe {
                let a = vld1q_s8(four.as_ptr().cast());
                for v in 0..NV {
                    acc[r][v] = dot16::<0>(acc[r][v], w[v], a);
                    acc[r + 1][v] = dot16::<1>(acc[r + 1][v], w[v], a);
                    acc[r + 2][v] = dot16::<2>(acc[r + 2][v], w[v], a);
                    acc[r + 3][v] = dot16::<3>(acc[r + 3][v], w[v], a);
                }
            }
            r += 4;
        }
        if let Some(two) = rows[r..].first_chunk::<2>() {
            // SAFETY: the token proves neon and dotprod; 8 bytes are readable.
            unsafe {
                let half = vld1_s8(two.as_ptr().cast());
                let a = vcombine_s8(half, half);
                for v in 0..NV {
                    acc[r][v] = dot16::<0>(acc[r][v], w[v], a);
                    acc[r + 1][v] = dot16::<1>(acc[r + 1][v], w[v], a);
                }
            }
            r += 2;
        }
        if r < MR {
            let a = self.prep_a(&rows[r]);
            for v in 0..NV {
                acc[r][v] = self.dot(acc[r][v], a, w[v]);
            }
        }
    }

    /// Rows apart are brought together: one load then serves four.
    #[inline(always)]
    fn step_apart<const MR: usize, const NV: usize>(
        self,
        acc: &mut [[Self::Acc; NV]; MR],
        rows: &[&[i8; QUAD]; MR],
        w: &[Self::W; NV],
    ) {
        self.step(acc, &rows.map(|r| *r), w);
    }
}

super::tile::gemm_s8_entries!(NeonDot, crate::simd::neon::Neon, rows [1, 2, 3, 4, 5, 6], panels [1], full 6 x 1, "neon,dotprod");
