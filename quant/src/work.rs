//! How much of the network's work a matrix is: multiply-adds per patch of a frame.
//!
//! Attention's own products are left out, and registers, which are few beside the patches.

use sf_formats::ModelConfig;
use sf_formats::arch::TensorSpec;
use sf_formats::config::MotionLayout;

/// Multiply-adds of a matrix per patch of every frame; 0 for what is no matrix or runs once per frame.
pub fn multiply_adds(config: &ModelConfig, spec: &TensorSpec) -> f64 {
    let Some((n, k)) = spec.matrix() else { return 0.0 };
    let name = spec.name.as_str();
    let passes = if config.motion_layout == MotionLayout::PerDirection { 2.0 } else { 1.0 };
    let per_patch = (n * k) as f64;
    let times = match name.split_once('.').map_or(name, |(first, _)| first) {
        "aa_time" => 0.0,
        "camera_head" => f64::from(u8::from(name.contains("res_conv"))),
        "image_stem" => half_area(config),
        // The backward pass has a set of its own where the passes do not share.
        "causal" if config.causal_share => passes,
        "motion_decoder" => passes,
        "motion_head" => passes * in_head(config, name),
        "point_head" | "conf_head" | "gs_head" => in_head(config, name),
        _ => 1.0,
    };
    per_patch * times
}

/// Pixels of half resolution in a patch.
fn half_area(config: &ModelConfig) -> f64 {
    f64::from(config.patch / 2).powi(2)
}

/// How often a matrix of a dense head runs per patch.
fn in_head(config: &ModelConfig, name: &str) -> f64 {
    let (_, layer) = name.split_once('.').unwrap_or(("", name));
    let full = f64::from(config.patch).powi(2);
    let level = |i: &str| match i {
        "1" => 16.0,
        "2" => 4.0,
        "3" => 1.0,
        _ => 0.25,
    };
    if layer.starts_with("conv.") {
        return half_area(config);
    }
    if layer.starts_with("resize_layers.3") {
        return 0.25;
    }
    let Some(scratch) = layer.strip_prefix("scratch.") else { return 1.0 };
    if let Some(i) = scratch.strip_prefix("layer").and_then(|r| r.get(..1)) {
        return level(i);
    }
    if let Some(i) = scratch.strip_prefix("refinenet").and_then(|r| r.get(..1)) {
        return level(i);
    }
    if scratch.starts_with("output_conv1") { 64.0 } else { full }
}

#[cfg(test)]
mod tests {
    use super::*;
    use sf_formats::arch;

    /// Against the counts of the network specification for one frame of 252 x 168, without attention: 2 operations per
    /// multiply-add, 216 patches.
    #[test]
    fn work_is_that_of_the_specification() {
        let config = ModelConfig::full().with_linear_heads();
        let of = |prefix: &str| -> f64 {
            let specs = arch::tensors(&config);
            let part = specs.iter().filter(|s| s.name.starts_with(prefix));
            part.map(|s| multiply_adds(&config, s)).sum()
        };
        // 12 dim^2 per block and patch.
        let block = 12.0 * 1024.0 * 1024.0;
        assert_eq!(of("decoder."), 36.0 * block);
        assert_eq!(of("encoder.blocks."), 24.0 * block);
        assert_eq!(of("causal."), 2.0 * 4.0 * 12.0 * 1152.0 * 1152.0);
        assert_eq!(of("point_head."), 3.0 * 196.0 * 1024.0);
        let nano = ModelConfig::nano();
        let conv = arch::tensors(&nano).into_iter().find(|s| s.name == "gs_head.conv.1.weight").unwrap();
        assert_eq!(multiply_adds(&nano, &conv), 49.0 * 9.0 * 32.0 * 32.0);
    }
}
