//! Sixteen Gaussians to the screen at a time: the fast path of [`crate::project`], and what becomes of its results.

use std::ops::Range;

use sf_formats::scene::Gaussians;
use sf_ops::simd::{Body, LANES, Simd, Vector};

use crate::math;
use crate::project::{AA_FLOOR, ALPHA_CUT, Counts, EASY_TRACE, FAR, MARGIN, Projector};
use crate::screen::{Met, Projected, Record, Seen, X_CUT, unpair};

/// Least determinant over trace of a covariance that is computed in f32, pixels squared. A low-pass of eps2d
/// alone gives eps2d.
const EASY_RATIO: f32 = 0.02;

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
