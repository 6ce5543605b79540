// Denoises an image in Open Image Denoise with weights of `demc-infer export`.
//
//   cc with_weights.c -o with_weights -lOpenImageDenoise
//   ./with_weights unet.tza 1920 1080 < images.raw > denoised.raw
//
// images.raw has colour, albedo, and normal: one image after the other, each [height, width, 3] floats.

#include <OpenImageDenoise/oidn.h>
#include <stdio.h>
#include <stdlib.h>

int main(int argc, char **argv) {
  if (argc != 4)
    return 2;
  size_t width = atoi(argv[2]), height = atoi(argv[3]), values = 3 * width * height;
  float *images = malloc(3 * values * sizeof(float)), *output = malloc(values * sizeof(float));
  FILE *file = fopen(argv[1], "rb");
  char *weights = malloc(64 << 20);
  if (!file || fread(images, sizeof(float), 3 * values, stdin) != 3 * values)
    return 1;
  size_t size = fread(weights, 1, 64 << 20, file);

  OIDNDevice device = oidnNewDevice(OIDN_DEVICE_TYPE_CPU);
  oidnCommitDevice(device);
  OIDNFilter filter = oidnNewFilter(device, "RT");
  const char *names[] = {"color", "albedo", "normal"};
  for (int i = 0; i < 3; i++)
    oidnSetSharedFilterImage(filter, names[i], images + i * values, OIDN_FORMAT_FLOAT3, width, height, 0, 0, 0);
  oidnSetSharedFilterImage(filter, "output", output, OIDN_FORMAT_FLOAT3, width, height, 0, 0, 0);
  oidnSetFilterBool(filter, "hdr", true);
  oidnSetSharedFilterData(filter, "weights", weights, size);
  oidnCommitFilter(filter);
  oidnExecuteFilter(filter);

  const char *message;
  if (oidnGetDeviceError(device, &message) != OIDN_ERROR_NONE) {
    fprintf(stderr, "Open Image Denoise: %s\n", message);
    return 1;
  }
  fwrite(output, sizeof(float), values, stdout);
  return 0;
}
