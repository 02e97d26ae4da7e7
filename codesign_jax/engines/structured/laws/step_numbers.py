"""Numbers of the scene that forces of a step read: a line each is all that the kernel needs.

`palm_and_object` and `link_forces` of `kernel/step.py` find them among their constants by these
names, and the reverse pass has their derivatives.  A number may bring its force on bodies along.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax

from codesign_jax.engines.structured.lanes import cross, spatial
from codesign_jax.scene import Scene


class StepNumber(NamedTuple):
    """A number of a world, or a vector of a few."""

    value: Callable[[Scene], Any]  # From a world's numbers to this one, of the shape below
    on: Callable[[Any], bool]  # Whether a scene with these effects has it
    shape: tuple[int, ...] = ()
    # Force at a body's centre of mass, (3, ...), of the number and the body's mass; None of numbers
    # that `Body.smooth_force` takes. A hand of three fingers has a fourth without mass in its
    # lanes (model/held.py): the force must be zero where the mass is.
    force: Callable[[jax.Array, jax.Array], jax.Array] | None = None
    bodies: tuple[str, ...] = ()  # On which it acts: "palm", "object", "link"


STEP_NUMBERS = {
    # Magnitude of gravity, along -z [m/s^2]
    "gravity": StepNumber(lambda scene: scene.gravity, lambda effects: effects.gravity),
}


def step_numbers(scene: Scene) -> dict[str, StepNumber]:
    """Those that a scene has, by name."""
    return {name: number for name, number in STEP_NUMBERS.items() if number.on(scene.effects)}


def pushed(body: str, smooth: jax.Array, mass: Any, centre: Any, constants: dict) -> jax.Array:
    """Smooth forces on a body, (6, ...), with those that numbers among its constants bring along.

    Args:
      body: Which, as in `StepNumber.bodies`.
      mass: Its mass [kg].
      centre: Its centre of mass [m], shape (3, ...).
    """
    for name, number in STEP_NUMBERS.items():
        if number.force is not None and body in number.bodies and name in constants:
            force = number.force(constants[name], mass)
            smooth = smooth + spatial(cross(centre, force), force)
    return smooth
