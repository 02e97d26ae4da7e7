"""The interface behind which every engine stands."""

from collections.abc import Callable
from typing import Any, NamedTuple, NoReturn, Protocol

import jax

from codesign_jax.model import ModelFields
from codesign_jax.scene import Scene
from codesign_jax.scene.schema import InputError, Problem
from codesign_jax.types import Forces, Trace


class Pose(NamedTuple):
    """Pose of a body in the world frame.

    Attributes:
      position: Origin of its frame [m], shape (..., 3).
      rotation: Its axes as the columns of a matrix, shape (..., 3, 3).
    """

    position: jax.Array
    rotation: jax.Array


class Bodies(NamedTuple):
    """Where the bodies of worlds are, every array with a leading axis (world,).

    Attributes:
      joint: Angles of the fingers' joints [rad], shape (world, finger, link, axis).
      joint_velocity: Their velocities [rad/s], likewise.
      palm: Pose of the palm.
      link: Poses of the fingers' links, whose origins are at their joints, (world, finger, link).
      object: Pose of the object, whose origin is its centre of mass.
      object_velocity: Its linear [m/s] and angular [rad/s] velocity, shape (world, 6).
    """

    joint: jax.Array
    joint_velocity: jax.Array
    palm: Pose
    link: Pose
    object: Pose
    object_velocity: jax.Array


class Engine(Protocol):
    """Steps batches of worlds; engines solve the same discrete equations and differ in how.

    An engine serves every scene of the structure of its own. Engines that are equal, as two of one
    kind with the same settings, for scenes of one structure, share compiled programs.

    Attributes:
      name: Name on the command line and in results.
      scene: The scene.

    An attribute `fills` that is True says that worlds which are decided when they start cost next
    to nothing: batches are then filled up to few sizes, so that one program serves, see `batch`.
    """

    name: str
    scene: Scene

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

    def observe(self, fields: ModelFields) -> Callable[[jax.Array], Bodies]:
        """What policies and environments see of worlds: a function of their states.

        Args:
          fields: Model fields, every array with a leading world axis.

        Returns:
          A function of states, see `model.RolloutState`, shape (world, n): those of `Trace.last`.
        """
        ...

    def contacts(
        self, fields: ModelFields, state: jax.Array, pressure: jax.Array, *, find: bool = True
    ) -> Forces:
        """Contact forces of the time steps that led to states; they have no derivative.

        Args:
          fields: Model fields, every array with a leading world axis.
          state: States, shape (world, n).
          pressure: Pressures of the chambers in these steps [Pa], shape (world, finger).
          find: Whether the forces are found; else zeros stand for them, which take no time.

        Returns:
          The forces, every array with a leading world axis; zero at the beginning of a grasp.

        Raises:
          InputError: If the engine tells no forces, see `tells_forces`.
        """
        ...


def tells_forces(engine: Engine) -> bool:
    """Whether the engine tells contact forces; one that asks a policy, whether its own does."""
    return hasattr(getattr(engine, "engine", engine), "recording")


def recording(engine: Engine, *, touch: bool = False) -> Engine:
    """The engine as one whose traces have the contact forces; `touch`: ring by ring as well."""
    method: Any = getattr(engine, "recording", None)
    if method is None or not tells_forces(engine):
        refuse_forces(engine.name)
    return method(touch=touch)


def refuse_forces(name: str) -> NoReturn:
    """The error of an engine that tells no contact forces."""
    raise InputError.of("unsupported", f"engine {name} records no forces; engine structured does")


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
        Problem(
            "unsupported",
            f"not supported by engine {engine}: object {shape.name!r} is a mesh; "
            "use engine structured",
        )
        for shape in scene.objects.object
        if shape.mesh
    ]
    if problems:
        raise InputError(problems)
