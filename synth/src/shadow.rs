//! Shadows on the ground: soft contact shadows under everything that stands on it, and sharp sun shadows.
//!
//! Each caster covers a screen rectangle (its base and where the sun throws its top); rays of the ground
//! inside are tested against the caster in its own axes.

use crate::body::{Body, Shadow};
use crate::light::{Light, Weather};
use crate::math::clamp01;
use crate::view::{Grid, Rect, View};
use glam::{DVec3, Vec3, Vec4};

/// Light of a ground ray: share of open sky, and whether the sun reaches it.
pub(crate) fn unpack(packed: f32) -> (f32, f32) {
    if packed < 0.0 { (-packed - 1.0, 0.0) } else { (packed, 1.0) }
}

/// Packs the share of open sky `o` and the sun: o in the sun, -1 - o in shadow.
fn darken(packed: f32, contact: f32, sunless: bool) -> f32 {
    let (open, sun) = unpack(packed);
    let open = open * (1.0 - contact);
    if sunless || sun == 0.0 { -1.0 - open } else { open }
}

/// A caster in its own axes.
struct Caster {
    half: [f32; 2],
    from: f32,
    to: f32,
    contact: f32,
    ball: bool,
}

/// Light of every ground ray. `surface` gives depths, parts and the number of the ground.
pub(crate) fn ground_light<'a>(
    (bodies, light): (&[Body], &Light),
    view: &View,
    grid: &Grid,
    time: f64,
    surface: impl Fn(usize) -> (&'a Vec4, &'a [u16; 4], u16),
) -> Vec<Vec4> {
    let mut out = vec![Vec4::ONE; view.width * view.height];
    let mut nodes = Vec::new();
    let sunny = light.weather == Weather::Sunny;
    for body in bodies {
        let caster = match body.shadow {
            Shadow::None => continue,
            Shadow::Box { half, from, to, contact } => Caster { half, from, to, contact, ball: false },
            Shadow::Ball { height, radii } => {
                Caster { half: [radii[0]; 2], from: height - radii[1], to: height + radii[1], contact: 0.0, ball: true }
            }
        };
        if !sunny && caster.contact <= 0.0 {
            continue;
        }
        body.motions(time, &mut nodes);
        let node = nodes[0];
        let (ax, ay) = (node.r.x_axis.as_vec3(), node.r.y_axis.as_vec3());
        let base = Vec3::new(node.t.x as f32, node.t.y as f32, 0.0);
        let sun = light.sun;
        // Contact reaches REACH beyond the base.
        let margin = if caster.contact > 0.0 { REACH } else { 0.0 };
        let throw = if sunny { -sun * (caster.to / sun.z) } else { Vec3::ZERO };
        let to_camera = view.r.transpose();
        let mut corners = [Vec3::ZERO; 8];
        for (k, c) in corners.iter_mut().enumerate() {
            let sx = if k & 1 == 0 { 1.0 } else { -1.0 } * (caster.half[0] + margin);
            let sy = if k & 2 == 0 { 1.0 } else { -1.0 } * (caster.half[1] + margin);
            let mut p = base + ax * sx + ay * sy;
            if k & 4 != 0 {
                p += Vec3::new(throw.x, throw.y, 0.0);
            }
            *c = (to_camera * (DVec3::new(f64::from(p.x), f64::from(p.y), 0.06) - view.t)).as_vec3();
        }
        let Some((rect, _)) = view.rect_of(&corners, 0.5) else { continue };
        let local_sun = Vec3::new(sun.dot(ax), sun.dot(ay), sun.z);
        let rect = grow(rect, view);
        for y in rect.y0..rect.y1 {
            for x in rect.x0..rect.x1 {
                let i = y * view.width + x;
                let (depth, part, ground) = surface(i);
                if part.iter().all(|&p| p != ground) {
                    continue;
                }
                for k in 0..4 {
                    if part[k] != ground {
                        continue;
                    }
                    let ray = DVec3::new(f64::from(grid.x[x][k]), f64::from(grid.y[y][k]), 1.0);
                    let p = (view.r * (ray * f64::from(depth[k])) + view.t).as_vec3() - base;
                    let q = Vec3::new(p.dot(ax), p.dot(ay), p.z);
                    let contact = caster.contact(q);
                    let sunless = sunny && caster.blocks(q, local_sun);
                    if contact > 0.0 || sunless {
                        out[i][k] = darken(out[i][k], contact, sunless);
                    }
                }
            }
        }
    }
    out
}

/// Distance to which a contact shadow reaches, metres.
const REACH: f32 = 0.45;

impl Caster {
    /// Depth of the contact shadow at a ground point.
    fn contact(&self, q: Vec3) -> f32 {
        if self.contact <= 0.0 {
            return 0.0;
        }
        let (dx, dy) = (q.x.abs() - self.half[0], q.y.abs() - self.half[1]);
        let (dx, dy) = (if dx > 0.0 { dx } else { 0.0 }, if dy > 0.0 { dy } else { 0.0 });
        let near = clamp01(1.0 - (dx * dx + dy * dy).sqrt() / REACH);
        self.contact * near * near
    }

    /// Whether the way from a ground point to the sun is blocked.
    fn blocks(&self, q: Vec3, sun: Vec3) -> bool {
        if self.ball {
            let middle = 0.5 * (self.from + self.to);
            let scale = Vec3::new(1.0 / self.half[0], 1.0 / self.half[1], 2.0 / (self.to - self.from));
            let (o, d) = ((q - Vec3::new(0.0, 0.0, middle)) * scale, sun * scale);
            let (a, b, c) = (d.dot(d), o.dot(d), o.dot(o) - 1.0);
            return b * b > a * c;
        }
        let (mut enter, mut leave) = ((self.from - q.z) / sun.z, (self.to - q.z) / sun.z);
        if enter < 0.0 {
            enter = 0.0;
        }
        for (o, d, h) in [(q.x, sun.x, self.half[0]), (q.y, sun.y, self.half[1])] {
            let d = if d.abs() < 1e-9 { 1e-9 } else { d };
            let (a, b) = ((-h - o) / d, (h - o) / d);
            let (a, b) = if a < b { (a, b) } else { (b, a) };
            enter = if a > enter { a } else { enter };
            leave = if b < leave { b } else { leave };
        }
        enter < leave
    }
}

/// Rectangles are bounded at the pavement's height; one pixel more covers the carriageway.
fn grow(r: Rect, view: &View) -> Rect {
    Rect {
        x0: r.x0.saturating_sub(1),
        x1: (r.x1 + 1).min(view.width),
        y0: r.y0.saturating_sub(1),
        y1: (r.y1 + 1).min(view.height),
    }
}
