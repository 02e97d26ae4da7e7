"""Which files of a folder are a run's: what may be deleted there, and what is refused.

A start writes a marker first: the names of the files that it is about to make, and digests of their
contents.  A folder without provenance.json is cleared of these files only, while they have these
contents.  `--fresh` deletes the files that a run has by their names, provenance.json last, so that
it can be given again if it was cut short.
"""

import json
import os
import re
import shutil
from collections.abc import Iterator, Mapping
from hashlib import sha256
from pathlib import Path

from codesign_jax import files, own
from codesign_jax.runs.columns import FILES, TABLES
from codesign_jax.runs.manifest import PROVENANCE, digests
from codesign_jax.runs.scene_files import MESHES, NAMES
from codesign_jax.scene.schema import InputError

LOCK, MARKER = ".lock", ".start.json"
_OURS = {*FILES, *TABLES, LOCK, MARKER}
_MESH = re.compile(r"object_[0-9]+\.[a-z0-9.]+")
_INSIDE = {
    own.FOLDER: re.compile(r"[A-Za-z_][\w.]*\.py"),
    "checkpoints": re.compile(r"[0-9]+(\.sha256|\.orbax-checkpoint-tmp.*)?"),
    "failures": re.compile(r"episode-[0-9]+-particle-[0-9]+-trial-[0-9]+\.npz"),
    "figures": re.compile(r"(cost_evolution|landscape)\.png"),
    MESHES: _MESH,
}
"""Names in the folders of a run; folders of steps are the run's with all that is in them."""


def refuse_foreign(path: Path) -> None:
    """Refuses a folder with files of other names than a run's."""
    if path.is_symlink() and not path.exists():
        raise InputError([f"--out {path} is a symbolic link to nothing"])
    if path.exists() and not path.is_dir():
        raise InputError([f"--out {path} is a file"])
    others = [name for name in _top(path) if _named(name) not in _OURS]
    if LOCK in _top(path) and not _is_lock(path / LOCK):
        others.append(LOCK)
    if others:
        raise InputError(
            [f"--out {path} holds other files ({_some(others)}); choose another folder"]
        )


def refuse_unmarked(path: Path) -> None:
    """Refuses a folder that is no run and holds more than what a start that was cut short left."""
    if (path / PROVENANCE).exists():
        return
    made = _marked(path)
    others = [name for name in _all(path) if not _is_left(path, name, made)]
    if not others:
        return
    if (path / "checkpoints").exists():
        hint = f"if it is a run that lost {PROVENANCE}, put that back from a copy and it goes on"
    else:
        hint = "they may be yours, or of a start that was cut short"
    raise InputError(
        [
            f"--out {path} holds {_some(others)} and no {PROVENANCE}: {hint}. Nothing was changed. "
            "Choose another folder, or delete these files yourself, if nobody needs them"
        ]
    )


def refuse_to_delete(path: Path, sources: tuple[Path, ...] = ()) -> None:
    """Refuses `--fresh` where more than a run's own files would go."""
    place = path.resolve()
    read = [str(file) for file in sources if place in file.resolve().parents]
    if read:
        raise InputError(
            [
                f"--fresh would delete {_some(read)}, which this command reads: copy the files of "
                "the scene to another folder, or choose another --out"
            ]
        )
    links = [name for name in _all(path) if (path / name).is_symlink()]
    if links:
        raise InputError(
            [f"--fresh deletes no symbolic links ({_some(links)} in {path}): delete them yourself"]
        )
    others = [name for name in _all(path) if not _is_of_a_run(path, name)]
    if others:
        raise InputError(
            [
                f"--fresh would delete {_some(others)} in {path}, which are no files of a run: "
                "move them elsewhere first, or choose another folder"
            ]
        )


def delete_run(path: Path) -> None:
    """Deletes a run's files, those that make it one last; see `refuse_to_delete`."""
    names = [name for name in _all(path) if name not in (LOCK, PROVENANCE)]
    for name in names:
        if _is_of_a_run(path, name):
            remove(path / name)
    for name in _INSIDE:
        _remove_empty(path / name)
    (path / PROVENANCE).unlink(missing_ok=True)


def begin(path: Path, contents: Mapping[str, bytes]) -> None:
    """Clears what an earlier start left, and names the files that this one is about to make."""
    made = _marked(path)
    for name in _all(path):
        if name != LOCK and name != MARKER and _is_left(path, name, made):
            remove(path / name)
    _remove_empty(path / MESHES)
    with files.atomically(path / MARKER) as part:
        part.write_text(json.dumps({"files": digests(contents)}, indent=2) + "\n", encoding="utf-8")


def tidy(path: Path) -> None:
    """Deletes the marker and the temporaries that killed processes left; of a run."""
    (path / MARKER).unlink(missing_ok=True)
    for name in _all(path):
        if _named(name) != name and _is_of_a_run(path, name):
            (path / name).unlink()


def remove(path: Path) -> None:
    """Deletes a file or a folder; of a link the link alone."""
    if path.is_dir() and not path.is_symlink():
        shutil.rmtree(path)
    else:
        path.unlink(missing_ok=True)


def _top(path: Path) -> list[str]:
    return sorted(os.listdir(path)) if path.is_dir() else []


def _all(path: Path) -> list[str]:
    """Names of the files in a folder, and in the folders that a run has there."""
    return [*_listed(path)]


def _listed(path: Path) -> Iterator[str]:
    for name in _top(path):
        inside = path / name
        if name in _INSIDE and inside.is_dir() and not inside.is_symlink():
            yield from (f"{name}/{other}" for other in _top(inside))
        else:
            yield name


def _named(name: str) -> str:
    """The file that a temporary was to replace, as `files.atomically` names it; others as they are.

    A killed process leaves its temporaries.
    """
    found = re.fullmatch(r"(.*?\.(?:toml|json|csv|log|npz|html|sha256|png))\.[^/]*tmp", name)
    return found[1] if found else name


def _is_lock(path: Path) -> bool:
    """Whether a file is the lock of a run, which holds a process's number."""
    try:
        with path.open("rb") as file:
            return not path.is_symlink() and re.fullmatch(rb"[0-9]*\s*", file.read(64)) is not None
    except OSError:
        return False


def _is_of_a_run(path: Path, name: str) -> bool:
    """Whether a run makes files of this name."""
    folder, _, inside = name.rpartition("/")
    if folder:
        return _INSIDE[folder].fullmatch(_named(inside)) is not None
    return _named(name) in _OURS - {*_INSIDE} and not (path / name).is_dir()


def _is_left(path: Path, name: str, made: dict[str, str]) -> bool:
    """Whether a file is what a start that was cut short left."""
    file = path / name
    if name in (LOCK, MARKER):
        return True
    if file.is_symlink() or not file.is_file():
        return False
    if _named(name) != name:
        return _named(name) in {*made, MARKER, PROVENANCE}
    return name in made and sha256(file.read_bytes()).hexdigest() == made[name]


def _marked(path: Path) -> dict[str, str]:
    """Files that a start was about to make, with their digests; none without a marker."""
    try:
        stored = json.loads((path / MARKER).read_bytes())["files"]
        named = {name: digest for name, digest in stored.items() if isinstance(digest, str)}
    except (OSError, ValueError, KeyError, TypeError, AttributeError, RecursionError):
        return {}
    return {
        n: d
        for n, d in named.items()
        if n in NAMES or _MESH.fullmatch(n.removeprefix(f"{MESHES}/"))
    }


def _remove_empty(path: Path) -> None:
    if path.is_dir() and not path.is_symlink() and not any(path.iterdir()):
        path.rmdir()


def _some(names: list[str]) -> str:
    """The first of some names, and how many more there are."""
    return ", ".join(names[:3]) + (f" and {len(names) - 3} more" if len(names) > 3 else "")
