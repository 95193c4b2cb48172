//! One tile, front to back.
//!
//! The tile is 32 rows of four [`Octet`]s of eight pixels. A Gaussian visits, row by row, the octets
//! that meet the run of pixels where its sigma is below the cut; within an octet all eight lanes
//! compute and the alpha test selects. Every step of a lane is one IEEE operation in a fixed order,
//! so any vector width gives the same bits.
//!
//! T carries the sign of life: a finished pixel holds -T, which keeps T for the output.
//!
//! Most entries of a dense scene lie behind finished pixels, so keys are sorted in doubling pieces,
//! nearest piece first, and the tile ends when no pixel is alive.

use crate::math::exp_neg;
use crate::project::{ALPHA_CUT, MARGIN, Record, TILE};

/// A pixel is finished when its next T would be at or below this.
pub const T_STOP: f32 = 1e-4;
/// Pixels handled together.
pub const LANES: usize = 8;
const SIDE: usize = TILE as usize;
const PER_ROW: usize = SIDE / LANES;
/// Keys sorted first; every further piece is twice as long. About what fills a tile of a dense scene.
const FIRST_PIECE: usize = 512;
/// Gaussians between two looks for finished octets.
const LOOK: usize = 32;

/// State of eight neighbouring pixels of a row.
#[derive(Clone, Copy, Debug)]
pub struct Octet {
    /// Transmittance, negated when the pixel is finished.
    t: [f32; LANES],
    /// Sum of T alpha times red, green, blue, z.
    sum: [[f32; LANES]; 4],
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
    octets: Box<[Octet; SIDE * PER_ROW]>,
    alive: [bool; SIDE * PER_ROW],
    /// `[pixel of the tile, channels]`.
    extra: Vec<f32>,
    keys: Vec<u64>,
}

impl Default for Tile {
    fn default() -> Self {
        let empty = Octet { t: [1.0; LANES], sum: [[0.0; LANES]; 4] };
        Tile {
            octets: Box::new([empty; SIDE * PER_ROW]),
            alive: [true; SIDE * PER_ROW],
            extra: Vec::new(),
            keys: Vec::new(),
        }
    }
}

impl Tile {
    /// Starts a tile: T = 1 inside the image, finished outside, and an empty list.
    pub fn clear(&mut self, place: Place, channels: usize) {
        for (i, octet) in self.octets.iter_mut().enumerate() {
            let (y, x0) = (i / PER_ROW, i % PER_ROW * LANES);
            for l in 0..LANES {
                octet.t[l] = if y < place.height && x0 + l < place.width { 1.0 } else { -1.0 };
            }
            octet.sum = [[0.0; LANES]; 4];
        }
        self.extra.clear();
        self.extra.resize(SIDE * SIDE * channels, 0.0);
        self.keys.clear();
    }

    /// Adds keys to the list.
    pub fn push(&mut self, keys: &[u64]) {
        self.keys.extend_from_slice(keys);
    }

    /// Composites the list in key order. `record` finds the record of a key.
    pub fn blend<'r>(&mut self, place: Place, a_max: f32, extra: Channels, record: impl Fn(u64) -> &'r Record) {
        let mut keys = std::mem::take(&mut self.keys);
        let mut rest = &mut keys[..];
        let mut piece = FIRST_PIECE;
        while !rest.is_empty() && self.look() {
            let n = piece.min(rest.len());
            if n < rest.len() {
                rest.select_nth_unstable(n - 1);
            }
            let (now, later) = rest.split_at_mut(n);
            now.sort_unstable();
            for (i, &key) in now.iter().enumerate() {
                if i % LOOK == LOOK - 1 && !self.look() {
                    break;
                }
                self.add(place, a_max, extra, record(key));
            }
            rest = later;
            piece *= 2;
        }
        self.keys = keys;
    }

    /// Marks the octets that still have a pixel alive; whether there is one.
    fn look(&mut self) -> bool {
        let mut any = false;
        for (alive, octet) in self.alive.iter_mut().zip(self.octets.iter()) {
            let mut most = octet.t[0];
            for &t in &octet.t[1..] {
                most = if t > most { t } else { most };
            }
            *alive = most > 0.0;
            any |= *alive;
        }
        any
    }

    /// Composites one Gaussian.
    fn add(&mut self, place: Place, a_max: f32, extra: Channels, r: &Record) {
        let first_row = usize::from(r.y.0).max(place.y) - place.y;
        let last_row = (usize::from(r.y.1) - place.y).min(SIDE);
        let first = (usize::from(r.x.0).max(place.x) - place.x) as f64;
        let last = (usize::from(r.x.1) - 1 - place.x).min(SIDE - 1) as f64;
        // From here columns count from the tile's first pixel centre.
        let u = r.u - (place.x as f64 + 0.5);
        for row in first_row..last_row {
            let dy = (place.y + row) as f64 + 0.5 - r.v;
            let base = (r.row_k * dy * dy) as f32;
            let left = r.cut - base + MARGIN as f32;
            if left < 0.0 {
                continue;
            }
            let middle = u + r.slope * dy;
            let half = f64::from(left.sqrt() * r.col_width) + MARGIN;
            let lo = (middle - half).max(first);
            let hi = (middle + half).min(last);
            if lo > hi {
                continue;
            }
            for o in lo as usize / LANES..=hi as usize / LANES {
                let at = row * PER_ROW + o;
                if !self.alive[at] {
                    continue;
                }
                let offset = ((o * LANES) as f64 - middle) as f32;
                let weight = update(&mut self.octets[at], r, (offset, base), a_max);
                if extra.channels > 0 {
                    let values = &extra.values[r.index as usize * extra.channels..][..extra.channels];
                    let sums = &mut self.extra[at * LANES * extra.channels..][..LANES * extra.channels];
                    for (sum, w) in sums.chunks_exact_mut(extra.channels).zip(weight) {
                        for (s, v) in sum.iter_mut().zip(values) {
                            *s += w * v;
                        }
                    }
                }
            }
        }
    }

    /// T and the sums of red, green, blue, z of a pixel of the tile.
    #[inline]
    pub fn pixel(&self, x: usize, y: usize) -> (f32, [f32; 4]) {
        let (o, l) = (&self.octets[y * PER_ROW + x / LANES], x % LANES);
        (o.t[l].abs(), [o.sum[0][l], o.sum[1][l], o.sum[2][l], o.sum[3][l]])
    }

    /// The extra sums of the first `width` pixels of a row.
    pub fn extra_row(&self, y: usize, width: usize, channels: usize) -> &[f32] {
        &self.extra[y * SIDE * channels..][..width * channels]
    }
}

/// One Gaussian on one octet; the weights T alpha. `offset` is the column of lane 0 from the row's
/// middle, `base` the part of sigma that the row alone gives.
#[inline(always)]
fn update(octet: &mut Octet, r: &Record, (offset, base): (f32, f32), a_max: f32) -> [f32; LANES] {
    let mut weight = [0.0; LANES];
    for l in 0..LANES {
        let d = offset + l as f32;
        let raw = r.opacity * exp_neg(-(base + r.col_k * (d * d)));
        let capped = if raw < a_max { raw } else { a_max };
        let t = octet.t[l];
        let alpha = if (raw >= ALPHA_CUT) & (t > 0.0) { capped } else { 0.0 };
        let next = t * (1.0 - alpha);
        let stop = (next <= T_STOP) & (t > 0.0);
        weight[l] = if stop { 0.0 } else { alpha * t };
        octet.t[l] = if stop { -t } else { next };
    }
    let values = [r.rgb[0], r.rgb[1], r.rgb[2], r.z];
    for (sum, value) in octet.sum.iter_mut().zip(values) {
        for l in 0..LANES {
            sum[l] += weight[l] * value;
        }
    }
    weight
}
