//! [`Street`]: a seed and options become a clip with exact ground truth.

use crate::math::{Rng, hash3, mix64, tan};
use crate::raycast::render;
use crate::scene::SceneSpec;
use crate::style::Style;
use crate::view::View;
use glam::DVec3;
use rayon::prelude::*;
use sf_formats::{Camera, Error, Intrinsics, Pose, Result};

/// Size and timing of a clip.
#[derive(Clone, Debug, PartialEq)]
pub struct Options {
    /// Number of frames.
    pub frames: usize,
    /// Image width, pixels.
    pub width: u32,
    /// Image height, pixels.
    pub height: u32,
    /// Camera rate, 1/s.
    pub fps: f64,
    /// Frame i is taken at i * stride / fps.
    pub stride: u32,
    /// Standard deviation of sensor noise, 8-bit levels; 0 gives clean frames.
    pub noise: f32,
    /// Distribution of streets.
    pub style: Style,
}

impl Default for Options {
    fn default() -> Options {
        Options { frames: 20, width: 252, height: 168, fps: 10.0, stride: 1, noise: 0.0, style: Style::default() }
    }
}

impl Options {
    /// Most frames of a clip: the street is built for as long as the camera car drives.
    pub const MAX_FRAMES: usize = 600;
    /// Most pixels of a frame.
    pub const MAX_PIXELS: u64 = 1 << 24;

    /// A training clip of a seed: four frames at 10 Hz; half of the seeds take every fifth frame (0.5 s), the
    /// others every first to fifth alike.
    pub fn training(seed: u64, width: u32, height: u32) -> Options {
        let mut rng = Rng::new(seed, "stride");
        let stride = if rng.chance(0.5) { 5 } else { 1 + rng.below(5) as u32 };
        Options { frames: 4, width, height, stride, ..Options::default() }
    }

    /// Refuses sizes, rates and probabilities that make no street ([`sf_formats::Status::Usage`]).
    pub fn check(&self) -> Result<()> {
        if self.frames == 0 || self.frames > Self::MAX_FRAMES {
            return Err(Error::usage(format!("frames = {} must be 1 to {}", self.frames, Self::MAX_FRAMES)));
        }
        let pixels = u64::from(self.width) * u64::from(self.height);
        if self.width < 16 || self.height < 16 || pixels > Self::MAX_PIXELS {
            return Err(Error::usage(format!(
                "size {}x{} must be at least 16x16 and at most {} pixels",
                self.width,
                self.height,
                Self::MAX_PIXELS
            )));
        }
        if !(self.fps.is_finite() && (0.1..=1000.0).contains(&self.fps)) || self.stride == 0 || self.stride > 1000 {
            return Err(Error::usage(format!("fps = {} and stride = {} give no camera rate", self.fps, self.stride)));
        }
        if self.seconds() > 60.0 {
            return Err(Error::usage(format!("the clip lasts {} s, the limit is 60 s", self.seconds())));
        }
        if !(0.0..=64.0).contains(&self.noise) {
            return Err(Error::usage(format!("noise = {} must be 0 to 64 levels", self.noise)));
        }
        let s = &self.style;
        let shares = [
            s.dim, s.sunny, s.turning, s.crossing, s.standing, s.slow, s.glance, s.traffic, s.heavy, s.parked,
            s.cyclists, s.built, s.trees,
        ];
        if shares.iter().any(|p| !(0.0..=1.0).contains(p)) || s.dim + s.sunny > 1.0 || s.standing + s.slow > 1.0 {
            return Err(Error::usage("every probability of the style must be 0 to 1, and so must their sums"));
        }
        let ranges = [(s.hfov, 20.0, 120.0), (s.camera_height, 0.8, 3.0), (s.speed, 0.0, 20.0)];
        if ranges.iter().any(|((a, b), lo, hi)| !(lo <= a && a <= b && b <= hi)) {
            return Err(Error::usage("hfov must be within 20 to 120 degrees, height 0.8 to 3 m, speed 0 to 20 m/s"));
        }
        let spreads = [(s.curvature, 0.05), (s.acceleration, 5.0), (s.pitch, 10.0), (s.yaw, 30.0), (s.people, 40.0)];
        if spreads.iter().any(|(v, hi)| !(0.0..=*hi).contains(v)) || s.vehicles.0 > s.vehicles.1 || s.vehicles.1 > 40 {
            return Err(Error::usage("a spread or count of the style is negative or beyond reason"));
        }
        Ok(())
    }

    /// Time of frame `i`, seconds.
    pub fn time(&self, i: usize) -> f64 {
        i as f64 * f64::from(self.stride) / self.fps
    }

    /// Time of the last frame.
    pub fn seconds(&self) -> f64 {
        self.time(self.frames.saturating_sub(1))
    }
}

/// Training and held-out seeds, disjoint by construction: a seed belongs to the training split when its
/// hash (splitmix64's finaliser) is even, to the held-out split when it is odd.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Split {
    /// Clips that a model may be trained on.
    Train,
    /// Clips that only evaluation may see.
    HeldOut,
}

impl Split {
    /// The split of a seed.
    pub fn of(seed: u64) -> Split {
        if mix64(seed) & 1 == 0 { Split::Train } else { Split::HeldOut }
    }

    /// Seeds of this split from `first` on, rising.
    pub fn seeds(self, first: u64) -> impl Iterator<Item = u64> {
        (first..=u64::MAX).filter(move |&s| Split::of(s) == self)
    }
}

/// One frame: pixels row by row, ground truth of the same size.
#[derive(Clone, Debug, PartialEq)]
pub struct Frame {
    /// Colour, [H, W, 3].
    pub rgb: Vec<u8>,
    /// z-depth of the pixel centre's ray, metres, [H, W]; 0 where there is no surface within 150 m
    /// (sky, and the last strip of ground under the horizon). Those pixels have object number 0.
    pub depth: Vec<f32>,
    /// Velocity of the material point seen at the pixel centre, world axes (the first camera's), m/s: the exact
    /// time derivative of the rigid part it lies on (turning vehicles and swinging limbs included). Wheels
    /// have the velocity of the vehicle body at that point, without their spin.
    pub velocity: Vec<[f32; 3]>,
    /// Object seen at the pixel centre: 0 sky, 1 ground, then one number per object, kept over the clip.
    pub id: Vec<u16>,
    /// Camera in world axes.
    pub camera: Camera,
    /// Seconds.
    pub time: f64,
}

impl Frame {
    /// Pixels that move faster than `threshold` m/s: 255, else 0.
    pub fn dynamic(&self, threshold: f32) -> Vec<u8> {
        let square = threshold * threshold;
        let fast = |v: &[f32; 3]| v[0] * v[0] + v[1] * v[1] + v[2] * v[2] > square;
        self.velocity.iter().map(|v| if fast(v) { 255 } else { 0 }).collect()
    }
}

/// Speed above which a pixel counts as dynamic in written masks, m/s.
pub const DYNAMIC: f32 = 1.0;

/// A clip: scene, camera path and timing.
#[derive(Clone, Debug)]
pub struct Street {
    seed: u64,
    options: Options,
    spec: SceneSpec,
    k: Intrinsics,
}

impl Street {
    /// Lays the street of a seed. Frames are drawn on demand.
    pub fn new(seed: u64, options: Options) -> Result<Street> {
        options.check()?;
        let spec = SceneSpec::lasting(seed, &options.style, options.seconds());
        let (w, h) = (f64::from(options.width), f64::from(options.height));
        let f = 0.5 * w / tan(0.5 * spec.hfov * std::f64::consts::PI / 180.0);
        Ok(Street { seed, options, spec, k: Intrinsics { fx: f, fy: f, cx: 0.5 * w, cy: 0.5 * h } })
    }

    /// The seed.
    pub fn seed(&self) -> u64 {
        self.seed
    }

    /// Size and timing.
    pub fn options(&self) -> &Options {
        &self.options
    }

    /// The scene behind the frames.
    pub fn spec(&self) -> &SceneSpec {
        &self.spec
    }

    /// Intrinsics, the same for all frames.
    pub fn intrinsics(&self) -> Intrinsics {
        self.k
    }

    /// Camera at any time, in the axes of the first camera.
    pub fn camera_at(&self, time: f64) -> Camera {
        let (r0, t0) = self.spec.ego.pose(0.0);
        let pose = if time == 0.0 {
            Pose::IDENTITY
        } else {
            let (r, t) = self.spec.ego.pose(time);
            Pose { r: r0, t: t0 }.inverse().then(&Pose { r, t })
        };
        Camera { width: self.options.width, height: self.options.height, k: self.k, pose }
    }

    /// Frame `i`, 0 to `frames - 1`.
    pub fn frame(&self, i: usize) -> Frame {
        self.frame_at(self.options.time(i))
    }

    /// The street at any time, also between frames.
    pub fn frame_at(&self, time: f64) -> Frame {
        let (r, t) = self.spec.ego.pose(time);
        let k = &self.k;
        let view = View {
            width: self.options.width as usize,
            height: self.options.height as usize,
            focal: [k.fx as f32, k.fy as f32],
            centre: [k.cx as f32, k.cy as f32],
            r,
            t,
        };
        let raster = render(&self.spec.scene, &view, time);
        let to_world = self.spec.ego.pose(0.0).0.transpose();
        let turn = |v: [f32; 3]| {
            if v == [0.0; 3] {
                return v;
            }
            (to_world * DVec3::new(f64::from(v[0]), f64::from(v[1]), f64::from(v[2]))).as_vec3().to_array()
        };
        let mut rgb = raster.rgb;
        if self.options.noise > 0.0 {
            grain(&mut rgb, self.options.noise, self.seed ^ mix64(time.to_bits()));
        }
        Frame {
            rgb,
            depth: raster.depth,
            velocity: raster.velocity.into_iter().map(turn).collect(),
            id: raster.id,
            camera: self.camera_at(time),
            time,
        }
    }

    /// All frames, drawn on all threads; the same bytes as one by one.
    pub fn frames(&self) -> Vec<Frame> {
        (0..self.options.frames).into_par_iter().map(|i| self.frame(i)).collect()
    }
}

/// Adds sensor noise of a standard deviation (sum of four uniforms per value).
fn grain(rgb: &mut [u8], sigma: f32, seed: u64) {
    let seed = Rng::new(seed, "noise").seed();
    for (i, v) in rgb.iter_mut().enumerate() {
        let h = hash3(i as i32, 0, 0, seed);
        let sum: u32 = h.to_le_bytes().iter().map(|&b| u32::from(b)).sum();
        // Four bytes have a standard deviation of 147.8 together.
        let x = f32::from(*v) + (sum as f32 - 510.0) * (sigma / 147.8) + 0.5;
        *v = if x > 255.0 {
            255
        } else if x > 0.0 {
            x as u8
        } else {
            0
        };
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::motion::Motion;
    use crate::raycast::ID_FIRST;

    /// Pixels: the velocity of a frame is the field of a node of the object it shows, in the first camera's axes.
    #[test]
    fn pixels_show_the_velocity_of_their_part() {
        let options = Options { width: 126, height: 84, ..Options::default() };
        let mut moving = 0;
        for seed in 0..8 {
            let street = Street::new(seed, options.clone()).unwrap();
            let frame = street.frame(7);
            let bodies = &street.spec().scene.bodies;
            let (r0, t0) = street.spec().ego.pose(0.0);
            let mut nodes = Vec::new();
            for i in 0..frame.id.len() {
                if frame.id[i] < ID_FIRST {
                    continue;
                }
                let body = &bodies[usize::from(frame.id[i] - ID_FIRST)];
                let (x, y) = (i % 126, i / 126);
                let p = frame.camera.unproject(x as f64 + 0.5, y as f64 + 0.5, f64::from(frame.depth[i]));
                body.motions(frame.time, &mut nodes);
                let v = DVec3::from(frame.velocity[i].map(f64::from));
                let off = |m: &Motion| (r0.transpose() * m.velocity_at(r0 * p + t0) - v).length();
                let least = nodes.iter().map(off).fold(f64::INFINITY, f64::min);
                assert!(least < 1e-4, "seed {seed} pixel {i}: off by {least} m/s");
                moving += usize::from(v.length() > 1.0);
            }
        }
        assert!(moving > 1_000, "{moving}");
    }
}
