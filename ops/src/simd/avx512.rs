//! AVX-512 (F, BW, VL, DQ): sixteen lanes are one register.
//!
//! Tile 12 x 32: 24 accumulators and two weight registers leave six of the 32; the activation is a broadcast
//! memory operand of the multiply-add.
#![allow(unsafe_code)]

use super::{LANES, Simd, Vector};
use std::arch::x86_64::*;
use std::ops::{Add, Div, Mul, Sub};

/// Token: this CPU has avx512f, avx512bw, avx512vl and avx512dq.
#[derive(Clone, Copy)]
pub(crate) struct Avx512(());

/// Sixteen lanes. Invariant: made from an [`Avx512`] token only.
#[derive(Clone, Copy)]
pub(crate) struct V(__m512);

impl Avx512 {
    /// The token; safe to call where the features are enabled.
    #[inline]
    #[target_feature(enable = "avx2,fma,f16c,avx512f,avx512bw,avx512vl,avx512dq")]
    pub(crate) fn new() -> Self {
        Avx512(())
    }
}

// Every SAFETY line below: the token, or the vector made from it, proves the features; array references give
// the bounds, and the loads and stores are unaligned ones.
impl Simd for Avx512 {
    type V = V;
    const REGISTERS: usize = 32;
    const AHEAD: bool = true;

    #[inline(always)]
    fn splat(self, x: f32) -> V {
        // SAFETY: the token proves avx512f.
        unsafe { V(_mm512_set1_ps(x)) }
    }

    #[inline(always)]
    fn load(self, x: &[f32; LANES]) -> V {
        // SAFETY: the token proves avx512f; 16 values are readable.
        unsafe { V(_mm512_loadu_ps(x.as_ptr())) }
    }

    #[inline(always)]
    fn load_f16(self, x: &[u16; LANES]) -> V {
        // SAFETY: the token proves avx512f; 16 values of 2 bytes are readable.
        unsafe { V(_mm512_cvtph_ps(_mm256_loadu_si256(x.as_ptr().cast::<__m256i>()))) }
    }

    #[inline(always)]
    fn load_i32(self, x: &[i32; LANES]) -> V {
        // SAFETY: the token proves avx512f; 16 values are readable.
        unsafe { V(_mm512_cvtepi32_ps(_mm512_loadu_si512(x.as_ptr().cast()))) }
    }

    #[inline(always)]
    fn load3(self, x: &[[f32; 3]; LANES]) -> [V; 3] {
        let p = x.as_ptr().cast::<f32>();
        // SAFETY: the token proves avx512f; 48 values are readable, and so are the index tables.
        unsafe {
            let (a, b, c) = (_mm512_loadu_ps(p), _mm512_loadu_ps(p.add(16)), _mm512_loadu_ps(p.add(32)));
            let mut y = [V(a); 3];
            for (i, y) in y.iter_mut().enumerate() {
                let (first, rest) = (index(&PICK3[i][0]), index(&PICK3[i][1]));
                y.0 = _mm512_permutex2var_ps(_mm512_permutex2var_ps(a, first, b), rest, c);
            }
            y
        }
    }

    #[inline(always)]
    fn load4(self, x: &[[f32; 4]; LANES]) -> [V; 4] {
        let p = x.as_ptr().cast::<f32>();
        // SAFETY: the token proves avx512f; 64 values are readable, and so are the index tables.
        unsafe {
            let (a, b) = (_mm512_loadu_ps(p), _mm512_loadu_ps(p.add(16)));
            let (c, d) = (_mm512_loadu_ps(p.add(32)), _mm512_loadu_ps(p.add(48)));
            let mut y = [V(a); 4];
            for (i, y) in y.iter_mut().enumerate() {
                let pick = index(&PICK4[i]);
                let (low, high) = (_mm512_permutex2var_ps(a, pick, b), _mm512_permutex2var_ps(c, pick, d));
                y.0 = _mm512_shuffle_f32x4::<0x44>(low, high);
            }
            y
        }
    }

    #[inline(always)]
    fn store3(self, [a, b, c]: [V; 3], x: &mut [[f32; 3]; LANES]) {
        let p = x.as_mut_ptr().cast::<f32>();
        // SAFETY: the token proves avx512f; 48 values are writable, and the index tables are readable.
        unsafe {
            for i in 0..3 {
                let ab = _mm512_permutex2var_ps(a.0, index(&PLACE3[i][0]), b.0);
                let abc = _mm512_mask_permutexvar_ps(ab, THIRD[i], index(&PLACE3[i][1]), c.0);
                _mm512_storeu_ps(p.add(16 * i), abc);
            }
        }
    }

    #[inline(always)]
    fn store_chosen(self, v: V, lanes: u16, x: &mut [f32; LANES]) {
        // SAFETY: the token proves avx512f; 16 values are writable. In a register first: compressing to memory takes a hundred cycles on
        // Zen 4.
        unsafe { _mm512_storeu_ps(x.as_mut_ptr(), _mm512_maskz_compress_ps(lanes, v.0)) }
    }

    #[inline(always)]
    fn transpose_quads(self, v: [V; 4]) -> [V; 4] {
        let [V(a), V(b), V(c), V(d)] = v;
        // SAFETY: the token proves avx512f.
        unsafe {
            let (ab_even, ab_odd) = (_mm512_shuffle_f32x4::<0x88>(a, b), _mm512_shuffle_f32x4::<0xdd>(a, b));
            let (cd_even, cd_odd) = (_mm512_shuffle_f32x4::<0x88>(c, d), _mm512_shuffle_f32x4::<0xdd>(c, d));
            [
                V(_mm512_shuffle_f32x4::<0x88>(ab_even, cd_even)),
                V(_mm512_shuffle_f32x4::<0x88>(ab_odd, cd_odd)),
                V(_mm512_shuffle_f32x4::<0xdd>(ab_even, cd_even)),
                V(_mm512_shuffle_f32x4::<0xdd>(ab_odd, cd_odd)),
            ]
        }
    }

    #[inline(always)]
    fn transpose(self, x: &mut [[f32; LANES]; LANES]) {
        // SAFETY: the token proves avx512f; every load and store is one row of the array.
        unsafe {
            let mut r = [_mm512_setzero_ps(); LANES];
            for i in 0..LANES {
                r[i] = _mm512_loadu_ps(x[i].as_ptr());
            }
            // Inside the four 128-bit groups: pairs, then quads, so that q[4i + c] holds columns c, c + 4, c + 8, c + 12
            // of rows 4i..4i + 3.
            let mut q = [_mm512_setzero_ps(); LANES];
            for i in (0..LANES).step_by(4) {
                let (ab_lo, ab_hi) = (_mm512_unpacklo_ps(r[i], r[i + 1]), _mm512_unpackhi_ps(r[i], r[i + 1]));
                let (cd_lo, cd_hi) = (_mm512_unpacklo_ps(r[i + 2], r[i + 3]), _mm512_unpackhi_ps(r[i + 2], r[i + 3]));
                q[i] = _mm512_shuffle_ps::<0x44>(ab_lo, cd_lo);
                q[i + 1] = _mm512_shuffle_ps::<0xee>(ab_lo, cd_lo);
                q[i + 2] = _mm512_shuffle_ps::<0x44>(ab_hi, cd_hi);
                q[i + 3] = _mm512_shuffle_ps::<0xee>(ab_hi, cd_hi);
            }
            // Across the groups.
            for c in 0..4 {
                let a = _mm512_shuffle_f32x4::<0x88>(q[c], q[4 + c]);
                let b = _mm512_shuffle_f32x4::<0xdd>(q[c], q[4 + c]);
                let d = _mm512_shuffle_f32x4::<0x88>(q[8 + c], q[12 + c]);
                let e = _mm512_shuffle_f32x4::<0xdd>(q[8 + c], q[12 + c]);
                _mm512_storeu_ps(x[c].as_mut_ptr(), _mm512_shuffle_f32x4::<0x88>(a, d));
                _mm512_storeu_ps(x[4 + c].as_mut_ptr(), _mm512_shuffle_f32x4::<0x88>(b, e));
                _mm512_storeu_ps(x[8 + c].as_mut_ptr(), _mm512_shuffle_f32x4::<0xdd>(a, d));
                _mm512_storeu_ps(x[12 + c].as_mut_ptr(), _mm512_shuffle_f32x4::<0xdd>(b, e));
            }
        }
    }
}

/// A table of lane numbers.
///
/// # Safety
/// The CPU has avx512f.
#[inline(always)]
unsafe fn index(table: &[i32; LANES]) -> __m512i {
    // SAFETY: the caller's promise; 16 values are readable.
    unsafe { _mm512_loadu_si512(table.as_ptr().cast()) }
}

/// 1 in the lanes where bit `h` of the number is clear, else -1.
const fn ones_less(h: usize) -> &'static [f32; LANES] {
    const SIGNS: [[f32; LANES]; 4] = {
        let mut signs = [[1.0; LANES]; 4];
        let mut at = 0;
        while at < 4 * LANES {
            if (at % LANES) >> (at / LANES) & 1 == 1 {
                signs[at / LANES][at % LANES] = -1.0;
            }
            at += 1;
        }
        signs
    };
    &SIGNS[h.trailing_zeros() as usize]
}

/// Numbers 3 i + c of 48: those below 32 from two vectors, then the rest from that (lanes 0..16) and the third.
const PICK3: [[[i32; LANES]; 2]; 3] = {
    let mut table = [[[0; LANES]; 2]; 3];
    let mut c = 0;
    while c < 3 {
        let mut i = 0;
        while i < LANES {
            let at = (3 * i + c) as i32;
            table[c][0][i] = if at < 32 { at } else { 0 };
            table[c][1][i] = if at < 32 { i as i32 } else { at - 16 };
            i += 1;
        }
        c += 1;
    }
    table
};
/// Numbers 4 i + c of 32, eight of them.
const PICK4: [[i32; LANES]; 4] = {
    let mut table = [[0; LANES]; 4];
    let mut c = 0;
    while c < 4 {
        let mut i = 0;
        while i < LANES / 2 {
            table[c][i] = (4 * i + c) as i32;
            i += 1;
        }
        c += 1;
    }
    table
};
/// Where number 16 j + l of 48 comes from: first two vectors, third vector.
const PLACE3: [[[i32; LANES]; 2]; 3] = {
    let mut table = [[[0; LANES]; 2]; 3];
    let mut at = 0;
    while at < 3 * LANES {
        let (lane, vector) = ((at / 3) as i32, at % 3);
        table[at / LANES][0][at % LANES] = if vector == 1 { 16 + lane } else { lane };
        table[at / LANES][1][at % LANES] = lane;
        at += 1;
    }
    table
};
/// Which lanes of the three results come from the third vector.
const THIRD: [u16; 3] = {
    let mut masks = [0; 3];
    let mut at = 2;
    while at < 3 * LANES {
        masks[at / LANES] |= 1 << (at % LANES);
        at += 3;
    }
    masks
};

impl Add for V {
    type Output = V;
    #[inline(always)]
    fn add(self, o: V) -> V {
        // SAFETY: the vector proves avx512f.
        unsafe { V(_mm512_add_ps(self.0, o.0)) }
    }
}

impl Sub for V {
    type Output = V;
    #[inline(always)]
    fn sub(self, o: V) -> V {
        // SAFETY: the vector proves avx512f.
        unsafe { V(_mm512_sub_ps(self.0, o.0)) }
    }
}

impl Mul for V {
    type Output = V;
    #[inline(always)]
    fn mul(self, o: V) -> V {
        // SAFETY: the vector proves avx512f.
        unsafe { V(_mm512_mul_ps(self.0, o.0)) }
    }
}

impl Div for V {
    type Output = V;
    #[inline(always)]
    fn div(self, o: V) -> V {
        // SAFETY: the vector proves avx512f.
        unsafe { V(_mm512_div_ps(self.0, o.0)) }
    }
}

impl Vector for V {
    #[inline(always)]
    fn store(self, x: &mut [f32; LANES]) {
        // SAFETY: the vector proves avx512f; 16 values are writable.
        unsafe { _mm512_storeu_ps(x.as_mut_ptr(), self.0) }
    }

    #[inline(always)]
    fn mul_add(self, a: V, b: V) -> V {
        // SAFETY: the vector proves avx512f.
        unsafe { V(_mm512_fmadd_ps(self.0, a.0, b.0)) }
    }

    #[inline(always)]
    fn neg_mul_add(self, a: V, b: V) -> V {
        // SAFETY: the vector proves avx512f.
        unsafe { V(_mm512_fnmadd_ps(self.0, a.0, b.0)) }
    }

    #[inline(always)]
    fn max(self, o: V) -> V {
        // SAFETY: the vector proves avx512f. maxps is exactly a > b ? a : b.
        unsafe { V(_mm512_max_ps(self.0, o.0)) }
    }

    #[inline(always)]
    fn min(self, o: V) -> V {
        // SAFETY: the vector proves avx512f. minps is exactly a < b ? a : b.
        unsafe { V(_mm512_min_ps(self.0, o.0)) }
    }

    #[inline(always)]
    fn select_gt(self, o: V, yes: V, no: V) -> V {
        // SAFETY: the vector proves avx512f.
        unsafe { V(_mm512_mask_blend_ps(_mm512_cmp_ps_mask::<_CMP_GT_OQ>(self.0, o.0), no.0, yes.0)) }
    }

    #[inline(always)]
    fn gt_bits(self, o: V) -> u16 {
        // SAFETY: the vector proves avx512f.
        unsafe { _mm512_cmp_ps_mask::<_CMP_GT_OQ>(self.0, o.0) }
    }

    #[inline(always)]
    fn sqrt(self) -> V {
        // SAFETY: the vector proves avx512f.
        unsafe { V(_mm512_sqrt_ps(self.0)) }
    }

    #[inline(always)]
    fn abs(self) -> V {
        // SAFETY: the vector proves avx512dq.
        unsafe { V(_mm512_andnot_ps(_mm512_set1_ps(-0.0), self.0)) }
    }

    #[inline(always)]
    fn minus_abs(self) -> V {
        // SAFETY: the vector proves avx512dq.
        unsafe { V(_mm512_or_ps(_mm512_set1_ps(-0.0), self.0)) }
    }

    #[inline(always)]
    fn times_pow2_of_low_bits(self, n: V) -> V {
        // SAFETY: the vectors prove avx512f.
        unsafe {
            let shifted = _mm512_slli_epi32::<23>(_mm512_castps_si512(n.0));
            V(_mm512_castsi512_ps(_mm512_add_epi32(_mm512_castps_si512(self.0), shifted)))
        }
    }

    #[inline(always)]
    fn fraction<S: Simd<V = V>>(self, _: S) -> (V, V) {
        // SAFETY: the vector proves avx512dq. 8: to nearest, ties to even.
        unsafe {
            let f = _mm512_reduce_ps::<8>(self.0);
            (V(f), V(_mm512_sub_ps(f, self.0)))
        }
    }

    #[inline(always)]
    fn times_pow2(self, minus_n: V) -> V {
        // SAFETY: the vectors prove avx512f.
        unsafe { V(_mm512_scalef_ps(self.0, minus_n.0)) }
    }

    #[inline(always)]
    fn pow2_of_low_bits(self, bias: i32) -> V {
        // SAFETY: the vector proves avx512f.
        unsafe {
            let shifted = _mm512_slli_epi32::<23>(_mm512_castps_si512(self.0));
            V(_mm512_castsi512_ps(_mm512_add_epi32(shifted, _mm512_set1_epi32(bias << 23))))
        }
    }

    #[inline(always)]
    fn add_bits(self, o: V) -> V {
        // SAFETY: the vector proves avx512f.
        unsafe {
            let sum = _mm512_add_epi32(_mm512_castps_si512(self.0), _mm512_castps_si512(o.0));
            V(_mm512_castsi512_ps(sum))
        }
    }

    #[inline(always)]
    fn negate(self, lanes: u16) -> V {
        // SAFETY: the vector proves avx512dq.
        unsafe { V(_mm512_mask_xor_ps(self.0, lanes, self.0, _mm512_set1_ps(-0.0))) }
    }

    #[inline(always)]
    fn swap<const H: usize>(self) -> V {
        let x = self.0;
        // SAFETY: the vector proves avx512f.
        unsafe {
            V(match H {
                1 => _mm512_permute_ps::<0xb1>(x),
                2 => _mm512_permute_ps::<0x4e>(x),
                4 => _mm512_shuffle_f32x4::<0xb1>(x, x),
                _ => _mm512_shuffle_f32x4::<0x4e>(x, x),
            })
        }
    }

    #[inline(always)]
    fn butterfly<const H: usize>(self) -> V {
        // One multiply-add by 1 or -1, exact, instead of a sum and a change of signs.
        // SAFETY: the vector proves avx512f; 16 values are readable.
        unsafe {
            let signs = _mm512_loadu_ps(const { ones_less(H) }.as_ptr());
            V(_mm512_fmadd_ps(self.0, signs, self.swap::<H>().0))
        }
    }

    #[inline(always)]
    fn max_magnitude(self, o: V) -> V {
        // SAFETY: the vectors prove avx512f.
        unsafe {
            let larger = _mm512_max_epu32(_mm512_castps_si512(self.abs().0), _mm512_castps_si512(o.0));
            V(_mm512_castsi512_ps(larger))
        }
    }

    #[inline(always)]
    fn store_s8(self, x: &mut [i8; LANES]) {
        // SAFETY: the vector proves avx512f; 16 bytes are writable.
        unsafe { _mm_storeu_si128(x.as_mut_ptr().cast(), _mm512_cvtepi32_epi8(_mm512_cvtps_epi32(self.0))) }
    }

    #[inline(always)]
    fn store_low_bytes([a, b, c, d]: [V; 4], x: &mut [i8; 4 * LANES]) {
        // SAFETY: the vectors prove avx512f and avx512bw; 64 bytes are writable. 0xca: first ? second : third, bit by bit.
        unsafe {
            let (a, b) = (_mm512_castps_si512(a.0), _mm512_slli_epi32::<8>(_mm512_castps_si512(b.0)));
            let (c, d) = (_mm512_castps_si512(c.0), _mm512_slli_epi32::<8>(_mm512_castps_si512(d.0)));
            let low = _mm512_set1_epi32(0xff);
            let ab = _mm512_ternarylogic_epi32::<0xca>(low, a, b);
            let cd = _mm512_slli_epi32::<16>(_mm512_ternarylogic_epi32::<0xca>(low, c, d));
            _mm512_storeu_si512(x.as_mut_ptr().cast(), _mm512_mask_blend_epi16(0xaaaa_aaaa, ab, cd));
        }
    }
}

super::table::vector_kernels!(
    "vector_avx512",
    crate::cpu::Features::AVX2.with(crate::cpu::Features::AVX512),
    Avx512,
    "avx2,fma,f16c,avx512f,avx512bw,avx512vl,avx512dq"
);
crate::gemm::tile::gemm_entries!(Avx512, rows [1, 2, 4, 6, 8, 10, 12], panels [1, 2], "avx2,fma,f16c,avx512f,avx512bw,avx512vl,avx512dq");
