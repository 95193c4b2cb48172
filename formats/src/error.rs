//! One error type for everything that crosses the process boundary.
//!
//! A message says what is wrong, where (file, tensor, frame, offset), what the limit is and what to
//! do, in one line. Bytes that come from a file pass through [`escape`] first.

use std::fmt;
use std::path::Path;

/// Result of everything in this crate.
pub type Result<T, E = Error> = std::result::Result<T, E>;

/// Outcome of a command or call: the process exit code and the C API value are the same number.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[repr(i32)]
pub enum Status {
    /// The result is valid.
    Ok = 0,
    /// A check ran and failed: accuracy gate, regression, metric.
    CheckFailed = 1,
    /// Wrong arguments.
    Usage = 2,
    /// Image, clip, camera, time or scene rejected.
    Input = 3,
    /// Blob or checkpoint malformed, incomplete or of the wrong shape.
    Model = 4,
    /// Memory, threads or another budget exceeded.
    Resource = 5,
    /// Opening, reading, writing or renaming failed.
    Io = 6,
    /// Understood, but not supported here: version, CPU feature, dtype, image kind.
    Unsupported = 7,
    /// Cancelled, or a deadline passed.
    Deadline = 8,
    /// Digest mismatch, file changed, self-test failed.
    Integrity = 9,
    /// A bug of ours, caught.
    Internal = 70,
    /// Ctrl-C.
    Interrupted = 130,
}

/// A fault with the status it maps to.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum Error {
    /// Wrong arguments ([`Status::Usage`]).
    #[error("{0}")]
    Usage(String),
    /// A clip, image, camera, time or scene was rejected ([`Status::Input`]).
    #[error("{at}: {why}")]
    Input {
        /// File, frame or field.
        at: String,
        /// What is wrong, the limit, what to do.
        why: String,
    },
    /// A blob or checkpoint is malformed ([`Status::Model`]).
    #[error("{at}: {why}")]
    Model {
        /// File and tensor or byte offset.
        at: String,
        /// What is wrong, the limit, what to do.
        why: String,
    },
    /// A budget would be exceeded ([`Status::Resource`]).
    #[error("{at}: {why}")]
    Resource {
        /// What asked for it.
        at: String,
        /// Needed and allowed amounts.
        why: String,
    },
    /// The operating system refused ([`Status::Io`]).
    #[error("{at}: {why}")]
    Io {
        /// The path.
        at: String,
        /// The operation and the system's reason.
        why: String,
    },
    /// Recognised but not supported ([`Status::Unsupported`]).
    #[error("{at}: {why}")]
    Unsupported {
        /// File or feature.
        at: String,
        /// What was found and what is supported.
        why: String,
    },
    /// Cancelled or too late ([`Status::Deadline`]).
    #[error("{0}")]
    Deadline(String),
    /// A digest, golden hash or self-test does not match ([`Status::Integrity`]).
    #[error("{at}: {why}")]
    Integrity {
        /// File and tensor.
        at: String,
        /// Expected and found.
        why: String,
    },
    /// A check ran and did not pass ([`Status::CheckFailed`]).
    #[error("{0}")]
    CheckFailed(String),
    /// A bug of ours ([`Status::Internal`]).
    #[error("internal error: {0}")]
    Internal(String),
}

macro_rules! shorthand {
    ($($(#[$doc:meta])* $name:ident => $variant:ident),* $(,)?) => {
        impl Error {
            $($(#[$doc])*
            pub fn $name(at: impl fmt::Display, why: impl fmt::Display) -> Self {
                Error::$variant { at: at.to_string(), why: why.to_string() }
            })*
        }
    };
}

shorthand! {
    /// [`Error::Input`] at a place.
    input => Input,
    /// [`Error::Model`] at a place.
    model => Model,
    /// [`Error::Resource`] at a place.
    resource => Resource,
    /// [`Error::Unsupported`] at a place.
    unsupported => Unsupported,
    /// [`Error::Integrity`] at a place.
    integrity => Integrity,
}

impl Error {
    /// [`Error::Io`] for an operation on a path.
    pub fn io(path: &Path, doing: &str, source: &std::io::Error) -> Self {
        Error::Io { at: escape_path(path), why: format!("cannot {doing}: {source}") }
    }

    /// [`Error::Usage`].
    pub fn usage(why: impl fmt::Display) -> Self {
        Error::Usage(why.to_string())
    }

    /// The status this error maps to.
    pub fn status(&self) -> Status {
        match self {
            Error::CheckFailed(_) => Status::CheckFailed,
            Error::Usage(_) => Status::Usage,
            Error::Input { .. } => Status::Input,
            Error::Model { .. } => Status::Model,
            Error::Resource { .. } => Status::Resource,
            Error::Io { .. } => Status::Io,
            Error::Unsupported { .. } => Status::Unsupported,
            Error::Deadline(_) => Status::Deadline,
            Error::Integrity { .. } => Status::Integrity,
            Error::Internal(_) => Status::Internal,
        }
    }

    /// The message as one line of at most 300 bytes.
    pub fn line(&self) -> String {
        one_line(&self.to_string())
    }
}

/// A text as one line of at most 300 bytes: control characters become spaces, what is longer ends in `...`.
pub fn one_line(text: &str) -> String {
    let mut line: String = text.chars().map(|c| if c.is_control() { ' ' } else { c }).collect();
    if line.len() > 300 {
        let mut end = 297;
        while !line.is_char_boundary(end) {
            end -= 1;
        }
        line.truncate(end);
        line.push_str("...");
    }
    line
}

/// Untrusted bytes as printable ASCII, at most 80 characters.
pub fn escape(bytes: &[u8]) -> String {
    let mut out = String::new();
    for &b in bytes {
        if out.len() >= 77 {
            out.push_str("...");
            break;
        }
        match b {
            0x20..=0x7e if b != b'\\' => out.push(char::from(b)),
            _ => out.push_str(&format!("\\x{b:02x}")),
        }
    }
    out
}

/// A path for a message: the last part is what a reader looks for, so a long path loses its head.
pub fn escape_path(path: &Path) -> String {
    let shown: String = path.to_string_lossy().chars().map(|c| if c.is_control() { '?' } else { c }).collect();
    if shown.chars().count() <= 120 {
        return shown;
    }
    let tail: Vec<char> = shown.chars().rev().take(117).collect();
    format!("...{}", tail.into_iter().rev().collect::<String>())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_message_is_one_short_printable_line() {
        let e = Error::model(escape(b"we\x01ird\n\xff"), "x".repeat(1000));
        let line = e.line();
        assert!(line.len() <= 300);
        assert!(line.starts_with("we\\x01ird\\x0a\\xff: xxx"));
        assert!(line.chars().all(|c| !c.is_control()));
        assert_eq!(e.status() as i32, 4);
    }

    #[test]
    fn a_long_path_keeps_its_end() {
        let long = format!("/{}/blob.sfw", "d".repeat(4000));
        let shown = escape_path(Path::new(&long));
        assert!(shown.ends_with("/blob.sfw") && shown.len() == 120);
    }
}
