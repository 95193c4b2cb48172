//! An int8 matrix as it lies in a blob: panels, scales, sums, signs.
//!
//! ```text
//! panels    round16(n) * round4(k) bytes, value (n, k) at ((n / 16 * Q + k / 4) * 16 + n % 16) * 4 + k % 4, Q = round4(k) / 4
//! scales    round16(n) f32: real weight = value * scale of its output
//! sums      round16(n) i32: the sum of an output's values
//! signs     one bit per rotated input, 16 a little-endian word; absent without rotation
//! ```
//!
//! n and k are those of [`TensorSpec::matrix`]. Values beyond n and k, scales and sums beyond n are zeros. Every
//! section but the signs is a multiple of 64 bytes.
//!
//! With a rotation the stored matrix is W R^T, for inputs that arrive as R x: R = H D / sqrt(b) on every block of
//! b consecutive input channels, D the diagonal of signs (bit set = -1), H the Hadamard matrix of order b in
//! Sylvester's order. A convolution rotates its input channels, the same for every pixel of its window.

use crate::arch::{Role, TensorSpec};
use crate::panel::LANES;

/// Consecutive inputs of one output.
pub const QUAD: usize = 4;
/// Bytes of one step of a panel: sixteen outputs, four inputs.
pub const STEP: usize = LANES * QUAD;
/// Largest block of a rotation.
pub const MAX_BLOCK: usize = 128;
/// Most inputs: kernels' sums stay exact in 32 bits.
pub const MAX_K: usize = 65_536;
/// Largest and, inverted, smallest scale.
pub const MAX_SCALE: f32 = (1u64 << 60) as f32;

/// Channels that a rotation of a matrix's inputs spans: all inputs of a linear layer, the input channels of a
/// convolution; `None` for what is no matrix.
pub fn rotated_width(spec: &TensorSpec) -> Option<usize> {
    match spec.role {
        Role::Linear | Role::Conv => Some(spec.shape[1]),
        Role::ConvTranspose => Some(spec.shape[0]),
        _ => None,
    }
}

/// The block of a rotation over `width` channels, the largest power of two up to [`MAX_BLOCK`] that divides it;
/// `None` where the width is no multiple of 16, so that it cannot be rotated.
pub fn rotation_block(width: usize) -> Option<usize> {
    (width > 0 && width.is_multiple_of(LANES)).then(|| 1 << width.trailing_zeros().min(MAX_BLOCK.trailing_zeros()))
}

/// Places of the sections of an int8 matrix.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Int8Layout {
    /// Outputs.
    pub n: usize,
    /// Inputs.
    pub k: usize,
    /// Sign words, one per 16 rotated channels; 0 without rotation.
    pub words: usize,
}

impl Int8Layout {
    /// Of a matrix, rotated or not; `None` for what cannot be stored so: no matrix, too many inputs, or a rotation
    /// over a width that has none.
    pub fn of(spec: &TensorSpec, rotated: bool) -> Option<Int8Layout> {
        let (n, k) = spec.matrix()?;
        let width = rotated_width(spec)?;
        let words = if rotated { rotation_block(width).map(|_| width / LANES)? } else { 0 };
        (k <= MAX_K).then_some(Int8Layout { n, k, words })
    }

    /// Outputs in memory.
    pub fn lanes(&self) -> usize {
        self.n.next_multiple_of(LANES)
    }

    /// Bytes of the panels.
    pub fn panels(&self) -> usize {
        self.lanes() * self.k.next_multiple_of(QUAD)
    }

    /// Start of the scales.
    pub fn scales(&self) -> usize {
        self.panels()
    }

    /// Start of the sums.
    pub fn sums(&self) -> usize {
        self.scales() + 4 * self.lanes()
    }

    /// Start of the signs.
    pub fn signs(&self) -> usize {
        self.sums() + 4 * self.lanes()
    }

    /// Bytes of everything.
    pub fn bytes(&self) -> usize {
        self.signs() + 2 * self.words
    }

    /// Place of value (output, input) in the panels.
    pub fn place(&self, o: usize, i: usize) -> usize {
        (o / LANES * self.k.div_ceil(QUAD) + i / QUAD) * STEP + o % LANES * QUAD + i % QUAD
    }
}

/// An int8 matrix in the file.
#[derive(Clone, Copy, Debug)]
pub struct Int8<'a> {
    /// Sizes.
    pub layout: Int8Layout,
    /// Panels, [`Int8Layout::panels`] values in [-127, 127].
    pub data: &'a [i8],
    /// One per output.
    pub scales: &'a [f32],
    /// One per output.
    pub sums: &'a [i32],
    /// One bit per rotated channel; empty without rotation.
    pub signs: &'a [u16],
}

impl<'a> Int8<'a> {
    /// The sections of `bytes`, which must be [`Int8Layout::bytes`] long and 64-byte aligned.
    pub fn new(layout: Int8Layout, bytes: &'a [u8]) -> Int8<'a> {
        assert_eq!(bytes.len(), layout.bytes(), "bytes of an int8 matrix");
        Int8 {
            layout,
            data: bytemuck::cast_slice(&bytes[..layout.panels()]),
            scales: &bytemuck::cast_slice(&bytes[layout.scales()..layout.sums()])[..layout.n],
            sums: &bytemuck::cast_slice(&bytes[layout.sums()..layout.signs()])[..layout.n],
            signs: bytemuck::cast_slice(&bytes[layout.signs()..]),
        }
    }
}

/// A row of input channels rotated in place, in f64: x becomes H D x / sqrt(b) on every block.
pub fn rotate(x: &mut [f64], signs: &[u16]) {
    let block = rotation_block(x.len()).unwrap_or_else(|| panic!("a rotation of {} channels", x.len()));
    assert_eq!(signs.len() * LANES, x.len(), "sign words of a rotation");
    for (i, v) in x.iter_mut().enumerate() {
        if signs[i / LANES] >> (i % LANES) & 1 == 1 {
            *v = -*v;
        }
    }
    x.chunks_exact_mut(block).for_each(hadamard);
}

/// [`rotate`] undone: D H x / sqrt(b), since H is symmetric and its own inverse but for the factor.
pub fn unrotate(x: &mut [f64], signs: &[u16]) {
    let block = rotation_block(x.len()).unwrap_or_else(|| panic!("a rotation of {} channels", x.len()));
    x.chunks_exact_mut(block).for_each(hadamard);
    for (i, v) in x.iter_mut().enumerate() {
        if signs[i / LANES] >> (i % LANES) & 1 == 1 {
            *v = -*v;
        }
    }
}

/// One block, by stages of distance 1, 2, 4, ...
fn hadamard(x: &mut [f64]) {
    let mut h = 1;
    while h < x.len() {
        for pair in x.chunks_exact_mut(2 * h) {
            let (a, b) = pair.split_at_mut(h);
            for (a, b) in a.iter_mut().zip(b) {
                (*a, *b) = (*a + *b, *a - *b);
            }
        }
        h *= 2;
    }
    let c = 1.0 / (x.len() as f64).sqrt();
    x.iter_mut().for_each(|v| *v *= c);
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn rotations_are_orthogonal_and_undone() {
        for width in [16, 48, 64, 160, 384] {
            let signs: Vec<u16> = (0..width / 16).map(|w| (w * 40_503 + 12_345) as u16).collect();
            let x: Vec<f64> = (0..width).map(|i| ((i * 37) % 23) as f64 - 11.0).collect();
            let mut y = x.clone();
            rotate(&mut y, &signs);
            let norm = |v: &[f64]| v.iter().map(|a| a * a).sum::<f64>();
            assert!((norm(&x) / norm(&y) - 1.0).abs() < 1e-12);
            // By definition: entry (i, j) of a block is (-1)^popcount(i & j) / sqrt(b), columns signed.
            let b = rotation_block(width).unwrap();
            for (i, got) in y.iter().enumerate() {
                let first = i / b * b;
                let want: f64 = (0..b)
                    .map(|j| {
                        let minus = ((i % b) & j).count_ones() % 2 + u32::from(signs[(first + j) / 16] >> (j % 16) & 1);
                        x[first + j] * f64::from(1 - 2 * (minus as i32 % 2)) / (b as f64).sqrt()
                    })
                    .sum();
                assert!((got - want).abs() < 1e-12, "{width} {i}");
            }
            unrotate(&mut y, &signs);
            assert!(x.iter().zip(&y).all(|(a, b)| (a - b).abs() < 1e-12));
        }
        assert_eq!(
            [8, 16, 40, 96, 192, 4096].map(rotation_block),
            [None, Some(16), None, Some(32), Some(64), Some(128)]
        );
    }

    #[test]
    fn sections_follow_each_other() {
        let spec = TensorSpec { name: "t".into(), shape: vec![19, 48], role: Role::Linear };
        let s = Int8Layout::of(&spec, true).unwrap();
        assert_eq!((s.panels(), s.sums() - s.scales(), s.signs(), s.bytes()), (32 * 48, 128, 32 * 48 + 256, 1798));
        assert_eq!([s.place(0, 0), s.place(1, 0), s.place(0, 4), s.place(16, 0)], [0, 4, 64, 12 * 64]);
        // A convolution rotates channels, not window positions.
        let spec = TensorSpec { shape: vec![3, 32, 3, 3], role: Role::Conv, ..spec };
        assert_eq!(Int8Layout::of(&spec, true), Some(Int8Layout { n: 3, k: 288, words: 2 }));
        let narrow = TensorSpec { shape: vec![3, 20], role: Role::Linear, ..spec };
        assert_eq!((Int8Layout::of(&narrow, true), Int8Layout::of(&narrow, false).map(|s| s.words)), (None, Some(0)));
    }
}
