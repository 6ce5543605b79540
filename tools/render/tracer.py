"""A path tracer on Mitsuba 3 that returns colour and the twelve feature channels (Sec. 3.1).

Features are normal, position, and albedo at a path's first vertex, and albedo at its second.
Mitsuba's own `aov` integrator has no second vertex. Emitters and BSDFs are sampled and weighted by
the power heuristic; Russian roulette starts at the third vertex.
"""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import numpy as np
from variant import mi

MAX_DEPTH = 8
"""Largest number of vertices of a path, without the camera."""
ROULETTE_DEPTH = 3
"""Vertex at which Russian roulette starts."""
LARGEST_WAVEFRONT = 1 << 21
"""Largest number of paths traced at once; each takes about 300 bytes."""
FEATURES = ("normal", "position", "albedo1", "albedo2", "mask")
"""Features of the first two vertices, in the order in which `trace` returns them."""


@dataclass
class Samples:
    """Sums over the samples of each pixel, `[H, W, C]` float64. Dividing by `count` gives means."""

    color: np.ndarray
    features: dict[str, np.ndarray]
    count: int

    def plus(self, other: Samples | None) -> Samples:
        """The sums over the samples of both."""
        if other is None:
            return self
        features = {name: planes + other.features[name] for name, planes in self.features.items()}
        return Samples(self.color + other.color, features, self.count + other.count)


def render(
    scene: mi.Scene, samples: int, seed: int, clamp: float = np.inf, view: int = 0, follow: bool = False
) -> Samples:
    """Traces `samples` paths per pixel of sensor number `view`: box filter, independent sampler.

    `clamp` limits the radiance of a sample, without emitters seen directly. With `follow`, albedo is that of
    the first surface behind mirrors and clear glass, as Blender Cycles and LuxCore write it.
    """
    sensor = scene.sensors()[view]
    width, height = (int(side) for side in sensor.film().crop_size())
    at_once = max(1, min(samples, LARGEST_WAVEFRONT // (width * height)))
    sums, done = None, 0
    while done < samples:
        count = min(at_once, samples - done)
        traced = trace_pixels(scene, sensor, width, height, count, seed + done, clamp, follow)
        sums = traced if sums is None else {name: sums[name] + traced[name] for name in sums}
        done += count
    shaped = {name: plane.reshape(height, width, -1) for name, plane in sums.items()}
    return Samples(shaped.pop("color"), shaped, samples)


def trace_pixels(
    scene, sensor, width: int, height: int, count: int, seed: int, clamp: float, follow: bool
) -> dict[str, np.ndarray]:
    """Sums over `count` paths of each pixel, `[H * W, C]` float64."""
    paths = width * height * count
    sampler = mi.load_dict({"type": "independent"})
    # Mitsuba hashes seed and index: neighbouring seeds are not correlated.
    sampler.seed(seed % (1 << 32), paths)
    # Opaque: one compiled kernel for any number of samples.
    pixel = dr.arange(mi.UInt32, paths) // dr.opaque(mi.UInt32, count)
    corner = mi.Point2f(mi.Float(pixel % width), mi.Float(pixel // width))
    film = (corner + sampler.next_2d()) / mi.ScalarPoint2f(width, height)
    ray, weight = sensor.sample_ray(0.0, sampler.next_1d(), film, sampler.next_2d())
    color, features = trace(scene, sampler, ray, dr.opaque(mi.Float, min(clamp, 1e30)), dr.opaque(mi.Bool, follow))
    color = color * weight

    channels = {"color": [*color]}
    for name, value in zip(FEATURES, features):
        channels[name] = [*value] if name != "mask" else [value]
    channels = {name: [mi.Float(plane) + dr.zeros(mi.Float, paths) for plane in planes] for name, planes in channels.items()}
    # Evaluates all at once: otherwise each of the 16 sums would trace every path again.
    dr.eval(channels)
    sums = {name: [dr.block_sum(plane, count).numpy() for plane in planes] for name, planes in channels.items()}
    return {name: np.stack(planes, axis=-1).astype(np.float64) for name, planes in sums.items()}


@dr.syntax
def trace(scene, sampler, ray, clamp, follow):
    """Radiance and features of each ray: `(Color3f, (normal, position, albedo1, albedo2, mask))`.

    `follow` (`Bool`): mirrors and clear glass tint the albedo of what is behind them.
    """
    context = mi.BSDFContext()
    ray = mi.Ray3f(ray)
    radiance, seen, throughput = mi.Color3f(0), mi.Color3f(0), mi.Color3f(1)
    normal, position, albedo1, albedo2 = mi.Vector3f(0), mi.Vector3f(0), mi.Color3f(0), mi.Color3f(0)
    mask = mi.Float(0)
    depth, active = mi.UInt32(0), mi.Bool(True)
    surfaces = mi.UInt32(0)  # Vertices that have given an albedo.
    before = dr.zeros(mi.SurfaceInteraction3f)
    before_pdf, before_delta, eta = mi.Float(1), mi.Bool(True), mi.Float(1)

    while dr.hint(active, max_iterations=MAX_DEPTH + 1, label="path"):
        si = scene.ray_intersect(ray, ray_flags=mi.RayFlags.All, coherent=(depth == 0))
        bsdf = si.bsdf(ray)
        emitter = si.emitter(scene)

        # Emission of the vertex, weighted against sampling it as a light.
        direction = mi.DirectionSample3f(scene, si, before)
        light_pdf = mi.Float(0)
        if ~before_delta:
            light_pdf = scene.pdf_emitter_direction(before, direction, ~before_delta)
        emitted = throughput * emitter.eval(si, active) * power(before_pdf, light_pdf)
        seen = dr.select(depth == 0, emitted, seen)
        radiance = dr.select(depth == 0, radiance, radiance + emitted)

        going_on = active & (depth + 1 < MAX_DEPTH) & si.is_valid()
        flags = bsdf.flags()
        smooth = going_on & mi.has_flag(flags, mi.BSDFFlags.Smooth)

        # One light sample.
        light, light_weight = scene.sample_emitter_direction(si, sampler.next_2d(), True, smooth)
        smooth &= light.pdf != 0
        towards = si.to_local(light.d)
        value, pdf, sample, sample_weight = bsdf.eval_pdf_sample(
            context, si, towards, sampler.next_1d(going_on), sampler.next_2d(going_on)
        )
        light_mis = dr.select(light.delta, 1, power(light.pdf, pdf))
        radiance = dr.select(smooth, radiance + throughput * si.to_world_mueller(value, -towards, si.wi) * light_weight * light_mis, radiance)

        # Normal, position, and mask of the first vertex, albedo of two.
        if active & (depth == 0) & si.is_valid():
            normal = mi.Vector3f(dr.select(dr.dot(si.sh_frame.n, ray.d) > 0, -si.sh_frame.n, si.sh_frame.n))
            position = mi.Vector3f(si.p)
            mask = mi.Float(1)
        clear = follow & (surfaces == 0) & si.is_valid() & mi.has_flag(flags, mi.BSDFFlags.Delta)
        clear &= ~mi.has_flag(flags, mi.BSDFFlags.Smooth) & going_on
        if active & (surfaces < 2) & ~clear:
            first = surfaces == 0
            texture = albedo(bsdf, si, sample_weight, emitter, active)
            # Behind a mirror, a lamp may be brighter than any surface.
            behind = follow & first & (depth > 0)
            texture = dr.select(behind, throughput * texture, dr.minimum(1, texture))
            albedo1 = dr.select(first, texture, albedo1)
            albedo2 = dr.select(first, albedo2, texture)
            surfaces += 1

        # The next direction.
        ray = si.spawn_ray(si.to_world(sample.wo))
        throughput *= sample_weight
        eta *= sample.eta
        before, before_pdf = si, sample.pdf
        before_delta = mi.has_flag(sample.sampled_type, mi.BSDFFlags.Delta)

        strongest = dr.max(throughput) * eta * eta
        survival = dr.minimum(strongest, 0.95)
        roulette = depth + 1 >= ROULETTE_DEPTH
        throughput[roulette] = throughput * dr.rcp(dr.maximum(survival, 1e-6))
        active = going_on & (strongest > 0) & (~roulette | (sampler.next_1d() < survival))
        depth += 1

    finite = dr.isfinite(mi.luminance(radiance))
    radiance = dr.select(finite, radiance, 0)
    # Limits the brightness and keeps the hue.
    radiance *= dr.minimum(1, clamp / dr.maximum(dr.max(radiance), 1e-12))
    return radiance + seen, (normal, position, albedo1, albedo2, mask)


def power(a: mi.Float, b: mi.Float) -> mi.Float:
    """Weight of the technique with density `a` (power heuristic)."""
    a, b = a * a, b * b
    return dr.select(a > 0, a / (a + b), 0)


def albedo(bsdf, si, sample_weight, emitter, active):
    """Diffuse reflectance, or else the specular tint; emission of emitters and sky."""
    diffuse = bsdf.eval_diffuse_reflectance(si, active)
    tint = dr.clip(sample_weight, 0, 1)
    surface = dr.select(mi.has_flag(bsdf.flags(), mi.BSDFFlags.Diffuse), diffuse, tint)
    return dr.select(si.is_valid(), surface, 0) + emitter.eval(si, active)
