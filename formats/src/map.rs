//! The one memory mapping of the project.
//!
//! A mapping shows the file as it is now, not as it was when checked: bytes overwritten in place
//! appear, and a truncated file kills the process at the next touch of a lost page. Who can write the
//! file must therefore be trusted for as long as it is mapped, or the file loaded by copy.
#![allow(unsafe_code)]

use crate::error::{Error, Result, escape_path};
use std::fs::File;
use std::path::Path;

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
