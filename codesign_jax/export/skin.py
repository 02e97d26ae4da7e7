"""The fingers' contact as plain MuJoCo can have it: spheres at the rings, and capsules.

A ring's section is no geom of MuJoCo's, and its force grows with the area that it meets.  So each
ring is a sphere as high as the section on its link, with the linear stiffness of its share of the
finger's length, and touches objects, table and palm.  Fingers touch each other and themselves with
capsules around their links.
"""

import itertools
from typing import NamedTuple

import mujoco
import numpy as np

from codesign_jax.model import pairs
from codesign_jax.model.layout import beyond_base, first_on_palm, ring_places, touches_itself
from codesign_jax.model.morphology import at_joints, sections
from codesign_jax.model.spec import add_pair, surroundings
from codesign_jax.scene import Scene
from codesign_jax.types import Params

_PASSIVE = {"contype": 0, "conaffinity": 0, "group": 3}  # contacts come from explicit pairs only


class Ball(NamedTuple):
    """A sphere of a finger on one of its links."""

    name: str  # name of its geom
    link: int  # the link, from 1 on
    place: np.ndarray  # place in the link's frame [m], shape (3,)
    share: float  # its stiffness as a share of the scene's


def balls(scene: Scene, finger: int, params: Params) -> list[Ball]:
    """The spheres of a finger, as high as the section on the inside of its bottom layer."""
    links = scene.discretization.links
    k = scene.discretization.hull_rings
    width = scene.hand.section.width
    along = ring_places(links, k)
    spheres = []
    segment = float(params.length[finger]) / links
    places = (along + at_joints(links)[:, None] * links) / links
    size = sections(scene.hand, params, places.ravel())
    heights, widths = (
        np.broadcast_to(v, (scene.num_fingers, along.size)) for v in (size.height, size.width)
    )
    for (i, j), at in np.ndenumerate(along):
        height = heights[finger, i * k + j]
        across = widths[finger, i * k + j]
        share = segment / k * (0.5 if i == links - 1 else 1.0) * across / width**2
        place = np.array([at * segment, 0.0, height / 2])
        spheres.append(Ball(f"finger_{finger}_ring_{i + 1}_{j}", i + 1, place, float(share)))
    return spheres


def add(scene: Scene, spec: mujoco.MjSpec, params: Params) -> dict[str, float]:
    """Adds spheres and capsules to a spec, with their pairs."""
    shares: dict[str, float] = {}
    e = scene.effects
    for f in range(scene.num_fingers):
        for ball in balls(scene, f, params):
            name = ball.name
            size = [ball.place[2], 0, 0]
            spec.body(f"finger_{f}_link_{ball.link}").add_geom(
                name=name, pos=ball.place, size=size, **_PASSIVE
            )
            shares[name] = ball.share
            if e.finger_object:
                add_pair(scene, spec, name, "object_0", 0)
            for other, kind in surroundings(scene, pairs.FINGER_TABLE) if e.finger_table else []:
                add_pair(scene, spec, other, name, kind)
            if e.finger_palm and _on_palm(scene, params, f, ball):
                add_pair(scene, spec, name, "palm_disc", pairs.PALM)
    if e.finger_finger or touches_itself(scene):
        _capsules(scene, spec, params)
    return shares


def _on_palm(scene: Scene, params: Params, finger: int, ball: Ball) -> bool:
    """Whether a sphere may touch the palm."""
    links = scene.discretization.links
    along = (ball.link - 0.5) * float(params.length[finger]) / links + ball.place[0]
    free = beyond_base(along, float(params.height[finger]))
    return bool(free) and ball.link >= first_on_palm(links)


def _capsules(scene: Scene, spec: mujoco.MjSpec, params: Params) -> None:
    """Capsules around the links, with which fingers touch each other and themselves."""
    links = scene.discretization.links
    names = []
    heights = sections(scene.hand, params, (np.arange(links) + 1.0) / links).height
    for f, i in itertools.product(range(scene.num_fingers), range(1, links + 1)):
        length = float(params.length[f])
        up = float(heights[f, min(i, heights.shape[1]) - 1]) / 2
        extent = length / links * (0.25 if i == links else 1.0)
        spec.body(f"finger_{f}_link_{i}").add_geom(
            name=f"finger_{f}_capsule_{i}",
            type=mujoco.mjtGeom.mjGEOM_CAPSULE,
            size=[up, 0, 0],
            fromto=[0, 0, up, extent, 0, up],
            **_PASSIVE,
        )
        arc = max(3.0, 1.8 * 2 * up / (length / links))
        names.append((f, i, arc, f"finger_{f}_capsule_{i}"))
    for (f, i, arc, first), (g, j, _, second) in itertools.combinations(names, 2):
        if scene.effects.finger_finger if f != g else touches_itself(scene) and j - i > arc:
            add_pair(scene, spec, first, second, pairs.FINGERS)
