//! The list of vector kernels, best first, and the one safe way to call them.
//!
//! A row holds entry points compiled for one instruction set; each is the generic body of the op named in its
//! comment. A new instruction set is a file beside this one with an `impl Simd` and a `vector_kernels!` line, and
//! a row in [`VECTOR`].
#![allow(unsafe_code)]

use crate::activation::Map;
use crate::attention::heads::{KeyPack, QueryPack, ValuePack};
use crate::attention::softmax::{MergeS8, Rows, SoftmaxTile, WeightsS8};
use crate::cpu::{Features, Kernels};
use crate::gemm::finish::Finish;
use crate::gemm::pack::RowPack;
use crate::gemm::s8::finish::FinishS8;
use crate::gemm::s8::rows::{QuadPack, WidePack};
use crate::layernorm::NormRow;
use crate::peak::Width;
use crate::quantize::{QuantizeRow, ToMap};
use crate::resize::BilinearRow;
use crate::rope::RopeRow;

/// The element-wise and row-wise kernels of one instruction set.
#[derive(Debug)]
pub struct VectorKernels {
    /// `vector_{isa}`.
    pub name: &'static str,
    /// Features they need.
    pub needs: Features,
    /// `activation::map_body`.
    pub(crate) map: unsafe fn(Map, &mut [f32]),
    /// `elementwise::add_body`: x += y.
    pub(crate) add: unsafe fn(&mut [f32], &[f32]),
    /// `layernorm::norm_row`.
    pub(crate) norm: unsafe fn(NormRow),
    /// `rope::rope_row`.
    pub(crate) rope: unsafe fn(RopeRow),
    /// `attention::softmax::softmax_tile`.
    pub(crate) softmax: unsafe fn(SoftmaxTile),
    /// `attention::softmax::store_rows`.
    pub(crate) store_rows: unsafe fn(Rows),
    /// `attention::softmax::weights_tile`.
    pub(crate) weights_s8: unsafe fn(WeightsS8),
    /// `attention::softmax::merge_tile`.
    pub(crate) merge_s8: unsafe fn(MergeS8),
    /// `attention::heads::pack_keys`.
    pub(crate) pack_keys: unsafe fn(KeyPack),
    /// `attention::heads::pack_queries`.
    pub(crate) pack_queries: unsafe fn(QueryPack),
    /// `attention::heads::pack_values`.
    pub(crate) pack_values: unsafe fn(ValuePack),
    /// `gemm::finish::finish`.
    pub(crate) finish: unsafe fn(Finish),
    /// `gemm::pack::pack_rows`.
    pub(crate) pack: unsafe fn(RowPack),
    /// `gemm::pack::widen`.
    pub(crate) widen: unsafe fn(&[u16], &mut [f32]),
    /// `gemm::s8::rows::pack_quads`.
    pub(crate) pack_quads: unsafe fn(QuadPack),
    /// `gemm::s8::rows::pack_wide`.
    pub(crate) pack_wide: unsafe fn(WidePack),
    /// `gemm::s8::finish::finish`.
    pub(crate) finish_s8: unsafe fn(FinishS8),
    /// `hadamard::rotate`.
    pub(crate) rotate: unsafe fn(&mut [f32], &[u16], usize),
    /// `quantize::quantize_row`.
    pub(crate) quantize: unsafe fn(QuantizeRow) -> f32,
    /// `quantize::largest_body`.
    pub(crate) largest: unsafe fn(&[f32], bool) -> f32,
    /// `quantize::to_map`.
    pub(crate) to_map: unsafe fn(ToMap),
    /// `resize::bilinear_row`.
    pub(crate) bilinear: unsafe fn(BilinearRow),
    /// `peak::peak_body`.
    pub(crate) peak: unsafe fn(Width, f32) -> f32,
}

/// Every set.
pub static VECTOR: &[&VectorKernels] = &[
    #[cfg(target_arch = "x86_64")]
    &super::avx512::VECTOR,
    #[cfg(target_arch = "x86_64")]
    &super::avx2::VECTOR,
    #[cfg(target_arch = "aarch64")]
    &super::neon::VECTOR,
    &super::scalar::VECTOR,
];

/// One static row of entry points: each takes the token, which is safe to make where the features are on.
macro_rules! vector_kernels {
    ($name:literal, $needs:expr, $token:ident $(, $features:literal)?) => {
        pub(crate) static VECTOR: crate::simd::table::VectorKernels = {
            $(#[target_feature(enable = $features)])?
            fn map(op: crate::activation::Map, x: &mut [f32]) {
                crate::activation::map_body($token::new(), op, x);
            }
            $(#[target_feature(enable = $features)])?
            fn add(x: &mut [f32], y: &[f32]) {
                crate::elementwise::add_body($token::new(), x, y);
            }
            $(#[target_feature(enable = $features)])?
            fn norm(row: crate::layernorm::NormRow) {
                crate::layernorm::norm_row($token::new(), row);
            }
            $(#[target_feature(enable = $features)])?
            fn rope(row: crate::rope::RopeRow) {
                crate::rope::rope_row($token::new(), row);
            }
            $(#[target_feature(enable = $features)])?
            fn softmax(tile: crate::attention::softmax::SoftmaxTile) {
                crate::attention::softmax::softmax_tile($token::new(), tile);
            }
            $(#[target_feature(enable = $features)])?
            fn store_rows(tile: crate::attention::softmax::Rows) {
                crate::attention::softmax::store_rows($token::new(), tile);
            }
            $(#[target_feature(enable = $features)])?
            fn weights_s8(tile: crate::attention::softmax::WeightsS8) {
                crate::attention::softmax::weights_tile($token::new(), tile);
            }
            $(#[target_feature(enable = $features)])?
            fn merge_s8(tile: crate::attention::softmax::MergeS8) {
                crate::attention::softmax::merge_tile($token::new(), tile);
            }
            $(#[target_feature(enable = $features)])?
            fn pack_keys(rows: crate::attention::heads::KeyPack) {
                crate::attention::heads::pack_keys($token::new(), rows);
            }
            $(#[target_feature(enable = $features)])?
            fn pack_queries(rows: crate::attention::heads::QueryPack) {
                crate::attention::heads::pack_queries($token::new(), rows);
            }
            $(#[target_feature(enable = $features)])?
            fn pack_values(rows: crate::attention::heads::ValuePack) {
                crate::attention::heads::pack_values($token::new(), rows);
            }
            $(#[target_feature(enable = $features)])?
            fn finish(tile: crate::gemm::finish::Finish) {
                crate::gemm::finish::finish($token::new(), &tile);
            }
            $(#[target_feature(enable = $features)])?
            fn pack(rows: crate::gemm::pack::RowPack) {
                crate::gemm::pack::pack_rows($token::new(), rows);
            }
            $(#[target_feature(enable = $features)])?
            fn widen(x: &[u16], out: &mut [f32]) {
                crate::gemm::pack::widen($token::new(), x, out);
            }
            $(#[target_feature(enable = $features)])?
            fn pack_quads(rows: crate::gemm::s8::rows::QuadPack) {
                crate::gemm::s8::rows::pack_quads($token::new(), rows);
            }
            $(#[target_feature(enable = $features)])?
            fn pack_wide(rows: crate::gemm::s8::rows::WidePack) {
                crate::gemm::s8::rows::pack_wide($token::new(), rows);
            }
            $(#[target_feature(enable = $features)])?
            fn finish_s8(tile: crate::gemm::s8::finish::FinishS8) {
                crate::gemm::finish::finish($token::new(), &tile);
            }
            $(#[target_feature(enable = $features)])?
            fn rotate(x: &mut [f32], signs: &[u16], block: usize) {
                crate::hadamard::rotate($token::new(), x, signs, block);
            }
            $(#[target_feature(enable = $features)])?
            fn quantize(row: crate::quantize::QuantizeRow) -> f32 {
                crate::quantize::quantize_row($token::new(), row)
            }
            $(#[target_feature(enable = $features)])?
            fn largest(x: &[f32], relu: bool) -> f32 {
                crate::quantize::largest_body($token::new(), x, relu)
            }
            $(#[target_feature(enable = $features)])?
            fn to_map(pixels: crate::quantize::ToMap) {
                crate::quantize::to_map($token::new(), pixels);
            }
            $(#[target_feature(enable = $features)])?
            fn bilinear(row: crate::resize::BilinearRow) {
                crate::resize::bilinear_row($token::new(), row);
            }
            $(#[target_feature(enable = $features)])?
            fn peak(width: crate::peak::Width, seed: f32) -> f32 {
                crate::peak::peak_body($token::new(), width, seed)
            }
            crate::simd::table::VectorKernels {
                name: $name,
                needs: $needs,
                map,
                add,
                norm,
                rope,
                softmax,
                store_rows,
                weights_s8,
                merge_s8,
                pack_keys,
                pack_queries,
                pack_values,
                finish,
                pack,
                widen,
                pack_quads,
                pack_wide,
                finish_s8,
                rotate,
                quantize,
                largest,
                to_map,
                bilinear,
                peak,
            }
        };
    };
}
pub(crate) use vector_kernels;

// A `Kernels` value is only made by `Kernels::choose`, which takes rows whose needs are among the detected
// features; this is the SAFETY argument of every call below. Lengths are checked inside the bodies, which
// are safe code.
impl Kernels {
    #[inline]
    pub(crate) fn map(&self, op: Map, x: &mut [f32]) {
        // SAFETY: chosen under the detected features.
        unsafe { (self.vector.map)(op, x) }
    }

    #[inline]
    pub(crate) fn add(&self, x: &mut [f32], y: &[f32]) {
        // SAFETY: chosen under the detected features.
        unsafe { (self.vector.add)(x, y) }
    }

    #[inline]
    pub(crate) fn norm(&self, row: NormRow) {
        // SAFETY: chosen under the detected features.
        unsafe { (self.vector.norm)(row) }
    }

    #[inline]
    pub(crate) fn rope(&self, row: RopeRow) {
        // SAFETY: chosen under the detected features.
        unsafe { (self.vector.rope)(row) }
    }

    #[inline]
    pub(crate) fn softmax(&self, tile: SoftmaxTile) {
        // SAFETY: chosen under the detected features.
        unsafe { (self.vector.softmax)(tile) }
    }

    #[inline]
    pub(crate) fn store_rows(&self, tile: Rows) {
        // SAFETY: chosen under the detected features.
        unsafe { (self.vector.store_rows)(tile) }
    }

    #[inline]
    pub(crate) fn weights_s8(&self, tile: WeightsS8) {
        // SAFETY: chosen under the detected features.
        unsafe { (self.vector.weights_s8)(tile) }
    }

    #[inline]
    pub(crate) fn merge_s8(&self, tile: MergeS8) {
        // SAFETY: chosen under the detected features.
        unsafe { (self.vector.merge_s8)(tile) }
    }

    #[inline]
    pub(crate) fn pack_keys(&self, rows: KeyPack) {
        // SAFETY: chosen under the detected features.
        unsafe { (self.vector.pack_keys)(rows) }
    }

    #[inline]
    pub(crate) fn pack_queries(&self, rows: QueryPack) {
        // SAFETY: chosen under the detected features.
        unsafe { (self.vector.pack_queries)(rows) }
    }

    #[inline]
    pub(crate) fn pack_values(&self, rows: ValuePack) {
        // SAFETY: chosen under the detected features.
        unsafe { (self.vector.pack_values)(rows) }
    }

    #[inline]
    pub(crate) fn finish(&self, tile: Finish) {
        // SAFETY: chosen under the detected features.
        unsafe { (self.vector.finish)(tile) }
    }

    #[inline]
    pub(crate) fn pack(&self, rows: RowPack) {
        // SAFETY: chosen under the detected features.
        unsafe { (self.vector.pack)(rows) }
    }

    #[inline]
    pub(crate) fn widen(&self, x: &[u16], out: &mut [f32]) {
        // SAFETY: chosen under the detected features.
        unsafe { (self.vector.widen)(x, out) }
    }

    #[inline]
    pub(crate) fn rotate(&self, x: &mut [f32], signs: &[u16], block: usize) {
        // SAFETY: chosen under the detected features.
        unsafe { (self.vector.rotate)(x, signs, block) }
    }

    /// The scale of the row.
    #[inline]
    pub(crate) fn quantize(&self, row: QuantizeRow) -> f32 {
        // SAFETY: chosen under the detected features.
        unsafe { (self.vector.quantize)(row) }
    }

    /// Largest magnitude, NaN when a value is not finite.
    #[inline]
    pub(crate) fn largest(&self, x: &[f32], relu: bool) -> f32 {
        // SAFETY: chosen under the detected features.
        unsafe { (self.vector.largest)(x, relu) }
    }

    #[inline]
    pub(crate) fn to_map(&self, pixels: ToMap) {
        // SAFETY: chosen under the detected features.
        unsafe { (self.vector.to_map)(pixels) }
    }

    #[inline]
    pub(crate) fn bilinear(&self, row: BilinearRow) {
        // SAFETY: chosen under the detected features.
        unsafe { (self.vector.bilinear)(row) }
    }

    #[inline]
    pub(crate) fn peak(&self, width: Width, seed: f32) -> f32 {
        // SAFETY: chosen under the detected features.
        unsafe { (self.vector.peak)(width, seed) }
    }
}
