//! The one weight layout: K1N16 panels.
//!
//! Panel p holds outputs 16p..16p+15; inside it, for each input k in order, 16 consecutive values, one per
//! output: element (n, k) lies at `(n / 16 * K + k) * 16 + n % 16`. Outputs beyond n are zeros. With f32 one
//! step of k is one cache line; with f16 (IEEE half bits, round to nearest even) half a line.

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

/// Rows of activations to be packed for a tile: `out[k][r] = scale * x[r][k]`.
pub(crate) struct RowPack<'a> {
    /// Row 0.
    pub x: &'a [f32],
    /// Values from one row to the next.
    pub stride: usize,
    /// Rows that exist.
    pub rows: usize,
    /// Values of each row to take.
    pub k: usize,
    /// Rows of the tile; those beyond `rows` are zeros.
    pub width: usize,
    /// Factor of every value.
    pub scale: f32,
    /// `[k][width]`.
    pub out: &'a mut [f32],
}

/// Steps of k taken from one row before the next: a cache line of each row stays in use.
const STEP: usize = 16;

/// Packs rows. Plain indexing: it moves each value once for every pass over the weights.
#[inline(always)]
pub(crate) fn pack_rows(t: RowPack) {
    let RowPack { x, stride, rows, k, width, scale, out } = t;
    let out = &mut out[..k * width];
    if rows < width {
        out.fill(0.0);
    }
    for k0 in (0..k).step_by(STEP) {
        let len = STEP.min(k - k0);
        let block = &mut out[k0 * width..][..len * width];
        for r in 0..rows {
            let from = &x[r * stride + k0..][..len];
            for (v, o) in from.iter().zip(block[r..].iter_mut().step_by(width)) {
                *o = v * scale;
            }
        }
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
