//! Clips, weights and hosts at the edge of what the engine accepts: cases I14 to I17, P01, P02, P11, P16 and
//! S15 of the list of bad inputs; known intrinsics; cancellation.

use sf_formats::blob::Dtype;
use sf_formats::clip::{Clip, ClipOptions};
use sf_formats::config::{Anchor, Extrapolate, Head, KSource, ModelConfig, Order};
use sf_formats::{Intrinsics, Status};
use sf_tests::int8::converted;
use sf_tests::tiny::{Frames, model, session, stages, tensors, tiny, tiny_guided};
use std::sync::Arc;
use std::sync::atomic::Ordering;
use std::time::Instant;
use streetforward::{ClipShape, Input, Model, Options, Prepared, Session};

#[test]
fn i14_one_frame_stands_still() {
    let config = tiny();
    let model = model(&config, &tensors(&config, 1), Dtype::F32);
    let clip = Frames::new(1, 28, 42, 1);
    let mut session = session(&model, clip.shape);
    let out = session.run(&clip.input()).unwrap();
    assert!(out.flags.no_motion);
    assert!(out.v_fwd.iter().chain(&out.v_bwd).flatten().chain(&out.dynamic).all(|&v| v == 0.0));
    assert!(out.mean.iter().flatten().chain(&out.depth).all(|v| v.is_finite()));
    assert!(out.depth.iter().all(|&z| z > 0.0));
    let scene = out.to_scene(&config, &[]);
    assert_eq!(scene.at(3.0, &scene.compose).unwrap().len(), 28 * 42);
}

#[test]
fn i15_ends_without_a_neighbour_mirror_and_are_flagged() {
    // A strict mask: the last frame's forward rows and the first frame's backward rows have no key at all.
    let config = ModelConfig { mask_self: false, ..tiny() };
    let model = model(&config, &tensors(&config, 2), Dtype::F32);
    let clip = Frames::new(3, 28, 42, 2);
    let all = stages(&model, &clip.input());
    assert!(all.values().flatten().all(|v| v.is_finite()));
    let mut session = session(&model, clip.shape);
    let out = session.run(&clip.input()).unwrap();
    assert_eq!(out.neighbours, [(true, false), (true, true), (false, true)]);
    let px = 28 * 42;
    for i in (0..px).chain(2 * px..3 * px) {
        assert_eq!(out.v_fwd[i], out.v_bwd[i].map(|v| -v), "pixel {i}");
    }
    assert!((px..2 * px).any(|i| out.v_fwd[i] != out.v_bwd[i].map(|v| -v)));

    let direct = ModelConfig { render_extrapolate: Extrapolate::Direct, ..config.clone() };
    let model = sf_tests::tiny::model(&direct, &tensors(&direct, 2), Dtype::F32);
    let mut session = sf_tests::tiny::session(&model, clip.shape);
    let out = session.run(&clip.input()).unwrap();
    assert!((0..px).any(|i| out.v_fwd[i] != out.v_bwd[i].map(|v| -v)));
}

#[test]
fn i16_more_than_the_budget_is_refused_with_numbers() {
    let config = tiny();
    let model = model(&config, &tensors(&config, 3), Dtype::F32);
    let refuse = |shape: ClipShape, max_bytes: u64| {
        let options = Options { threads: 1, max_bytes, ..Options::default() };
        Session::new(Arc::clone(&model), shape, options).err().expect("refused")
    };
    let e = refuse(ClipShape { frames: 1000, height: 280, width: 518 }, 8 << 30);
    assert_eq!(e.status(), Status::Resource);
    assert!(e.to_string().contains("8192 MiB") && e.to_string().contains("windows"), "{e}");
    for (frames, height, width) in [(5000, 14, 14), (4096, 14 * 1000, 14 * 1000), (1, 14 << 40, 14 << 40)] {
        assert_eq!(refuse(ClipShape { frames, height, width }, u64::MAX).status(), Status::Resource);
    }
    assert_eq!(refuse(ClipShape { frames: 0, height: 14, width: 14 }, 8 << 30).status(), Status::Usage);
    assert_eq!(refuse(ClipShape { frames: 1, height: 15, width: 14 }, 8 << 30).status(), Status::Input);

    // The plan's number is the budget that just suffices.
    let shape = ClipShape { frames: 2, height: 28, width: 42 };
    let plan = session(&model, shape).plan().clone();
    let need = plan.session_bytes();
    let options = Options { threads: 2, max_bytes: need, ..Options::default() };
    let mut session = Session::new(Arc::clone(&model), shape, options).unwrap();
    let options = Options { max_bytes: need - 1, ..options };
    assert_eq!(Session::new(Arc::clone(&model), shape, options).err().unwrap().status(), Status::Resource);
    assert!(plan.to_string().contains("2 frames of 42x28"), "{plan}");

    // More frames than the session is planned for.
    let long = Frames::new(3, 28, 42, 3);
    assert_eq!(session.run(&long.input()).unwrap_err().status(), Status::Resource);
    let other = Frames::new(2, 42, 28, 3);
    assert_eq!(session.run(&other.input()).unwrap_err().status(), Status::Input);
}

#[test]
fn i17_flat_repeated_and_noisy_frames_stay_finite() {
    let config = tiny();
    let model = model(&config, &tensors(&config, 4), Dtype::F32);
    let mut clip = Frames::new(3, 28, 42, 4);
    let first = clip.frame_mut(0).to_vec();
    let mut noise = sf_tests::tiny::Noise::new(9);
    let mut run = |fill: &mut dyn FnMut(usize) -> u8| {
        clip.images.iter_mut().enumerate().for_each(|(i, v)| *v = fill(i));
        let mut session = session(&model, clip.shape);
        let out = session.run(&clip.input()).unwrap();
        out.to_scene(&config, &[]).len()
    };
    for pixels in [
        run(&mut |i| first[i % first.len()]),
        run(&mut |_| 0),
        run(&mut |_| 255),
        run(&mut |_| (128.0 + 127.0 * noise.draw()) as u8),
    ] {
        assert_eq!(pixels, 3 * 28 * 42);
    }
}

#[test]
fn s15_broken_numbers_stop_with_the_stage_that_made_them() {
    let config = tiny();
    for (name, stage) in [
        ("encoder.blocks.1.mlp.fc2.bias", "encoder.1"),
        ("decoder.2.attn.proj.bias", "aa.2"),
        ("camera_head.fc_t.bias", "camera"),
        ("point_head.proj.bias", "depth"),
        ("gs_head.scratch.output_conv2.2.bias", "gs"),
        ("causal.1.mlp.fc2.bias", "causal.fwd.1"),
        ("motion_head.scratch.output_conv2.2.bias", "motion.fwd"),
    ] {
        let mut weights = tensors(&config, 5);
        // Finite in the file; overflows as soon as anything is added or multiplied twice.
        weights.get_mut(name).unwrap().iter_mut().for_each(|v| *v = f32::MAX);
        let last = name.rsplit_once(".bias").unwrap().0;
        weights.get_mut(&format!("{last}.weight")).unwrap().iter_mut().for_each(|v| *v = 1e38);
        let model = model(&config, &weights, Dtype::F32);
        let clip = Frames::new(2, 28, 42, 5);
        let mut session = session(&model, clip.shape);
        let e = session.run(&clip.input()).unwrap_err();
        assert_eq!(e.status(), Status::Integrity, "{name}: {e}");
        assert!(e.to_string().starts_with(&format!("stage {stage}")), "{name}: {e}");
    }
}

#[test]
fn known_intrinsics_override_the_fit() {
    let config = tiny();
    let model = model(&config, &tensors(&config, 6), Dtype::F32);
    let clip = Frames::new(2, 28, 42, 6);
    let k = Intrinsics { fx: 33.0, fy: 34.0, cx: 20.0, cy: 15.0 };
    let mut session = session(&model, clip.shape);
    let fitted = session.run(&clip.input()).unwrap().clone();
    let out = session.run(&Input { k: Some(k), ..clip.input() }).unwrap();
    assert_eq!(out.k, [k, k]);
    assert!(!out.flags.intrinsics_assumed);
    assert_eq!(out.depth, fitted.depth);
    assert_ne!(out.mean, fitted.mean);
}

#[test]
fn a_network_without_gaussian_and_motion_heads_gives_a_static_scene() {
    let config =
        ModelConfig { gs: Head::none(), motion: Head::none(), causal_depth: 0, causal_heads: 0, time_dim: 0, ..tiny() };
    let model = model(&config, &tensors(&config, 7), Dtype::F32);
    let clip = Frames::new(2, 28, 42, 7);
    let mut session = session(&model, clip.shape);
    let out = session.run(&clip.input()).unwrap();
    assert!(out.flags.no_motion && out.dynamic.iter().all(|&p| p == 0.0));
    let scene = out.to_scene(&config, &[]);
    assert!(scene.gaussians.opacity.iter().all(|&o| o == 0.0 || (o - 0.880_797).abs() < 1e-6));
    assert_eq!(scene.gaussians.colour[5][1], f32::from(clip.images[16]) / 255.0);
}

#[test]
fn a_session_repeats_itself_and_survives_cancellation() {
    let config = tiny();
    let model = model(&config, &tensors(&config, 8), Dtype::F32);
    let (clip, other) = (Frames::new(2, 28, 42, 8), Frames::new(2, 28, 42, 9));
    let mut session = session(&model, clip.shape);
    let first = session.run(&clip.input()).unwrap().clone();
    let flag = session.cancel_flag();
    flag.store(true, Ordering::Relaxed);
    assert_eq!(session.run(&clip.input()).unwrap_err().status(), Status::Deadline);
    flag.store(false, Ordering::Relaxed);
    let past = Some(Instant::now());
    assert_eq!(session.run_watched(&clip.input(), past, None).unwrap_err().status(), Status::Deadline);
    assert_ne!(*session.run(&other.input()).unwrap(), first);
    assert_eq!(*session.run(&clip.input()).unwrap(), first);
    assert!(session.stage_times().map(|s| s.time).sum::<std::time::Duration>().as_nanos() > 0);
}

#[test]
fn p01_p02_thread_counts_are_bounded() {
    let config = tiny();
    let model = model(&config, &tensors(&config, 9), Dtype::F32);
    let shape = ClipShape { frames: 1, height: 14, width: 14 };
    let make = |threads| Session::new(Arc::clone(&model), shape, Options { threads, ..Options::default() });
    let all = std::thread::available_parallelism().unwrap().get().min(streetforward::MAX_THREADS);
    assert_eq!(make(0).unwrap().threads(), all);
    assert_eq!(make(65).err().unwrap().status(), Status::Usage);
}

#[test]
fn p11_two_sessions_share_a_model() {
    let config = tiny();
    let model = model(&config, &tensors(&config, 10), Dtype::F16);
    let clip = Frames::new(2, 28, 42, 10);
    let run = || session(&model, clip.shape).run(&clip.input()).unwrap().clone();
    let (a, b) = std::thread::scope(|s| {
        let other = s.spawn(run);
        (run(), other.join().unwrap())
    });
    assert_eq!(a, b);
}

/// A host that flushes subnormals and rounds to zero gets the same bits, and its own mode back.
#[test]
#[cfg(target_arch = "x86_64")]
fn p16_the_host_control_word_changes_nothing() {
    let set = |mode: u32| {
        // SAFETY: loads a valid MXCSR value (exceptions masked) on this test's own thread.
        unsafe { std::arch::asm!("ldmxcsr [{}]", in(reg) &mode, options(nostack, readonly, preserves_flags)) }
    };
    let get = || {
        let mut mode = 0u32;
        // SAFETY: stores MXCSR into a local.
        unsafe { std::arch::asm!("stmxcsr [{}]", in(reg) &mut mode, options(nostack, preserves_flags)) };
        mode & 0xffc0
    };
    let config = tiny();
    let model = model(&config, &tensors(&config, 11), Dtype::F32);
    let clip = Frames::new(2, 28, 42, 11);
    let plain = session(&model, clip.shape).run(&clip.input()).unwrap().clone();
    // Round to zero, flush to zero, denormals are zero.
    let odd = 0x1f80 | 0x6000 | 0x8000 | 0x0040;
    set(odd);
    let other = session(&model, clip.shape).run(&clip.input()).unwrap().clone();
    let mode = get();
    set(0x1f80);
    assert_eq!(mode, odd);
    assert_eq!(plain, other);
}

/// The ablation without causal attention: no frame sees another, yet every frame has its velocities, and nothing
/// before the causal module changes.
#[test]
fn conventions_change_without_new_weights() {
    for config in [tiny(), tiny_guided()] {
        let model = model(&config, &tensors(&config, 17), Dtype::F32);
        let blind = Arc::new(model.with_config(ModelConfig { mask_k: 0, ..config.clone() }).unwrap());
        let clip = Frames::new(3, 28, 42, 17);
        let (seeing, alone) = (stages(&model, &clip.input()), stages(&blind, &clip.input()));
        assert_eq!(seeing["aa.3"], alone["aa.3"]);
        assert_ne!(seeing["causal.fwd.0"], alone["causal.fwd.0"]);
        // Both passes see the same, namely their own frame.
        assert_eq!(alone["causal.fwd.1"], alone["causal.bwd.1"]);
        let out = session(&blind, clip.shape).run(&clip.input()).unwrap().clone();
        assert_eq!(out.neighbours, [(true, false), (true, true), (false, true)]);
        assert!(out.v_fwd.iter().chain(&out.v_bwd).all(|v| v.iter().any(|x| *x != 0.0)));
        let weights = streetforward::reference::Weights::from_map(tensors(&config, 17), blind.config()).unwrap();
        let plain = streetforward::reference::run(&weights, blind.config(), &clip.input()).unwrap();
        let far = alone["out.v_fwd"].iter().zip(&plain.get("out.v_fwd").data).map(|(a, b)| (a - b).abs());
        assert!(far.fold(0.0, f32::max) < 1e-3);

        let e = model.with_config(ModelConfig { causal_depth: 1, ..config.clone() }).unwrap_err();
        assert!(e.to_string().contains("other tensors"), "{e}");
        let e = model.with_config(ModelConfig { motion_tau: 2.0, ..config }).unwrap_err();
        assert!(e.to_string().contains("motion.tau"), "{e}");
    }
}

/// Frames whose motion map nobody reads are skipped, unless a tap looks.
#[test]
fn taps_change_no_result() {
    for extrapolate in [Extrapolate::Mirror, Extrapolate::Direct] {
        for motion in [tiny().motion, Head::xdec_linear(4, 16, 1, 2)] {
            let config = ModelConfig { render_extrapolate: extrapolate, motion, ..tiny() };
            let model = model(&config, &tensors(&config, 13), Dtype::F32);
            let (clip, other) = (Frames::new(3, 28, 42, 13), Frames::new(3, 28, 42, 14));
            let mut session = session(&model, clip.shape);
            let mut count = 0;
            let tapped = session.run_watched(&clip.input(), None, Some(&mut |_| count += 1)).unwrap().clone();
            assert!(count > 50);
            session.run(&other.input()).unwrap();
            assert_eq!(*session.run(&clip.input()).unwrap(), tapped);
        }
    }
}

#[test]
#[should_panic(expected = "no complete result")]
fn a_failed_run_leaves_no_result() {
    let config = tiny();
    let model = model(&config, &tensors(&config, 15), Dtype::F32);
    let clip = Frames::new(1, 28, 42, 15);
    let mut session = session(&model, clip.shape);
    session.run(&clip.input()).unwrap();
    session.cancel_flag().store(true, Ordering::Relaxed);
    session.run(&clip.input()).unwrap_err();
    session.output();
}

/// Frames that arrive one by one: every window has the bits of a run from scratch.
#[test]
fn a_stream_has_the_bits_of_its_windows() {
    let linear = tiny().with_linear_heads();
    let own = ModelConfig { render_extrapolate: Extrapolate::Direct, mask_k: 2, ..linear.clone() };
    let strict = ModelConfig { mask_self: false, camera_k: KSource::FitFrame, causal_share: false, ..tiny() };
    let raw = ModelConfig { aa_order: Order::GlobalFirst, world_anchor: Anchor::Raw, ..tiny() };
    for config in [tiny(), tiny_guided(), linear, own, strict, raw] {
        stream_and_windows(&model(&config, &tensors(&config, 16), Dtype::F32));
    }
    let int8 = sf_tests::int8::tiny();
    for config in [int8.clone(), int8.with_linear_heads()] {
        stream_and_windows(&converted(&config, &tensors(&config, 16), sf_quant::Options::to(Dtype::Int8)));
    }
}

fn stream_and_windows(model: &Arc<Model>) {
    let drive = Frames::new(6, 28, 42, 16);
    let shape = ClipShape { frames: 3, ..drive.shape };
    let (mut stream, mut scratch) = (session(model, shape), session(model, shape));
    let mut newest = session(model, shape);
    let frame = |f: usize| &drive.images[f * 28 * 42 * 3..][..28 * 42 * 3];
    for f in 0..6 {
        let out = stream.push(frame(f), drive.times[f], None).unwrap().cloned();
        assert_eq!(out.is_some(), f >= 2);
        if let Some(out) = out {
            let images = &drive.images[(f - 2) * 28 * 42 * 3..][..3 * 28 * 42 * 3];
            let input = Input { shape, images, times: &drive.times[f - 2..=f], k: None };
            assert!(*scratch.run(&input).unwrap() == out, "window that ends with frame {f}");
            // The newest frame alone says the same about it.
            let alone = newest.push_newest(frame(f), drive.times[f], None).unwrap().unwrap();
            assert_eq!(alone.due, 2..3);
            // What is said about the intrinsics is about the frames that are due.
            assert!(out.flags.intrinsics_assumed || !alone.flags.intrinsics_assumed);
            let of_frame = |out: &streetforward::Output| streetforward::Output {
                flags: streetforward::Flags { no_motion: out.flags.no_motion, intrinsics_assumed: false },
                ..out.of_frame(2)
            };
            assert!(of_frame(alone) == of_frame(&out), "newest frame {f}");
            assert_eq!((alone.poses[0], &alone.times), (out.poses[0], &out.times));
        } else {
            assert!(newest.push_newest(frame(f), drive.times[f], None).unwrap().is_none());
        }
        // Refused frames leave no trace.
        assert_eq!(stream.push(frame(0), drive.times[f], None).unwrap_err().status(), Status::Input);
        assert_eq!(stream.push(&frame(0)[1..], 9.0, None).unwrap_err().status(), Status::Input);
        stream.cancel_flag().store(true, Ordering::Relaxed);
        assert_eq!(stream.push(frame(0), 9.0, None).unwrap_err().status(), Status::Deadline);
        stream.cancel_flag().store(false, Ordering::Relaxed);
    }
    stream.restart();
    assert!(stream.push(frame(0), 0.0, None).unwrap().is_none());
}

#[test]
fn a_real_drive_is_brought_to_size_and_run() {
    let folder = std::path::Path::new(env!("CARGO_MANIFEST_DIR")).join("data/drive");
    let options = ClipOptions { frames: Some(vec![0, 5, 10]), fps: Some(12.5), ..ClipOptions::default() };
    let clip = Clip::open(&folder, &options).unwrap();
    let config = tiny();
    let (w, h) = clip.frames[0].image.size();
    let natural = Prepared::from_clip(&config, &clip, None).unwrap().shape;
    assert!(natural.width.is_multiple_of(14) && natural.width * natural.height <= 255_000);
    let (have, want) = (natural.width as f64 / natural.height as f64, f64::from(w) / f64::from(h));
    assert!((have / want - 1.0).abs() < 0.05, "{have} for {want}");

    let clip = Prepared::from_clip(&config, &clip, Some((84, 42))).unwrap();
    assert_eq!((clip.sources.len(), clip.sources[0].size), (3, (w, h)));
    let model = model(&config, &tensors(&config, 12), Dtype::F32);
    let mut session = session(&model, clip.shape);
    let scene = session.run(&clip.input()).unwrap().to_scene(&config, &clip.sources);
    assert_eq!((scene.len(), scene.frames.len()), (3 * 84 * 42, 3));
    assert!((scene.frames[2].time - scene.frames[0].time - 0.8).abs() < 1e-9, "{:?}", scene.frames);
    scene.frames.iter().for_each(|f| f.camera.check(&f.name).unwrap());
}
