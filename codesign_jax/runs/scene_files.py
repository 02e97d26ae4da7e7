"""A resolved scene as TOML: scene, hand and objects, each value with its unit."""

import dataclasses
import json
from pathlib import Path
from typing import Any

from codesign_jax import scene as scenes
from codesign_jax.objects import Shape
from codesign_jax.scene import Scene

NAMES = ("scene.toml", "hand.toml", "objects.toml")
MESHES = "meshes"  # folder of the objects' meshes


def scene_texts(scene: Scene) -> dict[str, str]:
    """Returns the three files of a resolved scene by name; the scene refers to the others."""
    top = _fields(scene) | {"hand": "hand.toml", "objects": "objects.toml"}
    shapes = tuple(
        dataclasses.replace(shape, file=_mesh_name(shape, i) if shape.mesh else None)
        for i, shape in enumerate(scene.objects.object)
    )
    objects = dataclasses.replace(scene.objects, object=shapes)
    return {
        "scene.toml": _document(top, _units(scene) | {"gravity": "m/s^2"}),
        "hand.toml": _document(_fields(scene.hand), _units(scene.hand)),
        "objects.toml": _document(_fields(objects), _units(objects)),
    }


def write_scene(scene: Scene, folder: Path) -> None:
    """Writes a resolved scene, meshes included; `scene.load` of it returns an equal one.

    Args:
      scene: The scene.
      folder: An existing folder.

    Raises:
      RuntimeError: If what was written does not read back as the same scene.
    """
    for name, text in scene_texts(scene).items():
        (folder / name).write_text(text, encoding="utf-8")
    for i, shape in enumerate(scene.objects.object):
        if shape.mesh:
            (folder / MESHES).mkdir(exist_ok=True)
            (folder / _mesh_name(shape, i)).write_bytes(shape.mesh.path.read_bytes())
    if scenes.load(folder / "scene.toml") != scene:
        raise RuntimeError(f"{folder / 'scene.toml'} does not read back as it was written")


def _mesh_name(shape: Shape, index: int) -> str:
    """Names of objects are free text; numbers make file names everywhere."""
    assert shape.mesh is not None
    return f"{MESHES}/object_{index}{shape.mesh.path.suffix.lower()}"


def _document(table: dict[str, Any], units: dict[str, str]) -> str:
    lines: list[str] = []
    _write_table(table, units, "", lines)
    return "\n".join(lines).strip() + "\n"


def _write_table(table: dict[str, Any], units: dict[str, str], path: str, lines: list[str]) -> None:
    """Writes plain values first, as TOML asks, then tables and arrays of tables."""
    nested = {k: v for k, v in table.items() if _is_table(v) or _is_tables(v)}
    for key, value in table.items():
        if key not in nested:
            unit = units.get(key, "")
            lines.append(f"{key} = {_literal(value)}" + (f"  # {unit}" if unit else ""))
    for key, value in nested.items():
        name = f"{path}.{key}" if path else key
        for item in [value] if _is_table(value) else value:
            lines += ["", f"[{name}]" if _is_table(value) else f"[[{name}]]"]
            _write_table(_fields(item), _units(item), name, lines)


def _is_table(value: Any) -> bool:
    return dataclasses.is_dataclass(value) or isinstance(value, dict)


def _is_tables(value: Any) -> bool:
    return isinstance(value, tuple) and bool(value) and all(_is_table(v) for v in value)


def _fields(value: Any) -> dict[str, Any]:
    """Key-value pairs of a dataclass or a dictionary; TOML has no null, so None is left out."""
    if isinstance(value, dict):
        return value
    fields = [f for f in dataclasses.fields(value) if f.metadata.get("in_file", True)]
    pairs = {f.name: getattr(value, f.name) for f in fields}
    return {k: v for k, v in pairs.items() if v is not None}


def _units(value: Any) -> dict[str, str]:
    if isinstance(value, dict):
        return {}
    return {f.name: f.metadata.get("unit", "") for f in dataclasses.fields(value)}


def _literal(value: Any) -> str:
    """TOML of a plain value; `repr` of a float reads back as the same number."""
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, str):
        return json.dumps(value, ensure_ascii=False)
    if isinstance(value, tuple | list):
        return "[" + ", ".join(_literal(v) for v in value) + "]"
    return repr(value)
