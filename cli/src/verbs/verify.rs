//! `verify`: is this weight blob whole, and does it run here?
//!
//! Structure, every tensor's digest and every value are checked exactly as the engine checks them at
//! load.

use crate::args::{Load, path_json};
use crate::output::{Console, human_bytes, human_count};
use serde_json::json;
use sf_formats::blob::{Blob, Verify};
use sf_formats::digest::{Digest, hex, parse_hex};
use sf_formats::error::escape_path;
use sf_formats::{Result, arch};
use std::path::PathBuf;
use std::time::Instant;

/// What to verify.
#[derive(clap::Args)]
pub(crate) struct Args {
    /// Weight blob (.sfw)
    #[arg(short, long, value_name = "BLOB")]
    model: PathBuf,
    /// The digest the blob must have, 64 hexadecimal digits
    #[arg(long, value_name = "HEX", value_parser = digest)]
    digest: Option<Digest>,
    /// How the weight blob is read
    #[arg(long, value_enum, default_value_t = Load::Map)]
    load: Load,
}

fn digest(text: &str) -> Result<Digest, String> {
    parse_hex(text).ok_or_else(|| "a digest is 64 hexadecimal digits".into())
}

/// Prints the report.
pub(crate) fn run(args: &Args, console: &Console) -> Result<()> {
    let start = Instant::now();
    let blob = Blob::open(&args.model, args.load.mode(), Verify::Digests)?;
    let seconds = start.elapsed().as_secs_f64();
    if let Some(expected) = &args.digest {
        blob.expect_digest(expected)?;
    }
    let bytes = blob.file_bytes();
    let parameters = arch::parameters(blob.config());
    let json = json!({
        "schema": "streetforward.verify/1",
        "path": path_json(&args.model),
        "digest": hex(blob.digest()),
        "bytes": bytes,
        "tensor_count": blob.tensors().len(),
        "parameters": parameters,
        "verify_ms": seconds * 1e3,
    });
    let mut text = String::new();
    let mut row = |name: &str, value: String| text.push_str(&format!("{name:<10} {value}\n"));
    row("file", escape_path(&args.model));
    row("digest", hex(blob.digest()));
    row("network", format!("{} parameters in {} tensors", human_count(parameters), blob.tensors().len()));
    row(
        "verified",
        format!(
            "structure, {} tensor digests, {} in {:.0} ms ({:.2} GB/s)",
            blob.tensors().len(),
            human_bytes(bytes as u64),
            seconds * 1e3,
            bytes as f64 * 1e-9 / seconds.max(1e-9)
        ),
    );
    console.report(&json, &text)
}
