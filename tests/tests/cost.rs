//! The multiply-adds that the engine counts before a run are those that its operations count during one.

use sf_formats::Dtype;
use sf_formats::ModelConfig;
use sf_formats::config::{Concat, Extrapolate, Head, KSource, MotionLayout, Order};
use sf_ops::opclock::{self, Op};
use sf_tests::tiny::{Frames, model, session, tensors, tiny, tiny_guided};
use streetforward::{ClipShape, Cost, StageCost};

/// Gemm, convolution and attention of a run: counted before it, and by the operations.
fn both(config: &ModelConfig, shape: ClipShape) -> [[u64; 3]; 2] {
    let cost = Cost::of(config, shape).unwrap();
    let mut session = session(&model(config, &tensors(config, 3), Dtype::F32), shape);
    let clip = Frames::new(shape.frames, shape.height, shape.width, 5);
    opclock::start();
    session.run(&clip.input()).unwrap();
    let accounts = opclock::stop();
    let of = |op: Op| accounts[op as usize].work.macs;
    let sum = |part: fn(&StageCost) -> u64| cost.stages().iter().map(part).sum::<u64>();
    [[sum(|s| s.gemm), sum(|s| s.conv), sum(|s| s.attention)], [of(Op::Gemm), of(Op::Conv), of(Op::Attention)]]
}

#[test]
fn counted_is_what_runs() {
    let tiny = tiny();
    let linear = tiny.clone().with_linear_heads();
    let motion7 = |head: &Head| Head { out: 7, ..head.clone() };
    let configs = [
        tiny.clone(),
        linear.clone(),
        tiny_guided(),
        ModelConfig { aa_time: true, aa_order: Order::GlobalFirst, ..tiny.clone() },
        ModelConfig { camera_k: KSource::Fov, head_concat: Concat::Last, ..linear.clone() },
        ModelConfig { causal_share: false, causal_registers: true, mask_k: 2, ..tiny.clone() },
        ModelConfig { mask_self: false, render_extrapolate: Extrapolate::Direct, ..linear.clone() },
        ModelConfig { motion_layout: MotionLayout::SinglePass, motion: motion7(&tiny.motion), ..tiny.clone() },
        ModelConfig { gs: Head::none(), conf: Head::none(), motion: Head::none(), causal_depth: 0, ..tiny.clone() },
    ];
    for (i, config) in configs.iter().enumerate() {
        for (frames, height, width) in [(1, 28, 42), (2, 42, 28), (4, 28, 70)] {
            let [counted, ran] = both(config, ClipShape { frames, height, width });
            assert_eq!(counted, ran, "network {i}, {frames} frames of {width}x{height}: gemm, conv, attention");
            assert!(counted[0] > 0 && counted[2] > 0);
        }
    }
}
