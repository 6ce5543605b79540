//! Filter

use std::ffi::{c_char, c_float, c_int, c_void};
use std::ptr;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};

use demc_infer::denoise::MAX_INPUT_SCALE;

use crate::device::DemcDevice;
use crate::error::{Failure, guarded};
use crate::execute::execute;
use crate::handle;
use crate::image::{FormatCode, Image, Layout, check_name};
use crate::model::{DemcModel, Model};
use crate::settings::{Callback, Settings};

/// Receives the finished share of the image, `n`, from 0 to 1. Returns false to cancel.
///
/// It runs on a thread of the device. It must not throw exceptions or call demcExecuteFilter.
pub type DemcProgressMonitorFunction =
    Option<unsafe extern "C" fn(user: *mut c_void, n: f64) -> bool>;

/// Receives a warning: one sentence in UTF-8 that lives during the call. The same rules apply as to
/// the progress function.
pub type DemcWarningFunction =
    Option<unsafe extern "C" fn(user: *mut c_void, message: *const c_char)>;

/// Images and options of a model's executions.
pub struct Filter {
    model: Arc<Model>,
    settings: Mutex<Settings>,
}

/// A filter: images and options of a model's executions.
pub type DemcFilter = *mut Filter;

impl Filter {
    fn settings(&self) -> MutexGuard<'_, Settings> {
        let settings = self.settings.lock();
        settings.unwrap_or_else(PoisonError::into_inner)
    }
}

/// Runs a call on a filter.
///
/// # Safety
/// The handle is NULL or has a reference.
unsafe fn with_filter(filter: DemcFilter, work: impl FnOnce(&Filter) -> Result<(), Failure>) {
    // SAFETY: guaranteed by the caller.
    match unsafe { handle::shared("filter", filter) } {
        Ok(filter) => guarded(Some(&filter.model.device.errors), (), || work(&filter)),
        Err(failure) => guarded(None, (), || Err(failure)),
    }
}

fn no_option(name: &str, kind: &str) -> Failure {
    Failure::argument(format!("no {kind} option is called `{name}`"))
}

/// Creates a filter for a model of the device.
///
/// Filters of one model share its weights. Executions on one device run one after another.
///
/// Returns NULL on errors.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn demcNewFilter(device: DemcDevice, model: DemcModel) -> DemcFilter {
    // SAFETY: the caller passes NULL or a handle with a reference.
    let device = match unsafe { handle::shared("device", device) } {
        Ok(device) => device,
        Err(failure) => return guarded(None, ptr::null_mut(), || Err(failure)),
    };
    guarded(Some(&device.errors), ptr::null_mut(), || {
        // SAFETY: as above.
        let model = unsafe { handle::shared("model", model)? };
        if !Arc::ptr_eq(&model.device, &device) {
            return Err(Failure::argument("the model is on another device"));
        }
        Ok(handle::new(Filter {
            model,
            settings: Mutex::default(),
        }))
    })
}

/// Adds a reference to a filter. NULL is ignored.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn demcRetainFilter(filter: DemcFilter) {
    // SAFETY: the caller passes NULL or a handle with a reference.
    unsafe { handle::retain(filter) };
}

/// Removes a reference from a filter. NULL is ignored. The filter is deleted with its last reference.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn demcReleaseFilter(filter: DemcFilter) {
    // SAFETY: the caller passes NULL or a handle with a reference.
    unsafe { handle::release(filter) };
}

/// Sets an image whose pixels hold their channels side by side. All images have the same size.
///
/// ```text
/// name               channels  content
/// "color"            3         noisy colour: linear HDR radiance; negative samples count as 0
/// "normal"           3         shading normal at the first hit: world space, -1 to 1
/// "position"         3         first hit: world space; a pixel of infinite samples has none
/// "albedo"           3         albedo of the first hit, 0 to 1
/// "albedo2"          3         albedo of the second hit, 0 to 1
/// "output"           3         denoised colour: linear HDR radiance, not negative
/// "alpha"            1         noisy alpha, 0 to 1
/// "outputAlpha"      1         denoised alpha
/// "layer:NAME"       1 or 3    a further image to denoise, such as a light group
/// "outputLayer:NAME" 1 or 3    that layer, denoised
/// ```
///
/// "color" and "output" are required, and the features as the model needs them. The bundled models
/// need normal and albedo. Without position, they use zeros; without albedo2, the albedo. All models
/// but those of KPCN denoise layers. A layer of 3 channels is light, and one of 1 channel is a mask.
///
/// `data` is the caller's memory. It must stay valid until the last execution with it has ended. An
/// output may be the same image as an input, because outputs are written last.
///
/// `width` and `height` are in pixels: 1 to 32768 each, and at most 134217728 pixels.
///
/// `byteOffset` is the distance from `data` to the first sample. The strides are the distances from a
/// pixel and from a row to the next one, in bytes. They may be negative, as in flipped images. 0 is
/// packed: the size of a pixel, and `width` times `pixelByteStride`.
///
/// Errors: DEMC_ERROR_INVALID_ARGUMENT for an unknown name, NULL, and a format, size, or stride that
/// the image cannot have. The image is then as before.
#[unsafe(no_mangle)]
#[allow(clippy::too_many_arguments, reason = "those of Open Image Denoise")]
pub unsafe extern "C" fn demcSetFilterImage(
    filter: DemcFilter,
    name: *const c_char,
    data: *mut c_void,
    format: FormatCode,
    width: usize,
    height: usize,
    byte_offset: usize,
    pixel_byte_stride: isize,
    row_byte_stride: isize,
) {
    let layout = Layout {
        size: [width, height],
        offset: byte_offset,
        channel_stride: None,
        pixel_stride: pixel_byte_stride,
        row_stride: row_byte_stride,
    };
    // SAFETY: the caller passes a handle and a string.
    unsafe { set_image(filter, name, data, format, &layout) };
}

/// As demcSetFilterImage, for an image with a plane per channel.
///
/// `channelByteStride` is the distance from a plane to the next one in bytes. 0 is packed: `height`
/// times `rowByteStride`. A packed `pixelByteStride` is the size of a sample.
#[unsafe(no_mangle)]
#[allow(clippy::too_many_arguments, reason = "those of Open Image Denoise")]
pub unsafe extern "C" fn demcSetFilterPlanarImage(
    filter: DemcFilter,
    name: *const c_char,
    data: *mut c_void,
    format: FormatCode,
    width: usize,
    height: usize,
    byte_offset: usize,
    channel_byte_stride: isize,
    pixel_byte_stride: isize,
    row_byte_stride: isize,
) {
    let layout = Layout {
        size: [width, height],
        offset: byte_offset,
        channel_stride: Some(channel_byte_stride),
        pixel_stride: pixel_byte_stride,
        row_stride: row_byte_stride,
    };
    // SAFETY: the caller passes a handle and a string.
    unsafe { set_image(filter, name, data, format, &layout) };
}

/// # Safety
/// The handle is NULL or has a reference, and `name` is NULL or a string.
unsafe fn set_image(
    filter: DemcFilter,
    name: *const c_char,
    data: *mut c_void,
    format: FormatCode,
    layout: &Layout,
) {
    let set = |filter: &Filter| {
        // SAFETY: guaranteed by the caller.
        let name = unsafe { handle::text("name of the image", name)? };
        let image = Image::new(name, data, format, layout)?;
        filter.settings().images.insert(name.to_owned(), image);
        Ok(())
    };
    // SAFETY: guaranteed by the caller.
    unsafe { with_filter(filter, set) };
}

/// Removes an image. An image that is not set is no error.
///
/// Errors: DEMC_ERROR_INVALID_ARGUMENT for an unknown name.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn demcUnsetFilterImage(filter: DemcFilter, name: *const c_char) {
    let unset = |filter: &Filter| {
        // SAFETY: the caller passes NULL or a string.
        let name = unsafe { handle::text("name of the image", name)? };
        check_name(name)?;
        filter.settings().images.remove(name);
        Ok(())
    };
    // SAFETY: the caller passes NULL or a handle with a reference.
    unsafe { with_filter(filter, unset) };
}

/// Sets an option.
///
/// "restoreLight": whether the output gets the light of the noisy image. Without this call, the model
/// decides.
///
/// Errors: DEMC_ERROR_INVALID_ARGUMENT for an unknown name.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn demcSetFilterBool(filter: DemcFilter, name: *const c_char, value: bool) {
    let set = |filter: &Filter| {
        // SAFETY: the caller passes NULL or a string.
        match unsafe { handle::text("name of the option", name)? } {
            "restoreLight" => filter.settings().restore_light = Some(value),
            other => return Err(no_option(other, "bool")),
        }
        Ok(())
    };
    // SAFETY: the caller passes NULL or a handle with a reference.
    unsafe { with_filter(filter, set) };
}

/// Sets an option.
///
/// "maxMemoryMB": the memory of a pass in MiB beside model and images, at least 1. Larger images are
/// cut into tiles with the same result. 0, the default, is the free memory.
///
/// Errors: DEMC_ERROR_INVALID_ARGUMENT for an unknown name or a negative value.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn demcSetFilterInt(filter: DemcFilter, name: *const c_char, value: c_int) {
    let set = |filter: &Filter| {
        // SAFETY: the caller passes NULL or a string.
        match unsafe { handle::text("name of the option", name)? } {
            "maxMemoryMB" => {
                filter.settings().memory = match u64::try_from(value) {
                    Ok(0) => None,
                    Ok(mib) => Some(mib << 20),
                    Err(_) => {
                        return Err(Failure::argument(format!(
                            "maxMemoryMB = {value}: expected 0 or more"
                        )));
                    }
                }
            }
            other => return Err(no_option(other, "int")),
        }
        Ok(())
    };
    // SAFETY: the caller passes NULL or a handle with a reference.
    unsafe { with_filter(filter, set) };
}

/// Sets an option.
///
/// "inputScale": the factor on the colour before the network, from 1e-6 to 1e6; the output is divided
/// by it. NaN, the default, brings each image to the exposure of the training images. The frames of an
/// animation need one factor for all.
///
/// Errors: DEMC_ERROR_INVALID_ARGUMENT for an unknown name or a value outside the range.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn demcSetFilterFloat(
    filter: DemcFilter,
    name: *const c_char,
    value: c_float,
) {
    let set = |filter: &Filter| {
        // SAFETY: the caller passes NULL or a string.
        match unsafe { handle::text("name of the option", name)? } {
            "inputScale" => {
                let allowed = 1.0 / MAX_INPUT_SCALE..=MAX_INPUT_SCALE;
                if !value.is_nan() && !allowed.contains(&value) {
                    return Err(Failure::argument(format!(
                        "inputScale = {value}: expected NaN, or a factor from 1e-6 to 1e6"
                    )));
                }
                filter.settings().input_scale = Some(value).filter(|value| !value.is_nan());
            }
            other => return Err(no_option(other, "float")),
        }
        Ok(())
    };
    // SAFETY: the caller passes NULL or a handle with a reference.
    unsafe { with_filter(filter, set) };
}

/// Sets the function that receives the progress; NULL removes it. `user` is passed on to it.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn demcSetFilterProgressMonitorFunction(
    filter: DemcFilter,
    function: DemcProgressMonitorFunction,
    user: *mut c_void,
) {
    let set = |filter: &Filter| {
        filter.settings().progress = Callback { function, user };
        Ok(())
    };
    // SAFETY: the caller passes NULL or a handle with a reference.
    unsafe { with_filter(filter, set) };
}

/// Sets the function that receives warnings about images; NULL removes it. `user` is passed on to
/// it. Before an image is denoised, its normals are compared with its positions, if these are set, and
/// its features with those of the training images.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn demcSetFilterWarningFunction(
    filter: DemcFilter,
    function: DemcWarningFunction,
    user: *mut c_void,
) {
    let set = |filter: &Filter| {
        filter.settings().warning = Callback { function, user };
        Ok(())
    };
    // SAFETY: the caller passes NULL or a handle with a reference.
    unsafe { with_filter(filter, set) };
}

/// Denoises the images, and returns when the outputs are written.
///
/// No other thread may write to the memory of the images meanwhile, or read that of the outputs. This
/// includes the bytes between samples. On errors, no output is written.
///
/// Errors:
/// - DEMC_ERROR_INVALID_OPERATION: a required image is not set; the model denoises no layers; the call
///   comes from a function that an execution calls.
/// - DEMC_ERROR_INVALID_ARGUMENT: images of different sizes; NaN or infinite samples; samples of an
///   output that share memory; features far from the training images.
/// - DEMC_ERROR_OUT_OF_MEMORY: not even the smallest tile fits.
/// - DEMC_ERROR_CANCELLED: the progress function returned false.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn demcExecuteFilter(filter: DemcFilter) {
    let run = |filter: &Filter| {
        // Calls on this filter stay possible, also from the caller's functions.
        let settings = filter.settings().clone();
        execute(&filter.model, &settings)
    };
    // SAFETY: the caller passes NULL or a handle with a reference.
    unsafe { with_filter(filter, run) };
}
