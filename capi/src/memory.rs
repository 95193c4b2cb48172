//! The caller's memory: every pointer is checked for null and alignment, every struct for its size, before it is used.
#![allow(unsafe_code, reason = "the caller's pointers")]

use sf_formats::{Error, Result};

/// A `#[repr(C)]` struct whose first field, of type `usize`, is its size as the caller knows it.
///
/// # Safety
/// The first field is a `usize`, and every bit pattern is a value.
pub(crate) unsafe trait Struct: Copy {
    /// As in the header.
    const NAME: &'static str;
}

fn check<T>(p: *const T, name: &str) -> Result<()> {
    if p.is_null() {
        return Err(Error::usage(format!("{name} is NULL")));
    }
    if !p.is_aligned() {
        return Err(Error::usage(format!("{name} is not aligned to {} bytes", align_of::<T>())));
    }
    Ok(())
}

/// Refuses a null, misaligned or wrongly sized struct.
///
/// # Safety
/// `p` is null or points to as many bytes as its first field says.
pub(crate) unsafe fn check_struct<T: Struct>(p: *const T) -> Result<()> {
    check(p, T::NAME)?;
    // SAFETY: not null, aligned; the first field is the size (trait), and it is there (caller).
    let size = unsafe { *p.cast::<usize>() };
    if size != size_of::<T>() {
        return Err(Error::usage(format!(
            "{}: struct_size is {size}, this library has {}: set it, or use the library's own header",
            T::NAME,
            size_of::<T>()
        )));
    }
    Ok(())
}

/// The caller's struct.
///
/// # Safety
/// As [`check_struct`].
pub(crate) unsafe fn read<T: Struct>(p: *const T) -> Result<T> {
    // SAFETY: the caller's promise; then there are as many bytes as the struct has, and any pattern is a value.
    unsafe {
        check_struct(p)?;
        Ok(*p)
    }
}

/// Writes to the caller.
///
/// # Safety
/// `p` is null or points to room for a `T`.
pub(crate) unsafe fn write<T>(p: *mut T, name: &str, value: T) -> Result<()> {
    check(p, name)?;
    // SAFETY: not null, aligned, and room for it (caller).
    unsafe { p.write(value) };
    Ok(())
}

/// The caller's array of `count` values of type T.
///
/// # Safety
/// `p` is null or points to `count` values that nobody changes while the result is alive.
pub(crate) unsafe fn array<'a, T: Copy>(p: *const f32, count: usize, name: &str) -> Result<&'a [T]> {
    const { assert!(align_of::<T>() == align_of::<f32>()) };
    if count == 0 {
        return Ok(&[]);
    }
    check(p, name)?;
    if count.checked_mul(size_of::<T>()).is_none_or(|bytes| bytes > isize::MAX as usize) {
        return Err(Error::usage(format!("{name}: {count} values do not fit into memory")));
    }
    // SAFETY: not null, aligned, of a size that exists; `count` values are there (caller).
    Ok(unsafe { std::slice::from_raw_parts(p.cast(), count) })
}

/// Copies to the caller; a null pointer does not want the values.
///
/// # Safety
/// `p` is null or points to room for `values`, which it does not overlap.
pub(crate) unsafe fn put<T: Copy>(p: *mut T, values: &[T], name: &str) -> Result<()> {
    if p.is_null() || values.is_empty() {
        return Ok(());
    }
    check(p, name)?;
    // SAFETY: not null, aligned; room and no overlap (caller).
    unsafe { std::ptr::copy_nonoverlapping(values.as_ptr(), p, values.len()) };
    Ok(())
}
