//! [`Paint`]: what is drawn on the hulls of a vehicle: glass, lamps, doors, plates, wheel arches.
//!
//! Vehicle axes: x forward, y left, z up, origin on the ground under the middle.

use crate::light::Light;
use crate::math::{clamp01, floor, hash2, unit};
use crate::surface::{Look, Spot};
use crate::texture::{band, fade, mix, pulses, step};
use glam::Vec3;

/// Kind of vehicle.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Class {
    /// Saloon with a boot.
    Saloon,
    /// Hatchback or estate.
    Hatch,
    /// Tall off-roader.
    Suv,
    /// Delivery van.
    Van,
    /// City bus.
    Bus,
    /// Lorry with a box.
    Lorry,
}

/// Paintwork of a vehicle: what is drawn on its hulls.
#[derive(Clone, Debug)]
pub(crate) struct Paint {
    pub(crate) class: Class,
    pub(crate) half: [f32; 2],
    pub(crate) height: f32,
    pub(crate) belt: f32,
    pub(crate) colour: Vec3,
    pub(crate) accent: Vec3,
    pub(crate) arches: [f32; 2],
    pub(crate) radius: f32,
    /// Side glass at the belt: rear and front end, and how much each end moves per metre of height.
    pub(crate) glass: [f32; 4],
    pub(crate) brake: f32,
    pub(crate) plate: Vec3,
}

const GLASS: Look = Look { albedo: Vec3::new(0.018, 0.022, 0.026), glow: Vec3::ZERO, mirror: 0.30 };

impl Paint {
    /// Appearance of a hull.
    pub(crate) fn look(&self, at: &Spot, light: &Light) -> Look {
        let (p, n, f) = (at.p, at.n, at.fp);
        let mut look = Look { albedo: self.colour, glow: Vec3::ZERO, mirror: 0.09 };
        if self.class == Class::Bus {
            look.albedo = mix(self.accent, self.colour, step(p.z, 0.62, f.z));
            look.albedo = mix(look.albedo, Vec3::splat(0.6), band(p.z, self.height - 0.5, 9.0, f.z) * 0.5);
        }
        let end = n.x.abs() > 0.6 && n.z < 0.75;
        if n.y.abs() > 0.6 {
            self.side(&mut look, at);
        } else if end && p.z < self.belt {
            if n.x > 0.0 { self.front(&mut look, at, light) } else { self.rear(&mut look, at, light) }
        } else if p.z > self.belt + 0.005 && n.z < 0.95 {
            self.screen(&mut look, at, light);
        } else if n.z > 0.6 && p.x > self.half[0] - 1.2 && p.z < self.belt + 0.01 {
            let seam = band(p.y.abs(), 0.55 * self.half[1], 0.55 * self.half[1] + 0.03, f.y);
            look.albedo *= 1.0 - 0.35 * seam;
        }
        let dirt = 1.0 - 0.25 * clamp01((0.55 - p.z) * 2.0);
        look.albedo *= dirt;
        look
    }

    fn side(&self, look: &mut Look, at: &Spot) {
        let (p, f) = (at.p, at.fp);
        let up = p.z - self.belt;
        let (g0, g1) = (self.glass[0] + self.glass[2] * up, self.glass[1] + self.glass[3] * up);
        let top = self.height - if self.class == Class::Bus { 0.72 } else { 0.10 };
        let low = self.belt + if self.class == Class::Bus { 0.05 } else { 0.03 };
        let pane = band(p.x, g0, g1, f.x) * band(p.z, low, top, f.z);
        if pane > 0.0 {
            let pillars = match self.class {
                Class::Bus => pulses(p.x, 1.55, 0.0, 0.12, f.x),
                Class::Van | Class::Lorry => 0.0,
                _ => {
                    let x = 0.5 * (self.glass[0] + self.glass[1]) - 0.08;
                    band(p.x, x, x + 0.11, f.x).max(band(p.x, self.glass[0] + 0.55, self.glass[0] + 0.62, f.x))
                }
            };
            *look = look.mix(GLASS, pane * (1.0 - pillars));
        }
        if p.z > self.belt {
            return;
        }
        for x in self.arches {
            let (dx, dz) = (p.x - x, p.z - self.radius);
            let r = (dx * dx + dz * dz).sqrt();
            let w = f.x.max(f.z);
            let lip = band(r, self.radius + 0.05, self.radius + 0.09, w);
            look.albedo *= 1.0 - 0.25 * lip;
            *look = look.mix(Look::matt(Vec3::splat(0.008)), 1.0 - step(r, self.radius + 0.05, w));
        }
        let sill = 1.0 - step(p.z, 0.29, f.z);
        *look = look.mix(Look::matt(Vec3::splat(0.02)), sill * 0.8);
        if self.class == Class::Bus {
            for x in [self.half[0] - 1.1, 0.4] {
                let door = band(p.x, x - 0.6, x + 0.6, f.x) * band(p.z, 0.35, 2.3, f.z) * step(-p.y, 0.0, 0.1);
                *look = look.mix(GLASS, 0.8 * door);
            }
            return;
        }
        let (a, b) = (self.arches[1], self.arches[0]);
        for x in [a + 0.42, 0.5 * (a + b) + 0.05, b - 0.42] {
            let seam = band(p.x, x - 0.012, x + 0.012, f.x) * band(p.z, 0.32, self.belt, f.z);
            look.albedo *= 1.0 - 0.7 * seam;
            let handle = band(p.x, x + 0.06, x + 0.24, f.x) * band(p.z, self.belt - 0.16, self.belt - 0.12, f.z);
            look.albedo *= 1.0 - 0.6 * handle;
        }
        let crease = band(p.z, 0.62, 0.66, f.z);
        look.albedo *= 1.0 + 0.22 * crease;
    }

    fn front(&self, look: &mut Look, at: &Spot, light: &Light) {
        let (p, f) = (at.p, at.fp);
        let (y, w) = (p.y.abs(), self.half[1]);
        let z0 = if self.belt > 1.2 { 0.75 } else { self.belt - 0.36 };
        let bumper = 1.0 - step(p.z, 0.40, f.z);
        *look = look.mix(Look::matt(Vec3::splat(0.03)), bumper * 0.85);
        let grille = band(y, -1.0, 0.56 * w, f.y) * band(p.z, z0 - 0.12, z0 + 0.12, f.z);
        let bars = 0.5 + 0.5 * pulses(p.z, 0.07, 0.0, 0.03, f.z);
        *look =
            look.mix(Look { albedo: Vec3::splat(0.02 + 0.06 * bars), glow: Vec3::ZERO, mirror: 0.05 }, grille * 0.9);
        let lamp = band(y, 0.62 * w, 0.96 * w, f.y) * band(p.z, z0 - 0.05, z0 + 0.13, f.z);
        let beam = Vec3::new(1.0, 0.95, 0.82) * if light.lamps > 0.0 { 2.6 } else { 0.25 };
        *look = look.mix(Look { albedo: Vec3::splat(0.55), glow: beam, mirror: 0.2 }, lamp);
        let plate = band(y, -1.0, 0.26, f.y) * band(p.z, 0.42, 0.53, f.z);
        *look = look.mix(Look::matt(self.lettered(at)), plate);
    }

    fn rear(&self, look: &mut Look, at: &Spot, light: &Light) {
        let (p, f) = (at.p, at.fp);
        let (y, w) = (p.y.abs(), self.half[1]);
        let z0 = if self.belt > 1.2 { 0.85 } else { self.belt - 0.28 };
        let bumper = 1.0 - step(p.z, 0.38, f.z);
        *look = look.mix(Look::matt(Vec3::splat(0.03)), bumper * 0.7);
        let lamp = band(y, 0.66 * w, 0.98 * w, f.y) * band(p.z, z0 - 0.06, z0 + 0.16, f.z);
        let red = Vec3::new(1.0, 0.03, 0.02);
        let glow = red * if light.lamps > 0.0 { 0.5 + 0.9 * self.brake } else { 0.05 + 0.75 * self.brake };
        *look = look.mix(Look { albedo: Vec3::new(0.40, 0.012, 0.01), glow, mirror: 0.12 }, lamp);
        let plate = band(y, -1.0, 0.26, f.y) * band(p.z, z0 - 0.20, z0 - 0.08, f.z);
        *look = look.mix(Look::matt(self.lettered(at)), plate);
        let seam = band(p.z, z0 + 0.18, z0 + 0.195, f.z) + band(p.z, 0.52, 0.535, f.z) * 0.6;
        look.albedo *= 1.0 - 0.5 * clamp01(seam);
    }

    /// Number plate: dark characters of 6 cm.
    fn lettered(&self, at: &Spot) -> Vec3 {
        let ink = unit(hash2(floor(at.p.y / 0.06) as i32, 1, at.seed));
        let dark = fade(0.06, at.fp.y) * if ink < 0.6 { 0.75 } else { 0.0 };
        self.plate * (1.0 - dark)
    }

    /// Windscreen and rear window.
    fn screen(&self, look: &mut Look, at: &Spot, light: &Light) {
        let (p, f) = (at.p, at.fp);
        let up = (p.z - self.belt) / (self.height - self.belt);
        let side = self.half[1] - 0.13 - 0.14 * up;
        let rear_closed = at.n.x < 0.0 && matches!(self.class, Class::Van | Class::Lorry);
        if rear_closed {
            let seam = band(p.y.abs(), 0.0, 0.015, f.y);
            look.albedo *= 1.0 - 0.6 * seam;
            return;
        }
        let tall = self.class == Class::Bus;
        let (lo, hi) = if tall { (0.02, 0.76) } else { (0.08, 0.90) };
        let pane = band(p.y, -side, side, f.y) * band(up, lo, hi, f.z / (self.height - self.belt));
        *look = look.mix(GLASS, pane);
        if tall {
            let board = band(p.y, -0.8, 0.8, f.y) * band(up, 0.80, 0.94, f.z / (self.height - self.belt));
            let dots =
                if unit(hash2(floor(p.y / 0.09) as i32, floor(p.z / 0.1) as i32, at.seed)) < 0.5 { 1.0 } else { 0.2 };
            let dots = 0.6 + (dots - 0.6) * fade(0.1, f.y.max(f.z));
            let amber = Vec3::new(1.0, 0.55, 0.08) * dots * (0.35 + 0.6 * light.lamps);
            *look = look.mix(Look { albedo: Vec3::splat(0.01), glow: amber, mirror: 0.0 }, board);
        }
    }
}
