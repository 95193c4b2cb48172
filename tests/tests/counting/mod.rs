//! Counts what a process asks of the system: calls of the allocator, and threads started. By any thread, so a file that uses
//! it holds one test at a time.

use std::alloc::{GlobalAlloc, Layout, System};
use std::ffi::{c_int, c_void};
use std::sync::atomic::{AtomicI32, AtomicIsize, AtomicPtr, AtomicUsize, Ordering::SeqCst};

struct Counting;

static CALLS: AtomicUsize = AtomicUsize::new(0);
static BYTES: AtomicUsize = AtomicUsize::new(0);
static HELD: AtomicIsize = AtomicIsize::new(0);
static THREADS: AtomicUsize = AtomicUsize::new(0);
/// A thread that is not counted; 0: all are.
static IGNORED: AtomicI32 = AtomicI32::new(0);

/// Leaves the allocations of the process's first thread out, unless it is the caller: there the test harness allocates when
/// it tells that a test takes over a minute.
#[allow(dead_code)]
pub(crate) fn ignore_harness() {
    // SAFETY: calls without arguments that cannot fail.
    let (first, here) = unsafe { (libc::getpid(), libc::gettid()) };
    IGNORED.store(if first == here { 0 } else { first }, SeqCst);
}

/// Whether the calling thread is counted.
fn counted() -> bool {
    let ignored = IGNORED.load(SeqCst);
    // SAFETY: a call without arguments that cannot fail.
    ignored == 0 || unsafe { libc::gettid() } != ignored
}

/// What was asked for since the process started.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) struct Counts {
    /// Allocations, growths and releases.
    pub(crate) calls: usize,
    /// Bytes asked for.
    pub(crate) bytes: usize,
    /// Bytes asked for and not yet given back, of all threads; frees of what was there before the process counted make it negative.
    pub(crate) held: isize,
    /// Threads started.
    pub(crate) threads: usize,
}

/// The counts now.
pub(crate) fn counts() -> Counts {
    Counts {
        calls: CALLS.load(SeqCst),
        bytes: BYTES.load(SeqCst),
        held: HELD.load(SeqCst),
        threads: THREADS.load(SeqCst),
    }
}

// SAFETY: forwards every call unchanged to the system's allocator.
unsafe impl GlobalAlloc for Counting {
    unsafe fn alloc(&self, layout: Layout) -> *mut u8 {
        if counted() {
            CALLS.fetch_add(1, SeqCst);
            BYTES.fetch_add(layout.size(), SeqCst);
        }
        HELD.fetch_add(layout.size() as isize, SeqCst);
        // SAFETY: the caller's layout, unchanged.
        unsafe { System.alloc(layout) }
    }

    unsafe fn dealloc(&self, pointer: *mut u8, layout: Layout) {
        CALLS.fetch_add(usize::from(counted()), SeqCst);
        HELD.fetch_sub(layout.size() as isize, SeqCst);
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
