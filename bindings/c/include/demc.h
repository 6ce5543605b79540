// The C library of the DEMC denoiser. It denoises frames of Monte Carlo renderers in memory.
//
// This header is generated from the library's sources.
//
// - Objects are counted references. demcNew... creates one with one reference, demcRetain... adds
//   one, and demcRelease... removes one. Released handles cannot be recognised: do not use them.
// - Most functions return nothing. demcGetDeviceError returns the first error of a thread since its
//   last call, as in Open Image Denoise.
// - All functions can be called from all threads, also on one object.
// - Texts are UTF-8 with a final 0.

#ifndef DEMC_H
#define DEMC_H

#include <stdbool.h>
#include <stddef.h>

#if defined(__GNUC__)
#define DEMC_API __attribute__((visibility("default")))
#else
#define DEMC_API
#endif

#ifdef __cplusplus
extern "C" {
#endif

// -- Errors ------------------------------------------------------------------------------------

// Why a call failed. The first six codes have the numbers of Open Image Denoise.
typedef enum DemcError {
  // No error.
  DEMC_ERROR_NONE = 0,
  // A mistake of the library. Please report it.
  DEMC_ERROR_UNKNOWN = 1,
  // An argument or an image is wrong.
  DEMC_ERROR_INVALID_ARGUMENT = 2,
  // The call is not allowed now, or an image is not set.
  DEMC_ERROR_INVALID_OPERATION = 3,
  // The image does not fit into memory.
  DEMC_ERROR_OUT_OF_MEMORY = 4,
  // The device is not on this machine or not in this build.
  DEMC_ERROR_UNSUPPORTED_HARDWARE = 5,
  // The progress function stopped the work.
  DEMC_ERROR_CANCELLED = 6,
  // The model cannot be read.
  DEMC_ERROR_INVALID_MODEL = 7,
} DemcError;

// -- Device ------------------------------------------------------------------------------------

// A device: what computes, with its threads.
typedef struct DemcDeviceObject *DemcDevice;

// Returns the version of the library, such as "0.1.0".
DEMC_API const char *demcVersion(void);

// Creates a device and starts its threads.
//
// `name`: "flex" for the CPU; NULL is "flex". Builds with other features have "ndarray", "wgpu[:N]",
// and "cuda[:N]".
//
// `numThreads`: the largest number of threads. 0 is the number of processors, or that of the
// environment variable RAYON_NUM_THREADS. The threads end when the device is deleted. A process that
// forks must create its devices afterwards.
//
// The environment variable DEMC_ISA forces an instruction set: avx512, avx2, neon, or portable.
//
// Returns NULL on errors; demcGetDeviceError(NULL, ...) has the reason.
DEMC_API
DemcDevice demcNewDevice(const char *name,
                         int numThreads);

// Adds a reference to a device. NULL is ignored.
DEMC_API void demcRetainDevice(DemcDevice device);

// Removes a reference from a device. NULL is ignored. The device is deleted with its last reference,
// its last model, and its last filter.
DEMC_API
void demcReleaseDevice(DemcDevice device);

// Returns and clears the first error of the calling thread on this device since its last call of
// this function.
//
// With NULL: the first error of calls that had no device, such as a failed demcNewDevice or a NULL
// handle.
//
// `message`, unless NULL, gets one sentence in UTF-8, or an empty text without an error. The text
// lives until the calling thread calls this function again or the device is deleted.
DEMC_API DemcError demcGetDeviceError(DemcDevice device, const char **message);

// -- Model -------------------------------------------------------------------------------------

// A model: a network with its weights on a device.
typedef struct DemcModelObject *DemcModel;

// Reads a model.
//
// `path`, in UTF-8: an exported file (.safetensors), a run directory, or a checkpoint directory. The
// names "quality" and "fast" are models inside the library. NULL is "quality".
//
// Returns NULL on errors: DEMC_ERROR_INVALID_MODEL for a file that cannot be read, is damaged, is no
// model, or has another format.
DEMC_API
DemcModel demcNewModel(DemcDevice device,
                       const char *path);

// Reads a model from the `size` bytes of an exported file. They are copied.
//
// Returns NULL on errors, as demcNewModel.
DEMC_API DemcModel demcNewModelFromMemory(DemcDevice device, const void *bytes, size_t size);

// Adds a reference to a model. NULL is ignored.
DEMC_API void demcRetainModel(DemcModel model);

// Removes a reference from a model. NULL is ignored. The model is deleted with its last reference and
// its last filter.
DEMC_API
void demcReleaseModel(DemcModel model);

// -- Images ------------------------------------------------------------------------------------

// Format of a pixel. The numbers are those of Open Image Denoise.
typedef enum DemcFormat {
  // One 32-bit float.
  DEMC_FORMAT_FLOAT = 1,
  // Three 32-bit floats.
  DEMC_FORMAT_FLOAT3 = 3,
  // One 16-bit float (IEEE binary16).
  DEMC_FORMAT_HALF = 257,
  // Three 16-bit floats.
  DEMC_FORMAT_HALF3 = 259,
} DemcFormat;

// -- Filter ------------------------------------------------------------------------------------

// A filter: images and options of a model's executions.
typedef struct DemcFilterObject *DemcFilter;

// Receives the finished share of the image, `n`, from 0 to 1. Returns false to cancel.
//
// It runs on a thread of the device. It must not throw exceptions or call demcExecuteFilter.
typedef bool (*DemcProgressMonitorFunction)(void *user, double n);

// Receives a warning: one sentence in UTF-8 that lives during the call. The same rules apply as to
// the progress function.
typedef void (*DemcWarningFunction)(void *user, const char *message);

// Creates a filter for a model of the device.
//
// Filters of one model share its weights. Executions on one device run one after another.
//
// Returns NULL on errors.
DEMC_API DemcFilter demcNewFilter(DemcDevice device, DemcModel model);

// Adds a reference to a filter. NULL is ignored.
DEMC_API void demcRetainFilter(DemcFilter filter);

// Removes a reference from a filter. NULL is ignored. The filter is deleted with its last reference.
DEMC_API
void demcReleaseFilter(DemcFilter filter);

// Sets an image whose pixels hold their channels side by side. All images have the same size.
//
// name               channels  content
// "color"            3         noisy colour: linear HDR radiance; negative samples count as 0
// "normal"           3         shading normal at the first hit: world space, -1 to 1
// "position"         3         first hit: world space; a pixel of infinite samples has none
// "albedo"           3         albedo of the first hit, 0 to 1
// "albedo2"          3         albedo of the second hit, 0 to 1
// "output"           3         denoised colour: linear HDR radiance, not negative
// "alpha"            1         noisy alpha, 0 to 1
// "outputAlpha"      1         denoised alpha
// "layer:NAME"       1 or 3    a further image to denoise, such as a light group
// "outputLayer:NAME" 1 or 3    that layer, denoised
//
// "color" and "output" are required, and the features as the model needs them. The bundled models
// need normal and albedo. Without position, they use zeros; without albedo2, the albedo. All models
// but those of KPCN denoise layers. A layer of 3 channels is light, and one of 1 channel is a mask.
//
// `data` is the caller's memory. It must stay valid until the last execution with it has ended. An
// output may be the same image as an input, because outputs are written last.
//
// `width` and `height` are in pixels: 1 to 32768 each, and at most 134217728 pixels.
//
// `byteOffset` is the distance from `data` to the first sample. The strides are the distances from a
// pixel and from a row to the next one, in bytes. They may be negative, as in flipped images. 0 is
// packed: the size of a pixel, and `width` times `pixelByteStride`.
//
// Errors: DEMC_ERROR_INVALID_ARGUMENT for an unknown name, NULL, and a format, size, or stride that
// the image cannot have. The image is then as before.
DEMC_API
void demcSetFilterImage(DemcFilter filter,
                        const char *name,
                        void *data,
                        DemcFormat format,
                        size_t width,
                        size_t height,
                        size_t byteOffset,
                        ptrdiff_t pixelByteStride,
                        ptrdiff_t rowByteStride);

// As demcSetFilterImage, for an image with a plane per channel.
//
// `channelByteStride` is the distance from a plane to the next one in bytes. 0 is packed: `height`
// times `rowByteStride`. A packed `pixelByteStride` is the size of a sample.
DEMC_API
void demcSetFilterPlanarImage(DemcFilter filter,
                              const char *name,
                              void *data,
                              DemcFormat format,
                              size_t width,
                              size_t height,
                              size_t byteOffset,
                              ptrdiff_t channelByteStride,
                              ptrdiff_t pixelByteStride,
                              ptrdiff_t rowByteStride);

// Removes an image. An image that is not set is no error.
//
// Errors: DEMC_ERROR_INVALID_ARGUMENT for an unknown name.
DEMC_API void demcUnsetFilterImage(DemcFilter filter, const char *name);

// Sets an option.
//
// "restoreLight": whether the output gets the light of the noisy image. Without this call, the model
// decides.
//
// Errors: DEMC_ERROR_INVALID_ARGUMENT for an unknown name.
DEMC_API
void demcSetFilterBool(DemcFilter filter,
                       const char *name,
                       bool value);

// Sets an option.
//
// "maxMemoryMB": the memory of a pass in MiB beside model and images, at least 1. Larger images are
// cut into tiles with the same result. 0, the default, is the free memory.
//
// Errors: DEMC_ERROR_INVALID_ARGUMENT for an unknown name or a negative value.
DEMC_API void demcSetFilterInt(DemcFilter filter, const char *name, int value);

// Sets an option.
//
// "inputScale": the factor on the colour before the network, from 1e-6 to 1e6; the output is divided
// by it. NaN, the default, brings each image to the exposure of the training images. The frames of an
// animation need one factor for all.
//
// Errors: DEMC_ERROR_INVALID_ARGUMENT for an unknown name or a value outside the range.
DEMC_API
void demcSetFilterFloat(DemcFilter filter,
                        const char *name,
                        float value);

// Sets the function that receives the progress; NULL removes it. `user` is passed on to it.
DEMC_API
void demcSetFilterProgressMonitorFunction(DemcFilter filter,
                                          DemcProgressMonitorFunction function,
                                          void *user);

// Sets the function that receives warnings about images; NULL removes it. `user` is passed on to
// it. Before an image is denoised, its normals are compared with its positions, if these are set, and
// its features with those of the training images.
DEMC_API
void demcSetFilterWarningFunction(DemcFilter filter,
                                  DemcWarningFunction function,
                                  void *user);

// Denoises the images, and returns when the outputs are written.
//
// No other thread may write to the memory of the images meanwhile, or read that of the outputs. This
// includes the bytes between samples. On errors, no output is written.
//
// Errors:
// - DEMC_ERROR_INVALID_OPERATION: a required image is not set; the model denoises no layers; the call
//   comes from a function that an execution calls.
// - DEMC_ERROR_INVALID_ARGUMENT: images of different sizes; NaN or infinite samples; samples of an
//   output that share memory; features far from the training images.
// - DEMC_ERROR_OUT_OF_MEMORY: not even the smallest tile fits.
// - DEMC_ERROR_CANCELLED: the progress function returned false.
DEMC_API
void demcExecuteFilter(DemcFilter filter);

#ifdef __cplusplus
}
#endif

#endif // DEMC_H
