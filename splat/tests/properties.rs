//! Properties that hold for every picture.

mod common;

use std::sync::Arc;

use common::{Rng, Splat, camera, hard_scene, scene, straight};
use sf_formats::scene::{Gaussians, SplatSettings};
use sf_ops::Kernels;
use sf_ops::par::Pool;
use sf_splat::{Extra, RenderOptions, Rendered, Renderer, render};

const SETTINGS: SplatSettings = SplatSettings { aa: false, a_max: 0.999, eps2d: 0.3, near: 0.01 };

fn bits(values: &[f32]) -> Vec<u32> {
    values.iter().map(|v| v.to_bits()).collect()
}

fn assert_same(a: &Rendered, b: &Rendered, what: &str) {
    assert_eq!(a.stats, b.stats, "{what}");
    for (x, y) in [(&a.rgb, &b.rgb), (&a.depth, &b.depth), (&a.alpha, &b.alpha), (&a.extra, &b.extra)] {
        assert_eq!(bits(x), bits(y), "{what}");
    }
}

/// `n` ordinary splats in front of the straight camera, no libm anywhere.
fn plain_scene(seed: u64, n: usize) -> Gaussians {
    let mut rng = Rng(seed);
    scene((0..n).map(|_| {
        let z = rng.f(2.0, 12.0);
        Splat {
            mean: [rng.f(-1.0, 1.0) * z, rng.f(-0.7, 0.7) * z, z],
            scale: std::array::from_fn(|_| rng.f(0.01, 0.15)),
            quat: rng.quat(),
            opacity: rng.f(0.0, 1.0),
            colour: std::array::from_fn(|_| rng.f(0.0, 1.0)),
        }
    }))
}

#[test]
fn any_number_of_threads_gives_the_same_bits() {
    let rng = &mut Rng(77);
    let camera = camera(rng, 150, 101);
    let scene = hard_scene(rng, &camera, 4000);
    let values: Vec<f32> = (0..2 * scene.len()).map(|_| rng.f(-3.0, 3.0)).collect();
    let options = RenderOptions {
        background: [0.1, 0.2, 0.3],
        extra: Some(Extra { channels: 2, values: &values }),
        ..RenderOptions::default()
    };
    let settings = SplatSettings { aa: true, ..SETTINGS };
    let one = render(&scene, &camera, &settings, &options).unwrap();
    assert!(one.stats.visible > 1000 && one.alpha.iter().any(|&a| a > 0.999));
    for threads in [2, 3, 5] {
        let mut renderer = Renderer::new(threads).unwrap();
        let mut out = Rendered::default();
        // Another picture in between: kept memory must not show.
        for _ in 0..2 {
            renderer.render_into(&scene, &camera, &settings, &options, &mut out).unwrap();
            assert_same(&out, &one, &format!("{threads} threads"));
            let small = common::straight(7, 40);
            renderer.render_into(&plain_scene(1, 50), &small, &SETTINGS, &RenderOptions::default(), &mut out).unwrap();
            assert_eq!((out.rgb.len(), out.extra.len()), (7 * 40 * 3, 0));
        }
    }
}

#[test]
fn every_instruction_set_gives_the_same_bits() {
    let rng = &mut Rng(78);
    let camera = camera(rng, 150, 101);
    let scene = hard_scene(rng, &camera, 4000);
    let values: Vec<f32> = (0..3 * scene.len()).map(|_| rng.f(-3.0, 3.0)).collect();
    let extra = Some(Extra { channels: 3, values: &values });
    let options = RenderOptions { extra, ..RenderOptions::default() };
    let pool = Arc::new(Pool::new(2).unwrap());
    for aa in [false, true] {
        let settings = SplatSettings { aa, ..SETTINGS };
        let images: Vec<Rendered> = Kernels::available()
            .map(|k| Renderer::with_kernels(Arc::clone(&pool), k).render(&scene, &camera, &settings, &options).unwrap())
            .collect();
        for (image, k) in images.iter().zip(Kernels::available()) {
            assert_same(image, &images[0], k.isa.name());
        }
    }
}

#[test]
fn the_bits_are_the_same_on_every_machine() {
    // FNV-1a over the bits of all images; made on x86-64. A change of the arithmetic changes it.
    let scene = plain_scene(3, 3000);
    let mut hash = 0xcbf2_9ce4_8422_2325_u64;
    for aa in [false, true] {
        let image =
            render(&scene, &straight(130, 97), &SplatSettings { aa, ..SETTINGS }, &RenderOptions::default()).unwrap();
        for v in image.rgb.iter().chain(&image.depth).chain(&image.alpha) {
            for byte in v.to_bits().to_le_bytes() {
                hash = (hash ^ u64::from(byte)).wrapping_mul(0x0100_0000_01b3);
            }
        }
    }
    assert_eq!(format!("{hash:016x}"), "95e28d758a5b07b8");
}

#[test]
fn the_order_of_the_input_does_not_matter_when_depths_differ() {
    let scene_a = plain_scene(8, 2000);
    let mut z: Vec<u32> = scene_a.mean.iter().map(|m| m[2].to_bits()).collect();
    z.sort_unstable();
    assert!(z.windows(2).filter(|w| w[0] == w[1]).count() == 0, "depths must differ for this test");
    let mut order: Vec<usize> = (0..scene_a.len()).collect();
    let mut rng = Rng(9);
    for i in (1..order.len()).rev() {
        order.swap(i, rng.below(i + 1));
    }
    let mut scene_b = Gaussians::default();
    for &i in &order {
        scene_b.push_from(&scene_a, i, [0.0; 3], 1.0);
    }
    let camera = straight(100, 70);
    let a = render(&scene_a, &camera, &SETTINGS, &RenderOptions::default()).unwrap();
    let b = render(&scene_b, &camera, &SETTINGS, &RenderOptions::default()).unwrap();
    assert_same(&a, &b, "permuted");
}

#[test]
fn a_crop_shows_the_same_pixels() {
    // The clamp of the Jacobian depends on the frustum, so only splats far smaller than the margin of
    // 30 % are free of it. Moving the principal point rounds differently: a few units in the last place.
    let mut scene = plain_scene(4, 3000);
    scene.scale.iter_mut().flatten().for_each(|s| *s *= 0.25);
    let whole_camera = straight(120, 90);
    let whole = render(&scene, &whole_camera, &SETTINGS, &RenderOptions::default()).unwrap();
    let (x0, y0, w, h) = (37, 21, 45, 50);
    let mut crop_camera = straight(w as u32, h as u32);
    crop_camera.k.cx = whole_camera.k.cx - x0 as f64;
    crop_camera.k.cy = whole_camera.k.cy - y0 as f64;
    let crop = render(&scene, &crop_camera, &SETTINGS, &RenderOptions::default()).unwrap();
    for y in 0..h {
        for x in 0..w {
            let (i, j) = (y * w + x, (y + y0) * 120 + x + x0);
            for c in 0..3 {
                let (a, b) = (crop.rgb[3 * i + c], whole.rgb[3 * j + c]);
                assert!((a - b).abs() < 1e-5, "({x}, {y}): {a} and {b}");
            }
            assert!((crop.depth[i] - whole.depth[j]).abs() < 1e-4);
            assert!((crop.alpha[i] - whole.alpha[j]).abs() < 1e-5);
        }
    }
}

#[test]
fn the_background_is_weighted_by_what_is_left() {
    let (scene, camera) = (plain_scene(5, 500), straight(64, 48));
    let background = [0.25, 1.0, -2.0];
    let black = render(&scene, &camera, &SETTINGS, &RenderOptions::default()).unwrap();
    let options = RenderOptions { background, ..RenderOptions::default() };
    let coloured = render(&scene, &camera, &SETTINGS, &options).unwrap();
    assert_eq!(bits(&black.alpha), bits(&coloured.alpha));
    assert_eq!(bits(&black.depth), bits(&coloured.depth));
    for (i, alpha) in black.alpha.iter().enumerate() {
        assert!((0.0..=1.0 - 1e-4).contains(alpha), "alpha {alpha}");
        for c in 0..3 {
            let want = black.rgb[3 * i + c] + (1.0 - alpha) * background[c];
            assert!((coloured.rgb[3 * i + c] - want).abs() < 1e-6);
        }
    }
}

#[test]
fn extra_channels_composite_like_colour_and_depth() {
    let (scene, camera) = (plain_scene(6, 1500), straight(75, 66));
    // The camera is the world frame, so z is the third coordinate.
    let values: Vec<f32> =
        (0..scene.len()).flat_map(|i| [scene.colour[i][0], scene.mean[i][2], 1.0, scene.colour[i][2]]).collect();
    let options = RenderOptions { extra: Some(Extra { channels: 4, values: &values }), ..RenderOptions::default() };
    let image = render(&scene, &camera, &SETTINGS, &options).unwrap();
    for i in 0..image.alpha.len() {
        let extra = &image.extra[4 * i..][..4];
        let want = [image.rgb[3 * i], image.depth[i], image.alpha[i], image.rgb[3 * i + 2]];
        for c in [0, 1, 3] {
            assert_eq!(extra[c].to_bits(), want[c].to_bits(), "channel {c} of pixel {i}");
        }
        // A sum of weights against a product of transmittances.
        assert!((extra[2] - want[2]).abs() < 1e-5);
    }
    let expected = image.expected_depth();
    assert!(expected.iter().zip(&image.alpha).all(|(z, a)| if *a > 0.0 { (1.9..12.1).contains(z) } else { *z == 0.0 }));
}

#[test]
fn a_time_bomb_of_hidden_splats_is_cut_short() {
    // 100,000 opaque splats in one tile: two finish every pixel, the rest is neither sorted nor drawn.
    let splats = (0..100_000).map(|i| Splat {
        mean: [0.0, 0.0, 1.0 + i as f32 * 1e-4],
        scale: [10.0; 3],
        opacity: 1.0,
        ..Splat::default()
    });
    let image = render(&scene(splats), &straight(32, 32), &SETTINGS, &RenderOptions::default()).unwrap();
    assert_eq!((image.stats.visible, image.stats.entries), (100_000, 100_000));
    // One splat is drawn: T = 0.001, and the next would leave 1e-6.
    assert!(image.alpha.iter().all(|a| (a - 0.999).abs() < 1e-6));
    assert!(image.depth.iter().all(|d| (d - 0.999).abs() < 1e-5));
}
