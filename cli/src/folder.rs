//! [`OutputFolder`]: result folders that appear whole or not at all.

use crate::args::FolderArgs;
use crate::signals;
use sf_formats::{Error, Result};
use std::ffi::OsString;
use std::fs;
use std::io;
use std::path::{Path, PathBuf};

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

    /// The hidden folder beside the target that collects the files until [`OutputFolder::commit`] renames it.
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
}
