"""Hostile input, made and tried by `fuzz`: files, values, command lines and meshes."""

import os
import random
from functools import partial

from scripts.faults.bench import Bench
from scripts.faults.campaigns import Campaign
from scripts.faults.store import Result


def tried(bench: Bench, number: int, *, kind: str) -> Result:
    """A case of `fuzz` within this process."""
    from scripts.faults import fuzz

    folder = bench.scratch_folders / kind
    folder.mkdir(exist_ok=True)
    for left in folder.iterdir():
        if left.is_file():  # to write over it would wait for the disk
            left.unlink()
    word, _, detail = fuzz.CASES[kind](number, folder).partition(": ")
    return Result(word, detail)


_REAL = 5
"""Of so many command lines one is given to a new interpreter, the others to forks."""


def process(bench: Bench, number: int) -> Result:
    """A hostile command line in a process of its own."""
    from scripts.faults import fuzz

    chance = random.Random(f"process {number}")
    with bench.scratch() as scratch:
        elsewhere, place = scratch / "elsewhere", scratch / "work"
        elsewhere.mkdir()
        place.mkdir()
        words = fuzz.command_line(chance, elsewhere)
        while not all(map(_passable, words)):
            words = fuzz.command_line(chance, elsewhere)
        os.chdir(place)
        said = bench.finish(bench.start(*words, real=number % _REAL == 0))
        left = sorted(p.name for p in place.iterdir())
        what = f"{[w[:60] for w in words]}: status {said.code}"
        if said.traceback or said.code not in (0, 2):
            return Result("escaped", f"{what}: {said.text}")
        if left:
            return Result("escaped", f"{what} left {left}")
        return Result("refused" if said.code else "accepted")


def _passable(word: str) -> bool:
    """Whether a word can be an argument of a process."""
    try:
        return b"\0" not in os.fsencode(word)
    except UnicodeEncodeError:
        return False


_GOOD = frozenset({"refused", "accepted"})
CAMPAIGNS = (
    Campaign(
        "commands",
        2000,
        partial(tried, kind="commands"),
        _GOOD,
        "hostile command lines within one process",
        "exit status 0 or 2, no traceback, and no files where it refuses",
        "test_some_mutated_input, test_arguments_that_are_refused",
        size=100,
        limit=60,
    ),
    Campaign(
        "processes",
        200,
        process,
        _GOOD,
        "hostile command lines as processes of their own",
        "the same",
        "test_wrong_input_exits_2_and_creates_nothing",
        limit=300,
    ),
    Campaign(
        "mesh",
        2500,
        partial(tried, kind="mesh"),
        _GOOD,
        "STL, OBJ, PLY, OFF and GLB files with hostile changes",
        "refused within 20 s of processor time, or a mesh whose grid is finite",
        "test_some_mutated_input, test_sizes_of_mesh_files",
        size=50,
        limit=120,
    ),
    Campaign(
        "toml",
        200_000,
        partial(tried, kind="toml"),
        _GOOD,
        "scene, hand, object and accuracy files with hostile changes, and values of `--set`",
        "refused with the project's own error within 20 s of processor time, or a scene that "
        "reads back as it was written",
        "test_some_mutated_input, test_values_that_are_too_much",
        size=2000,
        limit=60,
    ),
)
