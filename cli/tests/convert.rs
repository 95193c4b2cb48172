//! `init` and `convert`.

mod common;

use common::{error_line, fails, files, ok, ok_json, ran, safetensors, tiny_config};
use std::fs;
use std::path::{Path, PathBuf};
use std::process::{Command, Stdio};

fn s(path: &Path) -> &str {
    path.to_str().unwrap()
}

/// A folder with a tiny configuration and a random checkpoint of it.
fn checkpoint() -> (tempfile::TempDir, PathBuf, PathBuf) {
    let dir = tempfile::tempdir().unwrap();
    let (config, ckpt) = (dir.path().join("tiny.json"), dir.path().join("tiny.safetensors"));
    fs::write(&config, tiny_config().to_json().to_string()).unwrap();
    ok(&["init", "--config", s(&config), "--seed", "7", "-o", s(&ckpt)]);
    (dir, config, ckpt)
}

#[test]
fn init_writes_checkpoints_and_blobs_of_the_same_network() {
    let (dir, config, ckpt) = checkpoint();
    let blob = dir.path().join("direct.sfw");
    let json = ok_json(&["init", "--config", s(&config), "--seed", "7", "-o", s(&blob)]);
    assert_eq!(json["parameters"], sf_formats::arch::parameters(&tiny_config()));
    assert_eq!(json["bytes"], fs::metadata(&blob).unwrap().len());
    let converted = dir.path().join("converted.sfw");
    ok(&["convert", s(&ckpt), "-o", s(&converted)]);
    // The same weights whichever way they went; the provenance differs.
    let (a, b) = (sf_formats::Blob::from_bytes(&fs::read(&blob).unwrap()).unwrap(), fs::read(&converted).unwrap());
    let b = sf_formats::Blob::from_bytes(&b).unwrap();
    assert_eq!(a.config(), b.config());
    for i in 0..a.tensors().len() {
        assert_eq!(a.bytes(i), b.bytes(i), "{}", a.tensors()[i].spec.name);
    }
    // Another seed is another network.
    let other = dir.path().join("other.sfw");
    let j = ok_json(&["init", "--config", s(&config), "--seed", "8", "-o", s(&other)]);
    assert_ne!(j["digest"], json["digest"]);
}

#[test]
fn init_refuses_what_it_cannot_write() {
    let (dir, config, ckpt) = checkpoint();
    assert!(fails(6, &["init", "--config", s(&config), "-o", s(&ckpt)]).contains("--force"));
    assert!(fails(2, &["init", "-o", "model.onnx"]).contains(".sfw"));
    fails(2, &["init", "--to", "f16", "-o", s(&dir.path().join("x.safetensors"))]);
    fails(2, &["init", "--preset", "huge", "-o", "x.sfw"]);
    fails(2, &["init"]);
    fs::write(&config, "{\"encoder.dmi\": 3}").unwrap();
    assert!(fails(4, &["init", "--config", s(&config), "-o", "x.sfw"]).contains("encoder.dmi"));
    fails(6, &["init", "--config", "/nonexistent.json", "-o", "x.sfw"]);
}

#[test]
fn heads_and_presets_are_chosen_by_flags() {
    let dir = tempfile::tempdir().unwrap();
    let out = dir.path().join("nano.sfw");
    let json = ok_json(&["init", "--heads", "linear", "--to", "f16", "-o", s(&out)]);
    assert_eq!(json["parameters"], 4_262_546);
    assert_eq!(json["config"]["gs.kind"], "xdec_linear");
    assert!(json["bytes"].as_u64().unwrap() < 3 * 4_262_546);
}

#[test]
fn c17_the_same_checkpoint_twice_gives_the_same_bytes() {
    let (dir, _, ckpt) = checkpoint();
    let (a, b) = (dir.path().join("a.sfw"), dir.path().join("b.sfw"));
    for out in [&a, &b] {
        ok(&["convert", s(&ckpt), "-o", s(out), "--to", "f16", "--keep", "decoder.0.=f32,gs_head.=f32"]);
    }
    assert_eq!(fs::read(&a).unwrap(), fs::read(&b).unwrap());
}

#[test]
fn precision_and_exceptions_are_reported() {
    let (dir, _, ckpt) = checkpoint();
    let out = dir.path().join("x.sfw");
    let json = ok_json(&["convert", s(&ckpt), "-o", s(&out), "--to", "f16", "--keep", "decoder.0.=f32"]);
    let dtype = |name: &str| {
        let list = json["tensors"].as_array().unwrap();
        list.iter().find(|t| t["name"] == name).unwrap()["dtype"].as_str().unwrap().to_string()
    };
    assert_eq!(dtype("decoder.0.attn.qkv.weight"), "f32");
    assert_eq!(dtype("decoder.1.attn.qkv.weight"), "f16");
    assert_eq!(json["digest"], ok_json(&["verify", "-m", s(&out)])["digest"]);
    fails(2, &["convert", s(&ckpt), "-o", s(&out), "--keep", "decoder.0."]);
    fails(2, &["convert", s(&ckpt), "-o", s(&out), "--to", "int3"]);
}

#[test]
fn a_dry_run_writes_nothing() {
    let (dir, _, ckpt) = checkpoint();
    let out = dir.path().join("x.sfw");
    let text = ok(&["convert", s(&ckpt), "-o", s(&out), "--dry-run"]);
    assert!(text.contains("dry run"), "{text}");
    assert!(!out.exists());
}

#[test]
fn c01_missing_tensors_are_named_and_may_be_allowed() {
    let dir = tempfile::tempdir().unwrap();
    let file = dir.path().join("x.safetensors");
    fs::write(&file, safetensors(&[("encoder.cls_tokn", &[1, 1, 16], &[0.0; 16])], &[])).unwrap();
    let config = dir.path().join("tiny.json");
    fs::write(&config, tiny_config().to_json().to_string()).unwrap();
    let out = dir.path().join("x.sfw");
    let line = fails(4, &["convert", s(&file), "-o", s(&out), "--config", s(&config)]);
    assert!(line.contains("encoder.cls_token"), "{line}");
    assert!(!out.exists());
}

#[test]
fn tensors_are_renamed_by_a_map() {
    let (dir, _, ckpt) = checkpoint();
    // The same tensors under other names.
    let bytes = fs::read(&ckpt).unwrap();
    let n = u64::from_le_bytes(bytes[..8].try_into().unwrap()) as usize;
    let header = String::from_utf8(bytes[8..8 + n].to_vec()).unwrap();
    let renamed = header.replace("\"encoder.norm.", "\"backbone.n.").replace("\"register_token\"", "\"regs\"");
    assert_ne!(header, renamed);
    let mut other = (renamed.len() as u64).to_le_bytes().to_vec();
    other.extend(renamed.as_bytes());
    other.extend(&bytes[8 + n..]);
    let file = dir.path().join("other.safetensors");
    fs::write(&file, other).unwrap();
    let (a, b, map) = (dir.path().join("a.sfw"), dir.path().join("b.sfw"), dir.path().join("map.json"));
    fails(4, &["convert", s(&file), "-o", s(&a)]);
    fs::write(&map, "{\"backbone.n.\": \"encoder.norm.\", \"regs\": \"register_token\"}").unwrap();
    ok(&["convert", s(&file), "-o", s(&a), "--map", s(&map)]);
    ok(&["convert", s(&ckpt), "-o", s(&b)]);
    let stats = |f: &Path| ok_json(&["inspect", s(f), "--stats", "--tensors", "*"])["tensors"].clone();
    assert_eq!(stats(&a), stats(&b));
    fs::write(&map, "{\"nothing.\": \"encoder.\"}").unwrap();
    assert!(fails(2, &["convert", s(&file), "-o", s(&dir.path().join("c")), "--map", s(&map)]).contains("nothing."));
    fs::write(&map, "[]").unwrap();
    fails(2, &["convert", s(&file), "-o", s(&dir.path().join("c")), "--map", s(&map)]);
}

#[test]
fn c11_the_output_is_the_input() {
    let (dir, _, ckpt) = checkpoint();
    let before = fs::read(&ckpt).unwrap();
    fails(2, &["convert", s(&ckpt), "-o", s(&ckpt), "--force"]);
    let link = dir.path().join("link.sfw");
    std::os::unix::fs::symlink(&ckpt, &link).unwrap();
    fails(2, &["convert", s(&ckpt), "-o", s(&link), "--force"]);
    assert_eq!(fs::read(&ckpt).unwrap(), before);
}

#[test]
fn c12_an_existing_output_needs_force() {
    let (dir, _, ckpt) = checkpoint();
    let out = dir.path().join("x.sfw");
    fs::write(&out, b"precious").unwrap();
    assert!(fails(6, &["convert", s(&ckpt), "-o", s(&out)]).contains("--force"));
    assert_eq!(fs::read(&out).unwrap(), b"precious");
    ok(&["convert", s(&ckpt), "-o", s(&out), "--force"]);
    ok(&["verify", "-m", s(&out)]);
}

#[test]
fn c13_a_file_size_limit_is_exit_6_and_leaves_nothing() {
    let (dir, _, ckpt) = checkpoint();
    let out = dir.path().join("x.sfw");
    let before = files(dir.path());
    // 8 blocks of 512 or 1024 bytes: less than any blob.
    let script = "ulimit -f 8; exec \"$0\" convert \"$1\" -o \"$2\"";
    let mut c = Command::new("sh");
    c.args(["-c", script, env!("CARGO_BIN_EXE_streetforward")]).arg(&ckpt).arg(&out);
    let r = ran(c.stdin(Stdio::null()).output().unwrap());
    assert_eq!(r.code, 6, "{}", r.stderr);
    error_line(&r.stderr);
    assert_eq!(files(dir.path()), before);
    // A folder that is not there.
    fails(6, &["convert", s(&ckpt), "-o", "/nonexistent/folder/x.sfw"]);
}

#[test]
fn b05_a_blob_is_not_a_checkpoint() {
    let (dir, config, _) = checkpoint();
    let blob = dir.path().join("x.sfw");
    ok(&["init", "--config", s(&config), "-o", s(&blob)]);
    let line = fails(4, &["convert", s(&blob), "-o", s(&dir.path().join("y.sfw"))]);
    assert!(line.contains("already converted"), "{line}");
    fs::write(&blob, b"").unwrap();
    fails(4, &["convert", s(&blob), "-o", s(&dir.path().join("y.sfw"))]);
}
