//! NEON without a byte dot product: sixteen outputs are four 128-bit registers.
//!
//! Bytes multiply to 16 bits; neighbouring products (at most 2 * 127 * 127 = 32,258) are added in 16 bits, and pairs of
//! those into the 32-bit sums. Tile 4 x 16: 16 sums, 4 weights, a broadcast and temporaries of 32 registers.
#![allow(unsafe_code)]

use super::pack::{QUAD, STEP};
use super::tile::Dot8;
use crate::simd::LANES;
use std::arch::aarch64::*;

/// Token: this CPU has neon.
#[derive(Clone, Copy)]
pub(crate) struct Neon(());

impl Neon {
    /// The token; safe to call where the features are enabled.
    #[inline]
    #[target_feature(enable = "neon")]
    pub(crate) fn new() -> Self {
        Neon(())
    }
}

/// Four outputs: acc + w . a.
///
/// # Safety
/// The CPU has neon.
#[inline(always)]
unsafe fn dot4(acc: int32x4_t, a: int8x16_t, w: int8x16_t) -> int32x4_t {
    // SAFETY: the caller's promise.
    unsafe {
        let low = vmull_s8(vget_low_s8(w), vget_low_s8(a));
        let high = vmull_high_s8(w, a);
        vpadalq_s16(acc, vpaddq_s16(low, high))
    }
}

/// Four registers from 64 bytes.
///
/// # Safety
/// The CPU has neon; 64 bytes are readable at `p`.
#[inline(always)]
pub(super) unsafe fn load_bytes(p: *const i8) -> [int8x16_t; 4] {
    // SAFETY: the caller's promise.
    unsafe { [vld1q_s8(p), vld1q_s8(p.add(16)), vld1q_s8(p.add(32)), vld1q_s8(p.add(48))] }
}

/// Four registers from 16 sums.
///
/// # Safety
/// The CPU has neon; 16 values are readable at `p`.
#[inline(always)]
pub(super) unsafe fn load_sums(p: *const i32) -> [int32x4_t; 4] {
    // SAFETY: the caller's promise.
    unsafe { [vld1q_s32(p), vld1q_s32(p.add(4)), vld1q_s32(p.add(8)), vld1q_s32(p.add(12))] }
}

/// Four registers to 16 sums.
///
/// # Safety
/// The CPU has neon; 16 values are writable at `p`.
#[inline(always)]
pub(super) unsafe fn store_sums(acc: [int32x4_t; 4], p: *mut i32) {
    // SAFETY: the caller's promise.
    unsafe {
        vst1q_s32(p, acc[0]);
        vst1q_s32(p.add(4), acc[1]);
        vst1q_s32(p.add(8), acc[2]);
        vst1q_s32(p.add(12), acc[3]);
    }
}

// Every SAFETY line below: the token proves neon; array references give the bounds.
impl Dot8 for Neon {
    type W = [int8x16_t; 4];
    type A = int8x16_t;
    type Acc = [int32x4_t; 4];

    #[inline(always)]
    fn zero(self) -> Self::Acc {
        // SAFETY: the token proves neon.
        unsafe { [vdupq_n_s32(0); 4] }
    }

    #[inline(always)]
    fn load(self, x: &[i32; LANES]) -> Self::Acc {
        // SAFETY: the token proves neon; 16 values are readable.
        unsafe { load_sums(x.as_ptr()) }
    }

    #[inline(always)]
    fn store(self, acc: Self::Acc, x: &mut [i32; LANES]) {
        // SAFETY: the token proves neon; 16 values are writable.
        unsafe { store_sums(acc, x.as_mut_ptr()) }
    }

    #[inline(always)]
    fn load_w(self, x: &[i8; STEP]) -> Self::W {
        // SAFETY: the token proves neon; 64 bytes are readable.
        unsafe { load_bytes(x.as_ptr()) }
    }

    #[inline(always)]
    fn prep_a(self, rows: &[[i8; QUAD]], r: usize) -> int8x16_t {
        // SAFETY: the token proves neon.
        unsafe { vreinterpretq_s8_s32(vdupq_n_s32(i32::from_ne_bytes(rows[r].map(|v| v as u8)))) }
    }

    #[inline(always)]
    fn dot(self, acc: Self::Acc, a: int8x16_t, w: Self::W) -> Self::Acc {
        // SAFETY: the token proves neon.
        unsafe { [dot4(acc[0], a, w[0]), dot4(acc[1], a, w[1]), dot4(acc[2], a, w[2]), dot4(acc[3], a, w[3])] }
    }
}

super::tile::gemm_s8_entries!(Neon, rows [1, 2, 3, 4], panels [1], full 4 x 1, "neon");
