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


@dataclasses.dataclass(frozen=True)
class Setting:
    """One point of the study; the default is the standard preset.

    Attributes:
      engine: Name of the engine.
      timestep: Time step [ms].
      links: Segments a finger.
      axes: Hinges a joint: 1 bends, 2 bends both ways, 3 also twists.
      spheres: Contact spheres a link.
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
    spheres: int = 1
    iterations: int | None = None
    precision: str = "float32"
    keep_contact: bool = False
    extra: tuple[str, ...] = ()

    @property
    def label(self) -> str:
        """The setting in a few words, without the engine."""
        parts = [f"{self.timestep:g} ms", f"{self.links} x {self.spheres}"]
        parts += [f"{self.axes} axes" if self.axes > 1 else "1 axis"] * (self.axes != 3)
        if self.iterations is not None:
            parts.append(f"{self.iterations} it." if self.iterations else "exact")
        parts += ["float64"] * (self.engine != "mujoco" and self.precision == "float64")
        parts += ["contact kept"] * self.keep_contact
        return ", ".join([*parts, *(e.rsplit(".", 1)[-1] for e in self.extra)])

    @property
    def wide(self) -> bool:
        """Whether JAX computes in float64; MuJoCo C takes float32 model fields then, as a run's."""
        return self.precision == "float64"

    def overrides(self) -> Overrides:
        """What the setting changes in a scene."""
        tables: dict[str, dict[str, Any]] = {
            "discretization": {
                "timestep": self.timestep * 1e-3,
                "links": self.links,
                "spheres_per_link": self.spheres,
            },
            "effects": {"lateral_bending": self.axes > 1, "twist": self.axes > 2},
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
        """The paper's scene at this setting.

        Args:
          more: Further overrides.
          **names: Hand and object set, see `scene.load`.

        Raises:
          SceneError: If the scene refuses the setting.
        """
        return scenes.load("paper_spheres", overrides=merge(self.overrides(), more or {}), **names)

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
PRESETS = {
    "fast": Setting(links=5, spheres=2),
    "standard": STANDARD,
    "reference": Setting(timestep=1.0, links=20),
}
"""The presets' discretizations in the structured engine, whose solver is its own."""
HULL = Setting(extra=("effects.surface=hull",))
"""The skinned hull as the fingers' surface, in the structured engine alone: see docs/hull.md."""
TIMESTEPS = (1.0, 2.0, 5.0, 10.0, 20.0)
LINKS = (3, 5, 10, 20, 40)
SPHERES = (1, 2, 4)
ITERATIONS = (1, 2, 4, 8)
# Several knobs at once: candidates for the Pareto front beside the single sweeps.
COMBINED = (
    {"links": 5, "spheres": 2},
    {"timestep": 20.0, "links": 5, "spheres": 2},
    {"timestep": 5.0, "links": 20},
    {"timestep": 2.0, "links": 20},
    {"timestep": 1.0, "links": 20},
    {"timestep": 1.0, "links": 40},
)


def sweep(base: Setting, **values: Iterable[Any]) -> list[Setting]:
    """Settings in which one field at a time takes other values."""
    return [dataclasses.replace(base, **{k: v}) for k, all_v in values.items() for v in all_v]


def one_at_a_time(engine: str) -> list[Setting]:
    """The study's settings of an engine: each knob on its own, then some together."""
    base = Setting(engine=engine)
    found = [base]
    found += sweep(base, timestep=TIMESTEPS, links=LINKS, axes=(1, 2), spheres=SPHERES)
    found += sweep(base, iterations=ITERATIONS)
    found += [dataclasses.replace(base, **changed) for changed in COMBINED]
    if engine != "mujoco":
        found.append(dataclasses.replace(base, precision="float64"))
    found.append(dataclasses.replace(base, timestep=20.0, keep_contact=True))
    if engine == "structured":
        found.append(HULL)
    return list(dict.fromkeys(found))
