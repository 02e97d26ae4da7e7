"""Contacts in the kernel, one item (a link, or a group of slots) at a time.

Where no lane of the block has an active contact, the item is skipped.
"""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp

from codesign_jax.engines.structured.kernel import objects
from codesign_jax.engines.structured.kernel.memory import MemoryLayout, anywhere, full, solid, upper
from codesign_jax.engines.structured.kernel.objects import WorldObject
from codesign_jax.engines.structured.kernel.solver import tree_add_scaled
from codesign_jax.engines.structured.lanes import sum_axis
from codesign_jax.engines.structured.lanewise import Lanes, lanes, lanewise
from codesign_jax.engines.structured.laws import contact, shapes
from codesign_jax.engines.structured.laws.cones import which_cone
from codesign_jax.engines.structured.laws.contact import Cone, Contacts, Line
from codesign_jax.scene import Scene

# Rows of a contact's jar and numbers of its line, by friction model.
ROWS = {"none": (3, 2), "coulomb": (3, 5), "full": (6, 5)}
# Fields of a cone that a friction model does not need.
NEEDLESS = {
    "none": ("tangent", "friction", "ratio", "spin", "roll"),
    "coulomb": ("spin", "roll"),
    "full": (),
}


def cone_fields(scene: Scene) -> list[str]:
    """Fields of the cones of a scene's contacts."""
    absent = NEEDLESS[scene.effects.friction]
    if not scene.effects.soft_touch:
        absent += ("growth", "least")
    return [name for name in Cone._fields if name not in absent]


def cone_of(scene: Scene, numbers: Any) -> Cone:
    """The cone of a scene's contacts from its numbers, in the order of `cone_fields`."""
    found: dict[str, Any] = dict.fromkeys(Cone._fields)
    return Cone(**found | {name: numbers[i] for i, name in enumerate(cone_fields(scene))})


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

    places: tuple[str, ...] = ("point", "normal", "gap")
    """Fields that say where contacts are, in the order of `contacts`' argument."""
    of_lines: tuple[str, ...] = ("gap",)
    """Fields that a line search needs."""

    def groups(self) -> dict[str, tuple[int, tuple[int, ...]]]:
        """The set's part of the scratch table."""
        rows, ray = ROWS[self.scene.effects.friction]
        fields = {"point": 3, "normal": 3, "gap": 1, "jar": rows, "step": rows, "ray": ray}
        return {f"{self.name}.{f}": (self.count, (n, self.k)) for f, n in fields.items()}

    def bind(self, table: MemoryLayout, ref: Any, read: Callable[[str], Lanes]) -> "BoundContacts":
        """The set in a kernel's memory; `read` reads constants of the worlds by name."""
        return BoundContacts(self, table, ref, self.cone(read))

    def cone_rows(self) -> dict[str, tuple[int, tuple[int, ...]]]:
        """The set's part of the table of the worlds' constants."""
        return {f"cone.{which_cone(self.name)}": (1, (len(cone_fields(self.scene)),))}

    def cone(self, read: Callable[[str], Lanes], pair: str = "") -> Cone:
        """Contact parameters of the set's pair of bodies or another, lanes of a world each."""
        numbers = read(f"cone.{which_cone(pair or self.name)}")
        return cone_of(self.scene, numbers)

    @staticmethod
    def contacts(place: tuple, cone: Cone) -> Contacts:
        """Contacts of (point, normal, gap), and what else the set keeps of them."""
        point, normal, gap = place
        return Contacts(point, normal, gap[0], cone)

    @staticmethod
    def of_line(gap: tuple, cone: Cone) -> Contacts:
        """What a line search needs of contacts: their gaps and cones."""
        (gap,) = gap
        return Contacts(gap, gap, gap[0], cone)


class BoundContacts:
    """A contact set with its memory; every method works on one item."""

    def __init__(self, of: ContactSet, table: MemoryLayout, ref: Any, cone: Cone):
        """See `ContactSet.bind`."""
        self.set, self.table, self.ref, self.cone = of, table, ref, cone

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

    def if_touching(self, item: Any, compute: Callable, parts: list[tuple]) -> list[Lanes]:
        """compute() where a lane touches, zeros of wide shapes elsewhere."""
        like = jnp.zeros((self.set.size,), self.ref.dtype)
        empty = [zeros(shape, like) for shape in parts]
        none, rebuild = solid(empty, self.set.size)

        def some() -> list[jax.Array]:
            return solid(compute(), self.set.size)[0]

        return rebuild(jax.lax.cond(self.touching(item), some, lambda: none))

    def create(self, item: Any, geometry: Any, motion: Lanes, velocity: Lanes) -> None:
        """Stores contacts (point, normal, gap) and their jar for relative motions (6, ...)."""
        self.write("gap", geometry[2], item)

        def store() -> None:
            for field, value in self.begin(geometry, motion, velocity).items():
                self.write(field, value, item)

        jax.lax.cond(self.touching(item), store, lambda: None)

    def begin(
        self, place: tuple, motion: Lanes, velocity: Lanes, ahead: tuple | None = None
    ) -> dict[str, Lanes]:
        """What is kept of new contacts, by field, for relative motions of their bodies.

        Args:
          place: Where they are, see `ContactSet.places`.
          motion: Relative acceleration.
          velocity: Relative velocity.
          ahead: See `sections.ahead`; None for contacts that act from touch on.
        """
        contacts = self.set.contacts

        def jar(place, cone, motion, velocity, *ahead):
            c = contacts(place, cone)
            c = c._replace(ahead=tuple(part[0] for part in ahead) or None)
            reference = c.reference(c.relative(velocity[:, None]))
            return c.relative(motion[:, None]) - reference

        value = lanewise(jar, place, self.cone, motion, velocity, *(ahead or ()))
        fields = dict(zip(self.set.places, place, strict=True))
        return {**fields, "jar": value, "step": lanewise(jnp.zeros_like, value)}

    def place(self, item: Any) -> tuple[Lanes, ...]:
        """Where the contacts are, see `ContactSet.places`."""
        return tuple(self.read(field, item) for field in self.set.places)

    def push(self, item: Any, alpha: Lanes) -> tuple[Lanes, Lanes]:
        """Adds the last step of the line search to jar.

        Returns:
          Contact inertia (6, 6) and wrench (6,) at the new jar, summed over the item's contacts.
        """
        parts: list[tuple] = [(21,), (6,)]
        triangle, wrench = self.if_touching(item, lambda: self._push(item, alpha), parts)
        return full(triangle), wrench

    def _push(self, item: Any, alpha: Lanes) -> list[Lanes]:
        contacts = self.set.contacts

        def response(place, cone, jar):
            c = contacts(place, cone)
            r = contact.constraint_update(c, jar)
            matrix = contact.contact_inertia(c, r.hessian)
            return sum_axis(matrix, 2), sum_axis(contact.contact_wrench(c, r.force), 1)

        # All is read before anything is stored, see `pairs.OwnSide`.
        jar, step, place = self.read("jar", item), self.read("step", item), self.place(item)
        jar = lanewise(tree_add_scaled, alpha, jar, step)
        self.write("jar", jar, item)
        matrix, wrench = lanewise(response, place, self.cone, jar)
        return [upper(matrix), wrench]

    def wrench(self, item: Any, alpha: Lanes) -> Lanes:
        """Wrench (6,) of the item's contacts where the last step has moved jar, which is kept."""
        return self.if_touching(item, lambda: [self._wrench(item, alpha)], [(6,)])[0]

    def _wrench(self, item: Any, alpha: Lanes) -> Lanes:
        contacts = self.set.contacts

        def response(place, cone, alpha, jar, step):
            c = contacts(place, cone)
            force = contact.constraint_update(c, jar + alpha * step).force
            return sum_axis(contact.contact_wrench(c, force), 1)

        jar, step = self.read("jar", item), self.read("step", item)
        return lanewise(response, self.place(item), self.cone, alpha, jar, step)

    def changes(self, item: Any, alpha: Lanes) -> Lanes:
        """How many of the item's contacts the last step takes to another zone of the cone."""
        return self.if_touching(item, lambda: [self._changes(item, alpha)], [()])[0]

    def _changes(self, item: Any, alpha: Lanes) -> Lanes:
        of_line = self.set.of_line

        def count(gap, cone, ray, alpha):
            c = of_line(gap, cone)
            line = Line(*(ray[i] if i < ray.shape[0] else None for i in range(5)))
            return sum_axis(jnp.where(contact.same_zone(c, line, alpha), 0.0, 1.0), 0)

        gap = tuple(self.read(field, item) for field in self.set.of_lines)
        return lanewise(count, gap, self.cone, self.read("ray", item), alpha)

    def prepare_linesearch(self, item: Any, step: Lanes) -> Lanes:
        """Stores the contacts' cost along a relative motion (6, ...); returns its slope at 0."""
        return self.if_touching(item, lambda: [self._prepare_linesearch(item, step)], [()])[0]

    def _prepare_linesearch(self, item: Any, step: Lanes) -> Lanes:
        contacts = self.set.contacts

        def relative(place, cone, step):
            return contacts(place, cone).relative(step[:, None])

        return self.line(item, lanewise(relative, self.place(item), self.cone, step))

    def line(self, item: Any, change: Lanes) -> Lanes:
        """Stores the contacts' cost along a change of jar; returns its slope at 0."""
        contacts = self.set.contacts

        def ray(place, cone, jar, change):
            c = contacts(place, cone)
            line = contact.line(c, jar, change)
            first, _ = contact.slopes(c, line, 0.0)
            return jnp.stack([v for v in line if v is not None]), sum_axis(first, 0)

        line, slope = lanewise(ray, self.place(item), self.cone, self.read("jar", item), change)
        self.write("step", change, item)
        self.write("ray", line, item)
        return slope

    def slopes(self, item: Any, alpha: Lanes) -> list[Lanes]:
        """First and second derivative of the item's cost by the step length, at alpha."""
        return self.if_touching(item, lambda: self._slopes(item, alpha), [(), ()])

    def _slopes(self, item: Any, alpha: Lanes) -> list[Lanes]:
        of_line = self.set.of_line

        def both(gap, cone, ray, alpha):
            c = of_line(gap, cone)
            line = Line(*(ray[i] if i < ray.shape[0] else None for i in range(5)))
            first, second = contact.slopes(c, line, alpha)
            return [sum_axis(first, 0), sum_axis(second, 0)]

        gap = tuple(self.read(field, item) for field in self.set.of_lines)
        return lanewise(both, gap, self.cone, self.read("ray", item), alpha)


def sphere_on_object(
    scene: Scene,
    thing: WorldObject,
    columns: Lanes,
    centre: Lanes,
    radius: Lanes | float,
) -> tuple[Lanes, Lanes, Lanes]:
    """Contacts of spheres with the objects: the one way to them for all that may touch.

    It reads the kernel's memory where an object is a mesh, so that it is called on lanes and not
    from within `lanewise`.  Points without a size, such as a hull's vertices, have radius 0.

    Args:
      scene: The scene.
      thing: The block's objects, see `objects.read`.
      columns: Columns of their orientation, shape (3, 3).
      centre: Sphere centres from the objects' [m], shape (3, k).
      radius: Sphere radii [m], shape (k,).

    Returns:
      Contact points [m] and unit normals from object to hand, shape (3, k), and gaps [m], negative
      in contact, shape (1, k).
    """
    local = lanewise(shapes.in_object, columns, centre)
    distance, gradient = objects.signed_distance(scene, thing, local)

    def place(*args):
        point, normal, gap = shapes.on_surface(*args)
        return point, normal, gap[None]

    return lanewise(place, columns, centre, radius, distance, gradient)


def sphere_on_table(height, centre, radius):
    """Point, normal and gap of spheres (3, k, ...) against the table."""
    c = shapes.spheres_on_table(None, height, centre, radius)  # type: ignore[arg-type]
    return c.point, c.normal, c.distance[None]
