//! `init`: a seeded random network, as a checkpoint or directly as a weight blob.
//!
//! Written tensor by tensor, so that the largest preset needs little memory.

use crate::args::{FileArgs, Precision, has_extension, path_json};
use crate::golden::{self, How};
use crate::network::{self, NetworkArgs};
use crate::output::{Console, human_bytes, human_count};
use crate::signals;
use serde_json::json;
use sf_formats::blob::{Blob, LoadMode, Verify};
use sf_formats::config::Value;
use sf_formats::digest::hex;
use sf_formats::error::escape_path;
use sf_formats::meta::keys;
use sf_formats::{Error, Result, arch};
use sf_quant::{Options, Outputs, Seeded, convert_checked, write_safetensors};
use std::sync::Arc;
use streetforward::Model;

/// Which network.
#[derive(clap::Args)]
pub(crate) struct Args {
    #[command(flatten)]
    network: NetworkArgs,
    /// The same seed gives the same bytes everywhere
    #[arg(long, value_name = "N", default_value_t = 1)]
    seed: u64,
    /// Precision of a .sfw blob; a .safetensors checkpoint is f32
    #[arg(long, value_enum, default_value_t = Precision::F32)]
    to: Precision,
    #[command(flatten)]
    file: FileArgs,
}

/// Writes the file and reports.
pub(crate) fn run(args: &Args, console: &Console) -> Result<()> {
    let config = args.network.config()?;
    let output = &args.file.output;
    let blob = has_extension(output, &["sfw"]);
    if !blob && !has_extension(output, &["safetensors"]) {
        return Err(Error::usage(format!("{}: the output ends in .sfw or .safetensors", escape_path(output))));
    }
    if !blob && args.to != Precision::F32 {
        return Err(Error::usage("--to is for .sfw outputs; a checkpoint is f32"));
    }
    let seeded = Seeded::new(&config, args.seed, Outputs::Random)?;
    signals::guard_file(output);
    let progress = console.progress(seeded.specs().len() as u64, "init");
    let source = network::Watched::new(&seeded, &progress);
    let digest = if blob {
        let command = format!("init --seed {} --to {}", args.seed, args.to.dtype().name());
        let options = Options { command, golden: true, ..Options::to(args.to.dtype()) };
        convert_checked(&source, output, args.file.overwrite(), &options, |path, _| {
            let model = Arc::new(Model::from_blob(Blob::open(path, LoadMode::Map, Verify::Structure)?)?);
            Ok(vec![(keys::GOLDEN.to_string(), Value::Text(hex(&golden::run(&model, &How::default())?)))])
        })?
        .blob_digest
    } else {
        write_safetensors(&source, output, args.file.overwrite())?;
        None
    };
    drop(progress);
    let bytes = std::fs::metadata(output).map_err(|e| Error::io(output, "read", &e))?.len();
    let parameters = arch::parameters(&config);
    let json = json!({
        "schema": "streetforward.init/1",
        "output": path_json(output),
        "seed": args.seed,
        "parameters": parameters,
        "tensor_count": seeded.specs().len(),
        "bytes": bytes,
        "digest": digest.map(|d| hex(&d)),
        "config": config.to_json(),
    });
    let text = format!(
        "{} parameters in {} tensors, random from seed {}, {} in {}\n",
        human_count(parameters),
        seeded.specs().len(),
        args.seed,
        human_bytes(bytes),
        escape_path(output)
    );
    console.report(&json, &text)
}
