"""The rollout kernel: assembly, equality with MuJoCo C, and worlds that share a block."""

import dataclasses

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from codesign_jax import model
from codesign_jax.compiler import gpu, launch, thread, vector
from codesign_jax.engines import make_engine
from codesign_jax.engines.structured import StructuredEngine
from codesign_jax.engines.structured.kernel import Limits, Program
from codesign_jax.engines.structured.world_model import world_constants
from codesign_jax.preflight import invalid_start
from codesign_jax.types import Status
from tests.helpers import grasps, oracles

pytestmark = pytest.mark.usefixtures("optimized_kernels")


@pytest.fixture(scope="module")
def grasp():
    """A pinch scene, three random worlds of it and controls: the number of steps is a kernel's."""
    scene = grasps.pinch("cylinder", links=2)
    params, trials = grasps.random_worlds(scene, 3, 3)
    fields, ctrl = grasps.batch_inputs(scene, params, trials)
    return scene, fields, jnp.asarray(np.asarray(ctrl[:, :230]))


@pytest.mark.slow  # 5 s each; `.ci/run` has NVIDIA's assembler take the default scene's kernels
@pytest.mark.parametrize(
    "effects",
    [
        {},
        {"neo_hookean": True, "wrist": False, "surface": "hull", "finger_finger": True},
        {"friction": "none", "wrist": False},
    ],
)
def test_kernel_becomes_ptx(effects, monkeypatch):
    """Every operation of the kernel has its instruction; with effects in float64."""
    texts = []

    def register(origin, trace, layout, *, keep):
        texts.append(thread.assembly(gpu.block_code(trace(), layout)))
        return "registered"

    monkeypatch.setattr(gpu, "register", register)
    monkeypatch.setattr(launch, "available", lambda platform: None)
    scene = grasps.pinch("cylinder", links=2, **{f"effects__{k}": v for k, v in effects.items()})
    width = 16 if effects else 32  # half a warp takes part, or all of it
    program = Program(scene, Limits(8, 8, 1e-6), width=width)
    engine = StructuredEngine(scene)

    def run(params, trials):
        f, c = grasps.batch_inputs(scene, params, trials)
        return program.simulate(
            world_constants(scene, f), engine.reset(f), c[:, :20], trajectory=bool(effects)
        )

    with jax.enable_x64(bool(effects)):
        worlds = grasps.random_worlds(scene, 3, 3)
        text = jax.jit(run).trace(*worlds).lower(lowering_platforms=("cuda",)).as_text()
    (code,) = texts
    used, other = ("f64", "f32") if effects else ("f32", "f64")
    assert "@registered" in text and f".entry {gpu.ENTRY}(" in code
    assert f".maxntid {width}" in code and (", 65535;" if effects else ", -1;") in code
    assert f"fma.rn.{used}" in code and f".{other}" not in code


COUNT = 48  # states that are stepped at once


@pytest.fixture(scope="module")
def stepped(grasp):
    """One step of as many worlds in float32: qvel after it, and what is left of the problem."""
    scene, *_ = grasp
    engine = StructuredEngine(scene, iterations=60, evaluations=12, tolerance=1e-10)

    @jax.jit
    def run(fields, qpos, qvel, ctrl):
        start = engine.state_at(engine.reset(fields), qpos, qvel)
        outputs, new = engine.advance(world_constants(scene, fields), start, ctrl[:, None])
        return engine.qvel(new), outputs["decrement"].T

    return run


def by_mujoco(scene, fields, *states):
    """Accelerations of a world in states of qpos, qvel and ctrl, and numbers of contacts."""
    data = mujoco.MjData(compiled := oracles.exact(scene, fields))
    accelerations = []
    for state in zip(*states, strict=True):
        data.qpos[:], data.qvel[:], data.ctrl[:] = state
        mujoco.mj_forward(compiled, data)
        accelerations.append((data.qacc.copy(), data.ncon))
    return map(np.array, zip(*accelerations, strict=True))


def test_float32_is_close_to_mujoco_in_contact(grasp, stepped):
    """The frame at the object keeps float32 velocities within 1e-4 of float64's in contact.

    The palm at 50 to 70 mm presses the straight fingers onto the table.
    """
    scene, fields, ctrl = grasp
    world_fields = grasps.nth(fields, 0)
    qpos = np.repeat(world_fields.start[None].astype(np.float32), COUNT, 0)
    qpos[:, 2] = np.linspace(0.05, 0.07, COUNT)
    u = np.repeat(np.asarray(ctrl[:1, 150]), COUNT, 0)
    still = np.zeros((COUNT, qpos.shape[1] - 1), np.float32)
    after, residual = stepped(grasps.repeat(world_fields, COUNT), qpos, still, u)
    assert float(residual.max()) < 1e-6
    acc, touching = by_mujoco(scene, world_fields, qpos, still, u)
    error = np.linalg.norm(after / scene.discretization.timestep - acc, axis=1)
    assert (error < 1e-4 * np.linalg.norm(acc, axis=1)).all(), error
    assert min(touching) > 4  # more than the object on the table


def test_in_float32_an_object_moves_as_in_float64_under_a_far_hand(grasp, stepped):
    """It slides and spins on the table; the hand hangs 2 m above and touches nothing.

    Friction holds the object as with some hundred kg.  With spatial quantities about the palm that
    would be a moment of inertia which hides the object's own 1e-4 kg m^2 (see `kinematics`): the
    largest error was 0.16 then and is 6e-6 about the object's centre.  In a grasp the palm is 0.1 m
    away, but many contacts of light fingers have the same effect.
    """
    scene, fields, ctrl = grasp
    count = COUNT
    random = np.random.default_rng(0)
    world_fields = grasps.nth(fields, 0)
    ratio = np.float32(30)  # as in the scene `paper`
    contact = dataclasses.replace(world_fields.constants.contact, friction_ratio=ratio)
    constants = dataclasses.replace(world_fields.constants, contact=contact)
    world_fields = world_fields._replace(constants=constants)
    qpos, qvel = (
        np.zeros((count, n)) for n in (world_fields.start.size, world_fields.start.size - 1)
    )
    qpos = qpos + world_fields.start
    u = np.repeat(np.asarray(ctrl[:1, 0]), count, 0)
    qpos[:, 2], qpos[:, -5] = 2.0, qpos[:, -5] - random.uniform(1e-5, 5e-4, count)
    qvel[:, -6:] = random.normal(size=(count, 6)) * [0.1, 0.1, 0.05, 2, 2, 2]
    u[:, :6] = qpos[:, :6]
    qpos, qvel, u = (v.astype(np.float32) for v in (qpos, qvel, u))
    after = np.asarray(stepped(grasps.repeat(world_fields, count), qpos, qvel, u)[0])
    acc = (after.astype(float) - qvel) / scene.discretization.timestep
    expected, touching = by_mujoco(scene, world_fields, qpos, qvel, u)
    accelerations, expected = (v[:, -6:].reshape(-1, 2, 3) for v in (acc, expected))
    errors = np.linalg.norm(accelerations - expected, axis=2) / np.linalg.norm(expected, axis=2)
    # Between both, by a factor of more than a hundred.
    assert errors.max() < 1e-3 and touching.min() > 0


@pytest.mark.slow  # 6 s
def test_neighbours_in_a_block_change_no_bit(grasp):
    """A world's numbers are the same whatever worlds share its vector."""
    scene, fields, ctrl = grasp
    run = jax.jit(StructuredEngine(scene).rollout)
    orders = [np.array(o) for o in ([0, 1, 2], [2, 0, 1], [0, 0, 0], [1, 2, 2])]
    alone = run(fields, ctrl)
    for order in orders:
        mixed = run(jax.tree.map(lambda v, o=order: v[o], fields), ctrl[order])
        for name in ("distance", "height", "speed", "status"):
            want = np.asarray(getattr(alone, name))[order]
            np.testing.assert_array_equal(getattr(mixed, name), want, err_msg=name)


def test_neighbours_of_a_failing_world_are_bitwise_unaffected(grasp):
    """A finger of the world in the middle is blown up; it keeps its last good state."""
    scene, fields, ctrl = grasp
    run = jax.jit(StructuredEngine(scene).rollout)
    good = run(fields, ctrl)
    bad = run(fields, ctrl.at[1, 20:, 6].set(1e12))
    for index in (0, 2):
        for a, b in zip(*map(jax.tree.leaves, (good, bad)), strict=True):
            np.testing.assert_array_equal(a[index], b[index])
    result = grasps.outcomes(scene, bad)
    assert int(result.status[1]) & (Status.SPEED | Status.NONFINITE)
    assert 20 < int(result.bad_step[1]) < 25
    end = model.split(scene, bad.last[1])
    assert np.isfinite(end.qpos).all() and np.abs(end.qvel).max() <= scene.limits.speed


def test_a_kernel_is_traced_once(grasp, monkeypatch):
    """The second program of a scene finds its machine code; other limits are another kernel."""
    scene, fields, ctrl = grasp
    first = jax.jit(StructuredEngine(scene).rollout)(fields, ctrl)
    monkeypatch.setattr(vector, "write", lambda *_: pytest.fail("written again"))
    again = jax.jit(StructuredEngine(scene).rollout)(fields, ctrl)
    np.testing.assert_array_equal(first.distance, again.distance)
    with pytest.raises(pytest.fail.Exception, match="written again"):
        jax.jit(StructuredEngine(scene, tolerance=1e-5).rollout)(fields, ctrl)


def test_a_device_without_kernels_is_told_of_other_engines(grasp, monkeypatch):
    """An error with the reason, as the engine is made or, found later, at the call."""
    scene, fields, ctrl = grasp
    engine = StructuredEngine(scene)

    def refuse(*_):
        raise launch.KernelUnavailable("XLA refused")

    monkeypatch.setattr(launch, "describe", refuse)
    with pytest.raises(launch.KernelUnavailable, match="XLA refused; engine mjx runs on every"):
        jax.eval_shape(engine.rollout, fields, ctrl)
    monkeypatch.setattr(launch, "available", lambda platform: "no compiler")
    with pytest.raises(launch.KernelUnavailable, match="no compiler; engine mjx runs on every"):
        make_engine("structured", scene)
    # What other engines need of this one's physics needs no kernel.
    jax.eval_shape(lambda f: invalid_start(scene, f), fields)
