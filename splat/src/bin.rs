//! Lists of the Gaussians that each tile may show.
//!
//! The scene is cut into [`GROUPS`] runs of consecutive Gaussians. A group projects its run, counts its
//! entries per tile, and scatters their keys by a counting sort. A tile's list is the concatenation of
//! the groups' parts, so no two threads write to one list and the result does not depend on their number.
//!
//! Key, 64 bits: `z bits (32) | group (4) | record in the group (28)`. z is positive, so the bits order
//! like the number; groups and records ascend with the Gaussian's index, so sorting whole keys
//! breaks ties by index, and no two keys are equal.

use sf_formats::scene::Gaussians;

use crate::project::{Counts, Projector, Record};

/// Number of runs the scene is cut into. Fixed, not the number of threads.
pub const GROUPS: usize = 16;
const RECORD_BITS: u32 = 28;
/// Most Gaussians a scene may have: what the keys can name.
pub const MAX_GAUSSIANS: usize = GROUPS << RECORD_BITS;

/// The run of consecutive Gaussians of one group.
pub fn run(gaussians: usize, group: usize) -> std::ops::Range<usize> {
    let cut = |g: usize| (gaussians as u128 * g as u128 / GROUPS as u128) as usize;
    cut(group)..cut(group + 1)
}

/// One run of the scene on the screen. All memory is kept between images.
#[derive(Debug, Default)]
pub struct Group {
    /// The visible Gaussians of the run, in index order.
    pub records: Vec<Record>,
    /// What was dropped or clamped.
    pub counts: Counts,
    /// Entries this group makes: the sum over its records of the tiles they meet.
    pub entries: u64,
    /// `keys[starts[t]..starts[t + 1]]` are those of tile `t`.
    starts: Vec<u32>,
    keys: Vec<u64>,
}

impl Group {
    /// Projects a run of the scene. `usable(i)` is a further test of Gaussian `i`; those that fail it
    /// count as not finite.
    pub fn project(
        &mut self,
        projector: &Projector,
        scene: &Gaussians,
        run: std::ops::Range<usize>,
        usable: &dyn Fn(usize) -> bool,
    ) {
        self.records.clear();
        self.counts = Counts::default();
        self.entries = 0;
        for i in run {
            let Some(record) = projector.project(scene, i, &mut self.counts) else { continue };
            if !usable(i) {
                self.counts.nonfinite += 1;
                continue;
            }
            self.entries += record.tiles();
            self.records.push(record);
        }
    }

    /// Scatters the keys of the records to the tiles of an image of `tiles` (columns, rows).
    ///
    /// Panics if there are 2^32 entries or more; the caller has a lower limit.
    pub fn bin(&mut self, group: usize, tiles: (u32, u32)) {
        let count = tiles.0 as usize * tiles.1 as usize;
        let entries = u32::try_from(self.entries).expect("fewer than 2^32 entries");
        self.starts.clear();
        self.starts.resize(count + 1, 0);
        self.keys.clear();
        self.keys.resize(entries as usize, 0);
        for r in &self.records {
            each_tile(r, tiles.0, |t| self.starts[t + 1] += 1);
        }
        for t in 0..count {
            self.starts[t + 1] += self.starts[t];
        }
        // Filling moves every start to its end, which is the next one's start; shifted back below.
        for (i, r) in self.records.iter().enumerate() {
            let key = u64::from(r.z.to_bits()) << 32 | (group << RECORD_BITS | i) as u64;
            each_tile(r, tiles.0, |t| {
                self.keys[self.starts[t] as usize] = key;
                self.starts[t] += 1;
            });
        }
        for t in (0..count).rev() {
            self.starts[t + 1] = self.starts[t];
        }
        self.starts[0] = 0;
    }

    /// The keys of one tile, unsorted.
    pub fn tile(&self, tile: usize) -> &[u64] {
        &self.keys[self.starts[tile] as usize..self.starts[tile + 1] as usize]
    }
}

/// The group and the record that a key names.
#[inline(always)]
pub fn locate(key: u64) -> (usize, usize) {
    let low = key as u32 as usize;
    (low >> RECORD_BITS, low & ((1 << RECORD_BITS) - 1))
}

#[inline(always)]
fn each_tile(r: &Record, columns: u32, mut f: impl FnMut(usize)) {
    let (x, y) = r.tile_box();
    for ty in y.0..y.1 {
        for tx in x.0..x.1 {
            f((ty * columns + tx) as usize);
        }
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
                assert!(run(n, g).len() <= 1 << RECORD_BITS);
            }
        }
    }
}
