"""Makes `expected.json` with independent implementations: `python tests/metrics/make_expected.py`.

Needs numpy, OpenEXR, scikit-image and NVIDIA's flip-evaluator from PyPI. The candidates are the sample's noisy test
images, and the references shifted by a pixel and brightened. RelMSE and similar metrics follow the papers' formulas in
float64. SSIM comes from scikit-image, FLIP from NVIDIA.
"""

import json
from pathlib import Path

import flip_evaluator
import numpy as np
import OpenEXR
from skimage.metrics import peak_signal_noise_ratio, structural_similarity

HERE = Path(__file__).parent
SCENES = HERE.parent.parent / "data" / "sample" / "test"


def read(path: Path) -> dict[str, np.ndarray]:
    """Noisy colour and reference, [H, W, 3]; negative radiance counts as 0."""
    with OpenEXR.File(str(path), separate_channels=True) as file:
        channels = {name: channel.pixels for name, channel in file.channels().items()}
    rgb = lambda prefix: np.stack([channels[prefix + c].astype(np.float32) for c in "RGB"], -1).clip(0)
    return {"color": rgb(""), "reference": rgb("ref.")}


def display(x: np.ndarray) -> np.ndarray:
    return np.clip(x.astype(np.float64), 0, 1) ** (1 / 2.2)


def metrics(c32: np.ndarray, r32: np.ndarray) -> dict[str, float]:
    c, r = c32.astype(np.float64), r32.astype(np.float64)
    square = (c - r) ** 2
    pixel = (square / (r**2 + 0.001)).sum(-1).ravel()
    inner = np.s_[21:-21, 21:-21]
    luminance = np.array([0.2126, 0.7152, 0.0722])
    shown_c, shown_r = display(c32), display(r32)
    flip_of = lambda a, b: flip_evaluator.evaluate(
        a.astype(np.float32), b.astype(np.float32), "LDR", inputsRGB=True, applyMagma=False
    )
    return {
        "relmse": pixel.mean(),
        "ssim": structural_similarity(
            shown_c, shown_r, data_range=1, channel_axis=-1,
            gaussian_weights=True, sigma=1.5, use_sample_covariance=False,
        ),
        "relmse@afgsa": 0.5 * np.mean(square / (r**2 + 0.01)),
        "relmse@sbmc": np.mean((square / (r**2 + 1e-4))[inner]),
        "mrse@pbrt": np.mean(square / (r + 0.01) ** 2),
        "relmse-trimmed": np.sort(pixel)[: pixel.size - pixel.size // 1000].mean(),
        "smape": np.mean(np.abs(c - r) / (np.abs(c) + np.abs(r) + 0.01)),
        "psnr": peak_signal_noise_ratio(shown_r, shown_c, data_range=1),
        "flip": float(flip_of(shown_r, shown_c)[0].astype(np.float64).mean()),
        "energy-bias": (c @ luminance).mean() / (r @ luminance).mean() - 1,
    }


def main() -> None:
    expected = {}
    for path in sorted(SCENES.glob("*.exr")):
        image = read(path)
        moved = np.roll(image["reference"], 1, axis=1) * np.float32(1.1)
        expected[path.stem] = {
            name: {metric: float(value) for metric, value in metrics(c, image["reference"]).items()}
            for name, c in {"noisy": image["color"], "moved": moved}.items()
        }
    (HERE / "expected.json").write_text(json.dumps(expected, indent=1) + "\n")


if __name__ == "__main__":
    main()
