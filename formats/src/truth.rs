//! Clips with exact ground truth: how they lie on disk, reading and writing.
//!
//! | file | content |
//! |---|---|
//! | `000000.png` ... | pictures |
//! | `transforms.json` | intrinsics, camera-to-world poses, times |
//! | `depth/000000.npy` | f32 `[H, W]`: z-depth in scene units, 0 where no surface is seen (sky) |
//! | `velocity/000000.npy` | f32 `[H, W, 3]`: world axes of `transforms.json`, scene units per second |
//! | `dynamic/000000.png` | gray, 255 where the surface moves, else 0 |

use crate::atomic::{self, Overwrite};
use crate::camera::Camera;
use crate::error::{Error, Result, escape_path};
use crate::image_io::{self, Orientation, Rgb8};
use crate::npy;
use crate::transforms::{self, View};
use std::collections::BTreeMap;
use std::path::{Path, PathBuf};
use std::sync::Mutex;

/// What is known about one frame.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct TruthFrame {
    /// Pixels in a row.
    pub width: u32,
    /// Rows.
    pub height: u32,
    /// `[H, W]` z-depth; 0 where no surface is seen.
    pub depth: Vec<f32>,
    /// `[H, W]` velocity in world axes, scene units per second.
    pub velocity: Option<Vec<[f32; 3]>>,
    /// `[H, W]` whether the surface moves.
    pub dynamic: Option<Vec<bool>>,
}

impl TruthFrame {
    /// Refuses arrays of the wrong length and values that are not finite.
    fn check(&self, at: &str) -> Result<()> {
        let n = self.width as usize * self.height as usize;
        let lengths = [
            ("depth", self.depth.len()),
            ("velocity", self.velocity.as_ref().map_or(n, Vec::len)),
            ("dynamic", self.dynamic.as_ref().map_or(n, Vec::len)),
        ];
        if let Some((name, len)) = lengths.into_iter().find(|l| l.1 != n) {
            let why = format!("{name} has {len} values; {}x{} are wanted", self.width, self.height);
            return Err(Error::input(at, why));
        }
        if let Some(i) = self.depth.iter().position(|d| !(d.is_finite() && *d >= 0.0)) {
            return Err(Error::input(
                at,
                format!("depth {} at pixel {i}; finite and not negative is wanted", self.depth[i]),
            ));
        }
        let bad = self.velocity.iter().flatten().position(|v| !v.iter().all(|c| c.is_finite()));
        if let Some(i) = bad {
            return Err(Error::input(at, format!("velocity at pixel {i} is not finite")));
        }
        Ok(())
    }
}

/// Ground truth of some frames of a clip.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct GroundTruth {
    /// One entry per index asked for.
    pub frames: Vec<TruthFrame>,
}

/// Name of a frame's file without its extension.
fn stem(index: usize) -> String {
    format!("{index:06}")
}

impl GroundTruth {
    /// Reads the frames `indices` of a clip's folder; `None` if the folder has no `depth` folder.
    pub fn load(folder: &Path, indices: &[usize]) -> Result<Option<GroundTruth>> {
        let [depth, velocity, dynamic] = ["depth", "velocity", "dynamic"].map(|d| folder.join(d));
        if !depth.is_dir() {
            return Ok(None);
        }
        let mut frames = Vec::with_capacity(indices.len());
        for &i in indices {
            let array = depth.join(stem(i) + ".npy");
            let at = escape_path(&array);
            let (shape, values) = npy::read_f32(&array)?;
            let [h, w] = shape[..] else {
                return Err(Error::input(at, format!("shape {shape:?}; [height, width] is wanted")));
            };
            let side = |v: usize| u32::try_from(v).ok().filter(|v| *v > 0 && *v <= Camera::MAX_SIDE);
            let (width, height) =
                side(w).zip(side(h)).ok_or_else(|| Error::input(&at, format!("{w}x{h} is no picture size")))?;
            let mut frame = TruthFrame { width, height, depth: values, velocity: None, dynamic: None };
            if velocity.is_dir() {
                let array = velocity.join(stem(i) + ".npy");
                let (shape, values) = npy::read_f32(&array)?;
                if shape[..] != [h, w, 3] {
                    let why = format!("shape {shape:?}; [{h}, {w}, 3] is wanted");
                    return Err(Error::input(escape_path(&array), why));
                }
                frame.velocity = Some(values.chunks_exact(3).map(|v| [v[0], v[1], v[2]]).collect());
            }
            if dynamic.is_dir() {
                let mask = image_io::read(&dynamic.join(stem(i) + ".png"), Orientation::Ignore)?;
                frame.dynamic = Some(mask.data.chunks_exact(3).map(|p| p[0] >= 128).collect());
            }
            frame.check(&at)?;
            frames.push(frame);
        }
        Ok(Some(GroundTruth { frames }))
    }
}

/// One frame to be written.
#[derive(Clone, Copy, Debug)]
pub struct ClipFrame<'a> {
    /// The picture.
    pub image: &'a Rgb8,
    /// Camera at the picture's size; its world is the first frame's camera.
    pub camera: Camera,
    /// Seconds.
    pub time: f64,
    /// Ground truth, if known.
    pub truth: Option<&'a TruthFrame>,
}

/// Writes a clip with its ground truth. Frames may come from several threads in any order.
#[derive(Debug)]
pub struct ClipWriter {
    folder: PathBuf,
    overwrite: Overwrite,
    views: Mutex<BTreeMap<usize, View>>,
}

impl ClipWriter {
    /// Makes the folder; with [`Overwrite::No`] it must be absent or empty.
    pub fn create(folder: &Path, overwrite: Overwrite) -> Result<ClipWriter> {
        output_folder(folder, overwrite)?;
        Ok(ClipWriter { folder: folder.to_path_buf(), overwrite, views: Mutex::default() })
    }

    /// Writes frame `index`.
    pub fn frame(&self, index: usize, frame: &ClipFrame) -> Result<()> {
        let name = stem(index);
        let view = View { name: name.clone() + ".png", time: frame.time, camera: frame.camera };
        let (w, h) = frame.image.size();
        if (w, h) != (frame.camera.width, frame.camera.height) {
            let why = format!("picture is {w}x{h}, camera {}x{}", frame.camera.width, frame.camera.height);
            return Err(Error::input(format!("frame {index}"), why));
        }
        frame.camera.check(&format!("frame {index}"))?;
        image_io::write_png(&self.folder.join(&view.name), frame.image, self.overwrite)?;
        if let Some(truth) = frame.truth {
            truth.check(&format!("ground truth of frame {index}"))?;
            let (rows, columns) = (truth.height as usize, truth.width as usize);
            let depth = self.subfolder("depth")?.join(name.clone() + ".npy");
            npy::write_f32(&depth, &[rows, columns], &truth.depth, self.overwrite)?;
            if let Some(v) = &truth.velocity {
                let path = self.subfolder("velocity")?.join(name.clone() + ".npy");
                npy::write_f32(&path, &[rows, columns, 3], v.as_flattened(), self.overwrite)?;
            }
            if let Some(d) = &truth.dynamic {
                let path = self.subfolder("dynamic")?.join(name + ".png");
                let gray: Vec<u8> = d.iter().map(|&d| if d { 255 } else { 0 }).collect();
                image_io::write_gray8(&path, (truth.width, truth.height), &gray, self.overwrite)?;
            }
        }
        self.views.lock().expect("no writer panicked").insert(index, view);
        Ok(())
    }

    fn subfolder(&self, name: &str) -> Result<PathBuf> {
        let path = self.folder.join(name);
        std::fs::create_dir_all(&path).map_err(|e| Error::io(&path, "create", &e))?;
        Ok(path)
    }

    /// Writes `transforms.json`; a clip is complete with it.
    pub fn finish(self) -> Result<()> {
        let views = self.views.into_inner().expect("no writer panicked");
        let views: Vec<View> = views.into_values().collect();
        let text = transforms::write(&views);
        atomic::write(&self.folder.join("transforms.json"), text.as_bytes(), self.overwrite)
    }
}

/// Makes an output folder; with [`Overwrite::No`] an existing one must be empty.
pub(crate) fn output_folder(folder: &Path, overwrite: Overwrite) -> Result<()> {
    if overwrite == Overwrite::No
        && let Ok(mut entries) = std::fs::read_dir(folder)
        && entries.next().is_some()
    {
        let e =
            std::io::Error::new(std::io::ErrorKind::AlreadyExists, "it is not empty; pass --force to write into it");
        return Err(Error::io(folder, "write", &e));
    }
    std::fs::create_dir_all(folder).map_err(|e| Error::io(folder, "create", &e))
}
