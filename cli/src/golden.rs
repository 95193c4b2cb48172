//! The golden run: a small seeded clip through the network. Its digest goes into the blob when it is written, and
//! `verify --run` repeats it on another machine.

use crate::reconstruct::output_digest;
use sf_formats::digest::{Digest, hex};
use sf_formats::error::escape_path;
use sf_formats::{Error, Result};
use std::sync::Arc;
use streetforward::{ClipShape, Input, Model, Options, Session};

/// Runs a clip of three frames, 4x3 patches each, on one and on two threads; the digest of the predictions.
pub(crate) fn run(model: &Arc<Model>) -> Result<Digest> {
    let patch = model.config().patch as usize;
    let shape = ClipShape { frames: 3, height: 3 * patch, width: 4 * patch };
    // Smooth pictures that differ from frame to frame; integer arithmetic, so equal everywhere.
    let pixel = |i: usize| {
        let (c, x, y) = (i % 3, i / 3 % shape.width, i / (3 * shape.width));
        ((x * (5 + c) + y * (3 + 2 * c) + x * y / 7) % 256) as u8
    };
    let images: Vec<u8> = (0..shape.frames * shape.height * shape.width * 3).map(pixel).collect();
    let input = Input { shape, images: &images, times: &[0.0, 0.1, 0.25], k: None };
    let on = |threads: usize| -> Result<Digest> {
        let mut session = Session::new(Arc::clone(model), shape, Options { threads, ..Options::default() })?;
        Ok(output_digest(session.run(&input)?))
    };
    let (one, two) = (on(1)?, on(2)?);
    if one != two {
        let place = model.blob().path().map_or_else(|| "blob".into(), escape_path);
        let why = format!("one thread gives {}, two give {}: this machine computes wrongly", hex(&one), hex(&two));
        return Err(Error::integrity(place, why));
    }
    Ok(one)
}
