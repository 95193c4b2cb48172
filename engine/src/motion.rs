//! From raw motion-head channels to velocities and dynamic probabilities (network specification, items
//! 10 to 13, 20 to 22, 25 and 26).
//!
//! A pass sees the frames within its [`Reach`]; a direction without a neighbour is never emitted as
//! predicted: it mirrors the other one (or keeps the raw value, by configuration).

use sf_formats::config::{Combine, Extrapolate, ModelConfig, MotionFrame, MotionLayout, MotionPer, Orientation};
use sf_ops::activation;

/// The frames `b` that a query in frame `a` sees: lo <= b - a <= hi.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) struct Reach {
    /// Smallest frame difference.
    pub lo: i32,
    /// Largest frame difference.
    pub hi: i32,
}

impl Reach {
    /// Of the forward and the backward pass; one-pass networks have the first alone, both ways.
    pub(crate) fn of(config: &ModelConfig) -> (Reach, Option<Reach>) {
        Self::within(config, config.mask_k as i32)
    }

    fn within(config: &ModelConfig, k: i32) -> (Reach, Option<Reach>) {
        if config.motion_layout == MotionLayout::SinglePass {
            return (Reach { lo: -k, hi: k }, None);
        }
        let near = i32::from(!config.mask_self);
        let (ahead, behind) = (Reach { lo: near, hi: k }, Reach { lo: -k, hi: -near });
        match config.mask_orientation {
            Orientation::Equation => (ahead, Some(behind)),
            Orientation::Figure => (behind, Some(ahead)),
        }
    }

    /// The directions themselves, for which frames have a neighbour: as [`Reach::of`], but a mask of no frames
    /// (an ablation) does not take away what there is to move towards.
    pub(crate) fn directions(config: &ModelConfig) -> (Reach, Option<Reach>) {
        Self::within(config, config.mask_k.max(1) as i32)
    }

    /// Whether frame `f` of `frames` sees any other frame.
    pub(crate) fn has_neighbour(&self, f: usize, frames: usize) -> bool {
        (0..frames).any(|b| {
            let d = b as i64 - f as i64;
            d != 0 && d >= i64::from(self.lo) && d <= i64::from(self.hi)
        })
    }
}

/// Raw channels of one row.
#[derive(Clone, Copy, Debug)]
pub(crate) enum Raw<'a> {
    /// Forward and backward pass, `[w, 4]` each: velocity 3, dynamic logit.
    Passes(&'a [f32], &'a [f32]),
    /// One pass, `[w, 7]`: v+ 3, v- 3, dynamic logit.
    Single(&'a [f32]),
}

/// A direction of time.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Direction {
    Forward,
    Backward,
}

/// How one frame's raw motion becomes velocity in world axes per second.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Map {
    /// Factors on raw v+ and v-.
    factor: (f32, f32),
    /// Whether the frame has a neighbour in the forward and in the backward direction.
    seen: (bool, bool),
    mirror: bool,
    /// Rows of the rotation to world axes.
    rotation: Option<[[f32; 3]; 3]>,
    bias: f32,
    combine: Combine,
}

impl Map {
    /// For frame `f` of a clip with these times; `rotation` takes its camera's axes to the world's.
    pub(crate) fn new(config: &ModelConfig, times: &[f64], f: usize, rotation: [[f32; 3]; 3]) -> Map {
        let n = times.len();
        let seen = match Reach::directions(config) {
            (fwd, Some(bwd)) => (fwd.has_neighbour(f, n), bwd.has_neighbour(f, n)),
            (_, None) => (f + 1 < n, f > 0),
        };
        let next = if f + 1 < n { times[f + 1] - times[f] } else { 0.0 };
        let previous = if f > 0 { times[f] - times[f - 1] } else { 0.0 };
        let (next, previous) = match (f + 1 < n, f > 0) {
            (true, true) => (next, previous),
            (true, false) => (next, next),
            (false, true) => (previous, previous),
            (false, false) => (1.0, 1.0),
        };
        let unit = config.motion_scale * config.world_scale;
        let per = |dt: f64| match config.motion_per {
            MotionPer::Second => unit,
            MotionPer::Step => unit / dt,
        };
        Map {
            factor: (per(next) as f32, (per(previous) * f64::from(config.motion_back_sign)) as f32),
            seen,
            mirror: config.render_extrapolate == Extrapolate::Mirror,
            rotation: (config.motion_frame == MotionFrame::Camera).then_some(rotation),
            bias: config.motion_bias as f32,
            combine: config.motion_combine,
        }
    }

    /// Whether the frame has a neighbour in the forward and in the backward direction.
    pub(crate) fn neighbours(&self) -> (bool, bool) {
        self.seen
    }

    /// Velocities of a row, world axes, scene units per second: those of `direction`, or, where it has no neighbour, the other's turned
    /// round.
    fn velocity_row(&self, raw: Raw, direction: Direction, out: &mut [[f32; 3]]) {
        let (ahead, behind) = self.seen;
        if !ahead && !behind {
            return out.fill([0.0; 3]);
        }
        let seen = if direction == Direction::Forward { ahead } else { behind };
        let turned = !seen && self.mirror;
        let forward = (direction == Direction::Forward) != turned;
        let (raw, channels, first) = match raw {
            Raw::Passes(f, b) => (if forward { f } else { b }, 4, 0),
            Raw::Single(s) => (s, 7, if forward { 0 } else { 3 }),
        };
        let factor = if forward { self.factor.0 } else { self.factor.1 };
        for (v, raw) in out.iter_mut().zip(raw.chunks_exact(channels)) {
            let x = [raw[first] * factor, raw[first + 1] * factor, raw[first + 2] * factor];
            *v = match &self.rotation {
                Some(r) => std::array::from_fn(|i| r[i][0] * x[0] + r[i][1] * x[1] + r[i][2] * x[2]),
                None => x,
            };
            if turned {
                *v = v.map(|x| -x);
            }
        }
    }

    /// v+ of a row.
    pub(crate) fn forward_row(&self, raw: Raw, out: &mut [[f32; 3]]) {
        self.velocity_row(raw, Direction::Forward, out);
    }

    /// v- of a row.
    pub(crate) fn backward_row(&self, raw: Raw, out: &mut [[f32; 3]]) {
        self.velocity_row(raw, Direction::Backward, out);
    }

    /// Logits of a direction's dynamic probability; zeros where the direction is not read.
    pub(crate) fn logit_row(&self, raw: Raw, direction: Direction, out: &mut [f32]) {
        let (forward, (ahead, behind)) = (direction == Direction::Forward, self.seen);
        match raw {
            Raw::Passes(f, _) if forward && ahead => self.logits(f, 4, 3, out),
            Raw::Passes(_, b) if !forward && behind => self.logits(b, 4, 3, out),
            Raw::Single(s) if forward && (ahead || behind) => self.logits(s, 7, 6, out),
            _ => out.fill(0.0),
        }
    }

    fn logits(&self, raw: &[f32], channels: usize, channel: usize, out: &mut [f32]) {
        out.iter_mut().zip(raw.chunks_exact(channels)).for_each(|(o, r)| *o = r[channel] + self.bias);
    }

    /// [`Map::dynamic_row`] from the sigmoids of both directions' logits; `forward` in and the result out.
    pub(crate) fn combine_row(&self, backward: &[f32], forward: &mut [f32], single: bool) {
        for (f, &b) in forward.iter_mut().zip(backward) {
            *f = match (self.seen, single) {
                ((false, false), _) => 0.0,
                (_, true) | ((true, false), _) => *f,
                ((false, true), _) => b,
                ((true, true), _) => self.combine(*f, b),
            };
        }
    }

    fn combine(&self, f: f32, b: f32) -> f32 {
        match self.combine {
            Combine::Mean => 0.5 * (f + b),
            Combine::Max => f.max(b),
        }
    }

    /// Dynamic probabilities of a row, over the directions that have a neighbour.
    pub(crate) fn dynamic_row(&self, raw: Raw, out: &mut [f32]) {
        let p = |logit: f32| activation::sigmoid(logit + self.bias);
        for (u, dynamic) in out.iter_mut().enumerate() {
            *dynamic = match (raw, self.seen) {
                (_, (false, false)) => 0.0,
                (Raw::Single(s), _) => p(s[7 * u + 6]),
                (Raw::Passes(f, _), (true, false)) => p(f[4 * u + 3]),
                (Raw::Passes(_, b), (false, true)) => p(b[4 * u + 3]),
                (Raw::Passes(f, b), (true, true)) => self.combine(p(f[4 * u + 3]), p(b[4 * u + 3])),
            };
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const TURN: [[f32; 3]; 3] = [[0.0, 0.0, 1.0], [0.0, 1.0, 0.0], [-1.0, 0.0, 0.0]];

    #[test]
    fn reach_follows_the_mask_settings() {
        let mut c = ModelConfig::base();
        assert_eq!(Reach::of(&c), (Reach { lo: 0, hi: 1 }, Some(Reach { lo: -1, hi: 0 })));
        c.mask_self = false;
        c.mask_k = 2;
        assert_eq!(Reach::of(&c), (Reach { lo: 1, hi: 2 }, Some(Reach { lo: -2, hi: -1 })));
        c.mask_orientation = Orientation::Figure;
        assert_eq!(Reach::of(&c), (Reach { lo: -2, hi: -1 }, Some(Reach { lo: 1, hi: 2 })));
        c.motion_layout = MotionLayout::SinglePass;
        assert_eq!(Reach::of(&c), (Reach { lo: -2, hi: 2 }, None));
        // No neighbour in the mask: the directions stay.
        let c = ModelConfig { mask_k: 0, ..ModelConfig::base() };
        let (own, directions) = (Reach { lo: 0, hi: 0 }, Reach::directions(&c));
        assert_eq!(Reach::of(&c), (own, Some(own)));
        assert_eq!(directions, Reach::of(&ModelConfig::base()));
        let ahead = Reach { lo: 0, hi: 1 };
        assert!(ahead.has_neighbour(0, 2) && !ahead.has_neighbour(1, 2) && !ahead.has_neighbour(0, 1));
    }

    #[test]
    fn ends_mirror_and_a_lone_frame_stands_still() {
        let c = ModelConfig::base();
        let raw = Raw::Passes(&[1.0, 2.0, 3.0, 0.0], &[-1.0, 0.0, 0.0, 4.0]);
        let run = |times: &[f64], f: usize| {
            let map = Map::new(&c, times, f, TURN);
            let (mut vf, mut vb, mut d) = ([[9.0; 3]], [[9.0; 3]], [9.0]);
            map.forward_row(raw, &mut vf);
            map.backward_row(raw, &mut vb);
            map.dynamic_row(raw, &mut d);
            (vf[0], vb[0], d[0])
        };
        let (vf, vb, d) = run(&[0.0, 0.1, 0.2], 1);
        assert_eq!((vf, vb), ([3.0, 2.0, -1.0], [0.0, 0.0, 1.0]));
        assert!((d - 0.5 * (0.5 + 0.982_013_8)).abs() < 1e-6);
        let (vf, vb, d) = run(&[0.0, 0.1, 0.2], 0);
        assert_eq!((vf, vb, d), ([3.0, 2.0, -1.0], [-3.0, -2.0, 1.0], 0.5));
        let (vf, vb, _) = run(&[0.0, 0.1, 0.2], 2);
        assert_eq!((vf, vb), ([0.0, 0.0, -1.0], [0.0, 0.0, 1.0]));
        assert_eq!(run(&[0.0], 0), ([0.0; 3], [0.0; 3], 0.0));
    }

    /// Logits, sigmoid and combination in steps give the bits of the row function that defines them.
    #[test]
    fn steps_have_the_bits_of_the_rows() {
        let raw: Vec<f32> = (0..4 * 21).map(|i| (i * 37 % 101) as f32 / 9.0 - 5.0).collect();
        let back: Vec<f32> = raw.iter().rev().copied().collect();
        for combine in [Combine::Mean, Combine::Max] {
            for layout in [MotionLayout::PerDirection, MotionLayout::SinglePass] {
                let c = ModelConfig { motion_combine: combine, motion_layout: layout, ..ModelConfig::nano() };
                let single = layout == MotionLayout::SinglePass;
                let raw = if single { Raw::Single(&raw) } else { Raw::Passes(&raw, &back) };
                let n = if single { 12 } else { 21 };
                for (times, f) in [(&[0.0][..], 0), (&[0.0, 0.1, 0.3], 0), (&[0.0, 0.1, 0.3], 1), (&[0.0, 0.1, 0.3], 2)]
                {
                    let map = Map::new(&c, times, f, TURN);
                    let (mut forward, mut backward, mut want) = (vec![9.0; n], vec![9.0; n], vec![9.0; n]);
                    map.logit_row(raw, Direction::Forward, &mut forward);
                    map.logit_row(raw, Direction::Backward, &mut backward);
                    for p in forward.iter_mut().chain(&mut backward) {
                        *p = activation::sigmoid(*p);
                    }
                    map.combine_row(&backward, &mut forward, single);
                    map.dynamic_row(raw, &mut want);
                    assert_eq!(forward, want, "{combine:?} {layout:?} frame {f} of {}", times.len());
                }
            }
        }
    }

    #[test]
    fn per_step_velocities_use_the_nearest_interval() {
        let mut c = ModelConfig::base();
        c.motion_per = MotionPer::Step;
        c.motion_frame = MotionFrame::World;
        c.motion_back_sign = -1;
        c.render_extrapolate = Extrapolate::Direct;
        let raw = Raw::Passes(&[1.0, 0.0, 0.0, 0.0], &[1.0, 0.0, 0.0, 0.0]);
        let times = [0.0, 0.5, 0.75];
        for (f, want) in [(0, (2.0, -2.0)), (1, (2.0 * 2.0, -2.0)), (2, (4.0, -4.0))] {
            let map = Map::new(&c, &times, f, TURN);
            let (mut vf, mut vb) = ([[9.0; 3]], [[9.0; 3]]);
            map.forward_row(raw, &mut vf);
            map.backward_row(raw, &mut vb);
            assert_eq!((vf[0][0], vb[0][0]), want, "frame {f}");
        }
    }
}
