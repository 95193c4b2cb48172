//! The C interface: `include/streetforward.h` describes every function and struct.
//!
//! | file | what |
//! |---|---|
//! | `call.rs` | what every function does: catch panics, keep the caller's floating-point mode, keep the message |
//! | `handle.rs` | numbers for objects: a wrong, used-up or busy one is a status, never a crash |
//! | `memory.rs` | the caller's structs and arrays: null, size and alignment checks |
//! | `raster.rs` | contexts, images of Gaussians and their gradients |
//!
//! `unsafe` is what C needs: reading and writing through the caller's pointers, in `memory.rs`, and the functions that
//! hand those pointers on.
#![deny(unsafe_code)]

mod call;
mod handle;
mod memory;
mod raster;

#[cfg(test)]
mod tests;

/// Changes when an existing function or struct changes.
const ABI_VERSION: u32 = 1;
