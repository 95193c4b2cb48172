//! [`Checkpoint`]: a source of named tensors, whatever its format; and what every format needs to be one.

use crate::error::{Error, Result};
use crate::open::open_regular;
use sha2::{Digest, Sha256};
use std::io::Read;
use std::path::Path;

/// Element type in the source file.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum SourceDtype {
    /// IEEE double, rounded to nearest even on reading.
    F64,
    /// IEEE single.
    F32,
    /// IEEE half.
    F16,
    /// Upper half of an IEEE single.
    Bf16,
    /// Integers, booleans, 8-bit floats and complex numbers: listed, never read. The name is the
    /// file's own.
    Int(&'static str),
}

impl SourceDtype {
    /// The usual short name.
    pub fn name(self) -> &'static str {
        match self {
            SourceDtype::F64 => "F64",
            SourceDtype::F32 => "F32",
            SourceDtype::F16 => "F16",
            SourceDtype::Bf16 => "BF16",
            SourceDtype::Int(name) => name,
        }
    }
}

/// One tensor of a checkpoint.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct CheckpointTensor {
    /// Name as in the file; wrapper prefixes are the converter's business.
    pub name: String,
    /// Extents, outermost first; empty for a scalar.
    pub shape: Vec<usize>,
    /// Element type in the file.
    pub dtype: SourceDtype,
}

impl CheckpointTensor {
    /// Number of elements; readers have checked that it does not overflow.
    pub fn count(&self) -> usize {
        self.shape.iter().product()
    }
}

/// A source of named tensors.
pub trait Checkpoint: Send + Sync {
    /// All tensors, in the order of the file.
    fn tensors(&self) -> &[CheckpointTensor];
    /// Replaces `out` by the values of tensor `index`, row-major, as f32 (F64 rounds to nearest even,
    /// and overflows to infinity). Integers are [`Error::Unsupported`].
    fn read_f32(&self, index: usize, out: &mut Vec<f32>) -> Result<()>;
    /// A text value stored beside the tensors.
    fn metadata(&self, key: &str) -> Option<&str>;
    /// One line for people: format, files, tensors, what was chosen or ignored.
    fn describe(&self) -> String;
    /// SHA-256 of the source: of the file, or of the shards' digests in file-name order.
    fn digest(&self) -> Result<[u8; 32]>;

    /// Index of a tensor by name (linear: for many look-ups build a map).
    fn find(&self, name: &str) -> Option<usize> {
        self.tensors().iter().position(|t| t.name == name)
    }
}

/// SHA-256 of a file, read once in 1 MiB pieces.
pub(crate) fn file_digest(path: &Path) -> Result<[u8; 32]> {
    let (mut file, _) = open_regular(path)?;
    let mut hash = Sha256::new();
    let mut buffer = vec![0u8; 1 << 20];
    loop {
        match file.read(&mut buffer) {
            Ok(0) => return Ok(hash.finalize().into()),
            Ok(n) => hash.update(&buffer[..n]),
            Err(e) if e.kind() == std::io::ErrorKind::Interrupted => {}
            Err(e) => return Err(Error::io(path, "read", &e)),
        }
    }
}

/// Appends little-endian elements as f32. `bytes` is a whole number of elements.
pub(crate) fn decode_f32(dtype: SourceDtype, bytes: &[u8], out: &mut Vec<f32>) {
    let two = |b: &[u8]| u16::from_le_bytes([b[0], b[1]]);
    match dtype {
        SourceDtype::F32 => out.extend(bytes.chunks_exact(4).map(|b| f32::from_le_bytes([b[0], b[1], b[2], b[3]]))),
        SourceDtype::F64 => out.extend(
            bytes.chunks_exact(8).map(|b| f64::from_le_bytes([b[0], b[1], b[2], b[3], b[4], b[5], b[6], b[7]]) as f32),
        ),
        SourceDtype::F16 => out.extend(bytes.chunks_exact(2).map(|b| half::f16::from_bits(two(b)).to_f32())),
        SourceDtype::Bf16 => out.extend(bytes.chunks_exact(2).map(|b| f32::from_bits(u32::from(two(b)) << 16))),
        SourceDtype::Int(name) => unreachable!("{name} is refused before decoding"),
    }
}
