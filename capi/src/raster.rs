//! Contexts, images of Gaussians and their gradients.
#![allow(unsafe_code, reason = "exported names, and the caller's pointers")]

use std::ffi::c_int;
use std::sync::Arc;

use glam::{DMat3, DVec3};
use sf_formats::scene::{Gaussians, SplatSettings};
use sf_formats::{Camera, Error, Intrinsics, Pose, Result};
use sf_ops::Kernels;
use sf_ops::par::Pool;
use sf_splat::{Gradients, ImageGradients, RenderOptions, Rendered, Renderer};

use crate::call::call;
use crate::handle::Table;
use crate::memory::{Struct, array, check_struct, put, read, write};

/// Most threads of a context.
const MAX_THREADS: u32 = 64;

static CONTEXTS: Table<Context> = Table::new(1, "sf_context");
static RASTERS: Table<Raster> = Table::new(2, "sf_raster");

/// Threads and kernels.
struct Context {
    pool: Arc<Pool>,
    kernels: &'static Kernels,
}

/// An image that can be gone back from, with its Gaussians; all memory is kept.
struct Raster {
    renderer: Renderer,
    scene: Gaussians,
    image: Rendered,
    gradients: Gradients,
}

/// `sf_gaussians`.
#[derive(Clone, Copy)]
#[repr(C)]
pub(crate) struct SfGaussians {
    pub(crate) struct_size: usize,
    pub(crate) count: u64,
    pub(crate) mean: *const f32,
    pub(crate) scale: *const f32,
    pub(crate) quat: *const f32,
    pub(crate) opacity: *const f32,
    pub(crate) colour: *const f32,
}

/// `sf_view`.
#[derive(Clone, Copy)]
#[repr(C)]
pub(crate) struct SfView {
    pub(crate) struct_size: usize,
    pub(crate) width: u32,
    pub(crate) height: u32,
    pub(crate) fx: f64,
    pub(crate) fy: f64,
    pub(crate) cx: f64,
    pub(crate) cy: f64,
    pub(crate) world_to_camera: [f64; 16],
}

/// `sf_splat_settings`.
#[derive(Clone, Copy)]
#[repr(C)]
pub(crate) struct SfSplatSettings {
    pub(crate) struct_size: usize,
    pub(crate) antialiased: i32,
    pub(crate) a_max: f32,
    pub(crate) eps2d: f32,
    pub(crate) near_z: f32,
    pub(crate) background: [f32; 3],
    pub(crate) max_entries: u64,
}

/// `sf_image`.
#[derive(Clone, Copy)]
#[repr(C)]
pub(crate) struct SfImage {
    pub(crate) struct_size: usize,
    pub(crate) pixels: u64,
    pub(crate) rgb: *mut f32,
    pub(crate) depth: *mut f32,
    pub(crate) alpha: *mut f32,
}

/// `sf_image_gradients`.
#[derive(Clone, Copy)]
#[repr(C)]
pub(crate) struct SfImageGradients {
    pub(crate) struct_size: usize,
    pub(crate) pixels: u64,
    pub(crate) rgb: *const f32,
    pub(crate) depth: *const f32,
    pub(crate) alpha: *const f32,
}

/// `sf_gaussian_gradients`.
#[derive(Clone, Copy)]
#[repr(C)]
pub(crate) struct SfGaussianGradients {
    pub(crate) struct_size: usize,
    pub(crate) count: u64,
    pub(crate) mean: *mut f32,
    pub(crate) scale: *mut f32,
    pub(crate) quat: *mut f32,
    pub(crate) opacity: *mut f32,
    pub(crate) colour: *mut f32,
    pub(crate) view: *mut f64,
}

/// `sf_counts`.
#[derive(Clone, Copy, Default)]
#[repr(C)]
pub(crate) struct SfCounts {
    pub(crate) struct_size: usize,
    pub(crate) gaussians: u64,
    pub(crate) visible: u64,
    pub(crate) entries: u64,
    pub(crate) block_updates: u64,
    pub(crate) dropped: u64,
    pub(crate) clamped: u64,
}

macro_rules! structs {
    ($($type:ident $name:literal),* $(,)?) => {
        $(
            // SAFETY: `struct_size: usize` stands first, and numbers and raw pointers take any bits.
            unsafe impl Struct for $type {
                const NAME: &'static str = $name;
            }
        )*
    };
}

structs! {
    SfGaussians "sf_gaussians",
    SfView "sf_view",
    SfSplatSettings "sf_splat_settings",
    SfImage "sf_image",
    SfImageGradients "sf_image_gradients",
    SfGaussianGradients "sf_gaussian_gradients",
    SfCounts "sf_counts",
}

/// A context of `threads` threads, the caller's included; 0 takes what the process may use.
///
/// # Safety
/// `out` is null or has room for a handle.
#[unsafe(no_mangle)]
pub(crate) unsafe extern "C" fn sf_context_create(threads: u32, out: *mut u64) -> c_int {
    call(|| {
        // SAFETY: the caller's promise. A failed call leaves no handle.
        unsafe { write(out, "out", 0) }?;
        if threads > MAX_THREADS {
            return Err(Error::usage(format!("{threads} threads: at most {MAX_THREADS}, or 0 for what is allowed")));
        }
        let threads = match threads {
            0 => std::thread::available_parallelism().map_or(1, usize::from).min(MAX_THREADS as usize),
            n => n as usize,
        };
        let kernels = Kernels::from_env().map_err(Error::usage)?;
        let pool = Pool::new(threads)
            .map_err(|e| Error::resource("sf_context", format!("cannot start {threads} threads: {e}")))?;
        let handle = CONTEXTS.insert(Context { pool: Arc::new(pool), kernels })?;
        // SAFETY: as above.
        unsafe { write(out, "out", handle) }
    })
}

/// Ends a context; its threads end with the last raster that uses them.
#[unsafe(no_mangle)]
pub(crate) extern "C" fn sf_context_destroy(context: u64) -> c_int {
    call(|| CONTEXTS.remove(context))
}

/// A raster that draws with the threads of a context.
///
/// # Safety
/// `out` is null or has room for a handle.
#[unsafe(no_mangle)]
pub(crate) unsafe extern "C" fn sf_raster_create(context: u64, out: *mut u64) -> c_int {
    call(|| {
        // SAFETY: the caller's promise. A failed call leaves no handle.
        unsafe { write(out, "out", 0) }?;
        let (pool, kernels) = CONTEXTS.with(context, |c| Ok((Arc::clone(&c.pool), c.kernels)))?;
        let handle = RASTERS.insert(Raster {
            renderer: Renderer::with_kernels(pool, kernels),
            scene: Gaussians::default(),
            image: Rendered::default(),
            gradients: Gradients::default(),
        })?;
        // SAFETY: as above.
        unsafe { write(out, "out", handle) }
    })
}

/// Ends a raster.
#[unsafe(no_mangle)]
pub(crate) extern "C" fn sf_raster_destroy(raster: u64) -> c_int {
    call(|| RASTERS.remove(raster))
}

/// The default settings, with their size.
///
/// # Safety
/// `settings` is null or has room.
#[unsafe(no_mangle)]
pub(crate) unsafe extern "C" fn sf_splat_settings_init(settings: *mut SfSplatSettings) -> c_int {
    call(|| {
        let (splat, options) = (SplatSettings::default(), RenderOptions::default());
        let defaults = SfSplatSettings {
            struct_size: size_of::<SfSplatSettings>(),
            antialiased: i32::from(splat.aa),
            a_max: splat.a_max,
            eps2d: splat.eps2d,
            near_z: splat.near,
            background: options.background,
            max_entries: options.max_entries,
        };
        // SAFETY: the caller's promise.
        unsafe { write(settings, SfSplatSettings::NAME, defaults) }
    })
}

/// Draws Gaussians and keeps what the way back needs, a copy of them included.
///
/// # Safety
/// Every pointer is null or points to what the header says.
#[unsafe(no_mangle)]
pub(crate) unsafe extern "C" fn sf_raster_forward(
    raster: u64,
    gaussians: *const SfGaussians,
    view: *const SfView,
    settings: *const SfSplatSettings,
    image: *const SfImage,
) -> c_int {
    call(|| {
        // SAFETY: the caller's promise.
        let (gaussians, view, image) = unsafe { (read(gaussians)?, read(view)?, read(image)?) };
        // SAFETY: the caller's promise.
        let settings = if settings.is_null() { None } else { Some(unsafe { read(settings) }?) };
        let (splat, options) = settings.map_or_else(Default::default, convert);
        let camera = camera(&view);
        same("sf_image.pixels", image.pixels, u64::from(view.width) * u64::from(view.height))?;
        RASTERS.with(raster, |r| {
            // SAFETY: the caller's promise.
            unsafe { copy_scene(&gaussians, &mut r.scene) }?;
            r.renderer.render_into(&r.scene, &camera, &splat, &options, &mut r.image)?;
            // SAFETY: the caller's promise; the source is our own memory.
            unsafe {
                put(image.rgb, &r.image.rgb, "sf_image.rgb")?;
                put(image.depth, &r.image.depth, "sf_image.depth")?;
                put(image.alpha, &r.image.alpha, "sf_image.alpha")
            }
        })
    })
}

/// From the gradients of the last image to those of its Gaussians and view.
///
/// # Safety
/// Every pointer is null or points to what the header says.
#[unsafe(no_mangle)]
pub(crate) unsafe extern "C" fn sf_raster_backward(
    raster: u64,
    image: *const SfImageGradients,
    gaussians: *const SfGaussianGradients,
) -> c_int {
    call(|| {
        // SAFETY: the caller's promise.
        let (image, out) = unsafe { (read(image)?, read(gaussians)?) };
        RASTERS.with(raster, |r| {
            let pixels = r.image.width * r.image.height;
            same("sf_image_gradients.pixels", image.pixels, pixels as u64)?;
            same("sf_gaussian_gradients.count", out.count, r.scene.len() as u64)?;
            let zeros = vec![0.0; if image.rgb.is_null() { 3 * pixels } else { pixels }];
            let given = |p: *const f32, n: usize, name| {
                // SAFETY: the caller's promise, for the length of this call.
                if p.is_null() { Ok(&zeros[..n]) } else { unsafe { array(p, n, name) } }
            };
            let gradients = ImageGradients {
                rgb: given(image.rgb, 3 * pixels, "sf_image_gradients.rgb")?,
                depth: given(image.depth, pixels, "sf_image_gradients.depth")?,
                alpha: given(image.alpha, pixels, "sf_image_gradients.alpha")?,
            };
            r.renderer.backward(&r.scene, &gradients, &mut r.gradients)?;
            let g = &r.gradients;
            // SAFETY: the caller's promise; the sources are our own memory.
            unsafe {
                put(out.mean, g.mean.as_flattened(), "sf_gaussian_gradients.mean")?;
                put(out.scale, g.scale.as_flattened(), "sf_gaussian_gradients.scale")?;
                put(out.quat, g.quat.as_flattened(), "sf_gaussian_gradients.quat")?;
                put(out.opacity, &g.opacity, "sf_gaussian_gradients.opacity")?;
                put(out.colour, g.colour.as_flattened(), "sf_gaussian_gradients.colour")?;
                put(out.view, g.view.as_flattened(), "sf_gaussian_gradients.view")
            }
        })
    })
}

/// Counts of the last image.
///
/// # Safety
/// `counts` is null or points to a struct with its size.
#[unsafe(no_mangle)]
pub(crate) unsafe extern "C" fn sf_raster_counts(raster: u64, counts: *mut SfCounts) -> c_int {
    call(|| {
        // SAFETY: the caller's promise.
        unsafe { check_struct(counts) }?;
        let stats = RASTERS.with(raster, |r| Ok(r.image.stats))?;
        let value = SfCounts {
            struct_size: size_of::<SfCounts>(),
            gaussians: stats.gaussians,
            visible: stats.visible,
            entries: stats.entries,
            block_updates: stats.block_updates,
            dropped: stats.dropped(),
            clamped: stats.clamped_scale + stats.clamped_opacity,
        };
        // SAFETY: the caller's promise.
        unsafe { write(counts, SfCounts::NAME, value) }
    })
}

fn same(name: &str, given: u64, want: u64) -> Result<()> {
    if given == want { Ok(()) } else { Err(Error::usage(format!("{name} is {given}, expected {want}"))) }
}

fn convert(s: SfSplatSettings) -> (SplatSettings, RenderOptions<'static>) {
    let splat = SplatSettings { aa: s.antialiased != 0, a_max: s.a_max, eps2d: s.eps2d, near: s.near_z };
    (splat, RenderOptions { background: s.background, max_entries: s.max_entries, ..RenderOptions::default() })
}

/// The renderer checks it. The centre is that of R and t as they are, so a rotation of f32 accuracy moves nothing.
fn camera(view: &SfView) -> Camera {
    let m = |row: usize, column: usize| view.world_to_camera[4 * row + column];
    let column = |j: usize| DVec3::new(m(0, j), m(1, j), m(2, j));
    let r = DMat3::from_cols(column(0), column(1), column(2));
    let bottom = [m(3, 0), m(3, 1), m(3, 2), m(3, 3)] == [0.0, 0.0, 0.0, 1.0];
    let t = if bottom { -(r.inverse() * column(3)) } else { DVec3::NAN };
    Camera {
        width: view.width,
        height: view.height,
        k: Intrinsics { fx: view.fx, fy: view.fy, cx: view.cx, cy: view.cy },
        pose: Pose { r: r.transpose(), t },
    }
}

/// # Safety
/// The pointers are null or point to `count` Gaussians.
unsafe fn copy_scene(from: &SfGaussians, to: &mut Gaussians) -> Result<()> {
    fn copy<T: Copy>(from: &[T], to: &mut Vec<T>) -> Result<()> {
        to.clear();
        to.try_reserve(from.len())
            .map_err(|_| Error::resource("sf_gaussians", format!("no memory for {} Gaussians", from.len())))?;
        to.extend_from_slice(from);
        Ok(())
    }
    let n = usize::try_from(from.count).map_err(|_| Error::usage(format!("sf_gaussians: {} Gaussians", from.count)))?;
    // SAFETY: the caller's promise, for the length of this call.
    unsafe {
        copy(array(from.mean, n, "sf_gaussians.mean")?, &mut to.mean)?;
        copy(array(from.scale, n, "sf_gaussians.scale")?, &mut to.scale)?;
        copy(array(from.quat, n, "sf_gaussians.quat")?, &mut to.quat)?;
        copy(array(from.opacity, n, "sf_gaussians.opacity")?, &mut to.opacity)?;
        copy(array(from.colour, n, "sf_gaussians.colour")?, &mut to.colour)
    }
}
