//! Sixteen-lane vectors.
pub mod table;
