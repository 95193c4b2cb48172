//! The list of matrix kernels, best first.

use crate::cpu::Features;

/// One kernel of the f32/f16-weight family.
#[derive(Debug)]
pub struct GemmKernel {
    /// `gemm_{weights}_{rows}x{columns}_{isa}`.
    pub name: &'static str,
    /// Features it needs.
    pub needs: Features,
    half: bool,
}

impl GemmKernel {
    /// Whether the weights are f16.
    pub fn is_half(&self) -> bool {
        self.half
    }
}

/// Every kernel of the family.
pub static GEMM_F: &[GemmKernel] = &[
    GemmKernel { name: "gemm_f32_4x16_scalar", needs: Features::NONE, half: false },
    GemmKernel { name: "gemm_f16_4x16_scalar", needs: Features::NONE, half: true },
];
