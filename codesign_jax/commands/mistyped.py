"""Command lines that the parser would refuse with a screen of text: what is wrong, in a line.

Only what is certain is refused here; everything else is the parser's.  Nothing heavy is imported:
`--help` is to be quick.
"""

import dataclasses
import difflib
import types
from collections.abc import Iterator, Sequence
from typing import Annotated, Any, Literal, NamedTuple, Union, get_args, get_origin, get_type_hints

import tyro


class Taken(NamedTuple):
    """A flag of a command.

    Attributes:
      kind: Type of its value: int, float, str, ...; bool for a flag without one.
      choices: Values that it takes; empty for any.
      many: Whether it takes several values.
    """

    kind: Any
    choices: tuple[str, ...]
    many: bool


def problems(arguments: Sequence[str], commands: Any) -> list[str]:
    """What is wrong with a command line, at most one line.

    Args:
      arguments: The arguments.
      commands: Union of the commands' dataclasses.
    """
    known = {command.__name__.lower(): command for command in get_args(commands)}
    if not arguments or arguments[0].startswith("-"):
        return []
    name = arguments[0]
    if name not in known:
        return [f"{name!r} is not a command; {_near(name, known)}"]
    if {"-h", "--help"} & {*arguments}:
        return []
    found = next(_wrong(name, arguments[1:], known_flags(known[name])), None)
    return [] if found is None else [f"{found} (codesign {name} --help has all flags)"]


def known_flags(command: Any) -> dict[str, Taken]:
    """The flags of a command by name, such as "--trials"."""
    found = {}
    hints = get_type_hints(command, include_extras=True)
    for field in dataclasses.fields(command):
        kind, marks = hints[field.name], ()
        while get_origin(kind) is Annotated:
            kind, *more = get_args(kind)
            marks = (*marks, *more)
        if tyro.conf.Positional in marks:
            continue
        names = [mark.name for mark in marks if getattr(mark, "name", None)]
        name = names[0] if names else field.name.replace("_", "-")
        found[f"--{name}"] = _taken(kind)
    return found


def _taken(kind: Any) -> Taken:
    """What values of a type a flag takes."""
    if get_origin(kind) in (Union, types.UnionType):
        kind = next(k for k in get_args(kind) if k is not type(None))
    if get_origin(kind) is Literal:
        return Taken(str, get_args(kind), False)
    if get_origin(kind) is tuple:
        return Taken(str, (), True)
    return Taken(kind, (), False)


def _wrong(command: str, arguments: Sequence[str], known: dict[str, Taken]) -> Iterator[str]:
    """What is wrong with the flags of a command and their values."""
    for place, argument in enumerate(arguments):
        if not argument.startswith("--") or argument == "--":
            continue
        given, equals, value = argument.partition("=")
        name = given.replace("_", "-")
        if name not in known:
            yield f"{command} has no {given}; {_near(name, known)}"
            continue
        taken = known[name]
        if taken.kind is bool:
            continue
        if not equals:
            value = arguments[place + 1] if place + 1 < len(arguments) else "--"
            if value.startswith("--"):
                yield f"{given} needs a value"
                continue
        if problem := None if taken.many else _value_problem(taken, value):
            yield f"{given} {value!r} {problem}"


def _value_problem(taken: Taken, value: str) -> str | None:
    """Why a flag does not take a value; None if it may."""
    if taken.choices:
        return None if value in taken.choices else f"must be one of {', '.join(taken.choices)}"
    if taken.kind not in (int, float):
        return None
    try:
        taken.kind(value)
    except ValueError:
        return f"must be a {'whole ' if taken.kind is int else ''}number"
    return None


def _near(name: str, names: Any) -> str:
    """The names that one may have meant, or all."""
    longer = [n for n in names if n.startswith(name) or name.startswith(n)]
    close = longer or difflib.get_close_matches(name, [*names], n=1, cutoff=0.5)
    return f"did you mean {' or '.join(close)}?" if close else f"valid: {', '.join(names)}"
