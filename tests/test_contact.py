"""The object on its table: rest, friction cone, creep, sliding and tipping, by closed forms."""

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
import scipy.optimize

from codesign_jax.engines.structured.laws import cones, contact
from tests.helpers.grasps import SHAPES, pinch
from tests.helpers.tables import GRAVITY, MASS, MU, Table

CORNERS = {"box": 4, "cylinder": 3, "capsule": 2, "sphere": 1}  # contact points of a resting object


@pytest.mark.parametrize("shape", SHAPES)
def test_resting_object(shape):
    """Sinks m g / (n k) with the declared stiffness, doubled at the table, and stays."""
    table = Table(shape)
    position, velocity = table.run(12.0)
    start = table.model.qpos0[-7:-4]
    assert table.data.ncon == CORNERS[shape]
    stiffness = 2 * table.scene.contact.normal_stiffness
    sunk = start[2] - position[-1, 2]
    assert sunk == pytest.approx(MASS * GRAVITY / (CORNERS[shape] * stiffness), rel=1e-3)
    late = position[-1000:]
    assert np.abs(late - late[0]).max() < 1e-9  # ten seconds: no drift
    assert np.abs(velocity[-1]).max() < 1e-9
    force = np.zeros(6)
    total = 0.0
    for i in range(table.data.ncon):
        mujoco.mj_contactForce(table.model, table.data, i, force)
        total += force[0]
    assert total == pytest.approx(MASS * GRAVITY, rel=1e-6)


@pytest.mark.parametrize("dissipation", [0.0, 0.006, 0.03])
@pytest.mark.parametrize("timestep", [0.01, 0.001])
def test_a_step_ends_with_the_force_at_its_end(dissipation, timestep):
    """A ball falls on the table and bounces: f = -k (g + (h + tau) v) of each step's end, no pull.

    MuJoCo C with our numbers, at any time step; g is the gap at the beginning of the step.  What
    does not act ahead of touch dissipates over one and a half steps at least.
    """
    table = Table(
        "sphere", contact__dissipation_time=dissipation, discretization__timestep=timestep
    )
    tau = max(dissipation, 1.5 * timestep)
    touch = table.data.qpos[-5]
    table.data.qpos[-5] += 0.02
    position, velocity = table.run(0.3)
    k, h, ends = 2 * table.scene.contact.normal_stiffness, timestep, velocity[:, 2]
    gaps = position[:, 2] - h * ends - touch  # at the beginning of each step
    force = np.where(gaps < 0, np.maximum(-k * (gaps + (h + tau) * ends), 0), 0)
    before = np.append(0, ends[:-1])
    assert (force > 0).sum() > 3
    np.testing.assert_allclose(ends, before + h * (force / MASS - GRAVITY), atol=1e-6)


@pytest.mark.parametrize("gap", [-2e-3, -1e-5, 1e-5, 2e-3])
@pytest.mark.parametrize("speed", [-2.0, -0.1, 0.3])
def test_a_contact_is_the_least_of_a_convex_problem(gap, speed):
    """A free mass under our cone against the law in closed form, in touch and ahead of it.

    Ahead of touch the gap closes within the step at the earliest: f = -k (h + tau) (v + g / h).
    """
    scene = pinch("sphere", links=1)
    h = scene.discretization.timestep
    tau = max(scene.contact.dissipation_time, 1.5 * h)
    with jax.enable_x64(True):
        cone = cones.make_cone(scene, MU, bodies=2)
        up = jnp.array([0.0, 0.0, 1.0])
        one = contact.Contacts(0.0 * up, up, jnp.float64(gap), cone)
        wanted = one.reference(speed * up)
        pushed = jax.jit(lambda a: contact.constraint_update(one, a * up - wanted).force[2])
        found = scipy.optimize.brentq(lambda a: MASS * (a + GRAVITY) - float(pushed(a)), -1e4, 1e4)
    k = scene.contact.normal_stiffness
    coming = gap / h if gap > 0 else gap / (h + tau)
    after = (MASS * (speed / h - GRAVITY) - k * (h + tau) * coming) / (MASS / h + k * (h + tau))
    after = after if -k * (h + tau) * (after + coming) > 0 else speed - h * GRAVITY
    assert speed + h * found == pytest.approx(after, abs=1e-9)


def creep(table, shape, angle):
    """Steady speed below the cone: F / (n k r 40 ms) for a friction ratio r, whatever the step.

    The table's contacts are twice as stiff; n of them share m g sin(angle).
    """
    contact, n = table.scene.contact, CORNERS[shape]
    damper = 2 * contact.normal_stiffness * contact.friction_ratio * 0.04
    return MASS * GRAVITY * np.sin(angle) / (n * damper)


@pytest.mark.parametrize("shape", ["box", "cylinder"])
def test_incline_below_the_friction_angle_holds(shape):
    """At 0.9 of the friction angle the object only creeps, at the soft contact's own speed."""
    angle = 0.9 * np.arctan(MU)
    flat, full = Table(shape, angle, flat=True), Table(shape, angle)
    (_, slow), (_, velocity) = flat.run(3.0), full.run(3.0)
    expected = creep(flat, shape, angle)
    assert slow[-1, 0] == pytest.approx(expected, rel=1e-6)
    assert np.abs(slow[-1, 1:]).max() < 1e-9
    # Uphill contacts of a tall object carry less, slip, and leave the rest to the others.
    assert expected < velocity[-1, 0] < 2 * expected < 1e-3


@pytest.mark.parametrize("shape", ["box", "cylinder"])
def test_incline_above_the_friction_angle_slides(shape):
    """At 1.1 of the friction angle: a = g (sin - mu cos), on average.

    MuJoCo's elliptic cone couples slip into the normal direction, so that a sliding object floats
    up and hops; over many hops the impulses obey Coulomb's law, within 3 % of friction at 10 ms:
    the acceleration is what is left of friction and weight.
    """
    angle = 1.1 * np.arctan(MU)
    expected = GRAVITY * (np.sin(angle) - MU * np.cos(angle))
    for timestep, error in ((0.01, 0.3), (0.002, 0.08)):
        table = Table(shape, angle, flat=True, discretization__timestep=timestep)
        _, velocity = table.run(1.0)
        assert velocity[-1, 0] == pytest.approx(expected, rel=error)
