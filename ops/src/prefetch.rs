//! A hint to fetch a cache line that will be read soon; no effect on results.
#![allow(unsafe_code)]

/// Starts to bring the first cache line of `x` near.
#[inline(always)]
pub fn prefetch<T>(x: &T) {
    let at: *const T = x;
    #[cfg(target_arch = "x86_64")]
    // SAFETY: a prefetch reads no data and cannot fault; SSE is part of x86-64.
    unsafe {
        std::arch::x86_64::_mm_prefetch::<{ std::arch::x86_64::_MM_HINT_T0 }>(at.cast());
    }
    #[cfg(target_arch = "aarch64")]
    // SAFETY: a prefetch reads no data and cannot fault.
    unsafe {
        std::arch::asm!("prfm pldl1keep, [{}]", in(reg) at, options(nostack, preserves_flags, readonly));
    }
    #[cfg(not(any(target_arch = "x86_64", target_arch = "aarch64")))]
    let _ = at;
}
