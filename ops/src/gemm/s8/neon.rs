//! NEON without a byte dot product: sixteen outputs are four 128-bit registers.
//!
//! Bytes multiply to 16 bits; neighbouring products (at most 2 * 128 * 127 = 32,512: rectified maps hold -128, weights do not) are added in 16 bits, and pairs of
//! those into the 32-bit sums. Tile 4 x 16: 16 sums, 4 weights, a broadcast and 8 temporaries of 32 registers.
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

/// Sixteen outputs: acc + w . a.
///
/// In assembly because the compiler sees that both halves of `a` are equal, replaces each second-half product by a move of
/// the weights and runs out of registers. Four chains side by side also suit cores that execute in order.
///
/// # Safety
/// The CPU has neon.
#[inline(always)]
unsafe fn dot16(acc: [int32x4_t; 4], a: int8x16_t, w: [int8x16_t; 4]) -> [int32x4_t; 4] {
    let [mut s0, mut s1, mut s2, mut s3] = acc;
    // SAFETY: the caller's promise; touches only its operands.
    unsafe {
        std::arch::asm!(
            "smull  {l0:v}.8h, {w0:v}.8b, {a:v}.8b",
            "smull  {l1:v}.8h, {w1:v}.8b, {a:v}.8b",
            "smull  {l2:v}.8h, {w2:v}.8b, {a:v}.8b",
            "smull  {l3:v}.8h, {w3:v}.8b, {a:v}.8b",
            "smull2 {h0:v}.8h, {w0:v}.16b, {a:v}.16b",
            "smull2 {h1:v}.8h, {w1:v}.16b, {a:v}.16b",
            "smull2 {h2:v}.8h, {w2:v}.16b, {a:v}.16b",
            "smull2 {h3:v}.8h, {w3:v}.16b, {a:v}.16b",
            "addp   {l0:v}.8h, {l0:v}.8h, {h0:v}.8h",
            "addp   {l1:v}.8h, {l1:v}.8h, {h1:v}.8h",
            "addp   {l2:v}.8h, {l2:v}.8h, {h2:v}.8h",
            "addp   {l3:v}.8h, {l3:v}.8h, {h3:v}.8h",
            "sadalp {s0:v}.4s, {l0:v}.8h",
            "sadalp {s1:v}.4s, {l1:v}.8h",
            "sadalp {s2:v}.4s, {l2:v}.8h",
            "sadalp {s3:v}.4s, {l3:v}.8h",
            s0 = inout(vreg) s0, s1 = inout(vreg) s1, s2 = inout(vreg) s2, s3 = inout(vreg) s3,
            w0 = in(vreg) w[0], w1 = in(vreg) w[1], w2 = in(vreg) w[2], w3 = in(vreg) w[3],
            a = in(vreg) a,
            l0 = out(vreg) _, l1 = out(vreg) _, l2 = out(vreg) _, l3 = out(vreg) _,
            h0 = out(vreg) _, h1 = out(vreg) _, h2 = out(vreg) _, h3 = out(vreg) _,
            options(pure, nomem, nostack, preserves_flags)
        );
    }
    [s0, s1, s2, s3]
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
        // SAFETY: the token proves neon.
        unsafe { dot16(acc, a, w) }
    }
}

super::tile::gemm_s8_entries!(Neon, crate::simd::neon::Neon, rows [1, 2, 3, 4], panels [1], full 4 x 1, "neon");
