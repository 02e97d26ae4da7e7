"""The scene: hand, objects, control, effects, phases, contact, time step; hashable.

A scene has two parts.  Its `structure` (effects, counts, kinds of shapes, time step and number of
steps) is what programs are compiled for; its leaves are all other numbers of the scene, hand and
object files, and may be traced: changing them compiles nothing.
"""

import dataclasses
import functools
from collections.abc import Callable
from typing import Any, TypeVar

import jax
import numpy as np

from codesign_jax.scene import draws, hand, key_frames, objects, schema
from codesign_jax.scene.schema import quantity
from codesign_jax.scene.tables import (
    Arm,
    Contact,
    Cost,
    Discretization,
    Effects,
    Fixture,
    Limits,
    Newton,
    Phases,
    Pneumatics,
    Solver,
)

T = TypeVar("T")
PHASES = ("approach", "inflate", "lift", "disturb", "ungrasp")


@dataclasses.dataclass(frozen=True)
class SceneFile:
    """A scene file, which names its hand and objects.

    Attributes:
      name: Name of the scene, as in results.
      description: What the scene is, in a line.
      hand: Name of a built-in hand, or the path of a hand file, relative to the scene file.
      objects: Name of a built-in object set, or the path of an object file, relative to the scene
        file.
      control: Name of a built-in control, or the path of a control file, relative to the scene
        file; docs/control.md.
      fixture: Static bodies beside the table.
      drawn: Constants that are drawn for every trial.
      gravity: Acceleration of gravity, only with `effects.gravity`.
    """

    name: str
    description: str
    hand: str
    objects: str
    effects: Effects
    phases: Phases
    arm: Arm
    cost: Cost
    contact: Contact
    discretization: Discretization
    solver: Solver
    limits: Limits
    pneumatics: Pneumatics = Pneumatics()
    newton: Newton = Newton()
    control: str = "paper"
    fixture: tuple[Fixture, ...] = ()
    drawn: draws.Constants = draws.Constants()
    gravity: float = quantity("m/s^2", 0, 100, kw_only=True)


@schema.table
@dataclasses.dataclass(frozen=True)
class Scene(SceneFile):
    """A simulation's description; built by `load`, changed by `dataclasses.replace`.

    A pytree whose leaves are the numbers that are not structure, named by the keys of the files,
    such as `hand.material.shear_modulus`, `contact.friction_ratio` and `objects.object[0].mass`;
    arrays of tables are tuples.  Units and ranges are those of the files.  Leaves are numbers, or
    arrays with a leading axis (world or trial) where a function says so; they may be traced:
    changing them compiles nothing.  `codesign_jax.scene.constants` checks them.

    Static are names, effects, counts, kinds of shapes, meshes, the time step, the end of the last
    phase, the solver's limits, and the parameter table with its bounds, presets and pressure limit,
    which describe a search and not a simulation.

    Attributes:
      num_steps: Time steps of one grasp, up to the end of the last phase that is on.
    """

    hand: hand.Hand
    objects: objects.ObjectSet
    control: key_frames.Control  # type: ignore[assignment]
    num_steps: int = dataclasses.field(
        default=0, kw_only=True, repr=False, metadata={"in_file": False}
    )

    def __post_init__(self) -> None:
        """Counts the time steps, but where the phases' ends are arrays: they are structure."""
        end = getattr(self.phases, self._phases[-1], None)
        if isinstance(end, float):
            count = round((end + self.phases.settle) / self.discretization.timestep)
            object.__setattr__(self, "num_steps", count)

    def checked(self, other: Any = None) -> "Scene":
        """The other scene if there is one, else this one, with numbers in their ranges.

        Raises:
          InputError: If the other one is no scene, and see `scene.constants.check`.
        """
        from codesign_jax.scene.constants import check

        scene = self if other is None else other
        if not isinstance(scene, Scene):
            kind = type(scene).__name__
            raise schema.InputError.of(
                "type", f"scene is a {kind}, not a Scene; scene.load reads one"
            )
        check(scene)
        return scene

    def __str__(self) -> str:
        """In a few lines; `repr` has every number."""
        shapes = ", ".join(shape.name for shape in self.objects.object)
        ends = ", ".join(f"{name} {_number(end)}" for name, end in self.phase_ends.items())
        step = _number(1e3 * self.discretization.timestep)
        return "\n".join(
            [
                f"scene {self.name}: {self.description}",
                f"hand {self.hand.name}: {self.num_fingers} fingers",
                f"objects {self.objects.name}: {shapes}",
                f"control {self.control.name}: {self.control.description}",
                f"{self.num_steps} steps of {step} ms; phases end at [s]: {ends}",
            ]
        )

    @functools.cached_property
    def bare(self) -> "Scene":
        """The scene without what no program depends on: names, and what describes a search."""
        return dataclasses.replace(
            self,
            name="",
            description="",
            limits=self.limits.of_worlds,
            hand=hand.structure(self.hand),
            objects=objects.structure(self.objects),
            control=key_frames.structure(self.control),
            drawn=draws.structure(self.drawn),
            fixture=tuple(dataclasses.replace(f, name="") for f in self.fixture),
        )

    @functools.cached_property
    def structure(self) -> "Scene":
        """The bare scene with fixed numbers.

        Scenes of equal structure share model templates, traces and compiled programs.
        """
        return _structure(jax.tree.structure(self.bare))

    @property
    def gravity_on(self) -> float:
        """Gravity as simulated: 0 if the effect is off [m/s^2]."""
        return self.gravity if self.effects.gravity else 0.0

    @property
    def num_fingers(self) -> int:
        """Number of fingers of the hand."""
        return len(self.hand.finger)

    @property
    def end_time(self) -> float:
        """End of the last phase that is on [s]."""
        return [*self.phase_ends.values()][-1]

    @property
    def phase_ends(self) -> dict[str, float]:
        """End times of the phases by name, in order, without those that are off [s].

        Unlike those of the table `phases` they count from the start of the settling.
        """
        ends = {name: getattr(self.phases, name) for name in self._phases}
        settle = self.phases.settle
        return {name: end + settle for name, end in ends.items()} if settle else ends

    @property
    def _phases(self) -> list[str]:
        on = {"disturb": self.effects.disturb, "ungrasp": self.effects.ungrasp}
        return [name for name in PHASES if on.get(name, True)]

    @property
    def window(self) -> tuple[float, float]:
        """Times t_0 and t_end between which losing the object costs: lift to end of disturb [s]."""
        return self.phase_ends["inflate"], self.phase_ends[self._judged]

    @property
    def _judged(self) -> str:
        """The last phase in which losing the object costs."""
        return "disturb" if self.effects.disturb else "lift"

    def steps_to(self, time: Any) -> Any:
        """Whole time steps up to a time [s]; NumPy and JAX arrays, traced or not, as numbers."""
        return (time / self.discretization.timestep + 0.5) // 1

    def last_step(self, phase: str | None = None) -> Any:
        """Index of the last time step of a phase: entry of a trace, row of controls.

        Args:
          phase: A name of `phase_ends`; None for the last phase in which losing the object costs,
            "disturb", or "lift" in a scene without it.

        Returns:
          An int, or a traced array of shape () where the scene's numbers are traced.

        Raises:
          InputError: If the grasp has no such phase.

        >>> from codesign_jax import scene
        >>> grasping = scene.load("paper")
        >>> grasping.last_step("disturb"), grasping.last_step("ungrasp"), grasping.num_steps
        (799, 899, 900)
        """
        ends = self.phase_ends
        if phase is not None and phase not in ends:
            raise schema.InputError([self._no_phase(phase)])
        last = self.steps_to(ends[phase or self._judged]) - 1
        return int(last) if isinstance(last, (int, float)) else last.astype(int)

    def _no_phase(self, phase: Any) -> str:
        if phase in self.effects.__dict__ and phase in self.phases.__dict__:
            return (
                f"scene {self.name!r} has no phase {phase!r}, as effects.{phase} = false; its "
                f"grasp ends with {[*self.phase_ends][-1]!r}"
            )
        return f"phase {phase!r} unknown; {schema.nearest(str(phase), self.phase_ends)}"


def _number(value: Any) -> str:
    """A number of a scene, which may be an array or traced."""
    return f"{value:g}" if isinstance(value, int | float) else f"<{np.shape(value)}>"


@functools.cache
def _structure(tree: Any) -> Scene:
    bare = jax.tree.unflatten(tree, [0] * tree.num_leaves)
    step = bare.discretization.timestep
    last = PHASES.index(bare._phases[-1])
    time = bare.num_steps * step - bare.phases.settle
    typical = schema.typical(bare)
    ends = {name: time * (i + 1) / (last + 1) for i, name in enumerate(PHASES)}
    phases = schema.replaced(typical.phases, **ends, deflate_time=step)
    return schema.replaced(typical, phases=phases)


def by_structure(function: Callable[[Scene], T]) -> Callable[[Scene], T]:
    """Evaluates a function of a scene once for each structure, with the fixed numbers."""
    cached = functools.cache(function)

    @functools.wraps(function)
    def evaluate(scene: Scene) -> T:
        return cached(scene.structure)

    evaluate.cache_clear = cached.cache_clear  # type: ignore[attr-defined]
    return evaluate
