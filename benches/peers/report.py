"""The report of a comparison: a Markdown table, and JSON with all data."""

from __future__ import annotations

import argparse
import datetime
import json
import os
import platform
import statistics
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any


@dataclass
class Result:
    """One peer in one case."""

    peer: str
    about: str
    ours_ms: list[float] = field(default_factory=list)
    peer_ms: list[float] = field(default_factory=list)
    peer_peak_mib: float | None = None
    deviation: float = 0.0
    others: list[float] = field(default_factory=list)

    @property
    def ratios(self) -> list[float]:
        return [peer / ours for peer, ours in zip(self.peer_ms, self.ours_ms)]

    @property
    def ratio(self) -> float:
        return statistics.median(self.peer_ms) / statistics.median(self.ours_ms)


@dataclass
class Comparison:
    """One case with all peers."""

    case: Any  # with a name, and a dataclass
    ours: str
    ours_ms: list[float]
    ours_peak_mib: float | None
    results: list[Result]
    notes: list[str]


def processor() -> str:
    try:
        lines = Path("/proc/cpuinfo").read_text().splitlines()
    except OSError:
        lines = []
    fields = {name.strip(): value.strip() for name, _, value in (line.partition(":") for line in lines)}
    wide = "AVX-512" if "avx512f" in fields.get("flags", "") else "AVX2" if "avx2" in fields.get("flags", "") else ""
    return ", ".join(filter(None, (fields.get("model name") or platform.processor() or platform.machine(), wide)))


def machine(args: argparse.Namespace) -> str:
    cores = len(os.sched_getaffinity(0))
    date = datetime.date.today().isoformat()
    return f"{processor()}, {cores} cores, {args.threads} threads, {platform.system()} {platform.machine()}, {date}"


def mib(value: float | None) -> str:
    return "-" if value is None else f"{value:.0f}"


def markdown(comparisons: list[Comparison], args: argparse.Namespace) -> str:
    """One row per case with its best peer, then all peers."""
    about = sorted({result.about.split(",")[0] for c in comparisons for result in c.results})
    ours = sorted({comparison.ours for comparison in comparisons})
    lines = [
        f"{machine(args)}. {', '.join(ours)}; {', '.join(about) or 'no peer'}. Medians of {args.rounds} rounds;"
        " ratio: the peer's time over ours, of the medians (min-max of the rounds).",
        "",
        "| case | ours, ms | best peer, ms | which | ratio | peak MiB, ours / peer |",
        "|---|---:|---:|---|---:|---:|",
    ]
    rows = []
    for comparison in comparisons:
        best = min(comparison.results, key=lambda result: result.ratio, default=None)
        for result in comparison.results or [None]:
            row = cells(comparison, result)
            rows.append(row)
            if result is best:
                lines.append(row)
    lines += ["", "Every peer:", "", *lines[2:4], *rows]
    if notes := [note for comparison in comparisons for note in comparison.notes]:
        lines += ["", *(f"- {note}" for note in notes)]
    return "\n".join(lines) + "\n"


def cells(comparison: Comparison, result: Result | None) -> str:
    name, ours = comparison.case.name, statistics.median(result.ours_ms if result else comparison.ours_ms)
    if result is None:
        return f"| {name} | {ours:.1f} | - | - | - | {mib(comparison.ours_peak_mib)} / - |"
    which = ", ".join([result.peer, *result.about.split(", ")[1:]])
    ratio = f"{result.ratio:.2f} ({min(result.ratios):.2f}-{max(result.ratios):.2f})"
    memory = f"{mib(comparison.ours_peak_mib)} / {mib(result.peer_peak_mib)}"
    return f"| {name} | {ours:.1f} | {statistics.median(result.peer_ms):.1f} | {which} | {ratio} | {memory} |"


def as_json(comparisons: list[Comparison], args: argparse.Namespace) -> str:
    entries = []
    for comparison in comparisons:
        entry = asdict(comparison) | {"name": comparison.case.name}
        for result, fields in zip(comparison.results, entry["results"]):
            fields |= {"ratio": result.ratio, "ratios": result.ratios}
        entries.append(entry)
    about = {"machine": machine(args), "threads": args.threads, "rounds": args.rounds, "device": args.device}
    about |= {"arguments": args.arguments, "torch_device": args.torch_device}
    return json.dumps(about | {"cases": entries}, indent=1) + "\n"
