//! The rasterizer against the f64 brute force.

mod common;

use std::sync::Arc;

use common::{Rng, camera, hard_scene, psnr, scene, straight};
use sf_formats::Camera;
use sf_formats::scene::{Gaussians, SplatSettings};
use sf_ops::Kernels;
use sf_ops::par::Pool;
use sf_splat::{RenderOptions, Renderer, reference};

/// Error on pixels whose decisions are all clear of their thresholds; the slack comes on top.
const CLEAN: f64 = 1e-3;
/// Least PSNR of a picture against the oracle.
const LEAST_PSNR: f64 = 90.0;

#[path = "common/street.rs"]
mod street;

/// Pixels compared, and those over 1/255.
fn compare(what: &str, scene: &Gaussians, camera: &Camera, settings: &SplatSettings) -> (usize, usize) {
    let background = [0.2, 0.7, 0.4];
    let want = reference::render(scene, camera, settings, background);
    let options = RenderOptions { background, ..RenderOptions::default() };
    let got = Renderer::new(2).unwrap().render(scene, camera, settings, &options).unwrap();
    let (db_rgb, db_alpha) = (psnr(&got.rgb, &want.rgb), psnr(&got.alpha, &want.alpha));
    assert!(db_rgb >= LEAST_PSNR && db_alpha >= LEAST_PSNR, "{what}: rgb {db_rgb:.1} dB, alpha {db_alpha:.1} dB");
    let mut over = 0;
    for i in 0..got.alpha.len() {
        let slack = want.slack[i];
        let mut worst = (f64::from(got.alpha[i]) - want.alpha[i]).abs();
        for c in 0..3 {
            worst = worst.max((f64::from(got.rgb[3 * i + c]) - want.rgb[3 * i + c]).abs());
        }
        let (x, y) = (i % got.width, i / got.width);
        assert!(worst <= CLEAN + slack, "{what}: pixel ({x}, {y}) is off by {worst:.2e}, slack {slack:.2e}");
        let depth = (f64::from(got.depth[i]) - want.depth[i]).abs();
        let allowed = CLEAN * want.depth[i].max(1.0) + slack * 4.0 * want.far[i].max(40.0);
        assert!(depth <= allowed, "{what}: depth of ({x}, {y}) is off by {depth:.2e}, allowed {allowed:.2e}");
        over += usize::from(worst > 1.0 / 255.0);
    }
    let clear = want.slack.iter().filter(|&&s| s == 0.0).count() as f64 / want.slack.len() as f64;
    let mean_alpha = want.alpha.iter().sum::<f64>() / want.alpha.len() as f64;
    println!(
        "{what}: rgb {db_rgb:.1} dB, alpha {db_alpha:.1} dB, clear of thresholds {clear:.2}, coverage {mean_alpha:.2}, \
         {:?}",
        got.stats
    );
    (got.alpha.len(), over)
}

#[test]
fn twenty_hard_scenes_match_the_oracle() {
    let (mut pixels, mut over) = (0, 0);
    for seed in 0..20 {
        let rng = &mut Rng(seed);
        let (width, height) = (33 + rng.below(90) as u32, 30 + rng.below(70) as u32);
        let mut camera = camera(rng, width, height);
        if seed % 3 == 1 {
            // Off-centre, and once outside the image.
            camera.k.cx += f64::from(rng.f(-0.7, 0.4)) * f64::from(width);
            camera.k.cy += f64::from(rng.f(-0.3, 0.3)) * f64::from(height);
        }
        let settings = SplatSettings {
            aa: seed % 2 == 1,
            a_max: if seed % 4 < 2 { 0.999 } else { 0.99 },
            ..SplatSettings::default()
        };
        let scene = hard_scene(rng, &camera, 360);
        let what = format!("seed {seed}, {width}x{height}, aa {}, a_max {}", settings.aa, settings.a_max);
        let (n, bad) = compare(&what, &scene, &camera, &settings);
        (pixels, over) = (pixels + n, over + bad);
    }
    assert!(over * 10_000 <= pixels, "{over} of {pixels} pixels are off by more than 1/255");
}

#[test]
fn long_needles_across_the_image_match_the_oracle() {
    // 1000 : 1 in pixels at all angles, some with their middle far outside: f32 covariances fail here.
    let mut rng = Rng(5);
    let camera = straight(96, 64);
    let needles = (0..40).map(|_| {
        let angle = rng.f(0.0, std::f32::consts::PI);
        common::Splat {
            mean: [rng.f(-30.0, 30.0), rng.f(-30.0, 30.0), rng.f(2.0, 9.0)],
            scale: [40.0, 1e-4, 1e-4],
            quat: [(angle / 2.0).cos(), 0.0, 0.0, (angle / 2.0).sin()],
            colour: [rng.f(0.0, 1.0), rng.f(0.0, 1.0), rng.f(0.0, 1.0)],
            ..common::Splat::default()
        }
    });
    compare("needles", &scene(needles), &camera, &SplatSettings::default());
}

#[test]
fn a_stack_of_equal_depths_is_drawn_in_index_order() {
    // S11: equal depths, order by index. Exactly equal z, so any other order changes the colour.
    let mut rng = Rng(11);
    let splats = (0..600).map(|_| common::Splat {
        mean: [rng.f(-2.0, 2.0), rng.f(-2.0, 2.0), 4.0],
        scale: [rng.log(0.02, 0.5); 3],
        opacity: rng.f(0.2, 1.0),
        colour: [rng.f(0.0, 1.0), rng.f(0.0, 1.0), rng.f(0.0, 1.0)],
        ..common::Splat::default()
    });
    let (scene, camera, settings) = (scene(splats), straight(64, 64), SplatSettings::default());
    let want = reference::render(&scene, &camera, &settings, [0.0; 3]);
    let got = sf_splat::render(&scene, &camera, &settings, &RenderOptions::default()).unwrap();
    // The slack channel allows swaps of equal depths; this does not.
    let worst = got.rgb.iter().zip(&want.rgb).fold(0.0, |w: f64, (a, b)| w.max((f64::from(*a) - b).abs()));
    assert!(psnr(&got.rgb, &want.rgb) > LEAST_PSNR && worst < 0.02, "worst {worst:.2e}");
}

#[test]
fn two_hundred_tiny_scenes_match_the_oracle() {
    let (mut pixels, mut over) = (0, 0);
    for seed in 0..200 {
        let rng = &mut Rng(10_000 + seed);
        let (width, height) = (1 + rng.below(24) as u32, 1 + rng.below(24) as u32);
        let camera = camera(rng, width, height);
        let count = rng.below(40);
        let mut scene = hard_scene(rng, &camera, count);
        // Colours are not clamped.
        scene.colour.iter_mut().flatten().for_each(|c| *c = 3.0 * *c - 1.0);
        let settings = SplatSettings {
            aa: seed % 2 == 1,
            eps2d: if seed % 8 == 7 { 0.1 } else { 0.3 },
            ..SplatSettings::default()
        };
        let (n, bad) = compare(&format!("tiny {seed}"), &scene, &camera, &settings);
        (pixels, over) = (pixels + n, over + bad);
    }
    assert!(over * 1000 <= pixels, "{over} of {pixels} pixels are off by more than 1/255");
}

#[test]
fn boxes_leave_nothing_out() {
    for seed in 0..8 {
        let rng = &mut Rng(40 + seed);
        let (width, height) = (40 + rng.below(40) as u32, 30 + rng.below(30) as u32);
        let camera = camera(rng, width, height);
        let scene = hard_scene(rng, &camera, 240);
        let settings = SplatSettings { aa: seed % 2 == 1, ..SplatSettings::default() };
        let all = reference::render(&scene, &camera, &settings, [0.1, 0.2, 0.3]);
        let boxed = reference::render_boxed(&scene, &camera, &settings, [0.1, 0.2, 0.3]);
        assert!(all.alpha.iter().any(|&a| a > 0.5));
        assert_eq!((all.decisions, &all.rgb, &all.depth), (boxed.decisions, &boxed.rgb, &boxed.depth), "seed {seed}");
        assert_eq!((&all.alpha, &all.slack, &all.far), (&boxed.alpha, &boxed.slack, &boxed.far), "seed {seed}");
    }
}

/// One picture of a street: pixels, and those outside the bounds. Asserts the PSNR.
fn street_picture(scene: &Gaussians, camera: &Camera, settings: &SplatSettings, what: &str) -> (usize, usize) {
    let want = reference::render_boxed(scene, camera, settings, [0.0; 3]);
    let pool = Arc::new(Pool::new(2).unwrap());
    let draw = |kernels: &'static Kernels| {
        let mut renderer = Renderer::with_kernels(Arc::clone(&pool), kernels);
        renderer.render(scene, camera, settings, &RenderOptions::default()).unwrap()
    };
    // One picture stands for all instruction sets, because they give the same bits.
    let mut sets = Kernels::available();
    let got = draw(sets.next().unwrap());
    let bits = |v: &[f32]| v.iter().map(|x| x.to_bits()).collect::<Vec<_>>();
    for kernels in sets {
        let other = draw(kernels);
        assert_eq!(other.stats, got.stats, "{what}");
        for (a, b) in [(&other.rgb, &got.rgb), (&other.depth, &got.depth), (&other.alpha, &got.alpha)] {
            assert!(bits(a) == bits(b), "{what}: {} gives other bits", kernels.isa.name());
        }
    }
    let (mut outside, mut clean) = (0, 0.0f64);
    for i in 0..got.alpha.len() {
        let slack = want.slack[i];
        let mut worst = (f64::from(got.alpha[i]) - want.alpha[i]).abs();
        for c in 0..3 {
            worst = worst.max((f64::from(got.rgb[3 * i + c]) - want.rgb[3 * i + c]).abs());
        }
        if slack == 0.0 {
            clean = clean.max(worst);
        }
        let depth = (f64::from(got.depth[i]) - want.depth[i]).abs();
        let allowed = CLEAN * want.depth[i] + slack * 4.0 * want.far[i] + 1e-6;
        outside += usize::from(worst > CLEAN + slack || depth > allowed);
    }
    let db = psnr(&got.rgb, &want.rgb);
    let pixels = got.alpha.len();
    println!("{what}: rgb {db:.1} dB, clean pixels within {clean:.1e}, {outside} of {pixels} pixels outside");
    assert!(db >= LEAST_PSNR, "{what}: {db:.1} dB");
    (pixels, outside)
}

#[test]
fn a_street_matches_the_oracle() {
    let scene = street::scene(126, 84);
    for aa in [false, true] {
        let settings = SplatSettings { aa, ..SplatSettings::default() };
        let camera = street::camera(252, 168, 1.5 * street::STEP);
        assert_eq!(street_picture(&scene, &camera, &settings, &format!("small street, aa {aa}")).1, 0);
    }
}

/// `cargo test --release -p sf-splat --test oracle -- --ignored --nocapture`: some minutes.
#[test]
#[ignore = "36 pictures of up to 580,160 Gaussians and 921,600 pixels in f64"]
fn large_streets_match_the_oracle() {
    let (mut pixels, mut outside) = (0, 0);
    for source in [(252, 168), (518, 280)] {
        let scene = street::scene(source.0, source.1);
        for (width, height) in [(252, 168), (518, 280), (1280, 720)] {
            // Between frames, a lane aside, and past the last frame.
            for (view, along, aside) in [("between", 1.5, 0.0), ("aside", 1.0, 1.5), ("ahead", 3.4, 0.0)] {
                let mut camera = street::camera(width, height, along * street::STEP);
                camera.pose.t.x += aside;
                for aa in [false, true] {
                    let settings = SplatSettings { aa, ..SplatSettings::default() };
                    let what = format!("{} Gaussians, {width}x{height}, {view}, aa {aa}", scene.len());
                    let (n, bad) = street_picture(&scene, &camera, &settings, &what);
                    (pixels, outside) = (pixels + n, outside + bad);
                }
            }
        }
    }
    let sets: Vec<_> = Kernels::available().map(|k| k.isa.name()).collect();
    println!("{outside} of {pixels} pixels outside, the same bits with {}", sets.join(", "));
    assert!(outside * 100_000 <= pixels, "{outside} of {pixels} pixels are outside the bounds");
}
