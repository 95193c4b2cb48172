//! Gaussian splats as PLY, with the attribute names and conventions of the INRIA implementation.
//!
//! Binary little-endian, one element `vertex`: `x y z nx ny nz f_dc_0..2 opacity scale_0..2 rot_0..3`.
//! Opacity is stored as its logit, scale as natural logarithm, rotation as w x y z, colour =
//! 0.5 + 0.28209479177387814 f_dc. Moving scenes add, last, so that every viewer still opens them:
//! `t0` (s), `vel_fwd_{x,y,z}` and `vel_bwd_{x,y,z}` (world axes, scene units per second), `dyn` (0..1),
//! `src_frame`.
//!
//! Reading takes the properties in any order and of any scalar type, and skips what it does not know.

use crate::atomic::{AtomicFile, Overwrite};
use crate::error::{Error, Result, escape, escape_path};
use crate::open::open_regular;
use crate::real::{exp, ln};
use crate::scene::{Compose, Gaussians, Scene};
use std::io::{BufRead, BufReader, Read};
use std::path::Path;

/// First spherical-harmonic basis function, 1 / (2 sqrt(pi)).
pub const SH_C0: f64 = 0.282_094_791_773_878_14;
/// Opacities are kept this far from 0 and 1 when written: the logit of those is infinite.
pub const OPACITY_MARGIN: f64 = 5e-7;
/// Standard deviations that are read, scene units; others are dropped.
pub const SCALE_RANGE: (f64, f64) = (1e-12, 1e6);
/// Largest absolute coordinate or speed that is read.
pub const FAR: f32 = 1e7;
/// Share of dropped Gaussians over which a scene counts as degraded.
pub const DEGRADED: f64 = 0.01;

/// Longest header, and most properties in it.
const HEADER_CAP: usize = 1 << 16;
const PROPERTY_CAP: usize = 512;
/// Most Gaussians that a scene indexes.
const COUNT_CAP: u64 = u32::MAX as u64;

/// What reading a scene had to leave out or change.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct LoadReport {
    /// Gaussians in the file.
    pub total: usize,
    /// Dropped: a field was NaN, infinite or beyond [`FAR`].
    pub not_finite: usize,
    /// Dropped: a scale outside [`SCALE_RANGE`].
    pub bad_scale: usize,
    /// Dropped: a rotation of length zero.
    pub zero_rotation: usize,
    /// Dropped: a source frame that the scene does not have.
    pub bad_source: usize,
    /// Kept: a dynamic probability outside 0..1, clamped.
    pub clamped: usize,
    /// More than 1 % was dropped.
    pub degraded: bool,
    /// What was ignored.
    pub notes: Vec<String>,
}

impl LoadReport {
    /// Gaussians that were left out.
    pub fn dropped(&self) -> usize {
        self.not_finite + self.bad_scale + self.zero_rotation + self.bad_source
    }
}

/// Splats as a file holds them, after the checks.
#[derive(Clone, Debug, Default, PartialEq)]
pub(crate) struct Splats {
    pub(crate) gaussians: Gaussians,
    pub(crate) v_fwd: Vec<[f32; 3]>,
    pub(crate) v_bwd: Vec<[f32; 3]>,
    pub(crate) dynamic: Vec<f32>,
    pub(crate) source: Vec<u32>,
}

const STANDARD: [&str; 17] = [
    "x", "y", "z", "nx", "ny", "nz", "f_dc_0", "f_dc_1", "f_dc_2", "opacity", "scale_0", "scale_1", "scale_2", "rot_0",
    "rot_1", "rot_2", "rot_3",
];
const MOTION: [&str; 9] =
    ["t0", "vel_fwd_x", "vel_fwd_y", "vel_fwd_z", "vel_bwd_x", "vel_bwd_y", "vel_bwd_z", "dyn", "src_frame"];

/// Bytes of a file's start up to `end_header`.
fn header(comments: &[String], count: usize, properties: &[&[&str]]) -> String {
    let mut h = String::from("ply\nformat binary_little_endian 1.0\n");
    for c in comments {
        h.push_str(&format!("comment {c}\n"));
    }
    h.push_str(&format!("element vertex {count}\n"));
    for name in properties.iter().copied().flatten() {
        h.push_str(&format!("property float {name}\n"));
    }
    h + "end_header\n"
}

/// Appends one splat's standard properties.
fn push_standard(row: &mut Vec<u8>, g: &Gaussians, i: usize) -> Result<()> {
    let (mean, scale, quat, opacity, colour) = (g.mean[i], g.scale[i], g.quat[i], g.opacity[i], g.colour[i]);
    let fields = mean.iter().chain(&scale).chain(&quat).chain(&colour).chain([&opacity]);
    if fields.into_iter().any(|v| !v.is_finite()) || scale.iter().any(|&s| !s.is_normal() || s < 0.0) {
        let why = format!("mean {mean:?}, scale {scale:?}, opacity {opacity}: not finite, or a scale is not positive");
        return Err(Error::integrity(format!("gaussian {i}"), why));
    }
    let mut put = |v: f64| row.extend((v as f32).to_le_bytes());
    mean.iter().for_each(|&v| put(v.into()));
    (0..3).for_each(|_| put(0.0));
    colour.iter().for_each(|&c| put((f64::from(c) - 0.5) / SH_C0));
    let p = f64::from(opacity).clamp(OPACITY_MARGIN, 1.0 - OPACITY_MARGIN);
    put(ln(p / (1.0 - p)));
    scale.iter().for_each(|&s| put(ln(s.into())));
    quat.iter().for_each(|&q| put(q.into()));
    Ok(())
}

/// Writes Gaussians as a plain INRIA file that every splat viewer opens.
pub fn export_ply(g: &Gaussians, path: &Path, overwrite: Overwrite) -> Result<()> {
    let comments = ["StreetForward static splats".to_owned(), AXES.to_owned()];
    let mut file = AtomicFile::create(path, overwrite)?;
    AtomicFile::write(&mut file, header(&comments, g.len(), &[&STANDARD]).as_bytes())?;
    let mut row = Vec::with_capacity(4 * STANDARD.len());
    for i in 0..g.len() {
        row.clear();
        push_standard(&mut row, g, i)?;
        AtomicFile::write(&mut file, &row)?;
    }
    file.commit()
}

const AXES: &str = "axes: OpenCV (x right, y down, z forward), world = first camera; lengths in scene units";

/// Writes one plain file per time, `frame_00000.ply` and so on: the composition baked, as sequence
/// players expect it. Gives the number of files.
pub fn export_sequence(
    scene: &Scene,
    rules: &Compose,
    times: &[f64],
    folder: &Path,
    overwrite: Overwrite,
) -> Result<usize> {
    crate::truth::output_folder(folder, overwrite)?;
    let mut now = Gaussians::default();
    for (n, &time) in times.iter().enumerate() {
        scene.at_into(time, rules, &mut now)?;
        export_ply(&now, &folder.join(format!("frame_{n:05}.ply")), overwrite)?;
    }
    Ok(times.len())
}

/// Writes a whole scene: standard properties, then motion.
pub(crate) fn write_scene(scene: &Scene, path: &Path, overwrite: Overwrite) -> Result<()> {
    let comments = [
        "StreetForward scene 1".to_owned(),
        AXES.to_owned(),
        "t0 in seconds; vel_fwd, vel_bwd in scene units per second; dyn is a probability".to_owned(),
        "position at time t: dynamic splats move by (t - t0) vel_fwd, or (t0 - t) vel_bwd".to_owned(),
    ];
    let mut file = AtomicFile::create(path, overwrite)?;
    AtomicFile::write(&mut file, header(&comments, scene.len(), &[&STANDARD, &MOTION]).as_bytes())?;
    let mut row = Vec::with_capacity(4 * (STANDARD.len() + MOTION.len()));
    for i in 0..scene.len() {
        row.clear();
        push_standard(&mut row, &scene.gaussians, i)?;
        let source = scene.source[i];
        let time = scene.frames.get(source as usize).map_or(0.0, |f| f.time as f32);
        let (f, b) = (scene.v_fwd[i], scene.v_bwd[i]);
        let motion = [time, f[0], f[1], f[2], b[0], b[1], b[2], scene.dynamic[i], source as f32];
        if motion.iter().any(|v| !v.is_finite()) {
            let why = format!("velocity {f:?} / {b:?}, dynamic {}: not finite", scene.dynamic[i]);
            return Err(Error::integrity(format!("gaussian {i}"), why));
        }
        motion.iter().for_each(|v| row.extend(v.to_le_bytes()));
        AtomicFile::write(&mut file, &row)?;
    }
    file.commit()
}

/// A scalar type of the format.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Scalar {
    I8,
    U8,
    I16,
    U16,
    I32,
    U32,
    F32,
    F64,
}

impl Scalar {
    fn of(name: &str) -> Option<Scalar> {
        Some(match name {
            "char" | "int8" => Scalar::I8,
            "uchar" | "uint8" => Scalar::U8,
            "short" | "int16" => Scalar::I16,
            "ushort" | "uint16" => Scalar::U16,
            "int" | "int32" => Scalar::I32,
            "uint" | "uint32" => Scalar::U32,
            "float" | "float32" => Scalar::F32,
            "double" | "float64" => Scalar::F64,
            _ => return None,
        })
    }

    fn size(self) -> u64 {
        match self {
            Scalar::I8 | Scalar::U8 => 1,
            Scalar::I16 | Scalar::U16 => 2,
            Scalar::I32 | Scalar::U32 | Scalar::F32 => 4,
            Scalar::F64 => 8,
        }
    }

    fn read(self, b: &[u8]) -> f64 {
        match self {
            Scalar::I8 => f64::from(b[0] as i8),
            Scalar::U8 => f64::from(b[0]),
            Scalar::I16 => f64::from(i16::from_le_bytes([b[0], b[1]])),
            Scalar::U16 => f64::from(u16::from_le_bytes([b[0], b[1]])),
            Scalar::I32 => f64::from(i32::from_le_bytes([b[0], b[1], b[2], b[3]])),
            Scalar::U32 => f64::from(u32::from_le_bytes([b[0], b[1], b[2], b[3]])),
            Scalar::F32 => f64::from(f32::from_le_bytes([b[0], b[1], b[2], b[3]])),
            Scalar::F64 => f64::from_le_bytes([b[0], b[1], b[2], b[3], b[4], b[5], b[6], b[7]]),
        }
    }
}

/// Where a property lies in a row.
#[derive(Clone, Debug, PartialEq, Eq)]
struct Property {
    name: String,
    offset: u64,
    scalar: Scalar,
}

/// The `vertex` element of a file.
#[derive(Debug, PartialEq, Eq)]
struct Layout {
    /// Bytes of other elements before the first row.
    skip: u64,
    count: u64,
    row: u64,
    properties: Vec<Property>,
}

/// Reads the header's lines and checks the count against the file's length.
fn read_header(reader: &mut impl BufRead, file_len: u64, at: &str) -> Result<Layout> {
    let fault = |why: String| Error::input(at, why);
    let mut used = 0usize;
    let mut line = Vec::new();
    let mut next = |line: &mut Vec<u8>| -> Result<()> {
        line.clear();
        let limit = (HEADER_CAP - used.min(HEADER_CAP)) as u64;
        reader
            .by_ref()
            .take(limit)
            .read_until(b'\n', line)
            .map_err(|e| Error::Io { at: at.to_owned(), why: format!("cannot read: {e}") })?;
        used += line.len();
        if line.pop() != Some(b'\n') {
            return Err(fault(format!("PLY header without end_header in its first {} KiB", HEADER_CAP >> 10)));
        }
        if line.last() == Some(&b'\r') {
            line.pop();
        }
        Ok(())
    };
    next(&mut line)?;
    if line != b"ply" {
        return Err(fault("does not start with 'ply'".into()));
    }
    // Bytes of the elements before `vertex`, then `vertex` itself, then those behind it.
    let (mut format, mut before, mut after) = (false, 0u64, 0u64);
    let mut elements: Vec<(String, u64, u64, bool)> = Vec::new();
    let mut properties: Vec<Property> = Vec::new();
    loop {
        next(&mut line)?;
        let text = std::str::from_utf8(&line).map_err(|_| fault(format!("header line '{}'", escape(&line))))?;
        let words: Vec<&str> = text.split_ascii_whitespace().collect();
        let bad = || fault(format!("header line '{}' is not understood", escape(text.as_bytes())));
        match words[..] {
            [] | ["comment" | "obj_info", ..] => {}
            ["format", "binary_little_endian", "1.0"] => format = true,
            ["format", kind, ..] => {
                let why = format!("PLY format '{}'; binary_little_endian 1.0 is read", escape(kind.as_bytes()));
                return Err(Error::unsupported(at, why));
            }
            ["element", name, count] => {
                let count = count.parse().map_err(|_| bad())?;
                if elements.len() == PROPERTY_CAP || elements.iter().any(|e| e.0 == name) {
                    return Err(bad());
                }
                elements.push((name.to_owned(), count, 0, false));
            }
            ["property", "list", _, _, _] => elements.last_mut().ok_or_else(bad)?.3 = true,
            ["property", kind, name] => {
                let scalar = Scalar::of(kind).ok_or_else(bad)?;
                let (element, _, row, _) = elements.last_mut().ok_or_else(bad)?;
                if element == "vertex" {
                    if properties.len() == PROPERTY_CAP || properties.iter().any(|p| p.name == name) {
                        return Err(bad());
                    }
                    properties.push(Property { name: name.to_owned(), offset: *row, scalar });
                }
                *row += scalar.size();
            }
            ["end_header"] => break,
            _ => return Err(bad()),
        }
    }
    if !format {
        return Err(fault("PLY header without a format line".into()));
    }
    let vertex = elements.iter().position(|e| e.0 == "vertex");
    let vertex = vertex.ok_or_else(|| fault("PLY file without a 'vertex' element".into()))?;
    let mut open_end = false;
    for (i, (name, count, row, list)) in elements.iter().enumerate() {
        let bytes =
            count.checked_mul(*row).ok_or_else(|| fault(format!("{count} rows of '{}'", escape(name.as_bytes()))))?;
        let sum = if i < vertex { &mut before } else { &mut after };
        *sum = sum.checked_add(bytes).ok_or_else(|| fault("element sizes overflow".into()))?;
        match (*list, i.cmp(&vertex)) {
            (false, _) => {}
            (true, std::cmp::Ordering::Greater) => open_end = true,
            (true, _) => return Err(Error::unsupported(at, "PLY list properties at or before the splats")),
        }
    }
    let (_, count, row, _) = elements[vertex];
    if count > COUNT_CAP {
        return Err(fault(format!("{count} splats; the limit is {COUNT_CAP}")));
    }
    let need = (used as u64).checked_add(before).and_then(|n| n.checked_add(after));
    let fits = need.is_some_and(|n| if open_end { n <= file_len } else { n == file_len });
    if !fits {
        let why = format!("{count} splats of {row} bytes do not match the file's {file_len} bytes: truncated?");
        return Err(fault(why));
    }
    Ok(Layout { skip: before, count, row, properties })
}

/// Reads splats from a file: ours, or any INRIA file. `frames` is the number of source frames that
/// exist, if known.
pub(crate) fn read(path: &Path, frames: Option<usize>) -> Result<(Splats, LoadReport)> {
    let (file, identity) = open_regular(path)?;
    let length = identity.bytes();
    read_from(BufReader::with_capacity(1 << 16, file), length, &escape_path(path), frames)
}

/// [`read`] from anything buffered, `length` bytes long.
pub(crate) fn read_from(
    mut reader: impl BufRead,
    length: u64,
    at: &str,
    frames: Option<usize>,
) -> Result<(Splats, LoadReport)> {
    let layout = read_header(&mut reader, length, at)?;
    let find = |name: &str| layout.properties.iter().find(|p| p.name == name);
    let need = |names: &[&str]| -> Result<Vec<Property>> {
        names
            .iter()
            .map(|name| {
                find(name).cloned().ok_or_else(|| {
                    let packed = find("packed_position").is_some();
                    let what = if packed { "compressed splats are not read" } else { "not a splat file" };
                    Error::unsupported(at, format!("PLY without the property '{name}': {what}"))
                })
            })
            .collect()
    };
    let (mean, scale, quat) = (
        need(&["x", "y", "z"])?,
        need(&["scale_0", "scale_1", "scale_2"])?,
        need(&["rot_0", "rot_1", "rot_2", "rot_3"])?,
    );
    let (opacity, colour) = (need(&["opacity"])?, need(&["f_dc_0", "f_dc_1", "f_dc_2"])?);
    let optional = |names: &[&str]| names.iter().map(|n| find(n).cloned()).collect::<Option<Vec<_>>>();
    let v_fwd = optional(&MOTION[1..4]);
    let v_bwd = optional(&MOTION[4..7]);
    let (dynamic, source) = (optional(&["dyn"]), optional(&["src_frame"]));

    let mut report = LoadReport { total: layout.count as usize, ..LoadReport::default() };
    if find("f_rest_0").is_some() {
        report.notes.push("view-dependent colour (f_rest_*) is ignored".into());
    }
    if v_fwd.is_none() || v_bwd.is_none() || dynamic.is_none() {
        report.notes.push("no motion properties: a static scene".into());
    }
    let cannot = |e: std::io::Error| Error::Io { at: at.to_owned(), why: format!("cannot read: {e}") };
    std::io::copy(&mut reader.by_ref().take(layout.skip), &mut std::io::sink()).map_err(cannot)?;
    let mut splats = Splats::default();
    // The count matches the file's length; 56 bytes a splat in memory, never more than the file.
    splats.gaussians.reserve(layout.count.min(length / 56) as usize);
    let mut row = vec![0u8; layout.row as usize];
    for _ in 0..layout.count {
        reader.read_exact(&mut row).map_err(cannot)?;
        let value = |p: &Property| p.scalar.read(&row[p.offset as usize..]);
        let three = |ps: &[Property]| [0, 1, 2].map(|i| value(&ps[i]) as f32);
        let (m, q) = (three(&mean), [0, 1, 2, 3].map(|i| value(&quat[i]) as f32));
        let log_scale = [0, 1, 2].map(|i| value(&scale[i]));
        let logit = value(&opacity[0]);
        let c = three(&colour).map(|c| (0.5 + SH_C0 * f64::from(c)) as f32);
        let (vf, vb) = (v_fwd.as_deref().map_or([0.0; 3], three), v_bwd.as_deref().map_or([0.0; 3], three));
        let p = dynamic.as_ref().map_or(0.0, |d| value(&d[0]) as f32);
        let from = source.as_ref().map_or(0.0, |s| value(&s[0]));
        let bounded = m.iter().chain(&vf).chain(&vb).all(|v| v.abs() <= FAR);
        let finite = q.iter().chain(&c).all(|v| v.is_finite()) && log_scale.iter().all(|v| v.is_finite());
        if !(bounded && finite && logit.is_finite() && p.is_finite() && from.is_finite()) {
            report.not_finite += 1;
            continue;
        }
        let s = log_scale.map(exp);
        if s.iter().any(|&s| s < SCALE_RANGE.0 || s > SCALE_RANGE.1) {
            report.bad_scale += 1;
            continue;
        }
        let norm: f32 = q.iter().map(|v| v * v).sum();
        if !(norm.is_normal() && norm > 1e-12) {
            report.zero_rotation += 1;
            continue;
        }
        let known = frames.unwrap_or(usize::MAX).min(u32::MAX as usize);
        if from < 0.0 || from.fract() != 0.0 || (from as usize >= known && frames.is_some()) || from > 1e9 {
            report.bad_source += 1;
            continue;
        }
        report.clamped += usize::from(!(0.0..=1.0).contains(&p));
        let g = &mut splats.gaussians;
        g.mean.push(m);
        g.scale.push(s.map(|s| s as f32));
        g.quat.push(q);
        g.opacity.push((1.0 / (1.0 + exp(-logit))) as f32);
        g.colour.push(c);
        splats.v_fwd.push(vf);
        splats.v_bwd.push(vb);
        splats.dynamic.push(p.clamp(0.0, 1.0));
        splats.source.push(from as u32);
    }
    report.degraded = report.dropped() as f64 > DEGRADED * report.total as f64;
    Ok((splats, report))
}
