//! Runs of one configuration: the first, the warm-up, then those that count; back to back or at a camera's pace.
//!
//! A time is one wall clock around `Session::run`: frames at the network's size in, poses, depth, Gaussians and
//! motion out. Decoding and resizing of pictures, building a scene and drawing it are not in it.

use crate::machine;
use crate::reconstruct::output_digest;
use sf_formats::digest::Digest;
use sf_formats::{Error, Result};
use sf_ops::opclock::{self, Accounts};
use std::str::FromStr;
use std::time::{Duration, Instant};
use streetforward::{Input, Session};

/// Most runs of an automatic warm-up.
const MAX_WARMUP: usize = 8;
/// Two successive runs that differ by less end an automatic warm-up.
const AGREE: f64 = 0.03;
/// Share of a configuration's time that an automatic warm-up may take.
const WARMUP_SHARE: f64 = 1.0 / 3.0;

/// Runs before those that count.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Warmup {
    /// Until two successive runs agree.
    Auto,
    /// So many.
    Runs(u32),
}

impl FromStr for Warmup {
    type Err = String;

    fn from_str(text: &str) -> Result<Warmup, String> {
        match (text, text.parse()) {
            ("auto", _) => Ok(Warmup::Auto),
            (_, Ok(n)) if n <= 1000 => Ok(Warmup::Runs(n)),
            _ => Err("auto, or a number of runs up to 1000".into()),
        }
    }
}

/// When a configuration is done, and how its runs are spaced.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Schedule {
    /// Runs that count; without it as many as fit into `seconds`.
    pub(crate) runs: Option<u32>,
    /// Wall time for warm-up and runs, where there is a limit.
    pub(crate) seconds: Option<f64>,
    pub(crate) warmup: Warmup,
    /// Time between two clips that arrive; without it a run follows the last one at once.
    pub(crate) period: Option<Duration>,
    /// Time from arrival to result that must not be exceeded.
    pub(crate) deadline: Option<Duration>,
}

/// One run that counts.
#[derive(Clone, Debug)]
pub(crate) struct Run {
    /// Whole run.
    pub(crate) time: Duration,
    /// From its arrival to its result; the run's time where runs follow each other.
    pub(crate) response: Duration,
    /// Stages of the session's clock.
    pub(crate) stages: Vec<Duration>,
}

/// What a pace asked and got.
#[derive(Clone, Copy, Debug, Default)]
pub(crate) struct Pace {
    /// Clips that arrived, those never looked at included.
    pub(crate) arrivals: u64,
    /// Clips never looked at: a newer one had arrived when the last run ended.
    pub(crate) skipped: u64,
    /// Processor time while waiting for a clip, as a share of one core; 1 is a core that spins.
    pub(crate) idle_cpu_share: Option<f64>,
}

/// All runs of one configuration.
pub(crate) struct Measured {
    pub(crate) first: Duration,
    pub(crate) warmup: usize,
    pub(crate) runs: Vec<Run>,
    pub(crate) pace: Option<Pace>,
    /// Most memory up to the end of the first run.
    pub(crate) peak_rss_bytes: Option<u64>,
    pub(crate) digest: Digest,
}

/// Runs a configuration. `tick` is called after every run.
pub(crate) fn measure(
    session: &mut Session,
    input: &Input,
    schedule: &Schedule,
    tick: &mut dyn FnMut(),
) -> Result<Measured> {
    let start = Instant::now();
    let mut once = |session: &mut Session| -> Result<Duration> {
        let clock = Instant::now();
        session.run(input)?;
        let time = clock.elapsed();
        tick();
        Ok(time)
    };
    let late = |share: f64| schedule.seconds.is_some_and(|s| start.elapsed().as_secs_f64() >= s * share);
    // The first run meets cold caches and pages: it is told apart and always part of the warm-up.
    let first = once(session)?;
    // A session allocates nothing after its first run; the digest below does.
    let peak_rss_bytes = machine::peak_rss_bytes();
    let digest = output_digest(session.output());
    let mut warmup = 1;
    let mut last = first;
    loop {
        let go_on = match schedule.warmup {
            Warmup::Runs(n) => warmup < n as usize,
            Warmup::Auto => warmup < MAX_WARMUP && !late(WARMUP_SHARE),
        };
        if !go_on {
            break;
        }
        let time = once(session)?;
        warmup += 1;
        let agree = (time.as_secs_f64() / last.as_secs_f64() - 1.0).abs() <= AGREE;
        last = time;
        if schedule.warmup == Warmup::Auto && agree {
            break;
        }
    }
    let mut runs: Vec<Run> = Vec::new();
    let mut pace = schedule.period.map(Pacer::new);
    let wanted = schedule.runs.map_or(usize::MAX, |n| n as usize);
    while runs.len() < wanted && (runs.is_empty() || !late(1.0)) {
        let arrival = pace.as_mut().map(Pacer::wait);
        let time = once(session)?;
        let response = arrival.map_or(time, |a| a.elapsed());
        runs.push(Run { time, response, stages: session.stage_times().map(|s| s.time).collect() });
    }
    if output_digest(session.output()) != digest {
        return Err(Error::Internal("two runs on the same clip gave different results".into()));
    }
    Ok(Measured { first, warmup, runs, pace: pace.map(Pacer::finish), peak_rss_bytes, digest })
}

/// Clips that arrive at a fixed pace; a run takes the newest one.
struct Pacer {
    period: Duration,
    start: Instant,
    /// The next clip that has not been taken.
    next: u32,
    pace: Pace,
    waited: Duration,
    busy: Duration,
}

impl Pacer {
    fn new(period: Duration) -> Pacer {
        let none = Duration::ZERO;
        Pacer { period, start: Instant::now(), next: 0, pace: Pace::default(), waited: none, busy: none }
    }

    /// Waits for the next clip, or takes the newest of those that have arrived; gives the time of its arrival.
    fn wait(&mut self) -> Instant {
        let arrived = (self.start.elapsed().as_nanos() / self.period.as_nanos()) as u32;
        if arrived > self.next {
            self.pace.skipped += u64::from(arrived - self.next);
            self.next = arrived;
        }
        let arrival = self.start + self.period * self.next;
        self.next += 1;
        self.pace.arrivals = u64::from(self.next);
        let now = Instant::now();
        if arrival > now {
            let before = machine::cpu_time();
            std::thread::sleep(arrival - now);
            if let (Some(before), Some(after)) = (before, machine::cpu_time()) {
                self.waited += now.elapsed();
                self.busy += after.saturating_sub(before);
            }
        }
        arrival
    }

    fn finish(mut self) -> Pace {
        // The processor clock steps by 10 ms: a share of less than a second means nothing.
        if self.waited >= Duration::from_secs(1) {
            self.pace.idle_cpu_share = Some(self.busy.as_secs_f64() / self.waited.as_secs_f64());
        }
        self.pace
    }
}

/// Steps of one new frame beside runs of the whole window, in turn.
pub(crate) struct Pushed {
    /// `Session::push` on a full window.
    pub(crate) push: Vec<Duration>,
    /// `Session::push_newest` on a full window.
    pub(crate) newest: Vec<Duration>,
    /// `Session::run`.
    pub(crate) whole: Vec<Duration>,
}

/// Pushes the clip's frames again and again, each step beside a run of the whole; the clip pushed frame by frame must give
/// what the run gave, whose digest is `digest`, and pushed for its newest frame alone what the run gave about that.
pub(crate) fn push(session: &mut Session, input: &Input, schedule: &Schedule, digest: Digest) -> Result<Pushed> {
    let (n, len) = (input.shape.frames, input.shape.height * input.shape.width * 3);
    let newest = output_digest(&session.output().of_frame(n - 1));
    for alone in [true, false] {
        session.restart();
        for (image, &time) in input.images.chunks_exact(len).zip(input.times) {
            match alone {
                true => session.push_newest(image, time, None)?,
                false => session.push(image, time, None)?,
            };
        }
        let (have, want) = match alone {
            true => (output_digest(&session.output().of_frame(n - 1)), newest),
            false => (output_digest(session.output()), digest),
        };
        if have != want {
            let why = "a clip pushed frame by frame gave another result than the clip at once";
            return Err(Error::Internal(why.into()));
        }
    }
    let start = Instant::now();
    let mut pushed = Pushed { push: Vec::new(), newest: Vec::new(), whole: Vec::new() };
    let mut time = input.times[n - 1];
    let wanted = schedule.runs.map_or(usize::MAX, |r| r as usize);
    let late = || schedule.seconds.is_some_and(|s| start.elapsed().as_secs_f64() >= s);
    while pushed.push.len() < wanted && (pushed.push.is_empty() || !late()) {
        let frame = pushed.push.len() % n;
        time += 0.1;
        let clock = Instant::now();
        session.push(&input.images[frame * len..][..len], time, None)?;
        pushed.push.push(clock.elapsed());
        time += 0.1;
        let clock = Instant::now();
        session.push_newest(&input.images[frame * len..][..len], time, None)?;
        pushed.newest.push(clock.elapsed());
        let clock = Instant::now();
        session.run(input)?;
        pushed.whole.push(clock.elapsed());
    }
    Ok(pushed)
}

/// One run with every operation booked by kind, and its time.
pub(crate) fn profile(session: &mut Session, input: &Input) -> Result<(Accounts, Duration)> {
    opclock::start();
    let clock = Instant::now();
    let result = session.run(input).map(|_| ());
    let time = clock.elapsed();
    let accounts = opclock::stop();
    result.map(|()| (accounts, time))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_late_run_takes_the_newest_clip() {
        let mut pacer = Pacer::new(Duration::from_millis(20));
        let first = pacer.wait();
        // Clips 1, 2 and 3 arrive meanwhile: 1 and 2 are never looked at.
        std::thread::sleep((first + Duration::from_millis(65)).saturating_duration_since(Instant::now()));
        let newest = pacer.wait();
        let behind = ((newest - pacer.start).as_nanos() / 20_000_000) as u32;
        assert!(behind >= 3);
        assert_eq!(pacer.pace.skipped, u64::from(behind) - 1);
        // In time again: the next one is waited for.
        let next = pacer.wait();
        assert!(next > newest && Instant::now() >= next);
        assert_eq!(pacer.finish().idle_cpu_share, None, "too short to tell");
    }

    #[test]
    fn warmups_are_read_and_refused() {
        assert_eq!("auto".parse(), Ok(Warmup::Auto));
        assert_eq!("0".parse(), Ok(Warmup::Runs(0)));
        for bad in ["", "-1", "1001", "soon"] {
            assert!(bad.parse::<Warmup>().is_err(), "{bad}");
        }
    }
}
