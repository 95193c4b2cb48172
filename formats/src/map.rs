//! Opening a file without surprises, and the one memory mapping of the project.
//!
//! A mapping shows the file as it is now, not as it was when checked: bytes overwritten in place
//! appear, and a truncated file kills the process at the next touch of a lost page. Who can write the
//! file must therefore be trusted for as long as it is mapped, or the file loaded by copy.
#![allow(unsafe_code)]

use crate::error::{Error, Result, escape_path};
use std::fs::{File, OpenOptions};
use std::os::unix::fs::{MetadataExt, OpenOptionsExt};
use std::path::Path;

/// What tells whether an open file is still the one that was checked. The time of the last status change
/// is left out: it moves when another file is renamed over this one, which is harmless.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) struct Identity {
    device: u64,
    inode: u64,
    bytes: u64,
    modified: (i64, i64),
}

impl Identity {
    /// Of an open file: one `fstat`.
    pub(crate) fn of(file: &File, path: &Path) -> Result<Identity> {
        let m = file.metadata().map_err(|e| Error::io(path, "read the status of", &e))?;
        Ok(Identity { device: m.dev(), inode: m.ino(), bytes: m.size(), modified: (m.mtime(), m.mtime_nsec()) })
    }

    /// Length in bytes.
    pub(crate) fn bytes(&self) -> u64 {
        self.bytes
    }
}

/// Opens a regular file for reading; never blocks, and refuses everything that is not a regular file
/// (FIFO, device, socket, directory) before and after opening it.
pub(crate) fn open_regular(path: &Path) -> Result<(File, Identity)> {
    let refuse = || {
        let e = std::io::Error::new(std::io::ErrorKind::InvalidInput, "it is not a regular file");
        Err(Error::io(path, "open", &e))
    };
    let before = std::fs::metadata(path).map_err(|e| Error::io(path, "open", &e))?;
    if !before.is_file() {
        return refuse();
    }
    let file = OpenOptions::new()
        .read(true)
        .custom_flags(libc::O_NONBLOCK)
        .open(path)
        .map_err(|e| Error::io(path, "open", &e))?;
    if !file.metadata().map_err(|e| Error::io(path, "open", &e))?.is_file() {
        return refuse();
    }
    let identity = Identity::of(&file, path)?;
    Ok((file, identity))
}

/// Maps a whole file read-only.
pub(crate) fn map(file: &File, path: &Path) -> Result<memmap2::Mmap> {
    // SAFETY: the mapping is private and read-only, so safe code cannot write through it. Another
    // process changing the file is outside what any check here can rule out: the caller compares the
    // file's identity before and after verification and offers it for later checks
    // (`Blob::unchanged`), and the module's header states the remaining requirement.
    unsafe { memmap2::Mmap::map(file) }.map_err(|e| match e.raw_os_error() {
        Some(libc::ENOMEM) => Error::resource(escape_path(path), "no address space left to map the file"),
        _ => Error::io(path, "map", &e),
    })
}
