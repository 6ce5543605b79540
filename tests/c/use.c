// Right calls of the C library: functions of the caller, threads, and layouts of images.

#include <math.h>
#include <pthread.h>
#include <stdint.h>

#include "check.h"

// What the functions of the caller count.
typedef struct Calls {
  DemcDevice device;
  DemcFilter filter;
  int count, most;
  double last;
} Calls;

static bool cancel(void *user, double n) {
  Calls *calls = (Calls *)user;
  CHECK(n >= calls->last && n <= 1);
  calls->last = n;
  return ++calls->count < calls->most;
}

static bool execute_inside(void *user, double n) {
  Calls *calls = (Calls *)user;
  (void)n;
  if (calls->count++ == 0) {
    demcExecuteFilter(calls->filter);
    ERROR(calls->device, INVALID_OPERATION, "must not execute");
    // Other calls are allowed.
    demcSetFilterFloat(calls->filter, "inputScale", NAN);
    demcReleaseFilter(calls->filter);
  }
  return true;
}

static void count_warning(void *user, const char *message) {
  CHECK(is_sentence(message));
  ++*(int *)user;
}

void callbacks(DemcDevice device, DemcModel model) {
  DemcFilter filter = complete_filter(device, model);
  Calls calls = {device, filter, 0, 3, 0};
  demcSetFilterProgressMonitorFunction(filter, cancel, &calls);
  demcExecuteFilter(filter);
  ERROR(device, CANCELLED, "cancelled");
  CHECK(calls.count == 3);
  calls = (Calls){device, filter, 0, 1, 0};
  demcExecuteFilter(filter);
  ERROR(device, CANCELLED, "cancelled");
  CHECK(is_untouched());
  calls = (Calls){device, filter, 0, 1 << 30, 0};
  demcExecuteFilter(filter);
  FINE(device);
  CHECK(calls.count > 3 && !is_untouched());
  // The last reference goes during the execution.
  calls.count = 0;
  demcSetFilterProgressMonitorFunction(filter, execute_inside, &calls);
  demcExecuteFilter(filter);
  FINE(device);
  // Normals of the wrong length.
  int warnings = 0;
  filter = complete_filter(device, model);
  set(filter, "normal", albedo, DEMC_FORMAT_FLOAT3);
  set(filter, "position", normal, DEMC_FORMAT_FLOAT3);
  demcSetFilterWarningFunction(filter, count_warning, &warnings);
  demcExecuteFilter(filter);
  FINE(device);
  CHECK(warnings > 0);
  demcReleaseFilter(filter);
}

static void *execute(void *filter) {
  demcExecuteFilter((DemcFilter)filter);
  return NULL;
}

static void *misuse_elsewhere(void *filter) {
  demcUnsetFilterImage((DemcFilter)filter, "colour");
  return NULL;
}

void threads(DemcDevice device, DemcModel model) {
  pthread_t ids[8];
  static float outputs[4][VALUES];
  DemcFilter filters[8];
  DemcFilter one = complete_filter(device, model);
  demcExecuteFilter(one);
  memcpy(expected, output, sizeof(expected));
  // Four times one filter, and four filters.
  for (int i = 0; i < 8; i++) {
    filters[i] = i < 4 ? one : complete_filter(device, model);
    if (i >= 4)
      set(filters[i], "output", outputs[i - 4], DEMC_FORMAT_FLOAT3);
  }
  for (int i = 0; i < 8; i++)
    CHECK(!pthread_create(&ids[i], NULL, execute, filters[i]));
  for (int i = 0; i < 8; i++)
    pthread_join(ids[i], NULL);
  FINE(device);
  CHECK(!memcmp(expected, output, sizeof(expected)));
  for (int i = 0; i < 4; i++) {
    CHECK(!memcmp(expected, outputs[i], sizeof(expected)));
    demcReleaseFilter(filters[4 + i]);
  }
  // Each thread has its own error.
  CHECK(!pthread_create(&ids[0], NULL, misuse_elsewhere, one));
  pthread_join(ids[0], NULL);
  FINE(device);
  demcReleaseFilter(one);
}

// Executes, and returns the largest difference to the expected output.
static float difference(DemcDevice device, DemcFilter filter) {
  float most = 0;
  demcExecuteFilter(filter);
  FINE(device);
  for (int i = 0; i < VALUES; i++)
    most = fmaxf(most, fabsf(output[i] - expected[i]));
  return most;
}

void layouts(DemcDevice device, DemcModel model) {
  static float planar[VALUES], flipped[VALUES], wide[4 * PIXELS], alpha[PIXELS], lit[VALUES];
  DemcFilter filter = complete_filter(device, model);
  CHECK(difference(device, filter) == 0);
  for (int i = 0; i < PIXELS; i++) {
    const int mirrored = (HEIGHT - 1 - i / WIDTH) * WIDTH + i % WIDTH;
    for (int channel = 0; channel < 3; channel++) {
      const float value = color[3 * i + channel];
      planar[channel * PIXELS + i] = flipped[3 * mirrored + channel] = value;
      wide[4 * i + channel] = value;
    }
  }
  const DemcFormat f3 = DEMC_FORMAT_FLOAT3;
  const ptrdiff_t row = 12 * WIDTH;
  demcSetFilterPlanarImage(filter, "color", planar, f3, WIDTH, HEIGHT, 0, 0, 0, 0);
  CHECK(difference(device, filter) == 0);
  IMAGE("color", flipped, f3, WIDTH, HEIGHT, (HEIGHT - 1) * row, 0, -row);
  CHECK(difference(device, filter) == 0);
  IMAGE("color", wide, f3, WIDTH, HEIGHT, 0, 16, 0);
  CHECK(difference(device, filter) == 0);
  // An output in the memory of the input keeps what lies between its samples.
  for (int i = 0; i < PIXELS; i++)
    wide[4 * i + 3] = (float)i;
  IMAGE("output", wide, f3, WIDTH, HEIGHT, 0, 16, 0);
  demcExecuteFilter(filter);
  FINE(device);
  for (int i = 0; i < PIXELS; i++)
    if (memcmp(wide + 4 * i, expected + 3 * i, 12) || wide[4 * i + 3] != (float)i)
      CHECK(!"the output in place");
  set(filter, "color", color, f3);
  set(filter, "output", output, f3);
  // Halves: 1 is 0x3c00.
  static uint16_t halves[VALUES];
  for (int i = 0; i < VALUES; i++)
    halves[i] = i % 3 == 2 ? 0x3c00 : 0;
  set(filter, "normal", halves, DEMC_FORMAT_HALF3);
  CHECK(difference(device, filter) == 0);
  // Alpha of one value stays, and so does the colour.
  for (int i = 0; i < PIXELS; i++)
    alpha[i] = 0.25f;
  set(filter, "alpha", alpha, DEMC_FORMAT_FLOAT);
  set(filter, "outputAlpha", halves, DEMC_FORMAT_HALF);
  set(filter, "normal", normal, f3);
  CHECK(difference(device, filter) == 0);
  CHECK(halves[0] == 0x3400 && halves[PIXELS - 1] == 0x3400);
  // A layer that is the colour becomes the output, if the model has layers.
  set(filter, "layer:all", color, f3);
  set(filter, "outputLayer:all", lit, f3);
  demcExecuteFilter(filter);
  const char *message;
  if (demcGetDeviceError(device, &message) == DEMC_ERROR_NONE) {
    float most = 0;
    for (int i = 0; i < VALUES; i++)
      most = fmaxf(most, fabsf(lit[i] - expected[i]));
    CHECK(most < 1e-4f);
  } else
    CHECK(strstr(message, "layers need a model"));
  demcReleaseFilter(filter);
}
