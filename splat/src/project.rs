//! Gaussians to the screen.
//!
//! The record keeps the quadratic form as a sum of squares in units of powers of two,
//!
//! ```text
//! x = d^2 + e^2 + nlo,  alpha = 2^-x
//! d = cx (X - u) + dy (Y - v)     cx = sqrt(log2(e) Syy / (2 det)),  dy = -cx Sxy / Syy
//! e = ar (Y - v)                  ar = sqrt(log2(e) / (2 Syy)),      nlo = -log2(opacity)
//! ```
//!
//! which equals opacity exp(-sigma) of the inverse covariance but cannot cancel and is never negative. d and e
//! are stored at the first pixel of the record's box, so that a centre far outside the image costs no precision.
//!
//! Two paths. Means, depths and centres are f64 in both: the order depends on them. The covariance is f32, sixteen
//! at a time, where that is enough: a trace of at most [`EASY_TRACE`] pixels squared and a determinant that the low-pass
//! keeps away from zero. Then Cauchy-Binet in f32 has a relative error below 4e-5 in the determinant. Anything
//! else, and any field that needs a rule (not finite, clamped, denormal), takes [`Projector::project`], which is f64:
//! a needle of 1000 x 0.5 pixels has a small eigenvalue that is the difference of numbers a million
//! times larger. The choice is made by bits that are equal everywhere.

use std::ops::Range;

use bytemuck::{Pod, Zeroable};
use glam::{DMat3, DVec3};
use sf_formats::scene::{Gaussians, SplatSettings};
use sf_formats::{Camera, Error, Result};
use sf_ops::simd::{Body, LANES, Simd, Vector};

use crate::math;

/// Alphas below this leave no trace: 1/255.
pub const ALPHA_CUT: f32 = 1.0 / 255.0;
/// Farthest z that is drawn (gsplat).
pub const FAR: f32 = 1e10;
/// Floor of the antialiasing factor (gsplat 1.6).
pub const AA_FLOOR: f64 = 0.005;
/// Side of a tile in pixels.
pub const TILE: u32 = 32;
/// Side of a block in pixels.
pub const BLOCK: usize = 4;
/// Standard deviations are clamped to this range, scene units. The low end keeps a zero scale a point;
/// the high end keeps the fourth powers in the determinant finite.
pub const SCALE_RANGE: (f32, f32) = (1e-20, 1e10);
/// Added to the radius of the box in sigma units and to runs in pixels, so that rounding never
/// excludes a pixel that the alpha test would keep.
pub const MARGIN: f64 = 1e-3;

/// log2(255), and a few units in the last place: -log2(alpha) above this leaves no trace.
pub const X_CUT: f32 = 7.994_354;
/// Largest trace of a covariance that is computed in f32, pixels squared: a sigma of 100 pixels.
pub const EASY_TRACE: f32 = 1e4;
/// Least determinant over trace of a covariance that is computed in f32, pixels squared. A low-pass of eps2d
/// alone gives eps2d.
const EASY_RATIO: f32 = 0.02;

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
    unused: u32,
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
    fn new(x: u32, y: u32, columns: u32) -> Met {
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
    records: Vec<Record>,
    len: usize,
    /// Camera z.
    z: Vec<f32>,
    /// The bits of [`Met::tile`].
    tile: Vec<f32>,
    /// The bits of [`Met::span`].
    span: Vec<f32>,
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
    fn room(&mut self) {
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
    fn push(&mut self, Projected { record, z, x, y }: Projected, columns: u32) {
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
fn pair([lo, hi]: [u16; 2]) -> u32 {
    u32::from(lo) | u32::from(hi) << 16
}

/// The numbers that [`pair`] packed.
fn unpair(bits: u32) -> [u16; 2] {
    [bits as u16, (bits >> 16) as u16]
}

/// Why a Gaussian is not drawn, or what was changed to draw it.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Counts {
    /// NaN or infinity in a field.
    pub nonfinite: u64,
    /// Negative scale.
    pub negative_scale: u64,
    /// Quaternion of length zero.
    pub zero_quaternion: u64,
    /// Covariance without a positive determinant.
    pub singular: u64,
    /// Scale clamped to [`SCALE_RANGE`].
    pub clamped_scale: u64,
    /// Opacity outside 0..=1, clamped.
    pub clamped_opacity: u64,
}

impl Counts {
    /// Adds those of another part of the scene.
    pub fn add(&mut self, other: &Counts) {
        self.nonfinite += other.nonfinite;
        self.negative_scale += other.negative_scale;
        self.zero_quaternion += other.zero_quaternion;
        self.singular += other.singular;
        self.clamped_scale += other.clamped_scale;
        self.clamped_opacity += other.clamped_opacity;
    }
}

/// Refuses settings under which the formulas have no value.
pub fn check_settings(s: &SplatSettings) -> Result<()> {
    let bad =
        |name: &str, v: f32, want: &str| Err(Error::input("splat settings", format!("{name} = {v} must be {want}")));
    if !(s.a_max > 0.0 && s.a_max < 1.0) {
        return bad("a_max", s.a_max, "between 0 and 1, both excluded");
    }
    if !(s.eps2d >= 0.0 && s.eps2d <= 100.0) {
        return bad("eps2d", s.eps2d, "0 to 100 pixels squared");
    }
    if !(s.near >= 1e-6 && s.near <= FAR) {
        return bad("near", s.near, "1e-6 to 1e10 scene units");
    }
    Ok(())
}

/// A camera with its settings, ready to project.
#[derive(Clone, Copy, Debug)]
pub struct Projector {
    pub(crate) world_to_camera: DMat3,
    pub(crate) centre: DVec3,
    pub(crate) camera: Camera,
    pub(crate) settings: SplatSettings,
    /// Limits of x/z in the Jacobian.
    pub(crate) clamp_x: (f64, f64),
    /// Limits of y/z in the Jacobian.
    pub(crate) clamp_y: (f64, f64),
}

impl Projector {
    /// Both must have been checked.
    pub fn new(camera: &Camera, settings: &SplatSettings) -> Projector {
        let clamp = |size: u32, f: f64, c: f64| {
            let size = f64::from(size);
            let margin = 0.3 * 0.5 * size / f;
            (-(c / f + margin), (size - c) / f + margin)
        };
        Projector {
            world_to_camera: camera.pose.r.transpose(),
            centre: camera.pose.t,
            camera: *camera,
            settings: *settings,
            clamp_x: clamp(camera.width, camera.k.fx, camera.k.cx),
            clamp_y: clamp(camera.height, camera.k.fy, camera.k.cy),
        }
    }

    /// Gaussian `i` on the screen by the f64 path; `None` when it leaves no trace in the image.
    pub fn project(&self, scene: &Gaussians, i: usize, counts: &mut Counts) -> Option<Projected> {
        let (mean, scale, quat) = (scene.mean[i], scene.scale[i], scene.quat[i]);
        let (opacity, rgb) = (scene.opacity[i], scene.colour[i]);
        let finite = |v: &[f32]| v.iter().all(|x| x.is_finite());
        if !(finite(&mean) && finite(&scale) && finite(&quat) && finite(&rgb) && opacity.is_finite()) {
            counts.nonfinite += 1;
            return None;
        }
        if scale.iter().any(|&s| s < 0.0) {
            counts.negative_scale += 1;
            return None;
        }
        let norm2 = quat.iter().fold(0.0, |a, &q| a + f64::from(q) * f64::from(q));
        if norm2 == 0.0 {
            counts.zero_quaternion += 1;
            return None;
        }
        let (lo, hi) = SCALE_RANGE;
        counts.clamped_scale += u64::from(scale.iter().any(|&s| s < lo || s > hi));
        counts.clamped_opacity += u64::from(!(0.0..=1.0).contains(&opacity));
        let mut opacity = opacity.clamp(0.0, 1.0);
        // Antialiasing only lowers it, so most invisible ones leave here.
        if opacity < ALPHA_CUT {
            return None;
        }

        let p = self.world_to_camera * (DVec3::from_array(mean.map(f64::from)) - self.centre);
        let z = p.z as f32;
        if !(z >= self.settings.near && z <= FAR) {
            return None;
        }
        let scale = scale.map(|s| f64::from(s.clamp(lo, hi)));
        let quat = quat.map(|q| f64::from(q) / norm2.sqrt());
        let Covariance { xx, xy: sxy, yy, det: before } = self.covariance(p, scale, quat);
        let eps = f64::from(self.settings.eps2d);
        let (sxx, syy) = (xx + eps, yy + eps);
        let det = before + eps * (xx + yy) + eps * eps;
        if det.is_nan() || det <= 0.0 {
            counts.singular += 1;
            return None;
        }
        if self.settings.aa {
            opacity *= (before / det).max(AA_FLOOR * AA_FLOOR).sqrt() as f32;
            if opacity < ALPHA_CUT {
                return None;
            }
        }

        let cut = math::ln(255.0 * f64::from(opacity));
        let radius = (2.0 * cut.max(0.0) + MARGIN).sqrt();
        let k = &self.camera.k;
        let (u, v) = (k.fx * (p.x / p.z) + k.cx, k.fy * (p.y / p.z) + k.cy);
        let x = pixel_span(u, radius * sxx.sqrt(), self.camera.width)?;
        let y = pixel_span(v, radius * syy.sqrt(), self.camera.height)?;
        let half_log2e = 0.5 * std::f64::consts::LOG2_E;
        let (cx, ar) = ((half_log2e * syy / det).sqrt(), (half_log2e / syy).sqrt());
        let dy = -cx * (sxy / syy);
        let (du, dv) = (f64::from(x[0]) + 0.5 - u, f64::from(y[0]) + 0.5 - v);
        let record = Record {
            d: (cx * du + dy * dv) as f32,
            cx: cx as f32,
            dy: dy as f32,
            e: (ar * dv) as f32,
            ar: ar as f32,
            nlo: (-std::f64::consts::LOG2_E * math::ln(f64::from(opacity))) as f32,
            rgb,
            index: i as u32,
            first: [x[0], y[0]],
            unused: 0,
        };
        Some(Projected { record, z, x, y })
    }

    /// The projected covariance before the low-pass of a scale and a unit quaternion.
    ///
    /// S = M M^T with M = J R^T Q diag(s), two rows of three numbers; its determinant is the sum of the
    /// squares of M's three 2x2 minors (Cauchy-Binet), which is never negative.
    fn covariance(&self, p: DVec3, scale: [f64; 3], [w, x, y, z]: [f64; 4]) -> Covariance {
        let columns = [
            DVec3::new(1.0 - 2.0 * (y * y + z * z), 2.0 * (x * y + w * z), 2.0 * (x * z - w * y)),
            DVec3::new(2.0 * (x * y - w * z), 1.0 - 2.0 * (x * x + z * z), 2.0 * (y * z + w * x)),
            DVec3::new(2.0 * (x * z + w * y), 2.0 * (y * z - w * x), 1.0 - 2.0 * (x * x + y * y)),
        ];
        let k = &self.camera.k;
        let (fx, fy) = (k.fx / p.z, k.fy / p.z);
        let tx = (p.x / p.z).clamp(self.clamp_x.0, self.clamp_x.1);
        let ty = (p.y / p.z).clamp(self.clamp_y.0, self.clamp_y.1);
        let (mut a, mut b) = ([0.0; 3], [0.0; 3]);
        for i in 0..3 {
            let axis = self.world_to_camera * columns[i];
            a[i] = fx * (axis.x - tx * axis.z) * scale[i];
            b[i] = fy * (axis.y - ty * axis.z) * scale[i];
        }
        let minor = |i: usize, j: usize| {
            let m = a[i] * b[j] - a[j] * b[i];
            m * m
        };
        Covariance {
            xx: a[0] * a[0] + a[1] * a[1] + a[2] * a[2],
            xy: a[0] * b[0] + a[1] * b[1] + a[2] * b[2],
            yy: b[0] * b[0] + b[1] * b[1] + b[2] * b[2],
            det: minor(0, 1) + minor(0, 2) + minor(1, 2),
        }
    }
}

/// Projects a run of the scene, sixteen at a time.
pub struct Project<'a> {
    /// The camera.
    pub projector: &'a Projector,
    /// The scene.
    pub scene: &'a Gaussians,
    /// Which part of it.
    pub run: Range<usize>,
    /// A further test of a visible Gaussian; those that fail it count as not finite.
    pub usable: Option<&'a (dyn Fn(usize) -> bool + Sync)>,
    /// Where visible ones go; emptied first.
    pub seen: &'a mut Seen,
    /// What was dropped or clamped.
    pub counts: &'a mut Counts,
    /// Columns of tiles.
    pub columns: u32,
    /// The number of records that meet every tile, 0 at first. They are counted here because a core has room for it beside the vectors.
    pub met: &'a mut [u32],
    /// Most pairs of record and tile: beyond it `met` is not continued.
    pub limit: u64,
}

/// Fields of sixteen Gaussians, as the scene holds them.
struct Sixteen<'a> {
    mean: &'a [[f32; 3]; LANES],
    scale: &'a [[f32; 3]; LANES],
    quat: &'a [[f32; 4]; LANES],
    opacity: &'a [f32; LANES],
    colour: &'a [[f32; 3]; LANES],
}

impl Body for Project<'_> {
    /// Entries: the sum over the records of the tiles they meet.
    type Output = u64;

    #[inline(always)]
    fn run<S: Simd>(self, s: S) -> u64 {
        let Project { projector, scene, run, usable, seen, counts, columns, met, limit } = self;
        seen.len = 0;
        let mut keep = Keep { projector, scene, usable, seen, counts, columns, met, limit, entries: 0 };
        let mut rows = [[0.0; LANES]; LANES];
        let (mean, rest) = scene.mean[run.clone()].as_chunks::<LANES>();
        let (scale, _) = scene.scale[run.clone()].as_chunks::<LANES>();
        let (quat, _) = scene.quat[run.clone()].as_chunks::<LANES>();
        let (opacity, _) = scene.opacity[run.clone()].as_chunks::<LANES>();
        let (colour, _) = scene.colour[run.clone()].as_chunks::<LANES>();
        let mut start = run.start;
        for ((((mean, scale), quat), opacity), colour) in mean.iter().zip(scale).zip(quat).zip(opacity).zip(colour) {
            let fields = Sixteen { mean, scale, quat, opacity, colour };
            let lanes = projector.sixteen(s, &fields, &mut rows, start as u32);
            keep.append(s, start, &mut rows, lanes);
            start += LANES;
        }
        if !rest.is_empty() {
            // The last ones, and zeros.
            let lanes = rest.len();
            let (mut mean, mut scale, mut colour) = ([[0.0; 3]; LANES], [[0.0; 3]; LANES], [[0.0; 3]; LANES]);
            let (mut quat, mut opacity) = ([[0.0; 4]; LANES], [0.0; LANES]);
            let last = start..run.end;
            mean[..lanes].copy_from_slice(rest);
            scale[..lanes].copy_from_slice(&scene.scale[last.clone()]);
            quat[..lanes].copy_from_slice(&scene.quat[last.clone()]);
            opacity[..lanes].copy_from_slice(&scene.opacity[last.clone()]);
            colour[..lanes].copy_from_slice(&scene.colour[last]);
            let fields = Sixteen { mean: &mean, scale: &scale, quat: &quat, opacity: &opacity, colour: &colour };
            let valid = (u32::from(u16::MAX) >> (LANES - lanes)) as u16;
            let (easy, hard) = projector.sixteen(s, &fields, &mut rows, start as u32);
            let lanes = (easy & valid, hard & valid);
            keep.append(s, start, &mut rows, lanes);
        }
        keep.entries
    }
}

/// [`Project`] at work.
struct Keep<'a> {
    projector: &'a Projector,
    scene: &'a Gaussians,
    usable: Option<&'a (dyn Fn(usize) -> bool + Sync)>,
    seen: &'a mut Seen,
    counts: &'a mut Counts,
    columns: u32,
    met: &'a mut [u32],
    limit: u64,
    entries: u64,
}

impl Keep<'_> {
    /// Appends the visible ones of sixteen: `easy` lanes from the fields of records in `rows`, `hard` lanes by the f64 path.
    #[inline(always)]
    fn append<S: Simd>(&mut self, s: S, start: usize, rows: &mut [[f32; LANES]; LANES], (easy, hard): (u16, u16)) {
        if easy | hard == 0 {
            return;
        }
        let at = self.seen.len;
        if hard == 0 && self.usable.is_none() {
            self.seen.room();
            let seen = &mut *self.seen;
            let (mut tile, mut span) = ([0.0; LANES], [0.0; LANES]);
            for l in 0..LANES {
                let met = Met::new(rows[X_ROW][l].to_bits(), rows[Y_ROW][l].to_bits(), self.columns);
                (tile[l], span[l]) = (f32::from_bits(met.tile), f32::from_bits(met.span));
            }
            let room = at..at + LANES;
            for (field, plane) in [(&rows[Z_ROW], &mut seen.z), (&tile, &mut seen.tile), (&span, &mut seen.span)] {
                let to = plane[room.clone()].first_chunk_mut().unwrap_or_else(|| unreachable!());
                s.store_chosen(s.load(field), easy, to);
            }
            s.transpose(rows);
            // Every row is written, and the next one over it where it is not visible: no branch to guess.
            let to: &mut [Record; LANES] = seen.records[room].first_chunk_mut().unwrap_or_else(|| unreachable!());
            let mut n = 0;
            for l in 0..LANES {
                to[n % LANES] = record(&rows[l]);
                n += usize::from(easy >> l & 1);
            }
            seen.len = at + n;
        } else {
            s.transpose(rows);
            self.append_hard(start, rows, (easy, hard));
        }
        let seen = &*self.seen;
        for (tile, span) in seen.tile[at..seen.len].iter().zip(&seen.span[at..seen.len]) {
            let met = Met { tile: tile.to_bits(), span: span.to_bits() };
            self.entries += u64::from(met.count());
            if self.entries <= self.limit {
                met.each(self.columns, |t, _| self.met[t] += 1);
            }
        }
    }

    /// [`Keep::append`] one by one.
    #[inline(never)]
    fn append_hard(&mut self, start: usize, rows: &[[f32; LANES]; LANES], (easy, hard): (u16, u16)) {
        let mut left = easy | hard;
        while left != 0 {
            let l = left.trailing_zeros() as usize % LANES;
            left &= left - 1;
            let projected = if easy >> l & 1 != 0 {
                let row = &rows[l];
                let (x, y) = (unpair(row[X_ROW].to_bits()), unpair(row[Y_ROW].to_bits()));
                Projected { record: record(row), z: row[Z_ROW], x, y }
            } else {
                let Some(projected) = self.projector.project(self.scene, start + l, self.counts) else { continue };
                projected
            };
            if self.usable.is_some_and(|usable| !usable(start + l)) {
                self.counts.nonfinite += 1;
                continue;
            }
            self.seen.push(projected, self.columns);
        }
    }
}

/// The record in the first numbers of a row.
#[inline(always)]
fn record(row: &[f32; LANES]) -> Record {
    let Some(first) = row.first_chunk::<12>() else { unreachable!() };
    bytemuck::cast(*first)
}

/// Where z lies in the rows of [`Projector::sixteen`], behind the record.
const Z_ROW: usize = 12;
/// `lo | hi << 16` of the columns.
const X_ROW: usize = 13;
/// `lo | hi << 16` of the rows.
const Y_ROW: usize = 14;

impl Projector {
    /// Sixteen Gaussians to records, field by field. Returns the lanes that are visible, and those that need the f64 path.
    #[inline(always)]
    fn sixteen<S: Simd>(&self, s: S, given: &Sixteen, rows: &mut [[f32; LANES]; LANES], first: u32) -> (u16, u16) {
        let (zero, one) = (s.splat(0.0), s.splat(1.0));

        // Fields that need no rule.
        let (mean, scale, colour) = (s.load3(given.mean), s.load3(given.scale), s.load3(given.colour));
        let [w, x, y, z] = s.load4(given.quat);
        let opacity = s.load(given.opacity);
        // 0 times a number is 0 unless the number is not finite.
        let mut unfinite = zero;
        for i in 0..3 {
            unfinite = mean[i].mul_add(zero, unfinite);
            unfinite = colour[i].mul_add(zero, unfinite);
        }
        let norm2 = w.mul_add(w, x.mul_add(x, y.mul_add(y, z * z)));
        // Squares of tiny ones underflow: below 1e-15 they are lengthened by 2^100 first.
        let longer = s.splat(1e-30).select_gt(norm2, s.splat(f32::from_bits(227 << 23)), one);
        let (w, x, y, z) = (w * longer, x * longer, y * longer, z * longer);
        let norm2 = w.mul_add(w, x.mul_add(x, y.mul_add(y, z * z)));
        let mut plain = one.gt_bits(unfinite.abs()) & norm2.gt_bits(s.splat(1e-30)) & s.splat(1e12).gt_bits(norm2);
        for v in scale {
            plain &= v.gt_bits(s.splat(1e-18)) & s.splat(1e9).gt_bits(v);
        }
        plain &= opacity.gt_bits(s.splat(-f32::from_bits(1))) & s.splat(1f32.next_up()).gt_bits(opacity);

        // Means in f64; the loops are vectorised by the compiler.
        let (m, k) = (&self.world_to_camera, &self.camera.k);
        let mut means = [[0.0f32; LANES]; 3];
        for i in 0..3 {
            mean[i].store(&mut means[i]);
        }
        let mut centre = [[0.0f64; LANES]; 2];
        let (mut depth, mut inverse, mut ray) = ([0.0f32; LANES], [0.0f32; LANES], [[0.0f32; LANES]; 2]);
        for l in 0..LANES {
            let x = f64::from(means[0][l]) - self.centre.x;
            let y = f64::from(means[1][l]) - self.centre.y;
            let z = f64::from(means[2][l]) - self.centre.z;
            let px = m.x_axis.x * x + m.y_axis.x * y + m.z_axis.x * z;
            let py = m.x_axis.y * x + m.y_axis.y * y + m.z_axis.y * z;
            let pz = m.x_axis.z * x + m.y_axis.z * y + m.z_axis.z * z;
            let over_z = 1.0 / pz;
            let (rx, ry) = (px * over_z, py * over_z);
            centre[0][l] = k.fx * rx + k.cx;
            centre[1][l] = k.fy * ry + k.cy;
            depth[l] = pz as f32;
            inverse[l] = over_z as f32;
            ray[0][l] = rx as f32;
            ray[1][l] = ry as f32;
        }
        let depth_v = s.load(&depth);
        let in_depth =
            depth_v.gt_bits(s.splat(self.settings.near.next_down())) & s.splat(FAR.next_up()).gt_bits(depth_v);
        let cut = s.splat(ALPHA_CUT.next_down());
        let seen = plain & in_depth & opacity.gt_bits(cut);
        if seen == 0 {
            return (0, !plain);
        }

        // Rows of J R^T, world axes: f/z (row 0 or 1 of R^T - ray row 2 of R^T).
        let ray = [clamp(s.load(&ray[0]), s, self.clamp_x), clamp(s.load(&ray[1]), s, self.clamp_y)];
        let over_z = s.load(&inverse);
        let (fx, fy) = (s.splat(k.fx as f32) * over_z, s.splat(k.fy as f32) * over_z);
        let (mut jx, mut jy) = ([zero; 3], [zero; 3]);
        let (right, down, forward) = (m.row(0), m.row(1), m.row(2));
        for j in 0..3 {
            let toward = s.splat(forward[j] as f32);
            jx[j] = fx * (s.splat(right[j] as f32) - ray[0] * toward);
            jy[j] = fy * (s.splat(down[j] as f32) - ray[1] * toward);
        }
        // Columns of Q from a quaternion of any length.
        let two = s.splat(2.0) / norm2;
        let (tx, ty, tz) = (two * x, two * y, two * z);
        let (xx, yy, zz) = (tx * x, ty * y, tz * z);
        let (xy, xz, yz) = (tx * y, tx * z, ty * z);
        let (wx, wy, wz) = (tx * w, ty * w, tz * w);
        let columns = [
            [one - (yy + zz), xy + wz, xz - wy],
            [xy - wz, one - (xx + zz), yz + wx],
            [xz + wy, yz - wx, one - (xx + yy)],
        ];
        let (mut a, mut b) = ([zero; 3], [zero; 3]);
        for i in 0..3 {
            a[i] = dot(&jx, &columns[i]) * scale[i];
            b[i] = dot(&jy, &columns[i]) * scale[i];
        }
        let (sxx, sxy, syy) = (dot(&a, &a), dot(&a, &b), dot(&b, &b));
        let minors = [a[0] * b[1] - a[1] * b[0], a[0] * b[2] - a[2] * b[0], a[1] * b[2] - a[2] * b[1]];
        let before = dot(&minors, &minors);
        let eps = s.splat(self.settings.eps2d);
        let det = before + eps * (sxx + syy + eps);
        let (sxx, syy) = (sxx + eps, syy + eps);
        let trace = sxx + syy;
        let soft = s.splat(EASY_TRACE).gt_bits(trace) & det.gt_bits(s.splat(EASY_RATIO) * trace);

        let opacity = if self.settings.aa {
            opacity * (before / det).max(s.splat((AA_FLOOR * AA_FLOOR) as f32)).sqrt()
        } else {
            opacity
        };
        let kept = opacity.gt_bits(cut);
        let log2 = math::log2(s, opacity);
        // radius^2 = 2 ln(255 opacity) and the margin.
        let over_cut = (log2 + s.splat(X_CUT)).max(zero);
        let radius2 = over_cut.mul_add(s.splat((2.0 * std::f64::consts::LN_2) as f32), s.splat(MARGIN as f32));
        let (mut lo, mut hi) = ([[0.0f32; LANES]; 2], [[0.0f32; LANES]; 2]);
        let mut inside = u16::MAX;
        for (i, (variance, size)) in [(sxx, self.camera.width), (syy, self.camera.height)].into_iter().enumerate() {
            let half = (radius2 * variance).sqrt() + s.splat((0.5 + MARGIN) as f32);
            let mut middle = [0.0f32; LANES];
            for l in 0..LANES {
                middle[l] = centre[i][l] as f32;
            }
            let (middle, size) = (s.load(&middle), s.splat(size as f32));
            // floor(v) + 1 = ceil(v) but for whole numbers, which the margin makes immaterial.
            let first = ceil(s, at_most((middle - half).max(zero), size));
            let past = ceil(s, at_most((middle + half - one).max(zero), size));
            inside &= past.gt_bits(first);
            first.store(&mut lo[i]);
            past.store(&mut hi[i]);
        }
        let easy = seen & soft & kept & inside;
        let hard = !plain | seen & !soft;
        if easy == 0 {
            return (0, hard);
        }

        let half_log2e = s.splat((0.5 * std::f64::consts::LOG2_E) as f32);
        let cx = (half_log2e * syy / det).sqrt();
        let ar = (half_log2e / syy).sqrt();
        let dy = zero - cx * (sxy / syy);
        let mut offset = [[0.0f32; LANES]; 2];
        let mut boxes = [[0.0f32; LANES]; 2];
        for i in 0..2 {
            for l in 0..LANES {
                offset[i][l] = (f64::from(lo[i][l]) + 0.5 - centre[i][l]) as f32;
                // 2^23 plus a small whole number holds it in the low bits.
                let bits = |v: f32| (v + 8_388_608.0).to_bits();
                boxes[i][l] = f32::from_bits(bits(lo[i][l]) & 0xffff | bits(hi[i][l]) << 16);
            }
        }
        let (du, dv) = (s.load(&offset[0]), s.load(&offset[1]));
        cx.mul_add(du, dy * dv).store(&mut rows[0]);
        cx.store(&mut rows[1]);
        dy.store(&mut rows[2]);
        (ar * dv).store(&mut rows[3]);
        ar.store(&mut rows[4]);
        (zero - log2).store(&mut rows[5]);
        for i in 0..3 {
            colour[i].store(&mut rows[6 + i]);
        }
        for l in 0..LANES {
            rows[9][l] = f32::from_bits(first + l as u32);
            rows[10][l] = f32::from_bits(boxes[0][l].to_bits() & 0xffff | boxes[1][l].to_bits() << 16);
        }
        rows[Z_ROW] = depth;
        rows[X_ROW] = boxes[0];
        rows[Y_ROW] = boxes[1];
        (easy, hard)
    }
}

/// x within limits.
#[inline(always)]
fn clamp<S: Simd>(x: S::V, s: S, (lo, hi): (f64, f64)) -> S::V {
    at_most(x.max(s.splat(lo as f32)), s.splat(hi as f32))
}

/// Sum of products.
#[inline(always)]
fn dot<V: Vector>(a: &[V; 3], b: &[V; 3]) -> V {
    a[0].mul_add(b[0], a[1].mul_add(b[1], a[2] * b[2]))
}

/// a < b ? a : b.
#[inline(always)]
fn at_most<V: Vector>(a: V, b: V) -> V {
    b.select_gt(a, a, b)
}

/// Smallest whole number not below x, for 0 <= x < 2^22.
#[inline(always)]
fn ceil<S: Simd>(s: S, x: S::V) -> S::V {
    let magic = s.splat(12_582_912.0);
    let near = (x + magic) - magic;
    x.select_gt(near, near + s.splat(1.0), near)
}

/// Symmetric 2x2 matrix with its determinant, pixels squared.
struct Covariance {
    xx: f64,
    xy: f64,
    yy: f64,
    det: f64,
}

/// Pixels `lo..hi` of `0..size` whose centres lie within `half` of `centre`; `None` when empty.
fn pixel_span(centre: f64, half: f64, size: u32) -> Option<[u16; 2]> {
    if centre.is_nan() || half.is_nan() {
        return None;
    }
    // Size <= 16384 fits.
    let lo = (centre - half - 0.5).ceil().max(0.0);
    let hi = (centre + half - 0.5).floor().min(f64::from(size) - 1.0);
    (lo <= hi).then(|| [lo as u16, hi as u16 + 1])
}

#[cfg(test)]
mod tests {
    use super::*;
    use sf_formats::{Intrinsics, Pose};

    #[test]
    fn spans_hold_exactly_the_pixel_centres_inside() {
        assert_eq!(pixel_span(4.5, 0.0, 8), Some([4, 5]));
        assert_eq!(pixel_span(4.4, 0.05, 8), None);
        assert_eq!(pixel_span(0.0, 1e30, 8), Some([0, 8]));
        assert_eq!(pixel_span(-3.0, 3.4, 8), None);
        assert_eq!(pixel_span(-3.0, 3.5, 8), Some([0, 1]));
        assert_eq!(pixel_span(f64::NAN, 1.0, 8), None);
        assert_eq!(pixel_span(3.0, f64::NAN, 8), None);
    }

    #[test]
    fn a_sphere_on_the_axis_is_a_disc_of_focal_over_z() {
        // s = 0.2 at z = 4 with f = 100: sigma 5 pixels, low-pass 0.3.
        let camera = Camera {
            width: 64,
            height: 48,
            k: Intrinsics { fx: 100.0, fy: 100.0, cx: 32.0, cy: 24.0 },
            pose: Pose::IDENTITY,
        };
        let scene = Gaussians {
            mean: vec![[0.0, 0.0, 4.0]],
            scale: vec![[0.2; 3]],
            quat: vec![[0.5, 0.5, -0.5, 0.5]],
            opacity: vec![1.0],
            colour: vec![[1.0, 0.0, 0.0]],
        };
        let mut counts = Counts::default();
        let p = Projector::new(&camera, &SplatSettings::default()).project(&scene, 0, &mut counts).unwrap();
        let r = p.record;
        let unit = (0.5 * std::f64::consts::LOG2_E / 25.3).sqrt() as f32;
        assert_eq!((p.z, r.nlo), (4.0, 0.0));
        assert!((r.cx - unit).abs() < 1e-7 && (r.ar - unit).abs() < 1e-7 && r.dy.abs() < 1e-7);
        assert!(
            (r.d - unit * (15.5 - 32.0)).abs() < 1e-6
                && (r.e - unit * (f32::from(r.first[1]) + 0.5 - 24.0)).abs() < 1e-6
        );
        // Radius sqrt(2 ln 255) * sqrt(25.3) = 16.74 pixels: centres 15.5..=48.5.
        assert_eq!((p.x, r.first[0]), ([15, 49], 15));
        assert_eq!(counts, Counts::default());
    }
}
