"""Denoises a data set with other programs, for `--baseline NAME=DIR` of `demc-infer`.

    pip install numpy OpenEXR pyoidn scikit-image PyWavelets
    python python/tools/baselines.py oidn --data data/sample -o oidn/
    python python/tools/baselines.py nlm --data data/sample -o nlm/

oidn             Intel's Open Image Denoise: HDR colour, noisy albedo (first hit), noisy normal
oidn-prefilter   the same; albedo and normal are denoised first, as its documentation recommends
oidn-color       the same without albedo and normal
oidn-reference   the denoised *references*: about the best possible score
nlm              non-local means of scikit-image on log(1 + 16 x), without features; its strength is
                 the noise that scikit-image estimates per image

Each output is an EXR file with channels R, G, B, named like the scene's file. Existing files are
replaced.
"""

import argparse
import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np
from dataset import Scene, as_kind, scenes, write
from oidn import with_prefilter

LOG_SCALE = 16
"""Factor of the radiance before log(1 + x); dark and bright noise then have similar size."""


def oidn(image: Scene, color: str = "") -> np.ndarray:
    import pyoidn

    return pyoidn.denoise(image.rgb(color), albedo=image.rgb("albedo1."), normal=image.rgb("normal.", "XYZ"), hdr=True)


def oidn_prefilter(image: Scene) -> np.ndarray:
    return with_prefilter(image.rgb(""), image.rgb("albedo1."), image.rgb("normal.", "XYZ"))


def oidn_color(image: Scene) -> np.ndarray:
    import pyoidn

    return pyoidn.denoise(image.rgb(""), hdr=True)


def oidn_reference(image: Scene) -> np.ndarray:
    return oidn(image, color="ref.")


def nlm(image: Scene) -> np.ndarray:
    from skimage.restoration import denoise_nl_means, estimate_sigma

    log = np.log1p(LOG_SCALE * image.rgb("").clip(0))
    sigma = float(estimate_sigma(log, average_sigmas=True, channel_axis=-1))
    clean = denoise_nl_means(
        log, patch_size=5, patch_distance=7, h=0.8 * sigma, sigma=sigma, fast_mode=True, channel_axis=-1
    )
    return np.expm1(clean) / LOG_SCALE


DENOISERS: dict[str, Callable[[Scene], np.ndarray]] = {
    "oidn": oidn,
    "oidn-prefilter": oidn_prefilter,
    "oidn-color": oidn_color,
    "oidn-reference": oidn_reference,
    "nlm": nlm,
}


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("denoiser", choices=DENOISERS)
    parser.add_argument("--data", type=Path, required=True, help="directory with manifest.json")
    parser.add_argument("--split", choices=["train", "test"], default="test")
    parser.add_argument("-o", "--output", type=Path, required=True, help="directory of the images, created if missing")
    arguments = parser.parse_args()
    try:
        arguments.output.mkdir(parents=True, exist_ok=True)
        for path in scenes(arguments.data, arguments.split):
            clean = DENOISERS[arguments.denoiser](Scene(path))
            bad = int((~np.isfinite(clean)).sum())
            if bad:
                raise ValueError(f"{path}: {arguments.denoiser} produced {bad} NaN or infinite values")
            planes = {name: as_kind(clean[..., i], np.dtype(np.float16)) for i, name in enumerate("RGB")}
            write(arguments.output / f"{path.stem}.exr", planes)
    except (OSError, ValueError, RuntimeError, ImportError) as error:
        print(f"error: {error}", file=sys.stderr)
        return 1
    return 0


if __name__ == "__main__":
    sys.exit(main())
