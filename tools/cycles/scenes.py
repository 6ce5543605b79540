"""Random scenes of Blender: things on a ground with volumes, hair, or motion. Metres, z up.

A scene depends on its seed, its kind, and the edition only.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import bpy
import bmesh  # isort: skip (part of bpy)
import numpy as np
from mathutils import Vector
from shading import BRICK, CELLS, CHECKER, MAGIC, NOISE, WAVE, Painter, Rng, Texture, logarithmic

SHUTTER = 0.5
"""Share of a frame that the shutter is open; it is in the middle of frame 1."""


# Things of about one metre, that stand on z = 0 before they are scaled.


def block(rng: Rng) -> bpy.types.Object:
    bpy.ops.mesh.primitive_cube_add(size=1, location=(0, 0, 0.5), scale=rng.uniform(0.3, 1, 3))
    thing = bpy.context.object
    bevel = thing.modifiers.new("bevel", "BEVEL")
    bevel.width, bevel.segments = float(rng.uniform(0.005, 0.1)), 3
    return thing


def ball(rng: Rng) -> bpy.types.Object:
    # Not a UV sphere: Blender places hair on it differently in each run.
    bpy.ops.mesh.primitive_ico_sphere_add(subdivisions=5, radius=0.5, location=(0, 0, 0.5))
    return smooth()


def tube(rng: Rng) -> bpy.types.Object:
    bpy.ops.mesh.primitive_cylinder_add(radius=float(rng.uniform(0.1, 0.5)), depth=1, location=(0, 0, 0.5), vertices=64)
    if rng.random() < 0.5:
        bpy.context.object.modifiers.new("hollow", "SOLIDIFY").thickness = 0.05
    return bpy.context.object


def ring(rng: Rng) -> bpy.types.Object:
    thick = float(rng.uniform(0.04, 0.2))
    bpy.ops.mesh.primitive_torus_add(major_radius=0.5 - thick, minor_radius=thick, location=(0, 0, thick), major_segments=64, minor_segments=24)
    return smooth()


def stone(rng: Rng) -> bpy.types.Object:
    bpy.ops.mesh.primitive_ico_sphere_add(subdivisions=5, radius=0.45, location=(0, 0, 0.4))
    thing = smooth()
    rough = bpy.data.textures.new("rough", "CLOUDS")
    rough.noise_scale = float(rng.uniform(0.2, 0.8))
    displace = thing.modifiers.new("rough", "DISPLACE")
    displace.texture, displace.strength = rough, float(rng.uniform(0.1, 0.5))
    return thing


def head(rng: Rng) -> bpy.types.Object:
    """Blender's monkey."""
    bpy.ops.mesh.primitive_monkey_add(size=1, location=(0, 0, 0.45))
    bpy.context.object.modifiers.new("smooth", "SUBSURF").render_levels = 2
    return smooth()


def word(rng: Rng) -> bpy.types.Object:
    """Upright letters."""
    bpy.ops.object.text_add(rotation=(np.pi / 2, 0, 0))
    thing = bpy.context.object
    letters = [chr(code) for code in range(ord("A"), ord("Z") + 1)]
    thing.data.body = "".join(rng.choice(letters, rng.integers(1, 6)))
    thing.data.extrude, thing.data.bevel_depth = float(rng.uniform(0.03, 0.2)), float(rng.uniform(0, 0.02))
    thing.data.align_x = "CENTER"
    return thing


def cage(rng: Rng) -> bpy.types.Object:
    """A ball of wires."""
    bpy.ops.mesh.primitive_ico_sphere_add(subdivisions=int(rng.integers(2, 5)), radius=0.5, location=(0, 0, 0.5))
    bpy.context.object.modifiers.new("wires", "WIREFRAME").thickness = float(rng.uniform(0.005, 0.04))
    return bpy.context.object


def steps(rng: Rng) -> bpy.types.Object:
    count = int(rng.integers(3, 9))
    bpy.ops.mesh.primitive_cube_add(size=1, location=(0, 0, 0.5 / count), scale=(1, 1 / count, 1 / count))
    array = bpy.context.object.modifiers.new("steps", "ARRAY")
    array.count, array.relative_offset_displace = count, (0, 1, 1)
    return bpy.context.object


def pyramid(rng: Rng) -> bpy.types.Object:
    sides = int(rng.integers(3, 9))
    bpy.ops.mesh.primitive_cone_add(vertices=sides, radius1=0.5, radius2=float(rng.choice([0, 0.25])), depth=1, location=(0, 0, 0.5))
    return bpy.context.object


def smooth() -> bpy.types.Object:
    bpy.ops.object.shade_smooth()
    return bpy.context.object


def triangulate(data: bpy.types.Mesh) -> None:
    """Makes triangles of several kinds of polygons, on which Blender places hair differently in each run."""
    if len({len(polygon.vertices) for polygon in data.polygons}) == 1:
        return
    mesh = bmesh.new()
    mesh.from_mesh(data)
    bmesh.ops.triangulate(mesh, faces=mesh.faces)
    mesh.to_mesh(data)
    mesh.free()


@dataclass(frozen=True)
class Edition:
    """Shapes, textures, and lights of a data set. No two editions share any."""

    shapes: tuple[Callable[[Rng], bpy.types.Object], ...]
    textures: tuple[Texture, ...]
    lights: tuple[str, ...]


EDITIONS = {
    "train": Edition((block, ball, tube, ring, stone), (NOISE, WAVE, CHECKER), ("gradient", "panels", "bulbs")),
    "heldout": Edition((head, word, cage, steps, pyramid), (CELLS, BRICK, MAGIC), ("sunny", "spots", "tubes")),
}


class Stage:
    """A scene under construction: Blender's current scene."""

    def __init__(self, rng: Rng, edition: Edition) -> None:
        self.rng, self.edition = rng, edition
        bpy.ops.wm.read_factory_settings(use_empty=True)
        self.scene = bpy.context.scene
        self.scene.render.use_motion_blur = False
        self.painter = Painter(rng, edition.textures)
        self.things: list[bpy.types.Object] = []
        self.walled = rng.random() < 0.5
        self.ground()
        for _ in range(rng.integers(5, 18)):
            self.thing()
        self.scene.world = bpy.data.worlds.new("world")
        self.scene.world.use_nodes = True
        self.background((0, 0, 0), 0.0)
        getattr(self, str(rng.choice(edition.lights)))()

    def ground(self) -> None:
        rng = self.rng
        bpy.ops.mesh.primitive_plane_add(size=float(rng.uniform(6, 40)))
        bpy.context.object.data.materials.append(self.painter.material())
        if self.walled:
            bpy.ops.mesh.primitive_plane_add(size=12, location=(0, float(rng.uniform(1.5, 3)), 6), rotation=(np.pi / 2, 0, 0))
            bpy.context.object.data.materials.append(self.painter.material())

    def thing(self) -> bpy.types.Object:
        """A random shape somewhere near the middle, with a random size, turn, and material."""
        rng = self.rng
        thing = self.edition.shapes[rng.integers(len(self.edition.shapes))](rng)
        size, out, turn = logarithmic(rng, 0.15, 0.9), 1.3 * np.sqrt(rng.random()), rng.uniform(0, 2 * np.pi)
        thing.location = Vector((out * np.cos(turn), out * np.sin(turn), 0)) + thing.location * size
        thing.scale = thing.scale * size
        if thing.type != "FONT":
            thing.rotation_euler.rotate_axis("Z", float(rng.uniform(0, 2 * np.pi)))
        thing.data.materials.append(self.painter.any_material())
        self.things.append(thing)
        return thing

    # Lights.

    def background(self, color: tuple, strength: float) -> None:
        node = self.scene.world.node_tree.nodes["Background"]
        node.inputs["Color"].default_value = (*color, 1.0)
        node.inputs["Strength"].default_value = strength

    def light(self, kind: str, at: Vector, power: float, size: float) -> bpy.types.Light:
        """A lamp that shines towards the middle; `power` in watts, `size` in metres."""
        data = bpy.data.lights.new(kind, kind)
        data.color, data.energy = self.painter.light_color(), power
        if kind == "AREA":
            data.size = size
        else:
            data.shadow_soft_size = size
        holder = bpy.data.objects.new(kind, data)
        holder.location = at
        holder.rotation_euler = (-at).to_track_quat("-Z", "Y").to_euler()
        self.scene.collection.objects.link(holder)
        return data

    def above(self) -> Vector:
        """A place above the things, in front of a wall."""
        rng = self.rng
        turn = rng.uniform(np.pi, 2 * np.pi) if self.walled else rng.uniform(0, 2 * np.pi)
        out = rng.uniform(0.5, 2.5)
        return Vector((out * np.cos(turn), out * np.sin(turn), rng.uniform(1.5, 3.5)))

    def gradient(self) -> None:
        """A sky from horizon to zenith, with or without a sun."""
        rng, tree = self.rng, self.scene.world.node_tree
        place, ramp, axis = (tree.nodes.new(kind) for kind in ("ShaderNodeTexCoord", "ShaderNodeValToRGB", "ShaderNodeSeparateXYZ"))
        low, high = ramp.color_ramp.elements
        low.color, high.color = (*rng.uniform(0.4, 1, 3), 1), (*(rng.uniform(0.2, 1, 3) * [0.5, 0.7, 1]), 1)
        tree.links.new(place.outputs["Generated"], axis.inputs[0])
        tree.links.new(axis.outputs["Z"], ramp.inputs["Fac"])
        self.background((1, 1, 1), float(rng.uniform(0.3, 1.5)))
        tree.links.new(ramp.outputs["Color"], tree.nodes["Background"].inputs["Color"])
        if rng.random() < 0.6:
            sun = self.light("SUN", self.above(), logarithmic(rng, 0.5, 8), 0)
            sun.angle = np.radians(logarithmic(rng, 0.3, 8))

    def panels(self) -> None:
        """Square lamps in the dark, or almost."""
        rng = self.rng
        self.background((1, 1, 1), float(rng.choice([0, 0.02, 0.1])))
        for _ in range(rng.integers(1, 4)):
            self.light("AREA", self.above(), logarithmic(rng, 20, 200), logarithmic(rng, 0.1, 1.5))

    def bulbs(self) -> None:
        """Many small round lamps."""
        rng = self.rng
        count = int(rng.integers(3, 40))
        for _ in range(count):
            at = self.above() * float(rng.uniform(0.3, 1))
            self.light("POINT", at, logarithmic(rng, 30, 150) / count, logarithmic(rng, 0.01, 0.1))

    def sunny(self) -> None:
        """Blender's model of the sky, with its sun."""
        rng, tree = self.rng, self.scene.world.node_tree
        sky = tree.nodes.new("ShaderNodeTexSky")
        sky.sun_elevation, sky.sun_rotation = np.radians(rng.uniform(2, 70)), rng.uniform(0, 6.28)
        sky.sun_disc = bool(rng.random() < 0.7)
        self.background((1, 1, 1), 0.1)
        tree.links.new(sky.outputs["Color"], tree.nodes["Background"].inputs["Color"])

    def spots(self) -> None:
        rng = self.rng
        self.background((1, 1, 1), float(rng.choice([0, 0.02, 0.1])))
        for _ in range(rng.integers(2, 7)):
            spot = self.light("SPOT", self.above(), logarithmic(rng, 60, 400), logarithmic(rng, 0.01, 0.2))
            spot.spot_size, spot.spot_blend = np.radians(rng.uniform(20, 80)), float(rng.random())

    def tubes(self) -> None:
        """Glowing rods."""
        rng = self.rng
        self.background((1, 1, 1), float(rng.choice([0, 0.02])))
        for _ in range(rng.integers(2, 9)):
            radius, long = logarithmic(rng, 0.01, 0.05), rng.uniform(0.4, 2)
            bpy.ops.mesh.primitive_cylinder_add(radius=radius, depth=long, location=self.above(), rotation=rng.uniform(0, 3.14, 3))
            bpy.context.object.data.materials.append(self.painter.lamp(logarithmic(rng, 0.5, 3) / (radius * long)))

    def group(self, rng: Rng) -> None:
        """Puts the sky in the first of Cycles' light groups, each lamp in one of the others."""
        sky, *lamps = (group.name for group in self.scene.view_layers[0].lightgroups)
        self.scene.world.lightgroup = sky
        for thing in self.scene.objects:
            thing.lightgroup = str(rng.choice(lamps))

    # Kinds.

    def things_alone(self) -> None:
        """Nothing more."""

    def volume(self) -> None:
        """Fog, smoke, or clouds."""
        rng = self.rng
        kind = rng.choice(["fog", "smoke", "cloud"], p=[0.35, 0.4, 0.25])
        if kind == "fog":
            bpy.ops.mesh.primitive_cube_add(size=12, location=(0, 0, 5.99))
            bpy.context.object.data.materials.append(self.painter.mist(logarithmic(rng, 2, 30)))
            return
        for _ in range(rng.integers(1, 4)):
            radius = logarithmic(rng, 0.4, 1.5)
            # A box: the density inside is that of a torn ball.
            at = (*rng.uniform(-1, 1, 2), radius * rng.uniform(0.3, 1) + (rng.uniform(0, 1) if kind == "cloud" else 0))
            bpy.ops.mesh.primitive_cube_add(size=2, location=at)
            bpy.context.object.scale = radius * rng.uniform(0.6, 1.3, 3)
            density = logarithmic(rng, 20, 100) if kind == "cloud" else logarithmic(rng, 2, 20)
            bpy.context.object.data.materials.append(self.painter.smoke(density / radius, kind == "cloud"))

    def fur(self) -> None:
        """Hair on some of the things, or a meadow."""
        rng = self.rng
        meshes = [thing for thing in self.things if thing.type == "MESH"]
        for thing in rng.permutation(np.array(meshes, dtype=object))[: rng.integers(1, 4)]:
            self.grow(thing, int(rng.integers(1000, 6000)), logarithmic(rng, 0.05, 0.4))
        if rng.random() < 0.3 or not meshes:
            bpy.ops.mesh.primitive_plane_add(size=4, location=(0, 0, 0.001))
            bpy.context.object.data.materials.append(self.painter.any_material())
            self.grow(bpy.context.object, int(rng.integers(5000, 30000)), logarithmic(rng, 0.05, 0.3))

    def grow(self, thing: bpy.types.Object, count: int, length: float) -> None:
        """Hair of this length, in metres, on a mesh."""
        rng = self.rng
        triangulate(thing.data)
        thing.data.materials.append(self.painter.hair())
        system = thing.modifiers.new("hair", "PARTICLE_SYSTEM").particle_system
        system.seed = int(rng.integers(1000))
        hair = system.settings
        hair.type, hair.count, hair.hair_step = "HAIR", count, 4
        # The length of a hair is a multiple of its speed at the root.
        hair.hair_length = length
        hair.brownian_factor = float(rng.uniform(0, 0.05))
        hair.material = len(thing.data.materials)
        hair.radius_scale, hair.root_radius, hair.tip_radius = 0.01, float(rng.uniform(0.15, 0.8)), 0.1
        hair.child_type, hair.rendered_child_count = "INTERPOLATED", int(rng.integers(2, 8))
        hair.roughness_1, hair.roughness_endpoint = float(rng.uniform(0, 0.1)), float(rng.uniform(0, 0.1))

    def motion(self) -> None:
        """A third of the things move or turn while the shutter is open."""
        rng = self.rng
        self.scene.render.use_motion_blur = True
        self.scene.render.motion_blur_shutter = SHUTTER
        for thing in self.things:
            if rng.random() < 0.6:
                continue
            way, turn = rng.normal(0, 1, 3) * logarithmic(rng, 0.02, 0.3), rng.normal(0, 1, 3) * rng.uniform(0, 0.6)
            at, facing = np.array(thing.location), np.array(thing.rotation_euler)
            for frame in (0, 2):
                thing.location, thing.rotation_euler = at + (frame - 1) * way, facing + (frame - 1) * turn
                thing.keyframe_insert("location", frame=frame)
                thing.keyframe_insert("rotation_euler", frame=frame)
        self.scene.frame_set(1)

    def camera(self, rng: Rng) -> None:
        """A view from above; one of three has defocus."""
        elevation = np.radians(rng.uniform(5, 50))
        turn = np.radians(rng.uniform(-150, -30)) if self.walled else rng.uniform(0, 2 * np.pi)
        distance = rng.uniform(1.3, 3.5)
        eye = distance * Vector((np.cos(elevation) * np.cos(turn), np.cos(elevation) * np.sin(turn), np.sin(elevation)))
        target = Vector((*rng.normal(0, 0.3, 2), rng.uniform(0.1, 0.5)))
        data = bpy.data.cameras.new("camera")
        data.angle, data.clip_start = np.radians(rng.uniform(25, 60)), 0.01
        data.dof.use_dof = bool(rng.random() < 0.35)
        data.dof.focus_distance = float(distance * rng.uniform(0.7, 1.1))
        data.dof.aperture_fstop = logarithmic(rng, 0.2, 2)
        holder = bpy.data.objects.new("camera", data)
        holder.location = eye
        holder.rotation_euler = (target - eye).to_track_quat("-Z", "Y").to_euler()
        self.scene.collection.objects.link(holder)
        self.scene.camera = holder


KINDS = {"things": Stage.things_alone, "volume": Stage.volume, "fur": Stage.fur, "motion": Stage.motion}
"""What a kind adds to a scene."""


def build(seed: int, index: int, kind: str, edition: str) -> Stage:
    """Scene number `index` of a seed."""
    stage = Stage(np.random.default_rng([seed, index, [*KINDS].index(kind)]), EDITIONS[edition])
    KINDS[kind](stage)
    return stage
