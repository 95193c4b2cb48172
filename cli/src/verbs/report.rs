//! `report`: results and scenes as one page to read, offline.

use crate::args::{FileArgs, path_json};
use crate::output::{Console, human_bytes};
use crate::reals::Reals;
use crate::{html, report, signals};
use serde_json::{Value, json};
use sf_formats::atomic::AtomicFile;
use sf_formats::error::escape_path;
use sf_formats::image_io::{self, Orientation};
use sf_formats::open::read_regular;
use sf_formats::{Error, Result, Scene};
use std::path::{Path, PathBuf};

/// What to show where.
#[derive(clap::Args)]
pub(crate) struct Args {
    /// JSON results of bench, compare, eval, run, demo, render; folders that run or demo wrote, or scenes
    #[arg(value_name = "RESULT", required = true)]
    results: Vec<PathBuf>,
    #[command(flatten)]
    file: FileArgs,
    /// The clip that the scenes were made from, to show its pictures beside the rendered ones
    #[arg(long, value_name = "CLIP")]
    clip: Option<PathBuf>,
    /// The page's heading
    #[arg(long, value_name = "TEXT", default_value = "Report")]
    title: String,
}

/// Longest JSON document.
const FILE_CAP: u64 = 256 << 20;

/// Writes the page and reports.
pub(crate) fn run(args: &Args, console: &Console) -> Result<()> {
    // The file is claimed before the pictures are drawn.
    signals::guard_file(&args.file.output);
    let mut file = AtomicFile::create(&args.file.output, args.file.overwrite())?;
    let mut sections = Vec::new();
    for path in &args.results {
        if path.is_dir() { folder(path, args.clip.as_deref(), &mut sections)? } else { sections.push(document(path)?) }
    }
    let page = report::page(&args.title, &sections);
    AtomicFile::write(&mut file, page.as_bytes())?;
    file.commit()?;
    let json = json!({
        "schema": "streetforward.report/1",
        "output": path_json(&args.file.output),
        "sections": sections.len(),
        "bytes": page.len(),
    });
    let text = format!(
        "{} sections in {}, {}\n",
        sections.len(),
        escape_path(&args.file.output),
        human_bytes(page.len() as u64)
    );
    console.report(&json, &text)
}

/// A JSON document as a section.
fn document(path: &Path) -> Result<String> {
    let at = escape_path(path);
    let bytes = read_regular(path, FILE_CAP)?
        .ok_or_else(|| Error::input(&at, format!("longer than {} MiB", FILE_CAP >> 20)))?;
    let value: Value = serde_json::from_slice(&bytes).map_err(|e| Error::input(&at, format!("is not JSON: {e}")))?;
    if !value["schema"].is_string() {
        return Err(Error::input(&at, "has no 'schema': not a result of streetforward --json"));
    }
    Ok(report::document(&value, &at))
}

/// The JSON documents, the sheet and the scene of a folder.
fn folder(path: &Path, clip: Option<&Path>, sections: &mut Vec<String>) -> Result<()> {
    let before = sections.len();
    for name in ["demo.json", "run.json", "eval.json", "compare.json", "bench.json"] {
        let file = path.join(name);
        if file.exists() {
            sections.push(document(&file)?);
        }
    }
    let own = |p: &Path| p.join("scene.json").exists().then(|| p.to_path_buf());
    // A demonstration keeps scene and clip in folders of these names.
    if let Some(at) = own(path).or_else(|| own(&path.join("scene"))) {
        let (scene, _) = Scene::load(&at)?;
        let beside = path.join("clip");
        let clip = clip.or(beside.is_dir().then_some(beside.as_path()));
        let reals = clip.map(|c| Reals::open(c, &scene)).transpose()?;
        let strip = html::strip(&scene, reals.as_ref(), crate::args::threads(0))?;
        let sheet = path.join("overview.png");
        let sheet = sheet.exists().then(|| image_io::read(&sheet, Orientation::Ignore)).transpose()?;
        let moving = scene.dynamic.iter().filter(|&&p| p > scene.compose.tau).count();
        let summary = format!("{} Gaussians, {moving} of them moving, {} frames", scene.len(), scene.frames.len());
        sections.push(report::scene(&escape_path(path), &summary, &strip, sheet.as_ref())?);
    }
    if sections.len() == before {
        return Err(Error::input(escape_path(path), "holds no result: run.json, demo.json, eval.json or scene.json"));
    }
    Ok(())
}
