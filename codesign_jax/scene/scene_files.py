"""A resolved scene as TOML: scene, hand and objects, each value with its unit."""

import dataclasses
import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import tomli_w

from codesign_jax import files, reuse
from codesign_jax import scene as scenes
from codesign_jax.scene import Scene, key_frames
from codesign_jax.scene.loading import OF_ACCURACY
from codesign_jax.scene.objects import Shape

NAMES = ("scene.toml", "hand.toml", "objects.toml", "control.toml")
MESHES = "meshes"  # folder of the objects' meshes
SEARCH = "search.toml"
"""The accuracy of a run's search, where it is another one than its scene's."""


def scene_texts(scene: Scene) -> dict[str, str]:
    """Returns the files of a resolved scene by name; the scene refers to the others."""
    top = _plain(scene) | {"hand": "hand.toml", "objects": "objects.toml"}
    top |= {"control": "control.toml"}
    shapes = tuple(
        dataclasses.replace(shape, file=_mesh_name(shape, i) if shape.mesh else None)
        for i, shape in enumerate(scene.objects.object)
    )
    objects = dataclasses.replace(scene.objects, object=shapes)
    hand = key_frames.without_parameters(scene.hand)
    return {
        "scene.toml": _document(
            top,
            _units(scene)
            | {"gravity": "m/s^2"}
            | dict.fromkeys(("hand", "objects", "control"), ""),
        ),
        "hand.toml": _document(_plain(hand), _units(hand)),
        "objects.toml": _document(_plain(objects), _units(objects)),
        "control.toml": _document(scene.control.as_file(), {}),
    }


def contents(scene: Scene) -> dict[str, bytes]:
    """Returns all files of a resolved scene, its meshes included, by name in the folder."""
    file_bytes = {name: text.encode() for name, text in scene_texts(scene).items()}
    for i, shape in enumerate(scene.objects.object):
        if shape.mesh:
            file_bytes[_mesh_name(shape, i)] = shape.mesh.content
    return file_bytes


def accuracy_text(scene: Scene, description: str) -> str:
    """All values of a scene's accuracy as a file that `scene.load_accuracy` reads."""
    tables = {name: getattr(scene, name) for name in OF_ACCURACY}
    units = {f"{n}.{key}": unit for n, t in tables.items() for key, unit in _units(t).items()}
    return _document({"description": description} | _plain(tables), units)


def digest(scene: Scene, engine: str, designs: np.ndarray, *numbers: int) -> str:
    """Digest of what determines outcomes, beside code, versions and device."""
    shape = designs.shape
    content = np.ascontiguousarray(designs).tobytes()
    return reuse.digest(scene_texts(scene), engine, shape, content, numbers)


def write_scene(scene: Scene, folder: Path, written: Mapping[str, bytes] | None = None) -> None:
    """Writes a resolved scene, meshes included; `scene.load` of it returns an equal one."""
    for name, content in (contents(scene) if written is None else written).items():
        (folder / name).parent.mkdir(exist_ok=True)  # of the meshes, of code
        with files.atomically(folder / name) as part:
            part.write_bytes(content)
    again = scenes.load(folder / "scene.toml")
    # A scene with other constants is another kind of object than one that was read.
    if again != scene and scene_texts(again) != scene_texts(scene):
        raise RuntimeError(f"{folder / 'scene.toml'} does not read back as it was written")


def _mesh_name(shape: Shape, index: int) -> str:
    """Names of objects are free text; numbers make file names everywhere."""
    assert shape.mesh is not None
    return f"{MESHES}/object_{index}{shape.mesh.path.suffix.lower()}"


def _document(table: dict[str, Any], units: dict[str, str]) -> str:
    lines = []
    prefix = ""
    for line in tomli_w.dumps(table).split("\n")[:-1]:  # texts may hold other ends of lines
        if header := re.fullmatch(r"\[+(.*?)\]+", line):
            prefix = header[1] + "."
        key, equals, _ = line.partition(" = ")
        unit = units.get(prefix + key, "") if equals else ""
        lines.append(f"{line}  # {unit}" if unit else line)
    return "\n".join(lines) + "\n"


def _plain(value: Any) -> Any:
    """Dataclasses as dictionaries and tuples as lists; TOML has no null, so None is left out."""
    if dataclasses.is_dataclass(value):
        fields = [f for f in dataclasses.fields(value) if f.metadata.get("in_file", True)]
        value = {f.name: getattr(value, f.name) for f in fields}
    if isinstance(value, dict):
        return {k: _plain(v) for k, v in value.items() if v is not None}
    return [_plain(v) for v in value] if isinstance(value, tuple | list) else value


def _units(value: Any, prefix: str = "") -> dict[str, str]:
    """Units of a dataclass's numbers by dotted key path; those of an array's entries are alike."""
    units: dict[str, str] = {}
    if isinstance(value, tuple):
        for entry in value:
            units |= _units(entry, prefix)
    elif dataclasses.is_dataclass(value):
        for field in dataclasses.fields(value):
            inside = _units(getattr(value, field.name), f"{prefix}{field.name}.")
            # The writer puts an array of small tables under its own key, an entry a line.
            listed = [f"{k.rpartition('.')[2]} in {u}" for k, u in inside.items() if u]
            units |= inside | {prefix + field.name: field.metadata.get("unit", ", ".join(listed))}
    return units
