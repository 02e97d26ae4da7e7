"""The table and the figure of docs/notes/search.md, from the files that `scripts.search` wrote."""

import argparse
import json
import sys
from pathlib import Path
from typing import Any

import numpy as np

from codesign_jax.optimize import NAMES
from codesign_jax.report.statistics import wilson
from codesign_jax.report.verdicts import RELIABLE
from scripts.shared import figures, tables

PAGE, FIGURE = Path("docs/notes/search.md"), Path("docs/figures/search.png")


def merged(rows: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """Rows of one search over other seeds as one row, in the order of their first seeds.

    Raises:
      ValueError: If they have a seed in common, or recommended at other times.
    """
    found: dict[tuple, dict[str, Any]] = {}
    for row in sorted(rows, key=lambda row: row.get("first_seed", 0)):
        name = tuple(row.get(n) for n in ("optimizer", "preset", "scene", "objects"))
        first = row.get("first_seed", 0)
        if name not in found:
            found[name] = row | {"next_seed": first + len(row["kept"][-1])}
            continue
        whole = found[name]
        if first < whole["next_seed"] or row["grasps"] != whole["grasps"]:
            raise ValueError(f"two files of {name} overlap, or have other marks")
        whole["kept"] = [a + b for a, b in zip(whole["kept"], row["kept"], strict=True)]
        whole["next_seed"] = first + len(row["kept"][-1])
    return [*found.values()]


def reached(row: dict[str, Any], share: float) -> str:
    """Grasps after which this share of the seeds keeps `RELIABLE`, and stays there."""
    good = np.array([np.mean(np.array(kept) >= RELIABLE) for kept in row["kept"]])
    below = np.flatnonzero(good < share)
    first = 0 if below.size == 0 else int(below[-1]) + 1
    return f"{row['grasps'][first]:,}" if first < len(good) else "not reached"


def table(rows: list[dict[str, Any]]) -> str:
    """A row for each optimiser: what its recommended designs keep at its last mark."""
    head = [
        "optimiser",
        "preset",
        "objects",
        "seeds",
        "grasps of a seed",
        "median kept",
        "5 % of the seeds below",
    ]
    head += ["share of seeds that keep 95 % (95 % interval)", "grasps until 90 % of the seeds do"]
    head += ["commit"]
    found = [head]
    for row in rows:
        kept = np.array(row["kept"][-1])
        good = int((kept >= RELIABLE).sum())
        share = wilson(good, kept.size)
        found.append(
            [
                f"`{row['optimizer']}`",
                row["preset"],
                row.get("objects") or "three",
                str(kept.size),
                f"{row['grasps'][-1]:,}",
                f"{np.median(kept):.3f}",
                f"{np.quantile(kept, 0.05):.3f}",
                f"{good / kept.size:.2f} ({share.low:.2f} to {share.high:.2f})",
                reached(row, 0.9),
                str(row.get("provenance", {}).get("commit", ""))[:7],
            ]
        )
    return tables.markdown(found)


def variant(name: str) -> bool:
    """Whether a case's name changes more than an optimiser's sizes."""
    changes = {pair.split("=")[0] for pair in name.partition(":")[2].split(",") if pair}
    return not changes <= {"particles", "trials"}


def draw(rows: list[dict[str, Any]], path: Path) -> Path:
    """Kept share of the recommended design against grasps: medians and 25 to 75 % of the seeds.

    Variants of an optimiser, but for its sizes, are in the table alone.
    """
    rows = [row for row in rows if not variant(row["optimizer"])]
    every = [(row["preset"], row.get("objects") or "three objects") for row in rows]
    points = {kind: 0 for kind in sorted(every)}
    for kind, row in zip(every, rows, strict=True):
        points[kind] += len(row["grasps"])
    kinds = [kind for kind, count in points.items() if count > 1]  # a lone point shows nothing
    figure = figures.new(4.6 * len(kinds), 3.6)
    for place, kind in enumerate(kinds):
        axes = figure.add_subplot(1, len(kinds), place + 1)
        for row in rows:
            if (row["preset"], row.get("objects") or "three objects") != kind:
                continue
            name, at = row["optimizer"].split(":")[0], row["grasps"]
            low, middle, high = np.quantile(np.array(row["kept"]), [0.25, 0.5, 0.75], axis=1)
            color = f"C{NAMES.index(name)}" if name in NAMES else None
            (line,) = axes.plot(at, middle, "o-", ms=4, color=color, label=name)
            away = [middle - low, high - middle]
            axes.errorbar(at, middle, away, color=line.get_color(), lw=1, capsize=3)
        axes.axhline(RELIABLE, color="0.6", lw=0.8)
        title = f"{kind[0]}, {kind[1]}"
        axes.set(xscale="log", xlabel="grasps of a seed, all counted", title=title, ylim=(0, 1.01))
        axes.set_ylabel("share of fresh grasps kept")
        ticks = sorted({g for row in rows for g in row["grasps"]})
        axes.set_xlim(0.8 * ticks[0], 1.25 * ticks[-1])
        axes.legend(fontsize=7, loc="lower right")
    return figures.save(figure, path)


def main(arguments: list[str] | None = None) -> int:
    """Runs the command and returns the exit status."""
    parser = argparse.ArgumentParser(prog="scripts.search.report", description=__doc__)
    parser.add_argument("folder", type=Path, help="what `scripts.search --out` wrote")
    parser.add_argument("--page", type=Path, default=PAGE)
    parser.add_argument("--figure", type=Path, default=FIGURE)
    args = parser.parse_args(arguments)
    rows = merged([json.loads(path.read_text()) for path in sorted(args.folder.glob("*.json"))])
    if not rows:
        print(f"error: {args.folder} has no results of scripts.search", file=sys.stderr)
        return 2
    tables.fill(args.page, table(rows), "search")
    print(args.page, draw(rows, args.figure))
    return 0


if __name__ == "__main__":
    sys.exit(main())
