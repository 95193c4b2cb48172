//! The list of int8 matrix kernels, best first. Selection, tests, benches and `doctor` read it.
#![allow(unsafe_code)]

use super::finish::FinishS8;
use super::product::ProductS8;
use super::rows::{QuadPack, WidePack};
use super::scalar;
use super::tile::{ColumnS8, TileS8};
#[cfg(target_arch = "x86_64")]
use super::{avx2, avx2wide, avx512vnni, avxvnni};
#[cfg(target_arch = "aarch64")]
use super::{neon, neondot};
use crate::cpu::{Features, Kernels};
use crate::gemm::tile::Windows;
use crate::quantize::MapOut;

/// How a kernel takes the bytes of activations.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Activations {
    /// As they are.
    Signed,
    /// As s8 + 128, unsigned; sums start at -128 times the sum of the output's weights.
    Offset128,
}

/// One kernel of the int8 family: s8 activations, s8 weights, exact i32 sums.
#[derive(Debug)]
pub struct GemmS8Kernel {
    /// `gemm_s8_{rows}x{columns}_{isa}`.
    pub name: &'static str,
    /// Features it needs.
    pub needs: Features,
    /// Rows of the full tile.
    pub mr: usize,
    /// Columns of the full tile, a multiple of 16.
    pub nr: usize,
    /// Row counts it can run, ascending; the last is `mr`. Fewer rows are packed up to the next one.
    pub rows: &'static [usize],
    /// How it takes activations.
    pub activations: Activations,
    /// Bytes that an activation takes in its memory: 1, or 2 where values are widened beforehand.
    pub bytes: usize,
    pub(crate) run: unsafe fn(TileS8, ()),
    /// The tile on windows in place.
    pub(crate) windows: unsafe fn(TileS8, Windows),
    /// Tiles of packed rows below one another.
    pub(crate) column: unsafe fn(ColumnS8),
    /// Full tiles of a product with their epilogue.
    pub(crate) product: unsafe fn(ProductS8),
    pub(crate) peak: unsafe fn(i32) -> i32,
}

impl GemmS8Kernel {
    /// Smallest row count it can run that holds `rows` (`rows <= mr`).
    pub(crate) fn fit(&self, rows: usize) -> usize {
        *self.rows.iter().find(|&&r| r >= rows).expect("at most mr rows")
    }

    /// Working memory as a map of pixels to be filled.
    pub(crate) fn map<'a>(&self, memory: &'a mut [f32]) -> MapOut<'a> {
        match (self.bytes, self.activations) {
            (1, Activations::Signed) => MapOut::Bytes(bytemuck::cast_slice_mut(memory), 0),
            (1, Activations::Offset128) => MapOut::Bytes(bytemuck::cast_slice_mut(memory), 0x80),
            _ => MapOut::Wide(bytemuck::cast_slice_mut(memory)),
        }
    }
}

/// Every kernel of the family.
pub static GEMM_S8: &[GemmS8Kernel] = &[
    #[cfg(target_arch = "x86_64")]
    GemmS8Kernel {
        name: "gemm_s8_12x32_avx512vnni",
        needs: Features::AVX2.with(Features::AVX512).with(Features::AVX512_VNNI),
        mr: 12,
        nr: 32,
        rows: &[1, 2, 4, 6, 8, 10, 12],
        activations: Activations::Offset128,
        bytes: 1,
        run: avx512vnni::gemm_s8,
        windows: avx512vnni::conv_s8,
        column: avx512vnni::column_s8,
        product: avx512vnni::product_s8,
        peak: avx512vnni::peak_s8,
    },
    #[cfg(target_arch = "x86_64")]
    GemmS8Kernel {
        name: "gemm_s8_6x16_avxvnni",
        needs: Features::AVX2.with(Features::AVX_VNNI),
        mr: 6,
        nr: 16,
        rows: &[1, 2, 3, 4, 5, 6],
        activations: Activations::Offset128,
        bytes: 1,
        run: avxvnni::gemm_s8,
        windows: avxvnni::conv_s8,
        column: avxvnni::column_s8,
        product: avxvnni::product_s8,
        peak: avxvnni::peak_s8,
    },
    #[cfg(target_arch = "x86_64")]
    GemmS8Kernel {
        name: "gemm_s8_6x16_avx2wide",
        needs: Features::AVX2,
        mr: 6,
        nr: 16,
        rows: &[1, 2, 3, 4, 5, 6],
        activations: Activations::Signed,
        bytes: 2,
        run: avx2wide::gemm_s8,
        windows: avx2wide::conv_s8,
        column: avx2wide::column_s8,
        product: avx2wide::product_s8,
        peak: avx2wide::peak_s8,
    },
    #[cfg(target_arch = "x86_64")]
    GemmS8Kernel {
        name: "gemm_s8_4x16_avx2",
        needs: Features::AVX2,
        mr: 4,
        nr: 16,
        rows: &[1, 2, 3, 4],
        activations: Activations::Signed,
        bytes: 1,
        run: avx2::gemm_s8,
        windows: avx2::conv_s8,
        column: avx2::column_s8,
        product: avx2::product_s8,
        peak: avx2::peak_s8,
    },
    #[cfg(target_arch = "aarch64")]
    GemmS8Kernel {
        name: "gemm_s8_6x16_neondot",
        needs: Features::NEON.with(Features::NEON_DOT),
        mr: 6,
        nr: 16,
        rows: &[1, 2, 3, 4, 5, 6],
        activations: Activations::Signed,
        bytes: 1,
        run: neondot::gemm_s8,
        windows: neondot::conv_s8,
        column: neondot::column_s8,
        product: neondot::product_s8,
        peak: neondot::peak_s8,
    },
    #[cfg(target_arch = "aarch64")]
    GemmS8Kernel {
        name: "gemm_s8_4x16_neon",
        needs: Features::NEON,
        mr: 4,
        nr: 16,
        rows: &[1, 2, 3, 4],
        activations: Activations::Signed,
        bytes: 1,
        run: neon::gemm_s8,
        windows: neon::conv_s8,
        column: neon::column_s8,
        product: neon::product_s8,
        peak: neon::peak_s8,
    },
    GemmS8Kernel {
        name: "gemm_s8_4x16_scalar",
        needs: Features::NONE,
        mr: 4,
        nr: 16,
        rows: &[1, 2, 4],
        activations: Activations::Signed,
        bytes: 1,
        run: scalar::gemm_s8,
        windows: scalar::conv_s8,
        column: scalar::column_s8,
        product: scalar::product_s8,
        peak: scalar::peak_s8,
    },
];

// A `Kernels` value only holds rows whose needs are among the detected features: the SAFETY argument of every call
// below. Lengths are checked inside, in safe code.
impl Kernels {
    /// Runs one tile of `gemm_s8`.
    #[inline]
    pub(crate) fn tile_s8(&self, tile: TileS8) {
        // SAFETY: chosen under the detected features.
        unsafe { (self.gemm_s8.run)(tile, ()) }
    }

    /// Runs one tile of `product_s8`, or of `gemm_s8` with `few` rows.
    #[inline]
    pub(crate) fn product_tile_s8(&self, few: bool, tile: TileS8) {
        // SAFETY: chosen under the detected features.
        unsafe { (self.products_s8(few).run)(tile, ()) }
    }

    /// Runs full tiles of `product_s8`, or of `gemm_s8` with `few` rows, with their epilogue.
    #[inline]
    pub(crate) fn product_tiles_s8(&self, few: bool, tiles: ProductS8) {
        // SAFETY: chosen under the detected features.
        unsafe { (self.products_s8(few).product)(tiles) }
    }

    /// The row for products: `product_s8`, or `gemm_s8` with `few` rows.
    #[inline]
    pub(crate) fn products_s8(&self, few: bool) -> &'static GemmS8Kernel {
        if few { self.gemm_s8 } else { self.product_s8 }
    }

    /// Runs one tile of `product_s8` on windows in place.
    #[inline]
    pub(crate) fn windows_s8(&self, tile: TileS8, at: Windows) {
        // SAFETY: chosen under the detected features.
        unsafe { (self.product_s8.windows)(tile, at) }
    }

    /// The peak probe of `product_s8`.
    #[inline]
    pub(crate) fn peak_s8(&self, seed: i32) -> i32 {
        // SAFETY: chosen under the detected features.
        unsafe { (self.product_s8.peak)(seed) }
    }

    /// Runs the tiles of all rows that share some panels, with the kernel that takes activations as bytes.
    #[inline]
    pub(crate) fn column_s8(&self, column: ColumnS8) {
        // SAFETY: chosen under the detected features.
        unsafe { (self.gemm_s8.column)(column) }
    }

    #[inline]
    pub(crate) fn pack_quads(&self, rows: QuadPack) {
        // SAFETY: chosen under the detected features.
        unsafe { (self.vector.pack_quads)(rows) }
    }

    #[inline]
    pub(crate) fn pack_wide(&self, rows: WidePack) {
        // SAFETY: chosen under the detected features.
        unsafe { (self.vector.pack_wide)(rows) }
    }

    #[inline]
    pub(crate) fn finish_s8(&self, tile: FinishS8) {
        // SAFETY: chosen under the detected features.
        unsafe { (self.vector.finish_s8)(tile) }
    }
}
