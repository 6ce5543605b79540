#!/usr/bin/env python3
"""Checks that docs/dependencies.md lists every direct dependency, and no other, and that none needs a newer Rust.

    python3 .ci/dependencies.py           # compares names
    python3 .ci/dependencies.py --write   # also updates versions and dates of the last release

Dates come from the index that cargo has downloaded.
"""

import json
import re
import subprocess
import sys
from pathlib import Path

PAGE = Path("docs/dependencies.md")
ROW = re.compile(r"^\| `([\w-]+)` \| ([^|]*) \| ([^|]*) \| (.*) \|$", re.MULTILINE)


def cargo_metadata():
    command = ["cargo", "metadata", "--format-version", "1", "--locked"]
    return json.loads(subprocess.run(command, check=True, capture_output=True, text=True).stdout)


def version_numbers(text):
    return tuple(int(part) for part in text.split("."))[:2]


def newer_compilers(metadata):
    """One line per package that needs a newer compiler than the workspace declares."""
    own = next(p["rust_version"] for p in metadata["packages"] if p["name"] == "demc-infer")
    return [f"{p['name']} {p['version']} needs Rust {p['rust_version']}, but Cargo.toml says {own}"
            for p in metadata["packages"]
            if p["rust_version"] and version_numbers(p["rust_version"]) > version_numbers(own)]


def direct(metadata):
    """Names of the crates that a package of the workspace names itself, and their versions in use."""
    packages = {package["id"]: package for package in metadata["packages"]}
    members = [packages[member] for member in metadata["workspace_members"]]
    own = {member["name"] for member in members}
    names = {dependency["name"] for member in members for dependency in member["dependencies"]} - own
    versions = {}
    for node in metadata["resolve"]["nodes"]:
        if packages[node["id"]]["name"] in own:
            for dependency in node["deps"]:
                package = packages[dependency["pkg"]]
                versions[package["name"]] = package["version"]
    return {name: versions.get(name, "optional") for name in sorted(names)}


def last_release(name):
    """Version and date of the newest release that is not a preview, from cargo's index."""
    path = {1: f"1/{name}", 2: f"2/{name}", 3: f"3/{name[0]}/{name}"}.get(len(name), f"{name[:2]}/{name[2:4]}/{name}")
    newest = ("", "")
    for index in Path.home().glob(f".cargo/registry/index/*/.cache/{path}"):
        for line in index.read_bytes().split(b"\0"):
            if line.startswith(b"{"):
                release = json.loads(line)
                if "-" not in release["vers"] and not release.get("yanked") and "pubtime" in release:
                    newest = max(newest, (release["pubtime"][:10], release["vers"]))
    return newest


def main():
    metadata = cargo_metadata()
    text, used = PAGE.read_text(), direct(metadata)
    listed = {match[1] for match in ROW.finditer(text)}
    problems = [f"{PAGE}: {name} is missing" for name in used if name not in listed]
    problems += newer_compilers(metadata)
    problems += [f"{PAGE}: {name} is not a dependency" for name in sorted(listed) if name not in used]
    print(*problems, f"{len(used)} direct dependencies", sep="\n")
    if "--write" in sys.argv[1:] and not problems:
        def row(match):
            date, version = last_release(match[1])
            return f"| `{match[1]}` | {used[match[1]]} | {date} ({version}) | {match[4]} |"
        PAGE.write_text(ROW.sub(row, text))
    return bool(problems)


sys.exit(main())
