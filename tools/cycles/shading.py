"""Random materials and volumes of Blender: Principled shaders on procedural textures."""

from __future__ import annotations

import colorsys
from dataclasses import dataclass

import bpy
import numpy as np

Rng = np.random.Generator


@dataclass(frozen=True)
class Texture:
    """A texture node and how to set it up: the range of inputs, and choices of properties."""

    node: str
    output: str
    inputs: dict[str, tuple[float, float]]
    choices: dict[str, tuple[str, ...]]


NOISE = Texture(
    "ShaderNodeTexNoise",
    "Fac",
    {"Scale": (1, 20), "Detail": (0, 8), "Roughness": (0.3, 0.8), "Distortion": (0, 3)},
    {"noise_type": ("FBM", "MULTIFRACTAL", "RIDGED_MULTIFRACTAL")},
)
WAVE = Texture(
    "ShaderNodeTexWave",
    "Fac",
    {"Scale": (1, 15), "Distortion": (0, 12), "Detail": (0, 5)},
    {"wave_type": ("BANDS", "RINGS"), "bands_direction": ("X", "Y", "DIAGONAL"), "wave_profile": ("SIN", "SAW", "TRI")},
)
CHECKER = Texture("ShaderNodeTexChecker", "Fac", {"Scale": (2, 30)}, {})
CELLS = Texture(
    "ShaderNodeTexVoronoi",
    "Distance",
    {"Scale": (2, 25), "Randomness": (0.2, 1)},
    {"feature": ("F1", "SMOOTH_F1", "DISTANCE_TO_EDGE"), "distance": ("EUCLIDEAN", "MANHATTAN", "CHEBYCHEV")},
)
BRICK = Texture("ShaderNodeTexBrick", "Fac", {"Scale": (2, 12), "Mortar Size": (0.005, 0.06)}, {})
MAGIC = Texture("ShaderNodeTexMagic", "Fac", {"Scale": (1, 8), "Distortion": (0.5, 3)}, {})


def color(rng: Rng) -> tuple[float, float, float]:
    """A reflectance: mostly muted, rarely bright and saturated."""
    return colorsys.hsv_to_rgb(rng.random(), rng.beta(1.0, 3.0), rng.uniform(0.05, 0.9))


def logarithmic(rng: Rng, low: float, high: float) -> float:
    """A number between both, uniform in its logarithm."""
    return float(np.exp(rng.uniform(np.log(low), np.log(high))))


class Painter:
    """Makes the materials of a scene from the textures of an edition."""

    def __init__(self, rng: Rng, textures: tuple[Texture, ...]) -> None:
        self.rng, self.textures = rng, textures
        self.materials = [self.material() for _ in range(rng.integers(5, 12))]

    def any_material(self) -> bpy.types.Material:
        return self.materials[self.rng.integers(len(self.materials))]

    def nodes(self, name: str) -> tuple[bpy.types.Material, bpy.types.NodeTree]:
        """A material without nodes but its output."""
        made = bpy.data.materials.new(name)
        made.use_nodes = True
        made.node_tree.nodes.clear()
        made.node_tree.nodes.new("ShaderNodeOutputMaterial")
        return made, made.node_tree

    def finish(self, made: bpy.types.Material, socket: bpy.types.NodeSocket, target: str) -> bpy.types.Material:
        """Links a shader to the `target` of the output: `Surface` or `Volume`."""
        tree = made.node_tree
        output = next(node for node in tree.nodes if node.type == "OUTPUT_MATERIAL")
        tree.links.new(socket, output.inputs[target])
        return made

    def texture(self, tree: bpy.types.NodeTree, kind: Texture | None = None, size: float = 1.0) -> bpy.types.NodeSocket:
        """Values from 0 to about 1 of a random texture; `size` of its features, in object units."""
        rng = self.rng
        kind = kind or self.textures[rng.integers(len(self.textures))]
        node, place = tree.nodes.new(kind.node), tree.nodes.new("ShaderNodeTexCoord")
        turn = tree.nodes.new("ShaderNodeMapping")
        turn.inputs["Rotation"].default_value = rng.uniform(0, 6.28, 3)
        turn.inputs["Location"].default_value = rng.uniform(-100, 100, 3)
        turn.inputs["Scale"].default_value = np.full(3, 1 / size)
        tree.links.new(place.outputs["Object"], turn.inputs["Vector"])
        tree.links.new(turn.outputs["Vector"], node.inputs["Vector"])
        for name, (low, high) in kind.inputs.items():
            node.inputs[name].default_value = logarithmic(rng, low, high) if low > 0 else float(rng.uniform(low, high))
        for name, values in kind.choices.items():
            setattr(node, name, str(rng.choice(values)))
        return node.outputs[kind.output]

    def paint(self, tree: bpy.types.NodeTree) -> bpy.types.NodeSocket:
        """Two to five colours by the values of a texture, smooth or with hard edges."""
        rng = self.rng
        ramp = tree.nodes.new("ShaderNodeValToRGB")
        ramp.color_ramp.interpolation = str(rng.choice(["LINEAR", "CONSTANT"], p=[0.6, 0.4]))
        elements = ramp.color_ramp.elements
        for position in np.sort(rng.uniform(0.15, 0.85, rng.integers(0, 4))):
            elements.new(float(position))
        for element in elements:
            element.color = (*color(rng), 1.0)
        tree.links.new(self.texture(tree), ramp.inputs["Fac"])
        return ramp.outputs["Color"]

    def material(self) -> bpy.types.Material:
        """Paint, plastic, lacquer, cloth, wax, metal, or glass."""
        rng = self.rng
        made, tree = self.nodes("material")
        shader = tree.nodes.new("ShaderNodeBsdfPrincipled")
        inputs = shader.inputs
        kind = rng.choice(["paint", "gloss", "cloth", "wax", "metal", "glass"], p=[0.4, 0.25, 0.08, 0.05, 0.14, 0.08])
        inputs["Base Color"].default_value = (*color(rng), 1.0)
        inputs["Roughness"].default_value = float(rng.uniform(0.6, 1) if kind in ("paint", "cloth") else rng.uniform(0.02, 0.5))
        if kind != "glass" and rng.random() < 0.65:
            tree.links.new(self.paint(tree), inputs["Base Color"])
        if kind == "paint":
            inputs["Specular IOR Level"].default_value = 0.0
        elif kind == "gloss":
            inputs["Coat Weight"].default_value = float(rng.choice([0, 1]))
        elif kind == "cloth":
            inputs["Sheen Weight"].default_value = float(rng.uniform(0.3, 1))
        elif kind == "wax":
            inputs["Subsurface Weight"].default_value = 1.0
            inputs["Subsurface Scale"].default_value = logarithmic(rng, 0.01, 0.1)
        elif kind == "metal":
            inputs["Metallic"].default_value = 1.0
            inputs["Anisotropic"].default_value = float(rng.choice([0, rng.uniform(0.2, 0.9)]))
        else:
            inputs["Transmission Weight"].default_value = 1.0
            inputs["Base Color"].default_value = (*rng.uniform(0.8, 1, 3), 1.0)
            inputs["Roughness"].default_value = float(rng.choice([0, rng.uniform(0.02, 0.3)], p=[0.7, 0.3]))
            inputs["IOR"].default_value = float(rng.uniform(1.3, 1.7))
        if kind != "glass" and rng.random() < 0.35:
            bump = tree.nodes.new("ShaderNodeBump")
            bump.inputs["Strength"].default_value = float(rng.uniform(0.1, 0.8))
            bump.inputs["Distance"].default_value = 0.05
            tree.links.new(self.texture(tree), bump.inputs["Height"])
            tree.links.new(bump.outputs["Normal"], inputs["Normal"])
        return self.finish(made, shader.outputs["BSDF"], "Surface")

    def lamp(self, strength: float) -> bpy.types.Material:
        """A glowing surface of a warm, white, or coloured light; `strength` in W/m^2/sr."""
        made, tree = self.nodes("lamp")
        shader = tree.nodes.new("ShaderNodeEmission")
        shader.inputs["Color"].default_value = (*self.light_color(), 1.0)
        shader.inputs["Strength"].default_value = strength
        return self.finish(made, shader.outputs["Emission"], "Surface")

    def light_color(self) -> tuple[float, float, float]:
        rng = self.rng
        return tuple(rng.uniform(0.1, 1, 3)) if rng.random() < 0.2 else (1.0, rng.uniform(0.7, 1), rng.uniform(0.45, 1))

    def hair(self) -> bpy.types.Material:
        """Hair from blond to black, or dyed."""
        rng = self.rng
        made, tree = self.nodes("hair")
        shader = tree.nodes.new("ShaderNodeBsdfHairPrincipled")
        inputs = {socket.identifier: socket for socket in shader.inputs}
        shader.parametrization = "MELANIN" if rng.random() < 0.6 else "COLOR"
        inputs["Color"].default_value = (*color(rng), 1.0)
        inputs["Melanin"].default_value = float(rng.random())
        inputs["Melanin Redness"].default_value = float(rng.random())
        inputs["Roughness"].default_value = float(rng.uniform(0.1, 0.5))
        return self.finish(made, shader.outputs["BSDF"], "Surface")

    def mist(self, depth: float) -> bpy.types.Material:
        """The same density everywhere; light travels about `depth` metres."""
        rng = self.rng
        made, tree = self.nodes("mist")
        shader = tree.nodes.new("ShaderNodeVolumePrincipled")
        shader.inputs["Color"].default_value = (*rng.uniform(0.6, 1, 3), 1.0)
        shader.inputs["Density"].default_value = 1 / depth
        shader.inputs["Anisotropy"].default_value = float(rng.uniform(-0.2, 0.8))
        return self.finish(made, shader.outputs["Volume"], "Volume")

    def smoke(self, density: float, white: bool) -> bpy.types.Material:
        """A ball of smoke or cloud, radius 1 in object units, thinner outwards, torn by noise."""
        rng = self.rng
        made, tree = self.nodes("smoke")
        nodes, links = tree.nodes, tree.links

        def math(operation: str, *inputs: object) -> bpy.types.NodeSocket:
            node = nodes.new("ShaderNodeMath")
            node.operation = operation
            for socket, value in zip(node.inputs, inputs):
                if isinstance(value, bpy.types.NodeSocket):
                    links.new(value, socket)
                else:
                    socket.default_value = value
            return node.outputs[0]

        place, length = nodes.new("ShaderNodeTexCoord"), nodes.new("ShaderNodeVectorMath")
        length.operation = "LENGTH"
        links.new(place.outputs["Object"], length.inputs[0])
        torn = self.texture(tree, NOISE, logarithmic(rng, 3, 12))
        # Nothing is left at a distance of 1.
        whole = math("MULTIPLY", math("SUBTRACT", 1.0, length.outputs["Value"]), logarithmic(rng, 1, 2.5))
        inside = math("SUBTRACT", math("ADD", whole, math("MINIMUM", torn, 1.0)), 1.0)
        edge = math("MULTIPLY", math("MAXIMUM", inside, 0.0), logarithmic(rng, 1, 8))
        shader = nodes.new("ShaderNodeVolumePrincipled")
        tint = rng.uniform(0.9, 1, 3) if white else np.array(color(rng)) * rng.uniform(0.3, 1)
        shader.inputs["Color"].default_value = (*tint, 1.0)
        shader.inputs["Anisotropy"].default_value = float(rng.uniform(0, 0.85 if white else 0.5))
        links.new(math("MULTIPLY", math("MINIMUM", edge, 1.0), density), shader.inputs["Density"])
        return self.finish(made, shader.outputs["Volume"], "Volume")
