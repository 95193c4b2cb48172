//! A clip: pictures with times, and intrinsics and poses where the source has them.
//!
//! Sources: a folder of pictures in natural order, a `transforms.json` (alone or in the folder), a list
//! file `images.txt` (one `PATH [SECONDS]` a line, `#` comments), or one picture. Only the frames that
//! are selected are decoded. File names are bytes: no encoding is assumed.

use crate::camera::{Intrinsics, Pose};
use crate::clip_source::Source;
use crate::error::{Error, Result, escape_path};
use crate::image_io::{self, Rgb8};
use crate::open::read_regular;
use std::path::{Path, PathBuf};

pub use crate::clip_source::natural;
pub use crate::image_io::Orientation;
pub use crate::truth::{ClipFrame, ClipWriter, GroundTruth, TruthFrame};

/// Frame rate when nothing gives times.
pub const DEFAULT_FPS: f64 = 10.0;
/// Shortest and longest time between frames, seconds, both excluded.
pub const TIME_STEP: (f64, f64) = (1e-4, 10.0);
/// Smallest side of a picture: one patch of every preset.
pub const MIN_SIDE: u32 = 14;
/// Largest ratio of the sides.
pub const MAX_ASPECT: u32 = 16;
/// Most decoded bytes of a clip: 8 GiB.
const MAX_BYTES: u64 = 8 << 30;
/// What to do with frames of different sizes.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum MixedSizes {
    /// Refuse them (default).
    #[default]
    Refuse,
    /// Keep every frame at its own size; the network resizes each to its own. The intrinsics belong to
    /// the first frame.
    Allow,
}

/// How a clip is opened.
#[derive(Clone, Debug, PartialEq)]
pub struct ClipOptions {
    /// Frames per second where neither `times` nor the source gives times; [`DEFAULT_FPS`] if `None`.
    pub fps: Option<f64>,
    /// Seconds of all frames of the source, or of the selected ones.
    pub times: Option<Vec<f64>>,
    /// Which frames, ascending indices into the source's order; all if `None`.
    pub frames: Option<Vec<usize>>,
    /// Most frames that are decoded.
    pub max_frames: usize,
    /// Frames of different sizes.
    pub mixed_sizes: MixedSizes,
    /// EXIF orientation.
    pub orientation: Orientation,
}

impl Default for ClipOptions {
    fn default() -> Self {
        ClipOptions {
            fps: None,
            times: None,
            frames: None,
            max_frames: 512,
            mixed_sizes: MixedSizes::Refuse,
            orientation: Orientation::Apply,
        }
    }
}

/// One decoded frame.
#[derive(Clone, Debug, PartialEq)]
pub struct Frame {
    /// The picture at its own size.
    pub image: Rgb8,
    /// Seconds.
    pub time: f64,
    /// File name for reports (bytes that are not UTF-8 are replaced).
    pub name: String,
}

/// Frames in time order.
#[derive(Clone, Debug, PartialEq)]
pub struct Clip {
    /// The selected frames.
    pub frames: Vec<Frame>,
    /// Their indices in the source, for ground truth.
    pub indices: Vec<usize>,
    /// Number of frames in the source.
    pub total: usize,
    /// Intrinsics at the size of the first frame, if the source has them.
    pub intrinsics: Option<Intrinsics>,
    /// Reference poses of the selected frames in the source's own world, if every one has one.
    pub poses: Option<Vec<Pose>>,
    /// Folder of the source, where ground truth lies.
    pub folder: PathBuf,
    /// What was ignored or assumed.
    pub notes: Vec<String>,
}

impl Clip {
    /// Opens a clip and decodes the selected frames.
    pub fn open(path: &Path, options: &ClipOptions) -> Result<Clip> {
        let mut source = Source::list(path)?;
        let at = escape_path(path);
        let total = source.frames.len();
        if total == 0 {
            return Err(Error::usage(format!("{at}: no PNG or JPEG picture found; pass a folder of frames")));
        }
        let chosen = select(total, options)?;
        let times = choose_times(&mut source, &chosen, options, &at)?;
        let poses = chosen.iter().map(|&i| source.frames[i].pose).collect();
        let mut clip = Clip {
            frames: Vec::with_capacity(chosen.len()),
            indices: chosen,
            total,
            intrinsics: None,
            poses,
            folder: source.folder,
            notes: source.notes,
        };
        let (mut bytes, mut transparent) = (0u64, 0usize);
        for (n, &i) in clip.indices.iter().enumerate() {
            let file = &source.frames[i].path;
            let name = file.file_name().unwrap_or_default().to_string_lossy().into_owned();
            let at = format!("frame {i} ({})", escape_path(file));
            let raw = read_regular(file, image_io::MAX_FILE)?
                .ok_or_else(|| Error::input(&at, "file is longer than 256 MiB"))?;
            let decoded = image_io::decode(&raw, &at, options.orientation)?;
            transparent += usize::from(decoded.alpha);
            let image = decoded.image;
            check_size(&image, &at)?;
            if let Some(first) = clip.frames.first()
                && first.image.size() != image.size()
                && options.mixed_sizes == MixedSizes::Refuse
            {
                let ((w, h), (w0, h0)) = (image.size(), first.image.size());
                return Err(Error::input(at, format!("is {w}x{h} but the first frame is {w0}x{h0}; pass --resize")));
            }
            bytes += image.data.len() as u64;
            if bytes > MAX_BYTES {
                let why = format!("clip decodes to more than {} GiB; select fewer --frames", MAX_BYTES >> 30);
                return Err(Error::resource(at, why));
            }
            clip.frames.push(Frame { image, time: times[n], name });
        }
        if transparent > 0 {
            clip.notes.push(format!("{transparent} frames have transparency, composited on black"));
        }
        clip.intrinsics = source.lens.map(|lens| lens.at(clip.frames[0].image.size()));
        if let Some(k) = &clip.intrinsics {
            k.check(&format!("{at}: intrinsics at the pictures' size"))?;
        }
        Ok(clip)
    }

    /// Times of the frames, seconds.
    pub fn times(&self) -> Vec<f64> {
        self.frames.iter().map(|f| f.time).collect()
    }

    /// Reference poses with the first selected frame's camera as the world.
    pub fn relative_poses(&self) -> Option<Vec<Pose>> {
        let poses = self.poses.as_ref()?;
        let world = poses.first()?.inverse();
        Some(poses.iter().map(|p| world.then(p)).collect())
    }
}

fn check_size(image: &Rgb8, at: &str) -> Result<()> {
    let (w, h) = image.size();
    let (short, long) = (w.min(h), w.max(h));
    if short < MIN_SIDE {
        return Err(Error::input(at, format!("is {w}x{h}; both sides must be at least {MIN_SIDE} pixels")));
    }
    if long > short * MAX_ASPECT {
        return Err(Error::input(at, format!("is {w}x{h}; the sides may differ {MAX_ASPECT} times at most")));
    }
    Ok(())
}

/// The indices to decode, checked.
fn select(total: usize, options: &ClipOptions) -> Result<Vec<usize>> {
    let chosen: Vec<usize> = options.frames.clone().unwrap_or_else(|| (0..total).collect());
    if chosen.is_empty() {
        return Err(Error::usage("no frame is selected"));
    }
    if let Some(i) = chosen.iter().find(|&&i| i >= total) {
        return Err(Error::usage(format!("frame {i} is selected, but the clip has frames 0 to {}", total - 1)));
    }
    if let Some(w) = chosen.windows(2).find(|w| w[0] >= w[1]) {
        return Err(Error::usage(format!("selected frames must ascend: {} then {}", w[0], w[1])));
    }
    if chosen.len() > options.max_frames {
        let why =
            format!("{} frames; the limit is {}: select some, or work in windows", chosen.len(), options.max_frames);
        return Err(Error::resource("clip", why));
    }
    Ok(chosen)
}

/// Times of the chosen frames: given, else the source's, else by rate.
fn choose_times(source: &mut Source, chosen: &[usize], options: &ClipOptions, at: &str) -> Result<Vec<f64>> {
    let total = source.frames.len();
    let timed = chosen.iter().filter(|&&i| source.frames[i].time.is_some()).count();
    let times: Vec<f64> = if let Some(given) = &options.times {
        if given.len() == chosen.len() {
            given.clone()
        } else if given.len() == total {
            chosen.iter().map(|&i| given[i]).collect()
        } else {
            let why = format!("{} times for {} selected of {total} frames", given.len(), chosen.len());
            return Err(Error::input("times", why));
        }
    } else if timed == chosen.len() {
        if options.fps.is_some() {
            source.notes.push("the frame rate is not used: the clip carries its own times".into());
        }
        chosen.iter().filter_map(|&i| source.frames[i].time).collect()
    } else if timed > 0 {
        return Err(Error::input(at, format!("only {timed} of {} frames have a time", chosen.len())));
    } else {
        let fps = options.fps.unwrap_or(DEFAULT_FPS);
        if !(fps.is_finite() && fps > 0.0) {
            return Err(Error::usage(format!("a frame rate of {fps} is not positive")));
        }
        if options.fps.is_none() && chosen.len() > 1 {
            source.notes.push(format!("no times given: {DEFAULT_FPS} frames per second are assumed"));
        }
        chosen.iter().map(|&i| i as f64 / fps).collect()
    };
    check_times(&times)?;
    Ok(times)
}

/// Refuses times that are not finite, absurd, or whose steps leave [`TIME_STEP`].
pub fn check_times(times: &[f64]) -> Result<()> {
    if let Some((i, t)) = times.iter().enumerate().find(|(_, t)| !t.is_finite() || t.abs() > 1e12) {
        return Err(Error::input(format!("frame {i}"), format!("time {t} is not a time in seconds")));
    }
    for (i, w) in times.windows(2).enumerate() {
        let step = w[1] - w[0];
        if !(step > TIME_STEP.0 && step < TIME_STEP.1) {
            let why = format!(
                "is {step} s after the frame before it; between {} and {} s are allowed",
                TIME_STEP.0, TIME_STEP.1
            );
            return Err(Error::input(format!("frame {}", i + 1), why));
        }
    }
    Ok(())
}
