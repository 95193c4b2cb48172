//! Hints to fetch cache lines that will be read or written soon; no effect on results.
#![allow(unsafe_code)]

/// Starts to bring the first cache line of `x` near.
#[inline(always)]
pub fn prefetch<T>(x: &T) {
    near_l1(x);
}

/// A hint by its name on x86-64 and the operation of `prfm` on aarch64.
macro_rules! hint {
    ($(#[$about:meta])* $name:ident, $x86:ident, $arm:literal) => {
        $(#[$about])*
        #[inline(always)]
        pub(crate) fn $name<T>(at: *const T) {
            #[cfg(target_arch = "x86_64")]
            // SAFETY: a prefetch reads no data and faults for no address; SSE is part of x86-64.
            unsafe {
                std::arch::x86_64::_mm_prefetch::<{ std::arch::x86_64::$x86 }>(at.cast());
            }
            #[cfg(target_arch = "aarch64")]
            // SAFETY: a prefetch reads no data and faults for no address.
            unsafe {
                std::arch::asm!(concat!("prfm ", $arm, ", [{}]"), in(reg) at, options(nostack, preserves_flags, readonly));
            }
            #[cfg(not(any(target_arch = "x86_64", target_arch = "aarch64")))]
            let _ = at;
        }
    };
}

hint!(
    /// Starts to bring the cache line of any address to the first-level cache.
    near_l1, _MM_HINT_T0, "pldl1keep"
);
hint!(
    /// Starts to bring the cache line of any address to the second-level cache.
    near_l2, _MM_HINT_T1, "pldl2keep"
);
hint!(
    /// Starts to bring the cache line of any address near, to be written. On x86-64 a plain prefetch while the kernels do not enable
    /// `prfchw`: a line that no other core holds arrives writable anyway.
    near_for_writing, _MM_HINT_ET0, "pstl1keep"
);
