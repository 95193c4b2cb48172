//! The list of vector kernels, best first.

use crate::cpu::Features;

/// The element-wise and row-wise kernels of one instruction set.
#[derive(Debug)]
pub struct VectorKernels {
    /// `vector_{isa}`.
    pub name: &'static str,
    /// Features they need.
    pub needs: Features,
}

/// Every set.
pub static VECTOR: &[VectorKernels] = &[VectorKernels { name: "vector_scalar", needs: Features::NONE }];
