//! Training clips of one split to standard output, in the layout of `sf_synth::stream`.
//!
//! `cargo run --release -p sf-synth --example stream -- train|held-out FIRST_SEED COUNT WxH | trainer`
#![deny(unsafe_code)]

use sf_synth::{Options, Split, stream};
use std::io::BufWriter;

fn main() -> Result<(), Box<dyn std::error::Error>> {
    let args: Vec<String> = std::env::args().skip(1).collect();
    let [split, first, count, size] = &args[..] else {
        return Err("usage: stream train|held-out FIRST_SEED COUNT WxH".into());
    };
    let split = match split.as_str() {
        "train" => Split::Train,
        "held-out" => Split::HeldOut,
        other => return Err(format!("{other} is neither train nor held-out").into()),
    };
    let (w, h) = size.split_once('x').ok_or("size must be WxH")?;
    let (w, h) = (w.parse()?, h.parse()?);
    let seeds = split.seeds(first.parse()?).take(count.parse()?);
    let mut out = BufWriter::with_capacity(1 << 20, std::io::stdout().lock());
    let clips = stream(seeds, |seed| Options::training(seed, w, h), &mut out)?;
    eprintln!("{clips} clips");
    Ok(())
}
