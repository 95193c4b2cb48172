//! What the default style draws: enough motion, sky, depth and turning, and nothing that is not finite.

use rayon::prelude::*;
use sf_formats::atomic::Overwrite;
use sf_formats::clip::{Clip, ClipOptions, GroundTruth};
use sf_synth::{DYNAMIC, FAR, ID_GROUND, ID_SKY, Options, Street, Style, write_clip};

struct Clip50 {
    dynamic: f64,
    sky: f64,
    depth: f64,
    rotation: f64,
    travel: f64,
}

fn clip(seed: u64) -> Clip50 {
    let street = Street::new(seed, Options { width: 168, height: 112, ..Options::default() }).unwrap();
    let frames: Vec<_> = [0, 5, 10, 15].map(|i| street.frame(i)).into();
    let (mut dynamic, mut sky, mut n) = (0usize, 0usize, 0usize);
    let mut depths = Vec::new();
    for f in &frames {
        f.camera.check("camera").unwrap();
        for i in 0..f.depth.len() {
            assert!(f.depth[i].is_finite() && (0.0..=FAR).contains(&f.depth[i]), "seed {seed}");
            assert!(f.velocity[i].iter().all(|v| v.is_finite() && v.abs() < 60.0), "seed {seed}");
            assert_eq!(f.depth[i] == 0.0, f.id[i] == ID_SKY, "seed {seed}");
            if f.id[i] <= ID_GROUND {
                assert_eq!(f.velocity[i], [0.0; 3], "seed {seed}: ground and sky stand still");
            }
            if f.depth[i] > 0.0 {
                depths.push(f.depth[i]);
            }
        }
        dynamic += f.dynamic(DYNAMIC).iter().filter(|&&m| m != 0).count();
        sky += f.id.iter().filter(|&&i| i == ID_SKY).count();
        n += f.id.len();
    }
    depths.sort_by(f32::total_cmp);
    let pose = frames[3].camera.pose;
    let trace = pose.r.x_axis.x + pose.r.y_axis.y + pose.r.z_axis.z;
    Clip50 {
        dynamic: dynamic as f64 / n as f64,
        sky: sky as f64 / n as f64,
        depth: f64::from(depths[depths.len() / 2]),
        rotation: ((trace - 1.0) / 2.0).clamp(-1.0, 1.0).acos().to_degrees(),
        travel: pose.t.length(),
    }
}

#[test]
fn fifty_clips_have_the_wanted_statistics() {
    let clips: Vec<Clip50> = (0..50u64).into_par_iter().map(clip).collect();
    let mean = |f: fn(&Clip50) -> f64| clips.iter().map(f).sum::<f64>() / clips.len() as f64;
    let (dynamic, sky, depth) = (mean(|c| c.dynamic), mean(|c| c.sky), mean(|c| c.depth));
    let (rotation, travel) = (mean(|c| c.rotation), mean(|c| c.travel));
    let moving = clips.iter().filter(|c| c.dynamic > 0.002).count();
    let turning = clips.iter().filter(|c| c.rotation > 12.0).count();
    println!(
        "dynamic {:.1} % (some in {moving} of 50), sky {:.1} %, median depth {depth:.1} m, rotation {rotation:.1} deg \
         ({turning} turn over 12 deg), travel {travel:.1} m",
        100.0 * dynamic,
        100.0 * sky
    );
    assert!((0.02..0.12).contains(&dynamic), "{dynamic}");
    assert!((0.10..0.35).contains(&sky), "{sky}");
    assert!((6.0..20.0).contains(&depth), "{depth}");
    assert!(rotation > 4.0 && turning >= 8, "{rotation} {turning}");
    assert!(moving >= 35, "{moving}");
    assert!((4.0..14.0).contains(&travel), "{travel}");
}

#[test]
fn a_written_clip_reads_back() {
    let dir = tempfile::tempdir().unwrap();
    let folder = dir.path().join("clip");
    let street = Street::new(1, Options { frames: 3, width: 84, height: 56, ..Options::default() }).unwrap();
    write_clip(&street, &folder, Overwrite::No).unwrap();
    let clip = Clip::open(&folder, &ClipOptions::default()).unwrap();
    let truth = GroundTruth::load(&folder, &[0, 1, 2]).unwrap().unwrap();
    for i in 0..3 {
        let frame = street.frame(i);
        assert_eq!(clip.frames[i].image.data, frame.rgb);
        assert!((clip.frames[i].time - frame.time).abs() < 1e-9);
        let pose = clip.poses.as_ref().unwrap()[i];
        assert!((pose.t - frame.camera.pose.t).length() < 1e-6);
        assert!((pose.r.z_axis - frame.camera.pose.r.z_axis).length() < 1e-6);
        assert_eq!(truth.frames[i].depth, frame.depth);
        assert_eq!(truth.frames[i].velocity.as_ref().unwrap(), &frame.velocity);
    }
    assert!((clip.intrinsics.unwrap().fx - street.intrinsics().fx).abs() < 1e-6);
    assert!(write_clip(&street, &folder, Overwrite::No).is_err());
}

/// Corners of the option space draw without a fault.
#[test]
fn extreme_styles_draw() {
    let empty =
        Style { traffic: 0.0, vehicles: (0, 0), people: 0.0, built: 0.0, parked: 0.0, trees: 0.0, ..Style::default() };
    let full = Style {
        traffic: 1.0,
        vehicles: (40, 40),
        people: 40.0,
        built: 1.0,
        parked: 1.0,
        trees: 1.0,
        turning: 1.0,
        hfov: (120.0, 120.0),
        curvature: 0.05,
        acceleration: 5.0,
        yaw: 30.0,
        ..Style::default()
    };
    for style in [empty, full] {
        for seed in 0..4 {
            let long =
                Options { frames: 60, fps: 1.0, width: 48, height: 16, style: style.clone(), ..Options::default() };
            let street = Street::new(seed, long).unwrap();
            for i in [0, 30, 59] {
                let frame = street.frame(i);
                assert!(frame.depth.iter().all(|d| d.is_finite()));
                frame.camera.check("camera").unwrap();
            }
        }
    }
}

#[test]
fn senseless_options_are_usage_errors() {
    let d = Options::default;
    for bad in [
        Options { frames: 0, ..d() },
        Options { width: 8, ..d() },
        Options { fps: f64::NAN, ..d() },
        Options { stride: 0, ..d() },
        Options { frames: 600, fps: 1.0, ..d() },
        Options { noise: -1.0, ..d() },
    ] {
        assert_eq!(Street::new(0, bad).unwrap_err().status() as i32, 2);
    }
}
