"""Random furnished rooms, lit through windows or by lamps.

Lengths are in metres, z is up, the floor is at z = 0, and the room's corner is the origin.
"""

from __future__ import annotations

import numpy as np
from furniture import Furnished
from patterns import Rng, mosaic
from stage import globe, matt, rgb, square_film
from variant import mi


class Room(Furnished):
    """One room."""

    picture = staticmethod(mosaic)

    def __init__(self, rng: Rng, grained: float = 0.0, grains: Rng | None = None) -> None:
        self.size = np.array([rng.uniform(3, 9), rng.uniform(3, 9), rng.uniform(2.3, 3.8)])
        super().__init__(rng, grained, grains)
        self.targets: list[np.ndarray] = []
        self.frames: list[dict] = []
        """Materials of bars, blinds, and curtains."""
        self.open_sides: list[int] = []
        """Numbers of the walls with windows; 0 is the wall along the x axis."""

        windows = rng.random() < 0.75
        self.shell(windows)
        self.scene["sky"] = self.sky(rng, 1.0 if windows else 0.2)
        if not windows or rng.random() < 0.35:
            self.lamps()
        self.furnish()

    # The shell.

    def shell(self, windows: bool) -> None:
        """Floor, ceiling, and four walls; with `windows`, one to three of them have windows."""
        rng, (x, y, z) = self.rng, self.size
        self.box([0, 0, -0.1], [x, y, 0], self.material())
        self.ceiling(matt({"type": "rgb", "value": float(rng.uniform(0.5, 0.9))}))
        wall, other = self.material(plain=True), self.material(plain=True)
        self.open_sides = rng.choice(4, rng.choice([1, 1, 2, 3]), replace=False).tolist() if windows else []
        for side in range(4):
            length = x if side % 2 == 0 else y
            turned = mi.ScalarTransform4f()
            # In its own coordinates a wall lies along x, with the room on the +y side.
            corner = [(0, 0), (x, 0), (x, y), (0, y)][side]
            turned = turned.translate([corner[0], corner[1], 0]).rotate([0, 0, 1], 90 * side)
            bsdf = wall if rng.random() < 0.7 else other
            if side in self.open_sides:
                self.windows(length, z, bsdf, turned)
            else:
                self.box([0, -0.1, 0], [length, 0, z], bsdf, turned)
                if rng.random() < 0.6:
                    self.pictures(length, z, turned)

    def ceiling(self, bsdf: dict) -> None:
        x, y, z = self.size
        self.box([0, 0, z], [x, y, z + 0.1], bsdf)

    def windows(self, length: float, height: float, wall: dict, place) -> None:
        """A wall with windows: the wall around them, and blinds, bars, or curtains."""
        rng = self.rng
        most = max(1, int(length / 1.3))
        count = int(rng.integers((most + 1) // 2, most + 1))
        sill = float(rng.choice([0.0, rng.uniform(0.3, 1.2)]))
        top = float(rng.uniform(max(sill + 0.7, 0.6 * height), height - 0.1))
        width = float(length / count * rng.uniform(0.4, 0.9))
        frame = self.any_material()
        self.frames.append(frame)
        if sill:
            self.box([0, -0.1, 0], [length, 0, sill], wall, place)
        self.box([0, -0.1, top], [length, 0, height], wall, place)
        style = rng.choice(["none", "bars", "blinds", "curtains"], p=[0.25, 0.35, 0.25, 0.15])
        pitch, tilt = rng.uniform(0.05, 0.16), float(rng.uniform(-60, 60))
        edge = 0.0
        for i in range(count):
            left = (i + 0.5) * length / count - width / 2
            self.box([edge, -0.1, sill], [left, 0, top], wall, place)
            edge = left + width
            if style == "bars":
                for x in np.linspace(left, edge, rng.integers(2, 6)):
                    self.box([x - 0.02, -0.08, sill], [x + 0.02, -0.03, top], frame, place)
                for z in np.linspace(sill, top, rng.integers(2, 6)):
                    self.box([left, -0.08, z - 0.02], [edge, -0.03, z + 0.02], frame, place)
            elif style == "blinds":
                for z in np.arange(sill, top, pitch):
                    slat = place.translate([(left + edge) / 2, 0.05, z]).rotate([1, 0, 0], tilt)
                    self.box([-width / 2, -pitch / 2, -0.003], [width / 2, pitch / 2, 0.003], frame, slat)
            elif style == "curtains":
                share = width * rng.uniform(0.1, 0.45)
                for start in (left - 0.1, edge + 0.1 - share):
                    for x in np.arange(start, start + share, 0.09):
                        self.rod([x, 0.08, max(0.02, sill - 0.3)], [x, 0.08, min(height, top + 0.2)], 0.05, frame, place)
        self.box([edge, -0.1, sill], [length, 0, top], wall, place)

    def pictures(self, length: float, height: float, place) -> None:
        rng = self.rng
        for _ in range(rng.integers(1, 4)):
            w, h = rng.uniform(0.3, 1.2), rng.uniform(0.3, 0.9)
            x, z = rng.uniform(0.2, max(0.3, length - w - 0.2)), rng.uniform(0.9, max(1.0, height - h - 0.3))
            image = self.picture(rng, [self.tint() for _ in range(5)])
            canvas = {"type": "bitmap", "bitmap": mi.Bitmap(image.astype(np.float32)), "raw": True}
            self.box([x - 0.04, 0, z - 0.04], [x + w + 0.04, 0.03, z + h + 0.04], self.any_material(), place)
            self.box([x, 0.03, z], [x + w, 0.035, z + h], matt(canvas), place)

    def lamps(self) -> None:
        """Ceiling panels, and hanging or standing globes."""
        rng, (x, y, z) = self.rng, self.size
        warm = np.array([1, rng.uniform(0.7, 1), rng.uniform(0.4, 1)])
        for _ in range(rng.integers(1, 5)):
            at = [float(rng.uniform(0.15, 0.85) * side) for side in (x, y)]
            power = float(np.exp(rng.uniform(np.log(3), np.log(60))))
            if rng.random() < 0.5:
                half = [float(v) for v in rng.uniform(0.05, 0.6, 2)]
                to_world = mi.ScalarTransform4f().translate([*at, float(z) - 0.02]).rotate([1, 0, 0], 180).scale([*half, 1])
                self.add({"type": "rectangle", "to_world": to_world, "emitter": {"type": "area", "radiance": rgb(warm * power)}})
            else:
                radius = float(rng.uniform(0.04, 0.15))
                height = float(rng.uniform(1.2, z - 0.2))
                self.add(globe([*at, height], radius, warm * power))
                hanging = rng.random() < 0.5
                self.rod([*at, height + radius if hanging else 0], [*at, z if hanging else height - radius], 0.015, self.any_material())

    def sun(self, rng: Rng) -> None:
        """A directional sun through a window, if the room has one: hard shadows of frames and blinds."""
        if not self.open_sides:
            return
        elevation = np.radians(rng.uniform(10, 55))
        # The outside of wall 0 is at -y.
        azimuth = np.radians(90 * (rng.choice(self.open_sides) - 1) + rng.uniform(-55, 55))
        power = np.exp(rng.uniform(np.log(2), np.log(60)))
        self.add_sun(elevation, azimuth, power * np.array([1, rng.uniform(0.75, 1), rng.uniform(0.5, 1)]))

    def blacken(self, rng: Rng) -> None:
        """Makes bars and blinds black, and everything else of their material.

        `color` yields no black, but real slats in front of a bright sky are often black.
        """
        black = matt({"type": "rgb", "value": float(rng.uniform(0, 0.02))})
        for shape in self.scene.values():
            if isinstance(shape, dict) and any(shape.get("bsdf") is frame for frame in self.frames):
                shape["bsdf"] = black

    # Furniture.

    def furnish(self) -> None:
        rng, (x, y, _) = self.rng, self.size
        pieces = self.pieces()
        rows = rng.random() < 0.3
        if rows:
            # A classroom or a restaurant: equal furniture in rows.
            pitch = rng.uniform(1.1, 2.0, 2)
            seed = int(rng.integers(1 << 31))
            kept, angle = self.rng, float(rng.choice([0, 90, 180, 270]))
            for px in np.arange(0.8, x - 0.6, pitch[0]):
                for py in np.arange(0.8, y - 0.6, pitch[1]):
                    self.rng = np.random.default_rng(seed)
                    place = mi.ScalarTransform4f().translate([float(px), float(py), 0]).rotate([0, 0, 1], angle)
                    self.desk(place)
                    self.targets.append(np.array([px, py, 0.6]))
            self.rng = kept
        for _ in range(rng.integers(3, 7) if rows else rng.integers(6, 16)):
            at = [float(rng.uniform(0.1, 0.9) * side) for side in (x, y)]
            angle = float(rng.choice([0, 90, 180, 270]) + rng.normal(0, 12))
            place = mi.ScalarTransform4f().translate([*at, 0]).rotate([0, 0, 1], angle)
            pieces[rng.integers(len(pieces))](place)
            self.targets.append(np.array([*at, rng.uniform(0.2, 1.2)]))

    def pieces(self) -> list:
        return [self.table, self.table, self.chair, self.chair, self.shelf, self.sofa, self.heap, self.plant, self.rug, self.post]

    def desk(self, place) -> None:
        """What stands in rows."""
        self.table(place, small=True)
        self.chair(place.translate([0, -0.5, 0]))

    def post(self, place) -> None:
        r = self.rng.uniform(0.03, 0.3)
        self.rod([0, 0, 0], [0, 0, self.size[2]], r, self.any_material(), place)

    # Views.

    def camera(self, rng: Rng, side: int) -> dict:
        """A view from inside, at a piece of furniture or across the room."""
        low, high = 0.12 * self.size, 0.88 * self.size
        low[2], high[2] = 0.7, min(2.1, self.size[2] - 0.3)
        eye = rng.uniform(low, high)
        close = rng.random() < 0.45 and self.targets
        target = self.targets[rng.integers(len(self.targets))] if close else rng.uniform([0, 0, 0.3], [*self.size[:2], 1.6])
        if np.linalg.norm(target - eye) < 1:
            target = self.size - eye
        return {
            "type": "perspective",
            "fov": float(rng.uniform(30, 60) if close else rng.uniform(50, 85)),
            "to_world": mi.ScalarTransform4f().look_at(eye.tolist(), target.tolist(), [0, 0, 1]),
            "film": square_film(side),
        }
