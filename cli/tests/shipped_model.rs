//! The trained network in `models/nano`: the blob is the checkpoint converted, and commands without a model run it.

mod common;

use common::{ok, ok_json};
use std::fs;
use std::path::{Path, PathBuf};

fn s(path: &Path) -> &str {
    path.to_str().unwrap()
}

/// Checkpoint and blob; none before a model ships.
fn shipped(test: &str) -> Option<(PathBuf, PathBuf)> {
    let folder = Path::new(env!("CARGO_MANIFEST_DIR")).join("../models/nano");
    let (checkpoint, blob) = (folder.join("nano.safetensors"), folder.join("nano.sfw"));
    if !checkpoint.exists() && !blob.exists() {
        println!("{test}: not run, models/nano holds no model");
        return None;
    }
    Some((checkpoint, blob))
}

#[test]
fn the_shipped_blob_is_the_converted_checkpoint() {
    let Some((checkpoint, blob)) = shipped("the_shipped_blob_is_the_converted_checkpoint") else { return };
    let dir = tempfile::tempdir().unwrap();
    let again = dir.path().join("nano.sfw");
    ok(&["convert", s(&checkpoint), "-o", s(&again), "--to", "f16"]);
    assert!(
        fs::read(&blob).unwrap() == fs::read(&again).unwrap(),
        "models/nano/nano.sfw is another model than nano.safetensors: convert it again with --to f16"
    );
}

#[test]
fn a_command_without_a_model_runs_the_shipped_one() {
    let Some((_, blob)) = shipped("a_command_without_a_model_runs_the_shipped_one") else { return };
    // At the size it was trained at, which its configuration tells; at 252x168 its depth is off by half.
    let json = ok_json(&["eval", "--synth-heldout", "1"]);
    assert_eq!(json["data"][0]["size"], serde_json::json!([168, 112]));
    assert_eq!(
        (json["model"]["embedded"].as_bool(), json["model"]["random_weights"].as_bool()),
        (Some(true), Some(false))
    );
    let file = ok_json(&["eval", "-m", s(&blob), "--synth-heldout", "1"]);
    assert_eq!(json["model"]["digest"], file["model"]["digest"]);
    assert_eq!(json["psnr_full_db"], file["psnr_full_db"]);
    // It has learned what a street looks like: far nearer than the medians of other streets would be.
    assert!(json["context_depth_absrel_scaled"].as_f64().unwrap() < 0.4, "{}", json["context_depth_absrel_scaled"]);
    assert!(json["translation_error_ratio"].as_f64().unwrap() < 0.6, "{}", json["translation_error_ratio"]);
}

/// int8 keeps what it promises on a street that no training saw, but for the whole render (docs/quantization.md).
/// Calibration brings colours nearer.
#[test]
fn int8_keeps_its_gates() {
    let Some((checkpoint, _)) = shipped("int8_keeps_its_gates") else { return };
    let dir = tempfile::tempdir().unwrap();
    let at = |name: &str| dir.path().join(name).to_str().unwrap().to_string();
    for seed in ["101", "102"] {
        ok(&["synth", "--seed", seed, "--frames", "11", "--size", "168x112", "-o", &at(seed)]);
    }
    let (f32, plain, calibrated) = (at("f32.sfw"), at("plain.sfw"), at("calibrated.sfw"));
    ok(&["convert", s(&checkpoint), "-o", &f32]);
    ok(&["convert", s(&checkpoint), "-o", &plain, "--to", "int8"]);
    let calib = at("102");
    ok(&["convert", s(&checkpoint), "-o", &calibrated, "--to", "int8", "--calib", &calib, "--frames", "0,5,10"]);
    let gates = "depth_absrel=0.01,rotation_deg_median=0.06,translation_deg_median=0.3,velocity_gate=1,\
        dynamic_flip_fraction=0.003,render_psnr_dynamic=42,truth_psnr_fall=0.1,truth_psnr_dynamic_fall=0.15";
    let clip = at("101");
    let judge = |model: &str| {
        ok_json(&["compare", &f32, model, "-i", &clip, "--frames", "0,5,10", "--outputs-only", "--gate", gates])
    };
    let (plain, calibrated) = (judge(&plain), judge(&calibrated));
    // Poses and depth are a few numbers far inside their gates: which is smaller is chance. Colours are one a pixel.
    let [plain, calibrated] = [&plain, &calibrated].map(|j| j["outputs"]["colour_p99"].as_f64().unwrap());
    assert!(calibrated > 0.0 && calibrated < 0.9 * plain, "colours: {calibrated} off calibrated, {plain} plain");
}
