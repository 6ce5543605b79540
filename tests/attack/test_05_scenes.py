"""Item 5: a resume names the scenes whose files changed."""
import hashlib
import json

from common import Attack, write_exr, write_manifest

KEYS = {"reference": "ref", "colour": "R", "feature": "normal", "mask": "mask"}


class Scenes(Attack):
    def setUp(self):
        super().setUp()
        data = self.root / "mine"
        data.mkdir()
        self.scenes = [("one", "train"), ("two", "train"), ("three", "train"), ("last", "test")]
        for number, (name, _) in enumerate(self.scenes):
            write_exr(data / f"{name}.exr", R=0.5 + number / 10)
        write_manifest(data, *((name, split, name, f"{name}.exr") for name, split in self.scenes))
        self.data = data

    def train(self, *options, steps=4):
        return self.run_program(
            "demc-train", "--config", "tiny.toml", "--run-dir", "r", "--set", "data.root=mine",
            "--set", "data.validation=0.4", "--set", f"train.steps={steps}", *options)

    def test_05_changed_scenes_are_named(self):
        self.assertEqual(self.train().code, 0)
        self.assertEqual(self.train("--resume").code, 0)
        for number, (name, _) in enumerate(self.scenes):
            path = self.data / f"{name}.exr"
            whole = path.read_bytes()
            for what, key in KEYS.items():
                write_exr(path, **{"R": 0.5 + number / 10, key: 0.75})
                for options in ([], ["--check"]):
                    with self.subTest(scene=name, what=what, options=options):
                        self.assert_refused(self.train("--resume", *options), "run.json", name, "changed since")
            path.write_bytes(whole)
        self.assertEqual(self.train("--resume").code, 0)

    def test_05_all_changed_scenes_are_named_at_once(self):
        self.assertEqual(self.train().code, 0)
        for name in ("one", "last"):
            write_exr(self.data / f"{name}.exr", ref=0.25)
        self.assert_refused(self.train("--resume"), "last, one")

    def test_05_other_scenes_and_splits_are_named(self):
        self.assertEqual(self.train().code, 0)
        path = self.data / "manifest.json"
        manifest = json.loads(path.read_text())
        for change in ("remove", "move"):
            changed = json.loads(path.read_text())
            if change == "remove":
                changed["scenes"].pop(3)
            else:
                changed["scenes"][3]["split"] = "train"
            path.write_text(json.dumps(changed))
            with self.subTest(change):
                self.assert_refused(self.train("--resume"), "run.json", "different scenes or splits", "last")
            path.write_text(json.dumps(manifest))

    def test_05_runs_without_checksums_resume(self):
        self.assertEqual(self.train().code, 0)
        checkpoint = next((self.root / "r" / "checkpoints").iterdir())
        for path in (self.root / "r" / "run.json", checkpoint / "run.json"):
            record = json.loads(path.read_text())
            self.assertEqual(sorted(record.pop("checksums")), sorted(name for name, _ in self.scenes))
            path.write_text(json.dumps(record))
        sums = checkpoint / "SHA256SUMS"
        names = [line.split("  ")[1] for line in sums.read_text().splitlines()]
        sums.write_text("".join(
            f"{hashlib.sha256((checkpoint / name).read_bytes()).hexdigest()}  {name}\n" for name in names))
        self.assertEqual(self.train("--resume").code, 0)
