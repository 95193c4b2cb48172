//! What a conversion did.

use sf_formats::Dtype;
use sf_formats::config::ModelConfig;
use sf_formats::digest::{Digest, hex};

/// Where a tensor's values come from.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Origin {
    /// The checkpoint.
    Checkpoint,
    /// Absent there and allowed to be: a neutral start.
    Initialised,
}

/// One tensor of the blob.
#[derive(Clone, Debug, PartialEq)]
pub struct TensorReport {
    /// Name in the network.
    pub name: String,
    /// Shape in the checkpoint.
    pub shape: Vec<usize>,
    /// Where its values come from.
    pub origin: Origin,
    /// Stored type; planned in a dry run.
    pub dtype: Dtype,
    /// Stored bytes; 0 in a dry run.
    pub bytes: u64,
    /// Stored as f32 because a value is outside the range of f16.
    pub promoted: bool,
    /// Outputs of a linear layer or convolution whose weights are all zero.
    pub zero_outputs: usize,
    /// Signal to error of the stored weights, dB; matrices of an int8 conversion only, `None` in a dry run.
    pub sqnr_db: Option<f64>,
    /// Why a matrix is not of the type asked for.
    pub reason: Option<String>,
}

/// What a conversion did, or would do.
#[derive(Clone, Debug, PartialEq)]
pub struct Report {
    /// Configuration of the network.
    pub config: ModelConfig,
    /// Where that was found.
    pub config_source: &'static str,
    /// What the source says of itself.
    pub source: String,
    /// Precision asked for.
    pub precision: Dtype,
    /// Every tensor, in file order.
    pub tensors: Vec<TensorReport>,
    /// Wrapper prefixes taken off and from how many tensors.
    pub stripped: Vec<(String, usize)>,
    /// Tensors of the checkpoint that are no part of the network.
    pub ignored: Vec<String>,
    /// Mappings and choices worth knowing.
    pub notes: Vec<String>,
    /// Licence of the weights, as given, as stored in the checkpoint, or as known for public weights.
    pub licence: Option<String>,
    /// SHA-256 of the source; `None` in a dry run.
    pub source_digest: Option<Digest>,
    /// Digest of the blob ([`sf_formats::Blob::digest`]); `None` in a dry run.
    pub blob_digest: Option<Digest>,
}

impl Report {
    /// Number of parameters.
    pub fn parameters(&self) -> usize {
        self.tensors.iter().map(|t| t.shape.iter().product::<usize>()).sum()
    }

    /// Stored bytes of all tensors.
    pub fn tensor_bytes(&self) -> u64 {
        self.tensors.iter().map(|t| t.bytes).sum()
    }

    /// Share of the weights of matrices that are of a type, in a conversion to int8.
    pub fn matrix_share(&self, dtype: Dtype) -> f64 {
        let weights = |t: &TensorReport| t.shape.iter().product::<usize>() as f64;
        // A matrix that is not int8 says why.
        let matrices = || self.tensors.iter().filter(|t| t.reason.is_some() || t.dtype == Dtype::Int8);
        matrices().filter(|t| t.dtype == dtype).map(weights).sum::<f64>()
            / matrices().map(weights).sum::<f64>().max(1.0)
    }

    /// For people: one fact per line.
    pub fn lines(&self) -> Vec<String> {
        let mut lines = vec![
            format!("source: {}", self.source),
            format!("configuration: {}", self.config_source),
            format!("tensors: {}, parameters: {}", self.tensors.len(), self.parameters()),
        ];
        let of = |d: Dtype| self.tensors.iter().filter(|t| t.dtype == d).count();
        lines.push(format!(
            "precision {}: {} tensors int8, {} tensors f16, {} tensors f32, {} bytes",
            self.precision.name(),
            of(Dtype::Int8),
            of(Dtype::F16),
            of(Dtype::F32),
            self.tensor_bytes()
        ));
        if self.precision == Dtype::Int8 {
            let share = self.matrix_share(Dtype::Int8);
            lines.push(format!("int8: {:.2} % of the matrix weights", 100.0 * share));
            let worst =
                self.tensors.iter().filter(|t| t.dtype == Dtype::Int8).filter_map(|t| Some((t.sqnr_db?, &t.name)));
            if let Some((db, name)) = worst.min_by(|a, b| a.0.total_cmp(&b.0)) {
                lines.push(format!("lowest signal to error of int8 weights: {db:.1} dB in {name}"));
            }
        }
        for (prefix, count) in &self.stripped {
            lines.push(format!("prefix {prefix} taken off {count} tensors"));
        }
        if !self.ignored.is_empty() {
            lines.push(format!("ignored: {} ({})", self.ignored.len(), first_five(&self.ignored)));
        }
        let named = |test: &dyn Fn(&TensorReport) -> bool| -> Vec<String> {
            self.tensors.iter().filter(|t| test(t)).map(|t| t.name.clone()).collect()
        };
        for (what, list) in [
            ("kept as f32, beyond the range of f16", named(&|t| t.promoted)),
            ("with outputs that are all zero", named(&|t| t.zero_outputs > 0)),
            ("absent from the checkpoint and initialised", named(&|t| t.origin == Origin::Initialised)),
        ] {
            if !list.is_empty() {
                lines.push(format!("{what}: {} ({})", list.len(), first_five(&list)));
            }
        }
        lines.extend(self.notes.iter().cloned());
        if let Some(licence) = &self.licence {
            lines.push(format!("licence: {licence}"));
        }
        if let Some(digest) = &self.blob_digest {
            lines.push(format!("digest: {}", hex(digest)));
        }
        lines
    }
}

/// The first five of a list, and dots if there are more.
pub(crate) fn first_five(list: &[String]) -> String {
    let dots = if list.len() > 5 { ", ..." } else { "" };
    format!("{}{dots}", list[..list.len().min(5)].join(", "))
}
