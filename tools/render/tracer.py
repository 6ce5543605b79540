"""A path tracer on Mitsuba 3 that returns colour and the twelve feature channels (Sec. 3.1).

Features are normal, position, and albedo at a path's first vertex, and albedo at its second.
Mitsuba's own `aov` integrator has no second vertex. Emitters and BSDFs are sampled and weighted by
the power heuristic; Russian roulette starts at the third vertex.

With `passes` it also returns what NFOR (Bitterli et al. 2016) and KPCN (Bako et al. 2017) need:
depth, the diffuse and the specular part of the colour, and the variance of each buffer.
"""

from __future__ import annotations

from dataclasses import dataclass, field

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
VARIANCES = ("color", "normal", "albedo1", "depth", "diffuse", "specular")
"""Buffers whose variance is measured with `passes`."""


@dataclass
class Samples:
    """Sums over the samples of each pixel, `[H, W, C]` float64. Dividing by `count` gives means."""

    color: np.ndarray
    features: dict[str, np.ndarray]
    """Of `FEATURES`; with `passes` also `depth`, `diffuse`, and `specular`."""
    count: int
    squares: dict[str, np.ndarray] = field(default_factory=dict)
    """Sums of squares of `VARIANCES`, with `passes`."""

    def plus(self, other: Samples | None) -> Samples:
        """The sums over the samples of both."""
        if other is None:
            return self
        both = lambda own, others: {name: planes + others[name] for name, planes in own.items()}
        return Samples(
            self.color + other.color,
            both(self.features, other.features),
            self.count + other.count,
            both(self.squares, other.squares),
        )

    def mean(self, name: str) -> np.ndarray:
        """The mean of colour or a feature."""
        return (self.color if name == "color" else self.features[name]) / self.count

    def variance(self, name: str) -> np.ndarray:
        """The variance of that mean, from the sample variance; needs `passes` and two samples."""
        spread = self.squares[name] / self.count - self.mean(name) ** 2
        return np.maximum(spread, 0) / (self.count - 1)


def render(
    scene: mi.Scene,
    samples: int,
    seed: int,
    clamp: float = np.inf,
    view: int = 0,
    follow: bool = False,
    passes: bool = False,
    motion: np.ndarray | None = None,
) -> Samples:
    """Traces `samples` paths per pixel of sensor number `view`: box filter, independent sampler.

    `clamp` limits the radiance of a sample, without emitters seen directly. With `follow`, albedo is that of
    the first surface behind mirrors and clear glass, as Blender Cycles and LuxCore write it. `motion` is the way
    of the camera during the exposure, `[3]` in scene units.
    """
    sensor = scene.sensors()[view]
    width, height = (int(side) for side in sensor.film().crop_size())
    at_once = max(1, min(samples, LARGEST_WAVEFRONT // (width * height)))
    sums, done = None, 0
    while done < samples:
        count = min(at_once, samples - done)
        traced = trace_pixels(scene, sensor, count, seed + done, clamp, follow, passes, motion)
        sums = traced if sums is None else {name: sums[name] + traced[name] for name in sums}
        done += count
    shaped = {name: plane.reshape(height, width, -1) for name, plane in sums.items()}
    squares = {name: shaped.pop(f"{name}^2") for name in VARIANCES if passes}
    return Samples(shaped.pop("color"), shaped, samples, squares)


def trace_pixels(
    scene, sensor, count: int, seed: int, clamp: float, follow: bool, passes: bool, motion: np.ndarray | None
) -> dict[str, np.ndarray]:
    """Sums over `count` paths of each pixel, `[H * W, C]` float64; `NAME^2` is the sum of squares."""
    width, height = (int(side) for side in sensor.film().crop_size())
    paths = width * height * count
    sampler = mi.load_dict({"type": "independent"})
    # Mitsuba hashes seed and index: neighbouring seeds are not correlated.
    sampler.seed(seed % (1 << 32), paths)
    # Opaque: one compiled kernel for any number of samples.
    pixel = dr.arange(mi.UInt32, paths) // dr.opaque(mi.UInt32, count)
    corner = mi.Point2f(mi.Float(pixel % width), mi.Float(pixel // width))
    film = (corner + sampler.next_2d()) / mi.ScalarPoint2f(width, height)
    ray, weight = sensor.sample_ray(0.0, sampler.next_1d(), film, sampler.next_2d())
    if motion is not None:
        # In the middle of the exposure, the camera is where the scene puts it.
        way = mi.Vector3f(*(dr.opaque(mi.Float, float(part)) for part in motion))
        ray.o += way * (sampler.next_1d() - 0.5)
    limit = dr.opaque(mi.Float, min(clamp, 1e30))
    color, features, (depth, diffuse) = trace(scene, sampler, ray, limit, dr.opaque(mi.Bool, follow), passes)

    values = {"color": color * weight} | dict(zip(FEATURES, features))
    if passes:
        values |= {"depth": depth, "diffuse": diffuse * weight, "specular": (color - diffuse) * weight}
    channels = {name: [*value] if name not in ("mask", "depth") else [value] for name, value in values.items()}
    if passes:
        channels |= {f"{name}^2": [plane * plane for plane in channels[name]] for name in VARIANCES}
    channels = {name: [mi.Float(plane) + dr.zeros(mi.Float, paths) for plane in planes] for name, planes in channels.items()}
    # Evaluates all at once: otherwise each of the sums would trace every path again.
    dr.eval(channels)
    sums = {name: [dr.block_sum(plane, count).numpy() for plane in planes] for name, planes in channels.items()}
    return {name: np.stack(planes, axis=-1).astype(np.float64) for name, planes in sums.items()}


@dr.syntax
def trace(scene, sampler, ray, clamp, follow, passes):
    """Radiance, features, and passes of each ray: `(Color3f, (normal, position, albedo1, albedo2, mask), (depth, diffuse))`.

    `follow` (`Bool`): mirrors and clear glass tint the albedo of what is behind them. Depth is the distance of
    the first vertex. The diffuse part of the radiance is scattered by the diffuse lobe of the first vertex, or
    emitted there. Without `passes` (`bool`), both are 0.
    """
    context, diffuse_lobe = mi.BSDFContext(), mi.BSDFContext()
    diffuse_lobe.type_mask = mi.BSDFFlags.Diffuse
    ray = mi.Ray3f(ray)
    radiance, seen, throughput = mi.Color3f(0), mi.Color3f(0), mi.Color3f(1)
    normal, position, albedo1, albedo2 = mi.Vector3f(0), mi.Vector3f(0), mi.Color3f(0), mi.Color3f(0)
    mask = mi.Float(0)
    distance, diffuse, share = mi.Float(0), mi.Color3f(0), mi.Color3f(0)
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
        diffuse = dr.select(depth == 0, diffuse, diffuse + share * emitted)

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
        lit = throughput * si.to_world_mueller(value, -towards, si.wi) * light_weight * light_mis
        radiance = dr.select(smooth, radiance + lit, radiance)
        if dr.hint(passes, mode="scalar"):
            reflectance = bsdf.eval_diffuse_reflectance(si, active & (depth == 0)) * dr.inv_pi
            # Some BSDFs, such as `principled`, ignore the choice of a lobe.
            lobe = lambda direction, wanted: dr.minimum(
                bsdf.eval(diffuse_lobe, si, direction, wanted & (depth == 0)), reflectance * dr.abs(direction.z)
            )
            first_lit = lit * part(lobe(towards, smooth), value)
            diffuse = dr.select(smooth, diffuse + dr.select(depth == 0, first_lit, share * lit), diffuse)
            if active & (depth == 0) & si.is_valid():
                distance = mi.Float(si.t)
                delta = mi.has_flag(sample.sampled_type, mi.BSDFFlags.Delta)
                share = dr.select(delta, 0, part(lobe(sample.wo, ~delta), bsdf.eval(context, si, sample.wo, ~delta)))

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
    limited = dr.minimum(1, clamp / dr.maximum(dr.max(radiance), 1e-12))
    diffuse = dr.select(finite & passes, diffuse * limited + seen, 0)
    return radiance * limited + seen, (normal, position, albedo1, albedo2, mask), (distance, diffuse)


def part(lobe: mi.Color3f, whole: mi.Color3f) -> mi.Color3f:
    """Share of one lobe in the value of a BSDF, 0 to 1."""
    return dr.select(whole > 0, dr.clip(lobe / whole, 0, 1), 0)


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
