// Wrong calls of the C library, each with its error. use.c has the right ones.
//
//   misuse [model.safetensors]     without a model, "quality"
//
// Prints a line per failed check and a summary. Exit code 1 if any failed.

#define _POSIX_C_SOURCE 200809L

#include <math.h>
#include <stdint.h>
#include <stdlib.h>

#include "check.h"

int checks, failures;
float color[VALUES], normal[VALUES], albedo[VALUES], output[VALUES], expected[VALUES];

static void make_images(void) {
  unsigned state = 1;
  for (int i = 0; i < VALUES; i++) {
    state = state * 1664525u + 1013904223u;
    color[i] = (float)(state >> 8) / 16777216.0f;
    normal[i] = i % 3 == 2;
    albedo[i] = 0.5f;
  }
}

static void null_handles(void) {
  float pixel[3];
  demcRetainDevice(NULL), demcRetainModel(NULL), demcRetainFilter(NULL);
  demcReleaseDevice(NULL), demcReleaseModel(NULL), demcReleaseFilter(NULL);
  FINE(NULL);
  CHECK(!demcNewModel(NULL, NULL));
  ERROR(NULL, INVALID_ARGUMENT, "device is NULL");
  CHECK(!demcNewModelFromMemory(NULL, pixel, sizeof(pixel)));
  ERROR(NULL, INVALID_ARGUMENT, "device is NULL");
  CHECK(!demcNewFilter(NULL, NULL));
  ERROR(NULL, INVALID_ARGUMENT, "device is NULL");
  demcSetFilterImage(NULL, "color", pixel, DEMC_FORMAT_FLOAT3, 1, 1, 0, 0, 0);
  ERROR(NULL, INVALID_ARGUMENT, "filter is NULL");
  demcSetFilterPlanarImage(NULL, "color", pixel, DEMC_FORMAT_FLOAT3, 1, 1, 0, 0, 0, 0);
  ERROR(NULL, INVALID_ARGUMENT, "filter is NULL");
  demcUnsetFilterImage(NULL, "color");
  ERROR(NULL, INVALID_ARGUMENT, "filter is NULL");
  demcSetFilterBool(NULL, "restoreLight", true);
  ERROR(NULL, INVALID_ARGUMENT, "filter is NULL");
  demcSetFilterInt(NULL, "maxMemoryMB", 1);
  ERROR(NULL, INVALID_ARGUMENT, "filter is NULL");
  demcSetFilterFloat(NULL, "inputScale", 1);
  ERROR(NULL, INVALID_ARGUMENT, "filter is NULL");
  demcSetFilterProgressMonitorFunction(NULL, NULL, NULL);
  ERROR(NULL, INVALID_ARGUMENT, "filter is NULL");
  demcSetFilterWarningFunction(NULL, NULL, NULL);
  ERROR(NULL, INVALID_ARGUMENT, "filter is NULL");
  demcExecuteFilter(NULL);
  ERROR(NULL, INVALID_ARGUMENT, "filter is NULL");
  demcExecuteFilter(NULL);
  CHECK(demcGetDeviceError(NULL, NULL) == DEMC_ERROR_INVALID_ARGUMENT);
  FINE(NULL);
}

static void devices(void) {
  CHECK(!demcNewDevice("tpu", 0));
  ERROR(NULL, INVALID_ARGUMENT, "unknown device `tpu`");
  CHECK(!demcNewDevice("", 0));
  ERROR(NULL, INVALID_ARGUMENT, "unknown device");
  CHECK(!demcNewDevice("\xff", 0));
  ERROR(NULL, INVALID_ARGUMENT, "not valid UTF-8");
  CHECK(!demcNewDevice("cuda", 0));
  ERROR(NULL, UNSUPPORTED_HARDWARE, "cuda");
  CHECK(!demcNewDevice("flex", -1));
  ERROR(NULL, INVALID_ARGUMENT, "-1 threads");
  const char *isa = getenv("DEMC_ISA");
  char *old = isa ? strdup(isa) : NULL;
  setenv("DEMC_ISA", "sse9", 1);
  CHECK(!demcNewDevice(NULL, 0));
  ERROR(NULL, INVALID_ARGUMENT, "sse9");
  old ? setenv("DEMC_ISA", old, 1) : unsetenv("DEMC_ISA");
  free(old);
  DemcDevice device = demcNewDevice(NULL, 1000000);
  CHECK(device);
  demcReleaseDevice(device);
}

static void models(DemcDevice device, const char *path) {
  CHECK(!demcNewModel(device, "no-such.safetensors"));
  ERROR(device, INVALID_MODEL, "no-such.safetensors");
  CHECK(!demcNewModel(device, ""));
  ERROR(device, INVALID_MODEL, "cannot read");
  CHECK(!demcNewModel(device, "/dev/null"));
  ERROR(device, INVALID_MODEL, "/dev/null");
  CHECK(!demcNewModel(device, "/"));
  ERROR(device, INVALID_MODEL, "neither a run directory");
  CHECK(!demcNewModel(device, "a\nb"));
  ERROR(device, INVALID_MODEL, "a\\nb");
  CHECK(!demcNewModel(device, "\xff.safetensors"));
  ERROR(device, INVALID_ARGUMENT, "not valid UTF-8");
  CHECK(!demcNewModelFromMemory(device, NULL, 4));
  ERROR(device, INVALID_ARGUMENT, "NULL");
  CHECK(!demcNewModelFromMemory(device, "", 0));
  ERROR(device, INVALID_MODEL, "memory");
  CHECK(!demcNewModelFromMemory(device, "no safetensors file", 19));
  ERROR(device, INVALID_MODEL, "memory");
  CHECK(!demcNewModelFromMemory(device, "", SIZE_MAX));
  ERROR(device, INVALID_ARGUMENT, "bytes are no model");
  FILE *file = path ? fopen(path, "rb") : NULL;
  if (!file)
    return;
  fseek(file, 0, SEEK_END);
  const size_t size = (size_t)ftell(file);
  char *bytes = (char *)malloc(size);
  rewind(file);
  CHECK(bytes && fread(bytes, 1, size, file) == size);
  fclose(file);
  DemcModel model = demcNewModelFromMemory(device, bytes, size);
  CHECK(model);
  demcReleaseModel(model);
  CHECK(!demcNewModelFromMemory(device, bytes, size / 2));
  ERROR(device, INVALID_MODEL, "cut short");
  bytes[size - 1] ^= 1;
  CHECK(!demcNewModelFromMemory(device, bytes, size));
  ERROR(device, INVALID_MODEL, "checksum");
  const char key[] = "\\\"format\\\":1";
  for (size_t i = 0; i + sizeof(key) < size; i++)
    if (!memcmp(bytes + i, key, sizeof(key) - 1)) {
      bytes[i + sizeof(key) - 2] = '9';
      break;
    }
  CHECK(!demcNewModelFromMemory(device, bytes, size));
  ERROR(device, INVALID_MODEL, "bundle format 9");
  free(bytes);
  FINE(device);
}

static void filters_and_options(DemcDevice device, DemcModel model) {
  CHECK(!demcNewFilter(device, NULL));
  ERROR(device, INVALID_ARGUMENT, "model is NULL");
  DemcDevice other = demcNewDevice("flex", 1);
  CHECK(!demcNewFilter(other, model));
  ERROR(other, INVALID_ARGUMENT, "another device");
  demcReleaseDevice(other);
  DemcFilter filter = demcNewFilter(device, model);
  demcSetFilterBool(filter, "hdr", true);
  ERROR(device, INVALID_ARGUMENT, "no bool option is called `hdr`");
  demcSetFilterBool(filter, NULL, true);
  ERROR(device, INVALID_ARGUMENT, "name of the option is NULL");
  demcSetFilterInt(filter, "quality", 1);
  ERROR(device, INVALID_ARGUMENT, "quality");
  demcSetFilterInt(filter, "maxMemoryMB", -1);
  ERROR(device, INVALID_ARGUMENT, "-1");
  demcSetFilterFloat(filter, "gamma", 1);
  ERROR(device, INVALID_ARGUMENT, "gamma");
  const float scales[] = {0, -1, 1e-7f, 1e7f, INFINITY};
  for (int i = 0; i < 5; i++) {
    demcSetFilterFloat(filter, "inputScale", scales[i]);
    ERROR(device, INVALID_ARGUMENT, "inputScale");
  }
  demcSetFilterFloat(filter, "inputScale", NAN);
  demcSetFilterFloat(filter, "inputScale", 2);
  FINE(device);
  // The first error stays.
  demcSetFilterFloat(filter, "first", 1);
  demcSetFilterFloat(filter, "second", 1);
  ERROR(device, INVALID_ARGUMENT, "first");
  FINE(device);
  demcReleaseFilter(filter);
}

static void wrong_images(DemcDevice device, DemcModel model) {
  DemcFilter filter = demcNewFilter(device, model);
#define REFUSED(part) ERROR(device, INVALID_ARGUMENT, part)
  const DemcFormat f3 = DEMC_FORMAT_FLOAT3;
  IMAGE(NULL, color, f3, WIDTH, HEIGHT, 0, 0, 0);
  REFUSED("name of the image is NULL");
  IMAGE("colour", color, f3, WIDTH, HEIGHT, 0, 0, 0);
  REFUSED("no image is called `colour`");
  IMAGE("layer:", color, f3, WIDTH, HEIGHT, 0, 0, 0);
  REFUSED("layer:");
  IMAGE("\xc3", color, f3, WIDTH, HEIGHT, 0, 0, 0);
  REFUSED("not valid UTF-8");
  IMAGE("color", NULL, f3, WIDTH, HEIGHT, 0, 0, 0);
  REFUSED("memory of color is NULL");
  IMAGE("color", color, DEMC_FORMAT_FLOAT, WIDTH, HEIGHT, 0, 0, 0);
  REFUSED("1 channel(s) per pixel instead of 3");
  IMAGE("alpha", color, f3, WIDTH, HEIGHT, 0, 0, 0);
  REFUSED("3 channel(s) per pixel instead of 1");
  IMAGE("color", color, (DemcFormat)0, WIDTH, HEIGHT, 0, 0, 0);
  REFUSED("unknown format 0");
  IMAGE("color", color, (DemcFormat)4, WIDTH, HEIGHT, 0, 0, 0);
  REFUSED("unknown format 4");
  IMAGE("color", color, f3, 0, HEIGHT, 0, 0, 0);
  REFUSED("color: ");
  IMAGE("color", color, f3, WIDTH, 0, 0, 0, 0);
  REFUSED("color: ");
  IMAGE("color", color, f3, 32769, 1, 0, 0, 0);
  REFUSED("32769");
  IMAGE("color", color, f3, 32768, 32768, 0, 0, 0);
  REFUSED("32768");
  IMAGE("color", color, f3, SIZE_MAX, SIZE_MAX, 0, 0, 0);
  REFUSED("color: ");
  IMAGE("color", color, f3, WIDTH, HEIGHT, 0, PTRDIFF_MAX, 0);
  REFUSED("huge strides");
  IMAGE("color", color, f3, WIDTH, HEIGHT, 0, 0, PTRDIFF_MIN);
  REFUSED("huge strides");
  IMAGE("color", color, f3, WIDTH, HEIGHT, SIZE_MAX, 0, 0);
  REFUSED("address space");
  IMAGE("color", color, f3, WIDTH, HEIGHT, 0, 0, PTRDIFF_MIN / HEIGHT);
  REFUSED("address space");
  demcSetFilterPlanarImage(filter, "color", color, f3, WIDTH, HEIGHT, 0, PTRDIFF_MAX, 0, 0);
  REFUSED("huge strides");
  demcUnsetFilterImage(filter, "colour");
  REFUSED("colour");
  demcUnsetFilterImage(filter, NULL);
  REFUSED("NULL");
  demcUnsetFilterImage(filter, "color");
  FINE(device);
  demcReleaseFilter(filter);
}

static void wrong_executions(DemcDevice device, DemcModel model) {
  static float alpha[PIXELS], bad[VALUES], large[3 * 512 * 512];
  for (int i = 0; i < VALUES; i++)
    output[i] = -1;
  DemcFilter filter = demcNewFilter(device, model);
#define FAILS(code, part) (demcExecuteFilter(filter), ERROR(device, code, part))
  FAILS(INVALID_OPERATION, "image color is not set");
  set(filter, "color", color, DEMC_FORMAT_FLOAT3);
  FAILS(INVALID_OPERATION, "image output is not set");
  set(filter, "output", output, DEMC_FORMAT_FLOAT3);
  FAILS(INVALID_OPERATION, "no normal");
  set(filter, "normal", normal, DEMC_FORMAT_FLOAT3);
  FAILS(INVALID_OPERATION, "no albedo");
  set(filter, "albedo", albedo, DEMC_FORMAT_FLOAT3);
  set(filter, "alpha", alpha, DEMC_FORMAT_FLOAT);
  FAILS(INVALID_OPERATION, "outputAlpha is not set");
  demcUnsetFilterImage(filter, "alpha");
  set(filter, "outputAlpha", alpha, DEMC_FORMAT_FLOAT);
  FAILS(INVALID_OPERATION, "image alpha is not set");
  demcUnsetFilterImage(filter, "outputAlpha");
  set(filter, "layer:sun", color, DEMC_FORMAT_FLOAT3);
  FAILS(INVALID_OPERATION, "outputLayer:sun is not set");
  set(filter, "outputLayer:sun", alpha, DEMC_FORMAT_FLOAT);
  FAILS(INVALID_ARGUMENT, "outputLayer:sun has 1 channels instead of 3");
  demcUnsetFilterImage(filter, "layer:sun");
  demcUnsetFilterImage(filter, "outputLayer:sun");
  IMAGE("output", output, DEMC_FORMAT_FLOAT3, HEIGHT, WIDTH, 0, 0, 0);
  FAILS(INVALID_ARGUMENT, "output has 40x24 pixels, but color has 24x40");
  IMAGE("output", output, DEMC_FORMAT_FLOAT3, WIDTH, HEIGHT, 0, 4, 0);
  FAILS(INVALID_ARGUMENT, "share memory");
  set(filter, "output", output, DEMC_FORMAT_FLOAT3);
  IMAGE("albedo", albedo, DEMC_FORMAT_FLOAT3, WIDTH, HEIGHT - 1, 0, 0, 0);
  FAILS(INVALID_ARGUMENT, "albedo has 23x40 pixels");
  set(filter, "albedo", albedo, DEMC_FORMAT_FLOAT3);
  memcpy(bad, color, sizeof(bad));
  bad[7] = NAN;
  set(filter, "color", bad, DEMC_FORMAT_FLOAT3);
  FAILS(INVALID_ARGUMENT, "color has 1 NaN");
  bad[7] = INFINITY;
  FAILS(INVALID_ARGUMENT, "first one is inf in row 0, column 2");
  set(filter, "color", color, DEMC_FORMAT_FLOAT3);
  set(filter, "normal", bad, DEMC_FORMAT_FLOAT3);
  FAILS(INVALID_ARGUMENT, "normal has 1 NaN");
  for (int i = 0; i < VALUES; i++)
    bad[i] = 1e6f;
  FAILS(INVALID_ARGUMENT, "does not fit the model's statistics");
  const char *names[] = {"color", "normal", "albedo", "output"};
  for (int i = 0; i < 4; i++)
    IMAGE(names[i], large, DEMC_FORMAT_FLOAT3, 512, 512, 0, 0, 0);
  demcSetFilterInt(filter, "maxMemoryMB", 1);
  FAILS(OUT_OF_MEMORY, "fit into memory");
  CHECK(is_untouched());
  demcReleaseFilter(filter);
}

int main(int count, char **arguments) {
  const char *path = count > 1 ? arguments[1] : NULL;
  make_images();
  CHECK(strlen(demcVersion()) >= 5);
  null_handles();
  devices();
  DemcDevice device = demcNewDevice("flex", 2);
  models(device, path);
  DemcModel model = demcNewModel(device, path);
  FINE(device);
  filters_and_options(device, model);
  wrong_images(device, model);
  wrong_executions(device, model);
  callbacks(device, model);
  threads(device, model);
  layouts(device, model);
  // A filter keeps its model and its device.
  DemcFilter filter = complete_filter(device, model);
  demcRetainFilter(filter), demcReleaseFilter(filter);
  demcReleaseModel(model);
  demcExecuteFilter(filter);
  FINE(device);
  demcReleaseDevice(device);
  demcExecuteFilter(filter);
  CHECK(!memcmp(expected, output, sizeof(expected)));
  demcReleaseFilter(filter);
  printf("misuse: %d checks, %d failed\n", checks, failures);
  return failures > 0;
}
