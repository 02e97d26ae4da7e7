"""Sections of the study, and what is computed of each: one file a section.

Every number of a section's states is that of an equilibrium under pressure at given curvatures:
blocked (straight), at shares of the free bend, bent further than that, sideways and twisted.
"""

import dataclasses
import json
import math
import time
from pathlib import Path
from typing import Any

import numpy as np
from scipy.stats import qmc

from scripts.section.elements import CURVATURES, Model, NoEquilibrium, Section
from scripts.shared import evidence, output

SHEAR_MODULUS = 88e3
PRESSURES = (10e3, 20e3, 35e3, 50e3, 75e3, 100e3)
"""Pressures [Pa]; of a silicone of another modulus they count relative to it."""
SHARES = (1.25, 0.75, 0.5, 0.25, 0.0)
"""Bends relative to the free one at the pressure, in the order in which they are computed."""
LATERAL = (0.5, 2.0, 5.0)
"""Curvatures sideways [1/m], beside zero."""
STRAINS = (-0.1, -0.02, 0.02, 0.1, 0.3)
"""Bends without pressure, as strains of the top."""
SIDES = (8, 6, 8, 6)
"""Elements along the sides."""
HELD_OUT = 3
"""Every third section of a family does not take part in the fit of the law."""


def design() -> dict[str, Section]:
    """The sections by name; a family's names begin alike."""
    sections = {}

    def spread(name: str, count: int, ranges: dict[str, tuple[float, float]], **fixed: Any) -> None:
        seed = sum(map(ord, name))
        sampler: Any = qmc.Sobol(len(ranges), seed=seed)  # type: ignore[call-arg]
        units = sampler.random_base2(math.ceil(math.log2(count)))[:count]
        for k, unit in enumerate(units):
            at = zip(ranges.items(), unit, strict=True)
            values = {n: round(a + (b - a) * float(u), 6) for (n, (a, b)), u in at}
            # A chamber of 4 mm is the least that can be cast.
            most = (min(values["height"], values["width"]) - 4e-3) / 2
            values["wall"] = round(min(values["wall"], most), 6)
            sections[f"{name}{k:02d}"] = Section(**values, **fixed, sides=SIDES)

    size = {"wall": (2e-3, 7e-3), "height": (14e-3, 28e-3), "width": (16e-3, 32e-3)}
    depth = {"thread_depth": (0.1, 0.9)}
    angle = {"winding_angle": (0.01, 0.08)}
    fabric = {"fabric_stiffness": (2e4, 3e5)}
    for wall in (2.5, 3.5, 5.0, 7.0):
        sections[f"nominal{len(sections):02d}"] = Section(wall=wall * 1e-3, sides=SIDES)
    spread("outside", 48, size)
    spread("chamber", 12, size, thread_depth=1.0)
    spread("inside", 16, size | depth)
    spread("crossed", 12, size | angle)
    spread("single", 6, size | {"winding_angle": (0.01, 0.04)}, crossed=False)
    spread("fabric", 12, size | fabric)
    spread("mixed", 12, size | depth | angle | fabric)
    # The same sections with twice as many elements tell the error of the mesh.
    for k, wall in enumerate((2.5, 5.0, 7.0)):
        fine = Section(wall=wall * 1e-3, layers=3, sides=(12, 8, 12, 8))
        sections[f"finer{k:02d}"] = fine
    return sections


def held_out(name: str) -> bool:
    """Whether a section is kept for testing the law."""
    return not name.startswith(("nominal", "finer")) and int(name[-2:]) % HELD_OUT == HELD_OUT - 1


def state(model: Model, moments: np.ndarray, kind: str) -> dict[str, Any]:
    """Numbers of an equilibrium."""
    positions = model.positions()
    return {
        "kind": kind,
        "pressure": model.pressure,
        "kappa": model.kappa.tolist(),
        "moments": moments.tolist(),
        "stiffness": model.stiffness().tolist(),
        "energy": model.energy(),
        "volume": model.volume(),
        "stretch": model.stretch,
        "tension": model.fabric_tension(),
        "width": float(np.ptp(positions[:, 1])),
        "low": float(positions[:, 2].min()),
        "high": float(positions[:, 2].max()),
    }


class Study:
    """The states of one section."""

    def __init__(self, section: Section):
        self.model = Model(section)
        self.states: list[dict[str, Any]] = []

    def run(self) -> list[dict[str, Any]]:
        self._without_pressure()
        self.model.rest()
        free = (
            {}
            if self.model.section.winding_angle and not self.model.section.crossed
            else {"twist": 0.0}
        )
        for pressure in PRESSURES:
            if not self._reach("free", pressure, lateral=0.0, **free):
                break
            bent = self.model.state.copy(), self.model.pressure
            self._at(pressure, bent)
            self.model.state, self.model.pressure = bent
        return self.states

    def _reach(self, kind: str, pressure: float, **kappa: float) -> bool:
        """Adds a state; False if there is none."""
        try:
            moments = self.model.reach(pressure, **kappa)
        except NoEquilibrium:
            self.states.append({"kind": kind, "pressure": pressure, "failed": True})
            return False
        self.states.append(state(self.model, moments, kind))
        return True

    def _without_pressure(self) -> None:
        self.model.solve(0.0, twist=0.0, bend=0.0, lateral=0.0)
        height = self.model.section.height
        for strain in STRAINS:
            self.model.rest()
            self._reach("empty", 0.0, twist=0.0, bend=strain / height, lateral=0.0)
        self.model.rest()
        for lateral in LATERAL:
            self._reach("empty_lateral", 0.0, twist=0.0, lateral=lateral)

    def _at(self, pressure: float, bent: tuple[np.ndarray, float]) -> None:
        twist, bend, _ = self.model.kappa
        for share in SHARES:
            if share < 1 and self.model.kappa[CURVATURES.index("bend")] > bend:
                self.model.state, self.model.pressure = bent
            held = {"twist": twist, "bend": share * bend}
            if not self._reach("held", pressure, lateral=0.0, **held):
                continue
            if share in (0.0, 0.5):
                self._sideways(pressure, held)
        self.model.state, self.model.pressure = bent
        self._sideways(pressure, {"twist": twist, "bend": bend})

    def _sideways(self, pressure: float, held: dict[str, float]) -> None:
        before = self.model.state, self.model.pressure
        for lateral in LATERAL:
            if not self._reach("sideways", pressure, lateral=lateral, **held):
                break
        self.model.state, self.model.pressure = before


def compute(folder: Path, share: str) -> None:
    """Computes the sections that the folder lacks; `share` I/N takes every N-th one."""
    first, count = (int(n) for n in share.split("/"))
    folder.mkdir(parents=True, exist_ok=True)
    for name, section in list(design().items())[first - 1 :: count]:
        path = folder / f"{name}.json"
        if path.exists():
            continue
        start = time.process_time()
        states = Study(section).run()
        seconds = time.process_time() - start
        content = {"section": dataclasses.asdict(section), "states": states}
        output.write_json(path, content | {"cpu_seconds": round(seconds, 1)})
        failed = sum("failed" in s for s in states)
        print(f"{name}: {len(states)} states, {failed} failed, {seconds:.0f} s", flush=True)


COLUMNS = (
    *("pressure", "twist", "bend", "lateral", "moment_twist", "moment_bend", "moment_lateral"),
    *("twist_twist", "twist_bend", "twist_lateral", "bend_bend", "bend_lateral"),
    *("lateral_lateral", "energy", "volume", "stretch", "tension", "width", "low", "high"),
)
"""Numbers of a state in the merged file [SI]; pairs are elements of the stiffness matrix."""


def merge(folder: Path, path: Path) -> None:
    """Writes the states of a folder's sections into one file of arrays, one a section."""
    arrays = {}
    for source in sorted(folder.glob("*.json")):
        content = json.loads(source.read_text())
        arrays[source.stem] = np.array(
            [_numbers(s) for s in content["states"] if "failed" not in s], np.float32
        )
    output.write_arrays(path, {"version": np.array(evidence.version())} | arrays)


def _numbers(values: dict[str, Any]) -> list[float]:
    stiffness = np.array(values["stiffness"])[np.triu_indices(3)]
    rest = [values[n] for n in COLUMNS[13:]]
    return [values["pressure"], *values["kappa"], *values["moments"], *stiffness, *rest]


def read(path: Path) -> dict[str, tuple[Section, dict[str, np.ndarray]]]:
    """Sections of a merged file by name, and their states by column."""
    sections = design()
    with np.load(path) as file:
        return {
            n: (sections[n], dict(zip(COLUMNS, file[n].T.astype(float), strict=True)))
            for n in file.files
            if n in sections
        }
