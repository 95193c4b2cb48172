//! Scenes, splat files, camera paths: round trips, and every bad input of section "cameras, scenes"
//! that concerns loading.

use glam::{DMat3, DVec3};
use sf_formats::atomic::Overwrite;
use sf_formats::camera_json::{self, TimedCamera};
use sf_formats::config::{Extrapolate, SelfRule, Split};
use sf_formats::ply::{self, LoadReport};
use sf_formats::poses_io::{self, PoseFormat};
use sf_formats::scene::{Compose, SceneFrame, SplatSettings};
use sf_formats::{Camera, Gaussians, Intrinsics, Pose, Scene};
use std::path::{Path, PathBuf};

/// The cases this file covers.
pub const COVERED: [&str; 11] = ["S01", "S02", "S03", "S04", "S05", "S06", "S07", "S10", "S12", "S14", "S15"];

fn camera(i: usize) -> Camera {
    Camera {
        width: 252,
        height: 168,
        k: Intrinsics { fx: 210.5, fy: 209.0, cx: 126.25, cy: 84.0 },
        pose: Pose { r: DMat3::from_rotation_y(0.3 * i as f64), t: DVec3::new(0.1, -0.2, 1.0 / 3.0 * i as f64) },
    }
}

/// Numbers in [0, 1) from a counter: the same on every machine.
fn noise(i: usize) -> f32 {
    let mut x = (i as u64).wrapping_mul(0x9e37_79b9_7f4a_7c15).wrapping_add(1);
    x = (x ^ (x >> 30)).wrapping_mul(0xbf58_476d_1ce4_e5b9);
    x = (x ^ (x >> 27)).wrapping_mul(0x94d0_49bb_1331_11eb);
    ((x >> 40) as f32) / (1u32 << 24) as f32
}

fn scene(n: usize) -> Scene {
    let r = |i: usize, k: usize| noise(16 * i + k);
    let mut opacity: Vec<f32> = (0..n).map(|i| r(i, 10)).collect();
    if n > 2 {
        (opacity[0], opacity[1]) = (0.0, 1.0);
    }
    Scene {
        gaussians: Gaussians {
            mean: (0..n).map(|i| [0, 1, 2].map(|k| 200.0 * (r(i, k) - 0.5))).collect(),
            scale: (0..n).map(|i| [3, 4, 5].map(|k| 1e-3 + r(i, k))).collect(),
            quat: (0..n).map(|i| [6, 7, 8, 9].map(|k| r(i, k) - 0.3)).collect(),
            opacity,
            colour: (0..n).map(|i| [11, 12, 13].map(|k| 1.2 * r(i, k) - 0.1)).collect(),
        },
        v_fwd: (0..n).map(|i| [14, 15, 16].map(|k| 40.0 * (r(i, k) - 0.5))).collect(),
        v_bwd: (0..n).map(|i| [17, 18, 19].map(|k| 40.0 * (r(i, k) - 0.5))).collect(),
        dynamic: (0..n).map(|i| r(i, 20)).collect(),
        source: (0..n).map(|i| i as u32 % 3).collect(),
        frames: (0..3)
            .map(|i| SceneFrame {
                time: 0.1 * i as f64,
                camera: camera(i),
                source_size: (640, 360),
                name: format!("frame \"{i}\" ü.jpg"),
            })
            .collect(),
        compose: Compose {
            window: 2,
            own: SelfRule::Neighbours,
            extrapolate: Extrapolate::Direct,
            split: Split::Soft,
            tau: 0.3,
        },
        splat: SplatSettings { aa: true, a_max: 0.99, eps2d: 0.1, near: 0.2 },
        notes: vec![("model".into(), "nano".into()), ("model".into(), "twice".into())],
    }
}

#[test]
fn a_scene_round_trips_within_a_millionth() {
    let dir = tempfile::tempdir().unwrap();
    let folder = dir.path().join("scene");
    let s = scene(2000);
    s.save(&folder, Overwrite::No).unwrap();
    let (t, report) = Scene::load(&folder).unwrap();
    assert_eq!(report, LoadReport { total: 2000, ..LoadReport::default() });
    assert_eq!(t.frames, s.frames);
    assert_eq!((t.compose, t.splat, &t.notes), (s.compose, s.splat, &s.notes));
    // Stored as they are: the same bits.
    assert_eq!(t.gaussians.mean, s.gaussians.mean);
    assert_eq!(t.gaussians.quat, s.gaussians.quat);
    assert_eq!((&t.v_fwd, &t.v_bwd), (&s.v_fwd, &s.v_bwd));
    assert_eq!((&t.dynamic, &t.source), (&s.dynamic, &s.source));
    // Stored through a logit, a logarithm, an offset.
    let worst = |a: &[f32], b: &[f32]| a.iter().zip(b).map(|(a, b)| (a - b).abs()).fold(0.0, f32::max);
    assert!(worst(&t.gaussians.opacity, &s.gaussians.opacity) < 1e-6);
    assert!(worst(t.gaussians.scale.as_flattened(), s.gaussians.scale.as_flattened()) < 1e-6);
    assert!(worst(t.gaussians.colour.as_flattened(), s.gaussians.colour.as_flattened()) < 1e-6);
    // Saved again, the bytes are the same but for what the first rounding moved: none here after one
    // more round.
    t.save(&folder, Overwrite::Yes).unwrap();
    assert_eq!(s.save(&folder, Overwrite::No).unwrap_err().status() as i32, 6);
    let (u, _) = Scene::load(&folder).unwrap();
    assert!(worst(&u.gaussians.opacity, &t.gaussians.opacity) < 1e-7);
}

#[test]
fn the_header_is_what_viewers_expect() {
    let dir = tempfile::tempdir().unwrap();
    let path = dir.path().join("x.ply");
    let s = scene(3);
    ply::export_ply(&s.gaussians, &path, Overwrite::No).unwrap();
    let bytes = std::fs::read(&path).unwrap();
    let end = bytes.windows(11).position(|w| w == b"end_header\n").unwrap() + 11;
    let header = std::str::from_utf8(&bytes[..end]).unwrap();
    let names: Vec<&str> = header.lines().filter_map(|l| l.strip_prefix("property float ")).collect();
    let standard = "x y z nx ny nz f_dc_0 f_dc_1 f_dc_2 opacity scale_0 scale_1 scale_2 rot_0 rot_1 rot_2 rot_3";
    assert_eq!(names.join(" "), standard);
    assert!(header.starts_with("ply\nformat binary_little_endian 1.0\n") && header.contains("\nelement vertex 3\n"));
    assert_eq!(bytes.len(), end + 3 * 17 * 4);
    // The third Gaussian by hand.
    let value = |k: usize| f32::from_le_bytes(bytes[end + 2 * 68 + 4 * k..][..4].try_into().unwrap());
    let g = &s.gaussians;
    assert_eq!(value(0), g.mean[2][0]);
    assert!((0.5 + 0.282_094_8 * value(6) - g.colour[2][0]).abs() < 1e-6);
    assert!((1.0 / (1.0 + (-value(9)).exp()) - g.opacity[2]).abs() < 1e-6);
    assert!((value(10).exp() - g.scale[2][0]).abs() < 1e-6);
    assert_eq!(value(13), g.quat[2][0]);
}

#[test]
fn a_sequence_bakes_the_composition() {
    let dir = tempfile::tempdir().unwrap();
    let s = scene(60);
    let rules = Compose::default();
    let n = ply::export_sequence(&s, &rules, &[0.0, 0.05, 0.1], dir.path(), Overwrite::No).unwrap();
    assert_eq!(n, 3);
    let (baked, report) = Scene::load(&dir.path().join("frame_00001.ply")).unwrap();
    assert_eq!(report.dropped(), 0);
    assert_eq!(baked.gaussians.mean, s.at(0.05, &rules).unwrap().mean);
    assert!(baked.frames.is_empty() && baked.dynamic.iter().all(|&p| p == 0.0));
    assert_eq!(
        ply::export_sequence(&s, &rules, &[f64::NAN], dir.path(), Overwrite::Yes).unwrap_err().status() as i32,
        3
    );
}

/// A PLY file of a header and rows of f32.
fn ply_file(dir: &Path, header: &str, rows: &[u8]) -> PathBuf {
    let path = dir.join("t.ply");
    let mut bytes = header.as_bytes().to_vec();
    bytes.extend(rows);
    std::fs::write(&path, bytes).unwrap();
    path
}

const NAMES: &str = "x y z f_dc_0 f_dc_1 f_dc_2 opacity scale_0 scale_1 scale_2 rot_0 rot_1 rot_2 rot_3";
const GOOD: [f32; 14] = [1.0, 2.0, 3.0, 0.0, 0.0, 0.0, 0.0, -2.0, -2.0, -2.0, 1.0, 0.0, 0.0, 0.0];

fn header(count: impl std::fmt::Display, names: &str) -> String {
    let list: String = names.split(' ').map(|n| format!("property float {n}\n")).collect();
    format!("ply\nformat binary_little_endian 1.0\nelement vertex {count}\n{list}end_header\n")
}

/// Loads 199 good rows and one with `changes`; gives what became of it.
fn with_row(changes: &[(usize, f32)]) -> (Scene, LoadReport) {
    let dir = tempfile::tempdir().unwrap();
    let mut bad = GOOD;
    changes.iter().for_each(|&(i, v)| bad[i] = v);
    let rows: Vec<u8> = [bad].iter().chain(&[GOOD; 199]).flatten().flat_map(|v| v.to_le_bytes()).collect();
    Scene::load(&ply_file(dir.path(), &header(200, NAMES), &rows)).unwrap()
}

#[test]
fn s04_nan_and_infinity_are_dropped_and_counted() {
    for field in 0..14 {
        for v in [f32::NAN, f32::INFINITY, f32::NEG_INFINITY] {
            let (s, report) = with_row(&[(field, v)]);
            assert_eq!((s.len(), report.not_finite, report.total), (199, 1, 200), "{field} {v}");
            assert!(!report.degraded);
        }
    }
    // 3 of 200 are more than 1 %.
    let dir = tempfile::tempdir().unwrap();
    let mut rows = [GOOD; 200];
    rows[..3].iter_mut().for_each(|r| r[0] = f32::NAN);
    let bytes: Vec<u8> = rows.iter().flatten().flat_map(|v| v.to_le_bytes()).collect();
    let (s, report) = Scene::load(&ply_file(dir.path(), &header(200, NAMES), &bytes)).unwrap();
    assert!(report.degraded && s.len() == 197);
}

#[test]
fn s05_absurd_scales_are_dropped() {
    for log in [-200.0, 90.0, 40.0, f32::MIN, f32::MAX] {
        let (s, report) = with_row(&[(8, log)]);
        assert_eq!((s.len(), report.bad_scale), (199, 1), "{log}");
    }
    assert_eq!(with_row(&[(8, -20.0), (9, 13.0)]).0.len(), 200);
}

#[test]
fn s06_zero_rotations_are_dropped() {
    let (s, report) = with_row(&[(10, 0.0)]);
    assert_eq!((s.len(), report.zero_rotation), (199, 1));
    let (s, report) = with_row(&[(10, 1e-30)]);
    assert_eq!((s.len(), report.zero_rotation), (199, 1));
    assert_eq!(with_row(&[(10, f32::MAX)]).1.zero_rotation, 1);
    assert_eq!(with_row(&[(10, -7.0)]).0.len(), 200);
}

#[test]
fn s07_opacity_stays_between_nothing_and_one() {
    for (logit, want) in [(-1e30, 0.0), (1e30, 1.0), (-100.0, 0.0), (100.0, 1.0), (0.0, 0.5)] {
        let (s, report) = with_row(&[(6, logit)]);
        assert_eq!(report.dropped(), 0);
        assert!((s.gaussians.opacity[0] - want).abs() < 1e-6 && (0.0..=1.0).contains(&s.gaussians.opacity[0]));
    }
}

#[test]
fn other_writers_files_are_read() {
    let dir = tempfile::tempdir().unwrap();
    // Another order, doubles, a flag and harmonics in between, another element in front and a face list
    // behind.
    let header = "ply\r\nformat binary_little_endian 1.0\r\ncomment by hand\r\nobj_info none\r\n\
        element chunk 2\r\nproperty ushort q\r\n\
        element vertex 1\r\nproperty double y\r\nproperty double x\r\nproperty float z\r\nproperty uchar flag\r\n\
        property float f_rest_0\r\nproperty float rot_3\r\nproperty float rot_2\r\nproperty float rot_1\r\n\
        property float rot_0\r\nproperty float scale_0\r\nproperty float scale_1\r\nproperty float scale_2\r\n\
        property float opacity\r\nproperty float f_dc_0\r\nproperty float f_dc_1\r\nproperty float f_dc_2\r\n\
        element face 1\r\nproperty list uchar int vertex_indices\r\nend_header\r\n";
    let mut rows = vec![9u8; 4];
    rows.extend(2.0f64.to_le_bytes());
    rows.extend(1.0f64.to_le_bytes());
    rows.extend(3.0f32.to_le_bytes());
    rows.push(255);
    for v in [9.0f32, 0.4, 0.3, 0.2, 0.1, -1.0, -2.0, -3.0, 0.0, 1.0, 0.0, -1.0] {
        rows.extend(v.to_le_bytes());
    }
    rows.extend([3, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0]);
    let (s, report) = Scene::load(&ply_file(dir.path(), header, &rows)).unwrap();
    assert_eq!(s.gaussians.mean, [[1.0, 2.0, 3.0]]);
    assert_eq!(s.gaussians.quat, [[0.1, 0.2, 0.3, 0.4]]);
    assert!((s.gaussians.scale[0][2] - (-3.0f32).exp()).abs() < 1e-6);
    assert!((s.gaussians.colour[0][2] - (0.5 - 0.282_094_8)).abs() < 1e-6);
    assert!(report.notes.iter().any(|n| n.contains("f_rest")));
}

/// Status and line of a refusal.
fn refused(path: &Path) -> (i32, String) {
    let e = Scene::load(path).expect_err("accepted");
    (e.status() as i32, e.line())
}

#[test]
fn s10_the_count_is_checked_against_the_file_before_memory_is_taken() {
    let dir = tempfile::tempdir().unwrap();
    let rows: Vec<u8> = GOOD.iter().flat_map(|v| v.to_le_bytes()).collect();
    for count in ["4294967296", "4294967295", "2", "0", "18446744073709551615", "18446744073709551616", "-1", "1e3"] {
        let (status, line) = refused(&ply_file(dir.path(), &header(count, NAMES), &rows));
        assert_eq!(status, 3, "{count}: {line}");
    }
    let (status, _) = refused(&ply_file(dir.path(), &header(1, NAMES), &rows[..55]));
    assert_eq!(status, 3);
    assert!(Scene::load(&ply_file(dir.path(), &header(1, NAMES), &rows)).is_ok());
    assert!(Scene::load(&ply_file(dir.path(), &header(0, NAMES), &[])).unwrap().0.is_empty());
}

#[test]
fn other_ply_files_are_named() {
    let dir = tempfile::tempdir().unwrap();
    let good = header(1, NAMES);
    let rows: Vec<u8> = GOOD.iter().flat_map(|v| v.to_le_bytes()).collect();
    for (from, to, status, word) in [
        ("binary_little_endian", "ascii", 7, "ascii"),
        ("binary_little_endian", "binary_big_endian", 7, "big_endian"),
        ("property float opacity", "property float alpha", 7, "'opacity'"),
        ("property float x", "property list uchar float x", 7, "list"),
        ("property float x", "property quad x", 3, "property quad x"),
        ("property float y", "property float x", 3, "property float x"),
        ("property float x", "property float packed_position", 7, "compressed"),
        ("element vertex", "element point", 3, "vertex"),
        ("format binary_little_endian 1.0\n", "", 3, "format"),
        ("ply\n", "ply2\n", 3, "'ply'"),
        ("end_header\n", "", 3, ""),
    ] {
        let (got, line) = refused(&ply_file(dir.path(), &good.replacen(from, to, 1), &rows));
        assert!(got == status && line.contains(word), "{from} -> {to}: {got} {line}");
    }
    let long = format!("ply\ncomment {}\n", "x".repeat(1 << 20));
    assert_eq!(refused(&ply_file(dir.path(), &long, &[])).0, 3);
    assert_eq!(refused(&dir.path().join("absent.ply")).0, 6);
}

#[test]
fn a_scene_that_contradicts_itself_is_refused() {
    let dir = tempfile::tempdir().unwrap();
    let folder = dir.path().join("scene");
    scene(10).save(&folder, Overwrite::No).unwrap();
    let json = folder.join("scene.json");
    let good = std::fs::read_to_string(&json).unwrap();
    for (from, to, status, word) in [
        ("\"gaussians\": 10", "\"gaussians\": 11", 3, "11"),
        ("streetforward.scene/1", "streetforward.scene/2", 7, "schema"),
        ("\"own\": \"neighbours\"", "\"own\": \"nobody\"", 3, "nobody"),
        ("\"window\": 2", "\"window\": 0", 3, "window"),
        ("\"near\": 0.2", "\"near\": -1", 3, "near"),
        ("\"width\": 252", "\"width\": 0", 3, "no pixels"),
        ("\"width\": 252", "\"width\": 65536", 5, "16384"),
        ("\"fx\": 210.5", "\"fx\": -1", 3, "fx"),
        ("\"time\": 0.1", "\"time\": -0.1", 3, "ascend"),
        ("\"aa\": true", "\"aa\": 1", 3, "aa"),
        ("\"schema\"", "\"frames\"", 3, "twice"),
    ] {
        let text = good.replacen(from, to, 1);
        assert_ne!(text, good, "{from}");
        std::fs::write(&json, text).unwrap();
        let (got, line) = refused(&folder);
        assert!(got == status && line.contains(word), "{from} -> {to}: {got} {line}");
    }
    // A source frame that the cameras do not have.
    let fewer = scene(10);
    let two = Scene { frames: fewer.frames[..2].to_vec(), ..fewer };
    two.save(&folder, Overwrite::Yes).unwrap();
    let (s, report) = Scene::load(&folder).unwrap();
    assert_eq!((report.bad_source, s.len()), (3, 7));
    assert!(report.degraded);
}

#[test]
fn s15_values_that_are_not_finite_are_never_written() {
    let dir = tempfile::tempdir().unwrap();
    type Break = fn(&mut Scene);
    let breaks: [Break; 5] = [
        |s| s.gaussians.mean[1][2] = f32::NAN,
        |s| s.gaussians.scale[1][0] = 0.0,
        |s| s.gaussians.opacity[1] = f32::INFINITY,
        |s| s.v_bwd[1][1] = f32::NAN,
        |s| s.dynamic[1] = f32::NAN,
    ];
    for (i, change) in breaks.iter().enumerate() {
        let mut s = scene(3);
        change(&mut s);
        let folder = dir.path().join(i.to_string());
        assert_eq!(s.save(&folder, Overwrite::No).unwrap_err().status() as i32, 9);
        assert_eq!(std::fs::read_dir(&folder).unwrap().count(), 0);
    }
}

fn path_json(camera: &str) -> String {
    format!("[{{\"time\": 0.5, {camera}}}]")
}

const EYE: &str = "\"camera_to_world\": [[1,0,0,0],[0,1,0,0],[0,0,1,0],[0,0,0,1]]";
const LENS: &str = "\"width\": 64, \"height\": 48, \"fx\": 50, \"fy\": 50, \"cx\": 32, \"cy\": 24";

/// Status of a camera path.
fn camera_status(text: &str) -> i32 {
    camera_json::parse(text.as_bytes(), "cams.json").map_or_else(|e| e.status() as i32, |_| 0)
}

#[test]
fn camera_paths_round_trip_and_take_every_lens() {
    let dir = tempfile::tempdir().unwrap();
    let path = dir.path().join("cams.json");
    let cameras: Vec<TimedCamera> = (0..3).map(|i| TimedCamera { time: 0.1 * i as f64, camera: camera(i) }).collect();
    camera_json::write(&path, &cameras, Overwrite::No).unwrap();
    assert_eq!(camera_json::read(&path).unwrap(), cameras);
    let k = "\"width\": 64, \"height\": 48, \"K\": [[50,0,32],[0,50,24],[0,0,1]]";
    let fov = "\"width\": 64, \"height\": 48, \"fov_deg\": 65.2384";
    let read = |lens: &str| camera_json::parse(path_json(&format!("{lens}, {EYE}")).as_bytes(), "x").unwrap()[0];
    assert_eq!(read(LENS), read(k));
    assert!((read(fov).camera.k.fx - 50.0).abs() < 1e-4 && read(fov).camera.k.cy == 24.0);
}

#[test]
fn s01_singular_lenses_are_refused() {
    for bad in ["0", "-50", "1e30", "null", "\"50\"", "NaN", "1e999"] {
        let lens = LENS.replace("\"fx\": 50", &format!("\"fx\": {bad}"));
        assert_eq!(camera_status(&path_json(&format!("{lens}, {EYE}"))), 3, "{bad}");
    }
    for k in ["[[50,1,32],[0,50,24],[0,0,1]]", "[[50,0,32],[0,50,24],[0,0,2]]", "[[50,0,32],[0,50,24]]", "7"] {
        let lens = format!("\"width\": 64, \"height\": 48, \"K\": {k}");
        assert_eq!(camera_status(&path_json(&format!("{lens}, {EYE}"))), 3, "{k}");
    }
    for fov in ["0", "180", "-5", "1e9"] {
        let lens = format!("\"width\": 64, \"height\": 48, \"fov_deg\": {fov}");
        assert_eq!(camera_status(&path_json(&format!("{lens}, {EYE}"))), 3, "{fov}");
    }
}

#[test]
fn s02_poses_that_are_not_rigid_are_refused() {
    for m in [
        "[[-1,0,0,0],[0,1,0,0],[0,0,1,0],[0,0,0,1]]",
        "[[2,0,0,0],[0,2,0,0],[0,0,2,0],[0,0,0,1]]",
        "[[1,0.01,0,0],[0,1,0,0],[0,0,1,0],[0,0,0,1]]",
        "[[0,0,0,0],[0,0,0,0],[0,0,0,0],[0,0,0,1]]",
        "[[1,0,0],[0,1,0],[0,0,1]]",
        "[[1,0,0,0],[0,1,0,0],[0,0,1,0]]",
        "[[1,0,0,\"0\"],[0,1,0,0],[0,0,1,0],[0,0,0,1]]",
    ] {
        assert_eq!(camera_status(&path_json(&format!("{LENS}, \"camera_to_world\": {m}"))), 3, "{m}");
    }
    // Within the tolerance of a thousandth.
    let near = "[[1.0001,0,0,0],[0,1,0,0],[0,0,1,0],[0,0,0,1]]";
    assert_eq!(camera_status(&path_json(&format!("{LENS}, \"camera_to_world\": {near}"))), 0);
}

#[test]
fn s03_bottom_row_and_far_centres_are_refused() {
    for m in [
        "[[1,0,0,0],[0,1,0,0],[0,0,1,0],[0,0,1,1]]",
        "[[1,0,0,0],[0,1,0,0],[0,0,1,0],[0,0,0,0]]",
        "[[1,0,0,1e30],[0,1,0,0],[0,0,1,0],[0,0,0,1]]",
    ] {
        assert_eq!(camera_status(&path_json(&format!("{LENS}, \"camera_to_world\": {m}"))), 3, "{m}");
    }
}

#[test]
fn s12_picture_sizes_are_judged() {
    for (w, status) in [("0", 3), ("1", 0), ("65536", 5), ("4294967296", 3), ("-4", 3), ("1.5", 3)] {
        let lens = LENS.replace("\"width\": 64", &format!("\"width\": {w}"));
        assert_eq!(camera_status(&path_json(&format!("{lens}, {EYE}"))), status, "{w}");
    }
}

#[test]
fn s14_times_that_are_none_are_refused() {
    for time in ["NaN", "1e13", "null", "\"0\"", "1e999"] {
        let text = path_json(&format!("{LENS}, {EYE}")).replace("0.5", time);
        assert_eq!(camera_status(&text), 3, "{time}");
    }
    assert_eq!(camera_status(&format!("[{{{LENS}, {EYE}}}]")), 3);
    assert_eq!(scene(3).at(f64::INFINITY, &Compose::default()).unwrap_err().status() as i32, 3);
    assert_eq!(camera_status("[]"), 3);
    assert_eq!(camera_status("{\"schema\": \"other/1\", \"cameras\": []}"), 7);
}

#[test]
fn poses_are_exported_at_the_source_size() {
    let dir = tempfile::tempdir().unwrap();
    let views = poses_io::views(&scene(3));
    assert_eq!((views[0].camera.width, views[0].camera.height), (640, 360));
    for format in PoseFormat::ALL {
        let files = poses_io::export(&views, format, &dir.path().join(format.name()), Overwrite::No).unwrap();
        assert!(files.iter().all(|f| f.is_file()));
    }
    let colmap = std::fs::read_to_string(dir.path().join("colmap/cameras.txt")).unwrap();
    assert!(colmap.lines().last().unwrap().starts_with("1 PINHOLE 640 360 "));
    // The file the product itself reads brings back the same cameras.
    let t = sf_formats::transforms::Transforms::read(&dir.path().join("nerfstudio/transforms.json")).unwrap();
    for (a, b) in t.frames.iter().zip(&views) {
        assert_eq!((a.pose, a.time), (Some(b.camera.pose), Some(b.time)));
        assert_eq!(t.lens.unwrap().at((640, 360)), b.camera.k);
    }
}
