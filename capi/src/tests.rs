//! The functions as C calls them.
#![allow(unsafe_code, reason = "calls through the C interface")]

use std::ffi::{c_char, c_int};
use std::ptr::{null, null_mut};

use sf_formats::Status;
use sf_formats::scene::{Gaussians, SplatSettings};
use sf_formats::{Camera, Error, Intrinsics, Pose};
use sf_splat::{Gradients, ImageGradients, RenderOptions, Renderer};

use crate::call::{call, sf_abi_version, sf_last_error, sf_version};
use crate::handle::Table;
use crate::raster::*;

const HEADER: &str = include_str!("../include/streetforward.h");
const SOURCES: [&str; 2] = [include_str!("call.rs"), include_str!("raster.rs")];
const OK: c_int = 0;
const USAGE: c_int = Status::Usage as c_int;
const INPUT: c_int = Status::Input as c_int;

const WIDTH: u32 = 37;
const HEIGHT: u32 = 23;
const PIXELS: usize = (WIDTH * HEIGHT) as usize;
const COUNT: usize = 200;

fn message() -> String {
    // SAFETY: no buffer, then one of the size asked for.
    unsafe {
        let size = sf_last_error(null_mut(), 0);
        let mut buffer = vec![0u8; size];
        assert_eq!(sf_last_error(buffer.as_mut_ptr().cast::<c_char>(), size), size);
        assert_eq!(buffer.pop(), Some(0));
        String::from_utf8(buffer).unwrap()
    }
}

/// A waving field of numbers in -1..1.
fn wave(n: usize, seed: u32) -> Vec<f32> {
    (0..n as u32).map(|i| ((i * 7919 + seed * 104_729) % 2003) as f32 / 1001.5 - 1.0).collect()
}

fn scene() -> Gaussians {
    let (x, q) = (wave(3 * COUNT, 1), wave(4 * COUNT, 2));
    Gaussians {
        mean: x.as_chunks::<3>().0.iter().map(|m| [3.0 * m[0], 2.0 * m[1], 5.0 + m[2]]).collect(),
        scale: wave(3 * COUNT, 3).as_chunks::<3>().0.iter().map(|s| s.map(|v| 0.2 + 0.1 * v)).collect(),
        quat: q.as_chunks::<4>().0.to_vec(),
        opacity: wave(COUNT, 4).iter().map(|o| 0.5 + 0.4 * o).collect(),
        colour: wave(3 * COUNT, 5).as_chunks::<3>().0.to_vec(),
    }
}

fn gaussians(scene: &Gaussians) -> SfGaussians {
    SfGaussians {
        struct_size: size_of::<SfGaussians>(),
        count: scene.len() as u64,
        mean: scene.mean.as_ptr().cast(),
        scale: scene.scale.as_ptr().cast(),
        quat: scene.quat.as_ptr().cast(),
        opacity: scene.opacity.as_ptr(),
        colour: scene.colour.as_ptr().cast(),
    }
}

fn view() -> SfView {
    // A quarter turn about z and a step back.
    let world_to_camera = [0., -1., 0., 0.1, 1., 0., 0., -0.2, 0., 0., 1., 0.5, 0., 0., 0., 1.];
    SfView {
        struct_size: size_of::<SfView>(),
        width: WIDTH,
        height: HEIGHT,
        fx: 30.0,
        fy: 31.0,
        cx: 18.0,
        cy: 12.0,
        world_to_camera,
    }
}

fn settings() -> SfSplatSettings {
    let mut settings = std::mem::MaybeUninit::uninit();
    // SAFETY: room for the struct, which is then filled.
    unsafe {
        assert_eq!(sf_splat_settings_init(settings.as_mut_ptr()), OK);
        settings.assume_init()
    }
}

fn no_image() -> SfImage {
    let none = null_mut();
    SfImage { struct_size: size_of::<SfImage>(), pixels: PIXELS as u64, rgb: none, depth: none, alpha: none }
}

fn no_gradients() -> (SfImageGradients, SfGaussianGradients) {
    let size = size_of::<SfImageGradients>();
    let image =
        SfImageGradients { struct_size: size, pixels: PIXELS as u64, rgb: null(), depth: null(), alpha: null() };
    let gaussians = SfGaussianGradients {
        struct_size: size_of::<SfGaussianGradients>(),
        count: COUNT as u64,
        mean: null_mut(),
        scale: null_mut(),
        quat: null_mut(),
        opacity: null_mut(),
        colour: null_mut(),
        view: null_mut(),
    };
    (image, gaussians)
}

/// A context and a raster, destroyed at the end.
struct Handles(u64, u64);

impl Handles {
    fn new(threads: u32) -> Handles {
        let mut handles = Handles(0, 0);
        // SAFETY: places for the handles.
        unsafe {
            assert_eq!(sf_context_create(threads, &mut handles.0), OK);
            assert_eq!(sf_raster_create(handles.0, &mut handles.1), OK);
        }
        handles
    }

    fn forward(&self, g: &SfGaussians, v: &SfView, s: *const SfSplatSettings, i: &SfImage) -> c_int {
        // SAFETY: the tests' pointers are null or as long as they say.
        unsafe { sf_raster_forward(self.1, g, v, s, i) }
    }

    fn backward(&self, i: &SfImageGradients, g: &SfGaussianGradients) -> c_int {
        // SAFETY: as above.
        unsafe { sf_raster_backward(self.1, i, g) }
    }
}

impl Drop for Handles {
    fn drop(&mut self) {
        assert_eq!((sf_context_destroy(self.0), sf_raster_destroy(self.1)), (OK, OK));
    }
}

#[test]
fn images_and_gradients_are_the_rasterizers() {
    let scene = scene();
    let camera = Camera {
        width: WIDTH,
        height: HEIGHT,
        k: Intrinsics { fx: 30.0, fy: 31.0, cx: 18.0, cy: 12.0 },
        pose: Pose {
            r: glam::DMat3::from_cols_array(&[0., -1., 0., 1., 0., 0., 0., 0., 1.]),
            t: glam::DVec3::new(0.2, 0.1, -0.5),
        },
    };
    let splat = SplatSettings { aa: true, ..SplatSettings::default() };
    let options = RenderOptions { background: [0.1, 0.2, 0.3], ..RenderOptions::default() };
    let mut renderer = Renderer::new(1).unwrap();
    let want = renderer.render(&scene, &camera, &splat, &options).unwrap();
    assert!(want.stats.visible > 50);
    let (rgb, depth, alpha) = (wave(3 * PIXELS, 6), wave(PIXELS, 7), wave(PIXELS, 8));
    let mut back = Gradients::default();
    renderer.backward(&scene, &ImageGradients { rgb: &rgb, depth: &depth, alpha: &alpha }, &mut back).unwrap();

    for threads in [1, 2, 0] {
        let handles = Handles::new(threads);
        let settings = SfSplatSettings { antialiased: 1, background: [0.1, 0.2, 0.3], ..settings() };
        let (mut c, mut d, mut a) = (vec![0.0f32; 3 * PIXELS], vec![0.0f32; PIXELS], vec![0.0f32; PIXELS]);
        let image = SfImage { rgb: c.as_mut_ptr(), depth: d.as_mut_ptr(), alpha: a.as_mut_ptr(), ..no_image() };
        {
            // A copy that is gone before the way back.
            let copy = scene.clone();
            assert_eq!(handles.forward(&gaussians(&copy), &view(), &settings, &image), OK, "{}", message());
        }
        assert_eq!((&c, &d, &a), (&want.rgb, &want.depth, &want.alpha));
        let mut out: Vec<Vec<f32>> = [3, 3, 4, 1, 3].iter().map(|n| vec![9.0; n * COUNT]).collect();
        let mut rows = [9.0f64; 12];
        let p: Vec<*mut f32> = out.iter_mut().map(|v| v.as_mut_ptr()).collect();
        let (empty, none) = no_gradients();
        let given = SfImageGradients { rgb: rgb.as_ptr(), depth: depth.as_ptr(), alpha: alpha.as_ptr(), ..empty };
        let wanted = SfGaussianGradients {
            mean: p[0],
            scale: p[1],
            quat: p[2],
            opacity: p[3],
            colour: p[4],
            view: rows.as_mut_ptr(),
            ..none
        };
        // Once for nobody and once without a gradient: neither leaves a trace.
        assert_eq!(handles.backward(&given, &none), OK);
        assert_eq!(handles.backward(&empty, &wanted), OK);
        assert!(out.iter().flatten().all(|&v| v == 0.0) && rows == [0.0; 12]);
        assert_eq!(handles.backward(&given, &wanted), OK, "{}", message());
        let fields = [back.mean.as_flattened(), back.scale.as_flattened(), back.quat.as_flattened(), &back.opacity];
        for (got, want) in out.iter().zip(fields.into_iter().chain([back.colour.as_flattened()])) {
            assert_eq!(got, want);
        }
        assert_eq!(rows, *back.view.as_flattened());
        let mut counts = SfCounts { struct_size: size_of::<SfCounts>(), ..SfCounts::default() };
        // SAFETY: a struct with its size.
        assert_eq!(unsafe { sf_raster_counts(handles.1, &mut counts) }, OK);
        assert_eq!((counts.gaussians, counts.visible), (COUNT as u64, want.stats.visible));
        assert_eq!((counts.entries, counts.block_updates), (want.stats.entries, want.stats.block_updates));
    }
}

#[test]
fn wrong_handles_are_refused() {
    let handles = Handles::new(1);
    let (g, out) = no_gradients();
    let mut raster = 0;
    // SAFETY: a place for the handle.
    assert_eq!(unsafe { sf_raster_create(handles.1, &mut raster) }, USAGE);
    assert!(message().contains("sf_context"), "{}", message());
    for wrong in [0, 1, u64::MAX, handles.0, handles.1 + 1, handles.1 ^ 1 << 40] {
        // SAFETY: valid structs; the handle is checked.
        assert_eq!(unsafe { sf_raster_backward(wrong, &g, &out) }, USAGE, "{wrong:#x}");
    }
    // SAFETY: a place for the handle.
    assert_eq!(unsafe { sf_raster_create(handles.0, &mut raster) }, OK);
    assert_eq!((sf_raster_destroy(raster), sf_raster_destroy(raster)), (OK, USAGE));
    assert!(message().contains("destroyed"), "{}", message());
    let mut again = 0;
    // SAFETY: a place for the handle; the slot is used again under another number.
    assert_eq!(unsafe { sf_raster_create(handles.0, &mut again) }, OK);
    assert_ne!(raster, again);
    assert_eq!((sf_raster_destroy(raster), sf_raster_destroy(again)), (USAGE, OK));
    assert_eq!((sf_raster_destroy(0), sf_context_destroy(0)), (OK, OK));
    // A raster outlives its context.
    let mut context = 0;
    // SAFETY: places for the handles.
    unsafe {
        assert_eq!(sf_context_create(2, &mut context), OK);
        assert_eq!(sf_raster_create(context, &mut raster), OK);
        assert_eq!(sf_context_destroy(context), OK);
        assert_eq!(sf_raster_forward(raster, &gaussians(&scene()), &view(), null(), &no_image()), OK);
        assert_eq!(sf_raster_destroy(raster), OK);
        assert_eq!(sf_context_create(65, &mut context), USAGE);
        assert_eq!((sf_context_create(1, null_mut()), sf_raster_create(handles.0, null_mut())), (USAGE, USAGE));
    }
}

#[test]
fn wrong_structs_arrays_and_values_are_refused() {
    let handles = Handles::new(1);
    let scene = scene();
    let (g, v, i) = (gaussians(&scene), view(), no_image());
    let (dimage, dgaussians) = no_gradients();
    // Nothing drawn yet.
    let nothing = SfImageGradients { pixels: 0, ..dimage };
    assert_eq!(handles.backward(&nothing, &SfGaussianGradients { count: 0, ..dgaussians }), USAGE);
    let check = |status: c_int, want: c_int, part: &str| {
        assert_eq!(status, want, "{part}: {}", message());
        assert!(message().contains(part) && message().len() <= 300, "{part}: {}", message());
    };
    let off = g.mean.wrapping_byte_add(1);
    for (bad, part) in [
        (SfGaussians { struct_size: 8, ..g }, "struct_size"),
        (SfGaussians { quat: null(), ..g }, "sf_gaussians.quat is NULL"),
        (SfGaussians { mean: off, ..g }, "sf_gaussians.mean is not aligned"),
        (SfGaussians { count: u64::MAX, ..g }, "sf_gaussians.mean"),
    ] {
        check(handles.forward(&bad, &v, null(), &i), USAGE, part);
    }
    // SAFETY: null is refused.
    unsafe {
        check(sf_raster_forward(handles.1, null(), &v, null(), &i), USAGE, "sf_gaussians is NULL");
        check(sf_raster_forward(handles.1, &g, null(), null(), &i), USAGE, "sf_view is NULL");
        check(sf_raster_forward(handles.1, &g, &v, null(), null()), USAGE, "sf_image is NULL");
        check(sf_splat_settings_init(null_mut()), USAGE, "sf_splat_settings is NULL");
        check(sf_raster_counts(handles.1, null_mut()), USAGE, "sf_counts is NULL");
    }
    check(
        handles.forward(&g, &v, null(), &SfImage { pixels: 850, ..i }),
        USAGE,
        "sf_image.pixels is 850, expected 851",
    );
    for (bad, part) in [
        (SfView { fx: f64::NAN, ..v }, "fx"),
        (SfView { world_to_camera: [0.0; 16], ..v }, "pose"),
        (SfView { world_to_camera: v.world_to_camera.map(|x| 1.5 * x), ..v }, "pose"),
        (
            SfView {
                world_to_camera: {
                    let mut m = v.world_to_camera;
                    m[12] = 1.0;
                    m
                },
                ..v
            },
            "pose",
        ),
    ] {
        check(handles.forward(&g, &bad, null(), &i), INPUT, part);
    }
    check(handles.forward(&g, &v, &SfSplatSettings { a_max: 1.0, ..settings() }, &i), INPUT, "a_max");
    let few = SfSplatSettings { max_entries: 3, ..settings() };
    check(handles.forward(&g, &v, &few, &i), Status::Resource as c_int, "limit of 3");
    // A failed image leaves nothing to go back from.
    check(handles.backward(&SfImageGradients { pixels: 0, ..dimage }, &dgaussians), USAGE, "no image was drawn");

    assert_eq!(handles.forward(&g, &v, null(), &i), OK);
    check(handles.backward(&SfImageGradients { pixels: 1, ..dimage }, &dgaussians), USAGE, "expected 851");
    check(handles.backward(&dimage, &SfGaussianGradients { count: 199, ..dgaussians }), USAGE, "expected 200");
    let mut bad = vec![0.0; PIXELS];
    bad[WIDTH as usize + 2] = f32::NAN;
    check(handles.backward(&SfImageGradients { alpha: bad.as_ptr(), ..dimage }, &dgaussians), INPUT, "(2, 1)");
    // No Gaussians are no mistake, and then no array is needed.
    let (none, p) = (Gaussians::default(), null());
    let empty = SfGaussians { mean: p, scale: p, quat: p, opacity: p, colour: p, ..gaussians(&none) };
    assert_eq!(handles.forward(&empty, &v, null(), &i), OK);
    assert_eq!(handles.backward(&dimage, &SfGaussianGradients { count: 0, ..dgaussians }), OK);
}

#[test]
fn a_panic_is_a_status_and_spends_the_object() {
    static TABLE: Table<u32> = Table::new(9, "thing");
    let handle = TABLE.insert(5).unwrap();
    let status = call(|| TABLE.with(handle, |_| -> Result<(), Error> { panic!("oh {}", 1) }));
    assert_eq!((status, message()), (70, "internal error: oh 1".into()));
    let status = call(|| TABLE.with(handle, |_| Ok(())));
    assert_eq!(status, 70);
    assert!(message().contains("destroy it"));
    assert_eq!(call(|| TABLE.remove(handle)), OK);
}

#[test]
fn an_object_serves_one_call_at_a_time() {
    static TABLE: Table<u32> = Table::new(9, "thing");
    let handle = TABLE.insert(5).unwrap();
    let status = call(|| {
        TABLE.with(handle, |_| {
            let other = std::thread::scope(|s| {
                s.spawn(|| (call(|| TABLE.with(handle, |_| Ok(()))), message())).join().expect("no panic")
            });
            assert_eq!(other.0, USAGE);
            assert!(other.1.contains("another thread"));
            // Destroyed under way: this call goes on.
            assert_eq!(call(|| TABLE.remove(handle)), OK);
            Ok(())
        })
    });
    assert_eq!((status, call(|| TABLE.with(handle, |_| Ok(())))), (OK, USAGE));
}

#[test]
fn a_message_is_cut_to_the_buffer() {
    let mut context = 0;
    let mut buffer = [b'x'; 8];
    // SAFETY: a place for the handle, and buffers of the sizes given.
    unsafe {
        assert_eq!(sf_context_create(1000, &mut context), USAGE);
        let size = sf_last_error(buffer.as_mut_ptr().cast(), 5);
        assert_eq!((&buffer, size), (b"1000\0xxx", message().len() + 1));
        assert_eq!(sf_last_error(null_mut(), 5), size);
        assert_eq!(std::ffi::CStr::from_ptr(sf_version()).to_str(), Ok(env!("CARGO_PKG_VERSION")));
    }
}

/// The words of a text between two marks.
fn between<'a>(text: &'a str, start: &str, end: &str) -> &'a str {
    let from = text.find(start).unwrap_or_else(|| panic!("{start} is missing")) + start.len();
    &text[from..from + text[from..].find(end).expect("an end")]
}

#[test]
fn the_header_says_what_the_library_does() {
    assert_eq!(between(HEADER, "#define SF_ABI_VERSION ", "\n"), sf_abi_version().to_string());
    for (name, status) in [
        ("OK", Status::Ok),
        ("CHECK_FAILED", Status::CheckFailed),
        ("USAGE", Status::Usage),
        ("INPUT", Status::Input),
        ("MODEL", Status::Model),
        ("RESOURCE", Status::Resource),
        ("IO", Status::Io),
        ("UNSUPPORTED", Status::Unsupported),
        ("DEADLINE", Status::Deadline),
        ("INTEGRITY", Status::Integrity),
        ("INTERNAL", Status::Internal),
        ("INTERRUPTED", Status::Interrupted),
    ] {
        let value: String =
            between(HEADER, &format!(" SF_{name} = "), "\n").chars().take_while(char::is_ascii_digit).collect();
        assert_eq!(value, (status as c_int).to_string(), "{name}");
    }

    // Functions: the same names on both sides.
    let mut declared: Vec<&str> = HEADER
        .lines()
        .filter(|l| !l.starts_with([' ', '/', '#', '}']) && l.contains('('))
        .map(|l| l[..l.find('(').unwrap()].rsplit([' ', '*']).next().unwrap())
        .collect();
    let mut exported: Vec<&str> = SOURCES
        .iter()
        .flat_map(|s| s.split("extern \"C\" fn ").skip(1))
        .map(|s| &s[..s.find('(').unwrap()])
        .filter(|name| name.starts_with("sf_"))
        .collect();
    declared.sort_unstable();
    exported.sort_unstable();
    assert_eq!(declared, exported);

    // Structs: the same fields of the same types in the same order.
    for (c, rust) in [
        ("sf_gaussians", "SfGaussians"),
        ("sf_view", "SfView"),
        ("sf_splat_settings", "SfSplatSettings"),
        ("sf_image", "SfImage"),
        ("sf_image_gradients", "SfImageGradients"),
        ("sf_gaussian_gradients", "SfGaussianGradients"),
        ("sf_counts", "SfCounts"),
    ] {
        let fields: Vec<String> = between(SOURCES[1], &format!("struct {rust} {{"), "\n}")
            .lines()
            .filter_map(|l| l.trim().strip_prefix("pub(crate) "))
            .map(|l| l.trim_end_matches(',').into())
            .collect();
        let mut want = Vec::new();
        for line in between(HEADER, &format!("typedef struct {c} {{"), "\n}").lines() {
            let line = line.split("/*").next().unwrap().trim().trim_end_matches(';');
            // `type a, b` or `const type *a`.
            let cut = if line.contains(',') { line.split_once(' ') } else { line.rsplit_once(' ') };
            let Some((kind, names)) = cut else { continue };
            for name in names.split(", ") {
                let (bare, pointer) = (name.trim_start_matches('*'), name.starts_with('*'));
                let (bare, array) = bare.split_once('[').map_or((bare, None), |(b, n)| (b, Some(&n[..n.len() - 1])));
                let scalar = match kind.trim_start_matches("const ") {
                    "float" => "f32",
                    "double" => "f64",
                    "size_t" => "usize",
                    "uint64_t" => "u64",
                    "uint32_t" => "u32",
                    "int32_t" => "i32",
                    other => panic!("{c}: type {other}"),
                };
                want.push(match (pointer, array) {
                    (true, _) if kind.starts_with("const ") => format!("{bare}: *const {scalar}"),
                    (true, _) => format!("{bare}: *mut {scalar}"),
                    (_, Some(n)) => format!("{bare}: [{scalar}; {n}]"),
                    _ => format!("{bare}: {scalar}"),
                });
            }
        }
        assert_eq!(fields, want, "{c}");
    }
}
