//! `transforms.json` as nerfstudio and instant-ngp write it.
//!
//! Read: intrinsics `fl_x fl_y cx cy w h` (for all frames, or equal in every frame) or
//! `camera_angle_x`; per frame `file_path`, `transform_matrix` (camera-to-world, OpenGL camera axes:
//! x right, y up, z backward) and `time` in seconds. In memory everything is OpenCV axes:
//! R_cv = R_gl diag(1, -1, -1). The world of the file is kept.

use crate::camera::{Camera, Intrinsics, Pose};
use crate::error::{Error, Result, escape, escape_path};
use crate::open::read_regular;
use glam::{DMat3, DVec3};
use serde_json::{Map, Value, json};
use std::path::{Component, Path, PathBuf};

/// Longest file that is read.
const FILE_CAP: u64 = 64 << 20;
/// Most `..` at the start of a `file_path`: nerfstudio's own exports use one or two.
const MAX_UP: usize = 2;

/// Changes the camera axes between OpenCV and OpenGL (its own inverse).
pub(crate) fn flip(pose: &Pose) -> Pose {
    Pose { r: pose.r * DMat3::from_diagonal(DVec3::new(1.0, -1.0, -1.0)), t: pose.t }
}

/// One frame of the file.
#[derive(Clone, Debug, PartialEq)]
pub struct TransformsFrame {
    /// The picture, relative to the file's folder.
    pub path: PathBuf,
    /// Camera to world, OpenCV axes.
    pub pose: Option<Pose>,
    /// Seconds.
    pub time: Option<f64>,
}

/// How a file gives the intrinsics.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Lens {
    /// In pixels of a picture of the given size; without it, of the pictures themselves.
    Pixels(Intrinsics, Option<(u32, u32)>),
    /// Horizontal field of view in radians; square pixels, centred.
    AngleX(f64),
}

impl Lens {
    /// The intrinsics for pictures of a size.
    pub fn at(&self, (width, height): (u32, u32)) -> Intrinsics {
        match *self {
            Lens::Pixels(k, Some(size)) => k.resized(size, (width, height)),
            Lens::Pixels(k, None) => k,
            Lens::AngleX(angle) => {
                let f = f64::from(width) / (2.0 * tan(0.5 * angle));
                Intrinsics { fx: f, fy: f, cx: f64::from(width) / 2.0, cy: f64::from(height) / 2.0 }
            }
        }
    }
}

/// Tangent for 0 < x < pi/2 by Lambert's continued fraction: the same bits on every platform, which a
/// system library does not promise for numbers that reach the network.
fn tan(x: f64) -> f64 {
    let x2 = x * x;
    let tail = (1..=20).rev().fold(41.0, |tail, i| f64::from(2 * i - 1) - x2 / tail);
    x / tail
}

/// The contents of a file.
#[derive(Clone, Debug, PartialEq)]
pub struct Transforms {
    /// Frames in the order of the file.
    pub frames: Vec<TransformsFrame>,
    /// Intrinsics, if given.
    pub lens: Option<Lens>,
    /// What was understood but not used (lens distortion).
    pub notes: Vec<String>,
}

impl Transforms {
    /// Reads and checks a file; the pictures are not touched.
    pub fn read(path: &Path) -> Result<Transforms> {
        let at = escape_path(path);
        let bytes = read_regular(path, FILE_CAP)?
            .ok_or_else(|| Error::input(&at, format!("longer than {} MiB", FILE_CAP >> 20)))?;
        Transforms::parse(&bytes, &at)
    }

    /// Reads a file's text; `at` names it in messages.
    pub fn parse(bytes: &[u8], at: &str) -> Result<Transforms> {
        let json = crate::json::parse(bytes).map_err(|why| Error::input(at, why))?;
        let root = json.as_object().ok_or_else(|| Error::input(at, "is not a JSON object"))?;
        let list = root
            .get("frames")
            .and_then(Value::as_array)
            .ok_or_else(|| Error::input(at, "has no 'frames' list: not a transforms.json"))?;
        let mut notes = Vec::new();
        let mut lens = read_lens(root, at)?;
        let mut frames = Vec::with_capacity(list.len());
        for (i, entry) in list.iter().enumerate() {
            let at = format!("{at}: frame {i}");
            let entry = entry.as_object().ok_or_else(|| Error::input(&at, "is not an object"))?;
            let file = entry.get("file_path").and_then(Value::as_str);
            let file = file.ok_or_else(|| Error::input(&at, "has no 'file_path' text"))?;
            let own = read_lens(entry, &at)?;
            match (i, lens, own) {
                (_, _, None) => {}
                (0, _, Some(_)) => lens = own,
                (_, Some(first), Some(own)) if first == own => {}
                _ => return Err(Error::unsupported(&at, "has other intrinsics than frame 0; one camera per clip")),
            }
            frames.push(TransformsFrame {
                path: inside(file).ok_or_else(|| {
                    let why = format!("file_path '{}' leaves the clip's folder", escape(file.as_bytes()));
                    Error::input(&at, why)
                })?,
                pose: entry.get("transform_matrix").map(|m| read_matrix(m, &at)).transpose()?.map(|p| flip(&p)),
                time: number(entry, "time", &at)?,
            });
        }
        let bent = ["k1", "k2", "k3", "k4", "p1", "p2"];
        let bent: Vec<&str> =
            bent.into_iter().filter(|k| root.get(*k).and_then(Value::as_f64).is_some_and(|v| v != 0.0)).collect();
        if !bent.is_empty() {
            notes.push(format!("lens distortion ({}) is not modelled; undistort the pictures first", bent.join(", ")));
        }
        Ok(Transforms { frames, lens, notes })
    }
}

/// A relative path that climbs at most [`MAX_UP`] levels, all at its start.
fn inside(file: &str) -> Option<PathBuf> {
    if file.is_empty() || file.contains('\0') {
        return None;
    }
    let (mut ups, mut down) = (0, false);
    for part in Path::new(file).components() {
        match part {
            Component::ParentDir if !down && ups < MAX_UP => ups += 1,
            Component::Normal(_) => down = true,
            Component::CurDir => {}
            _ => return None,
        }
    }
    down.then(|| PathBuf::from(file))
}

/// A finite number, or nothing; another type is an error.
fn number(entry: &Map<String, Value>, key: &str, at: &str) -> Result<Option<f64>> {
    match entry.get(key) {
        None | Some(Value::Null) => Ok(None),
        Some(v) => match v.as_f64().filter(|f| f.is_finite()) {
            Some(f) => Ok(Some(f)),
            None => Err(Error::input(at, format!("'{key}' is not a number"))),
        },
    }
}

fn read_lens(entry: &Map<String, Value>, at: &str) -> Result<Option<Lens>> {
    let get = |key| number(entry, key, at);
    let side = |key: &str| -> Result<Option<u32>> {
        let Some(v) = number(entry, key, at)? else { return Ok(None) };
        if v < 1.0 || v > f64::from(Camera::MAX_SIDE) || v.fract() != 0.0 {
            return Err(Error::input(at, format!("'{key}' = {v} is not a picture size up to {}", Camera::MAX_SIDE)));
        }
        Ok(Some(v as u32))
    };
    let size = side("w")?.zip(side("h")?);
    if let Some(fx) = get("fl_x")? {
        let fy = get("fl_y")?.unwrap_or(fx);
        let centre = size.map(|(w, h)| (f64::from(w) / 2.0, f64::from(h) / 2.0));
        let need = |v: Option<f64>, other: Option<f64>, key: &str| {
            v.or(other).ok_or_else(|| Error::input(at, format!("has fl_x but neither '{key}' nor w and h")))
        };
        let cx = need(get("cx")?, centre.map(|c| c.0), "cx")?;
        let cy = need(get("cy")?, centre.map(|c| c.1), "cy")?;
        let k = Intrinsics { fx, fy, cx, cy };
        k.check(at)?;
        return Ok(Some(Lens::Pixels(k, size)));
    }
    let Some(angle) = get("camera_angle_x")? else { return Ok(None) };
    if !(angle > 0.01 && angle < 3.0) {
        return Err(Error::input(at, format!("camera_angle_x = {angle} must be between 0.01 and 3 radians")));
    }
    Ok(Some(Lens::AngleX(angle)))
}

/// A 4x4 camera-to-world matrix, rows first, axes as in the file.
pub(crate) fn read_matrix(value: &Value, at: &str) -> Result<Pose> {
    let bad = || Error::input(at, "camera-to-world matrix is not four rows of four numbers");
    let rows = value.as_array().filter(|r| r.len() == 4).ok_or_else(bad)?;
    let mut m = [[0.0; 4]; 4];
    for (row, out) in rows.iter().zip(&mut m) {
        let row = row.as_array().filter(|r| r.len() == 4).ok_or_else(bad)?;
        for (v, out) in row.iter().zip(out) {
            *out = v.as_f64().ok_or_else(bad)?;
        }
    }
    Pose::from_rows(&m, at)
}

/// A view to be written: the picture's name, its time and its camera at the picture's size.
#[derive(Clone, Debug, PartialEq)]
pub struct View {
    /// File name as it goes into the file.
    pub name: String,
    /// Seconds.
    pub time: f64,
    /// Size, intrinsics and pose (OpenCV axes).
    pub camera: Camera,
}

/// The text of a `transforms.json`: intrinsics once when all views share them, else per frame.
pub fn write(views: &[View]) -> String {
    let lens = |c: &Camera| {
        json!({
            "fl_x": c.k.fx, "fl_y": c.k.fy, "cx": c.k.cx, "cy": c.k.cy, "w": c.width, "h": c.height,
        })
    };
    let shared = views.first().filter(|f| {
        views
            .iter()
            .all(|v| (v.camera.width, v.camera.height, v.camera.k) == (f.camera.width, f.camera.height, f.camera.k))
    });
    let mut root = Map::new();
    root.insert("camera_model".into(), json!("OPENCV"));
    if let Some(Value::Object(l)) = shared.map(|f| lens(&f.camera)) {
        root.extend(l);
    }
    let frames = views.iter().map(|v| {
        let mut frame = Map::new();
        frame.insert("file_path".into(), json!(v.name));
        frame.insert("time".into(), json!(v.time));
        if shared.is_none()
            && let Value::Object(l) = lens(&v.camera)
        {
            frame.extend(l);
        }
        frame.insert("transform_matrix".into(), json!(flip(&v.camera.pose).to_rows()));
        Value::Object(frame)
    });
    root.insert("frames".into(), frames.collect());
    serde_json::to_string_pretty(&Value::Object(root)).expect("finite numbers and text are JSON") + "\n"
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_tangent_is_accurate_over_its_range() {
        for i in 1..1500 {
            let x = f64::from(i) * 1e-3;
            assert!((tan(x) / x.tan() - 1.0).abs() < 4e-15, "tan {x}");
        }
    }

    #[test]
    fn an_opengl_camera_looks_down_minus_z() {
        let text = r#"{"frames": [{"file_path": "a.png",
            "transform_matrix": [[1,0,0,5],[0,1,0,6],[0,0,1,7],[0,0,0,1]]}]}"#;
        let t = Transforms::parse(text.as_bytes(), "t").unwrap();
        let pose = t.frames[0].pose.unwrap();
        // Forward of the OpenCV camera is the file's -z; down is its -y.
        assert_eq!(pose.apply(DVec3::Z), DVec3::new(5.0, 6.0, 6.0));
        assert_eq!(pose.apply(DVec3::Y), DVec3::new(5.0, 5.0, 7.0));
        assert_eq!(flip(&flip(&pose)), pose);
    }

    #[test]
    fn paths_stay_near_the_file() {
        for good in ["a.png", "./images/a.png", "../images/a.png", "../../x/a.png", "a b/ü.png"] {
            assert!(inside(good).is_some(), "{good}");
        }
        for bad in ["", "/etc/passwd", "../../../a.png", "x/../../a.png", "..", "a\0b"] {
            assert!(inside(bad).is_none(), "{bad}");
        }
    }
}
