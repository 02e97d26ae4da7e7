"""Parts as STL and 3MF files in millimetres, read back and checked."""

from pathlib import Path
from typing import NamedTuple

import manifold3d
import numpy as np
import trimesh

from codesign_jax.export.casting import Parts, parts
from codesign_jax.export.process import Process, Size

FOLDER = "parts"
FORMATS = ("stl", "3mf")
# STL holds float32: seven digits of lengths up to a metre, of which a volume has three.
_VOLUME, _LENGTH = 1e-4, 1e-3


class Part(NamedTuple):
    """A part as it was written."""

    name: str  # name of its files without their ending
    fingers: tuple[int, ...]  # indices of the fingers that it is for
    size: Size  # their dimensions
    volume: float  # volume of the solid, read back from its STL file [mm^3]
    extents: tuple[float, float, float]  # edges of its bounding box, likewise [mm]


def write(folder: Path, sizes: list[Size], process: Process) -> list[Part]:
    """Writes fingers and moulds, equal fingers once, as they stand on a printer's bed."""
    found = []
    for size in dict.fromkeys(sizes):
        fingers = tuple(i for i, other in enumerate(sizes) if other == size)
        label = "_".join(map(str, fingers))
        for kind, solid in standing(parts(size, process))._asdict().items():
            name = f"finger_{label}" + ("" if kind == "finger" else f"_{kind}")
            meshes = [_save(folder / f"{name}.{ending}", solid) for ending in FORMATS]
            extents = tuple(float(v) for v in meshes[0].extents)
            found.append(Part(name, fingers, size, float(meshes[0].volume), extents))
    return found


def standing(found: Parts) -> Parts:
    """Parts as they stand on z = 0 with their openings up."""
    turned = found._replace(tray=found.tray.rotate([180, 0, 0]))
    return Parts(*(s.translate([0, 0, -s.bounding_box()[2]]) for s in turned))


def mesh(solid: manifold3d.Manifold) -> trimesh.Trimesh:
    """A solid's surface."""
    surface = solid.to_mesh64()
    vertices = np.asarray(surface.vert_properties)[:, :3]
    return trimesh.Trimesh(vertices, np.asarray(surface.tri_verts), process=False)


def read(path: Path) -> trimesh.Trimesh:
    """Reads a part back."""
    return trimesh.load_mesh(path)


def _save(path: Path, solid: manifold3d.Manifold) -> trimesh.Trimesh:
    surface = mesh(solid)
    surface.units = "mm"
    surface.export(path)
    again, bounds = read(path), np.reshape(solid.bounding_box(), (2, 3))
    same = abs(again.volume - solid.volume()) <= _VOLUME * solid.volume()
    if not (again.is_watertight and same and np.allclose(again.bounds, bounds, atol=_LENGTH)):
        raise RuntimeError(f"{path} does not hold the part that was written")
    return again
