//! The cases of bad (and good) weight blobs, one test per case, named with its id.

use sf_formats::arch;
use sf_formats::atomic::Overwrite;
use sf_formats::config::{Head, ModelConfig, Trunk};
use sf_formats::{Blob, BlobWriter, Dtype, LoadMode, Meta, Verify};

/// The smallest network with every kind of storage: linear, convolution, transposed convolution,
/// vectors, tables, f32 and f16.
fn tiny() -> ModelConfig {
    let trunk = Trunk { dim: 4, depth: 1, heads: 1, registers: 1, mlp_ratio: 1, eps: 1e-6 };
    ModelConfig {
        patch: 1,
        encoder: trunk.clone(),
        pos_grid: 1,
        aa: Trunk { depth: 2, ..trunk },
        camera_dim: 4,
        camera_depth: 0,
        camera_heads: 1,
        camera_width: 4,
        depth: Head::xdec_linear(3, 4, 0, 1),
        conf: Head::none(),
        ..ModelConfig::pi3()
    }
}

fn values(len: usize, seed: usize) -> Vec<f32> {
    (0..len).map(|i| ((i * 7 + seed * 13) % 101) as f32 / 64.0 - 0.75).collect()
}

fn fill(mut w: BlobWriter) -> BlobWriter {
    for (i, spec) in w.specs().to_vec().iter().enumerate() {
        let dtype = if i % 3 == 0 { Dtype::F16 } else { Dtype::F32 };
        w.write(&values(spec.len(), i), dtype).unwrap();
    }
    w
}

fn build(config: &ModelConfig) -> Vec<u8> {
    let mut meta = Meta::new();
    meta.set_text(sf_formats::meta::keys::LICENCE, "test");
    fill(BlobWriter::in_memory(config, &meta).unwrap()).finish_bytes().unwrap()
}

#[test]
fn what_is_written_is_read() {
    let config = ModelConfig { gs: Head::dpt(11, [0, 0, 0, 0], [4, 4, 4, 4], 8), ..tiny() };
    let bytes = build(&config);
    let dir = tempfile::tempdir().unwrap();
    let path = dir.path().join("m.sfw");
    let mut meta = Meta::new();
    meta.set_text(sf_formats::meta::keys::LICENCE, "test");
    let digest = fill(BlobWriter::create(&path, Overwrite::No, &config, &meta).unwrap()).finish().unwrap();
    assert_eq!(std::fs::read(&path).unwrap(), bytes, "the same bytes on disk and in memory, and twice");

    let memory = Blob::from_bytes(&bytes).unwrap();
    for blob in [
        &memory,
        &Blob::open(&path, LoadMode::Map, Verify::Digests).unwrap(),
        &Blob::open(&path, LoadMode::Copy, Verify::Structure).unwrap(),
    ] {
        assert_eq!(*blob.config(), config);
        assert_eq!(*blob.meta(), meta);
        assert_eq!(*blob.digest(), digest);
        blob.expect_digest(&digest).unwrap();
        blob.unchanged().unwrap();
        blob.verify().unwrap();
        assert_eq!(blob.find("no.such"), None);
        let mut out = Vec::new();
        for (i, spec) in arch::tensors(&config).iter().enumerate() {
            let t = blob.find(&spec.name).unwrap();
            assert_eq!(blob.tensors()[t].spec, *spec);
            blob.read_f32(t, &mut out);
            // Multiples of 1/64 below 1 are exact in f16.
            assert_eq!(out, values(spec.len(), i), "{}", spec.name);
            assert_eq!(blob.bytes(t).as_ptr().align_offset(64), 0);
        }
    }
}
