//! The tile: acc[r][n] += sum over k of a[k][r] * w[k][n], in order of k with fused multiply-adds.
//!
//! Operands are packed: `a` holds for each k the `rows` activations of the tile; `w` is read in place from the
//! panels. Sums live in memory as `[panel][row][16]` between calls, so blocking over k continues them and the
//! bits never depend on the blocking. Written once; every instruction set instantiates it.

use super::{Act, PanelData, WeightType};
use crate::activation::{gelu_lanes, relu_lanes};
use crate::simd::{LANES, Simd, Vector};

/// One step of a product.
pub(crate) struct Tile<'a> {
    /// Rows, one of the kernel's counts.
    pub rows: usize,
    /// Panels, up to the kernel's nr / 16.
    pub panels: usize,
    /// Steps.
    pub k: usize,
    /// `[k][rows]`.
    pub a: &'a [f32],
    /// First panel at its first step.
    pub w: PanelData<'a>,
    /// Values from one panel to the next.
    pub w_stride: usize,
    /// Row 0 of panel 0.
    pub acc: &'a mut [f32],
    /// Values from one panel's sums to the next.
    pub acc_stride: usize,
}

impl PanelData<'_> {
    pub(crate) fn weights(&self) -> WeightType {
        match self {
            PanelData::F32(_) => WeightType::F32,
            PanelData::F16(_) => WeightType::F16,
        }
    }
}

/// A weight as stored.
pub(crate) trait Weight: Copy {
    fn load<S: Simd>(s: S, x: &[Self; LANES]) -> S::V;
}

impl Weight for f32 {
    #[inline(always)]
    fn load<S: Simd>(s: S, x: &[f32; LANES]) -> S::V {
        s.load(x)
    }
}

impl Weight for u16 {
    #[inline(always)]
    fn load<S: Simd>(s: S, x: &[u16; LANES]) -> S::V {
        s.load_f16(x)
    }
}

/// The tile with `MR` rows and `NV` panels; all sums stay in registers.
#[inline(always)]
pub(crate) fn body<S: Simd, W: Weight, const MR: usize, const NV: usize>(s: S, w: &[W], t: Tile) {
    let k = t.k;
    let a = &t.a.as_chunks::<MR>().0[..k];
    let mut panels: [&[[W; LANES]]; NV] = [&[]; NV];
    let mut acc = [[s.splat(0.0); NV]; MR];
    for v in 0..NV {
        panels[v] = &w[v * t.w_stride..][..k * LANES].as_chunks::<LANES>().0[..k];
        let sums = &t.acc[v * t.acc_stride..][..MR * LANES].as_chunks::<LANES>().0[..MR];
        for r in 0..MR {
            acc[r][v] = s.load(&sums[r]);
        }
    }
    for i in 0..k {
        let mut wv = [s.splat(0.0); NV];
        for v in 0..NV {
            wv[v] = W::load(s, &panels[v][i]);
        }
        let row = &a[i];
        for r in 0..MR {
            let x = s.splat(row[r]);
            for v in 0..NV {
                acc[r][v] = x.mul_add(wv[v], acc[r][v]);
            }
        }
    }
    for v in 0..NV {
        let sums = &mut t.acc[v * t.acc_stride..][..MR * LANES].as_chunks_mut::<LANES>().0[..MR];
        for r in 0..MR {
            acc[r][v].store(&mut sums[r]);
        }
    }
}

/// `gemm_f32` and `gemm_f16` of one instruction set: one body per row count and panel count.
macro_rules! gemm_entries {
    ($token:ident, rows $rows:tt, panels [$($panels:literal),*] $(, $features:literal)?) => {
        /// Tile with f32 weights.
        $(#[target_feature(enable = $features)])?
        pub(crate) fn gemm_f32(t: crate::gemm::tile::Tile) {
            let crate::gemm::PanelData::F32(w) = t.w else { panic!("f32 kernel on other weights") };
            match t.panels {
                $($panels => crate::gemm::tile::by_rows!($token, w, t, $panels, $rows),)*
                other => panic!("a tile of {other} panels"),
            }
        }

        /// Tile with f16 weights.
        $(#[target_feature(enable = $features)])?
        pub(crate) fn gemm_f16(t: crate::gemm::tile::Tile) {
            let crate::gemm::PanelData::F16(w) = t.w else { panic!("f16 kernel on other weights") };
            match t.panels {
                $($panels => crate::gemm::tile::by_rows!($token, w, t, $panels, $rows),)*
                other => panic!("a tile of {other} panels"),
            }
        }
    };
}
pub(crate) use gemm_entries;

macro_rules! by_rows {
    ($token:ident, $w:ident, $t:ident, $panels:literal, [$($rows:literal),*]) => {
        match $t.rows {
            $($rows => crate::gemm::tile::body::<_, _, $rows, $panels>($token::new(), $w, $t),)*
            other => panic!("a tile of {other} rows"),
        }
    };
}
pub(crate) use by_rows;

/// The epilogue of a finished tile, in place on its sums.
pub(crate) struct Finish<'a> {
    /// `[panel][row][16]`.
    pub acc: &'a mut [f32],
    /// Values from one panel's sums to the next.
    pub acc_stride: usize,
    /// Rows in use.
    pub rows: usize,
    /// Per panel, zeros beyond n.
    pub bias: Option<&'a [[f32; LANES]]>,
    /// Activation.
    pub act: Act,
    /// Per panel.
    pub gamma: Option<&'a [[f32; LANES]]>,
    /// Panels in use.
    pub panels: usize,
}

/// y = act(acc + bias) * gamma; every step rounds once.
#[inline(always)]
pub(crate) fn finish<S: Simd>(s: S, t: Finish) {
    for p in 0..t.panels {
        let rows = &mut t.acc[p * t.acc_stride..][..t.rows * LANES].as_chunks_mut::<LANES>().0[..t.rows];
        if let Some(bias) = t.bias {
            let b = s.load(&bias[p]);
            for row in rows.iter_mut() {
                (s.load(row) + b).store(row);
            }
        }
        match t.act {
            Act::None => {}
            Act::Gelu => {
                for row in rows.iter_mut() {
                    gelu_lanes(s, s.load(row)).store(row);
                }
            }
            Act::Relu => {
                for row in rows.iter_mut() {
                    relu_lanes(s, s.load(row)).store(row);
                }
            }
        }
        if let Some(gamma) = t.gamma {
            let g = s.load(&gamma[p]);
            for row in rows.iter_mut() {
                (s.load(row) * g).store(row);
            }
        }
    }
}
