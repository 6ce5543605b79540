"""`--shard I/N`: one worker's part of the work on a farm, as in `demc-infer denoise`."""

from __future__ import annotations

import argparse
import re
from collections.abc import Iterable
from dataclasses import dataclass


@dataclass(frozen=True)
class Shard:
    """Part `index` of `count`, from 1 to `count`."""

    index: int
    count: int

    @classmethod
    def parse(cls, text: str) -> Shard:
        """Raises ValueError for anything but I/N with I from 1 to N."""
        if not re.fullmatch("[0-9]+/[0-9]+", text):
            raise ValueError(text)
        shard = cls(*map(int, text.split("/")))
        if not 1 <= shard.index <= shard.count:
            raise ValueError(text)
        return shard

    def __str__(self) -> str:
        return f"{self.index}/{self.count}"

    def keep(self, names: Iterable[str]) -> set[str]:
        """This shard's names: of all names in order, the `index`th and every `count`th after it."""
        return set(sorted(names)[self.index - 1 :: self.count])


def _flag(text: str) -> Shard:
    try:
        return Shard.parse(text)
    except ValueError:
        raise argparse.ArgumentTypeError("expected I/N with I from 1 to N, such as 1/4") from None


def add_shard_flag(parser: argparse.ArgumentParser, items: str) -> None:
    """`--shard I/N`. `items` says what is shared out."""
    parser.add_argument(
        "--shard",
        type=_flag,
        metavar="I/N",
        help=f"only part I of N of the {items}, from 1/N to N/N, without a manifest; the command without --shard writes it",
    )
