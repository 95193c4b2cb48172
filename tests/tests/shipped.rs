//! What ships in `models/` is what the programs make.

use sf_formats::clip::{Clip, ClipOptions};
use sf_synth::{Options, Split, Street};
use std::path::Path;

/// Seed of the demonstration street.
const SEED: u64 = 7;

#[test]
fn the_demonstration_clip_is_the_drawn_street() {
    let folder = Path::new(env!("CARGO_MANIFEST_DIR")).join("../models/demo-clip");
    let clip = Clip::open(&folder, &ClipOptions::default()).unwrap();
    let street = Street::new(SEED, Options::default()).unwrap();
    let frames = street.frames();
    assert_eq!(clip.frames.len(), 20);
    assert_eq!(clip.frames.len(), frames.len());
    let poses = clip.poses.as_ref().unwrap();
    for (i, (shipped, drawn)) in clip.frames.iter().zip(&frames).enumerate() {
        assert!(shipped.image.data == drawn.rgb, "frame {i} differs");
        assert_eq!(shipped.time, drawn.time);
        let off = (poses[i].t - drawn.camera.pose.t).length();
        assert!(off < 1e-9, "camera of frame {i} is {off} off");
    }
}

#[test]
fn the_demonstration_seed_is_held_out() {
    assert_eq!(Split::HeldOut.seeds(SEED).next(), Some(SEED));
}
