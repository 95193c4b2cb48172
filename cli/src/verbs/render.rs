//! `render`: pictures of a scene from new places at new times.
//!
//! ```text
//! DIR/rgb/000000.png ...          the pictures, one per view
//! DIR/depth/000000.npy, .png      expected z-depth [H, W], 0 where nothing is; coloured
//! DIR/alpha/000000.png            coverage, gray
//! DIR/velocity/000000.npy, .png   [H, W, 3] world axes, scene units per second; direction as hue
//! DIR/cameras.json                the views, in the format that --path reads
//! ```

use crate::args::{FolderArgs, Picture, Shift, Size, Times, path_json};
use crate::folder::OutputFolder;
use crate::output::{Console, files_json};
use crate::views::{self, Rig};
use clap::ValueEnum;
use serde_json::json;
use sf_formats::atomic::Overwrite;
use sf_formats::camera_json::{self, TimedCamera};
use sf_formats::config::{SelfRule, Split};
use sf_formats::error::escape_path;
use sf_formats::image_io;
use sf_formats::picture::{self, DepthScale};
use sf_formats::{Error, Result, Scene, npy};
use sf_splat::{Extra, RenderOptions, Rendered, Renderer};
use std::path::PathBuf;
use std::time::Instant;

/// What to draw from where.
#[derive(clap::Args)]
pub(crate) struct Args {
    /// Scene folder that `run` wrote, or a .ply file
    #[arg(short, long, value_name = "SCENE")]
    scene: PathBuf,
    #[command(flatten)]
    folder: FolderArgs,
    /// Seconds: a list of numbers and FIRST:LAST:STEP ranges; default: the input times
    #[arg(long, value_name = "LIST", allow_hyphen_values = true)]
    times: Option<Times>,
    /// Cameras interpolated along the input cameras (default)
    #[arg(long)]
    follow: bool,
    /// The camera of one input frame, from 0
    #[arg(long, value_name = "N", conflicts_with = "follow")]
    frame: Option<usize>,
    /// One turn about what frame N sees (default frame 0), at RADIUS scene units
    #[arg(
        long,
        value_name = "RADIUS",
        num_args = 0..=1,
        require_equals = true,
        conflicts_with = "follow",
        value_parser = radius
    )]
    orbit: Option<Option<f64>>,
    /// Views (camera and time each) from a JSON file
    #[arg(long, value_name = "FILE", conflicts_with_all = ["follow", "frame", "orbit", "times"])]
    path: Option<PathBuf>,
    /// Displace every camera in its own axes: right, left, up, down, forward, back in scene units, yaw,
    /// pitch, roll in degrees, as right=1.5,yaw=5
    #[arg(long, value_name = "LIST")]
    shift: Option<Shift>,
    /// Picture size in pixels; default: the cameras' own
    #[arg(long, value_name = "WxH")]
    size: Option<Size>,
    /// What to write
    #[arg(long, value_name = "LIST", value_enum, value_delimiter = ',', default_value = "rgb")]
    buffers: Vec<Buffer>,
    /// Input frames either side of a time whose moving parts are drawn
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u32).range(1..))]
    window: Option<u32>,
    /// At an input time draw the neighbours' moving parts, not the frame's own
    #[arg(long)]
    exclude_own_frame: bool,
    /// File type of rgb pictures
    #[arg(long, value_enum, default_value_t = Picture::Png)]
    format: Picture,
    /// Threads, at most 64; 0 takes what affinity and cgroup allow
    #[arg(long, value_name = "N", default_value_t = 0, value_parser = clap::value_parser!(u32).range(0..=64))]
    threads: u32,
}

/// One kind of picture.
#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum)]
enum Buffer {
    /// Colour
    Rgb,
    /// Expected z-depth
    Depth,
    /// Coverage
    Alpha,
    /// Motion of what is seen
    Velocity,
}

/// Radius of an orbit.
fn radius(text: &str) -> Result<f64, String> {
    text.parse().ok().filter(|r: &f64| *r > 0.0 && *r <= 1e6).ok_or("a radius is over 0 and at most 1e6".into())
}

/// Draws everything and reports.
pub(crate) fn run(args: &Args, console: &Console) -> Result<()> {
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
    let (first, last) = scene.time_range();
    let beyond = views.iter().filter(|v| v.time < first - Scene::SAME_TIME || v.time > last + Scene::SAME_TIME).count();
    if beyond > 0 {
        console
            .note(format!("{beyond} of {} views lie beyond the clip's {first} to {last} s: extrapolated", views.len()));
    }
    let folder = OutputFolder::create(&args.folder)?;
    let mut painter = Painter::new(args, &scene)?;
    let progress = console.progress(views.len() as u64, "render");
    let mut rows = Vec::with_capacity(views.len());
    let mut total_ms = 0.0;
    for (i, view) in views.iter().enumerate() {
        let start = Instant::now();
        let picture = painter.draw(view)?;
        let ms = start.elapsed().as_secs_f64() * 1e3;
        total_ms += ms;
        painter.write(&folder, i, args, &picture)?;
        rows.push(json!({
            "time_s": view.time,
            "extrapolated": view.time < first || view.time > last,
            "width": view.camera.width,
            "height": view.camera.height,
            "render_ms": ms,
            "gaussians": picture.stats.gaussians,
            "visible": picture.stats.visible,
            "dropped": picture.stats.dropped(),
            "degraded": picture.stats.degraded(),
        }));
        progress.step();
    }
    drop(progress);
    camera_json::write(&folder.path().join("cameras.json"), &views, Overwrite::Yes)?;
    let files = folder.commit()?;
    let json = json!({
        "schema": "streetforward.render/1",
        "scene": path_json(&args.scene),
        "output": path_json(&args.folder.output),
        "views": rows,
        "render_total_ms": total_ms,
        "depth_picture_near": painter.depth_scale.map(|s| s.near),
        "depth_picture_far": painter.depth_scale.map(|s| s.far),
        "velocity_picture_top": painter.moving.is_some().then_some(painter.top_speed),
        "files": files_json(&files),
    });
    let text = format!(
        "{} view{} of {} Gaussians in {}: {} files, {:.1} ms a view\n",
        views.len(),
        if views.len() == 1 { "" } else { "s" },
        scene.len(),
        escape_path(&args.folder.output),
        files.len(),
        total_ms / views.len() as f64
    );
    console.report(&json, &text)
}

/// The views that the flags ask for, checked.
fn chosen_views(args: &Args, scene: &Scene) -> Result<Vec<TimedCamera>> {
    let mut views = match &args.path {
        Some(file) => camera_json::read(file)?,
        None => {
            let rig = match (args.orbit, args.frame) {
                (Some(radius), frame) => Rig::Orbit { frame: frame.unwrap_or(0), radius },
                (None, Some(frame)) => Rig::Frame(frame),
                (None, None) => Rig::Follow,
            };
            views::views(scene, rig, args.times.as_ref().map(|t| &t.0[..]))?
        }
    };
    if views.is_empty() {
        return Err(Error::input(escape_path(&args.scene), "has no cameras to render from; pass views with --path"));
    }
    for view in &mut views {
        if let Some(size) = args.size {
            view.camera = views::sized(&view.camera, size)?;
        }
        if let Some(shift) = &args.shift {
            view.camera = views::shifted(&view.camera, shift);
        }
        view.camera.check("view")?;
    }
    Ok(views)
}

/// Draws views of one scene, keeping memory between them.
struct Painter<'a> {
    scene: &'a Scene,
    /// One scale for all depth pictures: that of the first view.
    depth_scale: Option<DepthScale>,
    /// Speed of a full colour in velocity pictures, scene units per second.
    top_speed: f32,
    /// The scene with every Gaussian's velocity in place of its colour, where velocity is asked for:
    /// composed at a time, it gives the velocities in the order of the Gaussians drawn.
    moving: Option<Scene>,
    renderer: Renderer,
}

impl<'a> Painter<'a> {
    fn new(args: &Args, scene: &'a Scene) -> Result<Painter<'a>> {
        let moving = args.buffers.contains(&Buffer::Velocity).then(|| velocities_as_colours(scene));
        let top_speed = moving.as_ref().map_or(1.0, |m| picture::top_speed(&m.gaussians.colour, 1.0));
        let renderer = Renderer::new(crate::args::threads(args.threads))?;
        Ok(Painter { scene, depth_scale: None, top_speed, moving, renderer })
    }

    fn draw(&mut self, view: &TimedCamera) -> Result<Rendered> {
        let gaussians = self.scene.at(view.time, &self.scene.compose)?;
        let moving = match &self.moving {
            Some(s) => Some(s.at(view.time, &s.compose)?),
            None => None,
        };
        let extra = moving.as_ref().map(|m| Extra { channels: 3, values: m.colour.as_flattened() });
        let options = RenderOptions { extra, ..RenderOptions::default() };
        self.renderer.render(&gaussians, &view.camera, &self.scene.splat, &options)
    }

    /// Writes the buffers of one view.
    fn write(&mut self, folder: &OutputFolder, index: usize, args: &Args, drawn: &Rendered) -> Result<()> {
        let size = (drawn.width as u32, drawn.height as u32);
        let file = |name: &str, end: &str| -> Result<PathBuf> {
            Ok(folder.subfolder(name)?.join(format!("{index:06}.{end}")))
        };
        for buffer in &args.buffers {
            match buffer {
                Buffer::Rgb => {
                    let image = views::rgb8(drawn);
                    match args.format {
                        Picture::Png => image_io::write_png(&file("rgb", "png")?, &image, Overwrite::Yes)?,
                        Picture::Jpg => image_io::write_jpeg(&file("rgb", "jpg")?, &image, 92, Overwrite::Yes)?,
                    }
                }
                Buffer::Depth => {
                    let depth = drawn.expected_depth();
                    let scale = *self.depth_scale.get_or_insert_with(|| DepthScale::of(&depth));
                    npy::write_f32(&file("depth", "npy")?, &[drawn.height, drawn.width], &depth, Overwrite::Yes)?;
                    let image = picture::depth_colours(&depth, size, scale);
                    image_io::write_png(&file("depth", "png")?, &image, Overwrite::Yes)?;
                }
                Buffer::Alpha => {
                    let gray: Vec<u8> = drawn.alpha.iter().map(|a| (a * 255.0).round() as u8).collect();
                    image_io::write_gray8(&file("alpha", "png")?, size, &gray, Overwrite::Yes)?;
                }
                Buffer::Velocity => {
                    let shape = [drawn.height, drawn.width, 3];
                    npy::write_f32(&file("velocity", "npy")?, &shape, &drawn.extra, Overwrite::Yes)?;
                    let image = picture::velocity_wheel(drawn.extra.as_chunks().0, size, self.top_speed);
                    image_io::write_png(&file("velocity", "png")?, &image, Overwrite::Yes)?;
                }
            }
        }
        Ok(())
    }
}

/// Velocity of each Gaussian as the composition moves it: the mean of both directions, none for static
/// ones.
fn velocities_as_colours(scene: &Scene) -> Scene {
    let mut moving = scene.clone();
    for (i, colour) in moving.gaussians.colour.iter_mut().enumerate() {
        let still = scene.compose.split == Split::Hard && scene.dynamic[i] <= scene.compose.tau;
        let (f, b) = (scene.v_fwd[i], scene.v_bwd[i]);
        *colour = if still { [0.0; 3] } else { std::array::from_fn(|a| 0.5 * (f[a] - b[a])) };
    }
    moving
}
