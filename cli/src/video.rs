//! [`Video`]: pictures one after another into one file: animated PNG, y4m, or mp4 through the program `ffmpeg`.

use crate::output::Stdout;
use crate::signals;
use sf_formats::apng::{Apng, Palette};
use sf_formats::atomic::{AtomicFile, Overwrite};
use sf_formats::image_io::Rgb8;
use sf_formats::y4m::Y4m;
use sf_formats::{Error, Result};
use std::fs;
use std::io::{self, Read, Write};
use std::path::{Path, PathBuf};
use std::process::{Child, ChildStdin, Command, Stdio};

/// What a video file is.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Container {
    Apng,
    Y4m,
    Mp4,
}

/// Shape of a video.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Shape {
    /// Width and height of every picture.
    pub(crate) size: (u32, u32),
    /// Number of pictures.
    pub(crate) frames: usize,
    /// Pictures per second.
    pub(crate) fps: f64,
}

/// A video being written; nothing of it is seen before [`Video::finish`].
pub(crate) enum Video {
    Apng(Apng<Shared>, Shared),
    File(Y4m<AtomicFile>, PathBuf),
    Stdout(Y4m<Stdout>),
    Mp4(Box<Mp4>),
}

impl Video {
    /// Starts a file; `-` is standard output, for y4m.
    pub(crate) fn create(
        container: Container,
        path: &Path,
        overwrite: Overwrite,
        shape: Shape,
        palette: Option<Palette>,
    ) -> Result<Video> {
        let Shape { size, frames, fps } = shape;
        if path.as_os_str() == "-" {
            return match container {
                Container::Y4m => {
                    Ok(Video::Stdout(Y4m::new(Stdout::open()?, size, fps).map_err(|e| failed(path, &e))?))
                }
                _ => Err(Error::usage("only y4m goes to standard output: add --format y4m")),
            };
        }
        signals::guard_file(path);
        match container {
            Container::Apng => {
                let file = Shared::new(AtomicFile::create(path, overwrite)?);
                Ok(Video::Apng(Apng::new(file.clone(), size, frames, fps, palette)?, file))
            }
            Container::Y4m => {
                let file = AtomicFile::create(path, overwrite)?;
                Ok(Video::File(Y4m::new(file, size, fps).map_err(|e| failed(path, &e))?, path.to_owned()))
            }
            Container::Mp4 => Ok(Video::Mp4(Box::new(Mp4::start(path, overwrite, size, fps)?))),
        }
    }

    /// Appends a picture.
    pub(crate) fn frame(&mut self, image: &Rgb8) -> Result<()> {
        match self {
            Video::Apng(a, _) => a.frame(image),
            Video::File(y, path) => y.frame(image).map_err(|e| failed(path, &e)),
            Video::Stdout(y) => y.frame(image).map_err(|e| failed(Path::new("standard output"), &e)),
            Video::Mp4(m) => m.frame(image),
        }
    }

    /// Makes the file visible.
    pub(crate) fn finish(self) -> Result<()> {
        match self {
            Video::Apng(a, file) => {
                a.finish()?;
                file.commit()
            }
            Video::File(y, path) => y.finish().map_err(|e| failed(&path, &e))?.commit(),
            Video::Stdout(y) => y.finish().map(drop).map_err(|e| failed(Path::new("standard output"), &e)),
            Video::Mp4(m) => m.finish(),
        }
    }
}

fn failed(path: &Path, e: &io::Error) -> Error {
    Error::io(path, "write", e)
}

/// A file that the PNG encoder writes and that is committed after it: the encoder keeps its writer to itself.
#[derive(Clone)]
pub(crate) struct Shared(std::rc::Rc<std::cell::RefCell<Option<AtomicFile>>>);

impl Shared {
    fn new(file: AtomicFile) -> Shared {
        Shared(std::rc::Rc::new(std::cell::RefCell::new(Some(file))))
    }

    fn commit(&self) -> Result<()> {
        match self.0.borrow_mut().take() {
            Some(file) => file.commit(),
            None => Err(Error::Internal("a video file is finished twice".into())),
        }
    }

    fn with<T>(&self, act: impl FnOnce(&mut AtomicFile) -> io::Result<T>) -> io::Result<T> {
        self.0.borrow_mut().as_mut().map_or_else(|| Err(io::Error::other("it is finished")), act)
    }
}

impl Write for Shared {
    fn write(&mut self, bytes: &[u8]) -> io::Result<usize> {
        self.with(|f| Write::write(f, bytes))
    }

    fn flush(&mut self) -> io::Result<()> {
        self.with(Write::flush)
    }
}

/// The running `ffmpeg`, which writes beside the target under a temporary name.
pub(crate) struct Mp4 {
    child: Child,
    pipe: Option<Y4m<ChildStdin>>,
    temp: PathBuf,
    target: PathBuf,
    done: bool,
}

impl Mp4 {
    fn start(target: &Path, overwrite: Overwrite, size: (u32, u32), fps: f64) -> Result<Mp4> {
        if overwrite == Overwrite::No && fs::symlink_metadata(target).is_ok() {
            let e = io::Error::new(io::ErrorKind::AlreadyExists, "it exists; pass --force to replace it");
            return Err(Error::io(target, "write", &e));
        }
        // Absolute, so that ffmpeg takes nothing in it for a protocol or an option.
        let target = std::path::absolute(target).map_err(|e| Error::io(target, "write", &e))?;
        let name = target.file_name().ok_or_else(|| Error::usage("output path has no file name"))?;
        let mut hidden = std::ffi::OsString::from(".");
        hidden.push(name);
        hidden.push(format!(".{}.tmp", std::process::id()));
        let temp = target.with_file_name(hidden);
        let spawned = Command::new("ffmpeg")
            .args(["-hide_banner", "-loglevel", "error", "-nostdin", "-y", "-f", "yuv4mpegpipe", "-i", "pipe:0"])
            // The usual encoders take even sizes only.
            .args(["-vf", "pad=ceil(iw/2)*2:ceil(ih/2)*2", "-pix_fmt", "yuv420p", "-movflags", "+faststart"])
            .args(["-f", "mp4"])
            .arg(&temp)
            .stdin(Stdio::piped())
            .stdout(Stdio::null())
            .stderr(Stdio::piped())
            .spawn();
        let mut child = spawned.map_err(|e| match e.kind() {
            io::ErrorKind::NotFound => Error::unsupported(
                "mp4",
                "needs the program ffmpeg on the PATH; without it write --format y4m or apng, or pipe elsewhere: \
                 streetforward render ... --format y4m -o - | ffmpeg -i - out.mp4",
            ),
            _ => Error::io(Path::new("ffmpeg"), "start", &e),
        })?;
        let pipe = child.stdin.take();
        let mut mp4 = Mp4 { child, pipe: None, temp, target, done: false };
        match pipe.map(|p| Y4m::new(p, size, fps)) {
            Some(Ok(y4m)) => mp4.pipe = Some(y4m),
            Some(Err(e)) => return Err(mp4.complaint(&e.to_string())),
            None => return Err(Error::Internal("ffmpeg has no standard input".into())),
        }
        Ok(mp4)
    }

    fn frame(&mut self, image: &Rgb8) -> Result<()> {
        let written = self.pipe.as_mut().map_or_else(|| Err(io::Error::other("closed")), |p| p.frame(image));
        written.map_err(|e| self.complaint(&e.to_string()))
    }

    /// What ffmpeg said last, else `why`.
    fn complaint(&mut self, why: &str) -> Error {
        self.pipe = None;
        let mut said = String::new();
        if let Some(mut stderr) = self.child.stderr.take() {
            // A loud program must not fill memory.
            let mut bytes = Vec::new();
            let _ = stderr.by_ref().take(1 << 16).read_to_end(&mut bytes);
            said = String::from_utf8_lossy(&bytes).into_owned();
        }
        let last = said.lines().rev().map(str::trim).find(|l| !l.is_empty()).unwrap_or(why);
        let last: String = last.chars().filter(|c| !c.is_control()).take(200).collect();
        Error::io(&self.target, "encode with ffmpeg", &io::Error::other(last))
    }

    fn finish(mut self) -> Result<()> {
        let flushed = self.pipe.take().map_or(Ok(()), |p| p.finish().map(drop));
        if let Err(e) = flushed {
            return Err(self.complaint(&e.to_string()));
        }
        let status = self.child.wait().map_err(|e| Error::io(Path::new("ffmpeg"), "wait for", &e))?;
        if !status.success() {
            return Err(self.complaint(&status.to_string()));
        }
        fs::rename(&self.temp, &self.target).map_err(|e| Error::io(&self.target, "finish writing", &e))?;
        self.done = true;
        Ok(())
    }
}

impl Drop for Mp4 {
    fn drop(&mut self) {
        if !self.done {
            self.pipe = None;
            let _ = self.child.kill();
            let _ = self.child.wait();
            let _ = fs::remove_file(&self.temp);
        }
    }
}
