"""Finds and reads the TOML files of hands, objects, scenes and presets of accuracy."""

import tomllib
from pathlib import Path
from typing import Any

from codesign_jax.scene import schema

_PACKAGE = Path(__file__).parents[1]
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
