"""Scenes as data: hand, objects, effects, phases, and the numbers that may change.

`load` reads a scene file with the hand and the objects that it names, and checks all of them.
`parameters` has the design space, `constants` the numbers that may be traced, `effects` what each
effect means, `schema` the checks of files, `meshes` objects of any shape.

>>> from codesign_jax import scene
>>> grasping = scene.load("paper", overrides={"discretization.links": 5})
>>> grasping.num_fingers, grasping.num_steps, grasping.discretization.timestep  # s
(4, 900, 0.01)
>>> scene.load("paper", overrides={"gravty": 3.7})
Traceback (most recent call last):
codesign_jax.scene.schema.InputError: gravty is not a known key; did you mean 'gravity'?
"""

from codesign_jax.scene.description import Scene, by_structure
from codesign_jax.scene.loading import (
    accuracy_name,
    check_together,
    load,
    load_accuracy,
    with_accuracy,
)
from codesign_jax.scene.schema import InputError, Problem
from codesign_jax.scene.tables import (
    Accuracy,
    Arm,
    Contact,
    Cost,
    Discretization,
    Effects,
    Limits,
    Newton,
    Phases,
    Pneumatics,
    Solver,
)

__all__ = [
    "Accuracy",
    "Arm",
    "Contact",
    "Cost",
    "Discretization",
    "Effects",
    "Limits",
    "Newton",
    "Phases",
    "Pneumatics",
    "Scene",
    "InputError",
    "Problem",
    "Solver",
    "by_structure",
    "check_together",
    "load",
    "accuracy_name",
    "load_accuracy",
    "with_accuracy",
]
