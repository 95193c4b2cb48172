//! `verify`: is this weight blob whole, and does it run here?
//!
//! Structure, every tensor's digest and every value are checked exactly as the engine checks them at
//! load. With `--run` three small seeded clips go through the network on several numbers of threads: the digests of
//! everything predicted must be equal, and equal to the one that the converter found and stored.

use crate::args::{self, Load, path_json};
use crate::golden::{self, How};
use crate::output::{Console, human_bytes, human_count};
use serde_json::json;
use sf_formats::blob::{Blob, Verify};
use sf_formats::digest::{Digest, hex, parse_hex};
use sf_formats::error::escape_path;
use sf_formats::meta::keys;
use sf_formats::{Error, Result, arch};
use sf_ops::cpu::Isa;
use sf_quant::convert::NO_DIGEST;
use std::path::PathBuf;
use std::sync::Arc;
use std::time::Instant;
use streetforward::Model;

/// What to verify.
#[derive(clap::Args)]
pub(crate) struct Args {
    /// Weight blob (.sfw)
    #[arg(short, long, value_name = "BLOB")]
    model: PathBuf,
    /// The digest the blob must have, 64 hexadecimal digits
    #[arg(long, value_name = "HEX", value_parser = digest)]
    digest: Option<Digest>,
    /// Run three small seeded clips and compare threads, repeats and what the converter found
    #[arg(long)]
    run: bool,
    /// Numbers of threads of --run, each at most 64
    #[arg(long, value_name = "LIST", value_delimiter = ',', default_value = "1,2", requires = "run", value_parser = clap::value_parser!(u32).range(1..=64))]
    threads: Vec<u32>,
    /// Runs of every clip and number of threads
    #[arg(long, value_name = "N", default_value_t = 1, requires = "run", value_parser = clap::value_parser!(u32).range(1..=1_000_000))]
    repeat: u32,
    /// Highest instruction set of --run: scalar, avx2, avxvnni, avx512, avx512vnni, neon, neondot
    #[arg(long, value_name = "ISA", requires = "run", value_parser = args::isa)]
    isa: Option<Isa>,
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
    let golden = blob.meta().text(keys::GOLDEN).filter(|g| *g != NO_DIGEST).map(str::to_string);
    let how = How {
        threads: args.threads.iter().map(|&n| n as usize).collect(),
        repeat: args.repeat as usize,
        isa: args.isa,
    };
    let ran = match args.run {
        true => {
            Some((hex(&golden::run(&Arc::new(Model::from_blob(blob)?), &how)?), args::kernels(args.isa)?.isa.name()))
        }
        false => None,
    };
    if let (Some((ran, _)), Some(golden)) = (&ran, &golden)
        && ran != golden
    {
        let why = format!("the golden run gives {ran}, the converter found {golden}: this machine computes otherwise");
        return Err(Error::integrity(escape_path(&args.model), why));
    }
    let json = json!({
        "schema": "streetforward.verify/1",
        "path": path_json(&args.model),
        "digest": digest,
        "bytes": bytes,
        "tensor_count": tensors,
        "parameters": parameters,
        "verify_ms": seconds * 1e3,
        "run_digest": ran.as_ref().map(|r| &r.0),
        "isa": ran.as_ref().map(|r| r.1),
        "threads": ran.as_ref().map(|_| &args.threads),
        "repeat": ran.as_ref().map(|_| args.repeat),
        "golden_digest": golden,
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
    if let Some((ran, isa)) = ran {
        let threads: Vec<String> = args.threads.iter().map(u32::to_string).collect();
        let known = if golden.is_some() { ", as the converter found" } else { "" };
        row("ran", format!("{ran} with {isa} on {} threads{known}", threads.join(", ")));
    }
    console.report(&json, &text)
}
