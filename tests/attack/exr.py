"""Writes the scenes that attacks need: uncompressed EXR files with the channels of the layout demc-exr."""
import json
import struct

CHANNELS = [*"RGB", *(f"{buffer}.{axis}" for buffer in ("normal", "position") for axis in "XYZ"),
            *(f"{buffer}.{color}" for buffer in ("albedo1", "albedo2", "ref") for color in "RGB"), "mask.A"]


def write(path, side=64, **values):
    """A square image. The samples of a channel vary around 0.5; a keyword (`R`, `normal`, `ref`) replaces those
    of one channel or buffer by a constant."""
    def attribute(name, kind, data):
        return name.encode() + b"\0" + kind.encode() + b"\0" + struct.pack("<i", len(data)) + data

    names = sorted(CHANNELS)
    channels = b"".join(name.encode() + b"\0" + struct.pack("<iBBBBii", 2, 0, 0, 0, 0, 1, 1) for name in names)
    window = struct.pack("<iiii", 0, 0, side - 1, side - 1)
    header = b"".join((
        struct.pack("<ii", 20000630, 2),
        attribute("channels", "chlist", channels + b"\0"),
        attribute("compression", "compression", b"\0"),
        attribute("dataWindow", "box2i", window),
        attribute("displayWindow", "box2i", window),
        attribute("lineOrder", "lineOrder", b"\0"),
        attribute("pixelAspectRatio", "float", struct.pack("<f", 1)),
        attribute("screenWindowCenter", "v2f", struct.pack("<ff", 0, 0)),
        attribute("screenWindowWidth", "float", struct.pack("<f", 1)),
        b"\0"))
    size = 8 + 4 * side * len(names)
    first = len(header) + 8 * side
    offsets = b"".join(struct.pack("<Q", first + y * size) for y in range(side))
    lines = []
    for y in range(side):
        line = []
        for number, name in enumerate(names):
            value = values.get(name, values.get(name.split(".")[0]))
            line += ([value] * side if value is not None else
                     [0.3 + ((x * 7 + y * 13 + number * 29) % 41) / 100 for x in range(side)])
        lines.append(struct.pack("<ii", y, size - 8) + struct.pack(f"<{len(line)}f", *line))
    path.write_bytes(header + offsets + b"".join(lines))


def manifest(folder, *scenes):
    """Writes `manifest.json` for scenes `(name, split, base, file)` of 64x64 pixels."""
    entries = [dict(name=name, split=split, base=base, file=file, width=64, height=64)
               for name, split, base, file in scenes]
    (folder / "manifest.json").write_text(json.dumps({"format": "demc-exr 1", "scenes": entries}))
