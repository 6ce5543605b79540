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
