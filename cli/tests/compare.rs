//! `compare`, and the checks and scans of `convert`.

mod common;

use common::{error_line, fails, ok, ok_json, run, tiny_config};
use serde_json::Value;
use sf_formats::config::{HeadKind, ModelConfig, Trunk, Value as Setting};
use sf_formats::meta::keys;
use sf_formats::{Blob, BlobWriter, Dtype, LoadMode, Meta, Verify};
use std::fs;
use std::path::{Path, PathBuf};

fn s(path: &Path) -> &str {
    path.to_str().unwrap()
}

/// [`tiny_config`] with widths that int8 can rotate.
fn config() -> ModelConfig {
    let tiny = tiny_config();
    ModelConfig {
        encoder: Trunk { dim: 32, ..tiny.encoder },
        aa: Trunk { dim: 32, ..tiny.aa },
        camera_width: 16,
        time_dim: 16,
        causal_heads: 3,
        ..tiny
    }
}

/// A folder with a checkpoint, its f32 and int8 blobs and a clip.
struct Place {
    dir: tempfile::TempDir,
    ckpt: PathBuf,
    f32: PathBuf,
    int8: PathBuf,
    clip: PathBuf,
}

fn place() -> Place {
    let dir = tempfile::tempdir().unwrap();
    let at = |name: &str| dir.path().join(name);
    let (json, ckpt, f32, int8, clip) = (at("c.json"), at("a.safetensors"), at("a.sfw"), at("b.sfw"), at("clip"));
    fs::write(&json, config().to_json().to_string()).unwrap();
    ok(&["init", "--config", s(&json), "--seed", "3", "-o", s(&ckpt)]);
    ok(&["convert", s(&ckpt), "-o", s(&f32)]);
    ok(&["convert", s(&ckpt), "--to", "int8", "-o", s(&int8)]);
    ok(&["synth", "--seed", "1", "--frames", "3", "--size", "42x28", "-o", s(&clip)]);
    Place { dir, ckpt, f32, int8, clip }
}

fn output(json: &Value, key: &str) -> f64 {
    json["outputs"][key].as_f64().unwrap_or_else(|| panic!("{key} in {json}"))
}

#[test]
fn a_model_equals_itself_and_int8_is_near() {
    let p = place();
    let same = ok_json(&["compare", s(&p.f32), s(&p.f32), "-i", s(&p.clip), "--gate", "int8"]);
    assert_eq!((same["pass"].as_bool(), output(&same, "depth_absrel")), (Some(true), 0.0));
    assert_eq!((output(&same, "render_psnr_db"), output(&same, "dynamic_flip_fraction")), (100.0, 0.0));
    let stages = same["stages"].as_array().unwrap();
    assert!(stages.iter().any(|t| t["name"] == "aa.1") && stages.iter().all(|t| t["sqnr_db"] == 300.0));

    let near = ok_json(&["compare", s(&p.f32), s(&p.int8), "-i", s(&p.clip)]);
    assert!((1e-5..0.1).contains(&output(&near, "depth_absrel")), "{near}");
    assert!(output(&near, "render_psnr_db") > 25.0, "{near}");
    let aa = near["stages"].as_array().unwrap().iter().find(|t| t["name"] == "aa.1").unwrap().clone();
    assert!((25.0..60.0).contains(&aa["sqnr_db"].as_f64().unwrap()), "{aa}");
    assert!(near["gates"].as_array().unwrap().is_empty() && near["pass"] == true);
    // A checkpoint stands for its f32 blob.
    let direct = ok_json(&["compare", s(&p.ckpt), s(&p.int8), "-i", s(&p.clip), "--outputs-only"]);
    assert_eq!(direct["outputs"], near["outputs"]);
    assert!(direct["stages"].as_array().unwrap().is_empty());
}

#[test]
fn a_missed_gate_is_exit_1_with_a_report() {
    let p = place();
    let r = run(&[
        "compare",
        s(&p.f32),
        s(&p.int8),
        "-i",
        s(&p.clip),
        "--gate",
        "depth_absrel=1e-9,render_psnr=5",
        "--json",
    ]);
    assert_eq!(r.code, 1);
    let json: Value = serde_json::from_str(&r.stdout).unwrap();
    assert_eq!((json["pass"].as_bool(), json["gates"][0]["pass"].as_bool()), (Some(false), Some(false)));
    assert_eq!(json["gates"][1]["pass"], true);
    assert!(error_line(&r.stderr).contains("depth_absrel"), "{}", r.stderr);
    for bad in ["depth=1", "depth_absrel", "depth_absrel=x"] {
        fails(2, &["compare", s(&p.f32), s(&p.int8), "-i", s(&p.clip), "--gate", bad]);
    }
    // Two networks that are not one.
    let other = p.dir.path().join("other.sfw");
    let json = p.dir.path().join("o.json");
    let mut config = config();
    config.depth.depth = 0;
    assert_eq!(config.depth.kind, HeadKind::XdecLinear);
    fs::write(&json, config.to_json().to_string()).unwrap();
    ok(&["init", "--config", s(&json), "-o", s(&other)]);
    let line = fails(2, &["compare", s(&p.f32), s(&other), "-i", s(&p.clip)]);
    assert!(line.contains("depth.depth"), "{line}");
}

#[test]
fn c18_an_inaccurate_conversion_is_refused() {
    let p = place();
    let out = p.dir.path().join("checked.sfw");
    let convert = |more: &[&str]| {
        let mut args = vec!["convert", s(&p.ckpt), "--to", "int8", "-o", s(&out), "--check", s(&p.clip)];
        args.extend(more);
        run(&args)
    };
    // No share of f16 layers makes eight bits exact.
    let r = convert(&["--gate", "depth_absrel=1e-9"]);
    assert_eq!((r.code, out.exists(), r.stdout.as_str()), (1, false, ""), "{}", r.stderr);
    assert!(error_line(&r.stderr).contains("depth_absrel"), "{}", r.stderr);
    let r = convert(&["--gate", "depth_absrel=1e-9", "--allow-inaccurate"]);
    assert_eq!(r.code, 0, "{}", r.stderr);
    let blob = Blob::open(&out, LoadMode::Map, Verify::Digests).unwrap();
    assert_eq!(blob.meta().text(keys::CHECK_KEYS), Some("depth_absrel"));
    let Some(Setting::Floats(values)) = blob.meta().get(keys::CHECK_VALUES) else { panic!("no values") };
    assert!(values.len() == 1 && values[0] > 1e-9, "{values:?}");
    fs::remove_file(&out).unwrap();
    // A gate that int8 passes: no scan, nothing promoted.
    let r = convert(&["--gate", "depth_absrel=0.5", "--json"]);
    assert_eq!(r.code, 0, "{}", r.stderr);
    let json: Value = serde_json::from_str(&r.stdout).unwrap();
    assert_eq!((json["check"]["pass"].as_bool(), json["promoted_share"].as_f64()), (Some(true), Some(0.0)));
}

/// A gate that int8 just misses is reached by promoting some layers, and the report says which.
#[test]
fn a_scan_promotes_what_helps() {
    let p = place();
    let found = ok_json(&["compare", s(&p.f32), s(&p.int8), "-i", s(&p.clip)]);
    let gate = format!("depth_absrel={}", 0.97 * output(&found, "depth_absrel"));
    let out = p.dir.path().join("scanned.sfw");
    let json = ok_json(&["convert", s(&p.ckpt), "--to", "int8", "-o", s(&out), "--check", s(&p.clip), "--gate", &gate]);
    let share = json["promoted_share"].as_f64().unwrap();
    assert!(share > 0.0 && share <= 0.05, "{share}");
    let promoted: Vec<&Value> =
        json["tensors"].as_array().unwrap().iter().filter(|t| t["reason"] == "sensitivity scan").collect();
    assert!(!promoted.is_empty() && promoted.iter().all(|t| t["dtype"] == "f16"));
    ok(&["compare", s(&p.f32), s(&out), "-i", s(&p.clip), "--gate", &gate]);
}

#[test]
fn the_golden_run_is_stored_and_repeated() {
    let p = place();
    for file in [&p.f32, &p.int8] {
        let json = ok_json(&["verify", "-m", s(file), "--run"]);
        assert_eq!(json["golden_digest"], json["run_digest"]);
        assert_eq!(json["golden_digest"].as_str().map(str::len), Some(64));
    }
    // A blob that claims another result.
    let blob = Blob::open(&p.f32, LoadMode::Map, Verify::Digests).unwrap();
    let mut meta = Meta::new();
    meta.set_text(keys::GOLDEN, &"ab".repeat(32));
    let mut writer = BlobWriter::in_memory(blob.config(), &meta).unwrap();
    let mut values = Vec::new();
    for i in 0..blob.tensors().len() {
        blob.read_f32(i, &mut values);
        writer.write(&values, Dtype::F32).unwrap();
    }
    let forged = p.dir.path().join("forged.sfw");
    fs::write(&forged, writer.finish_bytes().unwrap()).unwrap();
    ok(&["verify", "-m", s(&forged)]);
    let line = fails(9, &["verify", "-m", s(&forged), "--run"]);
    assert!(line.contains("abab"), "{line}");
}
