//! The native scene: a folder with `scene.ply` (Gaussians and their motion, see `ply.rs`) and
//! `scene.json` (schema `streetforward.scene/1`: cameras, times, sizes, rules, notes).
//!
//! `scene.json` is written last: a folder that has it is complete. Keys are only ever added to it, so
//! unknown ones are ignored.

use crate::atomic::{self, Overwrite};
use crate::camera_json::{number, read_camera, size, write_camera};
use crate::config::{Setting, Value as Config};
use crate::error::{Error, Result, escape, escape_path};
use crate::open::read_regular;
use crate::ply::{self, LoadReport};
use crate::scene::{Compose, Scene, SceneFrame, SplatSettings};
use serde_json::{Map, Value, json};
use std::path::Path;

/// Name and version of `scene.json`.
pub const SCHEMA: &str = "streetforward.scene/1";
/// Longest `scene.json`.
const FILE_CAP: u64 = 64 << 20;

/// An f32 as the shortest decimal that reads back to it.
fn tidy(v: f32) -> Value {
    json!(v.to_string().parse::<f64>().unwrap_or(f64::from(v)))
}

fn name(choice: &impl Setting) -> Value {
    match choice.to_value() {
        Config::Text(t) => json!(t),
        other => json!(format!("{other:?}")),
    }
}

fn to_json(scene: &Scene) -> Value {
    let frames: Vec<Value> = scene
        .frames
        .iter()
        .map(|f| {
            let mut entry = Map::from_iter([("name".to_owned(), json!(f.name)), ("time".to_owned(), json!(f.time))]);
            entry.extend(write_camera(&f.camera));
            let (w, h) = f.source_size;
            let k = f.camera.k.resized((f.camera.width, f.camera.height), f.source_size);
            let source = json!({"width": w, "height": h, "fx": k.fx, "fy": k.fy, "cx": k.cx, "cy": k.cy});
            entry.insert("source".into(), source);
            Value::Object(entry)
        })
        .collect();
    let (c, s) = (&scene.compose, &scene.splat);
    let moving = scene.dynamic.iter().filter(|&&p| p > c.tau).count();
    let notes: Vec<Value> = scene.notes.iter().map(|(k, v)| json!([k, v])).collect();
    json!({
        "schema": SCHEMA,
        "axes": "OpenCV camera (x right, y down, z forward), camera-to-world, world = first camera",
        "units": {"length": "scene units", "time": "s", "velocity": "scene units per s"},
        "counts": {"gaussians": scene.len(), "dynamic": moving, "frames": scene.frames.len()},
        "frames": frames,
        "compose": {
            "window": c.window, "own": name(&c.own), "extrapolate": name(&c.extrapolate), "split": name(&c.split),
            "tau": tidy(c.tau),
        },
        "splat": {"aa": s.aa, "a_max": tidy(s.a_max), "eps2d": tidy(s.eps2d), "near": tidy(s.near)},
        "notes": notes,
    })
}

fn object<'a>(root: &'a Map<String, Value>, key: &str, at: &str) -> Result<&'a Map<String, Value>> {
    root.get(key).and_then(Value::as_object).ok_or_else(|| Error::input(at, format!("has no '{key}' object")))
}

fn choice<T: Setting>(entry: &Map<String, Value>, key: &str, at: &str) -> Result<T> {
    let text = entry.get(key).and_then(Value::as_str).unwrap_or_default();
    T::from_value(&Config::Text(text.to_owned()))
        .ok_or_else(|| Error::input(at, format!("'{key}' = '{}' is not known", escape(text.as_bytes()))))
}

/// Everything but the Gaussians, and how many of them there must be.
fn from_json(bytes: &[u8], at: &str) -> Result<(Scene, usize)> {
    let json = crate::json::parse(bytes).map_err(|why| Error::input(at, why))?;
    let root = json.as_object().ok_or_else(|| Error::input(at, "is not a JSON object"))?;
    match root.get("schema").and_then(Value::as_str) {
        Some(SCHEMA) => {}
        Some(other) => {
            let why = format!("schema '{}'; '{SCHEMA}' is read", escape(other.as_bytes()));
            return Err(Error::unsupported(at, why));
        }
        None => return Err(Error::input(at, "has no 'schema': not a scene.json")),
    }
    let count = number(object(root, "counts", at)?, "gaussians", at)?;
    if count < 0.0 || count.fract() != 0.0 || count > f64::from(u32::MAX) {
        return Err(Error::input(at, format!("{count} is not a number of gaussians")));
    }
    let list = root.get("frames").and_then(Value::as_array);
    let list = list.ok_or_else(|| Error::input(at, "has no 'frames' list"))?;
    let mut frames: Vec<SceneFrame> = Vec::with_capacity(list.len());
    for (i, entry) in list.iter().enumerate() {
        let at = format!("{at}: frame {i}");
        let entry = entry.as_object().ok_or_else(|| Error::input(&at, "is not an object"))?;
        let time = number(entry, "time", &at)?;
        if time.abs() > 1e12 || frames.last().is_some_and(|f| f.time >= time) {
            return Err(Error::input(&at, format!("time {time} does not ascend, or is no time in seconds")));
        }
        let source_size = size(object(entry, "source", &at)?, &at)?;
        if source_size.0 == 0 || source_size.1 == 0 {
            return Err(Error::input(&at, "source picture without pixels"));
        }
        let name = entry.get("name").and_then(Value::as_str).unwrap_or_default().to_owned();
        frames.push(SceneFrame { time, camera: read_camera(entry, &at)?, source_size, name });
    }
    let c = object(root, "compose", at)?;
    let window = number(c, "window", at)?;
    let tau = number(c, "tau", at)?;
    if !(1.0..=1e6).contains(&window) || window.fract() != 0.0 || !(0.0..=1.0).contains(&tau) {
        return Err(Error::input(at, format!("compose: window {window} or tau {tau} is out of range")));
    }
    let s = object(root, "splat", at)?;
    let (a_max, eps2d, near) = (number(s, "a_max", at)?, number(s, "eps2d", at)?, number(s, "near", at)?);
    if !(a_max > 0.0 && a_max <= 1.0 && (0.0..=100.0).contains(&eps2d) && near > 0.0 && near < 1e6) {
        return Err(Error::input(at, format!("splat: a_max {a_max}, eps2d {eps2d} or near {near} is out of range")));
    }
    let aa =
        s.get("aa").and_then(Value::as_bool).ok_or_else(|| Error::input(at, "splat: 'aa' is not true or false"))?;
    let pair = |v: &Value| Some((v.get(0)?.as_str()?.to_owned(), v.get(1)?.as_str()?.to_owned()));
    let notes = root.get("notes").and_then(Value::as_array).map(|l| l.iter().filter_map(pair).collect());
    let scene = Scene {
        gaussians: Default::default(),
        v_fwd: Vec::new(),
        v_bwd: Vec::new(),
        dynamic: Vec::new(),
        source: Vec::new(),
        frames,
        compose: Compose {
            window: window as u32,
            own: choice(c, "own", at)?,
            extrapolate: choice(c, "extrapolate", at)?,
            split: choice(c, "split", at)?,
            tau: tau as f32,
        },
        splat: SplatSettings { aa, a_max: a_max as f32, eps2d: eps2d as f32, near: near as f32 },
        notes: notes.unwrap_or_default(),
    };
    Ok((scene, count as usize))
}

impl Scene {
    /// Writes the scene's two files into `folder`, which is made if it is absent. Values that are not
    /// finite are [`Error::Integrity`].
    pub fn save(&self, folder: &Path, overwrite: Overwrite) -> Result<()> {
        let n = self.len();
        for (what, len) in [
            ("scales", self.gaussians.scale.len()),
            ("rotations", self.gaussians.quat.len()),
            ("opacities", self.gaussians.opacity.len()),
            ("colours", self.gaussians.colour.len()),
            ("forward velocities", self.v_fwd.len()),
            ("backward velocities", self.v_bwd.len()),
            ("probabilities", self.dynamic.len()),
            ("sources", self.source.len()),
        ] {
            assert_eq!(len, n, "{len} {what} for {n} means");
        }
        std::fs::create_dir_all(folder).map_err(|e| Error::io(folder, "create", &e))?;
        let json = folder.join("scene.json");
        if overwrite == Overwrite::No && json.exists() {
            let e = std::io::Error::new(std::io::ErrorKind::AlreadyExists, "it exists; pass --force to replace it");
            return Err(Error::io(&json, "write", &e));
        }
        ply::write_scene(self, &folder.join("scene.ply"), overwrite)?;
        let text = serde_json::to_string_pretty(&to_json(self)).expect("numbers and text are JSON") + "\n";
        atomic::write(&json, text.as_bytes(), overwrite)
    }

    /// Reads a scene's folder, or a PLY file of splats as a scene that stands still and has no cameras.
    ///
    /// Unusable Gaussians are dropped and counted; a file that contradicts itself is refused.
    pub fn load(path: &Path) -> Result<(Scene, LoadReport)> {
        let folder = path.is_dir();
        let (json, splats) =
            (path.join("scene.json"), if folder { path.join("scene.ply") } else { path.to_path_buf() });
        let (mut scene, count) = if folder && json.exists() {
            let at = escape_path(&json);
            let bytes = read_regular(&json, FILE_CAP)?
                .ok_or_else(|| Error::input(&at, format!("longer than {} MiB", FILE_CAP >> 20)))?;
            let (scene, count) = from_json(&bytes, &at)?;
            (scene, Some(count))
        } else {
            let empty = Scene {
                gaussians: Default::default(),
                v_fwd: Vec::new(),
                v_bwd: Vec::new(),
                dynamic: Vec::new(),
                source: Vec::new(),
                frames: Vec::new(),
                compose: Compose::default(),
                splat: SplatSettings::default(),
                notes: Vec::new(),
            };
            (empty, None)
        };
        let (read, mut report) = ply::read(&splats, count.map(|_| scene.frames.len()))?;
        if let Some(count) = count
            && count != report.total
        {
            let why = format!("holds {} gaussians, but scene.json says {count}", report.total);
            return Err(Error::input(escape_path(&splats), why));
        }
        if count.is_none() {
            report.notes.push("no scene.json: no cameras, and nothing moves".into());
        }
        scene.gaussians = read.gaussians;
        (scene.v_fwd, scene.v_bwd) = (read.v_fwd, read.v_bwd);
        (scene.dynamic, scene.source) = (read.dynamic, read.source);
        if count.is_none() {
            scene.dynamic.iter_mut().for_each(|p| *p = 0.0);
        }
        Ok((scene, report))
    }
}
