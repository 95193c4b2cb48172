//! Clip and model to network output: what `run`, `eval` and `demo` share.

use crate::args::{EngineArgs, Size};
use crate::model::Loaded;
use serde_json::{Value, json};
use sf_eval::Protocol;
use sf_formats::clip::Clip;
use sf_formats::digest::{Digest, sha256};
use sf_formats::{Intrinsics, ModelConfig, Result};
use std::sync::Arc;
use streetforward::preprocess::{DEFAULT_PIXELS, fit_size, prepare};
use streetforward::{ClipShape, FrameSource, Model, Options, Output, Prepared, Session, SourceFrame};

/// The frames that the protocol gives to the model.
pub(crate) fn context_clip(clip: &Clip, protocol: &Protocol) -> Clip {
    let pick = |i: &usize| clip.frames[*i].clone();
    Clip {
        frames: protocol.context.iter().map(pick).collect(),
        indices: protocol.context.iter().map(|&i| clip.indices[i]).collect(),
        total: clip.total,
        intrinsics: clip.intrinsics,
        poses: clip.poses.as_ref().map(|p| protocol.context.iter().map(|&i| p[i]).collect()),
        folder: clip.folder.clone(),
        notes: Vec::new(),
    }
}

/// Size at which a network sees a clip: as asked; or of as many pixels as it was trained with; or that of its
/// pictures in whole patches, shrunk to the pixels its position table was made for (and Pi3's limit).
pub(crate) fn network_size(config: &ModelConfig, clip: &Clip, asked: Option<Size>) -> (u32, u32) {
    size_for(config, clip.frames[0].image.size(), asked)
}

/// [`network_size`] for pictures of `w` x `h`.
pub(crate) fn size_for(config: &ModelConfig, (w, h): (u32, u32), asked: Option<Size>) -> (u32, u32) {
    if let Some(size) = asked {
        return (size.width, size.height);
    }
    if let Some([tw, th]) = config.image_size {
        return fit_size(w, h, config.patch, u64::from(tw) * u64::from(th));
    }
    let table = u64::from(config.pos_grid * config.patch).pow(2);
    fit_size(w, h, config.patch, table.min(DEFAULT_PIXELS).min(u64::from(w) * u64::from(h)))
}

/// A clip at the network's size. `k`: intrinsics at the size of the first picture, which override the
/// predicted ones.
pub(crate) fn prepare_clip(
    config: &ModelConfig,
    clip: &Clip,
    k: Option<Intrinsics>,
    size: (u32, u32),
) -> Result<Prepared> {
    let frames: Vec<SourceFrame> = clip
        .frames
        .iter()
        .map(|f| SourceFrame { name: &f.name, width: f.image.width, height: f.image.height, rgb: &f.image.data })
        .collect();
    prepare(config, &frames, &clip.times(), k, size)
}

/// A session for clips of one shape.
pub(crate) fn session(loaded: &Loaded, shape: ClipShape, engine: &EngineArgs) -> Result<Session> {
    session_of(&loaded.model, shape, engine)
}

/// A session of a model for clips of one shape.
pub(crate) fn session_of(model: &Arc<Model>, shape: ClipShape, engine: &EngineArgs) -> Result<Session> {
    let mut options = Options { threads: crate::args::threads(engine.threads), isa: engine.isa, ..Options::default() };
    if let Some(bytes) = engine.max_mem {
        options.max_bytes = bytes;
    }
    Session::new(Arc::clone(model), shape, options)
}

/// Names and sizes of a clip's pictures, for a scene.
pub(crate) fn sources(clip: &Clip) -> Vec<FrameSource> {
    clip.frames.iter().map(|f| FrameSource { name: f.name.clone(), size: f.image.size() }).collect()
}

/// Which pixels of the context frames a network takes for sky; none where it has no confidence.
pub(crate) fn sky(config: &ModelConfig, out: &Output) -> Option<Vec<bool>> {
    let least = config.sky_conf as f32;
    config.has_conf().then(|| out.conf.iter().map(|&c| sf_ops::activation::sigmoid(c) < least).collect())
}

/// What a session is and did, for reports.
pub(crate) fn session_json(session: &Session) -> Value {
    let stages = session.stage_times().map(|s| json!({ "name": s.name, "ms": s.time.as_secs_f64() * 1e3 }));
    json!({
        "threads": session.threads(),
        "isa": session.kernels().isa.name(),
        "arena_bytes": session.plan().arena_bytes(),
        "output_bytes": session.plan().output_bytes(),
        "stages": stages.collect::<Value>(),
    })
}

/// SHA-256 over everything a run predicts: equal on every CPU and for any number of threads.
pub(crate) fn output_digest(out: &Output) -> Digest {
    let mut all = Vec::new();
    let mut add = |values: &mut dyn Iterator<Item = f32>| {
        let bytes: Vec<u8> = values.flat_map(f32::to_le_bytes).collect();
        all.extend(sha256(&bytes));
    };
    for list in [&out.points, &out.mean, &out.scale, &out.colour, &out.v_fwd, &out.v_bwd] {
        add(&mut list.as_flattened().iter().copied());
    }
    add(&mut out.quat.as_flattened().iter().copied());
    for list in [&out.depth, &out.conf, &out.opacity, &out.dynamic] {
        add(&mut list.iter().copied());
    }
    let cameras = (0..out.poses.len()).flat_map(|f| {
        let k = out.k[f];
        let rows = out.poses[f].to_rows();
        [k.fx, k.fy, k.cx, k.cy].into_iter().chain(rows.into_iter().flatten())
    });
    all.extend(sha256(&cameras.flat_map(f64::to_le_bytes).collect::<Vec<u8>>()));
    sha256(&all)
}
