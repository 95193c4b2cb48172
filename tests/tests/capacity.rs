//! The nano preset at its demonstration size: time within reason, textured output, memory as planned. The
//! larger presets are measured with the example `capacity`.

use sf_formats::ModelConfig;
use sf_formats::blob::{Blob, Dtype};
use sf_quant::convert::{Options as Convert, convert_to_bytes};
use sf_quant::seeded::{Outputs, Seeded};
use sf_tests::tiny::{Frames, session};
use std::sync::Arc;
use std::time::Instant;
use streetforward::Model;

#[test]
fn nano_runs_a_clip_of_four_frames() {
    let seeded = Seeded::new(&ModelConfig::nano(), 1, Outputs::Random).unwrap();
    let bytes = convert_to_bytes(&seeded, &Convert::to(Dtype::F16)).unwrap();
    let model = Arc::new(Model::from_blob(Blob::from_bytes(&bytes).unwrap()).unwrap());
    let clip = Frames::new(4, 168, 252, 1);
    let mut session = session(&model, clip.shape);
    println!("{}", session.plan());
    let clock = Instant::now();
    let out = session.run(&clip.input()).unwrap();
    println!("{:.0} ms", clock.elapsed().as_secs_f64() * 1e3);
    // 20 GFLOP: some hundreds of milliseconds; the limit only catches a kernel that lost its vector form.
    assert!(clock.elapsed().as_secs() < 60);
    let spread = |v: &mut dyn Iterator<Item = f32>| {
        let (lo, hi) = v.fold((f32::MAX, f32::MIN), |(lo, hi), v| (lo.min(v), hi.max(v)));
        hi - lo
    };
    assert!(spread(&mut out.depth.iter().copied()) > 0.01);
    assert!(spread(&mut out.mean.iter().map(|m| m[0])) > 0.1);
    assert!(out.dynamic.iter().all(|p| (0.0..=1.0).contains(p)));
    assert_eq!(out.to_scene(model.config(), &[]).len(), 4 * 168 * 252);
}
