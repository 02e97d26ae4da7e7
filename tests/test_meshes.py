"""Meshes: mass and distance against closed forms, what is refused, what a repair says."""

import dataclasses
import itertools
import subprocess
import sys
from pathlib import Path

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
import trimesh
from scipy.spatial.transform import Rotation
from small import DATA, hand_world, nth, stack, still

from codesign_jax import meshes, model, objects, parameters, rollout, scene, schema
from codesign_jax.commands import common
from codesign_jax.engines import make_engine
from codesign_jax.engines.structured import collision
from codesign_jax.engines.structured import mesh as mesh_lanes
from codesign_jax.meshes import grid, mass, repair, surface
from codesign_jax.report import sketch
from codesign_jax.runs import scene_files

ROOT = Path(__file__).parent.parent
HEAD = (DATA / "box.toml").read_text().split("[[object]]")[0]
HOUSEHOLD = {
    "capsule", "cone", "torus", "ring_segment", "mug", "bottle", "superquadric", "bracket"
}  # fmt: skip


def box(*sizes):
    return trimesh.creation.box(sizes or (0.04, 0.05, 0.06))


def bracket():
    """An L, not convex: two boxes that share no inner wall."""
    outline = np.array([[22, 22], [22, 64], [0, 64], [0, 0], [64, 0], [64, 22.0]]) / 1e3
    vertices = np.array([[x, y, z] for y in (0, 0.044) for x, z in outline])
    fan = [[0, k, k + 1] for k in range(1, 5)]
    sides = [[k, 6 + k, (k + 1) % 6] for k in range(6)]
    sides += [[(k + 1) % 6, 6 + k, 6 + (k + 1) % 6] for k in range(6)]
    faces = np.array([*fan, *(6 + np.array(fan)[:, ::-1]), *sides])
    return trimesh.Trimesh(vertices, faces)


def solid(tmp_path, mesh, *, unit="m", repaired=False, voxel_error=5e-4):
    path = tmp_path / "object.off"  # keeps shared vertices and all digits, unlike STL
    mesh.export(path, digits=17)
    return meshes.load(path, unit=unit, repaired=repaired, voxel_error=voxel_error)


def problems(tmp_path, mesh, **options):
    with pytest.raises(schema.SceneError) as caught:
        solid(tmp_path, mesh, **options)
    return caught.value.problems


def object_file(tmp_path, *entries, name="objects.toml"):
    """An object file with entries as TOML lines, joined by semicolons."""
    text = HEAD + "".join("\n[[object]]\n" + "\n".join(e.split("; ")) + "\n" for e in entries)
    (tmp_path / name).write_text(text)
    return tmp_path / name


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
    assert found.rest_height == pytest.approx(pose[2, 3] - mesh.vertices[:, 2].min(), rel=1e-9)


def test_mass_of_round_bodies(tmp_path):
    """A prism of n sides and a geodesic ball, against cylinder and sphere."""
    n, r, h = 96, 0.03, 0.036
    found = solid(tmp_path, trimesh.creation.cylinder(r, 2 * h, sections=n))
    area = np.sin(2 * np.pi / n) / (2 * np.pi / n)  # of a regular polygon over its circle
    assert found.volume == pytest.approx(2 * np.pi * r**2 * h * area, rel=1e-9)
    # The faceting takes (2 pi / n)^2 / 3 = 0.14 % off the second moment, the height takes nothing.
    across = r**2 / 4 + h**2 / 3
    np.testing.assert_allclose(found.inertia, [across, across, r**2 / 2], rtol=2e-3)
    found = solid(tmp_path, trimesh.creation.icosphere(4, r))
    # 5120 faces with edges of 0.07 r lie up to (0.07 r)^2 / (6 r) = 0.08 % r below the sphere.
    assert found.volume == pytest.approx(4 / 3 * np.pi * r**3, rel=3e-3)
    np.testing.assert_allclose(found.inertia, 0.4 * r**2, rtol=3e-3)


def test_axes_of_a_symmetric_body_stay_those_of_the_file():
    np.testing.assert_array_equal(mass.principal_axes(np.diag([2.0, 2.0, 1.0])), np.eye(3))
    tensor = np.array([[2.0, 0.1, 0.0], [0.1, 1.0, 0.0], [0.0, 0.0, 3.0]])
    axes = mass.principal_axes(tensor)
    assert np.linalg.det(axes) == pytest.approx(1.0)
    assert (np.diag(axes) > 0.9).all()  # turned by the few degrees that it takes, not renamed


# --- distance ------------------------------------------------------------------------------------


def test_exact_distance_of_a_box_and_a_ball():
    points = np.random.default_rng(0).uniform(-0.05, 0.05, (3000, 3))
    mesh, half = box(), np.array([0.02, 0.025, 0.03])
    found = surface.signed_distance(surface.prepare(mesh.vertices, mesh.faces), points)
    with jax.enable_x64(True):
        expected = collision._box(jnp.asarray(half)[:, None], jnp.asarray(points.T))[0]
    np.testing.assert_allclose(found, expected, atol=1e-15)
    ball = trimesh.creation.icosphere(3, 0.03)
    found = surface.signed_distance(surface.prepare(ball.vertices, ball.faces), points)
    # 1280 faces with corners up to 0.1 r from their middles lie 0.1^2 / 2 r below the sphere.
    error = found - (np.linalg.norm(points, axis=1) - 0.03)
    assert -1e-12 < error.min() and error.max() < 0.005 * 0.03


def test_exact_distance_is_the_least_over_all_faces():
    """Nothing that the tree leaves out is nearer, inside, outside and in the corner of an L."""
    mesh = bracket()
    prepared = surface.prepare(mesh.vertices, mesh.faces)
    points = np.random.default_rng(1).uniform(-0.02, 0.08, (500, 3))
    found = surface.signed_distance(prepared, points)
    every = np.broadcast_to(np.arange(len(mesh.faces)), (500, len(mesh.faces)))
    least = np.sqrt(surface._squares(prepared, every, points[:, None]).min(1))
    np.testing.assert_allclose(np.abs(found), least, atol=1e-15)
    x, y, z = points.T
    inside = (0 < y) & (y < 0.044) & (0 < x) & (x < 0.064) & (0 < z) & (z < 0.064)
    inside &= (x < 0.022) | (z < 0.022)
    np.testing.assert_array_equal(found < 0, inside)


@pytest.mark.parametrize("bound", [5e-4, 3e-4])
def test_voxel_error_is_what_is_said(bound):
    """On an L, at points that the grid was not chosen by."""
    mesh = bracket()
    built = grid.build(mesh.vertices, mesh.faces, bound)
    assert built.error <= bound < built.worst
    rng = np.random.default_rng(2)
    points, face = trimesh.sample.sample_surface(mesh, 2000, seed=3)[:2]
    points = points + rng.uniform(-0.002, 0.002, (2000, 1)) * mesh.face_normals[face]
    exact = surface.signed_distance(surface.prepare(mesh.vertices, mesh.faces), points)
    error = np.abs(grid.interpolate(built, points) - exact)
    # The quantile of 2000 points scatters by a few per cent.
    assert np.quantile(error, 0.99) < 1.1 * bound and error.max() < 0.6 * built.cell
    # Where the centres of contact spheres are, the distance is smooth: far better than at edges.
    far = points + 0.008 * mesh.face_normals[face]
    exact = surface.signed_distance(surface.prepare(mesh.vertices, mesh.faces), far)
    convex = exact > 0.005  # not in the L's inner corner
    error = np.abs(grid.interpolate(built, far) - exact)[convex]
    assert np.quantile(error, 0.99) < 0.3 * bound


def test_grids_are_stored_and_damaged_files_are_not_used(tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    mesh = box()
    times = itertools.count(0.0, 2.0)  # every call of the clock is two seconds later
    monkeypatch.setattr(grid.time, "perf_counter", lambda: next(times))
    first = grid.cached("key", mesh.vertices, mesh.faces, 2e-3)
    [path] = (tmp_path / "codesign-jax" / "meshes").iterdir()
    monkeypatch.setattr(grid, "build", lambda *_: pytest.fail("built again"))
    again = grid.cached("key", mesh.vertices, mesh.faces, 2e-3)
    np.testing.assert_array_equal(first.values, again.values)
    assert first.cell == again.cell and first.error == again.error
    path.write_bytes(path.read_bytes()[:-100])
    monkeypatch.setattr(grid, "build", lambda *_: first)
    assert grid.cached("key", mesh.vertices, mesh.faces, 2e-3) is first


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


def test_no_unit_fits(tmp_path):
    (problem,) = problems(tmp_path, box(1e6, 1e6, 1e6))
    assert "outside [5, 500] mm" in problem and "looks like" not in problem


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
    with pytest.raises(schema.SceneError) as caught:
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
        "object e: mass of a box is missing",
        "object e: a box has no file",
    ):
        assert sum(expected in p for p in said) == 1, (expected, said)
    assert len(said) == 10


def test_a_surface_that_cuts_through_itself(tmp_path):
    """Two overlapping boxes are watertight and wound alike, but no body."""
    other = box()
    other.apply_translation([0.02, 0.01, 0])
    found = solid(tmp_path, trimesh.util.concatenate([box(), other]), voxel_error=1e-3)
    with pytest.raises(schema.SceneError, match="cuts through itself"):
        _ = found.grid


def test_too_fine_a_grid(tmp_path, monkeypatch):
    monkeypatch.setattr(grid, "MAX_NODES", 1000)
    with pytest.raises(schema.SceneError, match="more than 1,000"):
        _ = solid(tmp_path, box(), voxel_error=1e-3).grid


def test_density_becomes_a_mass(tmp_path):
    box(40, 50, 60).export(tmp_path / "box.stl")
    entry = 'name = "a"; type = "mesh"; file = "box.stl"; unit = "mm"; friction = 0.8; '
    shape = objects.load(object_file(tmp_path, entry + "density = 1000")).object[0]
    assert shape.mass == pytest.approx(0.12) and shape.density is None
    box(4, 5, 6).export(tmp_path / "box.stl")
    with pytest.raises(schema.SceneError, match=r"a: mass = 0.00012\d* is outside"):
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


def test_repair_of_a_good_mesh_changes_nothing(tmp_path):
    mesh = bracket()
    vertices, faces, report = repair.repair(mesh.vertices, mesh.faces)
    assert not report
    np.testing.assert_array_equal(faces, mesh.faces)
    np.testing.assert_array_equal(vertices, mesh.vertices)
    inverted = trimesh.Trimesh(mesh.vertices, mesh.faces[:, ::-1])
    assert solid(tmp_path, inverted, repaired=True).repairs == (
        "turned 20 of 20 faces, so that all point outwards",
    )


def test_what_cannot_be_repaired_is_still_refused(tmp_path):
    """Two boxes that share an edge: four faces meet there, and no order of them is right."""
    other = box()
    other.apply_translation([0.04, 0.05, 0])
    said = problems(tmp_path, trimesh.util.concatenate([box(), other]), repaired=True)
    assert any("more than two faces; even after the repair" in p for p in said)


def test_users_are_told_of_repairs_and_errors(tmp_path):
    mesh = box(40, 50, 60)
    trimesh.Trimesh(mesh.vertices, mesh.faces[:, ::-1]).export(tmp_path / "inverted.off")
    entry = 'name = "a"; type = "mesh"; file = "inverted.off"; unit = "mm"; mass = 0.1; '
    path = object_file(tmp_path, entry + "friction = 1; repair = true; voxel_error = 0.001")
    notes = common.mesh_notes(scene.load("paper", object_set=path))
    assert notes[0] == "object a: turned 12 of 12 faces, so that all point outwards"
    assert notes[1].startswith("object a: distances on 2.5 mm cells, error near the surface")


# --- the household set ---------------------------------------------------------------------------


@pytest.fixture(scope="module")
def household():
    return objects.load("household").object


def test_household_shapes(household):
    assert {shape.name for shape in household} == HOUSEHOLD
    for shape in household:
        # A hand that opens to some 120 mm holds 50 to 70 mm across; nothing is longer than 90 mm.
        assert 0.02 < min(shape.half_sizes) * 2 and max(shape.half_sizes) * 2 < 0.095
        assert shape.mesh.path.stat().st_size < 100_000 and not shape.mesh.repairs
        assert shape.mass == 0.1


def test_household_is_what_its_script_makes(tmp_path, household):
    script = [sys.executable, str(ROOT / "scripts" / "make_objects.py"), "--out", str(tmp_path)]
    subprocess.run(script, check=True, capture_output=True)
    toml = ROOT / "objects" / "household.toml"
    assert (tmp_path / "household.toml").read_text() == toml.read_text()
    for shape in household:
        made = trimesh.load_mesh(tmp_path / shape.file)
        kept = trimesh.load_mesh(shape.mesh.path)
        # Sines may differ in their last digit between machines; STL rounds to 1e-7 of the size.
        np.testing.assert_allclose(made.vertices, kept.vertices, atol=1e-4)
        np.testing.assert_array_equal(made.faces, kept.faces)


def test_household_distances_in_lanes(household):
    """The jitted interpolation against the exact distance of every mesh, a world each."""
    the_scene = scene.load("paper", object_set="household")
    count = len(household)
    shape = jnp.arange(count)[None]
    size = 1.03 * np.array([s.half_sizes for s in household]).T[:, None]
    rng = np.random.default_rng(4)
    points = np.stack([s.mesh.vertices[rng.integers(len(s.mesh.vertices), size=200)]
                       for s in household], -1).swapaxes(0, 1)  # fmt: skip
    points = 1.03 * (points + rng.normal(scale=0.005, size=points.shape))
    lanes = mesh_lanes.mesh_lanes(the_scene, shape, jnp.asarray(size, jnp.float32))
    distance, gradient = jax.jit(mesh_lanes.signed_distance)(lanes, jnp.asarray(points))
    np.testing.assert_allclose(jnp.linalg.norm(gradient, axis=0), 1.0, atol=1e-5)
    for i, s in enumerate(household):
        prepared = surface.prepare(s.mesh.vertices, s.mesh.faces)
        exact = 1.03 * surface.signed_distance(prepared, points[..., i].T / 1.03)
        error = np.abs(distance[:, i] - exact)
        # Points are around vertices, so often at edges, where half a cell is the limit.
        assert np.quantile(error, 0.9) < 5e-4 and error.max() < 0.6 * s.mesh.grid.cell, s.name
        away = exact > 0.004
        step = points[..., i].T + 1e-4 * np.asarray(gradient[..., i]).T
        slope = (1.03 * surface.signed_distance(prepared, step / 1.03) - exact) / 1e-4
        assert np.median(slope[away]) > 0.99, s.name  # it is the way out


def test_support_points_carry_the_lowest(household):
    """Whatever the pose, the four points include the lowest of the mesh, up to the selection."""
    the_scene = scene.load("paper", object_set="household")
    poses = Rotation.from_rotvec(np.random.default_rng(5).normal(size=(40, 3))).as_matrix()
    points = jax.jit(mesh_lanes.table_points)
    for i, s in enumerate(household):
        size = jnp.asarray(np.tile(np.array(s.half_sizes)[:, None, None], (1, 1, 40)))
        lanes = mesh_lanes.mesh_lanes(the_scene, jnp.full((1, 40), i), size)
        columns = jnp.asarray(poses.transpose(2, 1, 0))
        found = np.asarray(points(lanes, columns))
        lowest = (s.mesh.vertices @ poses.transpose(0, 2, 1))[..., 2].min(1)
        assert (found[2].min(0) - lowest < 8e-4).all(), s.name


# --- scenes --------------------------------------------------------------------------------------


def test_engines_that_cannot_say_so():
    the_scene = scene.load("paper", object_set="household")
    for name in ("mujoco", "mjx"):
        with pytest.raises(schema.SceneError) as caught:
            make_engine(name, the_scene)
        assert len(caught.value.problems) == 8
        assert f"not supported by engine {name}: object 'mug' is a mesh" in str(caught.value)


def test_a_scene_carries_its_meshes(tmp_path):
    the_scene = scene.load("paper", object_set="household")
    scene_files.write_scene(the_scene, tmp_path)  # reads it back and compares
    again = scene.load(tmp_path / "scene.toml")
    assert again == the_scene and hash(again) == hash(the_scene)
    assert again.objects.object[0].mesh.path.parent == tmp_path / "meshes"
    mine = the_scene.objects.object[0]
    other = dataclasses.replace(mine, mesh=the_scene.objects.object[1].mesh)
    assert other != mine


def test_pictures_show_the_mesh_where_it_is():
    the_scene = scene.load("paper", object_set="household", hand_name=DATA / "pinch.toml")
    params, trial = hand_world(the_scene)
    index = [s.name for s in the_scene.objects.object].index("mug")
    trial = still(index)._replace(size=np.array(1.1), yaw=np.array(0.3))
    compiled = model.compile_model(the_scene, params, trial, visual=True)
    (wires,) = sketch._outline(the_scene, compiled, index)
    mug = the_scene.objects.object[index].mesh
    low, high = np.nanmin(wires, 0), np.nanmax(wires, 0)
    np.testing.assert_allclose(low, 1.1 * mug.vertices.min(0), atol=1e-6)
    np.testing.assert_allclose(high, 1.1 * mug.vertices.max(0), atol=1e-6)
    data = mujoco.MjData(compiled)
    mujoco.mj_kinematics(compiled, data)
    body = model.layout(the_scene).object
    world = wires @ data.xmat[body].reshape(3, 3).T + data.xpos[body]
    assert np.nanmin(world[:, 2]) == pytest.approx(0.0, abs=1e-6)  # it stands on the table, upright
    assert np.nanmax(world[:, 2]) == pytest.approx(1.1 * 0.066, abs=1e-5)


# --- rollouts ------------------------------------------------------------------------------------

# A grasp in 1.3 s with few links and contacts: what is compared is the object's side of them.
HURRIED = {
    "discretization": {"links": 2},
    "effects": {"twist": False, "palm_contact": False, "finger_table": False, "disturb": False}
    | {"ungrasp": False},
    "phases": {"approach": 0.5, "inflate": 0.8, "lift": 1.3},
}


@pytest.fixture(scope="module")
def grasps(tmp_path_factory, household):
    """Two fingers grasp primitives, their meshed twins and the household's shapes, in one batch.

    Returns:
      Names; the trace of the batch and of the same worlds in reverse; how often it compiled.
    """
    folder = tmp_path_factory.mktemp("objects")
    box(60, 60, 60).export(folder / "box.stl")
    trimesh.creation.icosphere(4, 30).export(folder / "ball.stl")
    files = {"mesh box": folder / "box.stl", "mesh ball": folder / "ball.stl"}
    files |= {shape.name: shape.mesh.path for shape in household}
    common = "mass = 0.1; friction = 0.8"
    path = object_file(
        folder,
        f'name = "box"; type = "box"; size = [0.03, 0.03, 0.03]; {common}',
        f'name = "ball"; type = "sphere"; size = [0.03]; {common}',
        *(f'name = "{n}"; type = "mesh"; file = "{f}"; unit = "mm"; {common}'
          for n, f in files.items()),
    )  # fmt: skip
    the_scene = scene.load(
        "paper", hand_name=DATA / "pinch.toml", object_set=path, overrides=HURRIED
    )
    space = parameters.design_space(the_scene.hand, "2d")
    params = space.params(jnp.asarray((0.09, 0.05)))
    params = params._replace(pressure=params.pressure * 0 + 190e3)
    names = [shape.name for shape in the_scene.objects.object]
    size = {"size": np.float32(1.04), "yaw": np.float32(0.1)}
    trials = [still(i)._replace(**size) for i in range(len(names))]
    engine = make_engine("structured", the_scene)
    run = jax.jit(
        lambda p, t: rollout.simulate(the_scene, engine, p, t, trajectory=True)[1],
        # Compiling takes longer than all that is done with it here.
        compiler_options={"xla_backend_optimization_level": 0},
    )
    worlds = stack(*([params] * len(names)))
    traces = [nth(run(worlds, stack(*order)), ...) for order in (trials, trials[::-1])]
    return names, *traces, run._cache_size()


def test_primitives_and_meshes_share_a_batch_and_a_program(grasps):
    _, trace, other, compiled = grasps
    assert compiled == 1
    for a, b in zip(trace, other, strict=True):
        np.testing.assert_array_equal(a[::-1], b)  # worlds do not mix


def test_a_meshed_primitive_behaves_like_the_primitive(grasps):
    names, trace, *_ = grasps
    at, height, rest = names.index, trace.height, slice(0, 50)
    # On the table the same four corners carry both boxes: float32 rounding of 31 mm.
    np.testing.assert_allclose(height[at("mesh box"), rest], height[at("box"), rest], atol=1e-7)
    assert height[at("box"), -1] > 0.05  # it was lifted
    # Held, they differ by what the grid makes of the box's edges; 0.1 mm measured at the most.
    position = trace.qpos[..., -7:-4]
    np.testing.assert_allclose(position[at("mesh box")], position[at("box")], atol=5e-4)
    # A ball of facets stands on corners of them instead of on its lowest point.
    assert np.abs(height[at("mesh ball"), rest] - height[at("ball"), rest]).max() < 5e-4


def test_every_shape_stands_where_it_was_put(grasps):
    """Upright and still on the table, and finite while a hand that may not hold it grasps at it."""
    names, trace, *_ = grasps
    assert np.isfinite(trace.distance).all() and (trace.speed < 60).all()
    for i, name in enumerate(names):
        sunk = trace.height[i, 0] - trace.height[i, 45]
        # One to four contacts of 4 kN/m, and half a millimetre for what a selection of support
        # points cuts off round shapes.
        assert 0.0 < sunk < 0.1 * 9.81 / 4000 + 5e-4, name
        moved = trace.qpos[i, 45, -7:-5] - trace.qpos[i, 0, -7:-5]
        # A ball of facets rolls onto one: its 256 support points are 7 mm apart.
        assert np.abs(moved).max() < (4e-3 if name == "mesh ball" else 1e-3), name
