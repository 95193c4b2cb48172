//! `bench`: how long the network takes here, for every combination of the settings given.
//!
//! Without a model random weights serve: the time of a run does not depend on their values. Every combination has
//! its share of the time; results must be the same for every instruction set and thread count, which is checked.

use crate::args::{self, EngineArgs, Load, Precision, Size};
use crate::bench::baseline::{Baseline, Share, Timing};
use crate::bench::measure::{self, Measured, Schedule, Warmup};
use crate::bench::row::{Row, csv, csv_cell, tables};
use crate::bench::stats::{Percentile, Samples};
use crate::machine::{self, Machine, Peak};
use crate::model::{self, Loaded};
use crate::network::{Heads, Preset};
use crate::output::{Console, json_text, write_stdout};
use crate::progress::Progress;
use crate::reconstruct;
use clap::ValueEnum;
use serde_json::{Value, json};
use sf_formats::atomic::{self, Overwrite};
use sf_formats::digest::hex;
use sf_formats::error::escape_path;
use sf_formats::{Error, Result};
use sf_ops::Kernels;
use sf_ops::cpu::{Features, Isa};
use std::path::{Path, PathBuf};
use std::str::FromStr;
use std::time::{Duration, Instant, SystemTime};
use streetforward::{ClipShape, Cost, Input};

/// Time of each peak probe.
const PROBE: Duration = Duration::from_millis(200);
/// Time for everything when neither runs nor seconds are given.
const DEFAULT_SECS: f64 = 60.0;
/// More running tasks than this beside us make times unreliable.
const BUSY: f64 = 0.5;

/// What to measure.
#[derive(clap::Args)]
pub(crate) struct Args {
    /// Weight blob (.sfw) or checkpoint, may be given several times; without one random weights are used
    #[arg(short, long, value_name = "MODEL", conflicts_with_all = ["preset", "heads"])]
    model: Vec<PathBuf>,
    /// Networks with random weights
    #[arg(long, value_enum, value_delimiter = ',', value_name = "LIST", default_value = "nano")]
    preset: Vec<Preset>,
    /// Kind of the dense heads of --preset
    #[arg(long, value_enum)]
    heads: Option<Heads>,
    /// Precisions of the random network or of converted checkpoints; default: f32, a blob its own
    #[arg(long, value_enum, value_delimiter = ',', value_name = "LIST")]
    precision: Vec<Precision>,
    /// Worker threads, as 1,2; 0 is what affinity and cgroup allow
    #[arg(long, value_delimiter = ',', value_name = "LIST", default_value = "0", value_parser = clap::value_parser!(u32).range(0..=64))]
    threads: Vec<u32>,
    /// Frames of a clip, as 1,2,4
    #[arg(long, value_delimiter = ',', value_name = "LIST", default_value = "4", value_parser = clap::value_parser!(u32).range(1..=4096))]
    frames: Vec<u32>,
    /// Sizes of the frames, multiples of the patch
    #[arg(long, value_delimiter = ',', value_name = "LIST", default_value = "252x168")]
    size: Vec<Size>,
    /// Highest instruction sets to use, as scalar,avx2; default: the best
    #[arg(long, value_delimiter = ',', value_name = "LIST", value_parser = args::isa)]
    isa: Vec<Isa>,
    /// Memory budget of working memory and results: bytes, or with K, M, G; default 8G
    #[arg(long, value_name = "BYTES", value_parser = args::bytes)]
    max_mem: Option<u64>,
    /// How a weight blob is read
    #[arg(long, value_enum, default_value_t = Load::Map)]
    load: Load,
    /// Runs that count of every combination
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u32).range(1..=1_000_000))]
    runs: Option<u32>,
    /// Seconds for everything, shared by the combinations; default 60 without --runs
    #[arg(long, value_name = "SECONDS", value_parser = positive)]
    max_secs: Option<f64>,
    /// Runs before those that count: a number, or auto, until two successive ones agree within 3 %; the first run
    /// never counts
    #[arg(long, value_name = "N", default_value = "auto")]
    warmup: Warmup,
    /// Percentiles to report, each only where there are samples enough for it
    #[arg(long, value_delimiter = ',', value_name = "LIST", default_value = "50,90,99,99.9")]
    percentiles: Vec<Percentile>,
    /// A clip arrives every so many milliseconds; default: as soon as the last one is done
    #[arg(long, value_name = "MS", value_parser = positive)]
    period_ms: Option<f64>,
    /// Fail when a clip takes longer from its arrival to its result, in milliseconds
    #[arg(long, value_name = "MS", value_parser = positive)]
    deadline_ms: Option<f64>,
    /// Also time steps of one new frame (Session::push) beside runs of the whole window, in half of the time
    #[arg(long, conflicts_with = "period_ms")]
    push: bool,
    /// Also time every kind of operation, in a run of its own
    #[arg(long)]
    profile_ops: bool,
    /// Write the time of every run into this CSV file
    #[arg(long, value_name = "FILE")]
    samples: Option<PathBuf>,
    /// md, csv or json for standard output, or files that end so; default md
    #[arg(short, long, value_delimiter = ',', value_name = "LIST")]
    output: Vec<Target>,
    /// An earlier report (json): fail when a median is worse by more than --fail-over
    #[arg(long, value_name = "FILE")]
    baseline: Option<PathBuf>,
    /// How much worse a median may be than in the baseline, where the samples can tell
    #[arg(long, value_name = "SHARE", default_value = "5%")]
    fail_over: Share,
    /// Replace existing files
    #[arg(long)]
    force: bool,
}

fn positive(text: &str) -> Result<f64, String> {
    match text.parse::<f64>() {
        Ok(v) if v > 0.0 && v <= 1e7 => Ok(v),
        _ => Err("a number above 0, at most 10000000".into()),
    }
}

/// Kind of a report.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Format {
    Md,
    Csv,
    Json,
}

/// Where a report goes.
#[derive(Clone, Debug, PartialEq, Eq)]
struct Target {
    format: Format,
    /// None for standard output.
    file: Option<PathBuf>,
}

impl FromStr for Target {
    type Err = String;

    fn from_str(text: &str) -> Result<Target, String> {
        let format = |name: &str| match name {
            "md" => Some(Format::Md),
            "csv" => Some(Format::Csv),
            "json" => Some(Format::Json),
            _ => None,
        };
        if let Some(format) = format(text) {
            return Ok(Target { format, file: None });
        }
        let path = Path::new(text);
        match path.extension().and_then(|e| e.to_str()).and_then(format) {
            Some(format) => Ok(Target { format, file: Some(path.to_path_buf()) }),
            None => Err("md, csv, json, or a file that ends in .md, .csv or .json".into()),
        }
    }
}

/// A model to measure, before it is loaded.
enum Source<'a> {
    File(&'a Path),
    Preset(Preset),
}

impl Args {
    fn overwrite(&self) -> Overwrite {
        if self.force { Overwrite::Yes } else { Overwrite::No }
    }

    fn engine(&self, threads: u32, isa: Option<Isa>) -> EngineArgs {
        EngineArgs { threads, isa, max_mem: self.max_mem, load: self.load }
    }

    /// Reports on standard output and in files; `--json` is `-o json`.
    fn targets(&self, console: &Console) -> Result<Vec<Target>> {
        let mut targets = self.output.clone();
        if console.is_json() {
            targets.push(Target { format: Format::Json, file: None });
        }
        targets.dedup();
        match targets.iter().filter(|t| t.file.is_none()).count() {
            0 => targets.push(Target { format: Format::Md, file: None }),
            1 => {}
            _ => return Err(Error::usage("one report fits on standard output: give the others file names")),
        }
        let mut files = targets.iter().filter_map(|t| t.file.as_ref()).chain(&self.samples);
        if let Some(file) = files.find(|f| !self.force && f.exists()) {
            let e = std::io::Error::new(std::io::ErrorKind::AlreadyExists, "it exists; pass --force to replace it");
            return Err(Error::io(file, "write", &e));
        }
        Ok(targets)
    }
}

/// Measures, reports, compares.
pub(crate) fn run(args: &Args, console: &Console) -> Result<()> {
    // Everything that can be refused is, before minutes pass.
    let targets = args.targets(console)?;
    let baseline = args.baseline.as_deref().map(Baseline::open).transpose()?;
    let isas: Vec<Option<Isa>> =
        if args.isa.is_empty() { vec![None] } else { args.isa.iter().copied().map(Some).collect() };
    let kernels = isas.iter().map(|&isa| args::kernels(isa)).collect::<Result<Vec<_>>>()?;
    let mut threads: Vec<usize> = args.threads.iter().map(|&t| args::threads(t)).collect();
    threads.dedup();
    let mut peaks = Vec::new();
    for k in &kernels {
        for &t in &threads {
            peaks.push((k.isa, t, Peak::measure(k, t, PROBE)));
        }
    }

    let sources: Vec<Source> = match args.model.as_slice() {
        [] => args.preset.iter().copied().map(Source::Preset).collect(),
        files => files.iter().map(|f| Source::File(f)).collect(),
    };
    let precisions: Vec<Option<Precision>> =
        if args.precision.is_empty() { vec![None] } else { args.precision.iter().copied().map(Some).collect() };
    let per_model = args.size.len() * args.frames.len() * kernels.len() * threads.len();
    let mut left = sources.len() * precisions.len() * per_model;

    let machine = Machine::probe();
    let (load_before, mhz_before) = (machine::load_average(), machine::mhz());
    if let Some(load) = load_before.filter(|&l| l > BUSY) {
        console.warn(format!(
            "load average {load:.1} on {} threads: other programs run, times are not reliable",
            machine.allowed_threads
        ));
    }
    let seconds = args.max_secs.or(if args.runs.is_none() { Some(DEFAULT_SECS) } else { None });
    let start = Instant::now();
    let mut spent_loading = Duration::ZERO;
    let bar = console.progress(1000, "bench");
    let mut rows: Vec<Row> = Vec::new();
    let mut samples: Vec<String> = Vec::new();
    for source in &sources {
        for &precision in &precisions {
            let clock = Instant::now();
            let loaded = load(args, source, precision, console)?;
            spent_loading += clock.elapsed();
            for &size in &args.size {
                for &frames in &args.frames {
                    let shape =
                        ClipShape { frames: frames as usize, height: size.height as usize, width: size.width as usize };
                    for k in &kernels {
                        for &threads in &threads {
                            // What others left is shared by those that remain.
                            let used = (start.elapsed() - spent_loading).as_secs_f64();
                            let share = seconds.map(|s| (s - used).max(0.0) / left as f64);
                            let share = share.map(|s| if args.push { s / 2.0 } else { s });
                            let schedule = Schedule {
                                runs: args.runs,
                                seconds: share,
                                warmup: args.warmup,
                                period: args.period_ms.map(|p| Duration::from_secs_f64(p * 1e-3)),
                                deadline: args.deadline_ms.map(|d| Duration::from_secs_f64(d * 1e-3)),
                            };
                            let peak = peaks.iter().find(|p| (p.0, p.1) == (k.isa, threads)).expect("probed above").2;
                            let case = Case { args, source, loaded: &loaded, kernels: k, threads, shape, peak };
                            let (row, runs) = case.measure(&schedule, &Bar { bar: &bar, start, seconds })?;
                            if args.samples.is_some() {
                                samples.push(case.samples(&row, &runs));
                            }
                            rows.push(row);
                            left -= 1;
                            if seconds.is_none() {
                                bar.set((1000 * rows.len() / (rows.len() + left)) as u64);
                            }
                        }
                    }
                }
            }
        }
    }
    drop(bar);

    let mhz_after = machine::mhz();
    let mut described = machine.json();
    described["load_average_before"] = json!(load_before);
    described["load_average_after"] = json!(machine::load_average());
    described["mhz_before"] = json!(mhz_before);
    described["mhz_after"] = json!(mhz_after);
    let comparison = match &baseline {
        Some(baseline) => {
            if baseline.cpu.is_some() && baseline.cpu != machine.cpu {
                console.warn("the baseline is of another processor");
            }
            let timing = |row: &Row| Timing::of(&row.json(&args.percentiles), "this run");
            let timings = rows.iter().map(timing).collect::<Result<Vec<_>>>()?;
            Some(baseline.compare(&timings, args.fail_over)?)
        }
        None => None,
    };
    let json = json!({
        "schema": "streetforward.bench/1",
        "version": env!("CARGO_PKG_VERSION"),
        "time_unix_s": SystemTime::now().duration_since(SystemTime::UNIX_EPOCH).map_or(0, |d| d.as_secs()),
        "what_is_timed": "wall time of Session::run: frames at the network's size to poses, depth, Gaussians, motion",
        "machine": described,
        "results": rows.iter().map(|r| r.json(&args.percentiles)).collect::<Value>(),
        "baseline": comparison.as_ref().map(|c| json!({ "rows": c.lines, "slower": c.slower })),
    });
    let mut text = tables(&rows, &args.percentiles);
    text.push_str(&footer(args, &machine, &kernels, &rows, (mhz_before, mhz_after)));
    if let Some(comparison) = &comparison {
        text.push_str(&format!("\nagainst {}:\n", escape_path(args.baseline.as_deref().unwrap_or(Path::new("")))));
        comparison.lines.iter().for_each(|l| text.push_str(&format!("  {l}\n")));
    }
    if let Some(file) = &args.samples {
        atomic::write(file, (SAMPLES_HEAD.to_string() + &samples.concat()).as_bytes(), args.overwrite())?;
    }
    for target in &targets {
        let bytes = match target.format {
            Format::Md => text.clone(),
            Format::Csv => csv(&rows, &args.percentiles),
            Format::Json => json_text(&json)?,
        };
        match &target.file {
            Some(file) => atomic::write(file, bytes.as_bytes(), args.overwrite())?,
            None => write_stdout(bytes.as_bytes())?,
        }
    }
    verdict(&rows, comparison.map(|c| c.slower).unwrap_or_default())
}

/// What failed: results that differ, deadlines missed, medians worse than the baseline's.
fn verdict(rows: &[Row], slower: Vec<String>) -> Result<()> {
    for (i, row) in rows.iter().enumerate() {
        if let Some(first) = rows[..i].iter().find(|r| r.same_result_as(row) && r.digest != row.digest) {
            let why = format!("{} and {} give different results", first.name(), row.name());
            return Err(Error::CheckFailed(format!("{why}: this machine or this program computes wrongly")));
        }
    }
    if let Some(first) = slower.first() {
        let others = if slower.len() > 1 { format!("; {} more", slower.len() - 1) } else { String::new() };
        return Err(Error::CheckFailed(format!("{} of {} rows are slower: {first}{others}", slower.len(), rows.len())));
    }
    let missed = rows.iter().find_map(|r| r.deadline.filter(|d| d.1 > 0).map(|d| (r, d)));
    if let Some((row, (deadline, misses))) = missed {
        return Err(Error::CheckFailed(format!("{}: {misses} misses of the {deadline} ms deadline", row.name())));
    }
    Ok(())
}

/// Opens or makes a model.
fn load(args: &Args, source: &Source, precision: Option<Precision>, console: &Console) -> Result<Loaded> {
    match *source {
        Source::File(path) => {
            let to = precision.unwrap_or(Precision::F32);
            let loaded = model::load(Some(path), &args.engine(0, None), to, console)?;
            match (precision, loaded.precision()) {
                (Some(asked), Some(have)) if asked != have => {
                    let name = |p: Precision| p.dtype().name();
                    Err(Error::usage(format!(
                        "--precision {}: {} is a blob of {}; give its checkpoint, or leave the flag out",
                        name(asked),
                        escape_path(path),
                        name(have)
                    )))
                }
                _ => Ok(loaded),
            }
        }
        Source::Preset(preset) => {
            let config = crate::network::with_heads(crate::network::preset(preset), args.heads);
            model::random(&config, precision.unwrap_or(Precision::F32), console)
        }
    }
}

/// One combination.
struct Case<'a> {
    args: &'a Args,
    source: &'a Source<'a>,
    loaded: &'a Loaded,
    kernels: &'static Kernels,
    threads: usize,
    shape: ClipShape,
    peak: Peak,
}

/// The bar over everything.
struct Bar<'a> {
    bar: &'a Progress,
    start: Instant,
    seconds: Option<f64>,
}

impl Case<'_> {
    fn measure(&self, schedule: &Schedule, bar: &Bar) -> Result<(Row, Measured)> {
        machine::forget_peak_rss();
        let clock = Instant::now();
        let engine = self.args.engine(self.threads as u32, Some(self.kernels.isa));
        let mut session = reconstruct::session(self.loaded, self.shape, &engine)?;
        let session_ms = clock.elapsed().as_secs_f64() * 1e3;
        let (images, times) = pictures(self.shape);
        let input = Input { shape: self.shape, images: &images, times: &times, k: None };
        let mut tick = || {
            if let Some(seconds) = bar.seconds {
                bar.bar.set((1000.0 * bar.start.elapsed().as_secs_f64() / seconds) as u64);
            }
        };
        let measured = measure::measure(&mut session, &input, schedule, &mut tick)?;
        let push = match self.args.push {
            true => Some(measure::push(&mut session, &input, schedule, measured.digest)?),
            false => None,
        };
        let profile = if self.args.profile_ops { Some(measure::profile(&mut session, &input)?) } else { None };
        self.loaded.model.blob().unchanged()?;

        let ms = |d: Duration| d.as_secs_f64() * 1e3;
        let of =
            |part: fn(&measure::Run) -> Duration| Samples::new(measured.runs.iter().map(|r| ms(part(r))).collect());
        let stage = |(i, s): (usize, streetforward::StageTime)| {
            (s.name, Samples::new(measured.runs.iter().map(|r| ms(r.stages[i])).collect()).median())
        };
        let worst = measured.runs.iter().enumerate().max_by_key(|(_, r)| r.response);
        let late = schedule.deadline.map_or(0, |limit| measured.runs.iter().filter(|r| r.response > limit).count());
        let misses = late as u64 + measured.pace.map_or(0, |p| p.skipped);
        let row = Row {
            model: match self.source {
                Source::File(path) => Some(path.to_string_lossy().into_owned()),
                Source::Preset(_) => None,
            },
            preset: match self.source {
                Source::File(_) => None,
                Source::Preset(p) => p.to_possible_value().map(|v| match self.args.heads {
                    Some(Heads::Linear) => format!("{}-linear", v.get_name()),
                    _ => v.get_name().to_string(),
                }),
            },
            precision: self.loaded.precision().map_or("f32", |p| p.dtype().name()),
            isa: self.kernels.isa.name(),
            threads: self.threads,
            shape: self.shape,
            kernels: machine::kernels_json(self.kernels),
            warmup: measured.warmup,
            samples: of(|r| r.time),
            samples_ns: measured.runs.iter().map(|r| r.time.as_nanos() as u64).collect(),
            responses: of(|r| r.response),
            load_ms: self.loaded.load_ms(),
            session_ms,
            first_ms: ms(measured.first),
            weights_bytes: self.loaded.model.blob().file_bytes() as u64,
            arena_bytes: session.plan().arena_bytes(),
            output_bytes: session.plan().output_bytes(),
            peak_rss_bytes: measured.peak_rss_bytes,
            cost: Cost::of_model(&self.loaded.model, self.shape)?,
            peak: self.peak,
            stages: session.stage_times().enumerate().map(stage).collect(),
            pace: self.args.period_ms.zip(measured.pace),
            deadline: self.args.deadline_ms.map(|limit| (limit, misses)),
            worst_run: worst.map_or(0, |(i, _)| i + 1),
            profile,
            push: push.map(|p| {
                let samples = |times: Vec<Duration>| Samples::new(times.into_iter().map(ms).collect());
                [p.push, p.newest, p.whole].map(samples)
            }),
            digest: measured.digest,
        };
        Ok((row, measured))
    }

    /// Lines of the samples file.
    fn samples(&self, row: &Row, measured: &Measured) -> String {
        let name = row.model.as_deref().or(row.preset.as_deref()).unwrap_or_default();
        let name = csv_cell(&json!(name));
        let s = row.shape;
        let line = |(i, r): (usize, &measure::Run)| {
            format!(
                "{name},{},{},{},{},{},{},{},{},{}\n",
                row.precision,
                row.isa,
                row.threads,
                s.frames,
                s.width,
                s.height,
                i + 1,
                r.time.as_nanos(),
                r.response.as_nanos()
            )
        };
        measured.runs.iter().enumerate().map(line).collect()
    }
}

/// Columns of the samples file.
const SAMPLES_HEAD: &str = "model,precision,isa,threads,frames,width,height,run,run_ns,response_ns\n";

/// Smooth pictures that differ from frame to frame, a tenth of a second apart; integers, so equal everywhere.
fn pictures(shape: ClipShape) -> (Vec<u8>, Vec<f64>) {
    let pixel = |i: usize| {
        let (c, x, y) = (i % 3, i / 3 % shape.width, i / (3 * shape.width));
        ((x * (5 + c) + y * (3 + 2 * c) + x * y / 7) % 256) as u8
    };
    let images = (0..shape.frames * shape.height * shape.width * 3).map(pixel).collect();
    (images, (0..shape.frames).map(|f| f as f64 / 10.0).collect())
}

/// What was measured and on what, below the tables.
fn footer(
    args: &Args,
    machine: &Machine,
    kernels: &[&'static Kernels],
    rows: &[Row],
    (mhz_before, mhz_after): (Option<f64>, Option<f64>),
) -> String {
    let mut text = String::from(
        "\nA time is the wall time of one run: frames at the network's size to poses, depth, Gaussians and motion.\n",
    );
    let unknown = || "unknown".to_string();
    let clock = |mhz: Option<f64>| mhz.map_or_else(unknown, |m| format!("{m:.0}"));
    text.push_str(&format!(
        "{}, {} threads allowed, governor {}, {} MHz before, {} after\n",
        machine.cpu.clone().unwrap_or_else(unknown),
        machine.allowed_threads,
        machine.governor.clone().unwrap_or_else(unknown),
        clock(mhz_before),
        clock(mhz_after),
    ));
    for k in kernels {
        text.push_str(&format!("{}: {}\n", k.isa.name(), k.rows().map(|(_, name)| name).join(", ")));
    }
    let dot = [Features::AVX_VNNI, Features::AVX512_VNNI, Features::NEON_DOT];
    for k in kernels.iter().filter(|k| !dot.iter().any(|&f| k.features.has(f))) {
        if rows.iter().any(|r| r.precision == "int8" && r.isa == k.isa.name()) {
            text.push_str(&format!("{}: no instruction for dot products of bytes, int8 gains little\n", k.isa.name()));
        }
    }
    let fewest = rows.iter().map(|r| r.samples.len()).min().unwrap_or(0);
    for p in args.percentiles.iter().filter(|p| p.needs() > fewest) {
        text.push_str(&format!("{p} needs {} runs (fewest here: {fewest}): raise --runs or --max-secs\n", p.needs()));
    }
    if let Some(row) = rows.first() {
        text.push_str(&format!("result {}\n", hex(&row.digest)));
    }
    text
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn reports_go_where_they_are_asked() {
        assert_eq!("md".parse(), Ok(Target { format: Format::Md, file: None }));
        assert_eq!("a/b.json".parse(), Ok(Target { format: Format::Json, file: Some("a/b.json".into()) }));
        for bad in ["", "xml", "a.txt", "json/x"] {
            assert!(bad.parse::<Target>().is_err(), "{bad}");
        }
    }
}
