"""Cost and status of made-up traces, and the two rules for failed trials."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from codesign_jax import cost, rollout, scene
from codesign_jax.model import layout
from codesign_jax.types import Outcome, Status, Trace, failed
from tests.helpers import grasps

SCENE = scene.load("paper_spheres")
STEPS = SCENE.num_steps
LOST = SCENE.cost.lost_distance
evaluate = jax.jit(lambda trace: cost.outcome(SCENE, trace))
judge = jax.jit(lambda trace, trial: cost.outcome(SCENE, trace, 0, trial))


def trace(lost_from=None, until=STEPS, **changes):
    """A grasp that keeps the object until a step, releases it, and leaves it on the table."""
    distance = np.full(STEPS, 0.03)
    height = np.full(STEPS, 0.25)
    # un-grasped at 8.5 s
    distance[850:] = 0.25
    height[850:] = 0.03
    if lost_from is not None:
        distance[lost_from:until] = 0.2
    speed = np.full(STEPS, 0.5)
    for name, edits in changes.items():
        array = {"distance": distance, "height": height, "speed": speed}[name]
        for step, value in edits.items():
            array[step] = value
    return Trace(
        *(jnp.asarray(a, jnp.float32) for a in (distance, height, speed)), jnp.zeros((STEPS, 0))
    )


@pytest.mark.parametrize(
    "lost_from, expected",
    [
        (None, 0.0),
        (350, 3.0),  # as the lift begins, t_0 = 3.5 s
        (575, 1.5),
        (799, 3.0 * 0.01 / 4.5),  # the last step before t_end
        (800, 0.0),  # t_end = 8 s: kept
        (0, 3.0),  # never held
    ],
)
def test_cost_falls_linearly_with_the_time_of_loss(lost_from, expected):
    result = evaluate(trace(lost_from))
    assert result.status == Status.OK and result.bad_step == -1
    assert result.cost == pytest.approx(expected, abs=1e-6)
    inside = lost_from is not None and lost_from < 800
    time = max(lost_from, 350) * 0.01 if inside else np.inf
    assert result.lost_time == pytest.approx(time)


def test_the_threshold_is_inclusive():
    limit = np.float32(LOST)
    assert evaluate(trace(distance={500: limit})).cost > 0
    assert evaluate(trace(distance={500: np.nextafter(limit, np.float32(0))})).cost == 0


@pytest.mark.parametrize(
    "name, value, status",
    [
        ("speed", np.nan, Status.NONFINITE),
        ("speed", np.inf, Status.NONFINITE | Status.SPEED),
        ("distance", np.nan, Status.NONFINITE),
        ("speed", 1001.0, Status.SPEED),
        ("height", -0.011, Status.PENETRATION),
    ],
)
def test_failures_are_flagged_with_their_step(name, value, status):
    result = evaluate(trace(**{name: {600: value}}))
    assert result.status == status and result.bad_step == 600
    assert result.cost == SCENE.cost.maximum and np.isinf(result.lost_time)


def test_what_follows_a_loss_does_not_fail_the_trial():
    """The trial is decided: engines need not simulate further, and may differ there."""
    result = evaluate(trace(400, speed={600: np.nan}))
    assert result.status == Status.OK and result.cost == pytest.approx(3.0 * 4.0 / 4.5)
    result = evaluate(trace(600, speed={400: np.nan}))
    assert result.status == Status.NONFINITE and result.bad_step == 400


def test_a_stuck_object_fails_the_trial():
    """At the end it must be far from the hand or lie on the table."""
    last = STEPS - 1
    assert evaluate(trace(distance={last: 0.05}, height={last: 0.25})).status == Status.STUCK
    assert evaluate(trace(distance={last: 0.05}, height={last: 0.03})).status == Status.OK
    assert evaluate(trace(distance={last: 0.09}, height={last: 0.25})).status == Status.OK
    # One that was lost before cannot be stuck.
    assert evaluate(trace(400, distance={last: 0.05}, height={last: 0.25})).status == Status.OK
    without = scene.load("paper_spheres", overrides={"effects": {"ungrasp": False}})
    without_release = jax.tree.map(lambda v: v[: without.num_steps], trace())
    assert grasps.outcome(without, without_release).status == Status.OK


def test_whether_an_object_rests_is_told_by_its_own_size():
    """A sphere of 30 mm that is held at 40 mm is stuck; a cuboid may stand there on a corner."""
    distant = trace(distance={STEPS - 1: 0.05}, height={STEPS - 1: 0.04})
    for name, size, status in (
        ("sphere", 1.0, Status.STUCK),
        ("sphere", 1.4, Status.OK),  # this trial's has 42 mm
        ("cuboid", 1.0, Status.OK),
        ("cuboid", 0.7, Status.STUCK),  # 36 mm from its centre to a corner
    ):
        trial = rollout.nominal_trial(SCENE, name)._replace(size=jnp.float32(size))
        assert judge(distant, trial).status == status, (name, size)


@pytest.mark.parametrize(
    ("shift", "lost_from", "status"),
    [
        ((0.0, 0.0), 400, Status.UNMOVED),
        ((0.0, 0.9e-3), 400, Status.UNMOVED),
        ((0.0, 1.1e-3), 400, Status.OK),
        ((-0.03, 0.0), 400, Status.OK),
        ((0.0, 0.0), None, Status.OK),  # kept, and put back where it was
    ],
)
def test_a_lost_object_that_stayed_where_it_was_put_is_told(shift, lost_from, status):
    """By its place on the table alone: under its weight it sinks."""
    trial = rollout.nominal_trial(SCENE, "sphere")._replace(position=jnp.array([0.01, -0.02]))
    place = np.zeros(7)
    place[:3] = 0.01 + shift[0], -0.02 + shift[1], 0.02
    last = np.concatenate([np.zeros(6 + layout(SCENE).dofs.size), place])
    result = judge(trace(lost_from)._replace(last=jnp.asarray(last, jnp.float32)), trial)
    assert result.status == status and not failed(int(result.status))
    assert judge(trace(lost_from), trial).status == Status.OK  # where no state is known


CAP = Status.SOLVER_CAP
OVERFLOW = Status.CONTACT_OVERFLOW


def with_status(bits, lost_from=None, residuals=None):
    """A grasp with bits, and residuals of its solver, at steps."""
    status = np.zeros(STEPS, np.int32)
    residual = np.zeros(STEPS, np.float32)
    for array, values in ((status, bits), (residual, residuals or {})):
        array[[*values]] = [*values.values()]
    recorded = None if residuals is None else jnp.asarray(residual)
    return trace(lost_from)._replace(status=jnp.asarray(status), residual=recorded)


@pytest.mark.parametrize(
    ("bits", "lost_from", "start", "status", "bad_step"),
    [
        ({100: CAP}, None, 0, CAP, -1),  # a warning: the trial counts
        ({399: CAP}, 400, 0, CAP, -1),
        ({400: CAP}, 400, 0, Status.OK, -1),  # no warning of what follows the verdict,
        ({500: CAP}, 400, 0, Status.OK, -1),
        ({STEPS - 1: CAP}, None, 0, Status.OK, -1),  # nor of a step to a state that nothing reads
        ({100: OVERFLOW, 50: CAP}, None, 0, OVERFLOW | CAP, 100),
        ({}, 400, Status.INVALID_START, Status.INVALID_START, 0),
    ],
)
def test_bits_of_steps_become_those_of_the_trial(bits, lost_from, start, status, bad_step):
    result = grasps.outcome(SCENE, with_status(bits, lost_from), int(start))
    assert result.status == status and result.bad_step == bad_step
    assert failed(int(result.status)) == (bad_step >= 0)
    expected = SCENE.cost.maximum if bad_step >= 0 else 0.0 if lost_from is None else 4.0 / 1.5
    assert result.cost == pytest.approx(expected, abs=1e-6)
    batch = jax.tree.map(lambda v: v[None], result)
    assert cost.particle_cost(SCENE, batch) == result.cost


def test_a_trial_tells_how_its_solver_ended_and_warns_above_the_scene_s_threshold():
    """Share and largest residual of the capped steps before the verdict."""
    strict = scene.load("paper_spheres", overrides={"newton.residual": 0.5})

    def outcome(residuals, lost_from=None):
        bits = {100: CAP, 200 if lost_from is None else 500: CAP}
        return grasps.outcome(strict, with_status(bits, lost_from, residuals))

    quiet = outcome({100: 0.3, 200: 0.5, 300: 9.0})  # that of a solved step is no news
    assert quiet.status == Status.OK and float(quiet.residual) == 0.5
    assert float(quiet.capped) == pytest.approx(2 / (STEPS - 1))  # nothing reads the last step
    assert outcome({100: 0.3, 200: 0.51}).status == CAP
    early = outcome({100: 0.3, 500: 0.9}, 400)
    assert early.status == Status.OK and float(early.capped) == pytest.approx(1 / 400)
    steps_only = evaluate(with_status({100: CAP}))  # as of MuJoCo C: any such step is a warning
    assert steps_only.status == CAP and np.isnan(steps_only.residual)
    nothing = evaluate(trace())  # as of MJX
    assert nothing.status == Status.OK and np.isnan([nothing.capped, nothing.residual]).all()


def outcomes(costs, statuses):
    shape = np.shape(costs)
    return Outcome(
        jnp.asarray(costs, jnp.float32),
        jnp.asarray(statuses, jnp.int32),
        jnp.zeros(shape),
        jnp.zeros(shape, jnp.int32),
    )


def test_exclusion_and_worst():
    """The paper's rule averages what is left; the strict one charges failed trials in full."""
    trials = outcomes(
        [[0.0, 3.0, 1.0], [3.0, 3.0, 0.5], [3.0, 3.0, 3.0]], [[0, 64, 0], [1, 2, 0], [1, 1, 1]]
    )
    np.testing.assert_allclose(cost.particle_cost(SCENE, trials), [0.5, 0.5, 3.0])
    worst = scene.load("paper_spheres", overrides={"cost": {"failure": "worst"}})
    np.testing.assert_allclose(cost.particle_cost(worst, trials), [4 / 3, 6.5 / 3, 3.0])
