//! [`Blob`]: a validated weight file, used in place.
//!
//! A blob is data for a known network, never a program: its tensors are exactly those its
//! configuration asks for. Everything is checked on opening; afterwards nothing here can fail. The
//! format is described in `docs/blob-format.md`, its numbers are in [`crate::blob_layout`].

pub use crate::blob_check::TensorRecord;
use crate::blob_check::{self, Parsed};
use crate::blob_layout::HEADER;
pub use crate::blob_layout::{Dtype, Layout};
use crate::config::ModelConfig;
use crate::digest::{Digest, hex};
use crate::error::{Error, Result, escape_path};
use crate::map;
use crate::meta::Meta;
use crate::open::{Identity, open_regular};
use crate::panel::Order;
use crate::panel_s8::{Int8, unrotate};
use half::f16;
use std::fs::File;
use std::io::Read;
use std::os::unix::fs::FileExt;
use std::path::{Path, PathBuf};

/// How the file's bytes come into memory.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum LoadMode {
    /// Mapped: no copy, pages shared between processes. The file must not be overwritten or truncated
    /// in place while in use (replacing it by rename is fine).
    #[default]
    Map,
    /// Copied: what was checked is what is used, whatever happens to the file.
    Copy,
}

/// How much is checked on opening.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum Verify {
    /// Structure and header digest, not the tensors' values; time does not depend on the size.
    Structure,
    /// Also every tensor's SHA-256 and that its values are finite; reads the whole file.
    #[default]
    Digests,
}

/// A validated weight file.
#[derive(Debug)]
pub struct Blob {
    storage: Storage,
    parsed: Parsed,
    /// Tensor indices in order of names.
    by_name: Vec<u32>,
    origin: Option<Origin>,
}

#[derive(Debug)]
enum Storage {
    Map(memmap2::Mmap),
    Copy(AlignedBytes),
}

#[derive(Debug)]
struct Origin {
    path: PathBuf,
    file: File,
    identity: Identity,
}

impl Blob {
    /// Opens and validates a file; every fault has the status that `docs/blob-format.md` lists.
    pub fn open(path: impl AsRef<Path>, mode: LoadMode, verify: Verify) -> Result<Blob> {
        let path = path.as_ref();
        let at = escape_path(path);
        let (file, identity) = open_regular(path)?;
        let mut head = [0; HEADER];
        let filled = read_head(&file, &mut head).map_err(|e| Error::io(path, "read", &e))?;
        blob_check::check_header(&head[..filled], identity.bytes(), &at)?;
        let length = usize::try_from(identity.bytes())
            .map_err(|_| Error::unsupported(&at, format!("{} bytes do not fit into memory", identity.bytes())))?;
        let changed = || Err(Error::integrity(&at, "the file changed while it was being read"));
        let storage = match mode {
            LoadMode::Map => Storage::Map(map::map(&file, path)?),
            LoadMode::Copy => {
                let mut memory = AlignedBytes::new(length, &at)?;
                let mut reader = &file;
                match reader.read_exact(memory.bytes_mut()) {
                    Ok(()) => Storage::Copy(memory),
                    Err(e) if e.kind() == std::io::ErrorKind::UnexpectedEof => return changed(),
                    Err(e) => return Err(Error::io(path, "read", &e)),
                }
            }
        };
        if storage.bytes().len() != length {
            return changed();
        }
        let parsed = blob_check::parse(storage.bytes(), &at)?;
        if verify == Verify::Digests {
            blob_check::verify_tensors(storage.bytes(), &parsed.tensors, &at)?;
        }
        if Identity::of(&file, path)? != identity {
            return changed();
        }
        Ok(Blob::new(storage, parsed, Some(Origin { path: path.to_path_buf(), file, identity })))
    }

    /// Validates a file that is in memory, digests included, and keeps a 64-byte aligned copy.
    pub fn from_bytes(bytes: &[u8]) -> Result<Blob> {
        let at = "blob in memory";
        let parsed = blob_check::parse(bytes, at)?;
        blob_check::verify_tensors(bytes, &parsed.tensors, at)?;
        let mut memory = AlignedBytes::new(bytes.len(), at)?;
        memory.bytes_mut().copy_from_slice(bytes);
        Ok(Blob::new(Storage::Copy(memory), parsed, None))
    }

    fn new(storage: Storage, parsed: Parsed, origin: Option<Origin>) -> Blob {
        let mut by_name: Vec<u32> = (0..parsed.tensors.len() as u32).collect();
        by_name
            .sort_unstable_by(|&a, &b| parsed.tensors[a as usize].spec.name.cmp(&parsed.tensors[b as usize].spec.name));
        Blob { storage, parsed, by_name, origin }
    }

    /// Sizes and conventions of the network.
    pub fn config(&self) -> &ModelConfig {
        &self.parsed.config
    }

    /// Provenance and other metadata.
    pub fn meta(&self) -> &Meta {
        &self.parsed.meta
    }

    /// All tensors, in order of their place in the file.
    pub fn tensors(&self) -> &[TensorRecord] {
        &self.parsed.tensors
    }

    /// Index of a tensor.
    pub fn find(&self, name: &str) -> Option<usize> {
        let key = |&i: &u32| self.parsed.tensors[i as usize].spec.name.as_str();
        self.by_name.binary_search_by(|i| key(i).cmp(name)).ok().map(|slot| self.by_name[slot] as usize)
    }

    /// Stored bytes of tensor `i`, 64-byte aligned.
    pub fn bytes(&self, i: usize) -> &[u8] {
        let t = &self.parsed.tensors[i];
        &self.storage.bytes()[t.offset..t.offset + t.bytes]
    }

    /// Stored values of tensor `i`, which must be of type f32; matrices in panels ([`crate::panel`]).
    pub fn f32s(&self, i: usize) -> &[f32] {
        let t = &self.parsed.tensors[i];
        assert_eq!(t.dtype, Dtype::F32, "type of {}", t.spec.name);
        bytemuck::cast_slice(self.bytes(i))
    }

    /// Stored bit patterns of tensor `i`, which must be of type f16; always in panels.
    pub fn f16s(&self, i: usize) -> &[u16] {
        let t = &self.parsed.tensors[i];
        assert_eq!(t.dtype, Dtype::F16, "type of {}", t.spec.name);
        bytemuck::cast_slice(self.bytes(i))
    }

    /// Parts of tensor `i`, which must be of type int8.
    pub fn int8(&self, i: usize) -> Int8<'_> {
        Int8::new(self.parsed.tensors[i].int8_layout(), self.bytes(i))
    }

    /// Values of tensor `i` in checkpoint order into `out`, whatever way they are stored. An int8 matrix is
    /// multiplied by its scales and its rotation undone: what the network computes with.
    pub fn read_f32(&self, i: usize, out: &mut Vec<f32>) {
        let t = &self.parsed.tensors[i];
        out.clear();
        if t.dtype == Dtype::Int8 {
            out.resize(t.spec.len(), 0.0);
            self.read_int8(i, out);
            return;
        }
        let Some(order) = Order::of(&t.spec) else {
            out.extend_from_slice(self.f32s(i));
            return;
        };
        out.resize(t.spec.len(), 0.0);
        let mut panel = vec![0.0; order.panel_len()];
        for p in 0..order.panels() {
            let range = p * panel.len()..(p + 1) * panel.len();
            match t.dtype {
                Dtype::F32 => panel.copy_from_slice(&self.f32s(i)[range]),
                Dtype::Int8 => unreachable!("read by its own function"),
                Dtype::F16 => {
                    for (v, &bits) in panel.iter_mut().zip(&self.f16s(i)[range]) {
                        *v = f16::from_bits(bits).to_f32();
                    }
                }
            }
            order.unpack(p, &panel, out);
        }
    }

    fn read_int8(&self, i: usize, out: &mut [f32]) {
        let m = self.int8(i);
        let order = Order::of(&self.parsed.tensors[i].spec).expect("int8 tensors are matrices");
        let (n, k) = (m.layout.n, m.layout.k);
        let mut row = vec![0.0f64; k];
        for o in 0..n {
            for (i, v) in row.iter_mut().enumerate() {
                *v = f64::from(m.data[m.layout.place(o, i)]) * f64::from(m.scales[o]);
            }
            if !m.signs.is_empty() {
                row.chunks_exact_mut(16 * m.signs.len()).for_each(|channels| unrotate(channels, m.signs));
            }
            for (i, v) in row.iter().enumerate() {
                out[order.at(o, i)] = *v as f32;
            }
        }
    }

    /// The file's identity: the SHA-256 of its header section, which covers every tensor's digest.
    pub fn digest(&self) -> &Digest {
        &self.parsed.digest
    }

    /// Fails ([`crate::Status::Integrity`]) unless the file is the expected one.
    pub fn expect_digest(&self, expected: &Digest) -> Result<()> {
        if *expected == self.parsed.digest {
            return Ok(());
        }
        Err(Error::integrity(
            self.place(),
            format!("its digest is {}, expected {}", hex(&self.parsed.digest), hex(expected)),
        ))
    }

    /// Length of the file in bytes.
    pub fn file_bytes(&self) -> usize {
        self.storage.bytes().len()
    }

    /// Where it was opened; `None` for [`Blob::from_bytes`].
    pub fn path(&self) -> Option<&Path> {
        self.origin.as_ref().map(|o| o.path.as_path())
    }

    /// Checks digests and values of all tensors again.
    pub fn verify(&self) -> Result<()> {
        self.unchanged()?;
        blob_check::verify_tensors(self.storage.bytes(), &self.parsed.tensors, &self.place())
    }

    /// Whether a mapped file still is as it was when checked: one system call. A file replaced by
    /// rename counts as unchanged, since the mapping keeps the old one; a copy cannot change.
    pub fn unchanged(&self) -> Result<()> {
        match (&self.storage, &self.origin) {
            (Storage::Map(_), Some(o)) if Identity::of(&o.file, &o.path)? != o.identity => Err(Error::integrity(
                self.place(),
                "the file was changed in place while in use: open it again, or load it by copy",
            )),
            _ => Ok(()),
        }
    }

    fn place(&self) -> String {
        self.path().map_or_else(|| "blob in memory".to_string(), escape_path)
    }
}

impl Storage {
    fn bytes(&self) -> &[u8] {
        match self {
            Storage::Map(m) => m,
            Storage::Copy(m) => m.bytes(),
        }
    }
}

/// As much of the header as the file has.
fn read_head(file: &File, head: &mut [u8]) -> std::io::Result<usize> {
    let mut filled = 0;
    while filled < head.len() {
        match file.read_at(&mut head[filled..], filled as u64) {
            Ok(0) => break,
            Ok(n) => filled += n,
            Err(e) if e.kind() == std::io::ErrorKind::Interrupted => {}
            Err(e) => return Err(e),
        }
    }
    Ok(filled)
}

#[derive(Clone, Copy, Debug, bytemuck::Pod, bytemuck::Zeroable)]
#[repr(C, align(64))]
struct Line([u8; 64]);

/// Memory with the alignment that tensors have in the file.
#[derive(Debug)]
struct AlignedBytes {
    lines: Vec<Line>,
    length: usize,
}

impl AlignedBytes {
    fn new(length: usize, at: &str) -> Result<AlignedBytes> {
        let count = length.div_ceil(64);
        let mut lines = Vec::new();
        lines
            .try_reserve_exact(count)
            .map_err(|_| Error::resource(at, format!("no memory for {length} bytes; load it with a mapping")))?;
        lines.resize(count, Line([0; 64]));
        Ok(AlignedBytes { lines, length })
    }

    fn bytes(&self) -> &[u8] {
        &bytemuck::cast_slice(&self.lines)[..self.length]
    }

    fn bytes_mut(&mut self) -> &mut [u8] {
        &mut bytemuck::cast_slice_mut(&mut self.lines)[..self.length]
    }
}
