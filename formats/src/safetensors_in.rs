//! safetensors, read strictly.
//!
//! Layout: u64 little-endian header length n; n bytes of JSON, an object of
//! `name: {"dtype", "shape", "data_offsets": [begin, end]}` and optionally `__metadata__` (text to
//! text); then the data, which the offsets count from. Refused here: equal keys, holes, overlaps,
//! bytes behind the last tensor, zero-size tensors, lengths that are not shape x dtype.

use crate::checkpoint_source::{Checkpoint, CheckpointTensor, SourceDtype, decode_f32, file_digest};
use crate::error::{Error, Result, escape, escape_path};
use crate::open::open_regular;
use serde_json::Value;
use std::collections::BTreeMap;
use std::fs::File;
use std::os::unix::fs::FileExt;
use std::path::{Path, PathBuf};

/// Longest header: the full model's is 0.2 MB, 40 000 tensors need 6 MB.
const HEADER_CAP: u64 = 16 << 20;
/// Longest tensor name in bytes.
const NAME_CAP: usize = 512;
/// Most dimensions of a tensor.
const RANK_CAP: usize = 8;
/// Bytes read and converted at a time.
const CHUNK: usize = 1 << 18;

/// One open safetensors file.
#[derive(Debug)]
pub struct Safetensors {
    path: PathBuf,
    file: File,
    tensors: Vec<CheckpointTensor>,
    /// Absolute byte ranges, parallel to `tensors`.
    ranges: Vec<(u64, u64)>,
    metadata: BTreeMap<String, String>,
}

/// Type and bytes per element of a dtype name.
fn dtype(name: &str) -> Option<(SourceDtype, u64)> {
    Some(match name {
        "F64" => (SourceDtype::F64, 8),
        "F32" => (SourceDtype::F32, 4),
        "F16" => (SourceDtype::F16, 2),
        "BF16" => (SourceDtype::Bf16, 2),
        "BOOL" => (SourceDtype::Int("BOOL"), 1),
        "U8" => (SourceDtype::Int("U8"), 1),
        "I8" => (SourceDtype::Int("I8"), 1),
        "U16" => (SourceDtype::Int("U16"), 2),
        "I16" => (SourceDtype::Int("I16"), 2),
        "U32" => (SourceDtype::Int("U32"), 4),
        "I32" => (SourceDtype::Int("I32"), 4),
        "U64" => (SourceDtype::Int("U64"), 8),
        "I64" => (SourceDtype::Int("I64"), 8),
        "F8_E4M3" => (SourceDtype::Int("F8_E4M3"), 1),
        "F8_E5M2" => (SourceDtype::Int("F8_E5M2"), 1),
        "F8_E8M0" => (SourceDtype::Int("F8_E8M0"), 1),
        "C64" => (SourceDtype::Int("C64"), 8),
        _ => return None,
    })
}

impl Safetensors {
    /// Opens a file and checks its whole header; no tensor is read.
    pub fn open(path: &Path) -> Result<Safetensors> {
        let (file, identity) = open_regular(path)?;
        let length = identity.bytes();
        let at = escape_path(path);
        let fault = |why: String| Error::model(&at, why);
        if length < 10 {
            return Err(fault(format!("{length} bytes are too few for a safetensors file")));
        }
        let mut head = [0u8; 8];
        file.read_exact_at(&mut head, 0).map_err(|e| Error::io(path, "read", &e))?;
        let n = u64::from_le_bytes(head);
        if n > HEADER_CAP {
            return Err(fault(format!("header of {n} bytes is over the limit of {} MiB", HEADER_CAP >> 20)));
        }
        if n > length - 8 {
            return Err(fault(format!("header of {n} bytes does not fit in the file ({length} bytes): truncated?")));
        }
        let mut header = vec![0u8; n as usize];
        file.read_exact_at(&mut header, 8).map_err(|e| Error::io(path, "read", &e))?;
        let (list, metadata) = parse_header(&header, length - 8 - n).map_err(fault)?;
        let data = 8 + n;
        let (mut tensors, mut ranges) = (Vec::with_capacity(list.len()), Vec::with_capacity(list.len()));
        for (tensor, (begin, end)) in list {
            tensors.push(tensor);
            ranges.push((data + begin, data + end));
        }
        Ok(Safetensors { path: path.to_path_buf(), file, tensors, ranges, metadata })
    }

    /// The file.
    pub fn path(&self) -> &Path {
        &self.path
    }

    /// All text metadata, sorted by key.
    pub fn all_metadata(&self) -> &BTreeMap<String, String> {
        &self.metadata
    }
}

type Listed = (CheckpointTensor, (u64, u64));

/// Tensors with their byte ranges (in the order of their data) and the metadata.
fn parse_header(header: &[u8], data_len: u64) -> Result<(Vec<Listed>, BTreeMap<String, String>), String> {
    if header.first() != Some(&b'{') {
        return Err("header does not start with '{'".into());
    }
    let json = crate::json::parse(header).map_err(|why| format!("header {why}"))?;
    let Value::Object(entries) = json else { return Err("header is not a JSON object".into()) };
    let mut metadata = BTreeMap::new();
    let mut list: Vec<Listed> = Vec::with_capacity(entries.len());
    for (name, entry) in &entries {
        if name == "__metadata__" {
            let texts = entry.as_object().ok_or("__metadata__ is not an object")?;
            for (key, value) in texts {
                let text = value
                    .as_str()
                    .ok_or_else(|| format!("__metadata__ value of '{}' is not text", escape(key.as_bytes())))?;
                metadata.insert(key.clone(), text.to_owned());
            }
            continue;
        }
        list.push(parse_entry(name, entry).map_err(|why| format!("tensor '{}' {why}", escape(name.as_bytes())))?);
    }
    if list.is_empty() {
        return Err("holds no tensor".into());
    }
    list.sort_by_key(|(_, range)| *range);
    let mut next = 0u64;
    for (tensor, (begin, end)) in &list {
        let name = escape(tensor.name.as_bytes());
        if *begin < next {
            return Err(format!("tensor '{name}' at byte {begin} overlaps the one before it, which ends at {next}"));
        }
        if *begin > next {
            return Err(format!("hole of {} bytes before tensor '{name}'", begin - next));
        }
        if *end > data_len {
            return Err(format!("tensor '{name}' ends at byte {end} of {data_len}: truncated file?"));
        }
        next = *end;
    }
    if next != data_len {
        return Err(format!("{} bytes follow the last tensor", data_len - next));
    }
    Ok((list, metadata))
}

fn parse_entry(name: &str, entry: &Value) -> Result<Listed, String> {
    if name.is_empty() || name.len() > NAME_CAP || name.chars().any(char::is_control) {
        return Err(format!("has a name that is empty, over {NAME_CAP} bytes or holds control characters"));
    }
    let entry = entry.as_object().ok_or("is not an object")?;
    if let Some(key) = entry.keys().find(|k| !["dtype", "shape", "data_offsets"].contains(&k.as_str())) {
        return Err(format!("has the unknown field '{}'", escape(key.as_bytes())));
    }
    let kind = entry.get("dtype").and_then(Value::as_str).ok_or("has no dtype")?;
    let (dtype, size) = dtype(kind).ok_or_else(|| format!("has the unknown dtype '{}'", escape(kind.as_bytes())))?;
    let shape = entry.get("shape").and_then(Value::as_array).ok_or("has no shape")?;
    if shape.len() > RANK_CAP {
        return Err(format!("has {} dimensions; the limit is {RANK_CAP}", shape.len()));
    }
    let mut extents = Vec::with_capacity(shape.len());
    let mut bytes = size;
    for d in shape {
        let d = d.as_u64().ok_or("has a dimension that is not a whole number")?;
        if d == 0 {
            return Err("has a dimension of 0".into());
        }
        bytes = bytes.checked_mul(d).ok_or("has a shape whose size overflows")?;
        extents.push(usize::try_from(d).map_err(|_| "has a dimension beyond this machine's memory")?);
    }
    let offsets = entry.get("data_offsets").and_then(Value::as_array).ok_or("has no data_offsets")?;
    let [begin, end] = offsets.as_slice() else { return Err("needs two data_offsets".into()) };
    let (begin, end) = begin.as_u64().zip(end.as_u64()).ok_or("has data_offsets that are not whole numbers")?;
    if end.checked_sub(begin) != Some(bytes) {
        return Err(format!("needs {bytes} bytes by shape and dtype but has data_offsets [{begin}, {end}]"));
    }
    Ok((CheckpointTensor { name: name.to_owned(), shape: extents, dtype }, (begin, end)))
}

impl Checkpoint for Safetensors {
    fn tensors(&self) -> &[CheckpointTensor] {
        &self.tensors
    }

    fn read_f32(&self, index: usize, out: &mut Vec<f32>) -> Result<()> {
        let tensor = &self.tensors[index];
        out.clear();
        if let SourceDtype::Int(name) = tensor.dtype {
            let at = format!("{}: {}", escape_path(&self.path), escape(tensor.name.as_bytes()));
            return Err(Error::unsupported(at, format!("dtype {name} is no weight; F64, F32, F16 and BF16 are read")));
        }
        let count = tensor.count();
        out.try_reserve_exact(count)
            .map_err(|_| Error::resource(escape(tensor.name.as_bytes()), format!("no memory for {count} values")))?;
        let (mut from, end) = self.ranges[index];
        let mut buffer = vec![0u8; CHUNK.min((end - from) as usize)];
        while from < end {
            let n = CHUNK.min((end - from) as usize);
            self.file.read_exact_at(&mut buffer[..n], from).map_err(|e| Error::io(&self.path, "read", &e))?;
            decode_f32(tensor.dtype, &buffer[..n], out);
            from += n as u64;
        }
        Ok(())
    }

    fn metadata(&self, key: &str) -> Option<&str> {
        self.metadata.get(key).map(String::as_str)
    }

    fn describe(&self) -> String {
        format!("safetensors, {} tensors", self.tensors.len())
    }

    fn digest(&self) -> Result<[u8; 32]> {
        file_digest(&self.path)
    }
}
