//! Clips: every source, and every bad one that must be refused.

use glam::{DMat3, DVec3};
use sf_formats::atomic::Overwrite;
use sf_formats::clip::{Clip, ClipFrame, ClipOptions, ClipWriter, GroundTruth, MixedSizes, TruthFrame};
use sf_formats::image_io::{self, Rgb8};
use sf_formats::{Camera, Intrinsics, Pose, npy};
use std::path::{Path, PathBuf};

/// The cases this file covers.
pub const COVERED: [&str; 10] = ["I01", "I02", "I04", "I12", "I13", "I14", "I16", "I17", "I20", "I21"];

/// A picture whose pixels tell its number.
fn picture(n: u8, width: u32, height: u32) -> Rgb8 {
    let data = (0..width * height).flat_map(|i| [n, (i % 251) as u8, (i / width) as u8]).collect();
    Rgb8::new(width, height, data)
}

fn camera(i: usize) -> Camera {
    Camera {
        width: 28,
        height: 20,
        k: Intrinsics { fx: 25.0, fy: 24.0, cx: 14.25, cy: 9.75 },
        pose: Pose { r: DMat3::from_rotation_y(0.1 * i as f64), t: DVec3::new(0.5, -0.25, i as f64) },
    }
}

fn write_clip(folder: &Path, frames: usize) -> Vec<TruthFrame> {
    let writer = ClipWriter::create(folder, Overwrite::No).unwrap();
    let truth: Vec<TruthFrame> = (0..frames)
        .map(|i| TruthFrame {
            width: 28,
            height: 20,
            depth: (0..560).map(|p| (p + i) as f32 * 0.125).collect(),
            velocity: Some((0..560).map(|p| [p as f32, -1.5, i as f32]).collect()),
            dynamic: Some((0..560).map(|p| p % 7 == i).collect()),
        })
        .collect();
    // Backwards: the order of writing does not matter.
    for i in (0..frames).rev() {
        let image = picture(i as u8, 28, 20);
        let frame = ClipFrame { image: &image, camera: camera(i), time: i as f64 * 0.125, truth: Some(&truth[i]) };
        writer.frame(i, &frame).unwrap();
    }
    writer.finish().unwrap();
    truth
}

#[test]
fn a_written_clip_reads_back_exactly() {
    let dir = tempfile::tempdir().unwrap();
    let folder = dir.path().join("clip");
    let truth = write_clip(&folder, 12);
    let options = ClipOptions { frames: Some(vec![0, 2, 10, 11]), ..ClipOptions::default() };
    let clip = Clip::open(&folder, &options).unwrap();
    assert_eq!((clip.total, clip.frames.len()), (12, 4));
    assert_eq!(clip.times(), [0.0, 0.25, 1.25, 1.375]);
    assert_eq!(clip.intrinsics, Some(camera(0).k));
    for (frame, &i) in clip.frames.iter().zip(&clip.indices) {
        assert_eq!(frame.image, picture(i as u8, 28, 20));
        assert_eq!(frame.name, format!("{i:06}.png"));
    }
    for (pose, &i) in clip.poses.as_ref().unwrap().iter().zip(&clip.indices) {
        assert_eq!(*pose, camera(i).pose);
    }
    let relative = clip.relative_poses().unwrap();
    assert!((relative[1].t - DVec3::new(0.0, 0.0, 2.0)).length() < 1e-12);
    let loaded = GroundTruth::load(&clip.folder, &clip.indices).unwrap().unwrap();
    for (t, &i) in loaded.frames.iter().zip(&clip.indices) {
        assert_eq!(*t, truth[i]);
    }
    // The same frames as a bare folder: natural order, assumed rate, no truth about cameras.
    std::fs::remove_file(folder.join("transforms.json")).unwrap();
    let bare = Clip::open(&folder, &options).unwrap();
    assert_eq!(bare.times(), [0.0, 0.2, 1.0, 1.1]);
    assert!(bare.intrinsics.is_none() && bare.poses.is_none());
    assert_eq!(bare.frames[2].image, clip.frames[2].image);
}

/// Status and line of a refusal.
fn refused(path: &Path, options: &ClipOptions) -> (i32, String) {
    let e = Clip::open(path, options).expect_err("accepted");
    (e.status() as i32, e.line())
}

/// A folder of `sizes.len()` pictures `0.png`, `1.png`, ...
fn pictures(folder: &Path, sizes: &[(u32, u32)]) {
    for (i, &(w, h)) in sizes.iter().enumerate() {
        image_io::write_png(&folder.join(format!("{i}.png")), &picture(i as u8, w, h), Overwrite::Yes).unwrap();
    }
}

fn open(path: &Path) -> Clip {
    Clip::open(path, &ClipOptions::default()).unwrap()
}

#[test]
fn i01_a_damaged_frame_is_named_and_only_matters_when_selected() {
    let dir = tempfile::tempdir().unwrap();
    pictures(dir.path(), &[(20, 20); 3]);
    let whole = std::fs::read(dir.path().join("1.png")).unwrap();
    std::fs::write(dir.path().join("1.png"), &whole[..whole.len() / 2]).unwrap();
    let (status, line) = refused(dir.path(), &ClipOptions::default());
    assert!(status == 3 && line.starts_with("frame 1 (") && line.contains("1.png"), "{line}");
    let options = ClipOptions { frames: Some(vec![0, 2]), ..ClipOptions::default() };
    assert_eq!(Clip::open(dir.path(), &options).unwrap().indices, [0, 2]);
}

#[test]
fn i02_i04_small_and_narrow_frames_are_refused() {
    let dir = tempfile::tempdir().unwrap();
    for (size, word) in
        [((1, 1), "at least 14"), ((13, 200), "at least 14"), ((14, 225), "16 times"), ((1, 30_000), "14")]
    {
        pictures(dir.path(), &[size]);
        let (status, line) = refused(dir.path(), &ClipOptions::default());
        assert!(status == 3 && line.contains(word), "{size:?}: {line}");
    }
    pictures(dir.path(), &[(14, 224)]);
    assert_eq!(open(dir.path()).frames[0].image.size(), (14, 224));
}

#[test]
fn i12_frames_of_different_sizes_need_permission() {
    let dir = tempfile::tempdir().unwrap();
    pictures(dir.path(), &[(20, 20), (20, 20), (40, 20)]);
    let (status, line) = refused(dir.path(), &ClipOptions::default());
    assert!(status == 3 && line.starts_with("frame 2 (") && line.contains("--resize"), "{line}");
    let options = ClipOptions { mixed_sizes: MixedSizes::Allow, ..ClipOptions::default() };
    assert_eq!(Clip::open(dir.path(), &options).unwrap().frames[2].image.size(), (40, 20));
}

#[test]
fn i13_no_frames_is_a_usage_error() {
    let dir = tempfile::tempdir().unwrap();
    std::fs::write(dir.path().join("notes.md"), "x").unwrap();
    std::fs::write(dir.path().join("._0.png"), "resource fork").unwrap();
    std::fs::create_dir(dir.path().join("folder.png")).unwrap();
    assert_eq!(refused(dir.path(), &ClipOptions::default()).0, 2);
    pictures(dir.path(), &[(20, 20); 4]);
    for (frames, word) in
        [(vec![], "no frame"), (vec![4], "frames 0 to 3"), (vec![1, 1], "ascend"), (vec![2, 0], "ascend")]
    {
        let (status, line) = refused(dir.path(), &ClipOptions { frames: Some(frames), ..ClipOptions::default() });
        assert!(status == 2 && line.contains(word), "{line}");
    }
    assert_eq!(refused(&dir.path().join("absent"), &ClipOptions::default()).0, 6);
}

#[test]
fn i14_i17_one_frame_and_equal_frames_are_clips() {
    let dir = tempfile::tempdir().unwrap();
    pictures(dir.path(), &[(20, 20)]);
    let one = open(&dir.path().join("0.png"));
    assert_eq!((one.frames.len(), one.total, one.times()), (1, 1, vec![0.0]));
    assert_eq!(one.frames[0].image, open(dir.path()).frames[0].image);
    for (i, value) in [0u8, 0, 255].into_iter().enumerate() {
        let image = Rgb8::new(20, 20, vec![value; 1200]);
        image_io::write_png(&dir.path().join(format!("{i}.png")), &image, Overwrite::Yes).unwrap();
    }
    assert_eq!(open(dir.path()).frames.len(), 3);
}

#[test]
fn i16_more_frames_than_allowed_is_a_resource_error() {
    let dir = tempfile::tempdir().unwrap();
    // Not one of them is read.
    (0..1000).for_each(|i| std::fs::write(dir.path().join(format!("{i}.png")), "").unwrap());
    let (status, line) = refused(dir.path(), &ClipOptions::default());
    assert!(status == 5 && line.contains("1000 frames") && line.contains("512"), "{line}");
}

#[test]
fn i20_times_must_ascend_by_sensible_steps() {
    let dir = tempfile::tempdir().unwrap();
    pictures(dir.path(), &[(20, 20); 3]);
    let with = |times: &[f64]| ClipOptions { times: Some(times.to_vec()), ..ClipOptions::default() };
    for bad in [
        &[0.0, 0.1][..],
        &[0.0, 0.1, 0.1],
        &[0.0, 0.1, 0.05],
        &[0.0, 0.1, f64::NAN],
        &[0.0, 0.1, f64::INFINITY],
        &[0.0, 0.1, 1e18],
        &[1e18, 2e18, 3e18],
        &[0.0, 0.1, 10.1],
        &[0.0, 0.1, 0.10005],
    ] {
        let (status, line) = refused(dir.path(), &with(bad));
        assert_eq!(status, 3, "{bad:?}: {line}");
    }
    assert_eq!(Clip::open(dir.path(), &with(&[-1.0, 0.0, 0.5])).unwrap().times(), [-1.0, 0.0, 0.5]);
    // Times of all frames, or of the selected ones.
    for times in [&[5.0, 6.0, 7.5][..], &[5.0, 7.5]] {
        let options = ClipOptions { frames: Some(vec![0, 2]), ..with(times) };
        assert_eq!(Clip::open(dir.path(), &options).unwrap().times(), [5.0, 7.5]);
    }
    for (fps, status) in [(0.05, 3), (2e4, 3), (0.0, 2), (-1.0, 2), (f64::NAN, 2), (f64::INFINITY, 2)] {
        assert_eq!(refused(dir.path(), &ClipOptions { fps: Some(fps), ..ClipOptions::default() }).0, status, "{fps}");
    }
    let options = ClipOptions { fps: Some(12.5), ..ClipOptions::default() };
    assert_eq!(Clip::open(dir.path(), &options).unwrap().times(), [0.0, 0.08, 0.16]);
    assert!(open(dir.path()).notes[0].contains("10 frames per second"));
}

#[test]
fn i21_file_names_are_bytes() {
    use std::os::unix::ffi::OsStrExt;
    let dir = tempfile::tempdir().unwrap();
    let odd: [&[u8]; 3] = [b"a\n1.png", b"b\xff\xfe2.PNG", &[b"c".repeat(240).as_slice(), b".png"].concat()];
    for (i, name) in odd.iter().enumerate() {
        let path = dir.path().join(std::ffi::OsStr::from_bytes(name));
        image_io::write_png(&dir.path().join("x"), &picture(i as u8, 20, 20), Overwrite::Yes).unwrap();
        std::fs::rename(dir.path().join("x"), path).unwrap();
    }
    let clip = open(dir.path());
    assert_eq!(clip.frames.iter().map(|f| f.image.data[0]).collect::<Vec<_>>(), [0, 1, 2]);
    // A path of 4,096 bytes and more is the system's to refuse, in one short line.
    let long = format!("/{}", "d/".repeat(2500));
    let (status, line) = refused(Path::new(&long), &ClipOptions::default());
    assert!(status == 6 && line.len() <= 300);
}

#[test]
fn lists_give_order_and_times() {
    let dir = tempfile::tempdir().unwrap();
    pictures(dir.path(), &[(20, 20); 3]);
    std::fs::rename(dir.path().join("1.png"), dir.path().join("with space 1.png")).unwrap();
    let list = dir.path().join("images.txt");
    std::fs::write(&list, "# order is mine\r\n2.png 0.5\r\n\r\n  with space 1.png\t0.75  \r\n0.png 1e0").unwrap();
    for path in [list.as_path(), dir.path()] {
        let clip = open(path);
        assert_eq!(clip.times(), [0.5, 0.75, 1.0]);
        assert_eq!(clip.frames.iter().map(|f| f.image.data[0]).collect::<Vec<_>>(), [2, 1, 0]);
    }
    std::fs::write(&list, "0.png\nwith space 1.png\n2.png").unwrap();
    assert_eq!(open(&list).times(), [0.0, 0.1, 0.2]);
    std::fs::write(&list, "0.png 1\nwith space 1.png\n2.png 3").unwrap();
    assert_eq!(refused(&list, &ClipOptions::default()).0, 3);
    std::fs::write(&list, "0.png nan\nabsent.png nan").unwrap();
    assert_eq!(refused(&list, &ClipOptions::default()).0, 3);
    std::fs::write(&list, "absent.png").unwrap();
    assert_eq!(refused(&list, &ClipOptions::default()).0, 6);
    std::fs::write(&list, b"0\0.png").unwrap();
    assert_eq!(refused(&list, &ClipOptions::default()).0, 3);
    std::fs::write(&list, "").unwrap();
    assert_eq!(refused(&list, &ClipOptions::default()).0, 2);
}

const ROOT: &str = r#""fl_x": 30, "fl_y": 31, "cx": 14, "cy": 10, "w": 28, "h": 20"#;
const EYE: &str = "[[1,0,0,0],[0,1,0,0],[0,0,1,0],[0,0,0,1]]";

/// A transforms file over three pictures of 28x20, its frames out of order.
fn transforms(folder: &Path, root: &str, frame_extra: &str) -> PathBuf {
    pictures(folder, &[(28, 20); 3]);
    let frames: Vec<String> = [2, 0, 1]
        .iter()
        .map(|i| format!(r#"{{"file_path": "./{i}.png", "time": 0.{i}, "transform_matrix": {EYE}{frame_extra}}}"#))
        .collect();
    let path = folder.join("transforms.json");
    let comma = if root.is_empty() { "" } else { "," };
    std::fs::write(&path, format!(r#"{{{root}{comma} "frames": [{}]}}"#, frames.join(","))).unwrap();
    path
}

#[test]
fn transforms_give_order_times_lens_and_poses() {
    let dir = tempfile::tempdir().unwrap();
    let path = transforms(dir.path(), ROOT, "");
    let clip = open(&path);
    assert_eq!(clip.times(), [0.0, 0.1, 0.2]);
    assert_eq!(clip.frames.iter().map(|f| f.image.data[0]).collect::<Vec<_>>(), [0, 1, 2]);
    assert_eq!(clip.intrinsics, Some(Intrinsics { fx: 30.0, fy: 31.0, cx: 14.0, cy: 10.0 }));
    assert_eq!(clip.poses.as_ref().unwrap()[0].apply(DVec3::Z), -DVec3::Z);
    // The lens of larger pictures is scaled to these; per frame is as good as for all.
    transforms(dir.path(), r#""fl_x": 60, "fl_y": 62, "cx": 28, "cy": 20, "w": 56, "h": 40"#, "");
    assert_eq!(open(dir.path()).intrinsics, clip.intrinsics);
    transforms(dir.path(), "", &format!(", {ROOT}"));
    assert_eq!(open(dir.path()).intrinsics, clip.intrinsics);
    transforms(dir.path(), r#""camera_angle_x": 1.5707963267948966"#, "");
    let k = open(dir.path()).intrinsics.unwrap();
    assert!((k.fx - 14.0).abs() < 1e-12 && k.fx == k.fy && (k.cx, k.cy) == (14.0, 10.0));
    transforms(dir.path(), &format!(r#"{ROOT}, "k1": 0.1"#), "");
    assert!(open(dir.path()).notes[0].contains("k1"));
    transforms(dir.path(), "", "");
    assert_eq!(open(dir.path()).intrinsics, None);
}

#[test]
fn bad_transforms_are_refused() {
    let dir = tempfile::tempdir().unwrap();
    let path = transforms(dir.path(), ROOT, "");
    let good = std::fs::read_to_string(&path).unwrap();
    let good = good.as_str();
    for (from, to, status, word) in [
        ("./1.png", "../../../1.png", 3, "leaves"),
        ("./1.png", "/etc/passwd", 3, "leaves"),
        ("./1.png", "x/../1.png", 3, "leaves"),
        ("./1.png", "absent.png", 6, "absent.png"),
        ("\"./1.png\"", "7", 3, "file_path"),
        ("\"time\": 0.1", "\"time\": 0.2", 3, "frame 2"),
        ("\"time\": 0.1", "\"time\": \"x\"", 3, "'time'"),
        ("\"time\": 0.1, ", "", 3, "only 2 of 3"),
        ("\"time\": 0.1", "\"time\": 1e400", 3, "JSON"),
        ("[1,0,0,0]", "[-1,0,0,0]", 3, "reflection"),
        ("[1,0,0,0]", "[2,0,0,0]", 3, "orthonormal"),
        ("[1,0,0,0]", "[1,0,0,1e30]", 3, "beyond"),
        ("[0,0,0,1]]", "[0,0,0,2]]", 3, "bottom row"),
        ("[0,0,0,1]]", "[0,0,0,1],[]]", 3, "four rows"),
        ("\"fl_x\": 30", "\"fl_x\": 0", 3, "fx"),
        ("\"fl_x\": 30", "\"fl_x\": null, \"camera_angle_x\": 4", 3, "camera_angle_x"),
        ("\"w\": 28", "\"w\": 65537", 3, "'w'"),
        ("\"frames\"", "\"pictures\"", 3, "frames"),
        ("\"frames\"", "\"w\"", 3, "twice"),
        ("{", "[", 3, "JSON"),
    ] {
        let text = good.replacen(from, to, 1);
        assert_ne!(text, good, "{from}");
        std::fs::write(&path, text).unwrap();
        let (got, line) = refused(&path, &ClipOptions::default());
        assert!(got == status && line.contains(word), "{from} -> {to}: {got} {line}");
    }
    let differ = transforms(dir.path(), "", &format!(", {ROOT}"));
    let text = std::fs::read_to_string(&differ).unwrap();
    let at = text.rfind("\"fl_x\": 30").unwrap();
    std::fs::write(&differ, format!("{}\"fl_x\": 33{}", &text[..at], &text[at + 10..])).unwrap();
    assert_eq!(refused(&differ, &ClipOptions::default()).0, 7);
    std::fs::write(&path, r#"{"frames": []}"#).unwrap();
    assert_eq!(refused(&path, &ClipOptions::default()).0, 2);
}

#[test]
fn the_real_drive_is_read() {
    let drive = Path::new(env!("CARGO_MANIFEST_DIR")).join("../tests/data/drive");
    let options = ClipOptions { fps: Some(12.5), frames: Some(vec![0, 18]), ..ClipOptions::default() };
    let clip = Clip::open(&drive, &options).unwrap();
    assert_eq!((clip.total, clip.frames[1].image.size()), (19, (640, 360)));
    assert_eq!(clip.frames[1].name, "000019.jpg");
    assert!((clip.frames[1].time - 1.44).abs() < 1e-12);
    assert_eq!(GroundTruth::load(&clip.folder, &clip.indices).unwrap(), None);
}

#[test]
fn bad_ground_truth_is_refused() {
    let dir = tempfile::tempdir().unwrap();
    let folder = dir.path().join("clip");
    write_clip(&folder, 2);
    let load = || GroundTruth::load(&folder, &[0, 1]).map_err(|e| (e.status() as i32, e.line()));
    let depth = folder.join("depth/000001.npy");
    let good = std::fs::read(&depth).unwrap();
    assert!(load().is_ok());
    for (shape, value, word) in [
        (vec![560], 1.0, "[height, width]"),
        (vec![20, 28], f32::NAN, "NaN"),
        (vec![20, 28], -1.0, "-1"),
        (vec![28, 20], 1.0, "[28, 20, 3]"),
    ] {
        npy::write_f32(&depth, &shape, &[value; 560], Overwrite::Yes).unwrap();
        let (status, line) = load().unwrap_err();
        assert!(status == 3 && line.contains(word), "{line}");
    }
    std::fs::write(&depth, &good[..good.len() - 1]).unwrap();
    assert_eq!(load().unwrap_err().0, 3);
    std::fs::remove_file(&depth).unwrap();
    assert_eq!(load().unwrap_err().0, 6);
    // Writing into a folder that has something in it needs leave.
    assert_eq!(ClipWriter::create(&folder, Overwrite::No).unwrap_err().status() as i32, 6);
    assert!(ClipWriter::create(&folder, Overwrite::Yes).is_ok());
}
