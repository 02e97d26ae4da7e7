"""Tables and figure of docs/notes/search.md, from the files that `scripts.search` wrote.

Cases that change more than an optimiser's sizes are in neither.
"""

import argparse
import json
import sys
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib import ticker

from codesign_jax.optimize import NAMES
from codesign_jax.report.statistics import wilson
from codesign_jax.report.verdicts import RELIABLE
from scripts.shared import figures, tables

PAGE, FIGURE = Path("docs/notes/search.md"), Path("docs/figures/search.png")


def merged(rows: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """Rows of one search over other seeds, or of the same seeds at other marks, as one row each."""
    found: dict[tuple, dict[str, Any]] = {}
    for row in sorted(rows, key=lambda row: row.get("first_seed", 0)):
        first, place = row.get("first_seed", 0), (_question(row), *row["grasps"])
        if place in found and first < found[place]["next_seed"]:
            raise ValueError(f"two files of {place} overlap")
        whole = found.setdefault(place, row | {"kept": [[] for _ in row["grasps"]]})
        whole["kept"] = [a + b for a, b in zip(whole["kept"], row["kept"], strict=True)]
        whole["next_seed"] = first + len(row["kept"][-1])
    searches: dict[tuple, dict[str, Any]] = {}
    for (name, *_), row in found.items():
        one = searches.setdefault(name, row)
        if one is row:
            continue
        if any(one.get(n) != row.get(n) for n in ("first_seed", "next_seed")):
            raise ValueError(f"two files of {name} have other marks and other seeds")
        marks = dict(zip(one["grasps"] + row["grasps"], one["kept"] + row["kept"], strict=True))
        one["grasps"] = sorted(marks)
        one["kept"] = [marks[n] for n in one["grasps"]]
    return [*searches.values()]


def _question(row: dict[str, Any]) -> tuple:
    return tuple(row.get(n) for n in ("optimizer", "preset", "scene", "objects"))


def reached(row: dict[str, Any], share: float) -> str:
    """Grasps after which this share of the seeds keeps `RELIABLE`, and stays there."""
    good = np.array([np.mean(np.array(kept) >= RELIABLE) for kept in row["kept"]])
    below = np.flatnonzero(good < share)
    first = 0 if below.size == 0 else int(below[-1]) + 1
    return f"{row['grasps'][first]:,}" if first < len(good) else "not reached"


def order(row: dict[str, Any]) -> tuple:
    """Where a row stands: 23D first, the paper's objects first, the default's order of names."""
    name = row["optimizer"].split(":")[0]
    place = NAMES.index(name) if name in NAMES else len(NAMES)
    return row["preset"] != "23d", row.get("objects") or "", place, row["optimizer"]


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
    for row in sorted((r for r in rows if not variant(r["optimizer"])), key=order):
        kept = np.array(row["kept"][-1])
        found.append(
            [
                f"`{row['optimizer']}`",
                row["preset"],
                row.get("objects") or "three",
                str(kept.size),
                f"{row['grasps'][-1]:,}",
                f"{np.median(kept):.3f}",
                f"{np.quantile(kept, 0.05):.3f}",
                share_of(kept),
                reached(row, 0.9),
                str(row.get("provenance", {}).get("commit", ""))[:7],
            ]
        )
    return tables.markdown(found)


def share_of(kept: np.ndarray) -> str:
    """Share of the seeds that keep `RELIABLE`, with its interval."""
    good = int((kept >= RELIABLE).sum())
    share = wilson(good, kept.size)
    return f"{good / kept.size:.2f} ({share.low:.2f} to {share.high:.2f})"


def variant(name: str) -> bool:
    """Whether a case's name changes more than an optimiser's sizes."""
    changes = {pair.split("=")[0] for pair in name.partition(":")[2].split(",") if pair}
    return not changes <= {"particles", "trials"}


def draw(rows: list[dict[str, Any]], path: Path) -> Path:
    """What recommended designs keep, and how many seeds' designs keep `RELIABLE`, over grasps.

    Variants of an optimiser, but for its sizes, are in the table alone, as are questions that one
    optimiser was asked, or at one number of grasps.  Marks of optimisers at the same number of
    grasps stand a little beside one another.
    """
    rows = sorted((row for row in rows if not variant(row["optimizer"])), key=order)
    kinds: dict[tuple[str, str], list[dict[str, Any]]] = {}  # in the table's order
    for row in rows:
        kinds.setdefault((row["preset"], row.get("objects") or "three objects"), []).append(row)
    shown = {k: v for k, v in kinds.items() if len(v) > 1 and max(len(r["grasps"]) for r in v) > 1}
    shown = shown or kinds
    figure = figures.new(9.2, 3.8 * len(shown))
    for place, (kind, own) in enumerate(shown.items()):
        kept, share = (figure.add_subplot(len(shown), 2, 2 * place + i) for i in (1, 2))
        for number, row in enumerate(own):
            name, beside = row["optimizer"].split(":")[0], 1.02 ** (number - len(own) // 2)
            at, found = beside * np.array(row["grasps"]), [np.array(k) for k in row["kept"]]
            color = f"C{NAMES.index(name)}" if name in NAMES else None
            style: dict[str, Any] = {"fmt": "o-", "ms": 4, "lw": 1.4, "elinewidth": 1, "capsize": 3}
            low, middle, high = np.array([np.quantile(k, [0.25, 0.5, 0.75]) for k in found]).T
            seeds = " to ".join(str(n) for n in sorted({k.size for k in found}))
            style |= {"color": color, "label": f"{name}, {seeds} seeds"}
            kept.errorbar(at, middle, [middle - low, high - middle], **style)
            counts = [(int((k >= RELIABLE).sum()), k.size) for k in found]
            good, ends = np.array([g / n for g, n in counts]), [wilson(*c) for c in counts]
            away = [good - [e.low for e in ends], [e.high for e in ends] - good]
            share.errorbar(at, good, np.maximum(away, 0), **style)
        kept.axhline(RELIABLE, color="0.6", lw=0.8)
        # Shares near 1 are what differs: even steps are equal ratios of what is lost.
        kept.set_yscale("function", functions=(_stretched, _unstretched))
        kept.yaxis.set_major_locator(ticker.FixedLocator([0, 0.5, 0.8, 0.9, 0.95, 0.98, 1]))
        kept.yaxis.set_minor_locator(ticker.NullLocator())
        kept.yaxis.set_major_formatter(ticker.PercentFormatter(1))
        share.yaxis.set_major_formatter(ticker.PercentFormatter(1))
        title = f"{kind[0].removesuffix('d')} parameters, {kind[1]}"
        kept.set(title=f"{title}: fresh grasps kept,\nmedian and middle half of the seeds")
        share.set(title=f"seeds whose design keeps {100 * RELIABLE:.0f} %,\nwith 95 % intervals")
        ticks = sorted({g for row in own for g in row["grasps"]})
        for axes in (kept, share):
            axes.set(xscale="log", xlabel="grasps of a seed, all counted", ylim=(0, 1.002))
            axes.set_xlim(0.8 * ticks[0], 1.25 * ticks[-1])
            axes.xaxis.set_major_locator(ticker.LogLocator(subs=(1, 2, 5)))
            axes.xaxis.set_major_formatter("{x:,.0f}")
            axes.xaxis.set_minor_formatter(ticker.NullFormatter())
            axes.grid(axis="y", lw=0.3)
        kept.legend(fontsize=7, loc="lower right")
    return figures.save(figure, path)


def _stretched(share: np.ndarray) -> np.ndarray:
    return -np.log(1.01 - np.minimum(share, 1.005))


def _unstretched(height: np.ndarray) -> np.ndarray:
    return 1.01 - np.exp(-height)


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
