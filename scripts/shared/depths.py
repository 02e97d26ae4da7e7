"""How deep fingers are in the palm and in one another, from recorded states."""

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


AROUND, ALONG, INNER = 16, (0.0, 0.25, 0.5, 0.75, 1.0), (0.9, 0.5, 0.0)
"""Points of an outline, its places on a link as shares of the link, and outlines of the tip's face
as shares of the section."""


def in_fingers(scene: Scene, params: Params, at: Poses) -> tuple[np.ndarray, np.ndarray]:
    """Depth of the deepest point of a finger's surface in a link of another one.

    A link reaches from its joint to the next one, the last to the tip's flat face, with the outline
    |y/a|^4 + |z/b|^4 = 1; a depth is the distance to it, to first order, or to the tip's face where
    that is nearer.

    Args:
      scene: The scene.
      params: The hand.
      at: Its poses.

    Returns:
      The depth [m], and the largest quotient of a depth and the smaller side (width or height) of
      the section that it is in, both of shape (state,); 0 where no finger is in another.
    """
    lay = model.layout(scene)
    angle = np.linspace(0, 2 * np.pi, AROUND, endpoint=False)
    unit = np.stack([np.cos(angle), np.sin(angle)], 1)
    unit /= ((unit**4).sum(1) ** 0.25)[:, None]
    points, sizes = [], []
    for f, bodies in enumerate(lay.bodies):
        half = np.array([scene.hand.section.width, float(params.height[f])]) / 2
        whole = np.where(np.arange(lay.links) < lay.links - 1, 1, 0.5)
        span = float(params.length[f]) / lay.links * whole
        ring = np.c_[0 * unit[:, 0], unit * half + [0, half[1]]]
        local = np.concatenate(
            [ring + np.outer(part * span, [1, 0, 0])[:, None] for part in ALONG], 1
        )
        place = at.place[:, bodies, None] + local @ at.turn[:, bodies].swapaxes(-1, -2)
        inner = np.concatenate([unit * half * part for part in INNER]) + [0, half[1]]
        tip = np.c_[np.full(len(inner), span[-1]), inner] @ at.turn[:, bodies[-1]].swapaxes(-1, -2)
        tip += at.place[:, bodies[-1:]]
        points.append(np.concatenate([place.reshape(len(place), -1, 3), tip], 1))
        sizes.append((span, *half))
    worst = np.zeros((2, len(at.place)))
    for one, other in np.ndindex(len(points), len(points)):
        if one == other:
            continue
        bodies, (span, a, b) = lay.bodies[other], sizes[other]
        away = points[one][:, :, None] - at.place[:, None, bodies]
        x, y, z = np.moveaxis(away.swapaxes(1, 2) @ at.turn[:, bodies], -1, 0).swapaxes(2, 3)
        units = np.abs([y / a, (z - b) / b])
        phi = np.maximum((units**4).sum(0) ** 0.25, 1e-9)
        sides = np.array([a, b])[:, None, None, None]
        slope = np.sqrt(((units / phi) ** 6 / sides**2).sum(0))
        inside = (x >= 0) & (x <= span) & (phi < 1)
        to_face = np.where(np.arange(lay.links) == lay.links - 1, span - x, np.inf)
        depth = np.where(inside, np.minimum((1 - phi) / slope, to_face), 0.0).max((1, 2))
        worst = np.maximum(worst, [depth, depth / (2 * min(a, b))])
    return worst[0], worst[1]
