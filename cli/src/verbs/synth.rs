//! `synth`: procedural street clips with exact depth, velocity and poses.

use crate::args::{FolderArgs, Size, path_json};
use crate::output::{Console, OutputFolder, files_json};
use serde_json::json;
use sf_formats::Result;
use sf_formats::atomic::Overwrite;
use sf_formats::error::escape_path;
use sf_synth::{Options, Street, write_clip};
use std::time::Instant;

/// Which street.
#[derive(clap::Args)]
pub(crate) struct Args {
    #[command(flatten)]
    folder: FolderArgs,
    /// The street; the same seed gives the same bytes everywhere
    #[arg(long, value_name = "N", default_value_t = 1)]
    seed: u64,
    /// Pictures
    #[arg(long, value_name = "N", default_value_t = 20)]
    frames: usize,
    /// Picture size in pixels
    #[arg(long, value_name = "WxH", default_value = "252x168")]
    size: Size,
    /// Pictures per second
    #[arg(long, value_name = "FPS", default_value_t = 10.0)]
    fps: f64,
}

/// Writes the clip and reports.
pub(crate) fn run(args: &Args, console: &Console) -> Result<()> {
    let options = Options {
        frames: args.frames,
        width: args.size.width,
        height: args.size.height,
        fps: args.fps,
        ..Options::default()
    };
    let start = Instant::now();
    let street = Street::new(args.seed, options)?;
    let folder = OutputFolder::create(&args.folder)?;
    write_clip(&street, folder.path(), Overwrite::Yes)?;
    let files = folder.commit()?;
    let seconds = start.elapsed().as_secs_f64();
    let json = json!({
        "schema": "streetforward.synth/1",
        "output": path_json(&args.folder.output),
        "seed": args.seed,
        "frames": args.frames,
        "width": args.size.width,
        "height": args.size.height,
        "fps": args.fps,
        "total_ms": seconds * 1e3,
        "files": files_json(&files),
    });
    let text = format!(
        "{} frames of {} at {} Hz in {}: pictures, transforms.json, depth, velocity, dynamic; {:.0} ms\n",
        args.frames,
        args.size,
        args.fps,
        escape_path(&args.folder.output),
        seconds * 1e3
    );
    console.report(&json, &text)
}
