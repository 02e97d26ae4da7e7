"""Pressure against sideways bending, in float64: stored energy by quadrature, MuJoCo C, faults."""

import functools
from functools import partial

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from scipy import integrate

from codesign_jax import model, scene
from codesign_jax.model import morphology
from codesign_jax.scene import schema
from tests.helpers import grasps
from tests.helpers.curled_hands import batched, curled
from tests.helpers.planted_faults import Fault, planted, simulate

BOUND = 1e-8
"""As in test_steps.py."""
SETTINGS = {"effects__lateral_threshold": True}


def hand_and_numbers(the_scene):
    """Parameters of the hand, and the numbers of its first finger's joints."""
    params, _ = grasps.hand_world(the_scene, length=0.1)
    links = the_scene.discretization.links
    beams = morphology.finger_beams(the_scene.hand, params, links)
    numbers = morphology.thresholds(the_scene.hand, params, beams, links)[0, 0]
    return params, jax.tree.map(lambda v: v[:, 0], beams), numbers


# --- the law -------------------------------------------------------------------------------------


def stored(the_scene, params, pressure, bend, lateral):
    """Energy of a length of the first finger [J/m] by quadrature over its section.

    Walls of modulus 4 G in plane strain, and the chamber's volume times the pressure.  The fibre
    at height y and z has the strain that leaves the one bottom edge as long as it is: the left one
    or the right one, by the sign of the lateral curvature.
    """
    width, shear = the_scene.hand.section.width, the_scene.hand.material.shear_modulus
    height, wall = float(params.height[0]), float(params.wall[0])

    def strain(y, z):
        return bend * y - abs(lateral) * width / 2 + lateral * z

    def over(y0, y1, half, value):
        return integrate.dblquad(lambda z, y: value(y, z), y0, y1, -half, half, epsrel=1e-12)[0]

    chamber = wall, height - wall, width / 2 - wall
    energy = over(0, height, width / 2, lambda y, z: strain(y, z) ** 2)
    energy -= over(*chamber, lambda y, z: strain(y, z) ** 2)
    return 2 * shear * energy - pressure * over(*chamber, strain)


@pytest.mark.parametrize("lateral", [12.0, -12.0])
def test_moments_are_those_of_the_stored_energy(lateral):
    """Virtual work: slopes of the energy by both curvatures, where one edge has let go.

    The smoothing is off by (q_0/q)^2/2, 6e-4 at 12 /m; the energy is quadratic in the curvatures
    on either side, so that central differences are exact.
    """
    with jax.enable_x64(True):
        the_scene = scene.load("paper", overrides={"effects.lateral_threshold": True})
        params, beams, numbers = hand_and_numbers(the_scene)
        links, pressure, bend, small_step = the_scene.discretization.links, 69e3, 15.0, 0.5
        segment = float(params.length[0]) / links
        slopes = [
            (
                stored(the_scene, params, pressure, bend + b, lateral + s)
                - stored(the_scene, params, pressure, bend - b, lateral - s)
            )
            / (2 * small_step)
            for b, s in ((small_step, 0.0), (0.0, small_step))
        ]
        stiffness, moment = morphology.threshold_moments(
            tuple(map(jnp.asarray, numbers)),
            pressure,
            jnp.asarray(bend * segment),
            jnp.asarray(lateral * segment),
        )
        # As in `beam`, without the calibrated factor on the lateral spring.
        lateral_spring = beams.lateral[0] / the_scene.hand.material.lateral_factor
        mine = (
            beams.bending[0] * bend - pressure * beams.moment_per_pressure[0] - moment,
            lateral_spring * lateral + stiffness * lateral * segment,
        )
        # The smoothed length lacks q_0.
        mine = float(mine[0] - numbers[1] * numbers[2]), float(mine[1])
        assert float(stiffness) * abs(lateral) * segment > 0.01 and float(moment) > 1e-3
    np.testing.assert_allclose(mine, slopes, rtol=1e-3)


def test_it_needs_sideways_bending():
    with pytest.raises(schema.InputError, match="lateral_bending = false leaves out"):
        scene.load(
            "paper",
            overrides={"effects.lateral_threshold": True, "effects.lateral_bending": False},
        )


# --- the kernel ----------------------------------------------------------------------------------


def numbers_of(*factors):
    """Other numbers of the threshold."""

    def stage(right, the_scene, parent, constants, joint):
        numbers = constants["threshold"]
        scale = jnp.asarray(factors).reshape(-1, *[1] * (numbers.ndim - 1))
        return right(the_scene, parent, constants | {"threshold": scale * numbers}, joint)

    return Fault({"link_forces": stage})


def explicit(right, the_scene, parent, constants, joint):
    carry, found = right(the_scene, parent, constants, joint)
    return carry, found | {"armature_now": constants["armature"]}


FAULTS = {
    "sideways only the walls resist": numbers_of(0.0, 1.0, 1.0),
    "bending does not slacken the layer": numbers_of(1.0, 0.0, 1.0),
    "edges let go late": numbers_of(1.0, 1.0, 2.0),
    "the spring's inertia is left out": Fault({"link_forces": explicit}),
}


def stiffen(the_scene, model_, data, fields):
    """Gives MuJoCo's joints the springs of this state, and the moments on its bend hinges."""
    lay, h = model.layout(the_scene), the_scene.discretization.timestep
    angles = data.qpos[lay.dofs]
    for f, j in np.ndindex(*lay.dofs.shape[:2]):
        bend, lateral = lay.dofs[f, j, :2]
        numbers, (q, s) = np.asarray(fields.threshold)[0, f, 0], angles[f, j, :2]
        moment = max(numbers[0] * data.ctrl[6 + f] - numbers[1] * q, 0.0)
        length = np.hypot(s, numbers[2])
        added = moment / length
        model_.jnt_stiffness[lateral] += added
        if the_scene.discretization.spring_damping == "added":
            damping = model_.dof_damping[lateral] + h * added
        else:
            damping = max(model_.dof_damping[lateral], h * model_.jnt_stiffness[lateral])
        model_.dof_damping[lateral], model_.dof_armature[lateral] = damping, h * damping
        if moment > 0:
            data.qfrc_applied[bend] += numbers[1] * (length - numbers[2])


@functools.cache
def simulated(damping):
    """Relative errors of a step's accelerations, of each fault's world and of a sound one."""
    with jax.enable_x64(True):
        the_scene = grasps.pinch(
            "sphere", links=2, discretization__spring_damping=damping, **SETTINGS
        )
        model_, data, fields = curled(the_scene, 3, 0.4, 0.09)
        faults = FAULTS if damping == "added" else {}
        fields_, qpos, qvel, ctrl = batched([(model_, data, fields)] * (len(faults) + 1))
        with planted(faults):
            run = jax.jit(partial(simulate, the_scene))
            ctrl = jnp.asarray(np.repeat(ctrl[:, None], 2, 1))
            found = run(fields_, (qpos, qvel), ctrl, np.arange(len(qpos)))
    stiffen(the_scene, model_, data, fields)
    mujoco.mj_forward(model_, data)
    acc = (np.asarray(found["qvel"])[:, 1] - qvel) / the_scene.discretization.timestep
    return np.linalg.norm(acc - data.qacc, axis=1) / np.linalg.norm(data.qacc)


@pytest.mark.parametrize(
    "damping", ["added", pytest.param("least", marks=pytest.mark.slow)]
)  # quick: the other one, in the same lines
def test_accelerations_equal_mujoco_with_the_springs_of_the_state(damping):
    assert simulated(damping)[-1] < BOUND


@pytest.mark.parametrize("name", FAULTS)
def test_a_planted_fault_is_noticed(name):
    """By a hundred times the bound."""
    assert not simulated("added")[[*FAULTS].index(name)] < 100 * BOUND
