//! PyTorch checkpoints (`.pt`, `.pth`, `.bin`) through `pytorch-reader`, which interprets the pickle as
//! data and runs none of it.
//!
//! The weights are looked for under `state_dict`, `model`, `ema`, `module`, `net`, then at the top; the
//! choice and what was left aside are in [`Checkpoint::describe`]. Text values at the top level are the
//! metadata.

use crate::checkpoint_source::{Checkpoint, CheckpointTensor, SourceDtype, decode_f32, file_digest};
use crate::error::{Error, Result, escape, escape_path};
use pytorch_reader::{DType, PickleError, PickleValue, PytorchError, PytorchReader, Tensor};
use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

/// Where training scripts put the weights, the likeliest first.
const KEYS: [&str; 7] = ["state_dict", "model", "ema", "module", "net", "model_state_dict", "network"];

/// One open PyTorch file.
#[derive(Debug)]
pub(crate) struct TorchFile {
    path: PathBuf,
    tensors: Vec<CheckpointTensor>,
    sources: Vec<Tensor>,
    metadata: BTreeMap<String, String>,
    story: String,
}

/// The status of a reader's fault: the system's, an understood but unsupported content, or a broken
/// file.
fn fault(path: &Path, e: &PytorchError) -> Error {
    let why = format!("not a readable PyTorch checkpoint: {}", escape(e.to_string().as_bytes()));
    match e {
        // The system's own errors carry a number; the reader's are about the content.
        PytorchError::Io(io) if io.raw_os_error().is_some() => Error::io(path, "read", io),
        PytorchError::Pickle(PickleError::UnsupportedOpCode(_) | PickleError::UnsupportedType(_)) => {
            Error::unsupported(escape_path(path), why)
        }
        _ => Error::model(escape_path(path), why),
    }
}

fn dtype(d: DType) -> SourceDtype {
    match d {
        DType::F64 => SourceDtype::F64,
        DType::F32 => SourceDtype::F32,
        DType::F16 => SourceDtype::F16,
        DType::BF16 => SourceDtype::Bf16,
        DType::I64 => SourceDtype::Int("I64"),
        DType::I32 => SourceDtype::Int("I32"),
        DType::I16 => SourceDtype::Int("I16"),
        DType::I8 => SourceDtype::Int("I8"),
        DType::U64 => SourceDtype::Int("U64"),
        DType::U32 => SourceDtype::Int("U32"),
        DType::U16 => SourceDtype::Int("U16"),
        DType::U8 => SourceDtype::Int("U8"),
        DType::Bool => SourceDtype::Int("BOOL"),
    }
}

impl TorchFile {
    /// Opens a file; tensor bytes stay on disk.
    pub(crate) fn open(path: &Path) -> Result<TorchFile> {
        let at = escape_path(path);
        let top = PytorchReader::read_pickle_data(path, None).map_err(|e| fault(path, &e))?;
        let mut metadata = BTreeMap::new();
        let mut key = None;
        if let PickleValue::Dict(entries) = &top {
            for (name, value) in entries {
                if let PickleValue::String(text) = value {
                    metadata.insert(name.clone(), text.clone());
                }
            }
            key = KEYS.into_iter().find(|k| matches!(entries.get(*k), Some(PickleValue::Dict(d)) if !d.is_empty()));
        }
        drop(top);
        let whole = PytorchReader::new(path).map_err(|e| fault(path, &e))?;
        let total = whole.len();
        let reader = match key {
            Some(key) => PytorchReader::with_top_level_key(path, key).map_err(|e| fault(path, &e))?,
            None => whole,
        };
        let format = format!("{:?}", reader.metadata().format_type).to_lowercase();
        let mut sources: Vec<(String, Tensor)> = reader.into_tensors().into_iter().collect();
        if sources.is_empty() {
            return Err(Error::model(at, "PyTorch file without tensors"));
        }
        sources.sort_by(|a, b| a.0.cmp(&b.0));
        let story = format!(
            "PyTorch ({format}), {} tensors{}{}",
            sources.len(),
            key.map_or(String::new(), |k| format!(" under '{k}'")),
            match total - sources.len().min(total) {
                0 => String::new(),
                n => format!(", {n} others (optimizer, other copies) ignored"),
            },
        );
        let (mut tensors, mut kept) = (Vec::with_capacity(sources.len()), Vec::with_capacity(sources.len()));
        for (name, tensor) in sources {
            let shape = tensor.shape().to_vec();
            let size = shape.iter().try_fold(tensor.dtype().size(), |a, &d| a.checked_mul(d));
            if size.is_none() {
                let why = format!("shape of tensor '{}' overflows", escape(name.as_bytes()));
                return Err(Error::model(at, why));
            }
            tensors.push(CheckpointTensor { name, shape, dtype: dtype(tensor.dtype()) });
            kept.push(tensor);
        }
        Ok(TorchFile { path: path.to_path_buf(), tensors, sources: kept, metadata, story })
    }
}

impl Checkpoint for TorchFile {
    fn tensors(&self) -> &[CheckpointTensor] {
        &self.tensors
    }

    fn read_f32(&self, index: usize, out: &mut Vec<f32>) -> Result<()> {
        let tensor = &self.tensors[index];
        let at = || format!("{}: {}", escape_path(&self.path), escape(tensor.name.as_bytes()));
        out.clear();
        if let SourceDtype::Int(name) = tensor.dtype {
            let why = format!("dtype {name} is no weight; F64, F32, F16 and BF16 are read");
            return Err(Error::unsupported(at(), why));
        }
        let bytes = self.sources[index].read().map_err(|e| Error::model(at(), escape(e.to_string().as_bytes())))?;
        let count = tensor.count();
        if bytes.len() != count * self.sources[index].dtype().size() {
            return Err(Error::model(at(), format!("{} bytes found for {count} values", bytes.len())));
        }
        out.try_reserve_exact(count).map_err(|_| Error::resource(at(), format!("no memory for {count} values")))?;
        decode_f32(tensor.dtype, &bytes, out);
        Ok(())
    }

    fn metadata(&self, key: &str) -> Option<&str> {
        self.metadata.get(key).map(String::as_str)
    }

    fn describe(&self) -> String {
        self.story.clone()
    }

    fn digest(&self) -> Result<[u8; 32]> {
        file_digest(&self.path)
    }
}
