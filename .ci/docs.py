#!/usr/bin/env python3
"""Shell blocks and links of the documentation.

    docs.py pages           the name of each shell block, and its page
    docs.py show NAME       the commands of one block
    docs.py check           every shell block has a name of its own and runs in CI; links and images lead somewhere

A shell block is a ```sh fence; the line above it names it: <!-- ci: NAME -->
"""

import re
import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
# CI runs the blocks of these pages.
PAGES = ["README.md", *(f"docs/{page}.md" for page in (
    "training", "configuration", "data", "denoising", "farms", "clusters", "renderers", "evaluation", "export", "oidn", "devices", "performance", "network",
    "conclusions", "install", "python", "c-library", "dependencies")), "bindings/python/README.md", "models/README.md", "bindings/blender/README.md"]
NAME = re.compile(r"<!-- ci: ([a-z0-9-]+) -->")
LINK = re.compile(r"!?\[[^\]]*\]\(([^)\s]+)(?:\s+\"[^\"]*\")?\)")
ANCHOR = re.compile(r"<a (?:id|name)=\"([^\"]+)\"")


def markdown():
    """All Markdown files that git tracks or would add."""
    listed = subprocess.run(["git", "ls-files", "-co", "--exclude-standard", "*.md"], cwd=ROOT, check=True, text=True,
                            capture_output=True).stdout
    return sorted(path for path in listed.split() if (ROOT / path).exists())


def blocks(page):
    """(line, name or None, commands) of each shell block of a page."""
    found, fence, name = [], None, None
    for number, line in enumerate((ROOT / page).read_text().splitlines(), 1):
        if fence is None and line.lstrip().startswith("```"):
            fence = (line.strip()[3:], number, [])
        elif fence is not None and line.strip() == "```":
            if fence[0] in ("sh", "bash", "shell", "console"):
                found.append((fence[1], name, "\n".join(fence[2]) + "\n"))
            fence, name = None, None
        elif fence is not None:
            fence[2].append(line)
        elif line.strip():
            match = NAME.fullmatch(line.strip())
            name = match[1] if match else None
    return found


def prose(text):
    """The text without code, which holds no links."""
    return re.sub(r"`[^`\n]*`", "", re.sub(r"^```.*?^```", "", text, flags=re.M | re.S))


def anchors(path):
    """The anchors of a page's headings, as GitHub makes them."""
    found, text = set(), path.read_text()
    for heading in re.findall(r"^#+\s+(.+)$", re.sub(r"^```.*?^```", "", text, flags=re.M | re.S), flags=re.M):
        heading = re.sub(r"\[([^\]]*)\]\([^)]*\)", r"\1", heading)
        anchor = re.sub(r"[^\w\- ]", "", heading.strip().lower()).replace(" ", "-")
        count = sum(1 for known in found if known == anchor or re.fullmatch(re.escape(anchor) + r"-\d+", known))
        found.add(f"{anchor}-{count}" if count else anchor)
    return found | set(ANCHOR.findall(text))


def problems():
    """Everything that is wrong, one line each."""
    names, sections = {}, (ROOT / ".ci/sections.toml").read_text()
    for page in markdown():
        for line, name, _ in blocks(page):
            if page not in PAGES:
                yield f"{page}:{line}: CI runs no shell blocks of this page"
            elif name is None:
                yield f"{page}:{line}: the shell block has no name; expected <!-- ci: NAME --> in the line above"
            elif name in names:
                yield f"{page}:{line}: the block {name} stands in {names[name]} already"
            else:
                names[name] = page
                if not re.search(rf"\bblock {name}(?![a-z0-9-])", sections):
                    yield f"{page}:{line}: no section of .ci/sections.toml runs the block {name}"
        for link in LINK.findall(prose((ROOT / page).read_text())):
            if re.match(r"[a-z]+:", link):
                continue
            file, _, anchor = link.partition("#")
            target = ((ROOT / page).parent / file).resolve() if file else ROOT / page
            if not target.exists():
                yield f"{page}: no such file: {link}"
            elif not target.is_relative_to(ROOT):
                yield f"{page}: leads out of the repository: {link}"
            elif anchor and target.suffix == ".md" and anchor not in anchors(target):
                yield f"{page}: no such heading: {link}"


def main(arguments):
    pages = [page for page in PAGES if (ROOT / page).exists()]
    named = {name: commands for page in pages for _, name, commands in blocks(page)}
    match arguments:
        case ["pages"]:
            print(*(f"{name} {page}" for page in pages for _, name, _ in blocks(page) if name), sep="\n")
        case ["show", name] if name in named:
            print(named[name], end="")
        case ["check"]:
            found = list(problems())
            print(*found, f"{len(markdown())} pages, {len(named)} shell blocks, {len(found)} problems", sep="\n")
            return bool(found)
        case _:
            print(__doc__, file=sys.stderr)
            return 2


sys.exit(main(sys.argv[1:]))
