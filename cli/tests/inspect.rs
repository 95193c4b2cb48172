//! `inspect`: what it tells, and how it refuses what it cannot read.

mod common;

use common::{fails, ok, ok_json, run, safetensors};
use std::fs;
use std::path::Path;

fn checkpoint() -> Vec<u8> {
    let tensors: [(&str, &[usize], &[f32]); 3] = [
        ("encoder.a.weight", &[2, 2], &[1.0, -3.0, 0.0, 2.0]),
        ("encoder.a.bias", &[2], &[f32::NAN, 1.0]),
        ("head.gain", &[1], &[0.5]),
    ];
    safetensors(&tensors, &[("format", "pt")])
}

fn text(path: &Path) -> &str {
    path.to_str().unwrap()
}

#[test]
fn a_checkpoint_is_summarised_listed_and_measured() {
    let dir = tempfile::tempdir().unwrap();
    let file = dir.path().join("x.safetensors");
    fs::write(&file, checkpoint()).unwrap();
    let out = ok(&["inspect", text(&file)]);
    assert!(out.contains("checkpoint") && out.contains("7 in 3 tensors"), "{out}");
    assert!(out.contains("encoder") && !out.contains("encoder.a.weight"), "{out}");

    let json = ok_json(&["inspect", text(&file)]);
    assert_eq!(json["kind"], "checkpoint");
    assert_eq!((json["tensor_count"].as_u64(), json["values"].as_u64()), (Some(3), Some(7)));
    assert_eq!(json["groups"][0]["name"], "encoder");
    assert_eq!(json["groups"][0]["values"], 6);
    assert!(json.get("tensors").is_none());

    let json = ok_json(&["inspect", text(&file), "--tensors", "*.weight"]);
    assert_eq!(json["tensors"].as_array().unwrap().len(), 1);
    assert_eq!(json["tensors"][0]["shape"], serde_json::json!([2, 2]));
    assert!(json["tensors"][0].get("stats").is_none());

    let json = ok_json(&["inspect", text(&file), "--stats"]);
    let stats = &json["tensors"][0]["stats"];
    assert_eq!((stats["min"].as_f64(), stats["max"].as_f64()), (Some(-3.0), Some(2.0)));
    assert_eq!(json["tensors"][1]["stats"]["not_finite"], 1);
    assert!(ok(&["inspect", text(&file), "--stats"]).contains("not finite 1"));

    assert!(fails(2, &["inspect", text(&file), "--tensors", "decoder.*"]).contains("no tensor matches"));
}

#[test]
fn b01_an_empty_file() {
    let dir = tempfile::tempdir().unwrap();
    let file = dir.path().join("empty.sfw");
    fs::write(&file, b"").unwrap();
    assert!(fails(4, &["inspect", text(&file)]).contains("file is empty"));
}

#[test]
fn b05_other_formats_are_named() {
    let dir = tempfile::tempdir().unwrap();
    for (bytes, word) in [
        (&b"GGUF\x03\0\0\0rest"[..], "GGUF"),
        (b"\x7fELF\x02\x01\x01rest", "ELF"),
        (b"\x08\x07\x12\x07pytorch", "ONNX"),
        (b"<!DOCTYPE html><html>", "web page"),
        (b"version https://git-lfs.github.com/spec/v1\n", "git lfs pull"),
        (b"what is this", "not recognised"),
    ] {
        let file = dir.path().join("model.sfw");
        fs::write(&file, bytes).unwrap();
        let line = fails(4, &["inspect", text(&file)]);
        assert!(line.contains(word), "{line}");
    }
}

#[test]
fn c10_a_damaged_checkpoint() {
    let dir = tempfile::tempdir().unwrap();
    let file = dir.path().join("x.safetensors");
    let good = checkpoint();
    for cut in [9, 40, good.len() - 1] {
        fs::write(&file, &good[..cut]).unwrap();
        fails(4, &["inspect", text(&file)]);
    }
    let mut long = good.clone();
    long[7] = 0x7f;
    fs::write(&file, long).unwrap();
    fails(4, &["inspect", text(&file)]);
}

#[cfg(unix)]
#[test]
fn b28_b29_b30_what_is_not_a_readable_file() {
    let dir = tempfile::tempdir().unwrap();
    assert!(fails(6, &["inspect", "/dev/null"]).contains("not a regular file"));
    let fifo = dir.path().join("fifo");
    let made = std::process::Command::new("mkfifo").arg(&fifo).status().unwrap();
    assert!(made.success());
    // Nobody writes into it: an open would block for ever.
    fails(6, &["inspect", text(&fifo)]);
    assert!(fails(6, &["inspect", "/nonexistent/model.sfw"]).contains("model.sfw"));
    let link = dir.path().join("link");
    std::os::unix::fs::symlink("nowhere", &link).unwrap();
    fails(6, &["inspect", text(&link)]);
    let ring = dir.path().join("ring");
    std::os::unix::fs::symlink("ring", &ring).unwrap();
    fails(6, &["inspect", text(&ring)]);
}

#[cfg(unix)]
#[test]
fn i21_file_names_of_any_bytes() {
    use std::ffi::OsStr;
    use std::os::unix::ffi::OsStrExt;
    let dir = tempfile::tempdir().unwrap();
    for name in [&b"two\nlines.safetensors"[..], b"not\xffutf8.safetensors"] {
        let file = dir.path().join(OsStr::from_bytes(name));
        fs::write(&file, checkpoint()).unwrap();
        let r = run(&[OsStr::new("inspect"), file.as_os_str()]);
        assert_eq!(r.code, 0, "{}", r.stderr);
        assert!(r.stdout.contains(".safetensors"));
        // In a message the name cannot break the line.
        fs::write(&file, b"").unwrap();
        fails(4, &[OsStr::new("inspect"), file.as_os_str()]);
    }
    let long = format!("/{}", "x".repeat(4096));
    fails(6, &["inspect", &long]);
}
