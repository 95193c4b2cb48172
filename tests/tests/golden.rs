//! The engine against the PyTorch model's golden tensors, stage by stage.
//!
//! Distance of a stage: largest absolute difference over the largest absolute value of the golden stage;
//! quaternions up to sign. Three links of a chain are tested on every golden network:
//!
//! 1. the plain reference path against PyTorch,
//! 2. the fast path with f32 weights against the reference path,
//! 3. the fast path with f16 weights against the reference path.

use sf_formats::ModelConfig;
use sf_formats::blob::{Blob, Dtype};
use sf_formats::blob_writer::{BlobWriter, fits_f16};
use sf_formats::meta::Meta;
use sf_ops::cpu::{Isa, Kernels};
use sf_quant::seeded::{Outputs, Seeded};
use std::collections::BTreeMap;
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::sync::atomic::Ordering;
use streetforward::reference::{self, Stage, Stages};
use streetforward::{ClipShape, Input, Model, Options, Session};

/// Reference (f64 sums, f32 values) against PyTorch in f64: rounding of values between layers; 2.1e-6 measured.
const REFERENCE: f64 = 2e-5;
/// Fast f32 kernels against the reference: f32 sums besides; 9e-7 measured.
const FAST: f64 = 1e-5;
/// f16 weights: 2^-11 relative error per weight, grown by a dozen layers of random networks; 2.4e-3 measured.
const HALF: f64 = 1e-2;

/// One golden file.
struct Golden {
    name: String,
    config: ModelConfig,
    weights: BTreeMap<String, Vec<f32>>,
    shape: ClipShape,
    images: Vec<u8>,
    times: Vec<f64>,
    stages: BTreeMap<String, Stage>,
}

impl Golden {
    fn load(path: &Path) -> Golden {
        let bytes = std::fs::read(path).unwrap();
        let head = 8 + u64::from_le_bytes(bytes[..8].try_into().unwrap()) as usize;
        let json: serde_json::Value = serde_json::from_slice(&bytes[8..head]).unwrap();
        let name = path.file_stem().unwrap().to_string_lossy().into_owned();
        let config = json["__metadata__"]["streetforward.config"].as_str().unwrap();
        let mut golden = Golden {
            config: ModelConfig::from_json(config, &name).unwrap(),
            name,
            weights: BTreeMap::new(),
            shape: ClipShape { frames: 0, height: 0, width: 0 },
            images: Vec::new(),
            times: Vec::new(),
            stages: BTreeMap::new(),
        };
        for (key, entry) in json.as_object().unwrap().iter().filter(|(key, _)| *key != "__metadata__") {
            let number = |v: &serde_json::Value| v.as_u64().unwrap() as usize;
            let data = &bytes[head + number(&entry["data_offsets"][0])..head + number(&entry["data_offsets"][1])];
            let shape: Vec<usize> = entry["shape"].as_array().unwrap().iter().map(number).collect();
            let f32s = || data.chunks_exact(4).map(|b| f32::from_le_bytes(b.try_into().unwrap())).collect::<Vec<_>>();
            match (key.as_str(), entry["dtype"].as_str().unwrap()) {
                ("in.images", "U8") => {
                    golden.shape = ClipShape { frames: shape[0], height: shape[1], width: shape[2] };
                    golden.images = data.to_vec();
                }
                ("in.times", "F64") => {
                    golden.times = data.chunks_exact(8).map(|b| f64::from_le_bytes(b.try_into().unwrap())).collect();
                }
                (key, "F32") => match key.strip_prefix("w.") {
                    Some(weight) => drop(golden.weights.insert(weight.into(), f32s())),
                    None => drop(golden.stages.insert(key.into(), Stage { shape, data: f32s() })),
                },
                other => panic!("{other:?} in {}", golden.name),
            }
        }
        golden
    }

    fn all() -> Vec<Golden> {
        let folder = Path::new(env!("CARGO_MANIFEST_DIR")).join("data/golden");
        let mut paths: Vec<PathBuf> = std::fs::read_dir(folder).unwrap().map(|e| e.unwrap().path()).collect();
        paths.retain(|p| p.extension().is_some_and(|e| e == "safetensors"));
        paths.sort();
        assert!(paths.len() >= 12, "{} golden files", paths.len());
        paths.iter().map(|p| Golden::load(p)).collect()
    }

    fn input(&self) -> Input<'_> {
        Input { shape: self.shape, images: &self.images, times: &self.times, k: None }
    }

    fn reference(&self) -> Stages {
        let weights = reference::Weights::from_map(self.weights.clone(), &self.config).unwrap();
        reference::run(&weights, &self.config, &self.input()).unwrap()
    }

    fn model(&self, dtype: Dtype) -> Arc<Model> {
        let mut writer = BlobWriter::in_memory(&self.config, &Meta::default()).unwrap();
        for spec in writer.specs().to_vec() {
            let values = &self.weights[&spec.name];
            let dtype = if fits_f16(values) { dtype } else { Dtype::F32 };
            writer.write(values, dtype).unwrap();
        }
        let blob = Blob::from_bytes(&writer.finish_bytes().unwrap()).unwrap();
        Arc::new(Model::from_blob(blob).unwrap())
    }
}

/// Every stage of a fast run, frames joined.
fn fast(model: &Arc<Model>, input: &Input, threads: usize) -> BTreeMap<String, Stage> {
    fast_with(model, input, Options { threads, ..Options::default() })
}

fn fast_with(model: &Arc<Model>, input: &Input, options: Options) -> BTreeMap<String, Stage> {
    let mut session = Session::new(Arc::clone(model), input.shape, options).unwrap();
    let mut stages: BTreeMap<String, Stage> = BTreeMap::new();
    let mut tap = |tap: &streetforward::Tap| {
        let stage = stages.entry(tap.name.to_string()).or_insert_with(|| {
            let frames = tap.frame.map(|_| 0);
            Stage { shape: frames.into_iter().chain(tap.shape.iter().copied()).collect(), data: Vec::new() }
        });
        if let Some(frame) = tap.frame {
            assert_eq!(stage.shape[0], frame, "frames of {} come in order", tap.name);
            stage.shape[0] += 1;
        }
        stage.data.extend_from_slice(tap.data);
    };
    session.run_watched(input, None, Some(&mut tap)).unwrap();
    assert_eq!(session.layers_done().load(Ordering::Relaxed), session.plan().layers(), "progress reaches its end");
    stages
}

/// Largest difference over the largest value of `b`.
fn distance(name: &str, a: &Stage, b: &Stage) -> f64 {
    assert_eq!(a.shape, b.shape, "shape of {name}");
    let top = b.data.iter().fold(0.0f32, |m, v| m.max(v.abs())).max(1e-12);
    let far = |a: &[f32], b: &[f32], sign: f32| a.iter().zip(b).fold(0.0f32, |m, (a, b)| m.max((sign * a - b).abs()));
    let worst = if name == "out.quat" {
        let pairs = a.data.chunks_exact(4).zip(b.data.chunks_exact(4));
        pairs.map(|(a, b)| far(a, b, 1.0).min(far(a, b, -1.0))).fold(0.0, f32::max)
    } else {
        far(&a.data, &b.data, 1.0)
    };
    assert!(a.data.iter().all(|v| v.is_finite()), "{name} is not finite");
    f64::from(worst) / f64::from(top)
}

/// The stages of `b` that `a` has, against it; panics with every stage that is too far.
fn compare(title: &str, a: &BTreeMap<String, Stage>, b: &BTreeMap<String, Stage>, limit: f64) -> usize {
    let mut worst = (0.0, "");
    let (mut bad, mut count) = (Vec::new(), 0);
    for (name, stage) in b {
        let Some(mine) = a.get(name) else { continue };
        count += 1;
        let d = distance(name, mine, stage);
        if d > worst.0 {
            worst = (d, name);
        }
        if d > limit {
            bad.push(format!("{name}: {d:.2e}"));
        }
    }
    println!("{title}: {count} stages, worst {} {:.2e}", worst.1, worst.0);
    assert!(bad.is_empty(), "{title}, limit {limit:.0e}: {bad:?}");
    count
}

#[test]
fn the_reference_path_is_the_pytorch_model() {
    for golden in Golden::all() {
        let stages = golden.reference();
        for name in golden.stages.keys() {
            assert!(stages.0.contains_key(name), "{}: stage {name} is not computed", golden.name);
        }
        compare(&golden.name, &stages.0, &golden.stages, REFERENCE);
    }
}

#[test]
fn the_fast_path_is_the_reference_path() {
    for golden in Golden::all() {
        let reference = golden.reference();
        let stages = fast(&golden.model(Dtype::F32), &golden.input(), 2);
        for name in golden.stages.keys().filter(|n| *n != "time") {
            assert!(stages.contains_key(name), "{}: stage {name} is not shown", golden.name);
        }
        compare(&golden.name, &stages, &reference.0, FAST);
    }
}

#[test]
fn thread_counts_change_no_bit() {
    for golden in Golden::all() {
        for dtype in [Dtype::F32, Dtype::F16] {
            let model = golden.model(dtype);
            let one = fast(&model, &golden.input(), 1);
            for threads in [2, 3] {
                let more = fast(&model, &golden.input(), threads);
                same_bits(&format!("{}, {threads} threads", golden.name), &one, &more);
            }
        }
    }
}

fn same_bits(title: &str, a: &BTreeMap<String, Stage>, b: &BTreeMap<String, Stage>) {
    assert_eq!(a.keys().collect::<Vec<_>>(), b.keys().collect::<Vec<_>>(), "{title}");
    for (name, stage) in a {
        let bits = |s: &Stage| s.data.iter().map(|v| v.to_bits()).collect::<Vec<_>>();
        assert!(bits(stage) == bits(&b[name]), "{title}: {name}");
    }
}

#[test]
fn instruction_sets_change_no_bit() {
    let isas: Vec<Isa> = Kernels::available().map(|k| k.isa).collect();
    println!("compared: {isas:?}");
    assert!(isas.contains(&Isa::Scalar));
    for golden in Golden::all() {
        let model = golden.model(Dtype::F16);
        let run =
            |isa| fast_with(&model, &golden.input(), Options { threads: 2, isa: Some(isa), ..Options::default() });
        let scalar = run(Isa::Scalar);
        for &isa in isas.iter().filter(|&&isa| isa != Isa::Scalar) {
            same_bits(&format!("{}, {isa:?}", golden.name), &scalar, &run(isa));
        }
    }
}

/// The converter's own output, read back by both paths.
#[test]
fn a_converted_checkpoint_gives_what_the_checkpoint_says() {
    let config = sf_tests::tiny::tiny();
    let seeded = Seeded::new(&config, 3, Outputs::Random).unwrap();
    let clip = sf_tests::tiny::Frames::new(3, 28, 42, 3);
    let weights = reference::Weights::load(&seeded, &config).unwrap();
    let reference = reference::run(&weights, &config, &clip.input()).unwrap();
    for (dtype, limit) in [(Dtype::F32, FAST), (Dtype::F16, HALF)] {
        let bytes = sf_quant::convert::convert_to_bytes(&seeded, &sf_quant::convert::Options::to(dtype)).unwrap();
        let model = Arc::new(Model::from_blob(Blob::from_bytes(&bytes).unwrap()).unwrap());
        assert_eq!(*model.config(), config);
        let count = compare(dtype.name(), &fast(&model, &clip.input(), 2), &reference.0, limit);
        assert!(count > 30, "{count} stages");
    }
}

#[test]
fn half_weights_stay_close() {
    for golden in Golden::all() {
        let reference = golden.reference();
        let stages = fast(&golden.model(Dtype::F16), &golden.input(), 2);
        compare(&golden.name, &stages, &reference.0, HALF);
    }
}
