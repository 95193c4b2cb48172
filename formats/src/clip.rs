//! A clip: pictures with times, and intrinsics and poses where the source has them.
//!
//! Sources: a folder of pictures in natural order, a `transforms.json` (alone or in the folder), a list
//! file `images.txt` (one `PATH [SECONDS]` a line, `#` comments), or one picture. Only the frames that
//! are selected are decoded. File names are bytes: no encoding is assumed.

use crate::camera::{Intrinsics, Pose};
use crate::error::{Error, Result, escape, escape_path};
use crate::image_io::{self, Rgb8};
use crate::sniff::read_regular;
use crate::transforms::{Lens, Transforms};
use std::cmp::Ordering;
use std::ffi::OsStr;
use std::os::unix::ffi::OsStrExt;
use std::path::{Path, PathBuf};

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
/// Longest list file.
const LIST_CAP: u64 = 16 << 20;

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

/// A frame before it is decoded.
struct Listed {
    path: PathBuf,
    time: Option<f64>,
    pose: Option<Pose>,
}

/// A source before its pictures are decoded.
struct Source {
    folder: PathBuf,
    frames: Vec<Listed>,
    lens: Option<Lens>,
    notes: Vec<String>,
}

impl Clip {
    /// Opens a clip and decodes the selected frames.
    pub fn open(path: &Path, options: &ClipOptions) -> Result<Clip> {
        let mut source = list(path)?;
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

/// What a path holds, without decoding a picture.
fn list(path: &Path) -> Result<Source> {
    let meta = std::fs::metadata(path).map_err(|e| Error::io(path, "open", &e))?;
    let folder = if meta.is_dir() { path } else { path.parent().unwrap_or(Path::new("")) }.to_path_buf();
    if meta.is_dir() {
        let json = path.join("transforms.json");
        let text = path.join("images.txt");
        return if json.is_file() {
            list_transforms(&json, folder)
        } else if text.is_file() {
            list_text(&text, folder)
        } else {
            list_folder(folder)
        };
    }
    match ending(path).as_deref() {
        Some(b"json") => list_transforms(path, folder),
        Some(b"txt") => list_text(path, folder),
        _ => {
            let frames = vec![Listed { path: path.to_path_buf(), time: None, pose: None }];
            Ok(Source { folder, frames, lens: None, notes: Vec::new() })
        }
    }
}

/// Lower-case extension as bytes.
fn ending(path: &Path) -> Option<Vec<u8>> {
    path.extension().map(|e| e.as_bytes().to_ascii_lowercase())
}

fn is_picture(path: &Path) -> bool {
    let hidden = path.file_name().is_some_and(|n| n.as_bytes().starts_with(b"."));
    !hidden && matches!(ending(path).as_deref(), Some(b"png" | b"jpg" | b"jpeg"))
}

fn list_folder(folder: PathBuf) -> Result<Source> {
    let mut files = Vec::new();
    for entry in std::fs::read_dir(&folder).map_err(|e| Error::io(&folder, "list", &e))? {
        let path = entry.map_err(|e| Error::io(&folder, "list", &e))?.path();
        if is_picture(&path) && !path.is_dir() {
            files.push(path);
        }
    }
    files.sort_by(|a, b| natural(a, b));
    let frames = files.into_iter().map(|path| Listed { path, time: None, pose: None }).collect();
    Ok(Source { folder, frames, lens: None, notes: Vec::new() })
}

/// Order in which people number files: runs of digits compare as numbers, the rest as bytes.
pub fn natural(a: &Path, b: &Path) -> Ordering {
    let (full_a, full_b) = (a.as_os_str().as_bytes(), b.as_os_str().as_bytes());
    let (mut a, mut b) = (full_a, full_b);
    let digits = |s: &[u8]| s.iter().take_while(|c| c.is_ascii_digit()).count();
    loop {
        let (na, nb) = (digits(a), digits(b));
        if na > 0 && nb > 0 {
            // Without leading zeros the longer number is the larger one, of any length.
            let zeros = |s: &[u8]| s.iter().take_while(|c| **c == b'0').count();
            let (da, db) = (&a[zeros(&a[..na])..na], &b[zeros(&b[..nb])..nb]);
            let order = da.len().cmp(&db.len()).then_with(|| da.cmp(db));
            if order != Ordering::Equal {
                return order;
            }
            (a, b) = (&a[na..], &b[nb..]);
            continue;
        }
        match (a.split_first(), b.split_first()) {
            (Some((x, ra)), Some((y, rb))) if x == y => (a, b) = (ra, rb),
            (Some((x, _)), Some((y, _))) => return x.cmp(y),
            // 1.png and 01.png: bytes decide, so the order is total.
            (None, None) => return full_a.cmp(full_b),
            (x, _) => return if x.is_none() { Ordering::Less } else { Ordering::Greater },
        }
    }
}

fn list_transforms(path: &Path, folder: PathBuf) -> Result<Source> {
    let Transforms { frames, lens, notes } = Transforms::read(path)?;
    let mut frames: Vec<Listed> = frames
        .into_iter()
        .map(|f| Listed { path: with_extension(folder.join(f.path)), time: f.time, pose: f.pose })
        .collect();
    // Exporters write frames in any order; the clip is in time order.
    if frames.iter().all(|f| f.time.is_some()) {
        frames.sort_by(|a, b| a.time.partial_cmp(&b.time).unwrap_or(Ordering::Equal));
    } else {
        frames.sort_by(|a, b| natural(&a.path, &b.path));
    }
    Ok(Source { folder, frames, lens, notes })
}

/// Synthetic sets leave out `.png`.
fn with_extension(path: PathBuf) -> PathBuf {
    if path.extension().is_some() || path.exists() {
        return path;
    }
    let tried = ["png", "jpg", "jpeg"].map(|e| path.with_extension(e));
    tried.into_iter().find(|p| p.exists()).unwrap_or(path)
}

fn list_text(path: &Path, folder: PathBuf) -> Result<Source> {
    let at = escape_path(path);
    let bytes = read_regular(path, LIST_CAP)?
        .ok_or_else(|| Error::input(&at, format!("list is longer than {} MiB", LIST_CAP >> 20)))?;
    let mut frames = Vec::new();
    for (n, line) in bytes.split(|&b| b == b'\n').enumerate() {
        let line = line.trim_ascii();
        if line.is_empty() || line[0] == b'#' {
            continue;
        }
        if line.contains(&0) {
            return Err(Error::input(
                format!("{at}: line {}", n + 1),
                format!("holds a zero byte: '{}'", escape(line)),
            ));
        }
        let gap = line.iter().rposition(u8::is_ascii_whitespace);
        let time = gap.and_then(|g| std::str::from_utf8(&line[g + 1..]).ok()?.parse::<f64>().ok());
        let name = match (gap, time) {
            (Some(g), Some(_)) => line[..g].trim_ascii_end(),
            _ => line,
        };
        frames.push(Listed { path: folder.join(OsStr::from_bytes(name)), time, pose: None });
    }
    Ok(Source { folder, frames, lens: None, notes: Vec::new() })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn natural_order_is_numeric_and_total() {
        let sorted = |names: &[&str]| {
            let mut v: Vec<PathBuf> = names.iter().map(PathBuf::from).collect();
            v.sort_by(|a, b| natural(a, b));
            v.iter().map(|p| p.to_str().unwrap().to_owned()).collect::<Vec<_>>()
        };
        assert_eq!(sorted(&["f10.png", "f9.png", "f1.png", "f.png"]), ["f.png", "f1.png", "f9.png", "f10.png"]);
        assert_eq!(sorted(&["01.png", "1.png", "2.png", "0.png"]), ["0.png", "01.png", "1.png", "2.png"]);
        assert_eq!(
            sorted(&["99999999999999999999999.png", "100000000000000000000000.png"]),
            ["99999999999999999999999.png", "100000000000000000000000.png"]
        );
        assert_eq!(sorted(&["a2b10", "a2b9", "a10b1"]), ["a2b9", "a2b10", "a10b1"]);
    }
}
