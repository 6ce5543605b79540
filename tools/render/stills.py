"""Random still lifes: things on a table or furniture on a square, under the sky, mostly with defocus.

Lengths are in metres, z is up, and the things stand around the origin at z = 0.
"""

from __future__ import annotations

import numpy as np
from furniture import Furnished
from patterns import Rng, studio
from stage import RINGS, matt, square_film, tiled
from variant import mi


class Still(Furnished):
    """One still life."""

    studio = staticmethod(studio)

    def __init__(self, rng: Rng, grained: float = 0.0, grains: Rng | None = None) -> None:
        super().__init__(rng, grained, grains)
        self.square = rng.random() < 0.4
        self.reach = float(rng.uniform(1.5, 5) if self.square else rng.uniform(0.2, 0.6))
        """Largest distance of a thing from the origin."""
        self.walled = rng.random() < (0.2 if self.square else 0.4)
        self.ground()
        self.scene["sky"] = self.sky(rng, 1.0, skyline=rng.random() < 0.6)
        self.arrange()

    def darken(self, rng: Rng) -> None:
        """Replaces the sky by lamps in a black studio."""
        self.scene["sky"] = self.studio(rng)

    def surface(self, side: float) -> dict:
        """A material for `side` metres of floor.

        Texels of its pattern measure millimetres on a table and centimetres on a square.
        """
        rng = self.rng
        image = self.pattern(rng, np.array(self.tint()), np.array(self.tint()))
        if rng.random() < 0.75:
            image = np.clip(image * self.grain(rng), 0.005, 0.95)
        tile = self.reach * np.exp(rng.uniform(np.log(0.4), np.log(3)))
        paint = tiled(image, float(side / tile))
        if rng.random() < 0.6:
            return matt(paint)
        gloss = {"type": "roughplastic", "diffuse_reflectance": paint, "alpha": float(rng.uniform(0.1, 0.5)), "nonlinear": True}
        return {"type": "twosided", "bsdf": gloss}

    def ground(self) -> None:
        """A table top or a square, and in some scenes a wall behind it."""
        rng = self.rng
        half = self.reach * float(rng.uniform(3, 8) if self.square else rng.choice([rng.uniform(1.2, 2), rng.uniform(3, 6)]))
        flat = mi.ScalarTransform4f().scale([half, half, 1])
        self.add({"type": "rectangle", "to_world": flat}, self.surface(2 * half))
        self.box([-half, -half, -0.05 * self.reach - 0.02], [half, half, -1e-3], self.any_material())
        if self.walled:
            behind = self.reach * float(rng.uniform(1.3, 2.5))
            upright = mi.ScalarTransform4f().translate([0, behind, half]).rotate([1, 0, 0], 90).scale([half, half, 1])
            self.add({"type": "rectangle", "to_world": upright}, self.surface(2 * half))

    def arrange(self) -> None:
        rng = self.rng
        pieces = self.pieces()
        for _ in range(rng.integers(4, 16)):
            angle, out = rng.uniform(0, 2 * np.pi), self.reach * np.sqrt(rng.random())
            place = mi.ScalarTransform4f().translate([float(out * np.cos(angle)), float(out * np.sin(angle)), 0])
            place = place.rotate([0, 0, 1], float(rng.uniform(0, 360)))
            if self.square:
                pieces[rng.integers(len(pieces))](place)
            else:
                # Some furniture is toy-sized.
                kind = rng.random()
                small = float(rng.uniform(0.1, 0.25))
                if kind < 0.4:
                    self.vase(place)
                elif kind < 0.85:
                    self.thing(place)
                else:
                    pieces[rng.integers(4)](place.scale([small] * 3))

    def pieces(self) -> list:
        """Things on a square. The first four also stand on tables, toy-sized."""
        return [self.chair, self.table, self.sofa, self.heap, self.plant, self.shelf, self.bollard, self.bollard, self.vase]

    def bollard(self, place) -> None:
        rng = self.rng
        radius, height = rng.uniform(0.02, 0.2), rng.uniform(0.4, 2.5)
        self.rod([0, 0, 0], [0, 0, height], radius, self.any_material(), place)
        self.ball([0, 0, height], radius * rng.uniform(1, 1.6), self.any_material(), place)

    def vase(self, place) -> None:
        """A surface of revolution: bottles, bowls, pawns."""
        rng = self.rng
        height = self.reach * float(np.exp(rng.uniform(np.log(0.15), np.log(0.7))))
        width = height * float(rng.uniform(0.15, 0.6))
        knots = rng.uniform(0.15, 1, rng.integers(3, 8))
        t = np.linspace(0, 1, RINGS)
        # Cosine interpolation between the knots; both ends are closed.
        at = t * (len(knots) - 1)
        low = np.minimum(at.astype(int), len(knots) - 2)
        share = (1 - np.cos(np.pi * (at - low))) / 2
        radius = width * (knots[low] * (1 - share) + knots[low + 1] * share)
        z = height * t
        radius, z = np.concatenate([[0], radius, [0]]), np.concatenate([[0], z, [height]])
        self.turned(radius, z, place)

    def camera(self, rng: Rng, side: int) -> dict:
        """A view from above; two of three have a thin lens."""
        elevation = np.radians(rng.uniform(4, 30) if self.square else rng.uniform(10, 55))
        # In front of the wall, if any.
        azimuth = np.radians(rng.uniform(-150, -30)) if self.walled else rng.uniform(0, 2 * np.pi)
        distance = self.reach * rng.uniform(1.2, 3)
        eye = distance * np.array([np.cos(elevation) * np.cos(azimuth), np.cos(elevation) * np.sin(azimuth), np.sin(elevation)])
        target = rng.normal(0, 0.25, 3) * self.reach * [1, 1, 0.3] + [0, 0, 0.1 * self.reach]
        lens = {"type": "perspective"}
        if rng.random() < 0.65:
            aperture = distance * np.exp(rng.uniform(np.log(0.003), np.log(0.03)))
            lens = {"type": "thinlens", "aperture_radius": float(aperture), "focus_distance": float(distance * rng.uniform(0.8, 1.2))}
        return lens | {
            "fov": float(rng.uniform(25, 55)),
            "near_clip": 0.001,
            "to_world": mi.ScalarTransform4f().look_at(eye.tolist(), target.tolist(), [0, 0, 1]),
            "film": square_film(side),
        }
