"""Contact sets: the contacts of a pair of bodies, one item (a link, or a group of slots) at a time.

Where no lane of the block has an active contact, the item is skipped.  Here a contact has a fixed
place in memory.  Derived from it are contacts that get a slot (`slots`), contacts of the hand with
itself (`self_contacts`), and contacts that the lanes of a team share (`team_contacts`).
"""

from collections.abc import Callable
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp

from codesign_jax.engines.structured.kernel import rows
from codesign_jax.engines.structured.kernel.memory import (
    BoundTable,
    anywhere,
    full,
    loop,
    solid,
    tree_add_scaled,
    upper,
)
from codesign_jax.engines.structured.kernel.placement import Item, at
from codesign_jax.engines.structured.kernel.rows import Contact, Group, Rows
from codesign_jax.engines.structured.lanes import dot, sum_axis
from codesign_jax.engines.structured.lanewise import Lanes, lanes, lanewise
from codesign_jax.engines.structured.laws import contact, holding
from codesign_jax.engines.structured.laws.cones import friction_by_contact, which_cone
from codesign_jax.engines.structured.laws.contact import Cone, Contacts, LineCost
from codesign_jax.engines.structured.laws.rings import Place
from codesign_jax.model.held import held
from codesign_jax.scene import Scene

# Numbers of a contact's line, by friction model.
LINE = {"none": 2, "coulomb": 5}
# Fields of a cone that a friction model does not need.
NEEDLESS = {
    "none": ("tangential_mass", "friction", "regularized_friction"),
    "coulomb": (),
}


def cone_fields(scene: Scene) -> list[str]:
    return [name for name in Cone._fields if name not in NEEDLESS[scene.effects.friction]]


def cone_of(scene: Scene, numbers: Any) -> Cone:
    """The cone of a scene's contacts from its numbers, in the order of `cone_fields`."""
    fields: dict[str, Any] = dict.fromkeys(Cone._fields)
    return Cone(**fields | {name: numbers[i] for i, name in enumerate(cone_fields(scene))})


def zeros(shape: tuple[int, ...], like: jax.Array) -> Lanes:
    """Lanes of zeros of a finger each, like an array over the lanes."""
    count = 1
    for n in shape:
        count *= n
    return lanes([jnp.zeros_like(like)] * count, shape, wide=True)


class ContactSet:
    """The contacts of one pair of bodies: items are links or groups of slots, k contacts each.

    Attributes:
      in_teams: Whether each lane of a team has contacts of its own, and not all of them the same.
      per_link: Whether its items are a finger's links.
    """

    in_teams = False

    def __init__(self, scene: Scene, name: str, count: int, k: int, size: int):
        self.scene = scene
        self.name = name
        self.count = count
        self.k = k
        self.size = size
        self.on_object = name.endswith("_object")
        self.per_link = name.startswith("finger_")
        self.friction_by_contact = friction_by_contact(scene, name)
        # Self-contacts share what they hold, see `friction_memory`.
        self.holds = name in held(scene) and name != "finger_finger"
        # Whether places are stored where nothing touches as well, to be recorded
        self.stores_all = False

    @property
    def sizes(self) -> dict[str, int]:
        """Lengths of the axes of `rows`."""
        ray = LINE[self.scene.effects.friction]
        sizes = {rows.ONE: 1, rows.ITEM: self.count, rows.CONTACTS: self.k, rows.RAY: ray}
        return sizes | {rows.TOUCH: self.count * self.k}

    def groups_of(self, *tables: type[Rows]) -> dict[str, Group]:
        """The rows of declared ones that the set has."""
        groups: dict[str, Group] = {}
        for table in tables:
            for field, group in table.groups(self, self.sizes).items():
                groups[f"{self.name}.{field}"] = group
        return groups

    def groups(self) -> dict[str, Group]:
        """All rows of the set in scratch memory."""
        return self.groups_of(Contact)

    def bind(self, table: BoundTable, read: Callable[[str], Lanes]) -> "BoundContacts":
        """The set in a kernel's memory; `read` reads constants of the worlds by name."""
        return BoundContacts(self, table, self.cone(read))

    def cone_rows(self) -> dict[str, Group]:
        return {f"cone.{which_cone(self.name)}": (1, (len(cone_fields(self.scene)),))}

    def cone(self, read: Callable[[str], Lanes], pair: str = "") -> Cone:
        numbers = read(f"cone.{which_cone(pair or self.name)}")
        return cone_of(self.scene, numbers)

    @staticmethod
    def contacts(place: Place, cone: Cone) -> Contacts:
        return Contacts(place.point, place.normal, place.gap, cone.of_share(place.share))

    @staticmethod
    def of_line(share: jax.Array, cone: Cone) -> Contacts:
        """What a line search needs of contacts."""
        return Contacts(share[None], share[None], share, cone.of_share(share))


class BoundContacts:
    """A contact set with its memory; every method works on one item."""

    def __init__(self, of: ContactSet, table: BoundTable, cone: Cone):
        self.set = of
        self.table = table
        self.cone = cone
        self.like = jnp.zeros((of.size,), table.dtype)

    def read(self, field: str, item: Item) -> Lanes:
        """A field of the item's contacts, shape (component, k, finger, world)."""
        name = f"{self.set.name}.{field}"
        if not jnp.ndim(item.source):
            return self.table.read(name, item.source)
        return self.table.gather(name, item.source, self._lane())

    def write(self, field: str, value: Lanes, item: Item) -> None:
        """Stores a field of the item's contacts."""
        name = f"{self.set.name}.{field}"
        if not jnp.ndim(item.sink):
            self.table.write(name, value, item.sink)
        else:
            self.table.scatter(name, value, item.sink, self._lane())

    def _lane(self) -> jax.Array:
        return jax.lax.broadcasted_iota(jnp.int32, (self.set.size,), 0)

    def touching(self, item: Item) -> jax.Array:
        """Whether any lane's contact is active, a scalar."""
        shares = self.read(Contact.share, item).parts.ravel()
        mask = shares[0] > 0
        for share in shares[1:]:
            mask = mask | (share > 0)
        return anywhere(mask)

    def if_touching(self, item: Item, compute: Callable, parts: list[tuple]) -> list[Lanes]:
        """compute() where a lane touches, zeros of wide shapes elsewhere."""
        empty = [zeros(shape, self.like) for shape in parts]
        none, rebuild = solid(empty, self.set.size)

        def some() -> list[jax.Array]:
            return solid(compute(), self.set.size)[0]

        return rebuild(jax.lax.cond(self.touching(item), some, lambda: none))

    def cone_at(self, item: Item) -> Cone:
        """The cone of the item's contacts."""
        if item.cone is not None:
            return item.cone
        if not self.set.friction_by_contact:
            return self.cone
        return lanewise(Cone.of_friction, self.cone, self.read(Contact.friction, item)[0])

    def create(
        self,
        item: Item,
        place: Place,
        acc: Lanes,
        vel: Lanes,
        friction: Lanes | None = None,
        hold: tuple[Lanes, Lanes] | None = None,
    ) -> None:
        """Stores contacts of a link's or a group's places.

        Args:
          acc: Relative spatial acceleration of the bodies, (6, ...); `vel`: relative velocity.
          friction: Coulomb coefficients (1, k) of contacts that have their own.
          hold: What they hold of friction, (3, k), along the world's axes and as it is kept.
        """
        if friction is not None:
            self.write(Contact.friction, friction, item)
        place, jar = self.begin(item, place, acc, vel)
        more = {}
        if hold is not None:
            jar = lanewise(with_held, jar, place, self.cone_at(item), hold[0])
            more = {Contact.held: hold[1]}
        self.write(Contact.share, place.share, item)

        def store() -> None:
            for field, value in (fields_of(place, jar) | more).items():
                self.write(field, value, item)

        if self.set.stores_all:
            store()
        else:
            jax.lax.cond(self.touching(item), store, lambda: None)

    def begin(self, item: Item, place: Place, acc: Lanes, vel: Lanes) -> tuple[Place, Lanes]:
        """Places whose share is zero where no candidate is, and their jar."""
        run = partial(as_candidates, margin(self.set.scene))
        return lanewise(run, place, self.cone_at(item), acc, vel)

    def each_item(self, body: Callable[[Item], None]) -> None:
        """Runs body(item), which stores something, for all items."""

        def step(number: jax.Array, x: jax.Array) -> jax.Array:
            body(at(number))
            return x

        jax.lax.fori_loop(0, self.set.count, step, jnp.int32(0))

    def fold_items(self, body: Callable, start: Any) -> Any:
        """Folds body(item, tree of lanes) over all items."""
        fold = lambda number, carry: body(at(number), carry)  # noqa: E731
        return loop(self.set.count, fold, start, self.set.size)

    def place(self, item: Item) -> Place:
        return Place(*(self.read(field, item) for field in Place._fields))

    def deepest(self) -> Lanes:
        """The largest depth of the lanes' contacts [m], zero where nothing overlaps."""
        return self.fold_items(self._deeper, zeros((), self.like))

    def _deeper(self, item: Item, depth: Lanes) -> Lanes:
        return lanewise(
            _deeper, depth, self.read(Contact.share, item), self.read(Contact.gap, item)
        )

    def inertia_and_wrench(self, item: Item, alpha: Lanes) -> tuple[Lanes, Lanes]:
        """Adds the last step to jar; returns the contacts' inertia (6, 6) and wrench (6,) there."""
        parts: list[tuple] = [(21,), (6,)]
        triangle, wrench = self.if_touching(
            item, lambda: self._inertia_and_wrench(item, alpha), parts
        )
        return full(triangle), wrench

    def _inertia_and_wrench(self, item: Item, alpha: Lanes) -> list[Lanes]:
        # All is read before anything is stored, see `self_contacts.OwnSide`.
        jar = self.read(Contact.jar, item)
        step = self.read(Contact.step, item)
        place = self.place(item)
        jar = lanewise(tree_add_scaled, alpha, jar, step)
        self.write(Contact.jar, jar, item)
        matrix, wrench = lanewise(inertia_and_wrench, place, self.cone_at(item), jar)
        return [upper(matrix), wrench]

    def wrench(self, item: Item, alpha: Lanes) -> Lanes:
        """Wrench (6,) of the item's contacts where the last step has moved jar, which is kept."""
        return self.if_touching(item, lambda: [self._wrench(item, alpha)], [(6,)])[0]

    def _wrench(self, item: Item, alpha: Lanes) -> Lanes:
        contacts = self.set.contacts

        def response(place, cone, alpha, jar, step):
            c = contacts(place, cone)
            force = contact.constraint_update(c, jar + alpha * step).force
            return sum_axis(contact.contact_wrench(c, force), 1)

        jar = self.read(Contact.jar, item)
        step = self.read(Contact.step, item)
        return lanewise(response, self.place(item), self.cone_at(item), alpha, jar, step)

    def changes(self, item: Item, alpha: Lanes) -> Lanes:
        """How many of the item's contacts the last step takes to another zone of the cone."""
        return self.if_touching(item, lambda: [self._changes(item, alpha)], [()])[0]

    def _changes(self, item: Item, alpha: Lanes) -> Lanes:
        of_line = self.set.of_line

        def count(share, cone, ray, alpha):
            c = of_line(share, cone)
            line = LineCost(*(ray[i] if i < ray.shape[0] else None for i in range(5)))
            return sum_axis(jnp.where(contact.same_zone(c, line, alpha), 0.0, 1.0), 0)

        share = self.read(Contact.share, item)
        cone = self.cone_at(item)
        return lanewise(count, share, cone, self.read(Contact.ray, item), alpha)

    def prepare_linesearch(self, item: Item, step: Lanes) -> Lanes:
        """Stores the cost along a step (6, ...) of the acceleration; returns its slope at 0."""
        return self.if_touching(item, lambda: [self._prepare_linesearch(item, step)], [()])[0]

    def _prepare_linesearch(self, item: Item, step: Lanes) -> Lanes:
        return self.line(item, self.relative_acceleration(item, step))

    def relative_acceleration(self, item: Item, acc: Lanes) -> Lanes:
        """Accelerations (3, k) of contact points in their axes, by that of the bodies (6, ...)."""
        contacts = self.set.contacts

        def relative(place, cone, acc):
            return contacts(place, cone).relative(acc[:, None])

        return lanewise(relative, self.place(item), self.cone_at(item), acc)

    def record(self, table: BoundTable, name: str, value: Lanes, item: Item) -> None:
        """Writes a field of `rows.TouchForce` of an item's contacts, (..., k)."""
        for j in range(self.set.k):
            table.write(name, value[..., j, :, :], item.number * self.set.k + j)

    def line(self, item: Item, change: Lanes) -> Lanes:
        """Stores the contacts' cost along a change of jar; returns its slope at 0."""
        given = self.place(item), self.cone_at(item), self.read(Contact.jar, item), change
        line, slope = lanewise(cost_along_line, *given)
        self.write(Contact.step, change, item)
        self.write(Contact.ray, line, item)
        return slope

    def slopes(self, item: Item, alpha: Lanes) -> list[Lanes]:
        """First and second derivative of the item's cost by the step length, at alpha."""
        return self.if_touching(item, lambda: self._slopes(item, alpha), [(), ()])

    def _slopes(self, item: Item, alpha: Lanes) -> list[Lanes]:
        share = self.read(Contact.share, item)
        cone = self.cone_at(item)
        return lanewise(slopes_along_line, share, cone, self.read(Contact.ray, item), alpha)


# Stages that the kernel evaluates lane by lane


def inertia_and_wrench(place, cone, jar):
    """Sums over an item's contacts: the inertia (6, 6) that they add, and their wrench (6,)."""
    c = ContactSet.contacts(place, cone)
    r = contact.constraint_update(c, jar)
    matrix = contact.contact_inertia(c, r.hessian)
    return sum_axis(matrix, 2), sum_axis(contact.contact_wrench(c, r.force), 1)


def cost_along_line(place, cone, jar, change):
    """Numbers of the contacts' cost along a change of jar, see `LineCost`, and its slope at 0."""
    c = ContactSet.contacts(place, cone)
    line = contact.line(c, jar, change)
    first, _ = contact.slopes(c, line, 0.0)
    return jnp.stack([v for v in line if v is not None]), sum_axis(first, 0)


def slopes_along_line(share, cone, ray, alpha):
    """First and second derivative of that cost at alpha, summed over an item's contacts."""
    c = ContactSet.of_line(share, cone)
    line = LineCost(*(ray[i] if i < ray.shape[0] else None for i in range(5)))
    first, second = contact.slopes(c, line, alpha)
    return [sum_axis(first, 0), sum_axis(second, 0)]


def force_of_jar(place, cone, jar):
    """Forces (3, k) of contacts on their first body [N], world axes."""
    contacts = ContactSet.contacts(place, cone)
    force = contact.constraint_update(contacts, jar).force[:3]
    return jnp.where(contacts.active, force, 0.0)


def _deeper(depth, share, gap):
    """The larger of a depth and those of contacts that touch."""
    for k in range(gap.shape[0]):
        depth = jnp.maximum(depth, jnp.where(share[k] > 0, -gap[k], 0.0))
    return depth


def margin(scene: Scene) -> float:
    return contact.MARGIN if scene.effects.surface == "hull" else 0.0


def with_held(jar: jax.Array, place: Place, cone: Cone, held_friction: jax.Array) -> jax.Array:
    """The jar of contacts with the friction that they hold, see `holding.held`."""
    return jar + holding.held(ContactSet.contacts(place, cone), held_friction)


def fields_of(place: Place, jar: Lanes) -> dict[str, Lanes]:
    """What is kept of new contacts, by field."""
    return {**place._asdict(), Contact.jar: jar, Contact.step: lanewise(jnp.zeros_like, jar)}


def as_candidates(
    margin: float, place: Place, cone: Cone, acc: jax.Array, vel: jax.Array
) -> tuple[Place, jax.Array]:
    c = ContactSet.contacts(place, cone)
    speed = c.relative(vel[:, None])
    approach = -dot(place.normal, speed)
    share = contact.candidates(place.share, place.gap, approach, cone, margin)
    return place._replace(share=share), c.relative(acc[:, None]) - c.reference(speed)
