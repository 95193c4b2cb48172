//! Animated PNG: lossless animation that browsers and code hosting sites play.

use crate::error::{Error, Result};
use crate::image_io::Rgb8;
use png::{BitDepth, ColorType, Compression, Encoder, Writer};
use std::collections::HashMap;
use std::io::Write;

/// Writes an animation frame by frame; it repeats for ever.
pub struct Apng<W: Write> {
    writer: Writer<W>,
    size: (u32, u32),
    palette: Option<Palette>,
}

impl<W: Write> Apng<W> {
    /// Starts an animation of `frames` pictures of one size. With a palette the colours are the nearest of it,
    /// at a third of the bytes.
    pub fn new(to: W, size: (u32, u32), frames: usize, fps: f64, palette: Option<Palette>) -> Result<Apng<W>> {
        let frames = u32::try_from(frames).ok().filter(|n| *n > 0);
        let frames = frames.ok_or_else(|| Error::input("animation", "needs at least one picture"))?;
        let mut encoder = Encoder::new(to, size.0, size.1);
        encoder.set_depth(BitDepth::Eight);
        encoder.set_compression(Compression::High);
        encoder.set_color(if palette.is_some() { ColorType::Indexed } else { ColorType::Rgb });
        if let Some(p) = &palette {
            encoder.set_palette(p.colours.as_flattened().to_vec());
        }
        encoder.set_animated(frames, 0).map_err(fault)?;
        // Milliseconds; at least one, at most what 16 bits hold.
        let delay = (1000.0 / fps).round().clamp(1.0, 65535.0) as u16;
        encoder.set_frame_delay(delay, 1000).map_err(fault)?;
        Ok(Apng { writer: encoder.write_header().map_err(fault)?, size, palette })
    }

    /// Appends a picture. Panics on another size.
    pub fn frame(&mut self, image: &Rgb8) -> Result<()> {
        assert_eq!(image.size(), self.size, "all pictures of an animation have one size");
        match &mut self.palette {
            None => self.writer.write_image_data(&image.data),
            Some(p) => {
                let indices: Vec<u8> = image.data.as_chunks().0.iter().map(|&c| p.nearest(c)).collect();
                self.writer.write_image_data(&indices)
            }
        }
        .map_err(fault)
    }

    /// Ends the file.
    pub fn finish(self) -> Result<()> {
        self.writer.finish().map_err(fault)
    }
}

fn fault(e: png::EncodingError) -> Error {
    Error::Io { at: "animation".into(), why: format!("cannot write: {e}") }
}

/// Up to 256 colours that stand for those of some pictures: median cut.
#[derive(Clone, Debug)]
pub struct Palette {
    colours: Vec<[u8; 3]>,
    known: HashMap<[u8; 3], u8>,
}

impl Palette {
    /// Colours for pictures. `count`: 2 to 256.
    pub fn of<'a>(pictures: impl IntoIterator<Item = &'a Rgb8>, count: usize) -> Palette {
        // Colours in steps of 4 with their sums, which loses nothing that 256 colours could show.
        let mut cells: HashMap<[u8; 3], (u64, [u64; 3])> = HashMap::new();
        for image in pictures {
            for p in image.data.as_chunks::<3>().0 {
                let cell = cells.entry(p.map(|v| v >> 2)).or_default();
                cell.0 += 1;
                (0..3).for_each(|c| cell.1[c] += u64::from(p[c]));
            }
        }
        let mut all: Vec<([u8; 3], u64, [u64; 3])> = cells.into_iter().map(|(k, v)| (k, v.0, v.1)).collect();
        // The map's order is not the same twice.
        all.sort_unstable();
        let mut boxes = vec![all];
        while boxes.len() < count.clamp(2, 256) {
            // The box whose split gains most: pixels times the square of its longest side.
            let gain = |b: &Vec<([u8; 3], u64, [u64; 3])>| {
                let pixels: u64 = b.iter().map(|c| c.1).sum();
                pixels * u64::from(longest(b).1).pow(2)
            };
            let Some((i, g)) = boxes.iter().map(gain).enumerate().max_by_key(|&(i, g)| (g, usize::MAX - i)) else {
                break;
            };
            if g == 0 {
                break;
            }
            let mut part = boxes.swap_remove(i);
            let axis = longest(&part).0;
            part.sort_unstable_by_key(|c| (c.0[axis], c.0));
            let half = part.iter().map(|c| c.1).sum::<u64>() / 2;
            let mut before = 0;
            let cut = part.iter().position(|c| {
                before += c.1;
                before > half
            });
            // Both halves keep something.
            let cut = cut.unwrap_or(0).clamp(1, part.len() - 1);
            let rest = part.split_off(cut);
            boxes.push(part);
            boxes.push(rest);
        }
        let mean = |b: &Vec<([u8; 3], u64, [u64; 3])>| {
            let n: u64 = b.iter().map(|c| c.1).sum::<u64>().max(1);
            std::array::from_fn(|a| ((b.iter().map(|c| c.2[a]).sum::<u64>() + n / 2) / n) as u8)
        };
        Palette { colours: boxes.iter().map(mean).collect(), known: HashMap::new() }
    }

    fn nearest(&mut self, colour: [u8; 3]) -> u8 {
        let colours = &self.colours;
        *self.known.entry(colour).or_insert_with(|| {
            let distance = |c: &[u8; 3]| (0..3).map(|a| (i32::from(c[a]) - i32::from(colour[a])).pow(2)).sum::<i32>();
            (0..colours.len()).min_by_key(|&i| distance(&colours[i])).unwrap_or(0) as u8
        })
    }
}

/// Axis and length of a box's longest side.
fn longest(part: &[([u8; 3], u64, [u64; 3])]) -> (usize, u8) {
    let side = |a: usize| {
        let values = part.iter().map(|c| c.0[a]);
        values.clone().max().unwrap_or(0) - values.min().unwrap_or(0)
    };
    (0..3).map(|a| (a, side(a))).max_by_key(|s| s.1).unwrap_or((0, 0))
}

#[cfg(test)]
mod tests {
    use super::*;
    use png::Decoder;
    use std::io::Cursor;

    fn pictures() -> Vec<Rgb8> {
        let at = |f: usize| (0..3 * 6 * 4).map(|i| (i * 3 + 40 * f) as u8).collect();
        (0..3).map(|f| Rgb8::new(6, 4, at(f))).collect()
    }

    /// The frames of a file, as RGB.
    fn frames(bytes: Vec<u8>) -> (Vec<Vec<u8>>, u16) {
        let mut decoder = Decoder::new(Cursor::new(bytes));
        decoder.set_transformations(png::Transformations::EXPAND);
        let mut reader = decoder.read_info().unwrap();
        let n = reader.info().animation_control().unwrap().num_frames;
        let mut out = Vec::new();
        for _ in 0..n {
            let mut data = vec![0; reader.output_buffer_size().unwrap()];
            reader.next_frame(&mut data).unwrap();
            out.push(data);
        }
        (out, reader.info().frame_control().unwrap().delay_num)
    }

    #[test]
    fn an_animation_holds_every_picture() {
        let (pictures, mut bytes) = (pictures(), Vec::new());
        let mut a = Apng::new(&mut bytes, (6, 4), 3, 8.0, None).unwrap();
        pictures.iter().try_for_each(|p| a.frame(p)).unwrap();
        a.finish().unwrap();
        let (got, delay) = frames(bytes);
        assert_eq!(delay, 125);
        assert_eq!(got, pictures.iter().map(|p| p.data.clone()).collect::<Vec<_>>());
        assert!(Apng::new(Vec::new(), (6, 4), 0, 8.0, None).is_err());
    }

    #[test]
    fn few_colours_are_kept_and_many_become_near_ones() {
        let flat = Rgb8::new(2, 2, [[10, 20, 30], [200, 0, 0], [0, 200, 0], [10, 20, 30]].concat());
        let mut p = Palette::of([&flat], 256);
        assert_eq!(p.colours.len(), 3);
        for c in flat.data.as_chunks().0 {
            let i = p.nearest(*c);
            assert_eq!(p.colours[i as usize], *c);
        }
        let pictures = pictures();
        let palette = Palette::of(&pictures, 24);
        assert!(palette.colours.len() <= 24);
        let mut bytes = Vec::new();
        let mut a = Apng::new(&mut bytes, (6, 4), 3, 8.0, Some(palette)).unwrap();
        pictures.iter().try_for_each(|p| a.frame(p)).unwrap();
        a.finish().unwrap();
        for (got, want) in frames(bytes).0.iter().zip(&pictures) {
            let off = got.iter().zip(&want.data).map(|(a, b)| a.abs_diff(*b)).max().unwrap();
            assert!(off < 40, "{off}");
        }
    }
}
