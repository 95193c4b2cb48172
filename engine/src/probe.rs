//! What watches a run: stage taps, the cancel flag, the deadline, the guard against broken numbers, the
//! count of finished layers and the stage clock.

use sf_formats::{Error, Result};
use sf_ops::opclock::{self, Op, Work};
use sf_ops::par::Pool;
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
    pool: &'a Pool,
    clock: Instant,
    /// Time spent per stage of [`STAGES`].
    times: &'a mut [Duration; STAGES.len()],
}

impl<'a, 't> Probe<'a, 't> {
    /// Starts the clock; `times` go on from what they hold.
    pub(crate) fn new(
        taps: Option<TapFn<'t>>,
        watch: Watch<'a>,
        pool: &'a Pool,
        times: &'a mut [Duration; STAGES.len()],
    ) -> Probe<'a, 't> {
        Probe { taps, watch, pool, clock: Instant::now(), times }
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
        let _span = opclock::span(Op::Glue, || Work { macs: 0, bytes: 4 * data.len() as u64 });
        if !all_finite_on(self.pool, data) {
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

/// [`all_finite`] by the threads of a pool.
fn all_finite_on(pool: &Pool, data: &[f32]) -> bool {
    // 128 KiB, some ten microseconds of one thread: less is not worth a region.
    const TASK: usize = 1 << 15;
    let bad = AtomicBool::new(false);
    pool.run(data.len().div_ceil(TASK), &|task, _| {
        let piece = &data[task * TASK..data.len().min((task + 1) * TASK)];
        if !all_finite(piece) {
            bad.store(true, Ordering::Relaxed);
        }
    });
    !bad.into_inner()
}

/// Whether no value is NaN or infinite: the exponent bits are never all ones.
pub(crate) fn all_finite(data: &[f32]) -> bool {
    const EXPONENT: u32 = 0x7f80_0000;
    // Whole chunks without an exit keep the loop vectorised.
    data.chunks(4096)
        .all(|chunk| chunk.iter().fold(0, |bad, v| bad | u32::from(v.to_bits() & EXPONENT == EXPONENT)) == 0)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn only_nan_and_infinity_are_refused() {
        let mut data = vec![f32::MAX; 10_000];
        data[3] = f32::MIN_POSITIVE / 4.0;
        assert!(all_finite(&data));
        for bad in [f32::NAN, f32::INFINITY, f32::NEG_INFINITY] {
            for at in [0, 4095, 4096, 9999] {
                let mut data = data.clone();
                data[at] = bad;
                assert!(!all_finite(&data));
            }
            // On threads: in every task, the last and shorter one included.
            let pool = Pool::new(2).unwrap();
            let mut data = vec![1.0; 70_000];
            assert!(all_finite_on(&pool, &data));
            for at in [0, 32_767, 32_768, 69_999] {
                data[at] = bad;
                assert!(!all_finite_on(&pool, &data));
                data[at] = 1.0;
            }
        }
        assert!(all_finite_on(&Pool::new(1).unwrap(), &[]));
    }

    #[test]
    fn cancelled_and_late_runs_stop() {
        let (cancel, layers, mut times) = (AtomicBool::new(false), AtomicU32::new(0), Default::default());
        let watch = Watch { cancel: &cancel, layers: &layers, deadline: None };
        let pool = Pool::new(1).unwrap();
        let probe = Probe::new(None, watch, &pool, &mut times);
        probe.guard(format_args!("aa.1"), &[1.0]).unwrap();
        let e = probe.guard(format_args!("aa.1"), &[f32::NAN, 0.0]).unwrap_err();
        assert_eq!(e.status() as i32, 9);
        assert!(e.to_string().contains("aa.1: 1 of 2"), "{e}");
        cancel.store(true, Ordering::Relaxed);
        assert_eq!(probe.guard(format_args!("aa.1"), &[]).unwrap_err().status() as i32, 8);
        cancel.store(false, Ordering::Relaxed);
        let deadline = Some(Instant::now() - Duration::from_secs(1));
        let late = Probe::new(None, Watch { deadline, ..watch }, &pool, &mut times);
        assert_eq!(late.guard(format_args!("aa.1"), &[]).unwrap_err().status() as i32, 8);
    }
}
