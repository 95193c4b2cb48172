//! Tells the sources whether the trained model is there to be built into the binary: a package without it still
//! builds, and runs random weights where none are given.

use std::path::Path;

fn main() {
    let model = Path::new("../models/nano/nano.sfw");
    println!("cargo::rustc-check-cfg=cfg(has_model)");
    println!("cargo::rerun-if-changed={}", model.display());
    println!("cargo::rerun-if-changed=build.rs");
    if std::env::var_os("CARGO_FEATURE_EMBEDDED_MODEL").is_some() && model.exists() {
        println!("cargo::rustc-cfg=has_model");
    }
}
