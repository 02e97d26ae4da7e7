"""Where the contacts of a pair of bodies are in memory: the items of a pass over them."""

from typing import Any, NamedTuple


class Item(NamedTuple):
    """One contact, or the few of a link or of a group, in a pass over a pair of bodies.

    Where lanes have items of their own, those that a pass is not for read an item where nothing
    touches, the same for all of them, and write to one that nobody reads. So a GPU's memory, which
    is what its threads wait for, is asked for little that no lane uses.
    """

    source: Any  # Item that is read: a scalar, or int32 of shape (lane,) if lanes have their own
    sink: Any  # Item that is written, likewise
    number: Any = None  # Link, group or ring of a contact with a fixed place, likewise
    pairing: Any = None  # `self_contacts.FingerPairing` of a contact of the hand with itself
    cone: Any = None  # The contact's cone, where those of a pair of bodies differ


def at(number: Any) -> Item:
    """The item of a link or a group, the same on all lanes."""
    return Item(number, number, number)
