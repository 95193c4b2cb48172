//! AVX2 without a byte dot product: both sides widened to 16 bits, pairs multiplied and added to 32 bits.
//!
//! The instruction adds neighbouring products, so a 256-bit register holds four outputs of two half sums, added when the sums
//! are stored. Sixteen outputs would need four registers a row; the tile therefore goes over a panel twice, eight outputs at
//! a time: 6 rows x 8 outputs are 12 sums, 2 weights and 1 broadcast of 16 registers.
//!
//! Per step of a pass: 6 broadcasts (load unit only), 2 widening loads, 12 multiply-adds, 12 additions. Other exact forms, measured
//! on Zen 3 (billions of multiply-adds a second, operands in the first-level cache): this one 77.8; the byte form of `avx2.rs` 62.7, it
//! needs a sign, two multiplications and an addition for eight outputs; odd and even inputs apart (5 x 16) 68.8; weights widened
//! beforehand 69.6, they take twice the loads. The inexact byte form with saturation reaches 90.3.
//!
//! Two passes read weights twice and widen them twice, which shows with few rows: there the byte form is chosen.
#![allow(unsafe_code)]

use super::pack::{QUAD, STEP};
use super::tile::Dot8;
use crate::simd::LANES;
use std::arch::x86_64::*;

/// Token: this CPU has avx2.
#[derive(Clone, Copy)]
pub(crate) struct Avx2Wide(());

impl Avx2Wide {
    /// The token; safe to call where the features are enabled.
    #[inline]
    #[target_feature(enable = "avx2")]
    pub(crate) fn new() -> Self {
        Avx2Wide(())
    }
}

// Every SAFETY line below: the token proves avx2; array references and `pass` < 2 give the bounds, and the loads and stores
// are unaligned ones.
impl Dot8 for Avx2Wide {
    const AHEAD: bool = true;
    type Elem = i16;
    /// Four outputs each, four inputs of an output side by side.
    type W = [__m256i; 2];
    type A = __m256i;
    /// As the weights: two half sums of an output side by side.
    type Acc = [__m256i; 2];
    const PASSES: usize = 2;

    #[inline(always)]
    fn zero(self) -> Self::Acc {
        // SAFETY: the token proves avx2.
        unsafe { [_mm256_setzero_si256(); 2] }
    }

    #[inline(always)]
    fn load(self, pass: usize, x: &[i32; LANES]) -> Self::Acc {
        let x = &x[pass * 8..][..8];
        let p = x.as_ptr().cast::<__m128i>();
        // SAFETY: the token proves avx2; 32 bytes are readable. The sum goes into the first half, zero into the second.
        unsafe { [_mm256_cvtepu32_epi64(_mm_loadu_si128(p)), _mm256_cvtepu32_epi64(_mm_loadu_si128(p.add(1)))] }
    }

    #[inline(always)]
    fn store(self, pass: usize, acc: Self::Acc, x: &mut [i32; LANES]) {
        let x = &mut x[pass * 8..][..8];
        // SAFETY: the token proves avx2; 32 bytes are writable. The horizontal addition leaves outputs 0 1 4 5 | 2 3 6 7.
        unsafe {
            let sums = _mm256_permute4x64_epi64::<0xd8>(_mm256_hadd_epi32(acc[0], acc[1]));
            _mm256_storeu_si256(x.as_mut_ptr().cast(), sums);
        }
    }

    #[inline(always)]
    fn load_w(self, pass: usize, x: &[i8; STEP]) -> Self::W {
        let x = &x[pass * 32..][..32];
        let p = x.as_ptr().cast::<__m128i>();
        // SAFETY: the token proves avx2; 32 bytes are readable.
        unsafe { [_mm256_cvtepi8_epi16(_mm_loadu_si128(p)), _mm256_cvtepi8_epi16(_mm_loadu_si128(p.add(1)))] }
    }

    #[inline(always)]
    fn prep_a(self, quad: &[i16; QUAD]) -> __m256i {
        // SAFETY: the token proves avx2; 8 bytes are readable.
        unsafe { _mm256_broadcastq_epi64(_mm_loadu_si64(quad.as_ptr().cast())) }
    }

    #[inline(always)]
    fn dot(self, acc: Self::Acc, a: __m256i, w: Self::W) -> Self::Acc {
        // SAFETY: the token proves avx2.
        unsafe {
            [_mm256_add_epi32(acc[0], _mm256_madd_epi16(a, w[0])), _mm256_add_epi32(acc[1], _mm256_madd_epi16(a, w[1]))]
        }
    }
}

super::tile::gemm_s8_entries!(Avx2Wide, crate::simd::avx2::Avx2, rows [1, 2, 3, 4, 5, 6], panels [1], full 6 x 1, "avx2,fma,f16c");
