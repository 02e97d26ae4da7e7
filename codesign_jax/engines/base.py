"""The interface behind which every engine stands."""

from typing import Any, Protocol

import jax

from codesign_jax.model import ModelFields
from codesign_jax.scene import Scene
from codesign_jax.scene.schema import InputError
from codesign_jax.types import Trace


class Engine(Protocol):
    """Steps batches of worlds; engines solve the same discrete equations and differ in how.

    An engine serves every scene of the structure of its own. Engines that are equal, as two of one
    kind with the same settings, for scenes of one structure, share compiled programs.

    Attributes:
      name: Name on the command line and in results.
    """

    name: str

    def rollout(self, fields: ModelFields, ctrl: jax.Array, *, trajectory: bool = False) -> Trace:
        """Simulates one grasp in each world; traceable, with the batch as leading axis.

        Args:
          fields: Model fields and start states, every array with a leading world axis.
          ctrl: Controls, shape (world, time, nu).
          trajectory: Whether to return qpos of every step, and to simulate worlds that lost their
            object to the end of the grasp.

        Returns:
          The trace of every world, every array with a leading world axis; `Trace` says what it
          shows of worlds that are decided before the end.
        """
        ...


def tells_forces(engine: Engine) -> bool:
    """Whether the engine tells contact forces; one that asks a policy, whether its own does."""
    return hasattr(getattr(engine, "engine", engine), "recording")


def recording(engine: Engine, *, touch: bool = False) -> Engine:
    """The engine as one whose traces have the contact forces; `touch`: ring by ring as well."""
    method: Any = getattr(engine, "recording", None)
    if method is None or not tells_forces(engine):
        raise InputError([f"engine {engine.name} records no forces; engine structured does"])
    return method(touch=touch)


class Equal:
    """Equality and hash of engines by their kind and what `_key` returns."""

    def _key(self) -> tuple:
        raise NotImplementedError

    def __eq__(self, other: object) -> bool:
        return type(self) is type(other) and self._key() == other._key()  # type: ignore[attr-defined]

    def __hash__(self) -> int:
        return hash((type(self), self._key()))


def refuse_meshes(scene: Scene, engine: str) -> None:
    """Refuses objects that an engine with MuJoCo's own collision detection cannot simulate.

    MuJoCo takes a mesh for its convex hull, and its vertices, unlike a primitive's sizes, cannot
    differ between the worlds of a batch, as the size noise asks for.
    """
    problems = [
        f"not supported by engine {engine}: object {shape.name!r} is a mesh; use engine structured"
        for shape in scene.objects.object
        if shape.mesh
    ]
    if problems:
        raise InputError(problems)
