//! Camera poses for other programs.
//!
//! | format | file | convention |
//! |---|---|---|
//! | nerfstudio | `transforms.json` | camera-to-world, OpenGL axes |
//! | TUM | `poses_tum.txt` | `time tx ty tz qx qy qz qw`, camera-to-world, OpenCV axes |
//! | KITTI | `poses_kitti.txt` | first three rows of the camera-to-world matrix, row-major, OpenCV axes |
//! | COLMAP | `cameras.txt images.txt points3D.txt` | world-to-camera, OpenCV axes, PINHOLE |
//!
//! Intrinsics are those of the source pictures, before the network's resize.

use crate::atomic::{self, Overwrite};
use crate::camera::Camera;
use crate::error::{Error, Result};
use crate::scene::Scene;
use crate::transforms::{self, View};
use glam::DQuat;
use std::path::{Path, PathBuf};

/// A pose format.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum PoseFormat {
    /// nerfstudio and instant-ngp.
    Nerfstudio,
    /// TUM RGB-D benchmark.
    Tum,
    /// KITTI odometry.
    Kitti,
    /// COLMAP text model.
    Colmap,
}

impl PoseFormat {
    /// All formats.
    pub const ALL: [PoseFormat; 4] = [PoseFormat::Nerfstudio, PoseFormat::Tum, PoseFormat::Kitti, PoseFormat::Colmap];

    /// Name on the command line.
    pub fn name(self) -> &'static str {
        match self {
            PoseFormat::Nerfstudio => "nerfstudio",
            PoseFormat::Tum => "tum",
            PoseFormat::Kitti => "kitti",
            PoseFormat::Colmap => "colmap",
        }
    }
}

/// A scene's input cameras at the size of their source pictures.
pub fn views(scene: &Scene) -> Vec<View> {
    scene
        .frames
        .iter()
        .map(|f| View {
            name: f.name.clone(),
            time: f.time,
            camera: f.camera.resized(f.source_size.0, f.source_size.1),
        })
        .collect()
}

/// Writes a format's files into `folder` and gives their paths.
pub fn export(views: &[View], format: PoseFormat, folder: &Path, overwrite: Overwrite) -> Result<Vec<PathBuf>> {
    let files = match format {
        PoseFormat::Nerfstudio => vec![("transforms.json", transforms::write(views))],
        PoseFormat::Tum => vec![("poses_tum.txt", tum(views))],
        PoseFormat::Kitti => vec![("poses_kitti.txt", kitti(views))],
        PoseFormat::Colmap => {
            let (cameras, images) = colmap(views);
            let none = "# 3D point list with one line of data per point: none\n".to_owned();
            vec![("cameras.txt", cameras), ("images.txt", images), ("points3D.txt", none)]
        }
    };
    std::fs::create_dir_all(folder).map_err(|e| Error::io(folder, "create", &e))?;
    files
        .into_iter()
        .map(|(name, text)| {
            let path = folder.join(name);
            atomic::write(&path, text.as_bytes(), overwrite).map(|()| path)
        })
        .collect()
}

/// Unit quaternion of a rotation with w >= 0, so that a pose has one spelling.
fn quaternion(r: &glam::DMat3) -> DQuat {
    let q = DQuat::from_mat3(r).normalize();
    if q.w < 0.0 { -q } else { q }
}

fn tum(views: &[View]) -> String {
    let mut text = String::from("# timestamp tx ty tz qx qy qz qw\n");
    for v in views {
        let (t, q) = (v.camera.pose.t, quaternion(&v.camera.pose.r));
        text.push_str(&format!("{} {} {} {} {} {} {} {}\n", v.time, t.x, t.y, t.z, q.x, q.y, q.z, q.w));
    }
    text
}

fn kitti(views: &[View]) -> String {
    let mut text = String::new();
    for v in views {
        let rows = v.camera.pose.to_rows();
        let numbers: Vec<String> = rows[..3].iter().flatten().map(f64::to_string).collect();
        text.push_str(&(numbers.join(" ") + "\n"));
    }
    text
}

fn colmap(views: &[View]) -> (String, String) {
    let mut lenses: Vec<Camera> = Vec::new();
    let mut images = String::from(
        "# Image list with two lines of data per image:\n\
         #   IMAGE_ID, QW, QX, QY, QZ, TX, TY, TZ, CAMERA_ID, NAME\n\
         #   POINTS2D[] as (X, Y, POINT3D_ID): none\n",
    );
    for (i, v) in views.iter().enumerate() {
        let c = &v.camera;
        let same = |l: &Camera| (l.width, l.height, l.k) == (c.width, c.height, c.k);
        let lens = lenses.iter().position(same).unwrap_or_else(|| {
            lenses.push(*c);
            lenses.len() - 1
        });
        let inverse = c.pose.inverse();
        let (t, q) = (inverse.t, quaternion(&inverse.r));
        // Fields are split at white space, so a name may hold none.
        let name: String = v.name.chars().map(|c| if c.is_whitespace() || c.is_control() { '_' } else { c }).collect();
        let (i, lens) = (i + 1, lens + 1);
        images.push_str(&format!("{i} {} {} {} {} {} {} {} {lens} {name}\n\n", q.w, q.x, q.y, q.z, t.x, t.y, t.z));
    }
    let mut cameras = String::from("# Camera list: CAMERA_ID, MODEL, WIDTH, HEIGHT, PARAMS[] (fx, fy, cx, cy)\n");
    for (i, c) in lenses.iter().enumerate() {
        let k = c.k;
        cameras.push_str(&format!("{} PINHOLE {} {} {} {} {} {}\n", i + 1, c.width, c.height, k.fx, k.fy, k.cx, k.cy));
    }
    (cameras, images)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::camera::{Intrinsics, Pose};
    use glam::{DMat3, DVec3};

    fn view() -> View {
        let pose = Pose { r: DMat3::from_rotation_y(std::f64::consts::FRAC_PI_2), t: DVec3::new(1.0, 2.0, 3.0) };
        let k = Intrinsics { fx: 100.0, fy: 101.0, cx: 32.0, cy: 24.0 };
        View { name: "a b.png".into(), time: 0.25, camera: Camera { width: 64, height: 48, k, pose } }
    }

    /// Numbers of a line after `skip` words.
    fn numbers(line: &str, skip: usize) -> Vec<f64> {
        line.split(' ').skip(skip).map_while(|w| w.parse().ok()).collect()
    }

    #[test]
    fn every_format_holds_the_same_pose() {
        let v = view();
        let t = tum(std::slice::from_ref(&v));
        let n = numbers(t.lines().nth(1).unwrap(), 0);
        assert_eq!(n[..4], [0.25, 1.0, 2.0, 3.0]);
        let q = DQuat::from_xyzw(n[4], n[5], n[6], n[7]);
        assert!((DMat3::from_quat(q) - v.camera.pose.r).to_cols_array().iter().all(|e| e.abs() < 1e-15));
        let rows = numbers(kitti(std::slice::from_ref(&v)).lines().next().unwrap(), 0);
        assert_eq!(rows, v.camera.pose.to_rows()[..3].concat());
        let (cameras, images) = colmap(&[v.clone(), v.clone()]);
        assert_eq!(
            cameras.lines().filter(|l| !l.starts_with('#')).collect::<Vec<_>>(),
            ["1 PINHOLE 64 48 100 101 32 24"]
        );
        let lines: Vec<&str> = images.lines().filter(|l| !l.starts_with('#')).collect();
        assert_eq!(lines.len(), 4);
        assert!(lines[0].ends_with(" 1 a_b.png") && lines[1].is_empty() && lines[2].starts_with("2 "));
        let n = numbers(lines[0], 1);
        let w2c =
            Pose { r: DMat3::from_quat(DQuat::from_xyzw(n[1], n[2], n[3], n[0])), t: DVec3::new(n[4], n[5], n[6]) };
        assert!(
            (w2c.apply(v.camera.pose.apply(DVec3::new(0.5, -1.0, 4.0))) - DVec3::new(0.5, -1.0, 4.0)).length() < 1e-14
        );
    }
}
