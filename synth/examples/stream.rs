//! Training clips of one split to standard output, in the layout of `sf_synth::stream`.
//!
//! `cargo run --release -p sf-synth --example stream -- train|held-out FIRST_SEED COUNT WxH [FRAMES STRIDE] | trainer`
//!
//! Without FRAMES and STRIDE every seed has its own timing ([`Options::training`]).
#![deny(unsafe_code)]

use sf_synth::{Options, Split, stream};
use std::io::BufWriter;

fn main() -> Result<(), Box<dyn std::error::Error>> {
    let args: Vec<String> = std::env::args().skip(1).collect();
    let (plain, timing) = args.split_at(args.len().min(4));
    let ([split, first, count, size], [] | [_, _]) = (plain, timing) else {
        return Err("usage: stream train|held-out FIRST_SEED COUNT WxH [FRAMES STRIDE]".into());
    };
    let split = match split.as_str() {
        "train" => Split::Train,
        "held-out" => Split::HeldOut,
        other => return Err(format!("{other} is neither train nor held-out").into()),
    };
    let (w, h) = size.split_once('x').ok_or("size must be WxH")?;
    let (w, h) = (w.parse()?, h.parse()?);
    let seeds = split.seeds(first.parse()?).take(count.parse()?);
    let timing = match timing {
        [frames, stride] => Some((frames.parse()?, stride.parse()?)),
        _ => None,
    };
    let mut out = BufWriter::with_capacity(1 << 20, std::io::stdout().lock());
    let options = |seed| {
        let options = Options::training(seed, w, h);
        timing.map_or(options.clone(), |(frames, stride)| Options { frames, stride, ..options })
    };
    let clips = stream(seeds, options, &mut out)?;
    eprintln!("{clips} clips");
    Ok(())
}
