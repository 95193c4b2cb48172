//! Valid files, damaged at random: reading gives a result or an error of the right kind, never a panic,
//! and an accepted checkpoint can be read to its end.

use proptest::prelude::*;
use sf_formats::atomic::Overwrite;
use sf_formats::transforms::Transforms;
use sf_formats::{Gaussians, Scene, camera_json, checkpoint, image_io, npy, ply};
use std::sync::LazyLock;

/// One change of a file.
#[derive(Clone, Debug)]
enum Change {
    /// Another byte, at a share of the length.
    Set(f64, u8),
    /// Bytes taken out.
    Cut(f64, usize),
    /// Bytes put in.
    Insert(f64, Vec<u8>),
    /// Cut off.
    Truncate(f64),
    /// A run of digits replaced by another number.
    Number(f64, &'static str),
}

fn change() -> impl Strategy<Value = Change> {
    let numbers = prop::sample::select(vec![
        "0",
        "-1",
        "1",
        "2",
        "65536",
        "4294967296",
        "18446744073709551615",
        "18446744073709551616",
        "1e300",
        "1e999",
        "0.5",
        "9007199254740993",
        "",
    ]);
    prop_oneof![
        (0.0..1.0, any::<u8>()).prop_map(|(at, b)| Change::Set(at, b)),
        (0.0..1.0, 1usize..40).prop_map(|(at, n)| Change::Cut(at, n)),
        (0.0..1.0, prop::collection::vec(any::<u8>(), 1..20)).prop_map(|(at, b)| Change::Insert(at, b)),
        (0.0..1.0).prop_map(Change::Truncate),
        (0.0..1.0, numbers).prop_map(|(at, n)| Change::Number(at, n)),
    ]
}

/// The file after some changes, each meant for its first `focus` bytes (headers matter most).
fn damaged(file: &[u8], focus: usize, changes: &[Change]) -> Vec<u8> {
    let mut bytes = file.to_vec();
    for change in changes {
        let place = |at: f64, len: usize| ((len.min(focus)) as f64 * at) as usize;
        let len = bytes.len();
        match change {
            Change::Set(at, b) => {
                if let Some(old) = bytes.get_mut(place(*at, len)) {
                    *old = *b;
                }
            }
            Change::Cut(at, n) => {
                let from = place(*at, len);
                bytes.drain(from..(from + n).min(len));
            }
            Change::Insert(at, b) => {
                let from = place(*at, len);
                bytes.splice(from..from, b.iter().copied());
            }
            Change::Truncate(at) => bytes.truncate((len as f64 * at) as usize),
            Change::Number(at, text) => {
                let from = place(*at, len);
                if let Some(start) = bytes[from..].iter().position(u8::is_ascii_digit) {
                    let start = from + start;
                    let end = start + bytes[start..].iter().take_while(|b| b.is_ascii_digit()).count();
                    bytes.splice(start..end, text.bytes());
                }
            }
        }
    }
    bytes
}

fn changes() -> impl Strategy<Value = Vec<Change>> {
    prop::collection::vec(change(), 1..5)
}

static SAFETENSORS: LazyLock<Vec<u8>> = LazyLock::new(|| {
    let header = r#"{"__metadata__":{"k":"v"},"a.weight":{"dtype":"F32","shape":[2,3],"data_offsets":[0,24]},"b":{"dtype":"F16","shape":[2],"data_offsets":[24,28]},"n":{"dtype":"I64","shape":[],"data_offsets":[28,36]}}"#;
    let mut file = (header.len() as u64).to_le_bytes().to_vec();
    file.extend(header.as_bytes());
    file.extend((0..36).map(|i| i as u8));
    file
});

static ARRAY: LazyLock<Vec<u8>> = LazyLock::new(|| {
    let dir = tempfile::tempdir().unwrap();
    let path = dir.path().join("a.npy");
    npy::write_f32(&path, &[4, 6], &[1.0; 24], Overwrite::No).unwrap();
    std::fs::read(path).unwrap()
});

static SPLATS: LazyLock<Vec<u8>> = LazyLock::new(|| {
    let dir = tempfile::tempdir().unwrap();
    let path = dir.path().join("a.ply");
    let g = Gaussians {
        mean: vec![[1.0, 2.0, 3.0]; 9],
        scale: vec![[0.1; 3]; 9],
        quat: vec![[1.0, 0.0, 0.0, 0.0]; 9],
        opacity: vec![0.5; 9],
        colour: vec![[0.5; 3]; 9],
    };
    ply::export_ply(&g, &path, Overwrite::No).unwrap();
    std::fs::read(path).unwrap()
});

const TRANSFORMS: &str = r#"{"camera_model": "OPENCV", "fl_x": 30.5, "fl_y": 31, "cx": 14, "cy": 10, "w": 28, "h": 20,
"frames": [{"file_path": "a/0.png", "time": 0.0, "transform_matrix": [[1,0,0,0.5],[0,1,0,0],[0,0,1,-2],[0,0,0,1]]},
{"file_path": "a/1.png", "time": 0.1, "transform_matrix": [[1,0,0,0.75],[0,1,0,0],[0,0,1,-2.5],[0,0,0,1]]}]}"#;

const CAMERAS: &str = r#"{"schema": "streetforward.cameras/1", "cameras": [{"time": 0.5, "width": 64, "height": 48,
"fx": 50, "fy": 50.5, "cx": 32, "cy": 24, "camera_to_world": [[1,0,0,0],[0,1,0,0],[0,0,1,0],[0,0,0,1]]},
{"time": 1, "width": 64, "height": 48, "fov_deg": 60, "camera_to_world": [[1,0,0,0],[0,1,0,0],[0,0,1,0],[0,0,0,1]]}]}"#;

fn picture(name: &str) -> Vec<u8> {
    std::fs::read(std::path::Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/data").join(name)).unwrap()
}

static PNG: LazyLock<Vec<u8>> =
    LazyLock::new(|| image_io::encode_png(&image_io::Rgb8::new(9, 7, (0..189).map(|i| i as u8).collect())).unwrap());
static JPEGS: LazyLock<[Vec<u8>; 3]> = LazyLock::new(|| ["baseline.jpg", "progressive.jpg", "gray.jpg"].map(picture));

/// Whether a result is fine or an error with one of the given statuses and a good line.
fn judged<T>(result: sf_formats::Result<T>, statuses: &[i32]) -> Option<T> {
    match result {
        Ok(v) => Some(v),
        Err(e) => {
            assert!(statuses.contains(&(e.status() as i32)), "{:?}: {}", e.status(), e.line());
            assert!(e.line().len() <= 300 && !e.line().chars().any(char::is_control));
            None
        }
    }
}

proptest! {
    #![proptest_config(ProptestConfig { cases: 400, failure_persistence: None, ..ProptestConfig::default() })]

    #[test]
    fn safetensors(changes in changes(), focus in prop::sample::select(vec![8usize, 220, 1000])) {
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("x.safetensors");
        std::fs::write(&path, damaged(&SAFETENSORS, focus, &changes)).unwrap();
        if let Some(c) = judged(checkpoint::open(&[path]), &[4, 7]) {
            let mut out = Vec::new();
            for (i, t) in c.tensors().iter().enumerate() {
                if judged(c.read_f32(i, &mut out), &[7]).is_some() {
                    prop_assert_eq!(out.len(), t.count());
                }
            }
        }
    }

    #[test]
    fn arrays(changes in changes(), focus in prop::sample::select(vec![10usize, 80, 1000])) {
        if let Some(a) = judged(npy::parse(&damaged(&ARRAY, focus, &changes), "x"), &[3, 7]) {
            let count = match a.values {
                npy::Values::F32(v) => v.len(),
                npy::Values::F64(v) => v.len(),
                npy::Values::U8(v) => v.len(),
            };
            prop_assert_eq!(count, a.shape.iter().product::<usize>());
        }
    }

    #[test]
    fn splats(changes in changes(), focus in prop::sample::select(vec![120usize, 600, 2000])) {
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("x.ply");
        std::fs::write(&path, damaged(&SPLATS, focus, &changes)).unwrap();
        if let Some((scene, report)) = judged(Scene::load(&path), &[3, 7]) {
            prop_assert_eq!(scene.len() + report.dropped(), report.total);
            let g = &scene.gaussians;
            prop_assert!(g.mean.as_flattened().iter().chain(g.colour.as_flattened()).all(|v| v.is_finite()));
            prop_assert!(g.scale.as_flattened().iter().all(|v| v.is_finite() && *v > 0.0));
            prop_assert!(g.opacity.iter().all(|p| (0.0..=1.0).contains(p)));
        }
    }

    #[test]
    fn transforms(changes in changes()) {
        if let Some(t) = judged(Transforms::parse(&damaged(TRANSFORMS.as_bytes(), 1000, &changes), "x"), &[3, 7]) {
            for f in &t.frames {
                prop_assert!(f.path.is_relative());
                prop_assert!(f.pose.is_none_or(|p| p.check("x").is_ok()));
            }
        }
    }

    #[test]
    fn camera_paths(changes in changes()) {
        if let Some(list) = judged(camera_json::parse(&damaged(CAMERAS.as_bytes(), 1000, &changes), "x"), &[3, 5, 7]) {
            for c in list {
                prop_assert!(c.time.is_finite() && c.camera.check("x").is_ok());
            }
        }
    }

    #[test]
    fn pictures(which in 0usize..4, changes in changes(), focus in prop::sample::select(vec![64usize, 400, 2000])) {
        let file = if which == 3 { &*PNG } else { &JPEGS[which] };
        let bytes = damaged(file, focus, &changes);
        if let Some(d) = judged(image_io::decode(&bytes, "x", image_io::Orientation::Apply), &[3, 7]) {
            prop_assert_eq!(d.image.data.len(), 3 * d.image.width as usize * d.image.height as usize);
        }
    }
}
