//! PNG and JPEG pictures in and out.
//!
//! Every source becomes 8-bit RGB: 16-bit values v become round(v / 257), gray is repeated, palettes
//! are resolved, smaller depths are stretched to 0..255, alpha is composited on black. Colour profiles
//! and gamma are ignored: the bytes are what the network was trained on. EXIF orientation is applied
//! unless the caller asks otherwise. Sizes, kinds and truncation are judged from the markers and chunks
//! before anything is decoded. Damage inside a JPEG's compressed data that keeps its structure whole
//! cannot be seen: the format has no checksum.

use crate::atomic::{self, Overwrite};
use crate::error::{Error, Result, escape, escape_path};
use crate::open::read_regular;
use crate::sniff::FileKind;
use image::codecs::{jpeg, png};
use image::metadata::Orientation as Exif;
use image::{ColorType, DynamicImage, ExtendedColorType, ImageDecoder, ImageEncoder, RgbImage};
use std::io::Cursor;
use std::path::Path;

/// Most pixels of a picture: 64 Mi.
pub const MAX_PIXELS: u64 = 64 << 20;
/// Most decoded bytes: 4 a pixel.
const MAX_BYTES: u64 = 4 * MAX_PIXELS;
/// Longest picture file.
pub const MAX_FILE: u64 = 256 << 20;
/// Most scans of a progressive JPEG; encoders write about ten.
const MAX_SCANS: u32 = 100;
/// Longest PNG chunk that holds no pixels (profiles, text, EXIF).
const MAX_SIDE_CHUNK: u32 = 8 << 20;

/// 8-bit RGB picture, rows from the top, no padding.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Rgb8 {
    /// Pixels in a row.
    pub width: u32,
    /// Rows.
    pub height: u32,
    /// `[height, width, 3]`
    pub data: Vec<u8>,
}

impl Rgb8 {
    /// A picture of its bytes. Panics unless there are exactly `3 * width * height`.
    pub fn new(width: u32, height: u32, data: Vec<u8>) -> Rgb8 {
        assert_eq!(data.len() as u64, 3 * u64::from(width) * u64::from(height), "bytes of {width}x{height} RGB");
        Rgb8 { width, height, data }
    }

    /// Width and height.
    pub fn size(&self) -> (u32, u32) {
        (self.width, self.height)
    }

    /// The pixel in column `x` of row `y`.
    pub fn pixel(&self, x: u32, y: u32) -> [u8; 3] {
        let i = 3 * (y as usize * self.width as usize + x as usize);
        [self.data[i], self.data[i + 1], self.data[i + 2]]
    }
}

/// What to do with an EXIF orientation.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum Orientation {
    /// Turn the picture upright (default).
    #[default]
    Apply,
    /// Take the pixels as they are stored.
    Ignore,
}

/// A decoded picture and what happened on the way.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Decoded {
    /// The picture.
    pub image: Rgb8,
    /// The source had transparency, which was composited on black.
    pub alpha: bool,
    /// EXIF orientation of the source, 1 (upright) to 8.
    pub exif: u8,
}

/// What the header of a picture says.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
struct Header {
    width: u32,
    height: u32,
}

/// Reads a picture file.
pub fn read(path: &Path, orientation: Orientation) -> Result<Rgb8> {
    let at = escape_path(path);
    let bytes = read_regular(path, MAX_FILE)?
        .ok_or_else(|| Error::input(&at, format!("file is longer than {} MiB", MAX_FILE >> 20)))?;
    Ok(decode(&bytes, &at, orientation)?.image)
}

/// Decodes a picture from memory; `at` names it in messages.
pub fn decode(bytes: &[u8], at: &str, orientation: Orientation) -> Result<Decoded> {
    let kind = FileKind::of_bytes(&bytes[..bytes.len().min(264)]);
    let header = match kind {
        FileKind::Png => png_header(bytes, at)?,
        FileKind::Jpeg => jpeg_header(bytes, at)?,
        kind => return Err(Error::input(at, format!("not a PNG or JPEG picture: {}", kind.advice()))),
    };
    let pixels = u64::from(header.width) * u64::from(header.height);
    if pixels == 0 {
        return Err(Error::input(at, format!("picture of {}x{} has no pixels", header.width, header.height)));
    }
    if pixels > MAX_PIXELS {
        let why = format!("picture of {}x{} is over the limit of 64 Mi pixels", header.width, header.height);
        return Err(Error::input(at, why));
    }
    let broken =
        |e: image::ImageError| Error::input(at, format!("cannot decode: {}", escape(e.to_string().as_bytes())));
    if kind == FileKind::Jpeg {
        return finish(jpeg::JpegDecoder::new(Cursor::new(bytes)).map_err(broken)?, at, orientation);
    }
    // Bounds what compressed profiles and texts may unpack to.
    let mut limits = image::Limits::no_limits();
    limits.max_alloc = Some(MAX_BYTES);
    finish(png::PngDecoder::with_limits(Cursor::new(bytes), limits).map_err(broken)?, at, orientation)
}

/// Decodes the pixels, converts them to RGB8 and turns them upright.
fn finish(mut decoder: impl ImageDecoder, at: &str, orientation: Orientation) -> Result<Decoded> {
    let broken =
        |e: image::ImageError| Error::input(at, format!("cannot decode: {}", escape(e.to_string().as_bytes())));
    let exif = decoder.orientation().unwrap_or(Exif::NoTransforms);
    let ((width, height), colour, total) = (decoder.dimensions(), decoder.color_type(), decoder.total_bytes());
    if total > MAX_BYTES {
        return Err(Error::input(at, format!("picture decodes to {total} bytes; the limit is {MAX_BYTES}")));
    }
    let mut raw = vec![0u8; total as usize];
    decoder.read_image(&mut raw).map_err(broken)?;
    let data = to_rgb8(colour, raw, at)?;
    let mut image = RgbImage::from_raw(width, height, data).map(DynamicImage::ImageRgb8).expect("three bytes a pixel");
    if orientation == Orientation::Apply {
        image.apply_orientation(exif);
    }
    let image = image.into_rgb8();
    let image = Rgb8 { width: image.width(), height: image.height(), data: image.into_raw() };
    Ok(Decoded { image, alpha: colour.has_alpha(), exif: exif.to_exif() })
}

/// Any decoded layout as RGB8 (16-bit values are in native order).
fn to_rgb8(colour: ColorType, raw: Vec<u8>, at: &str) -> Result<Vec<u8>> {
    // Linear in the stored values: no gamma is applied, as documented.
    let over_black = |c: u32, a: u32, one: u32| (c * a + one / 2) / one;
    let narrow = |v: u32| ((v + 128) / 257) as u8;
    let wide = |b: &[u8]| u32::from(u16::from_ne_bytes([b[0], b[1]]));
    Ok(match colour {
        ColorType::Rgb8 => raw,
        ColorType::L8 => raw.iter().flat_map(|&v| [v; 3]).collect(),
        ColorType::La8 => {
            raw.chunks_exact(2).flat_map(|p| [over_black(p[0].into(), p[1].into(), 255) as u8; 3]).collect()
        }
        ColorType::Rgba8 => raw
            .chunks_exact(4)
            .flat_map(|p| [0, 1, 2].map(|i| over_black(p[i].into(), p[3].into(), 255) as u8))
            .collect(),
        ColorType::L16 => raw.chunks_exact(2).flat_map(|p| [narrow(wide(p)); 3]).collect(),
        ColorType::Rgb16 => raw.chunks_exact(2).map(|p| narrow(wide(p))).collect(),
        ColorType::La16 => {
            raw.chunks_exact(4).flat_map(|p| [narrow(over_black(wide(p), wide(&p[2..]), 65_535)); 3]).collect()
        }
        ColorType::Rgba16 => raw
            .chunks_exact(8)
            .flat_map(|p| [0, 2, 4].map(|i| narrow(over_black(wide(&p[i..]), wide(&p[6..]), 65_535))))
            .collect(),
        other => return Err(Error::unsupported(at, format!("pixel layout {other:?}"))),
    })
}

/// Walks the chunks of a PNG: whole, checksums of the small ones right, not animated.
fn png_header(bytes: &[u8], at: &str) -> Result<Header> {
    let fault = |why: String| Error::input(at, format!("broken PNG: {why}"));
    let be = |i: usize| bytes.get(i..i + 4).map(|b| u32::from_be_bytes([b[0], b[1], b[2], b[3]]));
    if !bytes.starts_with(b"\x89PNG\r\n\x1a\n") {
        return Err(fault("signature damaged (text-mode transfer?)".into()));
    }
    let (mut i, mut header) = (8, None);
    loop {
        let (length, kind) = be(i).zip(bytes.get(i + 4..i + 8)).ok_or_else(|| fault("truncated".into()))?;
        let end = i + 8 + length as usize;
        let crc = be(end).ok_or_else(|| fault(format!("truncated in chunk {}", escape(kind))))?;
        match kind {
            b"IHDR" if header.is_none() && length == 13 => {
                header = be(i + 8).zip(be(i + 12)).map(|(width, height)| Header { width, height });
            }
            _ if header.is_none() => return Err(fault("does not start with IHDR".into())),
            b"IHDR" => return Err(fault("two IHDR chunks".into())),
            b"acTL" => return Err(Error::input(at, "animated PNG; pass its frames as single pictures")),
            b"IEND" => return header.ok_or_else(|| fault("no IHDR".into())),
            // The decoder checks the pixels' own checksums.
            b"IDAT" => {}
            _ if length > MAX_SIDE_CHUNK => return Err(fault(format!("chunk {} of {length} bytes", escape(kind)))),
            _ if crc32(&bytes[i + 4..end]) != crc => {
                return Err(fault(format!("checksum of chunk {} is wrong", escape(kind))));
            }
            _ => {}
        }
        i = end + 4;
    }
}

/// CRC-32 (polynomial 0xEDB88320), bit by bit: only small chunks pass through.
fn crc32(bytes: &[u8]) -> u32 {
    !bytes.iter().fold(!0u32, |crc, &b| {
        (0..8).fold(crc ^ u32::from(b), |c, _| if c & 1 == 1 { (c >> 1) ^ 0xEDB8_8320 } else { c >> 1 })
    })
}

/// Walks the markers of a JPEG: a supported kind, whole to the end marker.
fn jpeg_header(bytes: &[u8], at: &str) -> Result<Header> {
    let fault = |why: &str| Error::input(at, format!("broken JPEG: {why}"));
    let unsupported = |what: &str| Error::unsupported(at, format!("{what} JPEG; save it as 8-bit RGB or gray"));
    let be = |i: usize| bytes.get(i..i + 2).map(|b| usize::from(u16::from_be_bytes([b[0], b[1]])));
    let (mut i, mut header, mut scans) = (2, None, 0u32);
    loop {
        if bytes.get(i) != Some(&0xff) {
            return Err(fault(if i >= bytes.len() { "truncated (no end marker)" } else { "marker expected" }));
        }
        while bytes.get(i) == Some(&0xff) {
            i += 1;
        }
        let marker = *bytes.get(i).ok_or_else(|| fault("truncated (no end marker)"))?;
        i += 1;
        match marker {
            0xd9 => {
                return match (header, scans) {
                    (Some(h), 1..) => Ok(h),
                    _ => Err(fault("no picture before the end marker")),
                };
            }
            0x01 | 0xd0..=0xd7 => continue,
            0x00 | 0xd8 => return Err(fault("marker out of place")),
            _ => {}
        }
        let length = be(i).filter(|&l| l >= 2).ok_or_else(|| fault("bad segment length"))?;
        let body = bytes.get(i + 2..i + length).ok_or_else(|| fault("truncated in a segment"))?;
        i += length;
        match marker {
            0xc0..=0xc2 => {
                let [precision, h1, h0, w1, w0, components, ..] = body else { return Err(fault("short frame header")) };
                if *precision != 8 {
                    return Err(unsupported(&format!("{precision}-bit")));
                }
                match components {
                    1 | 3 => {}
                    4 => return Err(unsupported("CMYK or YCCK")),
                    n => return Err(unsupported(&format!("{n}-component"))),
                }
                let side = |hi: u8, lo: u8| u32::from(u16::from_be_bytes([hi, lo]));
                if header.replace(Header { width: side(*w1, *w0), height: side(*h1, *h0) }).is_some() {
                    return Err(fault("two frame headers"));
                }
            }
            0xc3 | 0xc7 | 0xcb | 0xcf => return Err(unsupported("lossless")),
            0xc5 | 0xc6 | 0xcd | 0xce => return Err(unsupported("hierarchical")),
            0xc9 | 0xca | 0xcc => return Err(unsupported("arithmetic-coded")),
            0xda => {
                scans += 1;
                if scans > MAX_SCANS {
                    return Err(fault(&format!("more than {MAX_SCANS} scans")));
                }
                if header.is_none() {
                    return Err(fault("scan before the frame header"));
                }
                // Compressed data: up to a marker that is neither a stuffed zero nor a restart.
                loop {
                    let step = bytes[i..].iter().position(|&b| b == 0xff);
                    i += step.ok_or_else(|| fault("truncated (no end marker)"))?;
                    match bytes.get(i + 1) {
                        Some(0x00 | 0xd0..=0xd7) => i += 2,
                        Some(0xff) => i += 1,
                        _ => break,
                    }
                }
            }
            _ => {}
        }
    }
}

/// A picture as PNG bytes.
pub fn encode_png(image: &Rgb8) -> Result<Vec<u8>> {
    encode_png_of(&image.data, image.size(), ExtendedColorType::Rgb8)
}

fn encode_png_of(data: &[u8], (width, height): (u32, u32), colour: ExtendedColorType) -> Result<Vec<u8>> {
    let mut out = Vec::new();
    png::PngEncoder::new(&mut out)
        .write_image(data, width, height, colour)
        .map_err(|e| Error::Internal(format!("PNG encoder refused {width}x{height}: {e}")))?;
    Ok(out)
}

/// A picture as JPEG bytes; `quality` 1 to 100.
pub fn encode_jpeg(image: &Rgb8, quality: u8) -> Result<Vec<u8>> {
    let mut out = Vec::new();
    jpeg::JpegEncoder::new_with_quality(&mut out, quality.clamp(1, 100))
        .write_image(&image.data, image.width, image.height, ExtendedColorType::Rgb8)
        .map_err(|e| Error::input("picture", format!("cannot be JPEG at {}x{}: {e}", image.width, image.height)))?;
    Ok(out)
}

/// Writes an RGB picture as PNG.
pub fn write_png(path: &Path, image: &Rgb8, overwrite: Overwrite) -> Result<()> {
    atomic::write(path, &encode_png(image)?, overwrite)
}

/// Writes an RGB picture as JPEG; `quality` 1 to 100.
pub fn write_jpeg(path: &Path, image: &Rgb8, quality: u8, overwrite: Overwrite) -> Result<()> {
    atomic::write(path, &encode_jpeg(image, quality)?, overwrite)
}

/// Writes `[height, width]` 8-bit gray values as PNG. Panics on a wrong count.
pub fn write_gray8(path: &Path, (width, height): (u32, u32), data: &[u8], overwrite: Overwrite) -> Result<()> {
    assert_eq!(data.len() as u64, u64::from(width) * u64::from(height), "bytes of {width}x{height} gray");
    atomic::write(path, &encode_png_of(data, (width, height), ExtendedColorType::L8)?, overwrite)
}

/// Writes `[height, width]` 16-bit gray values as PNG. Panics on a wrong count.
pub fn write_gray16(path: &Path, (width, height): (u32, u32), data: &[u16], overwrite: Overwrite) -> Result<()> {
    assert_eq!(data.len() as u64, u64::from(width) * u64::from(height), "values of {width}x{height} gray");
    // The encoder takes native order and writes the file's big-endian itself.
    let bytes: Vec<u8> = data.iter().flat_map(|v| v.to_ne_bytes()).collect();
    atomic::write(path, &encode_png_of(&bytes, (width, height), ExtendedColorType::L16)?, overwrite)
}
