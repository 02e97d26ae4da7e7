"""A machine's records joined: errors by part and setting beside the times of the settings."""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from scripts.accuracy import analysis, figures
from scripts.accuracy.analysis import Records
from scripts.accuracy.figures import Point
from scripts.accuracy.settings import HULL, PRESETS, SPHERES, Setting, one_at_a_time

ERRORS = {
    "tip": ("finger tip [mm]", "tip_rms_mm"),
    "impulse": ("contact impulse, relative", "impulse_error"),
    "decision": ("verdicts that flip", "flipped"),
}
SHARED = ("tip", "impulse")
"""Errors of what all engines solve alike, see `Study.points`."""
WANTED = {
    "tip": (5.0, 2.0, 1.0, 0.5),
    "impulse": (0.05, 0.03, 0.02, 0.01),
    "decision": (0.07, 0.05, 0.03, 0.02),
}


class Study:
    """The records of a machine, joined: errors by part and setting, times by setting."""

    def __init__(self, files: Sequence[Path]):
        """Reads the files."""
        self.records, self.runs = analysis.load(files)
        self.times = analysis.times(self.records)
        self.grasps = analysis.decisions(self.records)
        self._compared: dict[str, dict[Setting, dict[str, Any]]] = {}

    def decisions(self, population: str) -> dict[Setting, dict[str, Any]]:
        """Every setting's decisions beside the finest's, over the same particles and trials."""
        if population not in self._compared:
            reference = analysis.finest(self.grasps, population)
            truth = self.grasps.get((reference, False, population))  # type: ignore[arg-type]
            found = {
                setting: analysis.compare(cost, truth)
                for (setting, moved, name), cost in self.grasps.items()
                if name == population and not moved and setting != reference
                if setting.engine == "structured"  # the others have no hull
                if truth is not None
            }
            found = dict(sorted(found.items(), key=lambda item: place(item[0])))
            self._compared[population] = found
        return self._compared[population]

    def errors(self, part: str) -> Records:
        """Records of a part with their errors, in the order of the study's settings.

        Those without a measurement as well, but not what only confirms the reference.
        """
        failed = [r for r in self.records if r["part"] == part and analysis.bad(r)]
        failed = [r for r in failed if part == "decision" or not r["more"]]
        return sorted(failed + self._errors(part), key=lambda r: place(r["of"]))

    def _errors(self, part: str) -> Records:
        if part in ("tip", "impulse"):
            return [r for r in analysis.against_reference(self.records, part) if not r["more"]]
        return [
            {"of": setting, "flipped": row["flipped"].value}
            for setting, row in self.decisions("late").items()
        ]

    def floor(self, setting: Setting, population: str = "late") -> float | None:
        """Share of verdicts that a micrometre changes at a setting; None where not measured."""
        both = [self.grasps.get((setting, moved, population)) for moved in (False, True)]
        return None if both[0] is None or both[1] is None else analysis.differ(*both)

    def cost(self, engine: str, setting: Setting) -> float | None:
        """Wall seconds of a simulated second of a world; None where it was not timed."""
        of = replace(setting, engine="structured", precision="float32")
        if engine != "structured" and of.surface == HULL:  # in the air, where it does not matter
            of = replace(of, surface=SPHERES)
        name = engine if engine == "mujoco" else f"{engine} {setting.precision}"
        found = self.times.get((name, of))
        if found is None and setting.keep_contact:  # refused: drawn where it would have been
            return self.cost(engine, replace(setting, keep_contact=False))
        return None if found is None else found["s_per_simulated_s"]

    def points(self, part: str) -> list[Point]:
        """Settings with error and cost.

        Without contact, and in how the hand closes, all engines solve the same equations: there
        MuJoCo C's error stands for the structured engine's, where that was not measured itself;
        not with a limit of iterations, as each engine has a solver of its own.
        """
        rows, found = self.errors(part), {}
        for r in rows:
            setting = r["of"]
            error = np.nan if analysis.bad(r) else r[ERRORS[part][1]]
            shared = part in SHARED and setting.engine == "mujoco" and setting.iterations is None
            for engine in (setting.engine, *(("structured",) if shared else ())):
                cost, key = self.cost(engine, setting), (engine, setting.label)
                if cost and (key not in found or setting.engine == engine):
                    kind = figures.knob(setting)
                    found[key] = Point(engine, kind, setting.label, cost, error)
        return list(found.values())

    def error(self, part: str, setting: Setting) -> float | None:
        """A setting's error of a kind, MuJoCo C's where that stands for it; see `points`."""
        if part == "tip":  # in the air neither the surface nor the limit of iterations matter
            setting = replace(setting, surface=HULL, iterations=None)
        engines = [setting.engine] + ["mujoco"] * (part in SHARED and setting.iterations is None)
        found = {(r["of"].engine, r["of"].label): r for r in self.errors(part)}
        rows = (found.get((engine, setting.label)) for engine in engines)
        row = next((r for r in rows if r and not analysis.bad(r)), None)
        return None if row is None else row[ERRORS[part][1]]

    def cheapest(self, part: str, engine: str, limit: float) -> Point | None:
        """The cheapest setting of an engine with an error below a limit."""
        fits = [p for p in self.points(part) if p.engine == engine and p.error < limit]
        return min(fits, key=lambda p: p.cost, default=None)

    def beaten_by(self, setting: Setting, *parts: str) -> list[Setting]:
        """Settings of the same engine that cost less and err less, in every part at once.

        Those without one of the errors count as not better.
        """
        cost = self.cost(setting.engine, setting) or np.inf
        errors = [self.error(part, setting) for part in parts]
        found = []
        for other in one_at_a_time(setting.engine):
            others = [self.error(part, other) for part in parts]
            pairs = list(zip(others, errors, strict=True))
            better = all(a is not None and b is not None and a < b for a, b in pairs)
            if better and (self.cost(other.engine, other) or np.inf) < cost:
                found.append(other)
        return found

    def machine(self) -> str:
        """Where the times come from, most of them if there are several runs."""
        timed = [r["run"] for r in self.records if r["part"] == "time"]
        run = self.runs[max(timed, key=timed.count)] if timed else self.runs[-1]
        batch = {
            v["engine"]: v["worlds"]
            for r in analysis.measured(self.records, "time")
            for v in r["engines"].values()
        }
        worlds = ", ".join(f"{e} {n:,} worlds" for e, n in batch.items())
        device = "" if run["device"] == "cpu" else f"{run['device']}, "
        text = f"{device}{run['cpu']}, {run['cpus']} cores; JAX {run['jax']}, MuJoCo "
        text += f"{run['mujoco']}; {run['date'][:10]}, commit {(run['commit'] or 'unknown')[:12]}"
        return f"{text}; {worlds}" if worlds else text


_ORDER = {
    (engine, setting.label): (number, i)
    for number, engine in enumerate(("structured", "mujoco", "mjx"))
    for i, setting in enumerate([*one_at_a_time("structured"), *one_at_a_time(engine)])
}


def place(setting: Setting) -> tuple[int, int]:
    """Where a setting stands in the tables: by engine, then as the study has them."""
    return _ORDER.get((setting.engine, setting.label), (9, 0))


def named(label: str, engine: str = "structured") -> str:
    """A setting's label, with the preset's name if it is one; presets are of our engine."""
    names = {s.label: n for n, s in PRESETS.items()} if engine == "structured" else {}
    return f"`{names[label]}`: {label}" if label in names else label
