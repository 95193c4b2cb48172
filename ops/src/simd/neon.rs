//! NEON: sixteen lanes are four 128-bit registers.
//!
//! Tile 6 x 16: 24 accumulators, four weight registers and a broadcast leave three of the 32 registers.
#![allow(unsafe_code)]

use super::{LANES, Simd, Vector};
use std::arch::aarch64::*;
use std::ops::{Add, Div, Mul, Sub};

/// Token: this CPU has neon.
#[derive(Clone, Copy)]
pub(crate) struct Neon(());

/// Four lanes each, in order. Invariant: made from a [`Neon`] token only.
#[derive(Clone, Copy)]
pub(crate) struct V([float32x4_t; 4]);

impl Neon {
    /// The token; safe to call where the features are enabled.
    #[inline]
    #[target_feature(enable = "neon")]
    pub(crate) fn new() -> Self {
        Neon(())
    }
}

/// `f(a[i], b[i])` for the four registers, written out so that nothing is left to inline.
macro_rules! each {
    ($f:ident, $a:expr, $b:expr) => {
        V([$f($a.0[0], $b.0[0]), $f($a.0[1], $b.0[1]), $f($a.0[2], $b.0[2]), $f($a.0[3], $b.0[3])])
    };
}

// Every SAFETY line below: the token, or the vector made from it, proves neon; array references give the bounds.
impl Simd for Neon {
    type V = V;
    const REGISTERS: usize = 8;

    #[inline(always)]
    fn splat(self, x: f32) -> V {
        // SAFETY: the token proves neon.
        unsafe { V([vdupq_n_f32(x); 4]) }
    }

    #[inline(always)]
    fn load(self, x: &[f32; LANES]) -> V {
        let p = x.as_ptr();
        // SAFETY: the token proves neon; 16 values are readable.
        unsafe { V([vld1q_f32(p), vld1q_f32(p.add(4)), vld1q_f32(p.add(8)), vld1q_f32(p.add(12))]) }
    }

    #[inline(always)]
    fn load_f16(self, x: &[u16; LANES]) -> V {
        let p = x.as_ptr();
        // SAFETY: the token proves neon; 16 values of 2 bytes are readable.
        unsafe {
            V([widen(vld1_u16(p)), widen(vld1_u16(p.add(4))), widen(vld1_u16(p.add(8))), widen(vld1_u16(p.add(12)))])
        }
    }

    #[inline(always)]
    fn transpose_quads(self, v: [V; 4]) -> [V; 4] {
        let [V(a), V(b), V(c), V(d)] = v;
        [
            V([a[0], b[0], c[0], d[0]]),
            V([a[1], b[1], c[1], d[1]]),
            V([a[2], b[2], c[2], d[2]]),
            V([a[3], b[3], c[3], d[3]]),
        ]
    }

    #[inline(always)]
    fn load_i32(self, x: &[i32; LANES]) -> V {
        let p = x.as_ptr();
        // SAFETY: the token proves neon; 16 values are readable.
        unsafe {
            V([
                vcvtq_f32_s32(vld1q_s32(p)),
                vcvtq_f32_s32(vld1q_s32(p.add(4))),
                vcvtq_f32_s32(vld1q_s32(p.add(8))),
                vcvtq_f32_s32(vld1q_s32(p.add(12))),
            ])
        }
    }
}

/// Four half-precision values to f32; exact.
///
/// # Safety
/// The CPU has neon.
#[inline(always)]
unsafe fn widen(x: uint16x4_t) -> float32x4_t {
    let y: float32x4_t;
    // The intrinsic is younger than this crate's minimum compiler.
    // SAFETY: fcvtl is part of base AArch64 vectors and touches only its operands.
    unsafe {
        std::arch::asm!(
            "fcvtl {y:v}.4s, {x:v}.4h",
            y = out(vreg) y,
            x = in(vreg) x,
            options(pure, nomem, nostack, preserves_flags)
        );
    }
    y
}

impl Add for V {
    type Output = V;
    #[inline(always)]
    fn add(self, o: V) -> V {
        // SAFETY: the vector proves neon.
        unsafe { each!(vaddq_f32, self, o) }
    }
}

impl Sub for V {
    type Output = V;
    #[inline(always)]
    fn sub(self, o: V) -> V {
        // SAFETY: the vector proves neon.
        unsafe { each!(vsubq_f32, self, o) }
    }
}

impl Mul for V {
    type Output = V;
    #[inline(always)]
    fn mul(self, o: V) -> V {
        // SAFETY: the vector proves neon.
        unsafe { each!(vmulq_f32, self, o) }
    }
}

impl Div for V {
    type Output = V;
    #[inline(always)]
    fn div(self, o: V) -> V {
        // SAFETY: the vector proves neon.
        unsafe { each!(vdivq_f32, self, o) }
    }
}

/// a > b ? yes : no.
///
/// # Safety
/// The CPU has neon.
#[inline(always)]
unsafe fn select(a: float32x4_t, b: float32x4_t, yes: float32x4_t, no: float32x4_t) -> float32x4_t {
    // SAFETY: the caller's promise.
    unsafe { vbslq_f32(vcgtq_f32(a, b), yes, no) }
}

impl Vector for V {
    #[inline(always)]
    fn store(self, x: &mut [f32; LANES]) {
        let p = x.as_mut_ptr();
        // SAFETY: the vector proves neon; 16 values are writable.
        unsafe {
            vst1q_f32(p, self.0[0]);
            vst1q_f32(p.add(4), self.0[1]);
            vst1q_f32(p.add(8), self.0[2]);
            vst1q_f32(p.add(12), self.0[3]);
        }
    }

    #[inline(always)]
    fn mul_add(self, a: V, b: V) -> V {
        let (x, a, b) = (self.0, a.0, b.0);
        // SAFETY: the vector proves neon.
        unsafe {
            V([
                vfmaq_f32(b[0], x[0], a[0]),
                vfmaq_f32(b[1], x[1], a[1]),
                vfmaq_f32(b[2], x[2], a[2]),
                vfmaq_f32(b[3], x[3], a[3]),
            ])
        }
    }

    #[inline(always)]
    fn max(self, o: V) -> V {
        // Compare and select: fmax has other rules for NaN and zeros.
        self.select_gt(o, self, o)
    }

    #[inline(always)]
    fn min(self, o: V) -> V {
        // Compare and select: fmin has other rules for NaN and zeros.
        o.select_gt(self, self, o)
    }

    #[inline(always)]
    fn select_gt(self, o: V, yes: V, no: V) -> V {
        let (a, b, y, n) = (self.0, o.0, yes.0, no.0);
        // SAFETY: the vector proves neon.
        unsafe {
            V([
                select(a[0], b[0], y[0], n[0]),
                select(a[1], b[1], y[1], n[1]),
                select(a[2], b[2], y[2], n[2]),
                select(a[3], b[3], y[3], n[3]),
            ])
        }
    }

    #[inline(always)]
    fn gt_bits(self, o: V) -> u16 {
        let mut bits = 0;
        // SAFETY: the vector proves neon; the table holds 16 values.
        unsafe {
            for i in 0..4 {
                let chosen = vandq_u32(vcgtq_f32(self.0[i], o.0[i]), vld1q_u32(BIT.as_ptr().add(4 * i)));
                bits |= vaddvq_u32(chosen);
            }
        }
        bits as u16
    }

    #[inline(always)]
    fn sqrt(self) -> V {
        let [a, b, c, d] = self.0;
        // SAFETY: the vector proves neon.
        unsafe { V([vsqrtq_f32(a), vsqrtq_f32(b), vsqrtq_f32(c), vsqrtq_f32(d)]) }
    }

    #[inline(always)]
    fn abs(self) -> V {
        // SAFETY: the vector proves neon.
        unsafe { V([vabsq_f32(self.0[0]), vabsq_f32(self.0[1]), vabsq_f32(self.0[2]), vabsq_f32(self.0[3])]) }
    }

    #[inline(always)]
    fn neg_mul_add(self, a: V, b: V) -> V {
        let (x, a, b) = (self.0, a.0, b.0);
        // SAFETY: the vector proves neon.
        unsafe {
            V([
                vfmsq_f32(b[0], x[0], a[0]),
                vfmsq_f32(b[1], x[1], a[1]),
                vfmsq_f32(b[2], x[2], a[2]),
                vfmsq_f32(b[3], x[3], a[3]),
            ])
        }
    }

    #[inline(always)]
    fn times_pow2_of_low_bits(self, n: V) -> V {
        let mut y = self.0;
        // SAFETY: the vectors prove neon.
        unsafe {
            for (r, n) in y.iter_mut().zip(n.0) {
                let shifted = vshlq_n_s32::<23>(vreinterpretq_s32_f32(n));
                *r = vreinterpretq_f32_s32(vaddq_s32(vreinterpretq_s32_f32(*r), shifted));
            }
        }
        V(y)
    }

    #[inline(always)]
    fn pow2_of_low_bits(self, bias: i32) -> V {
        // SAFETY: the vector proves neon.
        unsafe {
            let bias = vdupq_n_s32(bias << 23);
            let mut y = self.0;
            for r in &mut y {
                *r = vreinterpretq_f32_s32(vaddq_s32(vshlq_n_s32::<23>(vreinterpretq_s32_f32(*r)), bias));
            }
            V(y)
        }
    }

    #[inline(always)]
    fn add_bits(self, o: V) -> V {
        let mut y = self.0;
        // SAFETY: the vector proves neon.
        unsafe {
            for (r, o) in y.iter_mut().zip(o.0) {
                *r = vreinterpretq_f32_u32(vaddq_u32(vreinterpretq_u32_f32(*r), vreinterpretq_u32_f32(o)));
            }
        }
        V(y)
    }

    #[inline(always)]
    fn negate(self, lanes: u16) -> V {
        let mut y = self.0;
        // SAFETY: the vector proves neon; the table holds 16 values.
        unsafe {
            let bits = vdupq_n_u32(u32::from(lanes));
            for (i, r) in y.iter_mut().enumerate() {
                let chosen = vtstq_u32(bits, vld1q_u32(BIT.as_ptr().add(4 * i)));
                let sign = vandq_u32(chosen, vdupq_n_u32(1 << 31));
                *r = vreinterpretq_f32_u32(veorq_u32(vreinterpretq_u32_f32(*r), sign));
            }
        }
        V(y)
    }

    #[inline(always)]
    fn swap<const H: usize>(self) -> V {
        let [a, b, c, d] = self.0;
        // SAFETY: the vector proves neon.
        unsafe {
            match H {
                1 => V([vrev64q_f32(a), vrev64q_f32(b), vrev64q_f32(c), vrev64q_f32(d)]),
                2 => V([vextq_f32::<2>(a, a), vextq_f32::<2>(b, b), vextq_f32::<2>(c, c), vextq_f32::<2>(d, d)]),
                4 => V([b, a, d, c]),
                _ => V([c, d, a, b]),
            }
        }
    }

    #[inline(always)]
    fn max_magnitude(self, o: V) -> V {
        let mut y = self.abs().0;
        // SAFETY: the vectors prove neon.
        unsafe {
            for (a, b) in y.iter_mut().zip(o.0) {
                *a = vreinterpretq_f32_u32(vmaxq_u32(vreinterpretq_u32_f32(*a), vreinterpretq_u32_f32(b)));
            }
        }
        V(y)
    }

    #[inline(always)]
    fn store_s8(self, x: &mut [i8; LANES]) {
        let [a, b, c, d] = self.0;
        // SAFETY: the vector proves neon; 16 bytes are writable.
        unsafe {
            let low = vcombine_s16(vmovn_s32(vcvtnq_s32_f32(a)), vmovn_s32(vcvtnq_s32_f32(b)));
            let high = vcombine_s16(vmovn_s32(vcvtnq_s32_f32(c)), vmovn_s32(vcvtnq_s32_f32(d)));
            vst1q_s8(x.as_mut_ptr(), vcombine_s8(vmovn_s16(low), vmovn_s16(high)));
        }
    }

    #[inline(always)]
    fn store_low_bytes([a, b, c, d]: [V; 4], x: &mut [i8; 4 * LANES]) {
        // SAFETY: the vectors prove neon; 64 bytes are writable.
        unsafe {
            for i in 0..4 {
                let (a, b) = (vreinterpretq_u32_f32(a.0[i]), vreinterpretq_u32_f32(b.0[i]));
                let (c, d) = (vreinterpretq_u32_f32(c.0[i]), vreinterpretq_u32_f32(d.0[i]));
                // Shift left and insert keeps the bits below.
                let bytes = vsliq_n_u32::<24>(vsliq_n_u32::<16>(vsliq_n_u32::<8>(a, b), c), d);
                vst1q_s8(x.as_mut_ptr().add(16 * i), vreinterpretq_s8_u32(bytes));
            }
        }
    }
}

/// Bit i of a lane mask.
static BIT: [u32; LANES] = {
    let mut bit = [0; LANES];
    let mut i = 0;
    while i < LANES {
        bit[i] = 1 << i;
        i += 1;
    }
    bit
};

super::table::vector_kernels!("vector_neon", crate::cpu::Features::NEON, Neon, "neon");
crate::gemm::tile::gemm_entries!(Neon, rows [1, 2, 3, 4, 5, 6], panels [1], "neon");
