//! What every function does around its work.
#![allow(unsafe_code, reason = "exported names, and the caller's buffer")]

use std::any::Any;
use std::cell::RefCell;
use std::ffi::{c_char, c_int};
use std::panic::{AssertUnwindSafe, catch_unwind};

use sf_formats::{Error, Result, Status};
use sf_ops::cpu::DefaultFloatMode;

thread_local! {
    /// Message of this thread's last failed call.
    static LAST: RefCell<String> = const { RefCell::new(String::new()) };
}

/// Runs the body of a function. No panic gets out; the caller's floating-point mode, which would change results, is put
/// back afterwards.
pub(crate) fn call(body: impl FnOnce() -> Result<()>) -> c_int {
    let result = catch_unwind(AssertUnwindSafe(|| {
        let _mode = DefaultFloatMode::enter();
        body()
    }))
    .unwrap_or_else(|payload| Err(Error::Internal(text(&*payload))));
    match result {
        Ok(()) => Status::Ok as c_int,
        Err(e) => {
            // A thread that is ending has no message any more.
            let _ = LAST.try_with(|last| *last.borrow_mut() = e.line());
            e.status() as c_int
        }
    }
}

/// What a panic said.
fn text(payload: &(dyn Any + Send)) -> String {
    let text = payload.downcast_ref::<&str>().copied();
    text.or_else(|| payload.downcast_ref::<String>().map(String::as_str)).unwrap_or("panic").to_string()
}

/// The message of this thread's last failed call, cut to `capacity - 1` bytes; the length that holds all of it, its
/// zero included.
///
/// # Safety
/// `buffer` is null or has room for `capacity` bytes.
#[unsafe(no_mangle)]
pub(crate) unsafe extern "C" fn sf_last_error(buffer: *mut c_char, capacity: usize) -> usize {
    LAST.try_with(|last| {
        let Ok(last) = last.try_borrow() else { return 1 };
        if !buffer.is_null() && capacity > 0 {
            let shown = last.len().min(capacity - 1);
            // SAFETY: room for `capacity` bytes, the caller's promise.
            unsafe {
                std::ptr::copy_nonoverlapping(last.as_ptr().cast(), buffer, shown);
                *buffer.add(shown) = 0;
            }
        }
        last.len() + 1
    })
    .unwrap_or(1)
}

/// [`crate::ABI_VERSION`].
#[unsafe(no_mangle)]
pub(crate) extern "C" fn sf_abi_version() -> u32 {
    crate::ABI_VERSION
}

/// The version of the package.
#[unsafe(no_mangle)]
pub(crate) extern "C" fn sf_version() -> *const c_char {
    concat!(env!("CARGO_PKG_VERSION"), "\0").as_ptr().cast()
}
