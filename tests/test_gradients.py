"""Gradients of the structured engine against central differences of the same program.

All cases are worlds of one batch in float64, so that they share one compile: the world, its
perturbed copies, and a push on the object that no scene has.
"""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from codesign_jax import control, model
from codesign_jax.engines.structured import StructuredEngine
from codesign_jax.engines.structured.lanes import spatial
from tests import small

# One program, but its derivative compiles in two minutes of a core's time.
pytestmark = pytest.mark.slow

STEPS, STEP = 50, 2e-6
# Factors on the design's lengths, pressures, the object's mass and size, then lift of the arm [m],
# lift of the object [m], push along x [N] and start velocity along x [m/s].
NAMES = ("length", "pressure", "mass", "size", "arm", "height", "push", "velocity")
START = {"length": 1.0, "pressure": 1.0, "mass": 1.0, "size": 1.0}
WEIGHT = 0.1 * 9.81  # of the box [N]; its friction with the table is 0.5
AWAY = {"arm": 0.1}  # the hand stays high above everything

# Case: values, the parameters to check and the relative tolerance.  Central differences with a
# step e lose e^2 f'''/6f' to truncation and 1e-16 f/(e f') to rounding, each about 1e-9 here at
# e = 1e-5 to 1e-6; contact adds the solver's error of about 1e-12 / e.
CASES = {
    "bending": (AWAY, ("length", "pressure"), 1e-7),
    "falling": (AWAY | {"height": 2.0}, ("height", "velocity"), 1e-8),
    "resting": (AWAY | {"height": 1e-3}, ("mass", "size", "height"), 1e-6),
    "sticking": (AWAY | {"push": 0.25 * WEIGHT}, ("push", "mass", "size"), 1e-6),
    "sliding": (AWAY | {"push": 0.9 * WEIGHT}, ("push", "mass", "velocity"), 1e-6),
    "grasp": ({}, ("length", "pressure", "mass", "size", "arm"), 1e-6),
}


class Pushed(StructuredEngine):
    """The engine with a horizontal force at the object's centre, a further row of the controls."""

    def problem(self, run, hand, state, ctrl):
        problem, velocity = super().problem(run, hand, state, ctrl[:-1])
        zero = jnp.zeros_like(problem.kin.object_pos)
        force = zero.at[0].set(ctrl[-1:])
        wrench = spatial(jnp.cross(problem.kin.object_pos, force, axis=0), force)
        smooth = problem.smooth._replace(object=problem.smooth.object + wrench)
        return problem._replace(smooth=smooth), velocity


def short_grasp():
    """Half a second: the hand comes down beside the box, closes and begins to lift."""
    return small.pinch(
        "box",
        phases__approach=0.2,
        phases__inflate=0.35,
        phases__lift=0.5,
        effects__disturb=False,
        effects__ungrasp=False,
        effects__palm_object=False,
        effects__palm_table=False,
        arm__start_height=0.15,
    )


def tight(scene, kind=StructuredEngine):
    """An engine whose solver converges to rounding: differences divide its error by 1e-6."""
    return kind(scene, iterations=50, evaluations=20, tolerance=1e-24, kernel=False)


def world(scene, design, value):
    """Model fields and controls of one world from a design, its trial and the values of NAMES."""
    params, trial = design
    params = params._replace(
        length=params.length * value["length"],
        pressure=params.pressure * value["pressure"] * jnp.array([1.0, 0.9]),
        arm=params.arm + value["arm"] * jnp.eye(6)[2],
    )
    trial = trial._replace(
        mass=value["mass"], size=value["size"], yaw=0.1, position=jnp.array([0.003, 0.002])
    )
    trial = jax.tree.map(jnp.asarray, trial)
    fields = model.model_fields(scene, params, trial)
    start = fields.start.at[-5].add(value["height"])
    ctrl = control.commands(scene, params, trial)
    # The start velocity is an impulse of the first step.
    impulse = 0.1 * value["mass"] * value["velocity"] / scene.discretization.timestep
    push = jnp.full(STEPS, value["push"]).at[0].add(impulse)
    return fields._replace(start=start), jnp.column_stack([ctrl, push])


def simulate(scene, design, values):
    """A weighted sum of every world's final coordinates, and the box's position in them."""
    values = dict(zip(NAMES, values.T, strict=True))
    fields, ctrl = jax.vmap(lambda v: world(scene, design, v))(values)
    qpos = tight(scene, Pushed).rollout(fields, ctrl, trajectory=True).qpos[:, -1]
    weights = np.random.default_rng(0).normal(size=qpos.shape[1])
    return qpos @ weights, qpos[:, -7:-4]


@pytest.fixture(scope="module")
def checked():
    """By case: gradients, central differences, final position of the object."""
    scene, rows, where = short_grasp(), [], {}
    for case, (changes, names, _) in CASES.items():
        base = np.array([{**START, **changes}.get(n, 0.0) for n in NAMES])
        where[case] = len(rows)
        rows.append(base)
        for name in names:
            for step in (STEP, -STEP):
                rows.append(base + step * (np.array(NAMES) == name))
    design = small.hand_world(scene)
    with jax.enable_x64(True):

        def loss(values):
            value, place = simulate(scene, design, values)
            return value.sum(), (value, place)

        run = jax.jit(jax.grad(loss, has_aux=True))
        slope, (value, place) = jax.tree.map(np.asarray, run(jnp.array(rows)))
    found = {}
    for case, (_, names, _) in CASES.items():
        first = where[case]
        sides = value[first + 1 : first + 1 + 2 * len(names)].reshape(-1, 2)
        differences = (sides[:, 0] - sides[:, 1]) / (2 * STEP)
        columns = [NAMES.index(n) for n in names]
        found[case] = slope[first, columns], differences, place[first]
    return found


@pytest.mark.parametrize("case", CASES)
def test_gradient_equals_central_differences(checked, case):
    slope, differences, _ = checked[case]
    error = np.abs(slope - differences).max() / np.abs(slope).max()
    print(case, error)
    assert error < CASES[case][2], (slope, differences)


def test_the_cases_are_what_they_say(checked):
    """The box falls freely, rests, creeps below and slides above the friction limit, is held."""
    place = {case: v[2] for case, v in checked.items()}
    fallen = 9.81 * 0.01**2 * (STEPS - 1) * STEPS / 2
    assert place["falling"][2] == pytest.approx(2.03 - fallen, abs=1e-9)
    assert abs(place["resting"][2] - 0.03) < 1e-3
    assert 1e-6 < place["sticking"][0] - 0.003 < 1e-3
    assert place["sliding"][0] - 0.003 > 0.1
