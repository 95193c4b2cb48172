//! AVX-512-VNNI: sixteen outputs are one register; one instruction multiplies four inputs of sixteen outputs.
//!
//! It takes the activations unsigned: they are packed as s8 + 128, and sums start at -128 times the sum of the output's
//! weights. Tile 12 x 32: 24 sums, 2 weights and the broadcasts in the six registers left of 32.
#![allow(unsafe_code)]

use super::pack::{QUAD, STEP};
use super::tile::Dot8;
use crate::simd::LANES;
use std::arch::x86_64::*;

/// Token: this CPU has avx512f and avx512vnni.
#[derive(Clone, Copy)]
pub(crate) struct Avx512Vnni(());

impl Avx512Vnni {
    /// The token; safe to call where the features are enabled.
    #[inline]
    #[target_feature(enable = "avx512f,avx512vnni")]
    pub(crate) fn new() -> Self {
        Avx512Vnni(())
    }
}

// Every SAFETY line below: the token proves the features; array references give the bounds, and the loads and
// stores are unaligned ones.
impl Dot8 for Avx512Vnni {
    const AHEAD: bool = true;
    type Elem = i8;
    type W = __m512i;
    type A = __m512i;
    type Acc = __m512i;

    #[inline(always)]
    fn zero(self) -> __m512i {
        // SAFETY: the token proves avx512f.
        unsafe { _mm512_setzero_si512() }
    }

    #[inline(always)]
    fn load(self, _pass: usize, x: &[i32; LANES]) -> __m512i {
        // SAFETY: the token proves avx512f; 64 bytes are readable.
        unsafe { _mm512_loadu_si512(x.as_ptr().cast()) }
    }

    #[inline(always)]
    fn store(self, _pass: usize, acc: __m512i, x: &mut [i32; LANES]) {
        // SAFETY: the token proves avx512f; 64 bytes are writable.
        unsafe { _mm512_storeu_si512(x.as_mut_ptr().cast(), acc) }
    }

    #[inline(always)]
    fn load_w(self, _pass: usize, x: &[i8; STEP]) -> __m512i {
        // SAFETY: the token proves avx512f; 64 bytes are readable.
        unsafe { _mm512_loadu_si512(x.as_ptr().cast()) }
    }

    #[inline(always)]
    fn prep_a(self, quad: &[i8; QUAD]) -> __m512i {
        // SAFETY: the token proves avx512f.
        unsafe { _mm512_set1_epi32(i32::from_ne_bytes(quad.map(|v| v as u8))) }
    }

    #[inline(always)]
    fn dot(self, acc: __m512i, a: __m512i, w: __m512i) -> __m512i {
        // SAFETY: the token proves avx512vnni.
        unsafe { _mm512_dpbusd_epi32(acc, a, w) }
    }
}

super::tile::gemm_s8_entries!(
    Avx512Vnni, crate::simd::avx512::Avx512,
    rows [1, 2, 4, 6, 8, 10, 12],
    panels [1, 2], full 12 x 2,
    "avx2,fma,f16c,avx512f,avx512bw,avx512vl,avx512dq,avx512vnni"
);
