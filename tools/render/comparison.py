"""Rooms and still lifes of the paper's comparison (`--preset comparison`).

Neither the training nor the held-out scenes of the bundled models draw their furniture, textures,
pictures, and lights. The rest is shared: plain materials, the shape of rooms, and the cameras.
`tests/test_render.py` compares the three.
"""

from __future__ import annotations

import numpy as np
from patterns import TEXTURE_SIDE, Rng, color, environment, noise
from rooms import Room
from stage import globe, matt, rgb, square_film, tiled
from stills import Still
from variant import mi

# Textures.


def grid() -> tuple[np.ndarray, np.ndarray]:
    """Columns and rows of a texture, from 0 to 1."""
    y, x = np.mgrid[0:TEXTURE_SIDE, 0:TEXTURE_SIDE] / TEXTURE_SIDE
    return x, y


def plaid(rng: Rng) -> np.ndarray:
    """Bands of several widths that cross."""
    (x, y), count = grid(), int(rng.integers(1, 5))
    bands = rng.random(int(rng.integers(5, 12)))
    across, down = (bands[np.floor(t * count * len(bands)).astype(int) % len(bands)] for t in (x, y))
    return 0.5 * (across + down)


def chevrons(rng: Rng) -> np.ndarray:
    """Zigzag stripes."""
    (x, y), count = grid(), int(rng.integers(2, 9))
    bend = np.abs((x * count) % 1 - 0.5) * rng.uniform(0.5, 2)
    return ((y * count + bend) % 1 < rng.uniform(0.3, 0.7)).astype(float)


def arcs(rng: Rng) -> np.ndarray:
    """Quarter circles on tiles that are turned at random (Truchet)."""
    (x, y), count = grid(), int(rng.integers(4, 14))
    column, row = np.floor(x * count).astype(int), np.floor(y * count).astype(int)
    u, v = (x * count) % 1, (y * count) % 1
    u = np.where(rng.random((count, count))[row, column] < 0.5, u, 1 - u)
    distance = np.minimum(np.abs(np.hypot(u, v) - 0.5), np.abs(np.hypot(1 - u, 1 - v) - 0.5))
    return (distance < rng.uniform(0.08, 0.22)).astype(float)


def triangles(rng: Rng) -> np.ndarray:
    """Triangles, each with its own shade."""
    (x, y), count = grid(), 2 * int(rng.integers(2, 8))
    column, row = np.floor(x * count).astype(int), np.floor(y * count).astype(int)
    upper = (x * count) % 1 + (y * count) % 1 > 1
    return rng.random((count, count, 2))[row, column, upper.astype(int)]


def glyphs(rng: Rng) -> np.ndarray:
    """Lines of small signs, as of print."""
    n, cell = TEXTURE_SIDE, int(rng.choice([8, 16]))
    lines = n // cell
    marks = np.kron(rng.random((lines * 4, lines * 4)) < rng.uniform(0.3, 0.6), np.ones((cell // 4, cell // 4)))
    y, x = np.mgrid[0:n, 0:n]
    gap = (y % cell >= 0.75 * cell) | (x % cell >= 0.75 * cell)
    blank = rng.random((lines, lines))[y // cell, x // cell] < 0.15
    return np.where(gap | blank, 1.0, 1 - marks)


TEXTURES = (plaid, chevrons, arcs, triangles, glyphs)


def comparison_pattern(rng: Rng, a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """A texture of two colours, `[256, 256, 3]`."""
    share = TEXTURES[rng.integers(len(TEXTURES))](rng)
    return np.clip(a + (b - a) * share[..., None], 0.01, 0.95)


def comparison_grain(rng: Rng) -> np.ndarray:
    """Knitting, gravel, or leather: factors of a colour around 0.8, `[256, 256, 1]`."""
    x, y = grid()
    kind = rng.choice(["knitting", "gravel", "leather"])
    if kind == "knitting":
        stitches = int(rng.integers(10, 32))
        u, v = (x * stitches) % 1, y * stitches * 0.8
        slope = np.where(u < 0.5, u, 1 - u)
        factor = 0.45 + 0.6 * np.abs(np.sin(np.pi * (v + slope))) * np.sin(np.pi * ((2 * u) % 1))
    elif kind == "gravel":
        count = int(rng.integers(10, 26))
        centres = rng.uniform(0.2, 0.8, (count, count, 2))
        shade, nearest = np.zeros(x.shape), np.full(x.shape, np.inf)
        values = rng.uniform(0.5, 1.1, (count, count))
        for dx in (-1, 0, 1):
            for dy in (-1, 0, 1):
                column, row = np.floor(x * count).astype(int) + dx, np.floor(y * count).astype(int) + dy
                centre = centres[row % count, column % count]
                distance = np.hypot(x * count - column - centre[..., 0], y * count - row - centre[..., 1])
                shade = np.where(distance < nearest, values[row % count, column % count], shade)
                nearest = np.minimum(nearest, distance)
        factor = shade * (1 - 0.8 * np.minimum(nearest, 1))
    else:
        n = TEXTURE_SIDE
        ridges = np.abs(noise(rng, n, n, 6) - noise(rng, n, n, 5))
        factor = 0.5 + 2.5 * np.minimum(ridges, 0.2) + 0.1 * rng.random((n, n))
    return factor[..., None]


def squares_picture(rng: Rng, colors: list) -> np.ndarray:
    """A picture of squares within squares."""
    x, y = grid()
    far = np.maximum(np.abs(x - rng.uniform(0.3, 0.7)), np.abs(y - rng.uniform(0.3, 0.7)))
    return np.array(colors)[(far * rng.uniform(4, 24)).astype(int) % len(colors)]


# Light from outside.


def overcast(rng: Rng, brightness: float, skyline: bool = False) -> dict:
    """An environment map without a sun: the zenith is brightest, and bands of colour lie above the horizon, or
    hills if `skyline`."""
    height, width = 256, 512
    up = np.linspace(1, -1, height)[:, None]
    image = (1 + 2 * np.maximum(up, 0))[..., None] / 3 * np.array([rng.uniform(0.7, 1), 0.9, rng.uniform(0.8, 1.2)])
    image = image * np.ones((height, width, 1))
    if rng.random() < 0.5:
        band = np.exp(-(((up - rng.uniform(0.05, 0.3)) / rng.uniform(0.03, 0.12)) ** 2))
        swing = 1 + np.sin(np.linspace(0, 2 * np.pi, width) * rng.integers(1, 5) + rng.uniform(0, 6))[None]
        image += (band * swing)[..., None] * np.array(color(rng)) * rng.uniform(1, 8)
    ground = up < 0
    if skyline:
        hills = 0.25 * np.array([noise(rng, 2, width, 4)[0]])
        ground = up < hills - 0.05
    image = np.where(ground[..., None], np.array(color(rng)) * 0.3, image)
    return environment(image * brightness)


def ring_light(rng: Rng) -> dict:
    """An environment map with a ring of lamps around the zenith, and one coloured lamp; dark elsewhere."""
    height, width = 256, 512
    image = np.full((height, width, 3), rng.uniform(0.01, 0.06))
    lamps, row = int(rng.integers(4, 12)), int(rng.integers(30, 80))
    for lamp in range(lamps):
        left = int(lamp * width / lamps)
        image[row : row + 6, left : left + 9] += rng.uniform(20, 90)
    left = int(rng.integers(width - 24))
    image[90:120, left : left + 24] += np.array(rng.permutation([1.0, 0.3, 0.1])) * rng.uniform(5, 30)
    return environment(np.roll(image, int(rng.integers(width)), 1))


# Furniture.


class Comparison:
    """Furniture of the comparison, for a `Furnished` stage."""

    pattern = staticmethod(comparison_pattern)
    grain = staticmethod(comparison_grain)
    sky = staticmethod(overcast)

    def barrel(self, place) -> None:
        h, r = self.rng.uniform(0.5, 1.1), self.rng.uniform(0.2, 0.4)
        t = np.linspace(0, 1, 13)
        radius = np.concatenate([[0], r * (0.75 + np.sin(np.pi * t) / 4), [0]])
        self.turned(radius, h * np.concatenate([[0], t, [1]]), place)

    def cart(self, place) -> None:
        rng, wood = self.rng, self.any_material()
        w, d, axle = rng.uniform(0.3, 0.6), rng.uniform(0.5, 0.9), rng.uniform(0.15, 0.3)
        for low, high in (([-w, -d, 0], [w, d, 0.04]), ([-w, -d, 0], [-w + 0.03, d, 0.3]), ([w - 0.03, -d, 0], [w, d, 0.3])):
            self.box(np.add(low, [0, 0, axle]), np.add(high, [0, 0, axle]), wood, place)
        wheel = self.any_material()
        for side in (-w - 0.05, w + 0.05):
            self.rod([side - 0.02, 0, axle], [side + 0.02, 0, axle], axle, wheel, place)
            self.add({"type": "disk", "to_world": place.translate([float(side * 1.02), 0, float(axle)]).rotate([0, 1, 0], 90).scale([float(axle)] * 3)}, wheel)
        self.rod([0, d, axle], [0, d + 0.8, axle + rng.uniform(0.2, 0.6)], 0.02, wood, place)

    def fence(self, place) -> None:
        rng, wood = self.rng, self.any_material()
        w, h = rng.uniform(0.6, 1.4), rng.uniform(0.6, 1.2)
        for x in np.arange(-w, w, rng.uniform(0.08, 0.2)):
            self.box([x, -0.012, 0], [x + 0.05, 0.012, h * rng.uniform(0.9, 1)], wood, place)
        for z in (0.2 * h, 0.75 * h):
            self.box([-w, 0.012, z], [w, 0.04, z + 0.05], wood, place)

    def globe(self, place) -> None:
        """A ball in a ring on a foot."""
        rng, metal = self.rng, self.any_material()
        r, h = rng.uniform(0.12, 0.3), rng.uniform(0.3, 0.8)
        self.rod([0, 0, 0], [0, 0, h - r], 0.02, metal, place)
        self.rod([0, 0, 0], [0, 0, 0.03], 0.7 * r, metal, place)
        self.ball([0, 0, h], r, self.any_material(), place)
        turn, thick = np.linspace(0, 2 * np.pi, 33), 0.06 * r
        leaning = place.translate([0, 0, float(h)]).rotate([1, 0, 0], float(rng.uniform(50, 90)))
        self.turned(1.12 * r + thick * np.cos(turn), thick * np.sin(turn), leaning)

    def pipes(self, place) -> None:
        """Pipes with right-angled bends."""
        rng = self.rng
        for _ in range(rng.integers(2, 6)):
            metal, r = self.any_material(), rng.uniform(0.015, 0.06)
            at = np.array([rng.uniform(-0.5, 0.5), rng.uniform(-0.2, 0.2), 0.0])
            for step in range(rng.integers(3, 7)):
                axis = 2 if step % 2 == 0 else int(rng.integers(2))
                to = at.copy()
                to[axis] += rng.uniform(0.2, 0.5) * (1 if axis == 2 else rng.choice([-1, 1]))
                self.rod(at, to, r, metal, place)
                self.ball(to, 1.15 * r, metal, place)
                at = to

    def tripod(self, place) -> None:
        rng, wood = self.rng, self.any_material()
        h, spread = rng.uniform(0.8, 1.6), rng.uniform(0.2, 0.5)
        for angle in np.radians([90, 210, 330]):
            self.rod([spread * np.cos(angle), spread * np.sin(angle), 0], [0, 0, h], 0.018, wood, place)
        self.box([-0.15, -0.1, h], [0.15, 0.1, h + 0.2], self.any_material(), place)

    def crate(self, place) -> None:
        """A box of slats."""
        rng, wood = self.rng, self.any_material()
        w, h, slats = rng.uniform(0.2, 0.45), rng.uniform(0.25, 0.6), int(rng.integers(2, 6))
        for z in np.linspace(0, h - 0.06, slats):
            for side in (-w, w - 0.02):
                self.box([-w, side, z], [w, side + 0.02, z + 0.06], wood, place)
                self.box([side, -w, z], [side + 0.02, w, z + 0.06], wood, place)
        self.ball([0, 0, 0.6 * w], 0.6 * w, self.any_material(), place)

    def tent(self, place) -> None:
        """A roof on the ground, on two poles."""
        rng, cloth = self.rng, self.any_material()
        w, d, tilt = float(rng.uniform(0.3, 0.8)), float(rng.uniform(0.5, 1.2)), float(rng.uniform(35, 60))
        for side in (-1, 1):
            sheet = place.translate([0, 0, float(w * np.sin(np.radians(tilt)))]).rotate([0, 1, 0], 90 + side * (90 - tilt))
            self.box([0, -d, -0.006], [w, d, 0.006], cloth, sheet)
        for y in (-d, d):
            self.rod([0, y, 0], [0, y, w * np.sin(np.radians(tilt))], 0.015, self.any_material(), place)

    def object(self, place) -> None:
        """A small object: a bottle, dice, an open book, a spring, a candlestick, or cups."""
        rng, bsdf, kind = self.rng, self.any_material(), self.rng.integers(6)
        r, h = rng.uniform(0.03, 0.08), rng.uniform(0.08, 0.3)
        if kind == 0:
            profile = np.array([(0, 0), (1, 0), (1, 0.55), (0.9, 0.62), (0.3, 0.75), (0.3, 0.98), (0.36, 1), (0, 1)]).T
            self.turned(profile[0] * r, profile[1] * (h + 0.1), place)
        elif kind == 1:
            for _ in range(rng.integers(2, 5)):
                side, at = rng.uniform(0.3, 0.6) * r, rng.uniform(-1.5, 1.5, 2) * r
                turned = place.translate([float(at[0]), float(at[1]), 0]).rotate([0, 0, 1], float(rng.uniform(0, 90)))
                self.box([-side, -side, 0], [side, side, 2 * side], self.any_material(), turned)
        elif kind == 2:
            for side in (-1, 1):
                page = place.translate([0, 0, 0.01]).rotate([0, 1, 0], float(-side * rng.uniform(4, 18)))
                self.box([min(0, side * 2.2 * r), -1.6 * r, 0], [max(0, side * 2.2 * r), 1.6 * r, 0.012], bsdf, page)
        elif kind == 3:
            turns, steps = int(rng.integers(3, 7)), 60
            t = np.linspace(0, 1, steps + 1)
            points = np.stack([r * np.cos(2 * np.pi * turns * t), r * np.sin(2 * np.pi * turns * t), 0.008 + h * t], -1)
            for a, b in zip(points[:-1], points[1:]):
                self.rod(a, b, 0.1 * r, bsdf, place)
        elif kind == 4:
            profile = np.array([(0, 0), (1, 0), (1, 0.05), (0.2, 0.15), (0.15, 0.6), (0.3, 0.65), (0.15, 0.7), (0.4, 0.8), (0, 0.8)]).T
            self.turned(profile[0] * r, profile[1] * h, place)
            self.rod([0, 0, 0.8 * h], [0, 0, 0.8 * h + 0.1], 0.15 * r, self.any_material(), place)
        else:
            for cup in range(rng.integers(1, 4)):
                profile = np.array([(0, 0), (0.7, 0), (1, 1), (0.93, 1), (0.64, 0.08), (0, 0.08)]).T
                self.turned(profile[0] * r, profile[1] * r * 2 + cup * 0.5 * r, place)


class ComparisonRoom(Comparison, Room):
    """A room with windows in a strip below the ceiling, or with rings and strings of lamps."""

    picture = staticmethod(squares_picture)

    def pieces(self) -> list:
        return [self.barrel, self.cart, self.fence, self.globe, self.pipes, self.tripod, self.crate, self.crate, self.tent, self.plinth]

    def plinth(self, place) -> None:
        """Steps around a block with an object on it."""
        side, h = self.rng.uniform(0.15, 0.35), self.rng.uniform(0.3, 0.9)
        stone = self.any_material()
        for step in range(3):
            wide = side * (2 - 0.4 * step)
            self.box([-wide, -wide, 0.06 * step], [wide, wide, 0.06 * (step + 1)], stone, place)
        self.box([-side, -side, 0.18], [side, side, h], self.any_material(), place)
        self.object(place.translate([0, 0, float(h)]))

    def desk(self, place) -> None:
        self.plinth(place)
        self.crate(place.translate([0, -0.9, 0]))

    def windows(self, length: float, height: float, wall: dict, place) -> None:
        """A wall with a strip of panes below the ceiling."""
        rng, frame = self.rng, self.any_material()
        self.frames.append(frame)
        low, high = height * rng.uniform(0.45, 0.7), height - rng.uniform(0.05, 0.3)
        self.box([0, -0.1, 0], [length, 0, low], wall, place)
        self.box([0, -0.1, high], [length, 0, height], wall, place)
        for x in np.linspace(0, length, int(rng.integers(3, 10))):
            self.box([x - 0.025, -0.08, low], [x + 0.025, -0.02, high], frame, place)

    def lamps(self) -> None:
        """Rings of lamps below the ceiling, or strings of small ones."""
        rng, (x, y, z) = self.rng, self.size
        tint = np.array([1, rng.uniform(0.5, 1), rng.uniform(0.3, 1)])
        for _ in range(rng.integers(1, 3)):
            at, count = rng.uniform(0.25, 0.75, 2) * [x, y], int(rng.integers(5, 14))
            power = tint * np.exp(rng.uniform(np.log(20), np.log(200)))
            ring = rng.random() < 0.5
            for number in range(count):
                angle, share = 2 * np.pi * number / count, number / (count - 1)
                if ring:
                    centre = [*(at + 0.4 * np.array([np.cos(angle), np.sin(angle)])), z - 0.35]
                else:
                    centre = [0.1 * x + 0.8 * x * share, at[1], z - 0.15 - 1.2 * share * (1 - share)]
                self.add(globe(centre, 0.035, power))


    def sun(self, rng: Rng) -> None:
        """A floodlight outside that shines through a strip of panes, if the room has one."""
        if not self.open_sides:
            return
        (x, y, z), side = self.size, rng.choice(self.open_sides)
        outside = {0: (x / 2, -6), 1: (x + 6, y / 2), 2: (x / 2, y + 6), 3: (-6, y / 2)}[int(side)]
        at = [float(outside[0] + rng.uniform(-2, 2)), float(outside[1] + rng.uniform(-2, 2)), float(z + rng.uniform(0, 4))]
        tint, power = np.array([1, rng.uniform(0.6, 1), rng.uniform(0.3, 1)]), np.exp(rng.uniform(np.log(100), np.log(3000)))
        to_world = mi.ScalarTransform4f().look_at(at, [float(x / 2), float(y / 2), float(0.3 * z)], [0.1, 0.1, 1])
        light = {"type": "spot", "to_world": to_world, "cutoff_angle": 35.0, "intensity": rgb(tint * power)}
        self.scene["sun"] = light


class ComparisonStill(Comparison, Still):
    """A still life under a covered sky, or below a ring of lamps."""

    studio = staticmethod(ring_light)

    def pieces(self) -> list:
        return [self.barrel, self.crate, self.globe, self.tripod, self.cart, self.fence, self.tent, self.pipes]

    def vase(self, place) -> None:
        self.object(place)

    def thing(self, place) -> None:
        self.object(place)


class GlassBalls(ComparisonStill):
    """Two or three glass balls on a textured ground: the limit that the paper names (Fig. 11)."""

    def surface(self, side: float) -> dict:
        """A patterned floor without gloss."""
        image = self.pattern(self.rng, np.array(self.tint()), np.array(self.tint()))
        return matt(tiled(image, float(side / (2 * self.reach))))

    def arrange(self) -> None:
        rng, at = self.rng, -0.5
        for _ in range(rng.integers(2, 4)):
            r = self.reach * rng.uniform(0.25, 0.4)
            self.ball([self.reach * at, self.reach * rng.uniform(-0.3, 0.3), r], r, {"type": "dielectric"})
            at += rng.uniform(0.7, 0.9)

    def camera(self, rng: Rng, side: int) -> dict:
        """A view from above, without defocus."""
        distance, elevation = self.reach * rng.uniform(2, 3), np.radians(rng.uniform(15, 40))
        azimuth = np.radians(rng.uniform(-120, -60))
        eye = distance * np.array([np.cos(elevation) * np.cos(azimuth), np.cos(elevation) * np.sin(azimuth), np.sin(elevation)])
        to_world = mi.ScalarTransform4f().look_at(eye.tolist(), [0, 0, 0.2 * self.reach], [0, 0, 1])
        return {"type": "perspective", "fov": float(rng.uniform(30, 50)), "near_clip": 0.001, "to_world": to_world, "film": square_film(side)}
