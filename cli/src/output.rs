//! What a verb tells and writes: results on standard output (text or JSON), remarks on standard
//! error, output folders that appear whole or not at all.

use crate::args::{FolderArgs, path_json};
use crate::progress::{Follow, Progress};
use crate::signals;
use serde_json::Value;
use sf_formats::{Error, Result};
use std::ffi::OsString;
use std::fmt::Display;
use std::fs;
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

/// A folder being written: files go into a temporary folder, [`OutputFolder::commit`] makes them
/// visible. Dropped without it, nothing remains.
pub(crate) struct OutputFolder {
    target: PathBuf,
    stage: PathBuf,
    /// Whether the target was there before: then files are moved into it one by one.
    existed: bool,
    live: bool,
}

impl OutputFolder {
    /// Starts writing the folder of `args`; refuses one that is not empty unless forced.
    pub(crate) fn create(args: &FolderArgs) -> Result<OutputFolder> {
        let target = args.output.clone();
        let existed = match fs::metadata(&target) {
            Ok(m) if !m.is_dir() => {
                let e = io::Error::new(io::ErrorKind::NotADirectory, "it exists and is not a folder");
                return Err(Error::io(&target, "write", &e));
            }
            Ok(_) => true,
            Err(e) if e.kind() == io::ErrorKind::NotFound => false,
            Err(e) => return Err(Error::io(&target, "write", &e)),
        };
        let (folder, prefix) = if existed {
            (target.clone(), OsString::from(".streetforward."))
        } else {
            let name = target.file_name().ok_or_else(|| Error::usage("the output folder has no name"))?;
            let mut hidden = OsString::from(".");
            hidden.push(name);
            hidden.push(".");
            (target.with_file_name(""), hidden)
        };
        remove_stale(&folder, prefix.as_encoded_bytes());
        if existed && !args.force {
            let mut entries = fs::read_dir(&target).map_err(|e| Error::io(&target, "read", &e))?;
            if entries.next().is_some() {
                let e = io::Error::new(
                    io::ErrorKind::AlreadyExists,
                    "the folder is not empty; pass --force to write into it",
                );
                return Err(Error::io(&target, "write", &e));
            }
        }
        let mut name = prefix;
        name.push(format!("{}.tmp", std::process::id()));
        let stage = folder.join(name);
        // A killed process may have had the same id.
        let _ = fs::remove_dir_all(&stage);
        signals::guard_stage(&stage);
        let folder = OutputFolder { target, stage, existed, live: true };
        fs::create_dir_all(&folder.stage).map_err(|e| Error::io(&folder.target, "create", &e))?;
        Ok(folder)
    }

    /// Where to write files for now.
    pub(crate) fn path(&self) -> &Path {
        &self.stage
    }

    /// A subfolder to write into, made where it is missing.
    pub(crate) fn subfolder(&self, name: &str) -> Result<PathBuf> {
        let folder = self.stage.join(name);
        fs::create_dir_all(&folder).map_err(|e| Error::io(&folder, "create", &e))?;
        Ok(folder)
    }

    /// Makes the files visible under the target; gives their paths relative to it, sorted.
    pub(crate) fn commit(mut self) -> Result<Vec<PathBuf>> {
        let mut files = Vec::new();
        list_files(&self.stage, Path::new(""), &mut files).map_err(|e| Error::io(&self.target, "list", &e))?;
        files.sort();
        let failed = |e: &io::Error| Error::io(&self.target, "finish writing", e);
        if self.existed {
            for file in &files {
                let to = self.target.join(file);
                if let Some(parent) = to.parent() {
                    fs::create_dir_all(parent).map_err(|e| failed(&e))?;
                }
                fs::rename(self.stage.join(file), to).map_err(|e| failed(&e))?;
            }
        } else {
            fs::rename(&self.stage, &self.target).map_err(|e| failed(&e))?;
            self.live = false;
            signals::release_stage(&self.stage);
        }
        Ok(files)
    }
}

impl Drop for OutputFolder {
    fn drop(&mut self) {
        if self.live {
            let _ = fs::remove_dir_all(&self.stage);
            signals::release_stage(&self.stage);
        }
    }
}

/// Removes the temporary folders that killed processes left.
fn remove_stale(folder: &Path, prefix: &[u8]) {
    if !Path::new("/proc/self").exists() {
        // Without it nobody tells whether the owner still runs.
        return;
    }
    let here = if folder.as_os_str().is_empty() { Path::new(".") } else { folder };
    for entry in fs::read_dir(here).into_iter().flatten().flatten() {
        let name = entry.file_name();
        let owner = name.as_encoded_bytes().strip_prefix(prefix).and_then(|n| n.strip_suffix(b".tmp"));
        let owner = owner.and_then(|n| std::str::from_utf8(n).ok()).and_then(|n| n.parse::<u32>().ok());
        if owner.is_some_and(|pid| !Path::new(&format!("/proc/{pid}")).exists()) {
            let _ = fs::remove_dir_all(entry.path());
        }
    }
}

fn list_files(root: &Path, below: &Path, files: &mut Vec<PathBuf>) -> io::Result<()> {
    for entry in fs::read_dir(root.join(below))? {
        let entry = entry?;
        let relative = below.join(entry.file_name());
        if entry.file_type()?.is_dir() {
            list_files(root, &relative, files)?;
        } else {
            files.push(relative);
        }
    }
    Ok(())
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

    fn args(output: PathBuf, force: bool) -> FolderArgs {
        FolderArgs { output, force }
    }

    #[test]
    fn a_new_folder_appears_whole() {
        let dir = tempfile::tempdir().unwrap();
        let target = dir.path().join("out");
        {
            let folder = OutputFolder::create(&args(target.clone(), false)).unwrap();
            fs::write(folder.path().join("half"), b"x").unwrap();
        }
        assert_eq!(fs::read_dir(dir.path()).unwrap().count(), 0);
        let folder = OutputFolder::create(&args(target.clone(), false)).unwrap();
        fs::write(folder.path().join("b"), b"x").unwrap();
        fs::write(folder.subfolder("deep").unwrap().join("a"), b"x").unwrap();
        assert!(!target.exists());
        assert_eq!(folder.commit().unwrap(), [PathBuf::from("b"), PathBuf::from("deep/a")]);
        assert!(target.join("deep/a").exists());
        assert_eq!(fs::read_dir(dir.path()).unwrap().count(), 1);
    }

    #[test]
    fn a_folder_with_files_needs_force_and_keeps_strangers() {
        let dir = tempfile::tempdir().unwrap();
        let target = dir.path().to_path_buf();
        fs::write(target.join("mine"), b"old").unwrap();
        let e = OutputFolder::create(&args(target.clone(), false)).err().unwrap();
        assert_eq!(e.status() as i32, 6);
        assert!(e.to_string().contains("--force"));
        let folder = OutputFolder::create(&args(target.clone(), true)).unwrap();
        fs::write(folder.path().join("new"), b"y").unwrap();
        folder.commit().unwrap();
        assert_eq!(fs::read(target.join("mine")).unwrap(), b"old");
        assert_eq!(fs::read(target.join("new")).unwrap(), b"y");
        assert_eq!(fs::read_dir(&target).unwrap().count(), 2);
        let e = OutputFolder::create(&args(target.join("mine"), true)).err().unwrap();
        assert_eq!(e.status() as i32, 6);
    }

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
