//! One tile, back to front: from the gradients of its pixels to those of its Gaussians.
//!
//! The tile is drawn once more, and every pair of a Gaussian and a block that is composited is written down with its
//! sixteen alphas and weights. Then every block walks its pairs from the last to the first. With v_i = dL/dC c_i + dL/dD z_i
//! the value of a Gaussian at a pixel and B_i what is seen behind it,
//!
//! ```text
//! B_n = dL/dC background - dL/dA,   B_(i-1) = B_i + alpha_i (v_i - B_i)
//! dL/dalpha_i = T_i (v_i - B_i)      dL/dx_i = -ln 2 w_i (v_i - B_i), w = T alpha, x = d^2 + e^2 - log2(opacity); 0 at a_max
//! ```
//!
//! which divides by nothing and subtracts no sums. What a Gaussian needs of its pixels are ten sums ([`Sums`]): with h =
//! w (v - B), h times the products of d and e, which are of order one wherever alpha is not cut, and w times dL/dC, dL/dD.
//!
//! Sums are f32 in a fixed order: the lanes of a block by a tree, the blocks of a tile by number, and the tiles
//! of a Gaussian by number, in f64, when they are collected ([`crate::backward`]). A tile writes to slots of its own.

use std::ops::Range;
use std::sync::atomic::{AtomicU32, Ordering::Relaxed};

use sf_ops::simd::{Body, LANES, Simd, Vector};

use crate::bin::GROUPS;
use crate::blend::{BLOCKS, CHUNK, Draw, Line, PER_ROW, Place, Shared, Shown, Tile, columns_rows};
use crate::screen::BLOCK;

/// Sums of one Gaussian over pixels: h, h d, h d d, h e, h d e, h e e, then w dL/dred, w dL/dgreen, w dL/dblue, w dL/dD.
pub(crate) const SUMS: usize = 10;
/// The sums of a pair of Gaussian and tile.
pub(crate) type Slot = [AtomicU32; SUMS];
/// Where the folded vector holds them.
const LANE_OF_SUM: [usize; SUMS] = [0, 1, 2, 8, 9, 12, 4, 5, 6, 7];

/// dL/d of the images, row-major, the size of the image.
#[derive(Clone, Copy, Debug)]
pub struct ImageGradients<'a> {
    /// dL/drgb `[height, width, 3]`.
    pub rgb: &'a [f32],
    /// dL/ddepth `[height, width]`, of D = sum T alpha z.
    pub depth: &'a [f32],
    /// dL/dalpha `[height, width]`.
    pub alpha: &'a [f32],
}

/// A composited pair of Gaussian and block.
#[derive(Clone, Copy, Debug)]
#[repr(align(64))]
struct Pair {
    /// 0 where not composited.
    alpha: [f32; LANES],
    /// T alpha.
    weight: [f32; LANES],
}

/// Pairs of one block, neighbours in order.
#[derive(Clone, Copy, Debug)]
struct Stretch {
    pairs: (u32, u32),
    /// The stretch in front of it, [`NONE`] for the first.
    before: u32,
}

const NONE: u32 = u32::MAX;

/// What one worker writes down of a tile; the memory is kept.
#[derive(Debug, Default)]
pub(crate) struct History {
    /// The first `len` are of this tile.
    pairs: Vec<Pair>,
    /// Which of `shown` every pair is.
    who: Vec<u32>,
    len: usize,
    stretches: Vec<Stretch>,
    /// The last stretch of every block.
    last: Vec<u32>,
    /// The Gaussians dealt out, in order.
    shown: Vec<Shown>,
    /// Their slots.
    slots: Vec<u32>,
    /// Their sums.
    sums: Vec<Line>,
}

/// What the tiles of an image share.
#[derive(Clone, Copy)]
pub(crate) struct SharedBack<'a> {
    /// As drawn.
    pub(crate) shared: &'a Shared<'a>,
    /// The first slot of every record.
    pub(crate) first_slot: [&'a [u32]; GROUPS],
    /// All slots, zero.
    pub(crate) slots: &'a [Slot],
    /// What comes in.
    pub(crate) gradients: ImageGradients<'a>,
    /// Columns of the image.
    pub(crate) width: usize,
    /// Colour behind everything.
    pub(crate) background: [f32; 3],
}

/// One tile.
pub(crate) struct BlendBack<'a> {
    /// The tile, cleared.
    pub(crate) tile: &'a mut Tile,
    /// Its keys.
    pub(crate) lists: [&'a [u64]; GROUPS],
    pub(crate) history: &'a mut History,
    pub(crate) place: Place,
    pub(crate) shared: &'a SharedBack<'a>,
}

impl Body for BlendBack<'_> {
    type Output = ();

    #[inline(always)]
    fn run<S: Simd>(self, s: S) {
        let BlendBack { tile, lists, history, place, shared } = self;
        history.clear();
        tile.each_chunk(
            s,
            (place, &lists),
            shared.shared,
            &mut Write { history, place, first_slot: &shared.first_slot },
        );
        history.sums.clear();
        history.sums.resize(history.shown.len(), Line([0.0; LANES]));
        for b in 0..BLOCKS {
            if history.last[b] != NONE {
                let pixels = Pixels::of_block(b, place, shared);
                history.walk(s, b, &pixels, shared.shared.a_max);
            }
        }
        for (sums, &slot) in history.sums.iter().zip(&history.slots) {
            for (to, lane) in shared.slots[slot as usize].iter().zip(LANE_OF_SUM) {
                to.store(sums.0[lane].to_bits(), Relaxed);
            }
        }
    }
}

/// Writes chunks down.
struct Write<'a> {
    history: &'a mut History,
    place: Place,
    first_slot: &'a [&'a [u32]; GROUPS],
}

impl Draw for Write<'_> {
    #[inline(always)]
    fn draw<S: Simd>(&mut self, s: S, tile: &mut Tile, shared: &Shared, keys: Range<usize>) {
        let history = &mut *self.history;
        let first = history.shown.len();
        let (shown, keys) = tile.chunk_and_keys(keys);
        history.shown.extend_from_slice(shown);
        for &key in keys {
            let (group, record) = shared.form.locate(key);
            let slot = self.first_slot[group][record]
                + shared.seen[group].met(record).number(self.place.tile(shared.columns), shared.columns);
            history.slots.push(slot);
        }
        let mut left = tile.alive;
        while left != 0 {
            let b = left.trailing_zeros() as usize % BLOCKS;
            left &= left - 1;
            let (t, shown, list) = tile.block(b);
            if list.is_empty() {
                continue;
            }
            let start = history.len;
            history.room_for(list.len());
            let room = (&mut history.pairs[start..], &mut history.who[start..]);
            let (kept, alive) = take(s, columns_rows(s, b), t, (list, first as u32), shown, shared.a_max, room);
            tile.alive &= !(u64::from(!alive) << b);
            if kept > 0 {
                let before = std::mem::replace(&mut history.last[b], history.stretches.len() as u32);
                history.stretches.push(Stretch { pairs: (start as u32, (start + kept) as u32), before });
                history.len = start + kept;
            }
        }
    }
}

/// One block takes its list and writes down what is composited: how many entries, and whether a pixel is
/// still unfinished.
#[inline(always)]
fn take<S: Simd>(
    s: S,
    at: (S::V, S::V),
    transmittance: &mut [f32; LANES],
    (list, first): (&[u8], u32),
    shown: &[Shown; CHUNK],
    a_max: f32,
    (pairs, who): (&mut [Pair], &mut [u32]),
) -> (usize, bool) {
    let zero = s.splat(0.0);
    let mut t = s.load(transmittance);
    let (mut kept, mut alive) = (0, true);
    for &i in list {
        let step = shown[usize::from(i)].step(s, at, t, a_max);
        t = step.t;
        // Always written, and kept where it counts: a branch here would be a coin toss.
        step.weight.select_gt(zero, step.alpha, zero).store(&mut pairs[kept].alpha);
        step.weight.store(&mut pairs[kept].weight);
        who[kept] = first + u32::from(i);
        kept += usize::from(step.weight.gt_bits(zero) != 0);
        if step.going == 0 {
            alive = false;
            break;
        }
    }
    t.store(transmittance);
    (kept, alive)
}

/// What comes into the pixels of a block; 0 outside the image.
struct Pixels {
    /// dL/dred, dL/dgreen, dL/dblue, dL/dD.
    gradient: [[f32; LANES]; 4],
    /// dL/dC background - dL/dA.
    behind: [f32; LANES],
}

impl Pixels {
    #[inline(always)]
    fn of_block(b: usize, place: Place, shared: &SharedBack) -> Pixels {
        let mut pixels = Pixels { gradient: [[0.0; LANES]; 4], behind: [0.0; LANES] };
        let (x0, y0) = (b % PER_ROW * BLOCK, b / PER_ROW * BLOCK);
        let (g, [red, green, blue]) = (&shared.gradients, shared.background);
        for l in 0..LANES {
            let (x, y) = (x0 + l % BLOCK, y0 + l / BLOCK);
            if x < place.width && y < place.height {
                let i = (place.y + y) * shared.width + place.x + x;
                let rgb = [g.rgb[3 * i], g.rgb[3 * i + 1], g.rgb[3 * i + 2]];
                for c in 0..3 {
                    pixels.gradient[c][l] = rgb[c];
                }
                pixels.gradient[3][l] = g.depth[i];
                pixels.behind[l] = rgb[0] * red + rgb[1] * green + rgb[2] * blue - g.alpha[i];
            }
        }
        pixels
    }
}

impl History {
    fn clear(&mut self) {
        self.len = 0;
        self.stretches.clear();
        self.last.clear();
        self.last.resize(BLOCKS, NONE);
        self.shown.clear();
        self.slots.clear();
    }

    /// Room for `more` pairs after the first `len`.
    fn room_for(&mut self, more: usize) {
        let need = self.len + more;
        if self.pairs.len() < need {
            let size = need.next_power_of_two();
            self.pairs.resize(size, Pair { alpha: [0.0; LANES], weight: [0.0; LANES] });
            self.who.resize(size, 0);
        }
    }

    /// One block from its last pair to its first.
    #[inline(always)]
    fn walk<S: Simd>(&mut self, s: S, b: usize, pixels: &Pixels, a_max: f32) {
        let (zero, a_max) = (s.splat(0.0), s.splat(a_max));
        let at = columns_rows(s, b);
        let [red, green, blue, deep] = [0, 1, 2, 3].map(|c| s.load(&pixels.gradient[c]));
        let mut behind = s.load(&pixels.behind);
        let mut stretch = self.last[b];
        while stretch != NONE {
            let Stretch { pairs: (start, end), before } = self.stretches[stretch as usize];
            stretch = before;
            let pairs = self.pairs[start as usize..end as usize].iter();
            for (pair, &i) in pairs.zip(&self.who[start as usize..end as usize]).rev() {
                let o = &self.shown[i as usize];
                let [r, g, b, z] = o.value;
                let (alpha, weight) = (s.load(&pair.alpha), s.load(&pair.weight));
                let value =
                    red.mul_add(s.splat(r), green.mul_add(s.splat(g), blue.mul_add(s.splat(b), deep * s.splat(z))));
                let ahead = value - behind;
                behind = alpha.mul_add(ahead, behind);
                let h = a_max.select_gt(alpha, weight, zero) * ahead;
                let (d, e) = o.form(s, at);
                let hd = h * d;
                let hdd = hd * d;

                // Over the columns: lanes 0, 1, 2 of every row, and 4 colours. e is the same in a row, so its
                // products come after.
                let form = fold::<S, 2>(s, fold::<S, 1>(s, h, hd), hdd + hdd.swap::<1>());
                let colour = fold::<S, 2>(
                    s,
                    fold::<S, 1>(s, weight * red, weight * green),
                    fold::<S, 1>(s, weight * blue, weight * deep),
                );
                let form_e = form * e;
                let form_ee = form_e * e;
                // Over the rows.
                let rows = fold::<S, 8>(s, fold::<S, 4>(s, form, colour), fold::<S, 4>(s, form_e, form_ee));
                let sums = &mut self.sums[i as usize].0;
                (s.load(sums) + rows).store(sums);
            }
        }
    }
}

/// Lane l with l & H = 0: a(l) + a(l + H); with l & H = H: b(l) + b(l - H).
#[inline(always)]
fn fold<S: Simd, const H: usize>(s: S, a: S::V, b: S::V) -> S::V {
    let zero = s.splat(0.0);
    let high = s.load(&const { high_lanes::<H>() });
    high.select_gt(zero, b, a) + high.select_gt(zero, a, b).swap::<H>()
}

/// 1 in the lanes with the bit H.
const fn high_lanes<const H: usize>() -> [f32; LANES] {
    let mut lanes = [0.0; LANES];
    let mut l = 0;
    while l < LANES {
        lanes[l] = if l & H != 0 { 1.0 } else { 0.0 };
        l += 1;
    }
    lanes
}
