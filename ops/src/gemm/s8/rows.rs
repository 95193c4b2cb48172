//! Rows of int8 activations to the order in which a tile reads them: the quads of its rows side by side.

use super::pack::QUAD;
use crate::gemm::pack::MAX_MR;
use crate::prefetch::near_l1;
use crate::simd::{LANES, Simd, Vector};

/// Rows of int8 activations to be packed for a tile: `out[step][r] = from[r][4 step..][..4] ^ flip`.
pub(crate) struct QuadPack<'a> {
    /// At least `4 * steps` values each; an empty row is zeros.
    pub from: &'a [&'a [i8]; MAX_MR],
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
    pub from: &'a [&'a [i8]; MAX_MR],
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
    transposed(s, t.from, (t.steps, t.width), t.out, t.flip);
}

/// Packs rows of bytes as 16-bit values.
#[inline(always)]
pub(crate) fn pack_wide<S: Simd>(s: S, t: WidePack) {
    transposed(s, t.from, (t.steps, t.width), t.out, 0);
}

/// A packed quad. Functions, not closures: those lose the instruction set where they are not inlined.
trait Quad: Copy {
    /// Of sixteen quads of bytes.
    fn of(quads: &[f32; LANES], flip: u32) -> [Self; LANES];
    /// To memory, through registers.
    fn put<S: Simd>(s: S, quads: &[Self; LANES], to: &mut [Self; LANES]);
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

    #[inline(always)]
    fn put<S: Simd>(s: S, quads: &[u32; LANES], to: &mut [u32; LANES]) {
        s.load(bytemuck::cast_ref(quads)).store(bytemuck::cast_mut(to));
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

    #[inline(always)]
    fn put<S: Simd>(s: S, quads: &[[i16; QUAD]; LANES], to: &mut [[i16; QUAD]; LANES]) {
        let quads: &[[f32; LANES]; 2] = bytemuck::cast_ref(quads);
        let to: &mut [[f32; LANES]; 2] = bytemuck::cast_mut(to);
        for i in 0..2 {
            s.load(&quads[i]).store(&mut to[i]);
        }
    }
}

/// The first `width` of sixteen quads to `out` from `at` on. All of them where there is room: what runs over is written again by the
/// next step. Through registers: as a copy it is merged with the other one into a call of the C library.
#[inline(always)]
fn put_some<S: Simd, Q: Quad>(s: S, quads: &[Q; LANES], out: &mut [Q], (at, width): (usize, usize)) {
    match out[at..].first_chunk_mut::<LANES>() {
        Some(to) => Q::put(s, quads, to),
        None => out[at..at + width].copy_from_slice(&quads[..width]),
    }
}

/// The first `width` quads of each of `steps`, flipped.
#[inline(always)]
pub(crate) fn cut<'a, S: Simd>(
    s: S,
    steps: impl Iterator<Item = &'a [u32]>,
    (width, flip): (usize, u32),
    out: &mut [u32],
) {
    let mut at = 0;
    for from in steps {
        let from = from.first_chunk::<LANES>().expect("a vector of slack");
        put_some(s, &u32::of(bytemuck::cast_ref(from), flip), out, (at, width));
        at += width;
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
            put_some(s, &Q::of(lanes, flip), out, ((q0 + i) * width, width));
        }
        q0 += len;
    }
}
