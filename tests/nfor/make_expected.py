"""Makes `expected.safetensors`: NFOR of a small image, in NumPy and float64. `python tests/nfor/make_expected.py`.

Written from the paper (Bitterli et al. 2016) and the pseudocode in its supplement, with one loop over pixels and
one over neighbours; weights of NL-means as in Rousselle et al. 2012. Choices where the paper is silent are marked
"ours". `demc-infer/src/nfor/tests.rs` compares. Takes two minutes.

The file has the inputs (`color`, `normal`, `albedo`, `depth`, each with `.half1`, `.half2`, `.variance`) as float32,
the result as `denoised`, and the features of its last pass as `features`, all `[C, H, W]`.
"""

from pathlib import Path

import numpy as np
from safetensors.numpy import save_file

HEIGHT, WIDTH = 32, 40
SAMPLES = 16  # per pixel and half
EPSILON = 1e-10
RIDGE = 1e-4  # ours: for columns that hardly differ from others


def weights(image, variance, y, x, patch, window, k):
    """The neighbours of a pixel, and their weights."""
    _, height, width = image.shape
    rows = range(max(y - window, 0), min(y + window, height - 1) + 1)
    columns = range(max(x - window, 0), min(x + window, width - 1) + 1)
    neighbours = [(row, column) for row in rows for column in columns]
    return neighbours, np.array([weight(image, variance, (y, x), q, patch, k) for q in neighbours])


def weight(image, variance, p, q, patch, k):
    """exp of minus the mean distance of two patches; at an edge the patches are cut to what both have (ours)."""
    _, height, width = image.shape
    up, left = (min(patch, p[axis], q[axis]) for axis in (0, 1))
    down, right = (min(patch, size - 1 - p[axis], size - 1 - q[axis]) for axis, size in enumerate((height, width)))

    def cut(values, place):
        return values[:, place[0] - up:place[0] + down + 1, place[1] - left:place[1] + right + 1]

    noise_p, noise_q = cut(variance, p), cut(variance, q)
    squares = (cut(image, p) - cut(image, q)) ** 2 - (noise_p + np.minimum(noise_p, noise_q))
    return np.exp(-max(0.0, np.mean(squares / (EPSILON + noise_p + noise_q))) / k**2)


def nl_means(image, guide, variance, patch, window, k):
    out = np.empty_like(image)
    for y, x in np.ndindex(image.shape[1:]):
        neighbours, w = weights(guide, variance, y, x, patch, window, k)
        values = np.array([image[:, row, column] for row, column in neighbours])
        out[:, y, x] = w @ values / w.sum()
    return out


def regression(image, features, guide, variance, k):
    """Collaborative: each pixel is the weighted mean of the fits of all windows that contain it."""
    total = np.zeros(image.shape)
    total_weight = np.zeros(image.shape[1:])
    for y, x in np.ndindex(image.shape[1:]):
        neighbours, w = weights(guide, variance, y, x, 3, 9, k)
        rows = np.array([
            [column - x, row - y, *features[:, row, column]] for row, column in neighbours
        ])
        values = np.array([image[:, row, column] for row, column in neighbours])
        fitted = projection(rows, values, w)
        for (row, column), fit, weight_of_fit in zip(neighbours, fitted, w):
            total[:, row, column] += weight_of_fit * fit
            total_weight[row, column] += weight_of_fit
    return total / total_weight


def projection(columns, values, w):
    """The weighted least squares fit of `values`, damped where columns hardly differ from others (ours).

    Twice a ridge regression with columns of mean 0 and length 1: the second explains what the first left over.
    """
    root = np.sqrt(w)[:, None]
    mean = w @ values / w.sum()
    centred = columns - w @ columns / w.sum()
    length = np.sqrt((root**2 * centred**2).sum(0))
    # What is left of a constant column is rounding.
    length[length < 1e-12 * np.sqrt((root**2 * columns**2).sum(0))] = np.inf
    scaled = centred / np.where(length > 0, length, np.inf)
    left, singular, right = np.linalg.svd(root * scaled, full_matrices=False)
    damped = singular / (singular**2 + RIDGE)
    found = np.zeros((columns.shape[1], values.shape[1]))
    for _ in range(2):
        found += right.T @ (damped[:, None] * (left.T @ (root * (values - mean - scaled @ found))))
    return mean + scaled @ found


def nfor(buffers):
    halves = {name: buffer[:2] for name, buffer in buffers.items()}
    variances = {name: buffer[2] for name, buffer in buffers.items()}
    features = ("normal", "albedo", "depth")
    filtered = [
        np.concatenate([
            nl_means(halves[name][i], halves[name][1 - i], 2 * variances[name], 3, 5, 0.5) for name in features
        ])
        for i in (0, 1)
    ]
    a, b = halves["color"]
    variance = variances["color"]
    fits, errors = [], []
    for k in (0.5, 1.0):
        fit_a = regression(a, filtered[1], b, 2 * variance, k)
        fit_b = regression(b, filtered[0], a, 2 * variance, k)
        error_a = (b - fit_a) ** 2 - 2 * variance
        error_b = (a - fit_b) ** 2 - 2 * variance
        error = (error_a + error_b) / 2 - (fit_b - fit_a) ** 2 / 4
        # One choice for a pixel, not one for each channel (ours).
        errors.append(nl_means(error.mean(axis=0, keepdims=True), (a + b) / 2, variance, 1, 9, 1.0))
        fits.append((fit_a, fit_b))
    is_wide = np.float64(errors[0] >= errors[1])
    wide = nl_means(is_wide, (a + b) / 2, variance, 1, 9, 1.0)
    result_a, result_b = ((1 - wide) * narrow + wide * broad for narrow, broad in zip(*fits))
    last_features = []
    for name, channels in zip(features, (slice(0, 3), slice(3, 6), slice(6, 7))):
        mean = (filtered[0][channels] + filtered[1][channels]) / 2
        last_features.append(nl_means(mean, mean, (filtered[1][channels] - filtered[0][channels]) ** 2 / 4, 3, 2, 0.5))
    mean = (result_a + result_b) / 2
    last_features = np.concatenate(last_features)
    last = regression(mean, last_features, mean, (result_b - result_a) ** 2 / 4, 1.0)
    return {"denoised": np.maximum(last, 0), "features": last_features}


def rendered(random):
    """A ball before a wall with a pattern, as samples: edges within pixels, light with a few bright samples."""
    samples = 2 * SAMPLES
    y, x = np.mgrid[0:HEIGHT, 0:WIDTH]
    y = y + random.uniform(size=(samples, HEIGHT, WIDTH))
    x = x + random.uniform(size=(samples, HEIGHT, WIDTH))
    radius = 11.0
    across, up = (x - 24) / radius, (y - 15) / radius
    square = across**2 + up**2
    is_ball = square < 1
    forward = np.sqrt(np.maximum(1 - square, 0))
    normal = np.stack([np.where(is_ball, across, 0), np.where(is_ball, up, 0), np.where(is_ball, forward, 1)], 1)
    boards = ((x // 8 + y // 8) % 2)[:, None]
    wall = 0.2 + 0.6 * boards * np.array([1.0, 0.7, 0.4])[None, :, None, None]
    albedo = np.where(is_ball[:, None], np.array([0.3, 0.5, 0.8])[None, :, None, None], wall)
    depth = np.where(is_ball, 5 - forward, 6 + 0.02 * x)[:, None]
    light = np.maximum(0.7 * normal[:, 2] - 0.4 * normal[:, 1] + 0.1, 0.05)
    light = light * random.gamma(0.4, 1 / 0.4, light.shape) * np.where(random.uniform(size=light.shape) < 0.002, 30, 1)
    return {"color": albedo * light[:, None], "normal": normal, "albedo": albedo, "depth": depth}


def main():
    random = np.random.RandomState(3)
    buffers = {}
    for name, samples in rendered(random).items():
        halves = samples[:SAMPLES].mean(0), samples[SAMPLES:].mean(0)
        variance = samples.var(0, ddof=1) / len(samples)
        # Files are half; inputs have the same values in float32 and float64.
        buffers[name] = [np.float64(np.float16(values)) for values in (*halves, variance)]
    tensors = {
        f"{name}.{kind}": np.ascontiguousarray(values, np.float32)
        for name, three in buffers.items() for kind, values in zip(("half1", "half2", "variance"), three)
    }
    tensors |= {name: np.ascontiguousarray(values, np.float32) for name, values in nfor(buffers).items()}
    path = Path(__file__).with_name("expected.safetensors")
    save_file(tensors, path)
    path.chmod(0o644)


if __name__ == "__main__":
    main()
