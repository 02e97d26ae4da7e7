"""The scene: hand, objects, effects, phases, contact and discretization, frozen and hashable.

A scene has two parts.  Its `structure` (effects, counts, kinds of shapes, time step and number of
steps) is what programs are compiled for; its `Constants` are all other numbers of the scene, hand
and object files, and may be traced: changing them compiles nothing.
"""

import dataclasses
import functools
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, NamedTuple, TypeVar

from codesign_jax import files, hand, keypaths, objects, schema
from codesign_jax.schema import choice, quantity

T = TypeVar("T")


@dataclasses.dataclass(frozen=True)
class Effects:
    """What is simulated; an effect that is off has no joint, contact or branch in the program.

    `codesign_jax.effects` says what each means and which engines have it.
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
    says so.  `codesign_jax.constants` checks and changes them.

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
          constants: Numbers, of the structure of `constants()`; `codesign_jax.constants.check` says
            what is wrong with others.

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


@dataclasses.dataclass(frozen=True)
class _SceneFile:
    """Schema of a scene file: as `Scene`, with hand and objects by name."""

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
    gravity: float = quantity("m/s^2", 0, 100, kw_only=True)


def load(
    name: str | Path = "paper",
    *,
    hand_name: str | Path | None = None,
    object_set: str | Path | None = None,
    accuracy: str | Path | None = None,
    overrides: Mapping[Any, Any] | None = None,
) -> Scene:
    """Reads a scene with its hand and objects.

    Args:
      name: Name of a built-in scene, or a path ending in .toml.
      hand_name: Hand to use instead of the scene's.
      object_set: Object set to use instead of the scene's.
      accuracy: Preset of discretization and solver to use instead of the scene's: "fast",
        "standard", "reference", or a path ending in .toml; see `load_accuracy`.
      overrides: Values by key path that replace the files' and the preset's, nested or dotted,
        e.g. {"discretization": {"links": 5}, "hand.material.shear_modulus": 60e3}; see `keypaths`.

    Raises:
      SceneError: with every problem of the scene, the hand and the objects.
    """
    path = files.find("scenes", name)
    table = files.read(path)
    problems: list[str] = []
    changes = keypaths.flatten(_preset(accuracy, problems)) | keypaths.flatten(overrides or {})
    inside = {key: keypaths.below(changes, key) for key in ("hand", "objects")}
    own = {p: v for p, v in changes.items() if p[0] not in inside or len(p) == 1}
    keypaths.apply(table, own, path.name, problems)
    parsed = schema.parse(_SceneFile, table, path.name, problems)
    parts = {}
    for key, loader, chosen in (
        ("hand", hand.load, hand_name),
        ("objects", objects.load, object_set),
    ):
        named = table.get(key)
        if chosen is None and not isinstance(named, str):
            continue  # missing or of the wrong type: `parse` has said so
        try:
            source = _beside(path, named) if chosen is None else chosen
            parts[key] = loader(source, overrides=inside[key])
        except schema.SceneError as error:
            problems += error.problems
    if parsed is not None:
        _check(parsed, path.name, problems)
    if problems or parsed is None:
        raise schema.SceneError(problems)
    names = [f.name for f in dataclasses.fields(Scene) if f.name not in parts]
    return Scene(**parts, **{n: getattr(parsed, n) for n in names})


def load_accuracy(name: str | Path) -> Accuracy:
    """Reads a preset of discretization and solver; its values are checked with the scene's.

    Args:
      name: Name of a built-in preset, or a path ending in .toml.

    Raises:
      SceneError: with every problem of the file.
    """
    path = files.find("accuracy", name)
    problems: list[str] = []
    preset = schema.parse(Accuracy, files.read(path), path.name, problems)
    if problems or preset is None:
        raise schema.SceneError(problems)
    return preset


def _preset(name: str | Path | None, problems: list[str]) -> dict[str, dict[str, Any]]:
    """Overrides of a preset of accuracy; none without a name or with problems."""
    if name is None:
        return {}
    try:
        preset = load_accuracy(name)
    except schema.SceneError as error:
        problems += error.problems
        return {}
    return {
        "discretization": preset.discretization,
        "solver": preset.solver,
        "newton": preset.newton,
    }


def _beside(path: Path, name: str) -> str | Path:
    """Paths inside a scene file are relative to that file, whatever the working directory holds."""
    return path.parent / name if name.endswith(".toml") else name


def _check(scene: _SceneFile, where: str, problems: list[str]) -> None:
    problems += check_together(scene, where)
    e = scene.effects
    if e.surface == "hull" and e.friction == "full":
        problems.append(
            f"{where}.effects.surface = 'hull' needs friction = 'coulomb' or 'none', not 'full': "
            "a vertex has no patch of its own, its neighbours resist turning"
        )
    if scene.discretization.hull_points % 4:
        problems.append(
            f"{where}.discretization.hull_points = {scene.discretization.hull_points} "
            "must be a multiple of 4: every side of the section has as many"
        )


def check_together(scene: "Scene | _SceneFile", where: str) -> list[str]:
    """Returns what is wrong with numbers that are each in range, but do not go together.

    Args:
      scene: The scene, its numbers not traced.
      where: Key path shown before those of the scene.
    """
    problems = []
    p, h = scene.phases, scene.discretization.timestep
    times = [("approach", p.approach), ("inflate", p.inflate), ("lift", p.lift)]
    times += [("disturb", p.disturb), ("ungrasp", p.ungrasp)]
    for (first, a), (second, b) in zip(times, times[1:], strict=False):
        if not a < b:
            problems.append(f"{where}.phases.{second} = {b:g} s must come after {first} = {a:g} s")
    if p.ungrasp < p.disturb + p.deflate_time:
        problems.append(
            f"{where}.phases.deflate_time = {p.deflate_time:g} s does not fit between "
            f"disturb = {p.disturb:g} s and ungrasp = {p.ungrasp:g} s"
        )
    if scene.contact.time_constant < 2 * h:
        problems.append(
            f"{where}.contact.time_constant = {scene.contact.time_constant:g} s "
            f"must be at least two time steps ({2 * h:g} s): "
            "a stiffer contact is unstable (MuJoCo's refsafe)"
        )
    if isinstance(scene, Scene) and round(scene.end_time / h) != scene.num_steps:
        problems.append(
            f"{where}.phases ends after {scene.end_time:g} s: the number of steps is structure, "
            f"{scene.num_steps} of {h:g} s"
        )
    return problems
