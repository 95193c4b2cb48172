//! AVX-VNNI: sixteen outputs are two 256-bit registers; one instruction multiplies four inputs of eight outputs.
//!
//! It takes the activations unsigned: they are packed as s8 + 128, and sums start at -128 times the sum of the output's
//! weights. Tile 6 x 16: 12 sums, 2 weights, 1 broadcast of 16 registers.
#![allow(unsafe_code)]

use super::pack::{QUAD, STEP};
use super::tile::Dot8;
use crate::simd::LANES;
use std::arch::x86_64::*;

/// Token: this CPU has avx2 and avxvnni.
#[derive(Clone, Copy)]
pub(crate) struct AvxVnni(());

impl AvxVnni {
    /// The token; safe to call where the features are enabled.
    #[inline]
    #[target_feature(enable = "avx2,avxvnni")]
    pub(crate) fn new() -> Self {
        AvxVnni(())
    }
}

// Every SAFETY line below: the token proves the features; array references give the bounds, and the loads and
// stores are unaligned ones.
impl Dot8 for AvxVnni {
    const AHEAD: bool = true;
    type Elem = i8;
    type W = [__m256i; 2];
    type A = __m256i;
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
    fn prep_a(self, quad: &[i8; QUAD]) -> __m256i {
        // SAFETY: the token proves avx2.
        unsafe { _mm256_set1_epi32(i32::from_ne_bytes(quad.map(|v| v as u8))) }
    }

    #[inline(always)]
    fn dot(self, acc: Self::Acc, a: __m256i, w: Self::W) -> Self::Acc {
        // SAFETY: the token proves avxvnni.
        unsafe { [_mm256_dpbusd_avx_epi32(acc[0], a, w[0]), _mm256_dpbusd_avx_epi32(acc[1], a, w[1])] }
    }
}

super::tile::gemm_s8_entries!(AvxVnni, crate::simd::avx2::Avx2, rows [1, 2, 3, 4, 5, 6], panels [1], full 6 x 1, "avx2,fma,f16c,avxvnni");
