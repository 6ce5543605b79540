#!/usr/bin/env python3
"""Tests of .ci/run on a small repository with sections of its own, and of .ci/circles.py on small crates."""

import os
import shutil
import subprocess
import sys
import tempfile
import unittest
from pathlib import Path

HERE = Path(__file__).resolve().parent
TABLE = """
[[section]]
name = "format"
fast = true
required = true
seconds = 1
run = "echo format >>ran; {format}"

[[section]]
name = "tests"
required = true
seconds = 1
run = "echo tests >>ran; {tests}"

[[section]]
name = "library"
seconds = 1
paths = ["library"]
crates = ["one"]
run = "echo library >>ran; {library}"

[[section]]
name = "after-library"
seconds = 1
needs = ["library"]
run = "echo after-library >>ran"

[[section]]
name = "page"
seconds = 1
run = '''
block denoise
'''
"""


class Checks(unittest.TestCase):
    def setUp(self):
        folder = tempfile.TemporaryDirectory()
        self.addCleanup(folder.cleanup)
        self.root = Path(folder.name)
        (self.root / ".ci").mkdir()
        for name in ("run", "checks.py", "prelude.sh", "docs.py"):
            shutil.copy(HERE / name, self.root / ".ci" / name)
        for path, text in {
            "Cargo.toml": '[workspace]\nmembers = ["one", "two"]\n',
            "one/Cargo.toml": '[package]\nname = "one"\n[dependencies]\ntwo = "1"\n',
            "two/Cargo.toml": '[package]\nname = "two"\n',
            "two/src/lib.rs": "",
            "library/file": "",
            "other": "",
            "README.md": "<!-- ci: denoise -->\n```sh\necho page >>ran\n```\n",
            ".gitignore": "ran\ncache\n",
        }.items():
            (self.root / path).parent.mkdir(parents=True, exist_ok=True)
            (self.root / path).write_text(text)
        self.table()
        self.git("init", "-q")
        self.commit()
        self.write(".ci/all-passed", self.git("rev-parse", "HEAD"))
        self.commit()

    def table(self, **commands):
        text = TABLE
        for name in ("format", "tests", "library"):
            text = text.replace(f"{{{name}}}", commands.get(name, "true"))
        (self.root / ".ci/sections.toml").write_text(text)

    def write(self, path, text):
        (self.root / path).write_text(text)

    def git(self, *arguments):
        command = ["git", "-c", "user.name=a", "-c", "user.email=a@b", *arguments]
        return subprocess.run(command, cwd=self.root, check=True, text=True, capture_output=True).stdout.strip()

    def commit(self):
        self.git("add", "-A")
        self.git("commit", "-q", "-m", "change")

    def run_checks(self, *arguments):
        """The exit code, what ran, and the output."""
        (self.root / "ran").unlink(missing_ok=True)
        environment = {"PATH": os.environ["PATH"], "DEMC_CACHE": str(self.root / "cache"), "HOME": str(self.root)}
        done = subprocess.run(["bash", self.root / ".ci/run", *arguments], env=environment, text=True, capture_output=True)
        ran = self.root / "ran"
        return done.returncode, ran.read_text().split() if ran.exists() else [], done.stdout + done.stderr

    def test_a_failing_section_fails_each_tier(self):
        self.table(format="false")
        for arguments in ([], ["fast"], ["all"], ["format"]):
            code, ran, output = self.run_checks(*arguments)
            self.assertEqual((code, ran), (1, ["format"]), output)
            self.assertIn("FAILED: format", output)
        self.table(tests="exit 3")
        self.assertEqual(self.run_checks()[:2], (1, ["format", "tests"]))
        self.assertEqual(self.run_checks("all")[:2], (1, ["format", "tests"]))
        # An optional section that the change touches.
        self.table(library="missing-command")
        self.write("library/file", "changed")
        self.assertEqual(self.run_checks()[:2], (1, ["format", "tests", "library"]))

    def test_a_command_in_the_middle_fails_its_section(self):
        self.table(tests="false; true")
        self.assertEqual(self.run_checks()[0], 1)

    def test_keep_going_leaves_out_what_needs_the_failed_section(self):
        self.table(library="false")
        code, ran, output = self.run_checks("all", "--keep-going")
        self.assertEqual((code, ran), (1, ["format", "tests", "library", "page"]), output)

    def test_each_tier_has_its_sections(self):
        self.assertEqual(self.run_checks()[:2], (0, ["format", "tests"]))
        self.assertEqual(self.run_checks("fast")[:2], (0, ["format"]))
        self.assertEqual(self.run_checks("all")[:2], (0, ["format", "tests", "library", "after-library", "page"]))
        self.assertEqual(self.run_checks("after-library")[:2], (0, ["library", "after-library"]))
        self.assertEqual(self.run_checks("no-such-section")[0], 2)

    def test_a_change_runs_the_sections_that_it_touches(self):
        for path, expected in {"other": [], "library/file": ["library"], "two/src/lib.rs": ["library"], "README.md": ["page"]}.items():
            before = (self.root / path).read_text()
            self.write(path, before + "\n")
            code, ran, output = self.run_checks()
            self.assertEqual((code, ran), (0, ["format", "tests", *expected]), output)
            self.write(path, before)

    def test_an_unknown_change_touches_everything(self):
        self.write(".ci/all-passed", "0" * 40)
        code, ran, output = self.run_checks()
        self.assertEqual((code, ran), (0, ["format", "tests", "library", "after-library", "page"]), output)

    def test_a_spent_budget_leaves_out_optional_sections_only_and_passes(self):
        self.write("library/file", "changed")
        code, ran, output = self.run_checks("--budget", "0")
        self.assertEqual((code, ran), (0, ["format", "tests"]), output)
        self.assertIn("library: the budget of 0 minutes is spent", output)
        self.assertIn("page: not touched", output)

    def test_only_a_complete_pass_of_committed_files_is_recorded(self):
        record = self.root / ".ci/all-passed"
        self.run_checks("all")
        head = self.git("rev-parse", "HEAD")
        self.assertEqual(record.read_text().strip(), head)
        self.write("other", "changed")
        self.commit()
        self.table(library="false")
        self.run_checks("all")
        self.assertEqual(record.read_text().strip(), head)


class Circles(unittest.TestCase):
    def check(self, files):
        """Exit code and output of .ci/circles.py for a crate of `files`."""
        with tempfile.TemporaryDirectory() as root:
            for path, text in files.items():
                file = Path(root, "one/src", path)
                file.parent.mkdir(parents=True, exist_ok=True)
                file.write_text(text)
            subprocess.run(["git", "init", "-q", root], check=True)
            run = subprocess.run([sys.executable, HERE / "circles.py"], cwd=root, capture_output=True, text=True)
            return run.returncode, run.stdout + run.stderr

    def test_files_that_import_each_other_are_found(self):
        code, output = self.check({
            "lib.rs": "mod a; mod b; pub use b::B;",
            "a.rs": "use crate::{B};\npub struct A;",
            "b.rs": "pub struct B;\nfn f() { super::a::A; }",
        })
        self.assertEqual(code, 1, output)
        self.assertIn("a circle of a, b", output)

    def test_folders_that_import_each_other_are_found(self):
        code, output = self.check({
            "lib.rs": "mod a; mod b;",
            "a/mod.rs": "pub mod x; pub mod y;",
            "a/x.rs": "use crate::b::z::Z;",
            "a/y.rs": "pub struct Y;",
            "b/mod.rs": "pub mod w; pub mod z;",
            "b/w.rs": "use crate::a::{self, y::Y as Why};",
            "b/z.rs": "pub struct Z;",
        })
        self.assertEqual(code, 1, output)
        self.assertIn("a circle of a, b", output)

    def test_tests_comments_and_reexports_are_no_imports(self):
        code, output = self.check({
            "lib.rs": "mod a; mod b; pub use a::A;",
            "a.rs": "use crate::b::B;\npub struct A;",
            "b.rs": "// use crate::A;\npub struct B;\n#[cfg(test)]\nmod tests { use crate::A; }",
        })
        self.assertEqual(code, 0, output)


if __name__ == "__main__":
    unittest.main()
