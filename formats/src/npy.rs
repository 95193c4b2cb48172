//! NumPy `.npy` arrays: little-endian, C order, f32, f64 and u8.
//!
//! Layout: `\x93NUMPY`, major, minor, header length (u16 in version 1, u32 in version 2), a Python
//! dictionary `{'descr': '<f4', 'fortran_order': False, 'shape': (2, 3), }` padded with spaces and a
//! newline to a multiple of 64 bytes, then the values. Read strictly: the file must end with the last
//! value.

use crate::atomic::{AtomicFile, Overwrite};
use crate::error::{Error, Result, escape, escape_path};
use crate::open::read_regular;
use std::path::Path;

/// Longest array file that is read: 8 GiB.
const FILE_CAP: u64 = 8 << 30;
/// Longest header; ours are 118 bytes.
const HEADER_CAP: usize = 4096;
/// Most dimensions.
const RANK_CAP: usize = 8;

/// The values of an array.
#[derive(Clone, Debug, PartialEq)]
pub enum Values {
    /// `<f4`
    F32(Vec<f32>),
    /// `<f8`
    F64(Vec<f64>),
    /// `|u1`, and `|b1` as 0 and 1
    U8(Vec<u8>),
}

/// An array as it was read.
#[derive(Clone, Debug, PartialEq)]
pub struct Array {
    /// Extents, outermost first.
    pub shape: Vec<usize>,
    /// Row-major values.
    pub values: Values,
}

/// Reads an array file.
pub fn read(path: &Path) -> Result<Array> {
    let at = escape_path(path);
    let bytes = read_regular(path, FILE_CAP)?
        .ok_or_else(|| Error::resource(&at, format!("array is longer than {} GiB", FILE_CAP >> 30)))?;
    parse(&bytes, &at)
}

/// Reads an f32 array; another element type is refused.
pub fn read_f32(path: &Path) -> Result<(Vec<usize>, Vec<f32>)> {
    let array = read(path)?;
    match array.values {
        Values::F32(v) => Ok((array.shape, v)),
        Values::F64(_) => Err(Error::input(escape_path(path), "holds f64 values; f32 are wanted here")),
        Values::U8(_) => Err(Error::input(escape_path(path), "holds u8 values; f32 are wanted here")),
    }
}

/// Reads an array from memory; `at` names it in messages.
pub fn parse(bytes: &[u8], at: &str) -> Result<Array> {
    let fault = |why: &str| Error::input(at, why);
    let Some(rest) = bytes.strip_prefix(b"\x93NUMPY") else { return Err(fault("not a .npy array (wrong magic)")) };
    let (length, header_at) = match rest {
        [1, 0, a, b, ..] => (usize::from(u16::from_le_bytes([*a, *b])), 10),
        [2, 0, a, b, c, d, ..] => (u32::from_le_bytes([*a, *b, *c, *d]) as usize, 12),
        [3..=255, ..] => return Err(Error::unsupported(at, ".npy version 1.0 and 2.0 are read")),
        _ => return Err(fault("truncated .npy header")),
    };
    if length > HEADER_CAP {
        return Err(fault(&format!(".npy header of {length} bytes; the limit is {HEADER_CAP}")));
    }
    let header = bytes.get(header_at..header_at + length).ok_or_else(|| fault("truncated .npy header"))?;
    let (descr, shape) = parse_header(header, at)?;
    let size = match descr.as_str() {
        "<f4" => 4,
        "<f8" => 8,
        "|u1" | "|b1" => 1,
        other => {
            let why = format!("element type '{}'; <f4, <f8, |u1 and |b1 are read", escape(other.as_bytes()));
            return Err(Error::unsupported(at, why));
        }
    };
    let need = shape.iter().try_fold(size, |a: usize, &d| a.checked_mul(d));
    let data = &bytes[header_at + length..];
    if need != Some(data.len()) {
        let want = need.map_or("more than 2^64".into(), |n| n.to_string());
        return Err(fault(&format!("{} data bytes, but shape {shape:?} needs {want}", data.len())));
    }
    let values = match descr.as_str() {
        "<f4" => Values::F32(data.chunks_exact(4).map(|b| f32::from_le_bytes([b[0], b[1], b[2], b[3]])).collect()),
        "<f8" => Values::F64(
            data.chunks_exact(8)
                .map(|b| f64::from_le_bytes([b[0], b[1], b[2], b[3], b[4], b[5], b[6], b[7]]))
                .collect(),
        ),
        "|b1" if data.iter().any(|&b| b > 1) => return Err(fault("a boolean is neither 0 nor 1")),
        _ => Values::U8(data.to_vec()),
    };
    Ok(Array { shape, values })
}

/// Element type and shape of the Python dictionary.
fn parse_header(header: &[u8], at: &str) -> Result<(String, Vec<usize>)> {
    let fault = |why: &str| Error::input(at, format!(".npy header {why}"));
    let text = std::str::from_utf8(header).ok().filter(|t| t.is_ascii()).ok_or_else(|| fault("is not ASCII"))?;
    let inside =
        text.trim().strip_prefix('{').and_then(|t| t.strip_suffix('}')).ok_or_else(|| fault("is not a dictionary"))?;
    let (mut descr, mut fortran, mut shape) = (None, None, None);
    let mut rest = inside.trim();
    while !rest.is_empty() {
        let (key, after) = quoted(rest).ok_or_else(|| fault("has a key that is not quoted"))?;
        let after = after.trim_start().strip_prefix(':').ok_or_else(|| fault("lacks a colon"))?.trim_start();
        let twice = || fault(&format!("has the key '{}' twice", escape(key.as_bytes())));
        let after = match key {
            "descr" => {
                let (v, after) = quoted(after).ok_or_else(|| Error::unsupported(at, "structured .npy element type"))?;
                if descr.replace(v.to_owned()).is_some() {
                    return Err(twice());
                }
                after
            }
            "fortran_order" => {
                let (v, after) = match (after.strip_prefix("False"), after.strip_prefix("True")) {
                    (Some(after), _) => (false, after),
                    (_, Some(after)) => (true, after),
                    _ => return Err(fault("has a fortran_order that is neither True nor False")),
                };
                if fortran.replace(v).is_some() {
                    return Err(twice());
                }
                after
            }
            "shape" => {
                let (list, after) = after
                    .strip_prefix('(')
                    .and_then(|t| t.split_once(')'))
                    .ok_or_else(|| fault("has a shape that is not a tuple"))?;
                let mut dims = Vec::new();
                for part in list.split(',').map(str::trim).filter(|p| !p.is_empty()) {
                    let digits = part.bytes().all(|b| b.is_ascii_digit());
                    let d = part.parse().ok().filter(|_| digits).ok_or_else(|| fault("has a bad dimension"))?;
                    dims.push(d);
                }
                if dims.len() > RANK_CAP {
                    return Err(fault("has more than 8 dimensions"));
                }
                if shape.replace(dims).is_some() {
                    return Err(twice());
                }
                after
            }
            _ => return Err(fault(&format!("has the unknown key '{}'", escape(key.as_bytes())))),
        };
        rest = after.trim_start();
        match rest.strip_prefix(',') {
            Some(next) => rest = next.trim_start(),
            None if rest.is_empty() => {}
            None => return Err(fault("lacks a comma")),
        }
    }
    match (descr, fortran, shape) {
        (Some(_), Some(true), Some(_)) => {
            Err(Error::unsupported(at, "Fortran order; save it with numpy.ascontiguousarray"))
        }
        (Some(descr), Some(false), Some(shape)) => Ok((descr, shape)),
        _ => Err(fault("lacks descr, fortran_order or shape")),
    }
}

/// A quoted text without escapes at the start of `t`, and what follows it.
fn quoted(t: &str) -> Option<(&str, &str)> {
    let quote = t.chars().next().filter(|c| *c == '\'' || *c == '"')?;
    let (text, rest) = t[1..].split_once(quote)?;
    (!text.contains('\\')).then_some((text, rest))
}

/// Magic, version 1.0 and header, padded so that the values start at a multiple of 64 bytes.
fn header(descr: &str, shape: &[usize]) -> Vec<u8> {
    let mut dims = shape.iter().map(usize::to_string).collect::<Vec<_>>().join(", ");
    if shape.len() == 1 {
        dims.push(',');
    }
    let mut text = format!("{{'descr': '{descr}', 'fortran_order': False, 'shape': ({dims}), }}");
    let used = 10 + text.len() + 1;
    text.push_str(&" ".repeat(used.next_multiple_of(64) - used));
    text.push('\n');
    let mut out = b"\x93NUMPY\x01\x00".to_vec();
    out.extend((text.len() as u16).to_le_bytes());
    out.extend(text.as_bytes());
    out
}

fn write(path: &Path, descr: &str, shape: &[usize], bytes: &[u8], overwrite: Overwrite) -> Result<()> {
    let mut file = AtomicFile::create(path, overwrite)?;
    AtomicFile::write(&mut file, &header(descr, shape))?;
    AtomicFile::write(&mut file, bytes)?;
    file.commit()
}

fn check_shape(shape: &[usize], count: usize) {
    assert_eq!(shape.iter().product::<usize>(), count, "shape {shape:?} against {count} values");
}

/// Writes f32 values. Panics unless `shape` holds exactly the values.
pub fn write_f32(path: &Path, shape: &[usize], values: &[f32], overwrite: Overwrite) -> Result<()> {
    check_shape(shape, values.len());
    let bytes: Vec<u8> = values.iter().flat_map(|v| v.to_le_bytes()).collect();
    write(path, "<f4", shape, &bytes, overwrite)
}

/// Writes f64 values. Panics unless `shape` holds exactly the values.
pub fn write_f64(path: &Path, shape: &[usize], values: &[f64], overwrite: Overwrite) -> Result<()> {
    check_shape(shape, values.len());
    let bytes: Vec<u8> = values.iter().flat_map(|v| v.to_le_bytes()).collect();
    write(path, "<f8", shape, &bytes, overwrite)
}

/// Writes u8 values. Panics unless `shape` holds exactly the values.
pub fn write_u8(path: &Path, shape: &[usize], values: &[u8], overwrite: Overwrite) -> Result<()> {
    check_shape(shape, values.len());
    write(path, "|u1", shape, values, overwrite)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn arrays_round_trip() {
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("a.npy");
        for shape in [vec![2, 3], vec![6], vec![1, 6, 1]] {
            let v = [0.0, -1.5, f32::INFINITY, 1e-40, 3.0, 4.0];
            write_f32(&path, &shape, &v, Overwrite::Yes).unwrap();
            assert_eq!(read_f32(&path).unwrap(), (shape, v.to_vec()));
        }
        write_f64(&path, &[], &[2.5], Overwrite::Yes).unwrap();
        assert_eq!(read(&path).unwrap(), Array { shape: vec![], values: Values::F64(vec![2.5]) });
        write_u8(&path, &[0, 4], &[], Overwrite::Yes).unwrap();
        assert_eq!(read(&path).unwrap(), Array { shape: vec![0, 4], values: Values::U8(vec![]) });
        assert!(read_f32(&path).is_err());
        // The values start at a multiple of 64, as NumPy writes them.
        assert_eq!(header("<f4", &[480, 640]).len() % 64, 0);
    }

    #[test]
    fn anything_unexpected_is_refused() {
        let make = |text: &str, data: &[u8]| {
            let mut b = b"\x93NUMPY\x01\x00".to_vec();
            b.extend((text.len() as u16).to_le_bytes());
            b.extend(text.as_bytes());
            b.extend(data);
            b
        };
        let status = |b: &[u8]| parse(b, "x").map(|_| 0).unwrap_or_else(|e| e.status() as i32);
        let good = "{'descr': '<f4', 'fortran_order': False, 'shape': (1,), }";
        assert_eq!(status(&make(good, &[0; 4])), 0);
        assert_eq!(status(&make(good, &[0; 5])), 3);
        assert_eq!(status(&make(good, &[0; 3])), 3);
        for (from, to, want) in [
            ("<f4", ">f4", 7),
            ("<f4", "<i8", 7),
            ("False", "True", 7),
            ("False", "Maybe", 3),
            ("(1,)", "(-1,)", 3),
            ("(1,)", "(18446744073709551615, 4)", 3),
            ("(1,)", "(99999999999999999999,)", 3),
            ("(1,)", "[1]", 3),
            ("'shape': (1,)", "'descr': '<f4'", 3),
            ("'shape'", "'other'", 3),
            ("}", "", 3),
        ] {
            assert_eq!(status(&make(&good.replace(from, to), &[0; 4])), want, "{from} -> {to}");
        }
        assert_eq!(status(b"\x93NUMPY\x03\x00"), 7);
        assert_eq!(status(b"\x93NUMPY\x02\x00\xff\xff\xff\xff"), 3);
        assert_eq!(status(b"\x93NUM"), 3);
    }
}
