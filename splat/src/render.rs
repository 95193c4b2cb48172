//! Images of Gaussians: [`Renderer`] keeps memory and threads between images.
//!
//! Three parallel steps with a barrier each: project (16 runs of the scene), bin (the same runs), blend
//! (tiles). A tile is owned by one thread and written to the image by it.

use std::sync::atomic::{AtomicU64, Ordering::Relaxed};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError, RwLock, RwLockReadGuard};

use sf_formats::scene::{Gaussians, SplatSettings};
use sf_formats::{Camera, Error, Result};
use sf_ops::Kernels;
use sf_ops::par::Pool;
use sf_ops::prefetch::prefetch;
use sf_ops::simd::{Body, LANES, Simd, Vector};

use crate::backward::{Back, Drawn};
use crate::bin::{self, GROUPS, Group, KeyForm};
use crate::blend::{Blend, Channels, Place, Shared, Tile};
use crate::project::{self, Counts, Projector};
use crate::screen::{BLOCK, TILE};

/// Further values per Gaussian, composited like colour but without a background: velocity, dynamic
/// probability, class scores.
#[derive(Clone, Copy, Debug)]
pub struct Extra<'a> {
    /// Values per Gaussian.
    pub channels: usize,
    /// Row-major `[gaussians, channels]`. A Gaussian with a value that is not finite is dropped.
    pub values: &'a [f32],
}

/// What to draw besides the scene.
#[derive(Clone, Copy, Debug)]
pub struct RenderOptions<'a> {
    /// Colour behind everything, weighted by what is left of T. Default black.
    pub background: [f32; 3],
    /// Further channels.
    pub extra: Option<Extra<'a>>,
    /// Most pairs of a Gaussian and a tile; checked before memory is taken for them (8 bytes each).
    /// Default 2^26.
    pub max_entries: u64,
}

impl Default for RenderOptions<'_> {
    fn default() -> Self {
        RenderOptions { background: [0.0; 3], extra: None, max_entries: 1 << 26 }
    }
}

/// Counts of one image.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Stats {
    /// Gaussians in the scene.
    pub gaussians: u64,
    /// Gaussians that reach a pixel centre with an alpha of 1/255 or more (occlusion aside).
    pub visible: u64,
    /// Pairs of a visible Gaussian and a 32x32 tile.
    pub entries: u64,
    /// Pairs of a Gaussian and a 4x4 block with an unfinished pixel that were composited.
    pub block_updates: u64,
    /// Dropped: NaN or infinity in a field.
    pub dropped_nonfinite: u64,
    /// Dropped: negative scale.
    pub dropped_scale: u64,
    /// Dropped: quaternion of length zero.
    pub dropped_quaternion: u64,
    /// Dropped: projected covariance without a positive determinant (only without a low-pass).
    pub dropped_singular: u64,
    /// Drawn with a scale clamped to 1e-20..=1e10.
    pub clamped_scale: u64,
    /// Drawn with an opacity clamped to 0..=1.
    pub clamped_opacity: u64,
}

impl Stats {
    /// Gaussians that were dropped for what they hold, not for where they are.
    pub fn dropped(&self) -> u64 {
        self.dropped_nonfinite + self.dropped_scale + self.dropped_quaternion + self.dropped_singular
    }

    /// More than 1 % were dropped: the picture should not be trusted.
    pub fn degraded(&self) -> bool {
        self.dropped() * 100 > self.gaussians
    }
}

/// An image with its depth and coverage, row-major.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Rendered {
    /// Columns.
    pub width: usize,
    /// Rows.
    pub height: usize,
    /// Colour `[height, width, 3]`, background included, not clamped.
    pub rgb: Vec<f32>,
    /// D = sum T alpha z `[height, width]`: depth weighted by coverage, scene units.
    pub depth: Vec<f32>,
    /// Coverage 1 - T `[height, width]`, 0..=1 - 1e-4.
    pub alpha: Vec<f32>,
    /// Number of extra channels.
    pub channels: usize,
    /// Extra channels `[height, width, channels]`, sum T alpha value.
    pub extra: Vec<f32>,
    /// Counts.
    pub stats: Stats,
}

impl Rendered {
    /// Depth of what is seen, D / max(alpha, 1e-10) `[height, width]`; 0 where nothing is.
    pub fn expected_depth(&self) -> Vec<f32> {
        self.depth.iter().zip(&self.alpha).map(|(d, a)| d / a.max(1e-10)).collect()
    }

    fn resize(&mut self, width: usize, height: usize, channels: usize) -> Result<()> {
        let pixels = width * height;
        for (image, planes) in
            [(&mut self.rgb, 3), (&mut self.depth, 1), (&mut self.alpha, 1), (&mut self.extra, channels)]
        {
            // Tiles write every pixel, so what another image left needs no clearing.
            let room = pixels.checked_mul(planes).filter(|&len| {
                let more = len.saturating_sub(image.len());
                more == 0 || image.try_reserve_exact(more).is_ok()
            });
            let Some(len) = room else {
                let why = format!("no memory for a {width}x{height} image of {planes} channels");
                return Err(Error::resource("render", why));
            };
            image.resize(len, 0.0);
        }
        (self.width, self.height, self.channels) = (width, height, channels);
        Ok(())
    }
}

/// Draws one image on the calling thread. For many images keep a [`Renderer`].
pub fn render(
    scene: &Gaussians,
    camera: &Camera,
    settings: &SplatSettings,
    options: &RenderOptions,
) -> Result<Rendered> {
    Renderer::new(1)?.render(scene, camera, settings, options)
}

/// Draws images, keeping memory between them.
#[derive(Debug)]
pub struct Renderer {
    pub(crate) pool: Arc<Pool>,
    pub(crate) kernels: &'static Kernels,
    pub(crate) groups: [RwLock<Group>; GROUPS],
    pub(crate) tiles: Vec<Mutex<Tile>>,
    /// The last image, if it was drawn to the end.
    pub(crate) drawn: Option<Drawn>,
    pub(crate) back: Back,
}

impl Renderer {
    /// A renderer with its own threads, at least one (the caller).
    ///
    /// # Errors
    /// Status 5 when the system refuses a thread.
    ///
    /// # Panics
    /// As [`Renderer::with_pool`].
    pub fn new(threads: usize) -> Result<Renderer> {
        let pool = Pool::new(threads.max(1))
            .map_err(|e| Error::resource("render", format!("cannot start {threads} threads: {e}")))?;
        Ok(Renderer::with_pool(Arc::new(pool)))
    }

    /// A renderer on threads that others use too.
    ///
    /// # Panics
    /// As [`Kernels::best`], when the variable that caps the instruction set is unusable.
    pub fn with_pool(pool: Arc<Pool>) -> Renderer {
        Renderer::with_kernels(pool, Kernels::best())
    }

    /// A renderer on given threads and a given instruction set; the picture has the same bits on all.
    pub fn with_kernels(pool: Arc<Pool>, kernels: &'static Kernels) -> Renderer {
        Renderer {
            kernels,
            groups: std::array::from_fn(|_| RwLock::default()),
            tiles: (0..pool.threads()).map(|_| Mutex::default()).collect(),
            pool,
            drawn: None,
            back: Back::default(),
        }
    }

    /// Draws an image.
    ///
    /// # Errors
    /// Status 3 for a bad camera, setting or scene layout; 5 for a side over 16384 pixels, more entries
    /// than `options.max_entries`, or no memory.
    pub fn render(
        &mut self,
        scene: &Gaussians,
        camera: &Camera,
        settings: &SplatSettings,
        options: &RenderOptions,
    ) -> Result<Rendered> {
        let mut out = Rendered::default();
        self.render_into(scene, camera, settings, options, &mut out)?;
        Ok(out)
    }

    /// [`Renderer::render`] into images whose memory is kept. After an error `out` holds no image.
    pub fn render_into(
        &mut self,
        scene: &Gaussians,
        camera: &Camera,
        settings: &SplatSettings,
        options: &RenderOptions,
        out: &mut Rendered,
    ) -> Result<()> {
        self.drawn = None;
        camera.check("camera")?;
        project::check_settings(settings)?;
        check_scene(scene)?;
        let extra = check_extra(scene, options.extra)?;
        if !options.background.iter().all(|v| v.is_finite()) {
            return Err(Error::usage(format!("background {:?} must be finite", options.background)));
        }
        let columns = camera.width.div_ceil(TILE);
        let rows = camera.height.div_ceil(TILE);
        let limit = options.max_entries.min(u64::from(u32::MAX));
        let stats = self.project(scene, &Projector::new(camera, settings), extra, ((columns, rows), limit));
        if stats.entries > limit {
            return Err(Error::resource(
                "render",
                format!(
                    "{} visible Gaussians meet {} tiles in all, over the limit of {limit}: \
                     use a smaller image, fewer or smaller Gaussians, or a higher limit",
                    stats.visible, stats.entries
                ),
            ));
        }
        out.resize(camera.width as usize, camera.height as usize, extra.channels)?;
        out.stats = stats;
        let (groups, form) = (&self.groups, KeyForm::of(scene.len()));
        let groups: [_; GROUPS] = std::array::from_fn(|g| read(&groups[g]));
        let records = std::array::from_fn(|g| groups[g].seen.records());
        let seen = std::array::from_fn(|g| &groups[g].seen);
        let shared = Shared { records, seen, columns, form, a_max: settings.a_max, extra };
        out.stats.block_updates = self.blend(columns as usize, &groups, &shared, options.background, out);
        drop(groups);
        let (background, gaussians) = (options.background, scene.len());
        self.drawn = Some(Drawn { camera: *camera, settings: *settings, background, gaussians });
        Ok(())
    }

    /// Projects and bins all groups, up to the limit, and sums their counts.
    fn project(
        &mut self,
        scene: &Gaussians,
        projector: &Projector,
        extra: Channels,
        tiles: ((u32, u32), u64),
    ) -> Stats {
        let finite = |i: usize| extra.values[i * extra.channels..][..extra.channels].iter().all(|v| v.is_finite());
        let usable = (extra.channels > 0).then_some(&finite as &(dyn Fn(usize) -> bool + Sync));
        let (groups, kernels, form) = (&self.groups, self.kernels, KeyForm::of(scene.len()));
        let ((columns, _), limit) = tiles;
        let entries = AtomicU64::new(0);
        self.pool.run(GROUPS, &|g, _| {
            let part = (scene, bin::run(scene.len(), g));
            let group = &mut *write(&groups[g]);
            group.project(kernels, projector, part, usable, tiles);
            // At once, while what it reads is near. Once the limit is passed nobody will look.
            if entries.fetch_add(group.entries, Relaxed) + group.entries <= limit {
                group.bin(kernels, g, form, columns);
            }
        });
        let mut counts = Counts::default();
        let mut stats = Stats { gaussians: scene.len() as u64, ..Stats::default() };
        for group in &self.groups {
            let group = read(group);
            counts.add(&group.counts);
            stats.visible += group.seen.records().len() as u64;
            stats.entries += group.entries;
        }
        Stats {
            dropped_nonfinite: counts.nonfinite,
            dropped_scale: counts.negative_scale,
            dropped_quaternion: counts.zero_quaternion,
            dropped_singular: counts.singular,
            clamped_scale: counts.clamped_scale,
            clamped_opacity: counts.clamped_opacity,
            ..stats
        }
    }

    /// Blends all tiles into the image; the block updates.
    fn blend(
        &self,
        columns: usize,
        groups: &[RwLockReadGuard<Group>; GROUPS],
        shared: &Shared,
        background: [f32; 3],
        out: &mut Rendered,
    ) -> u64 {
        let (width, height, channels) = (out.width, out.height, out.channels);
        let side = TILE as usize;
        let rows = height.div_ceil(side);
        // Tiles of one row of tiles share a band of the image; each writes its columns under the lock.
        let band = |planes: usize| (side * width * planes).max(1);
        let mut rgb = out.rgb.chunks_mut(band(3));
        let mut depth = out.depth.chunks_mut(band(1));
        let mut alpha = out.alpha.chunks_mut(band(1));
        let mut extra = out.extra.chunks_mut(band(channels));
        let bands: [Mutex<Band>; MAX_BANDS] = std::array::from_fn(|_| {
            Mutex::new(Band {
                rgb: rgb.next().unwrap_or_default(),
                depth: depth.next().unwrap_or_default(),
                alpha: alpha.next().unwrap_or_default(),
                extra: extra.next().unwrap_or_default(),
            })
        });
        // Which worker takes which tile is open, so every one gets room for the longest list.
        let entries = |t: usize| groups.iter().map(|g| g.tile(t).len()).sum();
        let longest = (0..columns * rows).map(entries).max().unwrap_or(0);
        for tile in &self.tiles {
            lock(tile).reserve(longest, channels);
        }
        let updates = AtomicU64::new(0);
        // Neighbours in a row of tiles share a lock: each thread has its own stretch of rows, as long as all keep step.
        let (tiles, threads) = (columns * rows, self.pool.threads());
        let stretch = tiles.div_ceil(threads);
        self.pool.run(stretch * threads, &|task, worker| {
            let t = task % threads * stretch + task / threads;
            if t >= tiles {
                return;
            }
            let mut tile = lock(&self.tiles[worker]);
            let place = place(t, columns, (width, height));
            tile.clear(place, channels);
            lock(&bands[t / columns]).approach(place, width);
            let lists = std::array::from_fn(|g| groups[g].tile(t));
            self.kernels.enter(Blend { tile: &mut tile, lists, place, shared });
            updates.fetch_add(tile.updates(), Relaxed);
            let band = &mut *lock(&bands[t / columns]);
            self.kernels.enter(Store { band, tile: &tile, place, width, channels, background });
        });
        updates.into_inner()
    }
}

/// Where tile `t` lies in an image of a size.
pub(crate) fn place(t: usize, columns: usize, (width, height): (usize, usize)) -> Place {
    let side = TILE as usize;
    let (x, y) = (t % columns * side, t / columns * side);
    Place { x, y, width: side.min(width - x), height: side.min(height - y) }
}

/// Rows of tiles of the highest image.
const MAX_BANDS: usize = Camera::MAX_SIDE.div_ceil(TILE) as usize;

/// The part of every image that one row of tiles covers.
struct Band<'a> {
    rgb: &'a mut [f32],
    depth: &'a mut [f32],
    alpha: &'a mut [f32],
    extra: &'a mut [f32],
}

impl Band<'_> {
    /// Hints that the tile at `place` will be written: its rows lie on as many pages, where no hardware looks ahead.
    fn approach(&self, place: Place, width: usize) {
        for y in 0..place.height {
            let start = y * width + place.x;
            for x in (0..place.width).step_by(LANES) {
                for i in 0..3 {
                    prefetch(&self.rgb[3 * (start + x) + i * LANES.min(place.width - x)]);
                }
                prefetch(&self.depth[start + x]);
                prefetch(&self.alpha[start + x]);
            }
        }
    }
}

/// Writes a tile to its columns of a band, sixteen pixels at a time.
struct Store<'a, 'b> {
    band: &'a mut Band<'b>,
    tile: &'a Tile,
    place: Place,
    /// Columns of the image.
    width: usize,
    channels: usize,
    background: [f32; 3],
}

impl Body for Store<'_, '_> {
    type Output = ();

    #[inline(always)]
    fn run<S: Simd>(self, s: S) {
        let Store { band, tile, place, width, channels, background } = self;
        let one = s.splat(1.0);
        let background = [s.splat(background[0]), s.splat(background[1]), s.splat(background[2])];
        for x in (0..place.width).step_by(LANES) {
            let columns = LANES.min(place.width - x);
            for y in (0..place.height).step_by(BLOCK) {
                let [t, sums @ ..] = tile.rows(s, x / BLOCK, y / BLOCK);
                let [r, g, b, z] = sums;
                for row in 0..BLOCK.min(place.height - y) {
                    let start = (y + row) * width + place.x + x;
                    let t = t[row].abs();
                    let rgb = [r[row] + t * background[0], g[row] + t * background[1], b[row] + t * background[2]];
                    // Whole vectors where they fit, so that nothing goes through other memory.
                    let to = &mut band.rgb[3 * start..3 * (start + columns)].as_chunks_mut().0;
                    match <&mut [[f32; 3]; LANES]>::try_from(&mut **to) {
                        Ok(to) => s.store3(rgb, to),
                        Err(_) => {
                            let mut part = [[0.0; 3]; LANES];
                            s.store3(rgb, &mut part);
                            to.copy_from_slice(&part[..columns]);
                        }
                    }
                    let depth = &mut band.depth[start..start + columns];
                    let alpha = &mut band.alpha[start..start + columns];
                    store(z[row], depth);
                    store(one - t, alpha);
                }
            }
        }
        if channels > 0 {
            for y in 0..place.height {
                let start = y * width + place.x;
                let rows = band.extra[start * channels..(start + place.width) * channels].chunks_exact_mut(channels);
                for (x, out) in rows.enumerate() {
                    out.iter_mut().zip(tile.extra(x, y, channels)).for_each(|(v, sum)| *v = sum);
                }
            }
        }
    }
}

/// The first lanes to a slice of up to sixteen.
#[inline(always)]
fn store<V: Vector>(v: V, to: &mut [f32]) {
    match <&mut [f32; LANES]>::try_from(&mut *to) {
        Ok(to) => v.store(to),
        Err(_) => {
            let mut part = [0.0; LANES];
            v.store(&mut part);
            to.copy_from_slice(&part[..to.len()]);
        }
    }
}

fn check_scene(scene: &Gaussians) -> Result<()> {
    let n = scene.len();
    let fields = [scene.scale.len(), scene.quat.len(), scene.opacity.len(), scene.colour.len()];
    if fields.iter().any(|&len| len != n) {
        return Err(Error::input(
            "scene",
            format!("{n} means but {fields:?} scales, quaternions, opacities, colours: all must be equal"),
        ));
    }
    if n > bin::MAX_GAUSSIANS {
        return Err(Error::resource("scene", format!("{n} Gaussians, limit {}", bin::MAX_GAUSSIANS)));
    }
    Ok(())
}

fn check_extra<'a>(scene: &Gaussians, extra: Option<Extra<'a>>) -> Result<Channels<'a>> {
    let Some(Extra { channels, values }) = extra else { return Ok(Channels { channels: 0, values: &[] }) };
    if channels.checked_mul(scene.len()) != Some(values.len()) {
        return Err(Error::input(
            "extra channels",
            format!("{} values for {} Gaussians of {channels} channels", values.len(), scene.len()),
        ));
    }
    Ok(Channels { channels, values })
}

// A poisoned lock means that a task panicked; its panic has already reached the caller, and every
// image starts by clearing what it uses.
pub(crate) fn read<T>(lock: &RwLock<T>) -> RwLockReadGuard<'_, T> {
    lock.read().unwrap_or_else(PoisonError::into_inner)
}

pub(crate) fn write<T>(lock: &RwLock<T>) -> std::sync::RwLockWriteGuard<'_, T> {
    lock.write().unwrap_or_else(PoisonError::into_inner)
}

pub(crate) fn lock<T>(mutex: &Mutex<T>) -> MutexGuard<'_, T> {
    mutex.lock().unwrap_or_else(PoisonError::into_inner)
}
