"""Contacts in slots: few of the many places that may touch do, and only those get a slot.

Every lane fills the slots of a row from the first one on.  A pass through a row ends after the
largest number of slots that any lane of the block has filled, so its cost grows with the contacts
that exist and not with those that are possible.
"""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp

from codesign_jax.engines.structured.contact import Cone, Contacts
from codesign_jax.engines.structured.kernel.contacts import BoundContacts, ContactSet, zeros
from codesign_jax.engines.structured.kernel.memory import MemoryLayout, anywhere, full, solid
from codesign_jax.engines.structured.lanewise import Lanes, lanes, lanewise
from codesign_jax.scene import Scene


def hull_slots(scene: Scene) -> int:
    """Slots of a row of the hull for each of its pairs of bodies."""
    return scene.discretization.hull_rings * scene.discretization.hull_points


class SlotSet(ContactSet):
    """Contacts of one pair of bodies in slots, one contact each, several to a row."""

    def __init__(self, scene: Scene, name: str, rows: int, slots: int, size: int):
        """Prepares the set.

        Args:
          scene: The scene.
          name: Pair of bodies, as in `problem.relative`.
          rows: Number of rows.
          slots: Slots of a row, on each lane; one more takes what finds no room.
          size: Lanes of a block.
        """
        super().__init__(scene, name, rows * (slots + 1), 1, size)
        self.rows, self.slots = rows, slots

    def groups(self) -> dict[str, tuple[int, tuple[int, ...]]]:
        """The set's part of the scratch table."""
        more = {field: (self.count, (n, 1)) for field, n in self.more.items()}
        more["count"] = (self.rows, ())
        return super().groups() | {f"{self.name}.{f}": group for f, group in more.items()}

    more: dict[str, int] = {}
    """Components of further fields of a slot."""

    def bind(self, table: MemoryLayout, ref: Any, read: Callable[[str], Lanes]) -> "BoundSlots":
        """See `ContactSet`."""
        return BoundSlots(self, table, ref, self.cone(read))


class HullSet(SlotSet):
    """Contacts of the skinned hull's vertices; rows are the joints and the tip, see `hull`."""

    more = {"lever": 3, "share": 1}
    places = ("point", "normal", "gap", "lever", "share")
    of_lines = ("gap", "share")

    @staticmethod
    def contacts(place: tuple, cone: Cone) -> Contacts:
        """See `ContactSet`."""
        point, normal, gap, lever, share = place
        return Contacts(point, normal, gap[0], _soft(cone, share[0]), lever)

    @staticmethod
    def of_line(gap: tuple, cone: Cone) -> Contacts:
        """See `ContactSet`."""
        distance, share = (x[0] for x in gap)
        return Contacts(gap[0], gap[0], distance, _soft(cone, share))


def _soft(cone: Cone, share: jax.Array) -> Cone:
    """The cone of a vertex, which has a share of the stiffness."""
    tangent = None if cone.tangent is None else cone.tangent * share
    return cone._replace(normal=cone.normal * share, tangent=tangent)


class BoundSlots(BoundContacts):
    """Slots with their memory; methods work on a row."""

    set: SlotSet  # type: ignore[assignment]

    def clear(self, row: Any) -> None:
        """Empties a row."""
        none = jnp.zeros((self.set.size,), self.ref.dtype)
        self.write("count", lanes([none], (), wide=True), row)

    def used(self, row: Any) -> jax.Array:
        """Number of slots that any lane has filled, a scalar."""
        return jnp.minimum(jnp.max(self.filled(row).astype(jnp.int32)), self.set.slots)

    def filled(self, row: Any) -> jax.Array:
        """Number of slots that each lane has filled and that a pass goes through, shape (lane,)."""
        return self.read("count", row).lane

    def overflow(self) -> jax.Array:
        """One for lanes that had too few slots in any row, else zero, shape (lane,)."""

        def worst(row: jax.Array, most: jax.Array) -> jax.Array:
            return jnp.maximum(most, self.read("count", row).lane)

        none = jnp.zeros((self.set.size,), self.ref.dtype)
        most = jax.lax.fori_loop(0, self.set.rows, worst, none)
        return jnp.where(most > self.set.slots, 1.0, 0.0).astype(none.dtype)

    def add(self, row: Any, which: jax.Array, fields: dict[str, Lanes], lane: jax.Array) -> None:
        """Gives contacts a slot each, on the lanes that have one.

        Args:
          row: The row.
          which: Lanes that have a contact.
          fields: What is kept of it, see `begin`.
          lane: The lanes.
        """
        count, first = self.read("count", row).lane, row * (self.set.slots + 1)
        filled = count.astype(jnp.int32)
        # Lanes without a contact in a slot have sound numbers there, and no touch.
        fresh = first + jnp.minimum(jnp.max(filled), self.set.slots)
        mine = jnp.where(which, jnp.minimum(filled, self.set.slots), self.set.slots)
        for field, value in fields.items():
            away = lanewise(jnp.ones_like, value) if field == "gap" else value
            self.write(field, away, fresh)
            name = f"{self.set.name}.{field}"
            self.table.scatter(self.ref, name, value, first + mine, lane)
        more = jnp.where(which, count + 1.0, count)
        self.write("count", lanes([more], (), wide=True), row)

    def fold(self, row: Any, body: Callable, start: Any) -> Any:
        """Folds body(item, tree of lanes) over the slots in use."""
        used, first = self.used(row), row * (self.set.slots + 1)
        arrays, rebuild = solid(start, self.set.size)

        def step(carry: list) -> list:
            return [
                carry[0] + 1,
                *solid(body(first + carry[0], rebuild(carry[1:])), self.set.size)[0],
            ]

        return rebuild(jax.lax.while_loop(lambda c: c[0] < used, step, [jnp.int32(0), *arrays])[1:])

    def push(self, item: Any, alpha: Lanes) -> tuple[Lanes, Lanes]:
        """Adds the last step to jar; the row's contact inertia (9, 9) and wrench (9,)."""

        def add(slot: Any, sums: list[Lanes]) -> list[Lanes]:
            return lanewise(lambda a, b: jax.tree.map(jnp.add, a, b), sums, self._push(slot, alpha))

        triangle, wrench = self.fold(item, add, self._zeros((45,), (9,)))
        return full(triangle), wrench

    def prepare_linesearch(self, item: Any, step: Lanes) -> Lanes:
        """Stores the contacts' cost along a relative motion (9, ...); returns its slope at 0."""

        def add(slot: Any, sums: Lanes) -> Lanes:
            return lanewise(jnp.add, sums, self._prepare_linesearch(slot, step))

        return self.fold(item, add, self._zeros(())[0])

    def slopes(self, item: Any, alpha: Lanes) -> list[Lanes]:
        """First and second derivative of the row's cost by the step length, at alpha."""

        def add(slot: Any, sums: list[Lanes]) -> list[Lanes]:
            return lanewise(
                lambda a, b: jax.tree.map(jnp.add, a, b), sums, self._slopes(slot, alpha)
            )

        return self.fold(item, add, self._zeros((), ()))

    def _zeros(self, *shapes: tuple[int, ...]) -> list[Lanes]:
        like = jnp.zeros((self.set.size,), self.ref.dtype)
        return [zeros(shape, like) for shape in shapes]


def any_of(which: jax.Array, then: Callable[[], None]) -> None:
    """Runs what stores something, if any lane is true."""
    jax.lax.cond(anywhere(which), then, lambda: None)
