//! Frames per second on one core: `cargo run --release -p sf-synth --example speed -- [WxH]`
#![deny(unsafe_code)]

use sf_synth::{Options, Street};
use std::time::Instant;

fn main() -> Result<(), Box<dyn std::error::Error>> {
    let size = std::env::args().nth(1).unwrap_or("168x112".into());
    let (w, h) = size.split_once('x').ok_or("usage: speed [WxH]")?;
    let options = Options { width: w.parse()?, height: h.parse()?, ..Options::default() };
    let (mut streets, mut laying, mut frames, mut sum) = (0, 0.0, 0, 0u64);
    let start = Instant::now();
    for seed in 0..24 {
        let lay = Instant::now();
        let street = Street::new(seed, options.clone())?;
        laying += lay.elapsed().as_secs_f64();
        streets += 1;
        for i in (0..20).step_by(5) {
            let frame = street.frame(i);
            sum += u64::from(frame.rgb[0]);
            frames += 1;
        }
    }
    let seconds = start.elapsed().as_secs_f64();
    println!(
        "{w}x{h}, one thread: {:.1} frames/s, {:.2} ms to lay a street (check {sum})",
        f64::from(frames) / (seconds - laying),
        1e3 * laying / f64::from(streets)
    );
    Ok(())
}
