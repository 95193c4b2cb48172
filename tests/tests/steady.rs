//! The trained network in int8, run after run: no allocation, no thread start, the same result, and it stops when told to.
//! The long form measures, too:
//!
//! ```sh
//! cargo test --release -p sf-tests --test steady -- --ignored --nocapture
//! ```

mod counting;

use counting::{counts, ignore_harness};
use sf_formats::Dtype;
use sf_tests::nano;
use sf_tests::tiny::{Frames, bits};
use std::sync::atomic::Ordering;
use std::sync::{Arc, Mutex};
use std::time::{Duration, Instant};
use streetforward::{Model, Options, Session};

/// The counters belong to the process: one test at a time.
static ALONE: Mutex<()> = Mutex::new(());

fn session(model: &Arc<Model>, clip: &Frames) -> Session {
    Session::new(Arc::clone(model), clip.shape, Options { threads: 2, ..Options::default() }).unwrap()
}

/// Times of `runs` runs after the first, which must allocate and start nothing and predict what the first did.
fn steady(session: &mut Session, clip: &Frames, runs: usize) -> Vec<Duration> {
    let want = bits(session.run(&clip.input()).unwrap());
    let mut times = Vec::with_capacity(runs);
    ignore_harness();
    let warm = counts();
    for _ in 0..runs {
        let start = Instant::now();
        session.run(&clip.input()).unwrap();
        times.push(start.elapsed());
    }
    let now = counts();
    assert_eq!(now, warm, "allocations or thread starts in {runs} runs after the first");
    assert!(bits(session.output()) == want, "the last of {runs} runs differs from the first");
    println!("{runs} runs after the first: {} allocations, {} thread starts", now.calls - warm.calls, {
        now.threads - warm.threads
    });
    times
}

/// Sets the cancel flag `after` the start of a run; how long the run went on, or none when it was done before.
fn cancelled(session: &mut Session, clip: &Frames, after: Duration) -> Option<Duration> {
    let flag = session.cancel_flag();
    let (failed, end, set) = std::thread::scope(|scope| {
        let start = Instant::now();
        let canceller = scope.spawn(move || {
            std::thread::sleep(after.saturating_sub(start.elapsed()));
            let set = Instant::now();
            flag.store(true, Ordering::Relaxed);
            set
        });
        let failed = session.run(&clip.input()).map(|_| ()).map_err(|e| e.status() as i32);
        let end = Instant::now();
        (failed, end, canceller.join().unwrap())
    });
    session.cancel_flag().store(false, Ordering::Relaxed);
    match failed {
        Ok(()) => None,
        Err(status) => {
            assert_eq!(status, 8, "a cancelled run");
            Some(end.saturating_duration_since(set))
        }
    }
}

/// The value that `share` of the list does not exceed.
fn percentile(sorted: &[Duration], share: f64) -> Duration {
    sorted[((share * sorted.len() as f64).ceil() as usize).clamp(1, sorted.len()) - 1]
}

fn ms(d: Duration) -> f64 {
    d.as_secs_f64() * 1e3
}

#[test]
fn runs_ask_the_system_for_nothing() {
    let _alone = ALONE.lock().unwrap();
    // The counters count: what is not seen is not there.
    let before = counts();
    drop(std::hint::black_box(vec![1u8; 100]));
    std::thread::spawn(|| ()).join().unwrap();
    let after = counts();
    assert!(after.calls >= before.calls + 2 && after.bytes >= before.bytes + 100, "{before:?} {after:?}");
    assert_eq!(after.threads, before.threads + 1);

    let (model, _) = nano::converted(Dtype::Int8);
    let clip = nano::street(nano::held_out(200, 1)[0], 2, (84, 56));
    let mut session = session(&model, &clip);
    let time = *steady(&mut session, &clip, 10).iter().min().unwrap();
    let want = bits(session.output());
    for tenth in [1, 4, 7] {
        if let Some(late) = cancelled(&mut session, &clip, time * tenth / 10) {
            println!("cancelled at {tenth} tenths: back after {:.1} ms", ms(late));
        }
        // A cancelled run leaves nothing behind.
        assert!(bits(session.run(&clip.input()).unwrap()) == want);
    }
}

/// Needs a quiet machine for its bounds of time.
#[test]
#[ignore = "minutes, and measures time"]
fn a_thousand_runs() {
    let _alone = ALONE.lock().unwrap();
    let (model, _) = nano::converted(Dtype::Int8);
    let clip = nano::street(nano::held_out(200, 1)[0], 4, (168, 112));
    let mut session = session(&model, &clip);
    let mut times = steady(&mut session, &clip, 1000);
    times.sort_unstable();
    let [p50, p99, most] = [0.5, 0.99, 1.0].map(|share| percentile(&times, share));
    println!(
        "p50 {:.2} ms, p99 {:.2} ms, most {:.2} ms; p99 / p50 {:.3}",
        ms(p50),
        ms(p99),
        ms(most),
        ms(p99) / ms(p50)
    );

    // Cancelled at every moment of a run.
    let mut late: Vec<Duration> =
        (0..300).filter_map(|i| cancelled(&mut session, &clip, p50.mul_f64(f64::from(i) / 300.0))).collect();
    late.sort_unstable();
    assert!(late.len() > 200, "only {} runs were cancelled in time", late.len());
    let [middle, p99_late, longest] = [0.5, 0.99, 1.0].map(|share| percentile(&late, share));
    println!(
        "{} cancelled runs came back after {:.2} ms (median), {:.2} ms (p99), {:.2} ms (most)",
        late.len(),
        ms(middle),
        ms(p99_late),
        ms(longest)
    );
    assert!(p99 <= p50.mul_f64(1.25), "p99 {:.2} ms, p50 {:.2} ms", ms(p99), ms(p50));
    assert!(longest <= Duration::from_millis(10), "a cancelled run came back after {:.2} ms", ms(longest));
}

/// A large model, from a file in the variable `SF_MODEL` (`init --preset full --to int8`): cancelled runs end within a layer.
#[test]
#[ignore = "needs a blob in SF_MODEL, and minutes"]
fn a_large_run_is_cancelled_within_a_layer() {
    let _alone = ALONE.lock().unwrap();
    let Some(path) = std::env::var_os("SF_MODEL") else { return println!("not run: SF_MODEL names no blob") };
    let model = Arc::new(Model::open(path.as_ref(), sf_formats::LoadMode::Map).unwrap());
    let clip = nano::street(nano::held_out(200, 1)[0], 4, (252, 168));
    let mut session = session(&model, &clip);
    let start = Instant::now();
    session.run(&clip.input()).unwrap();
    let whole = start.elapsed();
    let layers = session.plan().layers();
    for share in [0.05, 0.25, 0.5, 0.75, 0.9] {
        match cancelled(&mut session, &clip, whole.mul_f64(share)) {
            Some(late) => println!(
                "cancelled at {share:.2} of {:.0} ms: back after {:.0} ms; a block takes {:.0} ms in the mean",
                ms(whole),
                ms(late),
                ms(whole) / f64::from(layers)
            ),
            None => println!("done before {share:.2} of {:.0} ms", ms(whole)),
        }
    }
}
