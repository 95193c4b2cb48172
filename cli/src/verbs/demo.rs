//! `demo`: a synthetic street through the network, with everything worth looking at.
//!
//! The clip is the shipped one, `models/demo-clip` (20 frames of 252x168 at 10 Hz from a held-out seed). The
//! command draws it, with the exact ground truth, so the demonstration works from any folder and needs no file.
//! Frames 0, 5, 10 and 15 go through the network; the other 16 judge what comes out.
//!
//! ```text
//! DIR/street.html         the moving street for a browser
//! DIR/overview.png        per context frame: picture, depth and true depth, motion and true motion, dynamic
//!                         probability, the scene drawn at its time, half a step later and from the right
//! DIR/novel/*.png         the street at all 20 times, 16 of them never seen
//! DIR/aside/*.png         the same from a metre to the right
//! DIR/orbit/*.png         time stands still, the camera circles
//! DIR/scene/              for render and export
//! DIR/clip/               the clip with its ground truth
//! DIR/demo.json           latency and metrics
//! ```

use crate::args::{EngineArgs, FolderArgs, Precision, Shift, path_json};
use crate::folder::OutputFolder;
use crate::html;
use crate::machine;
use crate::model;
use crate::output::{Console, files_json, human_count, json_text};
use crate::overview::overview;
use crate::reconstruct;
use crate::results::Results;
use crate::views::{self, Rig};
use serde_json::json;
use sf_eval::{EvalClip, EvalOptions, Protocol, Subject, evaluate_subject};
use sf_formats::atomic::{self, Overwrite};
use sf_formats::camera_json::TimedCamera;
use sf_formats::clip::{Clip, ClipOptions, GroundTruth, TruthFrame};
use sf_formats::error::escape_path;
use sf_formats::{Result, Scene, image_io};
use sf_splat::{RenderOptions, Renderer};
use sf_synth::{Options, Split, Street, write_clip};
use std::path::PathBuf;
use std::time::Instant;

/// Where to, and with which model.
#[derive(clap::Args)]
pub(crate) struct Args {
    #[command(flatten)]
    folder: FolderArgs,
    /// Weight blob (.sfw) or checkpoint; without it the trained nano network inside the binary
    #[arg(short, long, value_name = "MODEL")]
    model: Option<PathBuf>,
    /// The street; a seed that models may be trained on gives way to the next that they may not
    #[arg(long, value_name = "N", default_value_t = 4)]
    seed: u64,
    #[command(flatten)]
    engine: EngineArgs,
}

/// Scene units to the right for the views from aside.
const ASIDE: f64 = 1.0;

/// Runs the demonstration.
pub(crate) fn run(args: &Args, console: &Console) -> Result<()> {
    let folder = OutputFolder::create(&args.folder)?;
    let seed = Split::HeldOut.seeds(args.seed).next().unwrap_or(args.seed);
    let street = Street::new(seed, Options::default())?;
    let clip_folder = folder.subfolder("clip")?;
    write_clip(&street, &clip_folder, Overwrite::Yes)?;
    let clip = Clip::open(&clip_folder, &ClipOptions::default())?;
    let truth = GroundTruth::load(&clip_folder, &clip.indices)?;

    let loaded = model::load(args.model.as_deref(), &args.engine, Precision::F32, console)?;
    let config = loaded.model.config();
    let protocol = Protocol::storm20(clip.total)?;
    let context = reconstruct::context_clip(&clip, &protocol);
    let size = reconstruct::network_size(config, &context, None);
    let prepared = reconstruct::prepare_clip(config, &context, None, size)?;
    let mut session = reconstruct::session(&loaded, prepared.shape, &args.engine)?;
    let start = Instant::now();
    session.run(&prepared.input())?;
    let first_ms = start.elapsed().as_secs_f64() * 1e3;
    let start = Instant::now();
    session.run(&prepared.input())?;
    let run_ms = start.elapsed().as_secs_f64() * 1e3;
    loaded.model.blob().unchanged()?;

    let out = session.output();
    let mut scene = out.to_scene(config, &reconstruct::sources(&context));
    scene.notes = loaded.notes(&PathBuf::from(format!("synthetic street {seed}")));
    scene.save(&folder.subfolder("scene")?, Overwrite::Yes)?;
    let known: Vec<TruthFrame> = match &truth {
        Some(t) => protocol.context.iter().map(|&i| t.frames[i].clone()).collect(),
        None => Vec::new(),
    };
    let mut renderer = Renderer::new(session.threads())?;
    let sheet = overview(&Results { out, scene: &scene, prepared: &prepared, truth: &known }, &mut renderer)?;
    image_io::write_png(&folder.path().join("overview.png"), &sheet, Overwrite::Yes)?;

    let mut album = Album { scene: &scene, folder: &folder, renderer: &mut renderer, pictures: 0, total_ms: 0.0 };
    let times = clip.times();
    let along = views::views(&scene, Rig::Follow, Some(&times))?;
    album.write("novel", &along)?;
    let aside = Shift { right: ASIDE, ..Shift::default() };
    let aside: Vec<TimedCamera> =
        along.iter().map(|v| TimedCamera { camera: views::shifted(&v.camera, &aside), ..*v }).collect();
    album.write("aside", &aside)?;
    let middle = Rig::Orbit { frame: scene.frames.len() / 2, radius: None };
    album.write("orbit", &views::views(&scene, middle, None)?)?;
    let render_ms = album.total_ms / album.pictures as f64;
    let (page, _) = html::of_scene(&scene, Some(&clip_folder), &format!("Street {seed}"), session.threads())?;
    atomic::write(&folder.path().join("street.html"), page.as_bytes(), Overwrite::Yes)?;

    let options = EvalOptions::new(protocol);
    let sky = reconstruct::sky(config, out);
    let subject = Subject { scene: &scene, depth: Some(&out.depth), sky: sky.as_deref() };
    let scores = evaluate_subject(&EvalClip::new(&clip, truth.as_ref()), &subject, &mut renderer, &options)?;
    let random = loaded.random();
    let mut json = json!({
        "schema": "streetforward.demo/1",
        "output": path_json(&args.folder.output),
        "seed": seed,
        "model": loaded.json(),
        "width": size.0,
        "height": size.1,
        "session": reconstruct::session_json(&session),
        "first_ms": first_ms,
        "run_ms": run_ms,
        "render_ms": render_ms,
        "peak_rss_bytes": machine::peak_rss_bytes(),
        "gaussians": scene.len(),
        "eval": scores.to_json(),
    });
    atomic::write(&folder.path().join("demo.json"), json_text(&json)?.as_bytes(), Overwrite::Yes)?;
    let files = folder.commit()?;
    json["files"] = files_json(&files);

    let shown = escape_path(&args.folder.output);
    let mut text = String::new();
    if random {
        text.push_str("The weights are random: what follows is noise, and shows only that everything runs.\n\n");
    }
    text.push_str(&format!(
        "{} frames of {}x{} -> {} Gaussians\nnetwork {run_ms:.0} ms ({first_ms:.0} ms the first time) on {} \
         threads, {}; a rendered picture {render_ms:.1} ms\n\n",
        context.frames.len(),
        size.0,
        size.1,
        human_count(scene.len()),
        session.threads(),
        session.kernels().isa.name(),
    ));
    text.push_str(&scores.to_markdown());
    text.push_str(&format!(
        "\nLook at {shown}/street.html    in a browser: the street with a time slider and a free camera\n        \
         {shown}/overview.png   what the network saw and made of it, beside the truth\n        \
         {shown}/novel/         the street at 20 times, 16 of them never seen\n        \
         {shown}/aside/         the same from {ASIDE} unit to the right\n        \
         {shown}/orbit/         time stands still, the camera circles\n        \
         {shown}/scene          for streetforward render and export\n        \
         {shown}/clip/          the clip with its ground truth\n",
    ));
    console.report(&json, &text)
}

/// Draws pictures of one scene into subfolders.
struct Album<'a> {
    scene: &'a Scene,
    folder: &'a OutputFolder,
    renderer: &'a mut Renderer,
    pictures: usize,
    total_ms: f64,
}

impl Album<'_> {
    fn write(&mut self, name: &str, views: &[TimedCamera]) -> Result<()> {
        let folder = self.folder.subfolder(name)?;
        for (i, view) in views.iter().enumerate() {
            let start = Instant::now();
            let now = self.scene.at(view.time, &self.scene.compose)?;
            let drawn = self.renderer.render(&now, &view.camera, &self.scene.splat, &RenderOptions::default())?;
            self.total_ms += start.elapsed().as_secs_f64() * 1e3;
            self.pictures += 1;
            image_io::write_png(&folder.join(format!("{i:06}.png")), &views::rgb8(&drawn), Overwrite::Yes)?;
        }
        Ok(())
    }
}
