"""Processes that end at any moment, and files that cannot be written: runs go on bit for bit."""

import random
import signal
import time
from functools import partial
from pathlib import Path

from scripts.faults import finished
from scripts.faults.bench import Bench, Said
from scripts.faults.campaigns import Campaign
from scripts.faults.shim import Mode
from scripts.faults.store import Result

SIGNALS = (signal.SIGKILL, signal.SIGKILL, signal.SIGKILL, signal.SIGINT, signal.SIGTERM)
_KINDS = ("filter", "filter", "pso", "filter", "extended", "filter", "tested", "filter", "hull")
_OPERATIONS, _FULL, _BROKEN, _READ_ONLY = 100, 50, 50, 10
_ROOM = ("make room", "No space left", "space")


def killed(bench: Bench, number: int) -> Result:
    """A run ended one to three times at random moments, each time begun again by its command."""
    chance = random.Random(f"kills {number}")
    kind = _KINDS[number % len(_KINDS)]
    finished.place(bench, kind)
    longest, real = finished.seconds(bench, kind), number % 10 == 9
    tallies: dict[str, int] = {}
    with bench.scratch() as scratch:
        run = _begun(bench, kind, scratch / "run")
        words = [*finished.arguments(kind), "--out", run]
        for _ in range(1 + number % 3):
            chosen = chance.choice(SIGNALS)
            # A new interpreter imports for about as long as the rest takes.
            moment = chance.uniform(0.05, 1.0) * longest * (2 if real else 1)
            begin, process = time.monotonic(), bench.start(*words, real=real)
            if process.wait(moment) is not None:
                if not real:  # the machine is less busy than when this was measured
                    finished.took(bench, kind, time.monotonic() - begin)
                break
            process.send(chosen)
            said = bench.finish(process)
            name = signal.Signals(chosen).name
            tallies[name] = tallies.get(name, 0) + 1
            tallies["kills"] = tallies.get("kills", 0) + 1
            # Before the command has its handlers, SIGTERM ends a process as it ends any other.
            if said.code not in (-chosen, 128 + chosen, 0) or said.traceback:
                return Result("traceback", f"{name}, status {said.code}: {said.text}", tallies)
        if real:
            said = bench.finish(bench.start(*words, real=True))
        else:
            said = bench.command(*words)
        return judged(said, run, finished.place(bench, kind), tallies)


def _begun(bench: Bench, kind: str, run: Path) -> Path:
    """The folder of a run, which of the kind `extended` has its first episodes."""
    if kind == "extended":
        few = finished.arguments(kind, episodes=finished.SHORTER)
        said = bench.command(*few, "--out", run)
        if said.code:
            raise RuntimeError(said.text)
    return run


def judged(said: Said, run: Path, whole: Path, tallies: dict[str, int] | None = None) -> Result:
    """Compares a run with an uninterrupted one, once its command said that it is done."""
    if said.code or said.traceback:
        return Result("blocked", f"status {said.code}: {said.text}", tallies or {})
    different = finished.differences(run, whole)
    if different:
        return Result("differs", f"{', '.join(different)}: {said.text}", tallies or {})
    return Result("same", "", tallies or {})


def count_operations(bench: Bench) -> int:
    """File operations of an uninterrupted run, fewer than a few that vary."""
    path = bench.folder / "finished" / "operations"
    with bench.making(path) as new:
        if new:
            finished.place(bench, "filter")
            with bench.scratch() as scratch:
                bench.shim.arm(scratch / "run")
                bench.command(*finished.arguments("filter"), "--out", scratch / "run")
                count = bench.shim.disarm()
            finished.whole(path, str(count))
    return int(path.read_text())


def _place(bench: Bench, number: int, of: int) -> int:
    """The operation of a case: the cases are spread over a run, then between one another."""
    step = count_operations(bench) / of
    return 1 + int(step * (number % of) + step / 2 + 0.37 * step * (number // of)) % int(step * of)


def killed_at(bench: Bench, number: int) -> Result:
    """SIGKILL at a chosen file operation; of a write half is done."""
    at = _place(bench, number, _OPERATIONS)
    with bench.scratch() as scratch:
        run = scratch / "run"
        words = [*finished.arguments("filter"), "--out", run]
        said = bench.finish(bench.start(*words, armed=(run, at, Mode.KILL)))
        if said.code != -signal.SIGKILL:
            return Result("not reached" if not said.code else "blocked", f"{at}: {said.text}")
        return judged(bench.command(*words), run, finished.place(bench, "filter"))


def failing(bench: Bench, number: int, *, mode: Mode, of: int) -> Result:
    """File operations that fail: the command says so, and goes on once they no longer do."""
    at = _place(bench, number, of)
    tallies: dict[str, int] = {}
    with bench.scratch() as scratch:
        run = scratch / "run"
        words = [*finished.arguments("filter"), "--out", run]
        bench.shim.arm(run, at, mode)
        said = bench.command(*words)
        bench.shim.disarm()
        tallies[f"status {said.code}"] = 1
        if said.traceback:
            return Result("traceback", f"at {at}: {said.text}", tallies)
        if said.code not in (0, 1, 2):
            return Result("blocked", f"at {at}: status {said.code}: {said.text}", tallies)
        if said.code and "error: " not in said.text:
            return Result("silent", f"at {at}: status {said.code}: {said.text}", tallies)
        if said.code == 0 and mode is not Mode.BROKEN and not run.exists():
            return Result("silent", f"at {at}: {said.text}", tallies)
        return judged(bench.command(*words), run, finished.place(bench, "filter"), tallies)


CAMPAIGNS = (
    Campaign("kills", 100, killed, "same", limit=900, tries="kills"),
    Campaign("operations", _OPERATIONS, killed_at, "not reached, same", limit=600),
    Campaign("full", _FULL, partial(failing, mode=Mode.FULL, of=_FULL), "same", limit=300),
    Campaign("broken", _BROKEN, partial(failing, mode=Mode.BROKEN, of=_BROKEN), "same", limit=300),
    Campaign(
        "read-only",
        _READ_ONLY,
        partial(failing, mode=Mode.READ_ONLY, of=_READ_ONLY),
        "same",
        limit=300,
    ),
)
