//! YUV4MPEG2: uncompressed video as it comes through a pipe (`ffmpeg -i drive.mp4 -f yuv4mpegpipe -`).
//!
//! A header line, then frames: `FRAME`, parameters that are ignored, a line end, the planes Y, Cb, Cr. 8-bit 4:2:0
//! and 4:4:4, progressive. Colours are BT.601, limited range unless the header says `XCOLORRANGE=FULL`; every chroma
//! sample of 4:2:0 serves its four pixels. Integer arithmetic: the same bytes on every machine.

use crate::clip::MIN_SIDE;
use crate::error::{Error, Result, escape};
use crate::image_io::{MAX_PIXELS, Rgb8};
use std::io::{self, BufRead, ErrorKind};

/// Longest header or frame line.
const LINE_CAP: usize = 1024;

/// Chroma planes of a stream.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Chroma {
    /// Half as wide and half as high, rounded up.
    C420,
    /// As large as the picture.
    C444,
}

/// What the header line says.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Y4mHeader {
    /// Pixels in a row.
    pub width: u32,
    /// Rows.
    pub height: u32,
    /// Frames per second, where the header knows.
    pub fps: Option<f64>,
    /// Chroma planes.
    pub chroma: Chroma,
    /// Values from 0 to 255 instead of 16 to 235 (240).
    pub full_range: bool,
}

impl Y4mHeader {
    /// Reads the header line without its line end; `at` names the stream in messages.
    pub fn parse(line: &[u8], at: &str) -> Result<Y4mHeader> {
        let wrong = |why: String| Error::input(at, format!("YUV4MPEG2 header: {why}"));
        let mut fields = line.split(|&b| b == b' ').filter(|f| !f.is_empty());
        if fields.next() != Some(b"YUV4MPEG2") {
            let start = escape(&line[..line.len().min(16)]);
            return Err(Error::input(at, format!("starts with '{start}', not with YUV4MPEG2: not such a stream")));
        }
        let (mut width, mut height, mut fps) = (None, None, None);
        let (mut chroma, mut full_range) = (Chroma::C420, false);
        for field in fields {
            let text = escape(field);
            let value = &text[1..];
            let side = || match value.parse::<u32>() {
                Ok(n) if n >= MIN_SIDE => Ok(Some(n)),
                _ => Err(wrong(format!("{text} must be a side of at least {MIN_SIDE} pixels"))),
            };
            match field[0] {
                b'W' => width = side()?,
                b'H' => height = side()?,
                b'F' => {
                    let parts = value.split_once(':').map(|(n, d)| (n.parse::<u32>(), d.parse::<u32>()));
                    fps = match parts {
                        Some((Ok(0), Ok(0))) => None,
                        Some((Ok(n), Ok(d))) if n > 0 && d > 0 => Some(f64::from(n) / f64::from(d)),
                        _ => return Err(wrong(format!("{text} is not a frame rate as F25:1"))),
                    };
                }
                b'I' if matches!(value, "p" | "?") => {}
                b'I' => return Err(Error::unsupported(at, format!("{text}: interlaced video; deinterlace it"))),
                b'C' => {
                    chroma = match value {
                        "420" | "420jpeg" | "420mpeg2" | "420paldv" => Chroma::C420,
                        "444" => Chroma::C444,
                        _ => {
                            let why = format!("{text}: only 8-bit 4:2:0 and 4:4:4 (C420jpeg, C444); convert it");
                            return Err(Error::unsupported(at, why));
                        }
                    };
                }
                b'X' if value == "COLORRANGE=FULL" => full_range = true,
                // Aspect of the pixels, comments.
                b'A' | b'X' => {}
                _ => return Err(wrong(format!("{text} is unknown"))),
            }
        }
        let width = width.ok_or_else(|| wrong("W, the width, is missing".into()))?;
        let height = height.ok_or_else(|| wrong("H, the height, is missing".into()))?;
        if u64::from(width) * u64::from(height) > MAX_PIXELS {
            return Err(wrong(format!("{width}x{height} is over the limit of 64 Mi pixels")));
        }
        Ok(Y4mHeader { width, height, fps, chroma, full_range })
    }

    /// Width and height of a chroma plane.
    fn chroma_size(&self) -> (usize, usize) {
        let (w, h) = (self.width as usize, self.height as usize);
        match self.chroma {
            Chroma::C420 => (w.div_ceil(2), h.div_ceil(2)),
            Chroma::C444 => (w, h),
        }
    }

    /// Bytes of a frame's planes.
    fn frame_bytes(&self) -> usize {
        let (w, h) = self.chroma_size();
        self.width as usize * self.height as usize + 2 * w * h
    }

    /// Planes to RGB. Panics on a wrong count.
    fn to_rgb(self, planes: &[u8]) -> Rgb8 {
        assert_eq!(planes.len(), self.frame_bytes(), "planes of a frame");
        let (w, h) = (self.width as usize, self.height as usize);
        let (cw, ch) = self.chroma_size();
        let (luma, chroma) = planes.split_at(w * h);
        let (blue, red) = chroma.split_at(cw * ch);
        let step = if self.chroma == Chroma::C420 { 2 } else { 1 };
        let mut data = Vec::with_capacity(3 * w * h);
        for y in 0..h {
            for x in 0..w {
                let at = y / step * cw + x / step;
                let (l, d, e) = (i32::from(luma[y * w + x]), i32::from(blue[at]) - 128, i32::from(red[at]) - 128);
                // 16 fractional bits; limited range stretches 219 (224) steps to 255.
                let (l, [rv, gu, gv, bu]) = if self.full_range {
                    (l << 16, [91_881, 22_554, 46_802, 116_130])
                } else {
                    ((l - 16) * 76_309, [104_597, 25_675, 53_279, 132_201])
                };
                let byte = |v: i32| ((v + (1 << 15)) >> 16).clamp(0, 255) as u8;
                data.extend([byte(l + rv * e), byte(l - gu * d - gv * e), byte(l + bu * d)]);
            }
        }
        Rgb8::new(self.width, self.height, data)
    }
}

/// Frames of a stream, one after the other.
#[derive(Debug)]
pub struct Y4mReader<R> {
    input: R,
    at: String,
    header: Y4mHeader,
    planes: Vec<u8>,
    frames: u64,
}

impl<R: BufRead> Y4mReader<R> {
    /// Reads the header; `at` names the stream in messages.
    pub fn new(mut input: R, at: &str) -> Result<Y4mReader<R>> {
        let line = read_line(&mut input, at, "header")?
            .ok_or_else(|| Error::input(at, "is empty: a YUV4MPEG2 stream starts with a header line"))?;
        let header = Y4mHeader::parse(&line, at)?;
        Ok(Y4mReader { input, at: at.to_string(), header, planes: vec![0; header.frame_bytes()], frames: 0 })
    }

    /// What the header says.
    pub fn header(&self) -> &Y4mHeader {
        &self.header
    }

    /// The next frame; `None` at the end of the stream.
    pub fn read(&mut self) -> Result<Option<Rgb8>> {
        let at = format!("{}: frame {}", self.at, self.frames);
        let Some(line) = read_line(&mut self.input, &at, "frame line")? else { return Ok(None) };
        if !(line == b"FRAME" || line.starts_with(b"FRAME ")) {
            let start = escape(&line[..line.len().min(16)]);
            return Err(Error::input(at, format!("starts with '{start}' instead of FRAME: the stream is damaged")));
        }
        let mut have = 0;
        while have < self.planes.len() {
            match self.input.read(&mut self.planes[have..]) {
                Ok(0) => {
                    let why = format!("is cut off after {have} of {} bytes", self.planes.len());
                    return Err(Error::input(at, why));
                }
                Ok(n) => have += n,
                Err(e) if e.kind() == ErrorKind::Interrupted => {}
                Err(e) => return Err(broken(&at, &e)),
            }
        }
        self.frames += 1;
        Ok(Some(self.header.to_rgb(&self.planes)))
    }
}

fn broken(at: &str, e: &io::Error) -> Error {
    Error::Io { at: at.to_string(), why: format!("cannot read: {e}") }
}

/// Bytes up to the next line end, without it; `None` at the end of the stream.
fn read_line(input: &mut impl BufRead, at: &str, what: &str) -> Result<Option<Vec<u8>>> {
    let mut line = Vec::new();
    let mut byte = [0];
    loop {
        match input.read(&mut byte) {
            Ok(0) if line.is_empty() => return Ok(None),
            Ok(0) => return Err(Error::input(at, format!("ends inside its {what}"))),
            Ok(_) if byte[0] == b'\n' => return Ok(Some(line)),
            Ok(_) if line.len() == LINE_CAP => {
                let start = escape(&line[..16]);
                return Err(Error::input(at, format!("has no line end in {LINE_CAP} bytes of its {what} ('{start}')")));
            }
            Ok(_) => line.push(byte[0]),
            Err(e) if e.kind() == ErrorKind::Interrupted => {}
            Err(e) => return Err(broken(at, &e)),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn open(bytes: &[u8]) -> Result<Y4mReader<&[u8]>> {
        Y4mReader::new(bytes, "s")
    }

    #[test]
    fn headers_are_read() {
        let h = |line: &str| Y4mHeader::parse(line.as_bytes(), "s").unwrap();
        let full = h("YUV4MPEG2 W640 H361 F30000:1001 Ip A1:1 C420jpeg XYSCSS=420JPEG XCOLORRANGE=FULL");
        assert_eq!((full.width, full.height, full.chroma, full.full_range), (640, 361, Chroma::C420, true));
        assert!((full.fps.unwrap() - 29.97).abs() < 0.001);
        assert_eq!(full.frame_bytes(), 640 * 361 + 2 * 320 * 181);
        let bare = h("YUV4MPEG2 W16 H14");
        assert_eq!((bare.fps, bare.chroma, bare.full_range), (None, Chroma::C420, false));
        assert_eq!(h("YUV4MPEG2 W16 H14 F0:0 C444").chroma, Chroma::C444);
    }

    #[test]
    fn wrong_headers_are_named() {
        for (line, code, why) in [
            ("", 3, "empty"),
            ("\n", 3, "not with YUV4MPEG2"),
            ("RIFF\x01 W16 H14\n", 3, "'RIFF\\x01 W16 H14'"),
            ("YUV4MPEG2 W16 H14", 3, "ends inside its header"),
            ("YUV4MPEG2 H14 F25:1\n", 3, "W, the width, is missing"),
            ("YUV4MPEG2 W16\n", 3, "H, the height, is missing"),
            ("YUV4MPEG2 W0 H14\n", 3, "W0 must be"),
            ("YUV4MPEG2 W16 H-4\n", 3, "H-4 must be"),
            ("YUV4MPEG2 W99999999999 H14\n", 3, "W99999999999"),
            ("YUV4MPEG2 W60000 H60000\n", 3, "64 Mi"),
            ("YUV4MPEG2 W16 H14 F25\n", 3, "F25 is not"),
            ("YUV4MPEG2 W16 H14 F1:0\n", 3, "F1:0 is not"),
            ("YUV4MPEG2 W16 H14 It\n", 7, "interlaced"),
            ("YUV4MPEG2 W16 H14 C422\n", 7, "C422"),
            ("YUV4MPEG2 W16 H14 C420p10\n", 7, "C420p10"),
            ("YUV4MPEG2 W16 H14 Q3\n", 3, "Q3 is unknown"),
        ] {
            let e = open(line.as_bytes()).err().unwrap_or_else(|| panic!("{line}"));
            assert_eq!(e.status() as i32, code, "{line}: {e}");
            assert!(e.to_string().contains(why), "{line}: {e}");
        }
        let long = format!("YUV4MPEG2 X{}", "y".repeat(5000));
        assert!(open(long.as_bytes()).err().unwrap().to_string().contains("no line end"));
    }

    #[test]
    fn frames_come_until_the_end_and_damage_is_named() {
        let mut bytes = b"YUV4MPEG2 W16 H14 F10:1 C420jpeg\n".to_vec();
        for shade in [16u8, 235] {
            bytes.extend(b"FRAME Ip\n");
            bytes.extend(vec![shade; 16 * 14]);
            bytes.extend(vec![128; 2 * 8 * 7]);
        }
        let mut reader = open(&bytes).unwrap();
        assert_eq!(reader.read().unwrap().unwrap().data, vec![0; 3 * 16 * 14]);
        assert_eq!(reader.read().unwrap().unwrap().data, vec![255; 3 * 16 * 14]);
        assert_eq!(reader.read().unwrap(), None);
        let mut cut = open(&bytes[..bytes.len() - 5]).unwrap();
        cut.read().unwrap();
        let e = cut.read().unwrap_err().to_string();
        assert!(e.contains("frame 1") && e.contains("after 331 of 336 bytes"), "{e}");
        let mut wrong = bytes.clone();
        wrong[33] = b'G';
        let e = open(&wrong).unwrap().read().unwrap_err().to_string();
        assert!(e.contains("frame 0") && e.contains("GRAME"), "{e}");
    }

    /// The colours of BT.601: exact for gray, within a step for the primaries of 75 % colour bars.
    #[test]
    fn colours_are_bt601() {
        let pixel = |header: &str, y: u8, u: u8, v: u8| {
            let mut bytes = format!("YUV4MPEG2 W16 H14 C444 {header}\nFRAME\n").into_bytes();
            for plane in [y, u, v] {
                bytes.extend(vec![plane; 16 * 14]);
            }
            open(&bytes).unwrap().read().unwrap().unwrap().pixel(3, 5)
        };
        let close = |have: [u8; 3], want: [u8; 3]| {
            assert!(have.iter().zip(want).all(|(h, w)| h.abs_diff(w) <= 1), "{have:?} is not {want:?}");
        };
        close(pixel("Ip", 180, 128, 128), [191, 191, 191]);
        close(pixel("Ip", 65, 100, 212), [191, 0, 0]);
        close(pixel("Ip", 112, 72, 58), [0, 191, 0]);
        close(pixel("Ip", 35, 212, 114), [0, 0, 191]);
        close(pixel("XCOLORRANGE=FULL", 76, 85, 255), [254, 0, 0]);
        assert_eq!(pixel("XCOLORRANGE=FULL", 77, 128, 128), [77, 77, 77]);
        assert_eq!(pixel("Ip", 0, 0, 0)[0], 0, "below the range is black, not wrapped");
    }

    /// What [`crate::y4m::Y4m`] writes comes back: grays within a step, colours as far as their chroma is shared.
    #[test]
    fn a_written_video_comes_back() {
        let data = (0..15 * 15).flat_map(|i| [(i * 5 % 256) as u8; 3]).collect();
        let image = Rgb8::new(15, 15, data);
        let mut video = crate::y4m::Y4m::new(Vec::new(), (15, 15), 12.5).unwrap();
        video.frame(&image).unwrap();
        let bytes = video.finish().unwrap();
        let mut reader = open(&bytes).unwrap();
        assert_eq!(reader.header().fps, Some(12.5));
        let back = reader.read().unwrap().unwrap();
        assert!(back.data.iter().zip(&image.data).all(|(b, i)| b.abs_diff(*i) <= 2), "{back:?}");
        assert_eq!(reader.read().unwrap(), None);
    }

    #[test]
    fn odd_sizes_round_chroma_up() {
        let header = Y4mHeader::parse(b"YUV4MPEG2 W15 H15", "s").unwrap();
        let mut planes = vec![128; header.frame_bytes()];
        assert_eq!(planes.len(), 225 + 2 * 64);
        // The last chroma sample belongs to the last pixel alone.
        *planes.last_mut().unwrap() = 240;
        let image = header.to_rgb(&planes);
        assert_ne!(image.pixel(14, 14), image.pixel(13, 13));
        assert_eq!(image.pixel(13, 13), image.pixel(0, 0));
    }
}
