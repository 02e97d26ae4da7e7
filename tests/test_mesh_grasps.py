"""The household set and other meshes in scenes: distances in lanes, pictures, grasps."""

import dataclasses
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
from solids import box, object_file

from codesign_jax import model, objects, parameters, rollout, scene, schema
from codesign_jax.engines import make_engine
from codesign_jax.engines.structured import mesh as mesh_lanes
from codesign_jax.meshes import surface
from codesign_jax.report import sketch
from codesign_jax.runs import scene_files

ROOT = Path(__file__).parent.parent
HOUSEHOLD = {
    "capsule", "cone", "torus", "ring_segment", "mug", "bottle", "superquadric", "bracket"
}  # fmt: skip


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
    "effects": {
        "twist": False,
        "palm_object": False,
        "palm_table": False,
        "finger_table": False,
        "disturb": False,
    }
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
