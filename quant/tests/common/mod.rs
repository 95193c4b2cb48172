//! What several tests of the converter need.

use sf_formats::config::{Head, ModelConfig, Trunk};

/// A whole StreetForward network with heads of 64 channels, as detection takes them to be.
pub(crate) fn small() -> ModelConfig {
    let trunk = Trunk { dim: 64, depth: 1, heads: 1, registers: 2, mlp_ratio: 2, eps: 1e-6 };
    ModelConfig {
        patch: 4,
        encoder: trunk.clone(),
        pos_grid: 3,
        aa: Trunk { depth: 8, heads: 2, registers: 5, ..trunk },
        camera_dim: 64,
        camera_depth: 1,
        camera_heads: 1,
        camera_width: 32,
        depth: Head::xdec_linear(3, 64, 1, 1),
        conf: Head::none(),
        gs: Head::dpt(11, [0, 1, 2, 3], [4, 8, 12, 16], 8),
        time_dim: 16,
        causal_depth: 4,
        causal_heads: 2,
        motion: Head::dpt(4, [0, 1, 2, 3], [4, 8, 12, 16], 8),
        ..ModelConfig::full()
    }
}
