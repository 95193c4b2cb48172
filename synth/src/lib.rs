//! Seeded procedural street clips with exact ground truth: colour, z-depth, object numbers, world velocity,
//! camera poses and intrinsics.
//!
//! | file | what |
//! |---|---|
//! | `street.rs` | [`Street`], [`Options`], [`Split`]: a seed becomes a clip |
//! | `style.rs` | [`Style`]: the distribution that streets are drawn from |
//! | `scene.rs`, `plan.rs`, `frontage.rs`, `traffic.rs` | [`SceneSpec`]: the plan, what stands, what moves |
//! | `clip.rs`, `stream.rs` | a clip as a folder; many clips as one binary stream |
//! | `camera_motion.rs`, `motion.rs` | how the camera car and everything else moves, with exact derivatives |
//! | `ground.rs`, `buildings.rs`, `vegetation.rs`, `furniture.rs`, `vehicles.rs`, `people.rs`, `sky.rs` | what a street is made of |
//! | `facade.rs`, `paint.rs` | what is drawn on houses and vehicles |
//! | `body.rs`, `shape.rs`, `material.rs`, `surface.rs`, `texture.rs`, `light.rs`, `shadow.rs` | parts, primitives, surfaces |
//! | `view.rs`, `raycast.rs` | a camera and its rays; from a scene to pixels |
//! | `math.rs` | functions and random numbers with the same bits on every CPU |
//!
//! Everything is a function of the seed and the options alone: no platform mathematics, no clocks, and
//! threads only split whole frames and clips.
//!
//! ```
//! use sf_synth::{Options, Split, Street};
//!
//! let seed = Split::HeldOut.seeds(0).next().unwrap();
//! let street = Street::new(seed, Options { width: 126, height: 84, ..Options::default() })?;
//! let frame = street.frame(3);
//! let centre = 42 * 126 + 63;
//! let point = frame.camera.unproject(63.5, 42.5, f64::from(frame.depth[centre]));
//! assert!(point.is_finite() && frame.rgb.len() == 3 * 126 * 84);
//! # Ok::<(), sf_formats::Error>(())
//! ```
#![deny(unsafe_code)]

mod body;
mod buildings;
mod camera_motion;
mod clip;
mod facade;
mod frontage;
mod furniture;
mod ground;
mod light;
mod material;
mod math;
mod motion;
mod paint;
mod people;
mod plan;
mod raycast;
mod scene;
mod shadow;
mod shape;
mod sky;
mod stream;
mod street;
mod style;
mod surface;
mod texture;
mod traffic;
mod vegetation;
mod vehicles;
mod view;

pub use clip::write_clip;
pub use raycast::{FAR, ID_GROUND, ID_SKY};
pub use scene::SceneSpec;
pub use stream::{HEADER, MAGIC, stream};
pub use street::{DYNAMIC, Frame, Options, Split, Street};
pub use style::Style;
