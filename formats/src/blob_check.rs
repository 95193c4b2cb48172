//! Validation of a `.sfw` file, cheapest step first; nothing is allocated before the header's digest
//! matches, and nothing ever in proportion to a number the file merely states.
//!
//! Order: fixed header, exact file length, section bounds and caps, header digest, metadata, records
//! (names, types, extents, padding), configuration, the set of tensors. Digests and values of the
//! tensors follow in [`verify_tensors`], digest before value: a flipped bit is damage (status 9) even
//! where it happens to make a NaN.

use crate::arch::{self, TensorSpec};
use crate::blob_layout::{self as layout, Dtype, Layout, header, record};
use crate::config::{ModelConfig, Value};
use crate::digest::{Digest, hex, sha256};
use crate::error::{Error, Result, escape};
use crate::meta::{self, Meta};
use crate::panel::LANES;
use crate::panel_s8::{self, Int8Layout};
use crate::sniff::FileKind;
use sha2::{Digest as _, Sha256};
use std::collections::BTreeMap;
use std::ops::Range;
use std::sync::atomic::{AtomicUsize, Ordering};

/// One tensor of a blob.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct TensorRecord {
    /// Name, checkpoint shape and role.
    pub spec: TensorSpec,
    /// Type of the stored values.
    pub dtype: Dtype,
    /// Their order.
    pub layout: Layout,
    /// Start in the file; a multiple of 64.
    pub offset: usize,
    /// Length in bytes.
    pub bytes: usize,
    /// SHA-256 of those bytes.
    pub digest: Digest,
    /// Values of a block of the inputs' rotation, 0 without one; int8 matrices only.
    pub rotation: usize,
}

impl TensorRecord {
    /// Where the parts of an int8 matrix lie.
    ///
    /// # Panics
    /// When the tensor is not of type int8.
    pub fn int8_layout(&self) -> Int8Layout {
        assert_eq!(self.dtype, Dtype::Int8, "type of {}", self.spec.name);
        Int8Layout::of(&self.spec, self.rotation != 0).expect("checked on opening")
    }
}

/// What a valid file says.
#[derive(Debug)]
pub(crate) struct Parsed {
    pub(crate) config: ModelConfig,
    pub(crate) meta: Meta,
    pub(crate) tensors: Vec<TensorRecord>,
    pub(crate) digest: Digest,
}

/// Sections, as byte ranges; they tile the header section.
struct Sections {
    metadata: Range<usize>,
    metadata_count: u64,
    table: Range<usize>,
    names: Range<usize>,
    data: usize,
}

/// Checks the fixed header (`head`: the first 256 bytes, or all of a shorter file) against the length
/// of the file.
pub(crate) fn check_header(head: &[u8], file_bytes: u64, at: &str) -> Result<()> {
    sections(head, file_bytes, at).map(|_| ())
}

fn sections(head: &[u8], file_bytes: u64, at: &str) -> Result<Sections> {
    let bad = |why: String| Err(Error::model(at, why));
    let unsupported = |why: String| Err(Error::unsupported(at, why));
    if head.is_empty() {
        return bad("the file is empty".into());
    }
    if !head.starts_with(&layout::MAGIC_BYTES[..head.len().min(8)]) {
        return Err(Error::model(at, not_a_blob(head)));
    }
    let Some(h) = head.get(..layout::HEADER) else {
        return bad(format!("cut off: the header needs {} bytes, the file has {file_bytes}", layout::HEADER));
    };
    let endian = header::ENDIAN.number(h) as u32;
    if endian == layout::ENDIAN_WORD.swap_bytes() {
        return unsupported("big-endian blob; only little-endian ones are read: convert the checkpoint again".into());
    }
    if endian != layout::ENDIAN_WORD {
        return bad(format!("byte-order word is {endian:#010x}, must be {:#010x}", layout::ENDIAN_WORD));
    }
    let major = header::MAJOR.number(h);
    if major != u64::from(layout::VERSION.0) {
        return unsupported(format!(
            "blob format version {major}.{}, this program reads {}.x: {}",
            header::MINOR.number(h),
            layout::VERSION.0,
            if major > u64::from(layout::VERSION.0) { "use a newer program" } else { "convert the checkpoint again" },
        ));
    }
    if header::HEADER_LENGTH.number(h) != layout::HEADER as u64 {
        return bad(format!("header length {} must be {}", header::HEADER_LENGTH.number(h), layout::HEADER));
    }
    let architecture = header::ARCHITECTURE.number(h);
    if architecture != u64::from(layout::ARCHITECTURE_STREETFORWARD) {
        return unsupported(format!(
            "architecture id {architecture}; known: {} (StreetForward)",
            layout::ARCHITECTURE_STREETFORWARD
        ));
    }
    let required = header::REQUIRED.number(h);
    if required != 0 {
        return unsupported(format!("required feature bits {required:#x} are unknown: use a newer program"));
    }
    let kind = header::DIGEST_KIND.number(h);
    if kind != u64::from(layout::DIGEST_SHA256) {
        return unsupported(format!("digest algorithm {kind}; known: {} (SHA-256)", layout::DIGEST_SHA256));
    }
    if header::RESERVED.of(h).iter().any(|&b| b != 0) {
        return bad("reserved bytes of the header must be zero".into());
    }
    if file_bytes > layout::MAX_FILE {
        return unsupported(format!("{file_bytes} bytes; the limit is {}", layout::MAX_FILE));
    }
    let stated = header::FILE_LENGTH.number(h);
    if stated != file_bytes {
        let what = if stated > file_bytes { "truncated: copy it again" } else { "extra bytes at the end" };
        return bad(format!("the header says {stated} bytes, the file has {file_bytes}: {what}"));
    }
    if file_bytes < layout::MIN_FILE {
        return bad(format!("{file_bytes} bytes; a blob has at least {}", layout::MIN_FILE));
    }

    let count = header::TENSOR_COUNT.number(h);
    if count == 0 || count > layout::MAX_TENSORS {
        return bad(format!("{count} tensors; must be 1..{}", layout::MAX_TENSORS));
    }
    let mut end = layout::HEADER as u64;
    let mut section = |name: &str, offset: u64, length: u64| {
        if offset != end {
            return Err(Error::model(at, format!("{name} start at {offset}, must be {end}")));
        }
        end = offset
            .checked_add(length)
            .filter(|&e| e <= layout::MAX_HEAD.min(file_bytes))
            .ok_or_else(|| Error::model(at, format!("{name} of {length} bytes do not fit into the header section")))?;
        Ok(offset as usize..end as usize)
    };
    let metadata = section("metadata", header::META_OFFSET.number(h), header::META_LENGTH.number(h))?;
    let table = section("records", header::TABLE_OFFSET.number(h), header::TABLE_LENGTH.number(h))?;
    let names = section("names", header::NAMES_OFFSET.number(h), header::NAMES_LENGTH.number(h))?;
    if table.len() as u64 != count * layout::RECORD as u64 {
        return bad(format!("{} bytes of records for {count} tensors of {} each", table.len(), layout::RECORD));
    }
    let data = header::DATA_OFFSET.number(h);
    let want = names.end.next_multiple_of(layout::DATA_ALIGN as usize) as u64;
    if data != want || data > layout::MAX_HEAD {
        return bad(format!("data start at {data}, must be {want} and at most {}", layout::MAX_HEAD));
    }
    if data.checked_add(header::DATA_LENGTH.number(h)) != Some(file_bytes) || data == file_bytes {
        return bad(format!(
            "data of {} bytes at {data} must end with the file at {file_bytes}",
            header::DATA_LENGTH.number(h)
        ));
    }
    Ok(Sections { metadata, metadata_count: header::META_COUNT.number(h), table, names, data: data as usize })
}

/// Checks the structure of a whole file.
pub(crate) fn parse(bytes: &[u8], at: &str) -> Result<Parsed> {
    let s = sections(&bytes[..bytes.len().min(layout::HEADER)], bytes.len() as u64, at)?;
    let head = &bytes[..s.data];
    let digest = check_digests(head, &s, at)?;
    check_zeros(bytes, s.names.end..s.data, at)?;

    let pairs = meta::decode(&head[s.metadata.clone()], s.metadata_count, at)?;
    let records = records(bytes, &s, at)?;
    let mut settings: BTreeMap<String, Value> = BTreeMap::new();
    let mut meta = Meta::new();
    for (key, value) in pairs {
        match key.strip_prefix(meta::CONFIG_PREFIX) {
            Some(setting) => {
                settings.insert(setting.to_string(), value);
            }
            None => meta.set(&key, value),
        }
    }
    let config = ModelConfig::from_pairs(ModelConfig::base(), &settings, true, at)?;
    config.check(at)?;
    let tensors = match_specs(records, arch::tensors(&config), at)?;
    Ok(Parsed { config, meta, tensors, digest })
}

/// Header digest, then the root over the tensors' digests.
fn check_digests(head: &[u8], s: &Sections, at: &str) -> Result<Digest> {
    let f = header::HEADER_DIGEST;
    let mut hash = Sha256::new();
    hash.update(&head[..f.offset]);
    hash.update([0; 32]);
    hash.update(&head[f.offset + f.size..]);
    let digest: Digest = hash.finalize().into();
    if digest[..] != *f.of(head) {
        return Err(Error::integrity(
            at,
            "the digest of the header does not match: the file is damaged, copy it again",
        ));
    }
    let mut root = Sha256::new();
    for row in head[s.table.clone()].chunks_exact(layout::RECORD) {
        root.update(record::DIGEST.of(row));
    }
    if root.finalize()[..] != *header::TENSOR_ROOT.of(head) {
        return Err(Error::integrity(at, "the root of the tensors' digests does not match the records"));
    }
    Ok(digest)
}

fn check_zeros(bytes: &[u8], range: Range<usize>, at: &str) -> Result<()> {
    match bytes[range.clone()].iter().position(|&b| b != 0) {
        Some(i) => Err(Error::model(at, format!("padding at byte {} is not zero", range.start + i))),
        None => Ok(()),
    }
}

struct Record<'a> {
    name: &'a str,
    shape: Vec<usize>,
    dtype: Dtype,
    layout: Layout,
    offset: usize,
    bytes: usize,
    digest: Digest,
    rotation: usize,
}

/// Reads the records; extents, padding and names are valid and unique afterwards.
fn records<'a>(bytes: &'a [u8], s: &Sections, at: &str) -> Result<Vec<Record<'a>>> {
    let names = &bytes[s.names.clone()];
    let mut name_end = 0usize;
    let mut end = s.data as u64;
    let mut list = Vec::new();
    for (i, row) in bytes[s.table.clone()].chunks_exact(layout::RECORD).enumerate() {
        let length = record::NAME_LENGTH.number(row) as usize;
        if record::NAME_OFFSET.number(row) != name_end as u64 || length == 0 || length > layout::MAX_NAME {
            return Err(Error::model(
                at,
                format!("record {i}: its name must follow the one before and have 1..{} bytes", layout::MAX_NAME),
            ));
        }
        let Some(name) = names.get(name_end..name_end + length) else {
            return Err(Error::model(at, format!("record {i}: its name runs past the names section")));
        };
        name_end += length;
        let r = extent(row, name, (end, bytes.len() as u64), at)?;
        check_zeros(bytes, end as usize..r.offset, at)?;
        end = (r.offset + r.bytes) as u64;
        list.push(r);
    }
    if name_end != names.len() {
        return Err(Error::model(at, format!("{} bytes follow the last name", names.len() - name_end)));
    }
    if end != bytes.len() as u64 {
        return Err(Error::model(at, format!("{} bytes follow the last tensor", bytes.len() as u64 - end)));
    }
    let mut folded: Vec<String> = list.iter().map(|r| r.name.to_ascii_lowercase()).collect();
    folded.sort_unstable();
    if let Some(pair) = folded.windows(2).find(|pair| pair[0] == pair[1]) {
        return Err(Error::model(at, format!("two tensors are called {} (case aside)", pair[0])));
    }
    Ok(list)
}

/// One record; `(end, file)`: where the tensor before ends, and the file.
fn extent<'a>(row: &[u8], name: &'a [u8], (end, file): (u64, u64), at: &str) -> Result<Record<'a>> {
    let shown = || format!("{at}: tensor {}", escape(name));
    let bad = |why: String| Err(Error::model(shown(), why));
    let allowed = |b: &u8| b.is_ascii_alphanumeric() || matches!(b, b'.' | b'_' | b'-');
    let text = match std::str::from_utf8(name) {
        Ok(n) if name.iter().all(allowed) => n,
        _ => return bad("names consist of letters, digits, '.', '_' and '-'".into()),
    };
    let (code, order) = (record::DTYPE.number(row) as u8, record::LAYOUT.number(row) as u8);
    let (Some(dtype), Some(order)) = (Dtype::from_code(code), Layout::from_code(order)) else {
        return Err(Error::unsupported(
            shown(),
            format!(
                "type {code}, layout {order} is unknown; this program reads f32, f16, int8; RowMajor, K1N16, K4N16"
            ),
        ));
    };
    if record::RESERVED.of(row).iter().any(|&b| b != 0) {
        return bad("reserved bytes of the record must be zero".into());
    }
    let rank = record::RANK.number(row) as usize;
    if rank == 0 || rank > layout::MAX_RANK {
        return bad(format!("{rank} dimensions; must be 1..{}", layout::MAX_RANK));
    }
    let dims: Vec<u32> =
        record::DIMS.of(row).chunks_exact(4).map(|d| u32::from_le_bytes([d[0], d[1], d[2], d[3]])).collect();
    if dims[..rank].iter().any(|&d| d == 0 || d > layout::MAX_DIM) || dims[rank..].iter().any(|&d| d != 0) {
        return bad(format!("dimensions {dims:?} of which {rank} count must be 1..{}, the others 0", layout::MAX_DIM));
    }
    let (offset, length) = (record::OFFSET.number(row), record::LENGTH.number(row));
    let stop = offset.checked_add(length).filter(|&e| e <= file);
    if stop.is_none() {
        return bad(format!("{length} bytes at {offset} run past the end of the file at {file}"));
    }
    let values = dims[..rank].iter().try_fold(dtype.size() as u64, |n, &d| n.checked_mul(u64::from(d)));
    // Panels are filled up, int8 ones have scales, sums and signs: the exact length is checked where the role is known.
    let fits = values.is_some_and(|v| if order == Layout::RowMajor { v == length } else { v <= length });
    if !fits {
        return bad(format!("shape {:?} of {} is not {length} bytes", &dims[..rank], dtype.name()));
    }
    let want = layout::align(end, layout::TENSOR_ALIGN).unwrap_or(u64::MAX);
    if offset != want {
        let what = match offset {
            o if o % layout::TENSOR_ALIGN != 0 => "not a multiple of 64",
            o if o < want => "overlap with the tensor before",
            _ => "gap after the tensor before",
        };
        return bad(format!("starts at {offset}, must be {want}: {what}"));
    }
    let mut digest = [0; 32];
    digest.copy_from_slice(record::DIGEST.of(row));
    let shape = dims[..rank].iter().map(|&d| d as usize).collect();
    let rotation = record::ROTATION.number(row) as usize;
    Ok(Record {
        name: text,
        shape,
        dtype,
        layout: order,
        offset: offset as usize,
        bytes: length as usize,
        digest,
        rotation,
    })
}

/// Pairs the records with what the network needs: nothing missing, nothing extra, every shape equal,
/// and each tensor stored the one way its role has.
fn match_specs(records: Vec<Record>, specs: Vec<TensorSpec>, at: &str) -> Result<Vec<TensorRecord>> {
    let mut wanted: BTreeMap<String, TensorSpec> = specs.into_iter().map(|s| (s.name.clone(), s)).collect();
    let (mut tensors, mut extra, mut shapes) = (Vec::new(), Vec::new(), Vec::new());
    for r in records {
        match wanted.remove(r.name) {
            None => extra.push(r.name.to_string()),
            Some(spec) if spec.shape != r.shape => {
                shapes.push(format!("{} is {:?}, must be {:?}", r.name, r.shape, spec.shape));
            }
            Some(spec) => tensors.push(TensorRecord {
                spec,
                dtype: r.dtype,
                layout: r.layout,
                offset: r.offset,
                bytes: r.bytes,
                digest: r.digest,
                rotation: r.rotation,
            }),
        }
    }
    let missing: Vec<String> = wanted.into_keys().collect();
    let mut faults = Vec::new();
    for (what, list) in [("missing", missing), ("not expected", extra), ("of another shape", shapes)] {
        if !list.is_empty() {
            let dots = if list.len() > 5 { ", ..." } else { "" };
            faults.push(format!("{} {what}: {}{dots}", list.len(), list[..list.len().min(5)].join(", ")));
        }
    }
    if !faults.is_empty() {
        return Err(Error::model(at, format!("tensors do not match the configuration: {}", faults.join("; "))));
    }
    for t in &tensors {
        let fault = |why: String| Err(Error::model(format!("{at}: tensor {}", t.spec.name), why));
        let (order, dtype_fits) = match t.spec.matrix() {
            Some(_) => (Layout::of_matrix(t.dtype), true),
            None => (Layout::RowMajor, t.dtype == Dtype::F32),
        };
        if t.layout != order || !dtype_fits {
            return fault(format!(
                "stored as {} {}; matrices are K1N16 f32 or f16 or K4N16 int8, vectors and tables RowMajor f32",
                t.layout.name(),
                t.dtype.name()
            ));
        }
        if t.rotation != 0 {
            let width = panel_s8::rotated_width(&t.spec).filter(|_| t.dtype == Dtype::Int8);
            let block = width.and_then(panel_s8::rotation_block);
            if block != Some(t.rotation) {
                return fault(format!("a rotation by blocks of {} does not fit it", t.rotation));
            }
        }
        let bytes = match (t.spec.matrix(), t.dtype) {
            (Some(_), Dtype::Int8) => Int8Layout::of(&t.spec, t.rotation != 0).map(|s| s.bytes()),
            (Some((n, k)), _) => n.checked_next_multiple_of(LANES).and_then(|n| n.checked_mul(k * t.dtype.size())),
            (None, _) => t.spec.len().checked_mul(t.dtype.size()),
        };
        if bytes != Some(t.bytes) {
            return fault(format!(
                "shape {:?} as {} {} is not {} bytes",
                t.spec.shape,
                t.layout.name(),
                t.dtype.name(),
                t.bytes
            ));
        }
    }
    Ok(tensors)
}

/// Digest, then values of every tensor, on two threads when that pays; the first fault in file order.
pub(crate) fn verify_tensors(bytes: &[u8], tensors: &[TensorRecord], at: &str) -> Result<()> {
    let next = AtomicUsize::new(0);
    let work = || {
        loop {
            // Faults are rare: each worker keeps its first, and the smaller index wins below.
            let i = next.fetch_add(1, Ordering::Relaxed);
            let Some(t) = tensors.get(i) else { return Ok(()) };
            verify_tensor(&bytes[t.offset..t.offset + t.bytes], t, at).map_err(|e| (i, e))?;
        }
    };
    // Starting a thread costs as much as hashing some 100 KiB.
    if bytes.len() < 1 << 20 {
        return work().map_err(|(_, e)| e);
    }
    let both = std::thread::scope(|s| {
        let other = std::thread::Builder::new().spawn_scoped(s, work);
        let mine = work();
        // Without a second thread the first has done everything.
        let other = other.map_or(Ok(()), |t| t.join().unwrap_or_else(|p| std::panic::resume_unwind(p)));
        [mine, other]
    });
    both.into_iter().filter_map(Result::err).min_by_key(|(i, _)| *i).map_or(Ok(()), |(_, e)| Err(e))
}

fn verify_tensor(bytes: &[u8], t: &TensorRecord, at: &str) -> Result<()> {
    let found = sha256(bytes);
    let shown = || format!("{at}: tensor {}", t.spec.name);
    if found != t.digest {
        return Err(Error::integrity(
            shown(),
            format!(
                "SHA-256 is {}..., recorded {}...: the file is damaged, copy it again",
                &hex(&found)[..16],
                &hex(&t.digest)[..16]
            ),
        ));
    }
    // Exponent bits all set: NaN or infinite.
    let bad = match t.dtype {
        Dtype::Int8 => {
            return check_int8(bytes, t).map_or(Ok(()), |why| Err(Error::model(shown(), why)));
        }
        Dtype::F32 => first(bytes, |v| u32::from_le_bytes(v) & 0x7f80_0000 == 0x7f80_0000),
        Dtype::F16 => first(bytes, |v| u16::from_le_bytes(v) & 0x7c00 == 0x7c00),
    };
    if let Some(i) = bad {
        return Err(Error::model(shown(), format!("value {i} is NaN or infinite")));
    }
    if let Some((n, k)) = t.spec.matrix().filter(|(n, _)| n % LANES != 0) {
        let line = LANES * t.dtype.size();
        let last = &bytes[bytes.len() - k * line..];
        if last.chunks_exact(line).any(|l| l[n % LANES * t.dtype.size()..].iter().any(|&b| b != 0)) {
            return Err(Error::model(
                shown(),
                format!("the unused outputs of its last panel ({n} outputs) are not zero"),
            ));
        }
    }
    Ok(())
}

/// What is wrong with the values of an int8 matrix.
fn check_int8(bytes: &[u8], t: &TensorRecord) -> Option<String> {
    let s = t.int8_layout();
    let minus_128 = first(&bytes[..s.panels()], |[v]: [u8; 1]| v == 0x80);
    if let Some(i) = minus_128 {
        return Some(format!("byte {i} is -128; values are -127 to 127"));
    }
    // Unaligned where a test gives the bytes from anywhere.
    let number = |at: usize, o: usize| {
        let b = &bytes[at + 4 * o..][..4];
        u32::from_le_bytes([b[0], b[1], b[2], b[3]])
    };
    let limits = 1.0 / panel_s8::MAX_SCALE..=panel_s8::MAX_SCALE;
    for o in 0..s.n {
        let scale = f32::from_bits(number(s.scales(), o));
        if !limits.contains(&scale) {
            return Some(format!("the scale of output {o} is {scale:e}; it must be within 2^-60..2^60"));
        }
    }
    let zero = |range: Range<usize>| bytes[range].iter().all(|&b| b == 0);
    if !zero(s.scales() + 4 * s.n..s.sums()) || !zero(s.sums() + 4 * s.n..s.signs()) {
        return Some(format!("scales or sums of unused outputs (beyond {}) are not zero", s.n));
    }
    let quads = s.k.div_ceil(panel_s8::QUAD);
    let mut sums = vec![0i32; s.lanes()];
    for (panel, sums) in bytes[..s.panels()].chunks_exact(quads * panel_s8::STEP).zip(sums.as_chunks_mut::<LANES>().0) {
        sum_panel(panel.as_chunks().0, sums);
    }
    for (o, sum) in sums[..s.n].iter().enumerate() {
        let stored = number(s.sums(), o) as i32;
        if stored != *sum {
            return Some(format!("the stored sum of output {o} is {stored}, its values add up to {sum}"));
        }
    }
    let unused = (s.n..s.lanes()).any(|o| (0..s.k).any(|i| bytes[s.place(o, i)] != 0));
    let beyond = s.k..s.k.next_multiple_of(panel_s8::QUAD);
    if unused || (0..s.lanes()).any(|o| beyond.clone().any(|i| bytes[s.place(o, i)] != 0)) {
        return Some(format!("values beyond its {} outputs or {} inputs are not zero", s.n, s.k));
    }
    None
}

/// Sums of the four signed bytes of each of sixteen outputs over all steps of a panel. As words: bytes moved up by 128, every other one
/// of them added in the halves of a word, which hold 128 steps of two bytes; a byte at a time takes four times as long.
fn sum_panel(steps: &[[u8; panel_s8::STEP]], sums: &mut [i32; LANES]) {
    const EVEN: u32 = 0x00ff_00ff;
    for some in steps.chunks(128) {
        let mut halves = [0u32; LANES];
        for step in some {
            for (half, quad) in halves.iter_mut().zip(step.as_chunks::<{ panel_s8::QUAD }>().0) {
                let up = u32::from_le_bytes(*quad) ^ 0x8080_8080;
                *half += (up & EVEN) + (up >> 8 & EVEN);
            }
        }
        let moved = (some.len() * panel_s8::QUAD * 128) as i32;
        for (sum, half) in sums.iter_mut().zip(halves) {
            *sum += (half & 0xffff) as i32 + (half >> 16) as i32 - moved;
        }
    }
}

/// Index of the first value with a property. The common answer, none, is found without a branch per
/// value, at memory speed.
fn first<const N: usize>(bytes: &[u8], test: impl Fn([u8; N]) -> bool) -> Option<usize> {
    let (values, _) = bytes.as_chunks::<N>();
    let any = values.iter().fold(false, |any, &v| any | test(v));
    if any { values.iter().position(|&v| test(v)) } else { None }
}

/// What a file without our magic is, and what to do with it.
fn not_a_blob(head: &[u8]) -> String {
    let utf8: &[&[u8]] = &[
        &[0xc2, 0x89, b'S', b'F', b'W'],
        &[0xef, 0xbf, 0xbd, b'S', b'F', b'W'],
        &[0xef, 0xbb, 0xbf, 0xc2, 0x89, b'S', b'F', b'W'],
    ];
    let damage = if head.starts_with(&[0xef, 0xbb, 0xbf, 0x89, b'S', b'F', b'W']) {
        "a byte-order mark was put in front of it"
    } else if utf8.iter().any(|u| head.starts_with(u)) {
        "it was re-encoded as UTF-8 text"
    } else if head.starts_with(&[0x09, b'S', b'F', b'W']) {
        "its high bits were stripped"
    } else if head.starts_with(&layout::MAGIC_BYTES[..4]) {
        "its line ends were changed as if it were text"
    } else {
        let kind = FileKind::of_bytes(head);
        let run = match kind {
            FileKind::Safetensors | FileKind::Zip | FileKind::Pickle | FileKind::Tar => {
                "; run `streetforward convert` on it"
            }
            FileKind::Unknown => {
                return format!("not a weight blob: it starts with {}", escape(&head[..head.len().min(8)]));
            }
            _ => "",
        };
        return format!("not a weight blob: {}{run}", kind.advice());
    };
    format!("a damaged weight blob: {damage}; copy it again in binary mode")
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn sums_of_a_panel_are_those_of_its_bytes() {
        let mut state = 1u32;
        for steps in [0, 1, 2, 127, 128, 129, 300] {
            // Whole blocks of the largest and the smallest byte fill the halves of a word the most.
            for kind in 0..3 {
                let panel: Vec<[u8; panel_s8::STEP]> = (0..steps)
                    .map(|_| {
                        std::array::from_fn(|_| {
                            state = state.wrapping_mul(1_664_525).wrapping_add(1_013_904_223);
                            [(state >> 24) as u8, 127, 0x80][kind]
                        })
                    })
                    .collect();
                let mut sums = [5i32; LANES];
                sum_panel(&panel, &mut sums);
                for (o, sum) in sums.iter().enumerate() {
                    let bytes = panel.iter().flat_map(|step| &step[o * panel_s8::QUAD..][..panel_s8::QUAD]);
                    assert_eq!(*sum, 5 + bytes.map(|&b| i32::from(b as i8)).sum::<i32>(), "{steps} steps, output {o}");
                }
            }
        }
    }
}
