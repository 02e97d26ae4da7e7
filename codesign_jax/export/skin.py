"""The skinned hull as plain MuJoCo can have it: points that belong to single links.

A vertex of the hull follows two links with the weights 1 - w and w, while a geom of MuJoCo is a
rigid part of one body.  So a vertex becomes two points, one on each link, which share its stiffness
as the weights do: where the links turn little against each other both are where the vertex is, and
their forces act on the links as the vertex's would.  Points are spheres without a size to speak
of, each as stiff as its share of the surface (a square of the section's width has the scene's
stiffness), and touch objects and table.  Fingers touch each other with the boxes that the hull is
around their links.
"""

import itertools
from typing import NamedTuple

import mujoco
import numpy as np

from codesign_jax.model import hull, pairs
from codesign_jax.model.layout import first_on_palm
from codesign_jax.model.spec import add_pair
from codesign_jax.scene import Scene
from codesign_jax.types import Params

RADIUS = 1e-6
"""Radius of a point [m]."""
_PASSIVE = {"contype": 0, "conaffinity": 0, "group": 3}  # contacts come from explicit pairs only


class Point(NamedTuple):
    """A point of a finger on one of its links.

    Attributes:
      name: Name of its geom.
      link: The link, 0 the half segment at the palm.
      place: Place in the link's frame [m], shape (3,).
      share: Its stiffness as a share of the scene's.
    """

    name: str
    link: int
    place: np.ndarray
    share: float


def points(scene: Scene, finger: int, length: float, height: float) -> list[Point]:
    """The points of a finger.

    Args:
      scene: A scene with the hull.
      finger: Index of the finger, for names.
      length: Its length [m].
      height: Height of its section [m].
    """
    slots, links = hull.slots(scene), scene.discretization.links
    segment, width = length / links, scene.hand.section.width
    sides = np.array([segment * width, segment * height, width * height])
    share = np.tensordot(sides, slots.area, 1) / width**2
    found = []
    for row, k in np.ndindex(slots.along.shape):
        # A row hangs on the joint between two links; the last one, the tip's, on the last joint.
        joint = segment * (min(row, links - 1) + 0.5)
        sections = slots.across[row, k] * width, slots.up[row, k] * height
        place = np.array([joint + segment * slots.along[row, k], *sections])
        weight = slots.weight[row, k]
        follows = {row: 1 - weight, row + 1: weight} if row < links else {links: 1.0}
        for link, part in follows.items():
            if part > 0:
                name = f"finger_{finger}_point_{row}_{k}_{link}"
                own = place - [hull.link_origins(scene, length)[link], 0, 0]
                found.append(Point(name, link, own, float(part * share[row, k])))
    return found


def add(scene: Scene, spec: mujoco.MjSpec, params: Params) -> dict[str, float]:
    """Adds points and boxes to a spec, with their pairs.

    Args:
      scene: A scene with the hull and one object.
      spec: Its spec, which is changed.
      params: Parameters of the hand as concrete arrays.

    Returns:
      Stiffness of a contact of each point, by the geom's name, as a share of the scene's.
    """
    shares: dict[str, float] = {}
    for f in range(scene.num_fingers):
        length, height = float(params.length[f]), float(params.height[f])
        for point in points(scene, f, length, height):
            body = spec.body(f"finger_{f}_link_{point.link}")
            body.add_geom(name=point.name, pos=point.place, size=[RADIUS, 0, 0], **_PASSIVE)
            shares[point.name] = point.share
    e = scene.effects
    for name in shares:
        if e.finger_object:
            add_pair(scene, spec, name, "object_0", 0)
        if e.finger_table:
            add_pair(scene, spec, "table", name, pairs.HAND_TABLE)
        row = int(name.split("_")[3])
        if e.finger_palm and row >= first_on_palm(scene.discretization.links):
            add_pair(scene, spec, name, "palm_disc", pairs.PALM)
    if e.finger_finger:
        _boxes(scene, spec, params)
    return shares


def _boxes(scene: Scene, spec: mujoco.MjSpec, params: Params) -> None:
    """Boxes around the links, with which fingers touch each other."""
    links, width, names = scene.discretization.links, scene.hand.section.width, []
    for f, i in itertools.product(range(scene.num_fingers), range(1, links + 1)):
        height = float(params.height[f])
        extent = float(params.length[f]) / links * (0.5 if i == links else 1.0)
        half = [extent / 2, width / 2, height / 2]
        spec.body(f"finger_{f}_link_{i}").add_geom(
            name=f"finger_{f}_box_{i}",
            type=mujoco.mjtGeom.mjGEOM_BOX,
            size=half,
            pos=[extent / 2, 0, height / 2],
            **_PASSIVE,
        )
        names.append((f, f"finger_{f}_box_{i}"))
    for (f, first), (g, second) in itertools.combinations(names, 2):
        if f != g:
            add_pair(scene, spec, first, second, pairs.FINGERS)
