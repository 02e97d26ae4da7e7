"""MuJoCo's numbers of the contact pairs, for single models and for fields.

A pair has a kind: what touches the object with index i has kind i, what touches a fixture that has
a friction of its own one of the next, see `around`, and the others have the kinds below, which
count from the last of `frictions`.
"""

from typing import Any

from codesign_jax.model.layout import IMPEDANCE, dissipation, palm_impedance
from codesign_jax.scene import Scene

OBJECT_TABLE = -4
FINGER_TABLE = -3
FINGERS = -2
PALM = -1
SOLIMP = (0.001, 0.5, 2.0)
"""Width, midpoint and power of MuJoCo's impedance, which is constant here: they do not matter."""


def frictions(scene: Scene) -> list[Any]:
    """Coulomb coefficient of each kind of pair."""
    c = scene.contact
    others = [c.finger_table_friction, c.finger_finger_friction, c.finger_palm_friction]
    of_fixtures = [f.friction for f in scene.fixture if f.friction is not None]
    on_object = [s.friction for s in scene.objects.object]
    return [*on_object, *of_fixtures, scene.objects.table.friction, *others]


def around(scene: Scene, index: int, table: int) -> int:
    """Kind of a pair with the table, number 0, or a fixture, from 1 on."""
    with_friction = [i for i, f in enumerate(scene.fixture, 1) if f.friction is not None]
    return (
        len(scene.objects.object) + with_friction.index(index) if index in with_friction else table
    )


def impedances(scene: Scene) -> list[Any]:
    """Impedance of each kind of pair."""
    return [IMPEDANCE] * (len(frictions(scene)) - 1) + [palm_impedance(scene)]


def margin(touching: Any) -> Any:
    """MuJoCo's margin of a pair [m]; one that may not touch would have to be a metre deep."""
    return touching - 1.0


def numbers(scene: Scene, friction: Any, impedance: Any) -> tuple[list, list, list]:
    """MuJoCo's friction (5, without torsion and rolling), solref (2) and solimp (5) of a pair."""
    h = scene.discretization.timestep
    spring = 1.0 / (h * (h + dissipation(scene)))
    damper = 1.0 / h
    reference = [-impedance * spring, -impedance * damper]
    return [friction] * 2 + [0.0] * 3, reference, [impedance] * 2 + [*SOLIMP]
