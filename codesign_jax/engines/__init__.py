"""Engines by name; each advances batches of worlds behind the interface in `base`.

>>> from codesign_jax import engines
>>> engines.NAMES
('structured', 'mujoco', 'mjx')
"""

import functools

from codesign_jax.engines.base import Engine
from codesign_jax.scene import Newton, Scene, Solver, library, load_accuracy, schema
from codesign_jax.scene.effects import ENGINES

NAMES = ENGINES
DEFAULT = "structured"


def make_engine(name: str, scene: Scene) -> Engine:
    """Builds an engine for a scene.

    Args:
      name: One of `NAMES`.

    Raises:
      InputError: If there is no such engine, if `scene` is not a `Scene`, or if the engine does not
        do what the scene asks for: effects, meshes, or a [solver] table that the engine does not
        read, see `solver_problems`.

    >>> from codesign_jax import make_engine, scene
    >>> grasping = scene.load("paper")
    >>> make_engine("structured", grasping).name
    'structured'
    >>> make_engine("mojoco", grasping)
    Traceback (most recent call last):
    codesign_jax.scene.schema.InputError: engine 'mojoco' unknown; did you mean 'mujoco'?
    """
    if not isinstance(scene, Scene):
        words = f"scene is {scene!r}, not a Scene; scene.load({scene!r}) reads it"
        raise schema.InputError.of("type", words)
    if name == "mjx":
        from codesign_jax.engines.mjx import MjxEngine

        return MjxEngine(scene)
    if name == "mujoco":
        from codesign_jax.engines.mujoco import MujocoEngine

        return MujocoEngine(scene)
    if name == "structured":
        from codesign_jax.engines.structured import StructuredEngine

        if problems := solver_problems(scene):
            raise schema.InputError(problems)
        return StructuredEngine(scene)
    raise schema.InputError.of("unknown", f"engine {name!r} unknown; {schema.nearest(name, NAMES)}")


_INSTEAD = {"iterations": "iterations", "ls_iterations": "evaluations", "tolerance": "decrement"}
"""Key of the [newton] table for each key of [solver]; tolerances are measured otherwise."""


def solver_problems(scene: Scene) -> list[str]:
    """Why engine structured must not simulate a scene: its own limits of [solver] have no effect.

    MuJoCo's [solver] table stands beside structured's [newton]. Values that no accuracy
    has were written by somebody who wants them to act; with a [newton] table of its own as well the
    scene is one for all engines.
    """
    if scene.newton != Newton() or scene.solver in _usual_solvers():
        return []
    return [
        solver_problem(f"solver.{key} = {getattr(scene.solver, key):g}", key)
        for key in _INSTEAD
        if getattr(scene.solver, key) != getattr(Solver(), key)
    ]


def solver_problem(given: str, key: str = "") -> str:
    """Says that a value of the [solver] table has no effect in engine structured."""
    instead = f"newton.{_INSTEAD[key]}" if key in _INSTEAD else "the table [newton]"
    sentence = (
        f"{given} has no effect in engine structured, whose solver is not MuJoCo's: set {instead}, "
        "which limits it, or use engine mujoco or mjx"
    )
    return schema.Problem("unsupported", sentence)


@functools.cache
def _usual_solvers() -> tuple[Solver, ...]:
    presets = (load_accuracy(name).solver for name in library.available("accuracy"))
    return Solver(), Solver(ls_iterations=20), *(Solver(**values) for values in presets)


__all__ = ["DEFAULT", "NAMES", "Engine", "make_engine", "solver_problem", "solver_problems"]
