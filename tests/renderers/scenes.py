"""Small random scenes, the same for every renderer: meshes, materials, lamps, a camera.

Metres, z up. A scene depends on its number only. Scenes 1 to 4 are those that `docs/renderers.md` reports; others serve
for everything that is chosen by a measurement.
"""

from __future__ import annotations

import argparse
import random
from dataclasses import dataclass, field

import numpy as np


@dataclass
class Material:
    """`kind` is diffuse, checker, plastic, metal, glass or lamp; colours are linear RGB."""

    kind: str
    color: tuple = (0.8, 0.8, 0.8)
    color2: tuple = (0.1, 0.1, 0.1)
    roughness: float = 0.2


@dataclass
class Mesh:
    """Triangles `[N, 3, 3]` with texture coordinates `[N, 3, 2]` in metres; `smooth` for curved surfaces."""

    corners: np.ndarray
    uv: np.ndarray
    material: Material
    normals: np.ndarray | None = None


@dataclass
class Scene:
    """The camera looks from `origin` to `target`; `sky` is the radiance of the background."""

    name: str
    origin: tuple
    target: tuple
    fov: float
    sky: tuple
    transparent: bool = False
    meshes: list = field(default_factory=list)


def quad(center, u, v, material, tiles=1.0):
    """A parallelogram with the half edges `u` and `v`; its normal is `u x v`."""
    center, u, v = (np.asarray(x, dtype=float) for x in (center, u, v))
    a, b, c, d = center - u - v, center + u - v, center + u + v, center - u + v
    w, h = np.linalg.norm(u) * tiles, np.linalg.norm(v) * tiles
    s, t, p, q = (-w, -h), (w, -h), (w, h), (-w, h)
    return Mesh(np.array([[a, b, c], [a, c, d]]), np.array([[s, t, p], [s, p, q]]), material)


def box(center, half, angle, material, tiles=1.0):
    """A box with half edges `half`, turned by `angle` about z."""
    cos, sin = np.cos(angle), np.sin(angle)
    x, y, z = np.array([cos, sin, 0]) * half[0], np.array([-sin, cos, 0]) * half[1], np.array([0, 0, half[2]])
    center = np.asarray(center, dtype=float)
    sides = [quad(center + n, u, v, material, tiles) for n, u, v in [(x, y, z), (-x, z, y), (y, z, x), (-y, x, z), (z, x, y), (-z, y, x)]]
    return Mesh(np.concatenate([s.corners for s in sides]), np.concatenate([s.uv for s in sides]), material)


def sphere(center, radius, material, rings=24):
    """A sphere of `2 rings^2` quadrilaterals with smooth normals."""
    theta, phi = np.meshgrid(np.linspace(0, np.pi, rings + 1), np.linspace(0, 2 * np.pi, 2 * rings + 1), indexing="ij")
    points = np.stack([np.sin(theta) * np.cos(phi), np.sin(theta) * np.sin(phi), np.cos(theta)], axis=-1)
    coordinates = np.stack([phi, theta], axis=-1) * radius
    cells = []
    for grid in (points, coordinates):
        a, b, c, d = grid[:-1, :-1], grid[1:, :-1], grid[1:, 1:], grid[:-1, 1:]
        lower, upper = np.stack([a, b, c], axis=2), np.stack([a, c, d], axis=2)
        cells.append(np.concatenate([lower[1:-1].reshape(-1, 3, grid.shape[-1]), lower[:1].reshape(-1, 3, grid.shape[-1]),
                                     upper[1:].reshape(-1, 3, grid.shape[-1]), lower[-1:].reshape(-1, 3, grid.shape[-1])]))
    normals = cells[0]
    return Mesh(np.asarray(center) + radius * normals, cells[1], material, normals)


def surface(rng):
    """A random material."""
    color = tuple(rng.uniform(0.1, 0.9) for _ in range(3))
    kind = rng.choice(["diffuse", "diffuse", "checker", "plastic", "metal", "glass"])
    dark = tuple(0.3 * c for c in color)
    return Material(kind, color, dark, rng.choice([0.02, 0.15, 0.3]))


def lamp(center, size, radiance):
    """A square lamp that shines down."""
    material = Material("lamp", tuple(radiance))
    return quad(center, (size, 0, 0), (0, -size, 0), material)


def clutter(rng, scene, count, area, low):
    """Objects on the plane z = `low`, within `area` of the middle."""
    for _ in range(count):
        x, y, material = rng.uniform(-area, area), rng.uniform(-area, area), surface(rng)
        size = rng.uniform(0.08, 0.28)
        if rng.random() < 0.45:
            scene.meshes.append(sphere((x, y, low + size), size, material))
        else:
            half = (size, size * rng.uniform(0.4, 1.2), size * rng.uniform(0.3, 2.2))
            scene.meshes.append(box((x, y, low + half[2]), half, rng.uniform(0, 3), material, tiles=8))


def scene(number: int) -> Scene:
    """Scene `number`: a room, a room with a mirror, things under the sky, a closet with a small lamp, in turn.

    Scene 0 has some objects of scene 7 alone, on a transparent film (Cycles only).
    """
    if number == 0:
        result = scene(7)
        result.meshes, result.transparent = result.meshes[-9:], True
        return result
    rng = random.Random(number)
    kind = (number - 1) % 4
    angle, height = rng.uniform(0.3, 1.2), rng.uniform(1.0, 1.7)
    origin = (-1.9 * np.cos(angle) - 0.3, -1.9 * np.sin(angle) - 0.3, height)
    sky = (0.55, 0.7, 1.0) if kind == 2 else (0.0, 0.0, 0.0)
    result = Scene(f"scene-{number}", origin, (0.2, 0.2, 0.45), rng.uniform(45, 65), sky)
    white, floor = Material("diffuse", (0.75, 0.73, 0.7)), Material("checker", (0.6, 0.5, 0.4), (0.2, 0.12, 0.08))
    side = 6.0 if kind == 2 else 2.4
    result.meshes.append(quad((0, 0, 0), (side, 0, 0), (0, side, 0), floor, tiles=3))
    if kind != 2:
        wall = Material("diffuse", tuple(rng.uniform(0.3, 0.8) for _ in range(3)))
        result.meshes.append(quad((0, 0, 2.5), (0, side, 0), (side, 0, 0), white))
        result.meshes.append(quad((side, 0, 1.25), (0, 0, 1.25), (0, side, 0), wall))
        result.meshes.append(quad((0, side, 1.25), (side, 0, 0), (0, 0, 1.25), white))
        result.meshes.append(quad((-side, 0, 1.25), (0, side, 0), (0, 0, 1.25), white))
        result.meshes.append(quad((0, -side, 1.25), (0, 0, 1.25), (side, 0, 0), wall))
    if kind == 1:
        result.meshes.append(quad((0.4, side - 0.02, 1.2), (0.9, 0, 0), (0, 0, 0.7), Material("metal", (0.95, 0.95, 0.95), roughness=0.0)))
    size = 0.12 if kind == 3 else 0.6
    power = 0.9 if kind == 2 else 2.2
    result.meshes.append(lamp((0.3, -0.2, 2.4), size, [power / size**2 * c for c in (1.0, 0.9, 0.75)]))
    clutter(rng, result, 14, 1.1, 0.0)
    return result


def run(description, render):
    """The command line of a renderer's script: calls `render(scene, out, size, spp, seed, plain)`."""
    parser = argparse.ArgumentParser(description=description, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("scene", type=int)
    parser.add_argument("out")
    parser.add_argument("--spp", type=int, default=4)
    parser.add_argument("--size", default="320x200", type=lambda text: tuple(int(side) for side in text.split("x")))
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--plain", action="store_true")
    arguments = parser.parse_args()
    render(scene(arguments.scene), arguments.out, arguments.size, arguments.spp, arguments.seed, arguments.plain)
