"""Numbers of the scene that forces of a step read: a line each is all that the kernel needs.

`palm_and_object` and `link_forces` of `kernel/step.py` find them among their constants by these
names, and the reverse pass has their derivatives.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

from codesign_jax.scene import Scene


class StepNumber(NamedTuple):
    """A number of a world, or a vector of a few."""

    value: Callable[[Scene], Any]  # From a scene's numbers of shape (1, world): (*shape, 1, world)
    on: Callable[[Any], bool]  # Whether a scene with these effects has it
    shape: tuple[int, ...] = ()


STEP_NUMBERS = {
    # Magnitude of gravity, along -z [m/s^2]
    "gravity": StepNumber(lambda scene: scene.gravity, lambda effects: effects.gravity),
}


def step_numbers(scene: Scene) -> dict[str, StepNumber]:
    """Those that a scene has, by name."""
    return {name: number for name, number in STEP_NUMBERS.items() if number.on(scene.effects)}
