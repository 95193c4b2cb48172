//! Weather, light and the tone curve of the camera.

use crate::math::{Rng, exp_neg, sin_cos, smoothstep};
use crate::texture::mix;
use glam::Vec3;

/// Kind of weather, by rising softness of the light.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Weather {
    /// Direct sun with hard shadows.
    Sunny,
    /// Closed cloud cover.
    Overcast,
    /// Dusk: little light, lamps and windows lit.
    Dim,
}

/// Light of a clip: constant over its frames.
#[derive(Clone, Debug)]
pub(crate) struct Light {
    /// Weather.
    pub(crate) weather: Weather,
    /// Direction to the sun, street axes.
    pub(crate) sun: Vec3,
    /// Linear radiance factor of direct sun.
    pub(crate) sun_rgb: Vec3,
    /// Light of the sky from above.
    pub(crate) sky_rgb: Vec3,
    /// Light thrown back by the ground.
    pub(crate) bounce_rgb: Vec3,
    /// Sky colour overhead.
    pub(crate) zenith: Vec3,
    /// Sky colour at the horizon, also the haze.
    pub(crate) horizon: Vec3,
    /// Extinction, 1/m.
    pub(crate) haze: f32,
    /// Cloud cover, 0..1.
    pub(crate) cover: f32,
    /// Cloud seed.
    pub(crate) cloud_seed: u32,
    /// Lamps and windows lit: 0 by day, 1 at dusk.
    pub(crate) lamps: f32,
    /// Exposure times white balance.
    pub(crate) gain: Vec3,
    /// Tone curve from the square root of linear light to 8 bits, 0..=TONE_STEPS.
    tone: Vec<u8>,
}

/// Steps of the tone table; the square root spreads the dark end over enough of them.
const TONE_STEPS: usize = 2048;

impl Light {
    /// Draws the light of a clip; `dim` and `sunny` are probabilities, the rest is overcast.
    pub(crate) fn draw(rng: &mut Rng, dim: f64, sunny: f64) -> Light {
        let u = rng.unit();
        let weather = if u < dim {
            Weather::Dim
        } else if u < dim + sunny {
            Weather::Sunny
        } else {
            Weather::Overcast
        };
        let azimuth = rng.range(0.0, std::f64::consts::TAU);
        let height = rng.range(0.42, 1.1);
        let ((sa, ca), (sh, ch)) = (sin_cos(azimuth), sin_cos(height));
        let sun = Vec3::new((ca * ch) as f32, (sa * ch) as f32, sh as f32);
        let warm = (1.1 - height as f32) * 0.7;
        let (zenith, horizon, sun_rgb, sky_rgb, cover, haze, gain);
        match weather {
            Weather::Sunny => {
                let blue = rng.range32(0.0, 1.0);
                zenith = mix(Vec3::new(0.10, 0.22, 0.52), Vec3::new(0.17, 0.36, 0.62), blue);
                horizon = mix(Vec3::new(0.52, 0.66, 0.80), Vec3::new(0.72, 0.70, 0.66), warm);
                sun_rgb = mix(Vec3::new(1.75, 1.66, 1.50), Vec3::new(1.75, 1.42, 1.02), warm);
                sky_rgb = Vec3::new(0.42, 0.50, 0.62);
                cover = rng.range32(0.05, 0.62);
                haze = rng.range32(0.000_5, 0.004);
                gain = rng.range32(0.85, 1.15);
            }
            Weather::Overcast => {
                let grey = rng.range32(0.55, 0.85);
                zenith = Vec3::new(0.86, 0.92, 1.0) * grey * rng.range32(0.75, 1.0);
                horizon = Vec3::new(0.98, 0.99, 1.0) * grey;
                sun_rgb = Vec3::splat(rng.range32(0.0, 0.25));
                sky_rgb = Vec3::new(0.92, 0.96, 1.0) * 0.98;
                cover = rng.range32(0.8, 1.0);
                haze = rng.range32(0.000_5, 0.006);
                gain = rng.range32(0.9, 1.15);
            }
            Weather::Dim => {
                let t = rng.range32(0.0, 1.0);
                zenith = mix(Vec3::new(0.10, 0.13, 0.24), Vec3::new(0.20, 0.22, 0.28), t);
                horizon = mix(Vec3::new(0.42, 0.30, 0.28), Vec3::new(0.34, 0.36, 0.42), t);
                sun_rgb = Vec3::splat(0.05);
                sky_rgb = Vec3::new(0.34, 0.37, 0.48);
                cover = rng.range32(0.3, 0.9);
                haze = rng.range32(0.001, 0.006);
                gain = rng.range32(0.9, 1.3);
            }
        }
        let balance = Vec3::new(rng.normal(1.0, 0.045) as f32, 1.0, rng.normal(1.0, 0.05) as f32);
        let contrast = rng.range32(-0.08, 0.12);
        Light {
            weather,
            sun,
            sun_rgb,
            sky_rgb,
            bounce_rgb: sky_rgb * 0.28 + sun_rgb * (0.11 * sun.z),
            zenith,
            horizon,
            haze,
            cover,
            cloud_seed: rng.seed(),
            lamps: if weather == Weather::Dim { rng.range32(0.6, 1.0) } else { 0.0 },
            gain: balance * gain,
            tone: tone_table(contrast),
        }
    }

    /// Light that leaves a matt surface of a normal given in the same axes as `up` and `sun`.
    #[inline]
    pub(crate) fn matt(&self, albedo: Vec3, n: Vec3, up: Vec3, sun: Vec3) -> Vec3 {
        let h = 0.5 + 0.5 * n.dot(up);
        let direct = n.dot(sun);
        let mut light = self.bounce_rgb + (self.sky_rgb - self.bounce_rgb) * h;
        if direct > 0.0 {
            light += self.sun_rgb * direct;
        }
        albedo * light
    }

    /// Clear sky at a height above the horizon (sine of the elevation).
    #[inline]
    pub(crate) fn clear_sky(&self, up: f32) -> Vec3 {
        mix(self.horizon, self.zenith, smoothstep(-0.02, 0.55, up))
    }

    /// Blends a colour with the haze between it and the camera.
    #[inline]
    pub(crate) fn through_haze(&self, rgb: Vec3, distance: f32) -> Vec3 {
        mix(self.horizon * 0.92, rgb, exp_neg(-self.haze * distance))
    }

    /// Linear light to the camera's 8 bits.
    #[inline]
    pub(crate) fn develop(&self, rgb: Vec3) -> [u8; 3] {
        let x = rgb * self.gain;
        [x.x, x.y, x.z].map(|v| {
            let v = if v > 0.0 { v } else { 0.0 };
            let i = (v.sqrt() * TONE_STEPS as f32 * 0.5) as usize;
            self.tone[if i < TONE_STEPS { i } else { TONE_STEPS }]
        })
    }
}

/// Square root of light (0..2, so light 0..4) to 8 bits: soft shoulder above 0.8, display gamma, contrast.
fn tone_table(contrast: f32) -> Vec<u8> {
    (0..=TONE_STEPS)
        .map(|i| {
            let root = i as f32 * 2.0 / TONE_STEPS as f32;
            let light = root * root;
            // Shoulder: identity to 0.7, then 1 - 0.3 exp(-(x - 0.7) / 0.3).
            let x = if light < 0.7 { light } else { 1.0 - 0.3 * exp_neg(-(light - 0.7) / 0.3) };
            let g = gamma(x);
            let s = g + contrast * (g * g * (3.0 - 2.0 * g) - g);
            (s * 255.0 + 0.5) as u8
        })
        .collect()
}

/// x^(1/2.2) on 0..1 by Newton's method on y^11 = x^5 (2.2 = 11/5).
fn gamma(x: f32) -> f32 {
    if x <= 0.0 {
        return 0.0;
    }
    let x = f64::from(x);
    let x5 = x * x * x * x * x;
    let mut y = x.sqrt();
    for _ in 0..60 {
        let y2 = y * y;
        let y10 = y2 * y2 * y2 * y2 * y2;
        y -= (y10 * y - x5) / (11.0 * y10);
    }
    y as f32
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn tone_curve_is_gamma_and_rises() {
        for i in 1..=100 {
            let x = i as f32 / 100.0;
            assert!((gamma(x) - x.powf(1.0 / 2.2)).abs() < 1e-5);
        }
        let table = tone_table(0.1);
        assert!(table.windows(2).all(|w| w[0] <= w[1]) && table[0] == 0 && table[TONE_STEPS] > 250);
    }
}
