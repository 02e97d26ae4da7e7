"""Finds and reads hands, objects and scenes; writes files as a whole or not at all."""

import contextlib
import os
import tomllib
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from codesign_jax import schema

_PACKAGE = Path(__file__).parent
# In a checkout the folders lie beside the package; a wheel carries them inside it.
_FOLDERS = {
    "hands": (_PACKAGE / "hands", _PACKAGE.parent / "hands"),
    "objects": (_PACKAGE / "objects", _PACKAGE.parent / "objects"),
    "scenes": (_PACKAGE / "scenes",),
    "accuracy": (_PACKAGE / "scenes" / "accuracy",),
}


def available(kind: str) -> dict[str, Path]:
    """Returns the built-in files of a kind ("hands", "objects", "scenes", "accuracy") by name."""
    found: dict[str, Path] = {}
    for folder in _FOLDERS[kind]:
        if folder.is_dir():
            found |= {p.stem: p for p in sorted(folder.glob("*.toml"))}
    return found


def find(kind: str, name: str | Path) -> Path:
    """Resolves a built-in name or a path ending in .toml to a file.

    Raises:
      SceneError: if neither a file nor a built-in of that name exists.
    """
    path = Path(name)
    if path.suffix == ".toml":
        if path.is_file():
            return path
        raise schema.SceneError([f"{kind}: no file {str(path)!r}"])
    built_in = available(kind)
    if str(name) in built_in:
        return built_in[str(name)]
    beside = path.with_name(path.name + ".toml") if path.name else path
    if beside.is_file():
        hint = f"did you mean the file {str(beside)!r}?"
    else:
        hint = schema.nearest(str(name), built_in)
    raise schema.SceneError([f"{kind}: {str(name)!r} unknown; {hint}"])


def read(path: Path) -> dict[str, Any]:
    """Reads a TOML file.

    Raises:
      SceneError: if the file is not UTF-8 text or not valid TOML, with the parser's position.
    """
    try:
        return tomllib.loads(path.read_text(encoding="utf-8"))
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        raise schema.SceneError([f"{path.name}: not valid TOML: {error}"]) from error


@contextlib.contextmanager
def atomically(path: Path) -> Iterator[Path]:
    """Replaces a file as a whole: whoever reads it, and whenever, finds the old one or the new one.

    Args:
      path: The file; its folder is made if it is missing.

    Yields:
      The path to write to, beside the file. It takes the file's place, on disk, when the block ends
      and is removed if the block raises; a killed process leaves it behind, with a name in .tmp.

    Raises:
      OSError: If the file cannot be written; the old one stays.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    temporary = path.with_name(f"{path.name}.{os.getpid()}.tmp")
    try:
        yield temporary
        with temporary.open("rb") as file:
            os.fsync(file.fileno())
        os.replace(temporary, path)
    finally:
        temporary.unlink(missing_ok=True)


def cache_folder() -> Path:
    """Folder for what can be computed again, such as compiled programs; it may not exist yet."""
    return Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "codesign-jax"
