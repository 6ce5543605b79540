// The part of OIDN 2's header that with_weights.c needs, for tests: the package `pyoidn` has no header.

#include <stdbool.h>
#include <stddef.h>

typedef struct OIDNDeviceImpl *OIDNDevice;
typedef struct OIDNFilterImpl *OIDNFilter;

enum { OIDN_DEVICE_TYPE_CPU = 1, OIDN_FORMAT_FLOAT3 = 3, OIDN_ERROR_NONE = 0 };

OIDNDevice oidnNewDevice(int type);
void oidnCommitDevice(OIDNDevice device);
int oidnGetDeviceError(OIDNDevice device, const char **message);
OIDNFilter oidnNewFilter(OIDNDevice device, const char *type);
void oidnSetSharedFilterImage(OIDNFilter filter, const char *name, void *pixels, int format, size_t width, size_t height,
                              size_t offset, size_t pixelStride, size_t rowStride);
void oidnSetSharedFilterData(OIDNFilter filter, const char *name, void *data, size_t size);
void oidnSetFilterBool(OIDNFilter filter, const char *name, bool value);
void oidnCommitFilter(OIDNFilter filter);
void oidnExecuteFilter(OIDNFilter filter);
