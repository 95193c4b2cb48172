//! Whole-or-nothing writing: a temporary file beside the target, then a rename.
//!
//! A reader sees the old file or the new one, never a part; a killed writer leaves at most a
//! temporary file (`.NAME.PID.tmp`), which the next writer of the same target removes. A file that
//! some process still has mapped keeps its old bytes.

use crate::error::{Error, Result};
use std::ffi::OsString;
use std::fs::{self, File, OpenOptions};
use std::io::{self, BufWriter, Seek, SeekFrom, Write};
use std::path::{Path, PathBuf};

/// A file being written; becomes visible with [`AtomicFile::commit`], vanishes when dropped.
#[derive(Debug)]
pub struct AtomicFile {
    target: PathBuf,
    temp: PathBuf,
    file: Option<BufWriter<File>>,
}

/// Whether an existing target may be replaced.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Overwrite {
    /// Replace it.
    Yes,
    /// Refuse ([`crate::Status::Io`]).
    No,
}

impl AtomicFile {
    /// Starts writing `target`.
    pub fn create(target: &Path, overwrite: Overwrite) -> Result<AtomicFile> {
        if overwrite == Overwrite::No && fs::symlink_metadata(target).is_ok() {
            let e = io::Error::new(io::ErrorKind::AlreadyExists, "it exists; pass --force to replace it");
            return Err(Error::io(target, "write", &e));
        }
        let name = target.file_name().ok_or_else(|| Error::usage("output path has no file name"))?;
        let folder = match target.parent() {
            Some(p) if !p.as_os_str().is_empty() => p,
            _ => Path::new("."),
        };
        let mut prefix = OsString::from(".");
        prefix.push(name);
        prefix.push(".");
        remove_stale(folder, &prefix);
        let mut temp_name = prefix;
        temp_name.push(format!("{}.tmp", std::process::id()));
        let temp = folder.join(temp_name);
        let file = OpenOptions::new()
            .write(true)
            .create(true)
            .truncate(true)
            .open(&temp)
            .map_err(|e| Error::io(target, "create", &e))?;
        Ok(AtomicFile { target: target.to_path_buf(), temp, file: Some(BufWriter::with_capacity(1 << 20, file)) })
    }

    fn writer(&mut self) -> &mut BufWriter<File> {
        self.file.as_mut().expect("file is open until commit")
    }

    /// Appends bytes.
    pub fn write(&mut self, bytes: &[u8]) -> Result<()> {
        let result = self.writer().write_all(bytes);
        result.map_err(|e| Error::io(&self.target, "write", &e))
    }

    /// Overwrites bytes at a position (for headers that need digests of what follows).
    pub fn write_at(&mut self, position: u64, bytes: &[u8]) -> Result<()> {
        let w = self.writer();
        let result = w
            .seek(SeekFrom::Start(position))
            .and_then(|_| w.write_all(bytes))
            .and_then(|_| w.seek(SeekFrom::End(0)))
            .map(|_| ());
        result.map_err(|e| Error::io(&self.target, "write", &e))
    }

    /// The temporary file, with everything written so far in it.
    pub fn flushed(&mut self) -> Result<&Path> {
        let result = self.writer().flush();
        result.map_err(|e| Error::io(&self.target, "write", &e))?;
        Ok(&self.temp)
    }

    /// Flushes to disk and renames over the target.
    pub fn commit(mut self) -> Result<()> {
        let file = self.file.take().expect("file is open until commit");
        let done = file
            .into_inner()
            .map_err(io::IntoInnerError::into_error)
            .and_then(|f| f.sync_all())
            .and_then(|()| fs::rename(&self.temp, &self.target));
        if done.is_err() {
            let _ = fs::remove_file(&self.temp);
        }
        done.map_err(|e| Error::io(&self.target, "finish writing", &e))
    }
}

impl Write for AtomicFile {
    fn write(&mut self, buf: &[u8]) -> io::Result<usize> {
        self.writer().write(buf)
    }
    fn flush(&mut self) -> io::Result<()> {
        self.writer().flush()
    }
}

impl Drop for AtomicFile {
    fn drop(&mut self) {
        if self.file.take().is_some() {
            let _ = fs::remove_file(&self.temp);
        }
    }
}

/// Writes a whole file at once.
pub fn write(target: &Path, bytes: &[u8], overwrite: Overwrite) -> Result<()> {
    let mut file = AtomicFile::create(target, overwrite)?;
    AtomicFile::write(&mut file, bytes)?;
    file.commit()
}

/// Removes temporary files of the same target whose writer no longer runs.
fn remove_stale(folder: &Path, prefix: &OsString) {
    let Ok(entries) = fs::read_dir(folder) else { return };
    let prefix = prefix.as_encoded_bytes();
    for entry in entries.flatten() {
        let name = entry.file_name();
        let name = name.as_encoded_bytes();
        let Some(pid) = name
            .strip_prefix(prefix)
            .and_then(|rest| rest.strip_suffix(b".tmp"))
            .and_then(|pid| std::str::from_utf8(pid).ok())
            .and_then(|pid| pid.parse::<u32>().ok())
        else {
            continue;
        };
        if pid != std::process::id() && !Path::new(&format!("/proc/{pid}")).exists() {
            let _ = fs::remove_file(entry.path());
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn nothing_or_everything() {
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("out.bin");
        write(&path, b"old", Overwrite::No).unwrap();
        {
            let mut f = AtomicFile::create(&path, Overwrite::Yes).unwrap();
            AtomicFile::write(&mut f, b"half").unwrap();
        }
        assert_eq!(fs::read(&path).unwrap(), b"old");
        let e = write(&path, b"new", Overwrite::No).unwrap_err();
        assert_eq!(e.status() as i32, 6);
        let mut f = AtomicFile::create(&path, Overwrite::Yes).unwrap();
        AtomicFile::write(&mut f, b"new file").unwrap();
        f.write_at(0, b"NEW").unwrap();
        AtomicFile::write(&mut f, b"!").unwrap();
        f.commit().unwrap();
        assert_eq!(fs::read(&path).unwrap(), b"NEW file!");
        assert_eq!(fs::read_dir(dir.path()).unwrap().count(), 1);
    }

    #[test]
    fn a_dead_writers_temporary_file_is_cleaned_up() {
        let dir = tempfile::tempdir().unwrap();
        let stale = dir.path().join(".out.bin.4294967294.tmp");
        fs::write(&stale, b"x").unwrap();
        write(&dir.path().join("out.bin"), b"y", Overwrite::No).unwrap();
        assert!(!stale.exists());
    }

    #[test]
    fn a_missing_folder_is_an_io_error_that_names_the_path() {
        let e = write(Path::new("/nonexistent/folder/x.sfw"), b"", Overwrite::No).unwrap_err();
        assert_eq!(e.status() as i32, 6);
        assert!(e.to_string().contains("x.sfw"));
    }
}
