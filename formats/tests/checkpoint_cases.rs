//! Checkpoints: what is read, and every bad one that must be refused.

use sf_formats::checkpoint::{self, SourceDtype};
use std::path::{Path, PathBuf};

/// The cases this file covers.
pub const COVERED: [&str; 4] = ["C03", "C08", "C09", "C10"];

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
fn refused<P: AsRef<Path>>(paths: &[P]) -> (i32, String) {
    let paths: Vec<PathBuf> = paths.iter().map(|p| p.as_ref().to_path_buf()).collect();
    match checkpoint::open(&paths) {
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

const ONE: &str = r#"{"a":{"dtype":"F32","shape":[2],"data_offsets":[0,8]}}"#;

#[test]
fn the_official_writer_is_read() {
    use safetensors::tensor::{Dtype, TensorView, serialize};
    let dir = tempfile::tempdir().unwrap();
    let (a, b) = (f32s(&[1.0, 2.0, 3.0]), vec![0u8, 0x3c]);
    let views = [
        ("z.weight", TensorView::new(Dtype::F32, vec![3, 1], &a).unwrap()),
        ("a.half", TensorView::new(Dtype::F16, vec![1], &b).unwrap()),
    ];
    let info = [("format".to_owned(), "pt".to_owned())].into_iter().collect();
    let bytes = serialize(views, Some(info)).unwrap();
    let path = dir.path().join("o.safetensors");
    std::fs::write(&path, &bytes).unwrap();
    let c = checkpoint::open(&[path]).unwrap();
    let mut out = Vec::new();
    c.read_f32(c.find("z.weight").unwrap(), &mut out).unwrap();
    assert_eq!((out.as_slice(), c.metadata("format")), (&[1.0, 2.0, 3.0][..], Some("pt")));
    c.read_f32(c.find("a.half").unwrap(), &mut out).unwrap();
    assert_eq!(out, [1.0]);
    assert_eq!(c.digest().unwrap(), sf_formats::digest::sha256(&bytes));
}

#[test]
fn a_tensor_longer_than_a_read_is_whole() {
    let dir = tempfile::tempdir().unwrap();
    let values: Vec<f32> = (0..200_003).map(|i| i as f32).collect();
    let header =
        format!(r#"{{"a":{{"dtype":"F32","shape":[{0}],"data_offsets":[0,{1}]}}}}"#, values.len(), 4 * values.len());
    let c = checkpoint::open(&[file(dir.path(), "x.safetensors", &header, &f32s(&values))]).unwrap();
    let mut out = Vec::new();
    c.read_f32(0, &mut out).unwrap();
    assert_eq!(out, values);
}

#[test]
fn c10_every_malformed_header_is_refused() {
    let dir = tempfile::tempdir().unwrap();
    let data = f32s(&[1.0, 2.0]);
    let two = |second: &str| format!(r#"{{"a":{{"dtype":"F32","shape":[1],"data_offsets":[0,4]}},{second}}}"#);
    let deep = format!(r#"{{"a":{}1{}}}"#, "[".repeat(5000), "]".repeat(5000));
    for (header, word) in [
        (
            r#"{"a":{"dtype":"F32","shape":[2],"data_offsets":[0,8]},"a":{"dtype":"F32","shape":[2],"data_offsets":[0,8]}}"#,
            "'a' twice",
        ),
        (r#"{"a":{"dtype":"F32","shape":[2],"shape":[1],"data_offsets":[0,8]}}"#, "'shape' twice"),
        (r#"{"__metadata__":{"k":"1","k":"2"},"a":{"dtype":"F32","shape":[2],"data_offsets":[0,8]}}"#, "'k' twice"),
        (r#"{"__metadata__":{"k":1},"a":{"dtype":"F32","shape":[2],"data_offsets":[0,8]}}"#, "not text"),
        (r#"{"__metadata__":[],"a":{"dtype":"F32","shape":[2],"data_offsets":[0,8]}}"#, "not an object"),
        (&deep, "deeper"),
        (&two(r#""b":{"dtype":"F32","shape":[1],"data_offsets":[0,4]}"#), "overlaps"),
        (&two(r#""b":{"dtype":"U8","shape":[3],"data_offsets":[5,8]}"#), "hole"),
        (&two(r#""b":{"dtype":"F32","shape":[2],"data_offsets":[4,12]}"#), "truncated"),
        (r#"{"a":{"dtype":"F32","shape":[1],"data_offsets":[0,4]}}"#, "4 bytes follow"),
        (r#"{"a":{"dtype":"F32","shape":[3],"data_offsets":[0,8]}}"#, "needs 12"),
        (r#"{"a":{"dtype":"F32","shape":[2],"data_offsets":[8,0]}}"#, "needs 8"),
        (r#"{"a":{"dtype":"F32","shape":[2,0],"data_offsets":[0,0]}}"#, "of 0"),
        (r#"{"a":{"dtype":"F32","shape":[4294967296,4294967296,4],"data_offsets":[0,8]}}"#, "overflows"),
        (r#"{"a":{"dtype":"F32","shape":[18446744073709551615],"data_offsets":[0,8]}}"#, "overflows"),
        (r#"{"a":{"dtype":"F32","shape":[18446744073709551616],"data_offsets":[0,8]}}"#, "whole number"),
        (r#"{"a":{"dtype":"F32","shape":[-2],"data_offsets":[0,8]}}"#, "whole number"),
        (r#"{"a":{"dtype":"F32","shape":[2.5],"data_offsets":[0,8]}}"#, "whole number"),
        (r#"{"a":{"dtype":"F32","shape":[1,1,1,1,1,1,1,1,2],"data_offsets":[0,8]}}"#, "9 dimensions"),
        (r#"{"a":{"dtype":"F32","shape":[2],"data_offsets":[0,8,8]}}"#, "two data_offsets"),
        (r#"{"a":{"dtype":"F32","shape":[2],"data_offsets":[0,-8]}}"#, "whole numbers"),
        (r#"{"a":{"dtype":"Q4","shape":[2],"data_offsets":[0,8]}}"#, "'Q4'"),
        (r#"{"a":{"dtype":"F32","shape":[2],"data_offsets":[0,8],"x":1}}"#, "'x'"),
        (r#"{"a":[1]}"#, "not an object"),
        (r#"{"":{"dtype":"F32","shape":[2],"data_offsets":[0,8]}}"#, "name"),
        (r#"{"a\u0000b":{"dtype":"F32","shape":[2],"data_offsets":[0,8]}}"#, "name"),
        (r#"{"a":{"dtype":"F32","shape":[2],"data_offsets":[0,8]}"#, "JSON"),
        (r#"{"a":{"dtype":"F32","shape":[2],"data_offsets":[0,8]}} x"#, "JSON"),
        ("{}", "no tensor"),
        ("[]", "not recognised"),
    ] {
        let (status, line) = refused(&[file(dir.path(), "x.safetensors", header, &data)]);
        assert!(status == 4 && line.contains(word), "{header}\n{status} {line}");
        assert!(line.contains("x.safetensors"), "{line}");
    }
    // Not UTF-8, in a name.
    let path = file(dir.path(), "x.safetensors", ONE, &data);
    let mut bytes = std::fs::read(&path).unwrap();
    bytes[10] = 0xff;
    std::fs::write(&path, &bytes).unwrap();
    assert!(refused(&[&path]).1.contains("UTF-8"));
    // A header of 100 MB, claimed and real; one that is longer than the file.
    for length in [100_000_000u64, 1 << 39, (16 << 20) + 1] {
        bytes[..8].copy_from_slice(&length.to_le_bytes());
        std::fs::write(&path, &bytes).unwrap();
        assert!(refused(&[&path]).1.contains("16 MiB"));
    }
    bytes[..8].copy_from_slice(&1000u64.to_le_bytes());
    std::fs::write(&path, &bytes).unwrap();
    assert!(refused(&[path]).1.contains("truncated"));
}

#[test]
fn c10_every_truncation_is_refused() {
    let dir = tempfile::tempdir().unwrap();
    let path = file(dir.path(), "x.safetensors", ONE, &f32s(&[1.0, 2.0]));
    let whole = std::fs::read(&path).unwrap();
    for n in 0..whole.len() {
        std::fs::write(&path, &whole[..n]).unwrap();
        let (status, line) = refused(&[&path]);
        assert_eq!(status, 4, "{n}: {line}");
    }
    let longer = [whole.as_slice(), &[0]].concat();
    std::fs::write(&path, longer).unwrap();
    assert!(refused(&[path]).1.contains("1 bytes follow"));
}

/// A folder with two shards and an index over them.
fn shards(dir: &Path) -> [PathBuf; 3] {
    let a = file(dir, "m-1.safetensors", ONE, &f32s(&[1.0, 2.0]));
    let b = file(dir, "m-2.safetensors", &ONE.replace("\"a\"", "\"b\""), &f32s(&[3.0, 4.0]));
    let index = dir.join("m.safetensors.index.json");
    let text = r#"{"metadata":{"total_size":16},"weight_map":{"a":"m-1.safetensors","b":"m-2.safetensors"}}"#;
    std::fs::write(&index, text).unwrap();
    [a, b, index]
}

#[test]
fn sharded_sets_open_by_index_by_folder_and_by_list() {
    let dir = tempfile::tempdir().unwrap();
    let [a, b, index] = shards(dir.path());
    let mut digests = Vec::new();
    for paths in [vec![index], vec![dir.path().to_path_buf()], vec![b, a]] {
        let c = checkpoint::open(&paths).unwrap();
        let mut out = Vec::new();
        c.read_f32(c.find("b").unwrap(), &mut out).unwrap();
        assert_eq!((out.as_slice(), c.tensors().len()), (&[3.0, 4.0][..], 2));
        digests.push(c.digest().unwrap());
    }
    // The digest does not depend on how the set was named.
    assert!(digests.iter().all(|d| *d == digests[0]));
    std::fs::remove_file(dir.path().join("m.safetensors.index.json")).unwrap();
    assert!(refused(&[dir.path()]).1.contains("several"));
    std::fs::remove_file(dir.path().join("m-2.safetensors")).unwrap();
    assert_eq!(checkpoint::open(&[dir.path().to_path_buf()]).unwrap().tensors().len(), 1);
    std::fs::remove_file(dir.path().join("m-1.safetensors")).unwrap();
    assert_eq!(refused(&[dir.path()]).0, 4);
    assert_eq!(refused::<&Path>(&[]).0, 2);
}

#[test]
fn c08_broken_shard_sets_are_refused() {
    let dir = tempfile::tempdir().unwrap();
    let [a, b, index] = shards(dir.path());
    let good = std::fs::read_to_string(&index).unwrap();
    let outside = tempfile::tempdir().unwrap();
    let far = file(outside.path(), "far.safetensors", ONE, &f32s(&[1.0, 2.0]));
    for (from, to, word) in [
        // A shard that is absent.
        ("\"m-2.safetensors\"", "\"m-3.safetensors\"".to_owned(), "absent"),
        // Shards swapped.
        (
            r#""a":"m-1.safetensors","b":"m-2.safetensors""#,
            r#""a":"m-2.safetensors","b":"m-1.safetensors""#.to_owned(),
            "holds it",
        ),
        // A tensor that its shard lacks, and one that the index lacks.
        (r#""b":"m-2"#, r#""c":"m-2.safetensors","b":"m-2"#.to_owned(), "which lacks it"),
        (r#","b":"m-2.safetensors""#, r#","c":"m-2.safetensors""#.to_owned(), "does not list 'b'"),
        // The same tensor listed twice.
        (r#""b":"m-2"#, r#""a":"m-2.safetensors","b":"m-2"#.to_owned(), "'a' twice"),
        // An index that names itself.
        ("\"m-2.safetensors\"", "\"m.safetensors.index.json\"".to_owned(), "another index"),
        // Ways out of the folder.
        ("\"m-2.safetensors\"", "\"../m-2.safetensors\"".to_owned(), "leaves"),
        ("\"m-2.safetensors\"", format!("\"{}\"", far.display()), "leaves"),
        ("\"m-2.safetensors\"", "\"..\"".to_owned(), "leaves"),
        ("\"m-2.safetensors\"", "\"x/m-2.safetensors\"".to_owned(), "leaves"),
        ("\"m-2.safetensors\"", "7".to_owned(), "not text"),
        ("weight_map", "weights".to_owned(), "weight_map"),
    ] {
        let text = good.replacen(from, &to, 1);
        assert_ne!(text, good);
        std::fs::write(&index, text).unwrap();
        let (status, line) = refused(&[&index]);
        assert!(status == 4 && line.contains(word), "{to}: {status} {line}");
    }
    // One tensor in two shards, without an index.
    let copy = dir.path().join("m-3.safetensors");
    std::fs::copy(&a, &copy).unwrap();
    let (status, line) = refused(&[a, b, copy]);
    assert!(status == 4 && line.contains("'a' is in"), "{line}");
}

#[test]
fn c09_other_files_are_named() {
    let dir = tempfile::tempdir().unwrap();
    let path = dir.path().join("model.safetensors");
    let mut tar = vec![0u8; 600];
    tar[257..262].copy_from_slice(b"ustar");
    for (bytes, word) in [
        (&b""[..], "empty"),
        (b"GGUF\x03\0\0\0\0\0\0\0", "GGUF"),
        (b"\x08\x07\x12\x07pytorch\x1a", "ONNX"),
        (b"\x7fELF\x02\x01\x01\0\0\0", "ELF"),
        (b"<!DOCTYPE html><html>", "web page"),
        (b"\x89SFW\r\n\x1a\n\0\0\0\0", ".sfw"),
        (b"version https://git-lfs.github.com/spec/v1\noid sha256:0\n", "git lfs pull"),
        (b"\x1f\x8b\x08\0\0\0\0\0\0", "gzip"),
        (b"\x89HDF\r\n\x1a\n\0", "HDF5"),
        (b"{\"a\": 1}          ", "weight_map"),
        (b"some text, 20 bytes.", "not recognised"),
    ] {
        std::fs::write(&path, bytes).unwrap();
        let (status, line) = refused(&[&path]);
        assert!(status == 4 && line.contains(word), "{status} {line}");
    }
    // Pickles in every wrapping: refused without the feature, and broken ones with it; never run.
    let wanted = if cfg!(feature = "pytorch") { 4 } else { 7 };
    let evil = b"\x80\x02cos\nsystem\nX\x0d\x00\x00\x00touch /tmp/sf\x85R.";
    for bytes in [&b"PK\x03\x04\x14\0\0\0"[..], &tar, b"\x80\x02}q\x00.", b"PK\x05\x06"] {
        std::fs::write(&path, bytes).unwrap();
        let (status, line) = refused(&[&path]);
        assert!(status == wanted, "{status} {line}");
        assert!(cfg!(feature = "pytorch") || line.contains("`pytorch`"), "{line}");
    }
    std::fs::write(&path, evil).unwrap();
    assert!([4, 7].contains(&refused(&[&path]).0));
    // Folders, pipes and absent files are the system's affair.
    assert_eq!(refused(&[dir.path().join("absent")]).0, 6);
    assert_eq!(refused(&["/dev/null"]).0, 6);
}

#[cfg(feature = "pytorch")]
mod torch {
    use super::*;

    fn data(name: &str) -> PathBuf {
        Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/data").join(name)
    }

    #[test]
    fn pytorchs_own_files_are_read() {
        for name in ["plain.pt", "legacy.pt", "nested.pth"] {
            let c = checkpoint::open(&[data(name)]).unwrap();
            let names: Vec<&str> = c.tensors().iter().map(|t| t.name.as_str()).collect();
            let wanted = ["encoder.view", "encoder.weight", "head.bf16", "head.double", "head.half", "steps"];
            assert_eq!(names, wanted, "{name}: {}", c.describe());
            let get = |name: &str| {
                let mut out = Vec::new();
                c.read_f32(c.find(name).unwrap(), &mut out).unwrap();
                out
            };
            assert_eq!(get("encoder.weight"), (0..24).map(|i| 0.5 * i as f32).collect::<Vec<_>>());
            // Rows 1 and 2 of the transpose: columns 1 and 2.
            assert_eq!(get("encoder.view"), [0.5, 3.5, 6.5, 9.5, 1.0, 4.0, 7.0, 10.0]);
            assert_eq!(c.tensors()[0].shape, [2, 4]);
            assert_eq!(get("head.half"), [1.0, -0.5, 65504.0]);
            assert_eq!(get("head.bf16"), [3.0, -2.0]);
            assert_eq!(get("head.double"), [0.1f32]);
            let mut out = Vec::new();
            assert_eq!(c.read_f32(c.find("steps").unwrap(), &mut out).unwrap_err().status() as i32, 7);
        }
        let nested = checkpoint::open(&[data("nested.pth")]).unwrap();
        assert!(nested.describe().contains("under 'state_dict'") && nested.describe().contains("1 others"));
        assert_eq!(nested.metadata("streetforward.config"), Some("{\"a\": 1}"));
    }

    #[test]
    fn damaged_pytorch_files_are_refused_or_read_never_worse() {
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("x.pt");
        for name in ["plain.pt", "legacy.pt"] {
            let whole = std::fs::read(data(name)).unwrap();
            for n in (0..whole.len()).step_by(7) {
                std::fs::write(&path, &whole[..n]).unwrap();
                if let Err(e) = checkpoint::open(std::slice::from_ref(&path)) {
                    assert!([4, 7].contains(&(e.status() as i32)), "{name} cut at {n}: {}", e.line());
                }
                let mut flipped = whole.clone();
                flipped[n] ^= 0x55;
                std::fs::write(&path, &flipped).unwrap();
                match checkpoint::open(std::slice::from_ref(&path)) {
                    Ok(c) => {
                        let mut out = Vec::new();
                        for i in 0..c.tensors().len() {
                            let _ = c.read_f32(i, &mut out);
                        }
                    }
                    Err(e) => assert!([4, 7].contains(&(e.status() as i32)), "{name} flipped at {n}: {}", e.line()),
                }
            }
        }
    }
}
