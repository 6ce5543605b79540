"""Rooms and still lifes of the held-out set (`--preset heldout`).

Training scenes never draw their furniture, textures, pictures, and lights. The rest is shared: plain
materials, the shape of rooms, and the cameras. `tests/test_render.py` compares the two.
"""

from __future__ import annotations

import numpy as np
from patterns import TEXTURE_SIDE, Rng, color, environment, noise
from rooms import Room
from stage import rgb
from stills import Still
from variant import mi

# Textures.


def coordinates() -> tuple[np.ndarray, np.ndarray]:
    """Columns and rows of a texture, from 0 to 1."""
    n = TEXTURE_SIDE
    y, x = np.mgrid[0:n, 0:n] / n
    return x, y


def hexagons(rng: Rng) -> np.ndarray:
    """Six-sided tiles with joints; every tile has its own shade."""
    x, y = coordinates()
    across, up = int(rng.integers(3, 10)), 2 * int(rng.integers(2, 6))
    # A grid of centres, and one shifted by half a tile. A pixel belongs to the nearest centre.
    best, second, number = np.full(x.shape, np.inf), np.full(x.shape, np.inf), np.zeros(x.shape, int)
    for shift in (0.0, 0.5):
        for dx in (0, 1):
            for dy in (0, 1):
                column, row = np.floor(x * across - shift) + dx, np.floor(y * up / 2 - shift) + dy
                distance = np.hypot(x * across - shift - column, (y * up / 2 - shift - row) * 0.9)
                tile = (7 * (column % across) + 13 * (row % (up // 2)) + 31 * (shift > 0)).astype(int) % 29
                nearer = distance < best
                second = np.where(nearer, best, np.minimum(second, distance))
                number = np.where(nearer, tile, number)
                best = np.minimum(best, distance)
    shade = rng.random(29)[number]
    return np.where(second - best < 0.06, 0.0, 0.25 + 0.75 * shade)


def herringbone(rng: Rng) -> np.ndarray:
    """Boards at right angles."""
    x, y = coordinates()
    count = 4 * int(rng.integers(2, 7))
    u, v = np.floor(x * count).astype(int), np.floor(y * count).astype(int)
    # Along each diagonal, two cells lie flat and two stand.
    phase = (u - v) % 4
    flat = phase < 2
    number = np.where(flat, (u - phase) * 5 + v * 3, u * 7 + (v - (3 - phase)) * 11) % 37
    fx, fy = (x * count) % 1, (y * count) % 1
    edge = np.where(flat, np.minimum(fy, 1 - fy), np.minimum(fx, 1 - fx))
    return np.where(edge < 0.06, 0.0, 0.2 + 0.8 * rng.random(37)[number])


def terrazzo(rng: Rng) -> np.ndarray:
    """Chips of stone in plaster."""
    x, y = coordinates()
    share = np.zeros(x.shape)
    for _ in range(int(rng.integers(60, 240))):
        cx, cy, size, angle, value = rng.random(), rng.random(), rng.uniform(0.008, 0.05), rng.uniform(0, np.pi), rng.uniform(0.3, 1)
        dx, dy = (x - cx + 0.5) % 1 - 0.5, (y - cy + 0.5) % 1 - 0.5
        a, b = dx * np.cos(angle) + dy * np.sin(angle), dy * np.cos(angle) - dx * np.sin(angle)
        share[np.abs(a) + 1.7 * np.abs(b) < size] = value
    return share


def scales(rng: Rng) -> np.ndarray:
    """Rows of overlapping half discs."""
    x, y = coordinates()
    count, share = 2 * int(rng.integers(3, 9)), np.zeros(x.shape)
    for row in range(-1, count + 1):
        dx = (x * count + 0.5 * (row % 2)) % 1 - 0.5
        dy = y * count - row
        inside = (dy >= 0) & (np.hypot(dx, dy * 0.6) < 0.55)
        share = np.where(inside, np.minimum(1, np.hypot(dx, dy * 0.6) * 1.8), share)
    return share


TEXTURES = (hexagons, herringbone, terrazzo, scales)


def reserved_pattern(rng: Rng, a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """A texture of two colours, `[256, 256, 3]`."""
    share = TEXTURES[rng.integers(len(TEXTURES))](rng)
    return np.clip(a + (b - a) * share[..., None], 0.01, 0.95)


def reserved_grain(rng: Rng) -> np.ndarray:
    """Grass, rust, or brushed metal: factors of a colour around 0.8, `[256, 256, 1]`."""
    n = TEXTURE_SIDE
    kind = rng.choice(["grass", "rust", "brushed"])
    if kind == "grass":
        blades = rng.random((n, n))
        for shift in range(1, int(rng.integers(4, 12))):
            blades = np.maximum(blades, np.roll(rng.random((n, n)), shift, 0) * (1 - shift / 14))
        factor = 0.25 + 0.8 * (blades - blades.min()) / np.ptp(blades)
    elif kind == "rust":
        spots = noise(rng, n, n, 6)
        factor = np.where(spots > np.quantile(spots, rng.uniform(0.4, 0.8)), 0.35, 1.0) * (0.7 + 0.5 * rng.random((n, n)))
    else:
        lines = np.repeat(rng.random((n, 1)), n, 1)
        factor = 0.5 + 0.6 * lines * (0.8 + 0.4 * noise(rng, n, n, 3))
    return factor[..., None]


def rings_picture(rng: Rng, colors: list) -> np.ndarray:
    """A picture of rings around two points."""
    x, y = coordinates()
    (ax, ay), (bx, by) = rng.random((2, 2))
    rings = np.hypot(x - ax, y - ay) * rng.uniform(4, 18) + np.hypot(x - bx, y - by) * rng.uniform(4, 18)
    return np.array(colors)[rings.astype(int) % len(colors)]


# Light from outside.


def dusk(rng: Rng, brightness: float, skyline: bool = False) -> dict:
    """An environment map without a sun: a glow at one side of the horizon, or lamps of a town if `skyline`."""
    height, width = 256, 512
    up = np.linspace(1, -1, height)[:, None]
    azimuth = np.abs(np.linspace(-1, 1, width)[None])
    glow = np.exp(-((up / rng.uniform(0.1, 0.4)) ** 2) - (azimuth / rng.uniform(0.2, 0.7)) ** 2)
    high, low = np.array([0.3, 0.45, 1.0]) * rng.uniform(0.15, 0.6), np.array([1.0, rng.uniform(0.3, 0.7), rng.uniform(0.1, 0.5)])
    image = high * np.maximum(up, 0.05)[..., None] + low * glow[..., None] * rng.uniform(1, 6)
    image = np.where(up[..., None] > 0, image, np.array(color(rng)) * 0.2)
    if skyline:
        for _ in range(int(rng.integers(40, 160))):
            row, column = int(height / 2 + rng.integers(-30, 6)), int(rng.integers(width))
            image[row, column] += np.array([1, rng.uniform(0.6, 1), rng.uniform(0.2, 0.9)]) * rng.uniform(3, 40)
    return environment(np.roll(image, int(rng.integers(width)), 1) * brightness * 4)


def softboxes(rng: Rng) -> dict:
    """An environment map with three upright strips of light, one of them coloured; grey elsewhere."""
    height, width = 256, 512
    image = np.full((height, width, 3), rng.uniform(0.01, 0.08))
    tint = rng.permutation([1.0, rng.uniform(0.2, 0.7), rng.uniform(0.1, 0.4)])
    for number in range(3):
        left, wide = int(rng.integers(width)), int(rng.integers(8, 50))
        columns = np.arange(left, left + wide) % width
        power = rng.uniform(300, 900) / wide / 3
        image[int(rng.integers(10, 50)) : int(rng.integers(90, 125)), columns] += power * (tint if number == 0 else 1)
    return environment(image)


# Furniture.


class Reserved:
    """Furniture of the held-out set, for a `Furnished` stage."""

    pattern = staticmethod(reserved_pattern)
    grain = staticmethod(reserved_grain)
    sky = staticmethod(dusk)

    def bed(self, place) -> None:
        rng, wood = self.rng, self.any_material()
        w, length = rng.uniform(0.45, 0.95), 1.0
        self.box([-w, -length, 0.2], [w, length, 0.32], wood, place)
        self.box([-w + 0.03, -length + 0.03, 0.32], [w - 0.03, length - 0.03, 0.5], self.any_material(), place)
        self.box([-w, length, 0], [w, length + 0.05, rng.uniform(0.7, 1.3)], wood, place)
        blanket = rng.uniform(-0.2, 0.5)
        self.box([-w - 0.02, -length - 0.02, 0.48], [w + 0.02, blanket, 0.54], self.any_material(), place)
        for side in (-0.5, 0.5):
            self.ball([side * w, length * 0.75, 0.5], 0.17, self.any_material(), place)

    def wardrobe(self, place) -> None:
        rng, wood = self.rng, self.any_material()
        w, h, doors = rng.uniform(0.4, 0.9), rng.uniform(1.6, 2.2), int(rng.integers(2, 5))
        self.box([-w, -0.3, 0], [w, 0.3, h], wood, place)
        front = self.any_material()
        for door in range(doors):
            left, right = (-w + 2 * w * (door + side) / doors for side in (0.04, 0.96))
            self.box([left, 0.3, 0.06], [right, 0.32, h - 0.06], front, place)
            self.ball([right - 0.05, 0.34, h / 2], 0.02, self.any_material(), place)

    def stairs(self, place) -> None:
        rng, stone = self.rng, self.any_material()
        w, steps = rng.uniform(0.3, 0.7), int(rng.integers(3, 11))
        for step in range(steps):
            self.box([-w, 0.26 * step - 0.6, 0], [w, 0.26 * (step + 1) - 0.6, 0.17 * (step + 1)], stone, place)
        rail = self.any_material()
        self.rod([w, -0.6, 0.9], [w, 0.26 * steps - 0.6, 0.9 + 0.17 * steps], 0.025, rail, place)
        for step in range(steps):
            y = 0.26 * step - 0.47
            self.rod([w, y, 0.17 * step], [w, y, 0.98 + 0.17 * step], 0.012, rail, place)

    def bench(self, place) -> None:
        rng, wood = self.rng, self.any_material()
        w = rng.uniform(0.6, 1.2)
        for slat in range(5):
            self.box([-w, -0.25 + 0.1 * slat, 0.42], [w, -0.18 + 0.1 * slat, 0.45], wood, place)
        for slat in range(3):
            self.box([-w, -0.28, 0.55 + 0.13 * slat], [w, -0.25, 0.63 + 0.13 * slat], wood, place)
        iron = self.any_material()
        for x in (-0.8 * w, 0.8 * w):
            for y in (-0.26, 0.2):
                self.box([x - 0.03, y - 0.02, 0], [x + 0.03, y + 0.02, 0.42 if y > 0 else 0.95], iron, place)

    def stool(self, place) -> None:
        """A turned foot with a round seat."""
        rng = self.rng
        h, r = rng.uniform(0.4, 0.75), rng.uniform(0.15, 0.25)
        profile = [(0, 0), (0.8, 0), (0.8, 0.03), (0.15, 0.08), (0.1, 0.5), (0.2, 0.9), (1, 0.92), (1, 1), (0, 1)]
        radius, z = np.array(profile).T
        self.turned(radius * r, z * h, place)

    def ladder(self, place) -> None:
        rng, wood = self.rng, self.any_material()
        leaning = place.rotate([1, 0, 0], float(rng.uniform(8, 25)))
        h = rng.uniform(1.2, 2.2)
        for x in (-0.22, 0.22):
            self.box([x - 0.02, -0.03, 0], [x + 0.02, 0.03, h], wood, leaning)
        for z in np.arange(0.2, h, rng.uniform(0.2, 0.35)):
            self.rod([-0.22, 0, z], [0.22, 0, z], 0.016, wood, leaning)

    def divider(self, place) -> None:
        """A folding screen with a lattice."""
        rng, wood = self.rng, self.any_material()
        pitch = rng.uniform(0.08, 0.2)
        for panel in range(3):
            turned = place.translate([0.55 * (panel - 1), 0.1 * (panel % 2), 0]).rotate([0, 0, 1], 25 if panel % 2 else -25)
            for x in np.arange(-0.3, 0.31, pitch):
                self.box([x - 0.01, -0.01, 0.05], [x + 0.01, 0.01, 1.7], wood, turned)
            for z in np.arange(0.05, 1.71, pitch):
                self.box([-0.3, -0.01, z - 0.01], [0.3, 0.01, z + 0.01], wood, turned)

    def thing(self, place) -> None:
        """A small object: a ring, a cone, plates, a wire cube, an arch, or a pyramid of balls."""
        rng, bsdf, kind = self.rng, self.any_material(), self.rng.integers(6)
        r, h = rng.uniform(0.04, 0.12), rng.uniform(0.06, 0.3)
        if kind == 0:
            turn, thick = np.linspace(0, 2 * np.pi, 25), r * rng.uniform(0.15, 0.45)
            leaning = place.translate([0, 0, float(r + thick)]).rotate([1, 0, 0], float(rng.uniform(60, 90)))
            self.turned(r + thick * np.cos(turn), thick * np.sin(turn), leaning)
        elif kind == 1:
            self.turned(np.array([0, r, 0.0]), np.array([0, 0, h]), place)
        elif kind == 2:
            for plate in range(rng.integers(1, 7)):
                profile = np.array([(0, 0), (0.55, 0), (1, 0.25), (1, 0.3), (0.5, 0.08), (0, 0.08)]).T * r * 1.3
                self.turned(profile[0], profile[1] + plate * r * 0.14, place)
        elif kind == 3:
            turned = place.rotate([0, 0, 1], float(rng.uniform(0, 90)))
            for a in (-r, r):
                for b in (-r, r):
                    self.rod([a, b, 0], [a, b, 2 * r], r * 0.08, bsdf, turned)
                    for z in (0, 2 * r):
                        self.rod([a, -r, z], [a, r, z], r * 0.08, bsdf, turned)
                        self.rod([-r, a, z], [r, a, z], r * 0.08, bsdf, turned)
        elif kind == 4:
            for x in (-r, r):
                self.box([x - r * 0.3, -r * 0.4, 0], [x + r * 0.3, r * 0.4, h], bsdf, place)
            self.box([-r * 1.3, -r * 0.4, h], [r * 1.3, r * 0.4, h + r * 0.5], bsdf, place)
        else:
            small = r * 0.4
            for level, count in enumerate((3, 2, 1)):
                for i in range(count):
                    for j in range(count):
                        at = [(2 * i - count + 1) * small, (2 * j - count + 1) * small, small * (1 + 1.42 * level)]
                        self.ball(at, small, bsdf, place)


class ReservedRoom(Reserved, Room):
    """A room with skylights instead of windows, or with tubes and spots."""

    picture = staticmethod(rings_picture)

    def pieces(self) -> list:
        return [self.bed, self.wardrobe, self.stairs, self.bench, self.stool, self.stool, self.ladder, self.divider, self.pedestal]

    def pedestal(self, place) -> None:
        """A block with a thing on it."""
        side, h = self.rng.uniform(0.12, 0.3), self.rng.uniform(0.5, 1.1)
        self.box([-side, -side, 0], [side, side, h], self.any_material(), place)
        self.thing(place.translate([0, 0, float(h)]))

    def desk(self, place) -> None:
        self.pedestal(place)
        self.stool(place.translate([0, -0.6, 0]))

    def shell(self, windows: bool) -> None:
        self.skylit = windows
        super().shell(False)

    def ceiling(self, bsdf: dict) -> None:
        """With skylights: slots along y with bars."""
        x, y, z = self.size
        if not self.skylit:
            super().ceiling(bsdf)
            return
        slots = int(self.rng.integers(1, 4))
        near, far = y * self.rng.uniform(0.05, 0.3), y * self.rng.uniform(0.7, 0.95)
        half = x / slots * self.rng.uniform(0.12, 0.35)
        self.box([0, 0, z], [x, near, z + 0.1], bsdf)
        self.box([0, far, z], [x, y, z + 0.1], bsdf)
        edge, frame = 0.0, self.any_material()
        self.frames.append(frame)
        for slot in range(slots):
            middle = (slot + 0.5) * x / slots
            self.box([edge, near, z], [middle - half, far, z + 0.1], bsdf)
            edge = middle + half
            for at in np.linspace(near, far, self.rng.integers(2, 8)):
                self.box([middle - half, at - 0.03, z + 0.02], [edge, at + 0.03, z + 0.08], frame)
        self.box([edge, near, z], [x, far, z + 0.1], bsdf)

    def lamps(self) -> None:
        """Tubes below the ceiling, and spots."""
        rng, (x, y, z) = self.rng, self.size
        tint = np.array([rng.uniform(0.6, 1), 1, rng.uniform(0.6, 1)])
        for _ in range(rng.integers(1, 4)):
            at = rng.uniform(0.15, 0.85, 2) * [x, y]
            if rng.random() < 0.5:
                half, angle = rng.uniform(0.3, 0.8), rng.uniform(0, np.pi)
                along = half * np.array([np.cos(angle), np.sin(angle)])
                power = np.exp(rng.uniform(np.log(8), np.log(80)))
                ends = [[*(at - along), z - 0.12], [*(at + along), z - 0.12]]
                p0, p1 = ([float(v) for v in end] for end in ends)
                light = {"type": "area", "radiance": rgb(tint * power)}
                self.add({"type": "cylinder", "p0": p0, "p1": p1, "radius": float(rng.uniform(0.012, 0.03)), "emitter": light})
            else:
                target = [*(rng.uniform(0.2, 0.8, 2) * [x, y]), 0.5]
                power = np.exp(rng.uniform(np.log(5), np.log(60)))
                to_world = mi.ScalarTransform4f().look_at([*at.tolist(), float(z) - 0.05], [float(v) for v in target], [0.1, 1, 0.2])
                spot = {"type": "spot", "to_world": to_world, "cutoff_angle": float(rng.uniform(20, 60))}
                self.scene[f"spot{len(self.scene)}"] = spot | {"intensity": rgb(tint * power)}

    def sun(self, rng: Rng) -> None:
        """A directional sun through the skylights, if the room has some."""
        if not self.skylit:
            return
        elevation, azimuth = np.radians(rng.uniform(40, 85)), rng.uniform(0, 2 * np.pi)
        power = np.exp(rng.uniform(np.log(2), np.log(60)))
        self.add_sun(elevation, azimuth, power * np.array([1, rng.uniform(0.75, 1), rng.uniform(0.5, 1)]))


class ReservedStill(Reserved, Still):
    """A still life under an evening sky, or between strips of light."""

    studio = staticmethod(softboxes)

    def pieces(self) -> list:
        return [self.stool, self.bench, self.stairs, self.ladder, self.bed, self.wardrobe, self.divider]

    def vase(self, place) -> None:
        self.thing(place)
