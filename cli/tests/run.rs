//! `run`: clips of every kind through the network.

mod common;

use common::{command, error_line, fails, files, ok, ok_json, ran, run, tiny_blob, tiny_config};
use sf_formats::Dtype;
use sf_formats::atomic::Overwrite;
use sf_formats::config::{Head, ModelConfig};
use sf_formats::image_io::{self, Rgb8};
use sf_formats::{Scene, npy};
use sf_quant::{Options, Outputs, Seeded, convert_to_bytes};
use std::fs;
use std::path::{Path, PathBuf};

fn s(path: &Path) -> &str {
    path.to_str().unwrap()
}

fn drive() -> &'static str {
    concat!(env!("CARGO_MANIFEST_DIR"), "/../tests/data/drive")
}

fn picture(path: &Path, w: u32, h: u32, shade: usize) {
    let data = (0..(w * h * 3) as usize).map(|i| ((i * 7 + shade * 31) % 251) as u8).collect();
    image_io::write_png(path, &Rgb8::new(w, h, data), Overwrite::Yes).unwrap();
}

/// A folder with `tiny.sfw` and a clip of some 56x42 pictures in `clip/`.
fn workplace(frames: usize) -> (tempfile::TempDir, PathBuf, PathBuf) {
    let dir = tempfile::tempdir().unwrap();
    let (model, clip) = (dir.path().join("tiny.sfw"), dir.path().join("clip"));
    fs::write(&model, tiny_blob()).unwrap();
    fs::create_dir(&clip).unwrap();
    for f in 0..frames {
        picture(&clip.join(format!("{f}.png")), 56, 42, f);
    }
    (dir, model, clip)
}

const EVERYTHING: &str = "scene,depth,conf,points,poses,velocity,dynamic,overview";

#[test]
fn everything_is_written_with_the_documented_shapes() {
    let (dir, model, clip) = workplace(3);
    let (out, stages) = (dir.path().join("out"), dir.path().join("stages"));
    let json = ok_json(&[
        "run",
        "-m",
        s(&model),
        "-i",
        s(&clip),
        "-o",
        s(&out),
        "--emit",
        EVERYTHING,
        "--dump-stages",
        s(&stages),
        "--quiet",
    ]);
    assert_eq!((json["width"].as_u64(), json["height"].as_u64()), (Some(56), Some(42)));
    assert_eq!(json["gaussians"], 3 * 56 * 42);
    assert_eq!(json["no_motion"], false);
    assert_eq!(json["clip"]["times_s"], serde_json::json!([0.0, 0.1, 0.2]));
    for (name, tail) in [("depth", &[][..]), ("conf", &[]), ("points", &[3]), ("velocity", &[6]), ("dynamic", &[])] {
        let (shape, values) = npy::read_f32(&out.join(format!("{name}.npy"))).unwrap();
        assert_eq!(shape, [&[3, 42, 56], tail].concat(), "{name}");
        assert!(values.iter().all(|v| v.is_finite()), "{name}");
    }
    assert_eq!(npy::read(&out.join("poses.npy")).unwrap().shape, [3, 4, 4]);
    for file in ["depth/000002.png", "depth/000002_colour.png", "velocity/000000.png", "dynamic/000001.png"] {
        let image = image_io::read(&out.join(file), image_io::Orientation::Ignore).unwrap();
        assert_eq!(image.size(), (56, 42), "{file}");
    }
    let (scene, report) = Scene::load(&out).unwrap();
    assert_eq!((scene.len() + report.dropped(), scene.frames.len()), (3 * 56 * 42, 3));
    let saved: serde_json::Value = serde_json::from_slice(&fs::read(out.join("run.json")).unwrap()).unwrap();
    assert_eq!(saved["output_digest"], json["output_digest"]);
    for name in ["depth", "conf", "points", "poses", "velocity", "dynamic"] {
        let [a, b] = [&out, &stages].map(|d| fs::read(d.join(format!("{name}.npy"))).unwrap());
        assert_eq!(a, b, "{name}");
    }
    // Stages have a leading frame axis.
    let (shape, _) = npy::read_f32(&stages.join("patches.npy")).unwrap();
    assert_eq!(shape, [3, 12, 16]);
    assert_eq!(
        npy::read_f32(&stages.join("out.depth.npy")).unwrap().1,
        npy::read_f32(&out.join("depth.npy")).unwrap().1
    );
}

#[test]
fn results_do_not_depend_on_threads_loading_or_kernels_being_watched() {
    let (dir, model, clip) = workplace(2);
    let digest = |name: &str, flags: &[&str]| {
        let out = dir.path().join(name);
        let mut args = vec!["run", "-m", s(&model), "-i", s(&clip), "-o", s(&out), "-q"];
        args.extend(flags);
        ok_json(&args)["output_digest"].as_str().unwrap().to_string()
    };
    let one = digest("a", &["--threads", "1"]);
    assert_eq!(one, digest("b", &["--threads", "3"]));
    assert_eq!(one, digest("c", &["--load", "copy"]));
    assert_eq!(one, digest("d", &["--isa", "scalar"]));
    let stages = dir.path().join("stages");
    assert_eq!(one, digest("e", &["--dump-stages", s(&stages)]));
    assert_ne!(one, digest("f", &["--fps", "5"]), "time is part of the input");
}

#[test]
fn a_checkpoint_is_converted_for_the_run() {
    let (dir, _, clip) = workplace(2);
    let (config, ckpt) = (dir.path().join("tiny.json"), dir.path().join("tiny.safetensors"));
    let blob = dir.path().join("same.sfw");
    fs::write(&config, common::tiny_config().to_json().to_string()).unwrap();
    ok(&["init", "--config", s(&config), "-o", s(&ckpt)]);
    ok(&["init", "--config", s(&config), "-o", s(&blob)]);
    let scratch = dir.path().join("scratch");
    fs::create_dir(&scratch).unwrap();
    let out = dir.path().join("a");
    let args = ["run", "-m", s(&ckpt), "-i", s(&clip), "-o", s(&out), "--json"];
    let r = ran(command(&args).env("TMPDIR", &scratch).output().unwrap());
    assert_eq!(r.code, 0, "{}", r.stderr);
    assert!(r.stderr.contains("converting it to f32"), "{}", r.stderr);
    assert!(files(&scratch).is_empty(), "the temporary blob is gone");
    let json: serde_json::Value = serde_json::from_str(&r.stdout).unwrap();
    let direct = ok_json(&["run", "-m", s(&blob), "-i", s(&clip), "-o", s(&dir.path().join("b")), "-q"]);
    assert_eq!(json["output_digest"], direct["output_digest"]);
}

#[test]
fn without_a_model_the_built_in_one_runs_or_random_weights_that_say_so() {
    let (dir, _, clip) = workplace(2);
    let out = dir.path().join("out");
    let r = run(&["run", "-i", s(&clip), "-o", s(&out), "--json", "-q", "--emit", "conf"]);
    assert_eq!(r.code, 0, "{}", r.stderr);
    let json: serde_json::Value = serde_json::from_str(&r.stdout).unwrap();
    let random = json["model"]["random_weights"].as_bool().unwrap();
    assert_eq!(json["model"]["embedded"], !random);
    assert_eq!(r.stderr.contains("random weights"), random, "{}", r.stderr);
    assert_eq!(json["model"]["parameters"], 4_398_074);
}

#[test]
fn what_a_network_does_not_predict_is_not_emitted() {
    let (dir, _, clip) = workplace(2);
    let out = dir.path().join("out");
    let model = dir.path().join("bare.sfw");
    let config = ModelConfig { conf: Head::none(), ..tiny_config() };
    let seeded = Seeded::new(&config, 1, Outputs::Random).unwrap();
    fs::write(&model, convert_to_bytes(&seeded, &Options::to(Dtype::F32)).unwrap()).unwrap();
    let line = fails(2, &["run", "-m", s(&model), "-i", s(&clip), "-o", s(&out), "-q", "--emit", "conf"]);
    assert!(line.contains("confidence"), "{line}");
}

#[test]
fn a_real_drive_runs_renders_and_exports() {
    let dir = tempfile::tempdir().unwrap();
    let (model, out) = (dir.path().join("tiny.sfw"), dir.path().join("out"));
    fs::write(&model, tiny_blob()).unwrap();
    let args = ["run", "-m", s(&model), "-i", drive(), "--fps", "12.5", "--frames", "0,5,10,15", "-o", s(&out)];
    let json = ok_json(&[&args[..], &["--size", "112x56", "--emit", "scene,poses"]].concat());
    assert_eq!(json["clip"]["times_s"], serde_json::json!([0.0, 0.4, 0.8, 1.2]));
    assert_eq!(json["clip"]["names"][1], "000006.jpg");
    assert_eq!(json["clip"]["source_sizes"][0], serde_json::json!([640, 360]));
    let pictures = dir.path().join("pictures");
    ok(&["render", "-s", s(&out), "-o", s(&pictures), "--times", "0.2,1.2", "--shift", "right=0.5"]);
    assert_eq!(files(&pictures).len(), 3);
    let ply = dir.path().join("x.ply");
    ok(&["export", "-s", s(&out), "-o", s(&ply), "--at", "0.4"]);
    // Poses leave at the size of the source pictures.
    let poses: serde_json::Value = serde_json::from_slice(&fs::read(out.join("transforms.json")).unwrap()).unwrap();
    let first = if poses["w"].is_null() { &poses["frames"][0] } else { &poses };
    assert_eq!((first["w"].as_u64(), first["h"].as_u64()), (Some(640), Some(360)));
}

#[test]
fn intrinsics_may_be_given() {
    let (dir, model, clip) = workplace(2);
    let out = dir.path().join("out");
    let args = ["run", "-m", s(&model), "-i", s(&clip), "-o", s(&out), "--force", "-q"];
    let json = ok_json(&[&args[..], &["--size", "28x42", "--intrinsics", "50,60,28,21"]].concat());
    // Half as wide, as high.
    assert_eq!(json["intrinsics"][1], serde_json::json!([25.0, 60.0, 14.0, 21.0]));
    fails(2, &[&args[..], &["--intrinsics", "50,60"]].concat());
    fails(3, &[&args[..], &["--intrinsics", "0,60,28,21"]].concat());
    fails(3, &[&args[..], &["--intrinsics", "nan,60,28,21"]].concat());
    assert!(fails(3, &[&args[..], &["--intrinsics", "clip"]].concat()).contains("has no intrinsics"));
}

#[test]
fn i01_a_damaged_picture_is_named_by_frame() {
    let (dir, model, clip) = workplace(3);
    let file = clip.join("1.png");
    let bytes = fs::read(&file).unwrap();
    let out = dir.path().join("out");
    let mut flipped = bytes.clone();
    flipped[bytes.len() / 2] ^= 0x10;
    for bad in [&bytes[..bytes.len() / 2], b"not a picture", b"", &flipped] {
        fs::write(&file, bad).unwrap();
        let line = fails(3, &["run", "-m", s(&model), "-i", s(&clip), "-o", s(&out), "-q"]);
        assert!(line.contains("frame 1"), "{line}");
        assert!(!out.exists());
    }
    // Unselected frames are not touched.
    ok(&["run", "-m", s(&model), "-i", s(&clip), "-o", s(&out), "--frames", "0,2", "-q"]);
}

#[test]
fn i02_i03_i04_sizes_of_pictures() {
    let (dir, model, clip) = workplace(0);
    let out = dir.path().join("out");
    let shot = |w, h| {
        picture(&clip.join("0.png"), w, h, 0);
        run(&["run", "-m", s(&model), "-i", s(&clip), "-o", s(&out), "--json", "--force", "-q"])
    };
    for (w, h) in [(1, 1), (13, 40), (1, 4000), (2000, 20)] {
        let r = shot(w, h);
        assert_eq!(r.code, 3, "{w}x{h}: {}", r.stderr);
        error_line(&r.stderr);
    }
    // Not a multiple of the patch: resized, and told.
    let r = shot(61, 47);
    assert_eq!(r.code, 0, "{}", r.stderr);
    let json: serde_json::Value = serde_json::from_str(&r.stdout).unwrap();
    assert_eq!((json["width"].as_u64().unwrap() % 14, json["height"].as_u64().unwrap() % 14), (0, 0));
    assert_eq!(json["clip"]["source_sizes"][0], serde_json::json!([61, 47]));
    for size in ["60x42", "0x14"] {
        fails(3, &["run", "-m", s(&model), "-i", s(&clip), "-o", s(&out), "--force", "--size", size, "-q"]);
    }
}

#[test]
fn i12_pictures_of_different_sizes() {
    let (dir, model, clip) = workplace(2);
    picture(&clip.join("1.png"), 70, 42, 1);
    let out = dir.path().join("out");
    let line = fails(3, &["run", "-m", s(&model), "-i", s(&clip), "-o", s(&out), "-q"]);
    assert!(line.contains("--resize"), "{line}");
    ok(&["run", "-m", s(&model), "-i", s(&clip), "-o", s(&out), "--resize", "-q"]);
}

#[test]
fn i13_no_pictures() {
    let (dir, model, clip) = workplace(0);
    let out = dir.path().join("out");
    fs::write(clip.join("readme.txt"), b"nothing here").unwrap();
    fails(2, &["run", "-m", s(&model), "-i", s(&clip), "-o", s(&out)]);
    fails(6, &["run", "-m", s(&model), "-i", s(&dir.path().join("nowhere")), "-o", s(&out)]);
    assert!(!out.exists());
}

#[test]
fn i14_one_picture_stands_still() {
    let (dir, model, clip) = workplace(1);
    let out = dir.path().join("out");
    let json = ok_json(&["run", "-m", s(&model), "-i", s(&clip), "-o", s(&out), "--emit", EVERYTHING, "-q"]);
    assert_eq!(json["no_motion"], true);
    let (_, velocity) = npy::read_f32(&out.join("velocity.npy")).unwrap();
    assert!(velocity.iter().all(|&v| v == 0.0));
    let (_, dynamic) = npy::read_f32(&out.join("dynamic.npy")).unwrap();
    assert!(dynamic.iter().all(|&p| p == 0.0));
}

#[test]
fn i16_more_than_the_memory_budget() {
    let (dir, model, clip) = workplace(3);
    let out = dir.path().join("out");
    let line = fails(5, &["run", "-m", s(&model), "-i", s(&clip), "-o", s(&out), "--max-mem", "100K", "-q"]);
    assert!(line.contains("budget"), "{line}");
    fails(5, &["run", "-m", s(&model), "-i", s(&clip), "-o", s(&out), "--size", "140000x140000", "-q"]);
    assert!(!out.exists());
}

#[test]
fn i20_times_that_cannot_be() {
    let (dir, model, clip) = workplace(3);
    let out = dir.path().join("out");
    for times in ["0,0.1", "0,0.1,0.1", "0,0.2,0.1", "0,nan,1", "0,1,1e18", "0,1,20", "0,1e-5,1"] {
        fails(3, &["run", "-m", s(&model), "-i", s(&clip), "-o", s(&out), "--times", times, "-q"]);
    }
    for fps in ["0", "-1", "nan"] {
        fails(2, &["run", "-m", s(&model), "-i", s(&clip), "-o", s(&out), "--fps", fps, "-q"]);
    }
    assert!(!out.exists());
    let json = ok_json(&["run", "-m", s(&model), "-i", s(&clip), "-o", s(&out), "--times", "-0.5,0,2", "-q"]);
    assert_eq!(json["clip"]["times_s"], serde_json::json!([-0.5, 0.0, 2.0]));
}

#[test]
fn i21_picture_names_of_any_bytes() {
    use std::ffi::OsStr;
    use std::os::unix::ffi::OsStrExt;
    let (dir, model, clip) = workplace(0);
    for (f, name) in [&b"a\nb.png"[..], b"c\xffd.png"].into_iter().enumerate() {
        picture(&clip.join(OsStr::from_bytes(name)), 28, 28, f);
    }
    let out = dir.path().join("out");
    let json = ok_json(&["run", "-m", s(&model), "-i", s(&clip), "-o", s(&out), "-q"]);
    assert_eq!(json["clip"]["frames"], 2);
    Scene::load(&out).unwrap();
}

#[test]
fn b05_what_is_not_a_model() {
    let (dir, _, clip) = workplace(1);
    let (file, out) = (dir.path().join("model"), dir.path().join("out"));
    for (bytes, code) in [(&b""[..], 4), (b"GGUF\x03\0\0\0", 4), (b"\x7fELF\x02\x01", 4), (b"PK\x03\x04junk", 4)] {
        fs::write(&file, bytes).unwrap();
        let r = run(&["run", "-m", s(&file), "-i", s(&clip), "-o", s(&out), "-q"]);
        assert_eq!(r.code, code, "{:?}: {}", bytes, r.stderr);
        error_line(&r.stderr);
    }
    assert!(!out.exists());
    fails(6, &["run", "-m", "/nonexistent.sfw", "-i", s(&clip), "-o", s(&out), "-q"]);
}

#[test]
fn arguments_out_of_range_and_folders_in_use() {
    let (dir, model, clip) = workplace(2);
    let out = dir.path().join("out");
    let args = ["run", "-m", s(&model), "-i", s(&clip), "-o", s(&out)];
    for bad in [
        &["--threads", "65"][..],
        &["--threads", "-1"],
        &["--threads", "abc"],
        &["--frames", "0,x"],
        &["--frames", "1,0"],
        &["--frames", "7"],
        &["--size", "56"],
        &["--emit", "scene,gold"],
        &["--max-mem", "lots"],
        &["--load", "fly"],
        &["--precision", "int2"],
    ] {
        fails(2, &[&args[..], bad].concat());
    }
    assert!(!out.exists());
    fs::create_dir(&out).unwrap();
    fs::write(out.join("mine"), b"x").unwrap();
    assert!(fails(6, &[&args[..], &["-q"]].concat()).contains("--force"));
    assert_eq!(files(&out), [PathBuf::from("mine")]);
    ok(&[&args[..], &["--force", "-q"]].concat());
    assert!(out.join("mine").exists() && out.join("scene.ply").exists());
}
