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


CAMPAIGNS = (
    Campaign(
        "commands", 2000, partial(tried, kind="commands"), "accepted, refused", size=100, limit=60
    ),
    Campaign("processes", 200, process, "accepted, refused", limit=300),
    Campaign("mesh", 2500, partial(tried, kind="mesh"), "accepted, refused", size=50, limit=120),
    Campaign(
        "toml", 200_000, partial(tried, kind="toml"), "accepted, refused", size=2000, limit=60
    ),
)
