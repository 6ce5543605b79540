#!/usr/bin/env python3
"""Prints the licence texts of all crates in the programs, each text once.

    python3 tools/release/licences.py [PACKAGE...]

By default those of demc-infer, demc-train, and demc-data. A crate without a licence file gets the
standard text of the project's own MIT or Apache licence, with the crate's authors.
"""

import json
import re
import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
PROGRAMS = ["demc-infer", "demc-train", "demc-data"]
TEXTS = re.compile(r"(licen[cs]e|copying|copyright|notice|unlicense)", re.IGNORECASE)
"""Names of files with licence texts."""


def used_crates(programs: list[str]) -> set[tuple[str, str]]:
    """Names and versions of the crates that are linked into the programs."""
    command = ["cargo", "tree", "--quiet", "--prefix", "none", "--no-dedupe", "-e", "normal", "--format", "{p}"]
    command += [option for program in programs for option in ("-p", program)]
    lines = subprocess.run(command, cwd=ROOT, check=True, capture_output=True, text=True).stdout.splitlines()
    words = [line.split() for line in lines if line.strip() and "(/" not in line]
    return {(name, version.removeprefix("v")) for name, version, *_ in words}


def licence_texts(folder: Path) -> list[str]:
    """The licence texts of a crate's folder."""
    files = [*folder.iterdir(), *(folder / "LICENSES").glob("*")]
    files = sorted(path for path in files if path.is_file() and TEXTS.match(path.stem))
    return [path.read_text(encoding="utf-8", errors="replace").strip() for path in files]


def standard_text(package: dict) -> str:
    """The text for a crate without one, by its licence expression."""
    own = "LICENSE-MIT" if "MIT" in package["license"] else "LICENSE-APACHE"
    if own == "LICENSE-APACHE" and "Apache-2.0" not in package["license"]:
        sys.exit(f"error: {package['name']} has no licence text for {package['license']}")
    body = (ROOT / own).read_text()
    if own == "LICENSE-MIT":
        authors = ", ".join(package["authors"]) or f"the authors of {package['name']}"
        body = re.sub(r"Copyright .*", f"Copyright (c) {authors}", body, count=1)
    return body.strip()


def main() -> None:
    crates = used_crates(sys.argv[1:] or PROGRAMS)
    metadata = ["cargo", "metadata", "--format-version", "1", "--locked"]
    output = subprocess.run(metadata, cwd=ROOT, check=True, capture_output=True, text=True).stdout
    packages = [p for p in json.loads(output)["packages"] if (p["name"], p["version"]) in crates]
    users: dict[str, list[str]] = {}
    for package in sorted(packages, key=lambda package: package["name"]):
        texts = licence_texts(Path(package["manifest_path"]).parent) or [standard_text(package)]
        for text in texts:
            users.setdefault(text, []).append(f"{package['name']} {package['version']} ({package['license']})")
    print(f"The programs contain {len(packages)} crates. Their licences follow; own code is not listed.")
    for text, names in users.items():
        print("\n" + "=" * 100, *names, "", text, sep="\n")


if __name__ == "__main__":
    main()
