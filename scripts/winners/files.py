"""The winners' results and, as JSON beside them, the runs that made each call; joining both."""

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from codesign_jax import archives
from codesign_jax.scene import InputError
from scripts.shared import output

Arrays = dict[str, Any]
"""NumPy arrays by name."""

Run = dict[str, Any]
"""Provenance of a process, with the keys of the `calls` it made."""

UNKNOWN = "not recorded"
"""Command of calls that an early file's only command did not make."""


def calls(results: Arrays) -> list[str]:
    """Keys of the calls in results, EXPERIMENT|VARIANT|BLOCK."""
    return [name.removesuffix("|cost") for name in results if name.endswith("|cost")]


def read(path: Path) -> tuple[Arrays, dict[str, Any], list[Run]]:
    """Reads results with their settings and runs.

    Args:
      path: The .npz file; its .json lies beside it.

    Raises:
      InputError: If what made them cannot be read.
      ArchiveError: If the results are damaged.
    """
    try:
        notes = json.loads(path.with_suffix(".json").read_text())
        settings = notes.pop("settings")
    except (OSError, ValueError, KeyError) as error:
        problem = f"what made {path} cannot be read from its .json: {error}"
        raise InputError([problem]) from error
    results = archives.load(path)
    runs = notes["runs"] if "runs" in notes else _early(notes, calls(results))
    return results, settings, runs


def refuse_others(path: Path, found: dict[str, Any], settings: dict[str, Any]) -> None:
    """Refuses results of other settings.

    Raises:
      InputError: With what differs.
    """
    wanted = json.loads(json.dumps(settings))
    different = [k for k in {*found, *wanted} if found.get(k) != wanted.get(k)]
    if different:
        text = "; ".join(f"{k}: {found.get(k)} there, {wanted.get(k)} wanted" for k in different)
        raise InputError([f"{path} belongs to something else ({text}); delete it to start anew"])


def _early(notes: dict[str, Any], keys: list[str]) -> list[Run]:
    """Runs of a file that kept its last command alone, which may not have made every call."""
    command = str(notes.get("command"))
    named = "--variants" in command
    made = [k for k in keys if not named or k.split("|")[1] in command]
    runs = [{**notes, "calls": made}]
    rest = [k for k in keys if k not in made]
    return runs + ([{"command": UNKNOWN, "calls": rest}] if rest else [])


def note(runs: list[Run], key: str) -> None:
    """Notes that the last run makes a call.

    A run that was killed between its note and the results made nothing: the last note counts.
    """
    for run in runs:
        run["calls"] = [k for k in run["calls"] if k != key]
    runs[-1]["calls"].append(key)


def write_runs(path: Path, settings: dict[str, Any], runs: Sequence[Run]) -> None:
    """Writes the .json of a results file; as a whole or not at all."""
    kept = [run for run in runs if run["calls"]]
    output.write_json(path.with_suffix(".json"), {"settings": settings, "runs": kept}, indent=2)


def merge(paths: Sequence[Path], out: Path) -> list[str]:
    """Joins results of the same settings.

    Args:
      paths: Files to join; `out` may be one of them.
      out: File to write.

    Returns:
      The calls of the new file.

    Raises:
      InputError: If a file cannot be read, if settings or the numbers of a call differ, or if
        `out` exists and is not joined.
    """
    if out.exists() and out.resolve() not in [p.resolve() for p in paths]:
        raise InputError([f"{out} exists and is not among the files to join"])
    joined, settings, runs = read(paths[0])
    for path in paths[1:]:
        results, other, more = read(path)
        refuse_others(path, other, settings)
        _same_numbers(joined, results, path)
        known = set(calls(joined))
        runs += [{**run, "calls": [k for k in run["calls"] if k not in known]} for run in more]
        joined = results | joined
    archives.save(out, joined, compressed=True)
    write_runs(out, settings, runs)
    return calls(joined)


def _same_numbers(a: Arrays, b: Arrays, path: Path) -> None:
    for key in sorted(set(calls(a)) & set(calls(b))):
        for part in (f"{key}|cost", f"{key}|status"):
            if not np.array_equal(a[part], b[part], equal_nan=True):
                raise InputError([f"{path}: its {part} differs from that of the files before it"])
