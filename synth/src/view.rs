//! [`View`]: the camera of one frame, its rays and what of a box lands on the screen.

use glam::{DMat3, DVec3, Vec2, Vec3, Vec4};

/// Offsets of a pixel's four rays from its centre, pixels: the centre and three at 120 degrees.
/// Mirrored on odd columns and rows so that no direction is preferred.
const JITTER: [[f32; 2]; 4] = [[0.0, 0.0], [0.093, 0.348], [-0.348, -0.093], [0.255, -0.255]];
/// Nearest depth drawn, metres.
const NEAR: f32 = 0.08;
/// Camera of one frame, street axes.
#[derive(Clone, Copy, Debug)]
pub(crate) struct View {
    /// Image width.
    pub(crate) width: usize,
    /// Image height.
    pub(crate) height: usize,
    /// Focal lengths, pixels.
    pub(crate) focal: [f32; 2],
    /// Principal point, pixels.
    pub(crate) centre: [f32; 2],
    /// Camera (x right, y down, z forward) to street.
    pub(crate) r: DMat3,
    /// Camera centre, street.
    pub(crate) t: DVec3,
}

/// Pixel rectangle, end exclusive.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) struct Rect {
    pub(crate) x0: usize,
    pub(crate) x1: usize,
    pub(crate) y0: usize,
    pub(crate) y1: usize,
}

/// Ray coordinates of the sample grid.
pub(crate) struct Grid {
    /// (u - cx) / fx of the four rays, per column.
    pub(crate) x: Vec<Vec4>,
    /// (v - cy) / fy of the four rays, per row.
    pub(crate) y: Vec<Vec4>,
}

impl View {
    /// Rays of all columns and rows.
    pub(crate) fn grid(&self) -> Grid {
        let line = |n: usize, axis: usize| {
            (0..n)
                .map(|i| {
                    let mirror = if i & 1 == 1 { -1.0 } else { 1.0 };
                    let ray = |k: usize| i as f32 + 0.5 + mirror * JITTER[k][axis];
                    (Vec4::new(ray(0), ray(1), ray(2), ray(3)) - self.centre[axis]) / self.focal[axis]
                })
                .collect()
        };
        Grid { x: line(self.width, 0), y: line(self.height, 1) }
    }

    /// Screen rectangle of the convex hull of points in camera axes, and its nearest depth; `None` if it
    /// is behind the camera, off the screen or too small to matter.
    pub(crate) fn rect_of(&self, points: &[Vec3; 8], smallest: f32) -> Option<(Rect, f32)> {
        let (mut lo, mut hi) = (Vec2::splat(f32::INFINITY), Vec2::splat(f32::NEG_INFINITY));
        let mut near = f32::INFINITY;
        let mut grow = |p: Vec3| {
            let q = Vec2::new(p.x / p.z * self.focal[0] + self.centre[0], p.y / p.z * self.focal[1] + self.centre[1]);
            lo = lo.min(q);
            hi = hi.max(q);
        };
        for &p in points {
            near = near.min(p.z);
            if p.z >= NEAR {
                grow(p);
                // Every segment to a point behind the near plane stays inside the hull.
                for &b in points.iter().filter(|b| b.z < NEAR) {
                    grow(p + (b - p) * ((p.z - NEAR) / (p.z - b.z)));
                }
            }
        }
        let visible = lo.x < hi.x && hi.x > 0.0 && hi.y > 0.0;
        if !visible || lo.x >= self.width as f32 || lo.y >= self.height as f32 {
            return None;
        }
        if hi.x - lo.x < smallest && hi.y - lo.y < smallest {
            return None;
        }
        // A ray may start half a pixel from its centre.
        let start = |v: f32| if v > 1.0 { (v - 1.0) as usize } else { 0 };
        let end = |v: f32, n: usize| if v + 1.0 < n as f32 { (v + 2.0) as usize } else { n }.min(n);
        let rect = Rect { x0: start(lo.x), x1: end(hi.x, self.width), y0: start(lo.y), y1: end(hi.y, self.height) };
        Some((rect, near))
    }
}
