//! A session allocates and starts threads on creation, never again after its first run; and its arena is what the plan
//! says.

mod counting;

use counting::counts;
use sf_formats::blob::Blob;
use sf_formats::blob::Dtype;
use sf_formats::config::Head;
use sf_quant::convert::convert_to_bytes;
use sf_quant::seeded::{Outputs, Seeded};
use sf_tests::int8::converted;
use sf_tests::tiny::{Frames, model, session, tensors, tiny, tiny_guided};
use std::sync::Arc;
use streetforward::Model;

/// Bytes of records of fixed size: the plan's lists, the pool's flags, cameras and maps of three frames.
const RECORDS: usize = 8 << 10;

/// One test: the counters belong to the process.
#[test]
fn a_warm_session_allocates_nothing() {
    let pyramids = tiny();
    let linear = sf_formats::ModelConfig {
        gs: Head::xdec_linear(11, 16, 1, 2),
        motion: Head::xdec_linear(4, 16, 1, 2),
        conf: Head::none(),
        ..tiny()
    };
    for config in [pyramids, linear, tiny_guided()] {
        for dtype in Dtype::ALL {
            let tensors = tensors(&config, 1);
            let model = match dtype {
                Dtype::Int8 => converted(&config, &tensors, sf_quant::Options::to(dtype)),
                _ => model(&config, &tensors, dtype),
            };
            let clip = Frames::new(3, 28, 42, 1);
            let before = counts();
            let mut session = session(&model, clip.shape);
            let made = (counts().held - before.held) as usize;
            // Of two threads one is the caller's: the counter sees the other.
            assert_eq!(counts().threads - before.threads, 1);
            let planned = session.plan().session_bytes() as usize;
            // The plan itself, bookkeeping of threads and per-frame records come on top.
            assert!(
                made >= planned && made < planned + planned / 100 + RECORDS,
                "{made} bytes held, {planned} planned"
            );
            let warm = counts();
            session.run(&clip.input()).unwrap();
            // Threads keep nothing that the plan did not foresee.
            assert_eq!(counts(), warm, "allocations or threads in the first run");
            for _ in 0..3 {
                session.run(&clip.input()).unwrap();
            }
            assert_eq!(counts(), warm, "allocations or threads in warm runs");

            let frame = &clip.images[..28 * 42 * 3];
            let before = counts();
            (0..4).for_each(|f| assert_eq!(session.push(frame, f64::from(f), None).unwrap().is_some(), f >= 2));
            let warm = counts();
            assert_eq!((warm.held - before.held) as u64, session.plan().stream_bytes());
            (4..7).for_each(|f| assert!(session.push(frame, f64::from(f), None).unwrap().is_some()));
            (7..10).for_each(|f| assert!(session.push_newest(frame, f64::from(f), None).unwrap().is_some()));
            assert_eq!(counts(), warm, "allocations or threads in a warm stream");
        }
    }
    real_sizes();
}

/// At the size of the demonstration, what is held is what is planned within one in a hundred: nano, and pyramids.
fn real_sizes() {
    let small = Head::dpt(11, [0, 1, 2, 2], [16, 16, 32, 32], 32);
    let pyramids = sf_formats::ModelConfig { gs: small, ..sf_formats::ModelConfig::nano() };
    for config in [sf_formats::ModelConfig::nano(), pyramids] {
        for dtype in [Dtype::F32, Dtype::Int8] {
            let seeded = Seeded::new(&config, 1, Outputs::Random).unwrap();
            let bytes = convert_to_bytes(&seeded, &sf_quant::Options::to(dtype)).unwrap();
            let model = Arc::new(Model::from_blob(Blob::from_bytes(&bytes).unwrap()).unwrap());
            let clip = Frames::new(4, 168, 252, 1);
            let before = counts();
            let mut session = session(&model, clip.shape);
            session.run(&clip.input()).unwrap();
            let (held, planned) = ((counts().held - before.held) as f64, session.plan().session_bytes() as f64);
            println!("{dtype:?}: {held} bytes held, {planned} planned");
            assert!((held / planned - 1.0).abs() < 0.01, "{held} bytes held, {planned} planned");
        }
    }
}
