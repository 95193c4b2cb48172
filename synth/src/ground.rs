//! The road network and the ground it lies in: analytic ray hits, kerbs, markings, pavements.
//!
//! The main road is an arc of constant curvature k through the street origin. With q = 2y - k (x^2 + y^2)
//! a point's offset to the left of its axis is n = q / (1 + sqrt(1 - k q)), and its position along it
//! is s = atan2(k x, 1 - k y) / k. An optional cross street is straight, at right angles to the road at
//! `cross.s`. Carriageways lie at z = 0; everything behind the kerb at z = [`KERB`].

use crate::math::{Rng, atan2, clamp01, fract, hash2, sin_cos, unit};
use crate::motion::{Arc, Path};
use crate::texture::{band, fade, fbm2, mix, octaves, pulses, step};
use glam::{DVec2, Vec2, Vec3, Vec4};

/// Height of the pavement over the carriageway, metres.
pub(crate) const KERB: f32 = 0.12;
/// Radius of the kerb at a street corner, metres.
const CORNER: f32 = 4.0;
/// Distance from the crossing carriageway to the stop line, metres.
const STOP: f32 = 6.6;

/// Line between the two directions.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Centre {
    /// Two solid lines.
    Double,
    /// One solid line.
    Solid,
    /// Dashes.
    Dashed,
}

/// A street of one cross-section.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Road {
    /// Lanes in each direction.
    pub(crate) lanes: u32,
    /// Lane width, metres.
    pub(crate) lane: f32,
    /// Kerb to the left of the axis, metres, positive.
    pub(crate) left: f32,
    /// Kerb to the right of the axis, metres, positive.
    pub(crate) right: f32,
    /// Pavement width, metres.
    pub(crate) pavement: f32,
    /// Width of a parking lane on the left and on the right, 0 where there is none.
    pub(crate) parking: [f32; 2],
    /// Line in the middle.
    pub(crate) centre: Centre,
}

impl Road {
    /// Draws a cross-section.
    pub(crate) fn draw(rng: &mut Rng, lanes: u32) -> Road {
        let lane = rng.range32(2.9, 3.6);
        let mut parking = || if rng.chance(0.72) { 2.2 } else { 0.0 };
        let parking = [parking(), parking()];
        let edge = if lanes == 1 { 0.35 } else { 0.25 };
        let half = lanes as f32 * lane + edge;
        Road {
            lanes,
            lane,
            left: half + parking[0],
            right: half + parking[1],
            pavement: rng.range32(2.2, 4.6),
            parking,
            centre: rng.pick(&[Centre::Double, Centre::Solid, Centre::Dashed, Centre::Dashed]),
        }
    }

    /// Offset of the middle of lane `k` (0 next to the axis) in the direction of travel along the axis
    /// (right-hand traffic: negative) or against it.
    pub(crate) fn lane_centre(&self, k: u32, with_axis: Direction) -> f64 {
        let n = f64::from(self.lane) * (f64::from(k) + 0.5);
        if with_axis == Direction::With { -n } else { n }
    }
}

/// Sense of travel relative to the road's axis.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Direction {
    /// Increasing s.
    With,
    /// Decreasing s.
    Against,
}

/// The crossing street; its own axis points to the left of the main road.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Cross {
    /// Where on the main road, metres.
    pub(crate) s: f64,
    /// Its cross-section: `left` is its side towards smaller s.
    pub(crate) road: Road,
    centre: [f32; 2],
    /// Unit vector of the main road at the crossing.
    axis: [f32; 2],
}

/// Everything on the ground.
#[derive(Clone, Debug)]
pub(crate) struct Ground {
    /// Curvature of the main road, 1/m.
    pub(crate) curvature: f64,
    /// Main road.
    pub(crate) road: Road,
    /// Crossing street.
    pub(crate) cross: Option<Cross>,
    /// Crosswalks away from crossings: s of their middles.
    pub(crate) crosswalks: Vec<f64>,
    look: Look,
}

/// Colours and seeds of the ground.
#[derive(Clone, Copy, Debug)]
struct Look {
    seed: u32,
    asphalt: Vec3,
    centre: Vec3,
    kerb: Vec3,
    slab: Vec3,
    slab_size: f32,
    verge: Vec3,
    grass: f32,
    patches: f32,
    cycle_lane: Option<Vec3>,
    wet: f32,
}

impl Ground {
    /// Draws the surfaces of given roads.
    pub(crate) fn draw(
        rng: &mut Rng,
        curvature: f64,
        road: Road,
        cross: Option<(f64, Road)>,
        crosswalks: Vec<f64>,
    ) -> Ground {
        let grey = rng.range32(0.045, 0.115);
        let tint = rng.range32(-0.03, 0.05);
        let yellow = rng.chance(0.45);
        let grass = if rng.chance(0.5) { rng.range32(0.6, 1.0) } else { 0.0 };
        let stone = rng.range32(0.22, 0.4);
        let look = Look {
            seed: rng.seed(),
            asphalt: Vec3::new(grey * (1.0 + tint), grey, grey * (1.0 - tint * 0.6)),
            centre: if yellow { Vec3::new(0.62, 0.42, 0.07) } else { Vec3::splat(0.6) },
            kerb: Vec3::splat(rng.range32(0.28, 0.48)),
            slab: Vec3::new(stone * rng.range32(0.98, 1.12), stone, stone * rng.range32(0.82, 1.0)),
            slab_size: rng.pick(&[0.5, 0.6, 0.9, 1.2]),
            verge: if grass > 0.0 {
                Vec3::new(rng.range32(0.07, 0.14), rng.range32(0.14, 0.22), rng.range32(0.03, 0.06))
            } else {
                Vec3::new(stone * 0.8, stone * 0.74, stone * 0.64)
            },
            grass,
            patches: rng.range32(0.0, 1.0),
            cycle_lane: rng.chance(0.14).then(|| rng.pick(&[Vec3::new(0.30, 0.07, 0.05), Vec3::new(0.05, 0.19, 0.10)])),
            wet: if rng.chance(0.12) { 1.0 } else { 0.0 },
        };
        let cross = cross.map(|(s, road)| {
            let at = road_point(curvature, s, 0.0);
            let (sin, cos) = sin_cos(curvature * s);
            Cross { s, road, centre: [at.x as f32, at.y as f32], axis: [cos as f32, sin as f32] }
        });
        Ground { curvature, road, cross, crosswalks, look }
    }

    /// Street point of road coordinates: `s` along, `n` to the left.
    pub(crate) fn point(&self, s: f64, n: f64) -> DVec2 {
        road_point(self.curvature, s, n)
    }

    /// Direction of the road at `s`, radians.
    pub(crate) fn heading(&self, s: f64) -> f64 {
        self.curvature * s
    }

    /// Endless path at offset `n`, starting at `s`.
    pub(crate) fn lane_path(&self, s: f64, n: f64, direction: Direction) -> Path {
        let bend = self.curvature / (1.0 - self.curvature * n);
        let (heading, curvature) = match direction {
            Direction::With => (self.heading(s), bend),
            Direction::Against => (self.heading(s) + std::f64::consts::PI, -bend),
        };
        Path::new(self.point(s, n), heading, vec![Arc { length: 1e4, curvature }])
    }

    /// Street point of cross-street coordinates: `m` along the main road's axis, `q` to its left.
    pub(crate) fn cross_point(&self, cross: &Cross, m: f64, q: f64) -> DVec2 {
        let (sin, cos) = sin_cos(self.heading(cross.s));
        self.point(cross.s, 0.0) + DVec2::new(cos, sin) * m + DVec2::new(-sin, cos) * q
    }

    /// Distance behind the kerb, four points at once; negative on a carriageway.
    #[inline(always)]
    pub(crate) fn kerb_distance(&self, x: Vec4, y: Vec4) -> Vec4 {
        let k = self.curvature as f32;
        let q = 2.0 * y - k * (x * x + y * y);
        let n = q / (1.0 + (1.0 - k * q).max(Vec4::ZERO).sqrt());
        let a = (n - self.road.left).max(-self.road.right - n);
        let Some(c) = &self.cross else { return a };
        let (px, py) = (x - c.centre[0], y - c.centre[1]);
        let m = px * c.axis[0] + py * c.axis[1];
        // The cross street's left is towards smaller s.
        let b = (-m - c.road.left).max(m - c.road.right);
        let (ua, ub) = ((CORNER - a).max(Vec4::ZERO), (CORNER - b).max(Vec4::ZERO));
        let round = CORNER - (ua * ua + ub * ub).sqrt();
        let inner = a.min(b);
        let corner = a.cmplt(Vec4::splat(CORNER)) & b.cmplt(Vec4::splat(CORNER)) & inner.cmpgt(Vec4::ZERO);
        Vec4::select(corner, round.min(inner), inner)
    }

    /// First hit of four rays from height `h` with slopes `dz` (down is negative): depth and kerb face flag.
    ///
    /// The pavement's plane counts where it lies behind the kerb, then the carriageway's plane where it
    /// lies before it; between the two the ray meets the kerb's face, placed where the kerb distance,
    /// taken as linear between the planes, is zero.
    #[inline(always)]
    pub(crate) fn hit(&self, o: Vec3, dx: Vec4, dy: Vec4, dz: Vec4) -> (Vec4, u32) {
        let down = (-dz).max(Vec4::splat(1e-9));
        let t1 = Vec4::splat(o.z - KERB) / down;
        let t0 = Vec4::splat(o.z) / down;
        let at = |t: Vec4| self.kerb_distance(o.x + dx * t, o.y + dy * t);
        let (d1, d0) = (at(t1), at(t0));
        let top = d1.cmpge(Vec4::ZERO);
        let road = d0.cmplt(Vec4::ZERO);
        let face = t1 + (t0 - t1) * (d1 / (d1 - d0).min(Vec4::splat(-1e-6)));
        let t = Vec4::select(top, t1, Vec4::select(road, t0, face));
        let t = Vec4::select(dz.cmplt(Vec4::splat(-1e-6)), t, Vec4::INFINITY);
        (t, !(top | road).bitmask() & 15)
    }

    /// Albedo at a ground point. `fx` and `fy` are the changes of (x, y) over one pixel to the right and
    /// one down.
    pub(crate) fn albedo(&self, p: Vec2, fx: Vec2, fy: Vec2) -> Vec3 {
        let k = self.curvature as f32;
        let (cx, cy) = (k * p.x, 1.0 - k * p.y);
        let inv = 1.0 / (cx * cx + cy * cy).sqrt();
        let along = Vec2::new(cy * inv, cx * inv);
        let across = Vec2::new(-along.y, along.x);
        let q = 2.0 * p.y - k * (p.x * p.x + p.y * p.y);
        let root = 1.0 - k * q;
        let n = q / (1.0 + if root > 0.0 { root.sqrt() } else { 0.0 });
        let s = if k.abs() < 1e-6 { p.x } else { atan2(cx, cy) / k };
        let foot = |axis: Vec2| fx.dot(axis).abs() + fy.dot(axis).abs();
        let main = Place { s, n, fs: foot(along), fn_: foot(across) };
        let d = self.kerb_distance(Vec4::splat(p.x), Vec4::splat(p.y)).x;
        let crossing = self.cross.as_ref().map(|c| {
            let rel = p - Vec2::from(c.centre);
            let axis = Vec2::from(c.axis);
            let m = rel.dot(axis);
            let place = Place { s: rel.dot(axis.perp()), n: -m, fs: foot(axis.perp()), fn_: foot(axis) };
            (c, m, place)
        });
        if d > 0.0 {
            return self.behind_kerb(d, &main, crossing.map(|(_, _, place)| place));
        }
        let mut rgb = self.asphalt(p, &main);
        let in_main = n < self.road.left && n > -self.road.right;
        match crossing {
            None => self.mark_road(&mut rgb, &self.road, &main, f32::INFINITY),
            Some((c, m, place)) => {
                let gap_main = (m - c.road.right).max(-m - c.road.left);
                let gap_cross = (n - self.road.left).max(-n - self.road.right);
                if in_main && gap_main > 0.5 {
                    self.mark_road(&mut rgb, &self.road, &main, gap_main);
                } else if !in_main && gap_cross > 0.5 {
                    self.mark_road(&mut rgb, &c.road, &place, gap_cross);
                }
            }
        }
        let gutter = band(d, -0.35, 0.0, main.fn_);
        rgb * (1.0 - 0.25 * gutter)
    }

    /// Bare asphalt: grain, stains along the wheel tracks, patches, cracks, manholes.
    fn asphalt(&self, p: Vec2, at: &Place) -> Vec3 {
        let l = &self.look;
        let f = at.fs.max(at.fn_);
        let mut tone = 1.0 + 0.30 * fbm2(p.x, p.y, octaves(2.6, 4, l.seed), f);
        tone += 0.30 * fbm2(at.s * 0.12, at.n, octaves(1.7, 2, l.seed ^ 0x71), at.fn_);
        // Wheel tracks polish two strips in each lane.
        let track = fract(at.n / self.road.lane);
        let w = (track - 0.27).abs().min((track - 0.73).abs());
        tone += 0.07 * clamp01(1.0 - w * 7.0) * fade(self.road.lane * 0.4, at.fn_);
        let cell = [crate::math::floor(at.s / 9.0) as i32, crate::math::floor(at.n / 3.4) as i32];
        let h = hash2(cell[0], cell[1], l.seed ^ 0x9a);
        if unit(h) < 0.22 * l.patches {
            let (u, v) = (at.s - 9.0 * cell[0] as f32, at.n - 3.4 * cell[1] as f32);
            let (u0, v0) = (unit(h.rotate_left(7)) * 3.0, unit(h.rotate_left(13)) * 0.8);
            let (u1, v1) = (u0 + 2.0 + 4.0 * unit(h.rotate_left(19)), v0 + 1.0 + 1.4 * unit(h.rotate_left(25)));
            tone *= 1.0 - 0.36 * band(u, u0, u1, at.fs) * band(v, v0, v1, at.fn_);
        } else if unit(h) > 0.93 {
            let (u, v) = (at.s - 9.0 * cell[0] as f32 - 4.5, at.n - 3.4 * cell[1] as f32 - 1.7);
            let r = (u * u + v * v).sqrt();
            tone *= 1.0 - 0.4 * band(r, 0.24, 0.34, f) - 0.22 * band(r, -1.0, 0.24, f);
        }
        // A crack runs where slow noise crosses its middle.
        let crack_fade = fade(0.12, f);
        if crack_fade > 0.0 {
            let c = crate::texture::noise2(p.x * 0.31, p.y * 0.31, l.seed ^ 0x33)
                + 0.25 * crate::texture::noise2(p.x * 1.9, p.y * 1.9, l.seed ^ 0x34);
            tone *= 1.0 - 0.3 * crack_fade * clamp01(1.0 - (c - 0.6).abs() * 90.0);
        }
        let rgb = l.asphalt * tone;
        if l.wet > 0.0 { rgb * (0.62 + 0.25 * fbm2(p.x, p.y, octaves(5.0, 2, l.seed ^ 0x55), f)) } else { rgb }
    }

    /// Lines, crosswalks, stop lines and arrows. `gap` is the distance to the crossing carriageway.
    fn mark_road(&self, rgb: &mut Vec3, road: &Road, at: &Place, gap: f32) {
        let l = &self.look;
        let n = at.n;
        let (mut white, mut middle) = (0.0f32, 0.0f32);
        let half = road.lanes as f32 * road.lane;
        if let Some(colour) = l.cycle_lane {
            let strip = band(n, half - 1.4, half, at.fn_) + band(n, -half, -half + 1.4, at.fn_);
            *rgb = mix(*rgb, colour, 0.8 * strip);
        }
        let before_stop = if gap > STOP { 1.0 } else { 0.0 };
        match road.centre {
            Centre::Double => middle += band(n.abs(), 0.08, 0.20, at.fn_) * before_stop,
            Centre::Solid => middle += band(n, -0.08, 0.08, at.fn_) * before_stop,
            Centre::Dashed => {
                middle += band(n, -0.08, 0.08, at.fn_) * pulses(at.s, 9.0, 0.0, 3.6, at.fs) * before_stop;
            }
        }
        for k in 1..road.lanes {
            let x = k as f32 * road.lane;
            white += band(n.abs(), x - 0.07, x + 0.07, at.fn_) * pulses(at.s + 2.0, 8.0, 0.0, 3.0, at.fs) * before_stop;
        }
        white += band(n.abs(), half - 0.06, half + 0.06, at.fn_) * 0.85;
        for (side, &width) in [1.0f32, -1.0].iter().zip(&road.parking) {
            if width > 0.0 && gap > STOP + 2.0 {
                white += 0.7 * band(n * side, half, half + width, at.fn_) * pulses(at.s, 5.6, 0.0, 0.1, at.fs);
            }
        }
        if gap < f32::INFINITY {
            let bars = pulses(n, 1.0, 0.0, 0.52, at.fn_);
            white += band(gap, 1.6, 4.9, at.fs) * bars;
            // Cars stop on their side only: those who come towards the crossing.
            let (mine, edge) = (if at.s < 0.0 { -n } else { n }, STOP - 1.0);
            white += band(gap, edge, edge + 0.4, at.fs) * band(mine, 0.15, half, at.fn_);
            white += arrow(gap - STOP - 4.0, fract(n.abs() / road.lane) * road.lane - 0.5 * road.lane, at)
                * band(mine, 0.1, half, at.fn_);
        } else {
            for &c in &self.crosswalks {
                white += band(at.s - c as f32, -1.7, 1.7, at.fs) * pulses(n, 1.0, 0.0, 0.52, at.fn_);
                white += band((at.s - c as f32).abs(), 3.2, 3.5, at.fs)
                    * band(if at.s < c as f32 { -n } else { n }, 0.15, half, at.fn_);
            }
        }
        let wear = 0.88 + 0.5 * fbm2(at.s, n, octaves(0.9, 3, l.seed ^ 0x1234), at.fs.max(at.fn_));
        *rgb = mix(*rgb, l.centre, clamp01(middle) * clamp01(wear));
        *rgb = mix(*rgb, Vec3::splat(0.62), clamp01(white) * clamp01(wear));
    }

    /// Kerb stone, pavement and what lies behind it, `d` metres from the kerb.
    fn behind_kerb(&self, d: f32, main: &Place, cross: Option<Place>) -> Vec3 {
        let l = &self.look;
        // The street whose kerb is nearer rules the joints.
        let at = match cross {
            Some(c) if outside(&self.road, main.n) > d + 0.01 => c,
            _ => *main,
        };
        let f = at.fs.max(at.fn_);
        let joint = 1.0 - 0.35 * pulses(at.s, 1.0, 0.0, 0.03, at.fs);
        let grain = 1.0 + 0.25 * fbm2(at.s, at.n, octaves(0.7, 3, l.seed ^ 0x77), f);
        if d < 0.22 {
            return l.kerb * joint * grain;
        }
        let size = l.slab_size;
        let (i, j) = (crate::math::floor(at.s / size) as i32, crate::math::floor(d / size) as i32);
        let slab_tone = 1.0 + 0.22 * (unit(hash2(i, j, l.seed ^ 0xbeef)) - 0.5) * fade(size, f);
        let joints = pulses(at.s, size, 0.0, 0.025, at.fs).max(pulses(d, size, 0.0, 0.025, at.fn_));
        let stain = 1.0 + 0.3 * fbm2(at.s, at.n, octaves(3.1, 3, l.seed ^ 0x88), f);
        let slab = l.slab * (slab_tone * stain * (1.0 - 0.4 * joints) * grain);
        let plot = step(d, self.road.pavement, at.fn_);
        if plot <= 0.0 {
            return slab;
        }
        let rough = 1.0 + (0.3 + 0.6 * l.grass) * fbm2(at.s, at.n, octaves(1.3, 4, l.seed ^ 0x99), f);
        let dry = Vec3::new(1.5, 1.15, 0.9);
        let worn = clamp01(0.5 + 1.4 * fbm2(at.s, at.n, octaves(6.0, 2, l.seed ^ 0xaa), f));
        mix(slab, l.verge * rough * mix(Vec3::ONE, dry, worn * l.grass * 0.6), plot)
    }

    /// Colour of the kerb's face.
    pub(crate) fn face_albedo(&self) -> Vec3 {
        self.look.kerb * 0.8
    }

    /// Share of the sky the surface mirrors: wet asphalt.
    pub(crate) fn wetness(&self) -> f32 {
        self.look.wet
    }
}

/// Road coordinates of a point with its footprints, metres.
#[derive(Clone, Copy, Debug)]
struct Place {
    s: f32,
    n: f32,
    fs: f32,
    fn_: f32,
}

fn outside(road: &Road, n: f32) -> f32 {
    (n - road.left).max(-road.right - n)
}

/// Straight-ahead arrow, 3 m long, tip at u = 0, v across.
fn arrow(u: f32, v: f32, at: &Place) -> f32 {
    let shaft = band(u, 0.9, 3.0, at.fs) * band(v, -0.09, 0.09, at.fn_);
    let head = band(u, 0.0, 0.95, at.fs) * band(v.abs(), -1.0, 0.38 * clamp01(u / 0.95), at.fn_);
    shaft.max(head)
}

fn road_point(curvature: f64, s: f64, n: f64) -> DVec2 {
    let half = 0.5 * curvature * s;
    let sinc = if half.abs() < 1e-4 { 1.0 - half * half / 6.0 } else { sin_cos(half).0 / half };
    let (sh, ch) = sin_cos(half);
    let (sin, cos) = sin_cos(2.0 * half);
    DVec2::new(ch, sh) * (s * sinc) + DVec2::new(-sin, cos) * n
}

#[cfg(test)]
mod tests {
    use super::*;

    fn ground(curvature: f64) -> Ground {
        let mut rng = Rng::new(5, "ground");
        let road = Road::draw(&mut rng, 2);
        let other = Road::draw(&mut rng, 1);
        Ground::draw(&mut rng, curvature, road, Some((40.0, other)), vec![])
    }

    #[test]
    fn kerb_distance_inverts_road_coordinates() {
        for curvature in [0.0, 0.003, -0.015] {
            let g = ground(curvature);
            for s in [-30.0, 0.0, 12.0, 90.0] {
                for n in [-20.0f64, -3.0, 0.0, 2.5, 15.0] {
                    let p = g.point(s, n);
                    let got = g.kerb_distance(Vec4::splat(p.x as f32), Vec4::splat(p.y as f32)).x;
                    let want = (n as f32 - g.road.left).max(-g.road.right - n as f32);
                    assert!((got - want).abs() < 1e-3, "{curvature} {s} {n}: {got} {want}");
                }
            }
            let c = g.cross.unwrap();
            let p = g.cross_point(&c, 0.3, 60.0);
            assert!(g.kerb_distance(Vec4::splat(p.x as f32), Vec4::splat(p.y as f32)).x < 0.0);
        }
    }

    #[test]
    fn lane_paths_stay_at_their_offset() {
        let g = ground(0.012);
        for (direction, n) in [(Direction::With, -4.0), (Direction::Against, 3.0)] {
            let path = g.lane_path(10.0, n, direction);
            for s in [0.0, 7.0, 40.0] {
                let p = path.at(s).at;
                let d = g.kerb_distance(Vec4::splat(p.x as f32), Vec4::splat(p.y as f32)).x;
                let want = (n as f32 - g.road.left).max(-g.road.right - n as f32);
                assert!((d - want).abs() < 2e-3, "{direction:?} {s}");
            }
        }
    }

    #[test]
    fn rays_meet_the_planes_and_the_face_between_them() {
        let g = ground(0.004);
        let o = Vec3::new(0.0, 0.0, 1.6);
        let (mut road, mut top, mut face) = (0, 0, 0);
        for i in 0..2_000 {
            let (a, b) = (i % 50, i / 50);
            let dy = Vec4::splat((a as f32 - 25.0) * 0.04);
            let dz = Vec4::splat(-0.02 - b as f32 * 0.01);
            let (t, faces) = g.hit(o, Vec4::ONE, dy, dz);
            let p = o + Vec3::new(1.0, dy.x, dz.x) * t.x;
            let d = g.kerb_distance(Vec4::splat(p.x), Vec4::splat(p.y)).x;
            if faces != 0 {
                face += 1;
                assert!((-1e-4..=KERB + 1e-4).contains(&p.z) && d.abs() < 0.02, "{p} {d}");
            } else if p.z > 0.5 * KERB {
                top += 1;
                assert!((p.z - KERB).abs() < 1e-4 && d > -1e-3);
            } else {
                road += 1;
                assert!(p.z.abs() < 1e-4 && d < 1e-3);
            }
        }
        assert!(road > 300 && top > 300 && face > 10, "{road} {top} {face}");
    }
}
