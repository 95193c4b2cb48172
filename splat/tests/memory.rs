//! A renderer that has drawn a view draws it again without asking for memory.
#![allow(unsafe_code, reason = "an allocator that counts")]

mod common;

use std::alloc::{GlobalAlloc, Layout, System};
use std::sync::atomic::{AtomicUsize, Ordering::SeqCst};

use common::{Rng, camera, hard_scene};
use sf_formats::scene::SplatSettings;
use sf_splat::{Extra, RenderOptions, Rendered, Renderer};

static ALLOCATIONS: AtomicUsize = AtomicUsize::new(0);

struct Counting;

// SAFETY: everything is passed on to the system's allocator unchanged.
unsafe impl GlobalAlloc for Counting {
    unsafe fn alloc(&self, layout: Layout) -> *mut u8 {
        ALLOCATIONS.fetch_add(1, SeqCst);
        // SAFETY: the caller's promise.
        unsafe { System.alloc(layout) }
    }

    unsafe fn dealloc(&self, at: *mut u8, layout: Layout) {
        // SAFETY: the caller's promise.
        unsafe { System.dealloc(at, layout) }
    }

    unsafe fn realloc(&self, at: *mut u8, layout: Layout, size: usize) -> *mut u8 {
        ALLOCATIONS.fetch_add(1, SeqCst);
        // SAFETY: the caller's promise.
        unsafe { System.realloc(at, layout, size) }
    }
}

#[global_allocator]
static COUNTING: Counting = Counting;

// The only test of this file: another one beside it would be counted too.
#[test]
fn the_second_view_of_a_size_allocates_nothing() {
    let rng = &mut Rng(31);
    let camera = camera(rng, 200, 150);
    let scene = hard_scene(rng, &camera, 6000);
    let values = vec![0.5; 2 * scene.len()];
    let extra = Some(Extra { channels: 2, values: &values });
    let options = RenderOptions { extra, ..RenderOptions::default() };
    for threads in [1, 2] {
        let mut renderer = Renderer::new(threads).unwrap();
        let mut out = Rendered::default();
        let mut draw = || {
            let before = ALLOCATIONS.load(SeqCst);
            renderer.render_into(&scene, &camera, &SplatSettings::default(), &options, &mut out).unwrap();
            ALLOCATIONS.load(SeqCst) - before
        };
        assert!(draw() > 0);
        for _ in 0..10 {
            assert_eq!(draw(), 0, "{threads} threads");
        }
    }
}
