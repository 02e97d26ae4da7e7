"""The default engine under JAX's transformations, and what a trace means on every engine."""

from functools import partial

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from codesign_jax import codesign, control, cost, model, parameters, rollout
from codesign_jax.engines.mujoco import MujocoEngine, world_model
from codesign_jax.engines.structured import StructuredEngine
from codesign_jax.optimize import schedule
from codesign_jax.types import WARNINGS
from tests import small, toy

# A grasp in 1.2 s with few contacts: what is tested here does not depend on them.
SHORT = {
    "links": 2,
    "effects__palm_object": False,
    "effects__palm_table": False,
    "effects__finger_table": False,
    "effects__disturb": False,
    "effects__ungrasp": False,
    "phases__approach": 0.3,
    "phases__inflate": 0.5,
    "phases__lift": 1.2,
}


@pytest.fixture(scope="module")
def batch():
    """A short grasp, fields and controls of four random worlds."""
    scene = small.pinch("sphere", **SHORT)
    both = jax.jit(
        jax.vmap(lambda p, t: (model.model_fields(scene, p, t), control.commands(scene, p, t)))
    )
    return scene, *both(*small.random_worlds(scene, 3, 4))


def test_vmap_is_a_larger_batch(batch):
    """Nested, over axes in any place, and with controls that all share: the same bits."""
    scene, fields, ctrl = batch
    engine = StructuredEngine(scene)
    want = jax.jit(engine.rollout)(fields, ctrl)
    two = jax.tree.map(lambda v: v.reshape(2, 2, 1, *v.shape[1:]), (fields, ctrl))
    nested = jax.jit(jax.vmap(jax.vmap(engine.rollout)))(*two)
    moved = jnp.moveaxis(two[1], 0, 3)
    mixed = jax.jit(jax.vmap(jax.vmap(engine.rollout), in_axes=(0, 3)))(two[0], moved)
    for name in ("distance", "height", "speed", "status", "last"):
        expected = np.asarray(getattr(want, name))
        for got in (nested, mixed):
            found = np.asarray(getattr(got, name)).reshape(expected.shape)
            np.testing.assert_array_equal(found, expected, err_msg=name)
    shared = jax.jit(jax.vmap(engine.rollout, in_axes=(0, None)))(
        jax.tree.map(lambda v: v[:, None], fields), ctrl[:1]
    )
    alone = jax.jit(engine.rollout)(fields, jnp.repeat(ctrl[:1], 4, 0))
    np.testing.assert_array_equal(shared.distance[:, 0], alone.distance)


# Compiling the batch form takes longer than all that is done with it here.
QUICK = {"xla_backend_optimization_level": 0}


def engines(scene):
    """Every way to simulate but stock MJX, whose compile takes longer than all of these tests."""
    kernel, plain = (StructuredEngine(scene, kernel=k, tolerance=1e-16) for k in (True, False))
    return {"kernel": kernel, "batch": plain, "mujoco": MujocoEngine(scene, num_threads=1)}


@pytest.fixture(scope="module")
def decided():
    """Traces of every engine, without and with a trajectory, of a lost and of failing worlds.

    The hand of world 0 stays above the object, which is lost as the window opens, and rises on;
    world 1 starts below the table; a pressure of world 2 is not a number from step 10 on.
    """
    scene = small.pinch("sphere", **SHORT, effects__finger_object=False, effects__twist=False)
    with jax.enable_x64(True):
        params, trials = small.random_worlds(scene, 3, 3)
        fields, ctrl = jax.vmap(
            lambda p, t: (model.model_fields(scene, p, t), control.commands(scene, p, t))
        )(params, trials)
        ctrl = ctrl.at[0, :, 2].set(jnp.linspace(0.3, 0.4, ctrl.shape[1]))
        ctrl = ctrl.at[2, 10:, 6].set(jnp.nan)
        fields = fields._replace(start=fields.start.at[1, -5].set(-0.05))
        found = {
            (name, trajectory): jax.tree.map(
                np.asarray,
                jax.jit(partial(e.rollout, trajectory=trajectory), compiler_options=QUICK)(
                    fields, ctrl
                ),
            )
            for name, e in engines(scene).items()
            for trajectory in (False, True)
        }
        outcomes = {
            k: jax.tree.map(np.asarray, jax.vmap(lambda t: cost.outcome(scene, t))(v))
            for k, v in found.items()
        }
    return scene, found, outcomes


@pytest.mark.parametrize("trajectory", [False, True])
def test_a_trace_means_the_same_on_every_engine(decided, trajectory):
    """Where worlds are decided, what later entries show, and the state in which they stay."""
    scene, found, outcomes = decided
    first, end = round(scene.window[0] / 0.01), scene.num_steps
    want = found["mujoco", trajectory]
    lost_at = 0.01 * first
    assert outcomes["mujoco", trajectory].lost_time[0] == pytest.approx(lost_at)
    assert outcomes["mujoco", trajectory].bad_step.tolist() == [-1, 0, 11]
    for name in ("kernel", "batch"):
        for a, b in zip(outcomes[name, trajectory], outcomes["mujoco", trajectory], strict=True):
            np.testing.assert_allclose(a, b, err_msg=name)
        got = found[name, trajectory]
        for field in ("distance", "height", "speed", "qpos", "last"):
            # No contact but the object's with the table, where MuJoCo stops at its tolerance.
            a, b = getattr(got, field), getattr(want, field)
            np.testing.assert_allclose(a, b, atol=1e-6, err_msg=f"{name} {field}")
    for trace in (found[name, trajectory] for name in ("kernel", "batch", "mujoco")):
        rest = trace.distance[0, first:]
        if trajectory:
            assert rest[-1] - rest[0] > 0.03 and trace.qpos.shape[1] == end
            np.testing.assert_array_equal(
                trace.qpos[2, 10:], trace.qpos[2, 10:11].repeat(end - 10, 0)
            )
        else:
            np.testing.assert_array_equal(rest, rest[0])
        np.testing.assert_array_equal(trace.height[1], trace.height[1, 0])
        assert np.isnan(trace.speed[2, 11:]).all() and np.isfinite(trace.last).all()


def test_a_trajectory_changes_no_outcome(decided):
    _, _, outcomes = decided
    for name in ("kernel", "batch", "mujoco"):
        for a, b in zip(outcomes[name, False], outcomes[name, True], strict=True):
            np.testing.assert_array_equal(a, b)


# --- a whole optimisation as one program ---------------------------------------------------------


def test_a_run_is_the_loop_of_its_episodes_and_vmaps_over_seeds():
    """By the kernel, bit for bit; each seed of a batch as alone, with its own schedule.

    One episode alone maps as well.
    """
    scene = small.pinch("sphere", **SHORT)
    space = parameters.design_space(scene.hand, "2d")
    optimizer, engine = codesign.make_filter(space), StructuredEngine(scene)
    episode = codesign.make_episode(scene, engine, space, optimizer, 2)
    run = codesign.make_run(scene, engine, space, optimizer, 2)
    seeds = [(0, (0.1, 0.05), "concurrent"), (7, (0.09, 0.03), "control")]
    starts = [optimizer.init(jax.random.key(k), np.array(d), 3) for k, d, _ in seeds]
    masks = np.stack([schedule(n, np.array(space.is_morphology), 2) for *_, n in seeds])
    batch = jax.tree.map(lambda *v: jnp.stack(v), *starts)
    ends, infos = jax.jit(jax.vmap(run))(batch, masks)
    for k, state in enumerate(starts):
        end, info = run(state, masks[k])
        for e in range(2):
            state, want = episode(state, masks[k, e])
            for a, b in zip(jax.tree.leaves(info), jax.tree.leaves(want), strict=True):
                np.testing.assert_array_equal(a[e], b)
        np.testing.assert_array_equal(end.particles, state.particles)
        np.testing.assert_array_equal(ends.particles[k], end.particles)
        for a, b in zip(jax.tree.leaves(infos), jax.tree.leaves(info), strict=True):
            np.testing.assert_array_equal(a[k], b)
    _, firsts = jax.jit(jax.vmap(episode))(batch, masks[:, 0])
    np.testing.assert_array_equal(firsts.trials.cost, infos.trials.cost[:, 0])
    assert np.ptp(infos.trials.cost) > 0.1 and (infos.trials.status & ~int(WARNINGS) == 0).any()


# --- a cost of one's own -------------------------------------------------------------------------


def final_height(scene, trace, ctrl):
    """How far below 0.2 m the object is at the end; what the arm does is no part of it."""
    assert trace.qpos.shape[-1] > 0 and ctrl.shape[0] == trace.height.shape[0]
    return jnp.maximum(0.2 - trace.qpos[-1, -5], 0.0)


def test_a_cost_of_ones_own_sees_the_end_of_the_trace():
    """MuJoCo's own simulation gives the object's final height, far behind its loss."""
    scene = small.pinch("sphere", **SHORT)
    hand, trial = small.hand_world(scene, pressure=0.0)
    hand, trial = (jax.tree.map(lambda v: jnp.asarray(v)[None], x) for x in (hand, trial))
    engine = MujocoEngine(scene, num_threads=1)
    result = jax.jit(
        lambda p, t: rollout.evaluate(scene, engine, p, t, trajectory=True, cost=final_height)
    )(hand, trial)
    fields = model.model_fields(scene, *(small.nth(x, 0) for x in (hand, trial)))
    data = mujoco.MjData(compiled := world_model(scene, fields))
    data.qpos[:] = fields.start
    commands = control.commands(scene, *(small.nth(x, 0) for x in (hand, trial)))
    for u in np.asarray(commands)[:-1]:
        data.ctrl[:] = u
        mujoco.mj_step(compiled, data)
    assert np.isfinite(result.lost_time).all()  # the hand does not close
    np.testing.assert_allclose(result.cost, 0.2 - data.qpos[-5], rtol=1e-5)


def test_failed_trials_do_not_ask_ones_own_cost():
    """They show the scene's maximum; a cost that is no number for each world is refused."""
    scene, space, engine = toy.tiny()
    engine.failing = [1]
    params = jax.tree.map(lambda v: jnp.stack([v] * 3), space.params(jnp.array([0.05, 0.0])))
    trial = jax.tree.map(lambda v: v[None], rollout.nominal_trial(scene))
    evaluate = jax.jit(
        lambda p, t, c: rollout.evaluate(scene, engine, p, t, cost=c), static_argnums=2
    )
    result = evaluate(params, trial, lambda s, t, u: t.height[-1])
    np.testing.assert_array_equal(result.cost[:, 0], [0.5, scene.cost.maximum, 0.5])
    with pytest.raises(ValueError, match="one number for each world"):
        evaluate(params, trial, lambda s, t, u: t.height)
