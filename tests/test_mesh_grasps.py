"""The household set and other meshes in scenes: distances in lanes, pictures, grasps."""

import dataclasses
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
import trimesh

from codesign_jax import scene
from codesign_jax.engines import make_engine
from codesign_jax.engines import mujoco as mujoco_engine
from codesign_jax.engines.structured import StructuredEngine
from codesign_jax.engines.structured.laws import meshes as mesh_lanes
from codesign_jax.runs import scene_files
from codesign_jax.scene import objects, parameters, schema
from codesign_jax.scene.meshes import surface
from tests.helpers import oracles
from tests.helpers.grasps import DATA, batch_inputs, nth, stack, still, world_inputs
from tests.helpers.solids import box, object_file

# --- the household set ---------------------------------------------------------------------------


@pytest.fixture(scope="module")
def household():
    return objects.load("household").object


def test_household_distances_in_lanes(household):
    """The jitted interpolation against the exact distance of every mesh, a world each."""
    the_scene = scene.load("paper_spheres", object_set="household")
    count = len(household)
    shape = jnp.arange(count)[None]
    size = 1.03 * np.array([s.half_sizes for s in household]).T[:, None]
    rng = np.random.default_rng(4)
    points = np.stack([s.mesh.vertices[rng.integers(len(s.mesh.vertices), size=80)]
                       for s in household], -1).swapaxes(0, 1)  # fmt: skip
    points = 1.03 * (points + rng.normal(scale=0.005, size=points.shape))
    lanes = mesh_lanes.mesh_lanes(the_scene, shape, jnp.asarray(size, jnp.float32))
    distance, gradient = jax.jit(mesh_lanes.signed_distance)(lanes, jnp.asarray(points))
    np.testing.assert_allclose(jnp.linalg.norm(gradient, axis=0), 1.0, atol=1e-5)
    for i, s in enumerate(household):
        body = s.mesh.vertices, s.mesh.faces
        exact = 1.03 * surface.signed_distance(*body, points[..., i].T / 1.03)
        error = np.abs(distance[:, i] - exact)
        # Points are around vertices, so often at edges, where half a cell is the limit.
        assert np.quantile(error, 0.9) < 5e-4 and error.max() < 0.6 * s.mesh.grid.cell, s.name
        away = exact > 0.004
        step = points[..., i].T + 1e-4 * np.asarray(gradient[..., i]).T
        slope = (1.03 * surface.signed_distance(*body, step / 1.03) - exact) / 1e-4
        assert np.median(slope[away]) > 0.99, s.name  # it is the way out


# --- scenes --------------------------------------------------------------------------------------


def test_engines_that_cannot_say_so():
    the_scene = scene.load("paper_spheres", object_set="household")
    for name in ("mujoco", "mjx"):
        with pytest.raises(schema.InputError) as caught:
            make_engine(name, the_scene)
        assert len(caught.value.problems) == 8
        assert f"not supported by engine {name}: object 'mug' is a mesh" in str(caught.value)


def test_a_scene_carries_its_meshes(tmp_path):
    the_scene = scene.load("paper_spheres", object_set="household")
    scene_files.write_scene(the_scene, tmp_path)  # reads it back and compares
    again = scene.load(tmp_path / "scene.toml")
    assert again == the_scene and hash(again) == hash(the_scene)
    assert repr(again.structure) == repr(the_scene.structure)  # a run's kernel is found again
    assert again.objects.object[0].mesh.path.parent == tmp_path / "meshes"
    mine = the_scene.objects.object[0]
    other = dataclasses.replace(mine, mesh=the_scene.objects.object[1].mesh)
    assert other != mine


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


class Grasps(NamedTuple):
    """Grasps of a batch, in float64 and solved to rounding.

    Attributes:
      params: Params of all worlds.
      trials: The trial of each world.
      names: Name of the object of each world.
      path: What the kernel makes of them, and behind them of the same worlds in reverse.
      unbalanced: Forces that the kernel leaves unbalanced, see `oracles.unbalanced`.
    """

    params: Any
    trials: list
    names: list[str]
    path: oracles.Path
    unbalanced: np.ndarray


@pytest.fixture(scope="module")
def grasps(tmp_path_factory, household):
    """Two fingers grasp primitives, their meshed twins and a mug, in one batch."""
    folder = tmp_path_factory.mktemp("objects")
    box(60, 60, 60).export(folder / "box.stl")
    trimesh.creation.icosphere(4, 30).export(folder / "ball.stl")
    files = {"mesh box": folder / "box.stl", "mesh ball": folder / "ball.stl"}
    files |= {s.name: s.mesh.path for s in household if s.name == "mug"}
    common = "mass = 0.1; friction = 0.8"
    path = object_file(
        folder,
        f'name = "box"; type = "box"; size = [0.03, 0.03, 0.03]; {common}',
        f'name = "ball"; type = "sphere"; size = [0.03]; {common}',
        *(f'name = "{n}"; type = "mesh"; file = "{f}"; unit = "mm"; {common}'
          for n, f in files.items()),
    )  # fmt: skip
    the_scene = scene.load(
        "paper_spheres", hand_name=DATA / "pinch.toml", object_set=path, overrides=HURRIED
    )
    names = [shape.name for shape in the_scene.objects.object]
    with jax.enable_x64(True):
        params = nth(
            parameters.design_space(the_scene.hand, "2d").params(jnp.array((0.09, 0.05))), ...
        )
    params = params._replace(pressure=params.pressure * 0 + 190e3)
    yaws = [(i, 0.1) for i in range(len(names))]
    # Once more with the mug's handle between the fingers.
    yaws.append((names.index("mug"), 0.1 + np.pi / 2))
    trials = [still(i)._replace(size=np.array(1.04), yaw=np.array(yaw)) for i, yaw in yaws]

    names.append("turned mug")
    count, both = len(trials), [*trials, *trials[::-1]]
    engine = StructuredEngine(the_scene, iterations=100, evaluations=40, tolerance=1e-24)
    with jax.enable_x64(True):
        fields, ctrl = batch_inputs(the_scene, stack(*[params] * len(both)), stack(*both))
        path = oracles.path(engine, fields, ctrl)
        # Without the start: there an object stands on the table with no gap, and rounding decides
        # whether it touches.
        later = oracles.Path(*(v[:count, 1:] for v in path))
        fields, ctrl = nth((fields, ctrl), slice(count))
        left = oracles.unbalanced(the_scene, fields, ctrl[:, 1:], later, 10)
    return Grasps(params, trials, names, path, left)


def test_primitives_and_meshes_share_a_batch_and_a_program(grasps):
    """In the kernel's blocks of a few worlds, whose other worlds change no bit of a world."""
    for value in grasps.path:
        one, reverse = np.split(value, 2)
        np.testing.assert_array_equal(one[::-1], reverse)


def test_the_kernel_balances_all_forces_on_meshes(grasps):
    """Along a grasp of primitives and meshes, one of them by its handle: MuJoCo C has no such.

    The forces are those of contacts that plain JAX finds on the same grids.
    """
    qpos = grasps.path.qpos
    assert qpos.dtype == np.float64
    upright, turned = (grasps.names.index(name) for name in ("mug", "turned mug"))
    touched = np.abs(qpos[upright] - qpos[turned])[:, 6:-7].max()
    assert touched > 0.05  # the handle made a difference to the fingers, radians
    # A decrement of 1e-24 is an error of 1e-12 as the whole problem measures it; what is lost are
    # digits of the largest forces on a body that nearly cancel.
    assert grasps.unbalanced.max() < 1e-8


def test_accelerations_of_a_meshed_box_equal_mujoco(grasps, tmp_path):
    """MuJoCo C has no meshes that are not convex: it gets the box as a primitive of the same size.

    At the states that the kernel went through; its accelerations are differences of them.
    """
    common = "mass = 0.1; friction = 0.8"
    path = object_file(tmp_path, f'name = "box"; type = "box"; size = [0.03, 0.03, 0.03]; {common}')
    twin = scene.load(
        "paper_spheres", hand_name=DATA / "pinch.toml", object_set=path, overrides=HURRIED
    )
    world = grasps.names.index("mesh box")
    trial = grasps.trials[world]._replace(shape=np.int32(0))
    with jax.enable_x64(True):
        fields, ctrl = world_inputs(twin, grasps.params, trial)
        oracle = mujoco_engine.world_model(twin, fields)
    oracle.opt.tolerance, oracle.opt.iterations, oracle.opt.ls_iterations = 0.0, 200, 50
    data, h, qpos = mujoco.MjData(oracle), oracle.opt.timestep, grasps.path.qpos[world]
    speed, contacts = np.zeros((len(qpos) - 1, oracle.nv)), set()
    for k in range(len(speed)):
        mujoco.mj_differentiatePos(oracle, speed[k], h, qpos[k], qpos[k + 1])
    for k in range(1, len(speed)):
        data.qpos[:], data.qvel[:], data.ctrl[:] = qpos[k], speed[k - 1], ctrl[k]
        mujoco.mj_forward(oracle, data)
        error = np.linalg.norm((speed[k] - speed[k - 1]) / h - data.qacc)
        # The grid's distances are float32: 2e-9 m at 30 mm, of the 1e-3 m that the fingers press
        # in; 1e-7 measured.
        assert error < 1e-6 * max(np.linalg.norm(data.qacc), 100.0), k
        contacts.add(data.ncon)
    assert contacts >= {4, 6}  # on the table, and there between two fingers
