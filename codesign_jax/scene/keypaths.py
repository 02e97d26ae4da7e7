"""Single values of scene, hand and object files by their key path: `objects.noise.position=0.01`.

A path starts at the scene's root; `hand` and `objects` lead into the files that the scene names. An
entry of a list is named by its `name` or by its index: `objects.object.sphere.mass`,
`hand.finger.0.tilt` or `hand.finger[0].tilt`.
"""

import re
import tomllib
from collections.abc import Iterable, Mapping
from typing import Any

from codesign_jax.scene import schema

Path = tuple[str, ...]

_INDEX = re.compile(r"\[(\d+)\]")


def parse(pairs: Iterable[str]) -> dict[Path, Any]:
    """Reads KEY=VALUE; the later of two values of one key holds.

    Args:
      pairs: The pairs; a value is TOML, and what is none, such as a bare word, is a string.

    Raises:
      SceneError: With every pair that is not KEY=VALUE.
    """
    found: dict[Path, Any] = {}
    problems = []
    for pair in pairs:
        key, equals, text = pair.partition("=")
        path = _path(key.strip())
        if not equals or not all(path):
            problems.append(f"--set {pair!r} must be KEY=VALUE, such as discretization.links=5")
        else:
            found.pop(path, None)  # values are applied in the order in which they were given
            found[path] = _toml_value(text)
    if problems:
        raise schema.SceneError(problems)
    return found


def flatten(values: Mapping[Any, Any]) -> dict[Path, Any]:
    """Key paths of nested tables: {"solver": {"iterations": 5}} has ("solver", "iterations").

    Args:
      values: Values by key, dotted key path or tuple of keys; a value that is a mapping holds
        further keys.
    """
    found: dict[Path, Any] = {}
    for key, value in values.items():
        path = _path(key) if isinstance(key, str) else tuple(key)
        if isinstance(value, Mapping):
            found |= {path + rest: v for rest, v in flatten(value).items()}
        else:
            found[path] = value
    return found


def below(changes: Mapping[Path, Any], key: str) -> dict[Path, Any]:
    """The changes inside of a top-level key, with their paths from there."""
    return {path[1:]: v for path, v in changes.items() if path[0] == key and len(path) > 1}


def apply(table: dict, changes: Mapping[Path, Any], where: str, problems: list[str]) -> None:
    """Changes values of a file that was read; the file's schema checks keys and values afterwards.

    Args:
      table: The file's content, which is changed.
      changes: Values by path.
      where: The file's name, for messages.
      problems: List that collects the messages.
    """
    for path, value in changes.items():
        _apply(table, path, value, where, problems)


def _apply(place: Any, path: Path, value: Any, where: str, problems: list[str]) -> None:
    rest = path[1:]
    key: Any = path[0]
    if isinstance(place, list):
        index = _index(place, key)
        if index is None:
            problems.append(f"{where} has no entry {key!r}; {schema.nearest(key, _names(place))}")
            return
        where, key = f"{where}[{key}]", index
    elif isinstance(place, dict):
        where = f"{where}.{key}"
    else:
        problems.append(f"{where} = {place!r} is no table: it has no key {key!r}")
        return
    if not rest:
        place[key] = value
        return
    if isinstance(place, dict):
        # A table that the file leaves out; if there is no such table, the schema says so.
        place.setdefault(key, {})
    _apply(place[key], rest, value, where, problems)


def _names(entries: list) -> list[str]:
    """What the entries of a list may be called: their names, and their indices."""
    names = [str(e["name"]) for e in entries if isinstance(e, dict) and "name" in e]
    return names + [str(i) for i in range(len(entries))]


def _index(entries: list, key: str) -> int | None:
    for i, entry in enumerate(entries):
        if isinstance(entry, dict) and entry.get("name") == key:
            return i
    return int(key) if key.isdecimal() and int(key) < len(entries) else None


def _path(key: str) -> Path:
    """Splits "hand.finger[0].tilt" at its dots, indices in brackets as keys of their own."""
    return tuple(part.strip() for part in _INDEX.sub(r".\1", key).split("."))


def _toml_value(text: str) -> Any:
    try:
        return tomllib.loads(f"value = {text}")["value"]
    except tomllib.TOMLDecodeError:
        return text
