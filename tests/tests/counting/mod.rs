//! Counts what a process asks of the system: calls of the allocator, and threads started. By any thread, so a file that uses
//! it holds one test at a time.

use std::alloc::{GlobalAlloc, Layout, System};
use std::ffi::{c_int, c_void};
use std::sync::atomic::{AtomicPtr, AtomicUsize, Ordering::SeqCst};

struct Counting;

static CALLS: AtomicUsize = AtomicUsize::new(0);
static BYTES: AtomicUsize = AtomicUsize::new(0);
static THREADS: AtomicUsize = AtomicUsize::new(0);

/// What was asked for since the process started.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) struct Counts {
    /// Allocations, growths and releases.
    pub(crate) calls: usize,
    /// Bytes asked for.
    pub(crate) bytes: usize,
    /// Threads started.
    pub(crate) threads: usize,
}

/// The counts now.
pub(crate) fn counts() -> Counts {
    Counts { calls: CALLS.load(SeqCst), bytes: BYTES.load(SeqCst), threads: THREADS.load(SeqCst) }
}

// SAFETY: forwards every call unchanged to the system's allocator.
unsafe impl GlobalAlloc for Counting {
    unsafe fn alloc(&self, layout: Layout) -> *mut u8 {
        CALLS.fetch_add(1, SeqCst);
        BYTES.fetch_add(layout.size(), SeqCst);
        // SAFETY: the caller's layout, unchanged.
        unsafe { System.alloc(layout) }
    }

    unsafe fn dealloc(&self, pointer: *mut u8, layout: Layout) {
        CALLS.fetch_add(1, SeqCst);
        // SAFETY: the pointer came from `alloc` above with this layout.
        unsafe { System.dealloc(pointer, layout) }
    }
}

#[global_allocator]
static COUNTING: Counting = Counting;

type Start = extern "C" fn(*mut c_void) -> *mut c_void;
type Create = unsafe extern "C" fn(*mut libc::pthread_t, *const libc::pthread_attr_t, Start, *mut c_void) -> c_int;

/// Stands in front of the C library's function of this name, through which every thread of a Rust program starts.
///
/// # Safety
/// As of `pthread_create`.
// SAFETY: same name, signature and effect as the function that it hides.
#[unsafe(no_mangle)]
unsafe extern "C" fn pthread_create(
    thread: *mut libc::pthread_t,
    attributes: *const libc::pthread_attr_t,
    start: Start,
    argument: *mut c_void,
) -> c_int {
    static NEXT: AtomicPtr<c_void> = AtomicPtr::new(std::ptr::null_mut());
    THREADS.fetch_add(1, SeqCst);
    if NEXT.load(SeqCst).is_null() {
        // SAFETY: a name that ends in a zero; the result is checked below.
        NEXT.store(unsafe { libc::dlsym(libc::RTLD_NEXT, c"pthread_create".as_ptr()) }, SeqCst);
    }
    let next = NEXT.load(SeqCst);
    assert!(!next.is_null(), "no pthread_create behind this one");
    // SAFETY: the C library's function of this name has this signature.
    let create: Create = unsafe { std::mem::transmute::<*mut c_void, Create>(next) };
    // SAFETY: the caller's arguments, unchanged.
    unsafe { create(thread, attributes, start, argument) }
}
