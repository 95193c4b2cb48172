//! Fast path against reference path on random configurations: every choice of the configuration and many
//! shapes, in combinations that the golden networks do not have.

use sf_formats::ModelConfig;
use sf_formats::blob::Dtype;
use sf_formats::config::{
    Anchor, AngleRound, Combine, Concat, DepthMap, Extrapolate, GsMap, Head, HeadKind, KSource, MotionFrame,
    MotionLayout, MotionPer, Order, Orientation, PixelCentre, RcuSkip, Trunk,
};
use sf_tests::tiny::{Frames, Noise, model, stages, tensors};
use streetforward::reference;

/// Largest difference over the largest value of a stage, fast against reference: f32 sums; 9e-6 measured.
const LIMIT: f32 = 5e-5;

struct Draw(Noise);

impl Draw {
    fn of<T: Clone>(&mut self, options: &[T]) -> T {
        let x = (self.0.draw() + 1.0) / 2.0;
        options[((x * options.len() as f32) as usize).min(options.len() - 1)].clone()
    }

    fn number(&mut self, options: std::ops::Range<u32>) -> u32 {
        self.of(&options.collect::<Vec<_>>())
    }

    /// Width and heads.
    fn width(&mut self) -> (u32, u32) {
        let heads = self.of(&[1, 2, 3]);
        (heads * self.of(&[4, 8, 12, 20]), heads)
    }

    fn head(&mut self, out: u32, layers: u32) -> Head {
        if self.of(&[true, false]) {
            let (dim, heads) = self.width();
            return Head::xdec_linear(out, dim, self.number(0..3), heads);
        }
        if self.of(&[true, false]) {
            let (dim, heads) = self.width();
            let decoder = (dim, self.number(0..3), heads);
            return Head::guided(out, decoder, self.number(1..9), self.of(&[4, 7, 16]));
        }
        let mut four = |options: std::ops::Range<u32>| std::array::from_fn(|_| self.number(options.clone()));
        let (taps, channels) = (four(0..layers), four(1..5).map(|c| 4 * c));
        let features = self.of(&[8, 16, 24]);
        let head = Head::dpt(out, taps, channels, features);
        Head { hidden: self.of(&[5, 8]), rcu_skip: self.of(&[RcuSkip::Relu, RcuSkip::Raw]), ..head }
    }

    fn config(&mut self) -> ModelConfig {
        let (dim, heads) = self.width();
        let trunk = |d: &mut Draw, depth| Trunk {
            dim,
            depth,
            heads,
            registers: d.number(0..4),
            mlp_ratio: d.number(1..4),
            eps: d.of(&[1e-6, 1e-3]),
        };
        let depth = 2 * self.number(1..4);
        let (encoder, aa) = (trunk(self, 2), trunk(self, depth));
        let depth_map =
            self.of(&[DepthMap::Pi3Point, DepthMap::Pi3Point, DepthMap::Pi3Point, DepthMap::ExpZ, DepthMap::ExpZConf]);
        let (camera_dim, camera_heads) = self.width();
        let causal_in = self.of(&[Concat::Last, Concat::FrameGlobal]);
        let single = self.of(&[true, false, false]);
        let wide = if causal_in == Concat::Last { dim } else { 2 * dim };
        let causal_depth = self.number(1..4);
        // The head width inside the causal module must be a multiple of 4, and so must time.d_t here.
        let (time_dim, causal_heads) = (4 * self.number(1..4), 1);
        assert!((wide + time_dim) % 4 == 0);
        let mut config = ModelConfig {
            patch: self.of(&[4, 7, 14]),
            encoder,
            pos_grid: self.number(2..6),
            aa,
            aa_order: self.of(&[Order::FrameFirst, Order::GlobalFirst]),
            aa_time: self.of(&[true, false]),
            rope_round: self.of(&[AngleRound::None, AngleRound::Bf16]),
            head_concat: self.of(&[Concat::FrameGlobal, Concat::Last]),
            camera_dim,
            camera_heads,
            camera_depth: self.number(0..3),
            camera_width: self.of(&[8, 20]),
            camera_k: if depth_map == DepthMap::Pi3Point {
                self.of(&[KSource::FitShared, KSource::FitFrame, KSource::Fov])
            } else {
                KSource::Fov
            },
            camera_pixel: self.of(&[PixelCentre::Half, PixelCentre::Integer]),
            depth_map,
            gs_map: self.of(&[GsMap::Residual, GsMap::Dggt]),
            time_dim,
            causal_depth,
            causal_heads,
            causal_in,
            causal_registers: self.of(&[true, false]),
            causal_share: single || self.of(&[true, false]),
            mask_orientation: self.of(&[Orientation::Equation, Orientation::Figure]),
            mask_self: self.of(&[true, false]),
            mask_k: self.number(1..4),
            motion_layout: if single { MotionLayout::SinglePass } else { MotionLayout::PerDirection },
            motion_frame: self.of(&[MotionFrame::Camera, MotionFrame::World]),
            motion_per: self.of(&[MotionPer::Second, MotionPer::Step]),
            motion_back_sign: self.of(&[1, -1]),
            motion_combine: self.of(&[Combine::Mean, Combine::Max]),
            world_anchor: self.of(&[Anchor::First, Anchor::Raw]),
            world_scale: self.of(&[1.0, 2.5]),
            render_extrapolate: self.of(&[Extrapolate::Mirror, Extrapolate::Direct]),
            sky_conf: self.of(&[0.1, 0.5]),
            ..ModelConfig::base()
        };
        let out = match depth_map {
            DepthMap::Pi3Point => 3,
            DepthMap::ExpZ => 1,
            DepthMap::ExpZConf => 2,
        };
        config.depth = self.head(out, depth / 2);
        let conf = depth_map != DepthMap::ExpZConf && self.of(&[true, false]);
        config.conf = if conf { self.head(1, depth / 2) } else { Head::none() };
        config.gs = if self.of(&[true, true, false]) { self.head(11, depth / 2) } else { Head::none() };
        config.motion = self.head(if single { 7 } else { 4 }, causal_depth);
        let ModelConfig { patch, depth, conf, gs, motion, .. } = &mut config;
        let mut guided = false;
        for head in [depth, conf, gs, motion] {
            if head.kind == HeadKind::Guided {
                // Guided heads need an even patch.
                *patch = if *patch == 7 { 6 } else { *patch };
                guided = true;
            }
        }
        config.guide_channels = if guided { self.number(1..8) } else { 0 };
        config
    }
}

#[test]
fn fast_and_reference_agree_on_random_networks() {
    let (mut worst, mut guided) = ((0.0f32, String::new()), 0);
    for seed in 0..40 {
        let mut draw = Draw(Noise::new(1000 + seed));
        let config = draw.config();
        config.check("random").unwrap_or_else(|e| panic!("seed {seed}: {e}"));
        guided += usize::from(config.guide_channels > 0);
        let (rows, cols) = (draw.number(1..5) as usize, draw.number(1..6) as usize);
        let patch = config.patch as usize;
        let clip = Frames::new(draw.number(1..5) as usize, rows * patch, cols * patch, seed);
        let weights = tensors(&config, seed);

        let fast = stages(&model(&config, &weights, Dtype::F32), &clip.input());
        let loaded = reference::Weights::from_map(weights, &config).unwrap();
        let plain = reference::run(&loaded, &config, &clip.input()).unwrap();
        let mut compared = 0;
        for (name, stage) in plain.0.iter().filter(|(name, _)| *name != "time" && *name != "camera.fov") {
            let mine = fast.get(name).unwrap_or_else(|| panic!("seed {seed}: {name} is not shown"));
            assert_eq!(mine.len(), stage.data.len(), "seed {seed}: {name}");
            let top = stage.data.iter().fold(1e-9f32, |m, v| m.max(v.abs()));
            let far =
                |sign: f32, a: &[f32], b: &[f32]| a.iter().zip(b).fold(0.0f32, |m, (a, b)| m.max((sign * a - b).abs()));
            let d = if name == "out.quat" {
                let pairs = mine.chunks_exact(4).zip(stage.data.chunks_exact(4));
                pairs.fold(0.0f32, |m, (a, b)| m.max(far(1.0, a, b).min(far(-1.0, a, b))))
            } else {
                far(1.0, mine, &stage.data)
            } / top;
            if d > worst.0 {
                worst = (d, format!("seed {seed} {name}"));
            }
            assert!(d <= LIMIT, "seed {seed}: {name} is off by {d:.1e}; {config:?}");
            compared += 1;
        }
        assert!(compared >= 15, "seed {seed}: {compared} stages");
    }
    println!("worst: {} {:.1e}; {guided} networks with guided heads", worst.1, worst.0);
    assert!(guided >= 8, "{guided} networks with guided heads");
}
