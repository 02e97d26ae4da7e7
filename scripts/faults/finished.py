"""Runs that nothing interrupted, made once, and the comparison of others with them."""

import hashlib
import json
import os
import shutil
import time
from pathlib import Path

import numpy as np

import codesign_jax
from scripts.faults.bench import Bench

SIZE = ("--preset", "2d", "--particles", "4", "--trials", "3", "--test-trials", "3")
LINKS = ("--set", "discretization.links=3")
RUNS = {
    "filter": ("--scene", "paper_spheres", "--episodes", "6", "--reference-trials", "0"),
    "pso": ("--scene", "paper_spheres", "--episodes", "4", "--optimizer", "pso")
    + ("--reference-trials", "0"),
    "tested": ("--scene", "paper_spheres", "--episodes", "4", "--reference-trials", "3"),
    "hull": ("--scene", "paper", "--episodes", "4", "--reference-trials", "0"),
    "extended": ("--scene", "paper_spheres", "--episodes", "8", "--reference-trials", "0"),
}
"""Kinds of runs: what differs. `extended` is begun with fewer episodes, see `SHORTER`."""
SHORTER = "4"
TABLES = ("episodes.csv", "particles.csv", "trials.csv", "tests.csv")
SOURCES = ("scene.toml", "hand.toml", "objects.toml")


def arguments(kind: str, *, episodes: str | None = None) -> list[str]:
    """Arguments of `codesign` for a run of a kind, but for its folder."""
    more = [] if episodes is None else ["--episodes", episodes]
    return ["optimize", *SIZE, *RUNS[kind], *LINKS, "--seed", "3", *more]


def place(bench: Bench, kind: str) -> Path:
    """Folder of the finished run of a kind, which nobody may change; made at first use.

    Raises:
      RuntimeError: If the command does not end well without any fault.
    """
    folder = bench.folder / "finished" / kind
    with bench.making(folder) as new:
        if new:
            part = bench.scratch_folders / "new"
            said = bench.command(*arguments(kind), "--out", part)
            if said.code or said.traceback:
                raise RuntimeError(f"a run without faults failed: {said.text}")
            part.rename(folder)
    return folder


def copy(bench: Bench, kind: str, to: Path) -> Path:
    """Copies the finished run of a kind."""
    return Path(shutil.copytree(place(bench, kind), to, symlinks=True))


def seconds(bench: Bench, kind: str) -> float:
    """Time that a run of a kind takes in a process of its own; measured at first use."""
    path = bench.folder / "finished" / f"{kind}.json"
    with bench.making(path) as new:
        if new:
            place(bench, kind)  # programs are compiled and on disk
            with bench.scratch() as scratch:
                begin = time.monotonic()
                bench.finish(bench.start(*arguments(kind), "--out", scratch / "run"))
                whole(path, json.dumps(time.monotonic() - begin))
    return json.loads(path.read_text())


def took(bench: Bench, kind: str, seconds: float) -> None:
    """Corrects what `seconds` says of a kind."""
    whole(bench.folder / "finished" / f"{kind}.json", json.dumps(seconds))


def whole(path: Path, text: str) -> None:
    """Writes a file that others see as a whole."""
    part = path.with_suffix(f".{os.getpid()}")
    part.write_text(text)
    part.rename(path)


def code_digest() -> str:
    """Digest of the package's code, to which finished runs belong."""
    total = hashlib.sha256()
    root = Path(codesign_jax.__file__).parent
    for path in sorted([*root.rglob("*.py"), *root.rglob("*.toml")]):
        total.update(f"{path.relative_to(root)}\n".encode() + path.read_bytes())
    return total.hexdigest()


def differences(run: Path, finished: Path) -> list[str]:
    """What of a run's results is not bit for bit that of an uninterrupted run, by name.

    Tables and scene files by their bytes, checkpoints and outcomes at reference by their arrays. A
    file that only one of them has is a difference, and so is a temporary file that was left.
    """
    from codesign_jax import runs
    from codesign_jax.runs.checkpoint import digest
    from codesign_jax.runs.record import to_arrays

    found = []
    for name in (*TABLES, *SOURCES):
        if not _same_bytes(run / name, finished / name):
            found.append(name)
    found += [f"checkpoint {n}" for n in _unequal(_steps(run, finished), _steps(finished))]
    records = [runs.load_record(folder) for folder in (run, finished)]
    digests = [record and digest(to_arrays(record)) for record in records]
    if digests[0] is None or digests[0] != digests[1]:
        found.append("the record")
    if _reference(run) != _reference(finished):
        found.append("reference.npz")
    left = [p.name for p in run.rglob("*") if p.name.endswith((".tmp", ".part"))]
    left += [p.name for p in run.rglob("*.orbax-checkpoint-tmp*")]
    return found + [f"left behind: {name}" for name in left]


def _same_bytes(a: Path, b: Path) -> bool:
    if not (a.is_file() and b.is_file()):
        return not a.exists() and not b.exists()
    return a.read_bytes() == b.read_bytes()


def _steps(run: Path, like: Path | None = None) -> dict[str, str]:
    """Digest of the arrays of each checkpoint, but for those that say whose it is.

    Args:
      run: The run folder.
      like: A run; checkpoints older than all of its own are left out: a disk that fails when they
        are to be deleted leaves them, and nobody reads them.
    """
    import orbax.checkpoint as ocp

    from codesign_jax.runs.checkpoint import digest

    found = {}
    with ocp.StandardCheckpointer() as reader:
        kept = (run if like is None else like) / "checkpoints"
        oldest = min((int(p.stem) for p in kept.glob("*.sha256") if p.stem.isdigit()), default=0)
        for path in (run / "checkpoints").glob("*.sha256"):
            if path.stem.isdigit() and int(path.stem) < oldest:
                continue
            try:
                place = (run / "checkpoints" / path.stem / "default").resolve()
                arrays = dict(reader.restore(place))
                arrays.pop("run", None)
                found[path.stem] = digest(arrays)
            except Exception as error:  # whatever orbax meets there
                found[path.stem] = repr(error)
    return found


def _unequal(a: dict[str, str], b: dict[str, str]) -> list[str]:
    return sorted(name for name in {*a, *b} if a.get(name) != b.get(name))


def _reference(run: Path) -> dict[str, bytes] | None:
    path = run / "reference.npz"
    if not path.is_file():
        return None
    with np.load(path, allow_pickle=False) as stored:
        return {name: stored[name].tobytes() for name in stored.files if name != "key"}
