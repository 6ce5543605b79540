//! Device

use std::ffi::{c_char, c_int};
use std::ptr;
use std::sync::{Mutex, PoisonError};
use std::thread::{Builder, JoinHandle};

use demc_infer::device;
use demc_infer::memory::below_own_limits;
use demc_model::ops::{ISA_VARIABLE, Isa};
use demc_program::parallel;
use rayon::{ThreadPool, ThreadPoolBuilder};

use crate::error::{DemcError, Failure, ThreadErrors, fetch, guarded};
use crate::handle;

/// Memory in MiB without which no model can be read.
const LEAST_MEMORY: u64 = 128;

/// What computes, with its threads.
pub struct Device {
    pub(crate) burn: burn::tensor::Device,
    pub(crate) errors: ThreadErrors,
    threads: Threads,
    /// Held during an execution: the next one plans with the memory that this one needs.
    executing: Mutex<()>,
}

/// A device: what computes, with its threads.
pub type DemcDevice = *mut Device;

impl Device {
    fn new(name: &str, most_threads: c_int) -> Result<Self, Failure> {
        let Ok(most_threads) = usize::try_from(most_threads) else {
            return Err(Failure::argument(format!(
                "{most_threads} threads: expected 0 or more"
            )));
        };
        if let Some(left) = below_own_limits().map(|left| left >> 20)
            && left < LEAST_MEMORY
        {
            return Err(Failure::memory(format!(
                "the limits on memory leave {left} MiB, but {LEAST_MEMORY} are needed"
            )));
        }
        if let Err(unknown) = Isa::from_environment() {
            return Err(Failure::argument(format!("{ISA_VARIABLE}: {unknown}")));
        }
        let burn = device::parse(name)?;
        let count = parallel::threads().count;
        let count = match most_threads {
            0 => count,
            most => most.min(count),
        };
        Ok(Self {
            burn,
            errors: ThreadErrors::default(),
            threads: Threads::start(count)?,
            executing: Mutex::default(),
        })
    }

    /// Runs `work` on the device's threads, and waits for it.
    pub(crate) fn run<R: Send>(&self, work: impl FnOnce() -> R + Send) -> R {
        let pool = self.threads.pool.as_ref();
        pool.expect("it lives as long as the device").install(work)
    }

    /// As [`run`](Self::run), after all other executions on this device.
    pub(crate) fn execute<R: Send>(&self, work: impl FnOnce() -> R + Send) -> R {
        let lock = self.executing.lock();
        let _lock = lock.unwrap_or_else(PoisonError::into_inner);
        self.run(work)
    }
}

/// A pool of threads that all have ended when it is dropped, so the library can be unloaded.
struct Threads {
    pool: Option<ThreadPool>,
    handles: Vec<JoinHandle<()>>,
}

impl Threads {
    fn start(count: usize) -> Result<Self, Failure> {
        let mut threads = Self {
            pool: None,
            handles: Vec::new(),
        };
        let builder = ThreadPoolBuilder::new()
            .num_threads(count)
            .spawn_handler(|thread| {
                let named = Builder::new().name(format!("demc-{}", thread.index()));
                threads.handles.push(named.spawn(|| thread.run())?);
                Ok(())
            });
        let pool = builder
            .build()
            .map_err(|error| Failure::memory(format!("cannot start {count} threads: {error}")));
        threads.pool = Some(pool?);
        Ok(threads)
    }
}

impl Drop for Threads {
    fn drop(&mut self) {
        drop(self.pool.take());
        for handle in self.handles.drain(..) {
            // A thread that panicked has ended, too.
            let _ = handle.join();
        }
    }
}

/// Returns the version of the library, such as "0.1.0".
#[unsafe(no_mangle)]
pub extern "C" fn demcVersion() -> *const c_char {
    concat!(env!("CARGO_PKG_VERSION"), "\0").as_ptr().cast()
}

/// Creates a device and starts its threads.
///
/// `name`: "flex" for the CPU; NULL is "flex". Builds with other features have "ndarray", "wgpu[:N]",
/// and "cuda[:N]".
///
/// `numThreads`: the largest number of threads. 0 is the number of processors, or that of the
/// environment variable RAYON_NUM_THREADS. The threads end when the device is deleted. A process that
/// forks must create its devices afterwards.
///
/// The environment variable DEMC_ISA forces an instruction set: avx512, avx2, neon, or portable.
///
/// Returns NULL on errors; demcGetDeviceError(NULL, ...) has the reason.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn demcNewDevice(name: *const c_char, num_threads: c_int) -> DemcDevice {
    guarded(None, ptr::null_mut(), || {
        let name = if name.is_null() {
            "flex"
        } else {
            // SAFETY: the caller passes a string.
            unsafe { handle::text("name of the device", name)? }
        };
        Device::new(name, num_threads).map(handle::new)
    })
}

/// Adds a reference to a device. NULL is ignored.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn demcRetainDevice(device: DemcDevice) {
    // SAFETY: the caller passes NULL or a handle with a reference.
    unsafe { handle::retain(device) };
}

/// Removes a reference from a device. NULL is ignored. The device is deleted with its last reference,
/// its last model, and its last filter.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn demcReleaseDevice(device: DemcDevice) {
    // SAFETY: the caller passes NULL or a handle with a reference.
    unsafe { handle::release(device) };
}

/// Returns and clears the first error of the calling thread on this device since its last call of
/// this function.
///
/// With NULL: the first error of calls that had no device, such as a failed demcNewDevice or a NULL
/// handle.
///
/// `message`, unless NULL, gets one sentence in UTF-8, or an empty text without an error. The text
/// lives until the calling thread calls this function again or the device is deleted.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn demcGetDeviceError(
    device: DemcDevice,
    message: *mut *const c_char,
) -> DemcError {
    // SAFETY: the caller passes NULL or a handle with a reference.
    let device = unsafe { handle::shared("device", device) }.ok();
    let (code, text) = fetch(device.as_ref().map(|device| &device.errors));
    if !message.is_null() {
        // SAFETY: the caller passes NULL or a pointer to write to.
        unsafe { ptr::write(message, text) };
    }
    code
}
