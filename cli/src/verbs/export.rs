//! `export`: a scene as files that other tools open.

use crate::args::{FolderArgs, Times, path_json};
use crate::folder::OutputFolder;
use crate::output::{Console, files_json, human_bytes};
use crate::signals;
use clap::ValueEnum;
use serde_json::json;
use sf_formats::atomic::Overwrite;
use sf_formats::error::escape_path;
use sf_formats::poses_io::{self, PoseFormat};
use sf_formats::{Error, Gaussians, Result, Scene, ply};
use std::path::PathBuf;

/// What to write where.
#[derive(clap::Args)]
pub(crate) struct Args {
    /// Scene folder that `run` wrote, or a .ply file
    #[arg(short, long, value_name = "SCENE")]
    scene: PathBuf,
    /// File (ply) or folder (all others) to write
    #[arg(short, long, value_name = "PATH")]
    output: PathBuf,
    /// What to write
    #[arg(long, value_enum, default_value_t = Format::Ply)]
    format: Format,
    /// ply: the time in seconds; default: the first input frame
    #[arg(long, value_name = "SECONDS", allow_hyphen_values = true)]
    at: Option<f64>,
    /// ply-seq: numbers and FIRST:LAST:STEP ranges in seconds; default: the input times
    #[arg(long, value_name = "LIST", allow_hyphen_values = true)]
    times: Option<Times>,
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
    /// Camera poses, transforms.json at the size of the source pictures
    Nerfstudio,
    /// Camera poses, one line "time tx ty tz qx qy qz qw" each
    Tum,
    /// Camera poses, one 3x4 matrix a line
    Kitti,
    /// Camera poses, COLMAP text model
    Colmap,
}

/// Writes the files and reports.
pub(crate) fn run(args: &Args, console: &Console) -> Result<()> {
    if args.at.is_some() && args.format != Format::Ply {
        return Err(Error::usage("--at belongs to --format ply; a sequence takes --times"));
    }
    if args.times.is_some() && args.format != Format::PlySeq {
        return Err(Error::usage("--times belongs to --format ply-seq; one file takes --at"));
    }
    let (mut scene, report) = Scene::load(&args.scene)?;
    for note in &report.notes {
        console.note(format!("{}: {note}", escape_path(&args.scene)));
    }
    if args.static_only || args.dynamic_only {
        scene = part(&scene, args.dynamic_only);
    }
    let mut json = json!({
        "schema": "streetforward.export/1",
        "scene": path_json(&args.scene),
        "output": path_json(&args.output),
        "format": args.format.to_possible_value().map(|v| v.get_name().to_string()),
    });
    let what = match args.format {
        Format::Ply => {
            let time = args.at.unwrap_or(scene.time_range().0);
            if !time.is_finite() {
                return Err(Error::input("--at", format!("{time} is not a time in seconds")));
            }
            let now = scene.at(time, &scene.compose)?;
            signals::guard_file(&args.output);
            let overwrite = if args.force { Overwrite::Yes } else { Overwrite::No };
            ply::export_ply(&now, &args.output, overwrite)?;
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
        Format::Nerfstudio | Format::Tum | Format::Kitti | Format::Colmap => {
            let format = match args.format {
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

/// The scene's moving or standing Gaussians alone, by the scene's own threshold.
fn part(scene: &Scene, dynamic: bool) -> Scene {
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
    for i in (0..scene.len()).filter(|&i| (scene.dynamic[i] > scene.compose.tau) == dynamic) {
        out.gaussians.push_from(&scene.gaussians, i, [0.0; 3], 1.0);
        out.v_fwd.push(scene.v_fwd[i]);
        out.v_bwd.push(scene.v_bwd[i]);
        out.dynamic.push(scene.dynamic[i]);
        out.source.push(scene.source[i]);
    }
    out
}
