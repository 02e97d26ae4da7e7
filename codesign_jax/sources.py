"""The package's code as this process runs it: a digest for what is kept on disk.

What a file on disk says is not what a process runs: an editor, `git checkout` or rsync may change
it after the import.  So the state of all files is noted when the package is imported, before the
first of its modules, and what the modules define when the engine is imported.  Where either differs
later (an edit, `importlib.reload`, IPython's autoreload, a name that was replaced), nobody knows
any more which code runs: there is no digest then, and nothing is kept or found under one.
"""

import functools
import hashlib
import os
import sys
import types
from pathlib import Path

ROOT = Path(__file__).parent
UNRELATED = ("commands", "export", "optimize", "report", "runs")
"""Folders that no simulation depends on: they import engines, never the other way."""
_UNTRACED = ("archives", "caches", "compiler", "files", "kept_programs", "memory_maps", "sources")
"""What is not traced: to replace a name there is to change the machinery and no physics."""

_State = dict[str, tuple[int, ...]]


def _state() -> _State:
    """What the file system says of each file of code that a simulation depends on.

    The time of an inode's last change is among it, which no program can set back.
    """
    found, folders = {}, [""]
    while folders:
        folder = folders.pop()
        for entry in os.scandir(os.path.join(ROOT, folder)):
            name = f"{folder}{entry.name}"
            if entry.name.endswith(".py"):
                s = entry.stat()
                found[name] = (s.st_dev, s.st_ino, s.st_size, s.st_mtime_ns, s.st_ctime_ns)
            elif entry.is_dir() and name not in UNRELATED and entry.name != "__pycache__":
                folders.append(f"{name}/")
    return found


at_import = _state()
_defined: dict[str, dict[str, object]] = {}


def digest() -> str | None:
    """Digest of the code that this process runs, or None if that is not known.

    It is the same in every process that imported the same code, and costs three milliseconds.
    """
    return None if replaced() else of_files()


def of_files() -> str | None:
    """As `digest`, for what is not traced: names that were replaced do not matter."""
    if not at_import or _now() != at_import:
        return None
    found = _read()
    return found if _now() == at_import else None  # edited while it was read


def note() -> None:
    """Notes what the modules that have been imported so far define, see `replaced`."""
    for name, module in list(sys.modules.items()):
        parts = name.split(".")
        if parts[0] == __package__ and parts[1:2] and name not in _defined:
            if parts[1] not in (*UNRELATED, *_UNTRACED):
                _defined[name] = _names(module)


def replaced() -> list[str]:
    """Names of modules and classes that are not what they were when their module was noted.

    A module is noted when `programs` or the structured engine is imported, else when it is first
    seen here.
    The contents of containers are not looked at.
    """
    note()
    return [
        f"{module}.{name}"
        for module, names in _defined.items()
        for now in [_names(sys.modules.get(module))]
        for name, value in names.items()
        if now.get(name) is not value
    ]


def _names(module: object) -> dict[str, object]:
    """What a module and its own classes define, and the code of its own functions."""
    found = {}
    own = getattr(module, "__name__", None)
    for name, value in getattr(module, "__dict__", {}).items():
        if name.startswith("__"):
            continue
        found[name] = value
        if getattr(value, "__module__", None) != own:
            continue
        if isinstance(value, types.FunctionType):
            found[f"{name}()"] = value.__code__
        elif isinstance(value, type):
            found |= {f"{name}.{key}": v for key, v in vars(value).items() if key[:2] != "__"}
    return found


def _now() -> _State:
    try:
        return _state()
    except OSError:  # a file goes away while its state is read
        return {}


@functools.cache
def _read() -> str:
    found = hashlib.sha256()
    for name in sorted(at_import):
        code = (ROOT / name).read_bytes()
        found.update(f"{name} {len(code)}\n".encode() + code)
    return found.hexdigest()
