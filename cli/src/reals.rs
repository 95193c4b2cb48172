//! [`Reals`]: the pictures that a scene was made from, brought to its times and size.

use sf_formats::clip::{Clip, ClipOptions, MixedSizes};
use sf_formats::error::{escape, escape_path};
use sf_formats::image_io::Rgb8;
use sf_formats::{Error, Result, Scene};
use sf_ops::resize::{Filter, resample_u8};
use std::path::Path;

/// One picture of the clip.
pub(crate) struct Real {
    /// Seconds in the scene's time.
    pub(crate) time: f64,
    /// The picture at the size of the scene's cameras.
    pub(crate) image: Rgb8,
}

/// The clip's pictures in time order, source frames and those between them.
pub(crate) struct Reals(Vec<Real>);

impl Reals {
    /// Reads all pictures of a clip and finds the scene's frames among them by name. The scene's times count,
    /// whatever the clip says; other pictures lie between them as in the clip.
    ///
    /// # Errors
    /// Status 3 when the scene has no frames, or the clip lacks one of them.
    pub(crate) fn open(path: &Path, scene: &Scene) -> Result<Reals> {
        let options = ClipOptions { mixed_sizes: MixedSizes::Allow, ..ClipOptions::default() };
        let clip = Clip::open(path, &options)?;
        let first = scene.frames.first().ok_or_else(|| Error::input("--clip", "the scene has no frames"))?;
        let size = (first.camera.width, first.camera.height);
        let known: Vec<(f64, f64)> = scene
            .frames
            .iter()
            .map(|frame| {
                let real = clip.frames.iter().find(|f| f.name == frame.name).ok_or_else(|| {
                    let why =
                        format!("has no picture '{}', which the scene was made from", escape(frame.name.as_bytes()));
                    Error::input(escape_path(path), why)
                })?;
                Ok((real.time, frame.time))
            })
            .collect::<Result<_>>()?;
        if known.windows(2).any(|w| w[0].0 >= w[1].0) {
            return Err(Error::input(escape_path(path), "its pictures are not in the order of the scene's frames"));
        }
        let frames = clip.frames.into_iter();
        Ok(Reals(frames.map(|f| Real { time: carry(&known, f.time), image: resized(&f.image, size) }).collect()))
    }

    /// The picture nearest in time, the earlier of two; none when the clip is empty.
    pub(crate) fn nearest(&self, time: f64) -> Option<&Real> {
        let distance = |r: &Real| (r.time - time).abs();
        self.0.iter().reduce(|a, b| if distance(b) < distance(a) - Scene::SAME_TIME { b } else { a })
    }
}

/// A clip's time in the scene's: straight lines through the times of the common frames, carried on.
fn carry(known: &[(f64, f64)], time: f64) -> f64 {
    let n = known.len();
    if n < 2 {
        return known.first().map_or(time, |k| time - k.0 + k.1);
    }
    let hi = known.iter().position(|k| k.0 >= time).unwrap_or(n - 1).max(1);
    let (a, b) = (known[hi - 1], known[hi]);
    a.1 + (b.1 - a.1) * (time - a.0) / (b.0 - a.0)
}

/// A picture at a size.
pub(crate) fn resized(image: &Rgb8, (width, height): (u32, u32)) -> Rgb8 {
    if image.size() == (width, height) {
        return image.clone();
    }
    let sides = |w: u32, h: u32| (w as usize, h as usize);
    let data = resample_u8(&image.data, sides(image.width, image.height), Filter::Bicubic, sides(width, height));
    Rgb8::new(width, height, data)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn times_of_a_clip_become_times_of_the_scene() {
        // The scene was made at twice the speed, from the second and fourth of five pictures.
        let known = [(0.1, 0.0), (0.3, 0.4)];
        let got = [0.0, 0.1, 0.2, 0.3, 0.4].map(|t| carry(&known, t));
        for (g, want) in got.into_iter().zip([-0.2, 0.0, 0.2, 0.4, 0.6]) {
            assert!((g - want).abs() < 1e-12, "{g} {want}");
        }
        assert!((carry(&[(2.0, 0.0)], 2.5) - 0.5).abs() < 1e-12);
        let real = |time| Real { time, image: Rgb8::new(1, 1, vec![0; 3]) };
        let reals = Reals(vec![real(0.0), real(0.1), real(0.2)]);
        assert_eq!(reals.nearest(0.16).map(|r| r.time), Some(0.2));
        assert_eq!(reals.nearest(-5.0).map(|r| r.time), Some(0.0));
    }
}
