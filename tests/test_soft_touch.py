"""Touch without a jump, in float64: MuJoCo C with a contact's own numbers, and planted faults."""

import functools
from functools import partial

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from codesign_jax import scene
from codesign_jax.engines.structured.kernel.contact_sets import ContactSet
from codesign_jax.engines.structured.lanewise import lanewise
from codesign_jax.engines.structured.laws.cones import make_cone
from codesign_jax.engines.structured.laws.contact import Contacts, constraint_update
from tests.helpers import grasps
from tests.helpers.curled_hands import batched, curled
from tests.helpers.planted_faults import Fault, chosen, planted, simulate

BOUND = 1e-8
"""As in test_kernel_pairs.py."""
DEPTH = 4e-3
"""Depth of the ramp [m]: about what fingers of the state are inside one another."""
SETTINGS = {
    "effects__finger_finger": True,
    "effects__finger_palm": True,
    "effects__soft_touch": True,
    "contact__touch_depth": DEPTH,
    "discretization__spheres_per_link": 2,
}


def other_cone(**wrong):
    """Cones with other numbers, functions of the right ones."""

    def cone(right, mine, self, read, pair=""):
        found = right(self, read, pair)

        def change(c):
            return c._replace(**{name: f(getattr(c, name)) for name, f in wrong.items()})

        return chosen(mine, lanewise(change, found), found, wide=False)

    return Fault({}, methods={(ContactSet, "cone"): cone})


FAULTS = {
    "contacts have their full strength at once": other_cone(least=lambda v: 0 * v + 1),
    "the ramp begins at nothing": other_cone(least=lambda v: 0 * v),
    "the ramp is twice as steep": other_cone(growth=lambda v: 2 * v),
}


def share_of(the_scene, depth, impedance):
    """Share of damping and friction at a depth."""
    c = the_scene.contact
    least = the_scene.discretization.timestep**2 / (impedance * c.time_constant**2)
    return least + (1 - least) * np.minimum(depth / c.touch_depth, 1)


def soften(the_scene, model, data):
    """Gives MuJoCo's contacts, found already, what a ramp asks of their depths, and solves again.

    MuJoCo's R = (1 - d)/d invweight, so that another share of 1/R is another impedance d; its
    reference is given directly as (stiffness, damping), with b = damping/d, k = stiffness/d.
    """
    for contact in data.contact:
        given = contact.solimp[0]
        share = share_of(the_scene, -contact.dist, given)
        own = 1 / (1 + (1 - given) / given / share)
        time = the_scene.contact.time_constant
        contact.solimp[:2] = own
        contact.solref[:] = -own / (given * time**2) / share, -own * 2 / (given * time)
    mujoco.mj_makeConstraint(model, data)
    mujoco.mj_projectConstraint(model, data)
    mujoco.mj_fwdVelocity(model, data)
    mujoco.mj_fwdActuation(model, data)
    mujoco.mj_fwdAcceleration(model, data)
    mujoco.mj_fwdConstraint(model, data)


@functools.cache
def simulated():
    """Relative errors of a step's accelerations, of each fault's world and of a sound one."""
    with jax.enable_x64(True):
        the_scene = grasps.pinch("sphere", links=2, **SETTINGS)
        model, data, fields = curled(the_scene, 3, 1.9, 0.045)
        fields, qpos, qvel, ctrl = batched([(model, data, fields)] * (len(FAULTS) + 1))
        with planted(FAULTS):
            run = jax.jit(partial(simulate, the_scene))
            ctrl = jnp.asarray(np.repeat(ctrl[:, None], 2, 1))
            found = run(fields, (qpos, qvel), ctrl, np.arange(len(qpos)))
    mujoco.mj_forward(model, data)
    depth = -data.contact.dist / DEPTH
    assert (depth < 0.5).sum() > 1 and (depth > 1).any() and len(depth) > 5
    soften(the_scene, model, data)
    acc = (np.asarray(found["qvel"])[:, 1] - qvel) / the_scene.discretization.timestep
    return np.linalg.norm(acc - data.qacc, axis=1) / np.linalg.norm(data.qacc)


def test_accelerations_equal_mujoco_with_the_numbers_of_each_depth():
    """Spheres of curled fingers on one another, on palm and object, and the object on the table."""
    assert simulated()[-1] < BOUND


@pytest.mark.parametrize("name", FAULTS)
def test_a_planted_fault_is_noticed(name):
    """By a hundred times the bound."""
    assert not simulated()[[*FAULTS].index(name)] < 100 * BOUND


def force(the_scene, depth, velocity):
    """A contact's force along the normal at rest or moving, held so that nothing accelerates."""
    cone = make_cone(the_scene, 0.8, bodies=2)
    point, normal = jnp.zeros((3, 1)), jnp.array([[0.0], [0.0], [1.0]])
    c = Contacts(point, normal, jnp.full(1, -depth), cone)
    jar = -c.reference(jnp.array([[0.0], [0.0], [velocity]]))
    return float(constraint_update(c, jar).force[2, 0])


def test_elastic_force_stays_and_damping_grows():
    """At rest k depth, however deep; the damper is weak at first touch and whole at the depth."""
    with jax.enable_x64(True):
        hard, soft = (
            scene.load("paper_spheres", overrides={"effects.soft_touch": on})
            for on in (False, True)
        )
        stiffness, depth = soft.contact.normal_stiffness, soft.contact.touch_depth
        for d in (1e-6, 0.2 * depth, depth, 5 * depth):
            assert force(soft, d, 0.0) == pytest.approx(stiffness * d, rel=1e-12)
            assert force(hard, d, 0.0) == pytest.approx(stiffness * d, rel=1e-12)
            damping = force(soft, d, -0.01) - force(soft, d, 0.0)
            whole = force(hard, d, -0.01) - force(hard, d, 0.0)
            assert damping / whole == pytest.approx(
                share_of(soft, d, soft.contact.impedance), rel=1e-9
            )
