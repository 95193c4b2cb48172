//! Portable vectors: an array of sixteen values. `f32::mul_add` is a fused multiply-add on every target, in
//! software where the target has none (correct, and some 17 times slower than AVX2).

use super::{LANES, Simd, Vector};
use std::ops::{Add, Div, Mul, Sub};

/// Token of the portable code; exists on every CPU.
#[derive(Clone, Copy)]
pub(crate) struct Scalar;

/// Sixteen lanes in memory.
#[derive(Clone, Copy)]
pub(crate) struct Lanes([f32; LANES]);

impl Scalar {
    /// The token.
    #[inline(always)]
    pub(crate) fn new() -> Self {
        Scalar
    }
}

impl Simd for Scalar {
    type V = Lanes;
    // The compiler's registers, whatever they are.
    const REGISTERS: usize = 8;

    #[inline(always)]
    fn splat(self, x: f32) -> Lanes {
        Lanes([x; LANES])
    }

    #[inline(always)]
    fn load(self, x: &[f32; LANES]) -> Lanes {
        Lanes(*x)
    }

    #[inline(always)]
    fn load_f16(self, x: &[u16; LANES]) -> Lanes {
        Lanes(x.map(|bits| half::f16::from_bits(bits).to_f32_const()))
    }

    #[inline(always)]
    fn load_i32(self, x: &[i32; LANES]) -> Lanes {
        Lanes(x.map(|v| v as f32))
    }
}

impl Lanes {
    #[inline(always)]
    fn zip(self, other: Lanes, f: impl Fn(f32, f32) -> f32) -> Lanes {
        Lanes(std::array::from_fn(|i| f(self.0[i], other.0[i])))
    }
}

impl Add for Lanes {
    type Output = Lanes;
    #[inline(always)]
    fn add(self, o: Lanes) -> Lanes {
        self.zip(o, |a, b| a + b)
    }
}

impl Sub for Lanes {
    type Output = Lanes;
    #[inline(always)]
    fn sub(self, o: Lanes) -> Lanes {
        self.zip(o, |a, b| a - b)
    }
}

impl Mul for Lanes {
    type Output = Lanes;
    #[inline(always)]
    fn mul(self, o: Lanes) -> Lanes {
        self.zip(o, |a, b| a * b)
    }
}

impl Div for Lanes {
    type Output = Lanes;
    #[inline(always)]
    fn div(self, o: Lanes) -> Lanes {
        self.zip(o, |a, b| a / b)
    }
}

impl Vector for Lanes {
    #[inline(always)]
    fn store(self, x: &mut [f32; LANES]) {
        *x = self.0;
    }

    #[inline(always)]
    fn mul_add(self, a: Lanes, b: Lanes) -> Lanes {
        Lanes(std::array::from_fn(|i| self.0[i].mul_add(a.0[i], b.0[i])))
    }

    #[inline(always)]
    fn max(self, o: Lanes) -> Lanes {
        self.zip(o, |a, b| if a > b { a } else { b })
    }

    #[inline(always)]
    fn min(self, o: Lanes) -> Lanes {
        self.zip(o, |a, b| if a < b { a } else { b })
    }

    #[inline(always)]
    fn select_gt(self, o: Lanes, yes: Lanes, no: Lanes) -> Lanes {
        Lanes(std::array::from_fn(|i| if self.0[i] > o.0[i] { yes.0[i] } else { no.0[i] }))
    }

    #[inline(always)]
    fn gt_bits(self, o: Lanes) -> u16 {
        (0..LANES).fold(0, |bits, i| bits | u16::from(self.0[i] > o.0[i]) << i)
    }

    #[inline(always)]
    fn abs(self) -> Lanes {
        Lanes(self.0.map(f32::abs))
    }

    #[inline(always)]
    fn sqrt(self) -> Lanes {
        Lanes(self.0.map(f32::sqrt))
    }

    #[inline(always)]
    fn times_pow2_of_low_bits(self, n: Lanes) -> Lanes {
        self.zip(n, |x, n| f32::from_bits(x.to_bits().wrapping_add(n.to_bits() << 23)))
    }

    #[inline(always)]
    fn pow2_of_low_bits(self, bias: i32) -> Lanes {
        Lanes(self.0.map(|x| f32::from_bits((x.to_bits() << 23).wrapping_add((bias as u32) << 23))))
    }

    #[inline(always)]
    fn add_bits(self, o: Lanes) -> Lanes {
        self.zip(o, |a, b| f32::from_bits(a.to_bits().wrapping_add(b.to_bits())))
    }

    #[inline(always)]
    fn negate(self, lanes: u16) -> Lanes {
        Lanes(std::array::from_fn(|i| f32::from_bits(self.0[i].to_bits() ^ (u32::from(lanes >> i & 1) << 31))))
    }

    #[inline(always)]
    fn swap<const H: usize>(self) -> Lanes {
        Lanes(std::array::from_fn(|i| self.0[i ^ H]))
    }

    #[inline(always)]
    fn max_magnitude(self, o: Lanes) -> Lanes {
        self.zip(o, |a, b| f32::from_bits(a.abs().to_bits().max(b.to_bits())))
    }

    #[inline(always)]
    fn store_s8(self, x: &mut [i8; LANES]) {
        *x = self.0.map(round_s8);
    }

    #[inline(always)]
    fn store_low_bytes(v: [Lanes; 4], x: &mut [i8; 4 * LANES]) {
        *x = std::array::from_fn(|i| v[i % 4].0[i / 4].to_bits() as i8);
    }
}

/// A value in [-127, 127] to the nearest integer, ties to even: adding 1.5 * 2^23 leaves it in the low bits.
#[inline(always)]
fn round_s8(x: f32) -> i8 {
    (x + 12_582_912.0).to_bits() as u8 as i8
}

/// Token of a vector with one lane, for the scalar functions: the same bodies, so the same bits.
#[derive(Clone, Copy)]
pub(crate) struct Single;

/// One lane.
#[derive(Clone, Copy)]
pub(crate) struct Lane(f32);

impl Lane {
    /// The lane.
    #[inline(always)]
    pub(crate) fn value(self) -> f32 {
        self.0
    }
}

impl Simd for Single {
    type V = Lane;
    const REGISTERS: usize = 8;

    #[inline(always)]
    fn splat(self, x: f32) -> Lane {
        Lane(x)
    }

    #[inline(always)]
    fn load(self, x: &[f32; LANES]) -> Lane {
        Lane(x[0])
    }

    #[inline(always)]
    fn load_f16(self, x: &[u16; LANES]) -> Lane {
        Lane(half::f16::from_bits(x[0]).to_f32_const())
    }

    #[inline(always)]
    fn load_i32(self, x: &[i32; LANES]) -> Lane {
        Lane(x[0] as f32)
    }
}

impl Add for Lane {
    type Output = Lane;
    #[inline(always)]
    fn add(self, o: Lane) -> Lane {
        Lane(self.0 + o.0)
    }
}

impl Sub for Lane {
    type Output = Lane;
    #[inline(always)]
    fn sub(self, o: Lane) -> Lane {
        Lane(self.0 - o.0)
    }
}

impl Mul for Lane {
    type Output = Lane;
    #[inline(always)]
    fn mul(self, o: Lane) -> Lane {
        Lane(self.0 * o.0)
    }
}

impl Div for Lane {
    type Output = Lane;
    #[inline(always)]
    fn div(self, o: Lane) -> Lane {
        Lane(self.0 / o.0)
    }
}

impl Vector for Lane {
    #[inline(always)]
    fn store(self, x: &mut [f32; LANES]) {
        x[0] = self.0;
    }

    #[inline(always)]
    fn mul_add(self, a: Lane, b: Lane) -> Lane {
        Lane(self.0.mul_add(a.0, b.0))
    }

    #[inline(always)]
    fn max(self, o: Lane) -> Lane {
        if self.0 > o.0 { self } else { o }
    }

    #[inline(always)]
    fn min(self, o: Lane) -> Lane {
        if self.0 < o.0 { self } else { o }
    }

    #[inline(always)]
    fn select_gt(self, o: Lane, yes: Lane, no: Lane) -> Lane {
        if self.0 > o.0 { yes } else { no }
    }

    #[inline(always)]
    fn gt_bits(self, o: Lane) -> u16 {
        u16::from(self.0 > o.0)
    }

    #[inline(always)]
    fn abs(self) -> Lane {
        Lane(self.0.abs())
    }

    #[inline(always)]
    fn sqrt(self) -> Lane {
        Lane(self.0.sqrt())
    }

    #[inline(always)]
    fn times_pow2_of_low_bits(self, n: Lane) -> Lane {
        Lane(f32::from_bits(self.0.to_bits().wrapping_add(n.0.to_bits() << 23)))
    }

    #[inline(always)]
    fn pow2_of_low_bits(self, bias: i32) -> Lane {
        Lane(f32::from_bits((self.0.to_bits() << 23).wrapping_add((bias as u32) << 23)))
    }

    #[inline(always)]
    fn add_bits(self, o: Lane) -> Lane {
        Lane(f32::from_bits(self.0.to_bits().wrapping_add(o.0.to_bits())))
    }

    #[inline(always)]
    fn negate(self, lanes: u16) -> Lane {
        Lane(f32::from_bits(self.0.to_bits() ^ (u32::from(lanes & 1) << 31)))
    }

    /// The only lane stays.
    #[inline(always)]
    fn swap<const H: usize>(self) -> Lane {
        self
    }

    #[inline(always)]
    fn max_magnitude(self, o: Lane) -> Lane {
        Lane(f32::from_bits(self.0.abs().to_bits().max(o.0.to_bits())))
    }

    #[inline(always)]
    fn store_s8(self, x: &mut [i8; LANES]) {
        x[0] = round_s8(self.0);
    }

    #[inline(always)]
    fn store_low_bytes(v: [Lane; 4], x: &mut [i8; 4 * LANES]) {
        for j in 0..4 {
            x[j] = v[j].0.to_bits() as i8;
        }
    }
}

super::table::vector_kernels!("vector_scalar", crate::cpu::Features::NONE, Scalar);
crate::gemm::tile::gemm_entries!(Scalar, rows [1, 2, 4], panels [1]);
