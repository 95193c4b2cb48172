//! The backward pass against difference quotients and against the chain rule in f64.

mod common;

use std::sync::Arc;

use common::{Rng, Splat, camera, hard_scene, scene, straight};
use sf_formats::scene::{Gaussians, SplatSettings};
use sf_formats::{Camera, Status};
use sf_ops::Kernels;
use sf_ops::par::Pool;
use sf_splat::reference::{self, ReferenceImage, Source, View, render_sources};
use sf_splat::reference_grad::{ReferenceImageGradients, SourceGradient, gradients};
use sf_splat::{Gradients, ImageGradients, RenderOptions, Rendered, Renderer};

const BACKGROUND: [f32; 3] = [0.2, 0.7, 0.4];

/// Weights of a scalar L = sum of weights times image, one per value.
struct Weights {
    rgb: Vec<f32>,
    depth: Vec<f32>,
    alpha: Vec<f32>,
}

impl Weights {
    fn random(rng: &mut Rng, camera: &Camera) -> Weights {
        let pixels = (camera.width * camera.height) as usize;
        let mut values = |n: usize, size: f32| (0..n).map(|_| rng.f(-size, size)).collect();
        Weights { rgb: values(3 * pixels, 1.0), depth: values(pixels, 0.1), alpha: values(pixels, 1.0) }
    }

    /// Leaves out the pixels where f32 may decide otherwise than f64; how many are left.
    fn drop_slack(&mut self, image: &ReferenceImage) -> usize {
        let mut left = 0;
        for (i, &slack) in image.slack.iter().enumerate() {
            let keep = if slack > 0.0 { 0.0 } else { 1.0 };
            self.rgb[3 * i..3 * i + 3].iter_mut().for_each(|w| *w *= keep);
            self.depth[i] *= keep;
            self.alpha[i] *= keep;
            left += keep as usize;
        }
        left
    }

    fn image(&self) -> ImageGradients<'_> {
        ImageGradients { rgb: &self.rgb, depth: &self.depth, alpha: &self.alpha }
    }

    fn exact(&self) -> ReferenceImageGradients {
        let wide = |v: &[f32]| v.iter().map(|&x| f64::from(x)).collect();
        ReferenceImageGradients { rgb: wide(&self.rgb), depth: wide(&self.depth), alpha: wide(&self.alpha) }
    }

    /// L and the digest of the decisions.
    fn of(&self, sources: &[Source], view: &View) -> (f64, u64) {
        let image = render_sources(sources, view);
        let dot = |a: &[f32], b: &[f64]| a.iter().zip(b).map(|(a, b)| f64::from(*a) * b).sum::<f64>();
        let sum = dot(&self.rgb, &image.rgb) + dot(&self.depth, &image.depth) + dot(&self.alpha, &image.alpha);
        (sum, image.decisions)
    }
}

const FIELDS: usize = 14;
/// Names of the fields of [`flat`].
const NAMES: [&str; FIELDS] =
    ["x", "y", "z", "scale 0", "scale 1", "scale 2", "w", "qx", "qy", "qz", "opacity", "red", "green", "blue"];

fn flat(g: &SourceGradient) -> [f64; FIELDS] {
    let mut out = [0.0; FIELDS];
    out[0..3].copy_from_slice(&g.mean.to_array());
    out[3..6].copy_from_slice(&g.scale.to_array());
    out[6..10].copy_from_slice(&g.quat);
    out[10] = g.opacity;
    out[11..14].copy_from_slice(&g.rgb);
    out
}

fn fast_flat(g: &Gradients, i: usize) -> [f64; FIELDS] {
    let mut out = [0.0; FIELDS];
    let values = g.mean[i].iter().chain(&g.scale[i]).chain(&g.quat[i]).chain([&g.opacity[i]]).chain(&g.colour[i]);
    out.iter_mut().zip(values).for_each(|(o, v)| *o = f64::from(*v));
    out
}

fn field(s: &mut Source, f: usize) -> &mut f64 {
    match f {
        0..3 => &mut s.mean[f],
        3..6 => &mut s.scale[f - 3],
        6..10 => &mut s.quat[f - 6],
        10 => &mut s.opacity,
        _ => &mut s.rgb[f - 11],
    }
}

/// (L(+h) - L(-h)) / 2h with the largest h of a few under which no decision changes; `None` when there is none.
fn quotient(at: f64, mut l: impl FnMut(f64) -> (f64, u64)) -> Option<f64> {
    let decided = l(0.0).1;
    [1e-5, 1e-6, 1e-7].into_iter().find_map(|step| {
        let h = step * at.abs().max(0.01);
        let (up, down) = (l(h), l(-h));
        (up.1 == decided && down.1 == decided).then(|| (up.0 - down.0) / (2.0 * h))
    })
}

fn sources(scene: &Gaussians) -> Vec<Source> {
    (0..scene.len()).map(|i| Source::of(scene, i)).collect()
}

/// Splats of all opacities, some of which finish pixels, some reach `a_max`, some are stretched or off to the side.
fn small_scene(rng: &mut Rng, camera: &Camera, n: usize) -> Gaussians {
    scene((0..n).map(|i| {
        let z = rng.f(2.0, 9.0);
        let (u, v) = (rng.f(-0.2, 1.2) * camera.width as f32, rng.f(-0.2, 1.2) * camera.height as f32);
        let pixel = z / camera.k.fx as f32;
        let mut s = Splat {
            mean: camera.unproject(u.into(), v.into(), z.into()).as_vec3().to_array(),
            scale: std::array::from_fn(|_| pixel * rng.log(0.3, 4.0)),
            quat: rng.quat(),
            opacity: rng.f(0.02, 0.99),
            colour: std::array::from_fn(|_| rng.f(-0.2, 1.2)),
        };
        match i % 8 {
            // Reaches a_max, and with the next finishes pixels.
            0 | 1 | 4 => {
                let (u, v) = (rng.f(0.2, 0.8) * camera.width as f32, rng.f(0.2, 0.8) * camera.height as f32);
                s.mean = camera.unproject(u.into(), v.into(), (z + 4.0).into()).as_vec3().to_array();
                (s.opacity, s.scale) = (1.0, [pixel * 15.0; 3]);
            }
            2 => s.scale = [pixel * 12.0, pixel * 0.4, pixel * 0.05],
            // Far to the side, so that x/z is clamped, and large enough to be seen.
            3 => {
                s.mean = camera.unproject(-0.6 * f64::from(camera.width), v.into(), z.into()).as_vec3().to_array();
                s.scale = [pixel * 0.4 * camera.width as f32; 3];
                s.opacity = 0.3;
            }
            _ => {}
        }
        s
    }))
}

fn settings(aa: bool, a_max: f32) -> SplatSettings {
    SplatSettings { aa, a_max, ..SplatSettings::default() }
}

fn fast(scene: &Gaussians, camera: &Camera, settings: &SplatSettings, weights: &Weights) -> (Rendered, Gradients) {
    let options = RenderOptions { background: BACKGROUND, ..RenderOptions::default() };
    let mut renderer = Renderer::new(2).unwrap();
    let image = renderer.render(scene, camera, settings, &options).unwrap();
    let mut out = Gradients::default();
    renderer.backward(scene, &weights.image(), &mut out).unwrap();
    (image, out)
}

/// Pixels that do not see an opaque wall behind everything.
fn finished(scene: &Gaussians, camera: &Camera, settings: &SplatSettings, image: &Rendered) -> usize {
    let mut walled = scene.clone();
    let mean = camera.unproject(0.5 * f64::from(camera.width), 0.5 * f64::from(camera.height), 100.0);
    walled.mean.push(mean.as_vec3().to_array());
    walled.scale.push([1000.0; 3]);
    walled.quat.push([1.0, 0.0, 0.0, 0.0]);
    walled.opacity.push(0.1);
    walled.colour.push([1.0; 3]);
    let options = RenderOptions { background: BACKGROUND, ..RenderOptions::default() };
    let behind = sf_splat::render(&walled, camera, settings, &options).unwrap();
    behind.alpha.iter().zip(&image.alpha).filter(|(a, b)| a == b).count()
}

#[test]
fn difference_quotients() {
    // Relative to the gradient, and to a thousandth of the largest of its kind where that is small.
    let (mut least, mut compared, mut skipped) = (f64::INFINITY, 0, 0);
    for seed in 0..4 {
        let rng = &mut Rng(100 + seed);
        let camera = camera(rng, 37, 26);
        let scene = small_scene(rng, &camera, 32);
        let settings = settings(seed % 2 == 1, if seed % 3 == 0 { 0.99 } else { 0.999 });
        let mut weights = Weights::random(rng, &camera);
        let left = weights.drop_slack(&reference::render(&scene, &camera, &settings, BACKGROUND));
        assert!(left * 2 > weights.alpha.len(), "{left} pixels");
        let (image, got) = fast(&scene, &camera, &settings, &weights);
        let finished = finished(&scene, &camera, &settings, &image);
        assert!(finished > 20 && finished < 800 && image.alpha.iter().any(|&a| a < 0.9), "{finished} finished pixels");
        let view = View::of(&camera, &settings, BACKGROUND);
        let sources = sources(&scene);
        let (want, dr, dt) = gradients(&sources, &view, &weights.exact());

        let mut check = |what: &str, got: f64, exact: f64, quotient: f64, largest: f64| {
            let scale = quotient.abs().max(1e-3 * largest);
            assert!((exact - quotient).abs() <= 1e-4 * scale, "{what}: f64 {exact:.6e}, quotient {quotient:.6e}");
            assert!(
                (got - quotient).abs() <= 1e-3 * scale,
                "{what}: f32 {got:.6e}, quotient {quotient:.6e}, largest {largest:.1e}"
            );
            least = least.min(scale);
            compared += 1;
        };
        for f in 0..FIELDS {
            let largest = want.iter().fold(0.0, |m: f64, g| m.max(flat(g)[f].abs()));
            for i in 0..scene.len() {
                // At a limit of its range a field has a gradient to one side only.
                let mut at = sources[i];
                let here = *field(&mut at, f);
                if f == 10 && here == 1.0 {
                    continue;
                }
                let quotient = quotient(here, |h| {
                    let mut moved = sources.clone();
                    *field(&mut moved[i], f) += h;
                    weights.of(&moved, &view)
                });
                let Some(quotient) = quotient else {
                    skipped += 1;
                    continue;
                };
                let what = format!("seed {seed}, Gaussian {i}, {}", NAMES[f]);
                check(&what, fast_flat(&got, i)[f], flat(&want[i])[f], quotient, largest);
            }
        }
        let largest = (0..12).fold(0.0, |m: f64, i| m.max(got.view[i / 4][i % 4].abs()));
        for (row, column) in (0..12).map(|i| (i / 4, i % 4)) {
            let quotient = quotient(1.0, |h| {
                let mut moved = view;
                if column < 3 {
                    moved.r.col_mut(column)[row] += h
                } else {
                    moved.t[row] += h
                }
                weights.of(&sources, &moved)
            });
            let Some(quotient) = quotient else {
                skipped += 1;
                continue;
            };
            let exact = if column < 3 { dr.col(column)[row] } else { dt[row] };
            check(&format!("seed {seed}, view {row} {column}"), got.view[row][column], exact, quotient, largest);
        }
    }
    println!("{compared} gradients compared, {skipped} without a smooth step, smallest scale {least:.1e}");
    assert!(skipped * 50 < compared, "{skipped} of {compared} skipped");
}

/// Worst of |got - want| over |want| plus the root mean square of the field.
fn worst(scene: &Gaussians, got: &Gradients, want: &[SourceGradient]) -> [f64; FIELDS] {
    std::array::from_fn(|f| {
        let rms = (want.iter().map(|g| flat(g)[f].powi(2)).sum::<f64>() / want.len() as f64).sqrt();
        (0..scene.len()).fold(0.0, |w: f64, i| {
            let (a, b) = (fast_flat(got, i)[f], flat(&want[i])[f]);
            w.max((a - b).abs() / (b.abs() + rms + 1e-30))
        })
    })
}

#[test]
fn the_chain_rule_in_f64() {
    let (mut clear, mut pixels) = (0, 0);
    for seed in 0..12 {
        let rng = &mut Rng(200 + seed);
        let camera = camera(rng, 90 + seed as u32, 70);
        let scene = if seed < 6 { small_scene(rng, &camera, 600) } else { hard_scene(rng, &camera, 500) };
        let settings = settings(seed % 2 == 1, 0.999);
        let mut weights = Weights::random(rng, &camera);
        let left = weights.drop_slack(&reference::render(&scene, &camera, &settings, BACKGROUND));
        clear += left;
        pixels += weights.alpha.len();
        let (_, got) = fast(&scene, &camera, &settings, &weights);
        let (want, ..) = gradients(&sources(&scene), &View::of(&camera, &settings, BACKGROUND), &weights.exact());
        let worst = worst(&scene, &got, &want);
        println!("seed {seed}: {worst:.6?}");
        assert!(worst.iter().all(|&w| w < 2e-4), "seed {seed}: {worst:.6?}");
    }
    assert!(clear * 2 > pixels, "{clear} of {pixels} pixels are clear of thresholds");
}

fn bits(g: &Gradients) -> Vec<u64> {
    let fields = [g.mean.as_flattened(), g.scale.as_flattened(), g.quat.as_flattened(), &g.opacity];
    let fields = fields.into_iter().chain([g.colour.as_flattened()]).flatten().map(|v| u64::from(v.to_bits()));
    fields.chain(g.view.as_flattened().iter().map(|v| v.to_bits())).collect()
}

#[test]
fn any_threads_any_instruction_set_and_any_repeat_give_the_same_bits() {
    let rng = &mut Rng(78);
    let camera = camera(rng, 150, 101);
    let scene = hard_scene(rng, &camera, 4000);
    let (weights, other) = (Weights::random(rng, &camera), Weights::random(rng, &camera));
    let small = straight(7, 40);
    for aa in [false, true] {
        let settings = settings(aa, 0.999);
        let want = bits(&fast(&scene, &camera, &settings, &weights).1);
        assert!(want.iter().filter(|&&b| b << 1 != 0).count() > 3000);
        for kernels in Kernels::available() {
            for threads in [1, 2, 3] {
                let mut renderer = Renderer::with_kernels(Arc::new(Pool::new(threads).unwrap()), kernels);
                let options = RenderOptions { background: BACKGROUND, ..RenderOptions::default() };
                let mut out = Gradients::default();
                for _ in 0..2 {
                    renderer.render(&scene, &camera, &settings, &options).unwrap();
                    // Another gradient of the same image and another image in between: kept memory must not show.
                    renderer.backward(&scene, &other.image(), &mut out).unwrap();
                    renderer.backward(&scene, &weights.image(), &mut out).unwrap();
                    assert_eq!(bits(&out), want, "{} with {threads} threads", kernels.isa.name());
                    let few = small_scene(&mut Rng(1), &small, 20);
                    renderer.render(&few, &small, &settings, &options).unwrap();
                    renderer.backward(&few, &Weights::random(&mut Rng(2), &small).image(), &mut out).unwrap();
                    assert_eq!(out.mean.len(), 20);
                }
            }
        }
    }
}

#[test]
fn what_is_not_seen_has_no_gradient() {
    let camera = straight(40, 30);
    let wall = |z| Splat { mean: [0.0, 0.0, z], scale: [900.0; 3], opacity: 1.0, ..Splat::default() };
    let splats = [
        wall(2.0),
        // Behind what finishes every pixel, behind the camera, outside the image, transparent, not a number.
        wall(3.0),
        wall(4.0),
        Splat { mean: [0.1, 0.0, 5.0], ..Splat::default() },
        Splat { mean: [0.0, 0.0, -5.0], ..Splat::default() },
        Splat { mean: [90.0, 0.0, 5.0], ..Splat::default() },
        Splat { mean: [0.0, 0.0, 1.0], opacity: 0.003, ..Splat::default() },
        Splat { mean: [0.0, f32::NAN, 1.0], ..Splat::default() },
        Splat { quat: [0.0; 4], ..Splat::default() },
    ];
    let weights = Weights::random(&mut Rng(4), &camera);
    let (_, got) = fast(&scene(splats), &camera, &settings(false, 0.999), &weights);
    // The first wall is at a_max everywhere: its alpha is fixed, its colour and depth are not.
    assert!(fast_flat(&got, 0)[11..].iter().all(|&v| v != 0.0) && got.mean[0][2] != 0.0);
    assert!(got.opacity[0] == 0.0 && got.scale[0] == [0.0; 3] && got.quat[0] == [0.0; 4]);
    for i in 1..9 {
        assert_eq!(fast_flat(&got, i), [0.0; FIELDS], "Gaussian {i}");
    }
    // Nothing in view at all.
    let (_, got) = fast(&scene([]), &camera, &settings(false, 0.999), &weights);
    assert!(got.mean.is_empty() && got.view == [[0.0; 4]; 3]);
}

#[test]
fn clamped_fields_pass_nothing_on() {
    let camera = straight(20, 20);
    let weights = Weights::random(&mut Rng(5), &camera);
    let splats = [
        Splat { opacity: 1.5, scale: [0.3, 0.0, 0.3], ..Splat::default() },
        Splat { mean: [0.3, 0.2, 5.0], ..Splat::default() },
    ];
    let (_, got) = fast(&scene(splats), &camera, &settings(false, 0.999), &weights);
    assert!(got.opacity[0] == 0.0 && got.scale[0][1] == 0.0 && got.scale[0][0] != 0.0);
    assert!(got.opacity[1] != 0.0);
}

#[test]
fn wrong_calls_are_refused() {
    let camera = straight(9, 8);
    let one = scene([Splat::default()]);
    let weights = Weights::random(&mut Rng(6), &camera);
    let mut renderer = Renderer::new(1).unwrap();
    let mut out = Gradients::default();
    let mut status = |renderer: &mut Renderer, scene: &Gaussians, image: &ImageGradients| {
        let error = renderer.backward(scene, image, &mut out).unwrap_err();
        assert!(error.line().len() < 300);
        error.status()
    };
    assert_eq!(status(&mut renderer, &one, &weights.image()), Status::Usage);
    renderer.render(&one, &camera, &SplatSettings::default(), &RenderOptions::default()).unwrap();
    let two = scene([Splat::default(), Splat::default()]);
    assert_eq!(status(&mut renderer, &two, &weights.image()), Status::Input);
    let short = ImageGradients { alpha: &weights.alpha[1..], ..weights.image() };
    assert_eq!(status(&mut renderer, &one, &short), Status::Input);
    let mut bad = weights.depth.clone();
    bad[13] = f32::NAN;
    let image = ImageGradients { depth: &bad, ..weights.image() };
    assert_eq!(status(&mut renderer, &one, &image), Status::Input);
    // A failed image leaves nothing to go back from.
    let strict = RenderOptions { max_entries: 0, ..RenderOptions::default() };
    renderer.render(&one, &camera, &SplatSettings::default(), &strict).unwrap_err();
    assert_eq!(status(&mut renderer, &one, &weights.image()), Status::Usage);
}
