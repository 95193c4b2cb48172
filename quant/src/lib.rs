//! Checkpoint to weight blob, and seeded random networks.
//!
//! | file | what |
//! |---|---|
//! | `seeded.rs` | [`Seeded`]: the random network of a configuration and a seed |
//! | `rng.rs` | random numbers by position |
//! | `safetensors_out.rs` | [`write_safetensors`] |
#![deny(unsafe_code)]

pub mod rng;
mod safetensors_out;
pub mod seeded;

pub use safetensors_out::write_safetensors;
pub use seeded::{Outputs, Seeded};
