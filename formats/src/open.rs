//! Opening and reading files without surprises: regular files only, never blocking, never more than expected.

use crate::error::{Error, Result};
use std::fs::{File, OpenOptions};
use std::io::Read;
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

/// A whole regular file in memory, read once; longer than `cap` bytes gives `None`.
pub fn read_regular(path: &Path, cap: u64) -> Result<Option<Vec<u8>>> {
    let (file, identity) = open_regular(path)?;
    if identity.bytes() > cap {
        return Ok(None);
    }
    let mut bytes = Vec::with_capacity(identity.bytes() as usize);
    // The file may have grown since: one byte more than the cap tells.
    file.take(cap + 1).read_to_end(&mut bytes).map_err(|e| Error::io(path, "read", &e))?;
    Ok((bytes.len() as u64 <= cap).then_some(bytes))
}
