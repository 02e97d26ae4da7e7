"""Settings whose error and cost are measured: time step, links, axes, surface, solver, floats."""

import dataclasses
from collections.abc import Iterable, Mapping
from typing import Any

from codesign_jax import scene as scenes
from codesign_jax.engines import Engine, make_engine
from codesign_jax.engines.structured import StructuredEngine
from codesign_jax.scene import Scene, keypaths
from scripts.shared import peers

Overrides = Mapping[Any, Any]
"""Values by key path, nested or flat; see `keypaths`."""

# A relative Newton decrement is a square: these are the smallest that rounding lets a step reach.
EXACT = {
    "float32": {"iterations": 100, "evaluations": 40, "tolerance": 1e-9},
    "float64": {"iterations": 200, "evaluations": 40, "tolerance": 1e-16},
}
"""Arguments of the structured engine at which its steps are solved to rounding."""


HULL = "hull 2 x 8"
"""The fingers' surface of the scene `paper`: the skinned hull, rings x vertices a link."""
SPHERES = "spheres 1"
"""The surface of engines without the hull: contact spheres a link."""


@dataclasses.dataclass(frozen=True)
class Setting:
    """One point of the study; the default is the standard preset.

    Attributes:
      engine: Name of the engine.
      timestep: Time step [ms].
      links: Segments a finger.
      axes: Hinges a joint: 1 bends, 2 bends both ways, 3 also twists.
      surface: "hull R x P" with R rings of P vertices a link, or "spheres N" with N a link.
      damping: `discretization.spring_damping` of the scene.
      iterations: Newton iterations a step at most; None for the engine's own limit, 0 for as many
        as it takes to converge to rounding.
      precision: "float32" or "float64"; MuJoCo C computes in float64 always.
      keep_contact: Keeps the scene's contact time constant, also where the step is too long for it.
      extra: Further overrides, "table.key=value".
    """

    engine: str = "structured"
    timestep: float = 10.0
    links: int = 10
    axes: int = 3
    surface: str = HULL
    damping: str = "added"
    iterations: int | None = None
    precision: str = "float32"
    keep_contact: bool = False
    extra: tuple[str, ...] = ()

    @property
    def label(self) -> str:
        """The setting in a few words, without the engine."""
        parts = [f"{self.timestep:g} ms, {self.links} links"]
        parts += [self.surface] * (self.surface != HULL)
        parts += [f"{self.damping} damping"] * (self.damping != "added")
        parts += [f"{self.axes} axes" if self.axes > 1 else "1 axis"] * (self.axes != 3)
        if self.iterations is not None:
            parts.append(f"{self.iterations} it." if self.iterations else "exact")
        parts += ["float64"] * (self.engine != "mujoco" and self.precision == "float64")
        parts += ["contact kept"] * self.keep_contact
        changed = (e.split("=", 1) for e in self.extra)
        return ", ".join([*parts, *(f"{k.rsplit('.', 1)[-1]}={v}" for k, v in changed)])

    @property
    def wide(self) -> bool:
        """Whether JAX computes in float64; MuJoCo C takes float32 model fields then, as a run's."""
        return self.precision == "float64"

    @property
    def work(self) -> float:
        """Time steps and links, relative to the standard preset's: a rough cost."""
        return (10 / self.timestep) * (self.links / 10) * (3 if self.wide else 1)

    def overrides(self) -> Overrides:
        """What the setting changes in a scene."""
        kind, *sizes = self.surface.replace(" x", "").split()
        keys = ("hull_rings", "hull_points") if kind == "hull" else ("spheres_per_link",)
        tables: dict[str, dict[str, Any]] = {
            "discretization": {
                "timestep": self.timestep * 1e-3,
                "links": self.links,
                "spring_damping": self.damping,
                **{key: int(size) for key, size in zip(keys, sizes, strict=True)},
            },
            "effects": {
                "lateral_bending": self.axes > 1,
                "twist": self.axes > 2,
                "surface": kind,
                "finger_finger": False,
                "finger_palm": False,
            },
        }
        if self.iterations == 0:
            tables["solver"] = dict(peers.REFERENCE)
        elif self.iterations is not None:
            tables["solver"] = {"iterations": self.iterations}
        if self.timestep > 10 and not self.keep_contact:
            # MuJoCo's contacts need two steps a time constant. The normal stiffness stays: it is
            # declared apart from the time constant, see `model.contact_invweight`.
            tables["contact"] = {"time_constant": 2e-3 * self.timestep}
        return merge(tables, keypaths.parse(self.extra))

    def scene(self, more: Overrides | None = None, **names: Any) -> Scene:
        """The scene `paper` at this setting, without contact among fingers and with the palm.

        Args:
          more: Further overrides.
          **names: Hand and object set, see `scene.load`.

        Raises:
          InputError: If the scene refuses the setting.
        """
        return scenes.load("paper", overrides=merge(self.overrides(), more or {}), **names)

    def make(self, scene: Scene) -> Engine:
        """Builds the engine for a scene at this setting."""
        if self.engine != "structured" or self.iterations is None:
            return make_engine(self.engine, scene)
        if self.iterations == 0:
            return StructuredEngine(scene, **EXACT[self.precision])
        return StructuredEngine(scene, iterations=self.iterations)


def merge(*tables: Overrides) -> Overrides:
    """Overrides one after the other: the last value of a key holds."""
    merged: dict[keypaths.Path, Any] = {}
    for table in tables:
        merged |= keypaths.flatten(table)
    return merged


STANDARD = Setting()
FINE = Setting(timestep=2.0, links=20, damping="least")
"""Where one knob at a time is varied against its own limit: little else is left to err."""
REFERENCE = Setting(timestep=0.5, links=20, damping="least", precision="float64")
"""What verdicts are compared with."""
FINGERS = "effects.finger_finger=true"
LARGE_STRAIN = "effects.neo_hookean=true"
PRESETS = {
    "fast": Setting(damping="least", iterations=4),
    "standard": STANDARD,
    "fine": Setting(timestep=5.0, damping="least", iterations=6),
    "reference": Setting(timestep=1.0, links=20, damping="least"),
}
"""The presets in the structured engine, whose iterations are those of the table [newton]."""
TIMESTEPS = (2.0, 5.0, 10.0, 20.0)
LINKS = (5, 10, 20, 40)
SURFACES = ("hull 1 x 8", "hull 3 x 12", "hull 4 x 16", "spheres 1", "spheres 2")
ITERATIONS = (4, 8)
CONTACT = (
    "contact.friction_ratio=1", "contact.friction_ratio=3", "contact.friction_ratio=10",
    "contact.normal_stiffness=2000", "contact.normal_stiffness=8000", "contact.time_constant=0.04",
)  # fmt: skip
"""Constants of the contact, whose effect on creep stands in docs/notes/accuracy.md as well."""
# Several knobs at once: candidates for the Pareto front beside the single sweeps.
COMBINED = (
    {"links": 5, "surface": "hull 4 x 8"},
    {"timestep": 5.0, "damping": "least"},
    {"timestep": 5.0, "links": 20, "damping": "least"},
    {"timestep": 2.0, "damping": "least"},
    {"timestep": 2.0, "links": 20, "damping": "least"},
    {"timestep": 1.0, "links": 20, "damping": "least"},
    {"timestep": 1.0, "links": 40, "damping": "least"},
)

# Few Newton iterations: the solver's error beside those of step and links.
FEW_ITERATIONS = (
    {"damping": "least", "iterations": 4},
    {"timestep": 5.0, "damping": "least", "iterations": 3},
    {"timestep": 5.0, "damping": "least", "iterations": 4},
    {"timestep": 5.0, "damping": "least", "iterations": 6},
    {"timestep": 5.0, "links": 20, "damping": "least", "iterations": 4},
    {"timestep": 2.0, "links": 20, "damping": "least", "iterations": 4},
)


def sweep(base: Setting, **values: Iterable[Any]) -> list[Setting]:
    """Settings in which one field at a time takes other values."""
    return [dataclasses.replace(base, **{k: v}) for k, all_v in values.items() for v in all_v]


def standard_of(engine: str) -> Setting:
    """The standard setting of an engine: with its hull, or with spheres where it has none."""
    return Setting(engine=engine, surface=HULL if engine == "structured" else SPHERES)


def one_at_a_time(engine: str) -> list[Setting]:
    """The study's settings of an engine: each knob on its own, then some together."""
    base = standard_of(engine)
    found = [base]
    found += sweep(base, timestep=TIMESTEPS, links=LINKS, axes=(1, 2), damping=("least",))
    found += sweep(base, iterations=ITERATIONS)
    for changed in COMBINED:
        kept = {k: v for k, v in changed.items() if engine == "structured" or k != "surface"}
        found.append(dataclasses.replace(base, **kept))
    if engine != "mujoco":
        found.append(dataclasses.replace(base, precision="float64"))
    found.append(dataclasses.replace(base, timestep=20.0, keep_contact=True))
    if engine == "structured":
        found += [dataclasses.replace(base, **changed) for changed in FEW_ITERATIONS]
        found += sweep(
            base, surface=SURFACES, extra=((c,) for c in (*CONTACT, FINGERS, LARGE_STRAIN))
        )
    else:
        found += sweep(base, surface=("spheres 2", "spheres 4"))
    return list(dict.fromkeys(found))


def own_limits() -> dict[str, list[Setting]]:
    """Settings in which one knob alone goes to its limit, the limit last, by the knob's name."""
    return {
        "time step": sweep(FINE, timestep=(10.0, 5.0, 2.0, 1.0, 0.5)),
        "links": sweep(FINE, links=(5, 10, 20, 40)),
        "surface": sweep(FINE, surface=("spheres 1", "hull 1 x 8", HULL, "hull 4 x 16")),
        "damping": sweep(FINE, damping=("added", "least")),
        "float type": sweep(FINE, precision=("float32", "float64")),
    }
