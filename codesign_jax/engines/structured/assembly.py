"""What touches in a state, over arrays of all worlds, for what simulates nothing.

The kernel finds contacts link by link; here the same functions are called on whole arrays.
"""

from collections.abc import Callable
from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from codesign_jax.engines.structured.kernel import finger_collision, memory_tables
from codesign_jax.engines.structured.kernel.contact_sets import margin
from codesign_jax.engines.structured.lanes import dot, once
from codesign_jax.engines.structured.laws import holding, shapes, surroundings
from codesign_jax.engines.structured.laws.cones import own_friction, which_cone
from codesign_jax.engines.structured.laws.contact import Cone, Contacts, candidates
from codesign_jax.engines.structured.laws.kinematics import Kinematics, Spatial, mounted, relative
from codesign_jax.engines.structured.laws.rings import Place
from codesign_jax.engines.structured.laws.touch import ring_centre, touch
from codesign_jax.engines.structured.world_model import WorldModel, apply_columns
from codesign_jax.model import held
from codesign_jax.model.held import rings_of_link
from codesign_jax.model.layout import first_on_palm, palm_touches, touches_itself
from codesign_jax.scene import Scene

FAR = 1.0
"""Squared distance at which nothing touches [m^2]."""


def contacts(
    scene: Scene,
    hand: WorldModel,
    kin: Kinematics,
    position: jax.Array,
    velocity: Spatial | None = None,
) -> dict[str, Contacts]:
    """Contacts that the scene's effects call for but those of `hand_contacts`, by pair of bodies.

    Args:
      position: The object's centre, shape (3, 1, world).
      velocity: Of the bodies; none where they are at rest.
    """
    e = scene.effects
    found = {}

    def add(name: str, place: Place, count: int = 1) -> None:
        cone = getattr(hand.cones, which_cone(name))
        if own_friction(scene, name):
            assert hand.friction is not None
            own = hand.friction[np.array(surroundings.touched(scene, name, count))]
            cone = once(Cone.of_friction, cone, own if name.startswith("finger") else own[:, 0])

        def act(place: Place, cone: Cone, velocity: Spatial | None) -> Contacts:
            moving = None if velocity is None else relative(name, velocity)
            return _candidates(scene, place, cone, moving)

        found[name] = once(act, place, cone, velocity)

    def of_object(point: jax.Array) -> tuple[jax.Array, jax.Array]:
        local = shapes.in_object(kin.object, point)
        distance, gradient = once(lambda p: shapes.signed_distance(scene, hand, p), local)
        return distance, apply_columns(kin.object, gradient)

    def of_body(
        names: dict[str, bool], numbers: jax.Array, origin: jax.Array, frame: jax.Array
    ) -> None:
        centre = ring_centre(origin, frame, numbers)
        for name in (n for n in names if names[n]):
            around = [partial(f, position) for f in surroundings.fields(scene)]
            looks = around if name.endswith("_table") else [of_object]
            places = []
            for look in looks:
                places.append(_touch(scene, look, numbers, frame, centre))
            if places:
                finger = name.startswith("finger")
                add(name, _joined(places, int(finger)), numbers.shape[2 if finger else 1])

    if count := rings_of_link(scene):
        numbers = memory_tables.ring_numbers(scene, hand, count)
        numbers = jnp.moveaxis(numbers.reshape(-1, count, *numbers.shape[1:]), 2, 0)
        on = {"finger_object": e.finger_object, "finger_table": e.finger_table}
        of_body(on, numbers, kin.origin[:, :, None], kin.link[:, :, :, None])
    if palm_touches(scene):
        numbers = jnp.moveaxis(memory_tables.palm_numbers(scene, hand), 1, 0)
        on = {"palm_object": e.palm_object, "palm_table": e.palm_table}
        of_body(on, numbers, kin.place, kin.palm)
    if e.object_table and surroundings.slots(scene):
        places = _of_object(scene, hand, kin, position, of_object)
        add("object_table", _joined(places, 0))
    return found


def grips(scene: Scene, hold: jax.Array, kin: Kinematics) -> dict[str, jax.Array]:
    """What the contacts of `contacts` hold, see `holding.held`, by pair of bodies.

    Args:
      hold: As in `State`.

    Returns:
      Friction along the world's axes, shape (3, ...), items as those of the contacts.
    """
    found = {}
    rows = held.rows(scene)
    lanes = held.lanes(scene)
    links = scene.discretization.links
    for name in (n for n in rows if n != "finger_finger"):
        own = hold[rows[name]].reshape(-1, 3, lanes, hold.shape[-1])  # (item, 3, lane, world)
        if name.startswith("finger"):
            own = own.reshape(links, -1, *own.shape[1:])[:, :, :, : scene.num_fingers]
            own = jnp.moveaxis(own, 2, 0)
        else:
            own = _dealt_back(scene, name, own)
        found[name] = apply_columns(kin.object, own) if name.endswith("_object") else own
    return found


def _dealt_back(scene: Scene, name: str, own: jax.Array) -> jax.Array:
    """Numbers (item, 3, lane, world) of what is dealt to lanes, one behind the other."""
    fields = held.surfaces(scene) if name == "palm_table" else 1
    count = sum(held.object_points(scene)) if name == "object_table" else held.PALM_RINGS
    # (field, group and lane, 3, world): a group's fields are beside one another.
    own = own.reshape(-1, fields, *own.shape[1:])
    own = jnp.moveaxis(own, (1, 0, 3), (0, 1, 2)).reshape(fields, -1, 3, own.shape[-1])
    own = own[:, :count].reshape(-1, 3, own.shape[-1])
    return jnp.moveaxis(own, 1, 0)


def _candidates(scene: Scene, place: Place, cone: Cone, moving: jax.Array | None) -> Contacts:
    """Contacts at places, for relative velocities of their bodies or bodies at rest."""
    c = Contacts(*place[:3], cone.of_share(place.share))
    approach = 0.0 * place.gap
    if moving is not None:
        approach = -dot(c.normal, c.relative(moving))
    share = candidates(place.share, place.gap, approach, cone, margin(scene))
    return c._replace(cone=cone.of_share(share))


def _touch(
    scene: Scene, look: Callable, numbers: jax.Array, frame: jax.Array, centre: jax.Array
) -> Place:
    """Contacts of rings or spheres with a surface, see `touch`."""
    surface = scene.effects.surface
    return touch(surface, numbers, frame, centre, look(centre), look, apply=once)


def _joined(places: list[Place], axis: int) -> Place:
    """Contacts with several fields, one behind the other along an axis of the items."""
    if len(places) == 1:
        return places[0]
    axes = (axis + 1, axis + 1, axis, axis)
    fields = zip(axes, zip(*places, strict=True), strict=True)
    return Place(*(jnp.concatenate(values, at) for at, values in fields))


def _of_object(
    scene: Scene, hand: WorldModel, kin: Kinematics, position: jax.Array, of_object: Callable
) -> list[Place]:
    """Contacts of the object with table and fixtures, items first."""
    places = []
    one = jnp.ones_like
    if scene.effects.table:
        place = shapes.object_on_table(scene, hand, kin.object, position[2])
        places.append(Place(*place, one(place[2])))
    flat = [i for i, s in enumerate(scene.objects.object) if s.type not in held.ROUND]
    for fixture in scene.fixture:
        _, rows = surroundings.towards(fixture, position)
        arms = shapes.lowest_points(scene, hand, surroundings.faced(rows, kin.object))
        place = surroundings.object_on(fixture, position, rows[:, :, 0], arms)
        places.append(Place(*place, one(place[2])))
        if flat and held.EDGES[fixture.type]:
            point = surroundings.edges(fixture, position)
            on, normal, gap = (v[..., 0, :] for v in surroundings.edge_on(point, *of_object(point)))
            mine = jnp.isin(hand.object_id, jnp.array(flat))
            places.append(Place(on, normal, gap, jnp.where(mine, one(gap), 0.0)))
    return places


class HandContacts(NamedTuple):
    """Contacts of rings or spheres with other fingers, their own or the palm."""

    contacts: Contacts  # The contacts, shape (item, pair, world); a pair is two fingers, or one
    # Their links on the first finger, 1 for the first one that moves, shape (item,)
    links: jax.Array
    others: jax.Array  # Links of the other side, 0 for the palm, shape (item, pair, world)
    fingers: jax.Array  # First and second finger of the pairs, shape (2, pair)
    # What the pairs hold of friction, see `holding.held`, shape (3, 1, pair, world), or None
    grip: jax.Array | None = None

    def relative(self, motion: Spatial) -> jax.Array:
        """Motion of the first side to the other one, shape (6, item, pair, world)."""
        palm = jnp.broadcast_to(motion.palm[:, None], motion.link[:, :1].shape)
        every = jnp.concatenate([palm, motion.link], 1)
        mine = every[:, self.links][:, :, self.fingers[0]]
        return mine - _of_others(every, self.others, self.fingers[1])

    def jar(self, motion: Spatial, velocity: Spatial) -> jax.Array:
        """J a - aref of accelerations of the bodies, with the friction that is held."""
        c = self.contacts
        jar = c.relative(self.relative(motion)) - c.reference(c.relative(self.relative(velocity)))
        return jar if self.grip is None else jar + holding.held(c, self.grip)


class _FingerRings(NamedTuple):
    """The rings or spheres of all fingers, items from base to tip."""

    number: np.ndarray  # Number of each item, shape (item,)
    link: np.ndarray  # Its link, 1 for the first one that moves, same shape
    numbers: jax.Array  # Numbers of rings, shape (8, item, finger, world)
    frame: jax.Array  # Frames of their links, shape (3, 3, item, finger, world)
    centre: jax.Array  # Their centres, shape (3, item, finger, world)
    lines: "_CentreLines | None"  # Of fingers of rings

    def of(self, fingers: np.ndarray) -> tuple[jax.Array, jax.Array, jax.Array]:
        """Numbers, frames and centres of some fingers, which may come several times."""
        return self.numbers[:, :, fingers], self.frame[:, :, :, fingers], self.centre[:, :, fingers]


def _finger_rings(scene: Scene, hand: WorldModel, kin: Kinematics) -> _FingerRings:
    k = rings_of_link(scene)
    numbers = jnp.moveaxis(memory_tables.ring_numbers(scene, hand, k), 1, 0)
    shape = (*numbers.shape[:2], scene.num_fingers, kin.place.shape[-1])
    numbers = jnp.broadcast_to(numbers, shape)
    item = np.arange(scene.discretization.links * k)
    link = item // k + 1
    base_frame, base = mounted(kin.place, kin.palm, hand.mount, hand.base)
    frames = jnp.concatenate([base_frame[:, :, None], kin.link], 2)
    joints = jnp.concatenate([base[:, None], kin.origin], 1)
    frame = frames[:, :, link]
    centre = once(ring_centre, joints[:, link], frame, numbers)
    lines = None
    if scene.effects.surface == "hull":
        lines = _centre_lines(scene, frames, joints, numbers, centre)
    return _FingerRings(item, link, numbers, frame, centre, lines)


def hand_contacts(
    scene: Scene, hand: WorldModel, kin: Kinematics, velocity: Spatial, hold: jax.Array
) -> dict[str, HandContacts]:
    """Contacts of fingers with one another, with themselves and with the palm, by these names.

    Args:
      hold: What contacts hold, as in `State`.
    """
    e = scene.effects
    found = {}
    k = rings_of_link(scene)
    on_itself = touches_itself(scene)
    if not k or not (e.finger_finger or e.finger_palm or on_itself):
        return {}
    rings = _finger_rings(scene, hand, kin)
    alone = np.stack([np.arange(scene.num_fingers)] * 2)
    two = np.stack(np.triu_indices(scene.num_fingers, 1))
    grip = None
    rows = held.rows(scene).get("finger_finger")
    if rows is not None:
        grip = hold[rows].reshape(-1, 3, *hold.shape[1:])

    def add(name: str, place: Place, link: np.ndarray, others: jax.Array, fingers: np.ndarray):
        shape = place.gap.shape
        cone = getattr(hand.cones, "finger_palm" if name == "finger_palm" else "finger_finger")
        own = None
        if grip is not None and name != "finger_palm":
            own = jnp.moveaxis(grip[fingers[0] ^ fingers[1], :, fingers[0]], 1, 0)[:, None]
        others = jnp.broadcast_to(others, shape)
        met = HandContacts(None, jnp.asarray(link), others, jnp.asarray(fingers), own)  # type: ignore[arg-type]
        run = partial(_candidates, scene)
        found[name] = met._replace(contacts=once(run, place, cone, met.relative(velocity)))

    if e.finger_palm:
        first = (first_on_palm(scene.discretization.links) - 1) * k
        link = rings.link[first:]
        own = link, rings.numbers[:, first:], rings.numbers[:, 0]
        place = _on_palm(
            scene, hand, kin, own, (rings.frame[:, :, first:], rings.centre[:, first:])
        )
        add("finger_palm", place, link, jnp.int32(0), alone)
    if on_itself:
        place, other = _on_lines(rings, alone, own=True)
        add("finger_itself", place, rings.link, other, alone)
    if e.finger_finger and rings.lines is not None:
        place, other = _on_lines(rings, two, own=False)
        add("finger_finger", place, rings.link, other, two)
    elif e.finger_finger:
        mine, theirs = (v.ravel() for v in np.meshgrid(rings.number, rings.number, indexing="ij"))
        sides = [
            (v[:, i][:, :, f])
            for i, f in ((mine, two[0]), (theirs, two[1]))
            for v in (rings.numbers, rings.centre)
        ]
        place = once(finger_collision.balls, *sides)
        others = jnp.asarray(rings.link[theirs])[:, None, None]
        add("finger_finger", place, rings.link[mine], others, two)
    return found


def _on_lines(rings: _FingerRings, fingers: np.ndarray, *, own: bool) -> tuple[Place, jax.Array]:
    """Contacts of the first fingers' rings with the second ones' centre lines, and their segments.

    Args:
      fingers: First and second finger of the pairs, shape (2, pair).
      own: Whether both are the same finger.
    """
    lines = rings.lines
    assert lines is not None
    first, second = fingers
    numbers, frame, centre = rings.of(first)
    last = lines.last(rings.numbers) if own else None
    square, other, t = lines.nearest(centre, second, last)
    section = lines.sections(other, second)
    place = once(finger_collision.between, numbers, frame, centre, section, t)
    return place._replace(share=jnp.where(square < FAR, place.share, 0.0)), other


def _on_palm(
    scene: Scene, hand: WorldModel, kin: Kinematics, own: tuple, pose: tuple[jax.Array, jax.Array]
) -> Place:
    """Contacts of rings or spheres with the palm's disc, items first.

    Args:
      own: Their links, their numbers, and the numbers of their fingers' first ones.
      pose: Frames of their links, shape (3, 3, item, finger, world), and their centres.
    """
    assert hand.palm_disc is not None
    row, numbers, first = own
    frame, centre = pose
    disc = kin.place[:, None], kin.palm[:, :, None], hand.palm_disc[:, None]
    look = partial(finger_collision.palm_distance, palm=disc)
    place = _touch(scene, look, numbers, frame, centre)
    sizes = row[:, None, None], numbers, hand.offset[0], first
    return place._replace(share=place.share * finger_collision.free_of_palm(*sizes))


def depth_in_palm(scene: Scene, hand: WorldModel, kin: Kinematics) -> jax.Array:
    """Deepest overlap with the palm's disc of rings or spheres that may touch it [m], (world,)."""
    k = rings_of_link(scene)
    first = first_on_palm(scene.discretization.links) - 1
    numbers = jnp.moveaxis(memory_tables.ring_numbers(scene, hand, k), 1, 0)
    numbers = jnp.broadcast_to(numbers, (*numbers.shape[:2], *kin.origin.shape[2:]))
    own = numbers[:, first * k :]
    link = np.arange(first * k, numbers.shape[1]) // k
    frame = kin.link[:, :, link]
    centre = once(ring_centre, kin.origin[:, link], frame, own)
    place = _on_palm(scene, hand, kin, (link + 1, own, numbers[:, 0]), (frame, centre))
    depth = jnp.where(place.share > 0, -place.gap, -jnp.inf)
    return depth.reshape(-1, depth.shape[-1]).max(0)


class _CentreLines(NamedTuple):
    """Centre lines of fingers, and what `finger_collision.between` takes of them."""

    scene: Scene  # The scene
    # Where segments begin and the last one ends [m], shape (3, link + 2, finger, world)
    ends: jax.Array
    # Of the links, the palm's half one first, shape (3, 3, link + 1, finger, world)
    frames: jax.Array
    # Numbers of the ring whose section a segment has, shape (8, link + 1, finger, world)
    sizes: jax.Array

    def last(self, numbers: jax.Array) -> jax.Array:
        """The last place on segments that rings of the same finger touch; see `last_of`."""
        links = self.scene.discretization.links
        k = rings_of_link(self.scene)
        along = (finger_collision.ring_places(links, k) + np.arange(links)[:, None] + 0.5).ravel()
        largest = jnp.maximum(numbers[:, -1], numbers[:, 0])
        end = along[:, None, None] - finger_collision.arc(numbers[:, -1], largest)
        row = np.arange(links + 1)[:, None, None, None]
        length = np.where(row == links, finger_collision.TIP, 1.0)
        last = jnp.minimum((end - (row - 0.5)) / length, 1.0)
        return jnp.where(row > 0, last, -1.0)  # a finger's half link at the palm is the palm's

    def nearest(
        self, centre: jax.Array, second: np.ndarray, last: jax.Array | None
    ) -> tuple[jax.Array, jax.Array, jax.Array]:
        """Squared distances of places, their nearest segments and where on them."""
        start = self.ends[:, :-1, second]
        along = self.ends[:, 1:, second] - start
        if last is None:
            last = jnp.ones((along.shape[1], 1, 1, 1), centre.dtype)

        def one(best: tuple, row: tuple) -> tuple:
            number, start, along, last = row
            t = dot(centre - start[:, None], along[:, None]) / dot(along, along)
            t = jnp.minimum(jnp.maximum(t, 0.0), last)
            away = centre - start[:, None] - t * along[:, None]
            square = jnp.where(last >= 0, dot(away, away), FAR)
            better = square < finger_collision.SURELY * best[0]
            new = square, number, t
            return tuple(jnp.where(better, a, b) for a, b in zip(new, best, strict=True)), None

        none = 0.0 * centre[0]
        rows = np.arange(along.shape[1], dtype=np.int32)
        over = rows, jnp.moveaxis(start, 1, 0), jnp.moveaxis(along, 1, 0), last
        first = none + FAR, jnp.zeros(none.shape, jnp.int32), none
        return jax.lax.scan(one, first, over)[0]

    def sections(self, row: jax.Array, second: np.ndarray) -> tuple:
        """Ends, frames and sizes of segments, and whether they are the last ones."""
        links = self.scene.discretization.links
        ends = tuple(_of_others(self.ends, r, second) for r in (row, row + 1))
        near = finger_collision.neighbours(row, links)
        frames = tuple(_of_others(self.frames, r, second) for r in near)
        return ends, frames, _of_others(self.sizes, row, second), 1.0 * (row == links)


def _centre_lines(
    scene: Scene, frames: jax.Array, joints: jax.Array, numbers: jax.Array, centre: jax.Array
) -> _CentreLines:
    count = numbers.shape[1]
    row = np.arange(scene.discretization.links + 2)
    ring = np.full(row.shape, count - 1)
    if scene.hand.section.tapered:
        ring = np.maximum((row - 1) * rings_of_link(scene) - 1, 0)
    before = frames[:, :, np.maximum(row[:-1] - 1, 0)]
    passed = once(finger_collision.above, joints, before, frames, numbers[:, ring[:-1]])
    ends = jnp.concatenate([passed, centre[:, -1:]], 1)
    return _CentreLines(scene, ends, frames, numbers[:, ring[1:]])


def _of_others(every: jax.Array, row: jax.Array, second: jax.Array | np.ndarray) -> jax.Array:
    """Numbers (..., row, finger, world) at rows (item, pair, world) of pairs' second fingers."""
    return every[..., row, jnp.asarray(second)[:, None], jnp.arange(every.shape[-1])]
