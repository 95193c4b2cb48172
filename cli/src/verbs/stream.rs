//! `stream`: pictures to poses, depth and scenes as they come, from a folder that fills or from a video pipe.
//!
//! Every picture from the N-th on is a step: the network runs on the last N pictures, whose encoder tokens are kept
//! from step to step. A step is one line of JSON on standard output at once:
//!
//! | key | what |
//! |---|---|
//! | `step`, `frame`, `name`, `time_s` | the newest picture |
//! | `pose`, `poses`, `times_s` | camera to world of the newest and of all pictures of the window; the world is the window's first camera |
//! | `intrinsics`, `width`, `height` | fx, fy, cx, cy of the newest picture at its own size |
//! | `latency_ms` | from the moment the picture was seen (in a pipe: was whole) to the network's result |
//! | `run_ms` | the network's part of it |
//! | `deadline_missed`, `skipped` | against `--deadline-ms`; pictures passed over before this one |
//! | `files` | what was written, relative to the output folder |

use crate::args::{EngineArgs, FolderArgs, Precision, Size};
use crate::bench::stats::{Percentile, Samples};
use crate::folder::OutputFolder;
use crate::model;
use crate::output::{Console, files_json, write_stdout};
use crate::reconstruct;
use crate::results::DEPTH_STEPS;
use crate::signals;
use clap::{ArgGroup, ValueEnum};
use serde_json::json;
use sf_formats::atomic::Overwrite;
use sf_formats::clip::{DEFAULT_FPS, MIN_SIDE, natural};
use sf_formats::error::escape_path;
use sf_formats::image_io::{self, Orientation, Rgb8};
use sf_formats::y4m_in::Y4mReader;
use sf_formats::{Error, Result};
use std::cmp::Ordering;
use std::collections::HashSet;
use std::fs::File;
use std::io::{BufRead, BufReader};
use std::path::{Path, PathBuf};
use std::time::{Duration, Instant, SystemTime};
use streetforward::{ClipShape, FrameSource, Output, SourceFrame};

/// Time between two looks at a folder.
const POLL: Duration = Duration::from_millis(20);
/// A picture that cannot be read may still be growing for so long after its last change.
const GROWING: Duration = Duration::from_secs(2);

/// Where pictures come from and where results go.
#[derive(clap::Args)]
#[command(group(ArgGroup::new("from").required(true).args(["watch", "input"])))]
pub(crate) struct Args {
    /// Folder to which pictures are added; those in it are taken first, in the order of their numbers. Files should
    /// appear whole (by renaming); one that grows is waited for
    #[arg(long, value_name = "DIR")]
    watch: Option<PathBuf>,
    /// Video in YUV4MPEG2, - for standard input
    #[arg(short, long, value_name = "FILE")]
    input: Option<PathBuf>,
    /// Weight blob (.sfw), or a checkpoint, which is converted for this run; without it the trained nano network
    /// inside the binary
    #[arg(short, long, value_name = "MODEL")]
    model: Option<PathBuf>,
    /// Pictures that the network sees at once
    #[arg(long, value_name = "N", default_value_t = 4, value_parser = clap::value_parser!(u32).range(1..=512))]
    frames: u32,
    /// Network size in pixels, multiples of the patch; default: the first picture's, shrunk to what the network was
    /// made for
    #[arg(long, value_name = "WxH")]
    size: Option<Size>,
    /// Pictures per second; default: the video's, or 10
    #[arg(long, value_name = "FPS", value_parser = rate)]
    fps: Option<f64>,
    /// When several pictures wait, take the newest and pass over the others
    #[arg(long, conflicts_with = "input")]
    latest: bool,
    /// End after so many seconds without a new picture; default: wait until interrupted
    #[arg(long, value_name = "SECONDS", value_parser = rate, conflicts_with = "input")]
    until_idle: Option<f64>,
    /// Accept pictures of different sizes
    #[arg(long)]
    resize: bool,
    /// Fail at the end when a step took longer, in milliseconds
    #[arg(long, value_name = "MS", value_parser = rate)]
    deadline_ms: Option<f64>,
    /// Folder for files of the steps
    #[arg(short, long, value_name = "DIR")]
    output: Option<PathBuf>,
    /// Files to write: depth (16-bit pictures of the newest frame), scene (of the window)
    #[arg(long, value_enum, value_delimiter = ',', value_name = "LIST", default_value = "depth", requires = "output")]
    emit: Vec<Emit>,
    /// Results of the newest picture alone: the same, in a part of the time; no poses of the others, no scenes
    #[arg(long)]
    newest: bool,
    /// A scene for every N-th step
    #[arg(long, value_name = "N", default_value_t = 1, value_parser = clap::value_parser!(u64).range(1..), requires = "output")]
    scene_every: u64,
    /// Write into a folder that is not empty, replacing files of the same names
    #[arg(long)]
    force: bool,
    /// Precision of a converted checkpoint and of the random network
    #[arg(long, value_enum, default_value_t = Precision::F32)]
    precision: Precision,
    #[command(flatten)]
    engine: EngineArgs,
}

/// Files of a step.
#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum)]
enum Emit {
    /// Depth of the newest picture
    Depth,
    /// The scene of the window
    Scene,
}

fn rate(text: &str) -> Result<f64, String> {
    match text.parse::<f64>() {
        Ok(v) if v > 0.0 && v <= 1e6 => Ok(v),
        _ => Err("a number above 0, at most 1000000".into()),
    }
}

/// A picture that came.
struct Arrived {
    image: Rgb8,
    name: String,
    seen: Instant,
    /// Pictures passed over before it.
    skipped: u64,
}

/// Where pictures come from.
enum Feed {
    Folder(Watch),
    Video(Y4mReader<Box<dyn BufRead>>),
}

impl Feed {
    /// The next picture; `None` at the end.
    fn next(&mut self, console: &Console) -> Result<Option<Arrived>> {
        match self {
            Feed::Folder(watch) => watch.next(console),
            Feed::Video(reader) => {
                let image = reader.read()?;
                Ok(image.map(|image| Arrived { image, name: String::new(), seen: Instant::now(), skipped: 0 }))
            }
        }
    }
}

/// Runs until the pictures end.
pub(crate) fn run(args: &Args, console: &Console) -> Result<()> {
    if args.newest && args.emit.contains(&Emit::Scene) {
        return Err(Error::usage("--newest has no scene: it gives the results of one picture"));
    }
    let (mut feed, video_fps) = open(args)?;
    let files = args.output.as_deref().map(|folder| Files::create(folder, args)).transpose()?;
    let loaded = model::load(args.model.as_deref(), &args.engine, args.precision, console)?;
    let config = loaded.model.config();
    let fps = args.fps.or(video_fps).unwrap_or(DEFAULT_FPS);

    let window = args.frames as usize;
    let mut session = None;
    let mut sources: Vec<FrameSource> = Vec::new();
    let (mut came, mut index, mut step, mut misses) = (0usize, 0u64, 0u64, 0u64);
    let mut latencies = Vec::new();
    while let Some(picture) = feed.next(console)? {
        index += picture.skipped;
        let (frame, time) = (index, index as f64 / fps);
        let name = if picture.name.is_empty() { format!("frame {frame}") } else { picture.name.clone() };
        let own = picture.image.size();
        check_size(own, sources.last(), args.resize, &name)?;
        let (session, size) = match &mut session {
            Some(s) => s,
            None => {
                let size = reconstruct::size_for(config, own, args.size);
                let shape = ClipShape { frames: window, height: size.1 as usize, width: size.0 as usize };
                let made = reconstruct::session(&loaded, shape, &args.engine)?;
                console.note(format!(
                    "network: the last {window} pictures at {}x{}, {} threads, {}",
                    size.0,
                    size.1,
                    made.threads(),
                    made.kernels().isa.name()
                ));
                session.insert((made, size))
            }
        };
        let source = SourceFrame { name: &name, width: own.0, height: own.1, rgb: &picture.image.data };
        let prepared = streetforward::preprocess::prepare(config, &[source], &[time], None, *size)?;
        if sources.len() == window {
            sources.remove(0);
        }
        sources.push(FrameSource { name: name.clone(), size: own });
        came += 1;
        index += 1;
        let start = Instant::now();
        let pushed = match args.newest {
            true => session.push_newest(&prepared.images, time, None)?,
            false => session.push(&prepared.images, time, None)?,
        };
        let Some(out) = pushed else { continue };
        let run_ms = start.elapsed().as_secs_f64() * 1e3;
        let latency_ms = picture.seen.elapsed().as_secs_f64() * 1e3;
        let missed = args.deadline_ms.is_some_and(|d| latency_ms > d);
        misses += u64::from(missed);
        latencies.push(latency_ms);
        let written = match &files {
            Some(files) => {
                let origin = args.watch.as_deref().or(args.input.as_deref()).unwrap_or(Path::new("-"));
                files.write(out, (frame, step), args, |out| {
                    let mut scene = out.to_scene(config, &sources);
                    scene.notes = loaded.notes(origin);
                    scene
                })?
            }
            None => Vec::new(),
        };
        let last = window - 1;
        let k = out.k[last].resized(*size, own);
        let line = json!({
            "schema": "streetforward.stream/1",
            "step": step,
            "frame": frame,
            "name": name,
            "time_s": time,
            "pose": out.poses[last].to_rows(),
            "poses": (out.due == (0..window)).then(|| out.poses.iter().map(|p| json!(p.to_rows())).collect::<serde_json::Value>()),
            "times_s": out.times,
            "intrinsics": [k.fx, k.fy, k.cx, k.cy],
            "width": own.0,
            "height": own.1,
            "no_motion": out.flags.no_motion,
            "latency_ms": latency_ms,
            "run_ms": run_ms,
            "deadline_missed": missed,
            "skipped": picture.skipped,
            "files": files_json(&written),
        });
        write_stdout(format!("{line}\n").as_bytes())?;
        step += 1;
    }
    loaded.model.blob().unchanged()?;
    if step == 0 {
        return Err(Error::input("stream", format!("{came} pictures came, a step needs {window}: see --frames")));
    }
    let times = Samples::new(latencies);
    let p99 = times.percentile(Percentile(99.0)).map_or("n/a".into(), |t| format!("{t:.1}"));
    console.note(format!("{step} steps, latency p50 {:.1} ms, p99 {p99}, worst {:.1}", times.median(), times.max()));
    match args.deadline_ms {
        Some(deadline) if misses > 0 => {
            Err(Error::CheckFailed(format!("{misses} of {step} steps missed the deadline of {deadline} ms")))
        }
        _ => Ok(()),
    }
}

/// Opens the source; the frame rate that it knows of.
fn open(args: &Args) -> Result<(Feed, Option<f64>)> {
    if let Some(folder) = &args.watch {
        let meta = std::fs::metadata(folder).map_err(|e| Error::io(folder, "open", &e))?;
        if !meta.is_dir() {
            return Err(Error::input(escape_path(folder), "is not a folder: --watch takes the folder of the pictures"));
        }
        return Ok((Feed::Folder(Watch::new(folder.clone(), args.latest, args.until_idle)), None));
    }
    let path = args.input.as_deref().unwrap_or(Path::new("-"));
    let (input, at): (Box<dyn BufRead>, String) = if path == Path::new("-") {
        (Box::new(BufReader::new(std::io::stdin())), "standard input".into())
    } else {
        (Box::new(BufReader::new(File::open(path).map_err(|e| Error::io(path, "open", &e))?)), escape_path(path))
    };
    let reader = Y4mReader::new(input, &at)?;
    let fps = reader.header().fps;
    Ok((Feed::Video(reader), fps))
}

fn check_size(own: (u32, u32), last: Option<&FrameSource>, resize: bool, name: &str) -> Result<()> {
    if own.0.min(own.1) < MIN_SIDE {
        let why = format!("is {}x{}; both sides must be at least {MIN_SIDE} pixels", own.0, own.1);
        return Err(Error::input(name, why));
    }
    match last {
        Some(last) if last.size != own && !resize => {
            let ((w, h), (w0, h0)) = (own, last.size);
            Err(Error::input(name, format!("is {w}x{h} but the picture before it is {w0}x{h0}; pass --resize")))
        }
        _ => Ok(()),
    }
}

/// A folder to which pictures are added.
struct Watch {
    folder: PathBuf,
    latest: bool,
    until_idle: Option<Duration>,
    /// The last picture taken, and all names that are done with.
    last: Option<PathBuf>,
    done: HashSet<PathBuf>,
    /// A picture that is being looked at: length and time of its last change, when it was first seen, when it last changed.
    pending: Option<Pending>,
}

struct Pending {
    path: PathBuf,
    state: (u64, Option<SystemTime>),
    seen: Instant,
    changed: Instant,
}

impl Watch {
    fn new(folder: PathBuf, latest: bool, until_idle: Option<f64>) -> Watch {
        Watch {
            folder,
            latest,
            until_idle: until_idle.map(Duration::from_secs_f64),
            last: None,
            done: HashSet::new(),
            pending: None,
        }
    }

    /// Pictures that have not been taken, in natural order.
    fn waiting(&mut self, console: &Console) -> Result<Vec<PathBuf>> {
        let mut files = Vec::new();
        for entry in std::fs::read_dir(&self.folder).map_err(|e| Error::io(&self.folder, "list", &e))? {
            let path = entry.map_err(|e| Error::io(&self.folder, "list", &e))?.path();
            if !is_picture(&path) || self.done.contains(&path) {
                continue;
            }
            if self.last.as_ref().is_some_and(|last| natural(&path, last) == Ordering::Less) {
                console.warn(format!("{}: came after its successors and is left out", escape_path(&path)));
                self.done.insert(path);
                continue;
            }
            files.push(path);
        }
        files.sort_by(|a, b| natural(a, b));
        Ok(files)
    }

    fn next(&mut self, console: &Console) -> Result<Option<Arrived>> {
        let start = Instant::now();
        loop {
            let waiting = self.waiting(console)?;
            let (skipped, candidate) = match (self.latest, waiting.as_slice()) {
                (_, []) => (0, None),
                (true, [older @ .., newest]) => (older.len(), Some(newest)),
                (false, [first, ..]) => (0, Some(first)),
            };
            if let Some(path) = candidate {
                if let Some((image, seen)) = self.look(path)? {
                    self.done.extend(waiting.iter().take(skipped + 1).cloned());
                    self.last = Some(path.clone());
                    self.pending = None;
                    let name = path.file_name().unwrap_or_default().to_string_lossy().into_owned();
                    return Ok(Some(Arrived { image, name, seen, skipped: skipped as u64 }));
                }
            } else if self.until_idle.is_some_and(|limit| start.elapsed() >= limit) {
                return Ok(None);
            }
            std::thread::sleep(POLL);
        }
    }

    /// The picture, once it no longer grows; a picture that stays unreadable is an error.
    fn look(&mut self, path: &Path) -> Result<Option<(Rgb8, Instant)>> {
        let now = Instant::now();
        let meta = match std::fs::metadata(path) {
            Ok(meta) => meta,
            // Renamed or removed since it was listed.
            Err(e) if e.kind() == std::io::ErrorKind::NotFound => return Ok(None),
            Err(e) => return Err(Error::io(path, "open", &e)),
        };
        let state = (meta.len(), meta.modified().ok());
        let (seen, changed) = match &mut self.pending {
            Some(p) if p.path == path && p.state == state => (p.seen, p.changed),
            Some(p) if p.path == path => {
                (p.state, p.changed) = (state, now);
                return Ok(None);
            }
            _ => {
                self.pending = Some(Pending { path: path.to_path_buf(), state, seen: now, changed: now });
                (now, now)
            }
        };
        // A whole picture decodes at once; one that grows does not, and is looked at again.
        match image_io::read(path, Orientation::Apply) {
            Ok(image) => Ok(Some((image, seen))),
            Err(e) if changed.elapsed() > GROWING => Err(e),
            Err(_) => Ok(None),
        }
    }
}

fn is_picture(path: &Path) -> bool {
    let hidden = path.file_name().is_some_and(|n| n.as_encoded_bytes().starts_with(b"."));
    !hidden && crate::args::has_extension(path, &["png", "jpg", "jpeg"])
}

/// The folder of the steps' files: each appears whole, as soon as it is there.
struct Files {
    folder: PathBuf,
}

impl Files {
    fn create(folder: &Path, args: &Args) -> Result<Files> {
        let failed = |doing: &str, e: &std::io::Error| Error::io(folder, doing, e);
        std::fs::create_dir_all(folder).map_err(|e| failed("create", &e))?;
        let mut entries = std::fs::read_dir(folder).map_err(|e| failed("read", &e))?;
        if !args.force && entries.next().is_some() {
            let e = std::io::Error::new(
                std::io::ErrorKind::AlreadyExists,
                "the folder is not empty; pass --force to write into it",
            );
            return Err(failed("write", &e));
        }
        if args.emit.contains(&Emit::Depth) {
            let depth = folder.join("depth");
            std::fs::create_dir_all(&depth).map_err(|e| Error::io(&depth, "create", &e))?;
            signals::guard_file(&depth.join("x"));
        }
        Ok(Files { folder: folder.to_path_buf() })
    }

    /// Files of one step; their paths relative to the folder.
    fn write(
        &self,
        out: &Output,
        (frame, step): (u64, u64),
        args: &Args,
        scene: impl Fn(&Output) -> sf_formats::Scene,
    ) -> Result<Vec<PathBuf>> {
        let mut files = Vec::new();
        if args.emit.contains(&Emit::Depth) {
            let (w, h) = (out.shape.width, out.shape.height);
            let newest = &out.depth[(out.shape.frames - 1) * w * h..];
            let steps: Vec<u16> = newest.iter().map(|d| (d * DEPTH_STEPS).round() as u16).collect();
            let file = PathBuf::from(format!("depth/{frame:06}.png"));
            image_io::write_gray16(&self.folder.join(&file), (w as u32, h as u32), &steps, Overwrite::Yes)?;
            files.push(file);
        }
        if args.emit.contains(&Emit::Scene) && step.is_multiple_of(args.scene_every) {
            let name = PathBuf::from(format!("scene-{frame:06}"));
            let folder = OutputFolder::create(&FolderArgs { output: self.folder.join(&name), force: true })?;
            scene(out).save(folder.path(), Overwrite::Yes)?;
            files.extend(folder.commit()?.into_iter().map(|f| name.join(f)));
        }
        Ok(files)
    }
}
