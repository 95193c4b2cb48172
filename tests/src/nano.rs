//! The trained network that ships, in any precision, and streets that it has not seen.

use crate::tiny::Frames;
use sf_formats::blob::Blob;
use sf_formats::{Dtype, checkpoint};
use sf_quant::{Options, convert_to_bytes};
use sf_synth::{Split, Street};
use std::path::{Path, PathBuf};
use std::sync::Arc;
use streetforward::{ClipShape, Model};

/// The checkpoint in `models/nano`.
pub fn checkpoint_path() -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("../models/nano/nano.safetensors")
}

/// The checkpoint converted in memory, with the bytes of its blob.
pub fn converted(precision: Dtype) -> (Arc<Model>, Vec<u8>) {
    let source = checkpoint::open(&[checkpoint_path()]).unwrap();
    let bytes = convert_to_bytes(&*source, &Options::to(precision)).unwrap();
    (Arc::new(Model::from_blob(Blob::from_bytes(&bytes).unwrap()).unwrap()), bytes)
}

/// Seeds of the held-out split, from `first` on.
pub fn held_out(first: u64, count: usize) -> Vec<u64> {
    Split::HeldOut.seeds(first).take(count).collect()
}

/// Frames of a generated street, half a second apart as in training.
pub fn street(seed: u64, frames: usize, (width, height): (u32, u32)) -> Frames {
    let options = sf_synth::Options { width, height, frames, stride: 5, ..Default::default() };
    let drawn = Street::new(seed, options).unwrap().frames();
    Frames {
        shape: ClipShape { frames, height: height as usize, width: width as usize },
        times: drawn.iter().map(|f| f.time).collect(),
        images: drawn.into_iter().flat_map(|f| f.rgb).collect(),
    }
}
