//! Errors

use std::any::Any;
use std::cell::RefCell;
use std::collections::HashMap;
use std::error::Error;
use std::ffi::{CString, c_char};
use std::panic::{AssertUnwindSafe, catch_unwind};
use std::sync::atomic::{AtomicU64, Ordering};
use std::sync::{Mutex, PoisonError};

use demc_infer::buffers::BufferError;
use demc_infer::{BundleError, DenoiseError, DeviceError};
use demc_program::message::printable;

/// Why a call failed. The first six codes have the numbers of Open Image Denoise.
#[repr(C)]
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub enum DemcError {
    /// No error.
    #[default]
    None = 0,
    /// A mistake of the library. Please report it.
    Unknown = 1,
    /// An argument or an image is wrong.
    InvalidArgument = 2,
    /// The call is not allowed now, or an image is not set.
    InvalidOperation = 3,
    /// The image does not fit into memory.
    OutOfMemory = 4,
    /// The device is not on this machine or not in this build.
    UnsupportedHardware = 5,
    /// The progress function stopped the work.
    Cancelled = 6,
    /// The model cannot be read.
    InvalidModel = 7,
}

/// An error code with its message.
#[derive(Debug)]
pub(crate) struct Failure {
    code: DemcError,
    message: String,
}

impl Failure {
    fn new(code: DemcError, error: &dyn Error) -> Self {
        let mut message = error.to_string();
        let mut source = error.source();
        while let Some(error) = source {
            message += &format!(": {error}");
            source = error.source();
        }
        Self { code, message }
    }

    pub(crate) fn argument(message: impl Into<String>) -> Self {
        Self {
            code: DemcError::InvalidArgument,
            message: message.into(),
        }
    }

    pub(crate) fn operation(message: impl Into<String>) -> Self {
        Self {
            code: DemcError::InvalidOperation,
            message: message.into(),
        }
    }

    pub(crate) fn memory(message: impl Into<String>) -> Self {
        Self {
            code: DemcError::OutOfMemory,
            message: message.into(),
        }
    }

    fn panic(panic: &(dyn Any + Send)) -> Self {
        let text = panic
            .downcast_ref::<String>()
            .map(String::as_str)
            .or_else(|| panic.downcast_ref::<&str>().copied());
        Self {
            code: DemcError::Unknown,
            message: format!("internal error: {}", text.unwrap_or("no reason given")),
        }
    }
}

impl From<BufferError> for Failure {
    fn from(error: BufferError) -> Self {
        let code = match error {
            BufferError::Missing { .. } => DemcError::InvalidOperation,
            BufferError::Memory { .. } => DemcError::OutOfMemory,
            _ => DemcError::InvalidArgument,
        };
        Self::new(code, &error)
    }
}

impl From<DenoiseError> for Failure {
    fn from(error: DenoiseError) -> Self {
        let code = match error {
            DenoiseError::Cancelled { .. } => DemcError::Cancelled,
            DenoiseError::Memory { .. } => DemcError::OutOfMemory,
            DenoiseError::Layers { .. } => DemcError::InvalidOperation,
            DenoiseError::Device { .. } => DemcError::Unknown,
            _ => DemcError::InvalidArgument,
        };
        Self::new(code, &error)
    }
}

impl From<BundleError> for Failure {
    fn from(error: BundleError) -> Self {
        Self::new(DemcError::InvalidModel, &error)
    }
}

impl From<DeviceError> for Failure {
    fn from(error: DeviceError) -> Self {
        let code = match error {
            DeviceError::Unknown { .. } => DemcError::InvalidArgument,
            _ => DemcError::UnsupportedHardware,
        };
        Self::new(code, &error)
    }
}

/// The first error of a thread since it last asked, and the message that it got then.
#[derive(Debug, Default)]
struct ThreadError {
    code: DemcError,
    message: CString,
    fetched: CString,
}

impl ThreadError {
    fn record(&mut self, failure: Failure) {
        if self.code == DemcError::None {
            self.code = failure.code;
            // Without control characters, there is no 0 inside.
            self.message = CString::new(printable(&failure.message)).unwrap_or_default();
        }
    }

    /// The error, which is then none. The message lives until the next call.
    fn fetch(&mut self) -> (DemcError, *const c_char) {
        self.fetched = std::mem::take(&mut self.message);
        (std::mem::take(&mut self.code), self.fetched.as_ptr())
    }
}

/// The errors of all threads that used a device, by the number of the thread.
#[derive(Debug, Default)]
pub(crate) struct ThreadErrors(Mutex<HashMap<u64, ThreadError>>);

thread_local! {
    /// The number of the thread. The standard library's identity would be allocated memory that a
    /// main thread never frees.
    static THREAD: u64 = {
        static COUNT: AtomicU64 = AtomicU64::new(0);
        COUNT.fetch_add(1, Ordering::Relaxed)
    };
    /// The error of calls without a device.
    static WITHOUT_DEVICE: RefCell<ThreadError> = RefCell::default();
}

/// Applies `work` to this thread's error in those of a device, or to that without a device. Returns
/// `None` while the thread ends.
fn with_error<T>(
    device: Option<&ThreadErrors>,
    work: impl FnOnce(&mut ThreadError) -> T,
) -> Option<T> {
    match device {
        Some(errors) => {
            let mut errors = errors.0.lock().unwrap_or_else(PoisonError::into_inner);
            Some(work(errors.entry(THREAD.with(|id| *id)).or_default()))
        }
        None => {
            let done = WITHOUT_DEVICE.try_with(|error| work(&mut error.borrow_mut()));
            done.ok()
        }
    }
}

/// Runs the body of a call. A failure or a panic becomes this thread's error for the device, and the
/// call returns `otherwise`.
pub(crate) fn guarded<T>(
    device: Option<&ThreadErrors>,
    otherwise: T,
    work: impl FnOnce() -> Result<T, Failure>,
) -> T {
    let done =
        catch_unwind(AssertUnwindSafe(work)).unwrap_or_else(|panic| Err(Failure::panic(&*panic)));
    done.unwrap_or_else(|failure| {
        with_error(device, |error| error.record(failure));
        otherwise
    })
}

/// The first error of this thread for the device, or without one, which is then none. The message
/// lives until the thread's next call or the end of the device.
pub(crate) fn fetch(device: Option<&ThreadErrors>) -> (DemcError, *const c_char) {
    let fetched = with_error(device, ThreadError::fetch);
    fetched.unwrap_or((DemcError::None, c"".as_ptr()))
}
