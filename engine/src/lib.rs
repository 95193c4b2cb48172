//! The StreetForward network: a clip of street images in, a moving 3D street out.
//!
//! | file | what |
//! |---|---|
//! | `model.rs` | [`Model`]: a weight blob and typed handles into it |
//! | `session.rs` | [`Session`]: a model ready for clips of one shape; [`Options`] |
//! | `dims.rs` | [`ClipShape`]: what a session is made for, checked once; its token counts |
//! | `plan.rs` `held.rs` `arena.rs` | [`Plan`]: every size before the first frame; what a session holds; the one block of memory |
//! | `cost.rs` | [`Cost`]: the multiply-adds of a run, stage by stage |
//! | `input.rs` `preprocess.rs` | [`Input`]: frames at the network's size; resizing to it |
//! | `forward.rs` | the order of the network |
//! | `encoder.rs` | DINOv2 with registers, frame by frame |
//! | `aggregator.rs` | alternating frame and global attention |
//! | `block.rs` `net.rs` | the one transformer block; linear layers of every precision |
//! | `features.rs` | the tokens that heads read, where they lie |
//! | `heads/` | camera, linear, guided and DPT heads |
//! | `causal.rs` | the two masked passes over time |
//! | `rotation.rs` `intrinsics.rs` `unproject.rs` | poses, focal lengths, centres |
//! | `gaussians.rs` `motion.rs` | from raw channels to splats and velocities |
//! | `embed.rs` `tables.rs` | sinusoids and per-shape tables |
//! | `output.rs` | [`Output`], and the [`Scene`](sf_formats::Scene) made of it |
//! | `probe.rs` | stage taps, cancel flag, guard against broken numbers, clock |
//! | `reference/` | the whole network again, plainly, for judging the above |
//!
//! The result has the same bits for any number of threads and on any CPU: reductions have one order, work
//! is split by shape, and nothing here calls the platform's maths library.
//!
//! ```no_run
//! use sf_formats::blob::LoadMode;
//! use std::sync::Arc;
//! use streetforward::{ClipShape, Input, Model, Options, Session};
//!
//! # fn main() -> sf_formats::Result<()> {
//! let model = Arc::new(Model::open("nano.sfw".as_ref(), LoadMode::Map)?);
//! let shape = ClipShape { frames: 2, height: 168, width: 252 };
//! let mut session = Session::new(Arc::clone(&model), shape, Options::default())?;
//! println!("{}", session.plan());
//! let images = vec![127; 2 * 168 * 252 * 3];
//! let output = session.run(&Input { shape, images: &images, times: &[0.0, 0.1], k: None })?;
//! let scene = output.to_scene(model.config(), &[]);
//! println!("{} Gaussians", scene.len());
//! # Ok(())
//! # }
//! ```
#![deny(unsafe_code)]

mod aggregator;
mod arena;
mod block;
mod causal;
mod cost;
mod dims;
mod embed;
mod encoder;
mod features;
mod forward;
mod gaussians;
mod heads;
mod held;
mod input;
mod intrinsics;
mod model;
mod motion;
mod net;
mod output;
mod plan;
pub mod preprocess;
mod probe;
pub mod reference;
mod rotation;
mod session;
mod tables;
mod unproject;

pub use cost::{Cost, StageCost};
pub use dims::{ClipShape, MAX_FRAMES, MAX_PIXELS, MAX_TOKENS};
pub use input::Input;
pub use model::Model;
pub use output::{Flags, FrameSource, Output};
pub use plan::{DEFAULT_MAX_BYTES, Plan};
pub use preprocess::{Prepared, SourceFrame};
pub use probe::{Tap, TapFn};
pub use session::{MAX_THREADS, Options, Session, StageTime};
