//! Which layers int8 is too coarse for: the sensitivity scan of `convert --check`.
//!
//! When an int8 model misses its gates, every int8 layer (every block in networks of more than [`MAX_SINGLE`] layers), and the attention of
//! every stack of blocks, is the only int8 part of the network for once, everything else being f16: the error that it makes. Then
//! these candidates become f16 in the order of squared error per multiply-add until the gates pass, up to [`BUDGET`] of the
//! multiply-adds.
//!
//! Squared errors of parts add up, as long as each is measured alone. What an int8 network gains when one part becomes f16 is another
//! thing: beside the part's own error it holds twice its product with all the others', which is larger and has any sign. So a candidate
//! that brings the worst gate too little nearer for its work stays int8, and is asked again in the next of [`PASSES`]; in the last, anything
//! is taken that helps.

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
/// Times that the candidates are gone through.
const PASSES: usize = 3;
/// Share of a gate's bound from which on it counts.
const PRESSED: f64 = 0.5;

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
        // What is far from its bound need not get better.
        let pressed: Vec<Gate> = gates.iter().filter(|g| g.load(&verdict.outputs) > PRESSED).cloned().collect();
        let mut candidates = candidates(&report);
        let all: Vec<&String> = report.tensors.iter().filter(|t| t.dtype == Dtype::Int8).map(|t| &t.name).collect();
        let progress = console.progress(candidates.len() as u64, "scan");
        for c in &mut candidates {
            let others = all.iter().filter(|n| !c.names.contains(n)).map(|n| n.to_string()).collect();
            let alone = Options { promoted: others, ..options.clone() };
            c.error = squared(&pressed, &self.trial(&alone)?.0);
            progress.step();
        }
        drop(progress);
        candidates.sort_by(|a, b| (b.error / b.share).total_cmp(&(a.error / a.share)));
        let work = Work::of(&report.config);
        let mut promoted: Vec<String> = Vec::new();
        let mut least = versus::load(gates, &verdict);
        let mut pass = 1;
        while pass <= PASSES {
            let before = promoted.len();
            for c in &candidates {
                let mut more = promoted.clone();
                more.extend(c.names.iter().filter(|n| !promoted.contains(n)).cloned());
                if more.len() == promoted.len() || work.share(&more) > BUDGET {
                    continue;
                }
                let tried = self.trial(&Options { promoted: more.clone(), ..options.clone() })?.0;
                let load = versus::load(gates, &tried);
                // What it must bring for its work so that the rest of the budget suffices; in the end, anything.
                let (used, with) = (work.share(&promoted), work.share(&more));
                let enough = if pass < PASSES { least.ln() / (BUDGET - used) } else { 0.0 };
                if load >= least || (least / load).ln() < enough * (with - used) {
                    continue;
                }
                (promoted, verdict, least) = (more, tried, load);
                console.note(format!("{} as f16 ({:.2} % of the work): {load:.3}", c.label, 100.0 * with));
                if versus::failures(gates, &verdict).is_empty() {
                    return Ok(promoted);
                }
            }
            // Asked the same again, all would answer the same.
            pass = if promoted.len() == before { pass.max(PASSES - 1) + 1 } else { pass + 1 };
        }
        let share = work.share(&promoted);
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
    /// Sum of the squared loads with nothing else in int8.
    error: f64,
}

/// Sum of the squared loads: errors of independent layers add in it.
fn squared(gates: &[Gate], verdict: &Verdict) -> f64 {
    gates.iter().map(|g| g.load(&verdict.outputs).powi(2)).sum()
}

/// int8 layers, or blocks of them where there are many; and the attention of every stack of blocks, which runs in floats once its
/// output layers are no int8.
fn candidates(report: &Report) -> Vec<Candidate> {
    let work = Work::of(&report.config);
    let int8: Vec<&str> = report.tensors.iter().filter(|t| t.dtype == Dtype::Int8).map(|t| t.name.as_str()).collect();
    let label = |name: &str| {
        let layer = name.strip_suffix(".weight").unwrap_or(name);
        let block = layer.split_once(".attn.").or_else(|| layer.split_once(".mlp."));
        if int8.len() > MAX_SINGLE { block.map_or(layer, |(block, _)| block).to_string() } else { layer.to_string() }
    };
    let (mut groups, mut stacks) = (BTreeMap::<String, Vec<String>>::new(), BTreeMap::<String, Vec<String>>::new());
    for name in &int8 {
        groups.entry(label(name)).or_default().push(name.to_string());
        if let Some(stack) = stack_of(name) {
            stacks.entry(format!("attention of {stack}")).or_default().push(name.to_string());
        }
    }
    // That of a single block is a layer of its own.
    groups.extend(stacks.into_iter().filter(|(_, names)| names.len() > 1));
    let candidate =
        |(label, names): (String, Vec<String>)| Candidate { label, share: work.share(&names), names, error: 0.0 };
    groups.into_iter().map(candidate).collect()
}

/// The stack of blocks (`decoder` of `decoder.3`) whose attention a matrix ends.
fn stack_of(name: &str) -> Option<&str> {
    let block = name.strip_suffix(".attn.proj.weight")?;
    block.rsplit_once('.').map(|(stack, _)| stack)
}

/// Multiply-adds of a network's matrices.
struct Work {
    by_name: BTreeMap<String, f64>,
    all: f64,
}

impl Work {
    fn of(config: &ModelConfig) -> Work {
        let by_name: BTreeMap<String, f64> =
            arch::tensors(config).iter().map(|s| (s.name.clone(), multiply_adds(config, s))).collect();
        Work { all: by_name.values().sum(), by_name }
    }

    /// Share of the multiply-adds in these matrices.
    fn share(&self, names: &[String]) -> f64 {
        names.iter().filter_map(|n| self.by_name.get(n)).sum::<f64>() / self.all
    }
}

/// Share of a network's multiply-adds in these matrices.
pub(crate) fn share(config: &ModelConfig, names: &[String]) -> f64 {
    Work::of(config).share(names)
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

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn attention_goes_by_stacks() {
        assert_eq!(stack_of("decoder.3.attn.proj.weight"), Some("decoder"));
        assert_eq!(stack_of("point_decoder.blocks.0.attn.proj.weight"), Some("point_decoder.blocks"));
        assert_eq!((stack_of("decoder.3.attn.qkv.weight"), stack_of("gs_head.conv.0.weight")), (None, None));
        let config = ModelConfig::nano();
        let work = Work::of(&config);
        let all: Vec<String> = work.by_name.keys().cloned().collect();
        assert!((work.share(&all) - 1.0).abs() < 1e-12 && work.share(&[]) == 0.0);
    }
}
