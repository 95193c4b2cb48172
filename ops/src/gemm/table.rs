//! The list of matrix kernels, best first. Selection, tests, benches and `doctor` read it; a kernel exists
//! when it has a row here.
#![allow(unsafe_code)]

use super::tile::{Tile, Windows};
use crate::cpu::{Features, Kernels};
#[cfg(target_arch = "aarch64")]
use crate::simd::neon;
use crate::simd::scalar;
#[cfg(target_arch = "x86_64")]
use crate::simd::{avx2, avx512};

/// Storage of a kernel's weights.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum WeightType {
    /// f32.
    F32,
    /// IEEE half precision.
    F16,
}

/// One kernel of the f32/f16-weight family: f32 activations, f32 sums.
#[derive(Debug)]
pub struct GemmKernel {
    /// `gemm_{weights}_{rows}x{columns}_{isa}`.
    pub name: &'static str,
    /// Features it needs.
    pub needs: Features,
    /// Weights it reads.
    pub weights: WeightType,
    /// Rows of the full tile.
    pub mr: usize,
    /// Columns of the full tile, a multiple of 16.
    pub nr: usize,
    /// Row counts it can run, ascending; the last is `mr`. Fewer rows are packed up to the next one.
    pub rows: &'static [usize],
    pub(crate) run: unsafe fn(Tile, ()),
    /// The tile on windows in place.
    pub(crate) windows: unsafe fn(Tile, Windows),
}

impl GemmKernel {
    /// Smallest row count it can run that holds `rows` (`rows <= mr`).
    pub(crate) fn fit(&self, rows: usize) -> usize {
        *self.rows.iter().find(|&&r| r >= rows).expect("at most mr rows")
    }
}

#[cfg(target_arch = "x86_64")]
const AVX512: Features = Features::AVX2.with(Features::AVX512);

/// Every kernel of the family.
pub static GEMM_F: &[GemmKernel] = &[
    #[cfg(target_arch = "x86_64")]
    GemmKernel {
        name: "gemm_f32_12x32_avx512",
        needs: AVX512,
        weights: WeightType::F32,
        mr: 12,
        nr: 32,
        rows: &[1, 2, 4, 6, 8, 10, 12],
        run: avx512::gemm_f32,
        windows: avx512::conv_f32,
    },
    #[cfg(target_arch = "x86_64")]
    GemmKernel {
        name: "gemm_f16_12x32_avx512",
        needs: AVX512,
        weights: WeightType::F16,
        mr: 12,
        nr: 32,
        rows: &[1, 2, 4, 6, 8, 10, 12],
        run: avx512::gemm_f16,
        windows: avx512::conv_f16,
    },
    #[cfg(target_arch = "x86_64")]
    GemmKernel {
        name: "gemm_f32_6x16_avx2",
        needs: Features::AVX2,
        weights: WeightType::F32,
        mr: 6,
        nr: 16,
        rows: &[1, 2, 3, 4, 5, 6],
        run: avx2::gemm_f32,
        windows: avx2::conv_f32,
    },
    #[cfg(target_arch = "x86_64")]
    GemmKernel {
        name: "gemm_f16_6x16_avx2",
        needs: Features::AVX2,
        weights: WeightType::F16,
        mr: 6,
        nr: 16,
        rows: &[1, 2, 3, 4, 5, 6],
        run: avx2::gemm_f16,
        windows: avx2::conv_f16,
    },
    #[cfg(target_arch = "aarch64")]
    GemmKernel {
        name: "gemm_f32_6x16_neon",
        needs: Features::NEON,
        weights: WeightType::F32,
        mr: 6,
        nr: 16,
        rows: &[1, 2, 3, 4, 5, 6],
        run: neon::gemm_f32,
        windows: neon::conv_f32,
    },
    #[cfg(target_arch = "aarch64")]
    GemmKernel {
        name: "gemm_f16_6x16_neon",
        needs: Features::NEON,
        weights: WeightType::F16,
        mr: 6,
        nr: 16,
        rows: &[1, 2, 3, 4, 5, 6],
        run: neon::gemm_f16,
        windows: neon::conv_f16,
    },
    GemmKernel {
        name: "gemm_f32_4x16_scalar",
        needs: Features::NONE,
        weights: WeightType::F32,
        mr: 4,
        nr: 16,
        rows: &[1, 2, 4],
        run: scalar::gemm_f32,
        windows: scalar::conv_f32,
    },
    GemmKernel {
        name: "gemm_f16_4x16_scalar",
        needs: Features::NONE,
        weights: WeightType::F16,
        mr: 4,
        nr: 16,
        rows: &[1, 2, 4],
        run: scalar::gemm_f16,
        windows: scalar::conv_f16,
    },
];

impl Kernels {
    /// The kernel for these weights.
    pub(crate) fn gemm(&self, weights: WeightType) -> &'static GemmKernel {
        match weights {
            WeightType::F32 => self.gemm_f32,
            WeightType::F16 => self.gemm_f16,
        }
    }

    /// Runs one tile.
    #[inline]
    pub(crate) fn tile(&self, tile: Tile) {
        let kernel = self.gemm(tile.w.weights());
        // SAFETY: a `Kernels` value only holds rows whose needs are among the detected features; lengths are
        // checked inside, in safe code.
        unsafe { (kernel.run)(tile, ()) }
    }

    /// Runs one tile on windows in place.
    #[inline]
    pub(crate) fn windows(&self, tile: Tile, at: Windows) {
        let kernel = self.gemm(tile.w.weights());
        // SAFETY: as above.
        unsafe { (kernel.windows)(tile, at) }
    }
}
