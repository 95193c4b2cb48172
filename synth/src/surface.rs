//! A point to shade and what it sends back: from part coordinates to albedo, own light and mirror share.

use crate::texture::mix;
use glam::Vec3;

/// A point to shade, in part coordinates: textures stick to the part and move with it.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Spot {
    /// Surface point, metres.
    pub(crate) p: Vec3,
    /// Outward unit normal.
    pub(crate) n: Vec3,
    /// Footprint of a pixel along each axis, metres.
    pub(crate) fp: Vec3,
    /// Texture seed of the object.
    pub(crate) seed: u32,
}

impl Spot {
    /// Largest footprint.
    pub(crate) fn width(&self) -> f32 {
        self.fp.x.max(self.fp.y).max(self.fp.z)
    }
}

/// What a surface sends back.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) struct Look {
    /// Diffuse reflectance, linear.
    pub(crate) albedo: Vec3,
    /// Own light, linear.
    pub(crate) glow: Vec3,
    /// Share of the mirrored sky, 0..1.
    pub(crate) mirror: f32,
}

impl Look {
    /// A matt surface.
    pub(crate) fn matt(albedo: Vec3) -> Look {
        Look { albedo, glow: Vec3::ZERO, mirror: 0.0 }
    }

    /// Blend of two surfaces.
    pub(crate) fn mix(self, other: Look, t: f32) -> Look {
        Look {
            albedo: mix(self.albedo, other.albedo, t),
            glow: mix(self.glow, other.glow, t),
            mirror: self.mirror + (other.mirror - self.mirror) * t,
        }
    }
}
