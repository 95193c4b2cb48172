//! What a verb tells: results on standard output (text or JSON), remarks on standard error, numbers for
//! people.

use crate::args::path_json;
use crate::progress::{Follow, Progress};
use crate::signals;
use serde_json::Value;
use sf_formats::{Error, Result};
use std::fmt::Display;
use std::io::{self, IsTerminal, Write};
use std::path::{Path, PathBuf};
use streetforward::Session;

/// Where results and remarks of one command go.
pub(crate) struct Console {
    json: bool,
    quiet: bool,
}

impl Console {
    /// `json`: the result is one JSON document; `quiet`: no remarks, no progress.
    pub(crate) fn new(json: bool, quiet: bool) -> Console {
        Console { json, quiet }
    }

    /// Whether the result is a JSON document on standard output.
    pub(crate) fn is_json(&self) -> bool {
        self.json
    }

    /// The command's result, once: the JSON document or the text.
    pub(crate) fn report(&self, json: &Value, text: &str) -> Result<()> {
        if self.json { write_stdout(json_text(json)?.as_bytes()) } else { write_stdout(text.as_bytes()) }
    }

    /// A remark on standard error; a closed standard error is not a fault.
    pub(crate) fn note(&self, line: impl Display) {
        if !self.quiet {
            let _ = writeln!(io::stderr(), "{line}");
        }
    }

    /// A remark that matters even under `--quiet`.
    pub(crate) fn warn(&self, line: impl Display) {
        let _ = writeln!(io::stderr(), "warning: {line}");
    }

    /// A progress bar.
    pub(crate) fn progress(&self, total: u64, what: &'static str) -> Progress {
        Progress::new(total, what, !self.quiet)
    }

    /// A bar over the layers of the session's next run.
    pub(crate) fn follow(&self, session: &Session) -> Follow {
        let visible = !self.quiet && io::stderr().is_terminal();
        Follow::new(session.layers_done(), session.plan().layers(), "network", visible)
    }
}

/// A report as indented JSON text.
pub(crate) fn json_text(json: &Value) -> Result<String> {
    let mut text = serde_json::to_string_pretty(json)
        .map_err(|e| Error::Internal(format!("the report cannot be written as JSON: {e}")))?;
    text.push('\n');
    Ok(text)
}

/// Standard output; lost output is an error (closed, full, reader gone).
pub(crate) struct Stdout(io::StdoutLock<'static>);

impl Stdout {
    /// Fails when it was closed from the start.
    pub(crate) fn open() -> Result<Stdout> {
        if signals::stdout_closed() {
            return Err(stdout_error(&io::Error::other("it is closed")));
        }
        Ok(Stdout(io::stdout().lock()))
    }
}

impl Write for Stdout {
    fn write(&mut self, bytes: &[u8]) -> io::Result<usize> {
        self.0.write(bytes)
    }

    fn flush(&mut self) -> io::Result<()> {
        self.0.flush()
    }
}

fn stdout_error(e: &io::Error) -> Error {
    Error::io(Path::new("standard output"), "write", e)
}

/// Writes all bytes to standard output.
pub(crate) fn write_stdout(bytes: &[u8]) -> Result<()> {
    let mut out = Stdout::open()?;
    out.write_all(bytes).and_then(|()| out.flush()).map_err(|e| stdout_error(&e))
}

/// File paths of a report.
pub(crate) fn files_json(files: &[PathBuf]) -> Value {
    files.iter().map(|f| path_json(f)).collect()
}

/// Bytes for people: three digits and a binary unit.
pub(crate) fn human_bytes(n: u64) -> String {
    let units = ["B", "KiB", "MiB", "GiB", "TiB"];
    let mut value = n as f64;
    let mut unit = 0;
    while value >= 1000.0 && unit + 1 < units.len() {
        value /= 1024.0;
        unit += 1;
    }
    let digits = if unit == 0 || value >= 100.0 {
        0
    } else if value >= 10.0 {
        1
    } else {
        2
    };
    format!("{value:.digits$} {}", units[unit])
}

/// A count with thin groups of three: `11 817 876`.
pub(crate) fn human_count(n: usize) -> String {
    let digits = n.to_string();
    let mut out = String::new();
    for (i, c) in digits.chars().enumerate() {
        if i > 0 && (digits.len() - i).is_multiple_of(3) {
            out.push(' ');
        }
        out.push(c);
    }
    out
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn numbers_for_people() {
        assert_eq!(human_bytes(512), "512 B");
        assert_eq!(human_bytes(4096), "4.00 KiB");
        assert_eq!(human_bytes(47 << 20), "47.0 MiB");
        assert_eq!(human_bytes(4_341_010_220), "4.04 GiB");
        assert_eq!(human_count(11_817_876), "11 817 876");
        assert_eq!(human_count(42), "42");
    }
}
