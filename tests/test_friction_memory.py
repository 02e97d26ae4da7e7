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


def test_sliding_bodies_hold_coulomb_s_coefficient():
    """Contacts of one normal that slide and close: |g| is mu, against the motion."""
    with jax.enable_x64(True):
        share = jnp.array([0.3, 1.0, 0.6])
        cone = Cone(1.44 * share, 1.44 * share, MU, MU, 2778.0, 111.0)
        normals = jnp.array([[0.0], [0.0], [1.0]]) * jnp.ones((1, 3))
        contacts = Contacts(0 * normals, normals, -jnp.array([1e-3, 3e-3, 2e-4]), cone)
        velocity = jnp.array([[2.0], [0.0], [-0.1]]) * jnp.ones((1, 3))
        jar, none = -contacts.reference(velocity), jnp.zeros((3, 3))
        force = constraint_update(contacts, jar + holding.held(contacts, none)).force
        grip = np.asarray(holding.quotient(holding.hold(contacts, force, none).sum(1)))
    assert grip[0] > 0 and np.hypot(*grip[:2]) == pytest.approx(MU, rel=1e-12)


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
