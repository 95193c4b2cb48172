//! One process of `bench/peers`: this engine, run by lines on standard input.
//!
//! ```text
//! sf-peer-worker network MODEL FRAMES WIDTH HEIGHT THREADS CLIP TIMES     clip: raw RGB bytes; times: 0,0.5,...
//! sf-peer-worker work THREADS KIND SIZE...                                see work.rs
//! ```
//!
//! It prints `ready` after its first run. Then `run N` prints the nanoseconds of N runs, `save DIR` writes the outputs of
//! the last run as raw little-endian f32 files and prints `saved`; the end of the input ends it.
#![forbid(unsafe_code)]

mod network;
mod work;

use std::io::{BufRead, Write};
use std::process::ExitCode;
use std::time::Instant;

/// What can be run again and again.
trait Work {
    fn run(&mut self) -> Result<(), String>;

    fn save(&self, _folder: &str) -> Result<(), String> {
        Err("nothing to save".into())
    }
}

fn make(args: &[String]) -> Result<Box<dyn Work>, String> {
    match args.first().map(String::as_str) {
        Some("network") => network::open(&args[1..]),
        Some("work") => work::open(&args[1..]),
        _ => Err("network MODEL FRAMES WIDTH HEIGHT THREADS CLIP TIMES, or work THREADS KIND SIZE...".into()),
    }
}

fn serve() -> Result<(), String> {
    let args: Vec<String> = std::env::args().skip(1).collect();
    let mut work = make(&args)?;
    work.run()?;
    let mut out = std::io::stdout().lock();
    let mut say = |text: String| writeln!(out, "{text}").and_then(|()| out.flush()).map_err(|e| e.to_string());
    say("ready".into())?;
    for line in std::io::stdin().lock().lines() {
        let line = line.map_err(|e| e.to_string())?;
        match line.split_once(' ') {
            Some(("run", n)) => {
                let n: usize = n.parse().map_err(|_| format!("run {n}: not a number"))?;
                let mut times = String::new();
                for _ in 0..n {
                    let start = Instant::now();
                    work.run()?;
                    times.push_str(&format!("{} ", start.elapsed().as_nanos()));
                }
                say(times)?;
            }
            Some(("save", folder)) => {
                work.save(folder)?;
                say("saved".into())?;
            }
            _ => return Err(format!("{line:?} is no command")),
        }
    }
    Ok(())
}

fn main() -> ExitCode {
    match serve() {
        Ok(()) => ExitCode::SUCCESS,
        Err(why) => {
            eprintln!("error: {why}");
            ExitCode::FAILURE
        }
    }
}
