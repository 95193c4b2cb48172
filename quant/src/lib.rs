//! Checkpoint to weight blob, and seeded random networks.
//!
//! | file | what |
//! |---|---|
//! | `convert.rs` | [`convert()`]: a checkpoint to a `.sfw` blob, streaming |
//! | `recipe.rs` | which matrix gets which type, what is folded into it |
//! | `quantize.rs` | one matrix to int8: folding, rotation, step, rounding |
//! | `calibrate.rs` | rounding that knows the inputs, from clips |
//! | `work.rs` | multiply-adds of a matrix |
//! | `names.rs` | wrapper prefixes, VGGT's names, nearest names |
//! | `detect.rs` | a configuration from names and shapes |
//! | `report.rs` | [`Report`]: what a conversion did |
//! | `seeded.rs` | [`Seeded`]: the random network of a configuration and a seed |
//! | `rng.rs` | random numbers by position |
//! | `safetensors_out.rs` | [`write_safetensors`] |
//!
//! A random model as a checkpoint, and directly as a blob in memory:
//!
//! ```
//! use sf_formats::{Blob, Dtype, ModelConfig};
//! use sf_quant::{Options, Outputs, Seeded, convert_to_bytes};
//!
//! # fn main() -> sf_formats::Result<()> {
//! let mut config = ModelConfig::nano().with_linear_heads();
//! config.encoder.depth = 1;
//! let random = Seeded::new(&config, 7, Outputs::Random)?;
//! let blob = Blob::from_bytes(&convert_to_bytes(&random, &Options::to(Dtype::F16))?)?;
//! assert_eq!(*blob.config(), config);
//! # Ok(())
//! # }
//! ```
#![deny(unsafe_code)]

pub mod calibrate;
pub mod convert;
mod detect;
pub mod names;
pub mod quantize;
mod recipe;
pub mod report;
pub mod rng;
mod safetensors_out;
pub mod seeded;
pub mod work;

pub use calibrate::Calibration;
pub use convert::{Options, convert, convert_checked, convert_files, convert_to_bytes, parse_keep, plan, plan_files};
pub use report::Report;
pub use safetensors_out::write_safetensors;
pub use seeded::{Outputs, Seeded};
