//! Which frames are given and which are tested: what `evaluate.rs` measures on.
//!
//! The protocol of STORM that StreetForward follows: 20 frames at 10 Hz, context 0, 5, 10, 15, the other 16 are test
//! frames. 16 to 19 lie beyond the last context frame and are reported apart.

use crate::report::Part;
use sf_formats::clip::{Clip, GroundTruth, TruthFrame};
use sf_formats::image_io::Rgb8;
use sf_formats::{Error, Pose, Result};

/// Context and test frames.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Protocol {
    /// Name in reports.
    pub name: &'static str,
    /// Frames used: `0..frames`.
    pub frames: usize,
    /// Frames given to the model, ascending.
    pub context: Vec<usize>,
}

impl Protocol {
    /// The 20-frame protocol on the first frames of a clip of `available` frames.
    ///
    /// Shorter clips keep the stride of 5; up to five frames, the first and the last are given.
    pub fn storm20(available: usize) -> Result<Protocol> {
        let frames = available.min(20);
        let context = match frames {
            0..=2 => {
                return Err(Error::input("clip", format!("{available} frames; evaluation needs at least 3")));
            }
            3..=5 => vec![0, frames - 1],
            _ => (0..frames).step_by(5).collect(),
        };
        Ok(Protocol { name: "storm20", frames, context })
    }

    /// Frames that are tested, ascending.
    pub fn targets(&self) -> impl Iterator<Item = usize> {
        (0..self.frames).filter(|i| !self.context.contains(i))
    }

    /// Where a test frame belongs.
    pub fn part(&self, target: usize) -> Part {
        if self.context.last().is_some_and(|&last| target > last) { Part::Extrapolation } else { Part::Interpolation }
    }

    /// The context frame nearest in time, the earlier of two.
    pub(crate) fn nearest(&self, clip: &EvalClip, target: usize) -> usize {
        let distance = |c: usize| (clip.frames[c].time - clip.frames[target].time).abs();
        // A microsecond of rounding must not decide between two at equal distance.
        self.context.iter().copied().reduce(|a, b| if distance(b) < distance(a) - 1e-6 { b } else { a }).unwrap_or(0)
    }
}

/// Where test cameras come from.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum TargetPoses {
    /// The predicted context poses, interpolated and carried on in time.
    #[default]
    Predicted,
    /// The true poses, in the world of the prediction by the similarity that fits the context poses.
    AlignedTruth,
}

impl TargetPoses {
    /// Name in reports.
    pub fn name(self) -> &'static str {
        match self {
            TargetPoses::Predicted => "predicted",
            TargetPoses::AlignedTruth => "aligned_truth",
        }
    }
}

/// One true frame.
#[derive(Clone, Copy, Debug)]
pub struct EvalFrame<'a> {
    /// Seconds.
    pub time: f64,
    /// The picture at any size.
    pub image: &'a Rgb8,
    /// Camera to world, any world that is the same for all frames.
    pub pose: Option<Pose>,
    /// Depth, velocity (axes of that world) and mask, at any size.
    pub truth: Option<&'a TruthFrame>,
}

/// The true clip, context and test frames.
#[derive(Clone, Debug)]
pub struct EvalClip<'a> {
    /// In time order.
    pub frames: Vec<EvalFrame<'a>>,
}

impl<'a> EvalClip<'a> {
    /// A clip from disk with its ground truth, one entry per frame of the clip.
    pub fn new(clip: &'a Clip, truth: Option<&'a GroundTruth>) -> EvalClip<'a> {
        let frames = clip.frames.iter().enumerate().map(|(i, f)| EvalFrame {
            time: f.time,
            image: &f.image,
            pose: clip.poses.as_ref().and_then(|p| p.get(i).copied()),
            truth: truth.and_then(|t| t.frames.get(i)),
        });
        EvalClip { frames: frames.collect() }
    }
}

/// How to measure.
#[derive(Clone, Debug, PartialEq)]
pub struct EvalOptions {
    /// Context and test frames.
    pub protocol: Protocol,
    /// Where test cameras come from.
    pub target_poses: TargetPoses,
    /// True speed above which a pixel is dynamic, units per second.
    pub dynamic_speed: f32,
    /// Largest true depth that is compared.
    pub max_depth: f32,
    /// Colour where nothing was drawn.
    pub background: [f32; 3],
}

impl EvalOptions {
    /// The usual choices: predicted poses, 1 unit per second, 80 units, black.
    pub fn new(protocol: Protocol) -> EvalOptions {
        EvalOptions {
            protocol,
            target_poses: TargetPoses::default(),
            dynamic_speed: 1.0,
            max_depth: 80.0,
            background: [0.0; 3],
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn frames_of_the_protocol() {
        let p = Protocol::storm20(200).unwrap();
        assert_eq!((p.frames, p.context.as_slice()), (20, [0, 5, 10, 15].as_slice()));
        let parts = |part| p.targets().filter(|&t| p.part(t) == part).collect::<Vec<_>>();
        assert_eq!(parts(Part::Interpolation), [1, 2, 3, 4, 6, 7, 8, 9, 11, 12, 13, 14]);
        assert_eq!(parts(Part::Extrapolation), [16, 17, 18, 19]);
        assert_eq!(Protocol::storm20(19).unwrap().context, [0, 5, 10, 15]);
        assert_eq!(Protocol::storm20(6).unwrap().context, [0, 5]);
        assert_eq!(Protocol::storm20(4).unwrap().context, [0, 3]);
        assert!(Protocol::storm20(2).is_err());
    }
}
