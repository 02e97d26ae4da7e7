"""Tables and figure of docs/notes/search.md, from the files that `scripts.search` wrote.

Cases that change more than an optimiser's sizes are in the table of parts, beside the default on
the same seeds.
"""

import argparse
import json
import sys
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib import ticker

from codesign_jax.optimize import DEFAULT, NAMES
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


def parts(rows: list[dict[str, Any]]) -> str:
    """A row for each part of the default that is left out, beside the default on the same seeds."""
    found = [["without", "seeds", "grasps of a seed", "median kept"]]
    found[0] += ["share of seeds that keep 95 % (95 % interval)", "the default on these seeds"]
    found[0] += ["median of the default", "only the default keeps 95 %, only the variant does"]

    def question(row: dict[str, Any]) -> tuple:
        return tuple(row.get(n) for n in ("preset", "scene", "objects"))

    whole = {question(row): row for row in rows if row["optimizer"] == DEFAULT}
    for row in sorted((r for r in rows if variant(r["optimizer"])), key=order):
        name, kept = row["optimizer"].partition(":")[2], np.array(row["kept"][-1])
        beside = whole.get(question(row))
        if beside is None or not row["optimizer"].startswith(f"{DEFAULT}:"):
            continue
        start = row.get("first_seed", 0) - beside.get("first_seed", 0)
        same = np.array(beside["kept"][-1])[max(0, start) :][: kept.size]
        if start < 0 or same.size < kept.size:
            continue  # the default has not these seeds
        good, other = kept >= RELIABLE, same >= RELIABLE
        cells = [f"`{name}`", str(kept.size), f"{row['grasps'][-1]:,}", f"{np.median(kept):.3f}"]
        cells += [share_of(kept), share_of(same), f"{np.median(same):.3f}"]
        found.append([*cells, f"{int((other & ~good).sum())}, {int((good & ~other).sum())}"])
    return tables.markdown(found)


def variant(name: str) -> bool:
    """Whether a case's name changes more than an optimiser's sizes."""
    changes = {pair.split("=")[0] for pair in name.partition(":")[2].split(",") if pair}
    return not changes <= {"particles", "trials"}


def draw(rows: list[dict[str, Any]], path: Path) -> Path:
    """Kept share of the recommended design against grasps: medians and 25 to 75 % of the seeds.

    Variants of an optimiser, but for its sizes, are in the table alone.  Marks of optimisers at the
    same number of grasps stand a little beside one another.
    """
    rows = sorted((row for row in rows if not variant(row["optimizer"])), key=order)
    every = [(row["preset"], row.get("objects") or "three objects") for row in rows]
    points = dict.fromkeys(every, 0)  # in the table's order
    for kind, row in zip(every, rows, strict=True):
        points[kind] += len(row["grasps"])
    kinds = [kind for kind, count in points.items() if count > 1]  # a lone point shows nothing
    figure = figures.new(4.6 * len(kinds), 3.6)
    for place, kind in enumerate(kinds):
        axes = figure.add_subplot(1, len(kinds), place + 1)
        shown = [row for own, row in zip(every, rows, strict=True) if own == kind]
        for number, row in enumerate(shown):
            name, beside = row["optimizer"].split(":")[0], 1.03 ** (number - len(shown) // 2)
            at = beside * np.array(row["grasps"])
            low, middle, high = np.quantile(np.array(row["kept"]), [0.25, 0.5, 0.75], axis=1)
            color = f"C{NAMES.index(name)}" if name in NAMES else None
            (line,) = axes.plot(at, middle, "o-", ms=4, color=color, label=name)
            away = [middle - low, high - middle]
            axes.errorbar(at, middle, away, color=line.get_color(), lw=1, capsize=3)
        axes.axhline(RELIABLE, color="0.6", lw=0.8)
        title = f"{kind[0].removesuffix('d')} parameters, {kind[1]}"
        axes.set(xscale="log", xlabel="grasps of a seed, all counted", title=title, ylim=(0, 1.01))
        axes.set_ylabel("share of fresh grasps kept")
        ticks = sorted({g for row in shown for g in row["grasps"]})
        axes.set_xlim(0.8 * ticks[0], 1.25 * ticks[-1])
        axes.xaxis.set_major_locator(ticker.LogLocator(subs=(1, 2, 5)))
        axes.xaxis.set_major_formatter("{x:,.0f}")
        axes.xaxis.set_minor_formatter(ticker.NullFormatter())
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
    tables.fill(args.page, parts(rows), "parts")
    print(args.page, draw(rows, args.figure))
    return 0


if __name__ == "__main__":
    sys.exit(main())
