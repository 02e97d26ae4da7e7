"""Engines: lost and failing worlds, JAX's transformations, costs; single steps: test_steps."""

import functools
from functools import partial

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from codesign_jax import control, model, rollout, scene
from codesign_jax.engines import make_engine, solver_problems
from codesign_jax.engines.mujoco import MujocoEngine, world_model
from codesign_jax.engines.structured import StructuredEngine
from codesign_jax.types import Status
from tests.helpers import grasps, toy_engine
from tests.helpers.grasps import pinch
from tests.helpers.refusals import refusal

# Compiling takes longer than all that is done with a program here.
QUICK = {"xla_backend_optimization_level": 0}


def test_an_unknown_engine_is_refused():
    assert refusal(make_engine, "mujocco", pinch()) == [("unknown", "")]


def test_mujocos_solver_table_is_refused_where_it_has_no_effect():
    """Unless a preset wrote it, or [newton] is set as well: then the scene serves all engines."""
    changed = pinch(solver__iterations=31, solver__tolerance=1e-9)
    keys = ["solver.iterations", "solver.tolerance"]
    assert refusal(make_engine, "structured", changed) == [("unsupported", key) for key in keys]
    make_engine("mujoco", pinch(solver__iterations=31))
    make_engine("structured", pinch(solver__iterations=31, newton__iterations=30))
    assert not solver_problems(scene.load("paper", accuracy="reference"))
    assert not solver_problems(scene.load("paper"))


# --- the default engine under JAX's transformations, and what a trace means on every engine -------


# A grasp in 1.2 s with few contacts: what is tested here does not depend on them.
OFF = "palm_object palm_table finger_table disturb ungrasp"
SHORT = {"links": 2} | grasps.hurried(0.3, 0.5, 1.2, without=OFF)


# The engine and numbers of `decided`, so that both have one kernel.
IN_THE_AIR = SHORT | grasps.off("finger_object twist")
EXACT = {"tolerance": 1e-16}


def test_vmap_is_a_larger_batch():
    """Nested, over axes in any place, and with controls that all share: the same bits."""
    scene = grasps.pinch("sphere", **IN_THE_AIR)
    engine = StructuredEngine(scene, **EXACT)
    with jax.enable_x64(True):
        inputs = grasps.batch_inputs(scene, *grasps.random_worlds(scene, 3, 5))
        # NumPy cuts them and moves their axes.
        fields, ctrl = jax.tree.map(lambda v: np.asarray(v)[:4], inputs)
        compiled = partial(jax.jit, compiler_options=QUICK)
        run = compiled(engine.rollout)
        want = run(fields, ctrl)
        two = jax.tree.map(lambda v: v.reshape(2, 2, 1, *v.shape[1:]), (fields, ctrl))
        controls = np.moveaxis(two[1], 0, 3)
        mixed = compiled(jax.vmap(jax.vmap(engine.rollout), in_axes=(0, 3)))(two[0], controls)
        for name in ("distance", "height", "speed", "status", "last"):
            expected = np.asarray(getattr(want, name))
            values = np.asarray(getattr(mixed, name)).reshape(expected.shape)
            np.testing.assert_array_equal(values, expected, err_msg=name)
        shared = compiled(jax.vmap(engine.rollout, in_axes=(0, None)))(
            jax.tree.map(lambda v: v[:, None], fields), ctrl[:1]
        )
        alone = run(fields, np.repeat(ctrl[:1], 4, 0))
    np.testing.assert_array_equal(shared.distance[:, 0], alone.distance)


@pytest.fixture(scope="module")
def decided(tmp_path_factory):
    """Scene, hands and fields of a lost and of failing worlds; traces of them, and outcomes.

    The latter are a function of engine and trajectory, which simulates what nobody has asked for.

    The hand of world 0 stays above the object, which is lost as the window opens, and rises on;
    world 1 starts below the table; a pressure of world 2 is not a number from step 10 on, and the
    length of world 3; the fingers of world 4 are inflated at once, by 1e12 Pa.
    """
    scene = grasps.pinch("sphere", **IN_THE_AIR)
    with jax.enable_x64(True):
        params, trials = grasps.random_worlds(scene, 3, 5)
        params = params._replace(length=params.length.at[3].set(jnp.nan))
        fields, ctrl = grasps.batch_inputs(scene, params, trials)
        ctrl = ctrl.at[0, :, 2].set(jnp.linspace(0.3, 0.4, ctrl.shape[1]))
        ctrl = ctrl.at[2, 10:, 6].set(jnp.nan).at[4, :, 6:].set(1e12)
        # A micrometre above the table: exactly on it, rounding decides whether an object touches.
        start = fields.start.at[:, -5].add(1e-6)
        fields = fields._replace(start=start.at[1, -5].set(-0.05))
        params, fields = jax.tree.map(np.asarray, (params, fields))
    logs = tmp_path_factory.mktemp("log")  # where MuJoCo tells that a world went bad
    engines = {
        "structured": lambda: StructuredEngine(scene, **EXACT),
        "mujoco": lambda: MujocoEngine(scene, num_threads=1),
        "mjx": lambda: make_engine("mjx", scene),
    }

    @functools.cache
    def simulated(name, trajectory):
        with jax.enable_x64(True), pytest.MonkeyPatch.context() as patch:
            patch.chdir(logs)
            run = partial(engines[name]().rollout, trajectory=trajectory)
            trace = jax.jit(run, compiler_options=QUICK)(fields, ctrl)
            return jax.tree.map(np.asarray, (trace, grasps.outcomes(scene, trace)))

    return scene, params, fields, simulated


def test_distance_is_from_the_mean_of_the_links(decided):
    """Hand centre by hand: the mean over segments of their centres, at the start pose."""
    scene, params, fields, simulated = decided
    data = mujoco.MjData(compiled := world_model(scene, grasps.nth(fields, 0)))
    data.qpos[:] = fields.start[0]
    mujoco.mj_kinematics(compiled, data)
    lay = model.layout(scene)
    sizes = zip(params.length[0], params.height[0], strict=True)
    centres = [
        data.xpos[stub] + data.xmat[stub].reshape(3, 3) @ [share * length, 0, height / 2]
        for stub, (length, height) in zip(lay.stubs, sizes, strict=True)
        for share in (0.25, 0.75)  # of two links
    ]
    expected = np.linalg.norm(data.xpos[lay.object] - np.mean(centres, 0))
    np.testing.assert_allclose(simulated("mujoco", False)[0].distance[0, 0], expected, rtol=1e-12)


# By the kernel a trajectory is another program: quick tests compare its path with MuJoCo C step by
# step (test_kernel, test_steps). Stock MJX takes twelve seconds to compile.
@pytest.mark.parametrize(
    ("name", "trajectory"),
    [
        ("structured", False),
        pytest.param("structured", True, marks=pytest.mark.slow),
        pytest.param("mjx", False, marks=pytest.mark.slow),
    ],
)
def test_a_trace_means_the_same_on_every_engine(decided, name, trajectory):
    """Where worlds are decided, what later entries show, and the state in which they stay."""
    scene, *_, simulated = decided
    first = round(scene.window[0] / 0.01)
    end = scene.num_steps
    (got, ours), (want, outcome) = (simulated(n, trajectory) for n in (name, "mujoco"))
    lost_at = 0.01 * first
    assert outcome.lost_time[0] == pytest.approx(lost_at)
    # Below the table; the state after the step that had no number; before the first step; fast in
    # the first step, or beyond all numbers.
    assert outcome.bad_step.tolist() == [-1, 0, 11, 0, 1]
    assert outcome.status[:4].tolist() == [Status.OK, Status.PENETRATION, *[Status.NONFINITE] * 2]
    assert all(result.status[4] & (Status.SPEED | Status.NONFINITE) for result in (ours, outcome))
    untold = {"residual": None} | ({"capped": None} if name == "mjx" else {})  # how a solver ended
    compared = (result._replace(**untold) for result in (ours, outcome))
    for a, b in zip(*map(jax.tree.leaves, compared), strict=True):
        np.testing.assert_allclose(a[:4], b[:4])
    np.testing.assert_array_equal(ours.bad_step, outcome.bad_step)
    shown = [
        {f: getattr(trace, f)[:3] for f in ("distance", "height", "speed", "qpos")}
        | model.split(scene, trace.last[:3])._replace(acc=0)._asdict()
        for trace in (got, want)
    ]
    for field, value in shown[0].items():
        # No contact but the object's with the table, where MuJoCo stops at its tolerance.
        np.testing.assert_allclose(value, shown[1][field], atol=1e-6, err_msg=field)
    for trace in (got, want):
        rest = trace.distance[0, first:]
        if trajectory:
            assert rest[-1] - rest[0] > 0.03 and trace.qpos.shape[1] == end
            stays = trace.qpos[2, 10:11].repeat(end - 10, 0)
            np.testing.assert_array_equal(trace.qpos[2, 10:], stays)
        else:
            np.testing.assert_array_equal(rest, rest[0])
        np.testing.assert_array_equal(trace.height[1], trace.height[1, 0])
        assert np.isnan(trace.speed[2, 11:]).all() and np.isnan(trace.last[:3]).sum() == 1


def final_height(scene, trace, ctrl):
    """How far below 0.2 m the object is at the end; what the arm does is no part of it."""
    assert trace.qpos.shape[-1] > 0 and ctrl.shape[0] == trace.height.shape[0]
    return jnp.maximum(0.2 - trace.qpos[-1, -5], 0.0)


def test_a_cost_of_ones_own_sees_the_end_of_the_trace():
    """MuJoCo's own simulation gives the object's final height, far behind its loss."""
    scene = grasps.pinch("sphere", **SHORT)
    hand, trial = grasps.hand_world(scene, pressure=0.0)
    hand, trial = (jax.tree.map(lambda v: jnp.asarray(v)[None], x) for x in (hand, trial))
    engine = MujocoEngine(scene, num_threads=1)
    result = jax.jit(
        lambda p, t: rollout.evaluate(scene, engine, p, t, record_qpos=True, cost=final_height)
    )(hand, trial)
    fields, commands = grasps.world_inputs(scene, *(grasps.nth(x, 0) for x in (hand, trial)))
    data = mujoco.MjData(compiled := world_model(scene, fields))
    data.qpos[:] = fields.start
    for u in np.asarray(commands)[:-1]:
        data.ctrl[:] = u
        mujoco.mj_step(compiled, data)
    assert np.isfinite(result.lost_time).all()  # the hand does not close
    np.testing.assert_allclose(result.cost, 0.2 - data.qpos[-5], rtol=1e-5)


def test_a_cost_does_not_read_what_was_not_simulated():
    """Of a lost grasp the rest is missing without a trajectory: asked for, or an error in words."""
    scene, space, engine = toy_engine.tiny()
    params = jax.tree.map(lambda v: v[None], space.params(jnp.array([0.05, 0.0])))
    trial = jax.tree.map(lambda v: v[None], rollout.nominal_trial(scene))

    def cost_of(p, t, cost, **flags):
        return rollout.evaluate(scene, engine, p, t, cost=cost, **flags).cost[0, 0]

    def trace_it(cost, **flags):  # without a compile
        jax.eval_shape(partial(cost_of, cost=cost, **flags), params, trial)

    def height(scene, trace, ctrl):
        return trace.height[-1]

    jitted = jax.jit(lambda trace: trace.height[-1])  # the trace is still a tree of arrays
    for cost in (height, lambda s, t, u: jitted(t), lambda s, t, u: t.at(s).height):
        words = "pass stop_when_lost=False beside cost= to have all of the grasp, or stop_when_lost"
        with pytest.raises(ValueError, match=words):
            trace_it(cost)
    for flags in ({}, {"stop_when_lost": True}, {"stop_when_lost": False}):
        with pytest.raises(ValueError, match="trace.qpos, which is recorded with record_qpos=True"):
            trace_it(lambda s, t, u: t.qpos[-1, -5], **flags)

    @jax.jit
    def allowed(p, t):
        return [
            cost_of(p, t, height, stop_when_lost=False),
            cost_of(p, t, lambda s, t, u: t.at(s, "disturb").height, stop_when_lost=True),
            cost_of(p, t, lambda s, t, u: u[0, 0] * 0 + 1.5),  # reads nothing of the trace
        ]

    assert [float(v) for v in allowed(params, trial)] == [0.5, 0.5, 1.5]


# Nothing touches and nothing falls: a derivative compiles in half a minute, with contacts in two.
FREE = SHORT | grasps.off("finger_object object_table gravity wrist twist lateral_bending")


def bent(scene, engine, world, x, broken):
    """A number of each of some grasps, from factors x (world, 3) on length, pressure, modulus.

    The object is lost as the window opens, and `broken` worlds fail before: what the trace repeats
    from then on counts.
    """
    hand, trial = jax.tree.map(
        lambda v: jnp.asarray(v, x.dtype if v.dtype.kind == "f" else None), world
    )

    def inputs(x, broken):
        new = hand._replace(length=x[0] * hand.length, pressure=x[1] * hand.pressure)
        fields = model.model_fields(scene, new, trial)
        fields = fields._replace(stiffness=x[2] * fields.stiffness)
        ctrl = control.commands(scene, new, trial)
        return fields, ctrl.at[40:, 6].set(jnp.where(broken, jnp.nan, ctrl[40:, 6]))

    trace = engine.rollout(*jax.vmap(inputs)(x, broken))
    random = np.random.default_rng(0)
    end = jnp.concatenate(model.split(scene, trace.last)[:2], 1)
    weights = random.normal(size=end.shape[1]), random.normal(size=trace.distance.shape[1])
    return end @ weights[0] + trace.distance @ weights[1]


def slopes_by_vmap(value, x, broken):
    return jax.vmap(jax.grad(lambda x, b: value(x[None], b[None])[0]))(x, broken)


def slopes_of_a_share(value, x, broken):
    """Of one device's worlds, whose forward pass is repeated for the backward pass."""

    def slopes(x, broken):
        return jax.grad(lambda x: jax.checkpoint(value)(x, broken).sum())(x)

    part = jax.sharding.PartitionSpec("device")
    mesh = jax.sharding.Mesh(np.array(jax.devices()[:1]), ("device",))
    arguments = {"mesh": mesh, "in_specs": part, "out_specs": part, "check_vma": False}
    return jax.shard_map(slopes, **arguments)(x, broken)


@pytest.mark.parametrize(
    "slopes",
    [slopes_of_a_share, pytest.param(slopes_by_vmap, marks=pytest.mark.slow)],  # traced twice
)
def test_gradients_by_the_kernel_equal_central_differences(slopes):
    """In float64, of a world that is lost and of one that fails, whose pressures lag."""
    scene = grasps.pinch("sphere", **FREE, effects__pressure_dynamics=True)
    engine = StructuredEngine(scene, iterations=60, tolerance=1e-22)
    with jax.enable_x64(True):
        value = partial(bent, scene, engine, grasps.hand_world(scene, pressure=50e3))
        x = jnp.array([[1.0, 1.0, 1.0], [0.9, 1.1, 1.2]])
        broken = jnp.array([False, True])
        slope = jax.jit(partial(slopes, value), compiler_options=QUICK)(x, broken)
        step = 1e-5 * jnp.eye(3)
        sides = jnp.stack([x[:, None] + step, x[:, None] - step])
        every = jnp.broadcast_to(broken[:, None], sides.shape[:-1])
        both = jax.jit(value, compiler_options=QUICK)
        high, low = np.asarray(both(sides.reshape(-1, 3), every.ravel())).reshape(every.shape)
    assert np.isfinite(slope).all() and (np.abs(slope) > 1e-3).all()
    # A step of 1e-5 loses 1e-10 to truncation and 1e-11 to rounding.
    np.testing.assert_allclose(slope, (high - low) / 2e-5, rtol=1e-6)


def test_what_has_no_derivative_says_so():
    """Forward mode and second derivatives, before anything is compiled."""
    scene = grasps.pinch("sphere", **FREE)
    engine = StructuredEngine(scene)
    world = grasps.hand_world(scene)
    x = jnp.ones(3)

    def value(x):
        return bent(scene, engine, world, x[None], jnp.zeros(1, bool))[0]

    with pytest.raises(TypeError, match="forward-mode"):
        jax.jit(lambda x: jax.jvp(value, (x,), (x,))).lower(x)
    with pytest.raises(NotImplementedError, match="first derivatives only"):
        jax.eval_shape(jax.grad(lambda x: jax.grad(value)(x).sum()), x)
