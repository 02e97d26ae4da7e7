"""Friction that contacts hold from step to step, `effects.friction_memory`: what a state has of it.

Contacts of distance fields hold three numbers each; those of fingers with one another share three
for each pairing of the fingers.  All of them are numbers of the lanes of a world's fingers, of
which there is a power of two.
"""

from codesign_jax.model.layout import layout, palm_touches
from codesign_jax.scene import Scene

EDGES = {"box": 4, "cylinder": 1, "plane": 0}
"""Points of a fixture that may touch an object's faces, by its type."""
ROUND = ("sphere",)
"""Objects that touch a fixture in the one point that their own side finds."""
PALM_RINGS = 4
"""Rings of which the palm's disc is made."""


def lanes(scene: Scene) -> int:
    """Lanes of a world: its fingers, and as many more as make a power of two."""
    return 1 << (scene.num_fingers - 1).bit_length()


def rings_of_link(scene: Scene) -> int:
    """Rings of a link of a finger, or its contact spheres."""
    e = scene.effects
    spheres = layout(scene).spheres
    if e.surface == "spheres":
        return spheres.shape[-1] if spheres.size else 0
    between = e.finger_finger or e.finger_palm or e.finger_itself
    return scene.discretization.hull_rings * int(between or e.finger_object or e.finger_table)


def surfaces(scene: Scene) -> int:
    """Number of static surfaces: the table, if the scene has one, and the fixtures."""
    return int(scene.effects.table) + len(scene.fixture)


def object_points(scene: Scene) -> list[int]:
    """Largest number of contact points between the object and each static surface."""
    flat = any(shape.type not in ROUND for shape in scene.objects.object)
    each = [4 + EDGES[fixture.type] * flat for fixture in scene.fixture]
    return [4] * scene.effects.table + each


def palm_groups(scene: Scene) -> int:
    """Rings or spheres of the palm for each lane."""
    spheres = layout(scene).palm.size
    return -(-(PALM_RINGS if scene.effects.surface == "hull" else spheres) // lanes(scene))


def keeps(scene: Scene) -> bool:
    """Whether contacts hold friction from step to step.

    Spheres hold none: their contact is MuJoCo's, which has no state.
    """
    e = scene.effects
    return e.friction_memory and e.surface == "hull" and e.friction != "none"


def held(scene: Scene) -> dict[str, int]:
    """How many times three numbers a lane holds, by the pair of bodies that touch.

    Of `finger_finger` they are those of each pairing of the fingers, number 0 each finger with
    itself; see `FingerPairing`.  Of the others they are those of each contact.
    """
    if not keeps(scene):
        return {}
    e = scene.effects
    count = lanes(scene)
    many = surfaces(scene)
    rings = scene.discretization.links * rings_of_link(scene)
    palm = palm_groups(scene) if palm_touches(scene) else 0
    counts = {
        "finger_finger": count * ((e.finger_finger and scene.num_fingers > 1) or e.finger_itself),
        "finger_object": rings * e.finger_object,
        "finger_table": many * rings * e.finger_table,
        "palm_object": palm * e.palm_object,
        "palm_table": many * palm * e.palm_table,
        "object_table": -(-sum(object_points(scene)) // count) * e.object_table,
    }
    return {name: items for name, items in counts.items() if items}


def rows(scene: Scene) -> dict[str, slice]:
    """Rows of `RolloutState.held`, three for each of `held`, by the pair of bodies."""
    slices = {}
    first = 0
    for name, items in held(scene).items():
        slices[name] = slice(first, first + 3 * items)
        first += 3 * items
    return slices
