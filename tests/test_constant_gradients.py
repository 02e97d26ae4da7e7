"""Derivatives with respect to every physical number of a scene, the kernel running forward.

A short grasp with contact: the hand comes down beside a box, closes and begins to lift.
"""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from codesign_jax import model, rollout
from codesign_jax.engines.structured import StructuredEngine
from tests.helpers import grasps

# Forward it is one kernel; each of the two derivatives compiles in two minutes of a core's time.
pytestmark = pytest.mark.slow

STEP = 1e-6
# Times of the key frames: a command has a kink where a step falls on one, as all of them here do.
KINKS = ("phases",)
# What a grasp of given trials does not depend on: verdicts, noise, and effects that are off.
WITHOUT = ("cost", "limits", "pneumatics", "objects.noise", "arm.shake", "hand.palm.contact_radius")
MOVING = {
    "gravity",
    "contact.normal_stiffness",
    "contact.dissipation_time",
    "contact.friction_ratio",
    "hand.material.shear_modulus",
    "hand.material.damping_time",
    "hand.material.density",
    "hand.palm.mass",
    "hand.section.width",
    "hand.wrist.linear_stiffness",
    "hand.finger[0].tilt",
    "objects.object[0].friction",
    "objects.object[0].mass",
    "objects.object[0].size[0]",
    "objects.table.friction",
}
"""Some of the numbers whose derivative must not be zero, so that zeros prove nothing."""


def grasp(dtype, **settings):
    """The scene's numbers, and the function from numbers of worlds, (world,), to their losses."""
    scene = grasps.short_grasp()
    engine = StructuredEngine(scene, **settings)
    hand, trial = jax.tree.map(
        lambda v: jnp.asarray(v, dtype if v.dtype.kind == "f" else None), grasps.hand_world(scene)
    )
    trial = trial._replace(yaw=trial.yaw + 0.1, position=trial.position + 0.003)

    def losses(constants):
        count = jax.tree.leaves(constants)[0].shape[0]
        worlds = jax.tree.map(lambda v: jnp.broadcast_to(v, (count, *v.shape)), (hand, trial))
        # `evaluate` would do: what is differentiated are the coordinates at the end.
        _, trace = rollout.simulate(scene, engine, *worlds, record_qpos=True, constants=constants)
        end = jnp.concatenate(model.split(scene, trace.last)[:2], 1)
        size = end.shape[1]
        weights = np.random.default_rng(0).normal(size=size) / np.sqrt(size)
        return end @ jnp.asarray(weights, dtype)

    return jax.tree.map(lambda v: jnp.asarray([v], dtype), scene.constants()), losses


def slopes(start, losses):
    """Derivatives along every number, each relative to a change of the number by its own size."""
    found = jax.jit(jax.grad(lambda c: losses(c).sum()))(start)
    return np.array(
        [
            float(g[0] * size_of(v))
            for g, v in zip(*map(jax.tree.leaves, (found, start)), strict=True)
        ]
    )


def size_of(value):
    return np.where(np.asarray(value) != 0, np.abs(value), 1.0)[0]


def names_of(tree):
    pairs = jax.tree_util.tree_flatten_with_path(tree)[0]
    return [jax.tree_util.keystr(path).lstrip(".") for path, _ in pairs]


@pytest.fixture(scope="module")
def checked():
    """Names, derivatives in float64 with the solver converged, differences; default derivatives."""
    start, losses = grasp(np.float32)
    default = slopes(start, losses)
    with jax.enable_x64(True):
        start, losses = grasp(np.float64, iterations=60, evaluations=30, tolerance=1e-24)
        names, leaves = names_of(start), jax.tree.leaves(start)
        sides = []
        for sign in (1, -1):
            # World i has number i moved, the others as they are.
            moved = [
                jnp.full(len(leaves), v[0]).at[i].add(sign * STEP * size_of(v))
                for i, v in enumerate(leaves)
            ]
            sides.append(jax.tree.unflatten(jax.tree.structure(start), moved))
        run = jax.jit(losses)
        high, low = (np.asarray(run(side)) for side in sides)
        return names, slopes(start, losses), (high - low) / (2 * STEP), default


def test_gradient_by_every_constant_equals_central_differences(checked):
    names, slope, difference, _ = checked
    largest = np.abs(slope).max()
    error = np.abs(slope - difference) / largest
    for name, *row in zip(names, slope, difference, error, strict=True):
        print(name, *(f"{v:.3e}" for v in row))
    assert MOVING <= {n for n, s in zip(names, slope, strict=True) if abs(s) > 1e-6 * largest}
    for name, s, e in zip(names, slope, error, strict=True):
        if name.startswith(WITHOUT):
            assert s == 0, name
        if not name.startswith(KINKS):
            # The solver's rounding of 1e-15 over the step: 5e-10 were seen.
            assert e < 1e-8, name


def test_the_default_gradient_in_float32(checked):
    """Its error is that of float32 steps and of the default solver's tolerance."""
    names, slope, _, found = checked
    smooth = np.array([not n.startswith(KINKS) for n in names])
    error = np.linalg.norm((found - slope)[smooth]) / np.linalg.norm(slope[smooth])
    print("float32", error)
    for name, *row in zip(names, slope, found, strict=True):
        print(name, *(f"{v:.3e}" for v in row))
    assert error < 5e-3  # 6e-4 were seen
