"""Derivatives of a step through the hull and through contacts between fingers, in float64."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from codesign_jax import model
from codesign_jax.engines.structured import StructuredEngine, differentiable
from codesign_jax.engines.structured.constants import world_constants
from codesign_jax.engines.structured.lanes import Stages
from tests import small
from tests.test_structured import lanes_state

# The derivative of a step compiles in one to two minutes.
pytestmark = pytest.mark.slow

EFFECTS = {
    "hull": {"effects__surface": "hull"},
    "finger_finger": {"effects__finger_finger": True, "discretization__spheres_per_link": 2},
}


@pytest.mark.parametrize("effect", EFFECTS)
def test_step_against_central_differences(effect):
    """A weighted sum of the new velocities along a random direction of the state."""
    with jax.enable_x64(True):
        scene = small.pinch(
            "sphere", effects__palm_object=False, effects__palm_table=False, **EFFECTS[effect]
        )
        hand, trial = small.hand_world(scene, length=0.1)
        fields = model.model_fields(scene, jax.tree.map(jnp.asarray, hand), trial)
        fields = jax.tree.map(lambda x: x[None], fields)
        engine = StructuredEngine(scene, iterations=200, evaluations=40, tolerance=1e-26)
        random, lay = np.random.default_rng(0), model.layout(scene)
        qpos = np.array(fields.start[0])
        qpos[2] = 0.07
        angles = 0.1 * random.normal(size=lay.dofs.shape)
        angles[..., 0] += 0.8
        qpos[6 : 6 + lay.dofs.size] = angles.ravel()
        qvel = 0.3 * random.normal(size=len(qpos) - 1)
        along_q, along_v = random.normal(size=len(qpos)), random.normal(size=len(qvel))
        along_q[-4:] = 0.0  # the quaternion stays one
        weights, lanes = random.normal(size=len(qvel)), world_constants(scene, fields)
        ctrl = jnp.asarray([*qpos[:6], 6e4, 6e4])[:, None]
        name = {"hull": "hull_object"}.get(effect, effect)

        def state(t):
            return lanes_state(engine, scene, fields, qpos + t * along_q, qvel + t * along_v)

        def value(new):
            return (engine.qvel(new)[0] * weights).sum()

        @jax.jit
        def run(t):
            new, info = engine.step(lanes, state(t), ctrl)
            return value(new), info.acc

        def known(t, acc):
            """The same of a step whose accelerations are known."""
            at = state(t)._replace(acc=acc)
            return value(differentiable.step(scene, lanes, at, ctrl).state)

        @jax.jit
        def contacts(state):
            return differentiable.problem(scene, Stages(None), lanes, state, ctrl)[0].contacts

        assert int((contacts(state(0.0))[name].distance < 0).sum()) > 5
        h, (_, acc) = 1e-7, run(0.0)
        derivative = float(jax.jit(jax.grad(known))(0.0, acc))
        difference = float(run(h)[0] - run(-h)[0]) / (2 * h)
        # The solver's error of 1e-13 over h, and h^2 times a third derivative of stiff contacts.
        np.testing.assert_allclose(derivative, difference, rtol=1e-5)
