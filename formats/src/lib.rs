//! Everything that crosses a process boundary.
//!
//! | file | what |
//! |---|---|
//! | `error.rs` | [`Error`], [`Status`]: one line per fault, exit code = C API value |
//! | `config.rs` | [`ModelConfig`]: every size and every convention of the network, presets |
//! | `arch.rs` | the exact set of tensors a [`ModelConfig`] asks for |
//! | `atomic.rs` | whole-or-nothing writing: temporary file, then rename |
//! | `camera.rs` | [`Pose`], [`Intrinsics`], [`Camera`] |
//! | `scene.rs` | [`Scene`]: moving Gaussians; the composition at any time |
//!
//! Axes everywhere: OpenCV camera (x right, y down, z forward), camera-to-world poses, world = first
//! camera, seconds, scene units.
#![deny(unsafe_code)]

pub mod arch;
pub mod atomic;
pub mod camera;
pub mod config;
pub mod error;
pub mod scene;

pub use camera::{Camera, Intrinsics, Pose};
pub use config::ModelConfig;
pub use error::{Error, Result, Status};
pub use scene::{Gaussians, Scene};
