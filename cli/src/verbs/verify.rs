//! `verify`: is this weight blob whole, and does it run here?
//!
//! Structure, every tensor's digest and every value are checked exactly as the engine checks them at
//! load. With `--run` a small seeded clip goes through the network on one thread and on two: the digests of
//! everything predicted must be equal, and can be compared between machines.

use crate::args::{Load, path_json};
use crate::output::{Console, human_bytes, human_count};
use crate::reconstruct::output_digest;
use serde_json::json;
use sf_formats::blob::{Blob, Verify};
use sf_formats::digest::{Digest, hex, parse_hex};
use sf_formats::error::escape_path;
use sf_formats::{Error, Result, arch};
use std::path::PathBuf;
use std::sync::Arc;
use std::time::Instant;
use streetforward::{ClipShape, Input, Model, Options, Session};

/// What to verify.
#[derive(clap::Args)]
pub(crate) struct Args {
    /// Weight blob (.sfw)
    #[arg(short, long, value_name = "BLOB")]
    model: PathBuf,
    /// The digest the blob must have, 64 hexadecimal digits
    #[arg(long, value_name = "HEX", value_parser = digest)]
    digest: Option<Digest>,
    /// Run a small seeded clip on one and on two threads and compare
    #[arg(long)]
    run: bool,
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
    let tensors = blob.tensors().len();
    let digest = hex(blob.digest());
    let ran = if args.run { Some(hex(&self_test(blob)?)) } else { None };
    let json = json!({
        "schema": "streetforward.verify/1",
        "path": path_json(&args.model),
        "digest": digest,
        "bytes": bytes,
        "tensor_count": tensors,
        "parameters": parameters,
        "verify_ms": seconds * 1e3,
        "run_digest": ran,
    });
    let mut text = String::new();
    let mut row = |name: &str, value: String| text.push_str(&format!("{name:<10} {value}\n"));
    row("file", escape_path(&args.model));
    row("digest", digest);
    row("network", format!("{} parameters in {tensors} tensors", human_count(parameters)));
    row(
        "verified",
        format!(
            "structure, {tensors} tensor digests, {} in {:.0} ms ({:.2} GB/s)",
            human_bytes(bytes as u64),
            seconds * 1e3,
            bytes as f64 * 1e-9 / seconds.max(1e-9)
        ),
    );
    if let Some(ran) = ran {
        row("ran", format!("{ran} on 1 and on 2 threads"));
    }
    console.report(&json, &text)
}

/// Runs a seeded clip of three frames, 4x3 patches each, on one and on two threads; the digest of the
/// predictions.
fn self_test(blob: Blob) -> Result<Digest> {
    let patch = blob.config().patch as usize;
    let shape = ClipShape { frames: 3, height: 3 * patch, width: 4 * patch };
    // Smooth pictures that differ from frame to frame; integer arithmetic, so equal everywhere.
    let pixel = |i: usize| {
        let (c, x, y) = (i % 3, i / 3 % shape.width, i / (3 * shape.width));
        ((x * (5 + c) + y * (3 + 2 * c) + x * y / 7) % 256) as u8
    };
    let images: Vec<u8> = (0..shape.frames * shape.height * shape.width * 3).map(pixel).collect();
    let input = Input { shape, images: &images, times: &[0.0, 0.1, 0.25], k: None };
    let place = blob.path().map_or_else(|| "blob".into(), escape_path);
    let model = Arc::new(Model::from_blob(blob)?);
    let on = |threads: usize| -> Result<Digest> {
        let mut session = Session::new(Arc::clone(&model), shape, Options { threads, ..Options::default() })?;
        Ok(output_digest(session.run(&input)?))
    };
    let (one, two) = (on(1)?, on(2)?);
    if one != two {
        let why = format!("one thread gives {}, two give {}: this machine computes wrongly", hex(&one), hex(&two));
        return Err(Error::integrity(place, why));
    }
    Ok(one)
}
