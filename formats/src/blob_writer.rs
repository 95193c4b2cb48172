//! [`BlobWriter`]: writes a `.sfw` file tensor by tensor.
//!
//! The length of everything before the data follows from the configuration and the metadata alone, so
//! the data section's place is known at the start; records and digests are written over it at the end.
//! Memory in use is one panel beside the caller's tensor. The bytes depend on the arguments only.

use crate::arch::{self, TensorSpec};
use crate::atomic::{AtomicFile, Overwrite};
use crate::blob_layout::{self as layout, Dtype, Layout, header, record};
use crate::config::{ModelConfig, Value};
use crate::digest::{Digest, sha256};
use crate::error::{Error, Result};
use crate::meta::{self, Meta};
use crate::panel::{LANES, Order};
use crate::panel_s8::{self, Int8Layout};
use half::f16;
use half::slice::HalfFloatSliceExt;
use sha2::{Digest as _, Sha256};
use std::collections::BTreeMap;
use std::path::Path;

/// A blob being written; nothing is visible before [`BlobWriter::finish`].
#[derive(Debug)]
pub struct BlobWriter {
    sink: Sink,
    specs: Vec<TensorSpec>,
    head: Vec<u8>,
    /// All metadata, the configuration's keys included.
    pairs: BTreeMap<String, Value>,
    table: usize,
    data: u64,
    end: u64,
    written: usize,
}

/// A quantized matrix in the order of the blob, without padding of outputs.
#[derive(Clone, Copy, Debug)]
pub struct QuantizedMatrix<'a> {
    /// Values in [-127, 127], `[n][k]`, k in the order of [`TensorSpec::matrix`].
    pub values: &'a [i8],
    /// One per output.
    pub scales: &'a [f32],
    /// One bit per rotated channel, 16 a word; empty without rotation.
    pub signs: &'a [u16],
}

#[derive(Debug)]
enum Sink {
    File(AtomicFile),
    Memory(Vec<u8>),
}

impl Sink {
    fn write(&mut self, bytes: &[u8]) -> Result<()> {
        match self {
            Sink::File(f) => AtomicFile::write(f, bytes),
            Sink::Memory(v) => {
                v.extend_from_slice(bytes);
                Ok(())
            }
        }
    }
}

impl BlobWriter {
    /// Starts a file.
    pub fn create(path: &Path, overwrite: Overwrite, config: &ModelConfig, meta: &Meta) -> Result<BlobWriter> {
        let plan = plan(config, meta)?;
        let file = AtomicFile::create(path, overwrite)?;
        BlobWriter::start(Sink::File(file), plan)
    }

    /// Starts a blob in memory, for [`BlobWriter::finish_bytes`].
    pub fn in_memory(config: &ModelConfig, meta: &Meta) -> Result<BlobWriter> {
        BlobWriter::start(Sink::Memory(Vec::new()), plan(config, meta)?)
    }

    fn start(mut sink: Sink, plan: Planned) -> Result<BlobWriter> {
        let Planned { specs, pairs, head, table } = plan;
        sink.write(&head)?;
        let data = head.len() as u64;
        Ok(BlobWriter { sink, specs, head, pairs, table, data, end: data, written: 0 })
    }

    /// The tensors the configuration asks for, in the order in which [`BlobWriter::write`] takes them.
    pub fn specs(&self) -> &[TensorSpec] {
        &self.specs
    }

    /// Writes the next tensor from values in checkpoint order. Matrices become K1N16 panels of `dtype`;
    /// vectors and tables are stored row-major as f32 whatever `dtype` says. Returns its bytes.
    ///
    /// A value that is not finite in the stored type is an error; see [`fits_f16`].
    pub fn write(&mut self, values: &[f32], dtype: Dtype) -> Result<u64> {
        let at = self.next()?;
        let spec = &self.specs[self.written];
        assert_eq!(values.len(), spec.len(), "values of {}", spec.name);
        if dtype == Dtype::Int8 && spec.matrix().is_some() {
            return Err(Error::Internal(format!("{} needs a quantizer", spec.name)));
        }
        let mut out = Out { sink: &mut self.sink, hash: Sha256::new(), bytes: 0, name: &spec.name };
        let order = Order::of(spec);
        let (dtype, order_code) = match &order {
            None => {
                out.f32s(values)?;
                (Dtype::F32, Layout::RowMajor)
            }
            Some(order) => {
                let mut panel = vec![0.0f32; order.panel_len()];
                let mut halves = vec![f16::ZERO; if dtype == Dtype::F16 { panel.len() } else { 0 }];
                for p in 0..order.panels() {
                    order.pack(p, values, &mut panel);
                    match dtype {
                        Dtype::F32 => out.f32s(&panel)?,
                        Dtype::F16 => out.f16s(&panel, &mut halves)?,
                        Dtype::Int8 => unreachable!("refused above"),
                    }
                }
                (dtype, Layout::K1N16)
            }
        };
        let (digest, bytes) = (out.hash.finalize().into(), out.bytes);
        self.record((dtype, order_code, 0), (at, bytes), digest);
        Ok(bytes)
    }

    /// Writes the next tensor, a matrix, as int8. Returns its bytes.
    pub fn write_int8(&mut self, m: QuantizedMatrix) -> Result<u64> {
        let at = self.next()?;
        let spec = &self.specs[self.written];
        let Some(s) = Int8Layout::of(spec, !m.signs.is_empty()) else {
            return Err(Error::Internal(format!("{} {:?} cannot be int8", spec.name, spec.shape)));
        };
        assert!(m.values.len() == s.n * s.k && m.scales.len() == s.n, "values or scales of {}", spec.name);
        assert_eq!(m.signs.len(), s.words, "sign words of {}", spec.name);
        let limits = 1.0 / panel_s8::MAX_SCALE..=panel_s8::MAX_SCALE;
        if let Some(o) = m.scales.iter().position(|v| !limits.contains(v)) {
            return Err(Error::model(&spec.name, format!("the scale of output {o} is {:e}", m.scales[o])));
        }
        assert!(m.values.iter().all(|&v| v != i8::MIN), "-128 in {}", spec.name);

        let mut out = Out { sink: &mut self.sink, hash: Sha256::new(), bytes: 0, name: &spec.name };
        let mut panel = vec![0i8; s.panels() / (s.lanes() / LANES)];
        let (mut scales, mut sums) = (vec![0.0f32; s.lanes()], vec![0i32; s.lanes()]);
        scales[..s.n].copy_from_slice(m.scales);
        for first in (0..s.n).step_by(LANES) {
            panel.fill(0);
            for o in first..(first + LANES).min(s.n) {
                let row = &m.values[o * s.k..(o + 1) * s.k];
                sums[o] = row.iter().map(|&v| i32::from(v)).sum();
                for (i, &v) in row.iter().enumerate() {
                    panel[s.place(o - first, i)] = v;
                }
            }
            out.bytes(bytemuck::cast_slice(&panel))?;
        }
        out.bytes(bytemuck::cast_slice(&scales))?;
        out.bytes(bytemuck::cast_slice(&sums))?;
        out.bytes(bytemuck::cast_slice(m.signs))?;
        let (digest, bytes) = (out.hash.finalize().into(), out.bytes);
        assert_eq!(bytes, s.bytes() as u64, "bytes of {}", spec.name);
        let block = if m.signs.is_empty() { 0 } else { panel_s8::rotation_block(LANES * s.words).unwrap_or(0) };
        self.record((Dtype::Int8, Layout::K4N16, block), (at, bytes), digest);
        Ok(bytes)
    }

    /// Pads to the place of the next tensor.
    fn next(&mut self) -> Result<u64> {
        if self.written == self.specs.len() {
            return Err(Error::Internal("one tensor too many for the configuration".into()));
        }
        let at = layout::align(self.end, layout::TENSOR_ALIGN)
            .ok_or_else(|| Error::Internal("blob length overflows".into()))?;
        self.sink.write(&[0; layout::TENSOR_ALIGN as usize][..(at - self.end) as usize])?;
        Ok(at)
    }

    /// Notes a tensor that has been written.
    fn record(&mut self, (dtype, order, rotation): (Dtype, Layout, usize), (at, bytes): (u64, u64), digest: Digest) {
        let start = self.table + self.written * layout::RECORD;
        let row = &mut self.head[start..start + layout::RECORD];
        record::DTYPE.put_number(row, dtype as u64);
        record::LAYOUT.put_number(row, order as u64);
        record::ROTATION.put_number(row, rotation as u64);
        record::OFFSET.put_number(row, at);
        record::LENGTH.put_number(row, bytes);
        record::DIGEST.put(row, &digest);
        self.end = at + bytes;
        self.written += 1;
    }

    /// Replaces the value of a metadata key by one of the same type and length: for what is known only when the
    /// tensors are written.
    pub fn replace(&mut self, key: &str, value: Value) -> Result<()> {
        let mut meta = Meta::new();
        meta.set(key, value.clone());
        meta.check()?;
        let old = meta::encode(&self.pairs);
        match self.pairs.get_mut(key) {
            Some(slot) if !key.starts_with(meta::CONFIG_PREFIX) => *slot = value,
            _ => return Err(Error::Internal(format!("metadata {key} was not there from the start"))),
        }
        let new = meta::encode(&self.pairs);
        if new.len() != old.len() {
            return Err(Error::Internal(format!("metadata {key} changed its length")));
        }
        self.head[layout::HEADER..self.table].copy_from_slice(&new);
        Ok(())
    }

    /// Lengths, root and digest into the header.
    fn complete(&mut self) -> Result<Digest> {
        if self.written != self.specs.len() {
            return Err(Error::Internal(format!("{} of {} tensors written", self.written, self.specs.len())));
        }
        if self.end > layout::MAX_FILE {
            return Err(Error::unsupported("blob", format!("{} bytes, the limit is {}", self.end, layout::MAX_FILE)));
        }
        let mut root = Sha256::new();
        let records = &self.head[self.table..self.table + self.written * layout::RECORD];
        for row in records.chunks_exact(layout::RECORD) {
            root.update(record::DIGEST.of(row));
        }
        let head = &mut self.head;
        header::TENSOR_ROOT.put(head, &root.finalize());
        header::FILE_LENGTH.put_number(head, self.end);
        header::DATA_LENGTH.put_number(head, self.end - self.data);
        header::HEADER_DIGEST.put(head, &[0; 32]);
        let digest = sha256(head);
        header::HEADER_DIGEST.put(head, &digest);
        Ok(digest)
    }

    /// Writes the header and makes the file visible; returns its digest ([`crate::blob::Blob::digest`]).
    pub fn finish(self) -> Result<Digest> {
        self.finish_checked(|_| Ok(Vec::new()))
    }

    /// [`BlobWriter::finish`] after a look at the whole file while it still has a temporary name. `check` gets its
    /// path and may return metadata to replace ([`BlobWriter::replace`]); when it fails, nothing becomes visible.
    pub fn finish_checked(mut self, check: impl FnOnce(&Path) -> Result<Vec<(String, Value)>>) -> Result<Digest> {
        let mut digest = self.complete()?;
        let Sink::File(file) = &mut self.sink else {
            return Err(Error::Internal("a blob in memory ends with finish_bytes".into()));
        };
        file.write_at(0, &self.head)?;
        let replaced = check(file.flushed()?)?;
        if !replaced.is_empty() {
            for (key, value) in replaced {
                self.replace(&key, value)?;
            }
            digest = self.complete()?;
        }
        match self.sink {
            Sink::File(mut file) => {
                file.write_at(0, &self.head)?;
                file.commit()?;
                Ok(digest)
            }
            Sink::Memory(_) => unreachable!("refused above"),
        }
    }

    /// The bytes of a blob in memory.
    pub fn finish_bytes(mut self) -> Result<Vec<u8>> {
        self.complete()?;
        match self.sink {
            Sink::Memory(mut bytes) => {
                bytes[..self.head.len()].copy_from_slice(&self.head);
                Ok(bytes)
            }
            Sink::File(_) => Err(Error::Internal("a blob on disk ends with finish".into())),
        }
    }
}

/// Whether every value stays finite when rounded to f16 (largest finite value 65504).
pub fn fits_f16(values: &[f32]) -> bool {
    // 65520 is halfway between 65504 and the next step, and rounds (to even) to infinity.
    values.iter().all(|v| v.abs() < 65520.0)
}

/// A value as it comes back from f16.
pub fn through_f16(v: f32) -> f32 {
    f16::from_f32(v).to_f32()
}

/// The bytes of one tensor on their way out.
struct Out<'a> {
    sink: &'a mut Sink,
    hash: Sha256,
    bytes: u64,
    name: &'a str,
}

impl Out<'_> {
    fn bytes(&mut self, bytes: &[u8]) -> Result<()> {
        self.hash.update(bytes);
        self.bytes += bytes.len() as u64;
        self.sink.write(bytes)
    }

    fn f32s(&mut self, values: &[f32]) -> Result<()> {
        if values.iter().any(|v| !v.is_finite()) {
            return Err(Error::model(self.name, "a value is NaN or infinite"));
        }
        self.bytes(bytemuck::cast_slice(values))
    }

    fn f16s(&mut self, values: &[f32], halves: &mut [f16]) -> Result<()> {
        if !fits_f16(values) {
            return Err(Error::model(self.name, "a value is outside the range of f16 (65504)"));
        }
        halves.convert_from_f32_slice(values);
        self.bytes(bytemuck::cast_slice(halves))
    }
}

/// The header section with every place known and every length and digest still zero.
struct Planned {
    specs: Vec<TensorSpec>,
    pairs: BTreeMap<String, Value>,
    head: Vec<u8>,
    /// Start of the records.
    table: usize,
}

fn plan(config: &ModelConfig, meta: &Meta) -> Result<Planned> {
    config.check("configuration")?;
    meta.check()?;
    let mut pairs: BTreeMap<String, Value> =
        config.to_pairs().into_iter().map(|(k, v)| (format!("{}{k}", meta::CONFIG_PREFIX), v)).collect();
    for (key, value) in meta.iter() {
        if key.starts_with(meta::CONFIG_PREFIX) {
            return Err(Error::usage(format!("metadata {key}: keys of the configuration are set by it alone")));
        }
        pairs.insert(key.to_string(), value.clone());
    }
    let entries = meta::encode(&pairs);
    let specs = arch::tensors(config);
    let names: usize = specs.iter().map(|s| s.name.len()).sum();
    let table = layout::HEADER + entries.len();
    let names_at = table + specs.len() * layout::RECORD;
    let data = (names_at + names).next_multiple_of(layout::DATA_ALIGN as usize);
    if data as u64 > layout::MAX_HEAD || specs.len() as u64 > layout::MAX_TENSORS {
        return Err(Error::usage(format!(
            "{} tensors and {} bytes of metadata do not fit into a header of {} bytes; shorten the metadata",
            specs.len(),
            entries.len(),
            layout::MAX_HEAD
        )));
    }

    let mut head = vec![0; data];
    let h = &mut head[..];
    header::MAGIC.put(h, &layout::MAGIC_BYTES);
    for (field, value) in [
        (header::ENDIAN, u64::from(layout::ENDIAN_WORD)),
        (header::MAJOR, u64::from(layout::VERSION.0)),
        (header::MINOR, u64::from(layout::VERSION.1)),
        (header::HEADER_LENGTH, layout::HEADER as u64),
        (header::ARCHITECTURE, u64::from(layout::ARCHITECTURE_STREETFORWARD)),
        (header::DIGEST_KIND, u64::from(layout::DIGEST_SHA256)),
        (header::META_COUNT, pairs.len() as u64),
        (header::META_OFFSET, layout::HEADER as u64),
        (header::META_LENGTH, entries.len() as u64),
        (header::TENSOR_COUNT, specs.len() as u64),
        (header::TABLE_OFFSET, table as u64),
        (header::TABLE_LENGTH, (specs.len() * layout::RECORD) as u64),
        (header::NAMES_OFFSET, names_at as u64),
        (header::NAMES_LENGTH, names as u64),
        (header::DATA_OFFSET, data as u64),
    ] {
        field.put_number(h, value);
    }
    h[layout::HEADER..table].copy_from_slice(&entries);
    let mut name_offset = 0;
    for (i, spec) in specs.iter().enumerate() {
        let row = &mut h[table + i * layout::RECORD..][..layout::RECORD];
        record::NAME_OFFSET.put_number(row, name_offset as u64);
        record::NAME_LENGTH.put_number(row, spec.name.len() as u64);
        record::RANK.put_number(row, spec.shape.len() as u64);
        for (dim, &size) in row[record::DIMS.offset..][..record::DIMS.size].chunks_exact_mut(4).zip(&spec.shape) {
            dim.copy_from_slice(&(size as u32).to_le_bytes());
        }
        h[names_at + name_offset..][..spec.name.len()].copy_from_slice(spec.name.as_bytes());
        name_offset += spec.name.len();
    }
    Ok(Planned { specs, pairs, head, table })
}
