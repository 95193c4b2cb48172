//! [`Results`]: what the network said about a clip, as files.
//!
//! ```text
//! DIR/scene.ply, scene.json          the scene
//! DIR/overview.png                   per frame: picture, depth, motion, dynamic probability
//! DIR/depth.npy                      [N, H, W] z-depth, scene units
//! DIR/depth/000000.png               16 bit, depth x 256, 0 = none; 000000_colour.png to look at
//! DIR/conf.npy                       [N, H, W] confidence logits
//! DIR/points.npy                     [N, H, W, 3] points in camera axes
//! DIR/poses.npy, transforms.json     [N, 4, 4] camera to world; the same for other tools
//! DIR/velocity.npy, velocity/*.png   [N, H, W, 6] v+ and v-, world axes, scene units per second
//! DIR/dynamic.npy, dynamic/*.png     [N, H, W] dynamic probability
//! ```

use crate::folder::OutputFolder;
use clap::ValueEnum;
use sf_formats::atomic::Overwrite;
use sf_formats::clip::TruthFrame;
use sf_formats::image_io::{self, Rgb8};
use sf_formats::picture::{self, DepthScale};
use sf_formats::poses_io::{self, PoseFormat};
use sf_formats::{Result, Scene, npy};
use std::path::Path;
use streetforward::{Output, Prepared};

/// Steps of a 16-bit depth picture per scene unit, as KITTI's depth maps: value 0 is no depth.
pub(crate) const DEPTH_STEPS: f32 = 256.0;

/// One kind of result.
#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum)]
pub(crate) enum Emit {
    /// The scene that render and export read
    Scene,
    /// Depth: array, 16-bit pictures, coloured pictures
    Depth,
    /// Confidence logits, where the network has them
    Conf,
    /// Points in camera axes
    Points,
    /// Camera poses
    Poses,
    /// Velocities: array and pictures
    Velocity,
    /// Dynamic probability: array and pictures
    Dynamic,
    /// One picture to look at first
    Overview,
}

impl Emit {
    /// Its values as one `.npy` file in `folder`, where it has any: not the scene, not the overview, not a
    /// confidence that the network lacks.
    pub(crate) fn write_array(self, out: &Output, folder: &Path) -> Result<()> {
        let s = out.shape;
        let save = |name: &str, last: &[usize], values: &[f32]| {
            let shape = [&[s.frames, s.height, s.width], last].concat();
            npy::write_f32(&folder.join(name), &shape, values, Overwrite::Yes)
        };
        match self {
            Emit::Scene | Emit::Overview => Ok(()),
            Emit::Depth => save("depth.npy", &[], &out.depth),
            Emit::Conf if out.conf.is_empty() => Ok(()),
            Emit::Conf => save("conf.npy", &[], &out.conf),
            Emit::Points => save("points.npy", &[3], out.points.as_flattened()),
            Emit::Poses => {
                let rows: Vec<f64> = out.poses.iter().flat_map(|p| p.to_rows()).flatten().collect();
                npy::write_f64(&folder.join("poses.npy"), &[s.frames, 4, 4], &rows, Overwrite::Yes)
            }
            Emit::Velocity => {
                let pairs = out.v_fwd.iter().zip(&out.v_bwd);
                let both: Vec<f32> = pairs.flat_map(|(f, b)| [f[0], f[1], f[2], b[0], b[1], b[2]]).collect();
                save("velocity.npy", &[6], &both)
            }
            Emit::Dynamic => save("dynamic.npy", &[], &out.dynamic),
        }
    }
}

/// What the network said about a clip.
pub(crate) struct Results<'a> {
    pub(crate) out: &'a Output,
    pub(crate) scene: &'a Scene,
    pub(crate) prepared: &'a Prepared,
    /// Ground truth of the frames, where it is known at the network's size.
    pub(crate) truth: &'a [TruthFrame],
}

impl Results<'_> {
    /// Writes what is asked for.
    pub(crate) fn write(&self, emit: &[Emit], folder: &OutputFolder) -> Result<()> {
        let (out, size, n) = (self.out, self.size(), self.pixels());
        let frames = || (0..out.shape.frames).map(|f| (f, f * n..(f + 1) * n));
        for emit in emit {
            emit.write_array(out, folder.path())?;
            match emit {
                Emit::Scene => self.scene.save(folder.path(), Overwrite::Yes)?,
                Emit::Depth => {
                    let (pictures, scale) = (folder.subfolder("depth")?, DepthScale::of(&out.depth));
                    for (f, range) in frames() {
                        let depth = &out.depth[range];
                        // `as` saturates: what is too far for 16 bits is white.
                        let steps: Vec<u16> = depth.iter().map(|d| (d * DEPTH_STEPS).round() as u16).collect();
                        image_io::write_gray16(&pictures.join(format!("{f:06}.png")), size, &steps, Overwrite::Yes)?;
                        let colours = picture::depth_colours(depth, size, scale);
                        image_io::write_png(&pictures.join(format!("{f:06}_colour.png")), &colours, Overwrite::Yes)?;
                    }
                }
                Emit::Conf | Emit::Points => {}
                Emit::Poses => {
                    let views = poses_io::views(self.scene);
                    poses_io::export(&views, PoseFormat::Nerfstudio, folder.path(), Overwrite::Yes)?;
                }
                Emit::Velocity => {
                    let (pictures, velocity) = (folder.subfolder("velocity")?, self.velocity());
                    let top = picture::top_speed(&velocity, 1.0);
                    for (f, range) in frames() {
                        let wheel = picture::velocity_wheel(&velocity[range], size, top);
                        image_io::write_png(&pictures.join(format!("{f:06}.png")), &wheel, Overwrite::Yes)?;
                    }
                }
                Emit::Dynamic => {
                    let pictures = folder.subfolder("dynamic")?;
                    for (f, range) in frames() {
                        let gray: Vec<u8> = out.dynamic[range].iter().map(|p| (p * 255.0).round() as u8).collect();
                        image_io::write_gray8(&pictures.join(format!("{f:06}.png")), size, &gray, Overwrite::Yes)?;
                    }
                }
                Emit::Overview => {
                    image_io::write_png(&folder.path().join("overview.png"), &self.overview(), Overwrite::Yes)?;
                }
            }
        }
        Ok(())
    }

    fn size(&self) -> (u32, u32) {
        (self.out.shape.width as u32, self.out.shape.height as u32)
    }

    fn pixels(&self) -> usize {
        self.out.shape.width * self.out.shape.height
    }

    /// Motion of every pixel: the mean of v+ and -v-.
    fn velocity(&self) -> Vec<[f32; 3]> {
        let both = self.out.v_fwd.iter().zip(&self.out.v_bwd);
        both.map(|(f, b)| std::array::from_fn(|a| 0.5 * (f[a] - b[a]))).collect()
    }

    /// A row per frame: picture, depth, true depth, motion, true motion, dynamic probability; without ground
    /// truth four of them. Predicted and true depth have scales of their own, since a clip without poses
    /// is known up to scale; motion has one, since it is to be compared.
    pub(crate) fn overview(&self) -> Rgb8 {
        let (out, size, n) = (self.out, self.size(), self.pixels());
        let (scale, velocity) = (DepthScale::of(&out.depth), self.velocity());
        let moving: Vec<[f32; 3]> =
            self.truth.iter().filter_map(|t| t.velocity.as_deref()).flatten().copied().collect();
        let top = picture::top_speed(if moving.is_empty() { &velocity } else { &moving }, 1.0);
        let truth: Vec<f32> = self.truth.iter().flat_map(|t| &t.depth).copied().collect();
        let true_scale = DepthScale::of(&truth);
        let mut cells = Vec::new();
        for f in 0..out.shape.frames {
            let range = f * n..(f + 1) * n;
            cells.push(Rgb8::new(size.0, size.1, self.prepared.images[3 * f * n..3 * (f + 1) * n].to_vec()));
            let truth = self.truth.get(f).filter(|t| (t.width, t.height) == size);
            cells.push(picture::depth_colours(&out.depth[range.clone()], size, scale));
            cells.extend(truth.map(|t| picture::depth_colours(&t.depth, size, true_scale)));
            cells.push(picture::velocity_wheel(&velocity[range.clone()], size, top));
            cells.extend(truth.and_then(|t| t.velocity.as_ref()).map(|v| picture::velocity_wheel(v, size, top)));
            cells.push(picture::gray(&out.dynamic[range], size, (0.0, 1.0)));
        }
        let columns = cells.len() / out.shape.frames;
        picture::grid(&cells.iter().collect::<Vec<_>>(), columns)
    }
}
