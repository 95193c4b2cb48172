//! Running the built binary and judging what it says.
#![allow(dead_code, unreachable_pub, reason = "each test file uses a part of it")]

use serde_json::Value;
use sf_formats::Dtype;
use sf_formats::config::{Head, ModelConfig, Trunk};
use sf_quant::{Options, Outputs, Seeded, convert_to_bytes};
use std::ffi::OsStr;
use std::path::{Path, PathBuf};
use std::process::{Command, Output, Stdio};

/// The binary under test with no environment that could change it.
pub fn command<S: AsRef<OsStr>>(args: &[S]) -> Command {
    let mut c = Command::new(env!("CARGO_BIN_EXE_streetforward"));
    c.args(args).env_remove("STREETFORWARD_CPU").stdin(Stdio::null());
    c
}

/// What one call gave.
pub struct Ran {
    pub code: i32,
    pub stdout: String,
    pub stderr: String,
}

pub fn ran(output: Output) -> Ran {
    Ran {
        code: output.status.code().expect("the command must not die by a signal"),
        stdout: String::from_utf8(output.stdout).expect("standard output is UTF-8"),
        stderr: String::from_utf8(output.stderr).expect("standard error is UTF-8"),
    }
}

pub fn run<S: AsRef<OsStr>>(args: &[S]) -> Ran {
    ran(command(args).output().expect("the binary starts"))
}

/// Runs and expects success; gives standard output.
#[track_caller]
pub fn ok<S: AsRef<OsStr>>(args: &[S]) -> String {
    let r = run(args);
    assert_eq!(r.code, 0, "{}", r.stderr);
    r.stdout
}

/// Runs with `--json` and expects one document with the schema `streetforward.VERB/1`.
#[track_caller]
pub fn ok_json<S: AsRef<OsStr>>(args: &[S]) -> Value {
    let mut all: Vec<&OsStr> = args.iter().map(AsRef::as_ref).collect();
    all.push(OsStr::new("--json"));
    let text = ok(&all);
    let json: Value = serde_json::from_str(&text).unwrap_or_else(|e| panic!("{e} in {text}"));
    let verb = all[0].to_str().unwrap();
    assert_eq!(json["schema"], format!("streetforward.{verb}/1"), "{text}");
    json
}

/// Runs and expects the exit code, nothing on standard output and one short `error:` line as the
/// last of standard error; gives that line.
#[track_caller]
pub fn fails<S: AsRef<OsStr>>(code: i32, args: &[S]) -> String {
    let r = run(args);
    assert_eq!(r.code, code, "stdout {} stderr {}", r.stdout, r.stderr);
    assert_eq!(r.stdout, "", "a failed command prints no result");
    error_line(&r.stderr)
}

/// The one error line of a standard error text.
#[track_caller]
pub fn error_line(stderr: &str) -> String {
    let errors: Vec<&str> = stderr.lines().filter(|l| l.starts_with("error: ")).collect();
    assert_eq!(errors.len(), 1, "{stderr}");
    assert_eq!(stderr.lines().last(), Some(errors[0]), "{stderr}");
    assert!(errors[0].len() <= 300, "{} bytes: {}", errors[0].len(), errors[0]);
    assert!(errors[0].chars().all(|c| !c.is_control()), "{:?}", errors[0]);
    errors[0].to_string()
}

/// Every file below a folder, relative, sorted, hidden ones included.
pub fn files(folder: &Path) -> Vec<PathBuf> {
    fn walk(root: &Path, below: &Path, out: &mut Vec<PathBuf>) {
        for entry in std::fs::read_dir(root.join(below)).unwrap() {
            let entry = entry.unwrap();
            let relative = below.join(entry.file_name());
            if entry.file_type().unwrap().is_dir() { walk(root, &relative, out) } else { out.push(relative) }
        }
    }
    let mut out = Vec::new();
    walk(folder, Path::new(""), &mut out);
    out.sort();
    out
}

/// Bytes of a safetensors file with f32 tensors.
pub fn safetensors(tensors: &[(&str, &[usize], &[f32])], metadata: &[(&str, &str)]) -> Vec<u8> {
    let mut header = serde_json::Map::new();
    if !metadata.is_empty() {
        let map: serde_json::Map<_, _> = metadata.iter().map(|(k, v)| (k.to_string(), (*v).into())).collect();
        header.insert("__metadata__".into(), map.into());
    }
    let mut data = Vec::new();
    for (name, shape, values) in tensors {
        let start = data.len();
        data.extend(values.iter().flat_map(|v| v.to_le_bytes()));
        let row = serde_json::json!({ "dtype": "F32", "shape": shape, "data_offsets": [start, data.len()] });
        header.insert(name.to_string(), row);
    }
    let mut text = Value::Object(header).to_string();
    text.push_str(&" ".repeat(text.len().next_multiple_of(8) - text.len()));
    let mut bytes = (text.len() as u64).to_le_bytes().to_vec();
    bytes.extend(text.as_bytes());
    bytes.extend(data);
    bytes
}

/// A network small enough to run in milliseconds in any build: 28x42 pixels make six patches.
pub fn tiny_config() -> ModelConfig {
    let base = ModelConfig::base();
    ModelConfig {
        encoder: Trunk { dim: 16, depth: 1, heads: 2, registers: 1, ..base.encoder },
        pos_grid: 4,
        aa: Trunk { dim: 16, depth: 2, heads: 2, registers: 1, ..base.aa },
        camera_dim: 16,
        camera_depth: 1,
        camera_heads: 2,
        camera_width: 8,
        depth: Head::xdec_linear(3, 16, 1, 2),
        conf: Head::xdec_linear(1, 16, 1, 2),
        gs: Head::dpt(11, [0, 0, 0, 0], [4, 4, 8, 8], 8),
        time_dim: 8,
        causal_depth: 4,
        causal_heads: 3,
        motion: Head::dpt(4, [0, 1, 2, 3], [4, 4, 8, 8], 8),
        ..base
    }
}

/// A valid blob of [`tiny_config`] with random weights.
pub fn tiny_blob() -> Vec<u8> {
    let seeded = Seeded::new(&tiny_config(), 7, Outputs::Random).unwrap();
    convert_to_bytes(&seeded, &Options::to(Dtype::F32)).unwrap()
}
