"""The scene: hand, objects, effects, phases, contact and discretization, frozen and hashable.

A scene has two parts.  Its `structure` (effects, counts, kinds of shapes, time step and number of
steps) is what programs are compiled for; its `Constants` are all other numbers of the scene, hand
and object files, and may be traced: changing them compiles nothing.
"""

import dataclasses
import functools
from collections.abc import Callable
from typing import Any, NamedTuple, TypeVar

from codesign_jax.scene import hand, objects, schema
from codesign_jax.scene.schema import choice, quantity

T = TypeVar("T")


@dataclasses.dataclass(frozen=True)
class Effects:
    """What is simulated; an effect that is off has no joint, contact or branch in the program.

    `codesign_jax.scene.effects` says what each means and which engines have it.
    """

    lateral_bending: bool = True
    twist: bool = True
    wrist: bool = True
    finger_object: bool = True
    palm_object: bool = True
    finger_table: bool = True
    palm_table: bool = True
    object_table: bool = True
    finger_finger: bool = False
    surface: str = choice("spheres", "hull", default="spheres")
    friction: str = choice("none", "coulomb", "full", default="coulomb")
    disturb: bool = True
    ungrasp: bool = True
    neo_hookean: bool = False
    pressure_dynamics: bool = False
    gravity: bool = True


@dataclasses.dataclass(frozen=True)
class Phases:
    """End times of the phases of one grasp (paper Fig. 3) [s].

    The number of time steps is structure: the end of the last phase may not be changed by
    `Constants`.
    """

    approach: float = quantity("s", 0.01, 60)
    inflate: float = quantity("s", 0.01, 60)
    lift: float = quantity("s", 0.01, 60)
    disturb: float = quantity("s", 0.01, 60)
    ungrasp: float = quantity("s", 0.01, 60, structure=True)
    deflate_time: float = quantity("s", 0.001, 60)


@dataclasses.dataclass(frozen=True)
class Arm:
    """Start pose, reference height and disturbance of the arm frame X_D."""

    start_height: float = quantity("m", 0.05, 2)
    zero_height: float = quantity("m", 0, 1)
    shake_frequency: float = quantity("Hz", 0, 20)
    shake_amplitude: float = quantity("deg", 0, 90)


@dataclasses.dataclass(frozen=True)
class Cost:
    """Cost of a trial (paper Fig. 3): `maximum` if lost as the lift begins, 0 if kept."""

    maximum: float = quantity("", 0.1, 100)
    lost_distance: float = quantity("m", 0.001, 1)
    failure: str = choice("exclude", "worst")


@dataclasses.dataclass(frozen=True)
class Contact:
    """MuJoCo's soft contact as the rubber skin's own numbers; see `model.contact_invweight`.

    A contact of normal force N resists spin with `torsional_friction` N and rolling with
    `rolling_friction` N, both lengths as in MuJoCo, if the effect `friction` is "full".
    """

    normal_stiffness: float = quantity("N/m", 10, 1e6)
    time_constant: float = quantity("s", 1e-4, 1)
    impedance: float = quantity("", 0.01, 0.9999)
    friction_ratio: float = quantity("", 0.01, 1000)
    finger_table_friction: float = quantity("", 0, 5)
    torsional_friction: float = quantity("m", 1e-5, 0.1, default=0.003)
    rolling_friction: float = quantity("m", 1e-5, 0.1, default=0.0005)
    finger_finger_friction: float = quantity("", 0, 5, default=0.8)


@dataclasses.dataclass(frozen=True)
class Pneumatics:
    """Dynamics of the chambers' pressure, used with the effect `pressure_dynamics`."""

    lag: float = quantity("s", 0, 10, default=0.1)
    rate: float = quantity("Pa/s", 1e3, 1e9, default=400e3)
    maximum: float = quantity("Pa", 1e3, 1e6, default=200e3)


@dataclasses.dataclass(frozen=True)
class Discretization:
    """Time step, segments a finger (the paper's ten links) and density of the contact points.

    Each link has `spheres_per_link` spheres or, with the surface "hull", `hull_rings` rings of
    `hull_points` vertices, a multiple of four.
    """

    timestep: float = quantity("s", 1e-5, 0.05, structure=True)
    links: int = quantity("", 1, 200, structure=True)
    spheres_per_link: int = quantity("", 1, 20, structure=True)
    hull_rings: int = quantity("", 1, 20, structure=True, default=2)
    hull_points: int = quantity("", 4, 80, structure=True, default=8)


@dataclasses.dataclass(frozen=True)
class Solver:
    """MuJoCo's options of its contact solver, which the engines `mujoco` and `mjx` read.

    Largest numbers of Newton iterations and of line-search iterations, and MuJoCo's tolerance: the
    improvement or gradient of the cost, scaled by the model's inertia.  The engine `structured`
    measures convergence otherwise, see `Newton`, and refuses other values than a preset's where
    `[newton]` is not set as well.

    The tolerance must not be zero: MuJoCo's line search may then return no step at all.
    """

    iterations: int = quantity("", 1, 1000, structure=True, default=30)
    ls_iterations: int = quantity("", 1, 1000, structure=True, default=20)
    tolerance: float = quantity("", 1e-16, 1, structure=True, default=1e-8)


@dataclasses.dataclass(frozen=True)
class Newton:
    """Limits of the contact solver of the engine `structured`.

    Largest numbers of Newton iterations of a step and of line-search evaluations of an iteration,
    and the relative Newton decrement at which a world has converged, a share of the cost's scale;
    a step that ends above it sets SOLVER_CAP.  Where no kernel runs a line search has at most six
    evaluations.
    """

    iterations: int = quantity("", 1, 1000, structure=True, default=24)
    evaluations: int = quantity("", 1, 1000, structure=True, default=14)
    decrement: float = quantity("", 1e-16, 1, structure=True, default=1e-6)


@dataclasses.dataclass(frozen=True)
class Accuracy:
    """Values of a preset of accuracy; docs/accuracy.md has its measured errors and cost."""

    description: str
    discretization: dict
    solver: dict
    newton: dict = dataclasses.field(default_factory=dict)


@dataclasses.dataclass(frozen=True)
class Limits:
    """Bounds beyond which a world has failed although its numbers are finite."""

    speed: float = quantity("rad/s or m/s", 1, 1e9)
    penetration: float = quantity("m", 1e-4, 1)


class Constants(NamedTuple):
    """The numbers of a scene, its hand and its objects that are not structure.

    A pytree of nested named tuples whose names are the keys of the files, such as
    `constants.hand.material.shear_modulus`, `constants.contact.friction_ratio` and
    `constants.objects.object[0].mass`; arrays of tables are tuples.  Units and ranges are those of
    the files.  Leaves are numbers, or arrays with a leading axis (world or trial) where a function
    says so.  `codesign_jax.scene.constants` checks and changes them.

    What is not here: names, effects, counts, kinds of shapes, meshes, the time step, the end of the
    last phase, the solver's limits, and the parameter table with its bounds, presets and pressure
    limit, which describe a search and not a simulation.
    """

    hand: Any
    objects: Any
    gravity: Any
    phases: Any
    arm: Any
    cost: Any
    contact: Any
    limits: Any
    pneumatics: Any


@dataclasses.dataclass(frozen=True)
class Scene:
    """A simulation's description; built by `load`, changed by `dataclasses.replace`."""

    name: str
    description: str
    hand: hand.Hand
    objects: objects.ObjectSet
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
    gravity: float = quantity("m/s^2", 0, 100, kw_only=True)

    def constants(self) -> Constants:
        """The numbers of the scene's files that are not structure."""
        return Constants(**schema.numbers(self)._asdict())

    def with_constants(self, constants: Constants) -> "Scene":
        """The scene with other numbers, which may be arrays or traced, for functions to read.

        Args:
          constants: Numbers, of the structure of `constants()`; `scene.constants.check` says what
            is wrong with others.

        Returns:
          A scene that reads as this one, has its `structure` and cannot be hashed.
        """
        values = schema.with_numbers(self, constants)
        fields = {f.name: getattr(values, f.name) for f in dataclasses.fields(Scene)}
        return _SceneWithConstants(**fields, described=self.structure)

    @functools.cached_property
    def structure(self) -> "Scene":
        """The scene without what no program depends on: every number of `constants` is a fixed one.

        Scenes of equal structure share model templates, traces and compiled programs.
        """
        step = self.discretization.timestep
        last = ("approach", "inflate", "lift", "disturb", "ungrasp").index(self._last_phase)
        ends = (self.num_steps * step * (i + 1) / (last + 1) for i in range(5))
        fixed = schema.typical(self)
        return dataclasses.replace(
            fixed,
            name="",
            description="",
            phases=Phases(*ends, deflate_time=step),
            hand=hand.structure(fixed.hand),
            objects=objects.structure(fixed.objects),
        )

    @property
    def gravity_on(self) -> float:
        """Gravity as simulated: 0 if the effect is off [m/s^2]."""
        return self.gravity if self.effects.gravity else 0.0

    @property
    def num_fingers(self) -> int:
        """Number of fingers of the hand."""
        return len(self.hand.finger)

    @property
    def num_steps(self) -> int:
        """Time steps of one grasp, up to the end of the last phase that is on."""
        return round(self.end_time / self.discretization.timestep)

    @property
    def end_time(self) -> float:
        """End of the last phase that is on [s]."""
        return getattr(self.phases, self._last_phase)

    @property
    def _last_phase(self) -> str:
        if self.effects.ungrasp:
            return "ungrasp"
        return "disturb" if self.effects.disturb else "lift"

    @property
    def window(self) -> tuple[float, float]:
        """Times t_0 and t_end between which losing the object costs: lift to end of disturb [s]."""
        return (
            self.phases.inflate,
            self.phases.disturb if self.effects.disturb else self.phases.lift,
        )


@dataclasses.dataclass(frozen=True, eq=False)
class _SceneWithConstants(Scene):
    """A scene whose numbers may be arrays; see `Scene.with_constants`."""

    described: Scene = dataclasses.field(kw_only=True, metadata={"in_file": False})

    __hash__ = None  # type: ignore[assignment]

    @property
    def structure(self) -> Scene:  # type: ignore[override]
        """That of the scene whose numbers were changed."""
        return self.described

    @property
    def num_steps(self) -> int:
        """That of the scene whose numbers were changed."""
        return self.described.num_steps


def by_structure(function: Callable[[Scene], T]) -> Callable[[Scene], T]:
    """Evaluates a function of a scene once for each structure, with the fixed numbers."""
    cached = functools.cache(function)

    @functools.wraps(function)
    def evaluate(scene: Scene) -> T:
        return cached(scene.structure)

    evaluate.cache_clear = cached.cache_clear  # type: ignore[attr-defined]
    return evaluate
