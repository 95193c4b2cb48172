//! Flag groups and value parsers that several verbs share.
//!
//! Parsers refuse what cannot be read (exit 2). Values that are readable but unusable (a size of
//! 0x0, a time that is not a number, a singular camera) pass here and are refused by the code that
//! uses them, so that the exit code names the kind of fault (3 input, 5 resources).

use clap::{Args, ValueEnum};
use sf_formats::atomic::Overwrite;
use sf_formats::clip::{Clip, ClipOptions, MixedSizes, Orientation};
use sf_formats::{Dtype, Error, LoadMode};
use sf_ops::Kernels;
use sf_ops::cpu::Isa;
pub(crate) use sf_quant::names::glob;
use std::path::{Path, PathBuf};
use std::str::FromStr;

/// How the network runs; shared by the verbs that run it.
#[derive(Args, Clone, Debug)]
pub(crate) struct EngineArgs {
    /// Worker threads, at most 64; 0 takes what affinity and cgroup allow
    #[arg(help_heading = "Engine", long, value_name = "N", default_value_t = 0, value_parser = clap::value_parser!(u32).range(0..=64))]
    pub(crate) threads: u32,
    /// Highest instruction set to use: scalar, avx2, avxvnni, avx512, avx512vnni, neon, neondot
    #[arg(help_heading = "Engine", long, value_name = "ISA", value_parser = isa)]
    pub(crate) isa: Option<Isa>,
    /// Memory budget of working memory and results: bytes, or with K, M, G; default 8G
    #[arg(help_heading = "Engine", long, value_name = "BYTES", value_parser = bytes)]
    pub(crate) max_mem: Option<u64>,
    /// How the weight blob is read
    #[arg(help_heading = "Engine", long, value_enum, default_value_t = Load::Map)]
    pub(crate) load: Load,
}

/// Worker threads a `--threads` value stands for: 0 is what affinity and cgroup allow, at most 64.
pub(crate) fn threads(flag: u32) -> usize {
    match flag {
        0 => std::thread::available_parallelism().map_or(1, usize::from).min(64),
        n => n as usize,
    }
}

/// The kernels under `--isa`, or under the environment variable `STREETFORWARD_CPU`.
pub(crate) fn kernels(isa: Option<Isa>) -> sf_formats::Result<&'static Kernels> {
    match isa {
        Some(isa) => Kernels::capped(isa).map_err(|why| Error::unsupported("--isa", why)),
        None => Kernels::from_env().map_err(|why| Error::unsupported("environment", why)),
    }
}

/// An instruction set by name.
pub(crate) fn isa(text: &str) -> Result<Isa, String> {
    Isa::parse(text).ok_or_else(|| {
        let names: Vec<&str> = Isa::ALL.iter().map(|i| i.name()).collect();
        format!("known are {}", names.join(", "))
    })
}

/// How the weight blob is read.
#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum)]
pub(crate) enum Load {
    /// Memory-map the file: nothing is copied
    Map,
    /// Read it into memory: safe against later changes of the file
    Copy,
}

impl Load {
    /// As the blob reader names it.
    pub(crate) fn mode(self) -> LoadMode {
        match self {
            Load::Map => LoadMode::Map,
            Load::Copy => LoadMode::Copy,
        }
    }
}

/// Stored precision of weight matrices.
#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum)]
pub(crate) enum Precision {
    /// 32-bit floats
    F32,
    /// 16-bit floats, computed in 32 bits
    F16,
    /// 8-bit integers; sensitive layers stay floats
    Int8,
}

impl Precision {
    /// As the blob names it.
    pub(crate) fn dtype(self) -> Dtype {
        match self {
            Precision::F32 => Dtype::F32,
            Precision::F16 => Dtype::F16,
            Precision::Int8 => Dtype::Int8,
        }
    }
}

/// Width and height in pixels.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) struct Size {
    pub(crate) width: u32,
    pub(crate) height: u32,
}

impl FromStr for Size {
    type Err = String;

    fn from_str(text: &str) -> Result<Size, String> {
        let parse = |t: &str| t.parse::<u32>().ok();
        match text.split_once(['x', 'X']).map(|(w, h)| (parse(w), parse(h))) {
            Some((Some(width), Some(height))) => Ok(Size { width, height }),
            _ => Err("a size is WIDTHxHEIGHT in pixels, as 252x168".into()),
        }
    }
}

impl std::fmt::Display for Size {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        write!(f, "{}x{}", self.width, self.height)
    }
}

/// Bytes: a whole number, or one with K, M, G, T (powers of 1024).
pub(crate) fn bytes(text: &str) -> Result<u64, String> {
    let (digits, factor) = match text
        .trim_end_matches(['B', 'b'])
        .trim_end_matches('i')
        .split_at_checked(text.find(|c: char| !c.is_ascii_digit() && c != '.').unwrap_or(text.len()))
    {
        Some((d, "")) => (d, 1u64),
        Some((d, "k" | "K")) => (d, 1 << 10),
        Some((d, "m" | "M")) => (d, 1 << 20),
        Some((d, "g" | "G")) => (d, 1 << 30),
        Some((d, "t" | "T")) => (d, 1 << 40),
        _ => return Err("bytes are a number, or one with K, M, G, T, as 512M".into()),
    };
    let n: f64 = digits.parse().map_err(|_| "bytes are a number, or one with K, M, G, T, as 512M".to_string())?;
    let total = n * factor as f64;
    if total < 1.0 || total > (1u64 << 60) as f64 {
        return Err("must be between 1 byte and 2^60 bytes".into());
    }
    Ok(total as u64)
}

/// Most times one command takes.
const MAX_TIMES: usize = 100_000;

/// Times in seconds: a comma list whose members are numbers or `FIRST:LAST:STEP` (last included).
#[derive(Clone, Debug, PartialEq)]
pub(crate) struct Times(pub(crate) Vec<f64>);

impl FromStr for Times {
    type Err = String;

    fn from_str(text: &str) -> Result<Times, String> {
        let number = |t: &str| t.trim().parse::<f64>().map_err(|_| format!("{t:?} is not a number of seconds"));
        let mut list = Vec::new();
        for part in text.split(',') {
            let fields: Vec<&str> = part.split(':').collect();
            match fields[..] {
                [one] => list.push(number(one)?),
                [first, last, step] => {
                    let (first, last, step) = (number(first)?, number(last)?, number(step)?);
                    let steps = (last - first) / step;
                    // A millionth of a step forgives decimal rounding: 0:2:0.1 has 21 members.
                    if !(steps >= -1e-6 && steps < MAX_TIMES as f64) {
                        return Err(format!("{part:?} is not FIRST:LAST:STEP with at most {MAX_TIMES} steps"));
                    }
                    list.extend((0..=(steps + 1e-6) as usize).map(|i| first + i as f64 * step));
                }
                _ => return Err(format!("{part:?} is neither a number nor FIRST:LAST:STEP")),
            }
        }
        if list.len() > MAX_TIMES {
            return Err(format!("{} times are more than {MAX_TIMES}", list.len()));
        }
        Ok(Times(list))
    }
}

/// A displacement of the camera in its own axes.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub(crate) struct Shift {
    /// Scene units to the right.
    pub(crate) right: f64,
    /// Scene units up.
    pub(crate) up: f64,
    /// Scene units forward.
    pub(crate) forward: f64,
    /// Degrees to the right about the vertical axis.
    pub(crate) yaw: f64,
    /// Degrees upwards.
    pub(crate) pitch: f64,
    /// Degrees clockwise.
    pub(crate) roll: f64,
}

impl FromStr for Shift {
    type Err = String;

    fn from_str(text: &str) -> Result<Shift, String> {
        let mut shift = Shift::default();
        for part in text.split(',') {
            let (key, value) = part.split_once('=').ok_or_else(|| format!("{part:?} is not KEY=NUMBER"))?;
            let value: f64 = value.trim().parse().map_err(|_| format!("{part:?} is not KEY=NUMBER"))?;
            if value.is_nan() || value.abs() > 1e6 {
                return Err(format!("{part:?} is beyond 1e6"));
            }
            let (field, sign) = match key.trim() {
                "right" => (&mut shift.right, 1.0),
                "left" => (&mut shift.right, -1.0),
                "up" => (&mut shift.up, 1.0),
                "down" => (&mut shift.up, -1.0),
                "forward" => (&mut shift.forward, 1.0),
                "back" => (&mut shift.forward, -1.0),
                "yaw" => (&mut shift.yaw, 1.0),
                "pitch" => (&mut shift.pitch, 1.0),
                "roll" => (&mut shift.roll, 1.0),
                _ => return Err("keys are right, left, up, down, forward, back, yaw, pitch, roll".into()),
            };
            *field += sign * value;
        }
        Ok(shift)
    }
}

/// Whether a path's name ends in an extension, in any case.
pub(crate) fn has_extension(path: &Path, wanted: &[&str]) -> bool {
    path.extension().and_then(|e| e.to_str()).is_some_and(|e| wanted.iter().any(|w| e.eq_ignore_ascii_case(w)))
}

/// A path as JSON text; bytes that are not UTF-8 are replaced.
pub(crate) fn path_json(path: &Path) -> serde_json::Value {
    path.to_string_lossy().into()
}

/// Which clip, and how it is read.
#[derive(Args, Clone, Debug)]
pub(crate) struct ClipArgs {
    /// Folder of pictures, transforms.json, or a list file with one picture (and time) a line
    #[arg(short, long, value_name = "CLIP")]
    pub(crate) input: PathBuf,
    /// Pictures to use, from 0, as 0,5,10,15; default: all
    #[arg(long, value_name = "LIST", value_delimiter = ',')]
    pub(crate) frames: Option<Vec<usize>>,
    /// Pictures per second, where the clip has no times of its own; default 10
    #[arg(long, value_name = "FPS")]
    pub(crate) fps: Option<f64>,
    /// Seconds of every picture, in place of what the clip says
    #[arg(long, value_name = "LIST", allow_hyphen_values = true, conflicts_with = "fps")]
    pub(crate) times: Option<Times>,
    /// Accept pictures of different sizes
    #[arg(long)]
    pub(crate) resize: bool,
    /// Take pictures as stored, whatever orientation their EXIF data tell
    #[arg(long)]
    pub(crate) ignore_orientation: bool,
}

impl ClipArgs {
    /// Opens the clip.
    pub(crate) fn open(&self) -> sf_formats::Result<Clip> {
        let options = ClipOptions {
            fps: self.fps,
            times: self.times.as_ref().map(|t| t.0.clone()),
            frames: self.frames.clone(),
            mixed_sizes: if self.resize { MixedSizes::Allow } else { MixedSizes::Refuse },
            orientation: if self.ignore_orientation { Orientation::Ignore } else { Orientation::Apply },
            ..ClipOptions::default()
        };
        Clip::open(&self.input, &options)
    }
}

/// The output file flags of verbs that write one file.
#[derive(Args, Clone, Debug)]
pub(crate) struct FileArgs {
    /// File to write
    #[arg(short, long, value_name = "FILE")]
    pub(crate) output: PathBuf,
    /// Replace an existing file
    #[arg(long)]
    pub(crate) force: bool,
}

impl FileArgs {
    /// Whether an existing file may be replaced.
    pub(crate) fn overwrite(&self) -> Overwrite {
        if self.force { Overwrite::Yes } else { Overwrite::No }
    }
}

/// The output folder flags of verbs that write a folder.
#[derive(Args, Clone, Debug)]
pub(crate) struct FolderArgs {
    /// Folder to write; made where it does not exist
    #[arg(short, long, value_name = "DIR")]
    pub(crate) output: PathBuf,
    /// Write into a folder that is not empty, replacing files of the same names
    #[arg(long)]
    pub(crate) force: bool,
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn sizes() {
        assert_eq!("252x168".parse::<Size>().unwrap(), Size { width: 252, height: 168 });
        assert_eq!("0x0".parse::<Size>().unwrap().to_string(), "0x0");
        for bad in ["", "252", "252x", "x168", "-1x5", "252x168x3", "2.5x4", "4294967296x1"] {
            assert!(bad.parse::<Size>().is_err(), "{bad}");
        }
    }

    #[test]
    fn byte_amounts() {
        for (text, n) in [
            ("1", 1),
            ("512", 512),
            ("4K", 4096),
            ("2M", 2 << 20),
            ("1.5G", 3 << 29),
            ("2GiB", 2 << 30),
            ("3MB", 3 << 20),
            ("1t", 1 << 40),
        ] {
            assert_eq!(bytes(text), Ok(n), "{text}");
        }
        for bad in ["", "G", "0", "-1", "1Q", "1e30", "nan", "99999999T", "1.2.3", "5 G"] {
            assert!(bytes(bad).is_err(), "{bad}");
        }
    }

    #[test]
    fn times_are_lists_and_ranges_with_both_ends() {
        let t = "0:2:0.1".parse::<Times>().unwrap().0;
        assert_eq!(t.len(), 21);
        assert!((t[20] - 2.0).abs() < 1e-9);
        assert_eq!("0.5,1,2:1:-0.5".parse::<Times>().unwrap().0, [0.5, 1.0, 2.0, 1.5, 1.0]);
        assert_eq!("1:1:0.5".parse::<Times>().unwrap().0, [1.0]);
        // Readable, refused later as input.
        assert!("nan".parse::<Times>().unwrap().0[0].is_nan());
        for bad in ["", "a", "0:1", "0:1:0", "0:1:-1", "0:1:nan", "0:1e9:1e-9", "0:1:2:3", "1,,2"] {
            assert!(bad.parse::<Times>().is_err(), "{bad}");
        }
    }

    #[test]
    fn shifts_name_their_directions() {
        let s = "right=1.5,up=0.3,yaw=5".parse::<Shift>().unwrap();
        assert_eq!((s.right, s.up, s.yaw, s.forward), (1.5, 0.3, 5.0, 0.0));
        let s = "left=1,down=2,back=3".parse::<Shift>().unwrap();
        assert_eq!((s.right, s.up, s.forward), (-1.0, -2.0, -3.0));
        for bad in ["", "right", "right=", "sideways=1", "right=nan", "right=1e9", "right=inf"] {
            assert!(bad.parse::<Shift>().is_err(), "{bad}");
        }
    }

    #[test]
    fn globs() {
        for (pattern, name, want) in [
            ("*", "", true),
            ("", "", true),
            ("", "a", false),
            ("decoder.*", "decoder.3.attn.qkv.weight", true),
            ("*.weight", "decoder.3.attn.qkv.weight", true),
            ("*.weight", "decoder.3.attn.qkv.bias", false),
            ("decoder.?.attn.*", "decoder.3.attn.qkv.bias", true),
            ("decoder.?.attn.*", "decoder.13.attn.qkv.bias", false),
            ("*a*b", "xaybzab", true),
            ("a*b*c", "abcb", false),
            ("gs", "gs_head", false),
        ] {
            assert_eq!(glob(pattern, name), want, "{pattern} {name}");
        }
    }

    #[test]
    fn extensions_ignore_case() {
        assert!(has_extension(Path::new("a/b.SFW"), &["sfw"]));
        assert!(!has_extension(Path::new("a.sfw/b"), &["sfw"]));
        assert!(has_extension(Path::new("x.pt"), &["pth", "pt"]));
    }
}
