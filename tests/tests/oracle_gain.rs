//! What the representation can reach: one Gaussian per pixel with true depth, poses, velocity and mask, composed and
//! drawn by nano's rules, against copying the nearest given picture; on held-out streets at nano's size.

use sf_eval::{
    EvalClip, EvalFrame, EvalOptions, EvalReport, Method, Metric, OracleFrame, OracleOptions, Part, Protocol, evaluate,
    measure, oracle_scene,
};
use sf_formats::ModelConfig;
use sf_formats::clip::TruthFrame;
use sf_formats::image_io::Rgb8;
use sf_formats::scene::{Compose, SplatSettings};
use sf_splat::Renderer;
use sf_synth::{DYNAMIC, Frame, Options, Split, Street};

/// Streets; more move the means by some tenths of a dB.
const STREETS: usize = 4;

fn judge(frames: &[Frame], (width, height): (u32, u32), renderer: &mut Renderer) -> EvalReport {
    let images: Vec<Rgb8> = frames.iter().map(|f| Rgb8::new(width, height, f.rgb.clone())).collect();
    let truth = |f: &Frame| TruthFrame {
        width,
        height,
        depth: f.depth.clone(),
        velocity: Some(f.velocity.clone()),
        dynamic: Some(f.dynamic(DYNAMIC).iter().map(|&m| m != 0).collect()),
    };
    let truths: Vec<TruthFrame> = frames.iter().map(truth).collect();
    let options = EvalOptions::new(Protocol::storm20(frames.len()).unwrap());
    let nano = ModelConfig::nano();
    let given: Vec<OracleFrame> = options
        .protocol
        .context
        .iter()
        .map(|&c| OracleFrame {
            time: frames[c].time,
            camera: frames[c].camera,
            image: &images[c],
            truth: &truths[c],
            name: "",
        })
        .collect();
    let rules =
        OracleOptions { compose: Compose::of(&nano), splat: SplatSettings::of(&nano), ..OracleOptions::default() };
    let scene = oracle_scene(&given, &rules).unwrap();
    let all = (0..frames.len()).map(|i| EvalFrame {
        time: frames[i].time,
        image: &images[i],
        pose: Some(frames[i].camera.pose),
        truth: Some(&truths[i]),
    });
    let clip = EvalClip { frames: all.collect() };
    let mut report = evaluate(&clip, &scene, renderer, &options).unwrap();
    measure(&mut report, Method::Oracle, &clip, &(&scene).into(), (renderer, &options)).unwrap();
    report
}

#[test]
fn true_geometry_is_far_above_a_copy() {
    let [width, height] = ModelConfig::nano().image_size.unwrap();
    let mut renderer = Renderer::new(2).unwrap();
    let mut total: Option<EvalReport> = None;
    for seed in Split::HeldOut.seeds(0).take(STREETS) {
        let street = Street::new(seed, Options { width, height, ..Options::default() }).unwrap();
        let report = judge(&street.frames(), (width, height), &mut renderer);
        match &mut total {
            Some(total) => total.merge(&report).unwrap(),
            None => total = Some(report),
        }
    }
    let total = total.unwrap();
    println!("{}", total.to_markdown());
    let get = |method, metric| total.scores(method, Part::Interpolation).get(metric).unwrap();
    let gain = |metric| get(Method::Oracle, metric) - get(Method::CopyNearest, metric);
    assert!(gain(Metric::PsnrFull) >= 1.8 && gain(Metric::PsnrDynamic) >= 4.5);
    // All that moves is worth its motion.
    assert!(get(Method::Oracle, Metric::PsnrDynamic) > get(Method::NoMotion, Metric::PsnrDynamic) + 4.0);
}
