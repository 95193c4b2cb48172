//! Every kernel test once more, with guard pages around every allocation.
//!
//! Canaries see writes only. A vector load beyond the end of a slice gives right results until the slice ends where its mapping ends,
//! as the last tensor of a mapped file does; then it is a crash. Here the global allocator gives every allocation a mapping of its own
//! between two pages without access, so that a load or store one byte beyond inputs, weights, scales, outputs or the working memory
//! of a thread kills this test. Three in four allocations end at the page behind them, the others begin right behind the one in
//! front, in an order that is the same in every run of a test.
//!
//! The modules are those of `tests/kernels`; `exact.rs` adds outputs without canaries around them. When this test dies, `cargo test -p
//! sf-ops --test guard -- --nocapture --test-threads 1` says in which function, and a debugger where.
//!
//! `libc` and not `memmap2`, which has no mapping without access.

#![cfg(unix)]

#[path = "kernels/attention.rs"]
mod attention;
#[path = "kernels/attention_s8.rs"]
mod attention_s8;
#[path = "kernels/common.rs"]
mod common;
#[path = "kernels/conv.rs"]
mod conv;
#[path = "kernels/conv_s8.rs"]
mod conv_s8;
#[path = "kernels/exact.rs"]
mod exact;
#[path = "kernels/gemm.rs"]
mod gemm;
#[path = "kernels/gemm_s8.rs"]
mod gemm_s8;
#[path = "kernels/hash.rs"]
mod hash;
#[path = "kernels/quantize.rs"]
mod quantize;
#[path = "kernels/resize.rs"]
mod resize;
#[path = "kernels/rows.rs"]
mod rows;
#[path = "kernels/tolerance.rs"]
#[allow(dead_code)]
mod tolerance;

use std::alloc::{GlobalAlloc, Layout};
use std::cell::Cell;
use std::sync::atomic::{AtomicUsize, Ordering::Relaxed};

/// Gives every allocation a mapping between two pages without access.
struct Fence;

#[global_allocator]
static FENCE: Fence = Fence;

thread_local! {
    /// Allocations of this thread so far; a test has a thread of its own.
    static COUNT: Cell<u64> = const { Cell::new(0) };
}

/// Bytes of a page.
fn page() -> usize {
    static PAGE: AtomicUsize = AtomicUsize::new(0);
    match PAGE.load(Relaxed) {
        0 => {
            // SAFETY: asks for a constant of the system.
            let page = unsafe { libc::sysconf(libc::_SC_PAGESIZE) } as usize;
            PAGE.store(page, Relaxed);
            page
        }
        page => page,
    }
}

/// Whole pages for so many bytes.
fn inside(bytes: usize) -> usize {
    bytes.max(1).next_multiple_of(page())
}

/// One in four, mixed so that it does not follow the order in which a test allocates.
fn at_the_start() -> bool {
    let n = COUNT.get();
    COUNT.set(n + 1);
    n.wrapping_mul(0x9e37_79b9_7f4a_7c15) >> 62 == 0
}

// SAFETY: every block is a fresh private mapping that holds the layout, page-aligned or moved back from the end by a multiple of the
// alignment; it is unmapped whole when it is freed.
unsafe impl GlobalAlloc for Fence {
    unsafe fn alloc(&self, layout: Layout) -> *mut u8 {
        let (page, inside) = (page(), inside(layout.size()));
        if layout.align() > page {
            return std::ptr::null_mut();
        }
        // SAFETY: a new mapping; the part between the guards lies inside it.
        unsafe {
            let flags = libc::MAP_PRIVATE | libc::MAP_ANONYMOUS;
            let map = libc::mmap(std::ptr::null_mut(), inside + 2 * page, libc::PROT_NONE, flags, -1, 0);
            if map == libc::MAP_FAILED {
                return std::ptr::null_mut();
            }
            let map = map.cast::<u8>();
            // A backtrace makes more blocks than a process may have guarded mappings; without guards neighbours are one.
            let (open, len) = if std::thread::panicking() { (0, inside + 2 * page) } else { (page, inside) };
            if libc::mprotect(map.add(open).cast(), len, libc::PROT_READ | libc::PROT_WRITE) != 0 {
                return std::ptr::null_mut();
            }
            // The rest of a slice's length is a multiple of its alignment, so its end is the page's.
            let skip = if at_the_start() { 0 } else { (inside - layout.size()) & !(layout.align() - 1) };
            map.add(page + skip)
        }
    }

    unsafe fn dealloc(&self, p: *mut u8, layout: Layout) {
        // Either way the block begins in the first page between the guards.
        let map = p.map_addr(|a| (a & !(page() - 1)) - page());
        // SAFETY: the mapping that `alloc` made for this layout.
        unsafe { libc::munmap(map.cast(), inside(layout.size()) + 2 * page()) };
    }
}

/// Whether a process dies of reading this byte. A child does it, and nothing else.
fn dies_reading(at: *const u8) -> bool {
    // SAFETY: the child of a process with threads may only do what a signal handler may: one read and `_exit`.
    unsafe {
        let child = libc::fork();
        assert!(child >= 0, "{}", std::io::Error::last_os_error());
        if child == 0 {
            libc::signal(libc::SIGSEGV, libc::SIG_DFL);
            std::ptr::read_volatile(at);
            libc::_exit(0);
        }
        let mut status = 0;
        assert_eq!(libc::waitpid(child, &mut status, 0), child);
        libc::WIFSIGNALED(status) && libc::WTERMSIG(status) == libc::SIGSEGV
    }
}

#[test]
fn one_byte_beyond_kills() {
    let (mut ends, mut starts) = (0, 0);
    for n in (1..200).chain([1024, 4095, 4096, 4097, 50_000]) {
        let x = vec![1.0f32; n];
        let (first, behind) = (x.as_ptr().cast::<u8>(), x.as_ptr_range().end.cast::<u8>());
        assert!(!dies_reading(first) && !dies_reading(behind.wrapping_sub(1)), "{n} values must be readable");
        let (end, start) = (behind.addr().is_multiple_of(page()), first.addr().is_multiple_of(page()));
        assert!(end || start, "{n} values touch no guard page");
        assert!(!end || dies_reading(behind), "{n} values: read beyond the end");
        assert!(!start || dies_reading(first.wrapping_sub(1)), "{n} values: read before the start");
        (ends, starts) = (ends + usize::from(end), starts + usize::from(start));
    }
    assert!(ends > 100 && starts > 30, "{ends} ends and {starts} starts at guard pages");
}
