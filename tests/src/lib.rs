//! What the cross-crate tests share.
//!
//! | file | what |
//! |---|---|
//! | `tiny.rs` | tiny random networks, clips for them, and all stages of a run |
#![deny(unsafe_code)]

pub mod tiny;
