//! [`Facade`]: the drawn wall of a house: windows, shop fronts, doors, bands, masonry.
//!
//! Building axes: x along the street, +y or -y towards it, z up; heights count from the street.

use crate::light::Light;
use crate::math::{clamp01, floor, hash2, unit};
use crate::surface::{Look, Spot};
use crate::texture::{band, fade, fbm2, masonry, mix, octaves, pulses, step};
use glam::Vec3;

/// How the upper floors are opened.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Windows {
    /// Separate windows with frames and sills.
    Punched,
    /// Tall sashes with shutters.
    Shuttered,
    /// Continuous bands of glass.
    Ribbon,
    /// Glass from floor to floor in a grid of bars.
    Curtain,
    /// Pairs under a common lintel, brick between.
    Paired,
}

/// What stands at street level.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Base {
    /// Show windows and a sign band.
    Shop,
    /// Door and windows as above.
    Home,
    /// Garage doors or blank wall.
    Blank,
}

/// Drawing of a façade.
#[derive(Clone, Debug)]
pub(crate) struct Facade {
    pub(crate) windows: Windows,
    pub(crate) base: Base,
    pub(crate) wall: Vec3,
    pub(crate) trim: Vec3,
    pub(crate) accent: Vec3,
    /// Block height of masonry, 0 for render.
    pub(crate) blocks: f32,
    /// Height of the street level, of a floor, and of the whole wall, metres.
    pub(crate) ground: f32,
    pub(crate) floor: f32,
    pub(crate) height: f32,
    pub(crate) bay: f32,
    /// Half length of the building along x and along y.
    pub(crate) half: [f32; 2],
    pub(crate) open: [f32; 2],
    pub(crate) cornice: f32,
    pub(crate) lit: f32,
}

impl Facade {
    /// Blank strip at each end so that a whole number of bays fits.
    pub(crate) fn margin(&self) -> f32 {
        let length = 2.0 * self.half[0];
        0.5 * (length - floor(length / self.bay) * self.bay)
    }

    /// Appearance of a wall or the flat top.
    pub(crate) fn look(&self, at: &Spot, light: &Light) -> Look {
        if at.n.z.abs() > 0.5 {
            let grain = fbm2(at.p.x, at.p.y, octaves(1.5, 3, at.seed), at.fp.x.max(at.fp.y));
            return Look::matt(Vec3::splat(0.2) * (1.0 + 0.4 * grain));
        }
        let front = at.n.y.abs() > at.n.x.abs();
        let (u, fu, half) = if front { (at.p.x, at.fp.x, self.half[0]) } else { (at.p.y, at.fp.y, self.half[1]) };
        // Part coordinates start in the middle of the box; heights from the street.
        let z = at.p.z + 0.5 * self.height;
        let fz = at.fp.z;
        let seed = at.seed ^ if front { 0 } else { 0x51 };
        let mut look = Look::matt(self.bare(u, z, fu, fz, seed));
        let length = 2.0 * half;
        let margin = 0.5 * (length - floor(length / self.bay) * self.bay);
        let uu = u + half - margin;
        if z < self.ground {
            match self.base {
                Base::Shop => self.shop(&mut look, [u + half, z], [fu, fz], (length, light, seed)),
                Base::Home => self.home(&mut look, [uu, z], [fu, fz], (length - 2.0 * margin, light, seed)),
                Base::Blank => {
                    let gate = pulses(u + half, 6.1, 1.2, 4.2, fu) * band(z, -1.0, 2.6, fz);
                    let slats = 1.0 - 0.3 * pulses(z, 0.28, 0.0, 0.05, fz);
                    look = look.mix(Look::matt(self.accent * (0.7 * slats)), gate);
                }
            }
        } else {
            self.upper(&mut look, [uu, z], [fu, fz], (length - 2.0 * margin, light, seed));
        }
        let ledge = band(z, self.ground - 0.12, self.ground + 0.10, fz).max(band(
            z,
            self.height - self.cornice,
            self.height,
            fz,
        ));
        look = look.mix(Look::matt(self.trim), ledge * 0.85);
        let under = band(z, self.ground - 0.34, self.ground - 0.12, fz).max(band(
            z,
            self.height - self.cornice - 0.25,
            self.height - self.cornice,
            fz,
        ));
        look.albedo *= 1.0 - 0.35 * under;
        look
    }

    /// Wall without openings: masonry or render, streaks below the roof, splashes at the foot.
    fn bare(&self, u: f32, z: f32, fu: f32, fz: f32, seed: u32) -> Vec3 {
        let f = fu.max(fz);
        let mut tone = 1.0 + 0.22 * fbm2(u, z, octaves(3.2, 4, seed), f);
        tone += 0.16 * fbm2(u * 4.0, z * 0.35, octaves(1.5, 2, seed ^ 0x21), 4.0 * fu);
        if self.blocks > 0.0 {
            tone *= masonry(u, z, fu, fz, self.blocks, seed);
        }
        let foot = clamp01(1.0 - z / 0.9);
        self.wall * (tone * (1.0 - 0.3 * foot * foot))
    }

    fn upper(&self, look: &mut Look, [u, z]: [f32; 2], [fu, fz]: [f32; 2], (length, light, seed): (f32, &Light, u32)) {
        let h = z - self.ground;
        let floors = floor((self.height - self.ground - 0.45) / self.floor);
        let zone = band(h, 0.0, floors * self.floor, fz) * band(u, 0.0, length, fu);
        if zone <= 0.0 {
            return;
        }
        let (row, column) = (floor(h / self.floor), floor(u / self.bay));
        let (v, w) = (h - row * self.floor, u - column * self.bay);
        let (b, fl) = (self.bay, self.floor);
        let half = 0.5 * self.open[0] * b;
        let (sill, head) = (0.5 * fl * (1.0 - self.open[1]) + 0.1, 0.5 * fl * (1.0 + self.open[1]) + 0.1);
        // Opening, then the bars that divide its glass.
        let (lo, hi, z0, z1) = match self.windows {
            Windows::Punched | Windows::Shuttered => (0.5 * b - half, 0.5 * b + half, sill, head),
            Windows::Paired => (0.10 * b, 0.90 * b, sill, head),
            Windows::Ribbon => (0.0, b, sill, head),
            Windows::Curtain => (0.0, b, 0.0, fl),
        };
        let across = if lo == 0.0 { 1.0 } else { pulses(u, b, lo, hi, fu) };
        let upright = if z0 == 0.0 { 1.0 } else { pulses(h, fl, z0, z1, fz) };
        let pane = across * upright * zone;
        let frame = 0.07;
        let bars = match self.windows {
            Windows::Punched => {
                let m = 0.5 * b;
                pulses(u, b, m - 0.03, m + 0.03, fu)
                    .max(edge(w, lo, hi, frame, fu))
                    .max(edge(v, z0, z1, frame, fz))
                    .max(0.8 * pulses(h, fl, z0 + 0.62 * (z1 - z0), z0 + 0.62 * (z1 - z0) + 0.05, fz))
            }
            Windows::Shuttered => {
                edge(w, lo, hi, frame, fu).max(pulses(h, fl, 0.5 * (z0 + z1), 0.5 * (z0 + z1) + 0.06, fz))
            }
            Windows::Paired => pulses(u, b, 0.44 * b, 0.56 * b, fu).max(edge(w, lo, hi, frame, fu)),
            Windows::Ribbon => pulses(u, 0.5 * b, 0.0, 0.06, fu),
            Windows::Curtain => pulses(u, b, 0.0, 0.09, fu).max(pulses(h, fl, 0.0, 0.16, fz)),
        };
        let spandrel = if self.windows == Windows::Curtain { pulses(h, fl, 0.16, 0.85, fz) } else { 0.0 };
        // Lighter surround and sill, dark reveal under the lintel.
        let surround = pulses(u, b, lo - 0.12, hi + 0.12, fu).min(1.0) * pulses(h, fl, z0 - 0.14, z1 + 0.12, fz) * zone;
        if lo > 0.0 {
            *look = look.mix(Look::matt(self.trim), surround * 0.75);
        }
        if self.windows == Windows::Shuttered {
            let wing = 0.5 * (hi - lo);
            let leaf = pulses(u, b, lo - wing, lo - 0.02, fu) + pulses(u, b, hi + 0.02, hi + wing, fu);
            let slats = 1.0 - 0.3 * pulses(z, 0.12, 0.0, 0.04, fz);
            *look = look.mix(Look::matt(self.accent * (0.8 * slats)), clamp01(leaf) * upright * zone);
        }
        let glass = self.glass([row, column], [v / fl, w / b], fade(0.7 * b, fu.max(fz)), light, seed);
        let frame_look = Look::matt(if self.windows == Windows::Curtain { self.trim * 0.4 } else { self.trim });
        let mut inner = glass.mix(Look { albedo: self.accent * 0.35, glow: Vec3::ZERO, mirror: 0.15 }, spandrel * 0.8);
        inner = inner.mix(frame_look, clamp01(bars));
        let reveal = pulses(h, fl, z1 - 0.16, z1, fz);
        inner.albedo *= 1.0 - 0.5 * reveal;
        *look = look.mix(inner, pane);
    }

    /// A pane: dark room, curtains or a lit lamp, by window; `sharp` fades to the mean far away.
    fn glass(&self, [row, column]: [f32; 2], [v, w]: [f32; 2], sharp: f32, light: &Light, seed: u32) -> Look {
        let h = hash2(column as i32, row as i32, seed ^ 0xc0de);
        let (a, b) = (unit(h), unit(h.rotate_left(13)));
        let depth = 0.03 + 0.05 * a;
        let curtain = if b < 0.35 { 0.28 * (0.6 + 0.4 * a) } else { 0.0 };
        let drawn = if (w - 0.5).abs() > 0.5 * self.open[0] * (0.3 + 0.5 * a) { 1.0 } else { 0.25 };
        let blind = if unit(h.rotate_left(21)) < 0.25 && v > 0.45 { 0.32 } else { 0.0 };
        let own = depth + (curtain * drawn).max(blind);
        let mean = 0.11;
        let tone = mean + (own - mean) * sharp;
        let on = if unit(h.rotate_left(5)) < self.lit { 1.0 } else { 0.0 };
        let on = light.lamps * (self.lit + (on - self.lit) * sharp);
        Look {
            albedo: Vec3::new(0.92, 1.0, 1.1) * tone,
            glow: Vec3::new(0.85, 0.62, 0.32) * (on * (0.5 + 0.5 * a)),
            mirror: 0.22,
        }
    }

    fn shop(&self, look: &mut Look, [u, z]: [f32; 2], [fu, fz]: [f32; 2], (length, light, seed): (f32, &Light, u32)) {
        let top = self.ground * 0.70;
        let show = band(z, 0.45, top, fz) * band(u, 0.3, length - 0.3, fu);
        let piers = pulses(u, 4.4, 0.0, 0.4, fu);
        let bars = pulses(u, 1.47, 0.0, 0.06, fu).max(band(z, top - 0.45, top - 0.39, fz));
        // Goods: blocks of colour behind the glass, fading to their mean.
        let (i, j) = (floor(u / 0.55), floor(z / 0.6));
        let h = hash2(i as i32, j as i32, seed ^ 0x60);
        let own =
            Vec3::new(unit(h), unit(h.rotate_left(9)), unit(h.rotate_left(18))) * (0.22 * unit(h.rotate_left(25)));
        let goods = mix(Vec3::splat(0.075), own, fade(0.55, fu.max(fz)));
        let lamp = Vec3::new(1.0, 0.85, 0.6) * (0.10 + 0.75 * light.lamps);
        let inside = Look { albedo: Vec3::splat(0.03) + goods * 0.5, glow: goods * lamp * 1.2, mirror: 0.25 };
        let glass = inside.mix(Look::matt(self.trim * 0.35), bars);
        *look = look.mix(glass, show * (1.0 - piers));
        let door = pulses(u, 4.4, 2.0, 3.0, fu) * band(z, 0.0, 2.3, fz);
        *look = look.mix(Look { albedo: self.accent * 0.5, glow: Vec3::ZERO, mirror: 0.1 }, door * 0.8);
        let board = band(z, top + 0.10, self.ground - 0.30, fz) * band(u, 0.15, length - 0.15, fu);
        let letter = floor(u / 0.28);
        let ink = if unit(hash2(letter as i32, 7, seed)) < 0.68 { 1.0 } else { 0.0 };
        let middle = 0.5 * (top + self.ground - 0.2);
        let text = band(z, middle - 0.16, middle + 0.16, fz)
            * (pulses(u, 0.28, 0.03, 0.24, fu) * (0.68 + (ink - 0.68) * fade(0.28, fu)))
            * pulses(u, 8.8, 1.2, 5.4, fu);
        let paper = mix(self.accent, Vec3::splat(0.65), text);
        *look = look.mix(Look { albedo: paper, glow: paper * (0.4 * light.lamps), mirror: 0.02 }, board);
        let plinth = 1.0 - step(z, 0.45, fz);
        look.albedo *= 1.0 - 0.35 * plinth;
    }

    fn home(&self, look: &mut Look, [u, z]: [f32; 2], [fu, fz]: [f32; 2], (length, light, seed): (f32, &Light, u32)) {
        let column = floor(u / self.bay);
        let every = 3.0 + floor(3.0 * unit(seed));
        let is_door = column - floor(column / every) * every == 1.0;
        let zone = band(u, 0.0, length, fu);
        let half = 0.5 * self.open[0] * self.bay;
        let w = u - column * self.bay;
        if is_door {
            let leaf = band(w, 0.5 * self.bay - 0.55, 0.5 * self.bay + 0.55, fu) * band(z, 0.1, 2.3, fz) * zone;
            let light_above =
                band(z, 2.35, 2.75, fz) * band(w, 0.5 * self.bay - 0.55, 0.5 * self.bay + 0.55, fu) * zone;
            let rim = band(w, 0.5 * self.bay - 0.7, 0.5 * self.bay + 0.7, fu) * band(z, 0.0, 2.9, fz) * zone;
            let panel =
                edge(w, 0.5 * self.bay - 0.55, 0.5 * self.bay + 0.55, 0.12, fu).max(pulses(z, 0.9, 0.0, 0.1, fz));
            *look = look.mix(Look::matt(self.trim), rim);
            *look = look.mix(Look::matt(self.accent * (0.6 + 0.25 * panel)), leaf);
            *look = look.mix(
                Look { albedo: Vec3::splat(0.04), glow: Vec3::new(0.9, 0.7, 0.4) * light.lamps, mirror: 0.2 },
                light_above,
            );
            return;
        }
        let (lo, hi) = (0.5 * self.bay - half, 0.5 * self.bay + half);
        let rim = pulses(u, self.bay, lo - 0.1, hi + 0.1, fu) * band(z, 0.95, 2.6, fz) * zone;
        let pane = pulses(u, self.bay, lo, hi, fu) * band(z, 1.1, 2.5, fz) * zone;
        let bars = pulses(u, self.bay, 0.5 * self.bay - 0.03, 0.5 * self.bay + 0.03, fu).max(edge(w, lo, hi, 0.06, fu));
        let glass = self.glass([-1.0, column], [z / 3.0, w / self.bay], fade(0.7 * self.bay, fu.max(fz)), light, seed);
        *look = look.mix(Look::matt(self.trim), rim * 0.85);
        *look = look.mix(glass.mix(Look::matt(self.trim), clamp01(bars)), pane);
    }
}

/// Strips of a width inside both ends of lo..hi.
fn edge(x: f32, lo: f32, hi: f32, width: f32, footprint: f32) -> f32 {
    clamp01(band(x, lo, lo + width, footprint) + band(x, hi - width, hi, footprint))
}
