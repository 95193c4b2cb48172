//! A session allocates on creation and in its first run, never again; and its arena is what the plan says.

use sf_formats::blob::Dtype;
use sf_formats::config::Head;
use sf_tests::int8::converted;
use sf_tests::tiny::{Frames, model, session, tensors, tiny, tiny_guided};
use std::alloc::{GlobalAlloc, Layout, System};
use std::sync::atomic::{AtomicUsize, Ordering::SeqCst};

/// Calls and bytes asked of the allocator, by any thread.
struct Counting;

static CALLS: AtomicUsize = AtomicUsize::new(0);
static BYTES: AtomicUsize = AtomicUsize::new(0);

// SAFETY: forwards every call unchanged to the system's allocator.
unsafe impl GlobalAlloc for Counting {
    unsafe fn alloc(&self, layout: Layout) -> *mut u8 {
        CALLS.fetch_add(1, SeqCst);
        BYTES.fetch_add(layout.size(), SeqCst);
        // SAFETY: the caller's layout, unchanged.
        unsafe { System.alloc(layout) }
    }

    unsafe fn dealloc(&self, pointer: *mut u8, layout: Layout) {
        // SAFETY: the pointer came from `alloc` above with this layout.
        unsafe { System.dealloc(pointer, layout) }
    }
}

#[global_allocator]
static COUNTING: Counting = Counting;

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
            let before = BYTES.load(SeqCst);
            let mut session = session(&model, clip.shape);
            let made = BYTES.load(SeqCst) - before;
            let planned = (session.plan().arena_bytes() + session.plan().output_bytes()) as usize;
            // Tables, thread stacks' bookkeeping and per-frame records come on top.
            assert!(made >= planned && made < planned + planned / 4, "{made} bytes allocated, {planned} planned");
            session.run(&clip.input()).unwrap();
            let calls = CALLS.load(SeqCst);
            for _ in 0..3 {
                session.run(&clip.input()).unwrap();
            }
            assert_eq!(CALLS.load(SeqCst) - calls, 0, "allocations in warm runs");

            let frame = &clip.images[..28 * 42 * 3];
            (0..4).for_each(|f| assert_eq!(session.push(frame, f64::from(f), None).unwrap().is_some(), f >= 2));
            let calls = CALLS.load(SeqCst);
            (4..7).for_each(|f| assert!(session.push(frame, f64::from(f), None).unwrap().is_some()));
            assert_eq!(CALLS.load(SeqCst) - calls, 0, "allocations in a warm stream");
        }
    }
}
