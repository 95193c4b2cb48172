//! Writes a checkpoint as one safetensors file, tensor by tensor.
//!
//! Layout: u64 length of the header, JSON header padded with spaces to a multiple of 8, then the f32
//! values in the order of the header, without gaps.

use crate::seeded::CONFIG_KEY;
use serde_json::{Map, Value, json};
use sf_formats::atomic::{AtomicFile, Overwrite};
use sf_formats::checkpoint::Checkpoint;
use sf_formats::{Error, Result};
use std::path::Path;

/// Values converted to bytes at a time.
const CHUNK: usize = 1 << 16;

/// Writes all tensors as f32 with the configuration (if the source has one) in the metadata; returns
/// the length of the file. Holds one tensor in memory.
pub fn write_safetensors(source: &dyn Checkpoint, path: &Path, overwrite: Overwrite) -> Result<u64> {
    let mut header = Map::new();
    let mut texts = Map::new();
    texts.insert("format".into(), "pt".into());
    if let Some(config) = source.metadata(CONFIG_KEY) {
        texts.insert(CONFIG_KEY.into(), config.into());
    }
    header.insert("__metadata__".into(), Value::Object(texts));
    let mut end = 0u64;
    for t in source.tensors() {
        let start = end;
        end += 4 * t.count() as u64;
        header.insert(t.name.clone(), json!({ "dtype": "F32", "shape": t.shape, "data_offsets": [start, end] }));
    }
    let mut text = Value::Object(header).to_string().into_bytes();
    text.resize(text.len().next_multiple_of(8), b' ');

    let mut file = AtomicFile::create(path, overwrite)?;
    AtomicFile::write(&mut file, &(text.len() as u64).to_le_bytes())?;
    AtomicFile::write(&mut file, &text)?;
    let (mut values, mut bytes) = (Vec::new(), Vec::with_capacity(4 * CHUNK));
    for (i, t) in source.tensors().iter().enumerate() {
        source.read_f32(i, &mut values)?;
        if values.len() != t.count() {
            return Err(Error::Internal(format!("{} values for {} {:?}", values.len(), t.name, t.shape)));
        }
        for chunk in values.chunks(CHUNK) {
            bytes.clear();
            bytes.extend(chunk.iter().flat_map(|v| v.to_le_bytes()));
            AtomicFile::write(&mut file, &bytes)?;
        }
    }
    file.commit()?;
    Ok(8 + text.len() as u64 + end)
}
