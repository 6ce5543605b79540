"""Item 4: every flipped bit of a stored network is refused."""
import json
import random
import shutil
import struct

from common import LONG, Attack

FLIPS = 200 if LONG else 40


def flipped(data, rng):
    """A copy of the bytes with one random bit flipped, and its number."""
    bit = rng.randrange(8 * len(data))
    changed = bytearray(data)
    changed[bit // 8] ^= 1 << bit % 8
    return bytes(changed), bit


def parts(data):
    """Header (parsed) and tensor bytes of a safetensors file."""
    length = struct.unpack("<Q", data[:8])[0]
    return json.loads(data[8:8 + length]), data[8 + length:]


def file_of(header, tensors):
    """The bytes of a safetensors file."""
    text = json.dumps(header).encode()
    return struct.pack("<Q", len(text)) + text + tensors


class Checksums(Attack):
    def inspect(self, path, **options):
        return self.run_program("demc-infer", "inspect", "--model", path, **options)

    def test_04_flipped_bits_of_exports(self):
        rng = random.Random(4)
        kinds = [(names, precision) for names in ("burn", "torch") for precision in ("f32", "f16")]
        for names, precision in kinds:
            result = self.run_program("demc-infer", "export", "--model", "run", "-o", "e.safetensors", "--overwrite",
                                      "--names", names, "--precision", precision)
            self.assertEqual(result.code, 0, result)
            whole = (self.root / "e.safetensors").read_bytes()
            self.assertEqual(self.inspect("e.safetensors").code, 0)
            header_bits = 8 * (8 + struct.unpack("<Q", whole[:8])[0])
            for number in range(FLIPS // len(kinds)):
                # Half of the flips hit the header.
                region = whole[:header_bits // 8] if number % 2 else whole
                changed, bit = flipped(region, rng)
                (self.root / "flipped.safetensors").write_bytes(changed + whole[len(region):])
                with self.subTest(names=names, precision=precision, bit=bit):
                    self.assert_refused(self.inspect("flipped.safetensors"), "flipped.safetensors")

    def test_04_the_name_of_the_checksum(self):
        whole = (self.root / "model.safetensors").read_bytes()
        start = whole.index(b"sha256")
        for offset in range(6):
            for bit in range(8) if LONG else (0, 5):
                changed = bytearray(whole)
                changed[start + offset] ^= 1 << bit
                (self.root / "flipped.safetensors").write_bytes(changed)
                with self.subTest(offset=offset, bit=bit):
                    self.assert_refused(self.inspect("flipped.safetensors"), "flipped.safetensors")

    def test_04_every_reader_refuses(self):
        whole = bytearray((self.root / "model.safetensors").read_bytes())
        whole[-1000] ^= 1
        (self.root / "flipped.safetensors").write_bytes(whole)
        for command in (["denoise", "frame.exr", "-o", "o.exr"], ["evaluate", "--data", "data"], ["inspect"],
                        ["check", "frame.exr"], ["export", "-o", "e.onnx"], ["export", "-o", "e.safetensors"]):
            with self.subTest(command[0]):
                result = self.run_program("demc-infer", *command, "--model", "flipped.safetensors")
                self.assert_refused(result, "flipped.safetensors: damaged: its checksum differs")
        result = self.run_program("demc-train", "--config", "tiny.toml", "--run-dir", "r",
                                  "--set", "train.init=flipped.safetensors", "--check")
        self.assert_refused(result, "flipped.safetensors: damaged")

    def test_04_runs_and_checkpoints(self):
        rng = random.Random(5)
        checkpoint = next((self.root / "run" / "checkpoints").iterdir())
        model = checkpoint / "model.safetensors"
        whole = model.read_bytes()
        for path in ("run", checkpoint, model):
            self.assertEqual(self.inspect(path).code, 0)
            changed, bit = flipped(whole, rng)
            model.write_bytes(changed)
            with self.subTest(path=path, bit=bit):
                self.assert_refused(self.inspect(path), "model.safetensors")
            model.write_bytes(whole)
        # A model without a checksum of its own, as in older runs.
        header, tensors = parts(whole)
        entry = json.loads(header["__metadata__"]["demc"])
        del entry["sha256"]
        header["__metadata__"]["demc"] = json.dumps(entry)
        model.write_bytes(file_of(header, tensors))
        self.assert_refused(self.inspect("run"), "SHA256SUMS")
        self.assertEqual(self.inspect(model).code, 0)
        sums = checkpoint / "SHA256SUMS"
        for text in (b"", b"x", b"\xff", sums.read_bytes().replace(b"model", b"modem")):
            sums.write_bytes(text)
            with self.subTest(text=text[:5]):
                self.assert_refused(self.inspect("run"), "SHA256SUMS")

    def test_04_files_without_a_checksum_load(self):
        header, tensors = parts((self.root / "model.safetensors").read_bytes())
        entry = json.loads(header["__metadata__"]["demc"])
        del entry["sha256"]
        (self.root / "old.safetensors").write_bytes(file_of(header | {"__metadata__": {"demc": json.dumps(entry)}}, tensors))
        self.assertEqual(self.inspect("old.safetensors").code, 0)
        # The same content in another order of the header keeps its checksum.
        header, tensors = parts((self.root / "model.safetensors").read_bytes())
        (self.root / "again.safetensors").write_bytes(file_of(dict(reversed(header.items())), tensors))
        self.assertEqual(self.inspect("again.safetensors").code, 0)
        # Weights that were edited on purpose.
        changed = bytes([tensors[0] ^ 1]) + tensors[1:]
        (self.root / "edited.safetensors").write_bytes(file_of(header, changed))
        self.assert_refused(self.inspect("edited.safetensors"), "demc-infer import")
        result = self.run_program("demc-infer", "import", "edited.safetensors", "-o", "new.safetensors")
        self.assertEqual(result.code, 0, result)
        self.assertEqual(self.inspect("new.safetensors").code, 0)

    def test_04_exports_are_equal_byte_for_byte(self):
        first = (self.root / "model.safetensors").read_bytes()
        result = self.run_program("demc-infer", "export", "--model", "model.safetensors", "-o", "b.safetensors")
        self.assertEqual(result.code, 0, result)
        self.assertEqual((self.root / "b.safetensors").read_bytes(), first)
