"""A step's contacts: its contact lists, and what their forces and friction need beside them."""

from typing import NamedTuple

from codesign_jax.engines.structured.kernel.contact_list import ContactList
from codesign_jax.engines.structured.kernel.sides import Sides
from codesign_jax.engines.structured.kernel.step_memory import StepMemory
from codesign_jax.engines.structured.lanewise import Lanes


class StepContacts(NamedTuple):
    """The contacts of a step. It is a value: `counted` gives another one of the same memory."""

    # Lists whose contacts have a fixed place, by pair of bodies
    field_contacts: dict[str, ContactList]
    self_contacts: ContactList | None  # That of the hand with itself; None without
    sides: Sides | None  # The bodies that these are between; None without
    # Columns of the object's orientation, (3, 3, 1, world): its axes, along which contacts on it
    # hold friction
    columns: Lanes

    def counted(self) -> "StepContacts":
        """The contacts for passes through them, when all are found."""
        if self.self_contacts is None or self.sides is None:
            return self
        counted = self.self_contacts.counted()
        self.sides.list_bodies(counted)
        return self._replace(self_contacts=counted)


def begin(step: StepMemory, columns: Lanes) -> StepContacts:
    """The contact lists in a step's memory, before contacts are searched for.

    Args:
      step: The step's memory.
      columns: Columns of the object's orientation, shape (3, 3, 1, world).
    """
    layout = step.layout
    bound = {c.name: c.bind(step.scratch, step.block, step.constant) for c in layout.lists}
    if layout.self_list is None:
        return StepContacts(bound, None, None, columns)
    self_contacts = bound.pop(layout.self_list.name)
    gathers = layout.self_list.slots.gathers
    sides = Sides(step.scratch, step.block, layout.links + 1, gathers=gathers)
    return StepContacts(bound, self_contacts, sides, columns)
