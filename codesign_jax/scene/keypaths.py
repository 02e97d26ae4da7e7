"""Single values of scene, hand and object files by their key path: `objects.noise.position=0.01`.

A path starts at the scene's root; `hand` and `objects` lead into the files that the scene names. An
entry of a list is named by its `name` or by its index: `objects.object.sphere.mass`,
`hand.finger.0.tilt` or `hand.finger[0].tilt`.
"""

import pathlib
import re
from collections.abc import Callable, Iterable, Mapping
from typing import Any

import jax
import jax.core

from codesign_jax.scene import library, schema, texts

Path = tuple[str, ...]

_INDEX = re.compile(r"\[(\d+)\]")


def read(
    kind: str,
    name: str | pathlib.Path,
    overrides: Mapping[Any, Any] | None,
    problems: list[str],
    prepare: Callable[[dict[str, Any], dict[Path, Any]], None] = lambda table, changes: None,
) -> tuple[dict[str, Any], pathlib.Path, Any]:
    """Reads a file of hands, objects or controls, with other values in it.

    Args:
      prepare: Is told the file's table and the values by key path, both of which it may change.
    """
    path = library.find(kind, name)
    table = library.read(path)
    changes = flatten(overrides or {})
    prepare(table, changes)
    root = kind.removesuffix("s") if kind != "objects" else kind
    return table, path, apply(table, changes, path.name, problems, root=root)


def parse(pairs: Iterable[str]) -> dict[Path, Any]:
    """Reads KEY=VALUE; the later of two values of one key holds."""
    values: dict[Path, Any] = {}
    problems = []
    for pair in joined(pairs):
        key, equals, text = pair.partition("=")
        path = _path(key.strip())
        if not equals or not all(path):
            shown = schema.shown(pair)
            problems.append(
                schema.Problem(
                    "syntax", f"--set {shown} must be KEY=VALUE, such as discretization.links=5"
                )
            )
        else:
            values.pop(path, None)  # values are applied in the order in which they were given
            values[path] = _toml_value(text)
    if problems:
        raise schema.InputError(problems)
    return values


def joined(words: Iterable[str]) -> list[str]:
    """Words of a command line, of which those that a blank beside a = parted are one again.

    >>> joined(["gravity", "=", "3.7", "arm_z=", "10", "length", "=95"])
    ['gravity=3.7', 'arm_z=10', 'length=95']
    """
    joined_words: list[str] = []
    for word in words:
        before = joined_words[-1] if joined_words else ""
        open_end = before.endswith("=") and "=" not in word
        if open_end or (word.startswith("=") and before and "=" not in before):
            joined_words[-1] = before + word
        else:
            joined_words.append(word)
    return joined_words


def flatten(values: Mapping[Any, Any]) -> dict[Path, Any]:
    """Key paths of nested tables: {"solver": {"iterations": 5}} has ("solver", "iterations")."""
    if library.too_deep(values):
        deepest = library.DEEPEST
        raise schema.InputError.of("range", f"values are nested more than {deepest} tables deep")
    leaves: dict[Path, Any] = {}
    for key, value in values.items():
        path = _path(key) if isinstance(key, str) else key
        if not (isinstance(path, tuple) and path and all(isinstance(part, str) for part in path)):
            raise schema.InputError.of(
                "syntax", f"{schema.shown(key)} is no key path such as 'solver.iterations'"
            )
        if isinstance(value, Mapping):
            leaves |= {path + rest: v for rest, v in flatten(value).items()}
        else:
            leaves[path] = plain(value, ".".join(path))
    return leaves


def plain(value: Any, key: str) -> Any:
    """A value as a file would have it: of arrays and numbers of any library those of Python.

    Raises:
      InputError: If it is being traced: a file's values are known when it is read.
    """
    if isinstance(value, jax.core.Tracer):
        words = "is traced; dataclasses.replace puts traced numbers into a scene that was read"
        raise schema.InputError.of("type", f"{key} {words}")
    if isinstance(value, pathlib.PurePath):
        return str(value)
    if isinstance(value, Mapping):
        return {k: plain(v, f"{key}.{k}") for k, v in value.items()}
    if isinstance(value, list | tuple | range):
        return [plain(v, f"{key}[{i}]") for i, v in enumerate(value)]
    listed = getattr(value, "tolist", None)  # of NumPy, JAX and whatever has their interface
    return listed() if callable(listed) else value


def below(changes: Mapping[Path, Any], key: str) -> dict[Path, Any]:
    """The changes inside of a top-level key, with their paths from there."""
    return {path[1:]: v for path, v in changes.items() if path[0] == key and len(path) > 1}


def apply(
    table: dict[str, Any],
    changes: Mapping[Path, Any],
    where: str,
    problems: list[str],
    *,
    root: str = "",
) -> dict[str, str]:
    """Changes values of a file that was read, before its schema checks keys and values.

    Returns places of the changes as the schema names them, such as "paper.toml.noise", with what
    was given, such as "objects.noise"; for `as_given`. `root` is the scene's key of the file.
    """
    key_paths: dict[str, str] = {}
    for path, value in changes.items():
        _apply(table, path, value, ((where,), root), problems, key_paths)
    return key_paths


def as_given(problems: list[str], key_paths: Mapping[str, str]) -> list[str]:
    """Messages about changed values, with the keys as they were given instead of the file's."""
    longest = sorted(key_paths, key=len, reverse=True)
    return [_as_given(problem, longest, key_paths) for problem in problems]


def _as_given(problem: str, longest: list[str], key_paths: Mapping[str, str]) -> str:
    for key_path in longest:
        rest = problem.removeprefix(key_path)
        if rest != problem and not re.match(r"\w", rest):
            key, unknown, hint = f"{key_paths[key_path]}{rest}".partition(" is not a known key; ")
            parent = key.rpartition(".")[0]
            if parent:
                hint = hint.replace("did you mean '", f"did you mean '{parent}.")
            return schema.Problem.of(problem).told(key + unknown + hint)
    return problem


def _apply(
    node: Any,
    path: Path,
    value: Any,
    where: tuple[tuple[str, ...], str],
    problems: list[str],
    key_paths: dict[str, str],
) -> None:
    """Changes one value; `where` has the names of the place in messages, and as it is given."""
    names, place_name = where
    rest = path[1:]
    key: Any = path[0]
    if len(rest) >= library.DEEPEST:
        problems.append(
            schema.Problem(
                "type", f"{schema.shown('.'.join(path))} is no key: it has {len(path):,} parts"
            )
        )
        return
    if isinstance(node, list):
        index = _index(node, key)
        if index is None and any(isinstance(entry, dict) and key in entry for entry in node):
            for k in range(len(node)):  # a key without the name of an entry is that of all
                _apply(node, (str(k), *path), value, where, problems, key_paths)
            return
        if index is None:
            hint = schema.nearest(key, _names(node))
            problems.append(
                schema.Problem("unknown", f"{place_name} has no entry {schema.shown(key)}; {hint}")
            )
            return
        # The schema names an entry by its index, other checks by its name.
        names = tuple(n + form for n in names for form in (f"[{index}]", f" {key}"))
        key = index
    elif isinstance(node, dict):
        names = tuple(f"{name}.{key}" for name in names)
    else:
        value = schema.shown(node)
        problems.append(
            schema.Problem(
                "type", f"{place_name} = {value} is no table: it has no key {schema.shown(key)}"
            )
        )
        return
    place_name += f"[{path[0]}]" if path[0].isdecimal() else "." * bool(place_name) + path[0]
    if not rest or (isinstance(node, dict) and key not in node):
        key_paths |= dict.fromkeys(names, place_name)
    if not rest:
        node[key] = value
        return
    if isinstance(node, dict):
        # A table that the file leaves out; if there is no such table, the schema says so.
        node.setdefault(key, {})
    _apply(node[key], rest, value, (names, place_name), problems, key_paths)


def _names(entries: list[Any]) -> list[str]:
    names = [str(e["name"]) for e in entries if isinstance(e, dict) and "name" in e]
    return names or [str(i) for i in range(len(entries))]


def _index(entries: list[Any], key: str) -> int | None:
    for i, entry in enumerate(entries):
        if isinstance(entry, dict) and entry.get("name") == key:
            return i
    short = key.isdecimal() and len(key) < 10  # Python reads no number of thousands of digits
    return int(key) if short and int(key) < len(entries) else None


def _path(key: str) -> Path:
    return tuple(part.strip() for part in _INDEX.sub(r".\1", key).split("."))


def _toml_value(text: str) -> Any:
    plain_signs = texts.typed(text)
    try:
        table = library.parse(f"value = {plain_signs}")
    except (ValueError, RecursionError):
        return text
    if isinstance(table["value"], str):  # signs of a name stay what they are
        table = library.parse(f"value = {text}")
    return table["value"] if len(table) == 1 else text  # more keys on further lines
