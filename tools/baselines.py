"""Denoises a data set with other programs, for `--baseline NAME=DIR` of `demc-infer`.

    pip install numpy OpenEXR pyoidn scikit-image PyWavelets
    python tools/baselines.py oidn --data data/sample -o oidn/
    python tools/baselines.py nlm --data data/sample -o nlm/

oidn             Intel's Open Image Denoise: HDR colour, noisy albedo (first hit), noisy normal
oidn-prefilter   the same; albedo and normal are denoised first, as its documentation recommends
oidn-fast, oidn-fast-prefilter
                 the same two in the quality "fast"
oidn-balanced-prefilter
                 oidn-prefilter with the smaller network of the quality "balanced"
oidn-albedo      oidn with the albedo denoised first
oidn-color       the first without albedo and normal
oidn-reference   the denoised *references*: about the best possible score
nlm              non-local means of scikit-image on log(1 + 16 x), without features; its strength is
                 the noise that scikit-image estimates per image

The channels are found as `demc-infer` finds them, per file (docs/data.md#channel-layouts).
Each output is an EXR file with channels R, G, B, named like the scene's file. Existing files are
replaced.
"""

import argparse
import sys
from collections.abc import Callable
from functools import partial
from pathlib import Path

import numpy as np
from dataset import add_layout_flags, albedo, normal, pixels, reference, scenes, write
from demc.torch.exr import Frame, as_kind, read_exr
from demc.torch.layouts import BUFFERS
from oidn import prefiltered, with_prefilter

LOG_SCALE = 16
"""Factor of the radiance before log(1 + x); dark and bright noise then have similar size."""


def oidn(frame: Frame, quality: str = "high") -> np.ndarray:
    import pyoidn

    return pyoidn.denoise(pixels(frame.color), albedo=albedo(frame), normal=normal(frame), hdr=True, quality=quality)


def oidn_prefilter(frame: Frame, quality: str = "high") -> np.ndarray:
    return with_prefilter(pixels(frame.color), albedo(frame), normal(frame), quality)


def oidn_albedo(frame: Frame) -> np.ndarray:
    import pyoidn

    return pyoidn.denoise(pixels(frame.color), albedo=prefiltered("albedo", albedo(frame)), normal=normal(frame), hdr=True)


def oidn_color(frame: Frame) -> np.ndarray:
    import pyoidn

    return pyoidn.denoise(pixels(frame.color), hdr=True)


def oidn_reference(frame: Frame) -> np.ndarray:
    import pyoidn

    return pyoidn.denoise(reference(frame), albedo=albedo(frame), normal=normal(frame), hdr=True)


def nlm(frame: Frame) -> np.ndarray:
    from skimage.restoration import denoise_nl_means, estimate_sigma

    log = np.log1p(LOG_SCALE * pixels(frame.color))
    sigma = float(estimate_sigma(log, average_sigmas=True, channel_axis=-1))
    clean = denoise_nl_means(
        log, patch_size=5, patch_distance=7, h=0.8 * sigma, sigma=sigma, fast_mode=True, channel_axis=-1
    )
    return np.expm1(clean) / LOG_SCALE


DENOISERS: dict[str, Callable[[Frame], np.ndarray]] = {
    "oidn": oidn,
    "oidn-prefilter": oidn_prefilter,
    "oidn-fast": partial(oidn, quality="fast"),
    "oidn-fast-prefilter": partial(oidn_prefilter, quality="fast"),
    "oidn-balanced-prefilter": partial(oidn_prefilter, quality="balanced"),
    "oidn-albedo": oidn_albedo,
    "oidn-color": oidn_color,
    "oidn-reference": oidn_reference,
    "nlm": nlm,
}
WITHOUT_FEATURES = ("oidn-color", "nlm")


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("denoiser", choices=DENOISERS)
    parser.add_argument("--data", type=Path, required=True, help="directory with manifest.json")
    parser.add_argument("--split", choices=["train", "test"], default="test")
    parser.add_argument("-o", "--output", type=Path, required=True, help="directory of the images, created if missing")
    add_layout_flags(parser)
    arguments = parser.parse_args()
    missing = dict.fromkeys(BUFFERS, "zeros") if arguments.denoiser in WITHOUT_FEATURES else None
    try:
        arguments.output.mkdir(parents=True, exist_ok=True)
        for path in scenes(arguments.data, arguments.split):
            frame = read_exr(path, arguments.layout, arguments.layer, missing=missing)
            clean = DENOISERS[arguments.denoiser](frame)
            bad = int((~np.isfinite(clean)).sum())
            if bad:
                raise ValueError(f"{path}: {arguments.denoiser} produced {bad} NaN or infinite values")
            planes = {name: as_kind(clean[..., i], np.float16) for i, name in enumerate("RGB")}
            write(arguments.output / f"{path.stem}.exr", planes)
    except (OSError, ValueError, KeyError, RuntimeError, ImportError) as error:
        print(f"error: {error}", file=sys.stderr)
        return 1
    return 0


if __name__ == "__main__":
    sys.exit(main())
