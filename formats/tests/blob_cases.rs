//! The cases of bad (and good) weight blobs, one test per case, named with its id.

use sf_formats::arch;
use sf_formats::atomic::Overwrite;
use sf_formats::blob_layout::{self as layout, Field, header, record};
use sf_formats::blob_writer::QuantizedMatrix;
use sf_formats::config::{Head, ModelConfig, Trunk, Value};
use sf_formats::digest::sha256;
use sf_formats::panel_s8::{rotated_width, rotation_block};
use sf_formats::{Blob, BlobWriter, Dtype, Layout, LoadMode, Meta, Verify};
use std::path::Path;

/// The cases covered here; memory plans (b26) are not in the format.
pub const CASES: [&str; 34] = [
    "b01", "b02", "b03", "b04", "b05", "b06", "b07", "b08", "b09", "b10", "b11", "b12", "b13", "b14", "b15", "b16",
    "b17", "b18", "b19", "b20", "b21", "b22", "b23", "b24", "b25", "b27", "b28", "b29", "b30", "b31", "b32", "b33",
    "b34", "b36",
];

#[test]
fn every_listed_case_has_a_test() {
    let source = include_str!("blob_cases.rs");
    for id in CASES {
        assert!(source.contains(&format!("\nfn {id}_")), "{id}");
    }
    assert_eq!(source.matches("\nfn b").count(), CASES.len() + 1, "fn build and one test per case");
}

/// The smallest network with every kind of storage: linear, convolution, transposed convolution,
/// vectors, tables, f32 and f16.
fn tiny() -> ModelConfig {
    let trunk = Trunk { dim: 4, depth: 1, heads: 1, registers: 0, mlp_ratio: 1, eps: 1e-6 };
    ModelConfig {
        patch: 1,
        encoder: trunk.clone(),
        pos_grid: 1,
        aa: Trunk { depth: 2, ..trunk },
        camera_dim: 4,
        camera_depth: 0,
        camera_heads: 1,
        camera_width: 4,
        depth: Head::xdec_linear(3, 4, 0, 1),
        conf: Head::none(),
        ..ModelConfig::pi3()
    }
}

fn values(len: usize, seed: usize) -> Vec<f32> {
    (0..len).map(|i| ((i * 7 + seed * 13) % 101) as f32 / 64.0 - 0.75).collect()
}

fn fill(mut w: BlobWriter) -> BlobWriter {
    for (i, spec) in w.specs().to_vec().iter().enumerate() {
        let dtype = if i % 3 != 1 { Dtype::F16 } else { Dtype::F32 };
        w.write(&values(spec.len(), i), dtype).unwrap();
    }
    w
}

fn build(config: &ModelConfig) -> Vec<u8> {
    let mut meta = Meta::new();
    meta.set_text(sf_formats::meta::keys::LICENCE, "test");
    fill(BlobWriter::in_memory(config, &meta).unwrap()).finish_bytes().unwrap()
}

#[test]
fn what_is_written_is_read() {
    let config = ModelConfig { gs: Head::dpt(11, [0, 0, 0, 0], [4, 4, 4, 4], 8), ..tiny() };
    let bytes = build(&config);
    let dir = tempfile::tempdir().unwrap();
    let path = dir.path().join("m.sfw");
    let mut meta = Meta::new();
    meta.set_text(sf_formats::meta::keys::LICENCE, "test");
    let digest = fill(BlobWriter::create(&path, Overwrite::No, &config, &meta).unwrap()).finish().unwrap();
    assert_eq!(std::fs::read(&path).unwrap(), bytes, "the same bytes on disk and in memory, and twice");

    let memory = Blob::from_bytes(&bytes).unwrap();
    for blob in [
        &memory,
        &Blob::open(&path, LoadMode::Map, Verify::Digests).unwrap(),
        &Blob::open(&path, LoadMode::Copy, Verify::Structure).unwrap(),
    ] {
        assert_eq!(*blob.config(), config);
        assert_eq!(*blob.meta(), meta);
        assert_eq!(*blob.digest(), digest);
        blob.expect_digest(&digest).unwrap();
        blob.unchanged().unwrap();
        blob.verify().unwrap();
        assert_eq!(blob.find("no.such"), None);
        let mut out = Vec::new();
        for (i, spec) in arch::tensors(&config).iter().enumerate() {
            let t = blob.find(&spec.name).unwrap();
            assert_eq!(blob.tensors()[t].spec, *spec);
            blob.read_f32(t, &mut out);
            // Multiples of 1/64 below 1 are exact in f16.
            assert_eq!(out, values(spec.len(), i), "{}", spec.name);
            assert_eq!(blob.bytes(t).as_ptr().align_offset(64), 0);
        }
    }
}

/// A valid blob to damage, with digests made right again on demand.
#[derive(Clone)]
struct Forge(Vec<u8>);

impl Forge {
    fn new() -> Forge {
        Forge(build(&tiny()))
    }

    fn number(&self, f: Field) -> usize {
        f.number(&self.0) as usize
    }

    fn set(mut self, f: Field, value: u64) -> Forge {
        f.put_number(&mut self.0, value);
        self
    }

    fn row(&self, i: usize) -> usize {
        self.number(header::TABLE_OFFSET) + i * layout::RECORD
    }

    fn rows(&self) -> usize {
        self.number(header::TENSOR_COUNT)
    }

    fn get_in(&self, i: usize, f: Field) -> u64 {
        f.number(&self.0[self.row(i)..])
    }

    fn set_in(mut self, i: usize, f: Field, value: u64) -> Forge {
        let at = self.row(i);
        f.put_number(&mut self.0[at..], value);
        self
    }

    fn put(mut self, at: usize, bytes: &[u8]) -> Forge {
        self.0[at..at + bytes.len()].copy_from_slice(bytes);
        self
    }

    fn dims(self, i: usize, dims: &[u32]) -> Forge {
        let at = self.row(i) + record::DIMS.offset;
        let mut bytes = [0; 20];
        for (to, d) in bytes.chunks_exact_mut(4).zip(dims) {
            to.copy_from_slice(&d.to_le_bytes());
        }
        self.put(at, &bytes).set_in(i, record::RANK, dims.len() as u64)
    }

    fn name(&self, i: usize) -> (usize, String) {
        let at = self.number(header::NAMES_OFFSET) + self.get_in(i, record::NAME_OFFSET) as usize;
        let length = self.get_in(i, record::NAME_LENGTH) as usize;
        (at, String::from_utf8(self.0[at..at + length].to_vec()).unwrap())
    }

    fn find(&self, name: &str) -> usize {
        (0..self.rows()).find(|&i| self.name(i).1 == name).unwrap()
    }

    /// Replaces the eight bytes of an integer of the configuration.
    fn setting(self, key: &str, value: i64) -> Forge {
        let key = format!("config.{key}");
        let at = self.0.windows(key.len()).position(|w| w == key.as_bytes()).unwrap() + key.len();
        self.put(at, &value.to_le_bytes())
    }

    /// Recomputes the digests of tensors that lie inside the file, the root and the header's digest.
    fn stamp(mut self) -> Forge {
        let mut root = Vec::new();
        for i in 0..self.rows().min(100) {
            let (o, n) = (self.get_in(i, record::OFFSET) as usize, self.get_in(i, record::LENGTH) as usize);
            let row = self.row(i);
            if let Some(bytes) = o.checked_add(n).and_then(|end| self.0.get(o..end)) {
                let digest = sha256(bytes);
                record::DIGEST.put(&mut self.0[row..], &digest);
            }
            root.extend_from_slice(record::DIGEST.of(&self.0[row..]));
        }
        header::TENSOR_ROOT.put(&mut self.0, &sha256(&root));
        header::HEADER_DIGEST.put(&mut self.0, &[0; 32]);
        let data = self.number(header::DATA_OFFSET).min(self.0.len());
        let digest = sha256(&self.0[..data]);
        header::HEADER_DIGEST.put(&mut self.0, &digest);
        self
    }

    #[track_caller]
    fn refused(&self, status: i32, text: &str) {
        refused(&self.0, status, text);
    }
}

#[track_caller]
fn refused(bytes: &[u8], status: i32, text: &str) {
    let e = Blob::from_bytes(bytes).expect_err("accepted");
    assert!(e.status() as i32 == status && e.to_string().contains(text), "status {}: {e}", e.status() as i32);
    assert!(e.line().len() <= 300 && e.line().is_ascii(), "{}", e.line());
}

#[track_caller]
fn refused_file(path: &Path, status: i32, text: &str) {
    for mode in [LoadMode::Map, LoadMode::Copy] {
        let e = Blob::open(path, mode, Verify::Digests).expect_err("accepted");
        assert!(e.status() as i32 == status && e.to_string().contains(text), "status {}: {e}", e.status() as i32);
    }
}

fn saved(dir: &Path, bytes: &[u8]) -> std::path::PathBuf {
    let path = dir.join("model.sfw");
    std::fs::write(&path, bytes).unwrap();
    path
}

#[test]
fn stamping_a_good_blob_changes_nothing() {
    let good = Forge::new();
    assert_eq!(good.clone().stamp().0, good.0);
    Blob::from_bytes(&good.0).unwrap();
}

/// Past the digests every number of the header section is in an attacker's hands: random damage with
/// digests made right again is refused with a listed status, or gives a blob that can be read.
#[test]
fn damage_under_right_digests_is_survived() {
    let good = Forge::new();
    let head = good.number(header::NAMES_OFFSET) + good.number(header::NAMES_LENGTH);
    let mut state = 1u64;
    let mut below = |n: usize| {
        // Knuth's linear congruential generator; the high bits are the good ones.
        state = state.wrapping_mul(6364136223846793005).wrapping_add(1442695040888963407);
        (state >> 33) as usize % n
    };
    let (mut accepted, mut refused) = (0, 0);
    for _ in 0..4000 {
        let mut f = good.clone();
        for _ in 0..1 + below(3) {
            let at = layout::MAGIC_BYTES.len() + below(head - layout::MAGIC_BYTES.len());
            f.0[at] = [0, 1, 0x7f, 0x80, 0xff, below(256) as u8][below(6)];
        }
        let f = if f.number(header::DATA_OFFSET) == good.number(header::DATA_OFFSET)
            && f.number(header::TABLE_OFFSET) == good.number(header::TABLE_OFFSET)
            && f.rows() == good.rows()
        {
            f.stamp()
        } else {
            f
        };
        match Blob::from_bytes(&f.0) {
            Ok(blob) => {
                accepted += 1;
                let mut out = Vec::new();
                for i in 0..blob.tensors().len() {
                    blob.read_f32(i, &mut out);
                    assert_eq!(out.len(), blob.tensors()[i].spec.len());
                }
            }
            Err(e) => {
                refused += 1;
                assert!([4, 7, 9].contains(&(e.status() as i32)), "{e}");
            }
        }
    }
    // Both must have happened: metadata and optional bits may change, everything else may not.
    assert!(accepted > 10 && refused > 1000, "{accepted} accepted, {refused} refused");
}

#[test]
fn b01_empty_file() {
    refused(b"", 4, "empty");
    let dir = tempfile::tempdir().unwrap();
    refused_file(&saved(dir.path(), b""), 4, "empty");
}

#[test]
fn b02_shorter_than_the_header() {
    refused(&Forge::new().0[..255], 4, "needs 256 bytes, the file has 255");
    refused(&Forge::new().0[..5], 4, "needs 256 bytes, the file has 5");
}

#[test]
fn b03_truncated_at_every_byte() {
    let good = Forge::new().0;
    assert!(good.len() <= 64 << 10, "{}", good.len());
    for n in 0..good.len() {
        let e = Blob::from_bytes(&good[..n]).err().unwrap_or_else(|| panic!("accepted {n} bytes"));
        assert_eq!(e.status() as i32, 4, "{n} bytes: {e}");
    }
    // The same with a header that agrees with the shorter length.
    for n in (0..good.len()).filter(|n| *n >= layout::HEADER) {
        let cut = Forge(good[..n].to_vec()).set(header::FILE_LENGTH, n as u64);
        let data = cut.number(header::DATA_OFFSET);
        let cut = cut.set(header::DATA_LENGTH, n.saturating_sub(data) as u64);
        let cut = if n >= data { cut.stamp() } else { cut };
        assert_eq!(Blob::from_bytes(&cut.0).unwrap_err().status() as i32, 4, "{n} bytes");
    }
}

#[test]
fn b04_extra_bytes_at_the_end() {
    for extra in [1, 64, 4096] {
        let mut f = Forge::new();
        f.0.resize(f.0.len() + extra, 0);
        f.refused(4, "extra bytes at the end");
        let length = f.0.len() as u64;
        let data = f.number(header::DATA_OFFSET) as u64;
        let f = f.set(header::FILE_LENGTH, length).set(header::DATA_LENGTH, length - data).stamp();
        f.refused(4, &format!("{extra} bytes follow the last tensor"));
    }
}

#[test]
fn b05_other_formats_are_named() {
    let safetensors = [&40u64.to_le_bytes()[..], b"{\"a\":{}}", &[b' '; 31]].concat();
    for (bytes, text) in [
        (&safetensors[..], "safetensors checkpoint; convert it first; run `streetforward convert`"),
        (b"GGUF\x03\0\0\0", "GGUF"),
        (b"\x08\x07\x12\x07pytorch", "ONNX"),
        (
            b"PK\x03\x04\x14\0",
            "zip archive (PyTorch checkpoint, or something else zipped); run `streetforward convert`",
        ),
        (b"\x7fELF\x02\x01", "ELF"),
        (b"\x89PNG\r\n\x1a\n", "PNG"),
        (b"version https://git-lfs.github.com/spec/v1\n", "git lfs pull"),
        (&[0; 8192], "not a weight blob: it starts with \\x00"),
        (b"hello \x1b[31m", "not a weight blob: it starts with hello \\x1b["),
    ] {
        refused(bytes, 4, text);
    }
}

#[test]
fn b06_text_mode_damage() {
    let good = Forge::new().0;
    let replaced = |from: &[u8], to: &[u8]| {
        let mut out = Vec::new();
        let mut rest = &good[..];
        while let Some(&b) = rest.first() {
            if rest.starts_with(from) {
                out.extend_from_slice(to);
                rest = &rest[from.len()..];
            } else {
                out.push(b);
                rest = &rest[1..];
            }
        }
        out
    };
    refused(&replaced(b"\r\n", b"\n"), 4, "line ends");
    refused(&replaced(b"\n", b"\r\n"), 4, "line ends");
    refused(&replaced(b"\r", b"\n"), 4, "line ends");
    refused(&[b"\xef\xbb\xbf", &good[..]].concat(), 4, "byte-order mark");
    refused(&good.iter().map(|b| b & 0x7f).collect::<Vec<u8>>(), 4, "high bits");
    let latin1: String = good.iter().map(|&b| char::from(b)).collect();
    refused(latin1.as_bytes(), 4, "UTF-8");
    refused(String::from_utf8_lossy(&good).as_bytes(), 4, "UTF-8");
}

#[test]
fn b07_other_major_versions() {
    Forge::new().set(header::MAJOR, 2).refused(7, "version 2.1, this program reads 1.x: use a newer program");
    Forge::new().set(header::MAJOR, 0).refused(7, "version 0.1, this program reads 1.x: convert");
    // A newer minor version is compatible.
    let minor = Forge::new().set(header::MINOR, 9).stamp();
    Blob::from_bytes(&minor.0).unwrap();
}

#[test]
fn b08_swapped_byte_order() {
    Forge::new().set(header::ENDIAN, 0x0403_0201).refused(7, "big-endian");
    Forge::new().set(header::ENDIAN, 0x0102_0305).refused(4, "byte-order word");
}

#[test]
fn b09_absurd_tensor_counts() {
    for count in [0, 8193, 1 << 32, u64::MAX] {
        Forge::new().set(header::TENSOR_COUNT, count).refused(4, &format!("{count} tensors; must be 1..8192"));
    }
    let one_more = Forge::new().rows() as u64 + 1;
    Forge::new().set(header::TENSOR_COUNT, one_more).refused(4, "bytes of records");
    // Section lengths that wrap around.
    for field in [header::META_LENGTH, header::TABLE_LENGTH, header::NAMES_LENGTH, header::DATA_LENGTH] {
        for value in [u64::MAX, u64::MAX - 255, 1 << 40] {
            assert_eq!(Blob::from_bytes(&Forge::new().set(field, value).0).unwrap_err().status() as i32, 4);
        }
    }
}

#[test]
fn b10_absurd_dimensions() {
    let f = Forge::new();
    f.clone().dims(3, &[0, 4]).stamp().refused(4, "dimensions");
    f.clone().dims(3, &[(1 << 24) + 1]).stamp().refused(4, "dimensions");
    f.clone().dims(3, &[1 << 24; 5]).stamp().refused(4, "is not");
    f.clone().set_in(3, record::RANK, 0).stamp().refused(4, "0 dimensions");
    f.clone().set_in(3, record::RANK, 6).stamp().refused(4, "6 dimensions");
    // A dimension beyond the rank.
    let at = f.row(3) + record::DIMS.offset + 16;
    f.put(at, &[1]).stamp().refused(4, "the others 0");
}

#[test]
fn b11_shape_times_type_is_not_the_length() {
    let f = Forge::new();
    let vector = f.find("encoder.norm.bias");
    f.clone().set_in(vector, record::LENGTH, 12).stamp().refused(4, "encoder.norm.bias: shape [4] of f32 is not 12");
    f.clone().set_in(vector, record::LENGTH, 20).stamp().refused(4, "encoder.norm.bias: shape [4] of f32 is not 20");
    let matrix = f.find("point_head.proj.weight");
    f.clone().set_in(matrix, record::LENGTH, 16).stamp().refused(4, "point_head.proj.weight: shape");
    // f32 stored where f16 is stated: half the values would be left over.
    let wide = (0..f.rows()).find(|&i| f.get_in(i, record::DTYPE) == 1 && f.get_in(i, record::LAYOUT) == 1).unwrap();
    let name = f.name(wide).1;
    f.set_in(wide, record::DTYPE, 2).stamp().refused(4, &format!("{name}: shape"));
}

#[test]
fn b12_extents_past_the_end() {
    let f = Forge::new();
    let last = f.rows() - 1;
    for (offset, length) in [(u64::MAX - 63, 128), (1 << 63, 1 << 63), (f.0.len() as u64, 64), (64, u64::MAX)] {
        let bad = f.clone().set_in(last, record::OFFSET, offset).set_in(last, record::LENGTH, length);
        bad.stamp().refused(4, "past the end of the file");
    }
}

#[test]
fn b13_unaligned_offset() {
    let f = Forge::new();
    let at = f.get_in(2, record::OFFSET);
    f.set_in(2, record::OFFSET, at + 4).stamp().refused(4, "not a multiple of 64");
}

#[test]
fn b14_overlaps_and_zero_sizes() {
    let f = Forge::new();
    let first = f.get_in(0, record::OFFSET);
    f.clone().set_in(1, record::OFFSET, first).stamp().refused(4, "overlap");
    f.clone().set_in(1, record::OFFSET, 0).stamp().refused(4, "overlap");
    f.set_in(1, record::LENGTH, 0).stamp().refused(4, "is not 0 bytes");
}

#[test]
fn b15_gaps_and_hidden_bytes() {
    let f = Forge::new();
    let at = f.get_in(5, record::OFFSET);
    f.clone().set_in(5, record::OFFSET, at + 64).stamp().refused(4, "gap");
    let padded = (0..f.rows()).find(|&i| !f.get_in(i, record::LENGTH).is_multiple_of(64)).unwrap();
    let end = (f.get_in(padded, record::OFFSET) + f.get_in(padded, record::LENGTH)) as usize;
    f.clone().put(end, &[1]).stamp().refused(4, &format!("padding at byte {end} is not zero"));
    let before = f.number(header::DATA_OFFSET) - 1;
    f.clone().put(before, &[1]).stamp().refused(4, &format!("padding at byte {before} is not zero"));
    f.clone().put(header::RESERVED.offset + 7, &[1]).stamp().refused(4, "reserved");
    let reserved = f.row(1) + record::RESERVED.offset;
    f.clone().put(reserved, &[1]).stamp().refused(4, "reserved");
    // Unused outputs of a matrix's last panel: 4 of 16 are used.
    let matrix = f.find("camera_head.fc_t.weight");
    let size = if f.get_in(matrix, record::DTYPE) == 1 { 4 } else { 2 };
    let at = f.get_in(matrix, record::OFFSET) as usize + 3 * size;
    f.put(at, &[0, 1]).stamp().refused(4, "last panel (3 outputs)");
}

#[test]
fn b16_duplicate_names() {
    let f = Forge::new();
    let (a, first) = f.name(f.find("camera_head.more_mlps.0.weight"));
    let (b, _) = f.name(f.find("camera_head.more_mlps.2.weight"));
    f.clone().put(b, first.as_bytes()).stamp().refused(4, "two tensors are called camera_head.more_mlps.0.weight");
    f.clone().put(b, first.to_uppercase().as_bytes()).stamp().refused(4, "case aside");
    f.put(a + first.len() - 1, &[0]).stamp().refused(4, "camera_head.more_mlps.0.weigh\\x00");
}

#[test]
fn b17_names_with_bad_characters() {
    let f = Forge::new();
    let (at, _) = f.name(4);
    for (bytes, text) in
        [(&b"\x1b[31m"[..], "\\x1b[31m"), (b"\xff", "\\xff"), (b"../", "../"), (b" ", " "), (b"\\", "\\x5c")]
    {
        f.clone().put(at, bytes).stamp().refused(4, text);
    }
    f.clone().set_in(4, record::NAME_LENGTH, 129).stamp().refused(4, "1..128 bytes");
    f.clone().set_in(4, record::NAME_LENGTH, 0).stamp().refused(4, "1..128 bytes");
    f.set_in(4, record::NAME_OFFSET, 0).stamp().refused(4, "must follow");
}

#[test]
fn b18_unknown_types_and_feature_bits() {
    let f = Forge::new();
    f.clone().set_in(2, record::DTYPE, 9).stamp().refused(7, "type 9");
    f.clone().set_in(2, record::LAYOUT, 7).stamp().refused(7, "layout 7");
    f.clone().set(header::REQUIRED, 1 << 40).refused(7, "0x10000000000");
    f.clone().set(header::DIGEST_KIND, 2).refused(7, "digest algorithm 2");
    // Optional features may be ignored.
    let optional = f.set(header::OPTIONAL, u64::MAX).stamp();
    Blob::from_bytes(&optional.0).unwrap();
}

/// A blob with int8 matrices wherever they can be, rotated where the width allows; two of them are
/// `camera_head.fc_rot.weight` `[9, 32]` and `point_head.proj.weight` `[3, 20]`.
fn int8_blob() -> Vec<u8> {
    let trunk = Trunk { dim: 32, ..tiny().encoder };
    let config = ModelConfig {
        encoder: trunk.clone(),
        aa: Trunk { depth: 2, ..trunk },
        camera_width: 32,
        depth: Head::xdec_linear(3, 20, 0, 1),
        ..tiny()
    };
    let mut w = BlobWriter::in_memory(&config, &Meta::new()).unwrap();
    for (i, spec) in w.specs().to_vec().iter().enumerate() {
        let Some((n, k)) = spec.matrix() else {
            w.write(&values(spec.len(), i), Dtype::F32).unwrap();
            continue;
        };
        let bytes: Vec<i8> = (0..n * k).map(|v| ((v * 7 + i) % 255) as i8).map(|v| v.max(-127)).collect();
        let scales: Vec<f32> = (0..n).map(|o| 0.25 * (o + 1) as f32).collect();
        let width = rotated_width(spec).unwrap();
        let signs = vec![0x1234; if rotation_block(width).is_some() { width / 16 } else { 0 }];
        w.write_int8(QuantizedMatrix { values: &bytes, scales: &scales, signs: &signs }).unwrap();
    }
    w.finish_bytes().unwrap()
}

#[test]
fn int8_matrices_are_read_as_written() {
    let bytes = int8_blob();
    let blob = Blob::from_bytes(&bytes).unwrap();
    let i = blob.find("camera_head.fc_rot.weight").unwrap();
    let (t, m) = (&blob.tensors()[i], blob.int8(i));
    assert_eq!((t.dtype, t.layout, t.rotation), (Dtype::Int8, Layout::K4N16, 32));
    assert_eq!((m.layout.n, m.layout.k, m.data.len(), m.signs), (9, 32, 16 * 32, &[0x1234, 0x1234][..]));
    assert_eq!((m.scales[8], m.sums.len()), (2.25, 9));
    let stored = |o: usize, k: usize| m.data[m.layout.place(o, k)];
    assert_eq!(stored(0, 1), stored(0, 0).wrapping_add(7));
    let mut out = Vec::new();
    blob.read_f32(i, &mut out);
    // A rotation keeps the length of every row.
    for o in 0..9 {
        let want: f64 = (0..32).map(|k| (f64::from(stored(o, k)) * f64::from(m.scales[o])).powi(2)).sum();
        let have: f64 = out[o * 32..(o + 1) * 32].iter().map(|&v| f64::from(v).powi(2)).sum();
        assert!((have / want - 1.0).abs() < 1e-6);
    }
    // Without rotation the values themselves.
    let i = blob.find("point_head.proj.weight").unwrap();
    let m = blob.int8(i);
    assert_eq!((blob.tensors()[i].rotation, m.signs.len()), (0, 0));
    blob.read_f32(i, &mut out);
    assert_eq!(out[2 * 20 + 5], f32::from(m.data[m.layout.place(2, 5)]) * 0.75);
}

/// Bytes of the int8 matrix `[9, 32]`: panels, scales, sums, signs.
const INT8: [usize; 4] = [0, 16 * 32, 16 * 32 + 64, 16 * 32 + 128];

fn int8_matrix() -> (Forge, usize) {
    let f = Forge(int8_blob());
    let at = f.get_in(f.find("camera_head.fc_rot.weight"), record::OFFSET) as usize;
    (f, at)
}

#[test]
fn b20_scales_out_of_range() {
    let (f, at) = int8_matrix();
    for bad in [f32::NAN, f32::INFINITY, f32::NEG_INFINITY, 0.0, -0.0, -1.0, 1e-40, 8e-19, 1.3e18] {
        let f = f.clone().put(at + INT8[1] + 4 * 7, &bad.to_le_bytes()).stamp();
        f.refused(4, "camera_head.fc_rot.weight: the scale of output 7 is ");
    }
    for good in [1e-18f32, 1.1e18] {
        Blob::from_bytes(&f.clone().put(at + INT8[1], &good.to_le_bytes()).stamp().0).unwrap();
    }
    f.put(at + INT8[1] + 4 * 9, &1.0f32.to_le_bytes()).stamp().refused(4, "scales or sums of unused outputs");
}

#[test]
fn b21_a_byte_of_minus_128() {
    let (f, at) = int8_matrix();
    f.put(at + 70, &[0x80]).stamp().refused(4, "camera_head.fc_rot.weight: byte 70 is -128");
}

#[test]
fn b22_sums_that_are_not_the_sums() {
    let (f, at) = int8_matrix();
    let sum = i32::from_le_bytes(f.0[at + INT8[2] + 12..][..4].try_into().unwrap());
    let bad = f.clone().put(at + INT8[2] + 12, &(sum + 1).to_le_bytes()).stamp();
    bad.refused(4, "camera_head.fc_rot.weight: the stored sum of output 3 is ");
    // A changed weight under right digests shows here, too.
    let byte = f.0[at + 4];
    f.clone().put(at + 4, &[byte ^ 1]).stamp().refused(4, "the stored sum of output 1 is ");
    // Padding of outputs, with the sums left right.
    f.put(at + 4 * 9, &[1]).stamp().refused(4, "values beyond its 9 outputs or 32 inputs are not zero");
}

#[test]
fn int8_extents_and_rotations_are_checked() {
    let (f, _) = int8_matrix();
    let i = f.find("camera_head.fc_rot.weight");
    for block in [16, 64, 128, 1, u64::from(u32::MAX)] {
        f.clone().set_in(i, record::ROTATION, block).stamp().refused(4, "a rotation by blocks of");
    }
    // Without rotation there are no signs: four bytes too many.
    f.clone().set_in(i, record::ROTATION, 0).stamp().refused(4, "as K4N16 int8 is not 644 bytes");
    let narrow = f.find("point_head.proj.weight");
    f.clone().set_in(narrow, record::ROTATION, 16).stamp().refused(4, "a rotation by blocks of 16 does not fit");
    let vector = f.find("encoder.norm.bias");
    f.clone().set_in(vector, record::ROTATION, 32).stamp().refused(4, "a rotation by blocks of 32 does not fit");
    f.clone().set_in(i, record::LAYOUT, 1).stamp().refused(4, "stored as K1N16 int8");
    f.set_in(i, record::DTYPE, 2).stamp().refused(4, "camera_head.fc_rot.weight");
}

/// What only becomes known while tensors are written is put in its place at the end; a check that fails leaves no file.
#[test]
fn late_metadata_and_checks() {
    let dir = tempfile::tempdir().unwrap();
    let path = dir.path().join("m.sfw");
    let mut meta = Meta::new();
    meta.set("late.reals", Value::Floats(vec![0.0; 2]));
    let start = |overwrite| BlobWriter::create(&path, overwrite, &tiny(), &meta).unwrap();
    let late = |v: &[f64]| ("late.reals".to_string(), Value::Floats(v.to_vec()));
    let look = |temp: &Path| {
        let seen = Blob::open(temp, LoadMode::Map, Verify::Digests)?;
        assert_eq!(seen.meta().get("late.reals"), Some(&Value::Floats(vec![0.0; 2])));
        assert!(!path.exists());
        Ok(vec![late(&[1.5, 2.5])])
    };
    let digest = fill(start(Overwrite::No)).finish_checked(look).unwrap();
    let blob = Blob::open(&path, LoadMode::Map, Verify::Digests).unwrap();
    assert_eq!((blob.digest(), blob.meta().get("late.reals")), (&digest, Some(&late(&[1.5, 2.5]).1)));
    std::fs::remove_file(&path).unwrap();
    let e = fill(start(Overwrite::No)).finish_checked(|_| Err(sf_formats::Error::usage("no"))).unwrap_err();
    assert_eq!((e.status() as i32, std::fs::read_dir(dir.path()).unwrap().count()), (2, 0));
    let mut w = start(Overwrite::No);
    assert!(w.replace("late.reals", Value::Floats(vec![0.0; 3])).is_err());
    assert!(w.replace("other", Value::Int(0)).is_err());
    assert!(w.replace("config.mask.k", Value::Int(2)).is_err());
}

#[test]
fn b19_missing_extra_and_swapped_tensors() {
    let f = Forge::new();
    // One camera block more than the file has: 12 tensors, all after camera_decoder.blocks.0.
    f.clone().setting("camera.depth", 1).stamp().refused(4, "12 missing: camera_decoder.blocks.0.attn.proj.bias, ");
    let more = Forge(build(&ModelConfig { camera_depth: 1, ..tiny() }));
    more.setting("camera.depth", 0).stamp().refused(4, "12 not expected: camera_decoder.blocks.0.norm1.weight, ");
    let (at, name) = f.name(f.find("camera_head.fc_t.bias"));
    let renamed = f.clone().put(at + name.len() - 1, b"z").stamp();
    renamed.refused(4, "1 missing: camera_head.fc_t.bias; 1 not expected: camera_head.fc_t.biaz");
    let matrix = f.find("camera_head.fc_t.weight");
    f.clone().dims(matrix, &[4, 3]).stamp().refused(4, "camera_head.fc_t.weight is [4, 3], must be [3, 4]");
    let vector = f.find("encoder.norm.bias");
    f.clone().set_in(vector, record::LAYOUT, 1).stamp().refused(4, "encoder.norm.bias: stored as K1N16 f32");
    // A configuration key lost.
    let key = f.0.windows(13).position(|w| w == b"config.mask.k").unwrap();
    f.put(key, b"other.").stamp().refused(4, "metadata");
}

#[test]
fn b23_values_that_are_not_finite() {
    let f = Forge::new();
    let vector = f.find("encoder.norm.bias");
    let at = f.get_in(vector, record::OFFSET) as usize;
    for bad in [f32::NAN, f32::INFINITY, f32::NEG_INFINITY, f32::from_bits(0x7f80_0001)] {
        let f = f.clone().put(at + 8, &bad.to_le_bytes()).stamp();
        f.refused(4, "encoder.norm.bias: value 2 is NaN or infinite");
    }
    let half = (0..f.rows()).find(|&i| f.get_in(i, record::DTYPE) == 2).unwrap();
    let at = f.get_in(half, record::OFFSET) as usize;
    for bad in [0x7c00u16, 0xfc00, 0x7e00, 0x7c01] {
        f.clone().put(at + 2, &bad.to_le_bytes()).stamp().refused(4, "value 1 is NaN or infinite");
    }
}

#[test]
fn b24_every_bit_flipped() {
    let good = Forge::new();
    let data = good.number(header::DATA_OFFSET);
    let flips = |range: std::ops::Range<usize>| {
        let mut bytes = good.0.clone();
        for i in range {
            for bit in 0..8 {
                bytes[i] ^= 1 << bit;
                let e = Blob::from_bytes(&bytes).err().unwrap_or_else(|| panic!("accepted bit {bit} of byte {i}"));
                let status = e.status() as i32;
                // Padding is structure; everything else in the data is covered by a tensor's digest.
                let expected: &[i32] = if i < data { &[4, 7, 9] } else { &[4, 9] };
                assert!(expected.contains(&status), "bit {bit} of byte {i}: {e}");
                if status == 4 && i >= data {
                    assert!(e.to_string().contains("padding"), "{e}");
                }
                bytes[i] ^= 1 << bit;
            }
        }
    };
    let middle = data + (good.0.len() - data) / 2;
    std::thread::scope(|s| {
        s.spawn(|| flips(0..middle));
        flips(middle..good.0.len());
    });
    let at = good.get_in(7, record::OFFSET) as usize;
    let name = good.name(7).1;
    let flipped = good.0[at] ^ 1;
    good.put(at, &[flipped]).refused(9, &format!("tensor {name}: SHA-256"));
}

/// Over 1 MiB two threads share the tensors; the fault named is still the first one.
#[test]
fn the_first_of_several_damaged_tensors_is_named() {
    let trunk = Trunk { dim: 64, depth: 6, heads: 1, registers: 0, mlp_ratio: 4, eps: 1e-6 };
    let good = Forge(build(&ModelConfig { encoder: trunk.clone(), aa: trunk, ..tiny() }));
    assert!(good.0.len() > 1 << 20);
    Blob::from_bytes(&good.0).unwrap();
    for damaged in [&[0][..], &[good.rows() - 1], &[9, 10, 11], &[100, 30, 31, 99]] {
        let mut f = good.clone();
        for &i in damaged {
            let at = f.get_in(i, record::OFFSET) as usize;
            f.0[at] ^= 1;
        }
        let name = good.name(*damaged.iter().min().unwrap()).1;
        f.refused(9, &format!("tensor {name}: SHA-256"));
    }
}

#[test]
fn b25_another_digest_expected() {
    let blob = Blob::from_bytes(&Forge::new().0).unwrap();
    let e = blob.expect_digest(&[0xab; 32]).unwrap_err();
    assert_eq!(e.status() as i32, 9);
    assert!(e.line().contains(&"ab".repeat(32)) && e.line().contains(&sf_formats::digest::hex(blob.digest())));
}

#[test]
fn b27_unknown_architecture_and_bad_sizes() {
    let f = Forge::new();
    f.clone().set(header::ARCHITECTURE, 2).refused(7, "architecture id 2");
    f.clone().setting("aa.heads", 3).stamp().refused(4, "does not divide");
    f.clone().setting("patch", 0).stamp().refused(4, "patch = 0");
    f.clone().setting("encoder.depth", -1).stamp().refused(4, "encoder.depth");
    f.setting("encoder.depth", 1 << 31).stamp().refused(4, "encoder.depth");
}

#[test]
fn b28_directories_devices_and_sockets() {
    let dir = tempfile::tempdir().unwrap();
    refused_file(dir.path(), 6, "not a regular file");
    refused_file(Path::new("/dev/zero"), 6, "not a regular file");
    let socket = dir.path().join("socket");
    let _listener = std::os::unix::net::UnixListener::bind(&socket).unwrap();
    refused_file(&socket, 6, "not a regular file");
}

#[test]
fn b29_a_fifo_does_not_block() {
    let dir = tempfile::tempdir().unwrap();
    let fifo = dir.path().join("fifo");
    let made = std::process::Command::new("mkfifo").arg(&fifo).status().unwrap();
    assert!(made.success());
    refused_file(&fifo, 6, "not a regular file");
}

#[test]
fn b30_missing_dangling_looping_forbidden() {
    use std::os::unix::fs::{PermissionsExt, symlink};
    let dir = tempfile::tempdir().unwrap();
    let path = |name: &str| dir.path().join(name);
    refused_file(&path("missing.sfw"), 6, "No such file");
    symlink(path("nowhere"), path("dangling.sfw")).unwrap();
    refused_file(&path("dangling.sfw"), 6, "No such file");
    symlink(path("b.sfw"), path("a.sfw")).unwrap();
    symlink(path("a.sfw"), path("b.sfw")).unwrap();
    refused_file(&path("a.sfw"), 6, "symbolic links");
    let secret = saved(dir.path(), &Forge::new().0);
    std::fs::set_permissions(&secret, std::fs::Permissions::from_mode(0o000)).unwrap();
    // The superuser reads everything; then only the cases above say something.
    if std::fs::File::open(&secret).is_err() {
        refused_file(&secret, 6, "ermission");
    }
}

#[test]
fn b31_a_hole_where_the_data_should_be() {
    let f = Forge::new();
    let dir = tempfile::tempdir().unwrap();
    let path = saved(dir.path(), &f.0[..f.number(header::DATA_OFFSET)]);
    let file = std::fs::OpenOptions::new().write(true).open(&path).unwrap();
    file.set_len(f.0.len() as u64).unwrap();
    refused_file(&path, 9, "SHA-256");
    // Structure alone does not look at the values.
    Blob::open(&path, LoadMode::Map, Verify::Structure).unwrap();
    file.set_len(0).unwrap();
    file.set_len(f.0.len() as u64).unwrap();
    refused_file(&path, 4, "not a weight blob");
}

/// Opens a blob both ways, lets the file be changed, and gives what the re-check of the mapped one says.
fn after(change: impl Fn(&Path)) -> sf_formats::Result<()> {
    let dir = tempfile::tempdir().unwrap();
    let good = Forge::new().0;
    let path = saved(dir.path(), &good);
    let map = Blob::open(&path, LoadMode::Map, Verify::Digests).unwrap();
    let copy = Blob::open(&path, LoadMode::Copy, Verify::Digests).unwrap();
    change(&path);
    copy.unchanged().unwrap();
    copy.verify().unwrap();
    map.unchanged()
}

#[test]
fn b32_truncated_while_mapped() {
    let e = after(|path| {
        let file = std::fs::OpenOptions::new().write(true).open(path).unwrap();
        file.set_len(4096).unwrap();
    });
    assert_eq!(e.unwrap_err().status() as i32, 9);
}

#[test]
fn b33_overwritten_while_mapped() {
    let e = after(|path| {
        use std::os::unix::fs::FileExt;
        let file = std::fs::OpenOptions::new().write(true).open(path).unwrap();
        file.write_all_at(b"x", 9000).unwrap();
        let later = std::time::SystemTime::now() + std::time::Duration::from_secs(2);
        file.set_modified(later).unwrap();
    });
    let e = e.unwrap_err();
    assert_eq!(e.status() as i32, 9);
    assert!(e.to_string().contains("changed in place"), "{e}");
}

#[test]
fn b34_replaced_by_rename_while_mapped() {
    after(|path| sf_formats::atomic::write(path, b"new", Overwrite::Yes).unwrap()).unwrap();
}

#[test]
fn b36_larger_than_the_limit() {
    let f = Forge::new().set(header::FILE_LENGTH, 17 << 30);
    let dir = tempfile::tempdir().unwrap();
    let path = saved(dir.path(), &f.0);
    // A sparse file: 17 GiB long, a few blocks on disk.
    std::fs::OpenOptions::new().write(true).open(&path).unwrap().set_len(17 << 30).unwrap();
    refused_file(&path, 7, "the limit is");
}
