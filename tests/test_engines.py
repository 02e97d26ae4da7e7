"""Stock MJX against MuJoCo C: single steps in float64, whole short grasps, and failing worlds."""

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from codesign_jax import model, scene
from codesign_jax.engines import make_engine, solver_problems
from codesign_jax.engines.mjx import MjxEngine
from codesign_jax.engines.mujoco import MujocoEngine, world_model
from codesign_jax.scene import parameters, schema
from codesign_jax.types import Status
from tests.helpers import grasps
from tests.helpers.grasps import batch_inputs, nth, pinch, stack, still, world_inputs

# Designs (length, arm_z) [m] at which two fingers of three links lift the object at 190 kPa.
HOLDING = {"box": (0.09, 0.05), "cylinder": (0.10, 0.08), "sphere": (0.11, 0.025)}
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


# --- single steps --------------------------------------------------------------------------------


class Steps:
    """A grasp in MuJoCo C with every state on its way, and the compiled MJX step in float64."""

    def __init__(self, shape):
        # The solver's last digits are compared, so it has to find them.
        self.shape = shape
        self.scene = pinch(
            shape, solver__tolerance=1e-14, solver__iterations=100, solver__ls_iterations=50
        )
        with jax.enable_x64(True):
            params, trial = world(self.scene, HOLDING[shape], pressure=190e3)
            self.fields, ctrl = jax.device_get(world_inputs(self.scene, params, trial))
            self.engine = MjxEngine(self.scene)
        compiled = world_model(self.scene, self.fields)
        data = mujoco.MjData(compiled)
        data.qpos[:] = self.fields.start
        rows = []
        for u in ctrl[:600]:
            data.ctrl[:] = u
            state = [data.qpos.copy(), data.qvel.copy(), data.qacc_warmstart.copy(), u]
            mujoco.mj_step(compiled, data)
            new = [data.qacc.copy(), data.qfrc_constraint.copy(), data.ncon, data.qpos.copy()]
            rows.append([*state, *new])
        self.columns = [np.stack(column) for column in zip(*rows, strict=True)]

        def step(qpos, qvel, warmstart, u):
            data = self.engine.reset(self.fields)
            new = self.engine.step(
                self.fields, data.replace(qpos=qpos, qvel=qvel, qacc_warmstart=warmstart), u
            )
            return new.qpos, new.qvel, new.qacc, new.qfrc_constraint, new.qacc_warmstart

        self.step = jax.jit(jax.vmap(step), compiler_options=QUICK)


slow = pytest.mark.slow
BATCH = 25  # states of a grasp that are stepped at once


# Half a minute each to compile. The quick tests have stock MJX's whole grasps, below: its free
# motion against MuJoCo C, a held object, and what becomes of failing worlds.
@pytest.fixture(
    scope="module", params=[pytest.param(s, marks=slow) for s in ("sphere", "box", "cylinder")]
)
def steps(request):
    return Steps(request.param)


def test_mjx_steps_equal_mujocos(steps):
    """From the same state along a real grasp, both engines find the same acceleration."""
    pick = np.arange(0, 600, 600 // BATCH)
    qpos, qvel, warmstart, u, qacc, force, ncon, _ = (column[pick] for column in steps.columns)
    resting = {"sphere": 1, "box": 4, "cylinder": 3}[steps.shape]
    assert (ncon > resting).sum() >= 5  # fingers on the object or the table
    assert (qpos[:, -5] > 0.06).sum() >= 5  # the object is up in the air
    with jax.enable_x64(True):
        *_, our_qacc, our_force, _ = map(np.asarray, steps.step(qpos, qvel, warmstart, u))
    if steps.shape == "sphere":
        # Rounding (1e-16) times the condition number of M gives 1e-11.  At rest MJX keeps its warm
        # start once the scaled gradient is below the tolerance: 1.5e-6 measured.
        error = np.abs(our_qacc - qacc).max(1) / np.maximum(1.0, np.abs(qacc).max(1))
        assert error.max() < 1e-5
        assert np.median(error) < 1e-11
    # Forces [N]: MJX's contacts on a box differ in their frames' last digits (1e-4 N measured);
    # on a cylinder, by descent on a distance function, by up to 0.1 mm, times 2 kN/m.
    bound = {"sphere": 1e-6, "box": 1e-3, "cylinder": 0.2}[steps.shape]
    assert np.abs(our_force - force).max() < bound


def test_free_running_before_contact(steps):
    """A stretch of approach without copying the state, with the object on the table."""
    qpos, qvel, warmstart, u, *_, after = steps.columns
    state = (qpos[:1], qvel[:1], warmstart[:1])
    with jax.enable_x64(True):
        # The compiled batch has as many rows as the other test's; they all do the same.
        state = tuple(np.repeat(s, BATCH, 0) for s in state)
        for k in range(80):
            new = steps.step(*state, np.repeat(u[k : k + 1], BATCH, 0))
            state = (new[0], new[1], new[4])
    # Rounding only (1e-17 measured).  Once the object rests still, about step 100, MJX's early stop
    # (see above) makes it 4e-9.
    np.testing.assert_allclose(np.asarray(state[0])[0], after[79], atol=1e-13)


# --- whole rollouts ------------------------------------------------------------------------------

# A grasp in 2.2 s: the same phases, hurried, with fewer links, joints and contacts.
HURRIED = {
    "links": 2,
    "effects__twist": False,
    "effects__palm_object": False,
    "effects__palm_table": False,
    "effects__finger_table": False,
    "phases__approach": 0.5,
    "phases__inflate": 0.8,
    "phases__lift": 1.2,
    "phases__disturb": 1.6,
    "phases__ungrasp": 2.2,
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
    worlds = [world(the_scene, HOLDING["sphere"]) for _ in range(6)]
    worlds[OTHER] = world(the_scene, (0.11, 0.02))
    good = batch_inputs(the_scene, *stack(*worlds))
    worlds[LENGTH] = world(the_scene, HOLDING["sphere"], length=jnp.nan)
    worlds[PRESSURE] = world(the_scene, HOLDING["sphere"], pressure=1e12)
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


def test_traces_of_both_engines_mean_the_same(hurried, mjx_traces, mujoco_traces):
    """Entry k describes the state before step k; up to first touch float32 follows float64."""
    the_scene, (fields, _), _ = hurried
    (ours, _), (theirs, _) = mjx_traces, mujoco_traces
    steps = the_scene.num_steps
    for trace in (ours, theirs):
        assert trace.distance.shape == trace.height.shape == trace.speed.shape == (6, steps)
        assert trace.qpos.shape == (6, steps, fields.start.shape[1])
        np.testing.assert_allclose(trace.qpos[:, 0], fields.start, rtol=1e-6)
        np.testing.assert_allclose(trace.height[:, 0], fields.start[:, -5], rtol=1e-6)
        np.testing.assert_array_equal(trace.speed[:, 0], 0.0)
        np.testing.assert_allclose(trace.height, trace.qpos[..., -5], atol=1e-6)
    free = slice(0, 40)  # the hand is still above the object
    # Positions of up to 0.3 m and speeds of up to 1 m/s in float32, over 40 steps.
    np.testing.assert_allclose(ours.qpos[:, free], theirs.qpos[:, free], atol=1e-5)
    np.testing.assert_allclose(ours.distance[:, free], theirs.distance[:, free], atol=1e-5)
    np.testing.assert_allclose(ours.speed[:, free], theirs.speed[:, free], atol=1e-3)


def test_distance_is_from_the_mean_of_the_links(hurried, mujoco_traces):
    """Hand centre by hand: the mean over segments of their centres, at the start pose."""
    the_scene, (fields, _), _ = hurried
    data = mujoco.MjData(compiled := world_model(the_scene, nth(fields, 0)))
    data.qpos[:] = nth(fields, 0).start
    mujoco.mj_kinematics(compiled, data)
    lay, length = model.layout(the_scene), HOLDING["sphere"][0]
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


@pytest.mark.parametrize("engine", ["mjx", "mujoco"])
def test_failing_worlds_are_flagged_alike(hurried, engine, request):
    the_scene, *_ = hurried
    trace = request.getfixturevalue(f"{engine}_traces")[1]
    result = grasps.outcomes(the_scene, trace)
    for index, (status, step) in EXPECTED.items():
        assert result.status[index] == status and result.bad_step[index] == step
    # A finger under 1e12 Pa is fast in the first step, or beyond float32's numbers.
    assert result.status[PRESSURE] & (Status.SPEED | Status.NONFINITE)
    assert result.bad_step[PRESSURE] == 1


def test_a_failed_world_is_frozen_at_its_last_good_state(mjx_traces):
    (_, bad) = mjx_traces
    for index, step in ((CONTROL, NAN_FROM), (PRESSURE, 0), (BELOW, 0)):
        assert np.isfinite(bad.qpos[index]).all()
        rest = bad.qpos[index, step:]
        np.testing.assert_array_equal(rest, np.broadcast_to(rest[0], rest.shape))
    assert np.isnan(bad.speed[CONTROL, NAN_FROM + 1 :]).all()


def test_other_worlds_are_bitwise_unaffected(mjx_traces):
    """Good worlds do not notice failing ones in their batch."""
    good, bad = mjx_traces
    for index in (GOOD, OTHER):
        for a, b in zip(*map(jax.tree.leaves, (good, bad)), strict=True):
            np.testing.assert_array_equal(a[index], b[index])


def test_mujoco_worlds_are_unaffected_too(mujoco_traces):
    good, bad = mujoco_traces
    for index in (GOOD, OTHER):
        for a, b in zip(*map(jax.tree.leaves, (good, bad)), strict=True):
            np.testing.assert_array_equal(a[index], b[index])


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


def test_batches_do_not_depend_on_order_or_size(hurried):
    """MuJoCo solves each world by itself: any permutation and any batch gives the same numbers."""
    the_scene, (fields, ctrl), _ = hurried
    engine = make_engine("mujoco", the_scene)
    whole = engine.rollout(fields, ctrl)
    order = np.array([5, 0])
    part = engine.rollout(nth(fields, order), nth(ctrl, order))
    again = engine.rollout(fields, ctrl)
    for a, b, c in zip(*map(jax.tree.leaves, (whole, part, again)), strict=True):
        np.testing.assert_array_equal(np.asarray(a)[order], b)
        np.testing.assert_array_equal(a, c)


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
