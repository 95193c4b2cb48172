//! Properties that the architecture promises, on the engine with tiny random weights: self-checks 3 to 10
//! of the network specification (1 and 2, counts and names, are tests of `sf_formats::arch`; 7 is also a unit
//! test of the rotation).

use sf_formats::blob::Dtype;
use sf_formats::config::{Anchor, Head, KSource, ModelConfig, Order};
use sf_ops::rope::{AngleRound, RopeTable, qk_norm_rope};
use sf_ops::{Ctx, Kernels, MatMut};
use sf_tests::tiny::{Frames, model, stages, tensors, tiny};

/// Pi3's part alone, in its own gauge.
fn pi3() -> ModelConfig {
    ModelConfig {
        gs: Head::none(),
        motion: Head::none(),
        causal_depth: 0,
        causal_heads: 0,
        time_dim: 0,
        world_anchor: Anchor::Raw,
        camera_k: KSource::FitFrame,
        ..tiny()
    }
}

fn far(a: &[f32], b: &[f32]) -> f32 {
    assert_eq!(a.len(), b.len());
    let top = b.iter().fold(1e-6f32, |m, v| m.max(v.abs()));
    a.iter().zip(b).fold(0.0f32, |m, (a, b)| m.max((a - b).abs())) / top
}

fn same_bits(a: &[f32], b: &[f32]) -> bool {
    a.len() == b.len() && a.iter().zip(b).all(|(a, b)| a.to_bits() == b.to_bits())
}

fn frame(stage: &[f32], frames: usize, f: usize) -> &[f32] {
    let len = stage.len() / frames;
    &stage[f * len..][..len]
}

#[test]
fn check_3_permuted_frames_give_permuted_results() {
    let config = pi3();
    let model = model(&config, &tensors(&config, 3), Dtype::F32);
    let clip = Frames::new(4, 28, 42, 1);
    let order = [2, 0, 3, 1];
    let mut shuffled = Frames::new(4, 28, 42, 1);
    for (to, &from) in order.iter().enumerate() {
        let pixels = clip.input().images[from * 28 * 42 * 3..][..28 * 42 * 3].to_vec();
        shuffled.frame_mut(to).copy_from_slice(&pixels);
    }
    let (a, b) = (stages(&model, &clip.input()), stages(&model, &shuffled.input()));
    for name in ["aa.3", "camera.t", "camera.rot9", "point", "conf", "out.mean", "out.scale"] {
        for (to, &from) in order.iter().enumerate() {
            let d = far(frame(&b[name], 4, to), frame(&a[name], 4, from));
            // Sums over keys run in another order, nothing else changes.
            assert!(d < 2e-5, "{name}: frame {from} at {to} differs by {d:.1e}");
        }
    }
}

#[test]
fn check_4_one_frame_makes_global_attention_frame_attention() {
    let first = pi3();
    let swapped = ModelConfig { aa_order: Order::GlobalFirst, ..pi3() };
    let weights = tensors(&first, 4);
    let clip = Frames::new(1, 28, 42, 2);
    let a = stages(&model(&first, &weights, Dtype::F32), &clip.input());
    let b = stages(&model(&swapped, &weights, Dtype::F32), &clip.input());
    assert!(a.len() > 15);
    for (name, stage) in &a {
        assert!(same_bits(stage, &b[name]), "{name}");
    }
    // With two frames the order matters: the test above is not vacuous.
    let clip = Frames::new(2, 28, 42, 2);
    let a = stages(&model(&first, &weights, Dtype::F32), &clip.input());
    let b = stages(&model(&swapped, &weights, Dtype::F32), &clip.input());
    assert!(far(&a["aa.3"], &b["aa.3"]) > 1e-3);
}

#[test]
fn check_5_position_table_at_its_own_size_and_its_weights() {
    let config = ModelConfig { pos_grid: 3, ..pi3() };
    let weights = tensors(&config, 5);
    let native = stages(&model(&config, &weights, Dtype::F32), &Frames::new(1, 42, 42, 3).input());
    assert!(same_bits(&native["pos"], &weights["encoder.pos_embed"]));

    // Weights of a resize sum to one: a constant table stays constant.
    let mut constant = weights.clone();
    constant.get_mut("encoder.pos_embed").unwrap().fill(0.75);
    let resized = stages(&model(&config, &constant, Dtype::F32), &Frames::new(1, 28, 70, 3).input());
    assert!(resized["pos"].iter().all(|v| (v - 0.75).abs() < 1e-6));
}

#[test]
fn check_6_rotary_positions_are_relative_and_spare_registers() {
    let pool = sf_ops::par::Pool::new(1).unwrap();
    let ctx = Ctx { pool: &pool, kernels: Kernels::best() };
    let d = 16;
    let token: Vec<f32> = (0..3 * d).map(|i| (i as f32 * 0.7).sin()).collect();
    // q at one place, k at another; then both moved by (4, 7); then a register.
    let places = [(1, 2), (3, 5), (5, 9), (7, 12), (0, 0)];
    let table = RopeTable::new(&places, d, 100.0, AngleRound::None);
    let mut rows: Vec<f32> = places.iter().flat_map(|_| token.clone()).collect();
    qk_norm_rope(ctx, MatMut::new(&mut rows, 5, 3 * d), 1, None, Some(&table));
    let dot = |q: usize, k: usize| -> f32 { (0..d).map(|i| rows[q * 3 * d + i] * rows[k * 3 * d + d + i]).sum() };
    assert!((dot(0, 1) - dot(2, 3)).abs() < 1e-4, "{} {}", dot(0, 1), dot(2, 3));
    assert!((dot(0, 1) - dot(0, 3)).abs() > 1e-2);
    assert!(same_bits(&rows[4 * 3 * d..], &token));
}

#[test]
fn check_7_poses_are_rotations() {
    let config = pi3();
    for seed in 0..5 {
        let model = model(&config, &tensors(&config, 70 + seed), Dtype::F32);
        let clip = Frames::new(2, 28, 28, seed);
        let mut session = sf_tests::tiny::session(&model, clip.shape);
        for pose in &session.run(&clip.input()).unwrap().poses {
            let e = pose.r * pose.r.transpose() - glam::DMat3::IDENTITY;
            assert!(e.to_cols_array().iter().all(|v| v.abs() < 1e-6));
            assert!((pose.r.determinant() - 1.0).abs() < 1e-6);
        }
    }
}

#[test]
fn check_8_pixel_shuffle_reproduces_patch_coordinates() {
    let config = pi3();
    let mut weights = tensors(&config, 8);
    weights.get_mut("conf_head.proj.weight").unwrap().fill(0.0);
    weights.insert("conf_head.proj.bias".into(), (0..196).map(|i| i as f32).collect());
    let conf = &stages(&model(&config, &weights, Dtype::F32), &Frames::new(1, 28, 42, 3).input())["conf"];
    for y in 0..28 {
        for x in 0..42 {
            assert_eq!(conf[y * 42 + x], ((y % 14) * 14 + x % 14) as f32, "pixel {x} {y}");
        }
    }
}

#[test]
fn check_9_centres_project_to_their_own_pixels() {
    let config = tiny();
    let model = model(&config, &tensors(&config, 9), Dtype::F32);
    let clip = Frames::new(3, 28, 42, 4);
    let mut session = sf_tests::tiny::session(&model, clip.shape);
    let out = session.run(&clip.input()).unwrap();
    for f in 0..3 {
        let camera = out.camera(f);
        for i in (0..28 * 42).step_by(37) {
            let m = out.mean[f * 28 * 42 + i].map(f64::from);
            let (u, v, z) = camera.project(glam::DVec3::from_array(m));
            let want = ((i % 42) as f64 + 0.5, (i / 42) as f64 + 0.5, f64::from(out.depth[f * 28 * 42 + i]));
            assert!((u - want.0).abs() < 1e-3 && (v - want.1).abs() < 1e-3, "frame {f}: {u} {v} for {want:?}");
            assert!((z - want.2).abs() < 1e-5 * want.2);
        }
    }
}

#[test]
fn check_10_causal_features_see_exactly_their_frames() {
    let config = tiny();
    let mut weights = tensors(&config, 10);
    // Global layers switched off: a frame then reaches another through the causal module alone.
    for i in [1, 3] {
        weights.get_mut(&format!("decoder.{i}.ls1.gamma")).unwrap().fill(0.0);
    }
    let model = model(&config, &weights, Dtype::F32);
    let clip = Frames::new(4, 28, 42, 5);
    let plain = stages(&model, &clip.input());
    let changed = |f: usize| {
        let mut other = Frames::new(4, 28, 42, 5);
        other.frame_mut(f).iter_mut().for_each(|v| *v = 255 - *v);
        stages(&model, &other.input())
    };
    for moved in 0..4 {
        let other = changed(moved);
        for layer in 0..3 {
            for f in 0..4 {
                let same = |pass: &str| {
                    let name = format!("causal.{pass}.{layer}");
                    same_bits(frame(&plain[&name], 4, f), frame(&other[&name], 4, f))
                };
                // One layer reaches one frame further.
                let ahead = (f..=f + layer + 1).contains(&moved);
                let behind = (moved..=moved + layer + 1).contains(&f);
                assert_eq!(same("fwd"), !ahead, "forward layer {layer}: frame {f} when frame {moved} changes");
                assert_eq!(same("bwd"), !behind, "backward layer {layer}: frame {f} when frame {moved} changes");
            }
        }
    }
}
