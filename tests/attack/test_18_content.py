"""Items 18 to 20: data from which nothing can be learned, and images in both splits."""
import os
import shutil

from common import Attack, write_exr, write_manifest

WHOLE = "configuration and data are valid"
PROBLEMS = [({"R": 0.0, "G": 0.0, "B": 0.0}, "the noisy image is black"), ({"ref": 0.0}, "the reference is black"),
            ({"R": 1e30, "G": 1e30, "B": 1e30}, "the noisy image has only values above 1e15"),
            ({"ref": 1e30}, "the reference has only values above 1e15"),
            ({"ref": lambda x, y: 1e30 if x == y else 0.5}, "the reference has values above 1e15"),
            ({"R": 1e30}, "the noisy image has values above 1e15"), ({"normal": 0.0}, "normal is constant"),
            ({"position": 0.0}, "position is constant"), ({"albedo1": 0.0}, "texture1 is constant"),
            ({"albedo2": 0.0}, "texture2 is constant")]


class Content(Attack):
    def setUp(self):
        super().setUp()
        self.data = self.root / "mine"
        self.data.mkdir()
        for number, name in enumerate(("one", "two", "three", "four")):
            write_exr(self.data / f"{name}.exr", **{"mask": 0.5 + number / 10})
        self.list(("one", "train", "one"), ("two", "train", "two"), ("three", "test", "three"))

    def list(self, *scenes):
        write_manifest(self.data, *((name, split, base, f"{name}.exr") for name, split, base in scenes))

    def train(self, *options):
        return self.run_program("demc-train", "--config", "tiny.toml", "--run-dir", "r",
                                "--set", "data.root=mine", *options)

    def test_18_check_warns(self):
        # With 0.3, one of three training scenes is held out.
        self.list(("one", "train", "one"), ("two", "train", "two"), ("four", "train", "four"), ("three", "test", "three"))
        result = self.train("--check")
        self.assertIn(WHOLE, result.stdout, result)
        self.assertNotIn("warning", result.stdout)
        for validation in ("0.0", "0.3"):
            for values, words in PROBLEMS:
                for name in ("one", "two", "three"):
                    path = self.data / f"{name}.exr"
                    whole = path.read_bytes()
                    write_exr(path, **values)
                    result = self.train("--check", "--set", f"data.validation={validation}")
                    with self.subTest(words=words, scene=name, validation=validation):
                        self.assertEqual(result.code, 0, result)
                        self.assertIn(f"warning: {words}: {name}", result.stdout)
                        self.assertNotIn(WHOLE, result.stdout)
                    path.write_bytes(whole)

    def test_18_scenes_without_content_are_refused(self):
        """If no training scene can be learned from, nothing starts. One usable scene suffices."""
        fatal = [(values, words) for values, words in PROBLEMS if "black" in words or "only" in words]
        self.assertEqual(len(fatal), 4)
        commands = (["--check"], [], ["--set", "data.validation=0.5", "--check"])
        for number, (values, words) in enumerate(fatal):
            other = fatal[number - 1][0]
            for second, is_refused in ((values, True), (other, True), ({"normal": 0.0}, False)):
                write_exr(self.data / "one.exr", **values)
                write_exr(self.data / "two.exr", **second)
                write_exr(self.data / "three.exr", **values)
                for options in commands[:2] if is_refused else commands[::2]:
                    result = self.train(*options)
                    with self.subTest(words=words, second=second, options=options):
                        if is_refused:
                            self.assert_refused(result, "no training scene can be learned from", f"{words}: ", "one")
                            self.assertEqual(result.stderr.count("\n"), 1, result)
                            self.assertFalse((self.root / "r").exists())
                        elif "data.validation=0.5" not in options:
                            self.assertEqual(result.code, 0, result)
                            self.assertIn(f"warning: {words}: one, three", result.stdout)
                sweep = self.run_program("demc-train", "find-lr", "--config", "tiny.toml", "--set", "data.root=mine",
                                         "--steps", "10", "-o", "sweep") if is_refused else None
                if sweep:
                    self.assert_refused(sweep, "no training scene can be learned from")

    def test_18_a_tiny_loss(self):
        """Scenes of which one dark pixel is not black: the loss is nearly 0."""
        corner = lambda x, y: 1e-3 * (x == y == 63)
        for name in ("one", "two", "three", "four"):
            write_exr(self.data / f"{name}.exr", R=corner, G=0.0, B=0.0, ref=corner)
        self.list(*((name, "train", name) for name in ("one", "two", "three", "four")))
        result = self.train("--set", "train.steps=300", "--set", "run.log_every=300", "--set", "data.validation=0")
        self.assertEqual(result.code, 0, result)
        for words in ("NaN", "brings", "0.0000 over"):
            self.assertNotIn(words, result.stdout)

    def test_19_a_run_that_skipped_every_step_fails(self):
        for validation in ("0.0", "0.5"):
            # Such a weight makes every loss infinite.
            options = ["--set", "train.on_nan=skip", "--set", "loss.relmse=3e38", "--set", f"data.validation={validation}"]
            for resume in ([], ["--resume"]):
                result = self.train(*options, *resume)
                with self.subTest(validation=validation, resume=resume):
                    self.assert_refused(result, "all 2 steps were skipped", "untrained")
                    self.assertNotIn("Test split", result.stdout)
            self.assertFalse((self.root / "r" / "test.json").exists())
            self.assertFalse((self.root / "r" / "best.safetensors").exists())
            shutil.rmtree(self.root / "r")

    def test_20_one_file_under_two_names(self):
        one = self.data / "one.exr"
        (self.data / "folder").mkdir()
        os.link(one, self.data / "hard.exr")
        os.symlink("one.exr", self.data / "soft.exr")
        os.symlink(".", self.data / "here")
        for file in ("one.exr", "./one.exr", "folder/../one.exr", "hard.exr", "soft.exr", "here/one.exr", str(one)):
            for split in ("test", "train"):
                write_manifest(self.data, ("a", "train", "a", "one.exr"), ("b", split, "b", file))
                with self.subTest(file=file, split=split):
                    self.assert_refused(self.train("--check"), "scenes a and b are the same file")

    def test_20_copies_are_reported(self):
        shutil.copy(self.data / "one.exr", self.data / "four.exr")
        self.list(("one", "train", "one"), ("two", "train", "two"), ("four", "test", "four"))
        result = self.train("--check")
        self.assertIn("warning: copies of one image: four, one", result.stdout, result)
