//! `convert`: training checkpoints to a weight blob.

use crate::args::{EngineArgs, FileArgs, Precision, path_json};
use crate::golden::{self, How};
use crate::network::{self, Preset, Watched};
use crate::output::{Console, human_bytes, human_count};
use crate::scan::{self, Judge};
use crate::signals;
use crate::versus::{self, Verdict};
use serde_json::{Value, json};
use sf_eval::Gate;
use sf_formats::atomic::AtomicFile;
use sf_formats::blob::{Blob, LoadMode, Verify};
use sf_formats::checkpoint::{self, Checkpoint, CheckpointTensor};
use sf_formats::clip::{Clip, ClipOptions};
use sf_formats::config::Value as Setting;
use sf_formats::digest::hex;
use sf_formats::error::{escape, escape_path};
use sf_formats::meta::keys;
use sf_formats::{Dtype, Error, Result};
use sf_quant::convert::{SCAN_REASON, refuse_own_input};
use sf_quant::{Options, Report, convert_checked, plan};
use std::path::{Path, PathBuf};
use std::sync::Arc;
use streetforward::Model;

/// What to convert to what.
#[derive(clap::Args)]
pub(crate) struct Args {
    /// Checkpoint: .safetensors, .pt, .pth, .bin, a folder or index of shards, or the shards
    #[arg(value_name = "CKPT", required = true)]
    inputs: Vec<PathBuf>,
    #[command(flatten)]
    file: FileArgs,
    /// Precision of the weight matrices; sensitive ones stay f32 or f16
    #[arg(long, value_enum, default_value_t = Precision::F32)]
    to: Precision,
    /// Exceptions by the start of a tensor's name, * and ? as wildcards, as gs_head.=f32,decoder.*.mlp.fc2=f16
    #[arg(long, value_name = "PATTERN=PRECISION", value_delimiter = ',', value_parser = keep)]
    keep: Vec<(String, Dtype)>,
    /// JSON file of settings for a checkpoint that carries none
    #[arg(long, value_name = "FILE")]
    config: Option<PathBuf>,
    /// Settings of a preset for a checkpoint that carries none
    #[arg(long, value_enum, conflicts_with = "config")]
    preset: Option<Preset>,
    /// JSON object of renamed tensors: {"old name or prefix.": "new name or prefix."}
    #[arg(long, value_name = "FILE")]
    map: Option<PathBuf>,
    /// Tensors that may be missing, by the start of their name; they start neutral
    #[arg(long, value_name = "PREFIX", value_delimiter = ',')]
    allow_missing: Vec<String>,
    /// Text file with the licence of the weights, for the blob
    #[arg(long, value_name = "FILE")]
    licence: Option<PathBuf>,
    /// Clips whose inputs to the layers the rounding of int8 weights is made for; others than those of --check
    #[arg(long, value_name = "CLIP", num_args = 1..)]
    calib: Vec<PathBuf>,
    /// Pictures of every clip of --calib and --check to use, from 0, as 0,5,10,15; default: all
    #[arg(long, value_name = "LIST", value_delimiter = ',')]
    frames: Option<Vec<usize>>,
    /// Clips on which the result must keep up with the f32 model: no blob (exit code 1) when it does not. An int8
    /// model that does not is scanned, and its most sensitive layers become f16, up to 5 % of the multiply-adds
    #[arg(long, value_name = "CLIP", num_args = 1..)]
    check: Vec<PathBuf>,
    /// Bounds of --check, as those of compare
    #[arg(long, value_name = "KEY=LIMIT", value_delimiter = ',', value_parser = versus::parse_gate, default_value = "int8")]
    gate: Vec<Vec<Gate>>,
    /// Write the blob although --check failed; what was measured is stored in it
    #[arg(long, requires = "check")]
    allow_inaccurate: bool,
    #[command(flatten)]
    engine: EngineArgs,
    /// Report what would be done; write nothing
    #[arg(long)]
    dry_run: bool,
}

fn keep(text: &str) -> Result<(String, Dtype), String> {
    sf_quant::parse_keep(text).map_err(|e| e.to_string())
}

/// Longest name map and licence text that are read.
const TEXT_CAP: u64 = 4 << 20;

/// Converts and reports.
pub(crate) fn run(args: &Args, console: &Console) -> Result<()> {
    let output = &args.file.output;
    refuse_own_input(&args.inputs, output)?;
    let config = match (&args.config, args.preset) {
        (Some(file), _) => Some(network::read_config(file)?),
        (None, Some(preset)) => Some(network::preset(preset)),
        (None, None) => None,
    };
    let mut options = Options {
        golden: true,
        keep: args.keep.clone(),
        config,
        allow_missing: args.allow_missing.clone(),
        licence: args.licence.as_deref().map(|f| network::read_text(f, TEXT_CAP)).transpose()?,
        command: format!("convert --to {}", args.to.dtype().name()),
        ..Options::to(args.to.dtype())
    };
    let mut source = checkpoint::open(&args.inputs)?;
    if let Some(file) = &args.map {
        source = Box::new(Renamed::new(source, file)?);
    }
    if args.dry_run {
        let report = plan(&*source, &options)?;
        return console.report(&to_json(args, &report, None), &to_text(args, &report, None));
    }
    // An output that cannot be written is better known before clips are run.
    drop(AtomicFile::create(output, args.file.overwrite())?);
    signals::guard_file(output);
    let gates = args.gate.concat();
    let clip_options = ClipOptions { frames: args.frames.clone(), ..ClipOptions::default() };
    let open =
        |paths: &[PathBuf]| -> Result<Vec<Clip>> { paths.iter().map(|p| Clip::open(p, &clip_options)).collect() };
    if !args.calib.is_empty() {
        if args.to != Precision::Int8 {
            return Err(Error::usage("--calib is for --to int8"));
        }
        let calibration = scan::calibrate(&*source, &options, &open(&args.calib)?, &args.engine)?;
        options.calibration = Some(Arc::new(calibration));
    }
    let mut judge = None;
    if !args.check.is_empty() {
        let clips = open(&args.check)?;
        let mut j = Judge::new(&*source, &options, &clips, &args.engine)?;
        if args.to == Precision::Int8 {
            options.promoted = match j.scan(&options, &gates, console) {
                Err(Error::CheckFailed(why)) if args.allow_inaccurate => {
                    console.warn(why);
                    Vec::new()
                }
                found => found?,
            };
        }
        options.checks = gates.iter().map(|g| g.key.clone()).collect();
        judge = Some(j);
    }
    let mut verdict = None;
    let progress = console.progress(source.tensors().len() as u64, "convert");
    let watched = Watched::new(&*source, &progress);
    let report = convert_checked(&watched, output, args.file.overwrite(), &options, |path, _| {
        let model = Arc::new(Model::from_blob(Blob::open(path, LoadMode::Map, Verify::Structure)?)?);
        let mut found = vec![(keys::GOLDEN.to_string(), Setting::Text(hex(&golden::run(&model, &How::default())?)))];
        if let Some(judge) = &mut judge {
            let v = judge.verdict(&model)?;
            let failures = versus::failures(&gates, &v);
            if !failures.is_empty() && !args.allow_inaccurate {
                return Err(Error::CheckFailed(format!("no blob is written: {}", failures.join("; "))));
            }
            let values = gates.iter().map(|g| v.outputs.iter().find(|(k, _)| *k == g.key).and_then(|(_, v)| *v));
            let values = values.map(|v| v.filter(|v| v.is_finite()).unwrap_or(-1.0)).collect();
            found.push((keys::CHECK_VALUES.to_string(), Setting::Floats(values)));
            verdict = Some(v);
        }
        Ok(found)
    })?;
    drop(progress);
    let checked = verdict.as_ref().map(|v| (&gates[..], v));
    console.report(&to_json(args, &report, checked), &to_text(args, &report, checked))
}

/// Gates and what was measured.
type Checked<'a> = Option<(&'a [Gate], &'a Verdict)>;

fn to_json(args: &Args, report: &Report, checked: Checked) -> Value {
    let tensor = |t: &sf_quant::report::TensorReport| {
        json!({
            "name": t.name,
            "shape": t.shape,
            "dtype": t.dtype.name(),
            "bytes": t.bytes,
            "initialised": t.origin == sf_quant::report::Origin::Initialised,
            "promoted": t.promoted,
            "zero_outputs": t.zero_outputs,
            "weight_sqnr_db": t.sqnr_db,
            "reason": t.reason,
        })
    };
    json!({
        "schema": "streetforward.convert/1",
        "dry_run": args.dry_run,
        "inputs": args.inputs.iter().map(|p| path_json(p)).collect::<Value>(),
        "output": path_json(&args.file.output),
        "source": report.source,
        "config_source": report.config_source,
        "precision": report.precision.name(),
        "parameters": report.parameters(),
        "tensor_bytes": report.tensor_bytes(),
        "stripped": report.stripped.iter().map(|(p, n)| json!({ "prefix": p, "tensors": n })).collect::<Value>(),
        "ignored": report.ignored,
        "notes": report.notes,
        "licence": report.licence,
        "source_digest": report.source_digest.as_ref().map(hex),
        "digest": report.blob_digest.as_ref().map(hex),
        "config": report.config.to_json(),
        "check": checked.map(|(gates, verdict)| versus::to_json(gates, verdict)),
        "promoted_share": scan::share(&report.config, &promoted(report)),
        "tensors": report.tensors.iter().map(tensor).collect::<Value>(),
    })
}

/// Matrices that the scan made f16.
fn promoted(report: &Report) -> Vec<String> {
    let by_scan = |t: &&sf_quant::report::TensorReport| t.reason.as_deref() == Some(SCAN_REASON);
    report.tensors.iter().filter(by_scan).map(|t| t.name.clone()).collect()
}

fn to_text(args: &Args, report: &Report, checked: Checked) -> String {
    let mut text = String::new();
    let promoted = promoted(report);
    if !promoted.is_empty() {
        let share = 100.0 * scan::share(&report.config, &promoted);
        text.push_str(&format!("f16 after the scan, {share:.2} % of the multiply-adds: {}\n", promoted.join(", ")));
    }
    if let Some((gates, verdict)) = checked {
        text.push_str(&versus::to_text(gates, verdict));
    }
    for line in report.lines() {
        text.push_str(&line);
        text.push('\n');
    }
    let parameters = human_count(report.parameters());
    if args.dry_run {
        text.push_str(&format!("dry run: {parameters} parameters would go to {}\n", escape_path(&args.file.output)));
    } else {
        let size = human_bytes(report.tensor_bytes());
        text.push_str(&format!("{parameters} parameters, {size}, in {}\n", escape_path(&args.file.output)));
    }
    text
}

/// A checkpoint under other names.
struct Renamed {
    source: Box<dyn Checkpoint>,
    tensors: Vec<CheckpointTensor>,
}

impl Renamed {
    /// Reads the map; the longest matching key wins, and every key must match something.
    fn new(source: Box<dyn Checkpoint>, file: &Path) -> Result<Renamed> {
        let text = network::read_text(file, TEXT_CAP)?;
        let map: serde_json::Map<String, Value> = serde_json::from_str(&text)
            .map_err(|e| Error::usage(format!("{}: not a JSON object of names: {e}", escape_path(file))))?;
        let mut pairs = Vec::new();
        for (from, to) in &map {
            let to = to.as_str().ok_or_else(|| {
                Error::usage(format!("{}: '{}' is not renamed to a text", escape_path(file), escape(from.as_bytes())))
            })?;
            pairs.push((from.as_str(), to));
        }
        pairs.sort_by_key(|(from, _)| std::cmp::Reverse(from.len()));
        let mut used = vec![false; pairs.len()];
        let mut tensors = source.tensors().to_vec();
        for t in &mut tensors {
            if let Some(i) = pairs.iter().position(|(from, _)| matches(from, &t.name)) {
                used[i] = true;
                t.name = format!("{}{}", pairs[i].1, &t.name[pairs[i].0.len()..]);
            }
        }
        if let Some(i) = used.iter().position(|u| !u) {
            let name = escape(pairs[i].0.as_bytes());
            return Err(Error::usage(format!("{}: no tensor is called or starts with '{name}'", escape_path(file))));
        }
        Ok(Renamed { source, tensors })
    }
}

/// Whether a key of the map stands for a name: the name itself, or a prefix that ends in a dot.
fn matches(key: &str, name: &str) -> bool {
    key == name || (key.ends_with('.') && name.starts_with(key))
}

impl Checkpoint for Renamed {
    fn tensors(&self) -> &[CheckpointTensor] {
        &self.tensors
    }

    fn read_f32(&self, index: usize, out: &mut Vec<f32>) -> Result<()> {
        self.source.read_f32(index, out)
    }

    fn metadata(&self, key: &str) -> Option<&str> {
        self.source.metadata(key)
    }

    fn describe(&self) -> String {
        format!("{}, renamed", self.source.describe())
    }

    fn digest(&self) -> Result<[u8; 32]> {
        self.source.digest()
    }
}
