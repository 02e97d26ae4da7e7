"""Stock MJX and MuJoCo C: whole short grasps, and failing worlds; single steps: test_steps."""

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from codesign_jax import model, scene
from codesign_jax.engines import make_engine, solver_problems
from codesign_jax.engines.mujoco import MujocoEngine, world_model
from codesign_jax.scene import parameters, schema
from codesign_jax.types import Status
from tests.helpers import grasps
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


# Stock MJX takes twelve seconds to compile; quick: test_compose has both other engines' traces.
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
