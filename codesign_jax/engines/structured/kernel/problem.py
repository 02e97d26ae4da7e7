"""A step's problem for the solver: its memory and contacts, and palm, wrist and object."""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from codesign_jax.engines.structured.kernel.chambers import Chambers
from codesign_jax.engines.structured.kernel.contact_list import ContactList
from codesign_jax.engines.structured.kernel.memory import tree_add_scaled, zeros
from codesign_jax.engines.structured.kernel.rows import Air, Hand, Scratch
from codesign_jax.engines.structured.kernel.step_contacts import StepContacts
from codesign_jax.engines.structured.kernel.step_memory import StepMemory
from codesign_jax.engines.structured.lanewise import Lanes, lanewise
from codesign_jax.engines.structured.laws.inertia import Body, Centred


class Palm(NamedTuple):
    """What the solver needs of palm, wrist and object; lanes of a world."""

    palm: Body
    object: Centred
    smooth_palm: Any
    smooth_object: Any
    smooth_wrist: Any
    armature: Any
    axes: Any

    def unbalanced(self, now: "Iterate") -> tuple[Any, Any, Any]:
        """Forces that an iterate leaves on the palm, the object and the wrist's joints."""
        push = self.smooth_palm - self.palm.times(now.palm_acc)
        pull = self.smooth_object - self.object.times(now.object_acc)
        return push, pull, self.smooth_wrist - self.armature * now.wrist


class Iterate(NamedTuple):
    """Accelerations of the wrist, of palm and of object; lanes of a world."""

    wrist: Any
    palm_acc: Any
    object_acc: Any


class Problem:
    """The solver's problem of one step.

    Attributes:
      memory: The step's memory, in which the forward pass has left its results.
      palm: Palm, wrist and object.
      links: Moving links of a finger; `block`: the lanes; `like`: zeros of their shape and type.
      rigid: Whether the wrist's accelerations are known and no unknowns.
      columns: Columns of the object's orientation, shape (3, 3, 1, world).
      self_contacts: Contacts of the hand with itself; None without.
      sides: Their sides; None without.
      per_link: Contacts of the fingers with what is no finger, whose items are links.
      dealt: Contacts of the palm, and of the object with the table, whose items are dealt to the
        fingers' lanes.
      chambers: Chambers with a mass of air; None without the effect.
    """

    def __init__(self, memory: StepMemory, contacts: StepContacts, palm: Palm):
        self.memory = memory
        self.palm = palm
        self.links = memory.layout.links
        self.block = memory.block
        self.rigid = not memory.layout.scene.effects.wrist
        self.columns = contacts.columns
        self.self_contacts = contacts.self_contacts
        self.sides = contacts.sides
        fixed = contacts.field_contacts.values()
        self.per_link = [c for c in fixed if c.layout.per_link]
        self.dealt = [c for c in fixed if not c.layout.per_link]
        self.like = jnp.zeros((self.block.size,), palm.armature.dtype)
        self.chambers = Chambers(memory) if Air.air_step in memory.scratch else None

    def between(self, busy: jax.Array) -> ContactList | None:
        """Contacts of the hand with itself in worlds of the lanes `busy`; None without any."""
        return None if self.self_contacts is None else self.self_contacts.masked(busy)

    def read(self, *names: str, item: Any = 0) -> list[Lanes]:
        """Reads names; of the joints' armature that of this step, if it changes."""
        if Scratch.armature_now in self.memory.scratch:
            names = tuple(Scratch.armature_now if n == Hand.armature else n for n in names)
        return [self.memory.read(name, item) for name in names]

    def write(self, name: str, value: Lanes, item: Any) -> None:
        """Stores an item of a row of fingers, lanes of the item's shape."""
        self.memory.write(name, value, item)

    def move(self, name: str, item: Any, alpha: Lanes) -> Lanes:
        """Adds the last step to a link's "acc" or "link_acc", and returns the sum."""
        value = lanewise(tree_add_scaled, alpha, *self.read(name, f"step_{name}", item=item))
        self.write(name, value, item)
        return value

    def body_of(self, item: Any) -> list[Lanes]:
        """Mass (...), centre (3, ...) and inertia (6, ...) of a link, for `make_body`."""
        return self.read(Hand.mass, Scratch.body_centre, Scratch.tensor, item=item)

    def add_palm_wrench(self, r: Lanes) -> Lanes:
        """Adds the self-contacts that act on the palm."""
        assert self.sides is not None
        return lanewise(jnp.add, r, self.sides.wrench_on(0))

    def widened(self, acc: Lanes) -> Lanes:
        """Lanes of a world as those of its fingers."""
        return lanewise(jnp.add, acc, zeros(acc.shape[:-2], self.like))


def relative(pair: str, link: Any, palm: Lanes, obj: Lanes) -> Lanes:
    """Motion (6, ...) of the first body of a pair against the second; table and fixtures rest.

    Args:
      pair: The pair of bodies.
      link: Motion of the item's link; of pairs without a finger it is not read.
      palm: Motion of the palm.
      obj: Motion of the object.
    """
    motions = {"finger": link, "palm": palm, "object": obj}
    first, second = pair.split("_")
    if second not in motions:
        return motions[first]
    return lanewise(jnp.subtract, motions[first], motions[second])


def make_body(mass: jax.Array, centre: jax.Array, tensor: jax.Array) -> Body:
    """Body of a mass, a centre and the upper triangle xx, xy, xz, yy, yz, zz of a tensor."""
    xx, xy, xz, yy, yz, zz = (tensor[i] for i in range(6))
    rows = [jnp.stack(r) for r in ([xx, xy, xz], [xy, yy, yz], [xz, yz, zz])]
    return Body(mass, centre, jnp.stack(rows))


def triangle(tensor: jax.Array) -> jax.Array:
    """Upper triangle of a symmetric tensor, (3, 3, ...) to (6, ...)."""
    return jnp.stack([tensor[i, j] for i in range(3) for j in range(i, 3)])
