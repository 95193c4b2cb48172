//! Vectors of sixteen f32 lanes, on every instruction set.
//!
//! The width is fixed so that sums fold the same way everywhere: one register with AVX-512, two with AVX2,
//! four with NEON, an array in portable code. Every operation is an IEEE basic operation, a fused
//! multiply-add, a compare-select or a bit shift, so a body written once over `Simd` gives the same bits on
//! every CPU.
//!
//! `Simd` is a token: the value exists only inside a `#[target_feature]` entry point, and a `Vector` comes only from a
//! token, so holding either proves that the CPU has the instructions. Bodies are `#[inline(always)]` into
//! that entry point; a body that is not inlined loses the instructions and runs tens of times slower.

#[cfg(target_arch = "x86_64")]
pub(crate) mod avx2;
#[cfg(target_arch = "x86_64")]
pub(crate) mod avx512;
mod enter;
#[cfg(target_arch = "aarch64")]
pub(crate) mod neon;
pub(crate) mod scalar;
pub mod table;

pub use enter::Body;

use std::ops::{Add, Div, Mul, Sub};

/// Lanes of a vector.
pub const LANES: usize = 16;

/// Token of an instruction set.
pub trait Simd: Copy {
    /// Its vectors.
    type V: Vector;
    /// How many vectors the registers hold.
    const REGISTERS: usize;
    /// Whether tiles ask for memory ahead of its use; pays where multiply-adds outrun the caches.
    const AHEAD: bool = false;
    /// Every lane `x`.
    fn splat(self, x: f32) -> Self::V;
    /// Lane i from `x[i]`.
    fn load(self, x: &[f32; LANES]) -> Self::V;
    /// Lane i from the half-precision bits `x[i]`; exact.
    fn load_f16(self, x: &[u16; LANES]) -> Self::V;
    /// Lane i from the integer `x[i]`, rounded to nearest, ties to even.
    fn load_i32(self, x: &[i32; LANES]) -> Self::V;
    /// Vector c, lane i from `x[i][c]`.
    #[inline(always)]
    fn load3(self, x: &[[f32; 3]; LANES]) -> [Self::V; 3] {
        columns(self, x)
    }
    /// Vector c, lane i from `x[i][c]`.
    #[inline(always)]
    fn load4(self, x: &[[f32; 4]; LANES]) -> [Self::V; 4] {
        columns(self, x)
    }
    /// Vector c, lane i to `x[i][c]`.
    #[inline(always)]
    fn store3(self, v: [Self::V; 3], x: &mut [[f32; 3]; LANES]) {
        for (c, v) in v.into_iter().enumerate() {
            let mut lanes = [0.0; LANES];
            v.store(&mut lanes);
            for i in 0..LANES {
                x[i][c] = lanes[i];
            }
        }
    }
    /// The lanes of v whose bits are set in `lanes`, in order, to the front of `x`; what follows them in `x` is unspecified.
    #[inline(always)]
    fn store_chosen(self, v: Self::V, lanes: u16, x: &mut [f32; LANES]) {
        let mut all = [0.0; LANES];
        v.store(&mut all);
        let mut n = 0;
        for l in 0..LANES {
            x[n % LANES] = all[l];
            n += usize::from(lanes >> l & 1);
        }
    }
    /// Swaps rows and columns of four lanes each: four lanes from `4 j` on of result i are those from `4 i` on of `x[j]`.
    #[inline(always)]
    fn transpose_quads(self, v: [Self::V; 4]) -> [Self::V; 4] {
        let mut x = [[0.0; LANES]; 4];
        for (v, x) in v.into_iter().zip(&mut x) {
            v.store(x);
        }
        std::array::from_fn(|i| {
            let mut lanes = [0.0; LANES];
            for j in 0..4 {
                lanes[4 * j..4 * j + 4].copy_from_slice(&x[j][4 * i..4 * i + 4]);
            }
            self.load(&lanes)
        })
    }
    /// Swaps rows and columns.
    #[inline(always)]
    fn transpose(self, x: &mut [[f32; LANES]; LANES]) {
        for i in 0..LANES {
            for j in 0..i {
                let v = x[i][j];
                x[i][j] = x[j][i];
                x[j][i] = v;
            }
        }
    }
}

/// Vector c, lane i from `x[i][c]`.
#[inline(always)]
fn columns<S: Simd, const N: usize>(s: S, x: &[[f32; N]; LANES]) -> [S::V; N] {
    let mut vectors = [s.splat(0.0); N];
    for c in 0..N {
        let mut lanes = [0.0; LANES];
        for i in 0..LANES {
            lanes[i] = x[i][c];
        }
        vectors[c] = s.load(&lanes);
    }
    vectors
}

/// Sixteen f32 lanes.
pub trait Vector: Copy + Add<Output = Self> + Sub<Output = Self> + Mul<Output = Self> + Div<Output = Self> {
    /// Lane i to `x[i]`.
    fn store(self, x: &mut [f32; LANES]);
    /// self * a + b, rounded once.
    fn mul_add(self, a: Self, b: Self) -> Self;
    /// b - self * a, rounded once.
    #[inline(always)]
    fn neg_mul_add(self, a: Self, b: Self) -> Self {
        self.negate(u16::MAX).mul_add(a, b)
    }
    /// self > other ? self : other; a NaN on either side gives `other`.
    fn max(self, other: Self) -> Self;
    /// self < other ? self : other; a NaN on either side gives `other`.
    fn min(self, other: Self) -> Self;
    /// Lanes of `yes` where self > other, of `no` elsewhere (also for NaN).
    fn select_gt(self, other: Self, yes: Self, no: Self) -> Self;
    /// Bit i set where lane i of self > other; clear for NaN.
    fn gt_bits(self, other: Self) -> u16;
    /// Clears the sign bit.
    fn abs(self) -> Self;
    /// Sets the sign bit.
    #[inline(always)]
    fn minus_abs(self) -> Self {
        self.abs().negate(u16::MAX)
    }
    /// IEEE square root; NaN below zero.
    fn sqrt(self) -> Self;
    /// (bits(self) << 23) + (`bias` << 23) as float: 2^(n + bias - 127) when the low bits of self hold n.
    fn pow2_of_low_bits(self, bias: i32) -> Self;
    /// Sum of the bits of the lanes as integers, modulo 2^32.
    fn add_bits(self, other: Self) -> Self;
    /// bits(self) + (bits(n) << 23) as float: self 2^n where the low bits of n hold the integer n, self is normal and the result too.
    fn times_pow2_of_low_bits(self, n: Self) -> Self;
    /// self - n for the nearest integer n (ties to even), and something that stands for -n; |self| < 2^22.
    #[inline(always)]
    fn fraction<S: Simd<V = Self>>(self, s: S) -> (Self, Self) {
        // 1.5 * 2^23 less self holds the rounded integer in the low mantissa bits.
        let magic = s.splat(12_582_912.0);
        let shifted = magic - self;
        (self + (shifted - magic), shifted)
    }
    /// self 2^-n for the second result of [`Vector::fraction`]; self and the result are normal.
    #[inline(always)]
    fn times_pow2(self, minus_n: Self) -> Self {
        self.times_pow2_of_low_bits(minus_n)
    }
    /// Flips the sign of lane i where bit i of `lanes` is set; also of zeros.
    fn negate(self, lanes: u16) -> Self;
    /// Lane i takes lane i ^ H, for H = 1, 2, 4, 8.
    fn swap<const H: usize>(self) -> Self;
    /// Lane i and lane i ^ H: the sum where bit H of i is clear, lane i ^ H less lane i where it is set; one stage of a Hadamard transform.
    #[inline(always)]
    fn butterfly<const H: usize>(self) -> Self {
        self.swap::<H>() + self.negate(const { lanes_with(H) })
    }
    /// The larger of |self| and `other`, which is not negative, by their bits: infinity is above every number, and NaN above infinity.
    fn max_magnitude(self, other: Self) -> Self;
    /// Lanes within 1/2 of [-127, 127] to bytes, rounded to nearest, ties to even.
    fn store_s8(self, x: &mut [i8; LANES]);
    /// Byte 4i + j takes the lowest byte of the bits of lane i of vector j.
    fn store_low_bytes(v: [Self; 4], x: &mut [i8; 4 * LANES]);
}

/// Lanes with bit `h` of their number set.
const fn lanes_with(h: usize) -> u16 {
    let (mut lanes, mut i) = (0, 0);
    while i < LANES {
        if i & h != 0 {
            lanes |= 1 << i;
        }
        i += 1;
    }
    lanes
}

/// Sum of the lanes in the one fixed order: l + (l+8), then +4, +2, +1.
#[inline(always)]
pub(crate) fn fold_add<V: Vector>(v: V) -> f32 {
    // In every lane: addition commutes, so that the lanes' partners fold alike.
    let v = v + v.swap::<8>();
    let v = v + v.swap::<4>();
    let v = v + v.swap::<2>();
    let v = v + v.swap::<1>();
    let mut x = [0.0f32; LANES];
    v.store(&mut x);
    x[0]
}

/// A copy of up to 16 values, the rest filled with `fill`.
#[inline(always)]
pub(crate) fn padded(x: &[f32], fill: f32) -> [f32; LANES] {
    let mut lanes = [fill; LANES];
    lanes[..x.len()].copy_from_slice(x);
    lanes
}

/// A function of one lane, written over any instruction set.
pub(crate) trait Lanewise {
    /// Of every lane.
    fn apply<S: Simd>(s: S, x: S::V) -> S::V;
    /// Of several vectors at once.
    #[inline(always)]
    fn apply_all<S: Simd, const N: usize, const M: usize>(s: S, mut x: [[S::V; N]; M]) -> [[S::V; N]; M] {
        // A loop: `map` of arrays is not inlined, and a closure outside of the instruction set calls every operation.
        for m in 0..M {
            for n in 0..N {
                x[m][n] = Self::apply(s, x[m][n]);
            }
        }
        x
    }
}

/// x = F(x) over a slice of any length.
#[inline(always)]
pub(crate) fn map<S: Simd, F: Lanewise>(s: S, x: &mut [f32]) {
    let (blocks, tail) = x.as_chunks_mut::<LANES>();
    for block in blocks {
        F::apply(s, s.load(block)).store(block);
    }
    if !tail.is_empty() {
        let mut block = padded(tail, 0.0);
        F::apply(s, s.load(&block)).store(&mut block);
        tail.copy_from_slice(&block[..tail.len()]);
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::cpu::Kernels;

    /// Every operation that moves lanes or has an implementation of its own on some instruction set.
    struct Operations {
        rows: [[f32; LANES]; 4],
        chosen: u16,
    }

    impl Body for Operations {
        type Output = Vec<f32>;

        #[inline(always)]
        fn run<S: Simd>(self, s: S) -> Vec<f32> {
            let Operations { rows, chosen } = self;
            let flat = rows.concat();
            let (threes, fours) = (flat.as_chunks::<3>().0, flat.as_chunks::<4>().0);
            let (Some(threes), Some(fours)) = (threes.first_chunk(), fours.first_chunk()) else { unreachable!() };
            let (a, b, c, d) = (s.load(&rows[0]), s.load(&rows[1]), s.load(&rows[2]), s.load(&rows[3]));
            let (f, minus_n) = a.fraction(s);
            let mut to = [[0.0; LANES]; 20];
            let [x, y, z] = s.load3(threes);
            let [p, q, r, t] = s.load4(fours);
            let [k, l, m, n] = s.transpose_quads([a, b, c, d]);
            for (v, to) in [x, y, z, p, q, r, t, k, l, m, n].into_iter().zip(&mut to) {
                v.store(to);
            }
            a.neg_mul_add(b, c).store(&mut to[11]);
            a.min(b).store(&mut to[12]);
            a.minus_abs().store(&mut to[13]);
            f.store(&mut to[14]);
            s.splat(1.25).times_pow2(minus_n).store(&mut to[15]);
            s.store_chosen(a, chosen, &mut to[16]);
            to[16][chosen.count_ones() as usize..].fill(0.0);
            a.butterfly::<1>().butterfly::<2>().butterfly::<4>().butterfly::<8>().store(&mut to[17]);
            a.max_magnitude(b.abs()).store(&mut to[18]);
            let mut packed = [[0.0; 3]; LANES];
            s.store3([a, b, c], &mut packed);
            let mut to = to.concat();
            to.extend(packed.as_flattened());
            to
        }
    }

    #[test]
    fn every_set_moves_lanes_alike() {
        // Whole, half and other numbers of both signs, -30 to 30: ties of rounding are among them.
        let rows = std::array::from_fn(|j| std::array::from_fn(|i| ((i * 37 + j * 101) % 241) as f32 * 0.25 - 30.0));
        for chosen in [0, 1, 0x8000, 0x5a5a, u16::MAX] {
            let results: Vec<Vec<f32>> = Kernels::available().map(|k| k.enter(Operations { rows, chosen })).collect();
            for result in &results {
                let bits = |v: &[f32]| v.iter().map(|x| x.to_bits()).collect::<Vec<_>>();
                assert_eq!(bits(result), bits(&results[0]));
            }
            // What they mean, on one of them.
            let (flat, got) = (rows.concat(), &results[0]);
            let lane = |v: usize, i: usize| got[v * LANES + i];
            for i in 0..LANES {
                for c in 0..3 {
                    assert_eq!(lane(c, i), flat[3 * i + c]);
                    assert_eq!(got[20 * LANES + 3 * i + c], rows[c][i]);
                }
                for c in 0..4 {
                    assert_eq!(lane(3 + c, i), flat[4 * i + c]);
                    assert_eq!(lane(7 + c, i), rows[i / 4][4 * c + i % 4]);
                }
                let (a, b, c) = (rows[0][i], rows[1][i], rows[2][i]);
                assert_eq!(lane(11, i), (-a).mul_add(b, c));
                assert_eq!(lane(12, i), if a < b { a } else { b });
                assert_eq!(lane(13, i), -a.abs());
                assert_eq!(lane(14, i), a - a.round_ties_even());
                assert_eq!(lane(15, i), 1.25 * (-a.round_ties_even()).exp2());
            }
            let want: Vec<f32> = (0..LANES).filter(|&i| chosen >> i & 1 != 0).map(|i| rows[0][i]).collect();
            assert_eq!(got[16 * LANES..][..want.len()], want);
        }
    }
}
