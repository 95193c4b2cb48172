//! `eval`: a model against clips with ground truth, beside the trivial alternatives and what true geometry gives.
//!
//! Clips come from folders, or are drawn in memory from held-out seeds at the network's size. A clip without ground truth
//! has its frames between the given ones drawn and compared all the same; rows that need truth are absent. Rows of the table:
//!
//! ```text
//! model               the network's scene
//! no_motion           the same with every velocity zero
//! forward_only        the same without the next frame's dynamic Gaussians        (--ablations)
//! no_causal           mask.k = 0: no attention between frames for motion         (--ablations)
//! copy_nearest        the nearest given frame
//! oracle              true depth, pose, velocity and mask, 0.4 pixels, opacity 0.95, the model's rules
//! oracle_no_motion    the same with every velocity zero
//! ```

use crate::args::{EngineArgs, FolderArgs, Precision, Size, path_json};
use crate::folder::OutputFolder;
use crate::model::{self, Loaded};
use crate::output::{Console, json_text};
use crate::reconstruct;
use clap::ValueEnum;
use serde_json::{Value, json};
use sf_eval::{
    EvalClip, EvalOptions, EvalReport, Method, OracleOptions, Protocol, Subject, TargetPoses, evaluate_subject,
    measure, oracle_of_clip, standing,
};
use sf_formats::atomic::{self, Overwrite};
use sf_formats::clip::{Clip, ClipOptions, Frame, GroundTruth, TruthFrame};
use sf_formats::image_io::Rgb8;
use sf_formats::scene::{Compose, SplatSettings};
use sf_formats::{ModelConfig, Result, Scene};
use sf_splat::Renderer;
use sf_synth::{DYNAMIC, Options, Split, Street};
use std::path::PathBuf;
use std::sync::Arc;
use std::time::Instant;
use streetforward::Session;

/// Which model on which clips.
#[derive(clap::Args)]
pub(crate) struct Args {
    /// Weight blob (.sfw), or a checkpoint, which is converted for this run; without it the trained nano network
    /// inside the binary
    #[arg(short, long, value_name = "MODEL")]
    model: Option<PathBuf>,
    /// Clips with ground truth, as synth writes them; of any other clip of three frames or more (a real drive) only
    /// the pictures of the frames left out are compared
    #[arg(long, value_name = "CLIP", required_unless_present = "synth_heldout", num_args = 1..)]
    data: Vec<PathBuf>,
    /// Pictures per second, where a clip of --data has no times of its own; default 10
    #[arg(long, value_name = "FPS", conflicts_with = "synth_heldout")]
    fps: Option<f64>,
    /// Draw this many streets of seeds that no model is trained on, 20 frames at 10 Hz
    #[arg(long, value_name = "N", conflicts_with = "data", value_parser = clap::value_parser!(u32).range(1..=100_000))]
    synth_heldout: Option<u32>,
    /// First seed that may be drawn
    #[arg(long, value_name = "N", default_value_t = 0, requires = "synth_heldout")]
    seed: u64,
    /// Which frames are given and which are tested
    #[arg(long, value_enum, default_value_t = Rules::Storm20)]
    protocol: Rules,
    /// Cameras of the tested frames
    #[arg(long, value_enum, default_value_t = Poses::Predicted)]
    target_poses: Poses,
    /// Also measure the model without attention between frames for motion, and without backward velocities
    #[arg(long)]
    ablations: bool,
    /// Network size in pixels; default as in run
    #[arg(long, value_name = "WxH")]
    size: Option<Size>,
    /// Precision of a converted checkpoint and of the random network
    #[arg(long, value_enum, default_value_t = Precision::F32)]
    precision: Precision,
    /// Folder to write eval.json and eval.md into
    #[arg(short, long, value_name = "DIR")]
    output: Option<PathBuf>,
    /// Write into a folder that is not empty, replacing files of the same names
    #[arg(long, requires = "output")]
    force: bool,
    #[command(flatten)]
    engine: EngineArgs,
}

/// Evaluation protocol.
#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum)]
enum Rules {
    /// 20 frames, 0, 5, 10, 15 given, the others tested
    Storm20,
}

/// Cameras of the tested frames.
#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum)]
enum Poses {
    /// The predicted context poses, interpolated in time
    Predicted,
    /// The true poses, brought into the predicted world by a similarity
    AlignedTruth,
}

/// Size of drawn streets for networks that do not say at which size they were trained.
const DRAWN: (u32, u32) = (252, 168);

/// Evaluates and reports.
pub(crate) fn run(args: &Args, console: &Console) -> Result<()> {
    let folder = args.output.as_ref().map(|dir| FolderArgs { output: dir.clone(), force: args.force });
    let folder = folder.as_ref().map(OutputFolder::create).transpose()?;
    let loaded = model::load(args.model.as_deref(), &args.engine, args.precision, console)?;
    let renderer = Renderer::new(crate::args::threads(args.engine.threads))?;
    let mut bench = Bench { args, loaded: &loaded, renderer, sessions: Vec::new(), total: None, clips: Vec::new() };
    let seeds = args.synth_heldout.map(|n| Split::HeldOut.seeds(args.seed).take(n as usize));
    let count = args.data.len() as u64 + args.synth_heldout.map_or(0, u64::from);
    let progress = console.progress(count, "eval");
    for path in &args.data {
        let clip = Clip::open(path, &ClipOptions { fps: args.fps, ..ClipOptions::default() })?;
        let truth = GroundTruth::load(&clip.folder, &clip.indices)?;
        bench.judge(json!({ "path": path_json(path) }), &clip, truth.as_ref())?;
        progress.step();
    }
    for seed in seeds.into_iter().flatten() {
        let (width, height) = match (args.size, loaded.model.config().image_size) {
            (Some(size), _) => (size.width, size.height),
            (None, Some([width, height])) => (width, height),
            (None, None) => DRAWN,
        };
        let (clip, truth) = drawn(&Street::new(seed, Options { width, height, ..Options::default() })?);
        bench.judge(json!({ "seed": seed }), &clip, Some(&truth))?;
        progress.step();
    }
    drop(progress);
    loaded.model.blob().unchanged()?;
    let Bench { total, clips, .. } = bench;
    let Some(total) = total else { unreachable!("the parser asks for at least one clip") };
    let mut json = total.to_json();
    json["model"] = loaded.json();
    json["data"] = clips.into();
    let text = total.to_markdown();
    if let Some(folder) = folder {
        atomic::write(&folder.path().join("eval.json"), json_text(&json)?.as_bytes(), Overwrite::Yes)?;
        atomic::write(&folder.path().join("eval.md"), text.as_bytes(), Overwrite::Yes)?;
        folder.commit()?;
    }
    console.report(&json, &text)
}

/// A street as a clip in memory: what would be read back from the folder that `synth` writes.
fn drawn(street: &Street) -> (Clip, GroundTruth) {
    let options = street.options();
    let drawn = street.frames();
    let mut clip = Clip {
        frames: Vec::with_capacity(drawn.len()),
        indices: (0..drawn.len()).collect(),
        total: drawn.len(),
        intrinsics: drawn.first().map(|f| f.camera.k),
        poses: Some(drawn.iter().map(|f| f.camera.pose).collect()),
        folder: PathBuf::new(),
        notes: Vec::new(),
    };
    let mut truth = GroundTruth::default();
    for (i, frame) in drawn.into_iter().enumerate() {
        truth.frames.push(TruthFrame {
            width: options.width,
            height: options.height,
            dynamic: Some(frame.dynamic(DYNAMIC).iter().map(|&m| m != 0).collect()),
            depth: frame.depth,
            velocity: Some(frame.velocity),
        });
        let image = Rgb8::new(options.width, options.height, frame.rgb);
        clip.frames.push(Frame { image, time: frame.time, name: format!("{i:06}.png") });
    }
    (clip, truth)
}

/// What all clips share, and what was found so far.
struct Bench<'a> {
    args: &'a Args,
    loaded: &'a Loaded,
    renderer: Renderer,
    /// Of the last clip's shape: the model's, and the one without causal attention.
    sessions: Vec<Session>,
    total: Option<EvalReport>,
    clips: Vec<Value>,
}

impl Bench<'_> {
    /// Measures one clip and counts it; `entry` says which clip it is.
    fn judge(&mut self, mut entry: Value, clip: &Clip, truth: Option<&GroundTruth>) -> Result<()> {
        let config = self.loaded.model.config();
        let protocol = Protocol::storm20(clip.total)?;
        let target_poses = match self.args.target_poses {
            Poses::Predicted => TargetPoses::Predicted,
            Poses::AlignedTruth => TargetPoses::AlignedTruth,
        };
        let options = EvalOptions { target_poses, ..EvalOptions::new(protocol) };
        let context = reconstruct::context_clip(clip, &options.protocol);
        let size = reconstruct::network_size(config, &context, self.args.size);
        let prepared = reconstruct::prepare_clip(config, &context, None, size)?;
        self.make_sessions(&prepared)?;
        entry["size"] = json!([size.0, size.1]);
        let pairs = EvalClip::new(clip, truth);
        let mut report = None;
        for (session, method) in self.sessions.iter_mut().zip([Method::Model, Method::NoCausal]) {
            let config = session.model().config().clone();
            let start = Instant::now();
            session.run(&prepared.input())?;
            if method == Method::Model {
                entry["run_ms"] = json!(start.elapsed().as_secs_f64() * 1e3);
            }
            let out = session.output();
            let scene = out.to_scene(&config, &reconstruct::sources(&context));
            let sky = reconstruct::sky(&config, out);
            let subject = Subject { scene: &scene, depth: Some(&out.depth), sky: sky.as_deref() };
            match &mut report {
                None => {
                    let mut first = evaluate_subject(&pairs, &subject, &mut self.renderer, &options)?;
                    if self.args.ablations && config.has_motion() {
                        let by = (&mut self.renderer, &options);
                        measure(&mut first, Method::ForwardOnly, &pairs, &(&scene).into(), by)?;
                    }
                    report = Some(first);
                }
                Some(report) => measure(report, method, &pairs, &subject, (&mut self.renderer, &options))?,
            }
        }
        let Some(mut report) = report else { unreachable!("the model's own session is always there") };
        if let Some(oracle) = oracle(clip, truth, &options.protocol, config)? {
            let by = (&mut self.renderer, &options);
            measure(&mut report, Method::Oracle, &pairs, &(&oracle).into(), by)?;
            let by = (&mut self.renderer, &options);
            measure(&mut report, Method::OracleNoMotion, &pairs, &(&standing(&oracle)).into(), by)?;
        }
        entry["scores"] = report.to_json();
        self.clips.push(entry);
        match &mut self.total {
            Some(total) => total.merge(&report)?,
            None => self.total = Some(report),
        }
        Ok(())
    }

    /// Sessions for clips of this shape; those of the last clip where it had the same.
    fn make_sessions(&mut self, prepared: &streetforward::Prepared) -> Result<()> {
        if self.sessions.first().is_some_and(|s| s.plan().shape() == prepared.shape) {
            return Ok(());
        }
        let model = &self.loaded.model;
        let mut models = vec![Arc::clone(model)];
        let config = model.config();
        if self.args.ablations && config.has_motion() {
            models.push(Arc::new(model.with_config(ModelConfig { mask_k: 0, mask_self: true, ..config.clone() })?));
        }
        self.sessions.clear();
        for model in models {
            self.sessions.push(reconstruct::session_of(&model, prepared.shape, &self.args.engine)?);
        }
        Ok(())
    }
}

/// The true scene under the model's rules; none where the clip lacks depth, poses or intrinsics.
fn oracle(
    clip: &Clip,
    truth: Option<&GroundTruth>,
    protocol: &Protocol,
    config: &ModelConfig,
) -> Result<Option<Scene>> {
    let (Some(truth), Some(_), Some(_)) = (truth, &clip.poses, clip.intrinsics) else { return Ok(None) };
    let (compose, splat) = (Compose::of(config), SplatSettings::of(config));
    let options = OracleOptions { compose, splat, ..OracleOptions::default() };
    oracle_of_clip(clip, truth, &protocol.context, &options).map(Some)
}
