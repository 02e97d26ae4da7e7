"""The whole state of a world between two time steps, as one array."""

from typing import Any, NamedTuple

import numpy as np

from codesign_jax.model import held
from codesign_jax.model.layout import layout
from codesign_jax.scene import Scene
from codesign_jax.scene.schema import InputError


class RolloutState(NamedTuple):
    """The parts of `Trace.last`, one behind the other: all that a time step takes from the last.

    `ModelFields.start` takes the same array, or its beginning: qpos, or qpos and qvel.

    Attributes:
      qpos: Generalized positions, shape (..., nq).
      qvel: Generalized velocities, shape (..., nv).
      acc: Accelerations of the last step, from which the solver starts, shape (..., nv).  Each
        engine has the object's in its own frame.
      step: Number of time steps since the beginning of the grasp, which says whether a lost object
        counts, shape (..., 1).
      going: One for a world that goes on, zero for a decided one, see `Trace`, shape (..., 1).
      speed: Largest absolute velocity, for a failed world that of the failed step, shape (..., 1).
      held: Friction that contacts hold with `effects.friction_memory`, shape (..., row * lane), the
        rows as in `model.held`; empty without.
    """

    qpos: Any
    qvel: Any
    acc: Any
    step: Any
    going: Any
    speed: Any
    held: Any


def split(scene: Scene, start: Any) -> RolloutState:
    """The state that `ModelFields.start` has; what it lacks is that of a grasp's beginning.

    Args:
      start: Array of JAX or NumPy, shape (..., n).

    Raises:
      InputError: If n is none of the lengths that a state has.

    >>> import jax
    >>> from codesign_jax import model, parameters, rollout, scene
    >>> grasping = scene.load("paper")
    >>> space = parameters.design_space(grasping.hand, "2d")
    >>> hand = space.params(space.default())
    >>> fields = model.model_fields(grasping, hand, rollout.nominal_trial(grasping))
    >>> state = model.split(grasping, fields.start)
    >>> float(state.going[0]), state.held.shape  # 3 numbers of 47 contacts on 4 lanes
    (1.0, (564,))
    """
    nv = 12 + layout(scene).dofs.size
    rows = 3 * sum(held.held(scene).values())
    sizes = RolloutState(nv + 1, nv, nv, 1, 1, 1, rows * held.lanes(scene))
    ends = np.cumsum(sizes)
    n = start.shape[-1]
    if n not in {*ends[[0, 1, 6]]}:
        problem = f"start has {n} numbers; a state of the scene has {ends[-1]}, its beginning"
        raise InputError.of("size", f"{problem} {ends[0]} (qpos) or {ends[1]} (qpos, qvel)")
    parts = [
        start[..., end - size : end]
        if end <= n
        else np.zeros((*start.shape[:-1], size), start.dtype)
        for end, size in zip(ends, sizes, strict=True)
    ]
    state = RolloutState(*parts)
    if n > ends[1]:
        return state
    return state._replace(going=state.going + 1, speed=abs(state.qvel).max(-1, keepdims=True))
