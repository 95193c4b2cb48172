//! Everything that crosses a process boundary.
//!
//! | file | what |
//! |---|---|
//! | `error.rs` | [`Error`], [`Status`]: one line per fault, exit code = C API value |
//! | `config.rs` | [`ModelConfig`]: every size and every convention of the network, presets |
//! | `arch.rs` | the exact set of tensors a [`ModelConfig`] asks for |
//! | `atomic.rs` | whole-or-nothing writing: temporary file, then rename |
//! | `camera.rs` | [`Pose`], [`Intrinsics`], [`Camera`] |
//! | `checkpoint.rs` | [`checkpoint::open`]: training checkpoints, read tensor by tensor |
//! | `safetensors_in.rs`, `torch_in.rs` | the two checkpoint formats |
//! | `sniff.rs`, `json.rs` | what a file is by its content; JSON without equal keys |
//! | `scene.rs` | [`Scene`]: moving Gaussians; the composition at any time |
//!
//! Axes everywhere: OpenCV camera (x right, y down, z forward), camera-to-world poses, world = first
//! camera, seconds, scene units.
#![deny(unsafe_code)]

pub mod arch;
pub mod atomic;
pub mod camera;
pub mod checkpoint;
pub mod config;
pub mod digest;
pub mod error;
mod json;
mod map;
mod safetensors_in;
pub mod panel;
pub mod meta;
pub mod scene;
pub mod sniff;
#[cfg(feature = "pytorch")]
mod torch_in;

pub use camera::{Camera, Intrinsics, Pose};
pub use config::ModelConfig;
pub use error::{Error, Result, Status};
pub use scene::{Gaussians, Scene};
