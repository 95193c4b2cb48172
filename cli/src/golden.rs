//! The golden run: three small seeded clips through the network. The digest of what it predicts goes into the blob when
//! that is written, and `verify --run` repeats it on other machines, instruction sets and numbers of threads.
//!
//! | clip | frames | patches | pictures |
//! |---|---|---|---|
//! | waves | 3 | 4 x 3 | smooth, differ from frame to frame |
//! | noise | 2 | 5 x 2 | bytes without order: every value, steep edges |
//! | board | 1 | 3 x 4 | black and white squares; one frame, so no motion |

use crate::reconstruct::output_digest;
use sf_formats::digest::{Digest, hex, sha256};
use sf_formats::error::escape_path;
use sf_formats::{Error, Result};
use sf_ops::cpu::Isa;
use std::sync::Arc;
use streetforward::{ClipShape, Input, Model, Options, Session};

/// How often and on what the clips run.
#[derive(Clone, Debug)]
pub(crate) struct How {
    /// Numbers of threads; all must give one digest.
    pub(crate) threads: Vec<usize>,
    /// Runs in a row of every session.
    pub(crate) repeat: usize,
    /// Cap on the instruction set.
    pub(crate) isa: Option<Isa>,
}

impl Default for How {
    fn default() -> Self {
        How { threads: vec![1, 2], repeat: 1, isa: None }
    }
}

/// A clip: frames, patches across and down, the byte of a channel (0 to 2) of a pixel.
struct Golden {
    frames: usize,
    across: usize,
    down: usize,
    pixel: fn(frame: usize, x: usize, y: usize, channel: usize) -> u8,
}

/// Integer arithmetic throughout, so equal everywhere.
const CLIPS: [Golden; 3] = [
    Golden {
        frames: 3,
        across: 4,
        down: 3,
        pixel: |f, x, y, c| (((x + 11 * f) * (5 + c) + y * (3 + 2 * c) + x * y / 7) % 256) as u8,
    },
    Golden {
        frames: 2,
        across: 5,
        down: 2,
        pixel: |f, x, y, c| {
            let seed = (((f * 4096 + y) * 4096 + x) * 4 + c) as u64;
            (seed.wrapping_mul(0x9e37_79b9_7f4a_7c15) >> 40).wrapping_mul(0x85eb_ca6b) as u8
        },
    },
    Golden { frames: 1, across: 3, down: 4, pixel: |_, x, y, _| if (x / 5 + y / 5) % 2 == 0 { 0 } else { 255 } },
];

/// Runs the clips; the digest over the predictions of all of them.
///
/// # Errors
/// Status 9 when threads or repeats differ.
pub(crate) fn run(model: &Arc<Model>, how: &How) -> Result<Digest> {
    let digests: Vec<Digest> = CLIPS.iter().map(|clip| run_clip(model, clip, how)).collect::<Result<_>>()?;
    Ok(sha256(&digests.concat()))
}

fn run_clip(model: &Arc<Model>, clip: &Golden, how: &How) -> Result<Digest> {
    let patch = model.config().patch as usize;
    let shape = ClipShape { frames: clip.frames, height: clip.down * patch, width: clip.across * patch };
    let pixel = |i: usize| {
        let at = i / 3;
        let (x, y, f) = (at % shape.width, at / shape.width % shape.height, at / (shape.width * shape.height));
        (clip.pixel)(f, x, y, i % 3)
    };
    let images: Vec<u8> = (0..shape.frames * shape.height * shape.width * 3).map(pixel).collect();
    let times = [0.0, 0.1, 0.25];
    let input = Input { shape, images: &images, times: &times[..shape.frames], k: None };
    let mut first: Option<Digest> = None;
    for &threads in &how.threads {
        let options = Options { threads, isa: how.isa, ..Options::default() };
        let mut session = Session::new(Arc::clone(model), shape, options)?;
        for _ in 0..how.repeat {
            let digest = output_digest(session.run(&input)?);
            let want = *first.get_or_insert(digest);
            if digest != want {
                let place = model.blob().path().map_or_else(|| "blob".into(), escape_path);
                let (want, have) = (hex(&want), hex(&digest));
                let why = format!("{threads} threads give {have}, before it was {want}: this machine computes wrongly");
                return Err(Error::integrity(place, why));
            }
        }
    }
    first.ok_or_else(|| Error::usage("no thread or no repeat to run with"))
}

#[cfg(test)]
mod tests {
    use super::*;

    /// The pictures are what their names say, and stay so: stored digests depend on them.
    #[test]
    fn clips_are_fixed() {
        let bytes = |clip: &Golden| -> Vec<u8> {
            let size = (14 * clip.across, 14 * clip.down);
            let all = (0..clip.frames).flat_map(|f| (0..size.1).flat_map(move |y| (0..size.0).map(move |x| (f, y, x))));
            all.flat_map(|(f, y, x)| [0, 1, 2].map(|c| (clip.pixel)(f, x, y, c))).collect()
        };
        let all: Vec<Vec<u8>> = CLIPS.iter().map(bytes).collect();
        assert_eq!(all[0].len(), 3 * 56 * 42 * 3);
        let mut seen = [0u32; 256];
        all[1].iter().for_each(|&b| seen[usize::from(b)] += 1);
        // 11,760 bytes: 46 of each value, give or take four standard deviations.
        assert!(seen.iter().all(|n| (19..=73).contains(n)), "{seen:?}");
        assert!(all[2].iter().all(|b| [0, 255].contains(b)) && all[2][0] != all[2][15]);
        assert_eq!(hex(&sha256(&all.concat()))[..16], *"dea53a7052159a7d");
    }
}
