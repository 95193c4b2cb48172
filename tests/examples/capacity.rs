//! Time and memory of a seeded random network of a preset on one clip shape.
//!
//! ```text
//! cargo run --release -p sf-tests --example capacity -- base 4 252x168 f32 2
//! ```
//! Arguments: preset, frames, width x height, weight type (f32, f16), threads (0: all). Prints the plan and the
//! wall time of every stage of the second run.

use sf_formats::blob::{Blob, Dtype};
use sf_formats::{Error, ModelConfig, Result};
use sf_quant::convert::{Options as Convert, convert_to_bytes};
use sf_quant::seeded::{Outputs, Seeded};
use sf_tests::tiny::Frames;
use std::sync::Arc;
use std::time::Instant;
use streetforward::{Model, Options, Session};

fn main() -> Result<()> {
    let arguments: Vec<String> = std::env::args().skip(1).collect();
    let [preset, frames, size, dtype, threads] = &arguments[..] else {
        return Err(Error::usage("capacity PRESET FRAMES WxH f32|f16 THREADS"));
    };
    let number = |text: &str| text.parse::<usize>().map_err(|e| Error::usage(format!("{text}: {e}")));
    let config = ModelConfig::preset(preset).ok_or_else(|| Error::usage(format!("preset {preset} is unknown")))?;
    let dtype = if dtype == "f16" { Dtype::F16 } else { Dtype::F32 };
    let (w, h) = size.split_once('x').ok_or_else(|| Error::usage("the size is WIDTHxHEIGHT"))?;

    let clock = Instant::now();
    let bytes = convert_to_bytes(&Seeded::new(&config, 1, Outputs::Random)?, &Convert::to(dtype))?;
    let model = Arc::new(Model::from_blob(Blob::from_bytes(&bytes)?)?);
    drop(bytes);
    println!("{preset}: {} parameters made in {:.1} s", model.parameters(), clock.elapsed().as_secs_f64());

    let clip = Frames::new(number(frames)?, number(h)?, number(w)?, 1);
    let options = Options { threads: number(threads)?, ..Options::default() };
    let mut session = Session::new(model, clip.shape, options)?;
    println!("{}", session.plan());
    for run in ["first", "second"] {
        let clock = Instant::now();
        session.run(&clip.input())?;
        println!("{run} run    {:9.1} ms", clock.elapsed().as_secs_f64() * 1e3);
    }
    for stage in session.stage_times() {
        println!("  {:12} {:9.1} ms", stage.name, stage.time.as_secs_f64() * 1e3);
    }
    Ok(())
}
