//! The one weight layout: K1N16 panels.
//!
//! Panel p holds outputs 16p..16p+15; inside it, for each input k in order, 16 consecutive values, one per
//! output: element (n, k) lies at `(n / 16 * K + k) * 16 + n % 16`. Outputs beyond n are zeros. With f32 one
//! step of k is one cache line; with f16 (IEEE half bits, round to nearest even) half a line.

use super::ahead::Ahead;
use crate::activation::relu_lanes;
use crate::simd::{LANES, Simd, Vector};

/// Outputs per panel.
pub const NR: usize = 16;

/// Values of a panel matrix.
#[derive(Clone, Copy, Debug)]
pub enum PanelData<'a> {
    /// f32.
    F32(&'a [f32]),
    /// IEEE half precision, as bits.
    F16(&'a [u16]),
}

impl<'a> PanelData<'a> {
    /// The values from one on.
    pub(crate) fn from(self, at: usize) -> PanelData<'a> {
        match self {
            PanelData::F32(d) => PanelData::F32(&d[at..]),
            PanelData::F16(d) => PanelData::F16(&d[at..]),
        }
    }

    /// Asks for the values from one on (it may lie behind the last), so many for each step.
    pub(crate) fn ahead(self, at: usize, per_step: usize) -> Ahead {
        match self {
            PanelData::F32(d) => Ahead::nothing(d).with_weights(d.as_ptr().wrapping_add(at), per_step),
            PanelData::F16(d) => Ahead::nothing(d).with_weights(d.as_ptr().wrapping_add(at), per_step),
        }
    }
}

/// A borrowed `[n, k]` weight matrix in panels.
#[derive(Clone, Copy, Debug)]
pub struct Panels<'a> {
    /// Outputs.
    pub n: usize,
    /// Inputs.
    pub k: usize,
    /// [`panel_len`] values.
    pub data: PanelData<'a>,
}

impl<'a> Panels<'a> {
    /// f32 panels; checks the length.
    pub fn f32(data: &'a [f32], n: usize, k: usize) -> Panels<'a> {
        Panels { n, k, data: PanelData::F32(data) }.checked()
    }

    /// f16 panels; checks the length.
    pub fn f16(data: &'a [u16], n: usize, k: usize) -> Panels<'a> {
        Panels { n, k, data: PanelData::F16(data) }.checked()
    }

    /// The same panels, after a check of the length.
    pub(crate) fn checked(self) -> Panels<'a> {
        let len = match self.data {
            PanelData::F32(d) => d.len(),
            PanelData::F16(d) => d.len(),
        };
        assert_eq!(len, panel_len(self.n, self.k), "panels of {} x {}", self.n, self.k);
        self
    }
}

/// Values in the panels of an `[n, k]` matrix: n rounded up to 16, times k.
pub fn panel_len(n: usize, k: usize) -> usize {
    n.next_multiple_of(NR) * k
}

fn pack<T: Copy + Default>(w: &[f32], (n, k): (usize, usize), out: &mut [T], convert: impl Fn(f32) -> T) {
    assert_eq!(w.len(), n * k, "weights of {n} x {k}");
    assert_eq!(out.len(), panel_len(n, k), "panels of {n} x {k}");
    if k == 0 {
        return;
    }
    for (p, panel) in out.chunks_exact_mut(k * NR).enumerate() {
        for (i, lanes) in panel.chunks_exact_mut(NR).enumerate() {
            for (l, o) in lanes.iter_mut().enumerate() {
                *o = if p * NR + l < n { convert(w[(p * NR + l) * k + i]) } else { T::default() };
            }
        }
    }
}

/// Packs row-major `w` `[n, k]`.
pub fn pack_f32(w: &[f32], n: usize, k: usize, out: &mut [f32]) {
    pack(w, (n, k), out, |v| v);
}

/// Packs row-major `w` `[n, k]`, rounding to half precision, ties to even.
pub fn pack_f16(w: &[f32], n: usize, k: usize, out: &mut [u16]) {
    pack(w, (n, k), out, |v| half::f16::from_f32(v).to_bits());
}

/// Back to row-major `[n, k]`.
pub fn unpack(panels: Panels) -> Vec<f32> {
    let Panels { n, k, data } = panels.checked();
    let mut w = Vec::with_capacity(n * k);
    for o in 0..n {
        for i in 0..k {
            let at = (o / NR * k + i) * NR + o % NR;
            w.push(match data {
                PanelData::F32(d) => d[at],
                PanelData::F16(d) => half::f16::from_bits(d[at]).to_f32(),
            });
        }
    }
    w
}

/// Tallest tile of any kernel.
pub(crate) const MAX_MR: usize = LANES;

/// What happens to a value on its way into a tile.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) enum Change {
    Keep,
    /// x < 0 ? 0 : x.
    Relu,
    Scale(f32),
}

/// Rows of activations to be packed for a tile: `out[k][r] = change(from[r][k])`.
pub(crate) struct RowPack<'a> {
    /// At least `k` values each; an empty row is zeros.
    pub from: [&'a [f32]; MAX_MR],
    /// Values of each row to take.
    pub k: usize,
    /// Rows of the tile.
    pub width: usize,
    /// Applied to every value.
    pub change: Change,
    /// `[k][width]`.
    pub out: &'a mut [f32],
}

/// `rows` rows of a matrix, the others empty.
#[inline]
pub(crate) fn strided(x: &[f32], stride: usize, rows: usize) -> [&[f32]; MAX_MR] {
    let mut from: [&[f32]; MAX_MR] = [&[]; MAX_MR];
    for (r, row) in from.iter_mut().enumerate().take(rows) {
        *row = &x[r * stride..];
    }
    from
}

/// Packs rows in blocks of 16 x 16, transposed in registers.
#[inline(always)]
pub(crate) fn pack_rows<S: Simd>(s: S, t: RowPack) {
    let RowPack { from, k, width, change, out } = t;
    let out = &mut out[..k * width];
    let mut k0 = 0;
    while k0 < k {
        let len = LANES.min(k - k0);
        let mut block = [[0.0f32; LANES]; LANES];
        for r in 0..width.min(MAX_MR) {
            if from[r].is_empty() {
                continue;
            }
            // Through a register: copied as arrays, these 64 bytes become calls of memcpy.
            if let Some(row) = from[r][k0..].first_chunk::<LANES>() {
                s.load(row).store(&mut block[r]);
            } else {
                block[r][..len].copy_from_slice(&from[r][k0..k0 + len]);
            }
            match change {
                Change::Keep => {}
                Change::Relu => relu_lanes(s, s.load(&block[r])).store(&mut block[r]),
                Change::Scale(f) => (s.load(&block[r]) * s.splat(f)).store(&mut block[r]),
            }
        }
        s.transpose(&mut block);
        for (i, lanes) in block[..len].iter().enumerate() {
            let at = (k0 + i) * width;
            // Sixteen at once where there is room: what runs over is written again by the next step.
            match out[at..].first_chunk_mut::<LANES>() {
                Some(to) => s.load(lanes).store(to),
                None => out[at..at + width].copy_from_slice(&lanes[..width]),
            }
        }
        k0 += len;
    }
}

/// f16 bits, whole vectors, as f32; exact.
#[inline(always)]
pub(crate) fn widen<S: Simd>(s: S, x: &[u16], out: &mut [f32]) {
    for (x, out) in x.as_chunks::<LANES>().0.iter().zip(out.as_chunks_mut::<LANES>().0) {
        s.load_f16(x).store(out);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn layout_and_round_trip() {
        let (n, k) = (19, 3);
        let w: Vec<f32> = (0..n * k).map(|v| v as f32).collect();
        let mut p = vec![9.0; panel_len(n, k)];
        pack_f32(&w, n, k, &mut p);
        assert_eq!(p[0..3], [0.0, 3.0, 6.0]);
        assert_eq!(p[16], 1.0);
        assert_eq!(p[48], 48.0);
        assert_eq!(p[51], 0.0);
        assert_eq!(unpack(Panels::f32(&p, n, k)), w);
        let mut h = vec![9; panel_len(n, k)];
        pack_f16(&w, n, k, &mut h);
        assert_eq!(unpack(Panels::f16(&h, n, k)), w);
        assert_eq!(panel_len(0, 5), 0);
        assert_eq!(panel_len(16, 5), 80);
    }
}
