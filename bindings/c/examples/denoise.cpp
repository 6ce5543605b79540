// The same as denoise.c, with the C++ wrappers.
//
//   c++ denoise.cpp -o denoise $(pkg-config --cflags --libs demc)

#include <demc.hpp>

#include <iostream>
#include <memory>

#include "scene.h"

static void denoise(Frame &frame, const char *path) {
  demc::Device device = demc::newDevice();
  demc::Model model = demc::newModel(device, path);
  demc::Filter filter(device, model);
  filter.setImage("color", frame.color, DEMC_FORMAT_FLOAT3, WIDTH, HEIGHT);
  filter.setImage("normal", frame.normal, DEMC_FORMAT_FLOAT3, WIDTH, HEIGHT);
  filter.setImage("position", frame.position, DEMC_FORMAT_FLOAT3, WIDTH, HEIGHT);
  filter.setImage("albedo", frame.albedo, DEMC_FORMAT_FLOAT3, WIDTH, HEIGHT);
  // The denoised colour replaces the noisy one.
  filter.setImage("output", frame.color, DEMC_FORMAT_FLOAT3, WIDTH, HEIGHT);
  filter.execute();
}

int main(int count, char **arguments) {
  std::unique_ptr<Frame> frame(new Frame());
  render(frame.get());
  try {
    denoise(*frame, count > 1 ? arguments[1] : nullptr);
  } catch (const demc::Error &error) {
    std::cerr << "error " << error.code << ": " << error.what() << "\n";
    return 1;
  }
  if (!write_pfm("denoised.pfm", frame->color)) {
    std::cerr << "error: cannot write denoised.pfm\n";
    return 1;
  }
}
