//! Splats in the 32-byte layout of antimatter15's web viewer (`.splat`), which many viewers open.
//!
//! A row: centre f32 x 3, standard deviations f32 x 3, colour and opacity u8 x 4, rotation w x y z as
//! round(128 q + 128), u8 x 4. No header; the number of splats is the file's length over 32. The splats with the
//! largest volume times opacity come first, so a viewer that loads part of a file shows what matters.

use crate::atomic::{AtomicFile, Overwrite};
use crate::error::{Error, Result};
use crate::scene::Gaussians;
use std::path::Path;

/// Bytes of a splat.
pub const ROW: usize = 32;

/// The file's bytes.
///
/// # Errors
/// Status 9 for a value that is not finite, or a rotation of length zero.
pub fn splat_bytes(g: &Gaussians) -> Result<Vec<u8>> {
    let weight = |i: usize| g.scale[i].iter().map(|&s| f64::from(s)).product::<f64>() * f64::from(g.opacity[i]);
    let mut order: Vec<usize> = (0..g.len()).collect();
    order.sort_by(|&a, &b| weight(b).total_cmp(&weight(a)));
    let mut out = Vec::with_capacity(ROW * g.len());
    for i in order {
        let (mean, scale, quat, opacity, colour) = (g.mean[i], g.scale[i], g.quat[i], g.opacity[i], g.colour[i]);
        let norm = quat.iter().map(|q| q * q).sum::<f32>().sqrt();
        let all = mean.iter().chain(&scale).chain(&colour).chain([&opacity, &norm]);
        if all.into_iter().any(|v| !v.is_finite()) || norm == 0.0 {
            let why = format!(
                "mean {mean:?}, scale {scale:?}, rotation {quat:?}, opacity {opacity}: not finite, or no rotation"
            );
            return Err(Error::integrity(format!("gaussian {i}"), why));
        }
        let byte = |v: f32| (v.clamp(0.0, 1.0) * 255.0).round() as u8;
        out.extend(mean.into_iter().chain(scale).flat_map(f32::to_le_bytes));
        out.extend(colour.map(byte).into_iter().chain([byte(opacity)]));
        // `as` saturates: +1 would be 256.
        out.extend(quat.map(|q| (q / norm * 128.0 + 128.0).round() as u8));
    }
    Ok(out)
}

/// Writes Gaussians as a `.splat` file.
pub fn export_splat(g: &Gaussians, path: &Path, overwrite: Overwrite) -> Result<()> {
    let mut file = AtomicFile::create(path, overwrite)?;
    AtomicFile::write(&mut file, &splat_bytes(g)?)?;
    file.commit()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn rows_are_32_bytes_and_the_largest_splat_comes_first() {
        let g = Gaussians {
            mean: vec![[1.0, 2.0, 3.0], [4.0, 5.0, 6.0]],
            scale: vec![[0.1, 0.1, 0.1], [0.5, 0.25, 0.125]],
            quat: vec![[2.0, 0.0, 0.0, 0.0], [0.0, -1.0, 0.0, 0.0]],
            opacity: vec![1.0, 0.5],
            colour: vec![[0.0, 0.5, 1.0], [2.0, -1.0, 0.2]],
        };
        let b = splat_bytes(&g).unwrap();
        assert_eq!(b.len(), 64);
        let f = |at: usize| f32::from_le_bytes([b[at], b[at + 1], b[at + 2], b[at + 3]]);
        assert_eq!([f(0), f(4), f(8), f(12), f(16), f(20)], [4.0, 5.0, 6.0, 0.5, 0.25, 0.125]);
        assert_eq!(b[24..32], [255, 0, 51, 128, 128, 0, 128, 128]);
        assert_eq!((f(32), f(44)), (1.0, 0.1));
        assert_eq!(b[56..64], [0, 128, 255, 255, 255, 128, 128, 128]);
        for broken in [
            Gaussians { quat: vec![[0.0; 4]; 2], ..g.clone() },
            Gaussians { opacity: vec![f32::NAN; 2], ..g.clone() },
            Gaussians { mean: vec![[f32::INFINITY; 3]; 2], ..g.clone() },
        ] {
            assert_eq!(splat_bytes(&broken).unwrap_err().status() as i32, 9);
        }
        assert!(splat_bytes(&Gaussians::default()).unwrap().is_empty());
    }
}
