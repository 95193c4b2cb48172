//! `synth`, `eval` and `demo`: synthetic streets from drawing to judging.

mod common;

use common::{fails, files, ok, ok_json, tiny_blob};
use sf_formats::clip::{Clip, ClipOptions, GroundTruth};
use std::fs;
use std::path::Path;

fn s(path: &Path) -> &str {
    path.to_str().unwrap()
}

#[test]
fn a_synthetic_clip_is_complete_and_reproducible() {
    let dir = tempfile::tempdir().unwrap();
    let (a, b) = (dir.path().join("a"), dir.path().join("b"));
    let json = ok_json(&["synth", "--seed", "5", "--frames", "3", "--size", "84x56", "-o", s(&a)]);
    // Three pictures, depths, velocities and masks, and transforms.json.
    assert_eq!(json["files"].as_array().unwrap().len(), 13);
    let clip = Clip::open(&a, &ClipOptions::default()).unwrap();
    assert_eq!((clip.frames.len(), clip.frames[0].image.size()), (3, (84, 56)));
    assert_eq!(clip.times(), [0.0, 0.1, 0.2]);
    assert!(clip.poses.is_some() && clip.intrinsics.is_some());
    let truth = GroundTruth::load(&a, &[0, 1, 2]).unwrap().unwrap();
    assert!(truth.frames[2].depth.iter().any(|&d| d > 0.0) && truth.frames[2].velocity.is_some());
    ok(&["synth", "--seed", "5", "--frames", "3", "--size", "84x56", "-o", s(&b)]);
    for file in files(&a) {
        assert_eq!(fs::read(a.join(&file)).unwrap(), fs::read(b.join(&file)).unwrap(), "{}", file.display());
    }
}

#[test]
fn a_stream_of_clips_goes_to_standard_output() {
    let args = ["synth", "--stream", "3", "--seed", "10", "--size", "28x28"];
    let out = common::command(&args).output().unwrap();
    assert_eq!((out.status.code(), out.stderr.len()), (Some(0), 0));
    let seed_at = |at: usize| u64::from_le_bytes(out.stdout[at + 8..at + 16].try_into().unwrap());
    let (mut at, mut seeds) = (0, Vec::new());
    while at < out.stdout.len() {
        assert_eq!(&out.stdout[at..at + 8], b"SFSYNTH1");
        seeds.push(seed_at(at));
        at += 64 + u32::from_le_bytes(out.stdout[at + 16..at + 20].try_into().unwrap()) as usize;
    }
    let want: Vec<u64> = sf_synth::Split::Train.seeds(10).take(3).collect();
    assert_eq!((at, seeds), (out.stdout.len(), want));
    fails(2, &["synth", "--stream", "3", "-o", "x"]);
    fails(2, &["synth", "--stream", "3", "--json"]);
    fails(2, &["synth"]);
    // The reader is gone.
    let (reader, writer) = std::io::pipe().unwrap();
    drop(reader);
    assert_eq!(common::ran(common::command(&args).stdout(writer).output().unwrap()).code, 6);
}

#[test]
fn synth_refuses_what_makes_no_clip() {
    let dir = tempfile::tempdir().unwrap();
    let out = dir.path().join("out");
    for bad in [&["--frames", "0"][..], &["--size", "0x0"], &["--fps", "0"], &["--fps", "nan"], &["--seed", "-1"]] {
        fails(2, &[&["synth", "-o", s(&out)], bad].concat());
        assert!(!out.exists());
    }
    fs::create_dir(&out).unwrap();
    fs::write(out.join("mine"), b"x").unwrap();
    fails(6, &["synth", "-o", s(&out)]);
}

#[test]
fn eval_reports_the_model_and_the_trivial_alternatives() {
    let dir = tempfile::tempdir().unwrap();
    let model = dir.path().join("tiny.sfw");
    fs::write(&model, tiny_blob()).unwrap();
    let clips: Vec<_> = [1, 2].map(|seed| dir.path().join(format!("clip{seed}"))).into();
    for (seed, clip) in ["1", "2"].iter().zip(&clips) {
        ok(&["synth", "--seed", seed, "--frames", "8", "--size", "56x42", "-o", s(clip)]);
    }
    let args = ["eval", "-m", s(&model), "--data", s(&clips[0]), s(&clips[1])];
    let json = ok_json(&args);
    assert_eq!((json["clips"].as_u64(), json["data"].as_array().unwrap().len()), (Some(2), 2));
    for key in ["psnr_full_db", "ssim_full", "depth_rmse_full", "velocity_epe"] {
        assert!(json[key].is_number(), "{key}: {}", json[key]);
    }
    // A copy of the nearest picture shows the street, untrained weights do not.
    let copy = json["baselines"]["copy_nearest"]["psnr_full_db"].as_f64().unwrap();
    assert!(copy > json["psnr_full_db"].as_f64().unwrap() && copy > 10.0, "{copy}");
    assert!(json["ablations"]["no_motion"]["psnr_full_db"].is_number());
    assert!(ok(&args).contains("| frames        | method "));
    // True geometry through the same renderer.
    let oracle = &json["bounds"]["oracle"];
    assert!(oracle["psnr_full_db"].as_f64() > json["psnr_full_db"].as_f64(), "{oracle}");
    assert!(oracle["velocity_epe_ratio"].as_f64().unwrap() < 0.2 && oracle["rotation_deg"].as_f64().unwrap() < 1e-6);
    assert!(json["context_depth_absrel"].is_number() && json["sky_iou"].is_number());
    assert!(json["ablations"]["no_causal"].is_null());
    ok(&[&args[..], &["--target-poses", "aligned-truth"]].concat());
    fails(2, &["eval", "-m", s(&model)]);
    fails(6, &["eval", "-m", s(&model), "--data", "/nonexistent"]);
}

#[test]
fn eval_draws_held_out_streets_and_writes_its_table() {
    let dir = tempfile::tempdir().unwrap();
    let (model, out) = (dir.path().join("tiny.sfw"), dir.path().join("out"));
    fs::write(&model, tiny_blob()).unwrap();
    let args = ["eval", "-m", s(&model), "--synth-heldout", "2", "--seed", "3", "--size", "56x42", "--ablations"];
    let json = ok_json(&[&args[..], &["-o", s(&out)]].concat());
    let seeds: Vec<u64> = json["data"].as_array().unwrap().iter().map(|d| d["seed"].as_u64().unwrap()).collect();
    assert_eq!(seeds, sf_synth::Split::HeldOut.seeds(3).take(2).collect::<Vec<_>>());
    assert_eq!((json["interpolation_frames"].as_u64(), json["extrapolation_frames"].as_u64()), (Some(24), Some(8)));
    for (group, key) in [
        ("ablations", "no_motion"),
        ("ablations", "forward_only"),
        ("ablations", "no_causal"),
        ("baselines", "copy_nearest"),
        ("bounds", "oracle"),
        ("bounds", "oracle_no_motion"),
    ] {
        assert!(json[group][key]["interpolation"]["psnr_full_db"].is_number(), "{group}.{key}");
    }
    let file = |name: &str| fs::read_to_string(out.join(name)).unwrap();
    assert_eq!(serde_json::from_str::<serde_json::Value>(&file("eval.json")).unwrap(), json);
    assert!(file("eval.md").contains("| interpolation | oracle_no_motion |"), "{}", file("eval.md"));
    fails(2, &["eval", "--synth-heldout", "0"]);
    fails(2, &["eval", "--synth-heldout", "1", "--data", "x"]);
}

#[test]
fn a_real_drive_is_measured_by_the_frames_left_out() {
    let dir = tempfile::tempdir().unwrap();
    let model = dir.path().join("tiny.sfw");
    fs::write(&model, tiny_blob()).unwrap();
    let drive = concat!(env!("CARGO_MANIFEST_DIR"), "/../tests/data/drive");
    let args = ["eval", "-m", s(&model), "--data", drive, "--size", "112x56"];
    let json = ok_json(&[&args[..], &["--fps", "12.5"]].concat());
    assert_eq!((json["interpolation_frames"].as_u64(), json["extrapolation_frames"].as_u64()), (Some(12), Some(3)));
    let copy = &json["baselines"]["copy_nearest"];
    for of in [&json, copy, &json["ablations"]["no_motion"]] {
        for part in ["interpolation", "extrapolation"] {
            assert!(of[part]["psnr_full_db"].is_number() && of[part]["ssim_full"].is_number(), "{part}: {of}");
        }
    }
    // Nothing else is known of it.
    for key in ["psnr_dynamic_db", "depth_rmse_full", "velocity_epe", "rotation_deg", "dynamic_iou", "sky_iou"] {
        assert!(json[key].is_null(), "{key}: {}", json[key]);
    }
    assert_eq!(json["bounds"], serde_json::json!({}));
    // The network is told the frame rate; what is copied does not depend on it.
    let other = ok_json(&args);
    assert_eq!(other["baselines"]["copy_nearest"], *copy);
    assert_ne!(other["psnr_full_db"], json["psnr_full_db"]);
    fails(2, &["eval", "-m", s(&model), "--data", drive, "--fps", "0"]);
    fails(2, &["eval", "-m", s(&model), "--synth-heldout", "1", "--fps", "5"]);
}

#[test]
fn the_demo_runs_in_any_folder() {
    let dir = tempfile::tempdir().unwrap();
    let model = dir.path().join("tiny.sfw");
    fs::write(&model, tiny_blob()).unwrap();
    let out = dir.path().join("demo");
    let r = common::ran(
        common::command(&["demo", "-m", "tiny.sfw", "-o", "demo"]).current_dir(dir.path()).output().unwrap(),
    );
    assert_eq!(r.code, 0, "{}", r.stderr);
    assert!(r.stdout.contains("demo/overview.png") && r.stdout.contains("network"), "{}", r.stdout);
    assert!(!r.stdout.contains("random"), "{}", r.stdout);
    for file in ["overview.png", "novel/000019.png", "aside/000000.png", "orbit/000035.png", "scene/scene.ply"] {
        assert!(out.join(file).exists(), "{file}");
    }
    let json: serde_json::Value = serde_json::from_slice(&fs::read(out.join("demo.json")).unwrap()).unwrap();
    assert_eq!(json["schema"], "streetforward.demo/1");
    assert!(json["run_ms"].as_f64().unwrap() > 0.0 && json["eval"]["psnr_full_db"].is_number());
    ok(&["render", "-s", s(&out.join("scene")), "-o", s(&dir.path().join("again")), "--times", "0.3"]);
    ok(&["eval", "-m", s(&model), "--data", s(&out.join("clip"))]);
}
