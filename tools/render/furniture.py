"""Furniture and things on it, made of boxes, rods, and balls; z is up."""

from __future__ import annotations

import numpy as np
from stage import Stage, matt
from variant import mi


class Furnished(Stage):
    """A stage that can be furnished."""

    def table(self, place, small: bool = False) -> None:
        rng, wood = self.rng, self.any_material()
        w, d, h = rng.uniform(0.3, 0.45 if small else 1.0), rng.uniform(0.25, 0.35 if small else 0.6), rng.uniform(0.4, 0.8)
        self.box([-w, -d, h - 0.03], [w, d, h], wood, place)
        legs = self.any_material() if rng.random() < 0.4 else wood
        for sx in (-1, 1):
            for sy in (-1, 1):
                foot = [sx * (w - 0.05), sy * (d - 0.05)]
                self.rod([*foot, 0], [*foot, h - 0.03], rng.uniform(0.015, 0.04), legs, place)
        for _ in range(rng.integers(0, 3 if small else 9)):
            self.thing(place.translate([float(rng.uniform(-0.8, 0.8) * w), float(rng.uniform(-0.8, 0.8) * d), float(h)]))

    def chair(self, place) -> None:
        rng, wood = self.rng, self.any_material()
        w, h, back = 0.22, rng.uniform(0.4, 0.5), rng.uniform(0.8, 1.1)
        self.box([-w, -w, h - 0.04], [w, w, h], self.any_material() if rng.random() < 0.5 else wood, place)
        for sx in (-1, 1):
            self.rod([sx * (w - 0.03), w - 0.03, 0], [sx * (w - 0.03), w - 0.03, h], 0.018, wood, place)
            self.rod([sx * (w - 0.03), -w + 0.03, 0], [sx * (w - 0.03), -w + 0.03, back], 0.018, wood, place)
        if rng.random() < 0.5:
            for z in np.linspace(h + 0.12, back - 0.02, rng.integers(2, 5)):
                self.box([-w, -w + 0.01, z - 0.03], [w, -w + 0.04, z + 0.03], wood, place)
        else:
            for x in np.linspace(-w + 0.06, w - 0.06, rng.integers(3, 7)):
                self.rod([x, -w + 0.03, h], [x, -w + 0.03, back], 0.01, wood, place)
            self.box([-w, -w + 0.01, back - 0.05], [w, -w + 0.05, back], wood, place)

    def shelf(self, place) -> None:
        rng, wood = self.rng, self.any_material()
        w, d, h = rng.uniform(0.3, 0.8), 0.16, rng.uniform(0.8, 2.1)
        boards = int(rng.integers(3, 7))
        for sx in (-w, w):
            self.box([sx - 0.015, -d, 0], [sx + 0.015, d, h], wood, place)
        for z in np.linspace(0.05, h, boards):
            self.box([-w, -d, z - 0.012], [w, d, z + 0.012], wood, place)
        if rng.random() < 0.7:
            self.box([-w, -d - 0.01, 0], [w, -d, h], wood, place)
        gap = (h - 0.05) / (boards - 1)
        for z in np.linspace(0.05, h, boards)[:-1]:
            x = -w + 0.03
            while x < w - 0.1 and rng.random() < 0.93:
                thick = rng.uniform(0.02, 0.07)
                self.box([x, -d + 0.02, z + 0.012], [x + thick, rng.uniform(0, d), z + gap * rng.uniform(0.5, 0.9)], self.any_material(), place)
                x += thick + (rng.uniform(0, 0.15) if rng.random() < 0.2 else 0.002)

    def sofa(self, place) -> None:
        rng, cloth = self.rng, self.any_material()
        w = rng.uniform(0.4, 1.1)
        self.box([-w, -0.4, 0.12], [w, 0.4, 0.42], cloth, place)
        self.box([-w, -0.45, 0.12], [w, -0.25, 0.85], cloth, place)
        for sx in (-w - 0.08, w + 0.08):
            self.box([sx - 0.09, -0.45, 0.05], [sx + 0.09, 0.4, 0.6], cloth, place)
        for _ in range(rng.integers(0, 4)):
            leaning = place.translate([float(rng.uniform(-w, w) * 0.8), -0.15, 0.58]).rotate([1, 0, 0], 20).rotate([0, 1, 0], float(rng.uniform(-20, 20)))
            self.box([-0.18, -0.06, -0.16], [0.18, 0.06, 0.16], self.any_material(), leaning)

    def heap(self, place) -> None:
        """Stacked boxes."""
        rng, z = self.rng, 0.0
        side = rng.uniform(0.2, 0.6)
        for _ in range(rng.integers(1, 5)):
            h = rng.uniform(0.08, 0.5)
            turned = place.rotate([0, 0, 1], float(rng.normal(0, 15)))
            self.box([-side, -side * 0.7, z], [side, side * 0.7, z + h], self.any_material(), turned)
            z, side = z + h, side * rng.uniform(0.6, 1)
        self.thing(place.translate([0, 0, z]))

    def plant(self, place) -> None:
        rng = self.rng
        green = [float(v) for v in rng.uniform([0.03, 0.15, 0.02], [0.3, 0.5, 0.15])]
        leaf = matt({"type": "rgb", "value": green})
        h, r = rng.uniform(0.2, 0.5), rng.uniform(0.1, 0.22)
        self.rod([0, 0, 0], [0, 0, h], r, self.any_material(), place)
        self.add({"type": "disk", "to_world": place.translate([0, 0, float(h)]).scale([float(r), float(r), 1])}, self.any_material())
        for _ in range(rng.integers(20, 70)):
            out = place.translate([0, 0, float(h)]).rotate([0, 0, 1], float(rng.uniform(0, 360))).rotate([0, 1, 0], float(rng.uniform(-80, 10)))
            length, width = float(rng.uniform(0.1, 0.35)), float(rng.uniform(0.02, 0.07))
            self.add({"type": "rectangle", "to_world": out.translate([length * 1.3, 0, 0]).rotate([1, 0, 0], float(rng.uniform(-40, 40))).scale([length, width, 1])}, leaf)

    def rug(self, place) -> None:
        w, d = self.rng.uniform(0.5, 1.6, 2)
        self.box([-w, -d, 0], [w, d, 0.012], self.material(plain=True), place)

    def thing(self, place) -> None:
        """A small object on a table."""
        rng, bsdf, kind = self.rng, self.any_material(), self.rng.integers(5)
        r, h = rng.uniform(0.03, 0.1), rng.uniform(0.06, 0.3)
        if kind == 0:
            self.ball([0, 0, r], r, bsdf, place)
        elif kind == 1:
            self.rod([0, 0, 0], [0, 0, h], r * 0.6, bsdf, place)
        elif kind == 2:
            self.box([-r, -r * 1.4, 0], [r, r * 1.4, h * 0.3], bsdf, place.rotate([0, 0, 1], float(rng.uniform(0, 90))))
        elif kind == 3:
            self.ball([0, 0, r], r, bsdf, place)
            self.rod([0, 0, r], [0, 0, r + h], r * 0.25, bsdf, place)
        else:
            for i in range(rng.integers(2, 6)):
                self.box([-r, -r * 1.3, i * 0.025], [r, r * 1.3, i * 0.025 + 0.022], self.any_material(), place.rotate([0, 0, 1], float(rng.normal(0, 20))))
