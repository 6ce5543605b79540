"""Random colours, textures, pictures, and skies, as arrays."""

from __future__ import annotations

import colorsys

import numpy as np
from variant import mi

Rng = np.random.Generator
TEXTURE_SIDE = 256
"""Height and width of a texture, in pixels."""


def color(rng: Rng) -> list[float]:
    """A reflectance: mostly muted, rarely bright and saturated."""
    saturation = rng.beta(1.0, 3.5)
    return [float(c) for c in colorsys.hsv_to_rgb(rng.random(), saturation, rng.uniform(0.1, 0.9))]


def sky(rng: Rng, brightness: float, skyline: bool = False) -> dict:
    """An environment map: a gradient with clouds, and buildings if `skyline`.

    Three of four have a sun with a radius of 1 to 5 degrees.
    """
    height, width = 256, 512
    up = np.linspace(1, -1, height)[:, None, None]
    zenith = np.array([rng.uniform(0.5, 1), rng.uniform(0.7, 1), 1.0]) * rng.uniform(0.4, 1)
    horizon, ground = np.array([1, rng.uniform(0.8, 1), rng.uniform(0.6, 1)]), np.array(color(rng))
    image = np.where(up > 0, horizon + (zenith - horizon) * np.sqrt(np.abs(up)), ground) * np.ones((height, width, 1))
    image *= 0.6 + 0.8 * noise(rng, height, width, 4)[..., None]
    if rng.random() < 0.75:
        elevation, azimuth = np.radians(rng.uniform(8, 60)), rng.uniform(0, 2 * np.pi)
        theta = np.linspace(0, np.pi, height)[:, None]
        phi = np.linspace(0, 2 * np.pi, width)[None]
        cosine = np.cos(theta) * np.sin(elevation) + np.sin(theta) * np.cos(elevation) * np.cos(phi - azimuth)
        radius = np.radians(np.exp(rng.uniform(np.log(1), np.log(5))))
        sun = (np.arccos(np.clip(cosine, -1, 1)) < radius)[..., None]
        power = np.exp(rng.uniform(np.log(0.02), np.log(0.5))) / (1 - np.cos(radius))
        image += sun * power * np.array([1, rng.uniform(0.75, 1), rng.uniform(0.5, 1)])
    if skyline:
        image = built(rng, image)
    return environment(image * brightness * 4)


def studio(rng: Rng) -> dict:
    """An environment map with one to four lamps above, exactly black elsewhere."""
    height, width = 256, 512
    image = np.zeros((height, width, 3))
    for _ in range(rng.integers(1, 5)):
        top, left = int(rng.integers(0, 60)), int(rng.integers(0, width))
        high, wide = int(rng.integers(8, 40)), int(rng.integers(12, 90))
        solid = np.sin(np.pi * (top + high / 2) / height) * high * wide * 2 * np.pi**2 / (height * width)
        power = np.exp(rng.uniform(np.log(1), np.log(8))) / solid
        columns = np.arange(left, left + wide) % width
        image[top : top + high, columns] += power * np.array([1, rng.uniform(0.75, 1), rng.uniform(0.5, 1)])
    return environment(image)


def environment(image: np.ndarray) -> dict:
    """An environment emitter; the image is `[height, width, 3]`, zenith first."""
    # Mitsuba's environment maps have y up.
    to_world = mi.ScalarTransform4f().rotate([1, 0, 0], 90)
    return {"type": "envmap", "bitmap": mi.Bitmap(image.astype(np.float32)), "to_world": to_world}


def built(rng: Rng, image: np.ndarray) -> np.ndarray:
    """Adds buildings along the horizon and a coarse ground to a map `[height, width, 3]`, in place."""
    height, width, _ = image.shape
    horizon, left = height // 2, 0
    bumps = noise(rng, height, width, 6)[..., None]
    while left < width:
        right = left + int(rng.integers(6, 60))
        top = horizon - int(rng.integers(2, 60))
        y, x = np.mgrid[top:horizon, left : min(right, width)]
        across, up = rng.integers(3, 14, 2)
        window = (x % across > across * rng.uniform(0.2, 0.7)) & (y % up > up * rng.uniform(0.2, 0.7))
        wall, pane = (np.array(color(rng)) * rng.uniform(0.2, 1) for _ in range(2))
        image[top:horizon, left:right] = np.where(window[..., None], pane, wall) * (0.5 + bumps[top:horizon, left:right])
        left = right
    image[horizon:] *= 0.4 + 1.2 * bumps[horizon:]
    return image


def noise(rng: Rng, height: int, width: int, octaves: int) -> np.ndarray:
    """Smooth periodic noise from 0 to 1, `[height, width]`."""
    total, weight = np.zeros((height, width)), 0.0
    for octave in range(octaves):
        cells = 4 << octave
        grid = rng.random((cells, cells))
        y, x = (np.arange(n) * cells / n for n in (height, width))
        y0, x0 = y.astype(int), x.astype(int)
        fy, fx = ((t - t0) ** 2 * (3 - 2 * (t - t0)) for t, t0 in ((y, y0), (x, x0)))
        rows = grid[y0] * (1 - fy[:, None]) + grid[(y0 + 1) % cells] * fy[:, None]
        total += (rows[:, x0] * (1 - fx) + rows[:, (x0 + 1) % cells] * fx) * 0.5**octave
        weight += 0.5**octave
    return total / weight


def pattern(rng: Rng, a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """A texture of two colours, `[256, 256, 3]`."""
    n = TEXTURE_SIDE
    y, x = np.mgrid[0:n, 0:n] / n
    bumps, count = noise(rng, n, n, 5), int(rng.integers(2, 14))
    kind = rng.integers(6)
    if kind == 0:
        share = bumps
    elif kind == 1:
        share = ((x * count) % 1 < rng.uniform(0.2, 0.8)).astype(float)
    elif kind == 2:
        share = ((np.floor(x * count) + np.floor(y * count)) % 2).astype(float)
    elif kind == 3:
        rows = np.floor(y * count)
        share = (((y * count) % 1 < 0.08) | ((x * count / 2 + 0.5 * rows) % 1 < 0.04)).astype(float)
    elif kind == 4:
        share = 0.5 + 0.5 * np.sin(2 * np.pi * (x * count + 2 * bumps + 0.1 * np.sin(2 * np.pi * y)))
    else:
        share = (np.hypot((x * count) % 1 - 0.5, (y * count) % 1 - 0.5) < rng.uniform(0.15, 0.45)).astype(float)
    image = a + (b - a) * share[..., None]
    return np.clip(image * (0.85 + 0.3 * bumps[..., None] * rng.random()), 0.01, 0.95)


def grain(rng: Rng) -> np.ndarray:
    """Boards, stone, or cloth: factors of a colour around 0.8, with detail in every texel, `[256, 256, 1]`."""
    n = TEXTURE_SIDE
    y, x = np.mgrid[0:n, 0:n] / n
    kind = rng.choice(["boards", "stone", "cloth"], p=[0.55, 0.3, 0.15])
    if kind == "boards":
        boards, ends = int(rng.integers(4, 17)), int(rng.integers(1, 5))
        row = np.floor(y * boards).astype(int)
        along = x * ends + rng.random(boards)[row]
        board = (np.floor(along).astype(int) + 7 * row) % 61
        fibres = np.stack([np.interp(x[0], np.linspace(0, 1, 13), knots) for knots in rng.random((n, 13))])
        factor = rng.uniform(0.4, 1.15, 61)[board] * (0.6 + 0.4 * fibres + 0.4 * noise(rng, n, n, 6))
        joint = ((y * boards) % 1 < 0.04) | (along % 1 < 0.01)
        factor = np.where(joint, 0.4 * factor, factor)
    elif kind == "stone":
        veins = np.abs(noise(rng, n, n, 5) - 0.5) * rng.uniform(2, 8)
        factor = 0.3 + 0.5 * np.minimum(veins, 1) + 0.4 * noise(rng, n, n, 6) * rng.random((n, n))
    else:
        threads = int(rng.integers(12, 49))
        weave = 0.5 + 0.5 * np.sin(2 * np.pi * threads * x) * np.sin(2 * np.pi * threads * y)
        factor = 0.35 + 0.6 * weave + 0.25 * noise(rng, n, n, 5)
    return factor[..., None]


def mosaic(rng: Rng, colors: list) -> np.ndarray:
    """A picture of Voronoi cells."""
    n = TEXTURE_SIDE
    y, x = np.mgrid[0:n, 0:n] / n
    points = rng.random((rng.integers(4, 40), 2))
    distance = (x[..., None] - points[:, 0]) ** 2 + (y[..., None] - points[:, 1]) ** 2
    return np.array(colors)[np.argmin(distance, axis=-1) % len(colors)]
