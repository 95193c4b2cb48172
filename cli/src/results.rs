//! [`Results`]: what the network said about a clip, as files.
//!
//! ```text
//! DIR/scene.ply, scene.json          the scene
//! DIR/overview.png                   a sheet of everything with scales, see `overview.rs`
//! DIR/depth.npy                      [N, H, W] z-depth, scene units
//! DIR/depth/000000.png               16 bit, depth x 256, 0 = none; 000000_colour.png to look at
//! DIR/conf.npy                       [N, H, W] confidence logits
//! DIR/points.npy                     [N, H, W, 3] points in camera axes
//! DIR/poses.npy, transforms.json     [N, 4, 4] camera to world; the same for other tools
//! DIR/velocity.npy, velocity/*.png   [N, H, W, 6] v+ and v-, world axes, scene units per second
//! DIR/dynamic.npy, dynamic/*.png     [N, H, W] dynamic probability
//! ```

use crate::folder::OutputFolder;
use crate::overview::overview;
use clap::ValueEnum;
use sf_formats::atomic::Overwrite;
use sf_formats::clip::TruthFrame;
use sf_formats::image_io;
use sf_formats::picture::{self, DepthScale};
use sf_formats::poses_io::{self, PoseFormat};
use sf_formats::{Result, Scene, npy};
use sf_splat::Renderer;
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
    pub(crate) fn write(&self, emit: &[Emit], folder: &OutputFolder, renderer: &mut Renderer) -> Result<()> {
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
                    let legend = picture::depth_legend(320, scale, "units");
                    image_io::write_png(&pictures.join("scale.png"), &legend, Overwrite::Yes)?;
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
                    let legend = picture::velocity_legend(96, top, "units/s");
                    image_io::write_png(&pictures.join("scale.png"), &legend, Overwrite::Yes)?;
                }
                Emit::Dynamic => {
                    let pictures = folder.subfolder("dynamic")?;
                    for (f, range) in frames() {
                        let gray: Vec<u8> = out.dynamic[range].iter().map(|p| (p * 255.0).round() as u8).collect();
                        image_io::write_gray8(&pictures.join(format!("{f:06}.png")), size, &gray, Overwrite::Yes)?;
                    }
                }
                Emit::Overview => {
                    let sheet = overview(self, renderer)?;
                    image_io::write_png(&folder.path().join("overview.png"), &sheet, Overwrite::Yes)?;
                }
            }
        }
        Ok(())
    }

    /// Width and height of the network's pictures.
    pub(crate) fn size(&self) -> (u32, u32) {
        (self.out.shape.width as u32, self.out.shape.height as u32)
    }

    /// Pixels of a frame.
    pub(crate) fn pixels(&self) -> usize {
        self.out.shape.width * self.out.shape.height
    }

    /// Motion of every pixel as its own frame knows it: as `Scene::velocity`, but for pixels, as static Gaussians of
    /// the scene may have been merged.
    pub(crate) fn velocity(&self) -> Vec<[f32; 3]> {
        let (n, last) = (self.pixels(), self.out.shape.frames - 1);
        let both = self.out.v_fwd.iter().zip(&self.out.v_bwd).enumerate();
        both.map(|(i, (f, b))| match i / n {
            0 => *f,
            frame if frame == last => b.map(|v| -v),
            _ => std::array::from_fn(|a| 0.5 * (f[a] - b[a])),
        })
        .collect()
    }
}
