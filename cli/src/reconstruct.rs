//! Clip and model to network output: what `run`, `eval` and `demo` share.

use crate::args::{EngineArgs, Precision, Size};
use crate::network;
use crate::output::Console;
use crate::signals;
use serde_json::{Value, json};
use sf_formats::blob::{Blob, LoadMode, Verify};
use sf_formats::clip::Clip;
use sf_formats::digest::{Digest, hex, sha256};
use sf_formats::error::escape_path;
use sf_formats::sniff::FileKind;
use sf_formats::{Error, Intrinsics, ModelConfig, Result, checkpoint};
use sf_quant::{Options as ConvertOptions, Outputs, Seeded, convert, convert_to_bytes};
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::time::Instant;
use streetforward::preprocess::{DEFAULT_PIXELS, fit_size, prepare};
use streetforward::{ClipShape, FrameSource, Model, Options, Output, Prepared, Session, SourceFrame};

/// Seed of the network that stands in where no model is given.
const RANDOM_SEED: u64 = 1;

/// A model and where it came from.
pub(crate) struct Loaded {
    /// The model.
    pub(crate) model: Arc<Model>,
    /// File, or none for the random network.
    path: Option<PathBuf>,
    /// Milliseconds to open, convert and verify.
    load_ms: f64,
}

impl Loaded {
    /// For reports.
    pub(crate) fn json(&self) -> Value {
        json!({
            "path": self.path.as_ref().map(|p| p.to_string_lossy().into_owned()),
            "random_weights": self.path.is_none(),
            "digest": hex(self.model.blob().digest()),
            "parameters": self.model.parameters(),
            "weights_bytes": self.model.blob().file_bytes(),
            "load_ms": self.load_ms,
        })
    }
}

/// Opens a blob; converts a checkpoint into a temporary blob first; without a path makes the random nano
/// network in memory and says so.
pub(crate) fn load(path: Option<&Path>, engine: &EngineArgs, to: Precision, console: &Console) -> Result<Loaded> {
    let start = Instant::now();
    let blob = match path {
        None => {
            console.warn("no model given: a nano network with random weights runs, its result is noise");
            let seeded = Seeded::new(&ModelConfig::nano(), RANDOM_SEED, Outputs::Random)?;
            Blob::from_bytes(&convert_to_bytes(&seeded, &ConvertOptions::to(to.dtype()))?)?
        }
        Some(path) if is_checkpoint(path)? => from_checkpoint(path, to, console)?,
        Some(path) => Blob::open(path, engine.load.mode(), Verify::Digests)?,
    };
    let model = Arc::new(Model::from_blob(blob)?);
    Ok(Loaded { model, path: path.map(Path::to_path_buf), load_ms: start.elapsed().as_secs_f64() * 1e3 })
}

/// Whether a path holds a checkpoint; everything else is left to the blob reader and its messages.
fn is_checkpoint(path: &Path) -> Result<bool> {
    let meta = std::fs::metadata(path).map_err(|e| Error::io(path, "open", &e))?;
    if !meta.is_file() {
        return Ok(meta.is_dir());
    }
    let kinds = [FileKind::Safetensors, FileKind::Zip, FileKind::Pickle, FileKind::Tar, FileKind::Json];
    Ok(kinds.contains(&FileKind::of_file(path)?))
}

/// Converts a checkpoint into a temporary file that is gone when the blob is open.
fn from_checkpoint(path: &Path, to: Precision, console: &Console) -> Result<Blob> {
    let shown = escape_path(path);
    console.note(format!("{shown} is a checkpoint: converting it to {} for this run", to.dtype().name()));
    let source = checkpoint::open(&[path.to_path_buf()])?;
    let folder = scratch_folder()?;
    let file = folder.0.join("model.sfw");
    let progress = console.progress(source.tensors().len() as u64, "convert");
    let watched = network::Watched::new(&*source, &progress);
    convert(&watched, &file, sf_formats::atomic::Overwrite::No, &ConvertOptions::to(to.dtype()))?;
    drop(progress);
    // The mapping keeps the unlinked file; nobody else can reach it any more.
    Blob::open(&file, LoadMode::Map, Verify::Structure)
}

/// A private temporary folder, deleted when dropped.
struct Scratch(PathBuf);

fn scratch_folder() -> Result<Scratch> {
    use std::os::unix::fs::DirBuilderExt;
    let pid = std::process::id();
    // The name need not be secret: making the folder fails when somebody else made it first.
    for attempt in 0..100 {
        let path = std::env::temp_dir().join(format!("streetforward.{pid}.{attempt}"));
        match std::fs::DirBuilder::new().mode(0o700).create(&path) {
            Ok(()) => {
                signals::guard_stage(&path);
                return Ok(Scratch(path));
            }
            Err(e) if e.kind() == std::io::ErrorKind::AlreadyExists => {}
            Err(e) => return Err(Error::io(&path, "create", &e)),
        }
    }
    Err(Error::resource("temporary folder", "a hundred names are taken: clean the system's temporary folder"))
}

impl Drop for Scratch {
    fn drop(&mut self) {
        let _ = std::fs::remove_dir_all(&self.0);
        signals::release_stage(&self.0);
    }
}

/// Size at which a network sees a clip: as asked, or that of its pictures in whole patches, shrunk to the
/// pixels its position table was made for (and Pi3's limit).
pub(crate) fn network_size(config: &ModelConfig, clip: &Clip, asked: Option<Size>) -> (u32, u32) {
    if let Some(size) = asked {
        return (size.width, size.height);
    }
    let (w, h) = clip.frames[0].image.size();
    let table = u64::from(config.pos_grid * config.patch).pow(2);
    fit_size(w, h, config.patch, table.min(DEFAULT_PIXELS).min(u64::from(w) * u64::from(h)))
}

/// A clip at the network's size. `k`: intrinsics at the size of the first picture, which override the
/// predicted ones.
pub(crate) fn prepare_clip(
    config: &ModelConfig,
    clip: &Clip,
    k: Option<Intrinsics>,
    size: (u32, u32),
) -> Result<Prepared> {
    let frames: Vec<SourceFrame> = clip
        .frames
        .iter()
        .map(|f| SourceFrame { name: &f.name, width: f.image.width, height: f.image.height, rgb: &f.image.data })
        .collect();
    prepare(config, &frames, &clip.times(), k, size)
}

/// A session for clips of one shape.
pub(crate) fn session(loaded: &Loaded, shape: ClipShape, engine: &EngineArgs) -> Result<Session> {
    let mut options = Options { threads: crate::args::threads(engine.threads), isa: engine.isa, ..Options::default() };
    if let Some(bytes) = engine.max_mem {
        options.max_bytes = bytes;
    }
    Session::new(Arc::clone(&loaded.model), shape, options)
}

/// Names and sizes of a clip's pictures, for a scene.
pub(crate) fn sources(clip: &Clip) -> Vec<FrameSource> {
    clip.frames.iter().map(|f| FrameSource { name: f.name.clone(), size: f.image.size() }).collect()
}

/// What a session is and did, for reports.
pub(crate) fn session_json(session: &Session) -> Value {
    let stages = session.stage_times().map(|s| json!({ "name": s.name, "ms": s.time.as_secs_f64() * 1e3 }));
    json!({
        "threads": session.threads(),
        "isa": session.kernels().isa.name(),
        "arena_bytes": session.plan().arena_bytes(),
        "output_bytes": session.plan().output_bytes(),
        "stages": stages.collect::<Value>(),
    })
}

/// SHA-256 over everything a run predicts: equal on every CPU and for any number of threads.
pub(crate) fn output_digest(out: &Output) -> Digest {
    let mut all = Vec::new();
    let mut add = |values: &mut dyn Iterator<Item = f32>| {
        let bytes: Vec<u8> = values.flat_map(f32::to_le_bytes).collect();
        all.extend(sha256(&bytes));
    };
    for list in [&out.points, &out.mean, &out.scale, &out.colour, &out.v_fwd, &out.v_bwd] {
        add(&mut list.as_flattened().iter().copied());
    }
    add(&mut out.quat.as_flattened().iter().copied());
    for list in [&out.depth, &out.conf, &out.opacity, &out.dynamic] {
        add(&mut list.iter().copied());
    }
    let cameras = (0..out.poses.len()).flat_map(|f| {
        let k = out.k[f];
        let rows = out.poses[f].to_rows();
        [k.fx, k.fy, k.cx, k.cy].into_iter().chain(rows.into_iter().flatten())
    });
    all.extend(sha256(&cameras.flat_map(f64::to_le_bytes).collect::<Vec<u8>>()));
    sha256(&all)
}

/// Most memory this process has held, bytes; none where the system does not tell.
pub(crate) fn peak_rss_bytes() -> Option<u64> {
    let status = std::fs::read_to_string("/proc/self/status").ok()?;
    let line = status.lines().find_map(|l| l.strip_prefix("VmHWM:"))?;
    line.split_whitespace().next()?.parse::<u64>().ok()?.checked_mul(1024)
}
