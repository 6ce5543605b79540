"""Renders a scene of `scenes.py` with Mitsuba 3 (`pip install mitsuba`) to an EXR file.

    python with_mitsuba.py SCENE OUT.exr --spp 4 [--size 320x200] [--seed 0] [--plain]

The stock `aov` integrator writes the features under the names that docs/renderers.md asks for. `--plain` writes the
colour alone: a reference.

With LLVM's library (Debian: `libllvm19`; elsewhere the variable DRJIT_LIBLLVM_PATH names it) it takes a tenth of the
time.
"""

import math
import os
import sys

import numpy as np

FOLDER = os.path.dirname(os.path.abspath(__file__))
sys.path[:0] = [FOLDER, os.path.join(FOLDER, "../../tools/render")]
import scenes  # noqa: E402
from variant import mi  # noqa: E402

if "DRJIT_LIBLLVM_PATH" not in os.environ:
    mi.set_variant("scalar_rgb")

SAMPLES_AT_ONCE = 32
"""Samples per pixel of a pass; all paths of a pass are in memory."""


def rgb(color):
    return {"type": "rgb", "value": [float(x) for x in color]}


def bsdf_of(material):
    """A BSDF for a material of `scenes.py`."""
    color = rgb((0, 0, 0) if material.kind == "lamp" else material.color)
    if material.kind == "glass":
        return {"type": "dielectric", "int_ior": 1.5}
    if material.kind == "metal":
        kind = "roughconductor" if material.roughness > 0 else "conductor"
        result = {"type": kind, "specular_reflectance": color}
        return result | ({"alpha": material.roughness**2} if material.roughness > 0 else {})
    if material.kind == "plastic":
        return {"type": "roughplastic", "diffuse_reflectance": color, "alpha": max(material.roughness**2, 0.01)}
    if material.kind == "checker":
        # A unit of the coordinates has two squares in each direction, as in Cycles.
        color = {"type": "checkerboard", "color0": color, "color1": rgb(material.color2)}
    return {"type": "twosided", "bsdf": {"type": "diffuse", "reflectance": color}}


def shape_of(mesh, index):
    """A mesh with its BSDF or emitter."""
    corners = mesh.corners.reshape(-1, 3)
    properties = mi.Properties()
    if mesh.material.kind == "lamp":
        properties["emitter"] = mi.load_dict({"type": "area", "radiance": rgb(mesh.material.color)})
    properties["bsdf"] = mi.load_dict(bsdf_of(mesh.material))
    faces = np.arange(len(corners)).reshape(-1, 3)
    smooth = mesh.normals is not None
    shape = mi.Mesh(f"mesh-{index}", len(corners), len(faces), has_vertex_normals=smooth, has_vertex_texcoords=True, props=properties)
    parameters = mi.traverse(shape)
    parameters["vertex_positions"] = corners.ravel().astype(np.float32)
    parameters["faces"] = faces.ravel().astype(np.uint32)
    parameters["vertex_texcoords"] = mesh.uv.ravel().astype(np.float32)
    if smooth:
        parameters["vertex_normals"] = mesh.normals.ravel().astype(np.float32)
    parameters.update()
    return shape


def render(scene, out, size, spp, seed, plain):
    """Renders and writes one file."""
    path = {"type": "path", "max_depth": 13, "samples_per_pass": math.gcd(spp, SAMPLES_AT_ONCE)}
    aovs = {"type": "aov", "aovs": "albedo:albedo,normal:sh_normal,position:position", "image": path}
    camera = mi.ScalarTransform4f().look_at(origin=list(scene.origin), target=list(scene.target), up=[0, 0, 1])
    description = {
        "type": "scene",
        "integrator": path if plain else aovs,
        "sensor": {
            "type": "perspective",
            "fov": scene.fov,
            "fov_axis": "larger",
            "to_world": camera,
            "sampler": {"type": "independent", "sample_count": spp, "seed": seed},
            "film": {
                "type": "hdrfilm",
                "width": size[0],
                "height": size[1],
                "pixel_format": "rgb",
                "component_format": "float32",
                "rfilter": {"type": "box"},
            },
        },
    }
    if any(scene.sky):
        description["sky"] = {"type": "constant", "radiance": rgb(scene.sky)}
    for index, mesh in enumerate(scene.meshes):
        description[f"mesh-{index}"] = shape_of(mesh, index)
    loaded = mi.load_dict(description)
    mi.render(loaded, spp=spp, seed=seed)
    # The film keeps the names of the channels; `mi.Bitmap(mi.render(scene))` does not.
    loaded.sensors()[0].film().bitmap().write(out)


if __name__ == "__main__":
    scenes.run(__doc__, render)
