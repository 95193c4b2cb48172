//! [`Loaded`]: the model of a verb: a blob, a checkpoint converted for this run, the trained network inside the
//! binary, or random weights.

use crate::args::{EngineArgs, Precision};
use crate::network::Watched;
use crate::output::Console;
use crate::signals;
use clap::ValueEnum;
use serde_json::{Value, json};
use sf_formats::atomic::Overwrite;
use sf_formats::blob::{Blob, LoadMode, Verify};
use sf_formats::checkpoint::Checkpoint;
use sf_formats::digest::hex;
use sf_formats::error::escape_path;
use sf_formats::sniff::FileKind;
use sf_formats::{Error, ModelConfig, Result, checkpoint};
use sf_quant::{Options, Outputs, Seeded, convert, convert_to_bytes};
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::time::Instant;
use streetforward::Model;

/// Seed of the network that stands in where no model is given and none is built in.
const RANDOM_SEED: u64 = 1;

/// The trained nano network, where it was built in.
#[cfg(has_model)]
const EMBEDDED: Option<&[u8]> = Some(include_bytes!("../../models/nano/nano.sfw"));
#[cfg(not(has_model))]
const EMBEDDED: Option<&[u8]> = None;

/// Where weights came from.
#[derive(Clone, Debug, PartialEq, Eq)]
enum Origin {
    /// A file or folder of the user's.
    Path(PathBuf),
    /// The binary.
    Embedded,
    /// A seed.
    Random,
}

/// A model and where it came from.
pub(crate) struct Loaded {
    /// The model.
    pub(crate) model: Arc<Model>,
    origin: Origin,
    /// Milliseconds to open, convert and verify.
    load_ms: f64,
}

impl Loaded {
    /// Milliseconds from the file to a model that is ready, its digests verified.
    pub(crate) fn load_ms(&self) -> f64 {
        self.load_ms
    }

    /// Precision of most of its bytes; a blob may keep some of its tensors in another.
    pub(crate) fn precision(&self) -> Option<Precision> {
        let blob = self.model.blob();
        let bytes = |p: &Precision| -> usize {
            let tensors = blob.tensors().iter().enumerate();
            tensors.filter(|(_, t)| t.dtype == p.dtype()).map(|(i, _)| blob.bytes(i).len()).sum()
        };
        Precision::value_variants().iter().max_by_key(|p| bytes(p)).copied()
    }

    /// For reports.
    pub(crate) fn json(&self) -> Value {
        json!({
            "path": match &self.origin {
                Origin::Path(p) => Some(p.to_string_lossy()),
                Origin::Embedded | Origin::Random => None,
            },
            "embedded": self.origin == Origin::Embedded,
            "random_weights": self.random(),
            "digest": hex(self.model.blob().digest()),
            "parameters": self.model.parameters(),
            "weights_bytes": self.model.blob().file_bytes(),
            "load_ms": self.load_ms,
        })
    }

    /// Whether the weights mean nothing.
    pub(crate) fn random(&self) -> bool {
        self.origin == Origin::Random
    }

    /// Provenance that stays with a scene.
    pub(crate) fn notes(&self, clip: &Path) -> Vec<(String, String)> {
        vec![
            ("generator".into(), format!("streetforward {}", env!("CARGO_PKG_VERSION"))),
            ("model_digest".into(), hex(self.model.blob().digest())),
            ("random_weights".into(), self.random().to_string()),
            ("clip".into(), clip.to_string_lossy().into_owned()),
        ]
    }
}

/// Opens a blob; converts a checkpoint into a temporary blob first. Without a path: the network inside the binary;
/// where there is none, the random nano network, and a warning.
pub(crate) fn load(path: Option<&Path>, engine: &EngineArgs, to: Precision, console: &Console) -> Result<Loaded> {
    let start = Instant::now();
    let mut origin = path.map_or(Origin::Embedded, |p| Origin::Path(p.to_path_buf()));
    let blob = match (path, EMBEDDED) {
        (None, Some(bytes)) => Blob::from_bytes(bytes)?,
        (None, None) => {
            origin = Origin::Random;
            console.warn("no model given: a nano network with random weights runs, its result is noise");
            let seeded = Seeded::new(&ModelConfig::nano(), RANDOM_SEED, Outputs::Random)?;
            Blob::from_bytes(&convert_to_bytes(&seeded, &Options::to(to.dtype()))?)?
        }
        (Some(path), _) if is_checkpoint(path)? => from_checkpoint(path, to, console)?,
        (Some(path), _) => Blob::open(path, engine.load.mode(), Verify::Digests)?,
    };
    let model = Arc::new(Model::from_blob(blob)?);
    Ok(Loaded { model, origin, load_ms: start.elapsed().as_secs_f64() * 1e3 })
}

/// The random network of a configuration, always from the same seed, as a blob that is mapped like a file's.
pub(crate) fn random(config: &ModelConfig, to: Precision, console: &Console) -> Result<Loaded> {
    let seeded = Seeded::new(config, RANDOM_SEED, Outputs::Random)?;
    let (blob, load_ms) = temporary(&seeded, to, "weights", console)?;
    Ok(Loaded { model: Arc::new(Model::from_blob(blob)?), origin: Origin::Random, load_ms })
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
    temporary(&*source, to, "convert", console).map(|(blob, _)| blob)
}

/// Converts into a temporary file that is gone when the blob is open; also gives the milliseconds that opening took.
fn temporary(source: &dyn Checkpoint, to: Precision, what: &'static str, console: &Console) -> Result<(Blob, f64)> {
    let folder = scratch_folder()?;
    let file = folder.0.join("model.sfw");
    let progress = console.progress(source.tensors().len() as u64, what);
    let watched = Watched::new(source, &progress);
    convert(&watched, &file, Overwrite::No, &Options::to(to.dtype()))?;
    drop(progress);
    let start = Instant::now();
    // The mapping keeps the unlinked file; nobody else can reach it any more.
    let blob = Blob::open(&file, LoadMode::Map, Verify::Digests)?;
    Ok((blob, start.elapsed().as_secs_f64() * 1e3))
}

/// A private temporary folder, deleted when dropped.
pub(crate) struct Scratch(PathBuf);

impl Scratch {
    /// Where it is.
    pub(crate) fn path(&self) -> &Path {
        &self.0
    }
}

/// A new one, under the system's temporary folder.
pub(crate) fn scratch_folder() -> Result<Scratch> {
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
