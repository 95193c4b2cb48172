//! Which layers int8 is too coarse for: the sensitivity scan of `convert --check`.
//!
//! When an int8 model misses its gates, every int8 layer (every block in networks of more than [`MAX_SINGLE`] layers) is
//! set to f16 by itself, and what the gates gain is measured. Then layers become f16 in the order of gain per
//! multiply-add until the gates pass, up to [`BUDGET`] of the multiply-adds.

use crate::args::EngineArgs;
use crate::model::{Scratch, scratch_folder};
use crate::output::Console;
use crate::versus::{self, Answers, Sample, Verdict};
use sf_eval::Gate;
use sf_formats::atomic::Overwrite;
use sf_formats::blob::{Blob, LoadMode, Verify};
use sf_formats::checkpoint::Checkpoint;
use sf_formats::{Dtype, Error, ModelConfig, Result, arch};
use sf_quant::work::multiply_adds;
use sf_quant::{Calibration, Options, Report, convert};
use sf_splat::Renderer;
use std::cell::RefCell;
use std::collections::BTreeMap;
use std::sync::Arc;
use streetforward::Model;

/// Most layers that are tried one by one.
const MAX_SINGLE: usize = 120;
/// Largest share of the multiply-adds that may be promoted.
pub(crate) const BUDGET: f64 = 0.05;

/// A checkpoint, its f32 model's answers, and the means to judge other forms of it.
pub(crate) struct Judge<'a> {
    source: &'a dyn Checkpoint,
    engine: &'a EngineArgs,
    samples: Vec<Sample>,
    reference: Arc<Model>,
    answers: Answers,
    renderer: Renderer,
    /// Where trial blobs lie.
    folder: Scratch,
}

impl<'a> Judge<'a> {
    /// Converts to f32 and runs the clips.
    pub(crate) fn new(
        source: &'a dyn Checkpoint,
        options: &Options,
        clips: &[sf_formats::clip::Clip],
        engine: &'a EngineArgs,
    ) -> Result<Judge<'a>> {
        let folder = scratch_folder()?;
        let plain =
            Options { precision: Dtype::F32, keep: Vec::new(), golden: false, checks: Vec::new(), ..options.clone() };
        let reference = model(source, &folder, "reference.sfw", &plain)?.0;
        let samples = versus::samples(&reference, clips, None)?;
        let answers = versus::answers(&reference, &samples, engine, false)?;
        let renderer = Renderer::new(crate::args::threads(engine.threads))?;
        Ok(Judge { source, engine, samples, reference, answers, renderer, folder })
    }

    /// A model's outputs against the reference's.
    pub(crate) fn verdict(&mut self, model: &Arc<Model>) -> Result<Verdict> {
        let answers = versus::answers(model, &self.samples, self.engine, false)?;
        versus::compare(&self.samples, (&self.reference, &self.answers), (model, &answers), &mut self.renderer)
    }

    /// Converts with these options and judges the result.
    fn trial(&mut self, options: &Options) -> Result<(Verdict, Report)> {
        let plain = Options { golden: false, checks: Vec::new(), ..options.clone() };
        let (model, report) = model(self.source, &self.folder, "trial.sfw", &plain)?;
        Ok((self.verdict(&model)?, report))
    }

    /// Names of the matrices to promote so that the gates pass; none when they pass already.
    ///
    /// # Errors
    /// Status 1 when [`BUDGET`] does not suffice.
    pub(crate) fn scan(&mut self, options: &Options, gates: &[Gate], console: &Console) -> Result<Vec<String>> {
        let (all, report) = self.trial(options)?;
        let mut verdict = all;
        if versus::failures(gates, &verdict).is_empty() {
            return Ok(Vec::new());
        }
        console.note(format!("int8 misses {}: scanning its layers", versus::failures(gates, &verdict).join("; ")));
        let start = excess(gates, &verdict);
        let mut candidates = candidates(&report);
        let progress = console.progress(candidates.len() as u64, "scan");
        for c in &mut candidates {
            let alone = Options { promoted: c.names.clone(), ..options.clone() };
            c.gain = start - excess(gates, &self.trial(&alone)?.0);
            progress.step();
        }
        drop(progress);
        candidates.sort_by(|a, b| (b.gain / b.share).total_cmp(&(a.gain / a.share)));
        let (mut promoted, mut share) = (Vec::new(), 0.0);
        for c in candidates.iter().filter(|c| c.gain > 0.0) {
            if share + c.share > BUDGET {
                continue;
            }
            share += c.share;
            promoted.extend(c.names.iter().cloned());
            verdict = self.trial(&Options { promoted: promoted.clone(), ..options.clone() })?.0;
            console.note(format!(
                "{} as f16 ({:.2} % of the work): {:.3}",
                c.label,
                100.0 * share,
                versus::load(gates, &verdict)
            ));
            if versus::failures(gates, &verdict).is_empty() {
                return Ok(promoted);
            }
        }
        Err(Error::CheckFailed(format!(
            "with {:.1} % of the multiply-adds as f16 (the most allowed is {:.0} %) still: {}",
            100.0 * share,
            100.0 * BUDGET,
            versus::failures(gates, &verdict).join("; ")
        )))
    }
}

/// Something to promote.
struct Candidate {
    label: String,
    names: Vec<String>,
    /// Of all multiply-adds.
    share: f64,
    gain: f64,
}

/// Sum of the squared loads: errors of independent layers add in it.
fn excess(gates: &[Gate], verdict: &Verdict) -> f64 {
    gates.iter().map(|g| g.load(&verdict.outputs).powi(2)).sum()
}

/// int8 layers, or blocks of them where there are many.
fn candidates(report: &Report) -> Vec<Candidate> {
    let work = work(&report.config);
    let total: f64 = work.values().sum();
    let int8: Vec<&str> = report.tensors.iter().filter(|t| t.dtype == Dtype::Int8).map(|t| t.name.as_str()).collect();
    let label = |name: &str| {
        let layer = name.strip_suffix(".weight").unwrap_or(name);
        let block = layer.split_once(".attn.").or_else(|| layer.split_once(".mlp."));
        if int8.len() > MAX_SINGLE { block.map_or(layer, |(block, _)| block).to_string() } else { layer.to_string() }
    };
    let mut groups: BTreeMap<String, Candidate> = BTreeMap::new();
    for name in &int8 {
        let group = groups.entry(label(name)).or_insert_with_key(|label| Candidate {
            label: label.clone(),
            names: Vec::new(),
            share: 0.0,
            gain: 0.0,
        });
        group.names.push(name.to_string());
        group.share += work[*name] / total;
    }
    groups.into_values().collect()
}

/// Multiply-adds by name.
fn work(config: &ModelConfig) -> BTreeMap<String, f64> {
    arch::tensors(config).iter().map(|s| (s.name.clone(), multiply_adds(config, s))).collect()
}

/// Share of the multiply-adds in these matrices.
pub(crate) fn share(config: &ModelConfig, names: &[String]) -> f64 {
    let work = work(config);
    names.iter().filter_map(|n| work.get(n)).sum::<f64>() / work.values().sum::<f64>()
}

/// Runs clips through a checkpoint in f32 and gathers what its linear layers read.
pub(crate) fn calibrate(
    source: &dyn Checkpoint,
    options: &Options,
    clips: &[sf_formats::clip::Clip],
    engine: &EngineArgs,
) -> Result<Calibration> {
    let folder = scratch_folder()?;
    let plain = Options { precision: Dtype::F32, keep: Vec::new(), golden: false, ..options.clone() };
    let reference = model(source, &folder, "calibration.sfw", &plain)?.0;
    let calibration = RefCell::new(Calibration::default());
    for sample in versus::samples(&reference, clips, None)? {
        let mut session = crate::reconstruct::session_of(&reference, sample.prepared.shape, engine)?;
        let see = |name: &str, row: &[f32]| calibration.borrow_mut().add(name, row);
        session.run_observed(&sample.prepared.input(), &see)?;
    }
    let mut calibration = calibration.into_inner();
    calibration.finish();
    Ok(calibration)
}

/// A checkpoint as a model in a temporary file, which is gone from the folder at once.
fn model(source: &dyn Checkpoint, folder: &Scratch, name: &str, options: &Options) -> Result<(Arc<Model>, Report)> {
    let file = folder.path().join(name);
    let report = convert(source, &file, Overwrite::Yes, options)?;
    let blob = Blob::open(&file, LoadMode::Map, Verify::Structure)?;
    // The mapping keeps the unlinked file.
    std::fs::remove_file(&file).map_err(|e| Error::io(&file, "remove", &e))?;
    Ok((Arc::new(Model::from_blob(blob)?), report))
}
