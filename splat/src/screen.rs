//! A Gaussian on the screen: the record that drawing takes, and the tiles and blocks that it meets.

use bytemuck::{Pod, Zeroable};
use sf_ops::simd::LANES;

/// Side of a tile in pixels.
pub const TILE: u32 = 32;
/// Side of a block in pixels.
pub const BLOCK: usize = 4;
/// log2(255), and a few units in the last place: -log2(alpha) above this leaves no trace.
pub const X_CUT: f32 = 7.994_354;

/// A visible Gaussian on the screen: what drawing it takes. 48 bytes, because records go through memory once on the way in and once on
/// the way out.
#[derive(Clone, Copy, Debug, PartialEq, Pod, Zeroable)]
#[repr(C, align(16))]
pub struct Record {
    /// d at the centre of pixel `first`.
    pub d: f32,
    /// Change of d per column.
    pub cx: f32,
    /// Change of d per row.
    pub dy: f32,
    /// e in the row of `first`.
    pub e: f32,
    /// Change of e per row.
    pub ar: f32,
    /// -log2(opacity) after antialiasing, 0..=log2(255).
    pub nlo: f32,
    /// Colour.
    pub rgb: [f32; 3],
    /// Which Gaussian of the scene.
    pub index: u32,
    /// Column and row of the first pixel of its box.
    pub first: [u16; 2],
    pub(crate) unused: u32,
}

/// A record and where it lies.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Projected {
    /// The record.
    pub record: Record,
    /// Camera z, the sort key and the depth.
    pub z: f32,
    /// Pixels touched: columns `x[0]..x[1]`, not empty, inside the image.
    pub x: [u16; 2],
    /// Pixels touched: rows `y[0]..y[1]`, not empty, inside the image.
    pub y: [u16; 2],
}

/// Blocks of a tile, first and last of either axis, 0..=7.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Rect {
    /// Columns of blocks.
    pub x: (u8, u8),
    /// Rows of blocks.
    pub y: (u8, u8),
}

impl Rect {
    /// In 12 bits.
    #[inline(always)]
    pub fn pack(self) -> u32 {
        u32::from(self.x.0) | u32::from(self.x.1) << 3 | u32::from(self.y.0) << 6 | u32::from(self.y.1) << 9
    }

    /// Bit `8 row + column` set for every block.
    #[inline(always)]
    pub fn blocks(self) -> u64 {
        Self::blocks_of(self.pack())
    }

    /// [`Rect::blocks`] of 12 bits.
    #[inline(always)]
    pub fn blocks_of(bits: u32) -> u64 {
        // Columns in the low byte times rows as ones eight bits apart.
        COLUMNS[bits as usize % 64] * ROWS[bits as usize / 64 % 64]
    }
}

/// Bits `lo..=hi` for every `lo | hi << 3`.
const COLUMNS: [u64; 64] = spans(1);
/// Bits `8 lo, 8 lo + 8, ..= 8 hi`.
const ROWS: [u64; 64] = spans(8);

const fn spans(apart: usize) -> [u64; 64] {
    let mut table = [0; 64];
    let mut i = 0;
    while i < 64 {
        let mut bit = i % 8;
        while bit <= i / 8 {
            table[i] |= 1 << (bit * apart);
            bit += 1;
        }
        i += 1;
    }
    table
}

/// Tiles that a record meets, packed.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Met {
    /// Number of the first tile.
    pub tile: u32,
    /// `rectangle (12) | further columns of tiles (10) | further rows (10)`; the rectangle runs from the first block in the first tile
    /// to the last block in the last.
    pub span: u32,
}

impl Met {
    /// From the bits `lo | hi << 16` of columns and of rows, in an image of `columns` tiles a row. Any bits give something: lanes that
    /// are not visible come through here, too, and are not kept.
    #[inline(always)]
    pub(crate) fn new(x: u32, y: u32, columns: u32) -> Met {
        let (x0, x1) = (x & 0xffff, (x >> 16).wrapping_sub(1));
        let (y0, y1) = (y & 0xffff, (y >> 16).wrapping_sub(1));
        let rect = (x0 >> 2 & 7) | (x1 >> 2 & 7) << 3 | (y0 >> 2 & 7) << 6 | (y1 >> 2 & 7) << 9;
        let (wide, high) = ((x1 / TILE).wrapping_sub(x0 / TILE), (y1 / TILE).wrapping_sub(y0 / TILE));
        let tile = (y0 / TILE).wrapping_mul(columns).wrapping_add(x0 / TILE);
        Met { tile, span: rect | wide << 12 | high << 22 }
    }

    /// Further columns and rows of tiles.
    #[inline(always)]
    fn more(self) -> (u32, u32) {
        (self.span >> 12 & 0x3ff, self.span >> 22)
    }

    /// How many.
    #[inline(always)]
    pub fn count(self) -> u32 {
        let (wide, high) = self.more();
        (wide + 1) * (high + 1)
    }

    /// Column and row of a tile that it meets, counted from the first.
    fn place(self, tile: u32, columns: u32) -> (u32, u32) {
        (tile % columns - self.tile % columns, tile / columns - self.tile / columns)
    }

    /// Number of a tile that it meets, row by row.
    pub fn number(self, tile: u32, columns: u32) -> u32 {
        let (column, row) = self.place(tile, columns);
        row * (self.more().0 + 1) + column
    }

    /// The bits of the [`Rect`] in a tile that it meets.
    pub fn rect(self, tile: u32, columns: u32) -> u32 {
        let ((column, row), (wide, high)) = (self.place(tile, columns), self.more());
        part(column, wide, self.span) | part(row, high, self.span >> 6) << 6
    }

    /// Calls `f` with the number of every tile and the bits of the [`Rect`] in it.
    #[inline(always)]
    pub fn each(self, columns: u32, mut f: impl FnMut(usize, u32)) {
        let Met { tile, span } = self;
        if span >> 12 == 0 {
            return f(tile as usize, span);
        }
        let (wide, high) = self.more();
        for row in 0..=high {
            let rows = part(row, high, span >> 6) << 6;
            for column in 0..=wide {
                f((tile + row * columns + column) as usize, rows | part(column, wide, span));
            }
        }
    }
}

/// Blocks `lo | hi << 3` of one axis in tile `n` of `0..=last`, of which `bits` has the first in the first and the last in the last.
#[inline(always)]
fn part(n: u32, last: u32, bits: u32) -> u32 {
    let lo = if n == 0 { bits & 7 } else { 0 };
    let hi = if n == last { bits >> 3 & 7 } else { 7 };
    lo | hi << 3
}

/// The visible Gaussians of a run, in index order; the memory is kept between images.
///
/// What binning needs lies apart, packed: the records themselves are read only where they are drawn.
#[derive(Debug, Default)]
pub struct Seen {
    /// The first `len` are of this image, as in all vectors.
    pub(crate) records: Vec<Record>,
    pub(crate) len: usize,
    /// Camera z.
    pub(crate) z: Vec<f32>,
    /// The bits of [`Met::tile`].
    pub(crate) tile: Vec<f32>,
    /// The bits of [`Met::span`].
    pub(crate) span: Vec<f32>,
}

impl Seen {
    /// The records.
    #[inline(always)]
    pub fn records(&self) -> &[Record] {
        &self.records[..self.len]
    }

    /// Camera z and tiles of every record.
    #[inline(always)]
    pub fn places(&self) -> impl Iterator<Item = (f32, Met)> {
        let places = self.z[..self.len].iter().zip(&self.tile[..self.len]).zip(&self.span[..self.len]);
        places.map(|((&z, tile), span)| (z, Met { tile: tile.to_bits(), span: span.to_bits() }))
    }

    /// Tiles of a record.
    pub fn met(&self, record: usize) -> Met {
        Met { tile: self.tile[record].to_bits(), span: self.span[record].to_bits() }
    }

    /// Room for sixteen more; half as much again when it is short.
    #[inline(always)]
    pub(crate) fn room(&mut self) {
        if self.records.len() < self.len + LANES {
            self.grow();
        }
    }

    #[cold]
    #[inline(never)]
    fn grow(&mut self) {
        let len = (self.len + self.len / 2).max(1024) + LANES;
        self.records.resize(len, Record::zeroed());
        for plane in [&mut self.z, &mut self.tile, &mut self.span] {
            plane.resize(len, 0.0);
        }
    }

    /// Appends one.
    pub(crate) fn push(&mut self, Projected { record, z, x, y }: Projected, columns: u32) {
        self.room();
        let at = self.len;
        let met = Met::new(pair(x), pair(y), columns);
        self.records[at] = record;
        self.z[at] = z;
        (self.tile[at], self.span[at]) = (f32::from_bits(met.tile), f32::from_bits(met.span));
        self.len = at + 1;
    }
}

/// `lo | hi << 16`.
#[inline]
fn pair([lo, hi]: [u16; 2]) -> u32 {
    u32::from(lo) | u32::from(hi) << 16
}

/// The numbers that [`pair`] packed.
#[inline]
pub(crate) fn unpair(bits: u32) -> [u16; 2] {
    [bits as u16, (bits >> 16) as u16]
}
