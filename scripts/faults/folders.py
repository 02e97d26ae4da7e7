"""Damage of a run folder beside its checkpoints, and folders that are no run's."""

import json
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

from scripts.faults import checkpoints, damage, finished
from scripts.faults.bench import Bench, Said
from scripts.faults.campaigns import Campaign
from scripts.faults.kills import judged
from scripts.faults.store import Result

KIND = "filter"
_WAYS = tuple(damage.WAYS)
_VARYING = {".lock", "events.log", "provenance.json"}
"""Files that a command may change though it refuses to go on."""


def snapshot(folder: Path) -> dict[str, bytes | None]:
    """Bytes of all files below a folder, links and unreadable ones included; None for a folder."""
    found = {}
    for path in sorted(folder.rglob("*")):
        name = path.relative_to(folder).as_posix()
        if path.name not in _VARYING and not path.name.endswith(".tmp"):
            found[name] = damage.content(path)
    return found


def changes(before: dict[str, bytes | None], run: Path) -> list[str]:
    """Names of what was changed, deleted or added below a folder; a new empty folder is nothing."""
    after = snapshot(run)
    names = {n for n in {*before, *after} if before.get(n) != after.get(n)}
    return sorted(names | set(before) - set(after))


def _ended(bench: Bench, said: Said, run: Path, before: dict, what: str) -> Result:
    """The outcome of `optimize` on a folder that it either mends or leaves as it is."""
    if said.traceback:
        return Result("traceback", f"{what}: {said.text}")
    if said.refused:
        if changed := changes(before, run):
            return Result("lost", f"{what}: {changed}: {said.text}")
        return Result("refused")
    result = judged(said, run, finished.place(bench, KIND))
    return result._replace(detail=f"{what}: {result.detail}")


def tables(bench: Bench, number: int) -> Result:
    """A damaged table of a finished run is written again from the checkpoints."""
    name, way = finished.TABLES[number // len(_WAYS)], _WAYS[number % len(_WAYS)]
    with bench.scratch() as scratch:
        run = finished.copy(bench, KIND, scratch / "run")
        damage.apply(run / name, way)
        before = snapshot(run)
        said = bench.command(*finished.arguments(KIND), "--out", run)
        return _ended(bench, said, run, before, f"{name} {way}")


def _digit(path: Path) -> None:
    """Changes the last digit of a file's numbers that is no comment's."""
    lines = path.read_text().splitlines()
    for k in range(len(lines) - 1, -1, -1):
        code, mark, comment = lines[k].partition("#")
        places = [i for i, c in enumerate(code) if c.isdigit()]
        if places and "=" in code:
            i = places[-1]
            code = code[:i] + str((int(code[i]) + 1) % 10) + code[i + 1 :]
            lines[k] = code + mark + comment
            break
    path.write_text("\n".join(lines) + "\n")


_READERS = ("optimize", "evaluate", "report")


def words_of(name: str, run: Path, out: Path) -> list[str]:
    """Arguments of a command for a run, which it continues or reads."""
    if name == "optimize":
        return [*finished.arguments(KIND), "--out", str(run)]
    return [word.format(run=run, out=out) for word in checkpoints.READERS[name]]


def scenes(bench: Bench, number: int) -> Result:
    """Changed scene files of a run are refused by every command that reads it."""
    number, command = divmod(number, len(_READERS))
    ways = (*_WAYS, "a digit")
    name, way = finished.SOURCES[number // len(ways)], ways[number % len(ways)]
    with bench.scratch() as scratch:
        run = finished.copy(bench, KIND, scratch / "run")
        _digit(run / name) if way == "a digit" else damage.apply(run / name, way)
        before = snapshot(run)
        said = bench.command(*words_of(_READERS[command], run, scratch / "out"))
        what = f"{name} {way}, {_READERS[command]}"
        if said.traceback:
            return Result("traceback", f"{what}: {said.text}")
        if said.refused:
            return Result("lost" if changes(before, run) else "refused", f"{what}: {said.text}")
        same = _same_scene(run, finished.place(bench, KIND))
        return Result("same scene" if same else "silent", f"{what}: {said.text}")


def _same_scene(run: Path, whole: Path) -> bool:
    from codesign_jax import scene
    from codesign_jax.scene.schema import InputError

    try:
        return scene.load(run / "scene.toml") == scene.load(whole / "scene.toml")
    except InputError:
        return False


def _edited(change: Callable[[dict[str, Any]], Any]) -> Callable[[Path], None]:
    def apply(path: Path) -> None:
        content = json.loads(path.read_text())
        change(content)
        path.write_text(json.dumps(content))

    return apply


def _text(text: str) -> Callable[[Path], None]:
    def apply(path: Path) -> None:
        path.write_text(text)

    return apply


_HOSTILE: dict[str, Callable[[Path], None]] = {
    "nested a hundred thousand times": _text("[" * 100_000),
    "an empty table": _text("{}"),
    "a list": _text("[1, 2]"),
    "a number of 5,000 digits": _text('{"settings": ' + "9" * 5000 + "}"),
    "no environment": _edited(lambda c: c.pop("environment")),
    "no settings": _edited(lambda c: c.pop("settings")),
    "episodes a text": _edited(lambda c: c["settings"].update(episodes="4")),
    "episodes NaN": _edited(lambda c: c["settings"].update(episodes=float("nan"))),
    "a schema of the future": _edited(lambda c: c.update(schema=99)),
    "resumed a number": _edited(lambda c: c.update(resumed=5)),
    "an unknown setting": _edited(lambda c: c["settings"].update(colour="red")),
    "files elsewhere": _edited(lambda c: c.update(files={"../../etc/passwd": "0"})),
}


def provenance(bench: Bench, number: int) -> Result:
    """A damaged provenance.json is refused, or does not matter; no file of the run is lost."""
    number, command = divmod(number, len(_READERS))
    ways = (*_WAYS, *_HOSTILE)
    way = ways[number % len(ways)]
    with bench.scratch() as scratch:
        run = finished.copy(bench, KIND, scratch / "run")
        path = run / "provenance.json"
        _HOSTILE[way](path) if way in _HOSTILE else damage.apply(path, way)
        before = snapshot(run)
        said = bench.command(*words_of(_READERS[command], run, scratch / "out"))
        what = f"{way}, {_READERS[command]}"
        if _READERS[command] == "optimize" or said.code:
            return _ended(bench, said, run, before, what)
        return Result("lost" if changes(before, run) else "harmless", f"{what}: {said.text}")


def _begun(bench: Bench, run: Path) -> Path:
    """A run that has all but its final test."""
    finished.copy(bench, KIND, run)
    newest = checkpoints.steps(run)[0]
    shutil.rmtree(run / "checkpoints" / str(newest))
    (run / "checkpoints" / f"{newest}.sha256").unlink()
    (run / "tests.csv").unlink()
    return run


_MODES = (0o000, 0o444, 0o500)
_PLACES = 22


def permissions(bench: Bench, number: int) -> Result:
    """What may not be read or written is said; once it may, the run goes on."""
    which, mode = divmod(number, len(_MODES))
    with bench.scratch() as scratch:
        run = _begun(bench, scratch / "run")
        newest = checkpoints.steps(run)[0]
        step = run / "checkpoints" / str(newest)
        places = [run, run / "checkpoints", run / "figures"]
        places += [*sorted(p for p in run.iterdir() if p.is_file()), step, step / "default"]
        places += checkpoints.files(run, newest)
        if which >= min(len(places), _PLACES):
            return Result("no such place")
        place = places[which]
        before = place.stat().st_mode
        what = f"{place.relative_to(scratch)} {_MODES[mode]:o}"
        place.chmod(_MODES[mode])
        said = bench.command(*finished.arguments(KIND), "--out", run)
        if place.exists():
            place.chmod(before)
        if said.traceback:
            return Result("traceback", f"{what}: {said.text}")
        if said.code and not said.refused:
            return Result("blocked", f"{what}: status {said.code}: {said.text}")
        again = bench.command(*finished.arguments(KIND), "--out", run)
        result = judged(again, run, finished.place(bench, KIND))
        word = f"refused; then {result.word}" if said.code else result.word
        return Result(word, f"{what}: {said.text}\n{result.detail}")


def notes(bench: Bench, number: int) -> Result:
    """events.log and .lock damaged: the run goes on, or says why it does not."""
    name, way = ("events.log", ".lock")[number // len(_WAYS)], _WAYS[number % len(_WAYS)]
    with bench.scratch() as scratch:
        run = _begun(bench, scratch / "run")
        damage.apply(run / name, way)
        before = snapshot(run)
        said = bench.command(*finished.arguments(KIND), "--out", run)
        return _ended(bench, said, run, before, f"{name} {way}")


CAMPAIGNS = (
    Campaign("tables", len(finished.TABLES) * len(_WAYS), tables, "same, refused"),
    Campaign("scenes", 3 * len(finished.SOURCES) * (len(_WAYS) + 1), scenes, "refused, same scene"),
    Campaign("provenance", 3 * (len(_WAYS) + len(_HOSTILE)), provenance, "refused, same, harmless"),
    Campaign(
        "permissions", len(_MODES) * _PLACES, permissions, "same, refused; then same, no such place"
    ),
    Campaign("notes", 2 * len(_WAYS), notes, "same, refused"),
)
