// Renders a small frame, denoises it, and writes denoised.pfm.
//
//   cc denoise.c -o denoise $(pkg-config --cflags --libs demc) -lm
//   ./denoise                      with the bundled model "quality"
//   ./denoise model.safetensors    with another model

#include <demc.h>
#include <stdlib.h>

#include "scene.h"

// Draws the progress. Returning false would cancel.
static bool show_progress(void *user, double n) {
  (void)user;
  fprintf(stderr, "\r%3.0f %%", 100 * n);
  return true;
}

static void show_warning(void *user, const char *message) {
  (void)user;
  fprintf(stderr, "warning: %s\n", message);
}

// Prints the first error since the last call. Returns whether there was one.
static bool failed(DemcDevice device) {
  const char *message;
  if (demcGetDeviceError(device, &message) == DEMC_ERROR_NONE)
    return false;
  fprintf(stderr, "error: %s\n", message);
  return true;
}

int main(int count, char **arguments) {
  Frame *frame = (Frame *)calloc(1, sizeof(Frame));
  if (!frame)
    return 1;
  render(frame);

  DemcDevice device = demcNewDevice("flex", 0);
  if (!device) {
    failed(NULL);
    free(frame);
    return 1;
  }
  DemcModel model = demcNewModel(device, count > 1 ? arguments[1] : NULL);
  DemcFilter filter = demcNewFilter(device, model);

  const DemcFormat format = DEMC_FORMAT_FLOAT3;
  demcSetFilterImage(filter, "color", frame->color, format, WIDTH, HEIGHT, 0, 0, 0);
  demcSetFilterImage(filter, "normal", frame->normal, format, WIDTH, HEIGHT, 0, 0, 0);
  demcSetFilterImage(filter, "position", frame->position, format, WIDTH, HEIGHT, 0, 0, 0);
  demcSetFilterImage(filter, "albedo", frame->albedo, format, WIDTH, HEIGHT, 0, 0, 0);
  // The denoised colour replaces the noisy one.
  demcSetFilterImage(filter, "output", frame->color, format, WIDTH, HEIGHT, 0, 0, 0);
  demcSetFilterProgressMonitorFunction(filter, show_progress, NULL);
  demcSetFilterWarningFunction(filter, show_warning, NULL);
  demcExecuteFilter(filter);
  fprintf(stderr, "\n");

  bool is_done = !failed(device);
  if (is_done && !write_pfm("denoised.pfm", frame->color)) {
    perror("denoised.pfm");
    is_done = false;
  }
  demcReleaseFilter(filter);
  demcReleaseModel(model);
  demcReleaseDevice(device);
  free(frame);
  return is_done ? 0 : 1;
}
