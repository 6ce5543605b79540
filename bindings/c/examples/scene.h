// The scene of the examples: a tiled floor and a wall under a lamp, at 4 samples per pixel.

#include <math.h>
#include <stdio.h>

enum { WIDTH = 160, HEIGHT = 96, PIXELS = WIDTH * HEIGHT, SAMPLES = 4 };

// Images of WIDTH x HEIGHT pixels with 3 floats each, rows from top to bottom.
typedef struct Frame {
  float color[3 * PIXELS];    // linear radiance
  float normal[3 * PIXELS];   // world space
  float position[3 * PIXELS]; // world space, metres
  float albedo[3 * PIXELS];   // 0 to 1
} Frame;

// A random number from 0 to 1.
static float uniform(unsigned *state) {
  *state = *state * 1664525u + 1013904223u;
  return (float)(*state >> 8) / 16777216.0f;
}

// Adds one sample per image to a pixel.
static void add_sample(Frame *frame, int pixel, unsigned *state) {
  // A ray of a camera 4 m before the wall, z = 0, and 1.6 m above the floor, y = 0.
  const float camera[3] = {0.4f, 1.6f, 4.0f};
  const float x = ((float)(pixel % WIDTH) + uniform(state) - WIDTH / 2.0f) / HEIGHT;
  const float y = (HEIGHT / 2.0f - (float)(pixel / WIDTH) - uniform(state)) / HEIGHT;
  const int is_floor = y < 0 && camera[1] / -y < camera[2];
  const float distance = is_floor ? camera[1] / -y : camera[2];
  const float position[3] = {camera[0] + distance * x, camera[1] + distance * y,
                             camera[2] - distance};
  const float normal[3] = {0, (float)is_floor, (float)!is_floor};
  const int is_dark = ((int)floorf(position[0]) + (int)floorf(position[2])) % 2 == 0;
  const float albedo[3] = {is_floor && is_dark ? 0.1f : 0.7f, is_floor && is_dark ? 0.1f : 0.6f,
                           is_floor && is_dark ? 0.2f : 0.5f};
  // The light of a random point of a lamp of 1 m x 1 m.
  const float light[3] = {uniform(state) - 0.5f - position[0], 3.6f - position[1],
                          uniform(state) + 0.9f - position[2]};
  const float square = light[0] * light[0] + light[1] * light[1] + light[2] * light[2];
  const float cosines = (light[1] * normal[1] + light[2] * normal[2]) * light[1] / square;
  const float radiance = cosines > 0 ? 60.0f * cosines / square / 3.14159f : 0;
  for (int channel = 0; channel < 3; channel++) {
    const int i = 3 * pixel + channel;
    frame->color[i] += albedo[channel] * radiance / SAMPLES;
    frame->normal[i] += normal[channel] / SAMPLES;
    frame->position[i] += position[channel] / SAMPLES;
    frame->albedo[i] += albedo[channel] / SAMPLES;
  }
}

// Renders into a frame of zeros.
static void render(Frame *frame) {
  unsigned state = 1;
  for (int pixel = 0; pixel < PIXELS; pixel++)
    for (int sample = 0; sample < SAMPLES; sample++)
      add_sample(frame, pixel, &state);
}

// Writes a PFM file, whose rows go from bottom to top. Returns whether it is written.
static int write_pfm(const char *path, const float *pixels) {
  FILE *file = fopen(path, "wb");
  if (!file)
    return 0;
  int is_written = fprintf(file, "PF\n%d %d\n-1.0\n", WIDTH, HEIGHT) > 0;
  for (int row = HEIGHT - 1; row >= 0; row--)
    is_written &= fwrite(pixels + 3 * WIDTH * row, sizeof(float), 3 * WIDTH, file) == 3 * WIDTH;
  return (fclose(file) == 0) & is_written;
}
