"""Caches that are damaged, exchanged, full or filled by a killed process; files of arrays."""

import os
import random
import shutil
import signal
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from scripts.faults import damage, finished, products
from scripts.faults.bench import Bench
from scripts.faults.campaigns import Campaign
from scripts.faults.kills import judged
from scripts.faults.numbers import FAILING
from scripts.faults.shim import Mode
from scripts.faults.store import Result

KIND = "filter"
_WAYS = ("emptied", "half", "first byte flipped", "middle byte flipped", "last byte flipped")
_WAYS += ("zeros", "a folder", "deleted")


def _copy(scratch: Path) -> Path:
    """A copy of the harness's own caches; returns the folder that a process gets for all caches."""
    from codesign_jax import kept_programs

    own, place = Path(os.environ["XDG_CACHE_HOME"]) / "codesign-jax", scratch / "cache"
    kept_programs.check(own / "jax")  # forks and workers end without their list of programs
    shutil.copytree(own, place / "codesign-jax")
    return place


def _programs(place: Path) -> list[Path]:
    """Compiled programs of JAX's, the smaller half: the others take seconds to compile again."""
    found = sorted((place / "codesign-jax" / "jax").glob("*-cache"))
    found.sort(key=lambda path: path.stat().st_size)
    return found[: len(found) // 2]


def _run(bench: Bench, scratch: Path, cache: Path, armed: Any = None) -> Result:
    """A run in a process that has these caches: the same, and nothing said of caches."""
    run = scratch / "run"
    words = [*finished.arguments(KIND), "--out", run]
    said = bench.finish(
        bench.start(*words, environment={"XDG_CACHE_HOME": str(cache)}, armed=armed)
    )
    if "Error reading persistent" in said.text:
        return Result("warnings", said.text)
    return judged(said, run, finished.place(bench, KIND))


def _mended(bench: Bench, entries: list[Path], scratch: Path, cache: Path) -> Result:
    """The run with damaged entries, of which it needs some and makes these again."""
    before = {path: damage.content(path) for path in entries}
    result = _run(bench, scratch, cache)
    again = sum(damage.content(p) not in (None, content) for p, content in before.items())
    # Kernels are looked at one by one when they are needed, programs all at the start.
    programs = {p: content for p, content in before.items() if p.name.endswith("-cache")}
    left = sum(v is not None and damage.content(p) == v for p, v in programs.items())
    if result.word == "same" and left:
        return Result("not mended", f"{left} damaged entries are left")
    if result.word == "same" and not again:
        return Result("none needed", "the run made none of the damaged entries again")
    return result._replace(tallies={"entries": len(entries), "made again": again})


def _json(place: Path) -> list[Path]:
    return sorted((place / "codesign-jax").rglob("*.json"))


def _kernels(place: Path) -> list[Path]:
    return sorted((place / "codesign-jax" / "jax" / "kernels").glob("*.kernel"))


_ENTRIES: tuple[Callable[[Path], list[Path]], ...] = (_programs, _kernels)


def damaged(bench: Bench, number: int) -> Result:
    """Damaged entries are found, deleted and made again: the same run, without a warning."""
    way = _WAYS[number // len(_ENTRIES) % len(_WAYS)]
    with bench.scratch() as scratch:
        finished.place(bench, KIND)
        cache = _copy(scratch)
        entries = _ENTRIES[number % len(_ENTRIES)](cache)
        # The lists tell whether programs are what was written: both at once is another matter.
        for path in entries + (_json(cache) if number % 2 else []):
            damage.apply(path, way)
        return _mended(bench, entries, scratch, cache)


def exchanged(bench: Bench, number: int) -> Result:
    """JAX's entries exchanged with one another: it would load the wrong program."""
    with bench.scratch() as scratch:
        finished.place(bench, KIND)
        cache = _copy(scratch)
        entries = _programs(cache)
        contents = [path.read_bytes() for path in entries]
        by = 1 + number
        for path, content in zip(entries, contents[by:] + contents[:by], strict=True):
            path.write_bytes(content)
        return _mended(bench, entries, scratch, cache)


def full(bench: Bench, number: int) -> Result:
    """A full disk below the caches alone: the run is the same, and the next finds nothing torn."""
    chance = random.Random(f"full caches {number}")
    with bench.scratch() as scratch:
        finished.place(bench, KIND)
        cache = _copy(scratch)
        for path in _programs(cache):
            path.unlink()
        at = chance.randint(1, 60)
        result = _run(bench, scratch, cache, (cache, at, Mode.FULL))
        if result.word != "same":
            return result
        shutil.rmtree(scratch / "run")
        return _run(bench, scratch, cache)


def cold(bench: Bench, number: int) -> Result:
    """SIGKILL while empty caches are filled: the next process finds no torn entry."""
    chance = random.Random(f"cold {number}")
    with bench.scratch() as scratch:
        finished.place(bench, KIND)
        cache = scratch / "cache"
        words = [*finished.arguments(KIND), "--out", scratch / "run"]
        process = bench.start(*words, environment={"XDG_CACHE_HOME": str(cache)})
        moment = chance.uniform(0.3, 1.0) * 4 * finished.seconds(bench, KIND)
        if process.wait(moment) is None:
            process.send(signal.SIGKILL)
        bench.finish(process)
        entries = len(_programs(cache))
        result = _run(bench, scratch, cache)
        return result._replace(tallies={"entries": entries})


def _failure(bench: Bench) -> Path:
    """A file of a failed world, from a run in which all fail; made at first use."""
    path = bench.folder / "finished" / "failure.npz"
    with bench.making(path) as new, bench.scratch() as scratch:
        if new:
            words = ["optimize", *finished.SIZE, "--scene", "paper_spheres", *FAILING]
            bench.command(*words, "--episodes", "1", "--out", scratch / "run")
            found = sorted((scratch / "run" / "failures").glob("*.npz"))
            shutil.copyfile(found[0], scratch / "part")
            (scratch / "part").rename(path)
    return path


def _part(bench: Bench) -> Path:
    """The file from which a landscape that was killed goes on."""
    from codesign_jax import archives

    path = bench.scratch_folders / "part.npz"
    if not path.exists():
        file = archives.Parts(path)
        for k in range(3):
            file.append({"cost": np.arange(6.0) + k, "status": np.zeros(6, np.int32)})
    return path


def _grid(bench: Bench) -> Path:
    """A stored grid, of a mesh small enough to be read some thousand times."""
    from codesign_jax import archives

    path = bench.scratch_folders / "grid.npz"
    if not path.exists():
        values = np.random.default_rng(0).normal(size=(12, 12, 12)).astype(np.float32)
        archives.save(path, {"name": path.name, "values": values}, compressed=True)
    return path


def _read_reference(path: Path) -> Any:
    from codesign_jax.runs import outcomes

    outcomes.count(path)
    found = outcomes.load(path, _KEYS[path.parent])[0]
    return None if found is None else found._asdict()


def _read_landscape(path: Path) -> Any:
    from codesign_jax.report import landscape

    return landscape.load(path)._asdict()


def _read_failure(path: Path) -> Any:
    from codesign_jax.runs import failures

    found = failures.load(path)
    return {**found._asdict(), **found.trial._asdict(), "trial": 0}


def _read_part(path: Path) -> Any:
    from codesign_jax import archives

    found = archives.Parts(path).found
    return {f"{k}-{n}": v for k, part in enumerate(found) for n, v in part.items()}


def _read_grid(path: Path) -> Any:
    from codesign_jax import archives

    return archives.load(path)


_KEYS: dict[Path, str] = {}


def _reference(bench: Bench) -> Path:
    path = finished.place(bench, "tested") / "reference.npz"
    with np.load(path, allow_pickle=False) as stored:
        _KEYS[bench.scratch_folders] = str(stored["key"])
    return path


def _landscape(bench: Bench) -> Path:
    return products.product(bench, "landscape") / "landscape.npz"


_ARCHIVES: tuple[tuple[Callable[[Bench], Path], Callable[[Path], Any]], ...] = (
    (_reference, _read_reference),
    (_landscape, _read_landscape),
    (_failure, _read_failure),
    (_part, _read_part),
    (_grid, _read_grid),
)
_WHOLE: dict[int, tuple[bytes, Any]] = {}


def _changed(content: bytes, chance: random.Random) -> bytes:
    """A bit flipped, a byte set or deleted, some zeroed, or the end cut off."""
    data, at = bytearray(content), chance.randrange(len(content))
    match chance.randrange(6):
        case 0 | 1 | 2:
            data[at] ^= 1 << chance.randrange(8)
        case 3:
            data[at] = chance.randrange(256)
        case 4:
            del data[at : at + chance.choice((1, 1, 4, len(data)))]
        case 5:
            stop = min(len(data), at + chance.choice((4, 64)))
            data[at:stop] = bytes(stop - at)
    return bytes(data)


def archive(bench: Bench, number: int) -> Result:
    """A file of arrays with a damage is refused by its own error, or holds what was written."""
    from codesign_jax.archives import ArchiveError
    from codesign_jax.scene.schema import InputError

    which = number % len(_ARCHIVES)
    make, read = _ARCHIVES[which]
    path = bench.scratch_folders / "archive.npz"
    if which not in _WHOLE:
        content = make(bench).read_bytes()
        path.write_bytes(content)
        _WHOLE[which] = content, read(path)
    content, whole = _WHOLE[which]
    other = _changed(content, random.Random(f"archive {number}"))
    path.write_bytes(other)
    try:
        found = read(path)
    except (InputError, ArchiveError):
        return Result("refused")
    except Exception as error:
        return Result("escaped", f"{make.__name__}: {error!r}")
    if found is None:
        return Result("refused")
    wrong = [n for n, v in found.items() if not _equal(v, whole.get(n))]
    if wrong:
        return Result("wrong", f"{make.__name__}: {wrong}")
    same = other == content or set(found) == set(whole)
    return Result("same" if same else "fewer parts")


def _equal(a: Any, b: Any) -> bool:
    a, b = np.asarray(a), np.asarray(b)
    return a.dtype == b.dtype and a.shape == b.shape and a.tobytes() == b.tobytes()


CAMPAIGNS = (
    Campaign("caches", len(_ENTRIES) * len(_WAYS), damaged, "same", limit=900),
    Campaign("exchanged", 2, exchanged, "same", limit=900),
    Campaign("caches-full", 2, full, "same", limit=900),
    Campaign("cold", 2, cold, "same", limit=900),
    Campaign("archives", 25_000, archive, "fewer parts, refused, same", size=2500, limit=120),
)
