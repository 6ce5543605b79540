"""A Mitsuba scene under construction, and its materials."""

from __future__ import annotations

import numpy as np
from patterns import TEXTURE_SIDE, Rng, color, grain, pattern, sky
from variant import mi

RINGS, SEGMENTS = 40, 48
"""Resolution of a surface of revolution."""
METALS = ("Al", "Ag", "Au", "Cu", "Cr", "W")


def tiled(image: np.ndarray, times: float) -> dict:
    """A texture that repeats `times` times along either side of its surface."""
    transform = mi.ScalarTransform3f().scale([times, times])
    return {"type": "bitmap", "bitmap": mi.Bitmap(image.astype(np.float32)), "raw": True, "to_uv": transform}


def square_film(side: int) -> dict:
    """A film of `side` x `side` pixels with a box filter."""
    return {"type": "hdrfilm", "width": side, "height": side, "rfilter": {"type": "box"}}


def rgb(values) -> dict:
    """A colour, or radiance."""
    return {"type": "rgb", "value": [float(v) for v in values]}


def matt(paint: dict) -> dict:
    """A matt material, the same on both sides."""
    return {"type": "twosided", "bsdf": {"type": "diffuse", "reflectance": paint}}


def globe(at, radius: float, radiance) -> dict:
    """A glowing ball."""
    light = {"type": "area", "radiance": rgb(radiance)}
    return {"type": "sphere", "center": [float(v) for v in at], "radius": float(radius), "emitter": light}


class Stage:
    """Materials, and shapes made of them.

    A share `grained` of colours and patterns has a grain. Grains use the separate generator
    `grains`, so everything else is the same without them.
    """

    pattern = staticmethod(pattern)
    grain = staticmethod(grain)
    sky = staticmethod(sky)

    def __init__(self, rng: Rng, grained: float = 0.0, grains: Rng | None = None) -> None:
        self.rng, self.grained, self.grains = rng, grained, grains
        self.scene: dict = {"type": "scene"}
        self.palette = [color(rng) for _ in range(6)]
        self.materials = [self.material() for _ in range(rng.integers(6, 14))]

    # Materials.

    def tint(self) -> list[float]:
        """A colour of the palette or a random one."""
        return self.palette[self.rng.integers(len(self.palette))] if self.rng.random() < 0.7 else color(self.rng)

    def paint(self) -> dict:
        """A colour, or a pattern of two colours."""
        grained = self.grains is not None and self.grains.random() < self.grained
        if self.rng.random() < 0.45:
            tint = self.tint()
            if not grained:
                return {"type": "rgb", "value": tint}
            image = np.full((TEXTURE_SIDE, TEXTURE_SIDE, 3), tint)
            scale = float(np.exp(self.grains.uniform(np.log(0.5), np.log(3))))
        else:
            image = self.pattern(self.rng, np.array(self.tint()), np.array(self.tint()))
            scale = float(np.exp(self.rng.uniform(np.log(0.7), np.log(6))))
        if grained:
            image = np.clip(image * self.grain(self.grains), 0.005, 0.95)
        return tiled(image, scale)

    def material(self, plain: bool = False) -> dict:
        rng = self.rng
        kind = 0.0 if plain else rng.random()
        roughness = float(rng.uniform(0.05, 0.5))
        if kind < 0.62:
            surface = {"type": "diffuse", "reflectance": self.paint()}
        elif kind < 0.84:
            surface = {"type": "roughplastic", "diffuse_reflectance": self.paint(), "alpha": roughness, "nonlinear": True}
        elif kind < 0.93:
            surface = {"type": "roughconductor", "material": str(rng.choice(METALS)), "alpha": roughness}
        elif kind < 0.96:
            surface = {"type": "conductor", "material": str(rng.choice(METALS))}
        else:
            return {"type": "dielectric"}
        return {"type": "twosided", "bsdf": surface}

    def any_material(self) -> dict:
        return self.materials[self.rng.integers(len(self.materials))]

    # Light.

    def add_sun(self, elevation: float, azimuth: float, irradiance) -> None:
        """A sun in this direction, in radians: hard shadows."""
        towards = [np.cos(elevation) * np.cos(azimuth), np.cos(elevation) * np.sin(azimuth), np.sin(elevation)]
        away = [-float(v) for v in towards]
        self.scene["sun"] = {"type": "directional", "direction": away, "irradiance": rgb(irradiance)}

    # Shapes.

    def add(self, shape: dict, bsdf: dict | None = None) -> None:
        if bsdf is not None:
            shape["bsdf"] = bsdf
        self.scene[f"shape{len(self.scene)}"] = shape

    def box(self, low, high, bsdf: dict, place: mi.ScalarTransform4f | None = None) -> None:
        low, high = np.asarray(low, float), np.asarray(high, float)
        to_world = (place or mi.ScalarTransform4f()).translate(((low + high) / 2).tolist()).scale(((high - low) / 2).tolist())
        self.add({"type": "cube", "to_world": to_world}, bsdf)

    def rod(self, start, end, radius: float, bsdf: dict, place: mi.ScalarTransform4f | None = None) -> None:
        p0, p1 = ([float(v) for v in p] for p in (start, end))
        self.add({"type": "cylinder", "p0": p0, "p1": p1, "radius": float(radius), "to_world": place or mi.ScalarTransform4f()}, bsdf)

    def ball(self, center, radius: float, bsdf: dict, place: mi.ScalarTransform4f | None = None) -> None:
        shape = {"type": "sphere", "center": [float(v) for v in center], "radius": float(radius)}
        self.add(shape | {"to_world": place or mi.ScalarTransform4f()}, bsdf)

    def turned(self, radius: np.ndarray, z: np.ndarray, place) -> None:
        """The surface of revolution of a profile around z."""
        angle = np.linspace(0, 2 * np.pi, SEGMENTS + 1)
        points = np.stack(
            [
                np.outer(radius, np.cos(angle)),
                np.outer(radius, np.sin(angle)),
                np.outer(z, np.ones_like(angle)),
            ],
            axis=-1,
        )
        v, u = np.meshgrid(np.linspace(0, 1, len(z)), np.linspace(0, 2, SEGMENTS + 1), indexing="ij")
        row, column = np.meshgrid(np.arange(len(z) - 1), np.arange(SEGMENTS), indexing="ij")
        a = (row * (SEGMENTS + 1) + column).ravel()
        b, c, d = a + 1, a + SEGMENTS + 1, a + SEGMENTS + 2
        faces = np.concatenate([np.stack([a, b, d], -1), np.stack([a, d, c], -1)])
        matrix = np.array(place.matrix, float)
        world = points.reshape(-1, 3) @ matrix[:3, :3].T + matrix[:3, 3]
        self.mesh(world, faces, self.any_material(), np.stack([u, v], -1).reshape(-1, 2))

    def mesh(self, points: np.ndarray, faces: np.ndarray, bsdf: dict, uv: np.ndarray | None = None) -> None:
        """Triangles `[N, 3]` between points `[M, 3]`, with texture coordinates `[M, 2]`."""
        properties = mi.Properties()
        properties["bsdf"] = mi.load_dict(bsdf)
        mesh = mi.Mesh("mesh", len(points), len(faces), has_vertex_texcoords=uv is not None, props=properties)
        parameters = mi.traverse(mesh)
        parameters["vertex_positions"] = mi.Float(points.ravel().astype(np.float32))
        if uv is not None:
            parameters["vertex_texcoords"] = mi.Float(uv.ravel().astype(np.float32))
        parameters["faces"] = mi.UInt32(faces.ravel().astype(np.uint32))
        parameters.update()
        self.scene[f"shape{len(self.scene)}"] = mesh
