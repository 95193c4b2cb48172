//! A clip as a folder: pictures, `transforms.json`, depth, velocity and dynamic masks.

use crate::street::{DYNAMIC, Street};
use rayon::prelude::*;
use sf_formats::Result;
use sf_formats::atomic::Overwrite;
use sf_formats::clip::{ClipFrame, ClipWriter, TruthFrame};
use sf_formats::image_io::Rgb8;
use std::path::Path;

/// Writes all frames of a street with their ground truth (layout: [`sf_formats::clip`]). Pixels faster than
/// [`DYNAMIC`] are marked in the masks. `transforms.json` comes last, so a folder that has it is complete.
pub fn write_clip(street: &Street, folder: &Path, overwrite: Overwrite) -> Result<()> {
    let writer = ClipWriter::create(folder, overwrite)?;
    let options = street.options();
    (0..options.frames).into_par_iter().try_for_each(|i| {
        let frame = street.frame(i);
        let truth = TruthFrame {
            width: options.width,
            height: options.height,
            dynamic: Some(frame.dynamic(DYNAMIC).iter().map(|&m| m != 0).collect()),
            depth: frame.depth,
            velocity: Some(frame.velocity),
        };
        let image = Rgb8::new(options.width, options.height, frame.rgb);
        writer.frame(i, &ClipFrame { image: &image, camera: frame.camera, time: frame.time, truth: Some(&truth) })
    })?;
    writer.finish()
}
