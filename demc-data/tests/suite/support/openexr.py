"""check | write KIND PATH COMPRESSION | compare KIND INPUT OUTPUT"""
import sys
import numpy as np
import OpenEXR

H, W = 40, 48
HALF = "R G B A normal.X normal.Y normal.Z albedo1.R albedo1.G albedo1.B albedo2.R albedo2.G albedo2.B ref.R ref.G ref.B"
FLOAT = "position.X position.Y position.Z"


def channels(names, kind, seed):
    rng = np.random.default_rng(seed)
    samples = {n: rng.uniform(0, 4, (H, W)).astype(kind) for n in names.split()}
    if kind == np.uint32:
        samples = {n: rng.integers(0, 2**32, (H, W), dtype=np.uint32) for n in names.split()}
    return {n: OpenEXR.Channel(a) for n, a in samples.items()}


def header(compression, tiled=False):
    attributes = {
        "compression": getattr(OpenEXR, compression + "_COMPRESSION"),
        "type": OpenEXR.tiledimage if tiled else OpenEXR.scanlineimage,
        "dataWindow": (np.array([-3, 5], np.int32), np.array([W - 4, H + 4], np.int32)),
        "displayWindow": (np.array([-10, 0], np.int32), np.array([99, 79], np.int32)),
        "pixelAspectRatio": 1.25,
        "chromaticities": (0.64, 0.33, 0.3, 0.6, 0.15, 0.06, 0.3127, 0.329),
        "comments": "K\u00fcche",
        "demc": '{"spp": 4}',
        "owner": "nobody",
        "worldToCamera": np.eye(4, dtype=np.float32),
    }
    if tiled:
        attributes["tiles"] = OpenEXR.TileDescription()
        attributes["tiles"].xSize = attributes["tiles"].ySize = 16
    return attributes


def write(kind, path, compression):
    rgba = channels(HALF, np.float16, 1) | channels(FLOAT, np.float32, 2)
    rgba["mask.A"] = OpenEXR.Channel(np.ones((H, W), np.float16))
    if kind == "parts":
        other = channels("id", np.uint32, 3) | channels("Z", np.float32, 4)
        parts = [
            OpenEXR.Part(header("PXR24"), other, "other"),
            OpenEXR.Part(header(compression), rgba, "rgba"),
            OpenEXR.Part(header("DWAB", tiled=True), channels("R G B", np.float16, 5), "dct"),
        ]
        OpenEXR.File(parts).write(path)
    else:
        OpenEXR.File(header(compression, kind == "tiles"), rgba).write(path)


def same(a, b):
    if isinstance(a, (tuple, list)):
        return len(a) == len(b) and all(same(x, y) for x, y in zip(a, b))
    if isinstance(a, np.ndarray):
        return np.array_equal(a, b)
    if isinstance(a, OpenEXR.TileDescription):
        return (a.xSize, a.ySize, a.mode) == (b.xSize, b.ySize, b.mode)
    return a == b


def read(path):
    file = OpenEXR.File(path, separate_channels=True)
    file.parts  # keeps the samples alive
    return file


def compare(kind, input, output):
    before, after = read(input), read(output)
    parts = list(zip(before.parts, after.parts))
    if kind == "color":
        parts = [(p, after.parts[0]) for p in before.parts if p.name() == "rgba"]
        assert len(after.parts) == 1
    else:
        assert len(before.parts) == len(after.parts)
    color = (np.arange(3 * H * W) % 2039 / 8).astype(np.float32).reshape(3, H, W)
    for old, new in parts:
        assert old.name() == new.name() or kind == "color", (old.name(), new.name())
        recoded = len(before.parts) == 1 or old.name() == "rgba"
        for key, value in old.header.items():
            lossy = value in (OpenEXR.PXR24_COMPRESSION, OpenEXR.B44_COMPRESSION, OpenEXR.B44A_COMPRESSION,
                              OpenEXR.DWAA_COMPRESSION, OpenEXR.DWAB_COMPRESSION) if key == "compression" else False
            if key in ("channels", "chunkCount") or key == "compression" and (kind == "near" or lossy and recoded):
                continue
            assert key in new.header, key
            assert same(value, new.header[key]), (key, value, new.header[key])
        names = set(old.channels)
        assert set(new.channels) == ({"R", "G", "B", "A"} if kind == "color" else names), new.channels
        for name, channel in new.channels.items():
            pixels, expected = channel.pixels, old.channels[name].pixels
            assert pixels.dtype == expected.dtype, name
            if recoded and name in ("R", "G", "B"):
                expected = color["RGB".index(name)].astype(expected.dtype)
            if kind == "near":
                error = np.abs(pixels.astype(np.float64) - expected.astype(np.float64))
                assert error.mean() < 0.05 * np.abs(expected).mean(), (name, error.mean())
            else:
                assert pixels.tobytes() == expected.tobytes(), name


if sys.argv[1] != "check":
    globals()[sys.argv[1]](*sys.argv[2:])
