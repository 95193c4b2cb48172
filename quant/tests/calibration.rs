//! What a calibration changes in a blob beside the rounding of weights.

use sf_formats::checkpoint::Checkpoint;
use sf_formats::{Blob, Dtype};
use sf_quant::{Calibration, Options, Outputs, Seeded, convert_to_bytes};
use std::sync::Arc;

mod common;
use common::small;

const LAYER: &str = "encoder.blocks.0.attn.qkv";
const NORM: &str = "encoder.blocks.0.norm1";

fn values(blob: &Blob, name: &str) -> Vec<f32> {
    let mut values = Vec::new();
    blob.read_f32(blob.find(name).unwrap_or_else(|| panic!("no {name}")), &mut values);
    values
}

/// A norm gives its tokens around zero, and the bias behind it has the mean: the network is the same.
#[test]
fn norms_take_the_mean_off_and_biases_put_it_back() {
    let source = Seeded::new(&small(), 3, Outputs::Random).unwrap();
    let read = |name: &str| {
        let mut values = Vec::new();
        let at = source.tensors().iter().position(|t| t.name == name).unwrap_or_else(|| panic!("no {name}"));
        source.read_f32(at, &mut values).unwrap();
        values
    };
    let [gain, offset, bias, weight] =
        [format!("{NORM}.weight"), format!("{NORM}.bias"), format!("{LAYER}.bias"), format!("{LAYER}.weight")]
            .map(|n| read(&n));
    // Tokens around 0.7, as the norm gives them.
    let k = gain.len();
    let mut calibration = Calibration::default();
    let rows: Vec<Vec<f32>> =
        (0..500).map(|r| (0..k).map(|i| 0.7 + ((r * (i + 3) * 7919) % 1009) as f32 / 1009.0).collect()).collect();
    rows.iter().for_each(|row| calibration.add(&format!("{LAYER}.weight"), row));
    calibration.finish();
    let mean: Vec<f64> =
        (0..k).map(|i| rows.iter().map(|r| f64::from(r[i])).sum::<f64>() / rows.len() as f64).collect();

    let plain = Options::to(Dtype::Int8);
    let calibrated = Options { calibration: Some(Arc::new(calibration)), ..plain.clone() };
    let [plain, calibrated] =
        [plain, calibrated].map(|o| Blob::from_bytes(&convert_to_bytes(&source, &o).unwrap()).unwrap());
    assert!(values(&plain, &format!("{NORM}.bias")).iter().all(|&v| v == 0.0));
    for blob in [&plain, &calibrated] {
        assert!(values(blob, &format!("{NORM}.weight")).iter().all(|&v| v == 1.0));
    }
    for (i, v) in values(&calibrated, &format!("{NORM}.bias")).into_iter().enumerate() {
        let want = -(mean[i] - f64::from(offset[i])) / f64::from(gain[i]);
        assert!((f64::from(v) - want).abs() < 1e-6, "offset {i}: {v}, {want}");
    }
    for (o, v) in values(&calibrated, &format!("{LAYER}.bias")).into_iter().enumerate() {
        let product: f64 = (0..k).map(|i| f64::from(weight[o * k + i]) * mean[i]).sum();
        let want = f64::from(bias[o]) + product;
        assert!((f64::from(v) - want).abs() < 1e-5 * (1.0 + want.abs()), "bias {o}: {v}, {want}");
    }
    // A layer that was not seen is as without a calibration.
    for name in ["encoder.blocks.0.norm2.bias", "encoder.blocks.0.mlp.fc1.bias"] {
        assert_eq!(values(&plain, name), values(&calibrated, name), "{name}");
    }
}
