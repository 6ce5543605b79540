"""Output files that are complete or absent, also if several workers write the same one."""

from __future__ import annotations

import glob
import json
import os
import time
import uuid
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

ABANDONED = 24 * 3600
"""Age in seconds from which a file of a killed worker is removed. Ours: no file takes that long."""


@contextmanager
def replacing(path: Path) -> Iterator[Path]:
    """A new name beside `path`, different for each call on each computer. What is written there
    replaces `path` at the end, or is removed after an error."""
    for left in path.parent.glob(f".{glob.escape(path.name)}.*.unfinished"):
        with suppress(FileNotFoundError):  # Another worker has just finished it.
            if time.time() - left.stat().st_mtime > ABANDONED:
                left.unlink()
    unfinished = path.with_name(f".{path.name}.{uuid.uuid4().hex}.unfinished")
    try:
        yield unfinished
        os.replace(unfinished, path)
    finally:
        unfinished.unlink(missing_ok=True)


def write_text(path: Path, text: str) -> None:
    """Writes a text file completely or not at all."""
    with replacing(path) as unfinished:
        unfinished.write_text(text)


def write_json(path: Path, value: object) -> None:
    """Writes a JSON file completely or not at all."""
    write_text(path, json.dumps(value, indent=1))
