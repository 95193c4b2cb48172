//! CPU Gaussian splat rasterizer with the picture of gsplat.
//!
//! | file | what |
//! |---|---|
//! | `math.rs` | exp2, log2 and ln from own polynomials: the same bits on every CPU |
//! | `screen.rs` | a [`screen::Record`], and the tiles and blocks that it meets |
//! | `project.rs` | Gaussians -> records: culling, covariance, antialiasing, one at a time in f64 |
//! | `project_lanes.rs` | the same sixteen at a time in f32 where that is enough |
//! | `bin.rs` | records -> one list of `depth, record, blocks` keys per 32x32 tile |
//! | `blend.rs` | one tile front to back: lazy depth buckets, lists per 4x4 block, state in registers |
//! | `render.rs` | [`Renderer`]: memory, threads, output images |
//! | `blend_back.rs` | one tile back to front: gradients of its pixels -> sums per Gaussian |
//! | `project_back.rs` | sums of a Gaussian -> gradients of its fields and of the camera |
//! | `backward.rs` | [`Renderer::backward`]: both over a whole image |
//! | `reference.rs` | the same picture by brute force in f64: the oracle of the tests |
//! | `reference_grad.rs` | its gradients by the chain rule in f64 |
//!
//! The maths. A Gaussian with mean m, scale s, rotation Q seen by a camera (R, c), p = R^T (m - c):
//!
//! ```text
//! S  = J R^T Q diag(s^2) Q^T R J^T            J = d(u,v)/dp, x/z and y/z clamped to the frustum + 30 %
//! S2 = S + eps2d I                            o' = aa ? o sqrt(max(0.005^2, det S / det S2)) : o
//! sigma = 1/2 d^T S2^-1 d                     d = pixel centre (i+.5, j+.5) - (u, v)
//! alpha = min(a_max, o' exp(-sigma))          skipped below 1/255
//! C = sum T alpha c + T_end background        front to back in f32 camera z, ties by index;
//! D = sum T alpha z                           a pixel stops when the next T <= 1e-4
//! ```
//!
//! The result does not depend on the number of threads or on the CPU: no libm call, multiply-adds fused
//! where the code says so, one owner per tile, sort keys without equals.
#![deny(unsafe_code)]

pub mod backward;
pub mod bin;
pub mod blend;
mod blend_back;
pub mod math;
pub mod project;
mod project_back;
pub mod project_lanes;
pub mod reference;
pub mod reference_grad;
pub mod render;
pub mod screen;

pub use backward::Gradients;
pub use blend_back::ImageGradients;
pub use render::{Extra, RenderOptions, Rendered, Renderer, Stats, render};
pub use sf_formats::scene::SplatSettings;
