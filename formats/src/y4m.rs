//! YUV4MPEG2: uncompressed video that every encoder reads, to a file or a pipe.
//!
//! 8-bit 4:2:0 with chroma in the middle of its four pixels (`C420jpeg`), BT.601 matrix, limited range (16..235).

use crate::image_io::Rgb8;
use std::io::{self, Write};

/// Frames per second as a fraction of whole numbers: exact for whole rates, else thousandths.
pub fn rate(fps: f64) -> (u32, u32) {
    let whole = fps.round();
    if (fps - whole).abs() < 1e-6 && whole >= 1.0 {
        (whole as u32, 1)
    } else {
        ((fps * 1000.0).round().max(1.0) as u32, 1000)
    }
}

/// Writes a video frame by frame.
pub struct Y4m<W: Write> {
    to: W,
    size: (u32, u32),
    planes: Vec<u8>,
}

impl<W: Write> Y4m<W> {
    /// Starts a video of pictures of one size.
    pub fn new(mut to: W, size: (u32, u32), fps: f64) -> io::Result<Y4m<W>> {
        let (n, d) = rate(fps);
        let (w, h) = size;
        writeln!(to, "YUV4MPEG2 W{w} H{h} F{n}:{d} Ip A1:1 C420jpeg XCOLORRANGE=LIMITED")?;
        Ok(Y4m { to, size, planes: Vec::new() })
    }

    /// Appends a picture. Panics on another size.
    pub fn frame(&mut self, image: &Rgb8) -> io::Result<()> {
        assert_eq!(image.size(), self.size, "all pictures of a video have one size");
        self.planes.clear();
        yuv420(image, &mut self.planes);
        self.to.write_all(b"FRAME\n")?;
        self.to.write_all(&self.planes)
    }

    /// Flushes and gives the writer back.
    pub fn finish(mut self) -> io::Result<W> {
        self.to.flush()?;
        Ok(self.to)
    }
}

/// Appends the planes Y, Cb, Cr; a chroma value is that of the mean of up to four pixels.
pub fn yuv420(image: &Rgb8, out: &mut Vec<u8>) {
    let (w, h) = (image.width as usize, image.height as usize);
    let luma =
        |p: &[u8]| 16.0 + (65.481 * f32::from(p[0]) + 128.553 * f32::from(p[1]) + 24.966 * f32::from(p[2])) / 255.0;
    out.extend(image.data.chunks_exact(3).map(|p| luma(p).round() as u8));
    let mut chroma =
        [Vec::with_capacity(w.div_ceil(2) * h.div_ceil(2)), Vec::with_capacity(w.div_ceil(2) * h.div_ceil(2))];
    for y in (0..h).step_by(2) {
        for x in (0..w).step_by(2) {
            let (mut sum, mut n) = ([0.0f32; 3], 0.0);
            for row in y..(y + 2).min(h) {
                for column in x..(x + 2).min(w) {
                    (0..3).for_each(|c| sum[c] += f32::from(image.data[3 * (row * w + column) + c]));
                    n += 255.0;
                }
            }
            let [r, g, b] = sum.map(|s| s / n);
            chroma[0].push((128.0 - 37.797 * r - 74.203 * g + 112.0 * b).round() as u8);
            chroma[1].push((128.0 + 112.0 * r - 93.786 * g - 18.214 * b).round() as u8);
        }
    }
    chroma.iter().for_each(|c| out.extend(c));
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn colours_become_their_known_bytes() {
        // BT.601 limited range: black, white, and the primaries.
        for (rgb, yuv) in [
            ([0, 0, 0], [16, 128, 128]),
            ([255, 255, 255], [235, 128, 128]),
            ([255, 0, 0], [81, 90, 240]),
            ([0, 255, 0], [145, 54, 34]),
            ([0, 0, 255], [41, 240, 110]),
        ] {
            let mut out = Vec::new();
            yuv420(&Rgb8::new(1, 1, rgb.to_vec()), &mut out);
            assert_eq!(out, yuv, "{rgb:?}");
        }
    }

    #[test]
    fn a_video_has_its_header_and_whole_frames_of_odd_sizes() {
        let image = Rgb8::new(3, 3, (0..27).map(|i| 9 * i as u8).collect());
        let mut video = Y4m::new(Vec::new(), (3, 3), 12.5).unwrap();
        video.frame(&image).unwrap();
        video.frame(&image).unwrap();
        let bytes = video.finish().unwrap();
        let header = b"YUV4MPEG2 W3 H3 F12500:1000 Ip A1:1 C420jpeg XCOLORRANGE=LIMITED\n";
        assert!(bytes.starts_with(header));
        assert_eq!(bytes.len(), header.len() + 2 * (6 + 9 + 2 * 4));
        assert_eq!(&bytes[header.len()..header.len() + 6], b"FRAME\n");
        assert_eq!((rate(10.0), rate(1.0 / 3.0)), ((10, 1), (333, 1000)));
    }
}
