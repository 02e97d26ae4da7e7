"""Mesh files: read whole, once, and within limits of bytes, faces and time.

A file is a stranger's: the parsers see bytes that were looked at before, no archive, no other file
that this one names, and no picture.
"""

import codecs
import hashlib
import io
import json
import logging
import re
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import trimesh

from codesign_jax import files
from codesign_jax.scene import library, texts
from codesign_jax.scene.schema import InputError, shown

# What trimesh logs, tracebacks of what it tried first among it, is no message for a terminal.
logging.getLogger("trimesh").addHandler(logging.NullHandler())

FORMATS = ("glb", "gltf", "obj", "off", "ply", "stl")
"""Formats whose files hold all of a mesh, and are no archives."""
MOST_BYTES = 1 << 24
"""Largest file; a binary STL of 200,000 faces has 10 MB."""
MOST_FACES = 200_000
MOST_PARTS = 1000
"""Most bodies of a file: each costs trimesh a millisecond, however small it is."""
_STL_HEAD = 84
_STL_FACE = 50
"""Bytes of a binary STL before its faces, the last four of them their number, and of a face."""
_GROUP = re.compile(r"^[ \t]*+(?:usemtl|g|o|s|mtllib)\b.*$", re.MULTILINE)
"""Lines of an OBJ that name parts and materials: trimesh takes quadratic time for them."""
_FACE = re.compile(r"^[ \t]*+f[ \t]++(.*)$", re.MULTILINE)
"""Lines of an OBJ with the corners of a polygon."""
_COMMA = re.compile(
    r"^[ \t]*+(?:v|vertex|facet[ \t]++normal)?[ \t]*+[-+]?[0-9]++,[0-9]", re.MULTILINE
)
"""A line of positions or normals that begins with a number with a decimal comma."""


class Read(NamedTuple):
    """A mesh file."""

    vertices: np.ndarray  # positions in the file's unit, shape (vertex, 3)
    faces: np.ndarray  # vertex indices, shape (face, 3)
    content: bytes  # the file's bytes, all of which the mesh was read from
    digest: str  # their SHA-256


def read(path: Path) -> Read:
    """Reads a mesh file of one of `FORMATS`."""
    if not library.is_file(path):
        raise InputError.of("missing", f"no file {shown(str(path))}")
    kind = path.suffix.lower().removeprefix(".")
    if kind not in FORMATS:
        valid = ", ".join(f".{name}" for name in FORMATS)
        raise InputError.of(
            "unsupported", f"{path.name}: is no mesh file that is read; valid: {valid}"
        )
    try:
        with files.opened(path) as file:
            content = file.read(MOST_BYTES + 1)
    except OSError as error:
        raise InputError.of("file", f"{path.name}: {error.strerror}") from error
    if len(content) > MOST_BYTES:
        raise InputError.of(
            "range", f"{path.name}: has more than {MOST_BYTES >> 20} MiB; use fewer faces"
        )
    return parsed(path, content)


def parsed(path: Path, content: bytes) -> Read:
    """The mesh in a file of this name and content."""
    kind = path.suffix.lower().removeprefix(".")
    if foreign := texts.foreign(content):
        raise InputError.of("file", f"{path.name}: {foreign}")
    try:
        vertices, faces = _parse(content.removeprefix(codecs.BOM_UTF8), kind)
    except Exception as error:  # every format has its own parser with its own exceptions
        why = shown(str(error))[1:-1] or type(error).__name__
        raise InputError.of("syntax", f"{path.name}: cannot be read as a mesh: {why}") from error
    if problem := _problem(vertices, faces):
        raise InputError.of("geometry", f"{path.name}: {problem}")
    return Read(vertices, faces, content, hashlib.sha256(content).hexdigest())


def _parse(content: bytes, kind: str) -> tuple[np.ndarray, np.ndarray]:
    options: dict[str, Any] = {}
    if kind in ("glb", "gltf"):
        _check_gltf(content)
    elif kind == "stl" and (end := _end_of_binary_stl(content)):
        content = content[:end]
    elif kind != "ply" or b"format ascii" in content[:_STL_HEAD]:
        content = _text(content, kind).encode()
    if kind in ("glb", "gltf", "obj", "ply"):
        options["skip_materials"] = True
    with np.errstate(all="ignore"):  # numbers out of range are looked at below
        mesh = trimesh.load_mesh(io.BytesIO(content), file_type=kind, **options)
        # Seams of texture and shading are no holes.
        mesh.merge_vertices(merge_tex=True, merge_norm=True)
    vertices = np.asarray(mesh.vertices, float)
    if kind in ("glb", "gltf"):  # the one format that says which way is up (glTF 2.0, 3.4): y
        vertices = vertices[:, [0, 2, 1]] * (1.0, -1.0, 1.0)
    return vertices, np.asarray(mesh.faces)


def _end_of_binary_stl(content: bytes) -> int:
    """Where the last face of a binary STL ends; 0 for a text.

    Some programs write more behind it. A text has letters for the number of faces: so many faces
    no file has room for.
    """
    count = int.from_bytes(content[_STL_HEAD - 4 : _STL_HEAD], "little")
    end = _STL_HEAD + _STL_FACE * count
    if len(content) >= max(end, _STL_HEAD):
        return end
    if b"\0" in content[:_STL_HEAD]:
        whole = max(len(content) - _STL_HEAD, 0) // _STL_FACE
        raise ValueError(f"it is cut short: its head has {count:,} faces, the file {whole:,}")
    return 0


def _text(content: bytes, kind: str) -> str:
    """A mesh file of text, in which the parser finds nothing that takes it long."""
    # What is no UTF-8 trimesh would give to a detector of encodings, which takes minutes.
    text = content.decode("utf-8", "replace")
    if kind == "stl" and text.lower().count("endsolid") > MOST_PARTS:
        raise ValueError(f"more than {MOST_PARTS:,} solids")
    if _COMMA.search(text):
        raise ValueError("its numbers have decimal commas; save it with decimal points")
    if (
        kind == "obj"
        and sum(len(face[1].split()) - 2 for face in _FACE.finditer(text)) > MOST_FACES
    ):
        raise ValueError(f"more than {MOST_FACES:,} faces")
    if kind == "obj" and sum(1 for _ in _GROUP.finditer(text)) > MOST_PARTS:
        text = _GROUP.sub("", text)
    return text


def _check_gltf(content: bytes) -> None:
    text = content[20 : 20 + int.from_bytes(content[12:16], "little")]
    tree = json.loads(text if content[:4] == b"glTF" else content)
    parts = {key: tree.get(key, []) for key in ("buffers", "nodes", "meshes", "accessors")}
    for buffer in parts["buffers"]:
        if not str(buffer.get("uri", "data:")).startswith("data:"):
            uri = shown(buffer["uri"])
            raise ValueError(f"its numbers are in another file, {uri}; save it as .glb")
    if len(parts["nodes"]) > MOST_PARTS:
        raise ValueError(f"{len(parts['nodes']):,} nodes, more than {MOST_PARTS:,}")
    children = [child for node in parts["nodes"] for child in node.get("children", [])]
    if len(children) != len({*children}):
        raise ValueError("a node has two parents")
    counts = [int(accessor["count"]) for accessor in parts["accessors"]]
    bodies = [mesh["primitives"] for mesh in parts["meshes"]]
    corners = [sum(_corners(body, counts) for body in primitives) for primitives in bodies]
    # A mesh may stand in many places, and is read if it stands in none.
    used = [*range(len(bodies)), *(node["mesh"] for node in parts["nodes"] if "mesh" in node)]
    if (number := sum(len(bodies[k]) for k in used)) > MOST_PARTS:
        raise ValueError(f"{number:,} bodies, more than {MOST_PARTS:,}")
    if max([sum(corners[k] for k in used), *counts]) > 3 * MOST_FACES:
        raise ValueError(f"more than {MOST_FACES:,} faces")


def _corners(primitive: dict[str, Any], counts: list[int]) -> int:
    """Length of the longest list of numbers that is read of a body in a glTF file."""
    named = [
        *primitive["attributes"].values(),
        *([primitive["indices"]] * ("indices" in primitive)),
    ]
    return max(counts[k] for k in named)


def _problem(vertices: np.ndarray, faces: np.ndarray) -> str | None:
    if vertices.ndim != 2 or vertices.shape[1] != 3 or faces.ndim != 2 or faces.shape[1] != 3:
        return "is no mesh of triangles"
    if not len(faces) or not np.isfinite(vertices).all():
        return "has no faces, or positions that are not numbers"
    if len(faces) > MOST_FACES:
        return f"has {len(faces):,} faces, more than {MOST_FACES:,}"
    if faces.min() < 0 or faces.max() >= len(vertices):
        return "has faces of vertices that it does not have"
    return None
