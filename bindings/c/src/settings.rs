//! Settings of a filter: images, options, and functions of the caller.

use std::collections::BTreeMap;
use std::ffi::{CString, c_char, c_void};
use std::ptr;

use demc_program::message::printable;

use crate::image::Image;

/// What an execution reads.
#[derive(Clone, Default)]
pub(crate) struct Settings {
    pub images: BTreeMap<String, Image>,
    pub input_scale: Option<f32>,
    pub restore_light: Option<bool>,
    /// In bytes.
    pub memory: Option<u64>,
    pub progress: Callback<unsafe extern "C" fn(*mut c_void, f64) -> bool>,
    pub warning: Callback<unsafe extern "C" fn(*mut c_void, *const c_char)>,
}

/// A function of the caller with its pointer.
#[derive(Clone)]
pub(crate) struct Callback<F> {
    pub function: Option<F>,
    pub user: *mut c_void,
}

// SAFETY: the caller promises that its function can be called with its pointer on any thread.
unsafe impl<F> Send for Callback<F> {}
// SAFETY: as above.
unsafe impl<F> Sync for Callback<F> {}

impl<F> Default for Callback<F> {
    fn default() -> Self {
        Self {
            function: None,
            user: ptr::null_mut(),
        }
    }
}

impl Settings {
    /// Reports progress. Returns whether to continue.
    pub(crate) fn report(&self, share: f64) -> bool {
        let Callback { function, user } = self.progress;
        // SAFETY: the caller's function, with the caller's pointer.
        function.is_none_or(|function| unsafe { function(user, share) })
    }

    /// Whether anybody wants warnings.
    pub(crate) fn wants_warnings(&self) -> bool {
        self.warning.function.is_some()
    }

    /// Reports a warning.
    pub(crate) fn warn(&self, message: &str) {
        let Callback { function, user } = self.warning;
        let message = CString::new(printable(message)).unwrap_or_default();
        if let Some(function) = function {
            // SAFETY: the caller's function, with the caller's pointer; the text lives until it
            // returns.
            unsafe { function(user, message.as_ptr()) };
        }
    }
}
