"""What the other commands write is there as a whole or not at all, whatever ends them."""

import io
import json
import random
import shutil
import signal
import time
from pathlib import Path

from scripts.faults import finished
from scripts.faults.bench import Bench, Said
from scripts.faults.campaigns import Campaign
from scripts.faults.shim import Mode
from scripts.faults.store import Result

KIND = "filter"
COMMANDS = {
    "landscape": ("landscape", "{run}", "--points", "3", "--trials", "1", "--out", "{out}"),
    "export": ("export", "{run}", "--no-parts", "--out", "{out}"),
    "evaluate": ("evaluate", "{run}", "--trials", "1", "--render", "{out}/grasp.png"),
    "report": ("report", "{run}", "--no-replay", "--out", "{out}/report.html"),
}
_DATED = {".html": b"</html>", ".pdf": b"%%EOF"}
"""Kinds of files that hold a date, and how a whole one ends."""
_UNFINISHED = "landscape.part.npz"
_NAMES = tuple(COMMANDS)


def _words(bench: Bench, name: str, out: Path) -> list[str]:
    run = finished.place(bench, KIND)
    return [word.format(run=run, out=out) for word in COMMANDS[name]]


def product(bench: Bench, name: str) -> Path:
    """What a command writes without any fault; made at first use, with its time and operations."""
    folder = bench.folder / "finished" / f"product-{name}"
    with bench.making(folder) as new:
        if new:
            _make(bench, name, folder)
    return folder


def _make(bench: Bench, name: str, folder: Path) -> None:
    part, known = bench.scratch_folders / "product" / "out", {}
    for _ in range(2):  # the first time compiles
        shutil.rmtree(part.parent, ignore_errors=True)
        part.parent.mkdir(parents=True)
        bench.shim.arm(part.parent)
        begin = time.monotonic()
        said = bench.command(*_words(bench, name, part))
        known = {"seconds": time.monotonic() - begin, "operations": bench.shim.disarm()}
        if said.code or said.traceback:
            raise RuntimeError(f"{name} without faults failed: {said.text}")
    folder.with_suffix(".json").write_text(json.dumps(known))
    part.rename(folder)


def _known(bench: Bench, name: str, what: str) -> float:
    product(bench, name)
    path = bench.folder / "finished" / f"product-{name}.json"
    return json.loads(path.read_text())[what]


def torn(out: Path, whole: Path, *, finished_now: bool) -> list[str]:
    """Files that are not as they should be; those in .tmp do not count.

    Args:
      out: What was written.
      whole: What is written without any fault.
      finished_now: Whether nothing may be missing, or left of an earlier attempt.
    """
    found = []
    names = {p.relative_to(whole).as_posix() for p in whole.rglob("*") if p.is_file()}
    here = {p.relative_to(out).as_posix() for p in out.rglob("*") if p.is_file()}
    temporary = {n for n in here if n.endswith((".tmp", _UNFINISHED))}
    here -= {n for n in here if n.endswith(".tmp")}
    if finished_now and (names - here or here - names):
        found.append(f"missing {sorted(names - here)}, left {sorted(here - names)}")
    for name in here & names - temporary:
        mine, theirs = (out / name).read_bytes(), (whole / name).read_bytes()
        ending = _DATED.get(Path(name).suffix)
        if ending is not None:
            if ending not in mine[-64:] or abs(len(mine) - len(theirs)) > 2000:
                found.append(name)
        elif mine != theirs and not _picture(name, mine):
            found.append(name)
    return found


def _picture(name: str, content: bytes) -> bool:
    """Whether a picture can be read to its end; its bytes may hold a date."""
    if not name.endswith((".png", ".gif")):
        return False
    from PIL import Image

    try:
        with Image.open(io.BytesIO(content)) as image:
            image.load()
    except (OSError, SyntaxError, ValueError):
        return False
    return True


def _judged(bench: Bench, name: str, out: Path, said: Said, tallies: dict[str, int]) -> Result:
    """What a fault left, and whether the same command completes it."""
    whole = product(bench, name)
    bad = torn(out, whole, finished_now=False)
    complete = out.exists() and not torn(out, whole, finished_now=True)
    if name == "export" and out.exists() and not complete:
        bad.append("a folder that is not complete")
    if bad:
        return Result("torn", f"{name}: {bad}: {said.text}", tallies)
    if not (name == "export" and complete):  # which is not written over
        again = bench.command(*_words(bench, name, out))
        if again.code or again.traceback:
            return Result("blocked", f"{name}: then {again.text}", tallies)
    bad = torn(out, whole, finished_now=True)
    bad += [p.name for p in out.parent.iterdir() if p.name.endswith((".part", ".tmp"))]
    # Of a process that was killed while it wrote: who writes later cannot know that it is dead.
    tallies["temporary files left"] = len([*out.rglob("*.tmp")])
    if said.code != -signal.SIGKILL and tallies["temporary files left"]:
        bad.append("a temporary file of a process that ended by itself")
    if bad:
        return Result("torn", f"{name}: in the end {bad}: {said.text}", tallies)
    return Result("whole or absent", "", tallies)


def killed(bench: Bench, number: int) -> Result:
    """SIGKILL at a random moment, or at a file operation with half of a write done."""
    name = _NAMES[number % len(_NAMES)]
    chance = random.Random(f"products {number}")
    product(bench, name)
    with bench.scratch() as scratch:
        out = scratch / "out"
        words = _words(bench, name, out)
        if number // len(_NAMES) % 2:
            at = chance.randint(1, int(_known(bench, name, "operations")))
            said = bench.finish(bench.start(*words, armed=(scratch, at, Mode.KILL)))
        else:
            process = bench.start(*words)
            # A fork loads its programs for some seconds before it is where this process is at once.
            if process.wait(chance.uniform(1.0, 6.0 + _known(bench, name, "seconds"))) is None:
                process.send(signal.SIGKILL)
            said = bench.finish(process)
        tallies = {"kills": int(said.code == -signal.SIGKILL), name: 1}
        if said.code not in (0, -signal.SIGKILL) or said.traceback:
            return Result("traceback", f"{name}: status {said.code}: {said.text}", tallies)
        return _judged(bench, name, out, said, tallies)


def full(bench: Bench, number: int) -> Result:
    """ENOSPC from a file operation on, or EIO at one."""
    name, mode = _NAMES[number % len(_NAMES)], (Mode.FULL, Mode.BROKEN)[number // len(_NAMES) % 2]
    chance = random.Random(f"full {number}")
    at = chance.randint(1, int(_known(bench, name, "operations")))
    with bench.scratch() as scratch:
        out = scratch / "out"
        bench.shim.arm(scratch, at, mode)
        said = bench.command(*_words(bench, name, out))
        bench.shim.disarm()
        what, tallies = f"{name} {mode.name} at {at}", {f"status {said.code}": 1}
        if said.traceback:
            return Result("traceback", f"{what}: {said.text}", tallies)
        if said.code and (said.code not in (1, 2) or "error: " not in said.text):
            return Result("silent", f"{what}: status {said.code}: {said.text}", tallies)
        return _judged(bench, name, out, said, tallies)


CAMPAIGNS = (
    Campaign("products", 24, killed, "whole or absent", limit=600, tries="kills"),
    Campaign("products-full", 64, full, "whole or absent", limit=300),
)
