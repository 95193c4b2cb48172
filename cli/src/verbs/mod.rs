//! One file per verb; each has its arguments and a `run` that joins the crates.

mod bench;
mod compare;
mod convert;
mod demo;
mod doctor;
mod eval;
mod export;
mod init;
mod inspect;
mod plan;
mod render;
mod report;
mod run;
mod stream;
mod synth;
mod verify;

use crate::output::Console;
use sf_formats::Result;

/// What to do.
#[derive(clap::Subcommand)]
pub(crate) enum Verb {
    /// Show everything on a synthetic street
    Demo(demo::Args),
    /// Write a seeded random network as a checkpoint or weight blob
    Init(init::Args),
    /// Turn a training checkpoint into a weight blob
    Convert(convert::Args),
    /// Turn a clip of pictures into a scene
    Run(run::Args),
    /// Draw a scene from new places at new times
    Render(render::Args),
    /// Write a scene as files that other tools open
    Export(export::Args),
    /// Put results and scenes on one page to read
    Report(report::Args),
    /// Tell what is in a checkpoint, weight blob, splat file or scene folder
    Inspect(inspect::Args),
    /// Check a weight blob: structure and every digest
    Verify(verify::Args),
    /// Measure a model against clips with ground truth
    Eval(eval::Args),
    /// Measure what one model predicts against another, as int8 against f32
    Compare(compare::Args),
    /// Measure how long the network takes here
    Bench(bench::Args),
    /// Tell what a clip needs in memory and time, before it runs
    Plan(plan::Args),
    /// Turn pictures into poses, depth and scenes as they come
    Stream(stream::Args),
    /// Write a synthetic street clip with exact ground truth
    Synth(synth::Args),
    /// Describe this machine: processor, memory, threads, chosen kernels
    Doctor(doctor::Args),
}

impl Verb {
    /// Does it.
    pub(crate) fn run(&self, console: &Console) -> Result<()> {
        match self {
            Verb::Demo(args) => demo::run(args, console),
            Verb::Init(args) => init::run(args, console),
            Verb::Convert(args) => convert::run(args, console),
            Verb::Run(args) => run::run(args, console),
            Verb::Render(args) => render::run(args, console),
            Verb::Export(args) => export::run(args, console),
            Verb::Report(args) => report::run(args, console),
            Verb::Inspect(args) => inspect::run(args, console),
            Verb::Verify(args) => verify::run(args, console),
            Verb::Eval(args) => eval::run(args, console),
            Verb::Compare(args) => compare::run(args, console),
            Verb::Bench(args) => bench::run(args, console),
            Verb::Plan(args) => plan::run(args, console),
            Verb::Stream(args) => stream::run(args, console),
            Verb::Synth(args) => synth::run(args, console),
            Verb::Doctor(args) => doctor::run(args, console),
        }
    }
}
