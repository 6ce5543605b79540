//! Handles: reference-counted objects behind pointers, and strings of the caller.

use std::ffi::{CStr, c_char};
use std::panic::{AssertUnwindSafe, catch_unwind};
use std::sync::Arc;

use crate::error::Failure;

/// A new handle with one reference.
pub(crate) fn new<T>(object: T) -> *mut T {
    Arc::into_raw(Arc::new(object)).cast_mut()
}

/// The object of a handle, which stays alive as long as the result does.
///
/// # Errors
/// A null handle, which messages call `kind`.
///
/// # Safety
/// The handle is null, or comes from [`new`] and has a reference left.
pub(crate) unsafe fn shared<T>(kind: &str, handle: *mut T) -> Result<Arc<T>, Failure> {
    if handle.is_null() {
        return Err(Failure::argument(format!("the {kind} is NULL")));
    }
    // SAFETY: guaranteed by the caller; the added reference is the result's.
    unsafe {
        Arc::increment_strong_count(handle);
        Ok(Arc::from_raw(handle))
    }
}

/// Adds a reference. A null handle has none.
///
/// # Safety
/// As [`shared`].
pub(crate) unsafe fn retain<T>(handle: *mut T) {
    if !handle.is_null() {
        // SAFETY: guaranteed by the caller.
        unsafe { Arc::increment_strong_count(handle) };
    }
}

/// Removes a reference, and the object with the last one. A null handle has none.
///
/// # Safety
/// As [`shared`].
pub(crate) unsafe fn release<T>(handle: *mut T) {
    if !handle.is_null() {
        // SAFETY: guaranteed by the caller.
        let object = unsafe { Arc::from_raw(handle) };
        // Nothing can be reported for an object that is gone.
        let _ = catch_unwind(AssertUnwindSafe(|| drop(object)));
    }
}

/// A string of the caller.
///
/// # Errors
/// NULL or invalid UTF-8; messages call it `what`.
///
/// # Safety
/// NULL, or a string with a final 0 that nobody changes during `'a`.
pub(crate) unsafe fn text<'a>(what: &str, pointer: *const c_char) -> Result<&'a str, Failure> {
    if pointer.is_null() {
        return Err(Failure::argument(format!("the {what} is NULL")));
    }
    // SAFETY: guaranteed by the caller.
    let text = unsafe { CStr::from_ptr(pointer) };
    let text = text.to_str();
    text.map_err(|_| Failure::argument(format!("the {what} is not valid UTF-8")))
}
