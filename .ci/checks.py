#!/usr/bin/env python3
"""Checks this project on Linux. Needs a Rust toolchain and Python 3.11; installs the rest, as root.

    .ci/run              required sections, then those that the change touches, within the budget
    .ci/run fast         format, lints, unit tests of changed crates
    .ci/run all          every section
    .ci/run NAME...      the named sections, with those that they need
    .ci/run --list       every section: tier, seconds with warm dependencies, what it needs

`.ci/sections.toml` describes the sections. A section is touched if the change has a file of its `paths`, a
page with one of its shell blocks, or a file of its `crates` or of a crate that they depend on.

Compiled dependencies are kept in the directory of the variable DEMC_CACHE, by default ~/.cache/demc. Cargo names
each file there by compiler, features, and version.
"""

import argparse
import os
import re
import shutil
import signal
import subprocess
import sys
import tempfile
import time
import tomllib
from fnmatch import fnmatch
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
TABLE = ROOT / ".ci/sections.toml"
# The commit at which every section last passed.
ALL_PASSED = ROOT / ".ci/all-passed"
BUDGET = 25  # minutes
CACHE_LIMIT = 30  # GB
KEYS = {"name", "run", "seconds", "fast", "required", "paths", "crates", "needs"}


class Section:
    """One section of `.ci/sections.toml`."""

    def __init__(self, row):
        unknown = row.keys() - KEYS
        assert not unknown, f"{row.get('name')}: unknown keys {sorted(unknown)}"
        self.name, self.run, self.seconds = row["name"], row["run"], row["seconds"]
        self.fast, self.required = row.get("fast", False), row.get("required", False)
        self.paths, self.crates, self.needs = (row.get(key, []) for key in ("paths", "crates", "needs"))
        self.blocks = re.findall(r"^\s*(?:\S+=\S+ )*block ([a-z0-9-]+)", self.run, flags=re.MULTILINE)


def load():
    """All sections by name, in the order in which they run."""
    sections = {}
    for row in tomllib.loads(TABLE.read_text())["section"]:
        section = Section(row)
        assert section.name not in sections, f"two sections {section.name}"
        missing = [need for need in section.needs if need not in sections]
        assert not missing, f"{section.name} needs {missing}, which must stand above it"
        sections[section.name] = section
    return sections


def git(*arguments):
    """What git prints, or None if it fails."""
    done = subprocess.run(["git", *arguments], cwd=ROOT, text=True, capture_output=True)
    return done.stdout.strip() if done.returncode == 0 else None


def base_of_change(tier):
    """The commit that the change starts from: where it left the upstream branch, or what the tier last covered."""
    upstream = git("merge-base", "HEAD", "@{upstream}")
    if upstream and upstream != git("rev-parse", "HEAD"):
        return upstream
    if tier == "fast":
        return git("rev-parse", "HEAD~1")
    return ALL_PASSED.read_text().strip() if ALL_PASSED.exists() else None


def changed_files(base):
    """Paths that differ from `base`, in commits or not committed. None if git does not know `base`."""
    differing = git("diff", "--name-only", "--no-renames", base) if base else None
    untracked = git("ls-files", "--others", "--exclude-standard")
    return None if differing is None else [*differing.splitlines(), *(untracked or "").splitlines()]


def pages_of_blocks():
    """The page of each shell block."""
    done = subprocess.run([sys.executable, ".ci/docs.py", "pages"], cwd=ROOT, check=True, text=True, capture_output=True)
    return dict(line.split() for line in done.stdout.splitlines())


def members():
    """The directory of each crate of the workspace, and the crates of the workspace that it depends on."""
    found = {}
    for directory in tomllib.loads((ROOT / "Cargo.toml").read_text())["workspace"]["members"]:
        manifest = tomllib.loads((ROOT / directory / "Cargo.toml").read_text())
        found[manifest["package"]["name"]] = (directory, list(manifest.get("dependencies", {})))
    return found


def with_dependencies(names, crates):
    """These crates and all crates of the workspace below them."""
    below = {name for name in names if name in crates}
    return below | with_dependencies([need for name in below for need in crates[name][1]], crates) if below else below


def is_in(file, paths):
    """Whether a file is one of the paths, which may be patterns, or below it."""
    return any(fnmatch(file, path) or file.startswith(path.rstrip("/") + "/") for path in paths)


def touched(sections, files):
    """Names of the sections that a change of `files` touches: first by their own paths, then by crates."""
    if files is None:
        return [section.name for section in sections.values()]
    pages, crates = pages_of_blocks(), members()
    direct, indirect = [], []
    for section in sections.values():
        own = [*section.paths, *(pages[block] for block in section.blocks if block in pages)]
        sources = [f"{crates[name][0]}/{part}" for name in with_dependencies(section.crates, crates)
                   for part in ("src", "Cargo.toml", "build.rs")]
        sources += ["Cargo.toml", "Cargo.lock"] if section.crates else []
        if any(is_in(file, own) for file in files):
            direct.append(section.name)
        elif any(is_in(file, sources) for file in files):
            indirect.append(section.name)
    return direct + indirect


def changed_crates(files):
    """Packages with a changed file; all if the change is unknown."""
    crates = members()
    return [name for name, (directory, _) in crates.items()
            if files is None or any(is_in(file, [directory]) for file in files)]


class Run:
    """The sections that ran, and how."""

    def __init__(self, sections, environment):
        self.sections, self.environment = sections, environment
        self.started = time.monotonic()
        self.passed, self.failed, self.left_out = {}, [], []

    def minutes(self):
        return (time.monotonic() - self.started) / 60

    def missing(self, name):
        """The section and what it needs, as far as it has not run."""
        needs = [found for need in self.sections[name].needs for found in self.missing(need)]
        return [found for found in dict.fromkeys([*needs, name]) if found not in self.passed]

    def fits(self, name, budget):
        return self.minutes() + sum(self.sections[found].seconds for found in self.missing(name)) / 60 <= budget

    def run(self, name):
        """Runs a section after those that it needs. Returns whether it passed."""
        for found in self.missing(name):
            if found in self.failed or set(self.sections[found].needs) & set(self.failed):
                self.failed.append(found)
                return False
            if not self.run_alone(found):
                return False
        return True

    def run_alone(self, name):
        free = shutil.disk_usage(ROOT).free // 10**9
        print(f"\n== {name} (minute {self.minutes():.1f}, {free} GB free)", flush=True)
        begun = time.monotonic()
        command = "set -euo pipefail\nsource .ci/prelude.sh\n" + self.sections[name].run
        process = subprocess.Popen(["bash", "-c", command], cwd=ROOT, env=self.environment)
        try:
            code = process.wait()
        except KeyboardInterrupt:
            process.send_signal(signal.SIGINT)
            process.wait()
            raise
        if code == 0:
            self.passed[name] = time.monotonic() - begun
        else:
            self.failed.append(name)
            print(f"== {name} failed with code {code}", flush=True)
        return code == 0

    def summary(self):
        print(f"\n== {len(self.passed)} sections passed in {self.minutes():.1f} minutes; the longest in seconds")
        for name, seconds in sorted(self.passed.items(), key=lambda item: -item[1])[:20]:
            print(f"{seconds:6.0f}  {name}")
        if self.left_out:
            print("== not run:", *[f"  {name}: {why}" for name, why in self.left_out], sep="\n")
        if self.failed:
            print(f"== FAILED: {', '.join(self.failed)}", flush=True)


def environment(files, temporary):
    """The environment of the sections, which share the directory `temporary`."""
    cache = Path(os.environ.get("DEMC_CACHE") or Path(os.environ.get("XDG_CACHE_HOME") or "~/.cache").expanduser() / "demc")
    build = cache / "build"
    if build.exists():
        used = int(subprocess.run(["du", "-s", "-k", build], text=True, capture_output=True).stdout.split()[0]) // 10**6
        if used > CACHE_LIMIT:
            print(f"{build} has {used} GB, more than {CACHE_LIMIT}: it is deleted and built again")
            shutil.rmtree(build)
    build.mkdir(parents=True, exist_ok=True)
    return os.environ | {
        "CARGO_BUILD_BUILD_DIR": str(build), "CARGO_TERM_COLOR": "never", "DEMC_CACHE": str(cache),
        # Without a GPU, Mesa warns on stderr if this directory is not set.
        "XDG_RUNTIME_DIR": os.environ.get("XDG_RUNTIME_DIR", temporary),
        "DEMC_CHANGED_CRATES": " ".join(changed_crates(files)),
    }


def show(sections):
    for section in sections.values():
        tiers = ["fast"] * section.fast + ["required"] * section.required
        print(f"{section.name:20} {section.seconds:5} s  {', '.join(tiers) or '-':15} {', '.join(section.needs)}")


def main():
    parser = argparse.ArgumentParser(prog=".ci/run", description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("what", nargs="*", metavar="fast|all|NAME", help="a tier, or names of sections")
    parser.add_argument("--list", action="store_true", help="show all sections and run none")
    parser.add_argument("--since", metavar="COMMIT", help="the change is everything after COMMIT, and what is not committed; default: "
                        "after the upstream branch if HEAD is ahead of it, otherwise after the commit in .ci/all-passed (fast: after HEAD~1)")
    parser.add_argument("--budget", type=float, default=BUDGET, metavar="MINUTES",
                        help="an optional section starts only if it should end within so many minutes [%(default)s]")
    parser.add_argument("-k", "--keep-going", action="store_true", help="go on after a section that fails")
    options = parser.parse_args()
    sections = load()
    if options.list:
        return show(sections)
    tier = options.what[0] if options.what in (["fast"], ["all"]) else "named" if options.what else "default"
    unknown = [name for name in options.what if name not in sections] if tier == "named" else []
    if unknown:
        parser.error(f"no section {', '.join(unknown)}; .ci/run --list shows them")
    base = options.since or base_of_change(tier)
    files = changed_files(base)
    if files is None and options.since:
        parser.error(f"git knows no commit {options.since}")
    print(f"{tier}: {f'{len(files)} files changed since {base}' if files is not None else 'the change is unknown: all count as changed'}")

    optional = []
    match tier:
        case "fast":
            chosen = [section.name for section in sections.values() if section.fast]
        case "all":
            chosen = list(sections)
        case "named":
            chosen = options.what
        case _:
            chosen = [section.name for section in sections.values() if section.required]
            optional = [name for name in touched(sections, files) if name not in chosen and not sections[name].fast]
    temporary = tempfile.TemporaryDirectory()
    run = Run(sections, environment(files, temporary.name))
    for name in [*chosen, *optional]:
        if name in run.passed:
            continue
        if run.failed and not options.keep_going:
            run.left_out.append((name, "a section failed"))
        elif name in optional and not run.fits(name, options.budget):
            run.left_out.append((name, f"the budget of {options.budget:g} minutes is spent"))
        else:
            run.run(name)
    if tier == "default":
        run.left_out += [(name, "not touched") for name in sections if name not in [*chosen, *optional, *run.passed]]
    run.summary()
    if tier == "all" and not run.failed and not git("status", "--porcelain", "--untracked-files=no"):
        ALL_PASSED.write_text(git("rev-parse", "HEAD") + "\n")
        print(f"{ALL_PASSED.relative_to(ROOT)} names this commit now: commit it")
    return 1 if run.failed else 0


sys.exit(main())
