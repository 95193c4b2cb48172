//! The cases of checkpoints and of the converter, one test per case, named with its id.

use sf_formats::atomic::Overwrite;
use sf_formats::checkpoint::{self, Checkpoint, CheckpointTensor, SourceDtype};
use sf_formats::config::{Concat, Head, ModelConfig, Trunk, Value};
use sf_formats::digest::{Digest, sha256};
use sf_formats::meta::keys;
use sf_formats::{Blob, Dtype, LoadMode, Result, Verify};
use sf_quant::report::Origin;
use sf_quant::seeded::CONFIG_KEY;
use sf_quant::{
    Options, Outputs, Seeded, convert, convert_files, convert_to_bytes, parse_keep, plan, plan_files, write_safetensors,
};
use std::path::{Path, PathBuf};

mod common;
use common::small;

/// The cases covered here. Reading formats (c08 to c10) belongs to `formats`, killed writers (c14) to its
/// atomic files, calibration and accuracy gates (c15, c16, c18) to int8.
pub const CASES: [&str; 11] = ["c01", "c02", "c03", "c04", "c05", "c06", "c07", "c11", "c12", "c13", "c17"];

#[test]
fn every_listed_case_has_a_test() {
    let source = include_str!("convert_cases.rs");
    for id in CASES {
        assert!(source.contains(&format!("\nfn {id}_")), "{id}");
    }
}

/// A checkpoint in memory.
#[derive(Clone, Default)]
struct Mock {
    tensors: Vec<CheckpointTensor>,
    values: Vec<Vec<f32>>,
    config: Option<String>,
}

impl Mock {
    fn of(config: &ModelConfig) -> Mock {
        let seeded = Seeded::new(config, 1, Outputs::Random).unwrap();
        let mut mock = Mock { config: Some(config.to_json().to_string()), ..Mock::default() };
        for (i, t) in seeded.tensors().iter().enumerate() {
            let mut values = Vec::new();
            seeded.read_f32(i, &mut values).unwrap();
            mock.push(&t.name, &t.shape, values);
        }
        mock
    }

    fn push(&mut self, name: &str, shape: &[usize], values: Vec<f32>) {
        assert_eq!(values.len(), shape.iter().product::<usize>());
        self.tensors.push(CheckpointTensor { name: name.into(), shape: shape.to_vec(), dtype: SourceDtype::F32 });
        self.values.push(values);
    }

    fn at(&self, name: &str) -> usize {
        self.find(name).unwrap_or_else(|| panic!("no {name}"))
    }

    fn renamed(mut self, rename: impl Fn(&str) -> String) -> Mock {
        for t in &mut self.tensors {
            t.name = rename(&t.name);
        }
        self
    }

    fn without(mut self, prefix: &str) -> Mock {
        let keep: Vec<bool> = self.tensors.iter().map(|t| !t.name.starts_with(prefix)).collect();
        let mut k = keep.iter();
        self.tensors.retain(|_| *k.next().unwrap());
        let mut k = keep.iter();
        self.values.retain(|_| *k.next().unwrap());
        self
    }

    #[track_caller]
    fn refused(&self, options: &Options, status: i32, text: &str) {
        let e = convert_to_bytes(self, options).expect_err("accepted");
        assert!(e.status() as i32 == status && e.to_string().contains(text), "status {}: {e}", e.status() as i32);
    }

    fn blob(&self, options: &Options) -> Blob {
        Blob::from_bytes(&convert_to_bytes(self, options).unwrap()).unwrap()
    }
}

impl Checkpoint for Mock {
    fn tensors(&self) -> &[CheckpointTensor] {
        &self.tensors
    }
    fn read_f32(&self, index: usize, out: &mut Vec<f32>) -> Result<()> {
        out.clear();
        out.extend_from_slice(&self.values[index]);
        Ok(())
    }
    fn metadata(&self, key: &str) -> Option<&str> {
        self.config.as_deref().filter(|_| key == CONFIG_KEY)
    }
    fn describe(&self) -> String {
        "mock".into()
    }
    fn digest(&self) -> Result<Digest> {
        Ok(sha256(b"mock"))
    }
}

fn f32s() -> Options {
    Options::to(Dtype::F32)
}

/// Every value of the blob is that of the checkpoint, rounded to the stored type.
fn assert_same(blob: &Blob, source: &Mock) {
    let mut got = Vec::new();
    for (t, want) in source.tensors.iter().zip(&source.values) {
        let i = blob.find(&t.name).unwrap_or_else(|| panic!("no {}", t.name));
        blob.read_f32(i, &mut got);
        // Rounding to f16: half of 2^-10 relative, or half of the smallest step 2^-24.
        let tolerance = |w: f32| match blob.tensors()[i].dtype {
            Dtype::F32 => 0.0,
            Dtype::F16 => (w.abs() / 2048.0).max(2f32.powi(-25)),
            Dtype::Int8 => panic!("{} is int8", t.name),
        };
        assert!(got.iter().zip(want).all(|(g, &w)| (g - w).abs() <= tolerance(w)), "{}", t.name);
    }
}

#[test]
fn conversion_keeps_every_value() {
    let source = Mock::of(&small());
    for precision in [Dtype::F32, Dtype::F16] {
        let blob = source.blob(&Options { licence: Some("ours".into()), ..Options::to(precision) });
        assert_eq!(*blob.config(), small());
        assert_same(&blob, &source);
        assert_eq!(blob.meta().text(keys::LICENCE), Some("ours"));
        assert_eq!(blob.meta().text(keys::PRECISION), Some(precision.name()));
        assert_eq!(blob.meta().get("precision"), Some(&Value::Text(precision.name().into())));
        for t in blob.tensors() {
            let sensitive = t.spec.name.starts_with("camera_head.")
                || t.spec.name.starts_with("point_head.proj")
                || t.spec.name.contains("output_conv2.2");
            let want = if t.spec.matrix().is_some() && !sensitive { precision } else { Dtype::F32 };
            assert_eq!(t.dtype, want, "{}", t.spec.name);
        }
    }
}

#[test]
fn exceptions_choose_the_type_of_a_part() {
    let source = Mock::of(&small());
    let keep = vec![parse_keep("encoder.blocks.0.attn=f32").unwrap(), parse_keep("camera_head.=f16").unwrap()];
    let blob = source.blob(&Options { keep, ..Options::to(Dtype::F16) });
    let dtype = |name: &str| blob.tensors()[blob.find(name).unwrap()].dtype;
    assert_eq!(dtype("encoder.blocks.0.attn.qkv.weight"), Dtype::F32);
    assert_eq!(dtype("encoder.blocks.0.mlp.fc1.weight"), Dtype::F16);
    assert_eq!(dtype("camera_head.fc_t.weight"), Dtype::F16);
    source.refused(&Options { keep: vec![("encodr.".into(), Dtype::F16)], ..f32s() }, 2, "encodr.");
    for bad in ["x", "x=f64", "=f16", "x=F16"] {
        assert_eq!(parse_keep(bad).unwrap_err().status() as i32, 2);
    }
}

#[test]
fn c01_missing_extra_and_renamed() {
    let config = small();
    let source = Mock::of(&config);
    source.clone().without("camera_head.").refused(&f32s(), 4, "20 missing: camera_head.res_conv.0.res_conv1.weight, ");
    let mut more = source.clone();
    more.push("encoder.extra", &[1], vec![0.0]);
    more.refused(&f32s(), 4, "1 unexpected: encoder.extra");
    let typo = source.clone().renamed(|n| n.replace("encoder.norm.weight", "encoder.norm.weigth"));
    typo.refused(&f32s(), 4, "'encoder.norm.weigth' may be encoder.norm.weight");
    source.clone().renamed(|n| format!("student.{n}")).refused(&f32s(), 4, "prefix 'student.' is not a known wrapper");

    for prefix in ["module.", "_orig_mod.", "module._orig_mod.model.", "ema_model."] {
        let wrapped = source.clone().renamed(|n| format!("{prefix}{n}"));
        let report = plan(&wrapped, &f32s()).unwrap();
        assert_eq!(report.stripped, [(prefix.to_string(), source.tensors.len())]);
        assert_same(&wrapped.blob(&f32s()), &source);
    }
    // Two sets of weights in one file.
    let mut both = source.clone().renamed(|n| format!("model.{n}"));
    for (t, v) in source.tensors.iter().zip(&source.values) {
        both.push(&format!("ema_model.{}", t.name), &t.shape, v.clone());
    }
    both.refused(&f32s(), 4, "are the same tensor of the network");
}

#[test]
fn c01_names_the_file() {
    let dir = tempfile::tempdir().unwrap();
    let path = dir.path().join("part.safetensors");
    write_safetensors(&Mock::of(&small()).without("encoder.norm"), &path, Overwrite::No).unwrap();
    let e = plan_files(&[path], &f32s()).unwrap_err();
    assert!(e.to_string().contains("part.safetensors: tensors do not fit: 2 missing: encoder.norm.weight"), "{e}");
}

#[test]
fn c02_wrong_shapes() {
    let mut source = Mock::of(&small());
    let i = source.at("encoder.blocks.0.mlp.fc1.weight");
    source.tensors[i].shape.reverse();
    source.refused(&f32s(), 4, "encoder.blocks.0.mlp.fc1.weight is [64, 128], must be [128, 64]");
    let mut source = Mock::of(&small());
    let i = source.at("encoder.pos_embed");
    source.tensors[i].shape[1] = 17;
    source.refused(&f32s(), 4, "encoder.pos_embed is [1, 17, 64], must be [1, 10, 64]");
}

/// A safetensors file of the small network whose first matrix has another element type.
fn with_dtype(dir: &Path, name: &str, bytes_of: impl Fn(f32) -> Vec<u8>) -> (PathBuf, Vec<f32>) {
    let path = dir.join(format!("{name}.safetensors"));
    write_safetensors(&Mock::of(&small()), &path, Overwrite::No).unwrap();
    let file = std::fs::read(&path).unwrap();
    let length = u64::from_le_bytes(file[..8].try_into().unwrap()) as usize;
    let mut header: serde_json::Value = serde_json::from_slice(&file[8..8 + length]).unwrap();
    let mut data = Vec::new();
    let mut changed = Vec::new();
    for (tensor, entry) in header.as_object_mut().unwrap().iter_mut().filter(|(n, _)| *n != "__metadata__") {
        let offsets: Vec<usize> = serde_json::from_value(entry["data_offsets"].clone()).unwrap();
        let old = &file[8 + length + offsets[0]..8 + length + offsets[1]];
        let start = data.len();
        if tensor == "encoder.blocks.0.attn.qkv.weight" {
            entry["dtype"] = name.into();
            for v in old.chunks_exact(4) {
                let v = f32::from_le_bytes(v.try_into().unwrap());
                changed.push(v);
                data.extend(bytes_of(v));
            }
        } else {
            data.extend_from_slice(old);
        }
        entry["data_offsets"] = serde_json::json!([start, data.len()]);
    }
    let text = header.to_string();
    let all = [&(text.len() as u64).to_le_bytes()[..], text.as_bytes(), &data].concat();
    std::fs::write(&path, all).unwrap();
    (path, changed)
}

#[test]
fn c03_other_element_types() {
    let dir = tempfile::tempdir().unwrap();
    let out = dir.path().join("out.sfw");
    // Reads the changed tensor back from a converted file.
    let converted = |path: PathBuf| {
        convert_files(&[path], &out, Overwrite::Yes, &f32s()).unwrap();
        let blob = Blob::open(&out, LoadMode::Map, Verify::Digests).unwrap();
        let mut values = Vec::new();
        blob.read_f32(blob.find("encoder.blocks.0.attn.qkv.weight").unwrap(), &mut values);
        values
    };
    let (path, values) = with_dtype(dir.path(), "F64", |v| f64::from(v).to_le_bytes().to_vec());
    assert_eq!(converted(path), values);
    // The upper half of an f32 is its bf16 rounded towards zero.
    let (path, values) = with_dtype(dir.path(), "BF16", |v| v.to_le_bytes()[2..].to_vec());
    let truncated: Vec<f32> = values.iter().map(|v| f32::from_bits(v.to_bits() & 0xffff_0000)).collect();
    assert_eq!(converted(path), truncated);
    let (path, values) = with_dtype(dir.path(), "F16", |v| if v < 0.0 { vec![0, 0xbc] } else { vec![0, 0x3c] });
    assert_eq!(converted(path), values.iter().map(|&v| if v < 0.0 { -1.0 } else { 1.0 }).collect::<Vec<f32>>());
    let (path, _) = with_dtype(dir.path(), "I8", |v| vec![v as i8 as u8]);
    let wrong = plan_files(std::slice::from_ref(&path), &Options { config: Some(ModelConfig::base()), ..f32s() });
    assert_eq!(wrong.unwrap_err().status() as i32, 2);
    let e = convert_files(&[path], &out, Overwrite::Yes, &f32s()).unwrap_err();
    assert!(e.status() as i32 == 7 && e.to_string().contains("encoder.blocks.0.attn.qkv.weight"), "{e}");
}

#[test]
fn c04_values_that_are_not_finite() {
    let dir = tempfile::tempdir().unwrap();
    for (bad, shown) in [(f32::NAN, "NaN"), (f32::INFINITY, "inf"), (f32::NEG_INFINITY, "-inf")] {
        let mut source = Mock::of(&small());
        let i = source.at("decoder.1.mlp.fc2.weight");
        source.values[i][7] = bad;
        source.values[i][9] = f32::NAN;
        let why = format!("decoder.1.mlp.fc2.weight: value 7 is {shown}; 2 of 8192 are not finite");
        source.refused(&f32s(), 4, &why);
        let out = dir.path().join("out.sfw");
        assert!(convert(&source, &out, Overwrite::No, &f32s()).is_err());
        assert_eq!(std::fs::read_dir(dir.path()).unwrap().count(), 0, "nothing is left behind");
    }
}

#[test]
fn c05_beyond_the_range_of_f16() {
    let dir = tempfile::tempdir().unwrap();
    let mut source = Mock::of(&small());
    let (name, other) = ("decoder.1.mlp.fc2.weight", "decoder.1.mlp.fc1.weight");
    let i = source.at(name);
    source.values[i][7] = -65520.0;
    let i = source.at(other);
    // Rounds down to the largest finite value, 65504.
    source.values[i][0] = 65519.0;
    let out = dir.path().join("out.sfw");
    let report = convert(&source, &out, Overwrite::No, &Options::to(Dtype::F16)).unwrap();
    let promoted: Vec<&str> = report.tensors.iter().filter(|t| t.promoted).map(|t| t.name.as_str()).collect();
    assert_eq!(promoted, [name]);
    assert!(report.lines().iter().any(|l| l.contains("beyond the range of f16") && l.contains(name)));
    let blob = Blob::open(&out, LoadMode::Map, Verify::Digests).unwrap();
    assert_same(&blob, &source);
    assert_eq!(blob.tensors()[blob.find(name).unwrap()].dtype, Dtype::F32);
    assert_eq!(blob.tensors()[blob.find(other).unwrap()].dtype, Dtype::F16);
}

#[test]
fn c06_outputs_that_are_all_zero() {
    let dir = tempfile::tempdir().unwrap();
    let mut source = Mock::of(&small());
    let i = source.at("decoder.0.attn.proj.weight");
    source.values[i][64..3 * 64].fill(0.0);
    let report = convert(&source, &dir.path().join("out.sfw"), Overwrite::No, &f32s()).unwrap();
    let zero: Vec<(&str, usize)> =
        report.tensors.iter().filter(|t| t.zero_outputs > 0).map(|t| (t.name.as_str(), t.zero_outputs)).collect();
    assert_eq!(zero, [("decoder.0.attn.proj.weight", 2)]);
}

#[test]
fn c07_an_outlier_costs_the_others_nothing() {
    let mut source = Mock::of(&small());
    let i = source.at("decoder.0.attn.proj.weight");
    source.values[i][5] = 60000.0;
    // Each value is rounded for itself.
    assert_same(&source.blob(&Options::to(Dtype::F16)), &source);
}

#[test]
fn c11_output_is_an_input() {
    let dir = tempfile::tempdir().unwrap();
    let path = |n: &str| dir.path().join(n);
    let input = path("in.safetensors");
    write_safetensors(&Mock::of(&small()), &input, Overwrite::No).unwrap();
    let before = std::fs::read(&input).unwrap();
    std::os::unix::fs::symlink(&input, path("link.sfw")).unwrap();
    std::fs::hard_link(&input, path("hard.sfw")).unwrap();
    let dotted = dir.path().join(".").join("in.safetensors");
    for out in [&input, &dotted, &path("link.sfw"), &path("hard.sfw")] {
        let e = convert_files(std::slice::from_ref(&input), out, Overwrite::Yes, &f32s()).unwrap_err();
        assert!(e.status() as i32 == 2 && e.to_string().contains("is an input"), "{e}");
    }
    // Not named as an input, but a checkpoint all the same.
    std::fs::copy(&input, path("shard-2.safetensors")).unwrap();
    let out = path("shard-2.safetensors");
    let e = convert_files(std::slice::from_ref(&input), &out, Overwrite::Yes, &f32s()).unwrap_err();
    assert_eq!(e.status() as i32, 2);
    assert_eq!(std::fs::read(&input).unwrap(), before);
}

#[test]
fn c12_output_exists() {
    let dir = tempfile::tempdir().unwrap();
    let out = dir.path().join("out.sfw");
    std::fs::write(&out, "mine").unwrap();
    let source = Mock::of(&small());
    let e = convert(&source, &out, Overwrite::No, &f32s()).unwrap_err();
    assert!(e.status() as i32 == 6 && e.to_string().contains("--force"), "{e}");
    assert_eq!(std::fs::read(&out).unwrap(), b"mine");
    convert(&source, &out, Overwrite::Yes, &f32s()).unwrap();
    Blob::open(&out, LoadMode::Map, Verify::Digests).unwrap();
}

/// Set in the child process that runs under a limit on the size of files.
const CHILD: &str = "SF_TEST_C13_FOLDER";

#[test]
fn c13_no_room_and_no_permission() {
    let source = Mock::of(&small());
    if let Ok(folder) = std::env::var(CHILD) {
        let out = Path::new(&folder).join("out.sfw");
        let e = convert(&source, &out, Overwrite::Yes, &f32s()).unwrap_err();
        assert!(e.status() as i32 == 6 && e.to_string().contains("out.sfw"), "{e}");
        return;
    }
    // Nothing can be created there, not even by the superuser.
    let e = convert(&source, Path::new("/proc/out.sfw"), Overwrite::No, &f32s()).unwrap_err();
    assert_eq!(e.status() as i32, 6);
    let e = convert(&source, Path::new("/dev/null/out.sfw"), Overwrite::No, &f32s()).unwrap_err();
    assert_eq!(e.status() as i32, 6);

    let dir = tempfile::tempdir().unwrap();
    let out = dir.path().join("out.sfw");
    std::fs::write(&out, "old").unwrap();
    // The blob is over a megabyte; the limit is 64 blocks of 512 (or 1024) bytes. The signal is ignored,
    // as a program that reports the error does it.
    let child = std::process::Command::new("sh")
        .args(["-c", "trap '' XFSZ; ulimit -f 64; exec \"$0\" --exact c13_no_room_and_no_permission"])
        .arg(std::env::current_exe().unwrap())
        .env(CHILD, dir.path())
        .output()
        .unwrap();
    let said = String::from_utf8_lossy(&child.stdout);
    assert!(child.status.success() && said.contains("1 passed"), "{said}");
    assert_eq!(std::fs::read(&out).unwrap(), b"old");
    assert_eq!(std::fs::read_dir(dir.path()).unwrap().count(), 1, "no temporary file is left");
}

#[test]
fn c17_the_same_bytes_twice() {
    let dir = tempfile::tempdir().unwrap();
    let path = |n: &str| dir.path().join(n);
    let input = path("in.safetensors");
    write_safetensors(&Seeded::new(&small(), 5, Outputs::Random).unwrap(), &input, Overwrite::No).unwrap();
    let options = Options { command: "convert in.safetensors --to f16".into(), ..Options::to(Dtype::F16) };
    for name in ["a.sfw", "b.sfw"] {
        convert_files(std::slice::from_ref(&input), &path(name), Overwrite::No, &options).unwrap();
    }
    assert_eq!(std::fs::read(path("a.sfw")).unwrap(), std::fs::read(path("b.sfw")).unwrap());
}

#[test]
fn configuration_from_the_file_the_caller_or_the_shapes() {
    let config = small();
    let mut source = Mock::of(&config);
    assert_eq!(plan(&source, &f32s()).unwrap().config, config);
    let other = ModelConfig { mask_k: 2, ..config.clone() };
    source.refused(
        &Options { config: Some(other.clone()), ..f32s() },
        2,
        "differs from the checkpoint's own in mask.k",
    );
    source.config = None;
    assert_eq!(plan(&source, &Options { config: Some(other.clone()), ..f32s() }).unwrap().config, other);
    let report = plan(&source, &f32s()).unwrap();
    assert_eq!(report.config, config);
    assert!(report.config_source.contains("shapes"));
    source.config = Some("{\"patch\": 0}".into());
    source.refused(&f32s(), 4, "patch");
    source.config = Some("nonsense".into());
    source.refused(&f32s(), 4, "JSON");
}

#[test]
fn shapes_tell_every_size() {
    let c = small();
    let linear = |out: u32| Head::xdec_linear(out, 64, 2, 1);
    let bare = ModelConfig {
        gs: Head::none(),
        time_dim: 0,
        causal_depth: 0,
        causal_heads: 0,
        motion: Head::none(),
        image_resample: ModelConfig::pi3().image_resample,
        ..c.clone()
    };
    for want in [
        ModelConfig { conf: linear(1), gs: linear(11), motion: linear(4), ..c.clone() },
        ModelConfig { causal_in: Concat::FrameGlobal, causal_share: false, ..c.clone() },
        ModelConfig { encoder: Trunk { registers: 0, ..c.encoder.clone() }, aa_time: true, ..c.clone() },
        bare,
    ] {
        let mut source = Mock::of(&want);
        source.config = None;
        assert_eq!(plan(&source, &f32s()).unwrap().config, want);
    }
    // Hostile shapes end in an error, not in an overflow.
    for (name, shape) in [
        ("encoder.patch_embed.proj.weight", &[64, 3, usize::MAX, 4][..]),
        ("encoder.patch_embed.proj.weight", &[0, 3, 1 << 31, 1 << 31]),
        ("decoder.0.norm1.weight", &[u32::MAX as usize]),
        ("decoder.0.attn.q_norm.weight", &[0]),
        ("encoder.pos_embed", &[]),
    ] {
        let mut source = Mock::of(&c);
        source.config = None;
        let i = source.at(name);
        source.tensors[i].shape = shape.to_vec();
        assert_eq!(plan(&source, &f32s()).unwrap_err().status() as i32, 4, "{name} {shape:?}");
    }
}

#[test]
fn parts_that_may_be_missing_start_neutral() {
    let source = Mock::of(&small()).without("gs_head.").without("causal.").without("motion_head.");
    source.refused(&f32s(), 4, "missing");
    let allow_missing = ["gs_", "causal.", "motion_"].map(String::from).to_vec();
    let options = Options { allow_missing, ..f32s() };
    let report = plan(&source, &options).unwrap();
    let fresh = report.tensors.iter().filter(|t| t.origin == Origin::Initialised).count();
    assert_eq!(fresh, report.tensors.len() - source.tensors.len());
    let blob = source.blob(&options);
    assert_same(&blob, &source);
    let mut values = Vec::new();
    for name in ["gs_head", "motion_head"] {
        blob.read_f32(blob.find(&format!("{name}.scratch.output_conv2.2.weight")).unwrap(), &mut values);
        assert!(values.iter().all(|&v| v == 0.0));
    }
}

#[test]
fn what_is_no_part_of_the_network_is_ignored_and_reported() {
    let mut source = Mock::of(&small());
    source.push("encoder.mask_token", &[1, 64], vec![0.0; 64]);
    source.push("optimizer.state.0.exp_avg", &[2], vec![f32::NAN; 2]);
    source.push("image_mean", &[1, 3, 1, 1], vec![0.485, 0.456, 0.406]);
    source.push("image_std", &[1, 3, 1, 1], vec![0.229, 0.224, 0.225]);
    let report = plan(&source, &f32s()).unwrap();
    assert_eq!(report.ignored, ["encoder.mask_token", "optimizer.state.0.exp_avg"]);
    assert_same(&source.blob(&f32s()), &Mock::of(&small()));
    let i = source.at("image_std");
    source.values[i][1] = 0.5;
    source.refused(&f32s(), 4, "image_std is [0.229, 0.5, 0.225], the configuration says [0.229, 0.224, 0.225]");
}

#[test]
fn vggt_trunks_are_mapped() {
    let config = small();
    let want = Mock::of(&config);
    // One pair more than the configuration has, VGGT's tokens, and its camera head of another kind.
    let mut source = want.clone().without("register_token").without("camera_").without("point_").without("gs_");
    source = source.without("causal.").without("motion_");
    source.config = None;
    let mut source = source.renamed(|n| match n.strip_prefix("decoder.").and_then(|r| r.split_once('.')) {
        Some((i, block)) => {
            let i: u32 = i.parse().unwrap();
            format!("aggregator.{}_blocks.{}.{block}", ["frame", "global"][(i % 2) as usize], i / 2)
        }
        None => n.replace("encoder.", "aggregator.patch_embed."),
    });
    source.push("aggregator.camera_token", &[1, 2, 1, 64], vec![0.0; 128]);
    source.push("aggregator.register_token", &[1, 2, 4, 64], vec![0.0; 512]);
    source.push("aggregator.patch_embed.mask_token", &[1, 64], vec![0.0; 64]);
    source.push("aggregator.frame_blocks.4.ls1.gamma", &[64], vec![0.0; 64]);
    source.push("camera_head.trunk.0.norm1.weight", &[128], vec![1.0; 128]);
    let allow_missing = ["register_token", "camera_", "point_", "gs_", "causal.", "motion_"].map(String::from).to_vec();
    let options = Options { config: Some(config.clone()), allow_missing, ..f32s() };
    let report = plan(&source, &options).unwrap();
    assert_eq!(report.ignored.len(), 5, "{:?}", report.ignored);
    assert!(report.licence.unwrap().contains("VGGT"));
    let trunk = want.without("register_token").without("camera_").without("point_").without("gs_");
    assert_same(&source.blob(&options), &trunk.without("causal.").without("motion_"));
}

#[test]
fn public_pi3_is_recognised() {
    /// Names and shapes of public Pi3, without its 4 GB of values.
    struct Bare(Vec<CheckpointTensor>);
    impl Checkpoint for Bare {
        fn tensors(&self) -> &[CheckpointTensor] {
            &self.0
        }
        fn read_f32(&self, _: usize, _: &mut Vec<f32>) -> Result<()> {
            panic!("a plan reads no weights")
        }
        fn metadata(&self, _: &str) -> Option<&str> {
            None
        }
        fn describe(&self) -> String {
            "bare".into()
        }
        fn digest(&self) -> Result<Digest> {
            panic!("a plan hashes nothing")
        }
    }
    let pi3 = Bare(Seeded::new(&ModelConfig::pi3(), 0, Outputs::Random).unwrap().tensors().to_vec());
    let report = plan(&pi3, &Options::to(Dtype::F16)).unwrap();
    assert_eq!(report.config, ModelConfig::pi3());
    assert_eq!(report.parameters(), 958_696_732);
    assert!(report.licence.as_ref().unwrap().contains("CC BY-NC 4.0"));
    assert!(report.lines().iter().any(|l| l.starts_with("licence: ")));
    // The same with the parts of the whole network allowed to be missing.
    let allow_missing = ["gs_", "causal.", "motion_"].map(String::from).to_vec();
    let options = Options { config: Some(ModelConfig::full()), allow_missing, ..f32s() };
    assert_eq!(plan(&pi3, &options).unwrap().parameters(), 1_085_252_555);
}

#[test]
fn a_seeded_network_is_the_same_everywhere() {
    let dir = tempfile::tempdir().unwrap();
    let path = dir.path().join("m.safetensors");
    let seeded = Seeded::new(&small(), 42, Outputs::Random).unwrap();
    let length = write_safetensors(&seeded, &path, Overwrite::No).unwrap();
    let bytes = std::fs::read(&path).unwrap();
    assert_eq!(bytes.len() as u64, length);
    let source = checkpoint::open(&[path]).unwrap();
    assert_eq!(source.tensors(), seeded.tensors());
    assert_eq!(source.metadata("format"), Some("pt"));
    let (mut a, mut b) = (Vec::new(), Vec::new());
    for (i, spec) in seeded.specs().iter().enumerate() {
        seeded.read_f32(i, &mut a).unwrap();
        source.read_f32(i, &mut b).unwrap();
        assert_eq!(a, b, "{}", spec.name);
        assert!(a.iter().all(|v| v.is_finite()));
    }
    // The file and the blob made from it, and the blob made directly, hold the same weights.
    let direct = convert_to_bytes(&seeded, &f32s()).unwrap();
    let through = convert_to_bytes(source.as_ref(), &f32s()).unwrap();
    let (direct, through) = (Blob::from_bytes(&direct).unwrap(), Blob::from_bytes(&through).unwrap());
    let digests = |b: &Blob| b.tensors().iter().map(|t| t.digest).collect::<Vec<_>>();
    assert_eq!(digests(&direct), digests(&through));
    // Of all weights, on every platform.
    let all: Vec<u8> = digests(&direct).concat();
    assert_eq!(
        sf_formats::digest::hex(&sha256(&all)),
        "41bd5888ea5b596d4333d00b287f914ea5817f8a1c411d7a8236c658262a9985"
    );
    let another = convert_to_bytes(&Seeded::new(&small(), 43, Outputs::Random).unwrap(), &f32s()).unwrap();
    assert_ne!(digests(&Blob::from_bytes(&another).unwrap()), digests(&direct));
}

#[test]
fn seeded_values_have_the_stated_scales() {
    let config = small();
    let seeded = Seeded::new(&config, 0, Outputs::Random).unwrap();
    let values = |name: &str| {
        let mut v = Vec::new();
        seeded.read_f32(seeded.find(name).unwrap_or_else(|| panic!("no {name}")), &mut v).unwrap();
        v
    };
    let deviation = |v: &[f32]| (v.iter().map(|x| x * x).sum::<f32>() / v.len() as f32).sqrt();
    // 64 inputs: 1/8; within 5 %, as a few thousand samples allow.
    let near = |v: f32, want: f32| assert!((v / want - 1.0).abs() < 0.05, "{v} {want}");
    near(deviation(&values("decoder.3.attn.qkv.weight")), 0.125);
    near(deviation(&values("encoder.patch_embed.proj.weight")), 1.0 / 48f32.sqrt());
    near(deviation(&values("point_head.proj.weight")[2 * 16 * 64..]), 0.5 / 8.0);
    near(deviation(&values("point_head.proj.weight")[..2 * 16 * 64]), 0.005 / 8.0);
    assert!(values("encoder.blocks.0.ls1.gamma").iter().all(|&v| v == 1.0));
    assert!(values("decoder.0.ls2.gamma").iter().all(|&v| v == 0.1));
    assert_eq!(values("camera_head.fc_rot.bias"), [1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0]);
    let bias = values("point_head.proj.bias");
    assert_eq!(bias[32..], [1.609_438; 16]);
    // The ramp over x of a 4-pixel patch, focal length 14 patches.
    assert_eq!(bias[..4], [-1.5 / 56.0, -0.5 / 56.0, 0.5 / 56.0, 1.5 / 56.0]);
    assert_eq!(bias[16..20], [-1.5 / 56.0; 4]);
}
