//! What a path holds, listed before any picture is decoded: the sources of [`Clip::open`](crate::clip::Clip::open).

use crate::camera::Pose;
use crate::error::{Error, Result, escape, escape_path};
use crate::open::read_regular;
use crate::transforms::{Lens, Transforms};
use std::cmp::Ordering;
use std::ffi::OsStr;
use std::os::unix::ffi::OsStrExt;
use std::path::{Path, PathBuf};

/// Longest list file.
const LIST_CAP: u64 = 16 << 20;

/// A frame before it is decoded.
pub(crate) struct Listed {
    pub(crate) path: PathBuf,
    pub(crate) time: Option<f64>,
    pub(crate) pose: Option<Pose>,
}

/// A source before its pictures are decoded.
pub(crate) struct Source {
    pub(crate) folder: PathBuf,
    pub(crate) frames: Vec<Listed>,
    pub(crate) lens: Option<Lens>,
    pub(crate) notes: Vec<String>,
}

impl Source {
    /// What a path holds, without decoding a picture.
    pub(crate) fn list(path: &Path) -> Result<Source> {
        let meta = std::fs::metadata(path).map_err(|e| Error::io(path, "open", &e))?;
        let folder = if meta.is_dir() { path } else { path.parent().unwrap_or(Path::new("")) }.to_path_buf();
        if meta.is_dir() {
            let json = path.join("transforms.json");
            let text = path.join("images.txt");
            return if json.is_file() {
                list_transforms(&json, folder)
            } else if text.is_file() {
                list_text(&text, folder)
            } else {
                list_folder(folder)
            };
        }
        match ending(path).as_deref() {
            Some(b"json") => list_transforms(path, folder),
            Some(b"txt") => list_text(path, folder),
            _ => {
                let frames = vec![Listed { path: path.to_path_buf(), time: None, pose: None }];
                Ok(Source { folder, frames, lens: None, notes: Vec::new() })
            }
        }
    }
}

/// Lower-case extension as bytes.
fn ending(path: &Path) -> Option<Vec<u8>> {
    path.extension().map(|e| e.as_bytes().to_ascii_lowercase())
}

fn is_picture(path: &Path) -> bool {
    let hidden = path.file_name().is_some_and(|n| n.as_bytes().starts_with(b"."));
    !hidden && matches!(ending(path).as_deref(), Some(b"png" | b"jpg" | b"jpeg"))
}

fn list_folder(folder: PathBuf) -> Result<Source> {
    let mut files = Vec::new();
    for entry in std::fs::read_dir(&folder).map_err(|e| Error::io(&folder, "list", &e))? {
        let path = entry.map_err(|e| Error::io(&folder, "list", &e))?.path();
        if is_picture(&path) && !path.is_dir() {
            files.push(path);
        }
    }
    files.sort_by(|a, b| natural(a, b));
    let frames = files.into_iter().map(|path| Listed { path, time: None, pose: None }).collect();
    Ok(Source { folder, frames, lens: None, notes: Vec::new() })
}

/// Order in which people number files: runs of digits compare as numbers, the rest as bytes.
pub fn natural(a: &Path, b: &Path) -> Ordering {
    let (full_a, full_b) = (a.as_os_str().as_bytes(), b.as_os_str().as_bytes());
    let (mut a, mut b) = (full_a, full_b);
    let digits = |s: &[u8]| s.iter().take_while(|c| c.is_ascii_digit()).count();
    loop {
        let (na, nb) = (digits(a), digits(b));
        if na > 0 && nb > 0 {
            // Without leading zeros the longer number is the larger one, of any length.
            let zeros = |s: &[u8]| s.iter().take_while(|c| **c == b'0').count();
            let (da, db) = (&a[zeros(&a[..na])..na], &b[zeros(&b[..nb])..nb]);
            let order = da.len().cmp(&db.len()).then_with(|| da.cmp(db));
            if order != Ordering::Equal {
                return order;
            }
            (a, b) = (&a[na..], &b[nb..]);
            continue;
        }
        match (a.split_first(), b.split_first()) {
            (Some((x, ra)), Some((y, rb))) if x == y => (a, b) = (ra, rb),
            (Some((x, _)), Some((y, _))) => return x.cmp(y),
            // 1.png and 01.png: bytes decide, so the order is total.
            (None, None) => return full_a.cmp(full_b),
            (x, _) => return if x.is_none() { Ordering::Less } else { Ordering::Greater },
        }
    }
}

fn list_transforms(path: &Path, folder: PathBuf) -> Result<Source> {
    let Transforms { frames, lens, notes } = Transforms::read(path)?;
    let mut frames: Vec<Listed> = frames
        .into_iter()
        .map(|f| Listed { path: with_extension(folder.join(f.path)), time: f.time, pose: f.pose })
        .collect();
    // Exporters write frames in any order; the clip is in time order.
    if frames.iter().all(|f| f.time.is_some()) {
        frames.sort_by(|a, b| a.time.partial_cmp(&b.time).unwrap_or(Ordering::Equal));
    } else {
        frames.sort_by(|a, b| natural(&a.path, &b.path));
    }
    Ok(Source { folder, frames, lens, notes })
}

/// Synthetic sets leave out `.png`.
fn with_extension(path: PathBuf) -> PathBuf {
    if path.extension().is_some() || path.exists() {
        return path;
    }
    let tried = ["png", "jpg", "jpeg"].map(|e| path.with_extension(e));
    tried.into_iter().find(|p| p.exists()).unwrap_or(path)
}

fn list_text(path: &Path, folder: PathBuf) -> Result<Source> {
    let at = escape_path(path);
    let bytes = read_regular(path, LIST_CAP)?
        .ok_or_else(|| Error::input(&at, format!("list is longer than {} MiB", LIST_CAP >> 20)))?;
    let mut frames = Vec::new();
    for (n, line) in bytes.split(|&b| b == b'\n').enumerate() {
        let line = line.trim_ascii();
        if line.is_empty() || line[0] == b'#' {
            continue;
        }
        if line.contains(&0) {
            return Err(Error::input(
                format!("{at}: line {}", n + 1),
                format!("holds a zero byte: '{}'", escape(line)),
            ));
        }
        let gap = line.iter().rposition(u8::is_ascii_whitespace);
        let time = gap.and_then(|g| std::str::from_utf8(&line[g + 1..]).ok()?.parse::<f64>().ok());
        let name = match (gap, time) {
            (Some(g), Some(_)) => line[..g].trim_ascii_end(),
            _ => line,
        };
        frames.push(Listed { path: folder.join(OsStr::from_bytes(name)), time, pose: None });
    }
    Ok(Source { folder, frames, lens: None, notes: Vec::new() })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn natural_order_is_numeric_and_total() {
        let sorted = |names: &[&str]| {
            let mut v: Vec<PathBuf> = names.iter().map(PathBuf::from).collect();
            v.sort_by(|a, b| natural(a, b));
            v.iter().map(|p| p.to_str().unwrap().to_owned()).collect::<Vec<_>>()
        };
        assert_eq!(sorted(&["f10.png", "f9.png", "f1.png", "f.png"]), ["f.png", "f1.png", "f9.png", "f10.png"]);
        assert_eq!(sorted(&["01.png", "1.png", "2.png", "0.png"]), ["0.png", "01.png", "1.png", "2.png"]);
        assert_eq!(
            sorted(&["99999999999999999999999.png", "100000000000000000000000.png"]),
            ["99999999999999999999999.png", "100000000000000000000000.png"]
        );
        assert_eq!(sorted(&["a2b10", "a2b9", "a10b1"]), ["a2b9", "a2b10", "a10b1"]);
    }
}
