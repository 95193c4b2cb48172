//! `verify` and `inspect` on weight blobs.

mod common;

use common::{fails, ok, ok_json, tiny_blob};
use std::fs;
use std::path::PathBuf;

/// A folder with one valid blob.
fn blob() -> (tempfile::TempDir, PathBuf, Vec<u8>) {
    let dir = tempfile::tempdir().unwrap();
    let file = dir.path().join("tiny.sfw");
    let bytes = tiny_blob();
    fs::write(&file, &bytes).unwrap();
    (dir, file, bytes)
}

#[test]
fn a_good_blob_is_verified_and_inspected() {
    let (_dir, file, bytes) = blob();
    let file = file.to_str().unwrap();
    for load in ["map", "copy"] {
        let json = ok_json(&["verify", "-m", file, "--load", load]);
        assert_eq!(json["bytes"], bytes.len());
        assert_eq!(json["digest"].as_str().unwrap().len(), 64);
    }
    let text = ok(&["verify", "-m", file]);
    assert!(text.contains("digest") && text.contains("verified"), "{text}");

    let json = ok_json(&["inspect", file]);
    assert_eq!(json["kind"], "blob");
    assert_eq!(json["values"], ok_json(&["verify", "-m", file])["parameters"]);
    assert_eq!(json["config"]["encoder.dim"], 16);
    let json = ok_json(&["inspect", file, "--tensors", "decoder.0.attn.qkv.*", "--stats"]);
    assert_eq!(json["tensors"][0]["shape"], serde_json::json!([48, 16]));
    let stats = &json["tensors"][0]["stats"];
    // Random weights deviate by 1/sqrt(16 inputs).
    assert!((stats["std"].as_f64().unwrap() - 0.25).abs() < 0.02 && stats["not_finite"] == 0, "{stats}");
}

#[test]
fn b02_b04_a_blob_of_the_wrong_length() {
    let (_dir, file, bytes) = blob();
    for cut in [1, 100, 255, 256, 4096, bytes.len() - 1] {
        fs::write(&file, &bytes[..cut]).unwrap();
        fails(4, &["verify", "-m", file.to_str().unwrap()]);
    }
    fs::write(&file, [&bytes[..], b"\0"].concat()).unwrap();
    fails(4, &["verify", "-m", file.to_str().unwrap()]);
}

#[test]
fn b24_a_flipped_bit_is_an_integrity_error_that_names_the_tensor() {
    let (_dir, file, mut bytes) = blob();
    let last = bytes.len() - 4;
    bytes[last] ^= 1;
    fs::write(&file, bytes).unwrap();
    let line = fails(9, &["verify", "-m", file.to_str().unwrap()]);
    assert!(line.contains("motion_head"), "{line}");
}

#[test]
fn b25_the_expected_digest_differs() {
    let (_dir, file, _) = blob();
    let file = file.to_str().unwrap();
    let digest = ok_json(&["verify", "-m", file])["digest"].as_str().unwrap().to_string();
    ok(&["verify", "-m", file, "--digest", &digest]);
    let other = "0123456789abcdef".repeat(4);
    let line = fails(9, &["verify", "-m", file, "--digest", &other]);
    assert!(line.contains(&digest) && line.contains(&other), "{line}");
    fails(2, &["verify", "-m", file, "--digest", "abc"]);
}

#[test]
fn b05_a_checkpoint_is_not_a_blob() {
    let (_dir, file, _) = blob();
    fs::write(&file, common::safetensors(&[("a", &[1], &[0.0])], &[])).unwrap();
    let line = fails(4, &["verify", "-m", file.to_str().unwrap()]);
    assert!(line.contains("safetensors") && line.contains("convert"), "{line}");
}

#[test]
fn a_blob_runs_alike_on_one_and_two_threads() {
    let (_dir, file, _) = blob();
    let file = file.to_str().unwrap();
    let json = ok_json(&["verify", "-m", file, "--run"]);
    assert_eq!(json["run_digest"].as_str().unwrap().len(), 64);
    assert!(ok(&["verify", "-m", file, "--run"]).contains("on 1, 2 threads"));
    let more = ok_json(&["verify", "-m", file, "--run", "--threads", "1,3,8", "--repeat", "3", "--isa", "scalar"]);
    assert_eq!((&more["run_digest"], more["isa"].as_str()), (&json["run_digest"], Some("scalar")));
    fails(2, &["verify", "-m", file, "--threads", "2"]);
    fails(2, &["verify", "-m", file, "--run", "--threads", "0"]);
    fails(2, &["verify", "-m", file, "--run", "--repeat", "0"]);
    assert!(ok_json(&["verify", "-m", file])["run_digest"].is_null());
}
