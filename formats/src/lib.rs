//! Everything that crosses a process boundary.
//!
//! | file | what |
//! |---|---|
//! | `error.rs` | [`Error`], [`Status`]: one line per fault, exit code = C API value |
//! | `config.rs` | [`ModelConfig`]: every size and every convention of the network |
//! | `setting.rs`, `presets.rs`, `config_check.rs` | its value types, its named instances, its caps |
//! | `arch.rs` | the exact set of tensors a [`ModelConfig`] asks for |
//! | `blob.rs` | [`Blob`]: the `.sfw` weight file, validated and used in place |
//! | `blob_check.rs` | its validation, cheapest step first |
//! | `blob_layout.rs` | every offset and limit of the format |
//! | `blob_writer.rs` | [`BlobWriter`]: writes one, tensor by tensor |
//! | `meta.rs` | [`Meta`]: typed metadata of a blob |
//! | `panel.rs`, `panel_s8.rs` | order of a matrix's weights in a blob: floats; int8 with scales, sums, signs |
//! | `digest.rs` | SHA-256 |
//! | `open.rs` | opening and reading regular files safely |
//! | `map.rs` | the one memory mapping |
//! | `atomic.rs` | whole-or-nothing writing: temporary file, then rename |
//! | `camera.rs` | [`Pose`], [`Intrinsics`], [`Camera`] |
//! | `checkpoint.rs` | [`checkpoint::open`]: training checkpoints, read tensor by tensor |
//! | `checkpoint_source.rs` | [`checkpoint::Checkpoint`]: what every checkpoint format gives |
//! | `safetensors_in.rs`, `torch_in.rs` | the two formats |
//! | `clip.rs` | [`clip::Clip`]: frames, times, intrinsics, reference poses |
//! | `clip_source.rs`, `transforms.rs` | what a path holds: folders, lists, `transforms.json` |
//! | `truth.rs` | [`clip::GroundTruth`]; clips as folders with it |
//! | `y4m_in.rs` | [`y4m_in::Y4mReader`]: uncompressed video through a pipe |
//! | `image_io.rs`, `npy.rs` | PNG and JPEG pictures, NumPy arrays |
//! | `picture.rs`, `label.rs` | depth, velocity and other numbers as pictures with a known scale; small text |
//! | `scene_io.rs`, `ply.rs` | [`Scene::save`], [`Scene::load`]; splats as PLY and PLY sequences |
//! | `splat_file.rs`, `apng.rs`, `y4m.rs` | splats as `.splat`; animated PNG; uncompressed video |
//! | `camera_json.rs`, `poses_io.rs` | camera paths; poses for nerfstudio, TUM, KITTI, COLMAP |
//! | `sniff.rs`, `json.rs` | what a file is by its content; JSON without equal keys |
//! | `scene.rs` | [`Scene`]: moving Gaussians; the composition at any time |
//!
//! Axes everywhere: OpenCV camera (x right, y down, z forward), camera-to-world poses, world = first
//! camera, seconds, scene units.
#![deny(unsafe_code)]

pub mod apng;
pub mod arch;
pub mod atomic;
pub mod blob;
mod blob_check;
pub mod blob_layout;
pub mod blob_writer;
pub mod camera;
pub mod camera_json;
pub mod checkpoint;
mod checkpoint_source;
pub mod clip;
mod clip_source;
pub mod config;
mod config_check;
pub mod digest;
pub mod error;
pub mod image_io;
mod json;
pub mod label;
mod map;
pub mod meta;
pub mod npy;
pub mod open;
pub mod panel;
pub mod panel_s8;
pub mod picture;
pub mod ply;
pub mod poses_io;
mod presets;
mod real;
mod safetensors_in;
pub mod scene;
pub mod scene_io;
mod setting;
pub mod sniff;
pub mod splat_file;
#[cfg(feature = "pytorch")]
mod torch_in;
pub mod transforms;
mod truth;
pub mod y4m;
pub mod y4m_in;

pub use blob::{Blob, Dtype, Layout, LoadMode, TensorRecord, Verify};
pub use blob_writer::BlobWriter;
pub use camera::{Camera, Intrinsics, Pose};
pub use config::ModelConfig;
pub use error::{Error, Result, Status};
pub use meta::Meta;
pub use scene::{Gaussians, Scene};
