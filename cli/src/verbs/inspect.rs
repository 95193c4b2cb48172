//! `inspect`: what is in a checkpoint, weight blob, splat file or scene folder.
//!
//! Reads headers only, unless `--stats` asks for the values too.

use crate::args::{glob, path_json};
use crate::output::{Console, human_bytes, human_count};
use serde_json::{Map, Value, json};
use sf_formats::blob::{Blob, Dtype, LoadMode, Verify};
use sf_formats::checkpoint::{self, Checkpoint};
use sf_formats::config;
use sf_formats::digest::hex;
use sf_formats::error::{escape, escape_path};
use sf_formats::sniff::FileKind;
use sf_formats::{Error, ModelConfig, Result, Scene};
use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

/// What to look into.
#[derive(clap::Args)]
pub(crate) struct Args {
    /// Weight blob, checkpoint (file, folder or shard index), .ply file or scene folder
    #[arg(value_name = "PATH")]
    path: PathBuf,
    /// List the tensors whose name matches (`*` any text, `?` any character)
    #[arg(long, value_name = "GLOB")]
    tensors: Option<String>,
    /// Read the values: smallest, largest, mean, deviation, zeros, not finite
    #[arg(long)]
    stats: bool,
}

/// Name and value of one line of the report's head.
type Row = (&'static str, String);

/// What every kind of file reduces to.
struct Contents {
    kind: &'static str,
    /// Rows of the text report.
    head: Vec<Row>,
    /// Further JSON keys.
    json: Map<String, Value>,
    tensors: Vec<Tensor>,
}

/// One tensor or per-splat property.
struct Tensor {
    name: String,
    dtype: &'static str,
    shape: Vec<usize>,
    stats: Option<Stats>,
}

impl Tensor {
    fn count(&self) -> usize {
        self.shape.iter().product()
    }

    fn shape_text(&self) -> String {
        let dims: Vec<String> = self.shape.iter().map(usize::to_string).collect();
        if dims.is_empty() { "scalar".into() } else { dims.join("x") }
    }
}

/// Statistics of the finite values, in f64.
#[derive(Clone, Copy, Debug, PartialEq)]
struct Stats {
    min: f64,
    max: f64,
    mean: f64,
    std: f64,
    zeros: usize,
    not_finite: usize,
}

impl Stats {
    /// Of values; an empty or wholly non-finite list has zero moments.
    fn of(values: impl Iterator<Item = f32> + Clone) -> Stats {
        let finite = || values.clone().filter(|v| v.is_finite()).map(f64::from);
        let n = finite().count();
        let mean = finite().sum::<f64>() / n.max(1) as f64;
        // Second pass about the mean: the one-pass formula cancels.
        let variance = finite().map(|v| (v - mean) * (v - mean)).sum::<f64>() / n.max(1) as f64;
        let (min, max) = finite().fold((f64::INFINITY, f64::NEG_INFINITY), |(a, b), v| (a.min(v), b.max(v)));
        Stats {
            min: if n == 0 { 0.0 } else { min },
            max: if n == 0 { 0.0 } else { max },
            mean,
            std: variance.sqrt(),
            zeros: finite().filter(|&v| v == 0.0).count(),
            not_finite: values.filter(|v| !v.is_finite()).count(),
        }
    }

    fn json(&self) -> Value {
        json!({
            "min": self.min, "max": self.max, "mean": self.mean, "std": self.std,
            "zeros": self.zeros, "not_finite": self.not_finite,
        })
    }
}

/// Prints the report.
pub(crate) fn run(args: &Args, console: &Console) -> Result<()> {
    let contents = open(&args.path, args.stats)?;
    let listed: Vec<&Tensor> = match (&args.tensors, args.stats) {
        (Some(pattern), _) => contents.tensors.iter().filter(|t| glob(pattern, &t.name)).collect(),
        (None, true) => contents.tensors.iter().collect(),
        (None, false) => Vec::new(),
    };
    if let Some(pattern) = &args.tensors
        && listed.is_empty()
    {
        let why = format!("no tensor matches '{}' among {}", escape(pattern.as_bytes()), contents.tensors.len());
        return Err(Error::usage(why));
    }
    console.report(&to_json(&args.path, &contents, &listed), &to_text(&args.path, &contents, &listed))
}

/// Recognises the file or folder and reads its contents; values only with `stats`.
fn open(path: &Path, stats: bool) -> Result<Contents> {
    let meta = std::fs::metadata(path).map_err(|e| Error::io(path, "open", &e))?;
    if meta.is_dir() && path.join("scene.json").exists() {
        return of_scene("scene", path, stats);
    }
    if meta.is_dir() {
        return of_checkpoint(&*checkpoint::open(&[path.to_path_buf()])?, stats);
    }
    match FileKind::of_file(path)? {
        FileKind::Empty => Err(Error::model(escape_path(path), "file is empty")),
        FileKind::Safetensors | FileKind::Zip | FileKind::Pickle | FileKind::Tar | FileKind::Json => {
            of_checkpoint(&*checkpoint::open(&[path.to_path_buf()])?, stats)
        }
        FileKind::Blob => of_blob(path, stats),
        FileKind::Ply => of_scene("splats", path, stats),
        kind => Err(Error::model(
            escape_path(path),
            format!("{}; inspect reads .sfw, .safetensors, .pt, .ply and scene folders", kind.advice()),
        )),
    }
}

fn of_checkpoint(checkpoint: &dyn Checkpoint, stats: bool) -> Result<Contents> {
    let mut values = Vec::new();
    let mut tensors = Vec::new();
    for (i, t) in checkpoint.tensors().iter().enumerate() {
        // Integer tensors are listed, never read.
        let readable = stats && !matches!(t.dtype, checkpoint::SourceDtype::Int(_));
        if readable {
            checkpoint.read_f32(i, &mut values)?;
        }
        tensors.push(Tensor {
            name: t.name.clone(),
            dtype: t.dtype.name(),
            shape: t.shape.clone(),
            stats: readable.then(|| Stats::of(values.iter().copied())),
        });
    }
    let mut head = vec![("source", checkpoint.describe())];
    let mut extra = Map::new();
    if let Some(text) = checkpoint.metadata("streetforward.config") {
        let config = ModelConfig::from_json(text, "streetforward.config")?;
        head.push(("network", network(&config)));
        extra.insert("config".into(), config.to_json());
    }
    extra.insert("source".into(), checkpoint.describe().into());
    Ok(Contents { kind: "checkpoint", head, json: extra, tensors })
}

fn of_blob(path: &Path, stats: bool) -> Result<Contents> {
    let blob = Blob::open(path, LoadMode::Map, Verify::Structure)?;
    let mut values = Vec::new();
    let mut tensors = Vec::new();
    for (i, t) in blob.tensors().iter().enumerate() {
        if stats {
            blob.read_f32(i, &mut values);
        }
        let dtype = match t.dtype {
            Dtype::F32 => "F32",
            Dtype::F16 => "F16",
            Dtype::Int8 => "INT8",
        };
        tensors.push(Tensor {
            name: t.spec.name.clone(),
            dtype,
            shape: t.spec.shape.clone(),
            stats: stats.then(|| Stats::of(values.iter().copied())),
        });
    }
    let mut head = vec![("digest", hex(blob.digest())), ("network", network(blob.config()))];
    let mut meta = Map::new();
    for (key, value) in blob.meta().iter() {
        head.push(("", format!("{key} = {}", plain(value))));
        meta.insert(key.to_string(), plain(value));
    }
    let mut json = Map::new();
    json.insert("digest".into(), hex(blob.digest()).into());
    json.insert("config".into(), blob.config().to_json());
    json.insert("meta".into(), meta.into());
    Ok(Contents { kind: "blob", head, json, tensors })
}

fn of_scene(kind: &'static str, path: &Path, stats: bool) -> Result<Contents> {
    let (scene, report) = Scene::load(path)?;
    let g = &scene.gaussians;
    let fields: [(&str, &[f32], usize); 8] = [
        ("mean", g.mean.as_flattened(), 3),
        ("scale", g.scale.as_flattened(), 3),
        ("quaternion", g.quat.as_flattened(), 4),
        ("opacity", &g.opacity, 1),
        ("colour", g.colour.as_flattened(), 3),
        ("velocity_forward", scene.v_fwd.as_flattened(), 3),
        ("velocity_backward", scene.v_bwd.as_flattened(), 3),
        ("dynamic", &scene.dynamic, 1),
    ];
    let tensors = fields.iter().map(|&(name, values, width)| Tensor {
        name: name.into(),
        dtype: "F32",
        shape: if width == 1 { vec![scene.len()] } else { vec![scene.len(), width] },
        stats: stats.then(|| Stats::of(values.iter().copied())),
    });
    let moving = scene.dynamic.iter().filter(|&&p| p > scene.compose.tau).count();
    let (first, last) = scene.time_range();
    let mut head = vec![
        ("gaussians", format!("{}, {} of them moving", human_count(scene.len()), human_count(moving))),
        ("frames", format!("{} from {first} to {last} s", scene.frames.len())),
    ];
    if let Some(f) = scene.frames.first() {
        let ((w, h), (sw, sh)) = ((f.camera.width, f.camera.height), f.source_size);
        head.push(("cameras", format!("{w}x{h}, source pictures {sw}x{sh}")));
    }
    if report.dropped() > 0 {
        head.push(("dropped", format!("{} of {} unusable", report.dropped(), report.total)));
    }
    head.extend(report.notes.iter().map(|n| ("note", n.clone())));
    head.extend(scene.notes.iter().map(|(k, v)| ("", format!("{k} = {}", Value::from(v.as_str())))));
    let json = json!({
        "gaussians": scene.len(),
        "moving": moving,
        "frames": scene.frames.len(),
        "first_time_s": first,
        "last_time_s": last,
        "dropped": report.dropped(),
        "degraded": report.degraded,
        "load_notes": report.notes,
        "notes": scene.notes.iter().map(|(k, v)| (k.clone(), v.clone().into())).collect::<Map<String, Value>>(),
    });
    let Value::Object(json) = json else { unreachable!("made as an object") };
    Ok(Contents { kind, head, json, tensors: tensors.collect() })
}

/// A metadata value as JSON.
fn plain(value: &config::Value) -> Value {
    match value {
        config::Value::Int(i) => (*i).into(),
        config::Value::Float(f) => (*f).into(),
        config::Value::Bool(b) => (*b).into(),
        config::Value::Text(t) => t.as_str().into(),
        config::Value::Ints(l) => l.as_slice().into(),
        config::Value::Floats(l) => l.as_slice().into(),
    }
}

/// One line that tells a network's size.
fn network(c: &ModelConfig) -> String {
    let motion = if c.has_motion() { format!("{} causal layers", c.causal_depth) } else { "no motion".into() };
    format!(
        "encoder {}x{}, alternating attention {}x{}, {motion}, patch {}",
        c.encoder.depth, c.encoder.dim, c.aa.depth, c.aa.dim, c.patch
    )
}

/// Tensors, values and the first name part they share, in the order of first appearance.
fn groups(tensors: &[Tensor]) -> Vec<(String, usize, usize)> {
    let mut place: BTreeMap<&str, usize> = BTreeMap::new();
    let mut list: Vec<(String, usize, usize)> = Vec::new();
    for t in tensors {
        let group = t.name.split('.').next().unwrap_or_default();
        let i = *place.entry(group).or_insert(list.len());
        if i == list.len() {
            list.push((group.to_string(), 0, 0));
        }
        list[i].1 += 1;
        list[i].2 += t.count();
    }
    list
}

fn to_json(path: &Path, contents: &Contents, listed: &[&Tensor]) -> Value {
    let tensor = |t: &&Tensor| {
        let mut row = json!({ "name": t.name, "dtype": t.dtype, "shape": t.shape });
        if let Some(stats) = &t.stats {
            row["stats"] = stats.json();
        }
        row
    };
    let group =
        |(name, tensors, values): (String, usize, usize)| json!({ "name": name, "tensors": tensors, "values": values });
    let mut report = json!({
        "schema": "streetforward.inspect/1",
        "path": path_json(path),
        "kind": contents.kind,
        "tensor_count": contents.tensors.len(),
        "values": contents.tensors.iter().map(Tensor::count).sum::<usize>(),
        "groups": groups(&contents.tensors).into_iter().map(group).collect::<Value>(),
    });
    let map = report.as_object_mut().expect("made above as an object");
    map.extend(contents.json.clone());
    if !listed.is_empty() {
        map.insert("tensors".into(), listed.iter().map(tensor).collect());
    }
    report
}

fn to_text(path: &Path, contents: &Contents, listed: &[&Tensor]) -> String {
    let mut text = format!("{:<10} {}\n{:<10} {}\n", "file", escape_path(path), "kind", contents.kind);
    if let Ok(meta) = std::fs::metadata(path)
        && meta.is_file()
    {
        text.push_str(&format!("{:<10} {}\n", "size", human_bytes(meta.len())));
    }
    for (name, value) in &contents.head {
        text.push_str(&format!("{name:<10} {value}\n"));
    }
    let values: usize = contents.tensors.iter().map(Tensor::count).sum();
    text.push_str(&format!("{:<10} {} in {} tensors\n", "values", human_count(values), contents.tensors.len()));
    if listed.is_empty() {
        for (name, tensors, values) in groups(&contents.tensors) {
            let name = escape(name.as_bytes());
            text.push_str(&format!("  {name:<24} {tensors:>5} tensors {:>15}\n", human_count(values)));
        }
        return text;
    }
    let width = listed.iter().map(|t| t.name.len()).max().unwrap_or(0).min(60);
    for t in listed {
        let name = escape(t.name.as_bytes());
        text.push_str(&format!("  {name:<width$}  {:<4}  {:<16}", t.dtype, t.shape_text()));
        if let Some(s) = &t.stats {
            text.push_str(&format!(
                "  min {:>11.4e}  max {:>11.4e}  mean {:>11.4e}  std {:>10.4e}  zeros {}  not finite {}",
                s.min, s.max, s.mean, s.std, s.zeros, s.not_finite
            ));
        }
        text.push('\n');
    }
    text
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn statistics_are_of_the_finite_values() {
        let s = Stats::of([1.0, -3.0, 0.0, f32::NAN, 2.0, f32::INFINITY].into_iter());
        assert_eq!((s.min, s.max, s.mean, s.zeros, s.not_finite), (-3.0, 2.0, 0.0, 1, 2));
        assert!((s.std - 3.5f64.sqrt()).abs() < 1e-12);
        let s = Stats::of([f32::NAN].into_iter());
        assert_eq!((s.min, s.max, s.mean, s.std, s.not_finite), (0.0, 0.0, 0.0, 0.0, 1));
    }

    #[test]
    fn groups_keep_the_files_order() {
        let tensor = |name: &str, n| Tensor { name: name.into(), dtype: "F32", shape: vec![n, 2], stats: None };
        let list = [tensor("z.a", 1), tensor("a.b.c", 2), tensor("z.b", 3)];
        assert_eq!(groups(&list), [("z".to_string(), 2, 8), ("a".to_string(), 1, 4)]);
    }
}
