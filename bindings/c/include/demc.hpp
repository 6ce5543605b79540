// C++ wrappers of demc.h: handles that release themselves, and errors as exceptions (C++11).

#ifndef DEMC_HPP
#define DEMC_HPP

#include <demc.h>

#include <stdexcept>
#include <utility>

namespace demc {

// An error code with its message.
class Error : public std::runtime_error {
public:
  Error(DemcError code, const char *message) : std::runtime_error(message), code(code) {}
  DemcError code;
};

// Throws the first error of the calling thread on the device since its last call. nullptr: the first
// error of calls without a device.
inline void check(DemcDevice device) {
  const char *message;
  DemcError code = demcGetDeviceError(device, &message);
  if (code != DEMC_ERROR_NONE)
    throw Error(code, message);
}

// A handle with one reference.
template <typename T, void (*retain)(T), void (*release)(T)>
class Handle {
public:
  explicit Handle(T handle = nullptr) : handle(handle) {}
  Handle(const Handle &other) : handle(other.handle) { retain(handle); }
  Handle(Handle &&other) noexcept : handle(other.handle) { other.handle = nullptr; }
  Handle &operator=(Handle other) noexcept {
    std::swap(handle, other.handle);
    return *this;
  }
  ~Handle() { release(handle); }
  T get() const { return handle; }

private:
  T handle;
};

using Device = Handle<DemcDevice, demcRetainDevice, demcReleaseDevice>;
using Model = Handle<DemcModel, demcRetainModel, demcReleaseModel>;

// As demcNewDevice. Throws Error.
inline Device newDevice(const char *name = nullptr, int numThreads = 0) {
  Device device(demcNewDevice(name, numThreads));
  if (!device.get())
    check(nullptr);
  return device;
}

// As demcNewModel. Throws Error.
inline Model newModel(const Device &device, const char *path = nullptr) {
  Model model(demcNewModel(device.get(), path));
  check(device.get());
  return model;
}

// A filter of a model. Its member functions throw Error.
class Filter {
public:
  Filter(const Device &device, const Model &model)
      : device(device), filter(demcNewFilter(device.get(), model.get())) {
    check(device.get());
  }

  // As demcSetFilterImage.
  void setImage(const char *name, void *data, DemcFormat format, size_t width, size_t height,
                size_t byteOffset = 0, ptrdiff_t pixelByteStride = 0, ptrdiff_t rowByteStride = 0) {
    demcSetFilterImage(filter.get(), name, data, format, width, height, byteOffset,
                       pixelByteStride, rowByteStride);
    check(device.get());
  }

  // As demcExecuteFilter.
  void execute() {
    demcExecuteFilter(filter.get());
    check(device.get());
  }

  // For the other functions of demc.h.
  DemcFilter get() const { return filter.get(); }

private:
  Device device;
  Handle<DemcFilter, demcRetainFilter, demcReleaseFilter> filter;
};

} // namespace demc

#endif // DEMC_HPP
