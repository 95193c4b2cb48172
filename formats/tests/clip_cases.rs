//! Clips: every source, and every bad one that must be refused.

use glam::{DMat3, DVec3};
use sf_formats::atomic::Overwrite;
use sf_formats::clip::{Clip, ClipFrame, ClipOptions, ClipWriter, GroundTruth, TruthFrame};
use sf_formats::image_io::{self, Rgb8};
use sf_formats::{Camera, Intrinsics, Pose};
use std::path::Path;

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

#[test]
fn i13_no_frames_is_a_usage_error() {
    let dir = tempfile::tempdir().unwrap();
    std::fs::write(dir.path().join("notes.md"), "x").unwrap();
    let e = Clip::open(dir.path(), &ClipOptions::default()).unwrap_err();
    assert_eq!(e.status() as i32, 2);
    image_io::write_png(&dir.path().join("1.png"), &picture(0, 20, 20), Overwrite::No).unwrap();
    assert_eq!(Clip::open(dir.path(), &ClipOptions::default()).unwrap().frames.len(), 1);
}
