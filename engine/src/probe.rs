//! What watches a run: stage taps, the cancel flag, the deadline, the guard against broken numbers, the
//! count of finished layers and the stage clock.

use sf_formats::{Error, Result};
use sf_ops::Ctx;
use sf_ops::elementwise::all_finite;
use std::fmt;
use std::sync::atomic::{AtomicBool, AtomicU32, Ordering};
use std::time::{Duration, Instant};

/// One intermediate result handed to a tap.
#[derive(Debug)]
pub struct Tap<'a> {
    /// Stage name: `patches`, `encoder`, `aa.{i}`, `causal.fwd.{i}`, `gs.raw`, ...
    pub name: &'a str,
    /// Frame it belongs to; `None` for results of the whole clip.
    pub frame: Option<usize>,
    /// Row-major shape of `data`, without the frame axis where `frame` is given.
    pub shape: &'a [usize],
    /// The values.
    pub data: &'a [f32],
}

/// A function that sees every stage.
pub type TapFn<'a> = &'a mut dyn FnMut(&Tap);

/// Stages of the clock, in the order of execution.
pub(crate) const STAGES: [&str; 10] =
    ["preprocess", "encoder", "aa.frame", "aa.global", "camera", "depth", "conf", "gaussians", "causal", "motion"];

/// What the outside of a run sees of it, and how it stops it.
#[derive(Clone, Copy)]
pub(crate) struct Watch<'a> {
    /// Set from any thread to stop between two layers.
    pub(crate) cancel: &'a AtomicBool,
    /// Transformer blocks finished.
    pub(crate) layers: &'a AtomicU32,
    /// When the run stops by itself.
    pub(crate) deadline: Option<Instant>,
}

/// Watches one run.
pub(crate) struct Probe<'a, 't> {
    taps: Option<TapFn<'t>>,
    watch: Watch<'a>,
    ctx: Ctx<'a>,
    clock: Instant,
    /// Time spent per stage of [`STAGES`].
    times: &'a mut [Duration; STAGES.len()],
}

impl<'a, 't> Probe<'a, 't> {
    /// Starts the clock; `times` go on from what they hold.
    pub(crate) fn new(
        taps: Option<TapFn<'t>>,
        watch: Watch<'a>,
        ctx: Ctx<'a>,
        times: &'a mut [Duration; STAGES.len()],
    ) -> Probe<'a, 't> {
        Probe { taps, watch, ctx, clock: Instant::now(), times }
    }

    /// Whether anybody looks: stages that need extra work to show themselves ask first.
    pub(crate) fn tapped(&self) -> bool {
        self.taps.is_some()
    }

    /// Shows a result.
    pub(crate) fn emit(&mut self, name: fmt::Arguments, frame: Option<usize>, shape: &[usize], data: &[f32]) {
        if let Some(tap) = &mut self.taps {
            assert_eq!(shape.iter().product::<usize>(), data.len(), "shape of stage {name}");
            tap(&Tap { name: &name.to_string(), frame, shape, data });
        }
    }

    /// Stops when cancelled or late.
    pub(crate) fn check(&self, stage: fmt::Arguments) -> Result<()> {
        if self.watch.cancel.load(Ordering::Relaxed) {
            return Err(Error::Deadline(format!("cancelled after {stage}")));
        }
        if let Some(deadline) = self.watch.deadline
            && Instant::now() > deadline
        {
            return Err(Error::Deadline(format!("deadline passed after {stage}")));
        }
        Ok(())
    }

    /// Between layers: stops when cancelled or late, and when `data` holds a NaN or an infinity.
    pub(crate) fn guard(&self, stage: fmt::Arguments, data: &[f32]) -> Result<()> {
        self.check(stage)?;
        if !all_finite(self.ctx, data) {
            let bad = data.iter().filter(|v| !v.is_finite()).count();
            return Err(Error::integrity(
                format!("stage {stage}"),
                format!("{bad} of {} values are not finite: the weights are broken or do not fit f32", data.len()),
            ));
        }
        Ok(())
    }

    /// [`Probe::guard`] after a transformer block, which is counted.
    pub(crate) fn layer(&self, stage: fmt::Arguments, data: &[f32]) -> Result<()> {
        self.watch.layers.fetch_add(1, Ordering::Relaxed);
        self.guard(stage, data)
    }

    /// Books the time since the last call on a stage of [`STAGES`].
    pub(crate) fn lap(&mut self, stage: &str) {
        let now = Instant::now();
        let slot = STAGES.iter().position(|s| *s == stage).expect("a stage of the list");
        self.times[slot] += now - self.clock;
        self.clock = now;
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use sf_ops::Kernels;
    use sf_ops::par::Pool;

    #[test]
    fn cancelled_and_late_runs_stop() {
        let (cancel, layers, mut times) = (AtomicBool::new(false), AtomicU32::new(0), Default::default());
        let watch = Watch { cancel: &cancel, layers: &layers, deadline: None };
        let pool = Pool::new(1).unwrap();
        let ctx = Ctx { pool: &pool, kernels: Kernels::best() };
        let probe = Probe::new(None, watch, ctx, &mut times);
        probe.guard(format_args!("aa.1"), &[1.0]).unwrap();
        let e = probe.guard(format_args!("aa.1"), &[f32::NAN, 0.0]).unwrap_err();
        assert_eq!(e.status() as i32, 9);
        assert!(e.to_string().contains("aa.1: 1 of 2"), "{e}");
        cancel.store(true, Ordering::Relaxed);
        assert_eq!(probe.guard(format_args!("aa.1"), &[]).unwrap_err().status() as i32, 8);
        cancel.store(false, Ordering::Relaxed);
        let deadline = Some(Instant::now() - Duration::from_secs(1));
        let late = Probe::new(None, Watch { deadline, ..watch }, ctx, &mut times);
        assert_eq!(late.guard(format_args!("aa.1"), &[]).unwrap_err().status() as i32, 8);
    }
}
