//! From a scene and a camera to pixels: rectangles, depth test, one shading pass.
//!
//! 1. Every part is bounded by the screen rectangle of its box, clipped at the near plane, and sorted by
//!    its nearest depth.
//! 2. Inside its rectangle its four rays a pixel (the centre and three around it) are tested at once;
//!    a pixel already covered nearer than the part's box is skipped.
//! 3. The ground is tested analytically below the horizon.
//! 4. Colour is the mean of the four rays in linear light. Rays of a pixel that meet the same face are shaded
//!    once, over the whole pixel's footprint (textures filter themselves); rays that meet different
//!    surfaces are shaded each on its own. Depth, object and velocity come from the centre ray alone,
//!    so they never mix two surfaces.

use crate::body::{Body, Part};
use crate::ground::Ground;
use crate::light::Light;
use crate::motion::Motion;
use crate::shadow;
use crate::shape::Rays;
use crate::sky::sky;
use crate::surface::{Look, Spot};
use crate::view::{Grid, Rect, View};
use glam::{BVec4A, DMat3, DVec3, Vec3, Vec4};

/// Farthest surface with a depth, metres; beyond it the ground fades into the sky.
pub const FAR: f32 = 150.0;
/// Object number of no surface.
pub const ID_SKY: u16 = 0;
/// Object number of road, pavement and verge.
pub const ID_GROUND: u16 = 1;
/// Object number of the first body.
pub(crate) const ID_FIRST: u16 = 2;

const SKY: u16 = u16::MAX;
const GROUND: u16 = u16::MAX - 1;
const KERB_FACE: u16 = u16::MAX - 2;

/// What is drawn.
#[derive(Clone, Debug)]
pub(crate) struct Scene {
    /// Road and what lies beside it.
    pub(crate) ground: Ground,
    /// Weather.
    pub(crate) light: Light,
    /// Objects; body `i` has object number `i + 2`.
    pub(crate) bodies: Vec<Body>,
}

/// Pixels of a frame, row by row.
#[derive(Clone, Debug, Default, PartialEq)]
pub(crate) struct Raster {
    /// Colour, 3 bytes a pixel.
    pub(crate) rgb: Vec<u8>,
    /// z-depth of the centre ray, metres; 0 where there is no surface within [`FAR`].
    pub(crate) depth: Vec<f32>,
    /// Velocity of the material point under the centre ray, street axes, m/s; a wheel moves like the vehicle
    /// that carries it.
    pub(crate) velocity: Vec<[f32; 3]>,
    /// Object under the centre ray.
    pub(crate) id: Vec<u16>,
}

/// A part ready to be tested: camera rays in part coordinates are x c0 + y c1 + c2 from o.
struct Placed<'a> {
    part: &'a Part,
    body: usize,
    c: [Vec3; 3],
    o: Vec3,
    up: Vec3,
    sun: Vec3,
    /// Whose velocity field the part's pixels show.
    carrier: Motion,
    near: f32,
    rect: Rect,
}

impl Placed<'_> {
    /// Outward normal where a ray hits.
    fn normal(&self, (u, v, t): (f32, f32, f32)) -> Vec3 {
        self.part.shape.normal(self.o + (self.c[0] * u + self.c[1] * v + self.c[2]) * t)
    }
}

/// Draws a scene at a time.
pub(crate) fn render(scene: &Scene, view: &View, time: f64) -> Raster {
    let grid = view.grid();
    let placed = place(scene, view, time);
    let n = view.width * view.height;
    let mut target = Target { depth: vec![Vec4::INFINITY; n], part: vec![[SKY; 4]; n], width: view.width };
    for (i, p) in placed.iter().enumerate() {
        target.draw(p, i as u16, &grid, 1.0 / view.focal[0]);
    }
    let ground = camera_rays(view);
    target.draw_ground(scene, &ground, &grid, view);
    let dark = shadow::ground_light((&scene.bodies, &scene.light), view, &grid, time, |i| {
        (&target.depth[i], &target.part[i], GROUND)
    });
    shade(&Shading { scene, view, grid: &grid, placed: &placed, ground: &ground, dark: &dark }, &target)
}

fn to_f32(m: &DMat3) -> [Vec3; 3] {
    [m.x_axis.as_vec3(), m.y_axis.as_vec3(), m.z_axis.as_vec3()]
}

/// Camera rays in street axes.
struct CameraRays {
    c: [Vec3; 3],
    o: Vec3,
}

fn camera_rays(view: &View) -> CameraRays {
    CameraRays { c: to_f32(&view.r), o: view.t.as_vec3() }
}

/// Parts on the screen, nearest first.
fn place<'a>(scene: &'a Scene, view: &View, time: f64) -> Vec<Placed<'a>> {
    let mut placed = Vec::new();
    let mut nodes = Vec::new();
    let to_camera = view.r.transpose();
    let sun = scene.light.sun.as_dvec3();
    for (body, b) in scene.bodies.iter().enumerate() {
        b.motions(time, &mut nodes);
        for part in &b.parts {
            let node = &nodes[part.node];
            let motion = Motion { r: node.r * part.r, ..node.slide(part.t, DVec3::ZERO) };
            let inverse = motion.r.transpose();
            let o = (inverse * (view.t - motion.t)).as_vec3();
            let (lo, hi) = part.shape.bounds();
            let (axes, shift) = (to_f32(&(to_camera * motion.r)), (to_camera * (motion.t - view.t)).as_vec3());
            let mut corners = [Vec3::ZERO; 8];
            for (k, c) in corners.iter_mut().enumerate() {
                let pick = |bit: usize, a: f32, b: f32| if k >> bit & 1 == 0 { a } else { b };
                let p = Vec3::new(pick(0, lo.x, hi.x), pick(1, lo.y, hi.y), pick(2, lo.z, hi.z));
                *c = axes[0] * p.x + axes[1] * p.y + axes[2] * p.z + shift;
            }
            let Some((rect, near)) = view.rect_of(&corners, 0.4) else { continue };
            let c = to_f32(&(inverse * view.r));
            let (up, sun) = ((inverse * DVec3::Z).as_vec3(), (inverse * sun).as_vec3());
            let carrier = if b.spins(part.node) { nodes[0] } else { motion };
            placed.push(Placed { part, body, c, o, up, sun, carrier, near, rect });
        }
    }
    placed.sort_by(|a, b| a.near.total_cmp(&b.near));
    placed.truncate(usize::from(KERB_FACE));
    placed
}

/// Depth and part of the nearest surface of each ray.
struct Target {
    depth: Vec<Vec4>,
    part: Vec<[u16; 4]>,
    width: usize,
}

impl Target {
    #[inline(always)]
    fn put(&mut self, i: usize, t: Vec4, part: u16) {
        let closer: BVec4A = t.cmplt(self.depth[i]);
        let bits = closer.bitmask();
        if bits != 0 {
            self.depth[i] = Vec4::select(closer, t, self.depth[i]);
            for k in 0..4 {
                if bits >> k & 1 == 1 {
                    self.part[i][k] = part;
                }
            }
        }
    }

    fn draw(&mut self, p: &Placed, index: u16, grid: &Grid, pixel: f32) {
        use crate::shape::Shape;
        // One loop per kind of shape, so that the test itself is inlined into it.
        macro_rules! loop_over {
            ($shape:pat) => {
                if let $shape = &p.part.shape {
                    self.draw_with(p, index, grid, |r| p.part.shape.hit(r, pixel));
                    return;
                }
            };
        }
        loop_over!(Shape::Box { .. });
        loop_over!(Shape::Hull { .. });
        loop_over!(Shape::Cylinder { .. });
        self.draw_with(p, index, grid, |r| p.part.shape.hit(r, pixel));
    }

    #[inline(always)]
    fn draw_with(&mut self, p: &Placed, index: u16, grid: &Grid, hit: impl Fn(&Rays) -> Vec4) {
        let near = p.near;
        for y in p.rect.y0..p.rect.y1 {
            let v = grid.y[y];
            let row = [v * p.c[1].x + p.c[2].x, v * p.c[1].y + p.c[2].y, v * p.c[1].z + p.c[2].z];
            for x in p.rect.x0..p.rect.x1 {
                let i = y * self.width + x;
                if self.depth[i].max_element() <= near {
                    continue;
                }
                let u = grid.x[x];
                let rays =
                    Rays { o: p.o, dx: u * p.c[0].x + row[0], dy: u * p.c[0].y + row[1], dz: u * p.c[0].z + row[2] };
                self.put(i, hit(&rays), index);
            }
        }
    }

    fn draw_ground(&mut self, scene: &Scene, rays: &CameraRays, grid: &Grid, view: &View) {
        let c = &rays.c;
        for y in 0..view.height {
            let v = grid.y[y];
            for x in 0..view.width {
                let i = y * self.width + x;
                let u = grid.x[x];
                let dz = u * c[0].z + v * c[1].z + c[2].z;
                // No surface beyond FAR: the height alone tells.
                if (dz * -FAR).max_element() < rays.o.z - crate::ground::KERB {
                    continue;
                }
                let nearest = Vec4::splat(rays.o.z - crate::ground::KERB) / (-dz).max(Vec4::splat(1e-9));
                if nearest.cmpge(self.depth[i]).all() {
                    continue;
                }
                let (dx, dy) = (u * c[0].x + v * c[1].x + c[2].x, u * c[0].y + v * c[1].y + c[2].y);
                let (t, faces) = scene.ground.hit(rays.o, dx, dy, dz);
                let t = Vec4::select(t.cmple(Vec4::splat(FAR)), t, Vec4::INFINITY);
                let before = self.depth[i];
                self.put(i, t, GROUND);
                if faces != 0 {
                    for k in 0..4 {
                        if faces >> k & 1 == 1 && t[k] < before[k] {
                            self.part[i][k] = KERB_FACE;
                        }
                    }
                }
            }
        }
    }
}

struct Shading<'a> {
    scene: &'a Scene,
    view: &'a View,
    grid: &'a Grid,
    placed: &'a [Placed<'a>],
    ground: &'a CameraRays,
    dark: &'a [Vec4],
}

fn shade(s: &Shading, target: &Target) -> Raster {
    let n = s.view.width * s.view.height;
    let mut out = Raster { rgb: vec![0; 3 * n], depth: vec![0.0; n], velocity: vec![[0.0; 3]; n], id: vec![ID_SKY; n] };
    for y in 0..s.view.height {
        for x in 0..s.view.width {
            let i = y * s.view.width + x;
            let sum = s.pixel(x, y, &target.depth[i], &target.part[i], s.dark[i]);
            out.rgb[3 * i..3 * i + 3].copy_from_slice(&s.scene.light.develop(sum * 0.25));
            let (part, depth) = (target.part[i][0], target.depth[i][0]);
            match part {
                SKY => {}
                GROUND | KERB_FACE => {
                    out.depth[i] = depth;
                    out.id[i] = ID_GROUND;
                }
                part if depth <= FAR => {
                    let p = &s.placed[part as usize];
                    out.depth[i] = depth;
                    out.id[i] = ID_FIRST + p.body as u16;
                    if s.scene.bodies[p.body].moves() {
                        let ray = DVec3::new(f64::from(s.grid.x[x].x), f64::from(s.grid.y[y].x), 1.0);
                        let at = s.view.t + s.view.r * (ray * f64::from(depth));
                        out.velocity[i] = p.carrier.velocity_at(at).as_vec3().to_array();
                    }
                }
                _ => {}
            }
        }
    }
    out
}

impl Shading<'_> {
    /// Sum of the light of a pixel's four rays.
    fn pixel(&self, x: usize, y: usize, depth: &Vec4, parts: &[u16; 4], dark: Vec4) -> Vec3 {
        let (us, vs) = (self.grid.x[x], self.grid.y[y]);
        let (mut sum, mut done) = (Vec3::ZERO, 0u32);
        for k in 0..4 {
            if done >> k & 1 == 1 {
                continue;
            }
            let mut group: u32 =
                (k..4).filter(|&j| done >> j & 1 == 0 && parts[j] == parts[k]).fold(0, |m, j| m | 1 << j);
            let ray = (us[k], vs[k], depth[k]);
            let light = match parts[k] {
                SKY => self.sky(ray.0, ray.1),
                GROUND => {
                    let (mut open, mut sun) = (0.0, 0.0);
                    for j in (0..4).filter(|j| group >> j & 1 == 1) {
                        let (o, s) = shadow::unpack(dark[j]);
                        (open, sun) = (open + o, sun + s);
                    }
                    let share = 1.0 / group.count_ones() as f32;
                    self.ground(ray, open * share, sun * share)
                }
                KERB_FACE => self.kerb(ray.2),
                part => {
                    let p = &self.placed[usize::from(part)];
                    let n = p.normal(ray);
                    if p.part.shape.has_edges() {
                        for j in k + 1..4 {
                            // Another face of the same part: cos of about 25 degrees.
                            if group >> j & 1 == 1 && p.normal((us[j], vs[j], depth[j])).dot(n) < 0.9 {
                                group &= !(1 << j);
                            }
                        }
                    }
                    self.surface(p, n, ray)
                }
            };
            sum += light * group.count_ones() as f32;
            done |= group;
        }
        sum
    }

    fn sky(&self, u: f32, v: f32) -> Vec3 {
        let d = self.ground.c[0] * u + self.ground.c[1] * v + self.ground.c[2];
        let d = d / d.dot(d).sqrt();
        sky(&self.scene.light, d, 1.0 / self.view.focal[0])
    }

    fn ground(&self, (u, v, t): (f32, f32, f32), open: f32, sun: f32) -> Vec3 {
        let c = &self.ground.c;
        let d = c[0] * u + c[1] * v + c[2];
        let p = self.ground.o + d * t;
        // One pixel to the right moves the hit by t/f (c0 - d c0.z/d.z) on the plane.
        let slope = if d.z < -1e-4 { 1.0 / d.z } else { -1e4 };
        let fx = (c[0] - d * (c[0].z * slope)) * (t / self.view.focal[0]);
        let fy = (c[1] - d * (c[1].z * slope)) * (t / self.view.focal[1]);
        let albedo = self.scene.ground.albedo(p.truncate(), fx.truncate(), fy.truncate());
        let light = &self.scene.light;
        let mut rgb = albedo * (light.sky_rgb * open + light.sun_rgb * (light.sun.z * sun));
        let wet = self.scene.ground.wetness();
        if wet > 0.0 {
            let length = d.dot(d).sqrt();
            let graze = 1.0 + d.z / length;
            rgb += light.clear_sky(-d.z / length) * (0.5 * wet * graze * graze * graze * graze * open);
        }
        light.through_haze(rgb, t)
    }

    fn kerb(&self, t: f32) -> Vec3 {
        let light = &self.scene.light;
        let rgb = self.scene.ground.face_albedo() * (light.sky_rgb * 0.5 + light.bounce_rgb * 0.5);
        light.through_haze(rgb, t)
    }

    fn surface(&self, p: &Placed, n: Vec3, (u, v, t): (f32, f32, f32)) -> Vec3 {
        let d = p.c[0] * u + p.c[1] * v + p.c[2];
        let at = p.o + d * t;
        let facing = n.dot(d);
        // The far side of a shell of leaves is seen from inside.
        let n = if facing > 0.0 { -n } else { n };
        let slope = 1.0 / if facing.abs() > 0.08 { facing.abs() } else { 0.08 };
        let (fx, fy) = (t / self.view.focal[0], t / self.view.focal[1]);
        let step = |c: Vec3, f: f32| (c + d * (c.dot(n) * slope)) * f;
        let fp = step(p.c[0], fx).abs() + step(p.c[1], fy).abs();
        let body = &self.scene.bodies[p.body];
        let light = &self.scene.light;
        let look: Look = p.part.skin.look(&Spot { p: at, n, fp, seed: body.seed }, light);
        let mut rgb = light.matt(look.albedo, n, p.up, p.sun) + look.glow;
        if look.mirror > 0.0 {
            let length = d.dot(d).sqrt();
            let r = (d + n * (2.0 * facing.abs())) / length;
            let up = r.dot(p.up);
            let seen = if up > 0.0 { light.clear_sky(up) } else { light.bounce_rgb * 0.3 };
            rgb = rgb * (1.0 - look.mirror) + seen * look.mirror;
        }
        light.through_haze(rgb, t)
    }
}
