"""Stock MJX and MuJoCo C: whole short grasps, and failing worlds; single steps: test_steps."""

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
from codesign_jax.scene import parameters, schema
from codesign_jax.types import Status
from tests.helpers import grasps, toy_engine
from tests.helpers.grasps import batch_inputs, nth, pinch, stack, still

# A design (length, arm_z) [m] at which two fingers hold the sphere.
HOLDING = (0.11, 0.025)
# Compiling stock MJX takes longer than all that is done with it here.
QUICK = {"xla_backend_optimization_level": 0}


def world(the_scene, design, **changes):
    """Params and trial of a design, slightly off centre so that no symmetry hides a mistake."""
    space = parameters.design_space(the_scene.hand, "2d")
    params = space.params(jnp.asarray(design))
    params = params._replace(**{k: getattr(params, k) * 0 + v for k, v in changes.items()})
    dtype = params.length.dtype
    offset = {"position": jnp.array([0.004, 0.003], dtype), "arm_tilt": jnp.full(2, 0.05, dtype)}
    return params, jax.tree.map(jnp.asarray, still()._replace(**offset))


# --- whole rollouts ------------------------------------------------------------------------------

# A grasp in 1.3 s: the same phases, hurried, with fewer links, joints and contacts.
HURRIED = {
    "links": 2,
    "effects__lateral_bending": False,
    "effects__twist": False,
    "effects__palm_object": False,
    "effects__palm_table": False,
    "effects__finger_table": False,
    "phases__approach": 0.5,
    "phases__inflate": 0.7,
    "phases__lift": 0.9,
    "phases__disturb": 1.1,
    "phases__ungrasp": 1.3,
    "phases__deflate_time": 0.1,
    # Worlds that are not numbers never converge: their solver takes all iterations in every step.
    "solver__iterations": 10,
    "solver__ls_iterations": 10,
}
GOOD, LENGTH, CONTROL, PRESSURE, BELOW, OTHER = range(6)
NAN_FROM = 24  # time step of the first control that is not a number


@pytest.fixture(scope="module")
def hurried():
    """Fields and controls of six worlds, of which four fail in their own way, and of good ones."""
    the_scene = pinch("sphere", **HURRIED)
    worlds = [world(the_scene, HOLDING) for _ in range(6)]
    worlds[OTHER] = world(the_scene, (0.11, 0.02))
    good = batch_inputs(the_scene, *stack(*worlds))
    worlds[LENGTH] = world(the_scene, HOLDING, length=jnp.nan)
    worlds[PRESSURE] = world(the_scene, HOLDING, pressure=1e12)
    fields, ctrl = batch_inputs(the_scene, *stack(*worlds))
    ctrl = ctrl.at[CONTROL, NAN_FROM:, 6].set(jnp.nan)
    # Inflated from the first step on, so that the failure is sudden.
    ctrl = ctrl.at[PRESSURE, :, 6:].set(1e12)
    fields = fields._replace(start=fields.start.at[BELOW, -5].set(-0.05))
    return the_scene, good, (fields, ctrl)


@pytest.fixture(scope="module")
def mjx_traces(hurried):
    """Traces by stock MJX in float32, of the good and of the failing batch, by one program."""
    the_scene, good, bad = hurried
    engine = make_engine("mjx", the_scene)
    run = jax.jit(lambda f, c: engine.rollout(f, c, trajectory=True), compiler_options=QUICK)
    return tuple(jax.tree.map(np.asarray, run(*batch)) for batch in (good, bad))


@pytest.fixture(scope="module")
def mujoco_traces(hurried, tmp_path_factory):
    the_scene, good, bad = hurried
    engine = make_engine("mujoco", the_scene)
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(tmp_path_factory.mktemp("log"))  # where MuJoCo logs that a world went bad
        return tuple(
            jax.tree.map(np.asarray, engine.rollout(*batch, trajectory=True))
            for batch in (good, bad)
        )


# Stock MJX takes twelve seconds to compile; quick: traces of both other engines are below
slow = pytest.mark.slow


def test_distance_is_from_the_mean_of_the_links(hurried, mujoco_traces):
    """Hand centre by hand: the mean over segments of their centres, at the start pose."""
    the_scene, (fields, _), _ = hurried
    data = mujoco.MjData(compiled := world_model(the_scene, nth(fields, 0)))
    data.qpos[:] = nth(fields, 0).start
    mujoco.mj_kinematics(compiled, data)
    lay, length = model.layout(the_scene), HOLDING[0]
    along = (np.arange(2) + 0.5) * length / 2
    height = 0.010  # of the section's middle above the bottom layer
    centres = [
        data.xpos[s] + data.xmat[s].reshape(3, 3) @ [x, 0, height] for s in lay.stubs for x in along
    ]
    expected = np.linalg.norm(data.xpos[lay.object] - np.mean(centres, 0))
    np.testing.assert_allclose(mujoco_traces[0].distance[0, 0], expected, rtol=1e-5)


EXPECTED = {
    GOOD: (Status.OK, -1),
    LENGTH: (Status.NONFINITE, 0),  # positions are not numbers before the first step
    CONTROL: (Status.NONFINITE, NAN_FROM + 1),  # the state after the step that had it
    BELOW: (Status.PENETRATION, 0),
}


@pytest.mark.parametrize("engine", [pytest.param("mjx", marks=slow), "mujoco"])
def test_failing_worlds_are_flagged_alike(hurried, engine, request):
    the_scene, *_ = hurried
    trace = request.getfixturevalue(f"{engine}_traces")[1]
    result = grasps.outcomes(the_scene, trace)
    for index, (status, step) in EXPECTED.items():
        assert result.status[index] == status and result.bad_step[index] == step
    # A finger under 1e12 Pa is fast in the first step, or beyond float32's numbers.
    assert result.status[PRESSURE] & (Status.SPEED | Status.NONFINITE)
    assert result.bad_step[PRESSURE] == 1


def test_decided_worlds_are_not_simulated_further(hurried, monkeypatch):
    """MuJoCo leaves worlds that are lost or failed; their traces repeat the last entry."""
    the_scene, (fields, ctrl), _ = hurried
    engine = MujocoEngine(the_scene)
    asked, advance = [], MujocoEngine.advance

    def spy(self, batch, ids, *rest):
        asked.append(ids.tolist())
        return advance(self, batch, ids, *rest)

    monkeypatch.setattr(MujocoEngine, "advance", spy)
    # World 0 keeps the object at the start; world 1 holds its hand up in the air: lost at once.
    away = ctrl.at[1, :, 2].set(0.3)
    trace = jax.tree.map(np.asarray, engine.rollout(nth(fields, slice(0, 2)), away[:2]))
    window = round(the_scene.window[0] / the_scene.discretization.timestep)
    last = (window // 25 + 1) * 25  # the end of the chunk in which the window opens
    assert asked[window // 25] == [0, 1] and asked[window // 25 + 1] == [0]
    np.testing.assert_array_equal(trace.distance[1, last:], trace.distance[1, last - 1])
    result = grasps.outcome(the_scene, nth(trace, 1))
    np.testing.assert_allclose(result.cost, the_scene.cost.maximum, rtol=1e-6)


def test_unknown_engine_names_the_nearest():
    with pytest.raises(schema.InputError, match="did you mean 'mujoco'"):
        make_engine("mujocco", pinch())


def test_mujocos_solver_table_is_refused_where_it_has_no_effect():
    """Unless a preset wrote it, or [newton] is set as well: then the scene serves all engines."""
    with pytest.raises(schema.InputError) as error:
        make_engine("structured", pinch(solver__iterations=31, solver__tolerance=1e-9))
    iterations, tolerance = error.value.problems
    assert "solver.iterations = 31" in iterations and "set newton.iterations" in iterations
    assert "solver.tolerance = 1e-09" in tolerance and "set newton.decrement" in tolerance
    make_engine("mujoco", pinch(solver__iterations=31))
    make_engine("structured", pinch(solver__iterations=31, newton__iterations=30))
    assert not solver_problems(scene.load("paper", accuracy="reference"))
    assert not solver_problems(scene.load("paper"))


# --- the default engine under JAX's transformations, and what a trace means on every engine -------


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
    scene = grasps.pinch("sphere", **SHORT)
    return scene, *grasps.batch_inputs(scene, *grasps.random_worlds(scene, 3, 4))


def test_vmap_is_a_larger_batch(batch):
    """Nested, over axes in any place, and with controls that all share: the same bits."""
    scene, fields, ctrl = batch
    engine = StructuredEngine(scene)
    want = jax.jit(engine.rollout)(fields, ctrl)
    fields, ctrl = jax.tree.map(np.asarray, (fields, ctrl))  # whose axes NumPy moves
    two = jax.tree.map(lambda v: v.reshape(2, 2, 1, *v.shape[1:]), (fields, ctrl))
    moved = np.moveaxis(two[1], 0, 3)
    mixed = jax.jit(jax.vmap(jax.vmap(engine.rollout), in_axes=(0, 3)))(two[0], moved)
    for name in ("distance", "height", "speed", "status", "last"):
        expected = np.asarray(getattr(want, name))
        found = np.asarray(getattr(mixed, name)).reshape(expected.shape)
        np.testing.assert_array_equal(found, expected, err_msg=name)
    shared = jax.jit(jax.vmap(engine.rollout, in_axes=(0, None)))(
        jax.tree.map(lambda v: v[:, None], fields), ctrl[:1]
    )
    alone = jax.jit(engine.rollout)(fields, np.repeat(ctrl[:1], 4, 0))
    np.testing.assert_array_equal(shared.distance[:, 0], alone.distance)


# Compiling takes longer than all that is done with a program here.
QUICK = {"xla_backend_optimization_level": 0}


def engines(scene):
    """Every engine but stock MJX, whose compile takes longer than all of these tests."""
    return {
        "structured": StructuredEngine(scene, tolerance=1e-16),
        "mujoco": MujocoEngine(scene, num_threads=1),
    }


@pytest.fixture(scope="module")
def decided():
    """Traces, without and with a trajectory, of a lost and of failing worlds, and their outcomes.

    A function of engine, trajectory and number of pieces, one rollout after the other, which
    simulates what nobody has asked for yet.

    The hand of world 0 stays above the object, which is lost as the window opens, and rises on;
    world 1 starts below the table; a pressure of world 2 is not a number from step 10 on.
    """
    scene = grasps.pinch("sphere", **SHORT, effects__finger_object=False, effects__twist=False)
    with jax.enable_x64(True):
        params, trials = grasps.random_worlds(scene, 3, 3)
        fields, ctrl = grasps.batch_inputs(scene, params, trials)
        ctrl = ctrl.at[0, :, 2].set(jnp.linspace(0.3, 0.4, ctrl.shape[1]))
        ctrl = ctrl.at[2, 10:, 6].set(jnp.nan)
        # A micrometre above the table: exactly on it, rounding decides whether an object touches.
        start = fields.start.at[:, -5].add(1e-6)
        fields = fields._replace(start=start.at[1, -5].set(-0.05))

    @functools.cache
    def simulated(name, trajectory, pieces=1):
        with jax.enable_x64(True):
            run = partial(engines(scene)[name].rollout, trajectory=trajectory)
            run, last, parts = jax.jit(run, compiler_options=QUICK), fields.start, []
            for commands in jnp.split(ctrl, pieces, axis=1):
                trace = run(fields._replace(start=last), commands)
                parts, last = [*parts, trace._replace(last=None)], trace.last
            trace = jax.tree.map(lambda *v: jnp.concatenate(v, 1), *parts)._replace(last=last)
            return jax.tree.map(np.asarray, (trace, grasps.outcomes(scene, trace)))

    return scene, simulated


# By the kernel a trajectory is another program: quick tests compare its path with MuJoCo C step by
# step (test_kernel, test_steps).
TRAJECTORY = [False, pytest.param(True, marks=pytest.mark.slow)]


@pytest.mark.parametrize("trajectory", TRAJECTORY)
def test_a_trace_means_the_same_on_every_engine(decided, trajectory):
    """Where worlds are decided, what later entries show, and the state in which they stay."""
    scene, simulated = decided
    first, end = round(scene.window[0] / 0.01), scene.num_steps
    (got, ours), (want, outcome) = (simulated(n, trajectory) for n in ("structured", "mujoco"))
    lost_at = 0.01 * first
    assert outcome.lost_time[0] == pytest.approx(lost_at)
    assert outcome.bad_step.tolist() == [-1, 0, 11]
    told = ours._replace(residual=None), outcome._replace(residual=None)  # MuJoCo C has none
    for a, b in zip(*map(jax.tree.leaves, told), strict=True):
        np.testing.assert_allclose(a, b)
    shown = [
        {f: getattr(trace, f) for f in ("distance", "height", "speed", "qpos")}
        | model.split(scene, trace.last)._replace(acc=0)._asdict()
        for trace in (got, want)
    ]
    for field, value in shown[0].items():
        # No contact but the object's with the table, where MuJoCo stops at its tolerance.
        np.testing.assert_allclose(value, shown[1][field], atol=1e-6, err_msg=field)
    for trace in (got, want):
        rest = trace.distance[0, first:]
        if trajectory:
            assert rest[-1] - rest[0] > 0.03 and trace.qpos.shape[1] == end
            np.testing.assert_array_equal(
                trace.qpos[2, 10:], trace.qpos[2, 10:11].repeat(end - 10, 0)
            )
        else:
            np.testing.assert_array_equal(rest, rest[0])
        np.testing.assert_array_equal(trace.height[1], trace.height[1, 0])
        assert np.isnan(trace.speed[2, 11:]).all() and np.isnan(trace.last).sum() == 1


# --- a cost of one's own -------------------------------------------------------------------------


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


# --- gradients -----------------------------------------------------------------------------------

# Nothing touches and nothing falls: a derivative compiles in half a minute, with contacts in two.
FREE = SHORT | {
    "effects__finger_object": False,
    "effects__object_table": False,
    "effects__gravity": False,
    "effects__wrist": False,
    "effects__twist": False,
    "effects__lateral_bending": False,
}


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
        fields = fields._replace(jnt_stiffness=x[2] * fields.jnt_stiffness)
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
    how = {"mesh": mesh, "in_specs": part, "out_specs": part, "check_vma": False}
    return jax.shard_map(slopes, **how)(x, broken)


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
        x, broken = jnp.array([[1.0, 1.0, 1.0], [0.9, 1.1, 1.2]]), jnp.array([False, True])
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
    engine, world, x = StructuredEngine(scene), grasps.hand_world(scene), jnp.ones(3)

    def value(x):
        return bent(scene, engine, world, x[None], jnp.zeros(1, bool))[0]

    with pytest.raises(TypeError, match="forward-mode"):
        jax.jit(lambda x: jax.jvp(value, (x,), (x,))).lower(x)
    with pytest.raises(NotImplementedError, match="first derivatives only"):
        jax.eval_shape(jax.grad(lambda x: jax.grad(value)(x).sum()), x)
