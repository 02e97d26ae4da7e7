"""provenance.json of a run folder: whose folder it is, how it was made, and whether it is intact.

It may be a stranger's, or damaged: all that others read from it is checked here.
"""

import dataclasses
import datetime
import json
import uuid
from collections.abc import Mapping
from hashlib import sha256
from pathlib import Path
from typing import Any

from codesign_jax import files, own
from codesign_jax import scene as scenes
from codesign_jax.provenance import environment, git_state
from codesign_jax.runs import scene_files
from codesign_jax.runs.settings import Settings, check
from codesign_jax.scene.schema import InputError

PROVENANCE = "provenance.json"
"""File that makes a folder a run."""
SCHEMA = 1
"""Version of what a run folder holds; runs from before there were versions have none and are read.

It grows when a folder can no longer be read by the code before.
"""
_MOST_BYTES = 20_000_000
_OF_ENVIRONMENT = ("python", "platform", "machine", "device")


def new(settings: Settings, contents: Mapping[str, bytes], command: list[str]) -> dict[str, Any]:
    """What is noted of a run that begins now."""
    return {
        "schema": SCHEMA,
        "id": uuid.uuid4().hex,
        "settings": dataclasses.asdict(settings),
        "started": start_note(command),
        "environment": environment(),
        "git": git_state(),
        "files": digests(contents),
    }


def start_note(command: list[str]) -> dict[str, Any]:
    """Time and command line of a start."""
    now = datetime.datetime.now(datetime.UTC).isoformat(timespec="seconds")
    return {"time": now, "command": command}


def digests(contents: Mapping[str, bytes]) -> dict[str, str]:
    """SHA-256 digests of files' contents by name."""
    return {name: sha256(content).hexdigest() for name, content in contents.items()}


def write(path: Path, content: dict[str, Any]) -> None:
    """Writes provenance.json of a run folder."""
    with files.atomically(path / PROVENANCE) as part:
        part.write_text(json.dumps(content, indent=2) + "\n", encoding="utf-8")


def read_provenance(path: Path) -> dict[str, Any]:
    """Reads provenance.json of a run folder; settings that it lacks have their defaults."""
    file = path / PROVENANCE
    try:
        size = file.stat().st_size
        if not file.is_file() or size > _MOST_BYTES:
            raise _damaged(file, "it is no file" if size <= _MOST_BYTES else f"it has {size} bytes")
        text = file.read_text(encoding="utf-8")
    except OSError as error:
        if isinstance(error, FileNotFoundError | NotADirectoryError):
            why = f"it has no {PROVENANCE}" if _exists(path) else "there is no such folder"
        else:
            why = f"{PROVENANCE} cannot be read: {error.strerror}"
        raise InputError([f"{path} is not a run folder: {why}{_runs_inside(path)}"]) from error
    except UnicodeDecodeError as error:
        raise _damaged(file, "it is no text in UTF-8") from error
    try:
        stored = json.loads(text)
    except (ValueError, RecursionError) as error:
        raise _damaged(file, "it is no valid JSON") from error
    if problem := _problem(stored):
        raise _damaged(file, problem)
    if stored.get("schema", 0) > SCHEMA:
        raise InputError(
            [
                f"{path} was made by a newer version of codesign-jax (its folders have schema "
                f"{stored['schema']}, this version reads up to {SCHEMA}): use that version"
            ]
        )
    settings = Settings(**stored["settings"])
    if problems := check(settings, None):
        raise _damaged(file, f"its settings are not valid: {problems[0]}")
    stored["settings"] = dataclasses.asdict(settings)
    return stored


def changed_files(path: Path, stored: Mapping[str, Any]) -> list[str]:
    """Names of the scene files that differ from those the run was made with.

    Other comments or another layout of a TOML file are no difference. Runs from before digests were
    noted have none to compare with.
    """
    noted = stored.get("files", {})
    found = []
    for name, digest in noted.items():
        found += [] if _digest(path / name) == digest else [name]
    if not found or not set(found) <= set(scene_files.NAMES):
        return found
    try:
        texts = scene_files.scene_texts(scenes.load(path / "scene.toml"))
    except InputError:
        return found
    return [n for n in found if sha256(texts[n].encode()).hexdigest() != noted[n]]


def refuse_changed(path: Path, stored: Mapping[str, Any]) -> None:
    """Refuses a run whose scene files are not those it was made with."""
    changed = changed_files(path, stored)
    if not changed:
        return
    missing = [name for name in changed if not (path / name).exists()]
    what = "is missing" if missing == changed else "was changed"
    raise InputError(
        [
            f"{', '.join(str(path / name) for name in changed)} {what} since the run was made, so "
            "that its results are not those of this scene. Put back the file as it was. To try "
            "other values on the run's design leave the file and give --set KEY=VALUE; a run of "
            f"the new scene needs a folder of its own. Or, to accept the files as they are, delete "
            f'their lines under "files" in {path / PROVENANCE}'
        ]
    )


def _damaged(file: Path, why: str) -> InputError:
    return InputError(
        [f"{file} is damaged: {why}. Put it back from a copy, or choose another folder"]
    )


def _digest(path: Path) -> str:
    """A file's digest; nothing where there is no file that can be read."""
    try:
        return sha256(path.read_bytes()).hexdigest() if path.is_file() else ""
    except OSError:
        return ""


def _exists(path: Path) -> bool:
    try:
        return path.exists()
    except OSError:  # such as a name that is too long
        return False


def _runs_inside(path: Path) -> str:
    """A hint at the runs in a folder of several, such as that of --seeds."""
    try:
        inside = sorted(file.parent for file in path.glob(f"*/{PROVENANCE}"))
    except OSError:
        return ""
    inside.sort(key=lambda folder: (len(folder.name), folder.name))  # seed-2 before seed-10
    if not inside:
        return ""
    some = f"{inside[0]} or {inside[1]}" if len(inside) > 1 else str(inside[0])
    return f"; it holds {len(inside)} run{'s' * (len(inside) > 1)}: give one, such as {some}"


def _problem(stored: Any) -> str:
    """What is wrong with the types of a provenance; nothing if they are right."""
    if not isinstance(stored, dict):
        return "it is no table"
    types = {"settings": dict, "environment": dict, "started": dict, "git": dict, "files": dict}
    types |= {"resumed": list, "extended": list, "schema": int, "id": str}
    for name, kind in types.items():
        if name not in stored and name not in ("settings", "environment", "started"):
            continue
        if not isinstance(stored.get(name), kind) or isinstance(stored.get(name), bool):
            return f'"{name}" is missing' if name not in stored else f'"{name}" is not valid'
    if not _is_id(stored.get("id", "0" * 32)):
        return '"id" is not valid'
    steps = [stored["started"], *stored.get("resumed", []), *stored.get("extended", [])]
    checks = {
        "settings": _are_settings(stored["settings"]),
        "environment": _is_environment(stored["environment"]),
        "started, resumed or extended": all(map(_is_start, steps)),
        "git": isinstance(stored.get("git", {}).get("commit"), str | None),
        "files": all(
            isinstance(v, str) and _is_inside(k) for k, v in stored.get("files", {}).items()
        ),
    }
    wrong = [name for name, right in checks.items() if not right]
    return f'"{wrong[0]}" is not valid' if wrong else ""


def _is_id(text: str) -> bool:
    return len(text) == 32 and not set(text) - set("0123456789abcdef")


def _is_inside(name: str) -> bool:
    """Whether a name is of a file that a run has, and nowhere else."""
    folders = ([scene_files.MESHES], [own.FOLDER])
    return name in scene_files.NAMES or name.split("/")[:-1] in folders


def _are_settings(given: dict[str, Any]) -> bool:
    fields = {field.name: field for field in dataclasses.fields(Settings)}
    needed = {n for n, field in fields.items() if field.default is dataclasses.MISSING}
    right = all(type(v) is fields[n].type for n, v in given.items() if n in fields)
    return right and needed <= set(given) <= set(fields)


def _is_environment(given: dict[str, Any]) -> bool:
    versions = given.get("versions")
    return (
        all(isinstance(given.get(name), str) for name in _OF_ENVIRONMENT)
        and isinstance(versions, dict)
        and all(isinstance(v, str | None) for v in versions.values())
    )


def _is_start(given: Any) -> bool:
    if not isinstance(given, dict) or not isinstance(given.get("time"), str):
        return False
    command = given.get("command")
    return isinstance(command, list) and all(isinstance(word, str) for word in command)
