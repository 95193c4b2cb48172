//! Solid primitives in part coordinates: ray intersection four rays at a time, normals, bounds.
//!
//! A ray is o + t d with d of unit z in *camera* axes, so t is the z-depth itself. The four lanes of a
//! [`glam::Vec4`] are the four rays of one pixel; only elementwise +, -, x, /, sqrt, min, max and
//! compare-select are used, which round alike on every CPU.

use crate::math::clamp01;
use crate::texture::{fade, noise3};
use glam::{Vec3, Vec4};

/// Four rays from one origin, in part coordinates.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Rays {
    /// Common origin.
    pub(crate) o: Vec3,
    /// Direction, x of the four lanes.
    pub(crate) dx: Vec4,
    /// Direction, y of the four lanes.
    pub(crate) dy: Vec4,
    /// Direction, z of the four lanes.
    pub(crate) dz: Vec4,
}

/// Half-space n . p <= d.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) struct Plane {
    /// Unit outward normal.
    pub(crate) n: Vec3,
    /// Distance of the face from the origin.
    pub(crate) d: f32,
}

impl Plane {
    /// The face through a point with an outward direction of any length.
    pub(crate) fn through(point: Vec3, outward: Vec3) -> Plane {
        let n = outward / outward.dot(outward).sqrt();
        Plane { n, d: n.dot(point) }
    }
}

/// A primitive around its own origin.
#[derive(Clone, Debug, PartialEq)]
pub(crate) enum Shape {
    /// Axis-aligned box.
    Box {
        /// Half extents.
        half: Vec3,
    },
    /// Ellipsoid.
    Ellipsoid {
        /// Radii.
        radii: Vec3,
    },
    /// Cylinder along z.
    Cylinder {
        /// Radius.
        radius: f32,
        /// Half length.
        half: f32,
    },
    /// Cylinder along z with round ends.
    Capsule {
        /// Radius.
        radius: f32,
        /// Half length of the straight part.
        half: f32,
    },
    /// Convex solid between planes (vehicle bodies, pitched roofs).
    Hull {
        /// Faces.
        planes: Vec<Plane>,
        /// Corner of the bounding box.
        lo: Vec3,
        /// Opposite corner.
        hi: Vec3,
    },
    /// Shell of leaves: an ellipsoid with holes where noise is low; rays through a hole go on to the far
    /// side. The holes are part of the object, so they move with it and look alike from everywhere.
    Crown {
        /// Radii.
        radii: Vec3,
        /// Wavelength of the holes, metres.
        leaf: f32,
        /// Share of the shell that is open, about.
        open: f32,
        /// Which noise.
        seed: u32,
    },
}

const MISS: Vec4 = Vec4::INFINITY;

impl Shape {
    /// Corners of the bounding box.
    pub(crate) fn bounds(&self) -> (Vec3, Vec3) {
        let half = match self {
            Shape::Box { half } => *half,
            Shape::Ellipsoid { radii } | Shape::Crown { radii, .. } => *radii,
            Shape::Cylinder { radius, half } => Vec3::new(*radius, *radius, *half),
            Shape::Capsule { radius, half } => Vec3::new(*radius, *radius, half + radius),
            Shape::Hull { lo, hi, .. } => return (*lo, *hi),
        };
        (-half, half)
    }

    /// Whether its normal jumps anywhere.
    pub(crate) fn has_edges(&self) -> bool {
        matches!(self, Shape::Box { .. } | Shape::Hull { .. } | Shape::Cylinder { .. })
    }

    /// Outward normal at a surface point.
    pub(crate) fn normal(&self, p: Vec3) -> Vec3 {
        match self {
            Shape::Box { half } => {
                let q = p / *half;
                let a = q.abs();
                let pick = |v: f32| if v < 0.0 { -1.0 } else { 1.0 };
                if a.x >= a.y && a.x >= a.z {
                    Vec3::new(pick(q.x), 0.0, 0.0)
                } else if a.y >= a.z {
                    Vec3::new(0.0, pick(q.y), 0.0)
                } else {
                    Vec3::new(0.0, 0.0, pick(q.z))
                }
            }
            Shape::Ellipsoid { radii } | Shape::Crown { radii, .. } => unit_vector(p / (*radii * *radii)),
            Shape::Cylinder { radius, half } => {
                // A point of the mantle is nearer to it than to the cap's plane.
                let cap = half - p.z.abs();
                let mantle = radius - (p.x * p.x + p.y * p.y).sqrt();
                if cap.abs() < mantle.abs() {
                    Vec3::new(0.0, 0.0, if p.z < 0.0 { -1.0 } else { 1.0 })
                } else {
                    unit_vector(Vec3::new(p.x, p.y, 0.0))
                }
            }
            Shape::Capsule { half, .. } => {
                let z = if p.z > *half {
                    p.z - half
                } else if p.z < -half {
                    p.z + half
                } else {
                    0.0
                };
                unit_vector(Vec3::new(p.x, p.y, z))
            }
            Shape::Hull { planes, .. } => {
                let mut best = planes[0];
                for plane in planes {
                    if plane.n.dot(p) - plane.d > best.n.dot(p) - best.d {
                        best = *plane;
                    }
                }
                best.n
            }
        }
    }

    /// Depth of the first hit of each lane, infinity for a miss. The origin is taken to be outside.
    ///
    /// `pixel` is the width of a pixel at depth 1; it fades holes that would be narrower than two.
    #[inline(always)]
    pub(crate) fn hit(&self, r: &Rays, pixel: f32) -> Vec4 {
        match self {
            Shape::Box { half } => hit_box(r, *half),
            Shape::Ellipsoid { radii } => hit_ellipsoid(r, *radii).0,
            Shape::Cylinder { radius, half } => hit_cylinder(r, *radius, *half),
            Shape::Capsule { radius, half } => hit_capsule(r, *radius, *half),
            Shape::Hull { planes, .. } => hit_hull(r, planes),
            Shape::Crown { radii, leaf, open, seed } => {
                let (near, far) = hit_ellipsoid(r, *radii);
                if near.cmpge(MISS).all() {
                    return near;
                }
                let mut t = near;
                for k in 0..4 {
                    if near[k] < f32::INFINITY {
                        t[k] = leaf_hit(r, k, [near[k], far[k]], (*leaf, *open * fade(*leaf, near[k] * pixel), *seed));
                    }
                }
                t
            }
        }
    }
}

#[inline(always)]
fn unit_vector(v: Vec3) -> Vec3 {
    v / (v.dot(v) + 1e-30).sqrt()
}

/// Keeps entries in front of the origin whose interval is not empty.
#[inline(always)]
fn interval(enter: Vec4, leave: Vec4) -> Vec4 {
    let good = enter.cmple(leave) & enter.cmpgt(Vec4::ZERO);
    Vec4::select(good, enter, MISS)
}

/// Ray parameters between which one coordinate is within +-half.
#[inline(always)]
fn slab(o: f32, d: Vec4, half: f32) -> (Vec4, Vec4) {
    let tiny = Vec4::splat(1e-12);
    let d = Vec4::select(d.abs().cmplt(tiny), tiny, d);
    let inv = Vec4::ONE / d;
    let a = Vec4::splat(-half - o) * inv;
    let b = Vec4::splat(half - o) * inv;
    (a.min(b), a.max(b))
}

#[inline(always)]
fn hit_box(r: &Rays, half: Vec3) -> Vec4 {
    let (ax, bx) = slab(r.o.x, r.dx, half.x);
    let (ay, by) = slab(r.o.y, r.dy, half.y);
    let (az, bz) = slab(r.o.z, r.dz, half.z);
    interval(ax.max(ay).max(az), bx.min(by).min(bz))
}

/// Near and far hit.
#[inline(always)]
fn hit_ellipsoid(r: &Rays, radii: Vec3) -> (Vec4, Vec4) {
    let inv = Vec3::ONE / radii;
    let o = r.o * inv;
    let (dx, dy, dz) = (r.dx * inv.x, r.dy * inv.y, r.dz * inv.z);
    let a = dx * dx + dy * dy + dz * dz;
    let b = dx * o.x + dy * o.y + dz * o.z;
    let c = o.dot(o) - 1.0;
    let disc = b * b - a * c;
    let root = disc.max(Vec4::ZERO).sqrt();
    let (near, far) = ((-b - root) / a, (-b + root) / a);
    let good = disc.cmpgt(Vec4::ZERO) & near.cmpgt(Vec4::ZERO);
    (Vec4::select(good, near, MISS), far)
}

/// Ray parameters inside the endless cylinder.
#[inline(always)]
fn mantle(r: &Rays, radius: f32) -> (Vec4, Vec4) {
    let a = (r.dx * r.dx + r.dy * r.dy).max(Vec4::splat(1e-12));
    let b = r.dx * r.o.x + r.dy * r.o.y;
    let c = r.o.x * r.o.x + r.o.y * r.o.y - radius * radius;
    let disc = b * b - a * c;
    let root = disc.max(Vec4::ZERO).sqrt();
    let good = disc.cmpgt(Vec4::ZERO);
    (Vec4::select(good, (-b - root) / a, MISS), Vec4::select(good, (-b + root) / a, -MISS))
}

#[inline(always)]
fn hit_cylinder(r: &Rays, radius: f32, half: f32) -> Vec4 {
    let (a, b) = mantle(r, radius);
    let (az, bz) = slab(r.o.z, r.dz, half);
    interval(a.max(az), b.min(bz))
}

#[inline(always)]
fn hit_capsule(r: &Rays, radius: f32, half: f32) -> Vec4 {
    let tube = hit_cylinder(r, radius, half);
    let end = |z: f32| {
        let moved = Rays { o: Vec3::new(r.o.x, r.o.y, r.o.z - z), ..*r };
        hit_ellipsoid(&moved, Vec3::splat(radius)).0
    };
    tube.min(end(half)).min(end(-half))
}

#[inline(always)]
fn hit_hull(r: &Rays, planes: &[Plane]) -> Vec4 {
    let (mut enter, mut leave) = (-MISS, MISS);
    for p in planes {
        let speed = r.dx * p.n.x + r.dy * p.n.y + r.dz * p.n.z;
        let tiny = Vec4::splat(1e-12);
        let speed = Vec4::select(speed.abs().cmplt(tiny), tiny, speed);
        let t = Vec4::splat(p.d - p.n.dot(r.o)) / speed;
        let inward = speed.cmplt(Vec4::ZERO);
        enter = Vec4::select(inward, enter.max(t), enter);
        leave = Vec4::select(inward, leave, leave.min(t));
    }
    interval(enter, leave)
}

/// First of the two shell hits that is not in a hole.
#[inline]
fn leaf_hit(r: &Rays, k: usize, hits: [f32; 2], (leaf, open, seed): (f32, f32, u32)) -> f32 {
    // Noise of this kind is below 0.25 + 0.35 x over about a share x of the surface.
    let threshold = if open > 0.0 { 0.22 + 0.4 * clamp01(open) } else { 0.0 };
    for t in hits {
        if t <= 0.0 || threshold <= 0.0 {
            return hits[0];
        }
        let p = r.o + Vec3::new(r.dx[k], r.dy[k], r.dz[k]) * t;
        if noise3(p / leaf, seed) * (2.0 / 3.0) + noise3(p / (0.45 * leaf), seed ^ 0x5bd1) * (1.0 / 3.0) > threshold {
            return t;
        }
    }
    f32::INFINITY
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::math::Rng;

    fn shapes() -> Vec<Shape> {
        let hull = [
            Plane::through(Vec3::new(2.0, 0.0, 0.0), Vec3::new(1.0, 0.0, 0.4)),
            Plane::through(Vec3::new(-2.0, 0.0, 0.0), Vec3::new(-1.0, 0.0, 0.0)),
            Plane::through(Vec3::new(0.0, 0.8, 0.0), Vec3::Y),
            Plane::through(Vec3::new(0.0, -0.8, 0.0), -Vec3::Y),
            Plane::through(Vec3::new(0.0, 0.0, 1.0), Vec3::Z),
            Plane::through(Vec3::new(0.0, 0.0, -1.0), -Vec3::Z),
        ];
        vec![
            Shape::Box { half: Vec3::new(1.0, 0.5, 1.5) },
            Shape::Ellipsoid { radii: Vec3::new(1.0, 0.6, 1.4) },
            Shape::Cylinder { radius: 0.7, half: 1.2 },
            Shape::Capsule { radius: 0.5, half: 0.9 },
            Shape::Hull { planes: hull.to_vec(), lo: Vec3::new(-2.0, -0.8, -1.0), hi: Vec3::new(2.4, 0.8, 1.0) },
        ]
    }

    /// Whether a point is inside, from the definition of each solid.
    fn inside(shape: &Shape, p: Vec3) -> bool {
        match shape {
            Shape::Box { half } => p.abs().cmple(*half).all(),
            Shape::Ellipsoid { radii } | Shape::Crown { radii, .. } => (p / *radii).length() <= 1.0,
            Shape::Cylinder { radius, half } => p.truncate().length() <= *radius && p.z.abs() <= *half,
            Shape::Capsule { radius, half } => (p - Vec3::Z * p.z.max(-half).min(*half)).length() <= *radius,
            Shape::Hull { planes, .. } => planes.iter().all(|q| q.n.dot(p) <= q.d),
        }
    }

    /// Every hit against small steps along the ray; normals point out of the solid.
    #[test]
    fn hits_are_where_marching_enters_the_solid() {
        let mut rng = Rng::new(11, "rays");
        for shape in shapes() {
            let (mut hits, mut misses) = (0, 0);
            for _ in 0..400 {
                let mut v = |s: f32| Vec3::new(rng.range32(-s, s), rng.range32(-s, s), rng.range32(-s, s));
                let o = v(1.0) + Vec3::new(-6.0, 1.0, 0.5);
                let d = (v(1.3) - o) / 6.0;
                let r = Rays { o, dx: Vec4::splat(d.x), dy: Vec4::splat(d.y), dz: Vec4::splat(d.z) };
                let t = shape.hit(&r, 0.001)[2];
                let marched = (0..4_000).map(|i| i as f32 * 0.003).find(|&t| inside(&shape, o + d * t));
                match marched {
                    Some(m) => {
                        assert!((t - m).abs() < 4e-3, "{shape:?} {t} {m}");
                        let (p, n) = (o + d * t, shape.normal(o + d * t));
                        assert!((n.length() - 1.0).abs() < 1e-5 && n.dot(d) < 1e-3, "{shape:?}");
                        assert!(!inside(&shape, p + n * 2e-3) && inside(&shape, p - n * 1e-2), "{shape:?} {p} {n}");
                        hits += 1;
                    }
                    None => misses += 1,
                }
                let (lo, hi) = shape.bounds();
                if t.is_finite() {
                    let p = o + d * t;
                    assert!(p.cmpge(lo - 1e-4).all() && p.cmple(hi + 1e-4).all());
                }
            }
            assert!(hits > 50 && misses > 10, "{shape:?}: {hits} hits, {misses} misses");
        }
    }
}
