//! Cameras as JSON: a path to render along.
//!
//! ```json
//! {"schema": "streetforward.cameras/1", "cameras": [
//!   {"time": 0.5, "width": 252, "height": 168, "fx": 210.0, "fy": 210.0, "cx": 126.0, "cy": 84.0,
//!    "camera_to_world": [[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]}]}
//! ```
//!
//! OpenCV axes, seconds, scene units. Read as well: the bare list; `K` as three rows of three instead of
//! `fx fy cx cy`; `fov_deg`, the horizontal field of view, for square pixels and a centred lens.

use crate::atomic::{self, Overwrite};
use crate::camera::{Camera, Intrinsics};
use crate::error::{Error, Result, escape, escape_path};
use crate::open::read_regular;
use crate::transforms::{Lens, read_matrix};
use serde_json::{Map, Value, json};
use std::path::Path;

/// Name and version of the format.
pub const SCHEMA: &str = "streetforward.cameras/1";
/// Longest file, and most cameras in it.
const FILE_CAP: u64 = 64 << 20;
/// Most cameras of a path.
pub const MAX_CAMERAS: usize = 100_000;

/// A view at a time.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct TimedCamera {
    /// Seconds.
    pub time: f64,
    /// Size, intrinsics and pose.
    pub camera: Camera,
}

/// Reads a camera path.
pub fn read(path: &Path) -> Result<Vec<TimedCamera>> {
    let at = escape_path(path);
    let bytes = read_regular(path, FILE_CAP)?
        .ok_or_else(|| Error::input(&at, format!("longer than {} MiB", FILE_CAP >> 20)))?;
    parse(&bytes, &at)
}

/// Reads a camera path from memory; `at` names it in messages.
pub fn parse(bytes: &[u8], at: &str) -> Result<Vec<TimedCamera>> {
    let json = crate::json::parse(bytes).map_err(|why| Error::input(at, why))?;
    if let Some(schema) = json.get("schema")
        && schema.as_str() != Some(SCHEMA)
    {
        let why = format!("schema '{}'; '{SCHEMA}' is read", escape(schema.to_string().as_bytes()));
        return Err(Error::unsupported(at, why));
    }
    let list = json.as_array().or_else(|| json.get("cameras").and_then(Value::as_array));
    let list = list.ok_or_else(|| Error::input(at, "is neither a list of cameras nor an object with 'cameras'"))?;
    if list.is_empty() {
        return Err(Error::input(at, "holds no camera"));
    }
    if list.len() > MAX_CAMERAS {
        return Err(Error::resource(at, format!("{} cameras; the limit is {MAX_CAMERAS}", list.len())));
    }
    list.iter()
        .enumerate()
        .map(|(i, entry)| {
            let at = format!("{at}: camera {i}");
            let entry = entry.as_object().ok_or_else(|| Error::input(&at, "is not an object"))?;
            let time = number(entry, "time", &at)?;
            if time.abs() > 1e12 {
                return Err(Error::input(&at, format!("time {time} is not a time in seconds")));
            }
            Ok(TimedCamera { time, camera: read_camera(entry, &at)? })
        })
        .collect()
}

pub(crate) fn number(entry: &Map<String, Value>, key: &str, at: &str) -> Result<f64> {
    let value = entry.get(key).ok_or_else(|| Error::input(at, format!("has no '{key}'")))?;
    value.as_f64().filter(|v| v.is_finite()).ok_or_else(|| Error::input(at, format!("'{key}' is not a number")))
}

pub(crate) fn size(entry: &Map<String, Value>, at: &str) -> Result<(u32, u32)> {
    let side = |key: &str| -> Result<u32> {
        let v = number(entry, key, at)?;
        if v < 0.0 || v.fract() != 0.0 || v > f64::from(u32::MAX) {
            return Err(Error::input(at, format!("'{key}' = {v} is not a size in pixels")));
        }
        Ok(v as u32)
    };
    Ok((side("width")?, side("height")?))
}

/// A camera of `width height`, one form of intrinsics and `camera_to_world`, checked.
pub(crate) fn read_camera(entry: &Map<String, Value>, at: &str) -> Result<Camera> {
    let (width, height) = size(entry, at)?;
    let k = if let Some(rows) = entry.get("K") {
        let bad = || Error::input(at, "'K' is not [[fx, 0, cx], [0, fy, cy], [0, 0, 1]]");
        let mut m = [[0.0; 3]; 3];
        let rows = rows.as_array().filter(|r| r.len() == 3).ok_or_else(bad)?;
        for (row, out) in rows.iter().zip(&mut m) {
            let row = row.as_array().filter(|r| r.len() == 3).ok_or_else(bad)?;
            for (v, out) in row.iter().zip(out) {
                *out = v.as_f64().ok_or_else(bad)?;
            }
        }
        if m[0][1] != 0.0 || m[1][0] != 0.0 || m[2] != [0.0, 0.0, 1.0] {
            return Err(bad());
        }
        Intrinsics { fx: m[0][0], fy: m[1][1], cx: m[0][2], cy: m[1][2] }
    } else if entry.contains_key("fov_deg") {
        let fov = number(entry, "fov_deg", at)?;
        if !(fov > 0.5 && fov < 170.0) {
            return Err(Error::input(at, format!("fov_deg = {fov} must be between 0.5 and 170 degrees")));
        }
        Lens::AngleX(fov.to_radians()).at((width, height))
    } else {
        let get = |key| number(entry, key, at);
        Intrinsics { fx: get("fx")?, fy: get("fy")?, cx: get("cx")?, cy: get("cy")? }
    };
    let pose = entry.get("camera_to_world").ok_or_else(|| Error::input(at, "has no 'camera_to_world'"))?;
    let camera = Camera { width, height, k, pose: read_matrix(pose, at)? };
    camera.check(at)?;
    Ok(camera)
}

/// A camera as the members of a JSON object.
pub(crate) fn write_camera(c: &Camera) -> Map<String, Value> {
    let mut entry = Map::new();
    for (key, value) in [
        ("width", json!(c.width)),
        ("height", json!(c.height)),
        ("fx", json!(c.k.fx)),
        ("fy", json!(c.k.fy)),
        ("cx", json!(c.k.cx)),
        ("cy", json!(c.k.cy)),
        ("camera_to_world", json!(c.pose.to_rows())),
    ] {
        entry.insert(key.into(), value);
    }
    entry
}

/// Writes a camera path that [`read`] reads back exactly.
pub fn write(path: &Path, cameras: &[TimedCamera], overwrite: Overwrite) -> Result<()> {
    let list: Vec<Value> = cameras
        .iter()
        .map(|c| {
            let mut entry = Map::from_iter([("time".to_owned(), json!(c.time))]);
            entry.extend(write_camera(&c.camera));
            Value::Object(entry)
        })
        .collect();
    let text = serde_json::to_string_pretty(&json!({"schema": SCHEMA, "cameras": list}));
    atomic::write(path, (text.expect("numbers and text are JSON") + "\n").as_bytes(), overwrite)
}
