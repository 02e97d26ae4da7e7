"""How deep fingers stand in the palm and in one another, from recorded states."""

from typing import Any, NamedTuple

import jax
import mujoco
import numpy as np

from codesign_jax import model
from codesign_jax.engines.mujoco import world_model
from codesign_jax.model import hull
from codesign_jax.model.layout import first_on_palm
from codesign_jax.scene import Scene
from codesign_jax.types import Params, Trial


class Poses(NamedTuple):
    """Where all bodies of a world are in some of its states.

    Attributes:
      place: Origins of their frames [m], shape (state, body, 3).
      turn: Their orientations, shape (state, body, 3, 3).
    """

    place: np.ndarray
    turn: np.ndarray


def compiled(scene: Scene, params: Params, trial: Trial) -> mujoco.MjModel:
    """MuJoCo's model of a world, with which its states are read; numbers of shape ()."""
    fields = jax.jit(model.model_fields, static_argnums=0)(scene, params, trial)
    return world_model(scene, jax.tree.map(np.asarray, fields))


def poses(compiled: mujoco.MjModel, qpos: np.ndarray) -> Poses:
    """Poses of states, shape (state, nq)."""
    data, found = mujoco.MjData(compiled), []
    for state in qpos:
        data.qpos[:] = state
        mujoco.mj_kinematics(compiled, data)
        found.append((data.xpos.copy(), data.xmat.reshape(-1, 3, 3).copy()))
    return Poses(*(np.stack(v) for v in zip(*found, strict=True)))


def in_palm(scene: Scene, params: Params, at: Poses) -> np.ndarray:
    """Depth of the deepest vertex of the hulls in the palm's disc [m], shape (state,), or 0.

    The depth is to the nearest face.  What is fixed to the palm, the first quarter of a finger, is
    left out as in the contact.
    """
    lay, disc, mesh = model.layout(scene), scene.hand.palm, hull.hull(scene)
    free = mesh.link[:, 0] >= first_on_palm(lay.links)
    palm_place, palm_turn = at.place[:, 1], at.turn[:, 1]
    deepest = np.zeros(len(at.place))
    for f in range(scene.num_fingers):
        bodies = [lay.stubs[f], *lay.bodies[f]]
        straight = hull.rest(scene, float(params.length[f]), float(params.height[f]))
        origin = hull.link_origins(scene, float(params.length[f]))
        vertices: Any = 0.0
        for link, weight in zip(mesh.link[free].T, mesh.weight[free].T, strict=True):
            local = straight[free] - origin[link, None] * np.array([1.0, 0.0, 0.0])
            body = np.array(bodies)[link]
            moved = at.place[:, body] + np.einsum("svij,vj->svi", at.turn[:, body], local)
            vertices = vertices + weight[:, None] * moved
        x, y, z = np.moveaxis(
            np.einsum("sij,svi->svj", palm_turn, vertices - palm_place[:, None]), -1, 0
        )
        inside = np.minimum(disc.radius - np.hypot(x, y), np.minimum(z, disc.thickness - z))
        deepest = np.maximum(deepest, inside.max(1))
    return deepest
