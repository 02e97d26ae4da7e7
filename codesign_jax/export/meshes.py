"""Parts as STL and 3MF files in millimetres, read back and checked."""

from pathlib import Path
from typing import NamedTuple

import manifold3d
import numpy as np
import trimesh

from codesign_jax.export.casting import Parts, parts
from codesign_jax.export.palm import Palm, without_short_edges
from codesign_jax.export.process import Process, Size

FOLDER = "parts"
FORMATS = ("stl", "3mf")
# STL holds float32: seven digits of lengths up to a metre, of which a volume has three.
_VOLUME = 1e-4
_LENGTH = 1e-3


class Part(NamedTuple):
    """A part as it was written."""

    name: str  # name of its files without their ending
    fingers: tuple[int, ...]  # indices of the fingers that it is for
    volume: float  # volume of the solid, read back from its STL file [mm^3]
    extents: tuple[float, float, float]  # edges of its bounding box, likewise [mm]


def write(folder: Path, sizes: list[Size], process: Process) -> list[Part]:
    """Writes fingers and moulds, equal fingers once, as they stand on a printer's bed."""
    printed_parts = []
    for size in dict.fromkeys(sizes):
        fingers = tuple(i for i, other in enumerate(sizes) if other == size)
        label = "_".join(map(str, fingers))
        for kind, solid in standing(parts(size, process))._asdict().items():
            name = f"finger_{label}" + ("" if kind == "finger" else f"_{kind}")
            meshes = [_save(folder / f"{name}.{ending}", solid) for ending in FORMATS]
            extents = tuple(float(v) for v in meshes[0].extents)
            printed_parts.append(Part(name, fingers, float(meshes[0].volume), extents))
    return printed_parts


def write_palm(folder: Path, built: Palm) -> list[Part]:
    """Writes the palm and its clamp bars, equal bars once, as they stand on a printer's bed.

    Seats that stand in one another may leave a surface that no file can say as a closed one; such
    a palm is left out.
    """
    solids = {("palm", tuple(range(len(built.bars)))): built.body}
    alike: dict[tuple, list[int]] = {}
    for i, bar in enumerate(built.bars):
        low, high = np.reshape(bar.bounding_box(), (2, 3))
        key = *np.round(high - low, 3).tolist(), round(bar.volume(), 2)
        alike.setdefault(key, []).append(i)
    solids |= {("bar", tuple(fingers)): built.bars[fingers[0]] for fingers in alike.values()}
    printed_parts = []
    for (kind, fingers), solid in solids.items():
        name = kind if kind == "palm" else f"{kind}_{'_'.join(map(str, fingers))}"
        stands = without_short_edges(_stands(solid))
        if stands is None:
            continue
        meshes = [_save(folder / f"{name}.{ending}", stands) for ending in FORMATS]
        extents = tuple(float(v) for v in meshes[0].extents)
        printed_parts.append(Part(name, fingers, float(meshes[0].volume), extents))
    return printed_parts


def _stands(solid: manifold3d.Manifold) -> manifold3d.Manifold:
    return solid.translate([0, 0, -solid.bounding_box()[2]])


def standing(pieces: Parts) -> Parts:
    """Parts as they stand on z = 0 with their openings up."""
    turned = pieces._replace(tray=pieces.tray.rotate([180, 0, 0]))
    return Parts(*map(_stands, turned))


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
    again = read(path)
    bounds = np.reshape(solid.bounding_box(), (2, 3))
    same = abs(again.volume - solid.volume()) <= _VOLUME * solid.volume()
    if not (again.is_watertight and same and np.allclose(again.bounds, bounds, atol=_LENGTH)):
        raise RuntimeError(f"{path} does not hold the part that was written")
    return again
