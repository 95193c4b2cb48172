//! Sky: gradient, sun glow, two layers of clouds on a plane above the street.

use crate::light::{Light, Weather};
use crate::math::{clamp01, smoothstep};
use crate::texture::{fbm2, mix, octaves};
use glam::Vec3;

/// Colour of the sky in a unit direction; `pixel` is the angle of a pixel, radians.
pub(crate) fn sky(light: &Light, d: Vec3, pixel: f32) -> Vec3 {
    let up = d.z;
    let mut rgb = light.clear_sky(up);
    if light.weather != Weather::Overcast {
        let c = clamp01(d.dot(light.sun));
        let glow = c * c * c * c;
        let disc = glow * glow * glow * glow;
        rgb += light.sun_rgb * (0.10 * glow + 0.35 * disc * disc);
    }
    if up <= 0.015 {
        return rgb;
    }
    // The cloud plane one unit up: footprints grow as 1 / up^2 towards the horizon.
    let (x, y) = (d.x / (up + 0.06), d.y / (up + 0.06));
    let footprint = pixel / ((up + 0.06) * (up + 0.06));
    let seed = light.cloud_seed;
    let warp = fbm2(x, y, octaves(2.5, 2, seed ^ 0x11), footprint);
    let f = 0.5 + fbm2(x + warp, 1.25 * y - warp, octaves(1.9, 5, seed), footprint);
    let thick = f - (1.0 - light.cover);
    let cover = smoothstep(0.0, 0.28, thick) * smoothstep(0.015, 0.12, up);
    // Thin edges are bright with light from behind, thick middles grey.
    let bright = light.horizon * 0.9 + light.sky_rgb * 0.35 + light.sun_rgb * 0.12;
    let dark = light.horizon * 0.45 + light.zenith * 0.35;
    let body = mix(bright, dark, smoothstep(0.1, 0.6, thick));
    mix(rgb, body, 0.92 * cover)
}
