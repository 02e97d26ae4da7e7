"""Contacts whose slots are dealt to the lanes of a team, see `teams`."""

import contextlib
from collections.abc import Callable, Iterator
from typing import Any

import jax
import jax.numpy as jnp

from codesign_jax.engines.structured.kernel.contact_sets import ROWS
from codesign_jax.engines.structured.kernel.counts import Counts
from codesign_jax.engines.structured.kernel.memory import Block, solid
from codesign_jax.engines.structured.kernel.pairing import Pairing
from codesign_jax.engines.structured.kernel.pairs import BoundPairs, OwnSide, PairSet, _times
from codesign_jax.engines.structured.kernel.slots import BoundSlots, HullSet, Slot
from codesign_jax.engines.structured.kernel.teams import TEAM, Parts, ranks
from codesign_jax.engines.structured.lanewise import Lanes, lanes, lanewise
from codesign_jax.engines.structured.laws import contact
from codesign_jax.scene import Scene


class TeamHullSet(HullSet):
    """Contacts of the hull as one list a finger, in order of their rows."""

    def __init__(
        self, scene: Scene, name: str, rows: int, slots: int, size: int, block: tuple[int, int, int]
    ):
        """As `SlotSet`; block: fingers, worlds and lanes of a team."""
        super().__init__(scene, name, rows, slots, size, gathers=True)
        self.block = block
        n = ROWS[scene.effects.friction][0]
        self.more = HullSet.more | {"row": 1, "hessian": n * (n + 1) // 2, "force": n}

    def groups(self) -> dict[str, tuple[int, tuple[int, ...]]]:
        """See `SlotSet`; and where each row's contacts begin in the list, and its length."""
        more = {f"{self.name}.begin": (self.rows, ()), f"{self.name}.total": (1, ())}
        return super().groups() | more

    def bind(self, table: Any, ref: Any, read: Callable[[str], Lanes]) -> "TeamHull":
        """See `ContactSet`."""
        return TeamHull(self, table, ref, self.cone(read))


class TeamHull(BoundSlots):
    """The list with its memory."""

    set: TeamHullSet  # type: ignore[assignment]

    def __init__(self, *bound: Any):
        """See `BoundContacts`."""
        super().__init__(*bound)
        self.block = Block(*self.set.block)

    def _lane(self) -> jax.Array:
        return self.block.own

    def clear(self, row: Any) -> None:
        """Empties a row, which begins where the list ends."""
        super().clear(row)
        total = jnp.where(jnp.equal(row, 0), 0.0, self.read("total", 0).lane)
        for name, item in (("total", 0), ("begin", row)):
            self.write(name, lanes([total], (), wide=True), item)

    def add(self, row: Any, which: jax.Array, fields: dict[str, Lanes], lane: jax.Array) -> None:
        """See `BoundSlots`; lanes of a team append in their order."""
        total, rank, number = self.read("total", 0).lane, *ranks(self.block, which)
        end = self.set.rows * self.set.slots
        mine = jnp.where(which, jnp.minimum(total.astype(jnp.int32) + rank, end), end)
        at = jnp.zeros_like(total) + jnp.asarray(row, total.dtype)
        for field, value in {**fields, "row": lanes([at], (1, 1), wide=True)}.items():
            self.table.scatter(self.ref, f"{self.set.name}.{field}", value, mine, lane)
        more = number.astype(total.dtype)
        for name, item in (("total", 0), ("count", row)):
            value = self.read(name, item).lane + more
            self.write(name, lanes([value], (), wide=True), item)

    def keep_counts(self) -> None:
        """See `BoundSlots`."""
        super().keep_counts()
        most = self.set.rows * self.set.slots
        begins = [self.read("begin", k).lane.astype(jnp.int32) for k in range(self.set.rows)]
        self._begins = Counts.of_rows(begins, most)
        self._total = jnp.minimum(self.read("total", 0).lane.astype(jnp.int32), most)

    @contextlib.contextmanager
    def only(self, busy: jax.Array) -> Iterator[None]:
        """See `BoundSlots`."""
        before = self._total
        self._total = jnp.where(busy, before, 0)
        with super().only(busy):
            yield
        self._total = before

    def fold(self, row: Any, body: Callable, start: Any) -> Any:
        """Folds body(item, tree of lanes) over slots.

        Args:
          row: A row, whose contacts all lanes of a team go through; or None: those of all rows,
            dealt to the lanes.
          body: The function.
          start: The tree.
        """
        assert self._counts is not None
        empty, spare = self.set.count - 1, self.set.count - 2
        if row is None:
            rounds = jax.lax.div(jnp.max(self._total) + (TEAM - 1), jnp.int32(TEAM))
        else:
            count, begin = self._counts.of(row), self._begins.of(row)
            rounds = jnp.max(count)
        arrays, rebuild = solid(start, self.set.size)

        def step(carry: list) -> list:
            k = carry[0]
            if row is None:
                item = k * TEAM + self.block.mate
                mine = item < self._total
            else:
                item, mine = begin + k, k < count
            slot = Slot(jnp.where(mine, item, empty), jnp.where(mine, item, spare))
            return [k + 1, *solid(body(slot, rebuild(carry[1:])), self.set.size)[0]]

        first = [jnp.int32(0), *arrays]
        return rebuild(jax.lax.while_loop(lambda c: c[0] < rounds, step, first)[1:])

    def update_constraints(self, alpha: Lanes) -> None:
        """Adds the last step of the line search to jar; stores Hessians and forces."""

        def store(item: Any, nothing: list) -> list:
            force = self.update_constraint(item, self.place(item), alpha)
            self.write("force", force, item)
            return nothing

        self.fold(None, store, [])

    def columns(self, row: Any, first: Lanes, second: Lanes, forces: Lanes) -> list[Lanes]:
        """The lanes' columns of the sum of X'KX over a row's contacts.

        Args:
          row: The row.
          first: Motion that the lane's column belongs to, shape (9,).
          second: Another one, of which the last three components are wanted.
          forces: The lanes whose column are the forces.

        Returns:
          Both, shapes (9,) and (3,).
        """
        contacts = self.set.contacts

        def column(sums, place, cone, hessian, force, first, second, forces):
            c = contacts(place, cone)
            one, two = (_times(hessian, c.relative(m[:, None])) for m in (first, second))
            one = contact.contact_wrench(c, jnp.where(forces, force, one))
            return [sums[0] + one[:, 0], sums[1] + contact.contact_wrench(c, two)[6:, 0]]

        def add(item: Any, sums: list[Lanes]) -> list[Lanes]:
            kept = [self.read(name, item) for name in ("hessian", "force")]
            place = self.place(item)
            return lanewise(column, sums, place, self.cone, *kept, first, second, forces)

        return self.fold(row, add, self._zeros((9,), (3,)))

    def prepare_all(self, pairs: BoundPairs, palm: Lanes, obj: Lanes) -> Lanes:
        """`prepare_linesearch` of all rows; slopes at 0, each on its lane.

        Args:
          pairs: Has the rows' motion along the step.
          palm: The palm's motion, to which those are relative where contacts with it exist.
          obj: The object's motion.
        """
        held, contacts = self.set.on_object, self.set.contacts
        beside = pairs.set.palm

        def relative(place, cone, motion, turn, palm, obj):
            motion = motion + palm if beside else motion
            motion = motion - obj if held else motion
            return contacts(place, cone).relative(jnp.concatenate([motion, turn])[:, None])

        def add(item: Any, sums: Lanes) -> Lanes:
            row, place = self.read("row", item).lane.astype(jnp.int32), self.place(item)
            sides = [pairs.table.read(pairs.ref, f"side.{n}", row) for n in ("motion", "turn")]
            change = lanewise(relative, place, self.cone, *sides, palm, obj)
            return lanewise(jnp.add, sums, self.line(item, change))

        return self.fold(None, add, self._zeros(())[0])


class TeamPairSet(PairSet):
    """Contacts between fingers, a pairing's slots dealt to the lanes."""

    def __init__(self, scene: Scene, block: tuple[int, int, int], *rest: Any, **how: Any):
        """As `PairSet`; block: fingers, worlds and lanes of a team."""
        super().__init__(scene, block[:2], *rest, **how)
        self.block, self.size = block, block[0] * block[1] * block[2]  # type: ignore[assignment]
        self.more |= {"wrench": 9, "wrench_spare": 2 * TEAM - 9}

    def groups(self) -> dict[str, tuple[int, tuple[int, ...]]]:
        """See `PairSet`; spare rows take what lanes without a component store."""
        found: dict[str, tuple[int, tuple[int, ...]]] = {}
        for name, (count, shape) in super().groups().items():
            found[name] = count, shape
            if name in ("side.motion", "side.turn", "side.push"):
                found[f"{name}_spare"] = count, (-shape[0] % TEAM,)
        return found

    def bind(self, table: Any, ref: Any, read: Callable[[str], Lanes]) -> "TeamPairs":
        """See `ContactSet`."""
        cones = {name: self.cone(read, name) for name in self._names()}
        return TeamPairs(self, table, ref, cones)


class TeamPairs(BoundPairs):
    """The contacts with their memory."""

    def __init__(self, *bound: Any):
        """See `BoundPairs`."""
        super().__init__(*bound)
        self.parts, self._loaded = Parts(self.block, self.table, self.ref), False

    def _lane(self) -> jax.Array:
        return self.block.own

    def used(self, row: Any) -> jax.Array:
        """Rounds of a row."""
        return jax.lax.div(super().used(row) + (TEAM - 1), jnp.int32(TEAM))

    def _slot(self, row: Any, first: Any, k: jax.Array) -> Slot:
        return self._item(row, first, k * TEAM + self.block.mate)

    def _item(self, row: Any, first: Any, number: jax.Array) -> Slot:
        assert self._counts is not None
        mine, item = number < self._counts.of(row), first + number
        empty, spare = self.set.count - 1, self.set.slots
        return Slot(jnp.where(mine, item, empty), jnp.where(mine, item, spare))

    def add(self, row: Any, which: jax.Array, fields: dict[str, Lanes], lane: jax.Array) -> None:
        """See `BoundSlots`; lanes of a team append in their order."""
        slots, count = self.set.slots, self.read("count", row).lane
        rank, number = ranks(self.block, which)
        mine = jnp.where(which, jnp.minimum(count.astype(jnp.int32) + rank, slots), slots)
        for field, value in fields.items():
            name, first = f"{self.set.name}.{field}", row * (slots + 1)
            self.table.scatter(self.ref, name, value, first + mine, lane)
        self.write("count", lanes([count + number.astype(count.dtype)], (), wide=True), row)

    def own_side(self, item: Any) -> OwnSide:
        """See `BoundPairs`; wrenches are added up later."""
        return OwnSide(self.place(item), None, None)

    def load(self, item: Any, own: OwnSide, force: Lanes, pairing: Pairing) -> None:
        """Keeps a slot's wrench, which is added to its side's when the pass has ended."""
        contacts = self.set.contacts

        def wrench(place, cone, force):
            return contact.contact_wrench(contacts(place, cone), force)

        self.write("wrench", lanewise(wrench, own.place, self.cone, force), item)
        self._loaded = True

    def each(self, body: Callable, start: Any) -> Any:
        """See `BoundPairs`; adds up the wrenches of the pass."""
        found = super().each(body, start)
        if self._loaded:
            self._loaded = False
            self._add_wrenches()
        return found

    def clear_wrenches(self) -> None:
        """See `BoundPairs`."""
        none = jnp.zeros((self.set.size,), self.ref.dtype)

        def clear(row: Any, x: jax.Array) -> jax.Array:
            for first in (0, TEAM):
                self.parts.put("side.push", none, row, first)
            return x

        jax.lax.fori_loop(0, self.rows(), clear, jnp.int32(0))

    def _add_wrenches(self) -> None:
        """Adds slots to their sides one after the other, a lane each component."""
        name, palm = f"{self.set.name}.wrench", self.set.palm
        first_six = self.block.mate < 6

        def of_row(row: Any, x: jax.Array) -> jax.Array:
            def one(k: jax.Array, x: jax.Array) -> jax.Array:
                slot = self._item(row, row * (self.set.slots + 1), k)
                side = self.read("row", slot).lane.astype(jnp.int32)
                for first in (0, TEAM):
                    more = self.parts.get(name, slot.source, first)
                    more = self.parts.get("side.push", side, first) + more
                    self.parts.put("side.push", more, side, first)
                if palm:
                    more = jnp.where(
                        first_six & jnp.equal(row, 0), self.parts.get(name, slot.source), 0
                    )
                    more = self.parts.get("side.push", 0) - more
                    self.parts.put("side.push", more, 0)
                return x

            assert self._counts is not None
            return jax.lax.fori_loop(0, jnp.max(self._counts.of(row)), one, x)

        jax.lax.fori_loop(0, self.set.rows, of_row, jnp.int32(0))
