//! One tile, front to back.
//!
//! A tile is 32x32 pixels in 64 blocks of 4x4, one vector of sixteen lanes each. Its list of keys is split into
//! buckets of depth, and only the bucket about to be drawn is filtered and sorted: entries that meet nothing
//! but finished blocks are dropped by one AND of 64-bit masks. Up to `CHUNK` entries in order are then dealt
//! out to the blocks they meet, and every block takes its list in one go with its state in registers.
//! A pixel sees its Gaussians in key order whatever the chunks are.
//!
//! ```text
//! d = cx (X - u) - sl (Y - v),  e = ar (Y - v),  x = d^2 + e^2 - log2(opacity),  alpha = min(a_max, 2^-x)
//! ```
//!
//! T carries the sign of life: a finished pixel holds -T, which keeps T for the output, and no alpha makes
//! a negative T pass the test of the next T.

use std::ops::Range;

use sf_ops::prefetch::prefetch;
use sf_ops::simd::{Body, LANES, Simd, Vector};

use crate::bin::{self, KeyForm};
use crate::math::exp2_neg;
use crate::screen::{BLOCK, Record, Rect, Seen, TILE, X_CUT};

/// A pixel is finished when its next T would be at or below this.
pub const T_STOP: f32 = 1e-4;
const SIDE: usize = TILE as usize;
/// Blocks in a row of a tile.
pub(crate) const PER_ROW: usize = SIDE / BLOCK;
/// Blocks of a tile: the bits of a mask.
pub(crate) const BLOCKS: usize = PER_ROW * PER_ROW;
/// Entries dealt out together: 12 KiB of them and at most 16 KiB of lists stay in the first-level cache.
pub(crate) const CHUNK: usize = 256;
/// Keys that are filtered and sorted together at least.
const TOGETHER: usize = 16;
/// Most depth buckets of a list.
const BUCKETS: usize = 4096;

/// Column of a lane in its block.
const LANE_X: [f32; LANES] = [0., 1., 2., 3., 0., 1., 2., 3., 0., 1., 2., 3., 0., 1., 2., 3.];
/// Row of a lane in its block.
const LANE_Y: [f32; LANES] = [0., 0., 0., 0., 1., 1., 1., 1., 2., 2., 2., 2., 3., 3., 3., 3.];

/// State of sixteen pixels; five cache lines.
#[derive(Clone, Copy, Debug)]
#[repr(align(64))]
struct Block {
    /// Transmittance, negated when the pixel is finished.
    t: [f32; LANES],
    /// Sum of T alpha times red, green, blue, z.
    sum: [[f32; LANES]; 4],
}

/// A Gaussian in the coordinates of a tile: X and Y count pixel centres from the tile's first.
#[derive(Clone, Copy, Debug, Default)]
pub(crate) struct Shown {
    /// d of the tile's first pixel.
    d: f32,
    /// Change of d per column.
    cx: f32,
    /// Change of d per row.
    dy: f32,
    /// e of the tile's first row.
    e: f32,
    /// Change of e per row.
    ar: f32,
    /// -log2(opacity).
    nlo: f32,
    /// Red, green, blue, z.
    pub(crate) value: [f32; 4],
    index: u32,
}

/// Where a tile lies: its first pixel and how many of its columns and rows are inside the image.
#[derive(Clone, Copy, Debug)]
pub struct Place {
    /// First column of the tile in the image.
    pub x: usize,
    /// First row of the tile in the image.
    pub y: usize,
    /// Columns inside the image, 1..=32.
    pub width: usize,
    /// Rows inside the image, 1..=32.
    pub height: usize,
}

impl Place {
    /// Number of the tile.
    #[inline(always)]
    pub(crate) fn tile(&self, columns: u32) -> u32 {
        self.y as u32 / TILE * columns + self.x as u32 / TILE
    }
}

/// Extra per-Gaussian values: `values[index * channels + c]`.
#[derive(Clone, Copy, Debug)]
pub struct Channels<'a> {
    /// Values per Gaussian, 0 for none.
    pub channels: usize,
    /// Row-major `[gaussians, channels]`.
    pub values: &'a [f32],
}

/// One tile's pixels and its list; the memory is kept between tiles.
#[derive(Debug)]
pub struct Tile {
    blocks: Box<[Block; BLOCKS]>,
    /// Bit b set while block b has an unfinished pixel.
    pub(crate) alive: u64,
    /// `[block, channel][lane]`.
    extra: Vec<[f32; LANES]>,
    /// The keys by depth bucket; the first ones of the vector.
    keys: Vec<u64>,
    /// As long, for sorting.
    spare: Vec<u64>,
    /// `starts[b]` of bucket b, one more for the end.
    starts: Box<[u32; BUCKETS + 1]>,
    chunk: Box<Chunk>,
    updates: u64,
}

/// Entries in order and, per block, which of them it takes.
#[derive(Debug)]
struct Chunk {
    shown: [Shown; CHUNK],
    len: usize,
    /// One per block, and one that is not read.
    lists: [[u8; CHUNK]; BLOCKS + 1],
    lens: [u16; BLOCKS + 1],
    /// Of the block that is being drawn, one per entry of its list.
    weights: [Line; CHUNK],
}

/// A vector on a cache line.
#[derive(Clone, Copy, Debug)]
#[repr(align(64))]
pub(crate) struct Line(pub(crate) [f32; LANES]);

impl Default for Tile {
    fn default() -> Self {
        Tile {
            blocks: Box::new([Block { t: [1.0; LANES], sum: [[0.0; LANES]; 4] }; BLOCKS]),
            alive: 0,
            extra: Vec::new(),
            keys: Vec::new(),
            spare: Vec::new(),
            starts: Box::new([0; BUCKETS + 1]),
            chunk: Box::new(Chunk {
                shown: [Shown::default(); CHUNK],
                len: 0,
                lists: [[0; CHUNK]; BLOCKS + 1],
                lens: [0; BLOCKS + 1],
                weights: [Line([0.0; LANES]); CHUNK],
            }),
            updates: 0,
        }
    }
}

/// What the tiles of an image share.
#[derive(Clone, Copy, Debug)]
pub struct Shared<'a> {
    /// The records of every group.
    pub records: [&'a [Record]; bin::GROUPS],
    /// Where they lie.
    pub seen: [&'a Seen; bin::GROUPS],
    /// Columns of tiles.
    pub columns: u32,
    /// How keys name them.
    pub form: KeyForm,
    /// Largest alpha.
    pub a_max: f32,
    /// Further values.
    pub extra: Channels<'a>,
}

impl Shared<'_> {
    #[inline(always)]
    fn record(&self, form: KeyForm, key: u64) -> &Record {
        let (group, record) = form.locate(key);
        &self.records[group][record]
    }

    /// Starts to bring a record near; it lies on one cache line or on two.
    #[inline(always)]
    fn hint(&self, form: KeyForm, key: u64) {
        let record = self.record(form, key);
        prefetch(&record.d);
        prefetch(&record.first);
    }

    /// The blocks of the tile at `place` that the record of a key meets.
    #[inline(always)]
    fn blocks(&self, form: KeyForm, key: u64, place: Place) -> u64 {
        form.blocks(key, || {
            let (group, record) = form.locate(key);
            Rect::blocks_of(self.seen[group].met(record).rect(place.tile(self.columns), self.columns))
        })
    }
}

/// Composites the list of a tile in key order.
#[derive(Debug)]
pub struct Blend<'a> {
    /// The tile, cleared.
    pub tile: &'a mut Tile,
    /// Its keys, in any order.
    pub lists: [&'a [u64]; bin::GROUPS],
    /// Where it lies.
    pub place: Place,
    /// The image.
    pub shared: &'a Shared<'a>,
}

impl Body for Blend<'_> {
    type Output = ();

    #[inline(always)]
    fn run<S: Simd>(self, s: S) {
        let Blend { tile, lists, place, shared } = self;
        tile.each_chunk(s, (place, &lists), shared, &mut Composite);
    }
}

/// What is done with a chunk that has been dealt out to the lists of the blocks.
pub(crate) trait Draw {
    /// Draws the chunk, the keys `keys` of the ordered list, and updates the mask of unfinished blocks.
    fn draw<S: Simd>(&mut self, s: S, tile: &mut Tile, shared: &Shared, keys: Range<usize>);
}

/// Draws chunks into the tile's pixels.
struct Composite;

impl Draw for Composite {
    #[inline(always)]
    fn draw<S: Simd>(&mut self, s: S, tile: &mut Tile, shared: &Shared, _: Range<usize>) {
        tile.draw(s, shared);
    }
}

/// Sorts the first `len` keys, no two equal: a few, rarely many. `keys` has room for [`RANKED`] more.
///
/// Many are split by depth once more.
#[inline(always)]
fn sort(form: KeyForm, all: &mut [u64], len: usize, spare: &mut [u64]) {
    if len <= RANKED {
        return sort_few(all, len);
    }
    let (keys, spare) = (&mut all[..len], &mut spare[..len]);
    let (mut least, mut most) = (u64::MAX, 0);
    for &key in &*keys {
        least = least.min(key);
        most = most.max(key);
    }
    let (least, range) = (form.depth(least), form.depth(most) - form.depth(least));
    // About sixteen in each.
    let buckets = (len / 16).next_power_of_two().min(FEWER_BUCKETS);
    let shift = (u64::BITS - range.leading_zeros()).saturating_sub(buckets.trailing_zeros());
    let bucket = |key: u64| ((form.depth(key) - least) >> shift) as usize % FEWER_BUCKETS;
    let mut starts = [0u32; FEWER_BUCKETS + 1];
    for &key in &*keys {
        starts[bucket(key) + 1] += 1;
    }
    for b in 0..buckets {
        starts[b + 1] += starts[b];
    }
    for &key in &*keys {
        let at = &mut starts[bucket(key)];
        spare[*at as usize] = key;
        *at += 1;
    }
    keys.copy_from_slice(spare);
    let mut start = 0;
    for &end in &starts[..buckets] {
        let (few, end) = (start, end as usize);
        start = end;
        if end - few <= RANKED { sort_few(&mut all[few..], end - few) } else { all[few..end].sort_unstable() }
    }
}

/// Most keys that are sorted by their ranks.
const RANKED: usize = 64;
/// Buckets of a bucket.
const FEWER_BUCKETS: usize = 256;

/// Sorts the first `len` keys, at most [`RANKED`] of as many or more.
#[inline(always)]
fn sort_few(keys: &mut [u64], len: usize) {
    match len {
        0 | 1 => (),
        2..=16 => rank::<16>(keys, len),
        17..=32 => rank::<32>(keys, len),
        _ => rank::<64>(keys, len),
    }
}

/// Sorts the first `len` of N different keys: every one goes to the place that the number of smaller ones gives. No branch depends on
/// the keys, and the comparisons are vectors.
#[inline(always)]
fn rank<const N: usize>(keys: &mut [u64], len: usize) {
    let Some(keys) = keys.first_chunk_mut::<N>() else { unreachable!() };
    // Signed, for instruction sets that compare nothing else.
    let mut all = [0; N];
    for i in 0..N {
        all[i] = (keys[i] ^ 1 << 63) as i64;
    }
    let mut ranks = [0u64; N];
    for &key in &all[..len.min(N)] {
        for i in 0..N {
            ranks[i] += u64::from(key < all[i]);
        }
    }
    for i in 0..len.min(N) {
        keys[ranks[i] as usize % N] = all[i] as u64 ^ 1 << 63;
    }
}

impl Tile {
    /// Orders the keys front to back as far as they are seen, and hands them on in chunks.
    #[inline(always)]
    pub(crate) fn each_chunk<S: Simd, D: Draw>(
        &mut self,
        s: S,
        (place, lists): (Place, &[&[u64]; bin::GROUPS]),
        shared: &Shared,
        draw: &mut D,
    ) {
        // A form known to the compiler: keys are taken apart several times each.
        match shared.form {
            KeyForm::Short => self.each_chunk_of(KeyForm::Short, s, (place, lists), shared, draw),
            KeyForm::Long => self.each_chunk_of(KeyForm::Long, s, (place, lists), shared, draw),
        }
    }

    #[inline(always)]
    fn each_chunk_of<S: Simd, D: Draw>(
        &mut self,
        form: KeyForm,
        s: S,
        (place, lists): (Place, &[&[u64]; bin::GROUPS]),
        shared: &Shared,
        draw: &mut D,
    ) {
        let tile = self;
        let buckets = tile.split(lists, form);
        // Kept keys move to the front of the list, in order; `dealt..kept` wait for their records.
        let (mut dealt, mut kept) = (0, 0);
        let mut next = 0;
        while next < buckets {
            // Small buckets together: every loop has an end that the core guesses wrong.
            let start = tile.starts[next] as usize;
            next += 1;
            while next < buckets && (tile.starts[next] as usize) < start + TOGETHER {
                next += 1;
            }
            let end = tile.starts[next] as usize;
            let sorted = kept;
            for i in start..end {
                let key = tile.keys[i];
                let mask = shared.blocks(form, key, place);
                tile.keys[kept] = key;
                kept += usize::from(mask & tile.alive != 0);
            }
            sort(form, &mut tile.keys[sorted..], kept - sorted, &mut tile.spare);
            // Records lie in index order and are wanted in depth order: nearly every one is a cache miss, so all
            // of a chunk are on their way before the first is read.
            for &key in &tile.keys[sorted..kept] {
                shared.hint(form, key);
            }
            while kept - dealt >= CHUNK {
                tile.deal_keys(form, place, shared, dealt..dealt + CHUNK);
                draw.draw(s, tile, shared, dealt..dealt + CHUNK);
                tile.empty_chunk();
                dealt += CHUNK;
                if tile.alive == 0 {
                    return;
                }
            }
        }
        tile.deal_keys(form, place, shared, dealt..kept);
        draw.draw(s, tile, shared, dealt..kept);
        tile.empty_chunk();
    }

    /// Starts a tile: T = 1 inside the image, finished outside.
    pub fn clear(&mut self, place: Place, channels: usize) {
        self.alive = u64::MAX;
        self.blocks.fill(Block { t: [1.0; LANES], sum: [[0.0; LANES]; 4] });
        if place.width < SIDE || place.height < SIDE {
            for (i, block) in self.blocks.iter_mut().enumerate() {
                let (y0, x0) = (i / PER_ROW * BLOCK, i % PER_ROW * BLOCK);
                for l in 0..LANES {
                    let inside = y0 + l / BLOCK < place.height && x0 + l % BLOCK < place.width;
                    block.t[l] = if inside { 1.0 } else { -1.0 };
                }
                self.alive &= !(u64::from(y0 >= place.height || x0 >= place.width) << i);
            }
        }
        self.extra.clear();
        self.extra.resize(BLOCKS * channels, [0.0; LANES]);
        self.empty_chunk();
        self.updates = 0;
    }

    /// Makes room for lists of up to `entries` keys and for extra sums, so that no tile of an image allocates.
    pub fn reserve(&mut self, entries: usize, channels: usize) {
        self.room(entries);
        self.extra.clear();
        self.extra.reserve(BLOCKS * channels);
    }

    fn room(&mut self, entries: usize) {
        if self.keys.len() < entries + RANKED {
            self.keys.resize(entries + RANKED, 0);
            self.spare.resize(entries, 0);
        }
    }

    /// Blocks that took a Gaussian since [`Tile::clear`], counted once per pair.
    pub fn updates(&self) -> u64 {
        self.updates
    }

    /// Orders keys by bucket of depth, not inside a bucket, and returns the number of buckets.
    #[inline(always)]
    fn split(&mut self, lists: &[&[u64]; bin::GROUPS], form: KeyForm) -> usize {
        let (mut least, mut most, mut len) = (u64::MAX, 0, 0);
        for list in lists {
            len += list.len();
            for &key in *list {
                least = least.min(key);
                most = most.max(key);
            }
        }
        self.room(len);
        let split = &mut self.keys[..len];
        let Some(range) = form.depth(most).checked_sub(form.depth(least)) else { return 0 };
        let least = form.depth(least);
        // The shift that leaves the range just under the number of buckets: about 4 entries in each.
        let wanted = (len / 4).next_power_of_two().clamp(1, BUCKETS);
        let shift = (u64::BITS - range.leading_zeros()).saturating_sub(wanted.trailing_zeros());
        let bucket = |key: u64| ((form.depth(key) - least) >> shift) as usize & (BUCKETS - 1);
        let buckets = (range >> shift) as usize + 1;
        self.starts[..=buckets].fill(0);
        for list in lists {
            for &key in *list {
                self.starts[bucket(key) + 1] += 1;
            }
        }
        for b in 0..buckets {
            self.starts[b + 1] += self.starts[b];
        }
        // Filling moves every start to its end, which is the next one's start; shifted back below.
        for list in lists {
            for &key in *list {
                let at = &mut self.starts[bucket(key)];
                split[*at as usize] = key;
                *at += 1;
            }
        }
        for b in (0..buckets).rev() {
            self.starts[b + 1] = self.starts[b];
        }
        self.starts[0] = 0;
        buckets
    }

    /// Deals at most [`CHUNK`] keys of the ordered list.
    #[inline(always)]
    fn deal_keys(&mut self, form: KeyForm, place: Place, shared: &Shared, keys: Range<usize>) {
        for i in keys.clone() {
            let key = self.keys[i];
            self.deal(shared.record(form, key), form.z(key), place, shared.blocks(form, key, place));
        }
    }

    fn empty_chunk(&mut self) {
        self.chunk.len = 0;
        self.chunk.lens = [0; BLOCKS + 1];
    }

    /// Appends a Gaussian to the chunk and to the lists of the unfinished ones of `blocks`.
    #[inline(always)]
    fn deal(&mut self, r: &Record, z: f32, place: Place, blocks: u64) {
        let chunk = &mut *self.chunk;
        let at = chunk.len % CHUNK;
        let (x, y) = (place.x as f32 - f32::from(r.first[0]), place.y as f32 - f32::from(r.first[1]));
        chunk.shown[at] = Shown {
            d: r.cx.mul_add(x, r.dy.mul_add(y, r.d)),
            cx: r.cx,
            dy: r.dy,
            e: r.ar.mul_add(y, r.e),
            ar: r.ar,
            nlo: r.nlo,
            value: [r.rgb[0], r.rgb[1], r.rgb[2], z],
            index: r.index,
        };
        chunk.len = at + 1;
        let mut left = blocks & self.alive;
        // Four at a time, what is missing to the list that nobody reads: how many there are is a guess that often fails.
        loop {
            for _ in 0..4 {
                // 64 when none is left.
                let b = (left.trailing_zeros() as usize).min(BLOCKS);
                chunk.lists[b][usize::from(chunk.lens[b]) % CHUNK] = at as u8;
                chunk.lens[b] = chunk.lens[b].wrapping_add(1);
                left &= left.wrapping_sub(1);
            }
            if left == 0 {
                break;
            }
        }
    }

    /// The Gaussians of the chunk and the keys of a part of the ordered list.
    pub(crate) fn chunk_and_keys(&self, keys: Range<usize>) -> (&[Shown], &[u64]) {
        (&self.chunk.shown[..self.chunk.len], &self.keys[keys])
    }

    /// T of a block, negated where finished; the Gaussians of the chunk; which of them the block takes.
    pub(crate) fn block(&mut self, b: usize) -> (&mut [f32; LANES], &[Shown; CHUNK], &[u8]) {
        let chunk = &self.chunk;
        (&mut self.blocks[b].t, &chunk.shown, &chunk.lists[b][..usize::from(chunk.lens[b]).min(CHUNK)])
    }

    /// Draws the chunk.
    #[inline(always)]
    fn draw<S: Simd>(&mut self, s: S, shared: &Shared) {
        let mut left = self.alive;
        while left != 0 {
            let b = left.trailing_zeros() as usize % BLOCKS;
            left &= left - 1;
            let Chunk { shown, lists, lens, weights, .. } = &mut *self.chunk;
            let list = &lists[b][..usize::from(lens[b]).min(CHUNK)];
            if list.is_empty() {
                continue;
            }
            let extra = &mut self.extra[b * shared.extra.channels..][..shared.extra.channels];
            let (taken, alive) =
                take(s, &mut self.blocks[b], columns_rows(s, b), list, (shown, weights), shared, extra);
            self.updates += taken as u64;
            self.alive &= !(u64::from(!alive) << b);
        }
    }

    /// Four rows of sixteen pixels from block `(column, row)` on: T with the sign of life, and the sums of red, green, blue and z.
    #[inline(always)]
    pub(crate) fn rows<S: Simd>(&self, s: S, column: usize, row: usize) -> [[S::V; BLOCK]; 5] {
        let blocks = &self.blocks[row * PER_ROW + column..][..BLOCK];
        let mut rows = [[s.splat(0.0); BLOCK]; 5];
        for (i, block) in blocks.iter().enumerate() {
            rows[0][i] = s.load(&block.t);
            for c in 0..4 {
                rows[1 + c][i] = s.load(&block.sum[c]);
            }
        }
        for row in &mut rows {
            *row = s.transpose_quads(*row);
        }
        rows
    }

    /// The extra sums of a pixel of the tile.
    #[inline]
    pub fn extra(&self, x: usize, y: usize, channels: usize) -> impl Iterator<Item = f32> {
        let (b, l) = (y / BLOCK * PER_ROW + x / BLOCK, y % BLOCK * BLOCK + x % BLOCK);
        self.extra[b * channels..][..channels].iter().map(move |sum| sum[l])
    }
}

/// Columns and rows of the pixels of block `b`, counted from the tile's first.
#[inline(always)]
pub(crate) fn columns_rows<S: Simd>(s: S, b: usize) -> (S::V, S::V) {
    let x = s.load(&LANE_X) + s.splat((b % PER_ROW * BLOCK) as f32);
    let y = s.load(&LANE_Y) + s.splat((b / PER_ROW * BLOCK) as f32);
    (x, y)
}

/// A Gaussian at sixteen pixels.
pub(crate) struct Step<V> {
    /// Alpha, also where it is not composited.
    pub(crate) alpha: V,
    /// T alpha, 0 where it is not composited.
    pub(crate) weight: V,
    /// What T becomes.
    pub(crate) t: V,
    /// The pixels that are unfinished after it.
    pub(crate) going: u16,
}

impl Shown {
    /// d and e of sixteen pixels.
    #[inline(always)]
    pub(crate) fn form<S: Simd>(&self, s: S, (x, y): (S::V, S::V)) -> (S::V, S::V) {
        let d = s.splat(self.cx).mul_add(x, s.splat(self.dy).mul_add(y, s.splat(self.d)));
        (d, s.splat(self.ar).mul_add(y, s.splat(self.e)))
    }

    /// Composites over a T that is negative where a pixel is finished.
    #[inline(always)]
    pub(crate) fn step<S: Simd>(&self, s: S, at: (S::V, S::V), t: S::V, a_max: f32) -> Step<S::V> {
        let (zero, cut, stop, a_max) = (s.splat(0.0), s.splat(X_CUT.next_up()), s.splat(T_STOP), s.splat(a_max));
        let (d, e) = self.form(s, at);
        let q = d.mul_add(d, e.mul_add(e, s.splat(self.nlo)));
        let raw = exp2_neg(s, q);
        let alpha = cut.select_gt(q, raw.min(a_max), zero);
        // T is what one Gaussian waits for the other: one multiply-add, one comparison, one choice.
        let next = alpha.neg_mul_add(t, t);
        Step {
            alpha,
            weight: next.select_gt(stop, alpha * t, zero),
            t: next.select_gt(stop, next, t.minus_abs()),
            going: next.gt_bits(stop),
        }
    }
}

/// One block takes its list; how many entries it took and whether a pixel is still unfinished.
///
/// In one go where the registers hold it. Else first the weights with T alone in registers, then the sums: together
/// they are ten registers of AVX2's sixteen, and what did not fit was T, on its way through memory from one Gaussian to the next.
/// A pixel adds the same numbers in the same order either way.
#[inline(always)]
fn take<S: Simd>(
    s: S,
    block: &mut Block,
    at: (S::V, S::V),
    list: &[u8],
    chunk: (&[Shown; CHUNK], &mut [Line; CHUNK]),
    shared: &Shared,
    extra: &mut [[f32; LANES]],
) -> (usize, bool) {
    if S::REGISTERS < 32 || !extra.is_empty() {
        return take_twice(s, block, at, list, chunk, shared, extra);
    }
    let (shown, _) = chunk;
    let mut t = s.load(&block.t);
    let mut sums = [s.load(&block.sum[0]), s.load(&block.sum[1]), s.load(&block.sum[2]), s.load(&block.sum[3])];
    let (mut taken, mut alive) = (list.len(), true);
    for (n, &i) in list.iter().enumerate() {
        let o = &shown[usize::from(i)];
        let step = o.step(s, at, t, shared.a_max);
        t = step.t;
        for (sum, value) in sums.iter_mut().zip(o.value) {
            *sum = step.weight.mul_add(s.splat(value), *sum);
        }
        if step.going == 0 {
            (taken, alive) = (n + 1, false);
            break;
        }
    }
    t.store(&mut block.t);
    for (sum, to) in sums.into_iter().zip(&mut block.sum) {
        sum.store(to);
    }
    (taken, alive)
}

/// [`take`], first the weights and then the sums.
#[inline(always)]
fn take_twice<S: Simd>(
    s: S,
    block: &mut Block,
    at: (S::V, S::V),
    list: &[u8],
    chunk: (&[Shown; CHUNK], &mut [Line; CHUNK]),
    shared: &Shared,
    extra: &mut [[f32; LANES]],
) -> (usize, bool) {
    let (shown, weights) = chunk;
    let mut t = s.load(&block.t);
    let (mut taken, mut alive) = (list.len(), true);
    for (n, (&i, weight)) in list.iter().zip(weights.iter_mut()).enumerate() {
        let step = shown[usize::from(i)].step(s, at, t, shared.a_max);
        t = step.t;
        step.weight.store(&mut weight.0);
        if step.going == 0 {
            (taken, alive) = (n + 1, false);
            break;
        }
    }
    t.store(&mut block.t);
    let (list, weights) = (&list[..taken], &weights[..taken]);
    let (mut r, mut g) = (s.load(&block.sum[0]), s.load(&block.sum[1]));
    let (mut b, mut z) = (s.load(&block.sum[2]), s.load(&block.sum[3]));
    for (&i, weight) in list.iter().zip(weights) {
        let (o, weight) = (&shown[usize::from(i)], s.load(&weight.0));
        r = weight.mul_add(s.splat(o.value[0]), r);
        g = weight.mul_add(s.splat(o.value[1]), g);
        b = weight.mul_add(s.splat(o.value[2]), b);
        z = weight.mul_add(s.splat(o.value[3]), z);
    }
    r.store(&mut block.sum[0]);
    g.store(&mut block.sum[1]);
    b.store(&mut block.sum[2]);
    z.store(&mut block.sum[3]);
    for (channel, sum) in extra.iter_mut().enumerate() {
        let mut total = s.load(sum);
        for (&i, weight) in list.iter().zip(weights) {
            let index = shown[usize::from(i)].index as usize;
            let value = shared.extra.values[index * shared.extra.channels + channel];
            total = s.load(&weight.0).mul_add(s.splat(value), total);
        }
        total.store(sum);
    }
    (taken, alive)
}
