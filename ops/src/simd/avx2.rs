//! AVX2 + FMA + F16C: sixteen lanes are two 256-bit registers.
//!
//! Tile 6 x 16: 12 accumulators, two weight registers and one broadcast leave one of the 16 registers.
#![allow(unsafe_code)]

use super::{LANES, Simd, Vector};
use std::arch::x86_64::*;
use std::ops::{Add, Div, Mul, Sub};

/// Token: this CPU has avx2, fma and f16c.
#[derive(Clone, Copy)]
pub(crate) struct Avx2(());

/// Low and high eight lanes. Invariant: made from an [`Avx2`] token only.
#[derive(Clone, Copy)]
pub(crate) struct V(__m256, __m256);

impl Avx2 {
    /// The token; safe to call where the features are enabled.
    #[inline]
    #[target_feature(enable = "avx2,fma,f16c")]
    pub(crate) fn new() -> Self {
        Avx2(())
    }
}

// Every SAFETY line below: the token, or the vector made from it, proves the features; array references give
// the bounds, and the loads and stores are unaligned ones.
impl Simd for Avx2 {
    type V = V;
    const REGISTERS: usize = 8;

    #[inline(always)]
    fn splat(self, x: f32) -> V {
        // SAFETY: the token proves avx2.
        unsafe { V(_mm256_set1_ps(x), _mm256_set1_ps(x)) }
    }

    #[inline(always)]
    fn load(self, x: &[f32; LANES]) -> V {
        // SAFETY: the token proves avx2; 16 values are readable.
        unsafe { V(_mm256_loadu_ps(x.as_ptr()), _mm256_loadu_ps(x.as_ptr().add(8))) }
    }

    #[inline(always)]
    fn load_f16(self, x: &[u16; LANES]) -> V {
        // SAFETY: the token proves f16c; 16 values of 2 bytes are readable.
        unsafe {
            let p = x.as_ptr().cast::<__m128i>();
            V(_mm256_cvtph_ps(_mm_loadu_si128(p)), _mm256_cvtph_ps(_mm_loadu_si128(p.add(1))))
        }
    }

    #[inline(always)]
    fn load_i32(self, x: &[i32; LANES]) -> V {
        // SAFETY: the token proves avx2; 16 values are readable.
        unsafe {
            let p = x.as_ptr().cast::<__m256i>();
            V(_mm256_cvtepi32_ps(_mm256_loadu_si256(p)), _mm256_cvtepi32_ps(_mm256_loadu_si256(p.add(1))))
        }
    }

    #[inline(always)]
    fn transpose_quads(self, v: [V; 4]) -> [V; 4] {
        let [a, b, c, d] = v;
        // SAFETY: the token proves avx2.
        unsafe {
            [
                V(_mm256_permute2f128_ps::<0x20>(a.0, b.0), _mm256_permute2f128_ps::<0x20>(c.0, d.0)),
                V(_mm256_permute2f128_ps::<0x31>(a.0, b.0), _mm256_permute2f128_ps::<0x31>(c.0, d.0)),
                V(_mm256_permute2f128_ps::<0x20>(a.1, b.1), _mm256_permute2f128_ps::<0x20>(c.1, d.1)),
                V(_mm256_permute2f128_ps::<0x31>(a.1, b.1), _mm256_permute2f128_ps::<0x31>(c.1, d.1)),
            ]
        }
    }

    #[inline(always)]
    fn transpose(self, x: &mut [[f32; LANES]; LANES]) {
        // SAFETY: the token proves avx2; every load and store is half a row of the array.
        unsafe {
            let (a, b) = (quarter::<0, 0>(x), quarter::<0, 8>(x));
            let (c, d) = (quarter::<8, 0>(x), quarter::<8, 8>(x));
            for i in 0..8 {
                _mm256_storeu_ps(x[i].as_mut_ptr(), a[i]);
                _mm256_storeu_ps(x[i].as_mut_ptr().add(8), c[i]);
                _mm256_storeu_ps(x[8 + i].as_mut_ptr(), b[i]);
                _mm256_storeu_ps(x[8 + i].as_mut_ptr().add(8), d[i]);
            }
        }
    }
}

/// Eight rows of eight from a row and a column of 0 or 8 on, swapped. Not a closure: closures lose the instruction set
/// when they are not inlined.
///
/// # Safety
/// The CPU has avx2.
#[inline(always)]
unsafe fn quarter<const ROW: usize, const COL: usize>(x: &[[f32; LANES]; LANES]) -> [__m256; 8] {
    const { assert!(ROW <= 8 && COL <= 8) };
    // SAFETY: the caller's promise; eight values from column 8 or less on are inside a row.
    unsafe {
        let mut r = [_mm256_setzero_ps(); 8];
        for i in 0..8 {
            r[i] = _mm256_loadu_ps(x[ROW + i].as_ptr().add(COL));
        }
        transpose8(r)
    }
}

/// The lowest bytes of four vectors side by side in each lane.
///
/// # Safety
/// The CPU has avx2.
#[inline(always)]
unsafe fn low_bytes(v: [__m256; 4]) -> __m256i {
    // SAFETY: the caller's promise.
    unsafe {
        let (a, b) = (_mm256_castps_si256(v[0]), _mm256_castps_si256(v[1]));
        let (c, d) = (_mm256_castps_si256(v[2]), _mm256_castps_si256(v[3]));
        let even = _mm256_blend_epi16::<0xaa>(a, _mm256_slli_epi32::<16>(c));
        let odd = _mm256_blend_epi16::<0xaa>(b, _mm256_slli_epi32::<16>(d));
        _mm256_or_si256(_mm256_and_si256(even, _mm256_set1_epi16(0xff)), _mm256_slli_epi16::<8>(odd))
    }
}

/// Eight rows of eight, swapped.
///
/// # Safety
/// The CPU has avx2.
#[inline(always)]
unsafe fn transpose8(r: [__m256; 8]) -> [__m256; 8] {
    // SAFETY: the caller's promise.
    unsafe {
        let mut q = [_mm256_setzero_ps(); 8];
        for i in [0, 4] {
            let (ab_lo, ab_hi) = (_mm256_unpacklo_ps(r[i], r[i + 1]), _mm256_unpackhi_ps(r[i], r[i + 1]));
            let (cd_lo, cd_hi) = (_mm256_unpacklo_ps(r[i + 2], r[i + 3]), _mm256_unpackhi_ps(r[i + 2], r[i + 3]));
            q[i] = _mm256_shuffle_ps::<0x44>(ab_lo, cd_lo);
            q[i + 1] = _mm256_shuffle_ps::<0xee>(ab_lo, cd_lo);
            q[i + 2] = _mm256_shuffle_ps::<0x44>(ab_hi, cd_hi);
            q[i + 3] = _mm256_shuffle_ps::<0xee>(ab_hi, cd_hi);
        }
        let mut y = r;
        for c in 0..4 {
            y[c] = _mm256_permute2f128_ps::<0x20>(q[c], q[4 + c]);
            y[4 + c] = _mm256_permute2f128_ps::<0x31>(q[c], q[4 + c]);
        }
        y
    }
}

impl Add for V {
    type Output = V;
    #[inline(always)]
    fn add(self, o: V) -> V {
        // SAFETY: the vector proves avx2.
        unsafe { V(_mm256_add_ps(self.0, o.0), _mm256_add_ps(self.1, o.1)) }
    }
}

impl Sub for V {
    type Output = V;
    #[inline(always)]
    fn sub(self, o: V) -> V {
        // SAFETY: the vector proves avx2.
        unsafe { V(_mm256_sub_ps(self.0, o.0), _mm256_sub_ps(self.1, o.1)) }
    }
}

impl Mul for V {
    type Output = V;
    #[inline(always)]
    fn mul(self, o: V) -> V {
        // SAFETY: the vector proves avx2.
        unsafe { V(_mm256_mul_ps(self.0, o.0), _mm256_mul_ps(self.1, o.1)) }
    }
}

impl Div for V {
    type Output = V;
    #[inline(always)]
    fn div(self, o: V) -> V {
        // SAFETY: the vector proves avx2.
        unsafe { V(_mm256_div_ps(self.0, o.0), _mm256_div_ps(self.1, o.1)) }
    }
}

impl Vector for V {
    #[inline(always)]
    fn store(self, x: &mut [f32; LANES]) {
        // SAFETY: the vector proves avx2; 16 values are writable.
        unsafe {
            _mm256_storeu_ps(x.as_mut_ptr(), self.0);
            _mm256_storeu_ps(x.as_mut_ptr().add(8), self.1);
        }
    }

    #[inline(always)]
    fn mul_add(self, a: V, b: V) -> V {
        // SAFETY: the vector proves fma.
        unsafe { V(_mm256_fmadd_ps(self.0, a.0, b.0), _mm256_fmadd_ps(self.1, a.1, b.1)) }
    }

    #[inline(always)]
    fn neg_mul_add(self, a: V, b: V) -> V {
        // SAFETY: the vector proves fma.
        unsafe { V(_mm256_fnmadd_ps(self.0, a.0, b.0), _mm256_fnmadd_ps(self.1, a.1, b.1)) }
    }

    #[inline(always)]
    fn max(self, o: V) -> V {
        // SAFETY: the vector proves avx2. maxps is exactly a > b ? a : b.
        unsafe { V(_mm256_max_ps(self.0, o.0), _mm256_max_ps(self.1, o.1)) }
    }

    #[inline(always)]
    fn min(self, o: V) -> V {
        // SAFETY: the vector proves avx2. minps is exactly a < b ? a : b.
        unsafe { V(_mm256_min_ps(self.0, o.0), _mm256_min_ps(self.1, o.1)) }
    }

    #[inline(always)]
    fn select_gt(self, o: V, yes: V, no: V) -> V {
        // SAFETY: the vector proves avx2.
        unsafe {
            let lo = _mm256_cmp_ps::<_CMP_GT_OQ>(self.0, o.0);
            let hi = _mm256_cmp_ps::<_CMP_GT_OQ>(self.1, o.1);
            V(_mm256_blendv_ps(no.0, yes.0, lo), _mm256_blendv_ps(no.1, yes.1, hi))
        }
    }

    #[inline(always)]
    fn gt_bits(self, o: V) -> u16 {
        // SAFETY: the vector proves avx2.
        unsafe {
            let lo = _mm256_movemask_ps(_mm256_cmp_ps::<_CMP_GT_OQ>(self.0, o.0));
            let hi = _mm256_movemask_ps(_mm256_cmp_ps::<_CMP_GT_OQ>(self.1, o.1));
            (lo | hi << 8) as u16
        }
    }

    #[inline(always)]
    fn sqrt(self) -> V {
        // SAFETY: the vector proves avx2.
        unsafe { V(_mm256_sqrt_ps(self.0), _mm256_sqrt_ps(self.1)) }
    }

    #[inline(always)]
    fn abs(self) -> V {
        // SAFETY: the vector proves avx2.
        unsafe {
            let sign = _mm256_set1_ps(-0.0);
            V(_mm256_andnot_ps(sign, self.0), _mm256_andnot_ps(sign, self.1))
        }
    }

    #[inline(always)]
    fn minus_abs(self) -> V {
        // SAFETY: the vector proves avx2.
        unsafe {
            let sign = _mm256_set1_ps(-0.0);
            V(_mm256_or_ps(sign, self.0), _mm256_or_ps(sign, self.1))
        }
    }

    #[inline(always)]
    fn times_pow2_of_low_bits(self, n: V) -> V {
        // SAFETY: the vectors prove avx2.
        unsafe {
            let lo = _mm256_slli_epi32::<23>(_mm256_castps_si256(n.0));
            let hi = _mm256_slli_epi32::<23>(_mm256_castps_si256(n.1));
            let lo = _mm256_add_epi32(_mm256_castps_si256(self.0), lo);
            let hi = _mm256_add_epi32(_mm256_castps_si256(self.1), hi);
            V(_mm256_castsi256_ps(lo), _mm256_castsi256_ps(hi))
        }
    }

    #[inline(always)]
    fn pow2_of_low_bits(self, bias: i32) -> V {
        // SAFETY: the vector proves avx2.
        unsafe {
            let bias = _mm256_set1_epi32(bias << 23);
            let lo = _mm256_add_epi32(_mm256_slli_epi32::<23>(_mm256_castps_si256(self.0)), bias);
            let hi = _mm256_add_epi32(_mm256_slli_epi32::<23>(_mm256_castps_si256(self.1)), bias);
            V(_mm256_castsi256_ps(lo), _mm256_castsi256_ps(hi))
        }
    }

    #[inline(always)]
    fn add_bits(self, o: V) -> V {
        // SAFETY: the vector proves avx2.
        unsafe {
            let lo = _mm256_add_epi32(_mm256_castps_si256(self.0), _mm256_castps_si256(o.0));
            let hi = _mm256_add_epi32(_mm256_castps_si256(self.1), _mm256_castps_si256(o.1));
            V(_mm256_castsi256_ps(lo), _mm256_castsi256_ps(hi))
        }
    }

    #[inline(always)]
    fn negate(self, lanes: u16) -> V {
        // SAFETY: the vector proves avx2.
        unsafe {
            let bits = _mm256_set1_epi32(i32::from(lanes));
            let half = |x: __m256, bit: __m256i| {
                let chosen = _mm256_cmpeq_epi32(_mm256_and_si256(bits, bit), bit);
                _mm256_xor_ps(x, _mm256_and_ps(_mm256_castsi256_ps(chosen), _mm256_set1_ps(-0.0)))
            };
            let low = _mm256_setr_epi32(1, 1 << 1, 1 << 2, 1 << 3, 1 << 4, 1 << 5, 1 << 6, 1 << 7);
            V(half(self.0, low), half(self.1, _mm256_slli_epi32::<8>(low)))
        }
    }

    #[inline(always)]
    fn swap<const H: usize>(self) -> V {
        let V(a, b) = self;
        // SAFETY: the vector proves avx2.
        unsafe {
            match H {
                1 => V(_mm256_permute_ps::<0xb1>(a), _mm256_permute_ps::<0xb1>(b)),
                2 => V(_mm256_permute_ps::<0x4e>(a), _mm256_permute_ps::<0x4e>(b)),
                4 => V(_mm256_permute2f128_ps::<0x01>(a, a), _mm256_permute2f128_ps::<0x01>(b, b)),
                _ => V(b, a),
            }
        }
    }

    #[inline(always)]
    fn max_magnitude(self, o: V) -> V {
        let a = self.abs();
        // SAFETY: the vectors prove avx2.
        unsafe {
            let lo = _mm256_max_epu32(_mm256_castps_si256(a.0), _mm256_castps_si256(o.0));
            let hi = _mm256_max_epu32(_mm256_castps_si256(a.1), _mm256_castps_si256(o.1));
            V(_mm256_castsi256_ps(lo), _mm256_castsi256_ps(hi))
        }
    }

    #[inline(always)]
    fn store_s8(self, x: &mut [i8; LANES]) {
        // SAFETY: the vector proves avx2; 16 bytes are writable.
        unsafe {
            // Packing works inside halves: 0-3 8-11 | 4-7 12-15, put in order by the permutation of quads.
            let words = _mm256_packs_epi32(_mm256_cvtps_epi32(self.0), _mm256_cvtps_epi32(self.1));
            let words = _mm256_permute4x64_epi64::<0xd8>(words);
            let bytes = _mm_packs_epi16(_mm256_castsi256_si128(words), _mm256_extracti128_si256::<1>(words));
            _mm_storeu_si128(x.as_mut_ptr().cast(), bytes);
        }
    }

    #[inline(always)]
    fn store_low_bytes([a, b, c, d]: [V; 4], x: &mut [i8; 4 * LANES]) {
        let p = x.as_mut_ptr().cast::<__m256i>();
        // SAFETY: the vectors prove avx2; 64 bytes are writable.
        unsafe {
            _mm256_storeu_si256(p, low_bytes([a.0, b.0, c.0, d.0]));
            _mm256_storeu_si256(p.add(1), low_bytes([a.1, b.1, c.1, d.1]));
        }
    }
}

super::table::vector_kernels!("vector_avx2", crate::cpu::Features::AVX2, Avx2, "avx2,fma,f16c");
crate::gemm::tile::gemm_entries!(Avx2, rows [1, 2, 3, 4, 5, 6], panels [1], "avx2,fma,f16c");
