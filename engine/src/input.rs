//! What a run reads: frames at the network's size, their times, and intrinsics where they are known.

use crate::dims::ClipShape;
use sf_formats::{Error, Intrinsics, Result};

/// One clip at the network's size.
#[derive(Clone, Copy, Debug)]
pub struct Input<'a> {
    /// Frames and their size.
    pub shape: ClipShape,
    /// RGB bytes, `[frames, height, width, 3]`.
    pub images: &'a [u8],
    /// Seconds, strictly increasing.
    pub times: &'a [f64],
    /// Intrinsics at the network's size; they override the predicted ones.
    pub k: Option<Intrinsics>,
}

impl Input<'_> {
    /// Refuses lengths that do not fit, broken times and unusable intrinsics.
    pub fn check(&self) -> Result<()> {
        let s = self.shape;
        let need = s.frames * s.height * s.width * 3;
        if self.images.len() != need {
            return Err(Error::input("images", format!("{} bytes must be {need}", self.images.len())));
        }
        if self.times.len() != s.frames {
            return Err(Error::input("times", format!("{} times for {} frames", self.times.len(), s.frames)));
        }
        if let Some(f) = self.times.iter().position(|t| !t.is_finite()) {
            return Err(Error::input("times", format!("time of frame {f} is not finite")));
        }
        if let Some(f) = self.times.windows(2).position(|t| t[1] <= t[0]) {
            return Err(Error::input("times", format!("must increase: frame {} is not after frame {f}", f + 1)));
        }
        if let Some(k) = &self.k {
            k.check("intrinsics")?;
        }
        Ok(())
    }

    /// Bytes of one frame.
    pub(crate) fn frame(&self, f: usize) -> &[u8] {
        let len = self.shape.height * self.shape.width * 3;
        &self.images[f * len..][..len]
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn broken_inputs_are_refused() {
        let shape = ClipShape { frames: 2, height: 1, width: 1 };
        let good = Input { shape, images: &[0; 6], times: &[0.0, 0.1], k: None };
        good.check().unwrap();
        let bad_k = Intrinsics { fx: 0.0, fy: 1.0, cx: 0.0, cy: 0.0 };
        for bad in [
            Input { images: &[0; 5], ..good },
            Input { times: &[0.0], ..good },
            Input { times: &[0.0, f64::NAN], ..good },
            Input { times: &[0.1, 0.1], ..good },
            Input { k: Some(bad_k), ..good },
        ] {
            assert_eq!(bad.check().unwrap_err().status() as i32, 3);
        }
    }
}
