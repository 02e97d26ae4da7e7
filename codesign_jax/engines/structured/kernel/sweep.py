"""The reverse pass of a step through palm, fingers and contacts, from the tips inwards."""

from collections.abc import Callable
from functools import partial
from typing import TYPE_CHECKING, Any

import jax
import jax.numpy as jnp

from codesign_jax.engines.structured.kernel import fields, objects, powers
from codesign_jax.engines.structured.kernel.bars import Bars
from codesign_jax.engines.structured.kernel.contact_sets import zeros
from codesign_jax.engines.structured.kernel.memory import choose, loop
from codesign_jax.engines.structured.kernel.objects import WorldObject
from codesign_jax.engines.structured.kernel.powers import Chain, Place
from codesign_jax.engines.structured.kernel.problem import Iterate, Memory
from codesign_jax.engines.structured.kernel.pull import plus, pull
from codesign_jax.engines.structured.kernel.step import FINGER_CONSTANTS, LINK_CONSTANTS
from codesign_jax.engines.structured.lanewise import Lanes, lanes, lanewise
from codesign_jax.engines.structured.laws import shapes, surroundings
from codesign_jax.engines.structured.laws.cones import own_friction, which_cone
from codesign_jax.engines.structured.laws.kinematics import mounted
from codesign_jax.engines.structured.world_model import apply_columns

if TYPE_CHECKING:
    from codesign_jax.engines.structured.kernel.step import Step

SHAPES = Chain((3,), (3, 3), (6,), (6,), (6,), (6,))


class Sweep:
    """Adds a step's part of the cotangents, given its virtual accelerations."""

    def __init__(
        self,
        step: "Step",
        m: Memory,
        state: dict[str, Lanes],
        at: dict[str, Any],
        thing: WorldObject,
        virtual: Iterate,
        bars: Bars,
    ):
        """Takes a step's memory and geometry as the forward pass has left them, see `Step`.

        Args:
          step: The step.
          m: Its memory.
          state: Positions and velocities of wrist and object.
          at: What `Step` calculates of palm and object.
          thing: The objects.
          virtual: Virtual accelerations, see `Virtual.solve`.
          bars: The cotangents so far.
        """
        self.step, self.p, self.m, self.at, self.thing = step, step.p, m, at, thing
        self.virtual, self.bars, self.block = virtual, bars, step.block
        self.like = jnp.zeros((step.p.size,), step.finger_state.dtype)
        self.one = lanes([self.like + 1.0], (), wide=True)
        self.object = {"columns": at["columns"], "object_vel": at["object_vel"]}
        self.object |= {"height": state["position"][2]}
        if self.p.scene.fixture:
            self.object |= {"position": state["position"]}
        names = ("object_size", "grid_origin", "grid_cell", "grid_factor")
        self.object |= {n: step.constant(n) for n in names if n in step.p.world.groups}
        self.still: dict[str, Any] = {"object_id": step.constant("object_id")}
        self.still |= {"object_motion": at["now"].object_motion}
        self.still |= {"object_along": virtual.object_motion}
        if thing.mesh is not None:
            self.still |= {n: step.constant(n) for n in ("grid_first", "grid_nodes")}
            self.still |= {"meshed": thing.mesh.meshed}

    def chain(self, i: Any) -> Chain:
        """What the link before joint i hands on."""
        names = (f"chain.{n}" for n in Chain._fields)
        return Chain(*(self.m.scratch.read(self.m.scratch_ref, n, i) for n in names))

    def fingers(self, pressure: Lanes, centre_bar: Lanes) -> Chain:
        """Goes through the fingers from their tips, and through the contacts of their links.

        Args:
          pressure: Chamber pressures.
          centre_bar: Cotangent of the sum of the segments' centres.

        Returns:
          Cotangents of what the palm hands on, on each finger's lanes.
        """
        p, tips = self.p, self.p.links
        touching = [n for n in ("finger_object", "finger_table") if n in self.m.contacts]

        def link(i: Any, after: Chain) -> Chain:
            if touching:
                place = _place(self.chain(i + 1))
                for name in touching:
                    new = self.rings(name, i, place)
                    after = _add(after, **new._asdict())
            before = self._link(i, after, pressure, centre_bar)
            return self.more(before, i)

        after = Chain(*(zeros(shape, self.like) for shape in SHAPES))
        after = self.more(after, tips)
        base = loop(tips, link, after, p.size, reverse=True)
        return self._mount(base, centre_bar)

    def none(self, name: str) -> Lanes:
        """No cotangent of what a link hands on, by name."""
        return zeros(getattr(SHAPES, name), self.like)

    def more(self, bars: Chain, i: Any) -> Chain:
        """Adds what contacts between fingers have left for a link."""
        if "pairbar.origin" not in self.p.scratch.groups:
            return bars
        read = partial(self.p.scratch.read, self.step.scratch)
        return _add(bars, **{n: read(f"pairbar.{n}", i) for n in Place._fields})

    def _link(self, i: Any, after: Chain, pressure: Lanes, centre_bar: Lanes) -> Chain:
        numbers, joint = self.step.link_constants(i), self.step.joint(i)
        still = {"acc": joint.pop("acc")}
        still["virtual"] = self.m.scratch.read(self.m.scratch_ref, "virtual", i)
        share = self.p.hand.read(self.step.hand, "share", i + 1)
        still["centre_bar"] = lanewise(jnp.multiply, centre_bar, share)
        run, joint = partial(powers.of_link, self.p.scene), joint | {"pressure": pressure}
        before, own, moved = pull(run, (self.chain(i), numbers, joint), (still,), (after, self.one))
        self.bars.add({n: own.pop(n) for n in LINK_CONSTANTS}, i)
        sections = {n: own.pop(n) for n in FINGER_CONSTANTS if n in own}
        self.bars.add(sections, i if self.p.tapered else 0)
        self.bars.add(own | {"pressure": moved.pop("pressure")})
        self.bars.add_joint(moved, i)
        return before

    def _mount(self, base: Chain, centre_bar: Lanes) -> Chain:
        read = partial(self.p.hand.read, self.step.hand)
        names = ("mount", "base", "stub_centre")
        palm = self.at["place"], self.at["frame"]

        def run(palm, mount, base, stub, weight):
            place, frame = palm
            turned, origin = mounted(place, frame, mount, base)
            return turned, origin, dot_of(weight, place + apply_columns(frame, stub))

        weight = lanewise(jnp.multiply, centre_bar, read("share"))
        given = (palm, *(read(n) for n in names))
        (place, frame), *own = pull(run, given, (weight,), (base.frame, base.origin, self.one))
        self.bars.add(dict(zip(names, own, strict=True)))
        return base._replace(origin=place, frame=frame)

    # Contacts

    def palm_and_table(self, base: Chain) -> Chain:
        """Adds the contacts of the palm's rings or spheres, and of the object with the table."""
        names = [n for n in ("palm_object", "palm_table") if n in self.m.contacts]
        at, now = self.at, self.at["now"]
        place = Place(
            at["place"], at["frame"], at["vel"], now.palm_motion, self.virtual.palm_motion
        )
        if "palmbar.origin" in self.p.scratch.groups:
            read = partial(self.p.scratch.read, self.step.scratch)
            base = _add(base, **{n: read(f"palmbar.{n}") for n in Place._fields})
        for i in range(self.p.palm_groups if names else 0):
            for name in names:
                new = self.rings(name, i, place, "palm_ring")
                base = _add(base, **new._asdict())
        if powers.TABLE in self.m.contacts:
            self._table()
        return base

    def rings(self, name: str, i: Any, place: Place, table: str = "ring") -> Place:
        """Cotangents of a body, of an item of the contacts of its rings."""
        k = self.p.k if table == "ring" else 1
        rows = [self.p.hand.read(self.step.hand, table, i * k + j) for j in range(k)]
        numbers = lanewise(lambda rows: jnp.stack(rows, 1), rows)

        def compute(at: dict, still: dict) -> Place:
            if "meshed" in still and name.endswith("_object"):
                centre = lanewise(fields.ring_centres, place.origin, place.frame, numbers)
                still = still | {"values": self._values(centre)}
                if self.p.hull:
                    run = partial(powers.aim, self.p.scene, name)
                    again = lanewise(run, place, numbers, at, still)
                    still = still | {"values_again": self._values(again)}
            run = partial(powers.of_rings, self.p.scene, name)
            found, own, shared = pull(run, (place, numbers, at), (still,), self.one)
            for j in range(k):
                self.bars.add({table: own[:, j]}, i * k + j)
            self.bars.add(shared)
            return found

        return self._touching(name, i, compute)

    def _touching(self, name: str, i: Any, compute: Callable[[dict, dict], Place]) -> Place:
        """What is computed of an item's contacts if there are any."""
        at, empty = self._object(name), Place(*(self.none(n) for n in Place._fields))
        contacts = self.m.contacts[name]
        still = self.still | {"share": contacts.read("share", i)}
        return choose(contacts.touching(i), lambda: compute(at, still), empty, self.p.size)

    def _table(self) -> None:
        contacts, p = self.m.contacts[powers.TABLE], self.p
        finger = lanes([self.block.finger.astype(self.like.dtype)], (), wide=True)
        at, still = self._object(powers.TABLE), self.still
        if "meshed" in still:
            columns = self.at["columns"]
            still = still | {"factor": self.object["grid_factor"]}
            still |= {"support": self._support(columns, self.object["height"])}
            for j, fixture in enumerate(p.scene.fixture):
                position = self.object["position"]
                gap, rows = lanewise(partial(surroundings.towards, fixture), position)
                turned = lanewise(surroundings.faced, rows, columns)
                still |= {f"support_{j}": self._support(turned, gap)}
                if surroundings.EDGES[fixture.type]:
                    point = lanewise(partial(surroundings.edges, fixture), position)
                    still |= {f"values_{j}": self._values(point)}
        for i in range(contacts.set.count):

            def compute(i: int = i) -> None:
                run = partial(powers.of_table, p.scene, p.fingers, i)
                shares = {"share": contacts.read("share", i)}
                (found,) = pull(run, (at,), (finger, still | shares), self.one)
                self.bars.add(found)

            jax.lax.cond(contacts.touching(i), compute, lambda: None)

    def _object(self, name: str) -> dict[str, Lanes]:
        """What contacts of a pair of bodies depend on beside the hand, by name."""
        cone = f"cone.{which_cone(name)}"
        surrounded = bool(self.p.scene.fixture)
        names = {"height", "position"} if surrounded else {"height"}
        if not name.endswith("_table"):
            names = set(self.object) - names
        if name == powers.TABLE:
            names = set(self.object) - (set() if surrounded else {"grid_origin", "grid_cell"})
        chosen = {n: v for n, v in self.object.items() if n in names}
        names = [cone] + ["friction"] * own_friction(self.p.scene, name)
        return chosen | {n: self.step.constant(n) for n in names}

    def _support(self, columns: Lanes, height: Lanes) -> Lanes:
        """Points that may touch a table of these axes, in the object's frame."""
        points = objects.table_points(self.p.scene, self.thing, columns, height)
        return lanewise(_turned_back, columns, points)

    def _values(self, centre: Lanes) -> Lanes:
        local = lanewise(shapes.in_object, self.at["columns"], centre)
        return objects.cell_values(self.thing, local)


def dot_of(weight: jax.Array, vector: jax.Array) -> jax.Array:
    """Product of two vectors (3, ...)."""
    return sum(weight[k] * vector[k] for k in range(3))  # type: ignore[return-value]


def _turned_back(columns: jax.Array, points: jax.Array) -> jax.Array:
    """Points (3, point, world) along the world's axes in the object's frame."""
    return shapes.in_object(columns[:, :, 0], points)


def _place(chain: Chain) -> Place:
    return Place(*(getattr(chain, n) for n in Place._fields))


def _add(bars: Chain, **more: Lanes) -> Chain:
    old = {n: getattr(bars, n) for n in more}
    return bars._replace(**plus(old, more))
