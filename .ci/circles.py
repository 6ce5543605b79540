#!/usr/bin/env python3
"""Fails where Rust files of a crate, or folders side by side, import each other in a circle.

A `use` and a path in the code count; `mod` and a re-export (`pub use child::Name`) do not, and a re-exported name counts
as the file that defines it. Tests may import what they like.
"""

import graphlib
import pathlib
import re
import subprocess
import sys

IGNORED = re.compile(
    r'//[^\n]*|/\*.*?\*/|b?r(#*)".*?"\1|b?"(?:\\.|[^"\\])*"|b?\'(?:\\[^\']*|[^\'\\])\'', re.S
)
USE = re.compile(r"(\bpub(?:\([^)]*\))?\s+)?\buse\s+([^;]+);")
PATH = re.compile(r"\b(?:crate|super|self)(?:\s*::\s*\w+)+")


def without_tests(code):
    """`code` without items under `#[cfg(test)]`."""
    while (start := re.search(r"#\[cfg\((?:all\()?test\b[^\]]*\]", code)) is not None:
        depth = 0
        for end in range(start.end(), len(code)):
            depth += {"{": 1, "}": -1}.get(code[end], 0)
            if depth == 0 and code[end] in ";}":
                break
        code = code[: start.start()] + code[end + 1 :]
    return code


def leaves(tree, prefix=()):
    """The paths of a use tree, each with its name: `a::{b, c as d}` has the path (a, b) named b and (a, c) named d."""
    tree = tree.strip()
    brace = tree.find("{")
    if brace < 0:
        path, _, name = (part.strip() for part in tree.partition(" as "))
        path = prefix + tuple(part.strip() for part in path.split("::") if part.strip())
        if path[-1] == "self":
            path = path[:-1]
        return [(path, name or path[-1])]
    prefix += tuple(part.strip() for part in tree[:brace].split("::") if part.strip())
    parts, depth = [""], 0
    for letter in tree[brace + 1 : tree.rfind("}")]:
        depth += {"{": 1, "}": -1}.get(letter, 0)
        if letter == "," and depth == 0:
            parts.append("")
        else:
            parts[-1] += letter
    return [leaf for part in parts if part.strip() for leaf in leaves(part, prefix)]


class Crate:
    """The modules of one crate and what they import."""

    def __init__(self, root, files):
        self.files = {}
        for file in files:
            parts = file.relative_to(root).with_suffix("").parts
            if parts[-1] in ("mod", "lib", "main"):
                parts = parts[:-1]
            if "tests" not in parts and (parts or file.name == "lib.rs"):
                self.files[parts] = file
        self.paths, self.exports = {}, {}
        for module, file in self.files.items():
            self.paths[module] = self.read(module, without_tests(IGNORED.sub(" ", file.read_text())))

    def read(self, module, code):
        """The paths that `module` imports; its re-exports go to `exports`."""
        paths = []
        for public, tree in USE.findall(code):
            for path, name in leaves(tree):
                path = self.absolute(module, path)
                if path is None:
                    continue
                if public:
                    self.exports[module + (name,)] = path
                # A module may re-export what its children define.
                if not public or path[: len(module)] != module:
                    paths.append(path)
        for path in PATH.findall(USE.sub(" ", code)):
            paths.append(self.absolute(module, tuple(re.split(r"\s*::\s*", path))))
        return paths

    def absolute(self, module, path):
        """`path`, seen from `module`, from the root of the crate; none for another crate's."""
        if path[0] == "crate":
            return path[1:]
        if path[0] in ("self", "super"):
            while path and path[0] in ("self", "super"):
                module = module[:-1] if path[0] == "super" else module
                path = path[1:]
            return module + path
        return module + path if module + path[:1] in self.files else None

    def owner(self, path):
        """The module that defines `path`."""
        for length in range(len(path), 0, -1):
            target = self.exports.get(path[:length])
            # A function may have the name of its module.
            if target and target[:length] != path[:length]:
                return self.owner(target + path[length:])
            if path[:length] in self.files:
                return path[:length]
        return ()

    def imports(self):
        return {
            module: {owner for path in paths if (owner := self.owner(path)) != module and owner in self.files}
            for module, paths in self.paths.items()
        }


def circle(edges):
    """The nodes of a circle, if there is one."""
    try:
        graphlib.TopologicalSorter(edges).prepare()
    except graphlib.CycleError as error:
        return [sorted(set(error.args[1]))]
    return []


def folder_circles(imports):
    """Circles between the entries of one folder, a file or a folder each."""
    for folder in {module[:depth] for module in imports for depth in range(len(module))}:
        edges = {}
        for module, targets in imports.items():
            if module[: len(folder)] != folder or module == folder:
                continue
            entry = module[: len(folder) + 1]
            others = {target[: len(folder) + 1] for target in targets if target[: len(folder)] == folder and target != folder}
            edges.setdefault(entry, set()).update(others - {entry})
        yield from circle(edges)


def main():
    listed = subprocess.run(["git", "ls-files", "-co", "--exclude-standard", "*.rs"], check=True, capture_output=True, text=True)
    files = [pathlib.Path(file) for file in listed.stdout.split() if pathlib.Path(file).exists()]
    failed, checked = False, 0
    for root in sorted({pathlib.Path(*file.parts[: file.parts.index("src") + 1]) for file in files if "src" in file.parts}):
        crate = Crate(root, [file for file in files if root in file.parents])
        checked += len(crate.files)
        imports = crate.imports()
        for group in {tuple(group) for group in (*circle(imports), *folder_circles(imports))}:
            failed = True
            print(f"{root}: a circle of {', '.join('::'.join(module) or 'the root' for module in group)}")
            for module in sorted(imports):
                for target in sorted(imports[module]):
                    ends = [next((node for node in group if end[: len(node)] == node), None) for end in (module, target)]
                    if None not in ends and ends[0] != ends[1]:
                        print(f"    {'::'.join(module)} imports {'::'.join(target)}")
    if failed:
        sys.exit("Move what both need into a file of its own.")
    print(f"{checked} Rust files, no circle")


main()
