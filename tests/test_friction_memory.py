"""Friction that fingers hold from step to step: its law on contacts alone, and who has it.

The kernel's steps are compared with a dense solve in `test_planted_contacts`, its derivatives with
differences in `test_reverse`.
"""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from codesign_jax import model, scene
from codesign_jax.engines import make_engine
from codesign_jax.engines.structured.laws import holding
from codesign_jax.engines.structured.laws.contact import Cone, Contacts, constraint_update
from codesign_jax.model.layout import pairings_held
from tests.helpers import grasps
from tests.helpers.differences import curled

MU, STEPS = 0.8, 8


def touching(normals, depths, full=False):
    """Contacts with the default scene's numbers between fingers and unequal stiffnesses."""
    share = jnp.array([0.3, 1.0, 0.6])
    more = {"spin": 0.003, "roll": 0.0005} if full else {}
    cone = Cone(1.44 * share, 1.44 * share, MU, MU, 2778.0, 111.0, **more)
    normals = normals / np.linalg.norm(normals, axis=1, keepdims=True)
    return Contacts(jnp.zeros((3, 3)), jnp.asarray(normals.T), -jnp.asarray(depths), cone)


def next_grip(contacts, jar, grip):
    """The next g of contacts whose jar without friction that is held is given."""
    g = jnp.broadcast_to(jnp.asarray(grip)[:, None], (3, 3))
    force = constraint_update(contacts, jar + holding.held(contacts, g)).force
    return np.asarray(holding.quotient(holding.hold(contacts, force, g).sum(1))), force


@pytest.mark.parametrize("full", [False, True])
def test_bodies_at_rest_keep_what_they_hold(full):
    """Three contacts with normals up to 50 degrees apart, none of which moves."""
    with jax.enable_x64(True):
        normals = np.array([[0, 0, 1.0], [0.6, 0, 1], [0, -0.9, 1]])
        contacts = touching(normals, np.array([1e-3, 3e-3, 2e-4]), full)
        grip = np.array([0.3, -0.2, 0.1])
        resting = -contacts.reference(jnp.zeros((6 if full else 3, 3)))
        found, force = next_grip(contacts, resting, grip)
    np.testing.assert_allclose(found, grip, rtol=1e-12)
    # Each pushes as deep as it is, 4 kN/m times its share, and rubs in proportion.
    share = np.array([0.3, 1.0, 0.6]) * 1.44 * 2778.0 * np.array([1e-3, 3e-3, 2e-4])
    unit = normals / np.linalg.norm(normals, axis=1, keepdims=True)
    wanted = share[:, None] * (unit - grip + unit * (unit @ grip)[:, None])
    np.testing.assert_allclose(np.asarray(force)[:3].T, wanted, rtol=1e-12)


def test_sliding_bodies_hold_coulomb_s_coefficient():
    """Contacts of one normal that slide and close: |g| is mu, against the motion."""
    with jax.enable_x64(True):
        contacts = touching(np.array([[0, 0, 1.0]] * 3), np.array([1e-3, 3e-3, 2e-4]))
        velocity = jnp.array([[2.0], [0.0], [-0.1]]) * jnp.ones((1, 3))
        grip, _ = next_grip(contacts, -contacts.reference(velocity), np.zeros(3))
        assert grip[0] > 0 and np.hypot(*grip[:2]) == pytest.approx(MU, rel=1e-12)


def test_bodies_that_part_hold_by_their_elastic_force():
    """Sticking at 10 mm/s while they part by 5 mm/s: D b v over E, which is more than they push."""
    with jax.enable_x64(True):
        contacts = touching(np.array([[0, 0, 1.0]] * 3), np.full(3, 1e-3))
        velocity = jnp.array([[0.01], [0.0], [0.005]]) * jnp.ones((1, 3))
        grip, force = next_grip(contacts, -contacts.reference(velocity), np.zeros(3))
        share = np.array([0.3, 1.0, 0.6]) * 1.44
    np.testing.assert_allclose(np.asarray(force)[2], share * (2.778 - 111 * 0.005), rtol=1e-12)
    np.testing.assert_allclose(grip, [111 * 0.01 / 2.778, 0, 0], rtol=1e-12, atol=1e-15)


def test_spheres_keep_nothing():
    """Their contact is that of MuJoCo, which has no state, so that every engine simulates it."""
    for surface, held in ("hull", 4), ("spheres", 0):
        chosen = scene.load("paper", overrides={"effects.surface": surface})
        assert chosen.effects.friction_memory and pairings_held(chosen) == held
    make_engine("mujoco", chosen)


@pytest.fixture(scope="module")
def crossed():
    """Two fingers that hold one another above the object: the state, and in pieces on from it.

    A function of start, controls and steps of a piece: a sum of the end, the end, and the traces.
    """
    contacts = {"effects__finger_finger": True, "effects__friction_memory": True}
    chosen = grasps.pinch("box", links=2, effects__surface="hull", **contacts)
    engine = make_engine("structured", chosen)
    with jax.enable_x64(True):
        begin = curled(chosen, STEPS, bend=0.8, height=0.25)
        fields, ctrl = jax.tree.map(lambda v: jnp.asarray(v)[None], (begin.fields, begin.ctrl))
        ctrl = ctrl.at[..., 6:].set(180e3)  # Pa: they press on one another
        start = jax.jit(engine.rollout)(fields, ctrl).last
    assert np.abs(model.split(chosen, start).held).max() > 0.1

    def one(start, ctrl):
        trace = engine.rollout(fields._replace(start=start), ctrl)
        return trace.last, (trace.distance, trace.height, trace.speed)

    def pieces(start, ctrl, size):
        parts = jnp.moveaxis(ctrl.reshape(1, -1, size, ctrl.shape[2]), 1, 0)
        last, shown = jax.lax.scan(one, start, parts)
        shown, end = jnp.stack(shown).reshape(3, -1), model.split(chosen, last)
        return shown.sum() + end.qpos.sum() + end.held.sum(), (last, shown)

    return start, ctrl, pieces


def test_a_rollout_in_pieces_is_that_of_one_piece(crossed):
    """What fingers hold, the solver's warm start and the time of the grasp pass on: equal bits."""
    start, ctrl, pieces = crossed
    with jax.enable_x64(True):
        found = [jax.jit(partial(pieces, size=n))(start, ctrl)[1] for n in (STEPS, 1)]
    jax.tree.map(np.testing.assert_array_equal, *found)
