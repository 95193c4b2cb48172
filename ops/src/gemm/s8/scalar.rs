//! Portable byte dot product: the oracle for exactness, not for speed.

use super::pack::{QUAD, STEP};
use super::tile::Dot8;
use crate::simd::LANES;

/// Token of the portable code; exists on every CPU.
#[derive(Clone, Copy)]
pub(crate) struct Scalar;

impl Scalar {
    /// The token.
    #[inline(always)]
    pub(crate) fn new() -> Self {
        Scalar
    }
}

impl Dot8 for Scalar {
    type Elem = i8;
    type W = [i8; STEP];
    type A = [i8; QUAD];
    type Acc = [i32; LANES];

    #[inline(always)]
    fn zero(self) -> [i32; LANES] {
        [0; LANES]
    }

    #[inline(always)]
    fn load(self, _pass: usize, x: &[i32; LANES]) -> [i32; LANES] {
        *x
    }

    #[inline(always)]
    fn store(self, _pass: usize, acc: [i32; LANES], x: &mut [i32; LANES]) {
        *x = acc;
    }

    #[inline(always)]
    fn load_w(self, _pass: usize, x: &[i8; STEP]) -> [i8; STEP] {
        *x
    }

    #[inline(always)]
    fn prep_a(self, quad: &[i8; QUAD]) -> [i8; QUAD] {
        *quad
    }

    #[inline(always)]
    fn dot(self, mut acc: [i32; LANES], a: [i8; QUAD], w: [i8; STEP]) -> [i32; LANES] {
        for (sum, w) in acc.iter_mut().zip(w.as_chunks::<QUAD>().0) {
            for i in 0..QUAD {
                // Wrapping only for the peak probe, which sums without end; products check their k.
                *sum = sum.wrapping_add(i32::from(a[i]) * i32::from(w[i]));
            }
        }
        acc
    }
}

super::tile::gemm_s8_entries!(Scalar, crate::simd::scalar::Scalar, rows [1, 2, 4], panels [1], full 4 x 1);
