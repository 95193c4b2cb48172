//! Lists of the Gaussians that each tile may show.
//!
//! The scene is cut into [`GROUPS`] runs of consecutive Gaussians. A group projects its run, counts its
//! entries per tile, and scatters their keys by a counting sort. A tile's list is the concatenation of
//! the groups' parts, so no two threads write to one list and the result does not depend on their number.
//!
//! Key, 64 bits, see [`KeyForm`]: depth, group, record in the group, and where the form has room the rectangle
//! of 4x4 blocks that the record meets in the tile. z is positive, so its bits order like the number and the sign
//! is left out; groups and records ascend with the Gaussian's index, so sorting whole keys breaks ties by
//! index, and no two keys of a tile are equal.

use sf_formats::scene::Gaussians;
use sf_ops::Kernels;
use sf_ops::simd::{Body, Simd};

use crate::project::{Counts, Projector};
use crate::project_lanes::Project;
use crate::screen::{Rect, Seen};

/// Number of runs the scene is cut into. Fixed, not the number of threads.
pub const GROUPS: usize = 16;
/// Most Gaussians a scene may have: what the keys can name.
pub const MAX_GAUSSIANS: usize = GROUPS << (32 - GROUP_BITS);
const GROUP_BITS: u32 = 4;

/// How a key is packed. Depth is the 31 bits of z without the sign, at the top.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum KeyForm {
    /// `z (31) | group (4) | record (17) | rectangle (12)`, for scenes of up to 2^21 Gaussians.
    Short,
    /// `z (31) | 0 | group (4) | record (28)`; the rectangle is looked up in the record.
    Long,
}

impl KeyForm {
    const RECT_BITS: u32 = 12;
    const SHORT_RECORD_BITS: u32 = 17;

    /// The form for a scene.
    pub fn of(gaussians: usize) -> KeyForm {
        if gaussians.div_ceil(GROUPS) <= 1 << Self::SHORT_RECORD_BITS { KeyForm::Short } else { KeyForm::Long }
    }

    #[inline(always)]
    fn pack(self, z: f32, group: usize, record: usize, rect: u32) -> u64 {
        let z = u64::from(z.to_bits()) << 33;
        match self {
            KeyForm::Short => {
                let name = group << Self::SHORT_RECORD_BITS | record;
                z | (name as u64) << Self::RECT_BITS | u64::from(rect)
            }
            KeyForm::Long => z | (group << (32 - GROUP_BITS) | record) as u64,
        }
    }

    /// A number that ascends with depth and is equal only for equal depths.
    #[inline(always)]
    pub fn depth(self, key: u64) -> u64 {
        key >> 33
    }

    /// The z of a key.
    #[inline(always)]
    pub fn z(self, key: u64) -> f32 {
        f32::from_bits((key >> 33) as u32)
    }

    /// The group and the record that a key names.
    #[inline(always)]
    pub fn locate(self, key: u64) -> (usize, usize) {
        let (name, bits) = match self {
            KeyForm::Short => ((key >> Self::RECT_BITS) as usize, Self::SHORT_RECORD_BITS),
            KeyForm::Long => (key as usize, 32 - GROUP_BITS),
        };
        (name >> bits & (GROUPS - 1), name & ((1 << bits) - 1))
    }

    /// The mask of the blocks that a key meets; `look` finds it where the key does not hold it.
    #[inline(always)]
    pub fn blocks(self, key: u64, look: impl FnOnce() -> u64) -> u64 {
        match self {
            KeyForm::Short => Rect::blocks_of(key as u32 & ((1 << Self::RECT_BITS) - 1)),
            KeyForm::Long => look(),
        }
    }
}

/// The run of consecutive Gaussians of one group.
pub fn run(gaussians: usize, group: usize) -> std::ops::Range<usize> {
    let cut = |g: usize| (gaussians as u128 * g as u128 / GROUPS as u128) as usize;
    cut(group)..cut(group + 1)
}

/// One run of the scene on the screen. All memory is kept between images.
#[derive(Debug, Default)]
pub struct Group {
    /// The visible Gaussians of the run.
    pub seen: Seen,
    /// What was dropped or clamped.
    pub counts: Counts,
    /// Entries this group makes: the sum over its records of the tiles they meet.
    pub entries: u64,
    /// `keys[starts[t]..starts[t + 1]]` are those of tile `t`.
    starts: Vec<u32>,
    keys: Vec<u64>,
}

/// Scatters the keys of a group's records to their tiles.
struct Scatter<'a> {
    seen: &'a Seen,
    group: usize,
    form: KeyForm,
    /// Columns of tiles.
    columns: u32,
    /// Where the keys of every tile go; moved to their ends.
    starts: &'a mut [u32],
    /// Room for all.
    keys: &'a mut [u64],
}

impl Body for Scatter<'_> {
    type Output = ();

    #[inline(always)]
    fn run<S: Simd>(self, _: S) {
        // A form known to the compiler.
        match self.form {
            KeyForm::Short => self.scatter(KeyForm::Short),
            KeyForm::Long => self.scatter(KeyForm::Long),
        }
    }
}

impl Scatter<'_> {
    #[inline(always)]
    fn scatter(self, form: KeyForm) {
        let Scatter { seen, group, columns, starts, keys, .. } = self;
        for (i, (z, met)) in seen.places().enumerate() {
            met.each(columns, |t, rect| {
                keys[starts[t] as usize] = form.pack(z, group, i, rect);
                starts[t] += 1;
            });
        }
    }
}

impl Group {
    /// Projects a run of the scene for an image of `tiles` (columns, rows) and counts the records of every tile, up to `limit` pairs.
    /// `usable(i)` is a further test of a visible Gaussian `i`; those that fail it count as not finite.
    pub fn project(
        &mut self,
        kernels: &Kernels,
        projector: &Projector,
        (scene, run): (&Gaussians, std::ops::Range<usize>),
        usable: Option<&(dyn Fn(usize) -> bool + Sync)>,
        (tiles, limit): ((u32, u32), u64),
    ) {
        self.counts = Counts::default();
        // The counts lie two places on, so that their sums are starts and, once filling has moved these to the ends, starts again.
        self.starts.clear();
        self.starts.resize(tiles.0 as usize * tiles.1 as usize + 2, 0);
        let (seen, counts, met) = (&mut self.seen, &mut self.counts, &mut self.starts[2..]);
        self.entries =
            kernels.enter(Project { projector, scene, run, usable, seen, counts, columns: tiles.0, met, limit });
    }

    /// Scatters the keys of the records to the tiles of an image with `columns` tiles a row, after [`Group::project`] within the limit.
    ///
    /// Panics if there are 2^32 entries or more; the caller has a lower limit.
    pub fn bin(&mut self, kernels: &Kernels, group: usize, form: KeyForm, columns: u32) {
        let entries = u32::try_from(self.entries).expect("fewer than 2^32 entries") as usize;
        for t in 2..self.starts.len() {
            self.starts[t] += self.starts[t - 1];
        }
        // Every key is written: what is left of another image needs no clearing.
        if self.keys.len() < entries {
            self.keys.resize(entries, 0);
        }
        let (starts, keys) = (&mut self.starts[1..], &mut self.keys[..entries]);
        kernels.enter(Scatter { seen: &self.seen, group, form, columns, starts, keys });
    }

    /// The keys of one tile, unsorted.
    pub fn tile(&self, tile: usize) -> &[u64] {
        &self.keys[self.starts[tile] as usize..self.starts[tile + 1] as usize]
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn runs_cover_the_scene_once() {
        for n in [0, 1, 15, 16, 17, 1000, MAX_GAUSSIANS] {
            assert_eq!(run(n, 0).start, 0);
            assert_eq!(run(n, GROUPS - 1).end, n);
            for g in 1..GROUPS {
                assert_eq!(run(n, g).start, run(n, g - 1).end);
                assert!(run(n, g).len() <= 1 << (32 - GROUP_BITS));
            }
        }
    }

    #[test]
    fn keys_name_their_record_and_order_by_depth_then_index() {
        let rect = Rect { x: (1, 6), y: (0, 7) };
        for (form, last) in [(KeyForm::Short, (1 << 17) - 1), (KeyForm::Long, (1 << 28) - 1)] {
            let names = [(0, 0), (0, last), (7, 5), (15, 0), (15, last)];
            let keys: Vec<u64> = [0.01f32, 0.011, 4.0, 1e10]
                .iter()
                .flat_map(|&z| names.map(|(g, r)| form.pack(z, g, r, rect.pack())))
                .collect();
            assert!(keys.windows(2).all(|k| k[0] < k[1]));
            for (key, name) in keys.iter().zip(names.iter().cycle()) {
                assert_eq!(form.locate(*key), *name);
                assert!([0.01, 0.011, 4.0, 1e10].contains(&form.z(*key)));
                assert_eq!(form.blocks(*key, || rect.blocks()), rect.blocks());
            }
        }
        for y in 0..8 {
            for x in 0..8 {
                let inside = (1..=6).contains(&x) && y <= 7;
                assert_eq!(rect.blocks() >> (8 * y + x) & 1 == 1, inside, "block ({x}, {y})");
            }
        }
        assert_eq!(Rect { x: (7, 7), y: (7, 7) }.blocks(), 1 << 63);
        assert_eq!(Rect { x: (2, 3), y: (0, 1) }.blocks(), 0xc0c);
        assert_eq!(KeyForm::of(2 << 20), KeyForm::Short);
        assert_eq!(KeyForm::of((2 << 20) + 1), KeyForm::Long);
    }
}
