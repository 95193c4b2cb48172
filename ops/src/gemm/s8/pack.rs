//! int8 layouts: weights in K4N16 panels, activations in rows padded to four.
//!
//! Panel p holds outputs 16p..16p+15; inside it, for each four inputs in order, sixteen outputs of four consecutive
//! bytes: element (n, k) lies at `((n / 16 * Q + k / 4) * 16 + n % 16) * 4 + k % 4` with Q = k rounded up to four, over four. One
//! step of four inputs is 64 bytes, one cache line. Inputs beyond k and outputs beyond n are zeros.
//!
//! Values are symmetric, in [-127, 127]: -128 has no negative and would overflow the 16-bit step of the AVX2 kernel.

use crate::gemm::NR;

/// Consecutive inputs of one output in a panel.
pub const QUAD: usize = 4;
/// Bytes of one step of a panel: sixteen outputs, four inputs.
pub(crate) const STEP: usize = NR * QUAD;
/// Largest magnitude of a quantized value.
pub const MAX_S8: i8 = 127;
/// Most inputs of a product: 65,536 products of at most 255 x 127 stay below 2^31.
pub const MAX_K_S8: usize = 65_536;

/// A borrowed `[n, k]` int8 weight matrix in K4N16 panels: real weight = value * scale of its output.
#[derive(Clone, Copy, Debug)]
pub struct PanelsS8<'a> {
    /// Outputs.
    pub n: usize,
    /// Inputs, at most [`MAX_K_S8`].
    pub k: usize,
    /// [`panel_len_s8`] values in [-127, 127].
    pub data: &'a [i8],
    /// `[n]`, the step of each output.
    pub scales: &'a [f32],
    /// `[n]`, the sum of each output's values ([`col_sums`]); read by kernels that take activations as u8.
    pub col_sums: &'a [i32],
}

impl<'a> PanelsS8<'a> {
    /// The same panels, after a check of the lengths.
    pub(crate) fn checked(self) -> PanelsS8<'a> {
        let PanelsS8 { n, k, data, scales, col_sums } = self;
        assert!(k <= MAX_K_S8, "{k} inputs of an int8 product, {MAX_K_S8} at most");
        assert_eq!(data.len(), panel_len_s8(n, k), "int8 panels of {n} x {k}");
        assert!(scales.len() == n && col_sums.len() == n, "{} scales, {} sums, {n}", scales.len(), col_sums.len());
        self
    }
}

/// Inputs of a row in memory: `k` rounded up to four.
pub fn padded_k(k: usize) -> usize {
    k.next_multiple_of(QUAD)
}

/// Bytes in the panels of an `[n, k]` matrix: n rounded up to 16, times k rounded up to 4.
pub fn panel_len_s8(n: usize, k: usize) -> usize {
    n.next_multiple_of(NR) * padded_k(k)
}

/// Place of element (output, input).
fn place(o: usize, i: usize, k: usize) -> usize {
    (o / NR * padded_k(k) / QUAD + i / QUAD) * STEP + o % NR * QUAD + i % QUAD
}

/// Packs row-major `w` `[n, k]`, values in [-127, 127].
pub fn pack_s8(w: &[i8], n: usize, k: usize, out: &mut [i8]) {
    assert_eq!(w.len(), n * k, "weights of {n} x {k}");
    assert_eq!(out.len(), panel_len_s8(n, k), "int8 panels of {n} x {k}");
    out.fill(0);
    for o in 0..n {
        for i in 0..k {
            let v = w[o * k + i];
            assert!(v >= -MAX_S8, "weight {v} of output {o}, input {i}: -127 to 127 wanted");
            out[place(o, i, k)] = v;
        }
    }
}

/// Back to row-major `[n, k]`.
pub fn unpack_s8(data: &[i8], n: usize, k: usize) -> Vec<i8> {
    assert_eq!(data.len(), panel_len_s8(n, k), "int8 panels of {n} x {k}");
    let mut w = Vec::with_capacity(n * k);
    for o in 0..n {
        for i in 0..k {
            w.push(data[place(o, i, k)]);
        }
    }
    w
}

/// Sum of each output's values over the panels `data` -> `[n]`.
pub fn col_sums(data: &[i8], n: usize, k: usize) -> Vec<i32> {
    assert!(k <= MAX_K_S8, "{k} inputs of an int8 product, {MAX_K_S8} at most");
    assert_eq!(data.len(), panel_len_s8(n, k), "int8 panels of {n} x {k}");
    (0..n).map(|o| (0..k).map(|i| i32::from(data[place(o, i, k)])).sum()).collect()
}

/// Borrowed int8 activations `[m, k]`: real value = value * scale of its row.
#[derive(Clone, Copy, Debug)]
pub struct RowsS8<'a> {
    /// Rows.
    pub m: usize,
    /// Values of a row in use.
    pub k: usize,
    /// `[m, padded_k(k)]`, values in [-127, 127], zeros beyond k.
    pub data: &'a [i8],
    /// `[m]`, the step of each row.
    pub scales: &'a [f32],
}

impl<'a> RowsS8<'a> {
    /// The same rows, after a check of the lengths.
    pub(crate) fn checked(self) -> RowsS8<'a> {
        let RowsS8 { m, k, data, scales } = self;
        assert_eq!(data.len(), m * padded_k(k), "int8 rows of {m} x {k}");
        assert_eq!(scales.len(), m, "scales of {m} int8 rows");
        self
    }
}

/// Writable int8 activations, as [`RowsS8`].
#[derive(Debug)]
pub struct RowsS8Mut<'a> {
    /// Rows.
    pub m: usize,
    /// Values of a row in use.
    pub k: usize,
    /// `[m, padded_k(k)]`.
    pub data: &'a mut [i8],
    /// `[m]`.
    pub scales: &'a mut [f32],
}

impl RowsS8Mut<'_> {
    /// The same rows, read-only.
    pub fn as_rows(&self) -> RowsS8<'_> {
        RowsS8 { m: self.m, k: self.k, data: self.data, scales: self.scales }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn layout_and_round_trip() {
        let (n, k) = (19, 6);
        let w: Vec<i8> = (0..n * k).map(|v| v as i8).collect();
        let mut p = vec![9; panel_len_s8(n, k)];
        pack_s8(&w, n, k, &mut p);
        assert_eq!(p.len(), 32 * 8);
        // Output 0 inputs 0..4, output 1 inputs 0..4, and the tail of two.
        assert_eq!(p[..8], [0, 1, 2, 3, 6, 7, 8, 9]);
        assert_eq!(p[64..72], [4, 5, 0, 0, 10, 11, 0, 0]);
        // Output 16 opens the second panel; outputs 19..31 are zeros.
        assert_eq!(p[128..132], [96, 97, 98, 99]);
        assert!(p[128 + 12..192].iter().all(|&v| v == 0));
        assert_eq!(unpack_s8(&p, n, k), w);
        let sums: Vec<i32> = w.chunks(k).map(|r| r.iter().map(|&v| i32::from(v)).sum()).collect();
        assert_eq!(col_sums(&p, n, k), sums);
        assert_eq!((panel_len_s8(0, 5), panel_len_s8(16, 5), padded_k(0)), (0, 128, 0));
    }

    #[test]
    #[should_panic(expected = "weight -128 of output 1, input 0")]
    fn minus_128_is_refused() {
        pack_s8(&[0, -128], 2, 1, &mut [0; 64]);
    }
}
