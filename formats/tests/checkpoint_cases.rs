//! Checkpoints: what is read, and every bad one that must be refused.

use sf_formats::checkpoint::{self, SourceDtype};
use std::path::{Path, PathBuf};

/// A safetensors file from a header text and its data.
fn file(dir: &Path, name: &str, header: &str, data: &[u8]) -> PathBuf {
    let mut bytes = (header.len() as u64).to_le_bytes().to_vec();
    bytes.extend(header.as_bytes());
    bytes.extend(data);
    let path = dir.join(name);
    std::fs::write(&path, bytes).unwrap();
    path
}

/// F32 data as bytes.
fn f32s(values: &[f32]) -> Vec<u8> {
    values.iter().flat_map(|v| v.to_le_bytes()).collect()
}

/// The status and the line of a refusal.
fn refused(paths: &[PathBuf]) -> (i32, String) {
    match checkpoint::open(paths) {
        Ok(c) => panic!("accepted: {}", c.describe()),
        Err(e) => (e.status() as i32, e.line()),
    }
}

#[test]
fn c03_float_dtypes_become_f32_and_integers_are_refused() {
    let dir = tempfile::tempdir().unwrap();
    let mut data = f32s(&[1.5, -2.0]);
    data.extend([0x00, 0x3c, 0x01, 0x00]); // f16: 1 and the smallest subnormal
    data.extend([0x80, 0x3f, 0x80, 0xff]); // bf16: 1 and -inf
    data.extend((1.0f64 + 2f64.powi(-30)).to_le_bytes());
    data.extend(7i64.to_le_bytes());
    let header = r#"{"__metadata__":{"k":"v"},
        "a":{"dtype":"F32","shape":[1,2],"data_offsets":[0,8]},
        "b":{"dtype":"F16","shape":[2],"data_offsets":[8,12]},
        "c":{"dtype":"BF16","shape":[2],"data_offsets":[12,16]},
        "d":{"dtype":"F64","shape":[1],"data_offsets":[16,24]},
        "e":{"dtype":"I64","shape":[],"data_offsets":[24,32]}}"#;
    let path = file(dir.path(), "x.safetensors", header, &data);
    let c = checkpoint::open(&[path]).unwrap();
    assert_eq!(c.metadata("k"), Some("v"));
    let mut out = vec![9.0; 5];
    for (name, want) in
        [("a", &[1.5, -2.0][..]), ("b", &[1.0, 2f32.powi(-24)]), ("c", &[1.0, f32::NEG_INFINITY]), ("d", &[1.0])]
    {
        c.read_f32(c.find(name).unwrap(), &mut out).unwrap();
        assert_eq!(out, want, "{name}");
    }
    let e = c.find("e").unwrap();
    assert_eq!(c.tensors()[e].dtype, SourceDtype::Int("I64"));
    assert_eq!(c.tensors()[e].shape, Vec::<usize>::new());
    let refusal = c.read_f32(e, &mut out).unwrap_err();
    assert_eq!(refusal.status() as i32, 7);
    assert!(refusal.line().contains("I64") && refusal.line().contains(": e:"));
}

#[test]
fn c10_a_truncated_file_is_refused() {
    let dir = tempfile::tempdir().unwrap();
    let header = r#"{"a":{"dtype":"F32","shape":[2],"data_offsets":[0,8]}}"#;
    let path = file(dir.path(), "x.safetensors", header, &f32s(&[1.0]));
    let (status, line) = refused(&[path]);
    assert_eq!(status, 4);
    assert!(line.contains("truncated"), "{line}");
}
