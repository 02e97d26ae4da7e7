"""The object on its table: rest, friction cone, creep, sliding and tipping, by closed forms."""

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
import scipy.optimize
from scipy import integrate

from codesign_jax import control
from codesign_jax.engines.structured.laws import cones, contact
from codesign_jax.model import morphology
from tests.helpers import grasps
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
    k = 2 * table.scene.contact.normal_stiffness
    h = timestep
    ends = velocity[:, 2]
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
        cone = cones.make_cone(scene, MU, bodies=2, ratio=1.0)
        up = jnp.array([0.0, 0.0, 1.0])
        pair = contact.Contacts(0.0 * up, up, jnp.float64(gap), cone)
        reference = pair.reference(speed * up)
        pushed = jax.jit(lambda a: contact.constraint_update(pair, a * up - reference).force[2])
        acceleration = scipy.optimize.brentq(
            lambda a: MASS * (a + GRAVITY) - float(pushed(a)), -1e4, 1e4
        )
    k = scene.contact.normal_stiffness
    coming = gap / h if gap > 0 else gap / (h + tau)
    after = (MASS * (speed / h - GRAVITY) - k * (h + tau) * coming) / (MASS / h + k * (h + tau))
    after = after if -k * (h + tau) * (after + coming) > 0 else speed - h * GRAVITY
    assert speed + h * acceleration == pytest.approx(after, abs=1e-9)


@pytest.mark.parametrize("shape", ["box", "cylinder"])
def test_incline_below_the_friction_angle_holds(shape):
    """At 0.9 of the friction angle the object only creeps, at the soft contact's own speed.

    F / (n k r 40 ms) for a friction ratio r, whatever the step: the table's contacts are twice as
    stiff; n of them share m g sin(angle).
    """
    angle = 0.9 * np.arctan(MU)
    flat = Table(shape, angle, flat=True)
    full = Table(shape, angle)
    _, slow = flat.run(3.0)
    _, velocity = full.run(3.0)
    contact = flat.scene.contact
    damper = 2 * contact.normal_stiffness * contact.friction_ratio * 0.04
    expected = MASS * GRAVITY * np.sin(angle) / (CORNERS[shape] * damper)
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


# --- physics of the effects against closed forms, quadrature and scipy's integrators --------------


WIDTH = 0.020
G = 70e3
"""Width of the section [m] and shear modulus [Pa] of the paper's fingers."""


def moment(kappa, height, wall):
    """The neo-Hookean moment by quadrature over the section [N m]."""

    def density(y):
        stretch = 1 + kappa * y
        hollow = wall < y < height - wall
        return G * (stretch - stretch**-3) * y * (2 * wall if hollow else WIDTH)

    edges = [0, wall, height - wall, height]
    return sum(integrate.quad(density, a, b)[0] for a, b in zip(edges, edges[1:], strict=False))


@pytest.mark.parametrize("height,wall", [(0.020, 0.005), (0.015, 0.007), (0.025, 0.002)])
def test_neo_hookean_moment(height, wall):
    """E I kappa (1 - softening) is the integral of the stress, up to a stretch of 3."""
    beam = morphology.beam(height, wall, width=WIDTH, shear_modulus=G, density=1.0)
    for kappa in (1e-3, 1.0, 10.0, 100.0):
        share = morphology.softening(np.float64(kappa), height, wall, width=WIDTH)
        expected = moment(kappa, height, wall)
        assert beam.bending * kappa * (1 - share) == pytest.approx(expected, rel=1e-10)
        assert 0 < share < 0.75
    backwards = morphology.softening(np.float64(-10.0), height, wall, width=WIDTH)
    assert backwards == 0


def test_supply_against_an_integrator():
    """Lag, rate and maximum at once, along a grasp, against scipy's adaptive integrator."""
    h = 1e-3
    count = 9000
    scene = grasps.pinch(
        effects__pressure_dynamics=True,
        pneumatics__lag=0.15,
        pneumatics__rate=120e3,
        pneumatics__maximum=90e3,
        discretization__timestep=h,
    )
    time = np.arange(count) * h
    p = scene.phases
    end = scene.window[1]
    keys = [p.approach, p.inflate, end, end + p.deflate_time]
    commanded = 130e3 * np.interp(time, keys, [0.0, 1.0, 1.0, 0.0])[None]
    with jax.enable_x64(True):
        reached = np.asarray(control.supplied(scene, jnp.asarray(commanded).T)[0]).T[0]

    def rate(t, p):
        goal = min(commanded[0, min(int(t / h + 1e-9), count - 1)], 90e3)
        return np.clip((goal - p) / 0.15, -120e3, 120e3)

    options = {"max_step": 0.02, "rtol": 1e-6, "atol": 1.0}
    exact = integrate.solve_ivp(rate, (0, time[-1]), [0.0], t_eval=time, **options).y[0]
    # A step of 1 ms of at most 120 kPa/s is 120 Pa, and the demand is held over it.
    np.testing.assert_allclose(reached, exact, atol=130)
    assert reached.max() == pytest.approx(90e3, rel=1e-3)
    assert np.abs(np.diff(reached)).max() <= 120e3 * h * (1 + 1e-9)


@jax.enable_x64(True)
def some_contacts(friction, rng, count):
    """Contacts with random places and normals, world by world, and a pinch scene's cone."""
    scene = grasps.pinch(effects__friction=friction)
    normal = rng.normal(size=(3, 1, count))
    return contact.Contacts(
        point=jnp.asarray(0.05 * rng.normal(size=(3, 1, count))),
        normal=jnp.asarray(normal / np.linalg.norm(normal, axis=0)),
        gap=jnp.asarray(np.full((1, count), -1e-3)),
        cone=jax.jit(lambda: cones.make_cone(scene, 0.8, bodies=2, ratio=30.0))(),
    )


@jax.jit
def pushes(c, relative):
    """Wrenches, inertias and forces of contacts that accelerate so, relative to their aims."""
    answer = contact.constraint_update(c, relative)
    inertia = contact.contact_inertia(c, answer.hessian)
    return contact.contact_wrench(c, answer.force), inertia, answer.force


@pytest.mark.parametrize("friction", ["coulomb", pytest.param("none", marks=pytest.mark.slow)])
def test_force_and_inertia_are_derivatives_of_the_cost(friction):
    """In spatial accelerations, by automatic differentiation of the cost, in every zone."""
    rng = np.random.default_rng(3)
    count = 60
    c = some_contacts(friction, rng, count)
    with jax.enable_x64(True):
        # Towards the surface, along it, and turning, in all proportions.
        a = rng.normal(size=(6, 1, count)) * 10 ** rng.uniform(-1, 2, size=(6, 1, count))
        a[3:] += np.asarray(c.normal) * rng.normal(size=count) * 100
        a = jnp.asarray(a)

        def costs(a):
            return contact.constraint_update(c, c.relative(a)).cost

        def gradient(a):
            return jax.grad(lambda a: costs(a).sum())(a)

        along = jnp.eye(6)[:, :, None, None] * jnp.ones_like(a)
        hessian = jax.jit(jax.vmap(lambda v: jax.jvp(gradient, (a,), (v,))[1]))(along)
        wrench, inertia, _ = pushes(c, c.relative(a))
        size = float(jnp.abs(hessian).max())
        np.testing.assert_allclose(-wrench, jax.jit(gradient)(a), rtol=1e-9, atol=1e-9 * size)
        np.testing.assert_allclose(inertia, hessian, rtol=1e-9, atol=1e-9 * size)
        ranks = np.linalg.matrix_rank(np.moveaxis(np.asarray(inertia)[:, :, 0], -1, 0), tol=1e-9)
    # Apart, sliding (the cone's edge is curved in all tangential directions but the slip's) and
    # sticking.
    expected = {"none": {0, 1}, "coulomb": {0, 2, 3}}[friction]
    assert expected <= set(ranks)
