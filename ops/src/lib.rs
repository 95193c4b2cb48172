//! Kernels of the network: they know slices and shapes, not files and not the model.
//!
//! | file | what |
//! |---|---|
//! | `mat.rs` | [`Mat`], [`Hwc`]: borrowed matrices and images |
//! | `par.rs` | [`Pool`](par::Pool): the threads; the only file that makes any |
//! | `cpu.rs` | [`Features`](cpu::Features), [`Isa`](cpu::Isa), [`Kernels`], [`Ctx`]: what this CPU can do and which rows follow |
//! | `simd/` | 16-lane vectors, one file per instruction set, and the table of vector kernels |
//! | `gemm/` | matrix product with f32 or f16 weights in K1N16 panels; its table and packers |
//! | `gemm/s8/` | matrix product with int8 activations and weights, exact sums |
//! | `quantize.rs` `hadamard.rs` | rows to int8 per token, after layer norm and random-sign Hadamard rotation |
//! | `attention/` | frame-masked attention with streaming softmax, in f32 and in int8 |
//! | `conv.rs` `conv_s8.rs` | convolution and transposed convolution through the panels, f32 and int8 |
//! | `conv_map.rs` | bands, and windows read in place |
//! | `layernorm.rs` `rope.rs` | norms and rotary embedding |
//! | `activation.rs` `elementwise.rs` | exp, sigmoid, erf, gelu; sums, the check for NaN and infinities |
//! | `shuffle.rs` | the pixel shuffle |
//! | `resize.rs` | bilinear maps, Pillow's 8-bit resize, position tables |
//! | `trig.rs` | f64 sin, cos, exp, ln for tables |
//! | `prefetch.rs` | the hint to fetch a cache line |
//! | `opclock.rs` | time and work of the operations by kind, for profiles |
//! | `peak.rs` | the arithmetic peak of one core, for `doctor` and `bench` |
//! | `reference.rs` | the definition of every op in plain loops |
//!
//! Activations are f32, row-major, channels last. Shape mistakes are programmer errors and panic with the
//! numbers.
#![deny(unsafe_code)]

pub mod activation;
pub mod attention;
pub mod conv;
pub(crate) mod conv_map;
pub mod conv_s8;
pub mod cpu;
pub mod elementwise;
pub mod gemm;
pub mod hadamard;
pub mod layernorm;
pub mod mat;
pub mod opclock;
pub mod par;
pub mod peak;
pub mod prefetch;
pub mod quantize;
pub mod reference;
pub mod resize;
pub mod rope;
pub mod shuffle;
pub mod simd;
pub mod trig;

pub use cpu::{Ctx, Kernels};
pub use mat::{Hwc, HwcMut, Mat, MatMut};
