//! The multiply-adds that the engine counts before a run are those that its operations count during one.

use sf_formats::Dtype;
use sf_formats::ModelConfig;
use sf_formats::config::{Concat, Extrapolate, Head, KSource, MotionLayout, Order};
use sf_ops::opclock::{self, Op};
use sf_quant::Options;
use sf_tests::int8;
use sf_tests::tiny::{Frames, model, session, tensors, tiny, tiny_guided};
use std::sync::Arc;
use streetforward::{ClipShape, Cost, Model, StageCost};

/// Gemm, convolution, attention, int8: counted before a run, and by its operations.
fn both(model: &Arc<Model>, shape: ClipShape) -> [[u64; 4]; 2] {
    let cost = Cost::of_model(model, shape).unwrap();
    let mut session = session(model, shape);
    let clip = Frames::new(shape.frames, shape.height, shape.width, 5);
    opclock::start();
    session.run(&clip.input()).unwrap();
    let accounts = opclock::stop();
    let of = |op: Op| accounts[op as usize].work.macs;
    let sum = |part: fn(&StageCost) -> u64| cost.stages().iter().map(part).sum::<u64>();
    let int8 = of(Op::GemmS8) + of(Op::AttentionS8) + of(Op::ConvS8);
    assert_eq!(cost.int8(), sum(|s| s.int8));
    [
        [sum(|s| s.gemm), sum(|s| s.conv), sum(|s| s.attention), cost.int8()],
        [of(Op::Gemm) + of(Op::GemmS8), of(Op::Conv) + of(Op::ConvS8), of(Op::Attention) + of(Op::AttentionS8), int8],
    ]
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
            let shape = ClipShape { frames, height, width };
            let [counted, ran] = both(&model(config, &tensors(config, 3), Dtype::F32), shape);
            assert_eq!(counted, ran, "network {i}, {frames} frames of {width}x{height}: gemm, conv, attention, int8");
            assert!(counted[0] > 0 && counted[2] > 0 && counted[3] == 0);
            let float = Cost::of(config, shape).unwrap();
            assert_eq!(float.macs(), counted[..3].iter().sum::<u64>());
        }
    }
}

#[test]
fn int8_is_counted_apart() {
    for config in [int8::tiny(), int8::tiny().with_linear_heads()] {
        let model = int8::converted(&config, &tensors(&config, 3), Options::to(Dtype::Int8));
        for frames in [1, 3] {
            let [counted, ran] = both(&model, ClipShape { frames, height: 28, width: 42 });
            assert_eq!(counted, ran, "{frames} frames: gemm, conv, attention, int8");
            assert!(counted[3] > 0 && counted[3] < counted[..3].iter().sum());
        }
    }
}
