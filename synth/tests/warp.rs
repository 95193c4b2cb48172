//! Ground truth against pixels: a frame moved into its neighbour by depth, pose and velocity must look like it.

use rayon::prelude::*;
use sf_synth::{DYNAMIC, Frame, Options, Street};

/// Seconds between the frames compared.
const DT: f64 = 0.1;
/// Largest relative difference between the depth seen and the depth moved there.
const DEPTH: f64 = 0.015;
/// Mean PSNR that both sorts of pixels must reach, dB.
const PSNR: f64 = 30.0;
const SEEDS: u64 = 12;

/// Squared error and count of static and dynamic pixels.
#[derive(Clone, Copy, Default)]
struct Sums {
    error: [f64; 2],
    count: [usize; 2],
}

/// Every pixel of `b` is looked up in `a`, where its surface point was `DT` before.
///
/// A pixel counts where the point is visible in both: the four pixels between which `a` is sampled show the
/// same object, and the nearest of them lies at the expected depth.
fn warp(a: &Frame, b: &Frame) -> Sums {
    let (w, h) = (a.camera.width as usize, a.camera.height as usize);
    let mut sums = Sums::default();
    for y in 0..h {
        for x in 0..w {
            let i = y * w + x;
            if b.depth[i] == 0.0 {
                continue;
            }
            let now = b.camera.unproject(x as f64 + 0.5, y as f64 + 0.5, f64::from(b.depth[i]));
            let v = b.velocity[i].map(f64::from);
            let before = [now.x - v[0] * DT, now.y - v[1] * DT, now.z - v[2] * DT];
            let (u, v2, z) = a.camera.project(before.into());
            let (fx, fy) = (u - 0.5, v2 - 0.5);
            if z <= 0.1 || fx < 0.0 || fy < 0.0 || fx >= (w - 1) as f64 || fy >= (h - 1) as f64 {
                continue;
            }
            let (x0, y0) = (fx as usize, fy as usize);
            let taps = [y0 * w + x0, y0 * w + x0 + 1, (y0 + 1) * w + x0, (y0 + 1) * w + x0 + 1];
            let nearest = (fy + 0.5) as usize * w + (fx + 0.5) as usize;
            if taps.iter().any(|&t| a.id[t] != b.id[i]) || (f64::from(a.depth[nearest]) / z - 1.0).abs() > DEPTH {
                continue;
            }
            let (p, q) = (fx - x0 as f64, fy - y0 as f64);
            let weights = [(1.0 - p) * (1.0 - q), p * (1.0 - q), (1.0 - p) * q, p * q];
            let speed = (v[0] * v[0] + v[1] * v[1] + v[2] * v[2]).sqrt();
            let sort = usize::from(speed > f64::from(DYNAMIC));
            for c in 0..3 {
                let seen: f64 = taps.iter().zip(weights).map(|(&t, s)| f64::from(a.rgb[3 * t + c]) * s).sum();
                let e = seen - f64::from(b.rgb[3 * i + c]);
                sums.error[sort] += e * e;
            }
            sums.count[sort] += 3;
        }
    }
    sums
}

fn psnr(error: f64, count: usize) -> f64 {
    10.0 * (255.0 * 255.0 * count as f64 / error.max(1e-9)).log10()
}

fn check(width: u32, height: u32) {
    let options = Options { width, height, ..Options::default() };
    let sums: Vec<Sums> = (0..SEEDS)
        .into_par_iter()
        .map(|seed| {
            let street = Street::new(seed, options.clone()).unwrap();
            warp(&street.frame_at(0.5), &street.frame_at(0.5 + DT))
        })
        .collect();
    for (sort, name, least) in [(0, "static", 20_000), (1, "dynamic", 600)] {
        // A clip without enough moving pixels says nothing about them.
        let values: Vec<f64> =
            sums.iter().filter(|s| s.count[sort] > least).map(|s| psnr(s.error[sort], s.count[sort])).collect();
        let mean = values.iter().sum::<f64>() / values.len() as f64;
        println!("{width}x{height} {name}: mean {mean:.2} dB over {} clips: {values:.1?}", values.len());
        assert!(values.len() >= 8, "{name}: only {} clips have enough pixels", values.len());
        assert!(mean >= PSNR, "{width}x{height} {name}: {mean:.2} dB is under {PSNR} dB: {values:.1?}");
    }
}

#[test]
fn neighbouring_frames_agree_at_640x360() {
    check(640, 360);
}

#[test]
fn neighbouring_frames_agree_at_336x224() {
    check(336, 224);
}

/// The test has teeth: with the pose or the velocity left out the same pixels do not agree.
#[test]
fn wrong_ground_truth_is_noticed() {
    let options = Options { width: 336, height: 224, ..Options::default() };
    let (mut right, mut unposed, mut halved) = (Sums::default(), Sums::default(), Sums::default());
    for seed in 0..6 {
        let street = Street::new(seed, options.clone()).unwrap();
        let (a, b) = (street.frame_at(0.5), street.frame_at(0.5 + DT));
        let fixed = Frame { camera: b.camera, ..a.clone() };
        let mut slow = b.clone();
        slow.velocity.iter_mut().flatten().for_each(|v| *v *= 0.5);
        let got = [(&mut right, warp(&a, &b)), (&mut unposed, warp(&fixed, &b)), (&mut halved, warp(&a, &slow))];
        for (sums, got) in got {
            for sort in 0..2 {
                sums.error[sort] += got.error[sort];
                sums.count[sort] += got.count[sort];
            }
        }
    }
    let db = |s: &Sums, sort: usize| psnr(s.error[sort], s.count[sort]);
    println!("static {:.1} dB, without pose {:.1} dB", db(&right, 0), db(&unposed, 0));
    println!("dynamic {:.1} dB, half the velocity {:.1} dB", db(&right, 1), db(&halved, 1));
    assert!(db(&unposed, 0) < db(&right, 0) - 3.0);
    assert!(db(&halved, 1) < db(&right, 1) - 1.5);
}
