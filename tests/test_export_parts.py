"""Exported parts: closed, in millimetres, with the design's walls, chamber and volumes."""

import zipfile

import manifold3d
import numpy as np
import pytest
import trimesh
from numpy.polynomial import Polynomial

from codesign_jax.export import casting, meshes
from codesign_jax.export.process import Process, Section, Size


def uniform(length, width, height, wall):
    section = Section(width, height, wall)
    return Size(length, section, section, wall)


USUAL, FLAT, SHORT = uniform(95, 20, 20, 5), uniform(170, 20, 15, 7), uniform(12, 20, 25, 2)
TAPERED = Size(120, Section(24, 22, 5), Section(16, 14, 3), 4.0)
# STL holds float32: seven digits of lengths of up to 200 mm.
EXACT = 1e-4


@pytest.fixture(scope="module")
def written(tmp_path_factory):
    """Folder of the parts of three fingers, and what was said of them."""
    folder = tmp_path_factory.mktemp("parts")
    found = meshes.write(folder, [USUAL, FLAT, USUAL, SHORT], Process())
    return folder, {part.name: part for part in found}


def test_equal_fingers_are_written_once_in_both_formats(written):
    folder, parts = written
    labels = ["0_2", "1", "3"]
    kinds = ["", "_tray", "_core", "_base"]
    names = {f"finger_{label}{kind}" for label in labels for kind in kinds}
    assert set(parts) == names
    assert {p.name for p in folder.iterdir()} == {f"{n}.{e}" for n in names for e in meshes.FORMATS}
    assert parts["finger_0_2"].fingers == (0, 2)


def test_files_hold_closed_bodies_in_millimetres(written):
    folder, parts = written
    for path in folder.iterdir():
        surface, part = trimesh.load_mesh(path), parts[path.stem]
        assert surface.is_watertight and surface.is_winding_consistent
        assert surface.volume == pytest.approx(part.volume, rel=EXACT) and surface.volume > 0
        np.testing.assert_allclose(surface.bounds[0, 2], 0, atol=EXACT)  # on the printer's bed
        if path.suffix == ".3mf":
            text = zipfile.ZipFile(path).read("3D/3dmodel.model").decode()
            assert 'unit="millimeter"' in text
    assert np.allclose(parts["finger_1"].extents, (170, 20, 15), atol=EXACT)


@pytest.mark.parametrize(("name", "size"), [("0_2", USUAL), ("1", FLAT), ("3", SHORT)])
def test_walls_and_chamber_are_the_design_s(written, name, size):
    """Rays through the finger meet its surfaces at the thickness of the walls."""
    part = solid(written[0] / f"finger_{name}.stl")
    wall, (across, up) = size.base.wall, size.base.chamber
    low, high = np.reshape(part.bounding_box(), (2, 3))
    inside = np.array([size.length / 2, 0.3 * across / 2, wall + 0.3 * up])
    for axis, thick in enumerate((size.end, wall, wall)):
        step = 10 * np.eye(3)[axis]
        ends = (
            np.where(step > 0, place + way * step, inside) for way, place in ((-1, low), (1, high))
        )
        hits = part.ray_cast(*ends)
        places = sorted(hit.position[axis] for hit in hits)
        expected = [low[axis], low[axis] + thick, high[axis] - thick, high[axis]]
        np.testing.assert_allclose(places, expected, atol=EXACT)


def solid(path):
    """A part's file as a solid, for booleans."""
    surface = trimesh.load_mesh(path)
    return manifold3d.Manifold(
        manifold3d.Mesh64(np.asarray(surface.vertices, float), np.asarray(surface.faces, "uint64"))
    )


def box(low, high):
    return manifold3d.Manifold.cube(np.subtract(high, low)).translate(low)


@pytest.mark.parametrize("draft", [0.0, 3.0])
def test_what_the_moulds_hold_is_the_finger(tmp_path, draft):
    """The closed mould's cavity, from the files: the shell; the base's pocket: the bottom wall."""
    size, how = USUAL, Process(draft=draft, inlet=0.0)
    meshes.write(tmp_path, [size], how)
    length, (width, height, wall) = size.length, size.base
    # Back into the frame of the finger: the tray was turned over, the core's bars stood below it.
    tray = solid(tmp_path / "finger_0_tray.stl").translate([0, 0, -height - how.mould_wall])
    tray = tray.rotate([180, 0, 0])
    core = solid(tmp_path / "finger_0_core.stl").translate([0, 0, wall - how.mould_wall])
    assert (tray ^ core).volume() == pytest.approx(0, abs=1e-2)  # they fit: rounding of float32
    room = box([-2, -width / 2 - 2, wall], [length + 2, width / 2 + 2, height])
    cast = room - tray - core
    z = Polynomial([0, 1])
    side = np.tan(np.radians(draft)) * ((wall + height) / 2 - z)

    def prism(a, b, low, high):
        integral = ((a + 2 * side) * (b + 2 * side)).integ()
        return integral(high) - integral(low)

    chamber = length - 2 * wall, size.base.chamber[0]
    shell = prism(length, width, wall, height) - prism(*chamber, wall, height - wall)
    assert cast.volume() == pytest.approx(shell, rel=EXACT)
    base = solid(tmp_path / "finger_0_base.stl").translate([0, 0, -how.mould_wall])
    pocket = box([-2, -width / 2 - 2, 0], [length + 2, width / 2 + 2, wall]) - base
    bottom = (length + 2 * side(wall)) * (width + 2 * side(wall)) * wall
    assert pocket.volume() == pytest.approx(bottom, rel=EXACT)
    if not draft:
        assert cast.volume() + pocket.volume() == pytest.approx(size.volume, rel=EXACT)
    # The walls keep their thickness: what is between core and tray at any height.
    for height_at in (wall + 1, height - wall - 1):
        [ray] = cast.ray_cast([50.0, -50, height_at], [50.0, -chamber[1] / 2, height_at])[:1]
        inner = cast.ray_cast([50.0, -50, height_at], [50.0, 0, height_at])[1]
        assert inner.position[1] - ray.position[1] == pytest.approx(wall, abs=1e-3)


def test_moulds_of_a_tapered_finger_hold_it(tmp_path):
    """Shell and bottom wall are the finger, by Simpson's rule over its sections; walls have the
    thickness of the place."""
    how = Process(inlet=0.0)
    meshes.write(tmp_path, [TAPERED], how)
    finger, tray, core, base = (
        solid(tmp_path / f"finger_0{kind}.stl") for kind in ("", "_tray", "_core", "_base")
    )
    assert finger.volume() == pytest.approx(TAPERED.volume, rel=EXACT)
    made = casting.parts(TAPERED, how)
    for part, file in zip(made, (finger, tray, core, base), strict=True):
        assert part.volume() == pytest.approx(file.volume(), rel=EXACT)
    assert (made.tray ^ made.core).volume() == pytest.approx(0, abs=1e-6)
    assert core.genus() == 2 * len(casting.bars_of(TAPERED))
    x, half = (-2.0, 122.0), casting._shifted(casting._half(TAPERED), 2.0)
    rim, top = casting._rim(TAPERED), lambda x: TAPERED.at(x).height
    shell = casting._solid(x, half, rim, top) - made.tray - made.core
    pocket = casting._solid(x, half, lambda x: 0.0, rim) - made.base
    assert shell.volume() + pocket.volume() == pytest.approx(TAPERED.volume, rel=1e-6)
    for x in (10.0, 110.0):
        top = TAPERED.at(x).height
        hits = finger.ray_cast([x, 0.3, top + 5], [x, 0.3, -5])
        at = sorted(hit.position[2] for hit in hits)
        wall = TAPERED.at(x).wall
        np.testing.assert_allclose(at, [0, wall, top - wall, top], atol=1e-3)
