//! Gradients of an image with respect to its Gaussians and its camera: [`Renderer::backward`].
//!
//! Two parallel steps after a drawn image. Every tile is drawn again and walked back to front
//! (`blend_back.rs`); every run of the scene then collects the sums of its records over their tiles, in tile order, and takes
//! them through the projection (`project_back.rs`). A pair of record and tile has a slot of its own, so no two
//! tasks write to one place, and the gradients have the same bits for any number of threads.

use std::sync::Mutex;
use std::sync::atomic::Ordering::Relaxed;

use sf_formats::scene::{Gaussians, SplatSettings};
use sf_formats::{Camera, Error, Result};

use crate::bin::{self, GROUPS, KeyForm};
use crate::blend::{Channels, Shared};
use crate::blend_back::{BlendBack, History, ImageGradients, SUMS, SharedBack, Slot};
use crate::project::Projector;
use crate::render::{Renderer, lock, place, read};
use crate::screen::TILE;

/// dL/d of the Gaussians' fields, in the order of the scene, and of the view. All zero for a Gaussian that is not seen.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Gradients {
    /// Of the centres.
    pub mean: Vec<[f32; 3]>,
    /// Of the standard deviations; 0 where the scale was clamped.
    pub scale: Vec<[f32; 3]>,
    /// Of the quaternions as given, w, x, y, z; always orthogonal to them.
    pub quat: Vec<[f32; 4]>,
    /// Of the opacities; 0 where the opacity was clamped.
    pub opacity: Vec<f32>,
    /// Of the colours.
    pub colour: Vec<[f32; 3]>,
    /// Of the rows of the world-to-camera matrix, as if its twelve numbers were free.
    pub view: [[f64; 4]; 3],
}

impl Gradients {
    fn reset(&mut self, n: usize) -> Result<()> {
        fn zeros<T: Clone + Default>(v: &mut Vec<T>, n: usize) -> bool {
            v.clear();
            let room = v.try_reserve_exact(n).is_ok();
            if room {
                v.resize(n, T::default());
            }
            room
        }
        self.view = [[0.0; 4]; 3];
        let room = zeros(&mut self.mean, n)
            && zeros(&mut self.scale, n)
            && zeros(&mut self.quat, n)
            && zeros(&mut self.opacity, n)
            && zeros(&mut self.colour, n);
        if room { Ok(()) } else { Err(Error::resource("backward", format!("no memory for {n} gradients"))) }
    }
}

/// What [`Renderer::backward`] remembers of the image it goes back from.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Drawn {
    pub(crate) camera: Camera,
    pub(crate) settings: SplatSettings,
    pub(crate) background: [f32; 3],
    pub(crate) gaussians: usize,
}

/// Memory of the backward pass, kept.
#[derive(Debug, Default)]
pub(crate) struct Back {
    histories: Vec<Mutex<History>>,
    slots: Vec<Slot>,
    first_slot: [Vec<u32>; GROUPS],
}

/// One run's part of the gradients.
struct Part<'a> {
    mean: &'a mut [[f32; 3]],
    scale: &'a mut [[f32; 3]],
    quat: &'a mut [[f32; 4]],
    opacity: &'a mut [f32],
    colour: &'a mut [[f32; 3]],
    view: [[f64; 4]; 3],
}

impl Renderer {
    /// Gradients of a scalar L from those of the image that was drawn last, by the same `scene`.
    ///
    /// dL/drgb, dL/ddepth and dL/dalpha come in; extra channels have no part in L. The order of the Gaussians, the pixels they reach and
    /// where a pixel stops are taken as they are. An alpha at `a_max`, a clamped scale and a clamped opacity pass nothing on.
    /// Memory: 40 bytes per pair of Gaussian and tile, and per thread 132 bytes per pair of Gaussian and block of a tile.
    ///
    /// # Errors
    /// Status 2 when nothing was drawn before or the last drawing failed; 3 when the sizes are not those of the last image and scene or a
    /// gradient is not finite; 5 without memory. Then `out` holds no gradients.
    pub fn backward(&mut self, scene: &Gaussians, image: &ImageGradients, out: &mut Gradients) -> Result<()> {
        let drawn = self.drawn.ok_or_else(|| Error::usage("backward: no image was drawn before: render first"))?;
        check(scene, image, &drawn)?;
        out.reset(scene.len())?;
        self.tiles_back(image, &drawn);
        self.collect(scene, &drawn, out);
        Ok(())
    }

    /// Fills the slots.
    fn tiles_back(&mut self, image: &ImageGradients, drawn: &Drawn) {
        let Back { histories, slots, first_slot } = &mut self.back;
        histories.resize_with(self.pool.threads(), Mutex::default);
        let groups: [_; GROUPS] = std::array::from_fn(|g| read(&self.groups[g]));
        let mut next = 0u32;
        for (group, first) in groups.iter().zip(first_slot.iter_mut()) {
            first.clear();
            for (_, met) in group.seen.places() {
                first.push(next);
                // The sum over all is limited when the image is drawn.
                next += met.count();
            }
        }
        slots.clear();
        slots.resize_with(next as usize, Slot::default);
        let shared = Shared {
            records: std::array::from_fn(|g| groups[g].seen.records()),
            seen: std::array::from_fn(|g| &groups[g].seen),
            columns: drawn.camera.width.div_ceil(TILE),
            form: KeyForm::of(drawn.gaussians),
            a_max: drawn.settings.a_max,
            extra: Channels { channels: 0, values: &[] },
        };
        let (width, height) = (drawn.camera.width as usize, drawn.camera.height as usize);
        let back = SharedBack {
            shared: &shared,
            first_slot: std::array::from_fn(|g| &first_slot[g][..]),
            slots,
            gradients: *image,
            width,
            background: drawn.background,
        };
        let side = TILE as usize;
        let columns = width.div_ceil(side);
        self.pool.run(columns * height.div_ceil(side), &|t, worker| {
            let mut tile = lock(&self.tiles[worker]);
            let mut history = lock(&histories[worker]);
            let place = place(t, columns, (width, height));
            tile.clear(place, 0);
            let lists = std::array::from_fn(|g| groups[g].tile(t));
            self.kernels.enter(BlendBack { tile: &mut tile, lists, history: &mut history, place, shared: &back });
        });
    }

    /// From slots to gradients.
    fn collect(&self, scene: &Gaussians, drawn: &Drawn, out: &mut Gradients) {
        let projector = Projector::new(&drawn.camera, &drawn.settings);
        let (mut mean, mut scale, mut quat) = (&mut out.mean[..], &mut out.scale[..], &mut out.quat[..]);
        let (mut opacity, mut colour) = (&mut out.opacity[..], &mut out.colour[..]);
        let parts: [Mutex<Part>; GROUPS] = std::array::from_fn(|g| {
            let len = bin::run(scene.len(), g).len();
            Mutex::new(Part {
                mean: mean.split_off_mut(..len).unwrap_or_default(),
                scale: scale.split_off_mut(..len).unwrap_or_default(),
                quat: quat.split_off_mut(..len).unwrap_or_default(),
                opacity: opacity.split_off_mut(..len).unwrap_or_default(),
                colour: colour.split_off_mut(..len).unwrap_or_default(),
                view: [[0.0; 4]; 3],
            })
        });
        self.pool.run(GROUPS, &|g, _| {
            let (group, part) = (read(&self.groups[g]), &mut *lock(&parts[g]));
            let start = bin::run(scene.len(), g).start;
            let records = group.seen.records().iter().zip(group.seen.places());
            for ((record, (_, met)), &first) in records.zip(&self.back.first_slot[g]) {
                let mut sums = [0.0f64; SUMS];
                for slot in &self.back.slots[first as usize..][..met.count() as usize] {
                    for (sum, value) in sums.iter_mut().zip(slot) {
                        *sum += f64::from(f32::from_bits(value.load(Relaxed)));
                    }
                }
                if sums == [0.0; SUMS] {
                    continue;
                }
                let i = record.index as usize;
                let gradient = projector.backward(scene, i, &sums);
                gradient.add_view(scene.mean[i], &mut part.view);
                part.mean[i - start] = gradient.mean.as_vec3().to_array();
                part.scale[i - start] = gradient.scale.map(|v| v as f32);
                part.quat[i - start] = gradient.quat.map(|v| v as f32);
                part.opacity[i - start] = gradient.opacity as f32;
                part.colour[i - start] = gradient.colour.map(|v| v as f32);
            }
        });
        for part in parts {
            let part = part.into_inner().unwrap_or_else(std::sync::PoisonError::into_inner);
            for (to, row) in out.view.iter_mut().zip(part.view) {
                for (to, v) in to.iter_mut().zip(row) {
                    *to += v;
                }
            }
        }
    }
}

fn check(scene: &Gaussians, image: &ImageGradients, drawn: &Drawn) -> Result<()> {
    let n = scene.len();
    let fields = [scene.scale.len(), scene.quat.len(), scene.opacity.len(), scene.colour.len()];
    if n != drawn.gaussians || fields.iter().any(|&len| len != n) {
        return Err(Error::input(
            "backward",
            format!("{n} means and {fields:?} other fields, but {} Gaussians were drawn", drawn.gaussians),
        ));
    }
    let (width, height) = (drawn.camera.width as usize, drawn.camera.height as usize);
    for (name, values, channels) in [("rgb", image.rgb, 3), ("depth", image.depth, 1), ("alpha", image.alpha, 1)] {
        let want = width * height * channels;
        if values.len() != want {
            let got = values.len();
            return Err(Error::input("backward", format!("{got} gradients of {name}, the image has {want} values")));
        }
        if let Some(i) = values.iter().position(|v| !v.is_finite()) {
            let (x, y) = (i / channels % width, i / channels / width);
            return Err(Error::input(
                "backward",
                format!("the gradient of {name} at pixel ({x}, {y}) is {}, not a finite number", values[i]),
            ));
        }
    }
    Ok(())
}
