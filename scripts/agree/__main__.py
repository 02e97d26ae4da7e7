"""Compares this checkout with an older one: the licence for a change of the simulation.

    python -m scripts.agree OLD --kind same [--quick]
    python -m scripts.agree OLD --kind physics --expect recommended=0-1 hard=1-4 random=0-2

OLD is a commit, or a folder with its source.  *same* is for changes that must leave the physics as
it is: verdicts of recommended, hard and random designs flip no more than by a displacement of the
objects by a micrometre.  *physics* is for the others: the flips that the change is expected to
cause are stated before the run, in percent, and the table shows both.  In both cases float64
traces are compared with MuJoCo C, gradients with differences, and the rate with the older one.
The exit status is 1 if a line of the table fails.  `--quick` takes five minutes of two CPU cores,
all of it twenty; on a GPU less.
"""

import argparse
import sys
import tempfile
from collections.abc import Iterator
from importlib.util import find_spec
from pathlib import Path
from typing import NamedTuple

import numpy as np

from codesign_jax.codesign import SUCCESS_COST
from codesign_jax.types import failed
from scripts.agree import judgement, sides
from scripts.agree.judgement import Expected, Row
from scripts.shared import energy, output, work

GROUPS = ("recommended", "hard", "random")
HARD = sides.ROOT / "docs" / "data" / "search" / "hard.npz"
# Both solved to rounding (worker.EXACT), grasps to the end of the lift agree within 1e-8; a
# difference in a formula of a contact or a joint is larger than a micrometre or a microradian.
TRACE_BOUND = 1e-6
TRACE_STEPS = 300
# Differences of 1e-6 of a range lose up to 1e-5 where a contact begins in between.
GRADIENT_BOUND = 1e-4


class Size(NamedTuple):
    """How much is simulated."""

    designs: int
    trials: int
    call: int
    pairs: int
    worlds: int
    slopes: int


FULL = Size(designs=60, trials=40, call=600, pairs=16, worlds=32, slopes=12)
QUICK = Size(designs=24, trials=20, call=240, pairs=8, worlds=8, slopes=6)


def designs_of(new: sides.Side, size: Size) -> dict[str, list[list[float]]]:
    """Designs of each group, spread over all that a file has."""
    chosen = {"recommended": work.winners(), "hard": work.winners(HARD)}
    spread = {
        name: every[np.linspace(0, len(every) - 1, size.designs).astype(int)].tolist()
        for name, every in chosen.items()
    }
    return spread | {"random": new.ask("random_designs", count=size.designs)}


def verdict_rows(
    old: sides.Side,
    new: sides.Side,
    groups: dict[str, list[list[float]]],
    size: Size,
    folder: Path,
    expected: dict[str, Expected],
) -> Iterator[Row]:
    """Flips of each group, and of all where none is expected."""
    runs = {"old": (old, False), "moved": (old, True), "new": (new, False)}
    every: dict[str, list[np.ndarray]] = {name: [] for name in runs}
    for group, designs in groups.items():
        kept: dict[str, np.ndarray] = {}
        costs: dict[str, np.ndarray] = {}
        places: dict[str, np.ndarray] = {}
        for name, (side, moved) in runs.items():
            path = folder / f"{group}-{name}.npz"
            sizes = {"trials": size.trials, "call": size.call, "moved": moved}
            side.ask("verdicts", designs=designs, out=str(path), **sizes)
            with np.load(path) as arrays:
                kept[name] = (arrays["cost"] < SUCCESS_COST) & ~failed(arrays["status"])
                costs[name] = arrays["cost"]
                places[name] = arrays["position"]
            every[name].append(kept[name])
        if not np.array_equal(places["old"], places["new"]):
            raise RuntimeError("the two versions draw different trials: nothing can be compared")
        table = kept["old"], kept["new"], kept["moved"]
        if group in expected:
            row = judgement.physics(group, *table, expected[group])
        else:
            row = judgement.same(group, *table)
        equal = (costs["old"] == costs["new"]).mean()
        yield row._replace(figures=f"{row.figures}; equal costs {equal:.1%}")
    if not expected:
        old_, new_, moved_ = (np.concatenate(every[name]) for name in ("old", "new", "moved"))
        yield judgement.same("all groups", old_, new_, moved_)


def rate_rows(
    old: sides.Side, new: sides.Side, designs: list[list[float]], size: Size, compiled: dict
) -> Iterator[Row]:
    """Rate by pairs of calls in the order A B B A, and the time to compile."""
    seconds: dict[str, list[float]] = {"old": [], "new": []}
    both = {"old": old, "new": new}
    arguments = {"designs": designs, "trials": size.call // len(designs)}
    for side in both.values():
        side.ask("rate", **arguments)  # the first call of a program also loads it
    for pair in range(size.pairs):
        for name in ("old", "new") if pair % 2 == 0 else ("new", "old"):
            seconds[name].append(both[name].ask("rate", **arguments)["seconds"])
    yield judgement.rate(seconds["old"], seconds["new"])
    words = ", ".join(
        f"{name} {taken['processor_seconds']:.1f} s ({taken['seconds']:.1f} s by the clock)"
        for name, taken in compiled.items()
    )
    yield Row("compile time", f"{words}, processor time", True)


def exact_rows(
    source: Path, groups: dict[str, list[list[float]]], size: Size, folder: Path
) -> Iterator[Row]:
    """Traces against MuJoCo C and gradients against differences, in float64."""
    with sides.running(source, double=True) as exact:
        paths = {name: folder / f"trace-{name}.npz" for name in ("structured", "mujoco")}
        if find_spec("mujoco") is None:
            yield Row("traces, MuJoCo C", "left out: mujoco is not installed", True)
        else:
            for engine, path in paths.items():
                exact.ask("traces", worlds=size.worlds, engine=engine, out=str(path))
            ours, theirs = (np.load(p)["qpos"][:, :TRACE_STEPS] for p in paths.values())
            yield judgement.trace(ours, theirs, TRACE_BOUND)
        half = size.slopes // 2
        slopes = exact.ask(
            "gradients", designs=groups["recommended"][:half] + groups["hard"][:half]
        )
        derivative, difference = (np.array(slopes[n]) for n in ("derivative", "difference"))
        yield judgement.gradient(derivative, difference, GRADIENT_BOUND)


def energy_rows() -> Iterator[Row]:
    """The audit of energy, of this checkout."""
    for rise in energy.rises():
        figures = f"{rise.gained:.2%} gained, at most {rise.bound:.0%}"
        yield Row(f"energy, {rise.name}", figures, rise.gained <= rise.bound)


def compare(
    old_source: Path, size: Size, folder: Path, expected: dict[str, Expected]
) -> Iterator[Row]:
    """The table's lines, one after another."""
    with sides.running(old_source) as old, sides.running(sides.ROOT) as new:
        groups = designs_of(new, size)
        first = groups["recommended"][: size.call // size.trials]
        sizes = {"designs": first, "trials": size.call // len(first)}
        compiled = {n: s.ask("compiled", **sizes) for n, s in (("old", old), ("new", new))}
        yield from verdict_rows(old, new, groups, size, folder, expected)
        yield from rate_rows(old, new, first, size, compiled)
    yield from exact_rows(sides.ROOT, groups, size, folder)
    yield from energy_rows()


def expectations(words: list[str]) -> dict[str, Expected]:
    """Expected flips by group, of GROUP=LOW-HIGH in percent, or GROUP=SHARE.

    Raises:
      ValueError: If a group is missing or unknown, or its range is none.
    """
    ranges = {}
    for word in words:
        group, _, shares = word.partition("=")
        ends = [float(part) / 100 for part in shares.split("-")]
        if group not in GROUPS or not ends[0] <= ends[-1]:
            raise ValueError(f"{word}: write GROUP=LOW-HIGH in percent, of {', '.join(GROUPS)}")
        ranges[group] = Expected(ends[0], ends[-1])
    if missing := {*GROUPS} - {*ranges}:
        raise ValueError(f"state the expected flips of {', '.join(sorted(missing))} by --expect")
    return ranges


def main(arguments: list[str] | None = None) -> int:
    """Prints the table; returns 1 if a line fails, 2 for an input that cannot be used."""
    raw = argparse.RawDescriptionHelpFormatter
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=raw)
    parser.add_argument("old", help="commit, or folder with its source")
    parser.add_argument("--kind", required=True, choices=("same", "physics"))
    parser.add_argument("--expect", nargs="+", default=[], metavar="GROUP=LOW-HIGH")
    parser.add_argument("--quick", action="store_true")
    options = parser.parse_args(arguments)
    with tempfile.TemporaryDirectory() as temporary:
        folder = Path(temporary)
        try:
            if options.kind == "same" and options.expect:
                raise ValueError("--expect is for --kind physics")
            expected = expectations(options.expect) if options.kind == "physics" else {}
            source = sides.checkout(options.old, folder / "old")
        except ValueError as error:
            print(f"error: {error}", file=sys.stderr)
            return 2
        rows = []
        for row in compare(source, QUICK if options.quick else FULL, folder, expected):
            print(f"{'ok' if row.passed else 'FAILS':5}  {row.name}: {row.figures}", flush=True)
            rows.append(row)
    table = [["", "figures", ""]]
    table += [[row.name, row.figures, "ok" if row.passed else "**fails**"] for row in rows]
    print(f"\n{output.markdown(table)}")
    return int(not all(row.passed for row in rows))


if __name__ == "__main__":
    sys.exit(main())
