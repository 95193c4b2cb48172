//! Frames per second of one core, by the clock and by the time the thread really ran (Linux): `cargo run --release -p sf-synth --example speed -- [WxH]`
#![deny(unsafe_code)]

use sf_synth::{Options, Street};
use std::time::Instant;

/// Seconds this process has run on a core; `None` where the system does not tell.
fn on_core() -> Option<f64> {
    let stat = std::fs::read_to_string("/proc/self/schedstat").ok()?;
    Some(stat.split_whitespace().next()?.parse::<f64>().ok()? * 1e-9)
}

fn main() -> Result<(), Box<dyn std::error::Error>> {
    let size = std::env::args().nth(1).unwrap_or("168x112".into());
    let (w, h) = size.split_once('x').ok_or("usage: speed [WxH]")?;
    let options = Options { width: w.parse()?, height: h.parse()?, ..Options::default() };
    let (mut frames, mut sum) = (0, 0u64);
    let streets = (0..24).map(|seed| Street::new(seed, options.clone())).collect::<Result<Vec<_>, _>>()?;
    let (start, core) = (Instant::now(), on_core());
    for street in &streets {
        for i in (0..20).step_by(5) {
            let frame = street.frame(i);
            sum += u64::from(frame.rgb[0]);
            frames += 1;
        }
    }
    let rate = |seconds: f64| format!("{:.0} frames/s", f64::from(frames) / seconds);
    let clock = rate(start.elapsed().as_secs_f64());
    let busy = core.zip(on_core()).map_or("unknown".into(), |(a, b)| rate(b - a));
    println!("{w}x{h}, one thread: {clock} by the clock, {busy} of core time (check {sum})");
    Ok(())
}
