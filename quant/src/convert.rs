//! Checkpoint to weight blob, one tensor in memory at a time.
//!
//! Matrices become f32, f16 or int8 panels, everything else f32. Which matrix gets which type is decided in
//! `recipe.rs`; a matrix with a value beyond the range of f16 becomes f32 instead, and one whose int8 weights
//! do not reach [`WEIGHT_FLOOR_DB`] becomes f16.

use crate::calibrate::Calibration;
use crate::detect::detect;
use crate::names::{Names, WRAPPERS, nearest, resolve};
use crate::quantize::{self, EXACT_DB, Fold, Quantized, sqnr_db};
use crate::recipe::{self, Folding, Sources};
use crate::report::{Origin, Report, TensorReport, first_five};
use crate::seeded::{CONFIG_KEY, Outputs, Seeded};
use sf_formats::arch::{self, Role, TensorSpec};
use sf_formats::atomic::{AtomicFile, Overwrite};
use sf_formats::blob_writer::{BlobWriter, QuantizedMatrix, fits_f16, through_f16};
use sf_formats::checkpoint::{self, Checkpoint};
use sf_formats::config::{ModelConfig, Value};
use sf_formats::digest::hex;
use sf_formats::error::{escape, escape_path};
use sf_formats::meta::{Meta, keys};
use sf_formats::sniff::FileKind;
use sf_formats::{Dtype, Error, Result};
use std::collections::BTreeSet;
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::sync::mpsc::sync_channel;

/// What to convert to.
#[derive(Clone, Debug)]
pub struct Options {
    /// Type of the matrices.
    pub precision: Dtype,
    /// Exceptions by the start of the name (`*` and `?` as wildcards), first match wins; they concern matrices.
    pub keep: Vec<(String, Dtype)>,
    /// Names of matrices that int8 is too coarse for: stored as f16.
    pub promoted: Vec<String>,
    /// What the layers' inputs look like, for the rounding of int8 weights and their biases.
    pub calibration: Option<Arc<Calibration>>,
    /// Whether the blob gets a place for the digest of a golden run ([`keys::GOLDEN`]), which the caller fills in.
    pub golden: bool,
    /// Names of measurements for which the blob gets places ([`keys::CHECK_VALUES`]), which the caller fills in.
    pub checks: Vec<String>,
    /// Configuration for a checkpoint that carries none.
    pub config: Option<ModelConfig>,
    /// Prefixes of tensors that may be missing; they start neutral.
    pub allow_missing: Vec<String>,
    /// Licence text for the blob; without it the checkpoint's own, or what is known of public weights.
    pub licence: Option<String>,
    /// The command, for the blob's provenance; may be empty.
    pub command: String,
}

impl Options {
    /// Plain conversion to a precision.
    pub fn to(precision: Dtype) -> Options {
        Options {
            precision,
            keep: Vec::new(),
            promoted: Vec::new(),
            calibration: None,
            golden: false,
            checks: Vec::new(),
            config: None,
            allow_missing: Vec::new(),
            licence: None,
            command: String::new(),
        }
    }
}

/// int8 weights below this signal-to-error ratio are stored as f16: some row is dominated by few huge values.
pub const WEIGHT_FLOOR_DB: f64 = 30.0;

/// Reason of a matrix of [`Options::promoted`].
pub const SCAN_REASON: &str = "sensitivity scan";

/// Where no golden run has been made.
pub const NO_DIGEST: &str = "0000000000000000000000000000000000000000000000000000000000000000";

/// What the quantizer does, for the blob's provenance.
const RECIPE: &str = "weights: symmetric int8 per output, least-squares step, rotated by a random-sign block Hadamard; norms \
    and layer scales folded in; activations: symmetric int8 per token, at run time";

/// Reads an exception of the form `PATTERN=f16`, `PATTERN=f32` or `PATTERN=int8`.
pub fn parse_keep(text: &str) -> Result<(String, Dtype)> {
    let parsed = text.rsplit_once('=').and_then(|(prefix, name)| {
        let dtype = Dtype::ALL.into_iter().find(|d| d.name() == name)?;
        (!prefix.is_empty()).then(|| (prefix.to_string(), dtype))
    });
    parsed.ok_or_else(|| {
        Error::usage(format!(
            "'{}' is not of the form PATTERN=f32, PATTERN=f16 or PATTERN=int8",
            escape(text.as_bytes())
        ))
    })
}

/// What a conversion would do; reads names and shapes, no values.
pub fn plan(source: &dyn Checkpoint, options: &Options) -> Result<Report> {
    prepare(source, &source.describe(), options).map(|(report, _)| report)
}

/// [`plan`] for files.
pub fn plan_files(inputs: &[PathBuf], options: &Options) -> Result<Report> {
    prepare(checkpoint::open(inputs)?.as_ref(), &place(inputs), options).map(|(report, _)| report)
}

/// Converts an open checkpoint to a blob.
pub fn convert(source: &dyn Checkpoint, output: &Path, overwrite: Overwrite, options: &Options) -> Result<Report> {
    convert_at(source, &source.describe(), (output, overwrite), options, unchecked)
}

/// Converts files to a blob. The output must not be one of the inputs, nor a checkpoint.
pub fn convert_files(inputs: &[PathBuf], output: &Path, overwrite: Overwrite, options: &Options) -> Result<Report> {
    refuse_own_input(inputs, output)?;
    convert_at(checkpoint::open(inputs)?.as_ref(), &place(inputs), (output, overwrite), options, unchecked)
}

/// Converts an open checkpoint to the bytes of a blob, for networks that fit into memory.
pub fn convert_to_bytes(source: &dyn Checkpoint, options: &Options) -> Result<Vec<u8>> {
    let at = source.describe();
    let (mut report, jobs) = prepare(source, &at, options)?;
    let meta = provenance(source, options, &mut report)?;
    let mut writer = BlobWriter::in_memory(&report.config, &meta)?;
    stream((source, &at), (&jobs, options), &mut writer, &mut report)?;
    writer.finish_bytes()
}

/// [`convert()`] with a look at the whole blob before it becomes visible: `check` gets its temporary path and the
/// report so far, and may return metadata to fill in. When it fails, there is no blob.
pub fn convert_checked(
    source: &dyn Checkpoint,
    output: &Path,
    overwrite: Overwrite,
    options: &Options,
    check: impl FnOnce(&Path, &Report) -> Result<Vec<(String, Value)>>,
) -> Result<Report> {
    convert_at(source, &source.describe(), (output, overwrite), options, check)
}

/// Nothing to look at.
fn unchecked(_: &Path, _: &Report) -> Result<Vec<(String, Value)>> {
    Ok(Vec::new())
}

/// `at`: what messages call the source.
fn convert_at(
    source: &dyn Checkpoint,
    at: &str,
    (output, overwrite): (&Path, Overwrite),
    options: &Options,
    check: impl FnOnce(&Path, &Report) -> Result<Vec<(String, Value)>>,
) -> Result<Report> {
    let (mut report, jobs) = prepare(source, at, options)?;
    // An output that cannot be written is better known before gigabytes are hashed.
    drop(AtomicFile::create(output, overwrite)?);
    let meta = provenance(source, options, &mut report)?;
    let mut writer = BlobWriter::create(output, overwrite, &report.config, &meta)?;
    stream((source, at), (&jobs, options), &mut writer, &mut report)?;
    let digest = writer.finish_checked(|path| check(path, &report))?;
    report.blob_digest = Some(digest);
    Ok(report)
}

/// What messages call a set of files: the first.
fn place(inputs: &[PathBuf]) -> String {
    inputs.first().map_or_else(String::new, |p| escape_path(p))
}

/// Refuses to write over an input (by any name) or over a file that is itself a checkpoint.
pub fn refuse_own_input(inputs: &[PathBuf], output: &Path) -> Result<()> {
    // A path that does not exist cannot be one of the inputs, which do.
    let Ok(target) = output.canonicalize() else { return Ok(()) };
    let same = |input: &PathBuf| input.canonicalize().is_ok_and(|p| p == target) || same_file(input, output);
    if inputs.iter().any(same) {
        return Err(Error::usage(format!("{} is an input: choose another output", escape_path(output))));
    }
    let checkpoint = [FileKind::Safetensors, FileKind::Zip, FileKind::Pickle, FileKind::Tar];
    if target.is_file() && FileKind::of_file(&target).is_ok_and(|k| checkpoint.contains(&k)) {
        return Err(Error::usage(format!(
            "{} is a checkpoint, perhaps a shard of the input: choose another output or remove it",
            escape_path(output)
        )));
    }
    Ok(())
}

/// Whether two paths are one file (hard links).
fn same_file(a: &Path, b: &Path) -> bool {
    use std::os::unix::fs::MetadataExt;
    match (std::fs::metadata(a), std::fs::metadata(b)) {
        (Ok(a), Ok(b)) => a.dev() == b.dev() && a.ino() == b.ino(),
        _ => false,
    }
}

/// One tensor to write.
struct Job {
    spec: TensorSpec,
    /// Index in the checkpoint, or in the neutral network.
    from: (Origin, usize),
    dtype: Dtype,
    fate: Fate,
}

/// What happens to a tensor's values.
enum Fate {
    /// Stored as they are.
    Plain,
    /// Folded into others: stored as ones or zeros.
    Neutral(f32),
    /// A norm's offset, folded into the matrices that read the norm. Where its gain and offset come from, and which matrix's inputs
    /// give the mean that it takes off instead.
    Centring(Vec<Folded>, usize),
    /// A matrix that takes vectors in; where those come from, and which matrix's inputs give the mean that the norm takes off.
    Folded(Vec<Folded>, Option<usize>),
    /// The bias of the matrix before, folded with it.
    FoldedBias,
}

/// A vector of a [`Fold`], and where it comes from.
type Folded = (Part, (Origin, usize));

/// Which vector of a [`Fold`].
#[derive(Clone, Copy)]
enum Part {
    Gain,
    Offset,
    Gamma,
}

/// Names, configuration, the exact set of tensors, types: everything but values.
fn prepare(source: &dyn Checkpoint, at: &str, options: &Options) -> Result<(Report, Vec<Job>)> {
    let names = resolve(source.tensors(), at)?;
    let (config, config_source) = configuration(source, options, &names, at)?;
    let specs = arch::tensors(&config);
    let (mut notes, mut ignored) = (Vec::new(), names.ignored.clone());
    let licence = options
        .licence
        .clone()
        .or_else(|| ["licence", "license"].iter().find_map(|k| source.metadata(k)).map(str::to_string))
        .or_else(|| known_licence(&names, &specs));
    check_image(source, &names, &config, at)?;
    let surplus = if names.vggt { surplus_pairs(&names, &config) } else { BTreeSet::new() };
    if names.vggt {
        notes.push(format!(
            "VGGT names mapped: patch_embed to encoder, frame block j to decoder.{{2j}}, global block j to \
             decoder.{{2j+1}}, {} tensors of later pairs left out",
            surplus.len()
        ));
        ignored.extend(surplus.iter().cloned());
    }
    let from = check_set((source, at), (&names, &surplus), &specs, options)?;

    let mut used = vec![false; options.keep.len()];
    let mut choices = Vec::new();
    for spec in &specs {
        let kept = options.keep.iter().position(|(pattern, _)| recipe::names(pattern, &spec.name));
        if let Some(k) = kept {
            used[k] = true;
        }
        choices.push(recipe::choose(
            &config,
            spec,
            options.precision,
            (kept.map(|k| &options.keep[k]), options.promoted.contains(&spec.name)),
        ));
    }
    let folding = recipe::fold(&specs, &choices);
    let (mut jobs, mut tensors) = (Vec::new(), Vec::new());
    for (i, spec) in specs.into_iter().enumerate() {
        tensors.push(TensorReport {
            name: spec.name.clone(),
            shape: spec.shape.clone(),
            origin: from[i].0,
            dtype: choices[i].dtype,
            bytes: 0,
            promoted: false,
            zero_outputs: 0,
            sqnr_db: None,
            reason: choices[i].reason.clone(),
        });
        jobs.push(Job { spec, from: from[i], dtype: choices[i].dtype, fate: fate(&folding, &from, i) });
    }
    if let Some(k) = used.iter().position(|u| !u) {
        let (prefix, dtype) = &options.keep[k];
        return Err(Error::usage(format!(
            "no tensor is left for '{}={}' to keep: its prefix matches none, or an earlier one takes them all",
            escape(prefix.as_bytes()),
            dtype.name()
        )));
    }
    let report = Report {
        config,
        config_source,
        source: source.describe(),
        precision: options.precision,
        tensors,
        stripped: names.stripped.into_iter().collect(),
        ignored,
        notes,
        licence,
        source_digest: None,
        blob_digest: None,
    };
    Ok((report, jobs))
}

/// What the folding does to tensor `i`.
fn fate(folding: &Folding, from: &[(Origin, usize)], i: usize) -> Fate {
    let parts = |Sources { gain, offset, gamma, .. }: &Sources| {
        let parts = [(Part::Gain, gain), (Part::Offset, offset), (Part::Gamma, gamma)];
        parts.into_iter().filter_map(|(part, at)| at.map(|at| (part, from[at]))).collect()
    };
    if let Some(&first) = folding.offset_of.get(&i) {
        return Fate::Centring(parts(&Sources { gamma: None, ..folding.into[&first].clone() }), first);
    }
    if let Some(&value) = folding.neutral.get(&i) {
        return Fate::Neutral(value);
    }
    if folding.bias_of.contains_key(&i) {
        return Fate::FoldedBias;
    }
    match folding.into.get(&i) {
        Some(sources) => Fate::Folded(parts(sources), sources.first),
        None => Fate::Plain,
    }
}

/// The checkpoint's own configuration, else the caller's, else what names and shapes say.
fn configuration(
    source: &dyn Checkpoint,
    options: &Options,
    names: &Names,
    at: &str,
) -> Result<(ModelConfig, &'static str)> {
    let own = source.metadata(CONFIG_KEY).map(|text| ModelConfig::from_json(text, at)).transpose()?;
    match (own, &options.config) {
        (Some(own), Some(given)) if own != *given => {
            let differs = own.to_pairs().into_iter().zip(given.to_pairs()).find(|(a, b)| a != b);
            let key = differs.map_or_else(String::new, |(a, _)| a.0);
            Err(Error::usage(format!("the configuration given differs from the checkpoint's own in {key}: give none")))
        }
        (Some(own), _) => Ok((own, "from the checkpoint")),
        (None, Some(given)) => {
            given.check(at)?;
            Ok((given.clone(), "given"))
        }
        (None, None) => {
            Ok((detect(source.tensors(), names, at)?, "read from names and shapes; conventions are defaults"))
        }
    }
}

/// The stored normalisation must be the configuration's.
fn check_image(source: &dyn Checkpoint, names: &Names, config: &ModelConfig, at: &str) -> Result<()> {
    let mut stored = Vec::new();
    for (name, index, want) in
        [("image_mean", names.image[0], config.image_mean), ("image_std", names.image[1], config.image_std)]
    {
        let Some(index) = index else { continue };
        if source.tensors()[index].count() == 3 {
            source.read_f32(index, &mut stored)?;
        } else {
            stored.clear();
        }
        // Stored as f32: equal to 1e-6 means the same number.
        let same = stored.len() == 3 && stored.iter().zip(want).all(|(&s, w)| (f64::from(s) - w).abs() <= 1e-6);
        if !same {
            return Err(Error::model(at, format!("{name} is {stored:?}, the configuration says {want:?}")));
        }
    }
    Ok(())
}

/// Names of VGGT's attention pairs beyond the depth of the configuration.
fn surplus_pairs(names: &Names, config: &ModelConfig) -> BTreeSet<String> {
    let beyond = |name: &&String| {
        let layer = name.strip_prefix("decoder.").and_then(|r| r.split('.').next()).and_then(|i| i.parse::<u32>().ok());
        layer.is_some_and(|i| i >= config.aa.depth)
    };
    names.index.keys().filter(beyond).cloned().collect()
}

/// Nothing missing, nothing unexpected, every shape equal; returns where each tensor comes from.
fn check_set(
    (source, at): (&dyn Checkpoint, &str),
    (names, surplus): (&Names, &BTreeSet<String>),
    specs: &[TensorSpec],
    options: &Options,
) -> Result<Vec<(Origin, usize)>> {
    let (mut missing, mut shapes, mut from) = (Vec::new(), Vec::new(), Vec::new());
    let mut unexpected: BTreeSet<&str> =
        names.index.keys().map(String::as_str).filter(|n| !surplus.contains(*n)).collect();
    for (i, spec) in specs.iter().enumerate() {
        unexpected.remove(spec.name.as_str());
        match names.index.get(&spec.name) {
            Some(&index) => {
                let found = &source.tensors()[index].shape;
                if *found != spec.shape {
                    shapes.push(format!("{} is {found:?}, must be {:?}", spec.name, spec.shape));
                }
                from.push((Origin::Checkpoint, index));
            }
            None => {
                if !options.allow_missing.iter().any(|p| spec.name.starts_with(p.as_str())) {
                    missing.push(spec.name.clone());
                }
                from.push((Origin::Initialised, i));
            }
        }
    }
    let mut faults = Vec::new();
    if !missing.is_empty() {
        faults.push(format!("{} missing: {}", missing.len(), first_five(&missing)));
    }
    if !unexpected.is_empty() {
        let list: Vec<String> = unexpected.iter().map(|n| escape(n.as_bytes())).collect();
        faults.push(format!("{} unexpected: {}", list.len(), first_five(&list)));
    }
    if !shapes.is_empty() {
        faults.push(format!("{} of another shape: {}", shapes.len(), first_five(&shapes)));
    }
    if faults.is_empty() {
        return Ok(from);
    }
    let hint = hint(&missing, &unexpected).map_or_else(String::new, |h| format!(" ({h})"));
    Err(Error::model(at, format!("tensors do not fit{hint}: {}", faults.join("; "))))
}

/// What may have gone wrong with the names.
fn hint(missing: &[String], unexpected: &BTreeSet<&str>) -> Option<String> {
    let (first, name) = (missing.first()?, unexpected.iter().next()?);
    // One unknown word in front of every name?
    if let Some((prefix, _)) = name.split_once('.') {
        let wrapped = |m: &String| unexpected.contains(format!("{prefix}.{m}").as_str());
        if missing.iter().all(wrapped) {
            let shown = escape(prefix.as_bytes());
            return Some(format!("prefix '{shown}.' is not a known wrapper ({})", WRAPPERS.join(" ")));
        }
    }
    let near = nearest(first, unexpected.iter().copied())?;
    Some(format!("'{}' may be {first}", escape(near.as_bytes())))
}

/// The licence of public weights that a checkpoint looks like.
fn known_licence(names: &Names, specs: &[TensorSpec]) -> Option<String> {
    if names.vggt {
        return Some(
            "names are VGGT's; the public VGGT-1B weights are for non-commercial use (a commercial release exists)"
                .into(),
        );
    }
    // Parameters of public Pi3.
    let count: usize = specs.iter().map(TensorSpec::len).sum();
    let dino = "encoder weights derive from DINOv2 (Apache-2.0)";
    (count == 958_696_732).then(|| {
        format!("sizes are those of public Pi3: its weights are CC BY-NC 4.0 (non-commercial), its code BSD-3; {dino}")
    })
}

/// Metadata for the blob; hashes the source.
fn provenance(source: &dyn Checkpoint, options: &Options, report: &mut Report) -> Result<Meta> {
    let digest = source.digest()?;
    report.source_digest = Some(digest);
    let mut meta = Meta::new();
    meta.set_text(keys::SOURCE_DIGEST, &hex(&digest));
    meta.set_text(keys::SOURCE, &report.source);
    meta.set_text(keys::CONVERTER, env!("CARGO_PKG_VERSION"));
    meta.set_text(keys::PRECISION, options.precision.name());
    if !options.command.is_empty() {
        meta.set_text(keys::COMMAND, &options.command);
    }
    if let Some(licence) = &report.licence {
        meta.set_text(keys::LICENCE, licence);
    }
    if options.golden {
        meta.set_text(keys::GOLDEN, NO_DIGEST);
    }
    if !options.checks.is_empty() {
        meta.set_text(keys::CHECK_KEYS, &options.checks.join(","));
        meta.set(keys::CHECK_VALUES, Value::Floats(vec![0.0; options.checks.len()]));
    }
    if options.precision == Dtype::Int8 {
        meta.set_text(keys::QUANT_RECIPE, RECIPE);
        if let Some(calibration) = &options.calibration {
            meta.set_text(keys::CALIBRATION, &hex(&calibration.digest()));
        }
        let kept = report.tensors.iter().filter_map(|t| t.reason.as_ref().map(|why| (t, why)));
        let lines: Vec<String> = kept.map(|(t, why)| format!("{} {} {why}", t.name, t.dtype.name())).collect();
        meta.set_text(keys::QUANT_KEPT, &lines.join("\n"));
        let matrices = arch::tensors(&report.config).iter().filter(|s| s.matrix().is_some()).count();
        meta.set(keys::WEIGHT_SQNR, Value::Floats(vec![0.0; matrices]));
    }
    Ok(meta)
}

/// Values of one tensor, and what is folded into it.
struct Loaded {
    values: Vec<f32>,
    fold: Fold,
}

/// Reads on one thread, quantizes, packs and writes on the others; at most three tensors are in memory.
fn stream(
    (source, at): (&dyn Checkpoint, &str),
    (jobs, options): (&[Job], &Options),
    writer: &mut BlobWriter,
    report: &mut Report,
) -> Result<()> {
    let neutral = Seeded::new(&report.config, 0, Outputs::Neutral)?;
    let neutral = &neutral;
    let int8 = report.precision == Dtype::Int8;
    std::thread::scope(|scope| {
        // A rendezvous: the reader is one tensor ahead. It ends when the writer hangs up.
        let (send, receive) = sync_channel::<Result<Loaded>>(0);
        let read = move || {
            for job in jobs {
                let values = load_with_parts((source, at), neutral, (jobs, job), options.calibration.as_deref());
                let failed = values.is_err();
                if send.send(values).is_err() || failed {
                    return;
                }
            }
        };
        std::thread::Builder::new()
            .spawn_scoped(scope, read)
            .map_err(|e| Error::resource(at, format!("cannot start the reading thread: {e}")))?;
        // The matrix before, for its bias.
        let mut last: Option<(&TensorSpec, Loaded)> = None;
        // Of the matrix before: what its rounding adds to its bias.
        let mut shift: Option<(&str, Vec<f64>)> = None;
        for (job, row) in jobs.iter().zip(&mut report.tensors) {
            let mut loaded = receive.recv().map_err(|_| Error::Internal("the reading thread ended early".into()))??;
            row.zero_outputs = zero_outputs(&job.spec, &loaded.values);
            match job.fate {
                Fate::Neutral(value) => loaded.values.fill(value),
                Fate::FoldedBias => {
                    let (spec, weight) =
                        last.as_ref().ok_or_else(|| Error::Internal(format!("no matrix before {}", row.name)))?;
                    loaded.values = quantize::folded_bias(spec, &weight.values, &weight.fold, &loaded.values);
                }
                Fate::Folded(..) | Fate::Centring(..) | Fate::Plain => {}
            }
            if let Some((_, shift)) =
                shift.take().filter(|(layer, _)| job.spec.name.strip_suffix("bias") == Some(layer))
            {
                loaded.values.iter_mut().zip(shift).for_each(|(b, s)| *b = (f64::from(*b) + s) as f32);
            }
            if job.dtype == Dtype::Int8 {
                let found = write_int8(job, &loaded, options.calibration.as_deref(), writer, row)?;
                shift = job.spec.name.strip_suffix("weight").zip(found);
            } else {
                write_float(&loaded.values, job.dtype, writer, row)?;
                if int8 && job.spec.matrix().is_some() {
                    row.sqnr_db = Some(float_sqnr(&loaded.values, row.dtype));
                }
            }
            last = matches!(job.fate, Fate::Folded(..)).then_some((&job.spec, loaded));
        }
        if int8 {
            let table = report.tensors.iter().filter_map(|t| t.sqnr_db).map(|db| (db * 100.0).round() / 100.0);
            writer.replace(keys::WEIGHT_SQNR, Value::Floats(table.collect()))?;
        }
        Ok(())
    })
}

/// Writes a tensor as f32 or f16; a matrix beyond the range of f16 as f32.
fn write_float(values: &[f32], dtype: Dtype, writer: &mut BlobWriter, row: &mut TensorReport) -> Result<()> {
    row.promoted = dtype == Dtype::F16 && !fits_f16(values);
    row.dtype = if row.promoted { Dtype::F32 } else { dtype };
    row.bytes = writer.write(values, row.dtype)?;
    Ok(())
}

/// Writes a matrix as int8, or (folded all the same) as f16 where int8 would be too coarse. What the bias gains.
fn write_int8(
    job: &Job,
    loaded: &Loaded,
    calibration: Option<&Calibration>,
    writer: &mut BlobWriter,
    row: &mut TensorReport,
) -> Result<Option<Vec<f64>>> {
    let rotated = recipe::is_rotated(&job.spec);
    let q: Quantized = quantize::quantize(&job.spec, &loaded.values, &loaded.fold, rotated, calibration);
    row.sqnr_db = Some(q.sqnr_db());
    if q.sqnr_db() >= WEIGHT_FLOOR_DB || q.signal == 0.0 {
        row.bytes = writer.write_int8(QuantizedMatrix { values: &q.values, scales: &q.scales, signs: &q.signs })?;
        return Ok(Some(q.shift));
    }
    row.reason = Some(format!("int8 weights reach only {:.1} dB", q.sqnr_db()));
    let folded = quantize::folded(&job.spec, &loaded.values, &loaded.fold);
    write_float(&folded, Dtype::F16, writer, row)?;
    row.sqnr_db = Some(float_sqnr(&folded, row.dtype));
    Ok(None)
}

/// Signal to error of values stored as floats.
fn float_sqnr(values: &[f32], dtype: Dtype) -> f64 {
    if dtype == Dtype::F32 {
        return EXACT_DB;
    }
    let (signal, noise) = values.iter().fold((0.0, 0.0), |(s, n), &v| {
        let (v, stored) = (f64::from(v), f64::from(through_f16(v)));
        (s + v * v, n + (v - stored) * (v - stored))
    });
    sqnr_db(signal, noise)
}

/// The values of one tensor and of what is folded into it, around the mean where the calibration has seen it.
fn load_with_parts(
    (source, at): (&dyn Checkpoint, &str),
    neutral: &Seeded,
    (jobs, job): (&[Job], &Job),
    calibration: Option<&Calibration>,
) -> Result<Loaded> {
    let mut loaded = Loaded { values: load((source, at), neutral, job)?, fold: Fold::default() };
    let (parts, reader) = match &job.fate {
        Fate::Folded(parts, first) => (parts, *first),
        Fate::Centring(parts, first) => (parts, Some(*first)),
        _ => return Ok(loaded),
    };
    let fold = &mut loaded.fold;
    for (part, from) in parts {
        let values = Some(read((source, at), neutral, *from)?);
        match part {
            Part::Gain => fold.gain = values,
            Part::Offset => fold.offset = values,
            Part::Gamma => fold.gamma = values,
        }
    }
    // What the norm gives without its gain and offset, on average.
    let mean = calibration.zip(reader).and_then(|(c, reader)| c.mean(&jobs[reader].spec.name, fold));
    match (&job.fate, mean) {
        (Fate::Centring(..), mean) => {
            loaded.values.fill(0.0);
            loaded.values.iter_mut().zip(mean.iter().flatten()).for_each(|(v, m)| *v = -m);
        }
        // gain x + offset = gain (x - mean) + (offset + gain mean).
        (_, Some(mean)) => {
            if let Fold { gain: Some(gain), offset: Some(offset), .. } = fold {
                offset.iter_mut().zip(gain.iter().zip(mean)).for_each(|(o, (g, m))| *o = g.mul_add(m, *o));
            }
        }
        _ => {}
    }
    Ok(loaded)
}

/// The values of one tensor, wherever they come from.
fn read((source, _): (&dyn Checkpoint, &str), neutral: &Seeded, from: (Origin, usize)) -> Result<Vec<f32>> {
    let mut values = Vec::new();
    match from {
        (Origin::Checkpoint, index) => source.read_f32(index, &mut values)?,
        (Origin::Initialised, index) => neutral.read_f32(index, &mut values)?,
    }
    Ok(values)
}

/// The values of one tensor, all finite.
fn load((source, at): (&dyn Checkpoint, &str), neutral: &Seeded, job: &Job) -> Result<Vec<f32>> {
    let values = read((source, at), neutral, job.from)?;
    if values.len() != job.spec.len() {
        return Err(Error::Internal(format!("{} values for {} {:?}", values.len(), job.spec.name, job.spec.shape)));
    }
    if let Some(first) = values.iter().position(|v| !v.is_finite()) {
        let count = values.iter().filter(|v| !v.is_finite()).count();
        return Err(Error::model(
            format!("{at}: {}", job.spec.name),
            format!("value {first} is {}; {count} of {} are not finite", values[first], values.len()),
        ));
    }
    Ok(values)
}

/// Outputs whose weights are all zero.
fn zero_outputs(spec: &TensorSpec, values: &[f32]) -> usize {
    match spec.role {
        Role::Linear | Role::Conv => {
            values.chunks_exact(values.len() / spec.shape[0]).filter(|w| w.iter().all(|&v| v == 0.0)).count()
        }
        _ => 0,
    }
}
