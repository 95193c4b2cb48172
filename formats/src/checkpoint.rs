//! Training checkpoints: names, shapes and lazily read values.
//!
//! [`open`] takes a safetensors file, a sharded set (an `*.index.json`, the folder that holds one, or
//! the shard files themselves) or, with the feature `pytorch`, a `.pt`, `.pth` or `.bin` file. Only
//! the list of tensors is in memory; values are read tensor by tensor. Nothing in a file is ever
//! executed.

use crate::error::{Error, Result, escape, escape_path};
use crate::open::read_regular;
use crate::sniff::FileKind;
use sha2::{Digest, Sha256};
use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

pub use crate::checkpoint_source::{Checkpoint, CheckpointTensor, SourceDtype};
pub use crate::safetensors_in::Safetensors;

/// Longest index or shard list that is read.
const INDEX_CAP: u64 = 16 << 20;

/// Opens a checkpoint: one file, one folder, one index, or the files of a sharded set.
pub fn open(paths: &[PathBuf]) -> Result<Box<dyn Checkpoint>> {
    match paths {
        [] => Err(Error::usage("no checkpoint given")),
        [one] if one.is_dir() => open_folder(one),
        [one] => open_file(one),
        many => Ok(Box::new(Sharded::open(many, None)?)),
    }
}

fn open_file(path: &Path) -> Result<Box<dyn Checkpoint>> {
    match FileKind::of_file(path)? {
        FileKind::Safetensors => Ok(Box::new(Safetensors::open(path)?)),
        FileKind::Json => open_index(path),
        FileKind::Zip | FileKind::Pickle | FileKind::Tar => open_torch(path),
        kind => Err(Error::model(
            escape_path(path),
            format!("not a checkpoint: {}; wanted .safetensors or .pt", kind.advice()),
        )),
    }
}

#[cfg(feature = "pytorch")]
fn open_torch(path: &Path) -> Result<Box<dyn Checkpoint>> {
    Ok(Box::new(crate::torch_in::TorchFile::open(path)?))
}

#[cfg(not(feature = "pytorch"))]
fn open_torch(path: &Path) -> Result<Box<dyn Checkpoint>> {
    Err(Error::unsupported(
        escape_path(path),
        "PyTorch pickle checkpoints need a build with the feature `pytorch`; or save it once in Python with \
         safetensors.torch.save_file(state_dict, \"model.safetensors\")",
    ))
}

fn open_folder(folder: &Path) -> Result<Box<dyn Checkpoint>> {
    let entries = std::fs::read_dir(folder).map_err(|e| Error::io(folder, "list", &e))?;
    let mut files: Vec<PathBuf> = Vec::new();
    for entry in entries {
        files.push(entry.map_err(|e| Error::io(folder, "list", &e))?.path());
    }
    files.sort();
    let ending = |end: &str| -> Vec<PathBuf> {
        files.iter().filter(|f| f.as_os_str().as_encoded_bytes().ends_with(end.as_bytes())).cloned().collect()
    };
    let at = escape_path(folder);
    match (ending(".safetensors.index.json").as_slice(), ending(".safetensors").as_slice()) {
        ([index], _) => open_index(index),
        ([_, _, ..], _) => Err(Error::model(at, "holds several *.safetensors.index.json; name the one to use")),
        ([], [one]) => open_file(one),
        ([], []) => Err(Error::model(at, "holds no .safetensors file; name the checkpoint file itself")),
        ([], [_, _, ..]) => Err(Error::model(
            at,
            "holds several .safetensors files and no *.safetensors.index.json; name the file or the shards",
        )),
    }
}

fn open_index(path: &Path) -> Result<Box<dyn Checkpoint>> {
    let at = escape_path(path);
    let bytes = read_regular(path, INDEX_CAP)?
        .ok_or_else(|| Error::model(&at, format!("index is longer than {} MiB", INDEX_CAP >> 20)))?;
    let json = crate::json::parse(&bytes).map_err(|why| Error::model(&at, why))?;
    let map = json
        .get("weight_map")
        .and_then(|m| m.as_object())
        .ok_or_else(|| Error::model(&at, "JSON without a weight_map object: not a shard index"))?;
    let mut wanted: BTreeMap<String, String> = BTreeMap::new();
    for (name, file) in map {
        let file = file
            .as_str()
            .ok_or_else(|| Error::model(&at, format!("shard of '{}' is not text", escape(name.as_bytes()))))?;
        let plain =
            !file.is_empty() && file != "." && file != ".." && !file.contains(['/', '\\', '\0']) && file.len() <= 255;
        if !plain {
            return Err(Error::model(
                &at,
                format!(
                    "shard '{}' leaves the index's folder; only plain file names are read",
                    escape(file.as_bytes())
                ),
            ));
        }
        wanted.insert(name.clone(), file.to_owned());
    }
    if wanted.is_empty() {
        return Err(Error::model(&at, "weight_map is empty"));
    }
    let folder = path.parent().unwrap_or(Path::new(""));
    let mut names: Vec<&String> = wanted.values().collect();
    names.sort();
    names.dedup();
    let mut files = Vec::with_capacity(names.len());
    for name in names {
        let file = folder.join(name);
        if !file.exists() {
            return Err(Error::model(&at, format!("names the shard '{}', which is absent", escape(name.as_bytes()))));
        }
        if FileKind::of_file(&file)? == FileKind::Json {
            return Err(Error::model(&at, format!("names '{}', another index, as a shard", escape(name.as_bytes()))));
        }
        files.push(file);
    }
    Ok(Box::new(Sharded::open(&files, Some((&at, &wanted)))?))
}

/// Several safetensors files that make one checkpoint.
struct Sharded {
    shards: Vec<Safetensors>,
    tensors: Vec<CheckpointTensor>,
    /// Shard and index within it of every tensor.
    place: Vec<(usize, usize)>,
}

impl Sharded {
    /// Opens the shards; with an index, every tensor must be where the index says, and nowhere else.
    fn open(files: &[PathBuf], index: Option<(&str, &BTreeMap<String, String>)>) -> Result<Sharded> {
        let mut files = files.to_vec();
        files.sort();
        let mut shards = Vec::with_capacity(files.len());
        for file in &files {
            let kind = FileKind::of_file(file)?;
            if kind != FileKind::Safetensors {
                let why = format!("not a safetensors shard: {}", kind.advice());
                return Err(Error::model(escape_path(file), why));
            }
            shards.push(Safetensors::open(file)?);
        }
        let (mut tensors, mut place) = (Vec::new(), Vec::new());
        let mut seen: BTreeMap<String, usize> = BTreeMap::new();
        for (s, shard) in shards.iter().enumerate() {
            for (i, t) in shard.tensors().iter().enumerate() {
                let name = escape(t.name.as_bytes());
                if let Some(&first) = seen.get(&t.name) {
                    return Err(Error::model(
                        escape_path(&files[s]),
                        format!("tensor '{name}' is in {} too", escape_path(&files[first])),
                    ));
                }
                seen.insert(t.name.clone(), s);
                if let Some((at, wanted)) = index {
                    let here = files[s].file_name().unwrap_or_default().to_string_lossy();
                    match wanted.get(&t.name) {
                        Some(file) if *file == here => {}
                        Some(file) => {
                            let why = format!("puts '{name}' in '{}', but '{here}' holds it", escape(file.as_bytes()));
                            return Err(Error::model(at, why));
                        }
                        None => {
                            return Err(Error::model(at, format!("does not list '{name}', which '{here}' holds")));
                        }
                    }
                }
                tensors.push(t.clone());
                place.push((s, i));
            }
        }
        if let Some((at, wanted)) = index
            && let Some((name, file)) = wanted.iter().find(|(name, _)| !seen.contains_key(*name))
        {
            let (name, file) = (escape(name.as_bytes()), escape(file.as_bytes()));
            return Err(Error::model(at, format!("puts '{name}' in '{file}', which lacks it")));
        }
        Ok(Sharded { shards, tensors, place })
    }
}

impl Checkpoint for Sharded {
    fn tensors(&self) -> &[CheckpointTensor] {
        &self.tensors
    }

    fn read_f32(&self, index: usize, out: &mut Vec<f32>) -> Result<()> {
        let (shard, i) = self.place[index];
        self.shards[shard].read_f32(i, out)
    }

    fn metadata(&self, key: &str) -> Option<&str> {
        self.shards.iter().find_map(|s| s.metadata(key))
    }

    fn describe(&self) -> String {
        format!("safetensors in {} shards, {} tensors", self.shards.len(), self.tensors.len())
    }

    fn digest(&self) -> Result<[u8; 32]> {
        let mut all = Sha256::new();
        for shard in &self.shards {
            all.update(shard.digest()?);
        }
        Ok(all.finalize().into())
    }
}
