//! Model

use std::ffi::{c_char, c_void};
use std::path::Path;
use std::sync::Arc;
use std::{ptr, slice};

use demc_infer::{Bundle, BundleError, BundleFile, Bundled};

use crate::device::{DemcDevice, Device};
use crate::error::{Failure, guarded};
use crate::handle;

/// A network with its weights on a device.
pub struct Model {
    pub(crate) bundle: Bundle,
    pub(crate) device: Arc<Device>,
}

/// A model: a network with its weights on a device.
pub type DemcModel = *mut Model;

impl Model {
    /// Reads a file and builds its network on the device's threads.
    fn new(
        device: &Arc<Device>,
        read: impl FnOnce() -> Result<BundleFile, BundleError> + Send,
    ) -> Result<Self, Failure> {
        let bundle = device.run(|| read()?.into_bundle(&device.burn))?;
        Ok(Self {
            bundle,
            device: device.clone(),
        })
    }
}

/// Runs a call that makes a model.
///
/// # Safety
/// The handle is NULL or has a reference.
unsafe fn new_model(
    device: DemcDevice,
    make: impl FnOnce(&Arc<Device>) -> Result<Model, Failure>,
) -> DemcModel {
    // SAFETY: guaranteed by the caller.
    match unsafe { handle::shared("device", device) } {
        Ok(device) => guarded(Some(&device.errors), ptr::null_mut(), || {
            make(&device).map(handle::new)
        }),
        Err(failure) => guarded(None, ptr::null_mut(), || Err(failure)),
    }
}

/// Reads a model.
///
/// `path`, in UTF-8: an exported file (.safetensors), a run directory, or a checkpoint directory. The
/// names "quality" and "fast" are models inside the library. NULL is "quality".
///
/// Returns NULL on errors: DEMC_ERROR_INVALID_MODEL for a file that cannot be read, is damaged, is no
/// model, or has another format.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn demcNewModel(device: DemcDevice, path: *const c_char) -> DemcModel {
    let make = |device: &Arc<Device>| {
        if path.is_null() {
            return Model::new(device, || BundleFile::bundled(Bundled::Quality));
        }
        // SAFETY: the caller passes a string.
        let path = unsafe { handle::text("path of the model", path)? };
        Model::new(device, || BundleFile::read(Path::new(path)))
    };
    // SAFETY: the caller passes NULL or a handle with a reference.
    unsafe { new_model(device, make) }
}

/// Reads a model from the `size` bytes of an exported file. They are copied.
///
/// Returns NULL on errors, as demcNewModel.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn demcNewModelFromMemory(
    device: DemcDevice,
    bytes: *const c_void,
    size: usize,
) -> DemcModel {
    let make = |device: &Arc<Device>| {
        if bytes.is_null() {
            return Err(Failure::argument("the bytes of the model are NULL"));
        }
        if isize::try_from(size).is_err() {
            return Err(Failure::argument(format!("{size} bytes are no model")));
        }
        // SAFETY: the caller passes this number of bytes, which stay during the call.
        let bytes: &[u8] = unsafe { slice::from_raw_parts(bytes.cast(), size) };
        Model::new(device, || BundleFile::parse("memory".into(), bytes))
    };
    // SAFETY: the caller passes NULL or a handle with a reference.
    unsafe { new_model(device, make) }
}

/// Adds a reference to a model. NULL is ignored.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn demcRetainModel(model: DemcModel) {
    // SAFETY: the caller passes NULL or a handle with a reference.
    unsafe { handle::retain(model) };
}

/// Removes a reference from a model. NULL is ignored. The model is deleted with its last reference and
/// its last filter.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn demcReleaseModel(model: DemcModel) {
    // SAFETY: the caller passes NULL or a handle with a reference.
    unsafe { handle::release(model) };
}
