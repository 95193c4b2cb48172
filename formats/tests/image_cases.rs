//! Pictures: every kind that is read, with its documented conversion, and every bad one.

use sf_formats::atomic::Overwrite;
use sf_formats::image_io::{self, Decoded, Orientation, Rgb8};
use std::path::Path;

/// The cases this file covers.
pub const COVERED: [&str; 10] = ["I01", "I02", "I05", "I06", "I07", "I08", "I09", "I10", "I11", "I22"];

/// A PNG chunk with its checksum.
fn chunk(kind: &[u8; 4], body: &[u8]) -> Vec<u8> {
    let mut c = (body.len() as u32).to_be_bytes().to_vec();
    c.extend(kind);
    c.extend(body);
    let crc = !c[4..].iter().fold(!0u32, |crc, &b| {
        (0..8).fold(crc ^ u32::from(b), |c, _| if c & 1 == 1 { (c >> 1) ^ 0xedb8_8320 } else { c >> 1 })
    });
    c.extend(crc.to_be_bytes());
    c
}

/// zlib without compression.
fn zlib(data: &[u8]) -> Vec<u8> {
    let mut z = vec![0x78, 0x01, 1];
    z.extend((data.len() as u16).to_le_bytes());
    z.extend((!(data.len() as u16)).to_le_bytes());
    z.extend(data);
    let (a, b) = data.iter().fold((1u32, 0u32), |(a, b), &v| {
        let a = (a + u32::from(v)) % 65521;
        (a, (b + a) % 65521)
    });
    z.extend(((b << 16) | a).to_be_bytes());
    z
}

/// A PNG of raw scan lines (each with its filter byte), with chunks before the pixels.
struct Png<'a> {
    size: (u32, u32),
    depth: u8,
    colour: u8,
    interlace: u8,
    extra: &'a [Vec<u8>],
    lines: &'a [u8],
}

impl Png<'_> {
    fn bytes(&self) -> Vec<u8> {
        let mut header = self.size.0.to_be_bytes().to_vec();
        header.extend(self.size.1.to_be_bytes());
        header.extend([self.depth, self.colour, 0, 0, self.interlace]);
        let mut out = b"\x89PNG\r\n\x1a\n".to_vec();
        out.extend(chunk(b"IHDR", &header));
        self.extra.iter().for_each(|c| out.extend(c));
        out.extend(chunk(b"IDAT", &zlib(self.lines)));
        out.extend(chunk(b"IEND", &[]));
        out
    }
}

/// A gray 8-bit 2x1 picture: 10, 200.
const PLAIN: Png = Png { size: (2, 1), depth: 8, colour: 0, interlace: 0, extra: &[], lines: &[0, 10, 200] };

fn decode(bytes: &[u8]) -> Decoded {
    image_io::decode(bytes, "x", Orientation::Apply).unwrap()
}

/// Status and line of a refusal.
fn refused(bytes: &[u8]) -> (i32, String) {
    let e = image_io::decode(bytes, "picture 7", Orientation::Apply).expect_err("accepted");
    assert!(e.line().starts_with("picture 7: "), "{}", e.line());
    (e.status() as i32, e.line())
}

fn data(name: &str) -> Vec<u8> {
    std::fs::read(Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/data").join(name)).unwrap()
}

#[test]
fn written_pictures_read_back() {
    let dir = tempfile::tempdir().unwrap();
    let path = dir.path().join("p.png");
    let image = Rgb8::new(5, 3, (0..45).map(|i| i * 5).collect());
    image_io::write_png(&path, &image, Overwrite::No).unwrap();
    assert_eq!(image_io::read(&path, Orientation::Apply).unwrap(), image);
    assert_eq!(image_io::write_png(&path, &image, Overwrite::No).unwrap_err().status() as i32, 6);
    image_io::write_gray8(&path, (3, 1), &[0, 7, 255], Overwrite::Yes).unwrap();
    assert_eq!(image_io::read(&path, Orientation::Apply).unwrap().data, [0, 0, 0, 7, 7, 7, 255, 255, 255]);
    // 16-bit values are stored whole: the file's bytes are big-endian.
    image_io::write_gray16(&path, (2, 1), &[0x1234, 257 * 9], Overwrite::Yes).unwrap();
    assert_eq!(image_io::read(&path, Orientation::Apply).unwrap().data, [0x12, 0x12, 0x12, 9, 9, 9]);
    let smooth = Rgb8::new(16, 16, (0..768).map(|i| (i / 6) as u8).collect());
    let path = dir.path().join("p.jpg");
    image_io::write_jpeg(&path, &smooth, 95, Overwrite::No).unwrap();
    let back = image_io::read(&path, Orientation::Apply).unwrap();
    let worst = back.data.iter().zip(&smooth.data).map(|(a, b)| a.abs_diff(*b)).max();
    assert!(back.size() == (16, 16) && worst < Some(12), "{worst:?}");
}

#[test]
fn i01_every_truncation_is_refused() {
    let dir = tempfile::tempdir().unwrap();
    let image = Rgb8::new(24, 16, (0..1152).map(|i| (i * 7 % 256) as u8).collect());
    for whole in [image_io::encode_png(&image).unwrap(), data("baseline.jpg"), data("progressive.jpg")] {
        assert!(image_io::decode(&whole, "x", Orientation::Apply).is_ok());
        for n in 0..whole.len() {
            let (status, line) = refused(&whole[..n]);
            assert_eq!(status, 3, "cut at {n} of {}: {line}", whole.len());
        }
    }
    // Damaged pixels: every byte of the compressed data has a checksum.
    let whole = image_io::encode_png(&image).unwrap();
    for n in 8..whole.len() - 12 {
        let mut bad = whole.clone();
        bad[n] ^= 0x10;
        assert_eq!(refused(&bad).0, 3, "flipped at {n}");
    }
    std::fs::write(dir.path().join("x.png"), b"not a picture").unwrap();
    let e = image_io::read(&dir.path().join("x.png"), Orientation::Apply).unwrap_err();
    assert!(e.status() as i32 == 3 && e.line().contains("x.png"));
}

#[test]
fn i02_pictures_without_pixels_are_refused() {
    for size in [(0, 1), (1, 0), (0, 0)] {
        assert_eq!(refused(&Png { size, ..PLAIN }.bytes()).0, 3);
    }
    assert_eq!(decode(&Png { size: (1, 1), lines: &[0, 9], ..PLAIN }.bytes()).image.data, [9, 9, 9]);
}

#[test]
fn i05_bombs_are_judged_by_their_header() {
    for size in [(65_535, 65_535), (1 << 30, 1 << 30), (u32::MAX, 1), (8193, 8192)] {
        let (status, line) = refused(&Png { size, ..PLAIN }.bytes());
        assert!(status == 3 && (line.contains("64 Mi") || line.contains("decode")), "{line}");
    }
    // A JPEG may claim 65535 x 65535 in a few hundred bytes.
    let mut jpeg = data("baseline.jpg");
    let sof = jpeg.windows(2).position(|w| w == [0xff, 0xc0]).unwrap();
    jpeg[sof + 5..sof + 9].fill(0xff);
    assert!(refused(&jpeg).1.contains("64 Mi"));
    // 16-bit RGBA under the pixel limit, but over the byte limit.
    let (status, line) = refused(&Png { size: (8192, 8191), depth: 16, colour: 6, ..PLAIN }.bytes());
    assert!(status == 3 && line.contains("limit"), "{line}");
}

#[test]
fn i06_every_layout_becomes_rgb8_as_documented() {
    let palette = chunk(b"PLTE", &[1, 2, 3, 40, 50, 60]);
    let clear = chunk(b"tRNS", &[255, 0]);
    for (png, want, alpha) in [
        (PLAIN, [10, 10, 10, 200, 200, 200], false),
        // 1 bit: 0 and 1 become 0 and 255.
        (Png { depth: 1, lines: &[0, 0b0100_0000], ..PLAIN }, [0, 0, 0, 255, 255, 255], false),
        // 4 bits: times 17.
        (Png { depth: 4, lines: &[0, 0x3f], ..PLAIN }, [51, 51, 51, 255, 255, 255], false),
        // 16 bits: rounded.
        (Png { depth: 16, lines: &[0, 0x12, 0x80, 0x00, 0x81], ..PLAIN }, [18, 18, 18, 1, 1, 1], false),
        (Png { depth: 16, lines: &[0, 0xff, 0xff, 0x00, 0x80], ..PLAIN }, [255, 255, 255, 0, 0, 0], false),
        // Gray with alpha on black: 200 * 128 / 255.
        (Png { colour: 4, lines: &[0, 10, 255, 200, 128], ..PLAIN }, [10, 10, 10, 100, 100, 100], true),
        (Png { colour: 2, lines: &[0, 1, 2, 3, 4, 5, 6], ..PLAIN }, [1, 2, 3, 4, 5, 6], false),
        (Png { colour: 6, lines: &[0, 1, 2, 3, 255, 90, 60, 30, 85], ..PLAIN }, [1, 2, 3, 30, 20, 10], true),
        (
            Png { colour: 3, depth: 1, extra: std::slice::from_ref(&palette), lines: &[0, 0x40], ..PLAIN },
            [1, 2, 3, 40, 50, 60],
            false,
        ),
        (
            Png { colour: 3, depth: 8, extra: &[palette.clone(), clear], lines: &[0, 0, 1], ..PLAIN },
            [1, 2, 3, 0, 0, 0],
            true,
        ),
    ] {
        let d = decode(&png.bytes());
        assert_eq!((d.image.data.as_slice(), d.alpha), (&want[..], alpha), "colour {} depth {}", png.colour, png.depth);
    }
    let gray = decode(&data("gray.jpg")).image;
    assert!(gray.size() == (32, 16) && gray.data.chunks(3).all(|p| p[0] == p[1] && p[1] == p[2]));
}

#[test]
fn i07_other_jpeg_kinds_are_named() {
    assert!(decode(&data("baseline.jpg")).image.size() == (32, 16));
    let (status, line) = refused(&data("cmyk.jpg"));
    assert!(status == 7 && line.contains("CMYK"), "{line}");
    let good = data("baseline.jpg");
    let sof = good.windows(2).position(|w| w == [0xff, 0xc0]).unwrap();
    for (at, value, word) in [
        (sof + 1, 0xc3, "lossless"),
        (sof + 1, 0xc9, "arithmetic"),
        (sof + 1, 0xca, "arithmetic"),
        (sof + 1, 0xc5, "hierarchical"),
        (sof + 4, 12, "12-bit"),
        (sof + 9, 2, "2-component"),
    ] {
        let mut bad = good.clone();
        bad[at] = value;
        let (status, line) = refused(&bad);
        assert!(status == 7 && line.contains(word), "{word}: {status} {line}");
    }
}

#[test]
fn i08_scans_are_limited() {
    let good = data("progressive.jpg");
    let (a, b) = (decode(&good).image, decode(&data("baseline.jpg")).image);
    let worst = a.data.iter().zip(&b.data).map(|(a, b)| a.abs_diff(*b)).max();
    // The same picture, but for chroma subsampling.
    assert!(worst < Some(40), "{worst:?}");
    // The first scan repeated thousands of times.
    let sos = good.windows(2).position(|w| w == [0xff, 0xda]).unwrap();
    let next = sos + 2 + good[sos + 2..].windows(2).position(|w| w[0] == 0xff && ![0, 0xff].contains(&w[1])).unwrap();
    let mut bomb = good[..sos].to_vec();
    (0..5000).for_each(|_| bomb.extend(&good[sos..next]));
    bomb.extend(&good[sos..]);
    let start = std::time::Instant::now();
    let (status, line) = refused(&bomb);
    assert!(status == 3 && line.contains("scans"), "{line}");
    assert!(start.elapsed().as_secs_f64() < 2.0);
}

/// A TIFF block with one entry: the orientation.
fn exif(orientation: u16) -> Vec<u8> {
    let mut t = b"II*\0\x08\0\0\0\x01\0\x12\x01\x03\0\x01\0\0\0".to_vec();
    t.extend(orientation.to_le_bytes());
    t.extend([0; 6]);
    t
}

#[test]
fn i09_all_eight_orientations() {
    // Stored as a b c / d e f; the reading for each value by the standard's "row 0 is, column 0 is".
    let want: [(u16, u32, &str); 8] = [
        (1, 3, "abcdef"),
        (2, 3, "cbafed"),
        (3, 3, "fedcba"),
        (4, 3, "defabc"),
        (5, 2, "adbecf"),
        (6, 2, "daebfc"),
        (7, 2, "fcebda"),
        (8, 2, "cfbead"),
    ];
    for (value, width, letters) in want {
        let png = Png { size: (3, 2), extra: &[chunk(b"eXIf", &exif(value))], lines: b"\0abc\0def", ..PLAIN };
        let d = decode(&png.bytes());
        let got: String = d.image.data.iter().step_by(3).map(|&b| char::from(b)).collect();
        assert_eq!((d.image.width, got.as_str(), u16::from(d.exif)), (width, letters, value));
        let raw = image_io::decode(&png.bytes(), "x", Orientation::Ignore).unwrap().image;
        assert_eq!((raw.width, raw.data[0], raw.data[15]), (3, b'a', b'f'));
        // The same block in a JPEG turns it the same way.
        let stored = data("baseline.jpg");
        let mut app1 = vec![0xff, 0xe1];
        let block = [b"Exif\0\0".as_slice(), &exif(value)].concat();
        app1.extend((block.len() as u16 + 2).to_be_bytes());
        app1.extend(block);
        let jpeg = [&stored[..2], &app1, &stored[2..]].concat();
        let turned = decode(&jpeg).image;
        assert_eq!(turned.size(), if value < 5 { (32, 16) } else { (16, 32) });
        let (plain, corner) = (decode(&stored).image, turned.pixel(0, 0));
        let from = match value {
            1 | 5 => (0, 0),
            2 | 8 => (31, 0),
            3 | 7 => (31, 15),
            _ => (0, 15),
        };
        assert_eq!(corner, plain.pixel(from.0, from.1), "orientation {value}");
    }
    // A value outside 1 to 8 means nothing.
    let odd = Png { extra: &[chunk(b"eXIf", &exif(9))], ..PLAIN };
    assert_eq!(decode(&odd.bytes()).exif, 1);
}

#[test]
fn i10_profiles_and_gamma_are_ignored() {
    let gamma = chunk(b"gAMA", &100_000u32.to_be_bytes());
    let srgb = chunk(b"sRGB", &[0]);
    let plain = decode(&PLAIN.bytes());
    assert_eq!(decode(&Png { extra: &[gamma], ..PLAIN }.bytes()), plain);
    assert_eq!(decode(&Png { extra: &[srgb], ..PLAIN }.bytes()), plain);
    let profile = [b"p\0\0".as_slice(), &zlib(&[7; 200])].concat();
    assert_eq!(decode(&Png { extra: &[chunk(b"iCCP", &profile)], ..PLAIN }.bytes()), plain);
}

#[test]
fn i11_interlaced_is_read_damaged_and_animated_are_not() {
    // Adam7 of 2x2: pass 1 the first pixel, pass 6 its neighbour, pass 7 the second row.
    let adam7 = Png { size: (2, 2), interlace: 1, lines: &[0, 1, 0, 2, 0, 3, 4], ..PLAIN };
    assert_eq!(decode(&adam7.bytes()).image.data, [1, 1, 1, 2, 2, 2, 3, 3, 3, 4, 4, 4]);
    let mut text = chunk(b"tEXt", b"Comment\0hello");
    assert!(image_io::decode(&Png { extra: &[text.clone()], ..PLAIN }.bytes(), "x", Orientation::Apply).is_ok());
    *text.last_mut().unwrap() ^= 1;
    let (status, line) = refused(&Png { extra: &[text], ..PLAIN }.bytes());
    assert!(status == 3 && line.contains("checksum of chunk tEXt"), "{line}");
    let animation = chunk(b"acTL", &[0, 0, 0, 2, 0, 0, 0, 0]);
    let (status, line) = refused(&Png { extra: &[animation], ..PLAIN }.bytes());
    assert!(status == 3 && line.contains("animated"), "{line}");
}

#[test]
fn i22_a_picture_is_read_once_into_memory() {
    // Folders and devices are refused before reading, so a size and its bytes come from one open file.
    for path in ["/", "/dev/zero", "/nonexistent.png"] {
        let e = image_io::read(Path::new(path), Orientation::Apply).unwrap_err();
        assert_eq!(e.status() as i32, 6);
    }
}
