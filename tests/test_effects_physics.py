"""Physics of the effects against closed forms, quadrature and scipy's integrators."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import integrate

from codesign_jax import control
from codesign_jax.engines.structured.laws import cones, contact
from codesign_jax.model import morphology
from tests.helpers import grasps

WIDTH, G = 0.020, 70e3
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


# --- air supply ----------------------------------------------------------------------------------


def test_supply_against_an_integrator():
    """Lag, rate and maximum at once, along a grasp, against scipy's adaptive integrator."""
    h, count = 1e-3, 9000
    scene = grasps.pinch(
        effects__pressure_dynamics=True,
        pneumatics__lag=0.15,
        pneumatics__rate=120e3,
        pneumatics__maximum=90e3,
        discretization__timestep=h,
    )
    time = np.arange(count) * h
    p, end = scene.phases, scene.window[1]
    keys = [p.approach, p.inflate, end, end + p.deflate_time]
    wanted = 130e3 * np.interp(time, keys, [0.0, 1.0, 1.0, 0.0])[None]
    with jax.enable_x64(True):
        reached = np.asarray(control.supplied(scene, jnp.asarray(wanted).T)[0]).T[0]

    def rate(t, p):
        goal = min(wanted[0, min(int(t / h + 1e-9), count - 1)], 90e3)
        return np.clip((goal - p) / 0.15, -120e3, 120e3)

    options = {"max_step": 0.02, "rtol": 1e-6, "atol": 1.0}
    exact = integrate.solve_ivp(rate, (0, time[-1]), [0.0], t_eval=time, **options).y[0]
    # A step of 1 ms of at most 120 kPa/s is 120 Pa, and the demand is held over it.
    np.testing.assert_allclose(reached, exact, atol=130)
    assert reached.max() == pytest.approx(90e3, rel=1e-3)
    assert np.abs(np.diff(reached)).max() <= 120e3 * h * (1 + 1e-9)


# --- contact by itself ---------------------------------------------------------------------------


@jax.enable_x64(True)
def some_contacts(friction, rng, count):
    """Contacts with random places and normals, world by world, and a pinch scene's cone."""
    scene = grasps.pinch(effects__friction=friction)
    normal = rng.normal(size=(3, 1, count))
    return contact.Contacts(
        point=jnp.asarray(0.05 * rng.normal(size=(3, 1, count))),
        normal=jnp.asarray(normal / np.linalg.norm(normal, axis=0)),
        distance=jnp.asarray(np.full((1, count), -1e-3)),
        cone=jax.jit(lambda: cones.make_cone(scene, 0.8, bodies=2))(),
    )


@jax.jit
def pushes(c, relative):
    """Wrenches, inertias and forces of contacts that accelerate so, relative to their aims."""
    answer = contact.constraint_update(c, relative)
    inertia = contact.contact_inertia(c, answer.hessian)
    return contact.contact_wrench(c, answer.force), inertia, answer.force


@pytest.mark.parametrize(
    "friction", ["full", *(pytest.param(f, marks=pytest.mark.slow) for f in ("none", "coulomb"))]
)
def test_force_and_inertia_are_derivatives_of_the_cost(friction):
    """In spatial accelerations, by automatic differentiation of the cost, in every zone."""
    rng, count = np.random.default_rng(3), 60
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
    expected = {"none": {0, 1}, "coulomb": {0, 2, 3}, "full": {0, 5, 6}}[friction]
    assert expected <= set(ranks)
