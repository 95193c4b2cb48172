//! Contact sheet of ten streets: frames 0 and 10, depth, speed, one row a seed; or one picture of one seed.
//!
//! `cargo run --release -p sf-synth --example contact_sheet -- sheet.png [first-seed [WxH]]`
//! `cargo run --release -p sf-synth --example contact_sheet -- single.png SEED WxH FRAME`
#![deny(unsafe_code)]

use sf_formats::atomic::Overwrite;
use sf_formats::image_io::{Rgb8, write_png};
use sf_synth::{FAR, Frame, Options, Street};
use std::path::Path;

/// Rows of the sheet.
const ROWS: u64 = 10;

fn size(text: &str) -> Option<(u32, u32)> {
    let (w, h) = text.split_once('x')?;
    Some((w.parse().ok()?, h.parse().ok()?))
}

/// Near is dark, as is common for depth; no surface is white.
fn depth_gray(frame: &Frame) -> Vec<u8> {
    let level = |&z: &f32| if z == 0.0 { 255 } else { (250.0 * (z / FAR).sqrt()) as u8 };
    frame.depth.iter().map(level).flat_map(|v| [v; 3]).collect()
}

/// 15 m/s is white.
fn speed_gray(frame: &Frame) -> Vec<u8> {
    let level = |v: &[f32; 3]| (17.0 * (v[0] * v[0] + v[1] * v[1] + v[2] * v[2]).sqrt()).min(255.0) as u8;
    frame.velocity.iter().map(level).flat_map(|v| [v; 3]).collect()
}

fn main() -> Result<(), Box<dyn std::error::Error>> {
    let args: Vec<String> = std::env::args().skip(1).collect();
    let usage = "usage: contact_sheet OUT.png [SEED [WxH [FRAME]]]";
    let out = Path::new(args.first().ok_or(usage)?);
    let first: u64 = args.get(1).map_or(Ok(0), |s| s.parse())?;
    let (width, height) = args.get(2).map_or(Some((252, 168)), |s| size(s)).ok_or(usage)?;
    let options = Options { width, height, ..Options::default() };
    if let Some(frame) = args.get(3) {
        let frame = Street::new(first, options)?.frame(frame.parse()?);
        write_png(out, &Rgb8::new(width, height, frame.rgb), Overwrite::Yes)?;
        return Ok(());
    }
    let row_bytes = 3 * width as usize;
    let mut sheet = Vec::new();
    for seed in first..first + ROWS {
        let street = Street::new(seed, options.clone())?;
        let (a, b) = (street.frame(0), street.frame(10));
        let tiles = [a.rgb.clone(), b.rgb, depth_gray(&a), speed_gray(&a)];
        for y in 0..height as usize {
            tiles.iter().for_each(|t| sheet.extend(&t[y * row_bytes..(y + 1) * row_bytes]));
        }
    }
    write_png(out, &Rgb8::new(4 * width, ROWS as u32 * height, sheet), Overwrite::Yes)?;
    Ok(())
}
