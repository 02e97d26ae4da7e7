"""The interface behind which every engine stands."""

from collections.abc import Callable
from typing import Any, NamedTuple, Protocol

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


class Staged(NamedTuple):
    """A rollout in three parts, so that many batches share the middle one, the costly one.

    Outputs of a batch have the same bits whatever batches it was joined with, as `pack` and
    `unpack` are programs of a batch's own size, and blocks do not depend on each other.

    Attributes:
      pack: (fields, controls) to (blocks, common): arrays with a leading axis (block,), and those
        that every block reads, the same for all batches of a scene.
      launch: (blocks, common) to arrays with a leading axis (block,).
      unpack: (those arrays, number of worlds) to the trace.
      joins: Whether `launch` takes the blocks of several batches, one behind the other, and any
        part of them; otherwise it wants those of one batch.
    """

    pack: Callable[[ModelFields, jax.Array], tuple[tuple, tuple]]
    launch: Callable[[tuple, tuple], tuple]
    unpack: Callable[[tuple, int], Trace]
    joins: bool


def block_lanes(engine: Engine, worlds: int) -> int | None:
    """Lanes of the blocks in which an engine packs worlds; None if it has no blocks."""
    own: Any = getattr(engine, "block_lanes", None)
    return None if own is None else own(worlds)


def staged(engine: Engine, lanes: int | None = None, *, trajectory: bool = False) -> Staged:
    """The engine's own parts, or the whole rollout as the middle one."""
    own: Any = getattr(engine, "staged", None)
    if own is not None:
        return own(lanes, trajectory=trajectory)
    return Staged(
        pack=lambda fields, ctrl: ((fields, ctrl), ()),
        launch=lambda blocks, common: engine.rollout(*blocks, trajectory=trajectory),
        unpack=lambda trace, worlds: trace,
        joins=False,
    )


def tells_forces(engine: Engine) -> bool:
    """Whether the engine tells contact forces; one that asks a policy, whether its own does."""
    return hasattr(getattr(engine, "engine", engine), "recording")


def recording(engine: Engine) -> Engine:
    """The engine as one whose traces have the contact forces."""
    own: Any = getattr(engine, "recording", None)
    if own is None or not tells_forces(engine):
        raise InputError([f"engine {engine.name} records no forces; engine structured does"])
    return own()


class Equal:
    """Equality and hash of engines by their kind and what `_key` returns."""

    def _key(self) -> tuple:
        raise NotImplementedError

    def __eq__(self, other: object) -> bool:
        return type(self) is type(other) and self._key() == other._key()  # type: ignore[attr-defined]

    def __hash__(self) -> int:
        return hash((type(self), self._key()))


def refuse_meshes(scene: Scene, engine: str) -> None:
    """Says which objects an engine that collides by MuJoCo's own geoms cannot simulate.

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
