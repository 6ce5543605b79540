"""Open Image Denoise with denoised features, which its documentation recommends for quality."""

from __future__ import annotations

from contextlib import contextmanager

import numpy as np


def with_prefilter(color: np.ndarray, albedo: np.ndarray, normal: np.ndarray, quality: str = "high") -> np.ndarray:
    """Linear HDR colour, denoised with albedo and normal as guides; all `[H, W, 3]` float32."""
    import pyoidn

    guides = {name: prefiltered(name, feature, quality) for name, feature in (("albedo", albedo), ("normal", normal))}
    # clean_aux: the features have no noise.
    return pyoidn.denoise(color, **guides, hdr=True, clean_aux=True, quality=quality)


def prefiltered(kind: str, feature: np.ndarray, quality: str = "high") -> np.ndarray:
    """One feature, `albedo` or `normal`, denoised without guides; `quality` is `high`, `balanced`, or `fast`."""
    out = np.empty_like(feature)
    with feature_filter(kind, feature, out, quality) as filter:
        filter.execute()
    return out


@contextmanager
def feature_filter(kind: str, feature: np.ndarray, out: np.ndarray, quality: str):
    """A filter whose `execute` denoises a feature into `out`. The end raises RuntimeError if a step failed."""
    import pyoidn

    with pyoidn.Device(pyoidn.OIDN_DEVICE_TYPE_CPU) as device:
        device.commit()
        filter = pyoidn.Filter(device, pyoidn.OIDN_FILTER_TYPE_RT)
        try:
            filter.set_image(kind, feature, pyoidn.OIDN_FORMAT_FLOAT3)
            filter.set_image(pyoidn.OIDN_IMAGE_OUTPUT, out, pyoidn.OIDN_FORMAT_FLOAT3)
            filter.set_quality(getattr(pyoidn, f"OIDN_QUALITY_{quality.upper()}"))
            filter.commit()
            yield filter
            message = device.get_error()
        finally:
            filter.release()
    if message is not None:
        raise RuntimeError(f"Open Image Denoise, {kind} alone: {message}")
