#!/usr/bin/env python3
"""Nothing is compiled twice: every command of the documentation selects the same features of every dependency.

Cargo unites the features of the packages that one command builds. Two commands with different features of a crate below
Burn compile Burn twice, which takes five minutes or more. With different features of a crate of this workspace, they compile
it and all crates above it twice. Only commands without a command line may differ there.
"""

import subprocess
import sys

# Commands that build the libraries without a command line.
WITHOUT_CLI = {"cargo build -p demc-c", "the library of demc-infer"}

# What a command builds, as options of `cargo tree`.
COMMANDS = {
    "cargo test --workspace": ["--workspace", "-e", "normal,build,dev"],
    "cargo test -p demc-model -p demc-infer": ["-p", "demc-model", "-p", "demc-infer", "-e", "normal,build,dev"],
    "cargo build": ["--workspace", "-e", "normal,build"],
    "cargo run -p demc-infer": ["-p", "demc-infer", "-e", "normal,build"],
    "cargo run -p demc-infer --example frame": ["-p", "demc-infer", "-e", "normal,build,dev"],
    "cargo run -p demc-train": ["-p", "demc-train", "-e", "normal,build"],
    "cargo bench -p demc-bench": ["-p", "demc-bench", "-e", "normal,build,dev"],
    "cargo run -p demc-train --example manuals": ["-p", "demc-train", "-e", "normal,build,dev"],
    "cargo build -p demc-c": ["-p", "demc-c", "-e", "normal,build"],
    "cargo build -p demc-python": ["-p", "demc-python", "-e", "normal,build"],
    "the library of demc-infer": ["-p", "demc-infer", "--no-default-features", "-e", "normal,build"],
}


def features(options):
    """The feature sets of each package."""
    command = ["cargo", "tree", "--quiet", "--prefix", "none", "--no-dedupe", "--format", "{p}|{f}", *options]
    found = {}
    for line in subprocess.run(command, check=True, capture_output=True, text=True).stdout.splitlines():
        package, separator, names = line.partition("|")
        if separator:
            # The path of a package of the workspace follows its name.
            found.setdefault(package.split(" (/")[0], set()).add(names)
    return found


def main():
    sets = {command: features(options) for command, options in COMMANDS.items()}
    whole = sets["cargo test --workspace"]
    below_burn = features(["-p", "burn", "-e", "normal,build"])
    problems = [f"{package}: `{command}` has the features {sorted(found)}, the tests {sorted(whole[package])}"
                for command, all_found in sets.items() for package, found in sorted(all_found.items())
                if package in whole and found != whole[package]
                and (package in below_burn or package.startswith("demc-") and command not in WITHOUT_CLI)]
    print(*problems, f"{len(COMMANDS)} commands, {len(below_burn)} crates below Burn, {len(problems)} problems", sep="\n")
    return bool(problems)


sys.exit(main())
