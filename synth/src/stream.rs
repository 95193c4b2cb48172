//! Many clips as one binary stream, for a trainer at the other end of a pipe.
//!
//! Little-endian records without gaps, one per clip, in the order of the seeds:
//!
//! | bytes | what |
//! |---|---|
//! | 8 | magic `SFSYNTH1` |
//! | 8 | u64 seed |
//! | 4 | u32 bytes after this 64-byte header |
//! | 4, 4, 4 | u32 frames F, width W, height H |
//! | 8 x 4 | f64 fx, fy, cx, cy in pixels, pixel centres at +0.5 |
//! | 8 F | f64 times, seconds |
//! | 128 F | f64 [F, 4, 4] camera-to-world, OpenCV axes, world = first camera |
//! | 3 F H W | u8 [F, H, W, 3] colour |
//! | 2 F H W | f16 [F, H, W] z-depth, metres; 0 = no surface |
//! | 2 F H W | u16 [F, H, W] object numbers: 0 sky, 1 ground |
//! | 6 F H W | f16 [F, H, W, 3] velocity, world axes, m/s |

use crate::street::{Frame, Options, Street};
use half::f16;
use rayon::prelude::*;
use sf_formats::{Error, Result};
use std::io::Write;
use std::path::Path;

/// First bytes of every record.
pub const MAGIC: [u8; 8] = *b"SFSYNTH1";
/// Bytes of a record's header.
pub const HEADER: usize = 64;
/// Largest record; its length must fit 32 bits.
const MAX_RECORD: u64 = 1 << 31;

/// Renders the clips of `seeds` on all threads and writes them in order; returns how many. The bytes do not
/// depend on the number of threads.
///
/// `options` gives every seed its size, timing and style.
pub fn stream<W: Write>(
    seeds: impl IntoIterator<Item = u64>,
    options: impl Fn(u64) -> Options + Sync,
    out: &mut W,
) -> Result<u64> {
    let mut seeds = seeds.into_iter();
    let mut count = 0;
    loop {
        // A few clips a thread bound the memory and keep all threads busy while one clip is slow.
        let batch: Vec<u64> = seeds.by_ref().take(4 * rayon::current_num_threads()).collect();
        if batch.is_empty() {
            break;
        }
        let records: Vec<Vec<u8>> =
            batch.par_iter().map(|&seed| record(&Street::new(seed, options(seed))?)).collect::<Result<_>>()?;
        for bytes in &records {
            out.write_all(bytes).map_err(|e| Error::io(Path::new("stream"), "write", &e))?;
            count += 1;
        }
    }
    out.flush().map_err(|e| Error::io(Path::new("stream"), "write", &e))?;
    Ok(count)
}

/// One clip as bytes.
fn record(street: &Street) -> Result<Vec<u8>> {
    let o = street.options();
    let pixels = u64::from(o.width) * u64::from(o.height);
    let payload = o.frames as u64 * (8 + 128 + 13 * pixels);
    if payload > MAX_RECORD {
        return Err(Error::usage(format!(
            "a clip of {payload} bytes is over {MAX_RECORD}: use fewer or smaller frames"
        )));
    }
    let frames: Vec<Frame> = (0..o.frames).map(|i| street.frame(i)).collect();
    let mut out = Vec::with_capacity(HEADER + payload as usize);
    out.extend(MAGIC);
    out.extend(street.seed().to_le_bytes());
    for v in [payload as u32, o.frames as u32, o.width, o.height] {
        out.extend(v.to_le_bytes());
    }
    let k = street.intrinsics();
    for v in [k.fx, k.fy, k.cx, k.cy] {
        out.extend(v.to_le_bytes());
    }
    frames.iter().for_each(|f| out.extend(f.time.to_le_bytes()));
    for f in &frames {
        f.camera.pose.to_rows().as_flattened().iter().for_each(|v| out.extend(v.to_le_bytes()));
    }
    frames.iter().for_each(|f| out.extend(&f.rgb));
    for f in &frames {
        f.depth.iter().for_each(|&d| out.extend(f16::from_f32(d).to_le_bytes()));
    }
    for f in &frames {
        f.id.iter().for_each(|&i| out.extend(i.to_le_bytes()));
    }
    for f in &frames {
        f.velocity.as_flattened().iter().for_each(|&v| out.extend(f16::from_f32(v).to_le_bytes()));
    }
    debug_assert_eq!(out.len() as u64, HEADER as u64 + payload);
    Ok(out)
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Reads the documented layout back with nothing but offsets.
    #[test]
    fn records_have_the_documented_layout() {
        let options = |seed: u64| Options { frames: 2 + seed as usize, width: 42, height: 28, ..Options::default() };
        let mut bytes = Vec::new();
        assert_eq!(stream([0, 1], options, &mut bytes).unwrap(), 2);
        let mut rest = &bytes[..];
        for seed in 0..2u64 {
            let u32_at = |i: usize| u32::from_le_bytes(rest[i..i + 4].try_into().unwrap()) as usize;
            let f64_at = |i: usize| f64::from_le_bytes(rest[i..i + 8].try_into().unwrap());
            let f16_at = |i: usize| f16::from_le_bytes(rest[i..i + 2].try_into().unwrap()).to_f32();
            assert_eq!(rest[..8], MAGIC);
            assert_eq!(u64::from_le_bytes(rest[8..16].try_into().unwrap()), seed);
            let (payload, f, w, h) = (u32_at(16), u32_at(20), u32_at(24), u32_at(28));
            assert_eq!((f, w, h), (2 + seed as usize, 42, 28));
            let street = Street::new(seed, options(seed)).unwrap();
            assert_eq!(f64_at(32), street.intrinsics().fx);
            let frame = street.frame(1);
            assert_eq!(f64_at(HEADER + 8), frame.time);
            let poses = HEADER + 8 * f;
            assert_eq!(f64_at(poses + 128 + 8 * 3), frame.camera.pose.t.x);
            let rgb = poses + 128 * f;
            let n = w * h;
            assert_eq!(rest[rgb + 3 * n..rgb + 6 * n], frame.rgb);
            let (depth, id) = (rgb + 3 * n * f, rgb + 5 * n * f);
            let velocity = id + 2 * n * f;
            for i in 0..n {
                assert_eq!(f16_at(depth + 2 * (n + i)), f16::from_f32(frame.depth[i]).to_f32());
                assert_eq!(u16::from_le_bytes([rest[id + 2 * (n + i)], rest[id + 2 * (n + i) + 1]]), frame.id[i]);
                assert!((f16_at(velocity + 6 * (n + i)) - frame.velocity[i][0]).abs() <= 0.01);
            }
            assert_eq!(HEADER + payload, velocity + 6 * n * f);
            rest = &rest[HEADER + payload..];
        }
        assert!(rest.is_empty());
    }
}
