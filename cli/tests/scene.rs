//! `render`, `export` and `inspect` on a scene.

mod common;

use common::{fails, files, ok, ok_json, run};
use glam::{DMat3, DVec3};
use sf_formats::atomic::Overwrite;
use sf_formats::scene::{Compose, SceneFrame, SplatSettings};
use sf_formats::{Camera, Gaussians, Intrinsics, Pose, Scene, image_io, npy};
use std::fs;
use std::path::{Path, PathBuf};

/// A gray wall at z = 10 and a red ball in front of it that moves right at 2 units per second; three
/// frames half a second apart from a camera that drives forward.
fn scene() -> Scene {
    let mut g = Gaussians::default();
    let mut put = |mean: [f32; 3], scale: f32, colour: [f32; 3]| {
        g.mean.push(mean);
        g.scale.push([scale; 3]);
        g.quat.push([1.0, 0.0, 0.0, 0.0]);
        g.opacity.push(0.95);
        g.colour.push(colour);
    };
    for y in -6..=6 {
        for x in -8..=8 {
            put([x as f32, y as f32, 10.0], 0.7, [0.5; 3]);
        }
    }
    for f in 0..3 {
        put([-1.0 + f as f32, 0.0, 5.0], 0.4, [1.0, 0.0, 0.0]);
    }
    let n = g.len();
    let ball = |i: usize| i >= n - 3;
    let frame = |f: usize| SceneFrame {
        time: 0.5 * f as f64,
        camera: Camera {
            width: 48,
            height: 32,
            k: Intrinsics { fx: 40.0, fy: 40.0, cx: 24.0, cy: 16.0 },
            pose: Pose { r: DMat3::IDENTITY, t: DVec3::new(0.0, 0.0, 0.2 * f as f64) },
        },
        source_size: (96, 64),
        name: format!("{f:06}.png"),
    };
    Scene {
        v_fwd: (0..n).map(|i| if ball(i) { [2.0, 0.0, 0.0] } else { [0.0; 3] }).collect(),
        v_bwd: (0..n).map(|i| if ball(i) { [-2.0, 0.0, 0.0] } else { [0.0; 3] }).collect(),
        dynamic: (0..n).map(|i| if ball(i) { 0.9 } else { 0.1 }).collect(),
        source: (0..n).map(|i| if ball(i) { (i + 3 - n) as u32 } else { 0 }).collect(),
        gaussians: g,
        frames: (0..3).map(frame).collect(),
        compose: Compose::default(),
        splat: SplatSettings::default(),
        notes: vec![("model".into(), "made by hand".into())],
    }
}

/// A folder with the scene in `scene/`; the outputs of a test go beside it.
fn saved() -> (tempfile::TempDir, PathBuf) {
    let dir = tempfile::tempdir().unwrap();
    let path = dir.path().join("scene");
    scene().save(&path, Overwrite::No).unwrap();
    (dir, path)
}

/// Column of the reddest pixel of the middle row.
fn ball_column(picture: &Path) -> u32 {
    let image = image_io::read(picture, image_io::Orientation::Ignore).unwrap();
    let redness = |x: u32| {
        let p = image.pixel(x, image.height / 2);
        i32::from(p[0]) - i32::from(p[1])
    };
    (0..image.width).max_by_key(|&x| redness(x)).unwrap()
}

fn s(path: &Path) -> &str {
    path.to_str().unwrap()
}

#[test]
fn pictures_at_new_times_show_the_ball_where_it_moves() {
    let (dir, scene) = saved();
    let out = dir.path().join("out");
    let json = ok_json(&["render", "-s", s(&scene), "-o", s(&out), "--frame", "0", "--times", "0:1:0.25"]);
    assert_eq!(json["views"].as_array().unwrap().len(), 5);
    // From the first camera: u = 24 + 40 x / 5, and x = -1 + 2 t.
    for (i, want) in [16, 20, 24, 28, 32].into_iter().enumerate() {
        let got = ball_column(&out.join(format!("rgb/{i:06}.png")));
        assert!(got.abs_diff(want) <= 1, "view {i}: column {got}, expected {want}");
    }
    assert_eq!(files(&out).len(), 6, "five pictures and the cameras");
    assert_eq!(json["files"].as_array().unwrap().len(), 6);
}

#[test]
fn every_buffer_is_written_and_means_what_it_says() {
    let (dir, scene) = saved();
    let out = dir.path().join("out");
    let text = ok(&[
        "render",
        "-s",
        s(&scene),
        "-o",
        s(&out),
        "--times",
        "0.5",
        "--buffers",
        "rgb,depth,alpha,velocity",
        "--format",
        "jpg",
        "--threads",
        "2",
    ]);
    assert!(text.starts_with("1 view of"), "{text}");
    let names: Vec<String> = files(&out).iter().map(|f| f.display().to_string()).collect();
    assert_eq!(
        names,
        [
            "alpha/000000.png",
            "cameras.json",
            "depth/000000.npy",
            "depth/000000.png",
            "rgb/000000.jpg",
            "velocity/000000.npy",
            "velocity/000000.png"
        ]
    );
    let (shape, depth) = npy::read_f32(&out.join("depth/000000.npy")).unwrap();
    assert_eq!(shape, [32, 48]);
    // Camera at z = 0.2: ball at 4.8 in the middle, wall at 9.8 above it.
    assert!((depth[16 * 48 + 24] - 4.8).abs() < 0.6, "{}", depth[16 * 48 + 24]);
    assert!((depth[3 * 48 + 24] - 9.8).abs() < 0.3, "{}", depth[3 * 48 + 24]);
    let (shape, velocity) = npy::read_f32(&out.join("velocity/000000.npy")).unwrap();
    assert_eq!(shape, [32, 48, 3]);
    let at = |row: usize, column: usize| velocity[(row * 48 + column) * 3];
    assert!(at(16, 24) > 1.5, "{}", at(16, 24));
    assert_eq!(at(3, 4), 0.0);
}

#[test]
fn the_written_cameras_reproduce_the_pictures() {
    let (dir, scene) = saved();
    let (a, b) = (dir.path().join("a"), dir.path().join("b"));
    ok(&["render", "-s", s(&scene), "-o", s(&a), "--orbit", "--shift", "right=0.5,yaw=3", "--times", "0,0.3,0.9"]);
    ok(&["render", "-s", s(&scene), "-o", s(&b), "--path", s(&a.join("cameras.json"))]);
    for file in files(&a) {
        assert_eq!(fs::read(a.join(&file)).unwrap(), fs::read(b.join(&file)).unwrap(), "{}", file.display());
    }
    // Thread counts do not change a bit.
    let c = dir.path().join("c");
    ok(&["render", "-s", s(&scene), "-o", s(&c), "--path", s(&a.join("cameras.json")), "--threads", "3"]);
    for file in files(&a) {
        assert_eq!(fs::read(a.join(&file)).unwrap(), fs::read(c.join(&file)).unwrap(), "{}", file.display());
    }
}

#[test]
fn composition_flags_change_what_is_drawn() {
    let (dir, scene) = saved();
    let shot = |name: &str, flags: &[&str]| {
        let out = dir.path().join(name);
        let mut args = vec!["render", "-s", s(&scene), "-o", s(&out), "--times", "0.5", "--buffers", "velocity"];
        args.extend(flags);
        ok_json(&args)["views"][0]["gaussians"].as_u64().unwrap()
    };
    // 221 of the wall and one ball of the own frame, or one of each neighbour.
    assert_eq!(shot("own", &[]), 222);
    assert_eq!(shot("others", &["--exclude-own-frame"]), 223);
    let out = dir.path().join("between");
    let json = ok_json(&["render", "-s", s(&scene), "-o", s(&out), "--times", "0.25", "--window", "2"]);
    assert_eq!(json["views"][0]["gaussians"], 224);
}

#[test]
fn s14_times_beyond_the_clip_are_drawn_and_said_and_nan_is_refused() {
    let (dir, scene) = saved();
    let out = dir.path().join("out");
    let r = run(&["render", "-s", s(&scene), "-o", s(&out), "--times", "-0.5,0,1.5"]);
    assert_eq!(r.code, 0, "{}", r.stderr);
    assert!(r.stderr.contains("2 of 3 views lie beyond"), "{}", r.stderr);
    let refused = dir.path().join("refused");
    for bad in ["nan", "0,inf", "-inf"] {
        let line = fails(3, &["render", "-s", s(&scene), "-o", s(&refused), "--times", bad]);
        assert!(line.contains("not a time"), "{line}");
        assert!(!refused.exists());
    }
}

#[test]
fn s12_picture_sizes() {
    let (dir, scene) = saved();
    let refused = dir.path().join("refused");
    for (size, code) in [("0x10", 3), ("10x0", 3), ("65536x65536", 5), ("16385x1", 5)] {
        fails(code, &["render", "-s", s(&scene), "-o", s(&refused), "--size", size]);
        assert!(!refused.exists());
    }
    let out = dir.path().join("one");
    ok(&["render", "-s", s(&scene), "-o", s(&out), "--size", "1x1", "--times", "0"]);
    let image = image_io::read(&out.join("rgb/000000.png"), image_io::Orientation::Ignore).unwrap();
    assert_eq!(image.size(), (1, 1));
}

#[test]
fn s01_s02_s03_bad_cameras_in_a_path_file() {
    let (dir, scene) = saved();
    let good = dir.path().join("good");
    ok(&["render", "-s", s(&scene), "-o", s(&good), "--times", "0"]);
    let json: serde_json::Value = serde_json::from_slice(&fs::read(good.join("cameras.json")).unwrap()).unwrap();
    let file = dir.path().join("cams.json");
    let refused = dir.path().join("refused");
    let broken = |what: &str, edit: &dyn Fn(&mut serde_json::Value)| {
        let mut copy = json.clone();
        edit(&mut copy);
        assert_ne!(copy, json, "{what} changed nothing");
        fs::write(&file, copy.to_string()).unwrap();
        fails(3, &["render", "-s", s(&scene), "-o", s(&refused), "--path", s(&file)]);
        assert!(!refused.exists());
    };
    for (name, value) in [("fx", 0.0), ("fx", -40.0), ("fy", 1e30)] {
        broken(name, &|v| v["cameras"][0][name] = value.into());
    }
    broken("not a rotation", &|v| v["cameras"][0]["camera_to_world"][0][0] = 0.5.into());
    broken("reflection", &|v| v["cameras"][0]["camera_to_world"][0][0] = (-1.0).into());
    broken("bottom row", &|v| v["cameras"][0]["camera_to_world"][3][3] = 2.0.into());
    broken("far away", &|v| v["cameras"][0]["camera_to_world"][0][3] = 1e30.into());
    fs::write(&file, "{\"cameras\": [NaN]}").unwrap();
    fails(3, &["render", "-s", s(&scene), "-o", s(&refused), "--path", s(&file)]);
}

#[test]
fn s10_a_splat_file_that_is_shorter_than_it_says() {
    let (dir, scene) = saved();
    let ply = fs::read(scene.join("scene.ply")).unwrap();
    let file = dir.path().join("x.ply");
    fs::write(&file, &ply[..ply.len() - 10]).unwrap();
    fails(3, &["inspect", s(&file)]);
    let text = String::from_utf8_lossy(&ply[..600]).into_owned();
    let count = text.lines().find(|l| l.starts_with("element vertex")).unwrap();
    let at = text.find(count).unwrap();
    let mut many = ply.clone();
    many.splice(at..at + count.len(), b"element vertex 4294967296".iter().copied());
    fs::write(&file, many).unwrap();
    fails(3, &["render", "-s", s(&file), "-o", s(&dir.path().join("o"))]);
}

#[test]
fn export_writes_files_that_other_tools_open() {
    let (dir, scene) = saved();
    let file = dir.path().join("still.ply");
    let json = ok_json(&["export", "-s", s(&scene), "-o", s(&file), "--at", "0.25"]);
    // The wall and the balls of both neighbours.
    assert_eq!(json["gaussians"], 223);
    let (back, _) = Scene::load(&file).unwrap();
    assert_eq!(back.len(), 223);
    // An existing file is kept unless forced.
    let before = fs::read(&file).unwrap();
    assert!(fails(6, &["export", "-s", s(&scene), "-o", s(&file)]).contains("--force"));
    assert_eq!(fs::read(&file).unwrap(), before);
    ok(&["export", "-s", s(&scene), "-o", s(&file), "--force", "--static-only"]);
    assert_eq!(Scene::load(&file).unwrap().0.len(), 221);
    ok(&["export", "-s", s(&scene), "-o", s(&file), "--force", "--dynamic-only"]);
    assert_eq!(Scene::load(&file).unwrap().0.len(), 1);

    let folder = dir.path().join("sequence");
    let json = ok_json(&["export", "-s", s(&scene), "-o", s(&folder), "--format", "ply-seq", "--times", "0:1:0.25"]);
    assert_eq!(json["files"].as_array().unwrap().len(), 5);
    assert!(folder.join("frame_00004.ply").exists());

    for (format, name) in [
        ("nerfstudio", "transforms.json"),
        ("tum", "poses_tum.txt"),
        ("kitti", "poses_kitti.txt"),
        ("colmap", "images.txt"),
    ] {
        let folder = dir.path().join(format);
        let json = ok_json(&["export", "-s", s(&scene), "-o", s(&folder), "--format", format]);
        assert_eq!(json["cameras"], 3);
        assert!(folder.join(name).exists());
    }
    fails(2, &["export", "-s", s(&scene), "-o", "x", "--format", "obj"]);
    fails(2, &["export", "-s", s(&scene), "-o", "x", "--times", "0"]);
    fails(2, &["export", "-s", s(&scene), "-o", "x", "--format", "tum", "--at", "0"]);
    fails(3, &["export", "-s", s(&scene), "-o", s(&dir.path().join("n.ply")), "--at", "nan"]);
    assert!(!dir.path().join("n.ply").exists());
}

#[test]
fn a_plain_splat_file_needs_cameras_from_outside() {
    let (dir, scene) = saved();
    let file = dir.path().join("still.ply");
    ok(&["export", "-s", s(&scene), "-o", s(&file)]);
    let out = dir.path().join("out");
    assert!(fails(3, &["render", "-s", s(&file), "-o", s(&out)]).contains("--path"));
    let cams = dir.path().join("a");
    ok(&["render", "-s", s(&scene), "-o", s(&cams), "--times", "0"]);
    ok(&["render", "-s", s(&file), "-o", s(&out), "--path", s(&cams.join("cameras.json"))]);
    assert!(
        fails(3, &["export", "-s", s(&file), "-o", s(&dir.path().join("t")), "--format", "tum"]).contains("cameras")
    );
}

#[test]
fn inspect_tells_what_a_scene_holds() {
    let (_dir, scene) = saved();
    let json = ok_json(&["inspect", s(&scene), "--stats"]);
    assert_eq!((json["kind"].as_str(), json["gaussians"].as_u64()), (Some("scene"), Some(224)));
    assert_eq!((json["moving"].as_u64(), json["frames"].as_u64()), (Some(3), Some(3)));
    assert_eq!(json["notes"]["model"], "made by hand");
    assert_eq!(ok_json(&["inspect", s(&scene.join("scene.ply"))])["kind"], "splats");
}

#[test]
fn an_output_folder_with_files_is_refused_and_kept() {
    let (dir, scene) = saved();
    let out = dir.path().join("out");
    fs::create_dir(&out).unwrap();
    ok(&["render", "-s", s(&scene), "-o", s(&out), "--times", "0"]);
    let before = files(&out);
    assert!(fails(6, &["render", "-s", s(&scene), "-o", s(&out), "--times", "0,0.5"]).contains("--force"));
    assert_eq!(files(&out), before);
    ok(&["render", "-s", s(&scene), "-o", s(&out), "--times", "0,0.5", "--force"]);
    assert_eq!(files(&out).len(), before.len() + 1);
    // A file in the way.
    fails(6, &["render", "-s", s(&scene), "-o", s(&scene.join("scene.ply"))]);
}
