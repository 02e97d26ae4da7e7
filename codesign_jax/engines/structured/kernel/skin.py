"""The skinned hull in a kernel: which vertices touch, and how they enter the joints' elimination.

The algebra is that of `codesign_jax.engines.structured.laws.hull`, one row at a time.
"""

from typing import TYPE_CHECKING, Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from codesign_jax.engines.structured.kernel.objects import WorldObject
from codesign_jax.engines.structured.kernel.slots import BoundSlots, any_of
from codesign_jax.engines.structured.lanes import dot
from codesign_jax.engines.structured.lanewise import Lanes, lanewise
from codesign_jax.engines.structured.laws import hull
from codesign_jax.engines.structured.world_model import WorldModel
from codesign_jax.model import hull as mesh
from codesign_jax.scene import Scene

if TYPE_CHECKING:
    from codesign_jax.engines.structured.kernel.problem import Memory
    from codesign_jax.engines.structured.kernel.step import Step

KINDS = 3
"""Rows differ in their vertices: most have the same, the last joint's and the tip's their own."""


class Side(NamedTuple):
    """A link as a row's vertices follow it; lanes.

    Attributes:
      frame: Columns of its orientation, shape (3, 3, finger, world).
      motion: Its spatial acceleration, shape (6, finger, world).
      vel: Its spatial velocity, same shape.
    """

    frame: Lanes
    motion: Lanes
    vel: Lanes


def fields(scene: Scene) -> dict[str, tuple[int, tuple[int, ...]]]:
    """The hull's part of the hand's table: vertices (place, weight, share) and balls."""
    k = scene.discretization.hull_rings * scene.discretization.hull_points
    found = {"vertex": (KINDS * k, (5,)), "ball": (KINDS, (2,)), "section_box": (1, (3,))}
    if scene.effects.finger_finger or scene.effects.finger_palm:
        found["pair_vertex"] = (KINDS * pair_points(scene), (8,))
    return found


def pair_points(scene: Scene) -> int:
    """Points of a row that are tried in other fingers: twice as many a ring as the mesh has."""
    return 2 * scene.discretization.hull_rings * scene.discretization.hull_points


RIM = 2.0**-0.25
"""Where the tip's cap is as steep as it is flat, in units of half a segment and half a section."""


def pair_vertices(scene: Scene, section: jax.Array) -> jax.Array:
    """Points on the outline that fingers have for one another, see `sections.inside`.

    Rings of points in the directions of the hull's outline, on |y/a|^4 + |z/b|^4 = 1 about the
    section's middle, with a and b half the width and the height; towards the tip + |x/c|^4 over the
    last half segment c.

    Args:
      scene: The scene.
      section: Height, wall, segment and width, shape (4, finger, world).

    Returns:
      Place, outward normal, weight and share of the surface, shape (KINDS * k, 8, finger, world).
    """
    rings, points = scene.discretization.hull_rings, 2 * scene.discretization.hull_points
    outline, _ = mesh.outline(points)
    unit = 2.0 * outline - np.array([0.0, 1.0])
    unit = unit / (unit**4).sum(1, keepdims=True) ** 0.25
    height, _, segment, width = section
    half = jnp.stack([width, height]) / 2.0
    around = unit[..., None, None] * half
    ahead = jnp.roll(around, -1, 0) - around
    side = jnp.sqrt(ahead[:, 0] ** 2 + ahead[:, 1] ** 2)
    arc = 0.5 * (side + jnp.roll(side, 1, 0))
    area = 0.5 * (around[:, 0] * ahead[:, 1] - around[:, 1] * ahead[:, 0]).sum(0)
    weight = np.arange(1, rings + 1) / rings
    # Places from the joint in half segments: of a link, of the last one, and of the tip's rings.
    cap = np.where(weight > 0.5, np.minimum(2 * weight - 1, RIM), 2 * weight - 1)
    cap[-1] = RIM
    scale = RIM * np.arange(rings, -1, -1) / rings
    bounds = np.concatenate([scale[:1], (scale[:-1] + scale[1:]) / 2, [0.0]]) ** 2
    band = (bounds[:-1] - bounds[1:]) / points
    reach = (1.0 - scale[1:] ** 4) ** 0.25
    gaps = np.diff(cap, prepend=-1.0)
    length = np.append((gaps[:-1] + gaps[1:]) / 2, gaps[-1] / 2)
    shrunk = (1.0 - np.maximum(cap, 0.0) ** 4) ** 0.25
    kinds = (
        (2 * weight - 1, weight, 1.0 + 0 * weight, 2.0 / rings + 0 * weight, 0 * weight),
        (cap, (cap + 1) / 2, shrunk, length, np.where(weight == 1, band[0], 0.0)),
        (reach, 0 * weight, scale[1:], 0 * weight, band[1:]),
    )
    # All rings at once, shape (ring of a kind, point, finger, world): ring by ring they would be
    # hundreds of operations for XLA.
    at, follows, size, along, share = np.concatenate(kinds, 1)[..., None, None, None]
    steep = np.where(np.arange(len(at)) < rings, 0.0, np.maximum(at.ravel(), 0.0) ** 3)
    across, up = (size * around[:, i] for i in (0, 1))
    normal = [
        steep.reshape(at.shape) / segment * 2.0,
        *((size * unit[:, i, None, None]) ** 3 / half[i] for i in (0, 1)),
    ]
    long = jnp.sqrt(normal[0] ** 2 + normal[1] ** 2 + normal[2] ** 2)
    surface = (size * arc * along * segment / 2.0 + share * area) / width**2
    found = [at * segment / 2.0, across, up + half[1], *(n / long for n in normal)]
    found = [jnp.broadcast_to(x, across.shape) for x in (*found, follows, surface)]
    return jnp.stack(found, 2).reshape(-1, 8, *across.shape[2:])


def pack(scene: Scene, hand: WorldModel) -> dict[str, jax.Array]:
    """Arrays of `fields`, (item, component, finger, world).

    A ball is a radius and a height: around the point of that height above the joint, on the link
    behind it, all vertices of a straight row are within the radius.  The section's box is half the
    width, the height and a segment.
    """
    local, weight, share = hull.places(scene, hand)
    rows = np.array([max(local.shape[1] - KINDS, 0), local.shape[1] - 2, local.shape[1] - 1])
    weight = jnp.broadcast_to(weight, share.shape)
    vertex = jnp.concatenate([local, weight[None], share[None]])[:, rows]
    up = hand.centre[2, 0]
    away = local[:, rows] - jnp.stack([0 * up, 0 * up, up])[:, None, None]
    radius = jnp.sqrt(dot(away, away)).max(1)
    ball = jnp.stack([radius, jnp.broadcast_to(up, radius.shape)], 1)
    vertex = jnp.moveaxis(vertex, 0, 2).reshape(-1, 5, *up.shape)
    assert hand.section is not None
    height, _, segment, width = hand.section
    box = 0.5 * jnp.stack([width, height, segment])
    found = {"vertex": vertex, "ball": ball, "section_box": box[None]}
    if scene.effects.finger_finger or scene.effects.finger_palm:
        found["pair_vertex"] = pair_vertices(scene, hand.section)
    return found


def kind_of(row: Any, links: int) -> Any:
    """Which of the kinds a row is."""
    return jnp.maximum(row - (links - 2), 0)


class Skin:
    """Finds the vertices that touch the object or the table, row by row."""

    def __init__(self, step: "Step", at: dict[str, Any], m: "Memory", thing: WorldObject):
        """Takes a step's memory and geometry, see `Step`."""
        self.step, self.at, self.m, self.thing = step, at, m, thing
        d = step.p.scene.discretization
        self.k, self.links = d.hull_rings * d.hull_points, step.p.links
        self.sets = [c for n, c in m.contacts.items() if n.startswith("hull_")]

    def row(self, row: Any, joint: Lanes, before: Side, after: Side) -> None:
        """Gives a slot to each vertex of a row that touches.

        Args:
          row: The row.
          joint: Place of its joint.
          before: The link before it.
          after: The link behind it.
        """
        kind, block = kind_of(row, self.links), self.step.block
        moves = {c.set.name: self._moves(c.set.name, before, after) for c in self.sets}
        ball = self.step.p.hand.read(self.step.hand, "ball", kind)
        centre, reach = lanewise(hull.ball_around, joint, before.frame, after.frame, ball)
        for slots in self.sets:
            slots.clear(row)  # pyright: ignore[reportAttributeAccessIssue]  # hull sets are slots
            _, _, gap = self.step.geometry(slots.set.name, centre, reach, self.at, self.thing)

            def vertices(slots: BoundSlots = slots) -> None:
                def one(v: jax.Array, x: jax.Array) -> jax.Array:
                    v, mine = block.dealt(self.k, v)
                    self._vertex(row, kind * self.k + v, slots, joint, before, after, moves, mine)
                    return x

                jax.lax.fori_loop(0, block.rounds(self.k), one, jnp.int32(0))

            any_of(gap.lane < 0, vertices)

    def _vertex(self, row, item, slots, joint, before, after, moves, mine) -> None:
        vertex = self.step.p.hand.read(self.step.hand, "vertex", item)
        place = lanewise(hull.placed, vertex, joint, before.frame, after.frame)
        point, image, weight, share = place
        name = slots.set.name
        where, normal, gap = self.step.geometry(name, point, 0.0, self.at, self.thing)

        which = gap.lane < 0 if mine is None else mine & (gap.lane < 0)
        if self.step.p.fingers > self.step.p.num_fingers:  # the others fill up
            which = which & (self.step.block.finger < self.step.p.num_fingers)

        def store() -> None:
            arm = lanewise(lambda *places: hull.lever(*places), weight, image, where, point)
            kept = slots.begin((where, normal, gap, arm, share), *moves[name])
            kept |= slots.remembered({"vertex": item})
            slots.add(row, which, kept, self.step.block.own)

        any_of(which, store)

    def _moves(self, name: str, before: Side, after: Side) -> tuple[Lanes, Lanes]:
        """Relative acceleration and velocity of a row, (9, ...)."""
        obj = (self.at["now"].object_motion, self.at["object_vel"])
        one, two = (before.motion, before.vel), (after.motion, after.vel)
        return tuple(  # type: ignore[return-value]
            lanewise(hull.across, a, b, o if name.endswith("object") else None)
            for a, b, o in zip(one, two, obj, strict=True)
        )
