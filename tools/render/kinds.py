"""Still lifes of the kinds that are hard to denoise: `--kind`.

Each is a mixin: `kind_of(Foliage, Still)` has the furniture, textures, and skies of `Still`, and those of any other
edition with its still life.
"""

from __future__ import annotations

import tempfile

import numpy as np
from patterns import Rng, color
from stage import METALS, globe, matt, rgb
from stills import Still
from variant import mi

UPRIGHT = np.array([0.0, 0.0, 1.0])


class Glassware:
    """Things of glass and mirrors on a textured ground, with lamps that cast caustics."""

    def any_material(self) -> dict:
        kind = self.rng.random()
        if kind < 0.45:
            return {"type": "dielectric", "int_ior": float(self.rng.uniform(1.3, 1.8))}
        if kind < 0.55:
            return {"type": "roughdielectric", "alpha": float(self.rng.uniform(0.02, 0.2))}
        if kind < 0.7:
            return {"type": "twosided", "bsdf": {"type": "conductor", "material": str(self.rng.choice(METALS))}}
        return super().any_material()

    def arrange(self) -> None:
        super().arrange()
        rng, reach = self.rng, self.reach
        for _ in range(rng.integers(1, 4)):
            r, out, angle = reach * rng.uniform(0.1, 0.35), reach * rng.random(), rng.uniform(0, 2 * np.pi)
            self.ball([out * np.cos(angle), out * np.sin(angle), r], r, {"type": "dielectric"})
        if rng.random() < 0.4:
            place = mi.ScalarTransform4f().rotate([0, 0, 1], float(rng.uniform(-60, 60))).translate([0, float(1.3 * reach), 0])
            self.box([-reach, -0.01 * reach, 0], [reach, 0.01 * reach, reach], {"type": "twosided", "bsdf": {"type": "conductor", "material": "Ag"}}, place)
        for _ in range(rng.integers(0, 4)):
            at = reach * np.array([*rng.uniform(-2, 2, 2), rng.uniform(1.5, 4)])
            radius = reach * rng.uniform(0.03, 0.15)
            tint = np.array([1, rng.uniform(0.6, 1), rng.uniform(0.4, 1)])
            self.add(globe(at, radius, tint * rng.uniform(3, 30) * (reach / radius) ** 2 / 4))


class Lights:
    """Dozens of small lamps under a night sky."""

    def arrange(self) -> None:
        super().arrange()
        rng, reach = self.rng, self.reach
        dark = np.full((16, 32, 3), rng.choice([0.003, 0.02, 0.06])) * rng.uniform(0.3, 1, 3)
        self.scene["sky"] = {"type": "envmap", "bitmap": mi.Bitmap(dark.astype(np.float32))}
        tints = [rng.uniform(0.1, 1, 3) if rng.random() < 0.5 else np.array([1, 0.8, 0.6]) for _ in range(4)]
        count, radius = int(rng.integers(8, 48)), reach * rng.uniform(0.01, 0.04)
        strings, turns = rng.random() < 0.5, rng.integers(1, 4)
        for number in range(count):
            share = number / count
            if strings:
                turn, high = 2 * np.pi * share * turns, 0.6 + 0.4 * np.cos(8 * np.pi * share)
                at = reach * np.array([1.3 * np.cos(turn), 1.3 * np.sin(turn), high])
            else:
                at = reach * np.array([*rng.normal(0, 0.8, 2), rng.uniform(0.05, 1.2)])
            power = tints[number % len(tints)] * np.exp(rng.uniform(np.log(0.3), np.log(3)))
            self.add(globe(at, radius, power * (reach / radius) ** 2 / count))


class Foliage:
    """Grass, bushes, and trees in the sun."""

    def arrange(self) -> None:
        super().arrange()
        rng, reach = self.rng, self.reach
        greens = [matt(rgb(rng.uniform([0.03, 0.12, 0.02], [0.35, 0.45, 0.15]))) for _ in range(3)]
        if rng.random() < 0.8:
            blades = int(rng.integers(2000, 20000))
            feet = np.concatenate([rng.uniform(-1.5, 1.5, (blades, 2)) * reach, np.zeros((blades, 1))], 1)
            bent = UPRIGHT + rng.normal(0, 0.35, (blades, 3))
            self.leaves(feet, bent * reach * rng.uniform(0.05, 0.25), 0.06, greens[0])
        for _ in range(rng.integers(1, 6)):
            foot = np.array([*rng.uniform(-1.2, 1.2, 2) * reach, 0])
            height, spread, count = reach * rng.uniform(0.4, 1.6), reach * rng.uniform(0.15, 0.5), int(rng.integers(500, 5000))
            trunk = height * rng.uniform(0, 0.6)
            self.rod(foot, foot + UPRIGHT * (trunk + 0.3 * spread), 0.06 * spread, matt(rgb(rng.uniform(0.03, 0.3, 3))))
            ball = rng.normal(0, 1, (count, 3))
            ball *= (rng.random((count, 1)) ** 0.4 * spread) / np.linalg.norm(ball, axis=1, keepdims=True)
            self.leaves(foot + UPRIGHT * (trunk + spread) + ball, rng.normal(0, 1, (count, 3)) * spread * rng.uniform(0.06, 0.2), 0.35, greens[1 + rng.integers(2)])
        elevation, azimuth = np.radians(rng.uniform(15, 70)), rng.uniform(0, 2 * np.pi)
        self.add_sun(elevation, azimuth, rng.uniform(4, 30) * np.array([1, rng.uniform(0.75, 1), rng.uniform(0.5, 1)]))

    def leaves(self, feet: np.ndarray, along: np.ndarray, width: float, bsdf: dict) -> None:
        """Pointed leaves `[N, 3]`; `width` is a part of their length."""
        across = np.cross(along, self.rng.normal(0, 1, along.shape))
        across *= width * np.linalg.norm(along, axis=1, keepdims=True) / np.maximum(np.linalg.norm(across, axis=1, keepdims=True), 1e-9)
        points = np.stack([feet, feet + along / 2 + across / 2, feet + along, feet + along / 2 - across / 2], 1).reshape(-1, 3)
        first = 4 * np.arange(len(feet))[:, None]
        faces = np.concatenate([first + [0, 1, 2], first + [0, 2, 3]])
        self.mesh(points, faces, bsdf)


class Fine:
    """Nets, slats, wires, and print."""

    def arrange(self) -> None:
        super().arrange()
        rng, reach = self.rng, self.reach
        for _ in range(rng.integers(2, 6)):
            place = mi.ScalarTransform4f().translate([*(rng.uniform(-1, 1, 2) * reach).tolist(), 0]).rotate([0, 0, 1], float(rng.uniform(0, 180)))
            wide, high, bsdf = reach * rng.uniform(0.3, 0.9), reach * rng.uniform(0.3, 1), self.any_material()
            pitch = reach * np.exp(rng.uniform(np.log(0.012), np.log(0.08)))
            thick = pitch * rng.uniform(0.05, 0.25)
            kind = rng.integers(4)
            if kind < 2:
                for x in np.arange(-wide, wide, pitch):
                    self.rod([x, 0, 0], [x, 0, high], thick, bsdf, place)
                for z in np.arange(0, high, pitch) if kind == 0 else ():
                    self.rod([-wide, 0, z], [wide, 0, z], thick, bsdf, place)
            elif kind == 2:
                tilt = float(rng.uniform(0, 80))
                for z in np.arange(pitch, high, pitch):
                    slat = place.translate([0, 0, float(z)]).rotate([1, 0, 0], tilt)
                    self.box([-wide, -0.4 * pitch, -0.02 * pitch], [wide, 0.4 * pitch, 0.02 * pitch], bsdf, slat)
            else:
                sheet = place.translate([0, 0, float(high / 2)]).rotate([1, 0, 0], 90).scale([float(wide), float(high / 2), 1])
                self.add({"type": "rectangle", "to_world": sheet}, self.print())

    def print(self) -> dict:
        """A sheet of print: lines of words of small signs."""
        rng, side, cell = self.rng, 512, int(self.rng.choice([8, 12, 16]))
        y, x = np.mgrid[0:side, 0:side]
        strokes = rng.random((side // 2, side // 2)) < 0.45
        ink = strokes[y // 2, x // 2] & (y % cell < 0.6 * cell)
        words = rng.random((side // cell + 1, side // cell + 1)) < 0.8
        ink &= words[y // cell, x // cell] & (x > side // 12) & (x < side - side // 12)
        paper, black = np.array(color(rng)) * 0.3 + 0.6, np.array(color(rng)) * 0.15
        image = np.where(ink[..., None], black, paper).astype(np.float32)
        return matt({"type": "bitmap", "bitmap": mi.Bitmap(image), "raw": True})


class Fur:
    """Balls and rugs with hair."""

    def arrange(self) -> None:
        super().arrange()
        rng, reach = self.rng, self.reach
        for _ in range(rng.integers(1, 4)):
            strands, r = int(rng.integers(3000, 20000)), reach * rng.uniform(0.15, 0.4)
            middle = np.array([*rng.uniform(-0.8, 0.8, 2) * reach, r])
            outward = rng.normal(0, 1, (strands, 3))
            outward /= np.linalg.norm(outward, axis=1, keepdims=True)
            roots, length = middle + outward * r, r * rng.uniform(0.15, 0.9)
            if rng.random() < 0.4:
                # A rug.
                roots = np.concatenate([middle[:2] + rng.uniform(-2, 2, (strands, 2)) * r, np.zeros((strands, 1))], 1)
                outward = UPRIGHT + rng.normal(0, 0.2, (strands, 3))
            else:
                self.ball(middle, r, matt(rgb(rng.uniform(0.02, 0.4, 3))))
            self.hair(roots, outward * length, length * rng.uniform(0.005, 0.02))

    def hair(self, roots: np.ndarray, along: np.ndarray, radius: float) -> None:
        """Curved strands `[N, 3]` of hair, from blond to black, or dyed."""
        rng, steps = self.rng, np.linspace(0, 1, 5)[None, :, None]
        sag = np.array([0, 0, -0.5 * rng.random()]) * np.linalg.norm(along, axis=1, keepdims=True)
        curl = rng.normal(0, 0.12, (len(roots), 3)) * np.linalg.norm(along, axis=1, keepdims=True)
        points = roots[:, None] + along[:, None] * steps + (sag + curl)[:, None] * steps**2
        with tempfile.NamedTemporaryFile("w", suffix=".txt") as file:
            for strand in points:
                file.writelines(f"{x:.6f} {y:.6f} {z:.6f} {radius:.6f}\n" for x, y, z in strand)
                file.write("\n")
            file.flush()
            kind = rng.random()
            bsdf = {"type": "hair", "eumelanin": float(8 * rng.random() ** 3), "pheomelanin": float(rng.random() ** 2)}
            if kind < 0.3:
                bsdf = {"type": "roughplastic", "diffuse_reflectance": rgb(color(rng)), "alpha": 0.2}
                bsdf = {"type": "twosided", "bsdf": bsdf}
            self.scene[f"shape{len(self.scene)}"] = mi.load_dict({"type": "bsplinecurve", "filename": file.name, "bsdf": bsdf})


KINDS = {"glassware": Glassware, "lights": Lights, "foliage": Foliage, "fine": Fine, "fur": Fur}
"""The kinds, by name."""


def kind_of(kind: type, still: type[Still]) -> type[Still]:
    """Still lifes of a kind with the furniture of `still`."""
    return type(kind.__name__ + still.__name__, (kind, still), {})
