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
        "rgb,depth,depth-sum,alpha,velocity,dynamic",
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
            "depth/scale.png",
            "depth-sum/000000.npy",
            "dynamic/000000.png",
            "dynamic/000000_overlay.png",
            "rgb/000000.jpg",
            "velocity/000000.npy",
            "velocity/000000.png",
            "velocity/scale.png"
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
    assert!(at(16, 24) > 1.8, "{}", at(16, 24));
    assert_eq!(at(3, 4), 0.0);
    let (_, sum) = npy::read_f32(&out.join("depth-sum/000000.npy")).unwrap();
    // Expected depth is the sum over the coverage, which is below 1.
    assert!(sum.iter().zip(&depth).all(|(s, d)| s <= d) && sum[16 * 48 + 24] < depth[16 * 48 + 24]);
    let read = |name: &str| image_io::read(&out.join(name), image_io::Orientation::Ignore).unwrap();
    let dynamic = read("dynamic/000000.png");
    // The ball's probability is 0.9, the wall's 0.1; a little of the wall shines through.
    assert!(dynamic.pixel(24, 16)[0].abs_diff(222) < 10 && dynamic.pixel(4, 3)[0].abs_diff(26) < 2);
    let overlay = read("dynamic/000000_overlay.png");
    assert!(overlay.pixel(24, 16)[0] > overlay.pixel(24, 16)[2] + 60, "orange: {:?}", overlay.pixel(24, 16));
}

/// A clip for the scene: every source picture and one between each two, of one colour each.
fn clip(dir: &Path) -> PathBuf {
    let folder = dir.join("clip");
    fs::create_dir(&folder).unwrap();
    for (i, name) in ["000000", "000000b", "000001", "000001b", "000002"].iter().enumerate() {
        let image = image_io::Rgb8::new(96, 64, [50 * i as u8, 100, 150].repeat(96 * 64));
        image_io::write_png(&folder.join(format!("{name}.png")), &image, Overwrite::No).unwrap();
    }
    folder
}

/// A text field of a y4m header.
fn y4m_header(bytes: &[u8]) -> &str {
    std::str::from_utf8(&bytes[..bytes.iter().position(|&b| b == b'\n').unwrap()]).unwrap()
}

/// A PNG file without its animation chunks.
fn without_animation(bytes: &[u8]) -> Vec<u8> {
    let (mut out, mut at) = (bytes[..8].to_vec(), 8);
    while at < bytes.len() {
        let length = u32::from_be_bytes(bytes[at..at + 4].try_into().unwrap()) as usize;
        if ![b"acTL", b"fcTL", b"fdAT"].iter().any(|kind| bytes[at + 4..at + 8] == kind[..]) {
            out.extend(&bytes[at..at + 12 + length]);
        }
        at += 12 + length;
    }
    out
}

#[test]
fn animations_show_the_buffers_side_by_side() {
    let (dir, scene) = saved();
    let clip = clip(dir.path());
    let video = dir.path().join("out.y4m");
    let buffers = ["--times", "0:1:0.25", "--buffers", "real,rgb,depth,dynamic", "--clip", s(&clip)];
    let json = ok_json(&[&["render", "-s", s(&scene), "-o", s(&video)], &buffers[..]].concat());
    assert_eq!((json["format"].as_str(), json["fps"].as_f64()), (Some("y4m"), Some(4.0)));
    let bytes = fs::read(&video).unwrap();
    let (width, frame) = (4 * 48 + 3 * 4, (4 * 48 + 3 * 4) * 32 * 3 / 2);
    assert_eq!(y4m_header(&bytes), format!("YUV4MPEG2 W{width} H32 F4:1 Ip A1:1 C420jpeg XCOLORRANGE=LIMITED"));
    let body = &bytes[y4m_header(&bytes).len() + 1..];
    assert_eq!(body.len(), 5 * (6 + frame));
    // The real pictures by their luma: 50 more red each time.
    for (i, f) in body.chunks(6 + frame).enumerate() {
        let want = 16.0 + (65.481 * 50.0 * i as f64 + 128.553 * 100.0 + 24.966 * 150.0) / 255.0;
        assert!((f64::from(f[6 + 10 * width + 20]) - want).abs() < 1.0, "picture {i}");
    }
    // The same bytes on standard output, where nothing else may be.
    let mut args = vec!["render", "-s", s(&scene), "-o", "-", "--format", "y4m"];
    args.extend(buffers);
    let out = common::command(&args).output().unwrap();
    assert!(out.status.success() && out.stdout == bytes && !out.stderr.is_empty());

    let png = dir.path().join("out.apng");
    ok(&["render", "-s", s(&scene), "-o", s(&png), "--times", "0:1:0.5", "--fps", "8"]);
    let bytes = fs::read(&png).unwrap();
    let chunk = bytes.windows(4).position(|w| w == b"acTL").expect("an animation");
    assert_eq!(bytes[chunk + 4..chunk + 12], [0, 0, 0, 3, 0, 0, 0, 0], "three pictures, for ever");
    // A reader that knows no animation sees the first picture.
    let first = image_io::decode(&without_animation(&bytes), "first", image_io::Orientation::Ignore).unwrap();
    let folder = dir.path().join("pictures");
    ok(&["render", "-s", s(&scene), "-o", s(&folder), "--times", "0"]);
    let want = image_io::read(&folder.join("rgb/000000.png"), image_io::Orientation::Ignore).unwrap();
    assert_eq!(first.image, want);
    let few = dir.path().join("few.apng");
    ok(&["render", "-s", s(&scene), "-o", s(&few), "--times", "0:1:0.5", "--colours", "16"]);
    assert!(fs::metadata(&few).unwrap().len() < bytes.len() as u64);
    // Existing files stay.
    assert!(fails(6, &["render", "-s", s(&scene), "-o", s(&few)]).contains("--force"));
    ok(&["render", "-s", s(&scene), "-o", s(&few), "--force"]);
}

/// A folder with an executable script named ffmpeg.
#[cfg(unix)]
fn fake_ffmpeg(dir: &Path, script: &str) -> PathBuf {
    use std::os::unix::fs::PermissionsExt;
    let folder = dir.join(format!("bin{}", script.len()));
    fs::create_dir_all(&folder).unwrap();
    let file = folder.join("ffmpeg");
    fs::write(&file, format!("#!/bin/sh\n{script}\n")).unwrap();
    fs::set_permissions(&file, fs::Permissions::from_mode(0o755)).unwrap();
    folder
}

#[cfg(unix)]
#[test]
fn mp4_goes_through_ffmpeg_and_says_so_where_it_is_missing() {
    let (dir, scene) = saved();
    let video = dir.path().join("out.mp4");
    let call = |path: &str, extra: &[&str]| {
        let mut args = vec!["render", "-s", s(&scene), "-o", s(&video), "--times", "0:1:0.5"];
        args.extend(extra);
        common::ran(common::command(&args).env("PATH", path).output().unwrap())
    };
    let empty = dir.path().join("empty");
    fs::create_dir(&empty).unwrap();
    let r = call(s(&empty), &[]);
    assert!(r.code == 7 && r.stderr.contains("ffmpeg") && r.stderr.contains("y4m"), "{} {}", r.code, r.stderr);
    // Fails at once, and after all pictures.
    for script in
        ["echo noise >&2; echo 'Unknown encoder' >&2; exit 3", "cat > /dev/null; echo 'No space here' >&2; exit 1"]
    {
        let bin = fake_ffmpeg(dir.path(), script);
        let r = call(&format!("{}:/usr/bin:/bin", s(&bin)), &[]);
        assert!(r.code == 6 && (r.stderr.contains("Unknown encoder") || r.stderr.contains("No space")), "{}", r.stderr);
        assert!(!video.exists());
    }
    // What reaches the program is the y4m file, and its arguments name no more than the temporary file.
    let bin = fake_ffmpeg(dir.path(), "for last; do :; done\nprintf '%s\\n' \"$@\" > \"$last.args\"\ncat > \"$last\"");
    let path = format!("{}:/usr/bin:/bin", s(&bin));
    let r = call(&path, &[]);
    assert_eq!(r.code, 0, "{}", r.stderr);
    let y4m = dir.path().join("same.y4m");
    ok(&["render", "-s", s(&scene), "-o", s(&y4m), "--times", "0:1:0.5"]);
    assert_eq!(fs::read(&video).unwrap(), fs::read(&y4m).unwrap());
    let left: Vec<_> = fs::read_dir(dir.path()).unwrap().map(|e| e.unwrap().file_name()).collect();
    assert!(!left.iter().any(|n| n.to_string_lossy().ends_with(".tmp")), "{left:?}");
    assert!(call(&path, &[]).stderr.contains("--force"));
    assert_eq!(call(&path, &["--force"]).code, 0);
}

#[test]
fn flags_of_render_that_do_not_go_together() {
    let (dir, scene) = saved();
    let out = dir.path().join("out");
    for (args, why) in [
        (&["--buffers", "real"][..], "--clip"),
        (&["--clip", "x"], "--buffers real"),
        (&["--fps", "5"], "animation"),
        (&["--colours", "9"], "apng"),
        (&["--format", "apng", "--buffers", "depth-sum"], "arrays"),
    ] {
        let line = fails(2, &[&["render", "-s", s(&scene), "-o", s(&out)], args].concat());
        assert!(line.contains(why), "{args:?}: {line}");
    }
    assert!(fails(2, &["render", "-s", s(&scene), "-o", "-"]).contains("y4m"));
    assert!(fails(2, &["render", "-s", s(&scene), "-o", "-", "--format", "mp4"]).contains("y4m"));
    fails(2, &["render", "-s", s(&scene), "-o", s(&out), "--chase=0"]);
    fails(2, &["render", "-s", s(&scene), "-o", s(&out), "--chase", "--frame", "1"]);
    fails(2, &["render", "-s", s(&scene), "-o", s(&out), "--format", "apng", "--fps", "0"]);
    // A clip of other pictures.
    let other = dir.path().join("other");
    fs::create_dir(&other).unwrap();
    let image = image_io::Rgb8::new(20, 20, vec![0; 1200]);
    image_io::write_png(&other.join("a.png"), &image, Overwrite::No).unwrap();
    let line = fails(3, &["render", "-s", s(&scene), "-o", s(&out), "--buffers", "real", "--clip", s(&other)]);
    assert!(line.contains("000000.png"), "{line}");
    assert!(!out.exists());
    // An animation needs one size.
    let (a, b) = (dir.path().join("a"), dir.path().join("b"));
    ok(&["render", "-s", s(&scene), "-o", s(&a), "--times", "0,0.5"]);
    let text = fs::read_to_string(a.join("cameras.json")).unwrap();
    fs::write(&b, text.replacen("\"width\": 48", "\"width\": 50", 1)).unwrap();
    let video = dir.path().join("v.apng");
    let line = fails(3, &["render", "-s", s(&scene), "-o", s(&video), "--path", s(&b)]);
    assert!(line.contains("50x32") && !video.exists(), "{line}");
}

#[test]
fn cameras_follow_behind_and_turn_to_what_moves() {
    let (dir, scene) = saved();
    let behind = dir.path().join("behind");
    ok(&["render", "-s", s(&scene), "-o", s(&behind), "--chase=3", "--times", "0.5"]);
    let json: serde_json::Value = serde_json::from_slice(&fs::read(behind.join("cameras.json")).unwrap()).unwrap();
    let row = |i: usize| json["cameras"][0]["camera_to_world"][i][3].as_f64().unwrap();
    assert!((row(1) + 1.0).abs() < 1e-9 && (row(2) - (0.2 - 3.0)).abs() < 1e-9, "{} {}", row(1), row(2));
    // The ball stays in the middle column while it moves.
    let follow = dir.path().join("follow");
    ok(&["render", "-s", s(&scene), "-o", s(&follow), "--frame", "0", "--times", "0:1:0.25", "--look-at", "24,16@1"]);
    for i in 0..5 {
        let got = ball_column(&follow.join(format!("rgb/{i:06}.png")));
        assert!(got.abs_diff(24) <= 1, "view {i}: column {got}");
    }
    let none = dir.path().join("none");
    assert!(fails(3, &["render", "-s", s(&scene), "-o", s(&none), "--look-at", "2,2"]).contains("nothing"));
    fails(2, &["render", "-s", s(&scene), "-o", s(&none), "--look-at", "2"]);
}

/// Root mean square difference as PSNR, dB.
fn psnr(a: &[f32], b: &[f32]) -> f64 {
    let square: f64 = a.iter().zip(b).map(|(a, b)| f64::from(a - b).powi(2)).sum();
    -10.0 * (square / a.len() as f64).log10()
}

#[test]
fn an_exported_ply_draws_the_same_picture_when_read_back() {
    let dir = tempfile::tempdir().unwrap();
    let path = dir.path().join("street");
    ok(&["synth", "--seed", "17", "--frames", "8", "--size", "126x84", "--scene", s(&path)]);
    let (scene, _) = Scene::load(&path).unwrap();
    let mut renderer = sf_splat::Renderer::new(2).unwrap();
    let mut picture = |g: &Gaussians, camera: &Camera| {
        renderer.render(g, camera, &scene.splat, &sf_splat::RenderOptions::default()).unwrap().rgb
    };
    for (name, time, flags) in [("moment", 0.25, &["--at", "0.25"][..]), ("static", 0.0, &["--static-only"])] {
        let file = dir.path().join(format!("{name}.ply"));
        ok(&[&["export", "-s", s(&path), "-o", s(&file)], flags].concat());
        let (back, report) = Scene::load(&file).unwrap();
        assert_eq!(report.dropped(), 0);
        let mut rules = scene.compose;
        let camera = scene.camera_at(time).unwrap();
        let mut still = scene.clone();
        if name == "static" {
            // No dynamic splat exists in a frame that the scene does not have.
            still.source.iter_mut().for_each(|f| *f = 99);
            rules.window = 1;
        }
        let want = picture(&still.at(time, &rules).unwrap(), &camera);
        let got = picture(&back.gaussians, &camera);
        assert!(psnr(&got, &want) > 70.0, "{name}: {} dB", psnr(&got, &want));
    }
}

#[test]
fn a_true_scene_looks_like_its_clip() {
    let dir = tempfile::tempdir().unwrap();
    let (clip, scene, out) = (dir.path().join("clip"), dir.path().join("scene"), dir.path().join("out"));
    let json =
        ok_json(&["synth", "--seed", "17", "--frames", "6", "--size", "126x84", "-o", s(&clip), "--scene", s(&scene)]);
    assert_eq!(json["scene_gaussians"], 2 * 126 * 84);
    ok(&["render", "-s", s(&scene), "-o", s(&out), "--buffers", "rgb,real", "--clip", s(&clip)]);
    for i in 0..2 {
        let unit = |kind: &str| {
            let file = out.join(format!("{kind}/{i:06}.png"));
            let image = image_io::read(&file, image_io::Orientation::Ignore).unwrap();
            image.data.iter().map(|&b| f32::from(b) / 255.0).collect::<Vec<_>>()
        };
        let quality = psnr(&unit("rgb"), &unit("real"));
        assert!(quality > 22.0, "frame {i}: {quality} dB");
    }
}

#[test]
fn other_viewers_get_splats_of_32_bytes_and_a_page_that_needs_no_network() {
    let (dir, scene) = saved();
    let file = dir.path().join("still.splat");
    assert_eq!(ok_json(&["export", "-s", s(&scene), "-o", s(&file), "--at", "0.25"])["format"], "splat");
    assert_eq!(fs::metadata(&file).unwrap().len(), 32 * 223);
    let page = dir.path().join("page.html");
    let clip = clip(dir.path());
    let title = "A <b>street</b> & {{scene}}";
    let json = ok_json(&["export", "-s", s(&scene), "-o", s(&page), "--clip", s(&clip), "--title", title]);
    // Three source frames and one time between each two.
    assert_eq!((json["gaussians"].as_u64(), json["pictures"].as_u64()), (Some(224), Some(5)));
    let text = fs::read_to_string(&page).unwrap();
    assert!(!text.contains("http://") && !text.contains("https://"), "the page names a network address");
    assert!(!text.contains("<b>street"), "the title is text");
    let between = |start: &str| text.split(start).nth(1).unwrap().split("</script>").next().unwrap();
    let info: serde_json::Value =
        serde_json::from_str(between("<script type=\"application/json\" id=\"scene\">")).unwrap();
    assert_eq!((info["static"].as_u64(), info["moving"].as_u64()), (Some(221), Some(3)));
    assert_eq!(info["title"], title);
    let pictures = info["pictures"].as_array().unwrap();
    assert_eq!(pictures.iter().map(|p| p["time"].as_f64().unwrap()).collect::<Vec<_>>(), [0.0, 0.25, 0.5, 0.75, 1.0]);
    assert!(pictures.iter().all(|p| p["real"].is_string() && p["psnr_db"].is_f64()));
    // 27 bytes a splat and 14 more for one that moves, sections in steps of four.
    let up = |n: usize| n.next_multiple_of(4);
    let bytes = 224 * 12 + up(224 * 6) + 224 * 8 + up(224) + up(3 * 12) + up(3 * 2);
    assert_eq!(between("<script type=\"text/plain\" id=\"splats\">").len(), bytes.div_ceil(3) * 4);
    assert!(fails(6, &["export", "-s", s(&scene), "-o", s(&page)]).contains("--force"));
    // Without the clip the rendered pictures alone; nothing faint.
    let json = ok_json(&["export", "-s", s(&scene), "-o", s(&page), "--force", "--min-opacity", "0.99"]);
    assert_eq!(json["gaussians"], 0);
    fails(2, &["export", "-s", s(&scene), "-o", s(&page), "--format", "html", "--at", "1"]);
    fails(2, &["export", "-s", s(&scene), "-o", "x.ply", "--clip", "y"]);
    let plain = dir.path().join("plain.ply");
    ok(&["export", "-s", s(&scene), "-o", s(&plain)]);
    assert!(fails(3, &["export", "-s", s(&plain), "-o", s(&dir.path().join("n.html"))]).contains("cameras"));
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

#[test]
fn a_report_shows_results_and_scenes_on_one_page() {
    let (dir, scene) = saved();
    let clip = clip(dir.path());
    let rendered = dir.path().join("render.json");
    let text = ok(&["render", "-s", s(&scene), "-o", s(&dir.path().join("out")), "--times", "0:1:0.1", "--json"]);
    fs::write(&rendered, text).unwrap();
    let page = dir.path().join("report.html");
    let json = ok_json(&["report", s(&rendered), s(&scene), "--clip", s(&clip), "-o", s(&page), "--title", "A & B"]);
    assert_eq!(json["sections"], 2);
    let text = fs::read_to_string(&page).unwrap();
    assert!(!text.contains("http://") && !text.contains("https://"));
    for part in ["A &amp; B", "11 samples", "224 Gaussians, 3 of them moving", "never seen: real", "data:image/jpeg"] {
        assert!(text.contains(part), "{part}");
    }
    assert!(fails(6, &["report", s(&rendered), "-o", s(&page)]).contains("--force"));
    let bad = dir.path().join("bad.json");
    let out = dir.path().join("none.html");
    for (content, why) in [("{", "not JSON"), ("[1]", "schema"), ("{\"a\": 1}", "schema")] {
        fs::write(&bad, content).unwrap();
        let line = fails(3, &["report", s(&bad), "-o", s(&out)]);
        assert!(line.contains(why) && line.contains("bad.json"), "{line}");
    }
    let empty = dir.path().join("empty");
    fs::create_dir(&empty).unwrap();
    assert!(fails(3, &["report", s(&empty), "-o", s(&out)]).contains("no result"));
    fails(2, &["report", "-o", s(&out)]);
    fails(6, &["report", s(&dir.path().join("missing.json")), "-o", s(&out)]);
    assert!(!out.exists());
}
