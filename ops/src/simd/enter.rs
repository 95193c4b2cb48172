//! The door for kernels of other crates: a body written over [`Simd`] runs with the instruction set of a
//! [`Kernels`] value. Tables stay for the network's own kernels, which are chosen row by row.
#![allow(unsafe_code)]

use super::Simd;
use crate::cpu::{Features, Kernels};

/// A kernel over any instruction set. Its fields are the arguments.
pub trait Body {
    /// What it returns.
    type Output;
    /// The kernel. Mark it, and all that it calls with vectors, `#[inline(always)]`: only code inlined into the
    /// entry point has its instructions.
    fn run<S: Simd>(self, s: S) -> Self::Output;
}

#[cfg(target_arch = "x86_64")]
#[target_feature(enable = "avx2,fma,f16c,avx512f,avx512bw,avx512vl,avx512dq")]
fn avx512<B: Body>(body: B) -> B::Output {
    body.run(super::avx512::Avx512::new())
}

#[cfg(target_arch = "x86_64")]
#[target_feature(enable = "avx2,fma,f16c")]
fn avx2<B: Body>(body: B) -> B::Output {
    body.run(super::avx2::Avx2::new())
}

#[cfg(target_arch = "aarch64")]
#[target_feature(enable = "neon")]
fn neon<B: Body>(body: B) -> B::Output {
    body.run(super::neon::Neon::new())
}

impl Kernels {
    /// Runs a body with the widest vectors of this set.
    #[inline]
    pub fn enter<B: Body>(&self, body: B) -> B::Output {
        #[cfg(target_arch = "x86_64")]
        if self.features.has(Features::AVX2.with(Features::AVX512)) {
            // SAFETY: `features` is a subset of what this CPU was found to have.
            return unsafe { avx512(body) };
        }
        #[cfg(target_arch = "x86_64")]
        if self.features.has(Features::AVX2) {
            // SAFETY: as above.
            return unsafe { avx2(body) };
        }
        #[cfg(target_arch = "aarch64")]
        if self.features.has(Features::NEON) {
            // SAFETY: as above.
            return unsafe { neon(body) };
        }
        body.run(super::scalar::Scalar::new())
    }
}
