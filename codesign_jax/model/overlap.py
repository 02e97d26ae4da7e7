"""Checks of a design by its poses: overlaps of fingers, and strains of their walls.

A link reaches from its joint to the next one, the last to the tip's flat face, with the outline
|y/a|^4 + |z/b|^4 = 1.  A depth is the distance to it, to first order, or to the tip's face where
that is nearer.
"""

from typing import Any, NamedTuple

import jax
import numpy as np

from codesign_jax.model.layout import beyond_base, first_on_palm, layout
from codesign_jax.model.morphology import at_joints, sections
from codesign_jax.scene import Scene
from codesign_jax.types import Params

_AROUND = 16
_ALONG = (0.0, 0.25, 0.5, 0.75, 1.0)
_INNER = (0.9, 0.5, 0.0)
"""Points of an outline, its places on a link as shares of the link, and outlines of the tip's face
as shares of the section."""
_APART = 3
"""Links of one finger that are so far apart stand in one another only where it coils."""


class Overlaps(NamedTuple):
    """Depths of the deepest points of surfaces [m], 0 where there is no overlap.

    Attributes:
      fingers: Of finger i in finger j, shape (state, i, j); on the diagonal that of a finger in
        itself.
      palm: Of each finger in the palm's disc, shape (state, finger), without the part at its base
        that touches no palm, see `layout.beyond_base`.
    """

    fingers: np.ndarray
    palm: np.ndarray


def overlaps(
    scene: Scene, params: Params, place: np.ndarray, turn: np.ndarray, size: np.ndarray
) -> Overlaps:
    """Overlaps in states of one hand.

    Args:
      place: Origins of the bodies' frames [m], shape (state, body, 3).
      turn: Their orientations, shape (state, body, 3, 3).
      size: Width and height of sections on the bodies over those without pressure, shape
        (state, body, 2), see `section_sizes.of_bodies`.
    """
    lay = layout(scene)
    disc = scene.hand.palm
    links = lay.links
    count = scene.num_fingers
    whole = np.where(np.arange(links) < links - 1, 1, 0.5)
    angle = np.linspace(0, 2 * np.pi, _AROUND, endpoint=False)
    unit = np.stack([np.cos(angle), np.sin(angle)], 1)
    unit /= ((unit**4).sum(1) ** 0.25)[:, None]
    points = []
    owners = []
    sizes = []
    beyond = []
    middles = (np.arange(links) + 0.5 + whole / 2) / links
    section = sections(scene.hand, jax.tree.map(lambda v: np.asarray(v, float), params), middles)
    halves = np.stack(
        [np.broadcast_to(v, (count, links)) / 2 for v in (section.width, section.height)], -1
    )
    # Points of a link's outlines, and of the tip's face: places along it, and across in half axes
    # from the middle of the section
    around = np.tile(unit, (len(_ALONG), 1))
    part = np.repeat(_ALONG, _AROUND)
    face = np.concatenate([unit * part for part in _INNER])
    links_at = np.repeat(np.arange(links), len(part))
    links_at = np.append(links_at, np.full(len(face), links - 1))
    part = np.append(np.tile(part, links), np.ones(len(face)))
    across = np.concatenate([np.tile(around, (links, 1)), face]) + [0, 1]  # over the fabric
    for f, bodies in enumerate(lay.bodies):
        half = halves[f] * size[:, bodies]
        span = float(params.length[f]) / links * whole
        ahead = part * span[links_at]
        local = across * half[:, links_at]
        local = np.concatenate([np.broadcast_to(ahead[:, None], (*local.shape[:2], 1)), local], -1)
        along = (links_at + 0.5) * float(params.length[f]) / links + ahead
        free = beyond_base(along, float(params.height[f]) * size[:, bodies[:1], 1])
        beyond.append(free & (links_at >= first_on_palm(links) - 1))
        at = np.array(bodies)[links_at]
        offsets = np.einsum("spij,spj->spi", turn[:, at], local)
        points.append(place[:, at] + offsets)
        owners.append(links_at)
        sizes.append((span, *np.moveaxis(half, -1, 0)))
    depths = np.zeros((len(place), count, count))
    palm = np.zeros((len(place), count))
    for i, links_at in enumerate(owners):
        x, y, z = np.moveaxis((points[i] - place[:, None, 1]) @ turn[:, 1], -1, 0)
        inside = np.minimum(disc.radius - np.hypot(x, y), np.minimum(z, disc.thickness - z))
        palm[:, i] = inside.max(1, initial=0, where=beyond[i])
        for j, bodies in enumerate(lay.bodies):
            away = points[i][:, None] - place[:, bodies, None]
            depth = _depths(away @ turn[:, bodies], *sizes[j])
            if i == j:
                near = np.abs(links_at - np.arange(links)[:, None]) < _APART
                depth = np.where(near, 0.0, depth)
            depths[:, i, j] = depth.max((1, 2))
    return Overlaps(depths, palm)


def _depths(local: np.ndarray, span: np.ndarray, a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Depths of points in the frames of links, shape (state, link, point, 3), in these links.

    Args:
      span: Lengths of the links, shape (link,).
      a: Half of their widths in the middle, shape (state, link).
      b: Half of their heights, same shape.
    """
    x, y, z = np.moveaxis(local, -1, 0)
    a = a[..., None]
    b = b[..., None]
    units = np.abs([y / a, (z - b) / b])
    phi = np.maximum((units**4).sum(0) ** 0.25, 1e-9)
    slope = np.sqrt((units[0] / phi) ** 6 / a**2 + (units[1] / phi) ** 6 / b**2)
    slope = np.where(slope > 0, slope, 1 / np.minimum(a, b))  # on the axis
    inside = (x >= 0) & (x <= span[:, None]) & (phi < 1)
    last = np.arange(len(span)) == len(span) - 1
    to_face = np.where(last[:, None], span[:, None] - x, np.inf)
    return np.where(inside, np.minimum((1 - phi) / slope, to_face), 0.0)


def bend_angles(scene: Scene, qpos: Any) -> np.ndarray:
    """Bends of the fingers' joints [rad], (..., finger, link), of positions (..., nq)."""
    lay = layout(scene)
    return np.asarray(qpos)[..., lay.dofs[:, :, lay.axes.index("bend")]]


def wall_strain(scene: Scene, params: Params, bends: np.ndarray) -> np.ndarray:
    """Strain of the walls farthest from the bottom layer, kappa h, shaped as `bends`."""
    links = layout(scene).links
    exact = jax.tree.map(np.asarray, params)
    height = sections(scene.hand, exact, at_joints(links)).height
    return bends * (height / (exact.length / links)[:, None])
