//! AVX2 without a byte dot product: sixteen outputs are two 256-bit registers.
//!
//! |a| times w with the sign of a, as unsigned times signed bytes added in pairs to 16 bits: at most 2 * 128 * 127 =
//! 32,512, so the saturation of that instruction cannot happen while weights hold no -128 (rectified maps do); then pairs to 32 bits.
//! Tile 4 x 16: 8 sums, 2 weights, the activation and its magnitude, the ones and two temporaries of 16 registers.
#![allow(unsafe_code)]

use super::pack::{QUAD, STEP};
use super::tile::Dot8;
use crate::simd::LANES;
use std::arch::x86_64::*;

/// Token: this CPU has avx2.
#[derive(Clone, Copy)]
pub(crate) struct Avx2(());

impl Avx2 {
    /// The token; safe to call where the features are enabled.
    #[inline]
    #[target_feature(enable = "avx2")]
    pub(crate) fn new() -> Self {
        Avx2(())
    }
}

/// Eight outputs: acc + w . a.
///
/// # Safety
/// The CPU has avx2.
#[inline(always)]
unsafe fn dot8(acc: __m256i, (a, magnitude): (__m256i, __m256i), w: __m256i) -> __m256i {
    // SAFETY: the caller's promise.
    unsafe {
        let pairs = _mm256_maddubs_epi16(magnitude, _mm256_sign_epi8(w, a));
        _mm256_add_epi32(acc, _mm256_madd_epi16(pairs, _mm256_set1_epi16(1)))
    }
}

// Every SAFETY line below: the token proves avx2; array references give the bounds, and the loads and stores are
// unaligned ones.
impl Dot8 for Avx2 {
    const AHEAD: bool = true;
    type Elem = i8;
    type W = [__m256i; 2];
    type A = (__m256i, __m256i);
    type Acc = [__m256i; 2];

    #[inline(always)]
    fn zero(self) -> Self::Acc {
        // SAFETY: the token proves avx2.
        unsafe { [_mm256_setzero_si256(); 2] }
    }

    #[inline(always)]
    fn load(self, _pass: usize, x: &[i32; LANES]) -> Self::Acc {
        let p = x.as_ptr().cast::<__m256i>();
        // SAFETY: the token proves avx2; 64 bytes are readable.
        unsafe { [_mm256_loadu_si256(p), _mm256_loadu_si256(p.add(1))] }
    }

    #[inline(always)]
    fn store(self, _pass: usize, acc: Self::Acc, x: &mut [i32; LANES]) {
        let p = x.as_mut_ptr().cast::<__m256i>();
        // SAFETY: the token proves avx2; 64 bytes are writable.
        unsafe {
            _mm256_storeu_si256(p, acc[0]);
            _mm256_storeu_si256(p.add(1), acc[1]);
        }
    }

    #[inline(always)]
    fn load_w(self, _pass: usize, x: &[i8; STEP]) -> Self::W {
        let p = x.as_ptr().cast::<__m256i>();
        // SAFETY: the token proves avx2; 64 bytes are readable.
        unsafe { [_mm256_loadu_si256(p), _mm256_loadu_si256(p.add(1))] }
    }

    #[inline(always)]
    fn prep_a(self, quad: &[i8; QUAD]) -> Self::A {
        // SAFETY: the token proves avx2.
        unsafe {
            let a = _mm256_set1_epi32(i32::from_ne_bytes(quad.map(|v| v as u8)));
            (a, _mm256_abs_epi8(a))
        }
    }

    #[inline(always)]
    fn dot(self, acc: Self::Acc, a: Self::A, w: Self::W) -> Self::Acc {
        // SAFETY: the token proves avx2.
        unsafe { [dot8(acc[0], a, w[0]), dot8(acc[1], a, w[1])] }
    }
}

super::tile::gemm_s8_entries!(Avx2, crate::simd::avx2::Avx2, rows [1, 2, 3, 4], panels [1], full 4 x 1, "avx2,fma,f16c");
