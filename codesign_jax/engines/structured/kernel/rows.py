"""Every number of a block's memory, declared once: its table, its axes, and which scenes have it.

A table is an array (block, row, lane or world of the block), see `memory.MemoryLayout`.  A class
here names the rows of a table, or of a part of one.  Each attribute is a `Field`: its name, an axis
of items, and the shape of an item.  From the declarations follow layout, packing and unpacking
(`memory`), the tables of a scene (`memory_tables`) and those of cotangents (`cotangents`), which
have a row for each constant.

A field is read by `table.read(Hand.mass, link)`.  The fields of a contact belong to its list, so
there are several of each: `contacts.read(Contact.jar, item)`.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

Group = tuple[int, tuple[int, ...]]
"""Number of items, and shape of an item."""

# Axes of items
ONE = "one"  # a finger or a world
LINK = "link"  # moving links of a finger
BODY = "body"  # the palm, then the moving links
END = "end"  # ends of the segments of a centre line; also a finger's bodies and the palm
SECTION = "section"  # links of a tapered finger, else the finger
RING = "ring"  # rings, or balls, of a finger
PALM_GROUP = "palm_group"  # groups of the palm's rings, one ring for each finger's lanes
SUPPORT = "support"  # support points of a mesh, one for each finger's lanes
PAIRING = "pairing"  # pairings of fingers that hold friction on one another
ITEM = "item"  # of a contact list: links, groups, or slots
SLOT_ROW = "slot_row"  # rows of slots
TOUCH = "touch"  # contacts of a list that are recorded one by one

# Axes of an item
AXES = "axes"  # hinges of a joint
CONTACTS = "contacts"  # contacts of an item
RAY = "ray"  # numbers of a contact's cost along a line, see `laws.contact.LineCost`
LAW = "law"  # numbers of a section by finite elements
FRICTIONS = "frictions"  # coefficients of the object's points on table and fixtures
LANES = "lanes"  # lanes of a team
SPARE = "spare"  # lanes of a team without a component of a spatial vector


class Field(str):
    """The name of the rows of one quantity.

    It is the string by which tables know it, so that the fields of a record and those of a table
    can have the same names.

    Attributes:
      items: Axis of the items.
      shape: Shape of an item: numbers, and axes.
      on: Whether a kernel's layout, a `ContactLayout` or a record has it.
    """

    items: str
    shape: tuple[int | str, ...]
    on: Callable[[Any], bool]


def field(items: str, *shape: int | str, on: Callable[[Any], bool] = lambda _: True) -> Field:
    """Declares a field of a table; its class gives it its name."""
    declared = Field()
    declared.items = items
    declared.shape = shape
    declared.on = on
    return declared


class Rows:
    """Base of the declarations; `prefix` stands before the names of a part of a table."""

    def __init_subclass__(cls, prefix: str = "") -> None:
        super().__init_subclass__()
        for attribute, declared in list(vars(cls).items()):
            if isinstance(declared, Field):
                named = Field(f"{prefix}.{attribute}" if prefix else attribute)
                vars(named).update(vars(declared))
                setattr(cls, attribute, named)

    @classmethod
    def fields(cls) -> list[Field]:
        """The declared fields, in their order."""
        return [value for value in vars(cls).values() if isinstance(value, Field)]

    @classmethod
    def by_attribute(cls) -> dict[str, Field]:
        """The fields by their names without a prefix."""
        return {name: value for name, value in vars(cls).items() if isinstance(value, Field)}

    @classmethod
    def groups(cls, owner: Any, sizes: dict[str, int]) -> dict[str, Group]:
        """Items and shapes by name, of the fields that an owner has.

        Args:
          owner: A kernel's layout, a `ContactLayout`, or a record.
          sizes: Lengths of the axes.
        """

        def length(axis: int | str) -> int:
            return sizes[axis] if isinstance(axis, str) else axis

        return {
            declared: (sizes[declared.items], tuple(map(length, declared.shape)))
            for declared in cls.fields()
            if declared.on(owner)
        }


class Hand(Rows):
    """Constants of fingers and links, on each finger's lanes; see `world_model.WorldModel`."""

    mount = field(ONE, 3, 3)
    base = field(ONE, 3)
    stub_centre = field(ONE, 3)
    centre_weight = field(BODY)  # Weights of the segments in the hand's centre
    gain = field(SECTION)
    offset = field(LINK)
    mass = field(LINK)
    centre = field(LINK, 3)
    inertia = field(LINK, 3)
    stiffness = field(LINK, AXES)
    damping = field(LINK, AXES)
    armature = field(LINK, AXES)
    # Numbers of rings, see `laws.rings.Ring`
    ring = field(RING, 8, on=lambda layout: bool(layout.rings_per_link))
    palm_ring = field(PALM_GROUP, 8, on=lambda layout: layout.palm_touches)
    law = field(SECTION, LAW, on=lambda layout: layout.by_elements)
    # How sections grow, see `scene.section_growth`
    growth = field(SECTION, 4, on=lambda layout: layout.grows)
    section = field(
        SECTION,
        4,
        on=lambda layout: layout.scene.effects.neo_hookean and not layout.by_elements,
    )
    threshold = field(SECTION, 3, on=lambda layout: layout.scene.effects.lateral_threshold)
    volume = field(ONE, on=lambda layout: layout.scene.effects.air_mass)
    support = field(SUPPORT, 3, on=lambda layout: layout.meshes)


class World(Rows):
    """Constants of a world that every scene has, or every scene with meshes.

    Behind them are `verdict.Bounds`, "cone." and a name for each cone, and `laws.step_numbers`.
    """

    palm_mass = field(ONE)
    palm_centre = field(ONE, 3)
    palm_inertia = field(ONE, 3, 3)
    wrist_damping = field(ONE, 6)
    wrist_armature = field(ONE, 6)
    object_mass = field(ONE)
    object_inertia = field(ONE, 3)
    object_size = field(ONE, 3)
    object_id = field(ONE)
    # The grid of the object's mesh, see `laws.meshes.GridLanes`
    grid_first = field(ONE, on=lambda layout: layout.meshes)
    grid_nodes = field(ONE, 3, on=lambda layout: layout.meshes)
    grid_origin = field(ONE, 3, on=lambda layout: layout.meshes)
    grid_cell = field(ONE, on=lambda layout: layout.meshes)
    grid_factor = field(ONE, on=lambda layout: layout.meshes)
    grid_reach = field(ONE, on=lambda layout: layout.meshes)


class WorldOptions(Rows):
    """Constants of a world that some scenes have."""

    friction = field(ONE, FRICTIONS, on=lambda layout: layout.friction_by_point)
    wrist_stiffness = field(ONE, 6, on=lambda layout: layout.scene.effects.wrist)
    palm_disc = field(ONE, 2, on=lambda layout: layout.scene.effects.finger_palm)
    air = field(ONE, 2, on=lambda layout: layout.scene.effects.air_mass)


class FingerState(Rows):
    """State of the fingers' joints, and last the solver's warm start.

    Before the warm start is the friction that contacts hold: "held." and a pair of bodies,
    `friction_memory`.
    """

    finger = field(LINK, AXES)
    finger_vel = field(LINK, AXES)
    acc = field(LINK, AXES)


class WorldState(Rows):
    """State of wrist and object, of the trial, and the solver's warm start."""

    wrist = field(ONE, 6)
    position = field(ONE, 3)
    quat = field(ONE, 4)
    wrist_vel = field(ONE, 6)
    linear_vel = field(ONE, 3)
    angular_vel = field(ONE, 3)
    step = field(ONE, 1)  # Number of the time step
    going = field(ONE, 1)  # One for worlds that are not decided, else zero
    speed = field(ONE, 1)  # Largest velocity
    overlap = field(ONE, 1)  # Largest overlap of two bodies at the start [m]
    acc_wrist = field(ONE, 6)
    acc_object = field(ONE, 6)


class Scratch(Rows):
    """What a step leaves of links and joints for its parts: bodies, forces, factors."""

    axes = field(LINK, AXES, 6)
    body_centre = field(LINK, 3)
    tensor = field(LINK, 6)
    link_acc = field(LINK, 6)
    smooth = field(LINK, 6)
    tau = field(LINK, AXES)
    # Factors of the elimination, see `elimination.Factors`
    w = field(LINK, AXES, 6)
    g = field(LINK, AXES, 6)
    z = field(LINK, AXES)
    # Newton's step of the accelerations
    step_acc = field(LINK, AXES)
    step_link_acc = field(LINK, 6)
    # Behind the step, until it is known whether a world takes it
    new_finger = field(LINK, AXES)
    new_finger_vel = field(LINK, AXES)
    # The armature where it changes with the state
    armature_now = field(
        LINK, AXES, on=lambda layout: layout.scene.effects.lateral_threshold or layout.by_elements
    )
    # Height and width of sections over those without pressure
    grown = field(SECTION, 2, on=lambda layout: layout.grows)
    # Change of the links' accelerations by a chord step, in rollouts that record forces
    chord_link_acc = field(LINK, 6, on=lambda layout: layout.record and layout.team == 1)
    new_held_friction = field(PAIRING, 3, on=lambda layout: "finger_finger" in layout.held)


class Again(Rows):
    """What a second right side of the elimination needs, see `elimination.Kept`."""

    inverse = field(LINK, AXES, AXES)
    z_again = field(LINK, AXES)


class Air(Rows):
    """Chambers with a mass of air, in the letters of `chambers.Chambers`."""

    air_stiffness = field(ONE)  # c
    air_step = field(ONE)  # g'a of the last step
    air_series = field(ONE)  # w
    air_sum = field(ONE)  # s
    air_palm = field(ONE, 6)  # r_1
    air_object = field(ONE, 6)  # r_o1
    air_joint = field(LINK, AXES)  # y_1


class Search(Rows, prefix="pair"):
    """Where the fingers are, for the lanes of the others; see `finger_shapes`."""

    frame = field(BODY, 3, 3)
    joint = field(BODY, 3)
    end = field(END, 3)
    line = field(BODY, 7)
    other = field(BODY, 7)
    fastest = field(ONE)
    other_size = field(ONE, 2)


class Contact(Rows):
    """The contacts of an item of a list; `laws.rings.Place` has the first four."""

    point = field(ITEM, 3, CONTACTS)  # Place from the object's centre [m]
    normal = field(ITEM, 3, CONTACTS)
    gap = field(ITEM, CONTACTS)
    share = field(ITEM, CONTACTS)
    jar = field(ITEM, 3, CONTACTS)
    jar_step = field(ITEM, 3, CONTACTS)  # Change of jar by Newton's step
    ray = field(ITEM, RAY, CONTACTS)  # The cost along that step
    friction = field(ITEM, 1, CONTACTS, on=lambda contacts: contacts.friction_by_contact)
    held_friction = field(ITEM, 3, CONTACTS, on=lambda contacts: contacts.holds)


class Slot(Rows):
    """What a slot has beside its contact."""

    side = field(ITEM, 1, CONTACTS)  # Body of each lane's side: 0 is the palm
    hessian = field(ITEM, 6, CONTACTS)  # Upper triangle of the Hessian by jar
    # What conjugate gradients keep, see `coupling`
    first_response = field(ITEM, 3, CONTACTS)
    residual = field(ITEM, 3, CONTACTS)
    response = field(ITEM, 3, CONTACTS)
    direction = field(ITEM, 3, CONTACTS)
    direction_response = field(ITEM, 3, CONTACTS)
    force = field(ITEM, 3, CONTACTS)
    # Second side of contacts that a finger has with itself or the palm
    other_side = field(ITEM, 1, CONTACTS, on=lambda contacts: contacts.with_itself)
    # The different sides of a slot's lanes, see `Sides.list_bodies`
    side_listed = field(ITEM, 1, CONTACTS, on=lambda contacts: not contacts.slots.gathers)
    side_count = field(ITEM, 1, CONTACTS, on=lambda contacts: not contacts.slots.gathers)
    other_side_listed = field(
        ITEM, 1, CONTACTS, on=lambda contacts: contacts.with_itself and not contacts.slots.gathers
    )
    other_side_count = field(
        ITEM, 1, CONTACTS, on=lambda contacts: contacts.with_itself and not contacts.slots.gathers
    )


class TeamSlot(Rows):
    """What a slot has beside these where the lanes of a team share slots."""

    wrench = field(ITEM, 6, CONTACTS)
    wrench_spare = field(ITEM, SPARE, CONTACTS)


class Remembered(Rows):
    """What the adjoint remembers of a slot's search."""

    owner = field(ITEM, 1, CONTACTS)  # One on the lane of the contact's ring, else zero
    ring = field(ITEM, 1, CONTACTS)  # Number of the ring, or of both balls


class SlotCount(Rows):
    """Slots of a row that lanes have filled."""

    count = field(SLOT_ROW)


class TeamRing(Rows):
    """What a contact with a field has where the lanes of a team share rings."""

    hessian = field(ITEM, 6, CONTACTS)
    force = field(ITEM, 3, CONTACTS)


class Record(NamedTuple):
    """What a rollout records of its contacts beside the sums of each pair of bodies."""

    touch: bool = False  # Place and force of each ring on the object
    energy: bool = False  # Energy of the contacts' springs, see `holding.stored_energy`


class ForceSum(Rows):
    """What is recorded of a list's contacts on each lane; conditions are of `Record`."""

    force = field(ONE, 3)  # On the first body [N], world axes
    pressing = field(ONE)  # Sum of the normal forces [N]
    depth = field(ONE)  # The largest one [m]
    energy = field(ONE, on=lambda record: record.energy)  # [J]


class TouchForce(Rows):
    """What is recorded of each ring's contact with the object."""

    ring_point = field(TOUCH, 3)  # [m], world axes
    ring_normal = field(TOUCH, 3)
    ring_gap = field(TOUCH)
    ring_force = field(TOUCH, 3)  # On the ring [N], world axes


class PairForce(Rows):
    """What is recorded of a pairing of fingers: with the other finger or itself, with the palm."""

    pressing = field(SLOT_ROW, 2)  # Sum of the normal forces [N]
    depth = field(SLOT_ROW, 2)  # The largest one [m]
    energy = field(SLOT_ROW, 2, on=lambda record: record.energy)  # [J]


class Side(Rows, prefix="side"):
    """Bodies of the fingers' contacts with one another, from the palm to the tips."""

    link_acc = field(BODY, 6)
    link_acc_spare = field(BODY, SPARE, on=lambda layout: layout.team > 1)
    vel = field(BODY, 6)
    wrench = field(BODY, 6)
    wrench_spare = field(BODY, SPARE, on=lambda layout: layout.team > 1)


class Chip(Rows):
    """What is in a GPU's shared memory, of the fields of `Scratch` and `Again` and beside them.

    It is what the recursions over the links read.  Rows of `LANES` are columns of the team; spare
    rows take what lanes without a component store.
    """

    axes = field(LINK, AXES, LANES)
    w = field(LINK, AXES, LANES)
    g = field(LINK, AXES, LANES)
    inverse = field(LINK, AXES, AXES)
    matrix = field(LINK, 6, LANES)
    link_acc = field(LINK, 6)
    link_acc_spare = field(LINK, SPARE)
    step_link_acc = field(LINK, 6)
    step_link_acc_spare = field(LINK, SPARE)


class Shared(Rows, prefix="shared"):
    """What the lanes of a team hand to one another, there too."""

    u = field(ONE, AXES, LANES)
    h = field(ONE, AXES, LANES)
    q = field(ONE, 6, LANES)
    f = field(ONE, LANES)


# Of the adjoint


class Chain(Rows, prefix="chain"):
    """What bodies hand on from palm to tip, see `residual.LinkMotion`."""

    origin = field(BODY, 3)
    frame = field(BODY, 3, 3)
    vel = field(BODY, 6)
    bias = field(BODY, 6)
    link_acc = field(BODY, 6)
    along = field(BODY, 6)


class ChainBefore(Rows, prefix="before"):
    """The same as the last step ended, see `residual.Before`."""

    origin = field(LINK, 3)
    frame = field(LINK, 3, 3)
    vel = field(LINK, 6)


class Virtual(Rows):
    """Right side and solution of the adjoint's linear system, and of the held friction."""

    acc_bar = field(LINK, AXES)
    virtual = field(LINK, AXES)
    sums_bar = field(PAIRING, 4, on=lambda layout: "finger_finger" in layout.held)


class HeldBar(Rows):
    """Cotangents of what a list's contacts hold behind the step."""

    held_bar = field(ITEM, 3, CONTACTS, on=lambda contacts: contacts.holds)


class StepBar(Rows, prefix="bar"):
    """Cotangents to which several parts of a step add, beside those of constants."""

    columns = field(ONE, 3, 3)
    object_vel = field(ONE, 6)
    position = field(ONE, 3)
    pressure = field(ONE)
    grown = field(SECTION, 2, on=lambda layout: layout.grows)


class BodyBar(Rows, prefix="bodybar"):
    """Cotangents of the fingers' bodies and of the palm by contacts, see `kinds.BodyMotion`."""

    origin = field(END, 3)
    frame = field(END, 3, 3)
    vel = field(END, 6)
    link_acc = field(END, 6)
    along = field(END, 6)
