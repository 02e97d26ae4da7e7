"""Folders that are not, or no longer, the run of the command; strange places for --out."""

import os
import shutil
from collections.abc import Callable
from pathlib import Path

from scripts.faults import checkpoints, damage, finished
from scripts.faults.bench import Bench
from scripts.faults.campaigns import Campaign
from scripts.faults.folders import KIND, changes, snapshot, words_of
from scripts.faults.kills import judged
from scripts.faults.store import Result


def _of_another_seed(bench: Bench, run: Path) -> None:
    other = finished.place(bench, "extended")
    shutil.rmtree(run / "checkpoints")
    shutil.copytree(other / "checkpoints", run / "checkpoints")


def _renamed(bench: Bench, run: Path) -> None:
    folder, (newest, before) = run / "checkpoints", checkpoints.steps(run)[:2]
    shutil.rmtree(folder / str(newest))
    shutil.copytree(folder / str(before), folder / str(newest))
    text = (folder / f"{before}.sha256").read_text()
    (folder / f"{newest}.sha256").write_text(text.replace(f"  {before}/", f"  {newest}/"))


def _all_deleted(bench: Bench, run: Path) -> None:
    shutil.rmtree(run / "checkpoints")


def _all_damaged(bench: Bench, run: Path) -> None:
    for step in checkpoints.steps(run):
        damage.apply(run / "checkpoints" / f"{step}.sha256", "zeros")


_WHOSE = (_of_another_seed, _renamed, _all_deleted, _all_damaged)


def whose(bench: Bench, number: int) -> Result:
    """Checkpoints of another run, of another step, or none at all: refused, and nothing is lost."""
    which, command = divmod(number, 1 + len(checkpoints.READERS))
    name = ("optimize", *checkpoints.READERS)[command]
    with bench.scratch() as scratch:
        run = finished.copy(bench, KIND, scratch / "run")
        _WHOSE[which](bench, run)
        before = snapshot(run)
        said = bench.command(*words_of(name, run, scratch / "out"))
        what = f"{_WHOSE[which].__name__}, {name}"
        if said.traceback:
            return Result("traceback", f"{what}: {said.text}")
        if said.refused:
            return Result("lost" if changes(before, run) else "refused", f"{what}: {said.text}")
        return Result("silent", f"{what}: {said.text}")


def _sources(bench: Bench, mine: Path) -> list[str]:
    for name in finished.SOURCES:
        text = (finished.place(bench, KIND) / name).read_text()
        (mine / name).write_text(f"# my own comment\n{text}")
    (mine / "meshes").mkdir()
    (mine / "meshes" / "own.stl").write_text("solid own\nendsolid own\n")
    return ["optimize", *finished.SIZE, "--scene", str(mine / "scene.toml"), "--episodes", "1"]


def _without_provenance(bench: Bench, mine: Path) -> list[str]:
    shutil.rmtree(mine)
    finished.copy(bench, KIND, mine)
    (mine / "provenance.json").unlink()
    return [*finished.arguments(KIND), "--seed", "9"]


def _shown(bench: Bench, mine: Path) -> list[str]:
    (mine / "landscape.npz").write_bytes(b"hours of work")
    (mine / "report.html").write_text("<p>years of work")
    return finished.arguments(KIND)


def _named_as_ours(bench: Bench, mine: Path) -> list[str]:
    for name in ("episodes.csv", "trials.csv", "events.log", "reference.npz"):
        (mine / name).write_text("mine\n")
    return finished.arguments(KIND)


def _figures(bench: Bench, mine: Path) -> list[str]:
    (mine / "figures").mkdir()
    (mine / "figures" / "mine.png").write_bytes(b"a picture")
    return finished.arguments(KIND)


def _thesis(bench: Bench, mine: Path) -> list[str]:
    (mine / "thesis.tex").write_text("years of work")
    return [*finished.arguments(KIND), "--fresh"]


def _temporary(bench: Bench, mine: Path) -> list[str]:
    (mine / "letter.tmp").write_text("mine")
    return finished.arguments(KIND)


_FOREIGN = (_sources, _without_provenance, _shown, _named_as_ours, _figures, _thesis, _temporary)


def foreign(bench: Bench, number: int) -> Result:
    """Folders with files that are not a run's: refused, and not one of them is changed."""
    with bench.scratch() as scratch:
        mine = scratch / "mine"
        mine.mkdir()
        words = _FOREIGN[number](bench, mine)
        every = {p.name: damage.content(p) for p in mine.rglob("*")}
        said = bench.command(*words, "--out", mine)
        kept = {p.name: damage.content(p) for p in mine.rglob("*") if p.name in every}
        what = f"{_FOREIGN[number].__name__}: status {said.code}: {said.text}"
        if kept != every:
            return Result("lost", what)
        if said.traceback:
            return Result("traceback", what)
        return Result("refused" if said.refused else "accepted", what)


_OUTS: dict[str, Callable[[Path], str]] = {
    "a file": lambda s: str(_made(s / "file")),
    "below a file": lambda s: str(_made(s / "file") / "run"),
    "/proc": lambda s: "/proc/run",
    "300 characters": lambda s: str(s / ("n" * 300)),
    "spaces, umlauts, quotes": lambda s: str(s / "räume 名前 'a' \"b\" $(touch x) ; rm *"),
    "bytes that are no text": lambda s: os.fsdecode(os.fsencode(s) + b"/a\xffb"),
    "a line feed": lambda s: str(s / "a\nb"),
    "an empty name": lambda s: "",
    "read-only": lambda s: str(_closed(s / "closed") / "run"),
    "a link to nowhere": lambda s: str(_linked(s / "link")),
    "a link in a circle": lambda s: str(_circle(s / "circle")),
}


def _made(path: Path) -> Path:
    path.write_text("mine")
    return path


def _closed(path: Path) -> Path:
    path.mkdir(mode=0o500)
    return path


def _linked(path: Path) -> Path:
    path.symlink_to(path.parent / "nowhere" / "else")
    return path


def _circle(path: Path) -> Path:
    path.symlink_to(path)
    return path


def places(bench: Bench, number: int) -> Result:
    """Strange places for --out: they work, or are refused with exit status 2."""
    name, make = list(_OUTS.items())[number]
    with bench.scratch() as scratch:
        out = make(scratch)
        said = bench.command(*finished.arguments(KIND), "--out", out)
        if said.traceback:
            return Result("traceback", f"{name}: {said.text}")
        if said.code == 2:
            return Result("refused")
        if said.code:
            return Result("blocked", f"{name}: status {said.code}: {said.text}")
        where = Path(out) if out else scratch
        return judged(said, where.resolve(), finished.place(bench, KIND))


CAMPAIGNS = (
    Campaign("whose", len(_WHOSE) * (1 + len(checkpoints.READERS)), whose, "refused"),
    Campaign("foreign", len(_FOREIGN), foreign, "refused"),
    Campaign("places", len(_OUTS), places, "same, refused"),
)
