// What the tests of the C library share: checks of errors, and small images.

#include <demc.h>
#include <stdio.h>
#include <string.h>

enum { WIDTH = 40, HEIGHT = 24, PIXELS = WIDTH * HEIGHT, VALUES = 3 * PIXELS };

// Numbers of checks so far.
extern int checks, failures;

// Images of all tests: inputs, the output of an execution, and the right one.
extern float color[VALUES], normal[VALUES], albedo[VALUES], output[VALUES], expected[VALUES];

static inline void check(bool is_right, int line, const char *what) {
  checks++;
  if (!is_right) {
    failures++;
    fprintf(stderr, "line %d: %s\n", line, what);
  }
}
#define CHECK(condition) check(condition, __LINE__, #condition)

// Whether a message is one sentence: some text in one line.
static inline bool is_sentence(const char *text) {
  return strlen(text) > 8 && !strpbrk(text, "\n\r\t");
}

static inline void expect(DemcDevice device, DemcError code, const char *part, int line) {
  const char *message = NULL;
  const DemcError found = demcGetDeviceError(device, &message);
  const bool is_right = found == code && strstr(message, part) &&
                        (code == DEMC_ERROR_NONE ? !*message : is_sentence(message));
  check(is_right, line, part);
  if (!is_right)
    fprintf(stderr, "  error %d instead of %d: %s\n", found, code, message);
}
// The first error since the last call has this code, and a message with this part.
#define ERROR(device, code, part) expect(device, DEMC_ERROR_##code, part, __LINE__)
#define FINE(device) expect(device, DEMC_ERROR_NONE, "", __LINE__)

// Sets an image of a local `filter`.
#define IMAGE(...) demcSetFilterImage(filter, __VA_ARGS__)

static inline void set(DemcFilter filter, const char *name, void *data, DemcFormat format) {
  demcSetFilterImage(filter, name, data, format, WIDTH, HEIGHT, 0, 0, 0);
}

static inline DemcFilter complete_filter(DemcDevice device, DemcModel model) {
  DemcFilter filter = demcNewFilter(device, model);
  set(filter, "color", color, DEMC_FORMAT_FLOAT3);
  set(filter, "normal", normal, DEMC_FORMAT_FLOAT3);
  set(filter, "albedo", albedo, DEMC_FORMAT_FLOAT3);
  set(filter, "output", output, DEMC_FORMAT_FLOAT3);
  return filter;
}

// Whether nothing was written to the output, which was filled with -1.
static inline bool is_untouched(void) {
  for (int i = 0; i < VALUES; i++)
    if (output[i] != -1)
      return false;
  return true;
}

// Progress, cancellation, and warnings; parallel executions; images in every layout.
void callbacks(DemcDevice device, DemcModel model);
void threads(DemcDevice device, DemcModel model);
void layouts(DemcDevice device, DemcModel model);
