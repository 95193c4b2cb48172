//! Which network: presets and configuration files for `init` and `convert`; checkpoints with a progress bar.

use crate::progress::Progress;
use clap::ValueEnum;
use sf_formats::checkpoint::{Checkpoint, CheckpointTensor};
use sf_formats::error::escape_path;
use sf_formats::open::read_regular;
use sf_formats::{Error, ModelConfig, Result};
use std::path::{Path, PathBuf};

/// Longest configuration file that is read; a complete one has some 4 kB.
const CONFIG_CAP: u64 = 1 << 20;

/// A network's sizes.
#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum)]
pub(crate) enum Preset {
    /// 4.4 M parameters: demonstrations, small machines
    Nano,
    /// 114 M parameters
    Base,
    /// 1.1 G parameters, the published size
    Full,
    /// Public Pi3: poses and points, no Gaussians, no motion
    Pi3,
}

/// Kind of the dense heads.
#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum)]
pub(crate) enum Heads {
    /// The preset's or configuration's: convolutional pyramids, or convolutions beside the image (nano)
    Own,
    /// Transformer decoder and one linear layer, as Pi3's own heads
    Linear,
}

/// The network flags of `init`.
#[derive(clap::Args, Clone, Debug)]
pub(crate) struct NetworkArgs {
    /// Sizes of the network
    #[arg(long, value_enum, default_value_t = Preset::Nano)]
    preset: Preset,
    /// JSON file of settings (flat keys, docs/network.md); what it leaves out is as in base
    #[arg(long, value_name = "FILE", conflicts_with = "preset")]
    config: Option<PathBuf>,
    /// Kind of the dense heads
    #[arg(long, value_enum)]
    heads: Option<Heads>,
}

impl NetworkArgs {
    /// The configuration, checked.
    pub(crate) fn config(&self) -> Result<ModelConfig> {
        let config = match &self.config {
            Some(file) => read_config(file)?,
            None => preset(self.preset),
        };
        Ok(with_heads(config, self.heads))
    }
}

/// The network with heads of the kind asked for.
pub(crate) fn with_heads(config: ModelConfig, heads: Option<Heads>) -> ModelConfig {
    match heads {
        Some(Heads::Linear) => config.with_linear_heads(),
        Some(Heads::Own) | None => config,
    }
}

/// The configuration of a preset.
pub(crate) fn preset(preset: Preset) -> ModelConfig {
    match preset {
        Preset::Nano => ModelConfig::nano(),
        Preset::Base => ModelConfig::base(),
        Preset::Full => ModelConfig::full(),
        Preset::Pi3 => ModelConfig::pi3(),
    }
}

/// Reads a configuration file.
pub(crate) fn read_config(path: &Path) -> Result<ModelConfig> {
    let text = read_text(path, CONFIG_CAP)?;
    ModelConfig::from_json(&text, &escape_path(path))
}

/// A small text file of at most `cap` bytes.
pub(crate) fn read_text(path: &Path, cap: u64) -> Result<String> {
    let bytes = read_regular(path, cap)?
        .ok_or_else(|| Error::input(escape_path(path), format!("longer than {cap} bytes: not such a file")))?;
    String::from_utf8(bytes).map_err(|_| Error::input(escape_path(path), "is not UTF-8 text"))
}

/// A checkpoint that steps a progress bar with every tensor read.
pub(crate) struct Watched<'a> {
    source: &'a dyn Checkpoint,
    progress: &'a Progress,
}

impl<'a> Watched<'a> {
    /// Watches `source`.
    pub(crate) fn new(source: &'a dyn Checkpoint, progress: &'a Progress) -> Watched<'a> {
        Watched { source, progress }
    }
}

impl Checkpoint for Watched<'_> {
    fn tensors(&self) -> &[CheckpointTensor] {
        self.source.tensors()
    }

    fn read_f32(&self, index: usize, out: &mut Vec<f32>) -> Result<()> {
        self.progress.step();
        self.source.read_f32(index, out)
    }

    fn metadata(&self, key: &str) -> Option<&str> {
        self.source.metadata(key)
    }

    fn describe(&self) -> String {
        self.source.describe()
    }

    fn digest(&self) -> Result<[u8; 32]> {
        self.source.digest()
    }
}
