"""Finds and reads the TOML files of hands, objects, scenes and accuracies."""

import os
import re
import tomllib
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from codesign_jax import files
from codesign_jax.scene import schema, texts

_PACKAGE = Path(__file__).parents[1]
# In a checkout the folders lie beside the package; a wheel carries them inside it.
_FOLDERS = {
    "hands": (_PACKAGE / "hands", _PACKAGE.parent / "hands"),
    "objects": (_PACKAGE / "objects", _PACKAGE.parent / "objects"),
    "scenes": (_PACKAGE / "scenes",),
    "controls": (_PACKAGE / "controls",),
    "accuracy": (_PACKAGE / "scenes" / "accuracy",),
    "constants": (_PACKAGE / "constants",),
}
MOST_BYTES = 1 << 18
"""Largest file that is read; those that come with the package have 4 kB."""
_LONG_KEY = re.compile(r"""(?<![\w-])[\w-]++(?:\s*+\.\s*+(?:[\w-]++|"[^"\n]*+"|'[^'\n]*+')){100}""")
"""A dotted key for whose parts the parser needs time that grows with the square of their number."""
_OF_INLINE_TABLES = ("Invalid initial character for a key part", "Unclosed inline table")
"""What tomllib says of a table in braces over several lines, or with a comma at its end."""
DEEPEST = 12
"""Most tables and arrays inside of one another; a preset's fixed value has three."""


def available(kind: str) -> dict[str, Path]:
    """Returns the built-in files of a kind of `_FOLDERS` by name."""
    paths: dict[str, Path] = {}
    for folder in _FOLDERS[kind]:
        if folder.is_dir():
            paths |= {p.stem: p for p in sorted(folder.glob("*.toml"))}
    return paths


def find(kind: str, name: str | Path) -> Path:
    """Resolves a built-in name or a path ending in .toml to a file."""
    path = Path(name)
    if path.suffix == ".toml":
        if is_file(path):
            return path
        raise schema.InputError.of("missing", f"{kind}: no file {schema.shown(str(path))}")
    built_in = available(kind)
    if str(name) in built_in:
        return built_in[str(name)]
    if os.path.isdir(path) or path.suffix:  # never raises, as of a name that is too long
        raise schema.InputError.of(
            "file", f"{kind}: {schema.shown(str(path))} {_no_file(kind, path)}"
        )
    beside = path.with_name(path.name + ".toml") if path.name else path
    if is_file(beside):
        hint = f"did you mean the file {schema.shown(str(beside))}?"
    else:
        hint = schema.nearest(str(name), built_in)
    raise schema.InputError.of("unknown", f"{kind}: {schema.shown(str(name))} unknown; {hint}")


def _no_file(kind: str, path: Path) -> str:
    if os.path.isdir(path):
        inside = sorted(path.glob("*.toml"))[:1]
        return "is a folder" + (f"; did you mean {str(inside[0])!r}?" if inside else "")
    if kind == "objects":
        return (
            "is no object file: a mesh is named in one, which ends in .toml and has its mass and "
            "friction too (docs/meshes.md)"
        )
    return "must end in .toml"


def is_file(path: Path) -> bool:
    """Whether a path is a file; an InputError if the system does not say."""
    try:
        return path.is_file()
    except (OSError, ValueError) as error:  # ValueError: a NUL in the name, of some versions
        why = error.strerror if isinstance(error, OSError) else error
        raise schema.InputError.of("file", f"{schema.shown(str(path))}: {why}") from error


def read(path: Path) -> dict[str, Any]:
    """Reads a TOML file."""
    try:
        with files.opened(path) as file:
            data = file.read(MOST_BYTES + 1)
    except OSError as error:
        raise schema.InputError.of("file", f"{path.name}: {error.strerror}") from error
    if len(data) > MOST_BYTES:
        raise schema.InputError.of("range", f"{path.name}: has more than {MOST_BYTES:,} bytes")
    if foreign := texts.foreign(data):
        raise schema.InputError.of("file", f"{path.name}: {foreign}")
    try:
        table = parse(data.decode("utf-8-sig"))
    except (ValueError, OverflowError, RecursionError) as error:
        raise schema.InputError.of(
            "syntax", f"{path.name}: not valid TOML: {why_not(error)}"
        ) from error
    return table


def parse(text: str) -> dict[str, Any]:
    """TOML text as a table."""
    if _LONG_KEY.search(text):
        raise RecursionError
    # Line ends as a text file's: tomllib refuses a lone carriage return.
    table = tomllib.loads(text.replace("\r\n", "\n").replace("\r", "\n"))
    if too_deep(table):
        raise RecursionError
    return table


def why_not(error: Exception) -> str:
    """Why `parse` did not read a text, in words."""
    if isinstance(error, RecursionError):
        return f"tables and arrays are nested more than {DEEPEST} deep"
    if "integer string conversion" in str(error):
        return "a whole number has thousands of digits"
    text = schema.shown(str(error))[1:-1]
    if any(words in text for words in _OF_INLINE_TABLES):
        text += "; a table in braces stands in one line and has no comma at its end"
    return text


def too_deep(value: Any) -> bool:
    """Whether tables and arrays are nested more than `DEEPEST` deep; needs no stack."""
    level = [value]
    for _ in range(DEEPEST + 1):
        inside = [
            list(v.values()) if isinstance(v, Mapping) else v
            for v in level
            if isinstance(v, Mapping | list | tuple)
        ]
        level = [entry for entries in inside for entry in entries]
        if not level:
            return False
    return True
