//! What the cross-crate tests share.
//!
//! | file | what |
//! |---|---|
//! | `nano.rs` | the shipped network and held-out streets for it |
//! | `int8.rs` | int8 models of tensors in memory, and the network that breaks naive quantization |
//! | `tiny.rs` | tiny random networks, clips for them, and all stages of a run |
#![deny(unsafe_code)]

pub mod int8;
pub mod nano;
pub mod tiny;
