//! Frames of any size to the network's input: resize, then mean and deviation (network specification
//! 1.3 step 1, 1.4).
//!
//! Frames are resized, never padded: padding would create tokens that enter global attention and the
//! intrinsics fit. The resize is bit-exact with Pillow's 8-bit one.

use crate::dims::{ClipShape, Dims};
use crate::input::Input;
use crate::output::FrameSource;
use sf_formats::clip::Clip;
use sf_formats::config::{ModelConfig, Resample};
use sf_formats::{Error, Intrinsics, Result};
use sf_ops::cpu::DefaultFloatMode;
use sf_ops::opclock::{self, Op, Work};
use sf_ops::par::Pool;
use sf_ops::resize::{Filter, resample_u8};

/// Pixels per frame the public model was trained with at most (Pi3's loader).
pub const DEFAULT_PIXELS: u64 = 255_000;

/// Most extreme width over height (or height over width) of a source frame.
pub const MAX_ASPECT: f64 = 8.0;

/// The size, multiples of `patch`, that keeps the aspect of `w` x `h` within `pixels`.
///
/// Starts from the rounded multiples and shortens the side that is relatively too long until the
/// product fits, as the public tools do: 1920x1280 gives 616x406 at 255,000 pixels.
pub fn fit_size(w: u32, h: u32, patch: u32, pixels: u64) -> (u32, u32) {
    let (fw, fh, p) = (f64::from(w.max(1)), f64::from(h.max(1)), f64::from(patch));
    let scale = (pixels as f64 / (fw * fh)).sqrt();
    let (tw, th) = (fw * scale, fh * scale);
    let mut cols = ((tw / p).round() as u64).max(1);
    let mut rows = ((th / p).round() as u64).max(1);
    let area = u64::from(patch) * u64::from(patch);
    while cols * rows * area > pixels && (cols > 1 || rows > 1) {
        if rows == 1 || (cols > 1 && cols as f64 / rows as f64 > tw / th) {
            cols -= 1;
        } else {
            rows -= 1;
        }
    }
    (cols as u32 * patch, rows as u32 * patch)
}

/// One source frame.
#[derive(Clone, Copy, Debug)]
pub struct SourceFrame<'a> {
    /// Pixels.
    pub width: u32,
    /// Pixels.
    pub height: u32,
    /// RGB bytes, `[height, width, 3]`.
    pub rgb: &'a [u8],
    /// File name.
    pub name: &'a str,
}

/// A clip brought to the network's size.
#[derive(Clone, Debug)]
pub struct Prepared {
    /// Frames and their size.
    pub shape: ClipShape,
    /// RGB bytes, `[frames, height, width, 3]`.
    pub images: Vec<u8>,
    /// Seconds.
    pub times: Vec<f64>,
    /// Intrinsics at the network's size, where the clip had some.
    pub k: Option<Intrinsics>,
    /// Name and size of every frame before.
    pub sources: Vec<FrameSource>,
}

impl Prepared {
    /// A clip at `size` (width, height), or at the size of its own aspect that is a multiple of the patch,
    /// no larger than the clip and than [`DEFAULT_PIXELS`].
    pub fn from_clip(config: &ModelConfig, clip: &Clip, size: Option<(u32, u32)>) -> Result<Prepared> {
        let first = clip.frames.first().ok_or_else(|| Error::usage("a clip needs at least one frame"))?;
        let (w, h) = first.image.size();
        let size = size.unwrap_or_else(|| {
            let pixels = DEFAULT_PIXELS.min(u64::from(w) * u64::from(h));
            fit_size(w, h, config.patch, pixels)
        });
        let frames: Vec<SourceFrame> = clip
            .frames
            .iter()
            .map(|f| SourceFrame { width: f.image.width, height: f.image.height, rgb: &f.image.data, name: &f.name })
            .collect();
        prepare(config, &frames, &clip.times(), clip.intrinsics, size)
    }

    /// As input of a session of the same shape.
    pub fn input(&self) -> Input<'_> {
        Input { shape: self.shape, images: &self.images, times: &self.times, k: self.k }
    }
}

/// Resizes frames to `size` (width, height); `k` holds the intrinsics at the first frame's size.
pub fn prepare(
    config: &ModelConfig,
    frames: &[SourceFrame],
    times: &[f64],
    k: Option<Intrinsics>,
    size: (u32, u32),
) -> Result<Prepared> {
    let first = frames.first().ok_or_else(|| Error::usage("a clip needs at least one frame"))?;
    let shape = ClipShape { frames: frames.len(), height: size.1 as usize, width: size.0 as usize };
    let _mode = DefaultFloatMode::enter();
    // Caps before the allocation below.
    Dims::new(config, shape)?;
    let filter = match config.image_resample {
        Resample::Bicubic => Filter::Bicubic,
        Resample::Lanczos => Filter::Lanczos3,
        Resample::Bilinear => Filter::Bilinear,
    };
    let mut images = Vec::with_capacity(frames.len() * shape.height * shape.width * 3);
    for (f, frame) in frames.iter().enumerate() {
        let (w, h) = (frame.width as usize, frame.height as usize);
        if w == 0 || h == 0 || frame.rgb.len() != w * h * 3 {
            return Err(Error::input(format!("frame {f}"), format!("{} bytes for {w}x{h} RGB", frame.rgb.len())));
        }
        let aspect = w.max(h) as f64 / w.min(h) as f64;
        if aspect > MAX_ASPECT {
            let why = format!("{w}x{h} has an aspect of {aspect:.1}, at most {MAX_ASPECT}: crop it");
            return Err(Error::input(format!("frame {f}"), why));
        }
        if (w, h) == (shape.width, shape.height) {
            images.extend_from_slice(frame.rgb);
        } else {
            images.extend(resample_u8(frame.rgb, (w, h), filter, (shape.width, shape.height)));
        }
    }
    let prepared = Prepared {
        shape,
        images,
        times: times.to_vec(),
        k: k.map(|k| k.resized((first.width, first.height), size)),
        sources: frames.iter().map(|f| FrameSource { name: f.name.into(), size: (f.width, f.height) }).collect(),
    };
    prepared.input().check()?;
    Ok(prepared)
}

/// (byte / 255 - mean) / std per channel, by table.
pub(crate) struct Normaliser([[f32; 256]; 3]);

impl Normaliser {
    pub(crate) fn new(config: &ModelConfig) -> Normaliser {
        Normaliser(std::array::from_fn(|c| {
            let (mean, std) = (config.image_mean[c], config.image_std[c]);
            std::array::from_fn(|v| ((v as f64 / 255.0 - mean) / std) as f32)
        }))
    }

    /// `[h, w, 3]` bytes to values.
    pub(crate) fn apply(&self, bytes: &[u8], out: &mut [f32]) {
        assert_eq!(bytes.len(), out.len(), "bytes and values of an image");
        let _span = opclock::span(Op::Glue, || Work { macs: 0, bytes: 5 * out.len() as u64 });
        self.pixels(bytes, out);
    }

    /// [`Normaliser::apply`] by the threads of a pool.
    pub(crate) fn apply_on(&self, pool: &Pool, bytes: &[u8], out: &mut [f32]) {
        // Pixels of a task: 48 KiB of values.
        const TASK: usize = 1 << 12;
        assert_eq!(bytes.len(), out.len(), "bytes and values of an image");
        let _span = opclock::span(Op::Glue, || Work { macs: 0, bytes: 5 * out.len() as u64 });
        pool.chunks(out, 3 * TASK, &|i, out, _| self.pixels(&bytes[3 * TASK * i..][..out.len()], out));
    }

    fn pixels(&self, bytes: &[u8], out: &mut [f32]) {
        for (from, to) in bytes.chunks_exact(3).zip(out.chunks_exact_mut(3)) {
            for c in 0..3 {
                to[c] = self.0[c][usize::from(from[c])];
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn sizes_follow_the_public_rule() {
        assert_eq!(fit_size(1920, 1280, 14, 255_000), (616, 406));
        assert_eq!(fit_size(1600, 900, 14, 255_000), (672, 378));
        assert_eq!(fit_size(1920, 1080, 14, 255_000), (672, 378));
        assert_eq!(fit_size(240, 160, 14, 168 * 252), (252, 168));
        assert_eq!(fit_size(1, 1, 14, 10), (14, 14));
        for (w, h) in [(3, 4000), (4000, 3), (641, 479), (14, 14), (u32::MAX, 1)] {
            let (nw, nh) = fit_size(w, h, 14, 255_000);
            assert!(nw % 14 == 0 && nh % 14 == 0 && nw > 0 && nh > 0);
            assert!(u64::from(nw) * u64::from(nh) <= 255_000 || nw == 14 || nh == 14, "{w}x{h}: {nw}x{nh}");
        }
    }

    #[test]
    fn frames_are_resized_with_their_intrinsics() {
        let config = ModelConfig::base();
        let rgb = vec![90u8; 60 * 40 * 3];
        let frame = SourceFrame { width: 60, height: 40, rgb: &rgb, name: "a" };
        let k = Intrinsics { fx: 30.0, fy: 30.0, cx: 30.0, cy: 20.0 };
        let p = prepare(&config, &[frame, frame], &[0.0, 0.1], Some(k), (42, 28)).unwrap();
        assert_eq!(p.images, vec![90u8; 2 * 42 * 28 * 3]);
        assert_eq!(p.k.unwrap().cx, 21.0);
        let bad =
            |frames: &[SourceFrame], size| prepare(&config, frames, &[0.0], None, size).unwrap_err().status() as i32;
        assert_eq!(bad(&[], (42, 28)), 2);
        assert_eq!(bad(&[frame], (41, 28)), 3);
        assert_eq!(bad(&[SourceFrame { width: 61, ..frame }], (42, 28)), 3);
        let strip = vec![0u8; 100 * 3];
        assert_eq!(bad(&[SourceFrame { width: 100, height: 1, rgb: &strip, name: "b" }], (42, 28)), 3);
        assert_eq!(bad(&[frame; 5000], (42, 28)), 5);
    }

    #[test]
    fn normalisation_is_the_definition() {
        let config = ModelConfig::base();
        let mut out = [0.0; 3];
        Normaliser::new(&config).apply(&[0, 128, 255], &mut out);
        for c in 0..3 {
            let want = ([0.0, 128.0, 255.0][c] / 255.0 - config.image_mean[c]) / config.image_std[c];
            assert!((f64::from(out[c]) - want).abs() < 1e-6);
        }
    }
}
