"""Meshes: mass and distance against closed forms, what is refused, what a repair says."""

import mujoco
import numpy as np
import pytest
import trimesh
from scipy.spatial.transform import Rotation

from codesign_jax.scene import meshes, objects, schema
from codesign_jax.scene.meshes import grid, surface
from tests.helpers.solids import box, bracket, object_file


def solid(tmp_path, mesh, *, unit="m", repaired=False, voxel_error=5e-4):
    path = tmp_path / "object.off"  # keeps shared vertices and all digits, unlike STL
    mesh.export(path, digits=17)
    return meshes.load(path, unit=unit, repaired=repaired, voxel_error=voxel_error)


def problems(tmp_path, mesh, **options):
    with pytest.raises(schema.InputError) as caught:
        solid(tmp_path, mesh, **options)
    return caught.value.problems


# --- mass properties -----------------------------------------------------------------------------


def test_mass_of_a_box_in_any_pose(tmp_path):
    """Exact up to the rounding of moments over lengths, whatever the pose in the file."""
    mesh, half = box(), np.array([0.02, 0.025, 0.03])
    pose = np.eye(4)
    pose[:3, :3] = Rotation.from_rotvec([0.3, 0.9, -0.5]).as_matrix()
    pose[:3, 3] = [0.1, -0.2, 0.05]
    mesh.apply_transform(pose)
    found = solid(tmp_path, mesh)
    assert found.volume == pytest.approx(8 * half.prod(), rel=1e-12)
    expected = (half**2).sum() / 3 - half**2 / 3
    np.testing.assert_allclose(np.sort(found.inertia), np.sort(expected), rtol=1e-9)
    np.testing.assert_allclose(np.sort(found.half_sizes), half, rtol=1e-9)
    turned = np.zeros(9)
    mujoco.mju_quat2Mat(turned, found.upright)
    back = found.vertices @ turned.reshape(3, 3).T + pose[:3, 3]
    np.testing.assert_allclose(back, mesh.vertices, atol=1e-12)
    low = (found.hull @ turned.reshape(3, 3)[2]).min()
    assert -low == pytest.approx(pose[2, 3] - mesh.vertices[:, 2].min(), rel=1e-9)


# --- distance ------------------------------------------------------------------------------------


def test_exact_distance_is_the_least_over_all_faces():
    """Inside, outside and in the corner of an L."""
    mesh = bracket()
    points = np.random.default_rng(1).uniform(-0.02, 0.08, (500, 3))
    found = surface.signed_distance(mesh.vertices, mesh.faces, points)
    every = np.repeat(mesh.triangles, 500, 0), np.tile(points, (len(mesh.faces), 1))
    away = np.linalg.norm(trimesh.triangles.closest_point(*every) - every[1], axis=1)
    np.testing.assert_allclose(np.abs(found), away.reshape(-1, 500).min(0), atol=1e-15)
    x, y, z = points.T
    inside = (0 < y) & (y < 0.044) & (0 < x) & (x < 0.064) & (0 < z) & (z < 0.064)
    inside &= (x < 0.022) | (z < 0.022)
    np.testing.assert_array_equal(found < 0, inside)


@pytest.mark.parametrize("bound", [5e-4, pytest.param(3e-4, marks=pytest.mark.slow)])
def test_voxel_error_is_what_is_said(bound):
    """On an L, at points that the grid was not chosen by."""
    mesh = bracket()
    built = grid.build(mesh.vertices, mesh.faces, bound, 0.014)
    assert built.error <= bound < built.worst
    rng = np.random.default_rng(2)
    points, face = trimesh.sample.sample_surface(mesh, 2000, seed=3)[:2]
    points = points + rng.uniform(-0.002, 0.002, (2000, 1)) * mesh.face_normals[face]
    exact = surface.signed_distance(mesh.vertices, mesh.faces, points)
    error = np.abs(grid.interpolate(built, points) - exact)
    # The quantile of 2000 points scatters by a few per cent.
    assert np.quantile(error, 0.99) < 1.1 * bound and error.max() < 0.6 * built.cell
    # Where the centres of contact spheres are, the distance is smooth: far better than at edges.
    far = points + 0.008 * mesh.face_normals[face]
    exact = surface.signed_distance(mesh.vertices, mesh.faces, far)
    convex = exact > 0.005  # not in the L's inner corner
    error = np.abs(grid.interpolate(built, far) - exact)[convex]
    assert np.quantile(error, 0.99) < 0.3 * bound


# --- what is refused -----------------------------------------------------------------------------


def test_open_inverted_and_flipped(tmp_path):
    mesh = box()
    faces = mesh.faces.copy()
    (problem,) = problems(tmp_path, trimesh.Trimesh(mesh.vertices, faces[1:]))
    assert "object.off: not watertight: 3 edges" in problem and "repair = true" in problem
    (problem,) = problems(tmp_path, trimesh.Trimesh(mesh.vertices, faces[:, ::-1]))
    assert "inside out" in problem
    faces[0] = faces[0, ::-1]
    (problem,) = problems(tmp_path, trimesh.Trimesh(mesh.vertices, faces))
    assert "faces point to different sides at 3 edges" in problem


@pytest.mark.parametrize(
    ("size", "unit", "hint"),
    [
        (60.0, "m", "looks like millimetres: set unit = 'mm'"),
        (0.06, "mm", "looks like metres: set unit = 'm'"),
        (2.4, "mm", "looks like centimetres: set unit = 'cm'"),
    ],
)
def test_unit_slips(tmp_path, size, unit, hint):
    (problem,) = problems(tmp_path, box(size, size, size), unit=unit)
    assert hint in problem


def test_all_problems_at_once(tmp_path):
    """Of the file and of its meshes."""
    mesh = box(60, 60, 60)
    trimesh.Trimesh(mesh.vertices, mesh.faces[1:]).export(tmp_path / "open.off")
    (tmp_path / "broken.stl").write_text("this is no mesh")
    path = object_file(
        tmp_path,
        'name = "a"; type = "mesh"; file = "open.off"; mass = 0.1; friction = 0.8',
        'name = "b"; type = "mesh"; file = "none.stl"; mass = 0.1; friction = 0.8',
        'name = "c"; type = "mesh"; file = "broken.stl"; mass = 0.1; friction = 0.8',
        'name = "d"; type = "mesh"; size = [0.1]; friction = 0.8',
        'name = "e"; type = "box"; size = [0.03]; file = "open.off"; friction = 0.8',
    )
    with pytest.raises(schema.InputError) as caught:
        objects.load(path)
    said = caught.value.problems
    for expected in (
        "object a: open.off: is 60 m long",
        "object a: open.off: not watertight",
        "object b: no file",
        "object c: broken.stl:",
        "object d: a mesh has either a mass or a density",
        "object d: file of a mesh is missing",
        "object d: a mesh has no size",
        "object e: size of a box has 3 values, not 1",
        "object e: a box has either a mass or a density",
        "object e: a box has no file",
    ):
        assert sum(expected in p for p in said) == 1, (expected, said)
    assert len(said) == 10


def test_a_surface_that_cuts_through_itself(tmp_path):
    """Two overlapping boxes are watertight and wound alike, but no body."""
    other = box()
    other.apply_translation([0.02, 0.01, 0])
    found = solid(tmp_path, trimesh.util.concatenate([box(), other]), voxel_error=1e-3)
    with pytest.raises(schema.InputError, match="cuts through itself"):
        _ = found.grid


def disc(radius, height, bore=0.0):
    """A plate with or without a hole, turned out of the axes of its grid's cells."""
    make = trimesh.creation
    mesh = make.annulus(bore, radius, height) if bore else make.cylinder(radius, height)
    mesh.apply_transform(trimesh.transformations.rotation_matrix(0.5, [1, 2, 3]))
    return mesh


@pytest.mark.parametrize(
    "mesh",
    [box(120, 120, 2), box(80, 4, 4), box(7, 7, 7).subdivide(), disc(40, 1.5), disc(8, 50, 7.2)],
    ids=["plate", "rod", "cube", "disc", "tube"],
)
def test_bodies_that_are_thin_for_the_cells_do_not_cut_through_themselves(tmp_path, mesh):
    mesh.export(tmp_path / "thin.stl")
    thin = meshes.load(tmp_path / "thin.stl", unit="mm", repaired=False, voxel_error=5e-4)
    assert thin.grid.error <= 5e-4


def test_too_fine_a_grid(tmp_path, monkeypatch):
    monkeypatch.setattr(grid, "MAX_NODES", 1000)
    with pytest.raises(schema.InputError, match="more than 1,000"):
        _ = solid(tmp_path, box(), voxel_error=1e-3).grid


def test_density_becomes_a_mass(tmp_path):
    box(40, 50, 60).export(tmp_path / "box.stl")
    entry = 'name = "a"; type = "mesh"; file = "box.stl"; unit = "mm"; friction = 0.8; '
    shape = objects.load(object_file(tmp_path, entry + "density = 1000")).object[0]
    assert shape.mass == pytest.approx(0.12) and shape.density is None
    box(4, 5, 6).export(tmp_path / "box.stl")
    with pytest.raises(schema.InputError, match=r"a: mass = 0.00012\d* is outside"):
        objects.load(object_file(tmp_path, entry + "density = 1000"))


# --- repair --------------------------------------------------------------------------------------


def test_repair_mends_and_says_what(tmp_path):
    mesh = box()
    faces = mesh.faces[mesh.face_normals[:, 2] < 0.5].copy()  # a square hole
    faces[3] = faces[3, ::-1]
    vertices = np.vstack([mesh.vertices, mesh.vertices[faces[5, 0]] + 1e-7])
    faces[5, 0] = len(vertices) - 1  # a seam
    faces = np.vstack([faces, faces[7]])  # a face twice
    torn = trimesh.Trimesh(vertices, faces, process=False)
    said = problems(tmp_path, torn)
    assert any("not watertight" in p for p in said)
    mended = solid(tmp_path, torn, repaired=True)
    assert mended.volume == pytest.approx(mesh.volume, rel=1e-5)
    assert mended.repairs == (
        "merged 1 vertices into their neighbours",
        "dropped 1 degenerate or duplicate faces",
        "closed a hole of 4 edges",
        "turned 1 of 14 faces, so that all point outwards",
    )
