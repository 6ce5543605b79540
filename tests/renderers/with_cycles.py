"""Renders a scene of `scenes.py` with Blender Cycles (`pip install bpy`) to a multilayer EXR file.

    python with_cycles.py SCENE OUT.exr --spp 4 [--size 320x200] [--seed 0] [--plain]

The passes are those that docs/renderers.md asks for. `--plain` writes the colour alone: a reference.
"""

import os
import sys

import bpy
import numpy as np

sys.path.insert(0, os.path.dirname(os.path.abspath(__file__)))
import scenes  # noqa: E402


def material_of(material, index):
    """A node tree for a material of `scenes.py`."""
    result = bpy.data.materials.new(f"{material.kind}-{index}")
    result.use_nodes = True
    nodes, links = result.node_tree.nodes, result.node_tree.links
    nodes.clear()
    output = nodes.new("ShaderNodeOutputMaterial")
    color = (*material.color, 1.0)
    if material.kind == "lamp":
        shader = nodes.new("ShaderNodeEmission")
        shader.inputs["Color"].default_value = color
        # The front alone emits, as in the other renderers.
        geometry, front = nodes.new("ShaderNodeNewGeometry"), nodes.new("ShaderNodeMath")
        front.operation = "SUBTRACT"
        front.inputs[0].default_value = 1.0
        links.new(geometry.outputs["Backfacing"], front.inputs[1])
        links.new(front.outputs[0], shader.inputs["Strength"])
        result.cycles.emission_sampling = "FRONT"
    elif material.kind == "glass":
        shader = nodes.new("ShaderNodeBsdfGlass")
        shader.inputs["IOR"].default_value = 1.5
        shader.inputs["Roughness"].default_value = 0.0
    elif material.kind == "metal":
        shader = nodes.new("ShaderNodeBsdfAnisotropic")
        shader.inputs["Color"].default_value = color
        shader.inputs["Roughness"].default_value = material.roughness
    elif material.kind == "plastic":
        shader = nodes.new("ShaderNodeBsdfPrincipled")
        shader.inputs["Base Color"].default_value = color
        shader.inputs["Roughness"].default_value = material.roughness
    else:
        shader = nodes.new("ShaderNodeBsdfDiffuse")
        shader.inputs["Color"].default_value = color
    if material.kind == "checker":
        checker, coordinates = nodes.new("ShaderNodeTexChecker"), nodes.new("ShaderNodeUVMap")
        coordinates.uv_map = "uv"
        checker.inputs["Color1"].default_value = color
        checker.inputs["Color2"].default_value = (*material.color2, 1.0)
        checker.inputs["Scale"].default_value = 2.0
        links.new(coordinates.outputs["UV"], checker.inputs["Vector"])
        links.new(checker.outputs["Color"], shader.inputs["Color"])
    links.new(shader.outputs[0], output.inputs["Surface"])
    return result


def add_mesh(mesh, index):
    """Adds a mesh; triangles of smooth meshes share corners."""
    corners = mesh.corners.reshape(-1, 3)
    points, place = np.unique(corners.round(6), axis=0, return_inverse=True)
    faces = place.reshape(-1, 3)
    data = bpy.data.meshes.new(f"mesh-{index}")
    data.from_pydata(points.tolist(), [], faces.tolist())
    layer = data.uv_layers.new(name="uv")
    layer.data.foreach_set("uv", mesh.uv.reshape(-1).astype(np.float32))
    data.polygons.foreach_set("use_smooth", [mesh.normals is not None] * len(faces))
    data.materials.append(material_of(mesh.material, index))
    bpy.context.scene.collection.objects.link(bpy.data.objects.new(f"object-{index}", data))


def build(scene):
    """Fills Blender's scene."""
    bpy.ops.wm.read_factory_settings(use_empty=True)
    for index, mesh in enumerate(scene.meshes):
        add_mesh(mesh, index)
    target = bpy.context.scene
    world = bpy.data.worlds.new("sky")
    world.use_nodes = True
    world.node_tree.nodes["Background"].inputs["Color"].default_value = (*scene.sky, 1.0)
    target.world = world
    camera = bpy.data.cameras.new("camera")
    camera.angle = np.radians(scene.fov)
    holder = bpy.data.objects.new("camera", camera)
    from mathutils import Vector

    holder.location = scene.origin
    holder.rotation_euler = (Vector(scene.target) - Vector(scene.origin)).to_track_quat("-Z", "Y").to_euler()
    target.collection.objects.link(holder)
    target.camera = holder
    return target


def render(scene, out, size, spp, seed, plain):
    """Renders and writes one file."""
    target = build(scene)
    target.render.engine = "CYCLES"
    target.cycles.samples = spp
    target.cycles.use_adaptive_sampling = False
    target.cycles.use_denoising = False
    target.cycles.seed = seed
    target.render.film_transparent = scene.transparent
    target.cycles.max_bounces = 12
    target.render.resolution_x, target.render.resolution_y = size
    target.render.resolution_percentage = 100
    target.render.use_persistent_data = False
    layer = target.view_layers[0]
    if not plain:
        layer.use_pass_normal = True
        layer.use_pass_position = True
        layer.cycles.denoising_store_passes = True
    image = target.render.image_settings
    if bpy.app.version >= (5, 0, 0):
        image.media_type = "MULTI_LAYER_IMAGE"
    image.file_format = "OPEN_EXR_MULTILAYER"
    image.color_depth = "32"
    image.exr_codec = "ZIP"
    target.render.filepath = os.path.abspath(out)
    target.render.use_file_extension = False
    bpy.ops.render.render(write_still=True)


if __name__ == "__main__":
    scenes.run(__doc__, render)
