"""Contacts of a kernel: one item at a time, and nothing computed where no lane touches."""

from collections.abc import Callable
from types import SimpleNamespace
from typing import Any

import jax
import jax.numpy as jnp

from codesign_jax.engines.structured import collision, contact
from codesign_jax.engines.structured.contact import Contacts, Line
from codesign_jax.engines.structured.kernel.memory import (
    MemoryLayout,
    anywhere,
    full,
    solid,
    upper,
)
from codesign_jax.engines.structured.lanes import sum_axis
from codesign_jax.engines.structured.lanewise import Lanes, lanes, lanewise
from codesign_jax.engines.structured.solver import along
from codesign_jax.scene import Scene

# Rows of a contact's cone and numbers of its line, by friction model.
ROWS = {"none": (3, 2), "coulomb": (3, 5), "full": (6, 5)}


def zeros(shape: tuple[int, ...], like: jax.Array) -> Lanes:
    """Lanes of zeros of a finger each, like an array over the lanes."""
    count = 1
    for n in shape:
        count *= n
    return lanes([jnp.zeros_like(like)] * count, shape, wide=True)


class ContactSet:
    """The contacts of one pair of bodies: items are links or groups of slots, k contacts each."""

    def __init__(self, scene: Scene, name: str, count: int, k: int, size: int):
        """Prepares the set.

        Args:
          scene: The scene.
          name: Pair of bodies, as in `problem.relative`.
          count: Number of items.
          k: Contacts of an item, on each lane.
          size: Lanes of a block.
        """
        self.scene, self.name, self.count, self.k, self.size = scene, name, count, k, size
        self.on_object = name.endswith("_object")

    def groups(self) -> dict[str, tuple[int, tuple[int, ...]]]:
        """The set's part of the scratch table."""
        rows, ray = ROWS[self.scene.effects.friction]
        fields = {"point": 3, "normal": 3, "gap": 1, "jar": rows, "step": rows, "ray": ray}
        return {f"{self.name}.{f}": (self.count, (n, self.k)) for f, n in fields.items()}

    def bind(self, table: MemoryLayout, ref: Any, friction: Lanes) -> "BoundContacts":
        """The set in a kernel's memory; friction is that of each world's object."""
        return BoundContacts(self, table, ref, friction)

    def cone(self, friction: jax.Array) -> contact.Cone:
        """Contact parameters; friction of the object, shape (1, world)."""
        make = collision.make_cone
        if self.on_object:
            return make(self.scene, friction, bodies=2)
        table = self.scene.objects.table.friction
        if self.name != "object_table":
            table = self.scene.contact.finger_table_friction
        return make(self.scene, table, bodies=1)


class BoundContacts:
    """A contact set with its memory; every method works on one item."""

    def __init__(self, of: ContactSet, table: MemoryLayout, ref: Any, friction: Lanes):
        """See `ContactSet.bind`."""
        self.set, self.table, self.ref, self.friction = of, table, ref, friction

    def read(self, field: str, item: Any) -> Lanes:
        """A field of the item's contacts, shape (component, k, finger, world)."""
        return self.table.read(self.ref, f"{self.set.name}.{field}", item)

    def write(self, field: str, value: Lanes, item: Any) -> None:
        """Stores a field."""
        self.table.write(self.ref, f"{self.set.name}.{field}", value, item)

    def touching(self, item: Any) -> jax.Array:
        """Whether any lane's contact is active, a scalar."""
        gaps = self.read("gap", item).parts.ravel()
        mask = gaps[0] < 0
        for gap in gaps[1:]:
            mask = mask | (gap < 0)
        return anywhere(mask)

    def if_touching(self, item: Any, compute: Callable, shapes: list[tuple]) -> list[Lanes]:
        """compute() where a lane touches, zeros of wide shapes elsewhere."""
        like = jnp.zeros((self.set.size,), self.friction.dtype)
        empty = [zeros(shape, like) for shape in shapes]
        none, rebuild = solid(empty, self.set.size)

        def some() -> list[jax.Array]:
            return solid(compute(), self.set.size)[0]

        return rebuild(jax.lax.cond(self.touching(item), some, lambda: none))

    def create(self, item: Any, geometry: Any, motion: Lanes, velocity: Lanes) -> None:
        """Stores contacts (point, normal, gap) and their jar for relative motions (6, ...)."""
        point, normal, gap = geometry
        self.write("gap", gap, item)

        def jar(point, normal, gap, friction, motion, velocity):
            c = Contacts(point, normal, gap[0], self.set.cone(friction))
            reference = c.reference(c.relative(velocity[:, None]))
            return c.relative(motion[:, None]) - reference

        def store() -> None:
            self.write("point", point, item)
            self.write("normal", normal, item)
            value = lanewise(jar, point, normal, gap, self.friction, motion, velocity)
            self.write("jar", value, item)
            self.write("step", lanewise(jnp.zeros_like, value), item)

        jax.lax.cond(self.touching(item), store, lambda: None)

    def _contacts(self, item: Any) -> tuple[Lanes, Lanes, Lanes]:
        gap = self.read("gap", item)
        return self.read("point", item), self.read("normal", item), gap[0]

    def push(self, item: Any, alpha: Lanes) -> tuple[Lanes, Lanes]:
        """Moves jar along the last line; contact inertia (6, 6) and wrench (6,), summed over k."""

        def response(point, normal, gap, friction, jar):
            c = Contacts(point, normal, gap, self.set.cone(friction))
            r = contact.respond(c, jar)
            matrix = contact.contact_inertia(c, r.hessian)
            return sum_axis(matrix, 2), sum_axis(contact.contact_wrench(c, r.force), 1)

        def compute() -> list[Lanes]:
            jar, step = self.read("jar", item), self.read("step", item)
            jar = lanewise(along, alpha, jar, step)
            self.write("jar", jar, item)
            matrix, wrench = lanewise(response, *self._contacts(item), self.friction, jar)
            return [upper(matrix), wrench]

        triangle, wrench = self.if_touching(item, compute, [(21,), (6,)])
        return full(triangle), wrench

    def aim(self, item: Any, step: Lanes) -> Lanes:
        """Stores the line along a relative motion (6, ...); returns the cost's slope at 0."""

        def ray(point, normal, gap, friction, jar, step):
            c = Contacts(point, normal, gap, self.set.cone(friction))
            change = c.relative(step[:, None])
            line = contact.line(c, jar, change)
            first, _ = contact.slopes(c, line, 0.0)
            return change, jnp.stack([v for v in line if v is not None]), sum_axis(first, 0)

        def compute() -> list[Lanes]:
            jar = self.read("jar", item)
            out = lanewise(ray, *self._contacts(item), self.friction, jar, step)
            self.write("step", out[0], item)
            self.write("ray", out[1], item)
            return [out[2]]

        return self.if_touching(item, compute, [()])[0]

    def slopes(self, item: Any, alpha: Lanes) -> list[Lanes]:
        """First and second derivative of the item's cost along the line."""

        def both(gap, friction, ray, alpha):
            c = Contacts(gap, gap, gap, self.set.cone(friction))
            line = Line(*(ray[i] if i < ray.shape[0] else None for i in range(5)))
            first, second = contact.slopes(c, line, alpha)
            return [sum_axis(first, 0), sum_axis(second, 0)]

        def compute() -> list[Lanes]:
            gap, ray = self.read("gap", item)[0], self.read("ray", item)
            return lanewise(both, gap, self.friction, ray, alpha)

        return self.if_touching(item, compute, [(), ()])


def sphere_on_object(scene: Scene, size, shape, columns, position, centre, radius):
    """Point, normal and gap of spheres (3, k, ...) against the object."""
    hand = SimpleNamespace(object_size=size, object_id=shape.astype(jnp.int32), mesh=None)
    kin = SimpleNamespace(object=columns, object_pos=position)
    c = collision.spheres_on_object(scene, hand, kin, direct, centre, radius)  # type: ignore[arg-type]
    return c.point, c.normal, c.distance[None]


def sphere_on_table(scene: Scene, height, centre, radius):
    """Point, normal and gap of spheres (3, k, ...) against the table."""
    c = collision.spheres_on_table(scene, height, centre, radius)
    return c.point, c.normal, c.distance[None]


def direct(function: Callable, *args: Any) -> Any:
    """Runs a stage: in a kernel nothing is computed twice."""
    return function(*args)
