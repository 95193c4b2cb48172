//! Rows of int8 activations to the order in which a tile reads them: the quads of its rows side by side.

use super::pack::QUAD;
use crate::gemm::pack::MAX_MR;
use crate::prefetch::near_l1;
use crate::simd::{LANES, Simd};

/// Rows of int8 activations to be packed for a tile: `out[step][r] = from[r][4 step..][..4] ^ flip`.
pub(crate) struct QuadPack<'a> {
    /// At least `4 * steps` values each; an empty row is zeros.
    pub from: [&'a [i8]; MAX_MR],
    /// Steps of four values.
    pub steps: usize,
    /// Rows of the tile.
    pub width: usize,
    /// 0x80808080 turns s8 into s8 + 128 as u8; 0 keeps.
    pub flip: u32,
    /// `[steps][width]`, four bytes each.
    pub out: &'a mut [u32],
}

/// Rows of int8 activations to be packed for a tile of 16-bit activations: `out[step][r] = from[r][4 step..][..4]`.
pub(crate) struct WidePack<'a> {
    /// At least `4 * steps` values each; an empty row is zeros.
    pub from: [&'a [i8]; MAX_MR],
    /// Steps of four values.
    pub steps: usize,
    /// Rows of the tile.
    pub width: usize,
    /// `[steps][width]`.
    pub out: &'a mut [[i16; QUAD]],
}

/// Packs rows of bytes.
#[inline(always)]
pub(crate) fn pack_quads<S: Simd>(s: S, t: QuadPack) {
    transposed(s, &t.from, (t.steps, t.width), t.out, t.flip);
}

/// Packs rows of bytes as 16-bit values.
#[inline(always)]
pub(crate) fn pack_wide<S: Simd>(s: S, t: WidePack) {
    transposed(s, &t.from, (t.steps, t.width), t.out, 0);
}

/// A packed quad. Functions, not closures: those lose the instruction set where they are not inlined.
trait Quad: Copy {
    /// Of sixteen quads of bytes.
    fn of(quads: &[f32; LANES], flip: u32) -> [Self; LANES];
}

impl Quad for u32 {
    #[inline(always)]
    fn of(quads: &[f32; LANES], flip: u32) -> [u32; LANES] {
        let mut out = [0; LANES];
        for i in 0..LANES {
            out[i] = quads[i].to_bits() ^ flip;
        }
        out
    }
}

impl Quad for [i16; QUAD] {
    #[inline(always)]
    fn of(quads: &[f32; LANES], _flip: u32) -> [[i16; QUAD]; LANES] {
        let bytes: &[[i8; QUAD]; LANES] = bytemuck::cast_ref(quads);
        let mut out = [[0; QUAD]; LANES];
        for i in 0..LANES {
            for j in 0..QUAD {
                out[i][j] = i16::from(bytes[i][j]);
            }
        }
        out
    }
}

/// Bytes of a row asked for before they are packed.
const ROW_AHEAD: usize = 4 * LANES * QUAD;

/// Rows to quads in blocks of 16 x 16, transposed in registers (a quad moves like the bits of one f32).
#[inline(always)]
fn transposed<S: Simd, Q: Quad>(
    s: S,
    from: &[&[i8]; MAX_MR],
    (steps, width): (usize, usize),
    out: &mut [Q],
    flip: u32,
) {
    let out = &mut out[..steps * width];
    let mut q0 = 0;
    while q0 < steps {
        let len = LANES.min(steps - q0);
        let mut block = [[0.0f32; LANES]; LANES];
        for r in 0..width.min(MAX_MR) {
            if from[r].is_empty() {
                continue;
            }
            let row = &from[r][q0 * QUAD..(q0 + len) * QUAD];
            // Rows are far apart: more streams than the hardware follows.
            near_l1(row.as_ptr().wrapping_add(ROW_AHEAD));
            // Sixteen at once as one copy of known size: of unknown size it is a call of the C library.
            match row.first_chunk::<{ LANES * QUAD }>() {
                Some(row) => block[r] = bytemuck::cast(*row),
                None => {
                    for (b, quad) in block[r].iter_mut().zip(row.as_chunks::<QUAD>().0) {
                        *b = f32::from_bits(u32::from_ne_bytes(quad.map(|v| v as u8)));
                    }
                }
            }
        }
        s.transpose(&mut block);
        for (i, lanes) in block[..len].iter().enumerate() {
            let at = (q0 + i) * width;
            let quads = Q::of(lanes, flip);
            // Sixteen at once where there is room: what runs over is written again by the next step.
            match out[at..].first_chunk_mut::<LANES>() {
                Some(to) => *to = quads,
                None => out[at..at + width].copy_from_slice(&quads[..width]),
            }
        }
        q0 += len;
    }
}
