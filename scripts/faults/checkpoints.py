"""Damage of the newest checkpoint: nothing goes on from it, and nobody reads another in silence."""

import re
import shutil
from pathlib import Path

from scripts.faults import damage, finished
from scripts.faults.bench import Bench
from scripts.faults.campaigns import Campaign
from scripts.faults.kills import judged
from scripts.faults.store import Result

KIND = "filter"
_WAYS = (*damage.WAYS, "older")
_FILES = 12
"""Files of a step and its file of digests; the count follows orbax, a case beyond it is void."""
_SAID = re.compile("checkpoint", re.IGNORECASE)
READERS = {
    "evaluate": ("evaluate", "{run}", "--dry-run"),
    "landscape": ("landscape", "{run}", "--dry-run"),
    "report": ("report", "{run}", "--no-replay", "--out", "{out}.html"),
    "export": ("export", "{run}", "--out", "{out}", "--no-parts", "--no-sheet"),
}
"""Commands that read a run, without what they simulate."""


def steps(run: Path) -> list[int]:
    """Numbers of a run's checkpoints, the newest first."""
    found = (p.stem for p in (run / "checkpoints").glob("*.sha256"))
    return sorted((int(n) for n in found if n.isdigit()), reverse=True)


def files(run: Path, step: int) -> list[Path]:
    """Files of a checkpoint by folder and size, since orbax names some at random."""
    place = run / "checkpoints"
    inside = [p for p in (place / str(step)).rglob("*") if p.is_file()]
    return [*sorted(inside, key=lambda p: (str(p.parent), p.stat().st_size, p.name))] + [
        place / f"{step}.sha256"
    ]


def _damaged(bench: Bench, number: int, run: Path) -> tuple[str, bool] | None:
    """Copies the finished run and damages its newest checkpoint.

    Returns:
      What was done, and whether a reader finds anything else; None if there is no such file.
    """
    finished.copy(bench, KIND, run)
    newest, before = steps(run)[:2]
    mine, older = files(run, newest), files(run, before)
    which, way = number // len(_WAYS), _WAYS[number % len(_WAYS)]
    if which >= len(mine):
        return None
    other = older[which] if which < len(older) else None
    if way == "older" and other is None:
        return None
    path = mine[which]
    before, changed = damage.content(path), damage.apply(path, way, other)
    if path.suffix == ".sha256" and changed and (now := damage.content(path)) is not None:
        # How the last line ends says nothing.
        changed = (before or b"").decode().splitlines() != now.decode(errors="replace").splitlines()
    return f"{path.relative_to(run)} {way}", changed


def optimized(bench: Bench, number: int) -> Result:
    """The run's command goes on from the checkpoint before, and says so."""
    with bench.scratch() as scratch:
        run = scratch / "run"
        done = _damaged(bench, number, run)
        if done is None:
            return Result("no such file")
        what, changed = done
        newest = steps(finished.place(bench, KIND))[0]
        said = bench.command(*finished.arguments(KIND), "--out", run)
        if said.refused and (run / "checkpoints" / str(newest)).exists():
            return Result("refused")  # what another step's digests make of it is not known
        result = judged(said, run, finished.place(bench, KIND))
        if result.word != "same":
            return result._replace(detail=f"{what}: {result.detail}")
        if not changed or _SAID.search(said.text):
            return Result("same and said" if changed else "same bytes")
        # Orbax does not read all of its files.
        return Result("silent", f"{what}: {said.text}")


def read(bench: Bench, number: int) -> Result:
    """The commands that read the run say what is damaged, and export refuses."""
    tallies: dict[str, int] = {}
    with bench.scratch() as scratch:
        run, out = scratch / "run", scratch / "out"
        done = _damaged(bench, number, run)
        if done is None:
            return Result("no such file")
        what, changed = done
        for name, template in READERS.items():
            words = [word.format(run=run, out=out) for word in template]
            said = bench.command(*words)
            if said.traceback:
                return Result("traceback", f"{what}, {name}: {said.text}", tallies)
            if changed and not _SAID.search(said.text):
                return Result("silent", f"{what}, {name}: {said.text}", tallies)
            if changed and name == "export" and said.code != 2:
                return Result("exported", f"{what}: {said.text}", tallies)
            tallies[f"{name} {said.code}"] = 1
            shutil.rmtree(out, ignore_errors=True)
    return Result("said" if changed else "same bytes", "", tallies)


CAMPAIGNS = (
    Campaign(
        "checkpoint",
        _FILES * len(_WAYS),
        optimized,
        "no such file, refused, same and said, same bytes",
    ),
    Campaign("readers", _FILES * len(_WAYS), read, "no such file, said, same bytes"),
)
