//! Which kind of file this is, by its content: a wrong file is named in the message.

use crate::error::{Error, Result};
use crate::open::open_regular;
use std::io::Read;
use std::path::Path;

/// A file kind recognised from its first bytes.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum FileKind {
    /// No bytes at all.
    Empty,
    /// safetensors: a header length, then `{`.
    Safetensors,
    /// A zip archive: PyTorch since 1.6.
    Zip,
    /// A bare pickle: PyTorch before 1.6.
    Pickle,
    /// A tar archive: PyTorch before 0.1.10.
    Tar,
    /// JSON text.
    Json,
    /// Our weight blob.
    Blob,
    /// GGUF.
    Gguf,
    /// ONNX.
    Onnx,
    /// HDF5 (Keras).
    Hdf5,
    /// ELF program or library.
    Elf,
    /// A web page, mostly a failed download.
    Html,
    /// A Git LFS pointer instead of the file.
    LfsPointer,
    /// gzip.
    Gzip,
    /// NumPy array.
    Npy,
    /// PNG picture.
    Png,
    /// JPEG picture.
    Jpeg,
    /// PLY points.
    Ply,
    /// None of these.
    Unknown,
}

impl FileKind {
    /// What to call it, and what to do with it when it is not what was asked for.
    pub fn advice(self) -> &'static str {
        match self {
            FileKind::Empty => "the file is empty",
            FileKind::Safetensors => "this is a safetensors checkpoint; convert it first",
            FileKind::Zip => "this is a zip archive (PyTorch checkpoint, or something else zipped)",
            FileKind::Pickle => "this is a Python pickle (old PyTorch checkpoint)",
            FileKind::Tar => "this is a tar archive (PyTorch before 0.1.10, or something else packed)",
            FileKind::Json => "this is JSON text",
            FileKind::Blob => "this is a StreetForward weight blob (.sfw), already converted",
            FileKind::Gguf => "this is a GGUF model of another family; pass the original checkpoint",
            FileKind::Onnx => "this looks like an ONNX graph; pass the original checkpoint",
            FileKind::Hdf5 => "this is an HDF5 file; save the weights as safetensors",
            FileKind::Elf => "this is a program or library (ELF), not weights",
            FileKind::Html => "this is a web page: the download failed or needs a login",
            FileKind::LfsPointer => "this is a Git LFS pointer; run `git lfs pull` to get the file itself",
            FileKind::Gzip => "this is gzip-compressed; unpack it first",
            FileKind::Npy => "this is a NumPy array",
            FileKind::Png => "this is a PNG picture",
            FileKind::Jpeg => "this is a JPEG picture",
            FileKind::Ply => "this is a PLY file",
            FileKind::Unknown => "the format is not recognised",
        }
    }

    /// From the first bytes (264 are enough).
    pub fn of_bytes(head: &[u8]) -> FileKind {
        let at = |i: usize, what: &[u8]| head.get(i..).is_some_and(|h| h.starts_with(what));
        let text = || {
            let start = head.iter().position(|c| !c.is_ascii_whitespace()).unwrap_or(head.len());
            head[start..].iter().take(16).map(u8::to_ascii_lowercase).collect::<Vec<u8>>()
        };
        match head {
            [] => FileKind::Empty,
            _ if at(1, b"SFW") || at(0, b"SFW") => FileKind::Blob,
            _ if at(0, b"GGUF") => FileKind::Gguf,
            _ if at(0, b"PK\x03\x04") || at(0, b"PK\x05\x06") => FileKind::Zip,
            _ if at(0, b"\x7fELF") => FileKind::Elf,
            _ if at(0, b"\x89HDF") => FileKind::Hdf5,
            _ if at(0, b"\x93NUMPY") => FileKind::Npy,
            _ if at(0, b"\x89PNG") => FileKind::Png,
            _ if at(0, b"\xff\xd8\xff") => FileKind::Jpeg,
            _ if at(0, b"\x1f\x8b") => FileKind::Gzip,
            _ if at(0, b"ply\n") || at(0, b"ply\r") => FileKind::Ply,
            _ if at(0, b"version https://git-lfs") => FileKind::LfsPointer,
            _ if at(257, b"ustar") => FileKind::Tar,
            // A safetensors header length has its high bytes zero and a JSON object behind it.
            _ if head.len() >= 9 && head[8] == b'{' && head[5..8] == [0, 0, 0] => FileKind::Safetensors,
            [0x80, 2..=5, ..] => FileKind::Pickle,
            // ONNX: field 1 (IR version, varint), then a length-delimited field 2 (producer).
            [0x08, 1..=15, 0x12, ..] => FileKind::Onnx,
            _ => {
                let t = text();
                if t.starts_with(b"<!doctype") || t.starts_with(b"<html") || t.starts_with(b"<head") {
                    FileKind::Html
                } else if t.starts_with(b"{") || t.starts_with(b"[") {
                    FileKind::Json
                } else {
                    FileKind::Unknown
                }
            }
        }
    }

    /// From the first bytes of a regular file.
    pub fn of_file(path: &Path) -> Result<FileKind> {
        let (file, _) = open_regular(path)?;
        let mut head = Vec::with_capacity(264);
        file.take(264).read_to_end(&mut head).map_err(|e| Error::io(path, "read", &e))?;
        Ok(FileKind::of_bytes(&head))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn files_are_recognised_by_content() {
        let mut safetensors = 2u64.to_le_bytes().to_vec();
        safetensors.extend(b"{}");
        for (bytes, kind) in [
            (&b""[..], FileKind::Empty),
            (&safetensors, FileKind::Safetensors),
            (b"GGUF\x03\0\0\0", FileKind::Gguf),
            (b"\x7fELF\x02\x01", FileKind::Elf),
            (b"\n <!DOCTYPE html>", FileKind::Html),
            (b"PK\x03\x04", FileKind::Zip),
            (b"\x80\x02}q\0.", FileKind::Pickle),
            (b"\x08\x07\x12\x07pytorch", FileKind::Onnx),
            (b"version https://git-lfs.github.com/spec/v1\n", FileKind::LfsPointer),
            (b" {\"a\": 1}", FileKind::Json),
            (b"hello", FileKind::Unknown),
        ] {
            assert_eq!(FileKind::of_bytes(bytes), kind);
        }
    }
}
