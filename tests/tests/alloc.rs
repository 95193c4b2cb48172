//! A session allocates and starts threads on creation, never again after its first run; and its arena is what the plan
//! says.

mod counting;

use counting::counts;
use sf_formats::blob::Dtype;
use sf_formats::config::Head;
use sf_tests::int8::converted;
use sf_tests::tiny::{Frames, model, session, tensors, tiny, tiny_guided};
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
            let made = counts().bytes - before.bytes;
            // Of two threads one is the caller's: the counter sees the other.
            assert_eq!(counts().threads - before.threads, 1);
            let planned = (session.plan().arena_bytes() + session.plan().output_bytes()) as usize;
            // Tables, thread stacks' bookkeeping and per-frame records come on top.
            assert!(made >= planned && made < planned + planned / 4, "{made} bytes allocated, {planned} planned");
            session.run(&clip.input()).unwrap();
            let warm = counts();
            for _ in 0..3 {
                session.run(&clip.input()).unwrap();
            }
            assert_eq!(counts(), warm, "allocations or threads in warm runs");

            let frame = &clip.images[..28 * 42 * 3];
            (0..4).for_each(|f| assert_eq!(session.push(frame, f64::from(f), None).unwrap().is_some(), f >= 2));
            let warm = counts();
            (4..7).for_each(|f| assert!(session.push(frame, f64::from(f), None).unwrap().is_some()));
            assert_eq!(counts(), warm, "allocations or threads in a warm stream");
        }
    }
}
