//! Random-sign block Hadamard rotation: y = c H (d * x) on each block of a row.
//!
//! d is a vector of signs, H the unnormalised Hadamard matrix of order b (Sylvester: H_1 = 1, H_2b = [[H, H], [H, -H]]), c =
//! 1/sqrt(b). The rotation is orthogonal and spreads outlier channels over the block; weights rotated the same way
//! give the same products. b is the largest power of two up to 128 that divides the row, whose width must be a multiple
//! of 16.
//!
//! Stages run with distances 1, 2, 4, 8 inside a vector of 16 lanes, then 16, 32, 64 across vectors: only additions and
//! subtractions in one order, so the bits are the same everywhere. [`rotate_rows`] multiplies by c at the end; fused with
//! quantization ([`crate::quantize`]) c goes into the row's scale and costs nothing.

use crate::cpu::Ctx;
use crate::mat::MatMut;
use crate::opclock::{self, Op, Work};
use crate::par::SharedMut;
use crate::simd::{LANES, Simd, Vector};

/// Largest block.
pub const MAX_BLOCK: usize = 128;

/// The rotation of rows of one width.
#[derive(Clone, Copy, Debug)]
pub struct Rotation<'a> {
    width: usize,
    signs: &'a [u16],
}

impl<'a> Rotation<'a> {
    /// Rotation of rows of `width` values, a multiple of 16. Bit i % 16 of `signs[i / 16]` is set where value i is negated.
    pub fn new(width: usize, signs: &'a [u16]) -> Rotation<'a> {
        assert!(width > 0 && width.is_multiple_of(LANES), "rotation of {width} values: a multiple of 16 wanted");
        assert_eq!(signs.len(), width / LANES, "sign words of a rotation of {width} values");
        Rotation { width, signs }
    }

    /// Values of a row.
    pub fn width(&self) -> usize {
        self.width
    }

    /// Sign bits, sixteen a word.
    pub fn signs(&self) -> &'a [u16] {
        self.signs
    }

    /// Values of a block: the largest power of two up to 128 that divides the width.
    pub fn block(&self) -> usize {
        block(self.width)
    }

    /// 1/sqrt(block), to the nearest f32.
    pub fn normalizer(&self) -> f32 {
        (1.0 / (self.block() as f64).sqrt()) as f32
    }
}

/// The block of rows of `width` values: the largest power of two up to 128 that divides it.
pub fn block(width: usize) -> usize {
    1 << width.trailing_zeros().min(MAX_BLOCK.trailing_zeros())
}

/// Whole vectors of a row on their way into a rotation.
pub(crate) trait Vectors<S: Simd> {
    /// Vector i; `out` is what the result's place holds.
    fn at(&self, s: S, i: usize, out: &[f32; LANES]) -> S::V;
}

/// A row as it is.
pub(crate) struct Plain<'a>(pub &'a [[f32; LANES]]);

impl<S: Simd> Vectors<S> for Plain<'_> {
    #[inline(always)]
    fn at(&self, s: S, i: usize, _out: &[f32; LANES]) -> S::V {
        s.load(&self.0[i])
    }
}

/// The row that the result replaces.
struct InPlace;

impl<S: Simd> Vectors<S> for InPlace {
    #[inline(always)]
    fn at(&self, s: S, _i: usize, out: &[f32; LANES]) -> S::V {
        s.load(out)
    }
}

/// All stages of a block of `N` vectors.
#[inline(always)]
fn stages<V: Vector, const N: usize>(v: &mut [V; N]) {
    for v in v.iter_mut() {
        *v = v.butterfly::<1>().butterfly::<2>().butterfly::<4>().butterfly::<8>();
    }
    let mut h = 1;
    while h < N {
        for i in 0..N {
            if i & h == 0 {
                (v[i], v[i + h]) = (v[i] + v[i + h], v[i] - v[i + h]);
            }
        }
        h *= 2;
    }
}

/// Blocks of `N` vectors, unnormalised.
#[inline(always)]
fn blocks<S: Simd, X: Vectors<S>, const N: usize>(s: S, x: &X, out: &mut [f32], signs: &[u16]) -> S::V {
    let mut largest = s.splat(0.0);
    let out = out.as_chunks_mut::<LANES>().0.as_chunks_mut::<N>().0;
    for (b, (block, signs)) in out.iter_mut().zip(signs.as_chunks::<N>().0).enumerate() {
        let mut v = [largest; N];
        for i in 0..N {
            v[i] = x.at(s, b * N + i, &block[i]).negate(signs[i]);
        }
        stages(&mut v);
        for i in 0..N {
            largest = v[i].max_magnitude(largest);
            v[i].store(&mut block[i]);
        }
    }
    largest
}

/// Rotates a row without the factor 1/sqrt(block) into `out`, of the rotation's width; returns the largest magnitudes, lane by lane and by
/// their bits, so that NaN and infinities show.
#[inline(always)]
pub(crate) fn rotate_into<S: Simd, X: Vectors<S>>(s: S, x: X, out: &mut [f32], signs: &[u16], block: usize) -> S::V {
    match block {
        16 => blocks::<S, X, 1>(s, &x, out, signs),
        32 => blocks::<S, X, 2>(s, &x, out, signs),
        64 => blocks::<S, X, 4>(s, &x, out, signs),
        128 => blocks::<S, X, 8>(s, &x, out, signs),
        other => panic!("a Hadamard block of {other}"),
    }
}

/// Rotates a row without the factor 1/sqrt(block).
#[inline(always)]
pub(crate) fn rotate<S: Simd>(s: S, x: &mut [f32], signs: &[u16], block: usize) {
    rotate_into(s, InPlace, x, signs, block);
}

/// Values of one task: about 64 KiB.
const TASK: usize = 1 << 14;

/// Rotates every row of `x` in place.
pub fn rotate_rows(ctx: Ctx, rotation: Rotation, x: MatMut) {
    let (rows, cols, stride) = (x.rows, x.cols, x.stride);
    assert_eq!(cols, rotation.width, "width of a rotation");
    let c = rotation.normalizer();
    let _span = opclock::span(Op::Quantize, || Work::values(rows * cols));
    let per_task = (TASK / cols).max(1);
    let shared = SharedMut::new(x.data);
    ctx.pool.run(rows.div_ceil(per_task), &|task, _| {
        for r in task * per_task..((task + 1) * per_task).min(rows) {
            // SAFETY: rows are disjoint (stride >= cols) and each belongs to one task.
            #[allow(unsafe_code)]
            let row = unsafe { shared.slice(r * stride..r * stride + cols) };
            ctx.kernels.rotate(row, rotation.signs, rotation.block());
            row.iter_mut().for_each(|v| *v *= c);
        }
    });
}
