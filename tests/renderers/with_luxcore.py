"""Renders a scene of `scenes.py` with LuxCore (`pip install pyluxcore`) to EXR files.

    python with_luxcore.py SCENE OUT.exr --spp 4 [--size 320x200] [--seed 0] [--plain]

LuxCore writes each output as a file of its own with channels R, G, B: the colour to OUT.exr, and the features to
OUT.albedo.exr, OUT.normal.exr and OUT.position.exr. `--plain` writes the colour alone: a reference.
"""

import os
import sys
import time

import numpy as np
import pyluxcore

sys.path.insert(0, os.path.dirname(os.path.abspath(__file__)))
import scenes  # noqa: E402

pyluxcore.Init()

OUTPUTS = {"": "RGB", "albedo": "ALBEDO", "normal": "AVG_SHADING_NORMAL", "position": "POSITION"}


def material_of(name, material):
    """Properties of a material of `scenes.py`."""
    color = [float(x) for x in material.color]
    start, textures = f"scene.materials.{name}.", {}
    if material.kind == "lamp":
        values = {"type": "matte", "kd": [0.0] * 3, "emission": color, "emission.power": 0.0, "emission.normalizebycolor": 0}
    elif material.kind == "glass":
        values = {"type": "glass", "kr": [1.0] * 3, "kt": [1.0] * 3, "interiorior": 1.5}
    elif material.kind == "metal":
        rough = max(material.roughness**2, 1e-4)
        kind = {"type": "mirror", "kr": color} if material.roughness == 0 else {"type": "metal2"}
        values = kind if material.roughness == 0 else kind | {"fresnel": f"{name}-f", "uroughness": rough, "vroughness": rough}
        textures = {f"scene.textures.{name}-f.type": "fresnelcolor", f"scene.textures.{name}-f.kr": color}
    elif material.kind == "plastic":
        rough = max(material.roughness**2, 0.01)
        values = {"type": "glossy2", "kd": color, "ks": [0.04] * 3, "uroughness": rough, "vroughness": rough}
    elif material.kind == "checker":
        values = {"type": "matte", "kd": f"{name}-c"}
        start_texture = f"scene.textures.{name}-c."
        dark = [float(x) for x in material.color2]
        values_texture = {"type": "checkerboard2d", "texture1": color, "texture2": dark, "mapping.type": "uvmapping2d", "mapping.uvscale": [2.0, 2.0]}
        textures = {start_texture + key: value for key, value in values_texture.items()}
    else:
        values = {"type": "matte", "kd": color}
    return textures | {start + key: value for key, value in values.items()}


def properties(values):
    """LuxCore's properties of a dictionary."""
    result = pyluxcore.Properties()
    for key, value in values.items():
        result.Set(pyluxcore.Property(key, value))
    return result


def build(source):
    """LuxCore's scene."""
    scene = pyluxcore.Scene()
    camera = {"type": "perspective", "lookat.orig": list(map(float, source.origin)), "lookat.target": list(map(float, source.target)),
              "up": [0.0, 0.0, 1.0], "fieldofview": float(source.fov), "autovolume.enable": 0}
    scene.Parse(properties({f"scene.camera.{key}": value for key, value in camera.items()}))
    if any(source.sky):
        sky = {"type": "constantinfinite", "color": list(map(float, source.sky))}
        scene.Parse(properties({f"scene.lights.sky.{key}": value for key, value in sky.items()}))
    for index, mesh in enumerate(source.meshes):
        name = f"m{index}"
        corners = [tuple(map(float, corner)) for corner in mesh.corners.reshape(-1, 3)]
        faces = [(i, i + 1, i + 2) for i in range(0, len(corners), 3)]
        normals = None if mesh.normals is None else [tuple(map(float, n)) for n in mesh.normals.reshape(-1, 3)]
        scene.DefineMesh(name, corners, faces, normals, [tuple(map(float, uv)) for uv in mesh.uv.reshape(-1, 2)], None, None)
        scene.Parse(properties(material_of(name, mesh.material)))
        scene.Parse(properties({f"scene.objects.{name}.shape": name, f"scene.objects.{name}.material": name}))
    return scene


def render(source, out, size, spp, seed, plain):
    """Renders and writes the files."""
    stem = out.removesuffix(".exr")
    outputs = {"": "RGB"} if plain else OUTPUTS
    config = {"renderengine.type": "PATHCPU", "renderengine.seed": seed + 1, "sampler.type": "RANDOM", "film.width": size[0], "film.height": size[1],
              "film.filter.type": "BOX", "film.filter.width": 0.5, "path.pathdepth.total": 13, "path.clamping.variance.maxvalue": 0.0,
              "batch.haltspp": spp, "film.imagepipelines.0.0.type": "NOP"}
    for index, (name, kind) in enumerate(outputs.items()):
        config[f"film.outputs.{index}.type"] = kind
        config[f"film.outputs.{index}.filename"] = f"{stem}.{name}.exr" if name else out
    session = pyluxcore.RenderSession(pyluxcore.RenderConfig(properties(config), build(source)))
    session.Start()
    while not session.HasDone():
        time.sleep(0.05)
        session.UpdateStats()
    session.Stop()
    session.GetFilm().Save()


if __name__ == "__main__":
    scenes.run(__doc__, render)
