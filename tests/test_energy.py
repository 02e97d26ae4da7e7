"""The energy audit: closed forms, a sound world, and planted sources of energy that it must see."""

import dataclasses
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from codesign_jax import model
from codesign_jax.engines.structured.laws import inertia
from codesign_jax.scene import beams, section_numbers
from scripts.shared import energy
from tests.helpers import grasps
from tests.helpers.planted_faults import Fault, planted, simulate

STEPS = 30
SETTINGS = {
    "effects__surface": "hull",
    "effects__finger_finger": True,
    "effects__friction_memory": True,
    "discretization__integrator": "newmark",
}
BOUND = 0.01
"""Largest rise of a sound world over its energy at the start [chosen]; sources cause ten times it.
What sound worlds gain is of the second order of a step of 10 ms."""


def link(**wrong):
    """A stage of a link with other constants or joint states, functions of all of them, by name."""

    def stage(right, the_scene, parent, constants, joint):
        both = constants | joint
        new = {name: change(both) for name, change in wrong.items()}
        constants = {k: new.get(k, v) for k, v in constants.items()}
        return right(the_scene, parent, constants, {k: new.get(k, v) for k, v in joint.items()})

    return stage


def explicit(right, the_scene, *args):
    """Velocity products whole, however fast a link turns."""
    step = dataclasses.replace(the_scene.discretization, timestep=1e-9)
    return right(dataclasses.replace(the_scene, discretization=step), *args)


def nothing_carried(right, *args):
    *chains, force = right(*args)
    return *chains, 0 * force


def outwards(both):
    """1 where a joint moves away from straight, -1 where it returns."""
    return jnp.sign(both["finger"] * both["finger_vel"])


FAST = "velocity products"
SOURCES = {
    FAST: Fault({"link_forces": explicit, "carried_momentum": nothing_carried}),
    "springs": Fault(
        {"link_forces": link(stiffness=lambda b: b["stiffness"] * (1 - 0.5 * outwards(b)))}
    ),
    "chambers": Fault(
        {"link_forces": link(pressure=lambda b: b["pressure"] * (1 + outwards(b)[0]))}
    ),
    "contacts": Fault(
        {
            "as_candidates": lambda f, margin, place, cone, acc, vel: f(
                margin, place, cone, acc, -vel
            )
        }
    ),
}


@pytest.fixture(scope="module")
def audited():
    """Largest rises of a world for each source, and of sound ones at both starts.

    Fingers and object meet, and the table; in worlds of FAST fingers turn by a radian a step.
    """
    with jax.enable_x64(True), planted(SOURCES):
        the_scene = grasps.pinch("box", links=3, **SETTINGS)
        names = [*SOURCES, "none", f"none, {FAST}"]
        count = len(names)
        hand = grasps.hand_world(the_scene, length=0.15, wall=0.002, height=0.0165)
        fields, _ = grasps.world_inputs(the_scene, *hand)
        random = np.random.default_rng(3)
        qpos = np.array(fields.start)
        qpos[2] = 0.1
        dofs = model.layout(the_scene).dofs
        qpos[dofs] = 0.1 * random.normal(size=dofs.shape)
        qvel = np.zeros(len(qpos) - 1)
        qvel[dofs] = 40.0 * random.normal(size=dofs.shape)
        qvel[-4] = -0.3  # onto the table
        ctrl = np.repeat(np.append(qpos[:6], [60e3] * the_scene.num_fingers)[None], STEPS, 0)
        many, ctrl = grasps.repeat((fields, jnp.asarray(ctrl)), count)
        state = np.repeat(qpos[None], count, 0), np.repeat(qvel[None], count, 0)
        for world in (names.index(FAST), count - 1):
            state[0][world, 2] = 0.3
            state[1][world] = 0.0
            state[1][world, dofs[:, 0, 0]] = 100.0
        run = jax.jit(partial(simulate, the_scene))
        series = run(many, state, ctrl, np.arange(count))
        path = energy.Path(series["qpos"], series["qvel"], series.get("held"))
        audit = energy.audit(the_scene, many, ctrl, path)
    return dict(zip(names, audit.rise() / audit.stored[:, 0], strict=True))


@pytest.mark.slow  # 15 s; quick: closed forms of the energy, and planted faults of the same laws
def test_sound_worlds_gain_nothing(audited):
    assert audited["none"] < BOUND and audited[f"none, {FAST}"] < BOUND, audited


@pytest.mark.slow  # as the test before it
@pytest.mark.parametrize("name", SOURCES)
def test_a_source_of_energy_is_seen(audited, name):
    assert audited[name] > 10 * BOUND, audited


def test_moments_of_a_section_are_the_slopes_of_its_energy():
    """By JAX, with a thread that is wound one way: slack and taut, bent, twisted and sideways."""
    with jax.enable_x64(True):
        the_scene = grasps.pinch(section__law="elements", effects__neo_hookean=True)
        n = section_numbers.numbers(
            np.array(20e-3),
            np.array(4e-3),
            np.array(24e-3),
            shear_modulus=88e3,
            length=0.1,
            thread_depth=0.4,
            winding_angle=0.02,
            crossed=False,
        )
        law = jnp.stack([*map(jnp.asarray, n), jnp.array(0.01)])
        constants = [jnp.ones(3)] * 3
        for pressure in (-10e3, 0.0, 50e3):
            energy_of = partial(inertia.joint_energy, {"law": law}, jnp.array(pressure))
            for q in jnp.array([[0.15, 0.05, -0.2], [-0.1, -0.08, 0.1], [1e-3, 0.002, 0.06]]):
                springs = inertia.section_springs(the_scene, constants, law, jnp.array(pressure), q)
                slope = jax.grad(energy_of)(q)
                np.testing.assert_allclose(springs.moments, -slope, rtol=1e-9, atol=1e-13)
                assert (springs.stiffness >= 1).all()  # never less than at rest


@pytest.mark.parametrize("threshold", [False, True])
def test_joint_moments_are_the_slopes_of_the_energy(threshold):
    """Of springs, softening, chamber and threshold, by JAX."""
    with jax.enable_x64(True):
        constants = {
            "stiffness": jnp.array([0.02, 0.03, 0.01]),
            "gain": jnp.array(1.5e-6),
            "section": jnp.array([0.0165, 0.002, 0.017, 0.02]),
        }
        if threshold:
            constants["threshold"] = jnp.array([1e-6, 0.004, 0.01])
        pressure = jnp.array(50e3)
        for q in jnp.array([[0.5, 0.1, -0.2], [-0.3, -0.4, 0.1], [1e-3, 0.02, 0.6]]):
            slope = jax.grad(partial(inertia.joint_energy, constants, pressure))(q)
            stiffness = constants["stiffness"]
            moment = -stiffness * q
            more = constants["gain"] * pressure
            more += inertia.softening_moment(constants["section"], stiffness[0], q[0])
            if threshold:
                numbers = tuple(constants["threshold"])
                spring, bend = model.morphology.threshold_moments(numbers, pressure, q[0], q[1])
                moment = moment.at[1].add(-spring * q[1])
                more += bend
            np.testing.assert_allclose(-slope, moment.at[0].add(more), rtol=1e-12, atol=1e-15)


def test_bending_energy_is_that_of_a_neo_hookean_section():
    """By quadrature of the strain energy G/2 (lambda^2 + lambda^-2 - 2) over the section."""
    height = 0.0165
    wall = 0.002
    width = 0.02
    x, w = np.polynomial.legendre.leggauss(60)
    for kappa in (1.0, 30.0, 150.0):
        energy_per_length = 0.0
        edges = (0.0, wall, height - wall, height)
        for (low, high), span in zip(
            zip(edges, edges[1:], strict=False), (width, 2 * wall, width), strict=True
        ):
            y = low + (high - low) * (x + 1) / 2
            stretch = 1 + kappa * y
            density = (stretch**2 + stretch**-2 - 2) / 2
            energy_per_length += span * (density * w).sum() * (high - low) / 2
        linear = beams.beam(
            np.array(height), np.array(wall), width=width, shear_modulus=1.0, density=1.0
        ).bending
        share = beams.softening_energy(np.array(kappa), height, wall, width=width)
        expected = linear * kappa**2 / 2 * (1 - share)
        np.testing.assert_allclose(energy_per_length, expected, rtol=1e-10)


SPIN = np.array([60.0, -50.0, 62.0])
"""Angular velocity of a thrown object [rad/s], 100 in all: a radian in a step of 10 ms."""


@pytest.mark.parametrize("timestep", [0.02, 0.01, 0.005])
def test_a_thrown_object_keeps_its_spin(timestep):
    """Half a second of flight of a box with edges as 1 : 1 : 2, by the moment and the integrator.

    Explicit gyroscopic moments multiply its energy by more than a hundred.
    """
    with jax.enable_x64(True):
        principal = jnp.array([5.0, 5.0, 2.0]) * 1e-5
        omega = jnp.array(SPIN)
        tensor, inverse = jnp.diag(principal), jnp.diag(1 / principal)
        kinetic = []
        for _ in range(round(0.5 / timestep)):
            kinetic.append(float(omega @ tensor @ omega / 2))
            moment = inertia.gyroscopic_moment(tensor, inverse, omega, timestep)
            omega = omega + timestep * inverse @ moment  # along the body's axes, as `integrate`
    assert max(kinetic) < 1.05 * kinetic[0]
    assert min(kinetic) > 0.5 * kinetic[0]
