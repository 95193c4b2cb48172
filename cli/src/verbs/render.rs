//! `render`: pictures of a scene from new places at new times, as a folder or as one animation.
//!
//! ```text
//! DIR/rgb/000000.png ...          the pictures, one per view
//! DIR/real/000000.png             the clip's picture nearest in time (--clip)
//! DIR/depth/000000.npy, .png      expected z-depth [H, W], 0 where nothing is; coloured
//! DIR/depth-sum/000000.npy        depth weighted by coverage, sum T alpha z
//! DIR/alpha/000000.png            coverage, gray
//! DIR/velocity/000000.npy, .png   [H, W, 3] world axes, scene units per second; direction as hue
//! DIR/dynamic/000000.png          dynamic probability, gray; 000000_overlay.png over the picture
//! DIR/depth/scale.png ...         what the colours mean
//! DIR/cameras.json                the views, in the format that --path reads
//! FILE.apng, .y4m, .mp4           the buffers side by side, one view after another
//! ```

use crate::args::FolderArgs;
use crate::args::{Shift, Size, Times, has_extension, path_json};
use crate::folder::OutputFolder;
use crate::output::{Console, files_json, human_bytes};
use crate::reals::Reals;
use crate::video::{Container, Shape, Video};
use crate::views::{self, Rig, Track};
use clap::ValueEnum;
use serde_json::{Value, json};
use sf_formats::apng::Palette;
use sf_formats::atomic::Overwrite;
use sf_formats::camera_json::{self, TimedCamera};
use sf_formats::config::{SelfRule, Split};
use sf_formats::error::escape_path;
use sf_formats::image_io::{self, Rgb8};
use sf_formats::picture::{self, DepthScale};
use sf_formats::{Error, Result, Scene, npy};
use sf_splat::{Extra, RenderOptions, Rendered, Renderer};
use std::path::{Path, PathBuf};
use std::time::Instant;

/// What to draw from where.
#[derive(clap::Args)]
pub(crate) struct Args {
    /// Scene folder that `run` wrote, or a .ply file
    #[arg(short, long, value_name = "SCENE")]
    scene: PathBuf,
    /// Folder for pictures; file for an animation, `-` for y4m on standard output
    #[arg(short, long, value_name = "PATH")]
    output: PathBuf,
    /// Write into a folder that is not empty, or replace the file
    #[arg(long)]
    force: bool,
    /// Seconds: a list of numbers and FIRST:LAST:STEP ranges; default: the input times
    #[arg(long, value_name = "LIST", allow_hyphen_values = true)]
    times: Option<Times>,
    /// Cameras interpolated along the input cameras (default)
    #[arg(long)]
    follow: bool,
    /// Behind and above the input cameras: BACK scene units behind, a third of it above; without a number a
    /// tenth of the distance to what is seen
    #[arg(
        long,
        value_name = "BACK",
        num_args = 0..=1,
        require_equals = true,
        conflicts_with = "follow",
        value_parser = distance
    )]
    chase: Option<Option<f64>>,
    /// The camera of one input frame, from 0
    #[arg(long, value_name = "N", conflicts_with_all = ["follow", "chase"])]
    frame: Option<usize>,
    /// One turn about what frame N sees (default frame 0), at RADIUS scene units
    #[arg(
        long,
        value_name = "RADIUS",
        num_args = 0..=1,
        require_equals = true,
        conflicts_with_all = ["follow", "chase"],
        value_parser = distance
    )]
    orbit: Option<Option<f64>>,
    /// Views (camera and time each) from a JSON file
    #[arg(long, value_name = "FILE", conflicts_with_all = ["follow", "chase", "frame", "orbit", "times"])]
    path: Option<PathBuf>,
    /// Displace every camera in its own axes: right, left, up, down, forward, back in scene units, yaw,
    /// pitch, roll in degrees, as right=1.5,yaw=5
    #[arg(long, value_name = "LIST")]
    shift: Option<Shift>,
    /// Turn every camera to the moving thing that input frame N (default 0) sees at pixel X,Y, and follow it
    #[arg(long, value_name = "X,Y[@N]")]
    look_at: Option<Target>,
    /// Picture size in pixels; default: the cameras' own
    #[arg(long, value_name = "WxH")]
    size: Option<Size>,
    /// What to write; in an animation they stand side by side
    #[arg(long, value_name = "LIST", value_enum, value_delimiter = ',', default_value = "rgb")]
    buffers: Vec<Buffer>,
    /// The clip that the scene was made from, for the buffer `real`
    #[arg(long, value_name = "CLIP")]
    clip: Option<PathBuf>,
    /// Input frames either side of a time whose moving parts are drawn
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u32).range(1..))]
    window: Option<u32>,
    /// At an input time draw the neighbours' moving parts, not the frame's own
    #[arg(long)]
    exclude_own_frame: bool,
    /// File type; default: by the ending .apng, .y4m or .mp4 of the output, else png
    #[arg(long, value_enum)]
    format: Option<Format>,
    /// Pictures per second of an animation; default: real time when the times are evenly spaced, else 10
    #[arg(long, value_name = "FPS", value_parser = fps)]
    fps: Option<f64>,
    /// apng: at most this many colours, 2 to 256; a third of the bytes
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u16).range(2..=256))]
    colours: Option<u16>,
    /// Threads, at most 64; 0 takes what affinity and cgroup allow
    #[arg(long, value_name = "N", default_value_t = 0, value_parser = clap::value_parser!(u32).range(0..=64))]
    threads: u32,
}

/// One kind of picture.
#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum)]
enum Buffer {
    /// Colour
    Rgb,
    /// The clip's picture nearest in time
    Real,
    /// Expected z-depth: weighted by coverage, divided by it
    Depth,
    /// Depth weighted by coverage
    DepthSum,
    /// Coverage
    Alpha,
    /// Motion of what is seen
    Velocity,
    /// Dynamic probability of what is seen
    Dynamic,
}

/// File type of the result.
#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum)]
enum Format {
    /// Pictures, lossless
    Png,
    /// Pictures, small; rgb and real only, the other buffers stay png
    Jpg,
    /// Animated PNG
    Apng,
    /// Uncompressed video for any encoder
    Y4m,
    /// Video by the program ffmpeg, which must be installed
    Mp4,
}

impl Format {
    /// As asked for, or by the output's ending.
    fn of(args: &Args) -> Format {
        let endings = [("apng", Format::Apng), ("y4m", Format::Y4m), ("mp4", Format::Mp4)];
        let by_name = endings.into_iter().find(|e| has_extension(&args.output, &[e.0])).map(|e| e.1);
        args.format.or(by_name).unwrap_or(Format::Png)
    }

    fn container(self) -> Option<Container> {
        match self {
            Format::Png | Format::Jpg => None,
            Format::Apng => Some(Container::Apng),
            Format::Y4m => Some(Container::Y4m),
            Format::Mp4 => Some(Container::Mp4),
        }
    }
}

/// A pixel of an input frame.
#[derive(Clone, Copy, Debug, PartialEq)]
struct Target {
    x: f64,
    y: f64,
    frame: usize,
}

impl std::str::FromStr for Target {
    type Err = String;

    fn from_str(text: &str) -> Result<Target, String> {
        let (pixel, frame) = text.split_once('@').unwrap_or((text, "0"));
        let number = |t: &str| t.trim().parse::<f64>().ok().filter(|v| v.is_finite());
        let pair = pixel.split_once(',').map(|(x, y)| (number(x), number(y)));
        match (pair, frame.parse()) {
            (Some((Some(x), Some(y))), Ok(frame)) => Ok(Target { x, y, frame }),
            _ => Err("a pixel is X,Y, of input frame N X,Y@N".into()),
        }
    }
}

fn fps(text: &str) -> Result<f64, String> {
    text.parse().ok().filter(|f: &f64| (0.02..=1000.0).contains(f)).ok_or("a rate is 0.02 to 1000 a second".into())
}

/// Radius of an orbit, distance of a chase.
fn distance(text: &str) -> Result<f64, String> {
    text.parse().ok().filter(|r: &f64| *r > 0.0 && *r <= 1e6).ok_or("a distance is over 0 and at most 1e6".into())
}

/// Draws everything and reports.
pub(crate) fn run(args: &Args, console: &Console) -> Result<()> {
    let format = Format::of(args);
    check(args, format, console)?;
    let (mut scene, report) = Scene::load(&args.scene)?;
    for note in &report.notes {
        console.note(format!("{}: {note}", escape_path(&args.scene)));
    }
    if let Some(window) = args.window {
        scene.compose.window = window;
    }
    if args.exclude_own_frame {
        scene.compose.own = SelfRule::Neighbours;
    }
    let views = chosen_views(args, &scene)?;
    let reals = match (&args.clip, args.buffers.contains(&Buffer::Real)) {
        (Some(clip), true) => Some(Reals::open(clip, &scene)?),
        _ => None,
    };
    let (first, last) = scene.time_range();
    let beyond = views.iter().filter(|v| v.time < first - Scene::SAME_TIME || v.time > last + Scene::SAME_TIME).count();
    if beyond > 0 {
        console
            .note(format!("{beyond} of {} views lie beyond the clip's {first} to {last} s: extrapolated", views.len()));
    }
    let mut painter = Painter::new(args, &scene, reals)?;
    let (files, fps) = match format.container() {
        None => (pictures(args, format, &views, &mut painter, console)?, None),
        Some(container) => {
            let fps = args.fps.unwrap_or_else(|| natural_fps(&views));
            animation(args, container, &views, fps, &mut painter, console)?;
            (vec![args.output.clone()], Some(fps))
        }
    };
    let to_stdout = args.output.as_os_str() == "-";
    let json = json!({
        "schema": "streetforward.render/1",
        "scene": path_json(&args.scene),
        "output": path_json(&args.output),
        "format": format.to_possible_value().map(|v| v.get_name().to_string()),
        "fps": fps,
        "views": painter.rows,
        "render_total_ms": painter.total_ms,
        "depth_picture_near": painter.depth_scale.map(|s| s.near),
        "depth_picture_far": painter.depth_scale.map(|s| s.far),
        "velocity_picture_top": painter.wants_motion.then_some(painter.top_speed),
        "files": files_json(&files),
    });
    let what = match fps {
        None => format!("{} files", files.len()),
        Some(fps) => {
            let bytes =
                std::fs::metadata(&args.output).map_or(String::new(), |m| format!(", {}", human_bytes(m.len())));
            format!("{fps} pictures a second{bytes}")
        }
    };
    let text = format!(
        "{} view{} of {} Gaussians in {}: {what}, {:.1} ms a view\n",
        views.len(),
        if views.len() == 1 { "" } else { "s" },
        scene.len(),
        escape_path(&args.output),
        painter.total_ms / views.len() as f64
    );
    if to_stdout {
        console.note(text.trim_end());
        return Ok(());
    }
    console.report(&json, &text)
}

/// Flags that do not go together.
fn check(args: &Args, format: Format, console: &Console) -> Result<()> {
    let video = format.container().is_some();
    if args.output.as_os_str() == "-" {
        if format != Format::Y4m {
            return Err(Error::usage("only y4m goes to standard output: add --format y4m"));
        }
        if console.is_json() {
            return Err(Error::usage("--json and -o - both want standard output"));
        }
    }
    if !video && args.fps.is_some() {
        return Err(Error::usage("--fps belongs to an animation: --format apng, y4m or mp4"));
    }
    if format != Format::Apng && args.colours.is_some() {
        return Err(Error::usage("--colours belongs to --format apng"));
    }
    let wants_real = args.buffers.contains(&Buffer::Real);
    if wants_real && args.clip.is_none() {
        return Err(Error::usage("--buffers real needs --clip CLIP, the clip that the scene was made from"));
    }
    if args.clip.is_some() && !wants_real {
        return Err(Error::usage("--clip belongs to --buffers real"));
    }
    if video && args.buffers.contains(&Buffer::DepthSum) {
        return Err(Error::usage("depth-sum is written as arrays only: not in an animation"));
    }
    Ok(())
}

/// One file per view and buffer; gives their names.
fn pictures(
    args: &Args,
    format: Format,
    views: &[TimedCamera],
    painter: &mut Painter,
    console: &Console,
) -> Result<Vec<PathBuf>> {
    let folder = OutputFolder::create(&FolderArgs { output: args.output.clone(), force: args.force })?;
    let progress = console.progress(views.len() as u64, "render");
    for (i, view) in views.iter().enumerate() {
        let drawn = painter.draw(view)?;
        painter.write(&folder, i, args, format, view, &drawn)?;
        progress.step();
    }
    drop(progress);
    painter.write_scales(&folder, args)?;
    camera_json::write(&folder.path().join("cameras.json"), views, Overwrite::Yes)?;
    folder.commit()
}

/// All views in one file, their buffers side by side.
fn animation(
    args: &Args,
    container: Container,
    views: &[TimedCamera],
    fps: f64,
    painter: &mut Painter,
    console: &Console,
) -> Result<()> {
    let size = (views[0].camera.width, views[0].camera.height);
    if let Some(other) = views.iter().find(|v| (v.camera.width, v.camera.height) != size) {
        let why = format!(
            "views of {}x{} and {}x{}: an animation has one size, see --size",
            size.0, size.1, other.camera.width, other.camera.height
        );
        return Err(Error::input("--path", why));
    }
    let width = size.0 as usize * args.buffers.len() + GAP * (args.buffers.len() - 1);
    if width > 16_384 {
        return Err(Error::resource("animation", format!("{width} pixels wide; the limit is 16384")));
    }
    let shape = Shape { size: (width as u32, size.1), frames: views.len(), fps };
    let overwrite = if args.force { Overwrite::Yes } else { Overwrite::No };
    // Without a palette the file is claimed before the first picture is drawn.
    let open = |palette| Video::create(container, &args.output, overwrite, shape, palette);
    let mut video = if args.colours.is_none() { Some(open(None)?) } else { None };
    let mut kept = Vec::new();
    let progress = console.progress(views.len() as u64, "render");
    for view in views {
        let drawn = painter.draw(view)?;
        let mut sheet = picture::blank(shape.size.0, size.1, picture::INK.0);
        for (i, &buffer) in args.buffers.iter().enumerate() {
            let image = painter.picture(buffer, view, &drawn)?;
            picture::paste(&mut sheet, &image, ((i * (size.0 as usize + GAP)) as u32, 0));
        }
        match &mut video {
            Some(v) => v.frame(&sheet)?,
            None => kept.push(sheet),
        }
        progress.step();
    }
    drop(progress);
    let mut video = match (video, args.colours) {
        (Some(v), _) => v,
        (None, colours) => open(Some(Palette::of(&kept, colours.map_or(256, usize::from))))?,
    };
    kept.iter().try_for_each(|sheet| video.frame(sheet))?;
    video.finish()
}

/// Pixels between the buffers of an animation.
const GAP: usize = 4;

/// Pictures per second at which time passes as it did, 10 where the times are not evenly spaced or stand still.
fn natural_fps(views: &[TimedCamera]) -> f64 {
    let n = views.len();
    let step = if n > 1 { (views[n - 1].time - views[0].time) / (n - 1) as f64 } else { 0.0 };
    let even = views.windows(2).all(|w| ((w[1].time - w[0].time) - step).abs() <= 0.01 * step.abs());
    let fps = 1.0 / step.abs();
    // Decimal times are not exact: 0.1 s steps are 10 a second.
    let fps = (fps * 1e6).round() / 1e6;
    if even && (0.02..=1000.0).contains(&fps) { fps } else { 10.0 }
}

/// The views that the flags ask for, checked.
fn chosen_views(args: &Args, scene: &Scene) -> Result<Vec<TimedCamera>> {
    let mut views = match &args.path {
        Some(file) => camera_json::read(file)?,
        None => {
            let rig = match (args.orbit, args.chase, args.frame) {
                (Some(radius), _, frame) => Rig::Orbit { frame: frame.unwrap_or(0), radius },
                (None, Some(back), _) => Rig::Chase { back },
                (None, None, Some(frame)) => Rig::Frame(frame),
                (None, None, None) => Rig::Follow,
            };
            views::views(scene, rig, args.times.as_ref().map(|t| &t.0[..]))?
        }
    };
    if views.is_empty() {
        return Err(Error::input(escape_path(&args.scene), "has no cameras to render from; pass views with --path"));
    }
    let track = args.look_at.map(|t| Track::of(scene, t.frame, (t.x, t.y))).transpose()?;
    for view in &mut views {
        if let Some(size) = args.size {
            view.camera = views::sized(&view.camera, size)?;
        }
        if let Some(shift) = &args.shift {
            view.camera = views::shifted(&view.camera, shift);
        }
        if let Some(track) = &track {
            view.camera = views::aimed(&view.camera, track.at(view.time));
        }
        view.camera.check("view")?;
    }
    Ok(views)
}

/// Values per Gaussian that are drawn besides the colour: velocity and dynamic probability.
const EXTRA: usize = 4;

/// Draws views of one scene, keeping memory between them.
struct Painter<'a> {
    scene: &'a Scene,
    reals: Option<Reals>,
    /// One scale for all depth pictures: that of the first view.
    depth_scale: Option<DepthScale>,
    /// Speed of a full colour in velocity pictures, scene units per second.
    top_speed: f32,
    wants_motion: bool,
    /// The scene with every Gaussian's velocity in place of its colour and its probability as a scale, where these
    /// are asked for: composed at a time, it gives them in the order of the Gaussians drawn.
    moving: Option<Scene>,
    renderer: Renderer,
    /// What is reported of each view.
    rows: Vec<Value>,
    total_ms: f64,
}

impl<'a> Painter<'a> {
    fn new(args: &Args, scene: &'a Scene, reals: Option<Reals>) -> Result<Painter<'a>> {
        let wants_motion = args.buffers.contains(&Buffer::Velocity);
        let moving = (wants_motion || args.buffers.contains(&Buffer::Dynamic)).then(|| motion_as_looks(scene));
        let top_speed = moving.as_ref().map_or(1.0, |m| picture::top_speed(&m.gaussians.colour, 1.0));
        let renderer = Renderer::new(crate::args::threads(args.threads))?;
        let (rows, total_ms) = (Vec::new(), 0.0);
        Ok(Painter { scene, reals, depth_scale: None, top_speed, wants_motion, moving, renderer, rows, total_ms })
    }

    fn draw(&mut self, view: &TimedCamera) -> Result<Rendered> {
        let start = Instant::now();
        let gaussians = self.scene.at(view.time, &self.scene.compose)?;
        let values: Option<Vec<f32>> = match &self.moving {
            Some(s) => {
                let now = s.at(view.time, &s.compose)?;
                Some(now.colour.iter().zip(&now.scale).flat_map(|(v, p)| [v[0], v[1], v[2], p[0]]).collect())
            }
            None => None,
        };
        let extra = values.as_ref().map(|values| Extra { channels: EXTRA, values });
        let options = RenderOptions { extra, ..RenderOptions::default() };
        let mut drawn = self.renderer.render(&gaussians, &view.camera, &self.scene.splat, &options)?;
        // Of what is seen, whatever its coverage.
        for (values, alpha) in drawn.extra.chunks_exact_mut(EXTRA).zip(&drawn.alpha) {
            values.iter_mut().for_each(|v| *v /= alpha.max(1e-10));
        }
        let ms = start.elapsed().as_secs_f64() * 1e3;
        self.total_ms += ms;
        let (first, last) = self.scene.time_range();
        self.rows.push(json!({
            "time_s": view.time,
            "extrapolated": view.time < first || view.time > last,
            "width": view.camera.width,
            "height": view.camera.height,
            "render_ms": ms,
            "gaussians": drawn.stats.gaussians,
            "visible": drawn.stats.visible,
            "dropped": drawn.stats.dropped(),
            "degraded": drawn.stats.degraded(),
        }));
        Ok(drawn)
    }

    /// A buffer of a drawn view to look at.
    fn picture(&mut self, buffer: Buffer, view: &TimedCamera, drawn: &Rendered) -> Result<Rgb8> {
        let size = (drawn.width as u32, drawn.height as u32);
        Ok(match buffer {
            Buffer::Rgb => views::rgb8(drawn),
            Buffer::Real => {
                let real = self.reals.as_ref().and_then(|r| r.nearest(view.time));
                let real = real.ok_or_else(|| Error::input("--clip", "holds no picture"))?;
                crate::reals::resized(&real.image, size)
            }
            Buffer::Depth | Buffer::DepthSum => {
                let depth = drawn.expected_depth();
                let scale = *self.depth_scale.get_or_insert_with(|| DepthScale::of(&depth));
                picture::depth_colours(&depth, size, scale)
            }
            Buffer::Alpha => picture::gray(&drawn.alpha, size, (0.0, 1.0)),
            Buffer::Velocity => picture::velocity_wheel(&velocity(drawn), size, self.top_speed),
            Buffer::Dynamic => picture::dynamic_overlay(&views::rgb8(drawn), &probability(drawn)),
        })
    }

    /// Writes the buffers of one view.
    fn write(
        &mut self,
        folder: &OutputFolder,
        index: usize,
        args: &Args,
        format: Format,
        view: &TimedCamera,
        drawn: &Rendered,
    ) -> Result<()> {
        let (w, h) = (drawn.width, drawn.height);
        for &buffer in &args.buffers {
            let name = buffer.to_possible_value().map(|v| v.get_name().to_string()).unwrap_or_default();
            let file = |end: &str| -> Result<PathBuf> { Ok(folder.subfolder(&name)?.join(format!("{index:06}{end}"))) };
            let array = |shape: &[usize], values: &[f32]| npy::write_f32(&file(".npy")?, shape, values, Overwrite::Yes);
            match buffer {
                Buffer::Depth => array(&[h, w], &drawn.expected_depth())?,
                Buffer::DepthSum => array(&[h, w], &drawn.depth)?,
                Buffer::Velocity => array(&[h, w, 3], velocity(drawn).as_flattened())?,
                Buffer::Rgb | Buffer::Real | Buffer::Alpha | Buffer::Dynamic => {}
            }
            match buffer {
                Buffer::Rgb | Buffer::Real if format == Format::Jpg => {
                    image_io::write_jpeg(&file(".jpg")?, &self.picture(buffer, view, drawn)?, 92, Overwrite::Yes)?;
                }
                Buffer::Rgb | Buffer::Real | Buffer::Depth | Buffer::Velocity => {
                    image_io::write_png(&file(".png")?, &self.picture(buffer, view, drawn)?, Overwrite::Yes)?;
                }
                Buffer::Alpha => write_share(&file(".png")?, (w, h), &drawn.alpha)?,
                Buffer::Dynamic => {
                    write_share(&file(".png")?, (w, h), &probability(drawn))?;
                    image_io::write_png(&file("_overlay.png")?, &self.picture(buffer, view, drawn)?, Overwrite::Yes)?;
                }
                Buffer::DepthSum => {}
            }
        }
        Ok(())
    }

    /// Writes what the colours mean.
    fn write_scales(&self, folder: &OutputFolder, args: &Args) -> Result<()> {
        if let (true, Some(scale)) = (args.buffers.contains(&Buffer::Depth), self.depth_scale) {
            let image = picture::depth_legend(320, scale, "units");
            image_io::write_png(&folder.subfolder("depth")?.join("scale.png"), &image, Overwrite::Yes)?;
        }
        if self.wants_motion {
            let image = picture::velocity_legend(96, self.top_speed, "units/s");
            image_io::write_png(&folder.subfolder("velocity")?.join("scale.png"), &image, Overwrite::Yes)?;
        }
        Ok(())
    }
}

/// Velocity of what is seen.
fn velocity(drawn: &Rendered) -> Vec<[f32; 3]> {
    drawn.extra.as_chunks::<EXTRA>().0.iter().map(|v| [v[0], v[1], v[2]]).collect()
}

/// Dynamic probability of what is seen.
fn probability(drawn: &Rendered) -> Vec<f32> {
    drawn.extra.as_chunks::<EXTRA>().0.iter().map(|v| v[3]).collect()
}

/// Values 0..1 as an 8-bit gray picture.
fn write_share(path: &Path, (w, h): (usize, usize), values: &[f32]) -> Result<()> {
    let gray: Vec<u8> = values.iter().map(|v| (v * 255.0).round() as u8).collect();
    image_io::write_gray8(path, (w as u32, h as u32), &gray, Overwrite::Yes)
}

/// The scene with motion in place of looks. Colour: velocity, none for static ones. Scale: the dynamic probability.
fn motion_as_looks(scene: &Scene) -> Scene {
    let mut moving = scene.clone();
    for i in 0..scene.len() {
        let still = scene.compose.split == Split::Hard && scene.dynamic[i] <= scene.compose.tau;
        moving.gaussians.colour[i] = if still { [0.0; 3] } else { scene.velocity(i) };
        moving.gaussians.scale[i] = [scene.dynamic[i]; 3];
    }
    moving
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn time_passes_as_it_did_unless_the_times_are_uneven() {
        let views = |times: &[f64]| {
            let camera = sf_formats::Camera {
                width: 1,
                height: 1,
                k: sf_formats::Intrinsics { fx: 1.0, fy: 1.0, cx: 0.5, cy: 0.5 },
                pose: sf_formats::Pose::IDENTITY,
            };
            times.iter().map(|&time| TimedCamera { time, camera }).collect::<Vec<_>>()
        };
        for (times, want) in [
            (&[0.0, 0.1, 0.2, 0.30000000000000004][..], 10.0),
            (&[0.2, 0.16, 0.12], 25.0),
            (&[0.0, 0.1, 0.3], 10.0),
            (&[0.5; 36], 10.0),
            (&[3.0], 10.0),
            (&[0.0, 1e-6], 10.0),
        ] {
            assert_eq!(natural_fps(&views(times)), want, "{times:?}");
        }
    }

    #[test]
    fn targets() {
        assert_eq!("12,34.5".parse(), Ok(Target { x: 12.0, y: 34.5, frame: 0 }));
        assert_eq!("1,2@3".parse(), Ok(Target { x: 1.0, y: 2.0, frame: 3 }));
        for bad in ["", "1", "1,", "1,2@", "1,2@x", "nan,1", "1,2,3"] {
            assert!(bad.parse::<Target>().is_err(), "{bad}");
        }
    }
}
