//! Scalar exp, sigmoid, erf and gelu with the same bits as the vector bodies.

/// e^x.
pub fn exp(x: f32) -> f32 {
    crate::reference::exp(x)
}

/// 1 / (1 + e^-x).
pub fn sigmoid(x: f32) -> f32 {
    crate::reference::sigmoid(x)
}

/// Error function.
pub fn erf(x: f32) -> f32 {
    crate::reference::erf(f64::from(x)) as f32
}

/// x Phi(x), erf form.
pub fn gelu(x: f32) -> f32 {
    crate::reference::gelu(x)
}
