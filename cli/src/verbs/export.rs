//! `export`: a scene as files that other tools open.

use crate::args::{FolderArgs, Times, has_extension, path_json};
use crate::folder::OutputFolder;
use crate::html;
use crate::output::{Console, files_json, human_bytes};
use crate::signals;
use clap::ValueEnum;
use serde_json::json;
use sf_formats::atomic::{AtomicFile, Overwrite};
use sf_formats::error::escape_path;
use sf_formats::poses_io::{self, PoseFormat};
use sf_formats::{Error, Gaussians, Result, Scene, ply, splat_file};
use std::path::PathBuf;

/// What to write where.
#[derive(clap::Args)]
pub(crate) struct Args {
    /// Scene folder that `run` wrote, or a .ply file
    #[arg(short, long, value_name = "SCENE")]
    scene: PathBuf,
    /// File (ply, splat, html) or folder (all others) to write
    #[arg(short, long, value_name = "PATH")]
    output: PathBuf,
    /// What to write
    /// [default: by the ending .ply, .splat or .html of the output, else ply]
    #[arg(long, value_enum)]
    format: Option<Format>,
    /// ply and splat: the time in seconds; default: the first input frame
    #[arg(long, value_name = "SECONDS", allow_hyphen_values = true)]
    at: Option<f64>,
    /// ply-seq: numbers and FIRST:LAST:STEP ranges in seconds; default: the input times
    #[arg(long, value_name = "LIST", allow_hyphen_values = true)]
    times: Option<Times>,
    /// html: the clip that the scene was made from, to show its pictures beside the rendered ones
    #[arg(long, value_name = "CLIP")]
    clip: Option<PathBuf>,
    /// html: the page's heading; default: the scene's folder name
    #[arg(long, value_name = "TEXT")]
    title: Option<String>,
    /// Leave out splats less opaque than this, 0 to 1
    #[arg(long, value_name = "ALPHA", value_parser = share)]
    min_opacity: Option<f32>,
    /// Leave out what moves
    #[arg(long)]
    static_only: bool,
    /// Leave out what stands still
    #[arg(long, conflicts_with = "static_only")]
    dynamic_only: bool,
    /// Replace existing files
    #[arg(long)]
    force: bool,
}

/// File format.
#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum)]
enum Format {
    /// The splats at one time, INRIA attributes: every splat viewer
    Ply,
    /// One such file per time: sequence players
    PlySeq,
    /// The splats at one time, 32 bytes each: antimatter15's viewer and others
    Splat,
    /// The moving scene with a viewer in one page: a browser, no network
    Html,
    /// Camera poses, transforms.json at the size of the source pictures
    Nerfstudio,
    /// Camera poses, one line "time tx ty tz qx qy qz qw" each
    Tum,
    /// Camera poses, one 3x4 matrix a line
    Kitti,
    /// Camera poses, COLMAP text model
    Colmap,
}

impl Format {
    /// As asked for, or by the output's ending.
    fn of(args: &Args) -> Format {
        let endings = [("splat", Format::Splat), ("html", Format::Html)];
        let by_name = endings.into_iter().find(|e| has_extension(&args.output, &[e.0])).map(|e| e.1);
        args.format.or(by_name).unwrap_or(Format::Ply)
    }
}

/// A number 0 to 1.
fn share(text: &str) -> Result<f32, String> {
    text.parse().ok().filter(|v: &f32| (0.0..=1.0).contains(v)).ok_or("a number 0 to 1 is wanted".into())
}

/// Writes the files and reports.
pub(crate) fn run(args: &Args, console: &Console) -> Result<()> {
    let format = Format::of(args);
    if args.at.is_some() && !matches!(format, Format::Ply | Format::Splat) {
        return Err(Error::usage("--at belongs to --format ply and splat; a sequence takes --times"));
    }
    if args.times.is_some() && format != Format::PlySeq {
        return Err(Error::usage("--times belongs to --format ply-seq; one file takes --at"));
    }
    if (args.clip.is_some() || args.title.is_some()) && format != Format::Html {
        return Err(Error::usage("--clip and --title belong to --format html"));
    }
    let (mut scene, report) = Scene::load(&args.scene)?;
    for note in &report.notes {
        console.note(format!("{}: {note}", escape_path(&args.scene)));
    }
    if args.static_only || args.dynamic_only || args.min_opacity.is_some() {
        let side = |p: f32| match (args.static_only, args.dynamic_only) {
            (true, _) => p <= scene.compose.tau,
            (_, true) => p > scene.compose.tau,
            _ => true,
        };
        let least = args.min_opacity.unwrap_or(0.0);
        scene = part(&scene, |i| side(scene.dynamic[i]) && scene.gaussians.opacity[i] >= least);
    }
    let overwrite = if args.force { Overwrite::Yes } else { Overwrite::No };
    let mut json = json!({
        "schema": "streetforward.export/1",
        "scene": path_json(&args.scene),
        "output": path_json(&args.output),
        "format": format.to_possible_value().map(|v| v.get_name().to_string()),
    });
    let what = match format {
        Format::Ply | Format::Splat => {
            let time = args.at.unwrap_or(scene.time_range().0);
            if !time.is_finite() {
                return Err(Error::input("--at", format!("{time} is not a time in seconds")));
            }
            let now = scene.at(time, &scene.compose)?;
            signals::guard_file(&args.output);
            match format {
                Format::Splat => splat_file::export_splat(&now, &args.output, overwrite)?,
                _ => ply::export_ply(&now, &args.output, overwrite)?,
            }
            json["time_s"] = time.into();
            json["gaussians"] = now.len().into();
            json["files"] = files_json(std::slice::from_ref(&args.output));
            format!("{} Gaussians at {time} s in {}", now.len(), escape_path(&args.output))
        }
        Format::PlySeq => {
            let folder = OutputFolder::create(&folder_args(args))?;
            let times = match &args.times {
                Some(t) => t.0.clone(),
                None => scene.frames.iter().map(|f| f.time).collect(),
            };
            if times.is_empty() {
                return Err(Error::input(escape_path(&args.scene), "has no input times; pass --times"));
            }
            ply::export_sequence(&scene, &scene.compose, &times, folder.path(), Overwrite::Yes)?;
            let files = folder.commit()?;
            json["times_s"] = times.clone().into();
            json["files"] = files_json(&files);
            format!("{} files, one per time, in {}", files.len(), escape_path(&args.output))
        }
        Format::Html => {
            let name = args.scene.file_name().map(|n| n.to_string_lossy().into_owned());
            let title = args.title.clone().or(name).unwrap_or_else(|| "Scene".into());
            // The file is claimed before the pictures are drawn.
            signals::guard_file(&args.output);
            let mut file = AtomicFile::create(&args.output, overwrite)?;
            let threads = crate::args::threads(0);
            let (page, pictures) = html::of_scene(&scene, args.clip.as_deref(), &title, threads)?;
            AtomicFile::write(&mut file, page.as_bytes())?;
            file.commit()?;
            json["gaussians"] = scene.len().into();
            json["pictures"] = pictures.into();
            json["files"] = files_json(std::slice::from_ref(&args.output));
            format!("{} Gaussians and {pictures} pictures in {}", scene.len(), escape_path(&args.output))
        }
        Format::Nerfstudio | Format::Tum | Format::Kitti | Format::Colmap => {
            let format = match format {
                Format::Tum => PoseFormat::Tum,
                Format::Kitti => PoseFormat::Kitti,
                Format::Colmap => PoseFormat::Colmap,
                _ => PoseFormat::Nerfstudio,
            };
            if scene.frames.is_empty() {
                return Err(Error::input(escape_path(&args.scene), "has no cameras: only a scene folder has them"));
            }
            let folder = OutputFolder::create(&folder_args(args))?;
            poses_io::export(&poses_io::views(&scene), format, folder.path(), Overwrite::Yes)?;
            let files = folder.commit()?;
            json["cameras"] = scene.frames.len().into();
            json["files"] = files_json(&files);
            format!("{} camera poses in {}", scene.frames.len(), escape_path(&args.output))
        }
    };
    let size = std::fs::metadata(&args.output).ok().filter(|m| m.is_file()).map(|m| human_bytes(m.len()));
    let text = format!("{what}{}\n", size.map_or(String::new(), |s| format!(", {s}")));
    console.report(&json, &text)
}

fn folder_args(args: &Args) -> FolderArgs {
    FolderArgs { output: args.output.clone(), force: args.force }
}

/// Some of a scene's Gaussians.
fn part(scene: &Scene, keep: impl Fn(usize) -> bool) -> Scene {
    let mut out = Scene {
        gaussians: Gaussians::default(),
        v_fwd: Vec::new(),
        v_bwd: Vec::new(),
        dynamic: Vec::new(),
        source: Vec::new(),
        frames: scene.frames.clone(),
        compose: scene.compose,
        splat: scene.splat,
        notes: scene.notes.clone(),
    };
    for i in (0..scene.len()).filter(|&i| keep(i)) {
        out.gaussians.push_from(&scene.gaussians, i, [0.0; 3], 1.0);
        out.v_fwd.push(scene.v_fwd[i]);
        out.v_bwd.push(scene.v_bwd[i]);
        out.dynamic.push(scene.dynamic[i]);
        out.source.push(scene.source[i]);
    }
    out
}
