"""Draws how the differences change with training steps and with the width.

    pip install matplotlib
    for size in quarter half paper narrow; do
        demc-train ablate --results results/comparison/$size/results.csv
    done
    python results/comparison/scaling.py -o results/comparison/scaling.svg

It reads the `ablation.json` that `ablate` writes beside each file.
"""

import argparse
import json
from pathlib import Path

import matplotlib
from matplotlib import pyplot

HERE = Path(__file__).parent
STEPS = {500: "quarter", 1000: "half", 2000: "paper"}
WIDTHS = {8: "narrow", 16: "paper"}
AXES = {"training steps, width 16": STEPS, "width, 2,000 steps": WIDTHS}
"""The folder of each value."""
VARIANTS = {"DEMCnoSN": "o", "SEMC": "s"}
"""Variants and their marks."""


def change(folder: str, variant: str) -> tuple[float, list[float]]:
    """Percent by which the variant's RelMSE exceeds DEMC's, and the interval's lengths below and above."""
    rows = json.loads((HERE / folder / "ablation.json").read_text())["rows"]
    (estimate,) = [row["relmse"]["change"] for row in rows if row["name"] == variant]
    mean = estimate["mean"]
    low, high = estimate["interval"]
    return 100 * mean, [100 * (mean - low), 100 * (high - mean)]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("-o", "--output", type=Path, required=True, metavar="FILE")
    args = parser.parse_args()
    matplotlib.rcParams["svg.hashsalt"] = "scaling"
    figure, panels = pyplot.subplots(1, len(AXES), figsize=(8, 3.5), sharey=True, layout="constrained")
    for panel, (label, folders) in zip(panels, AXES.items()):
        for shift, (variant, mark) in zip((-0.06, 0.06), VARIANTS.items()):
            changes = [change(folder, variant) for folder in folders.values()]
            places = [place + shift for place in range(len(folders))]
            means = [mean for mean, _ in changes]
            lengths = list(zip(*[length for _, length in changes]))
            panel.errorbar(places, means, lengths, marker=mark, capsize=3, label=f"{variant} against DEMC")
        panel.axhline(0, color="grey", linewidth=0.8)
        panel.set_xticks(range(len(folders)), [f"{value:,}" for value in folders])
        panel.set_xlabel(label)
    panels[0].set_ylabel("change of RelMSE, %")
    figure.legend(*panels[0].get_legend_handles_labels(), loc="outside upper center", ncols=len(VARIANTS), frameon=False)
    figure.savefig(args.output, metadata={"Date": None})


if __name__ == "__main__":
    main()
