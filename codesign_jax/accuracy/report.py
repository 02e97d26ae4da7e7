"""From committed records to figures, tables and CSV."""

import csv
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from codesign_jax.accuracy import figures, statistics
from codesign_jax.accuracy.figures import Point
from codesign_jax.accuracy.settings import PRESETS, Setting
from codesign_jax.accuracy.statistics import Records
from codesign_jax.benchmark.report import markdown
from codesign_jax.experiments.report import fill
from codesign_jax.experiments.statistics import Interval

MACHINES = {"h200": "NVIDIA H200 and 16 CPU cores", "cpu": "2 CPU cores"}
ERRORS = {
    "tip": ("finger tip [mm]", "tip_rms_mm"),
    "step": ("acceleration of a step, 99 %", "step_p99"),
    "impulse": ("contact impulse, relative", "impulse_error"),
    "decision": ("verdicts that flip", "flipped"),
}
WANTED = {
    "tip": (5.0, 2.0, 1.0, 0.5),
    "step": (1e-1, 1e-3, 1e-4),
    "impulse": (0.1, 0.05, 0.02, 0.01),
    "decision": (0.08, 0.05, 0.03, 0.02),
}


class Study:
    """The records of a machine, joined: errors by part and setting, times by setting."""

    def __init__(self, files: Sequence[Path]):
        """Reads the files."""
        self.records, self.runs = statistics.load(files)
        self.times = statistics.times(self.records)
        self.grasps = statistics.decisions(self.records)
        self.reference = statistics.finest(self.grasps, "spread")

    def errors(self, part: str) -> Records:
        """Records of a part with their errors, those without a measurement as well."""
        failed = [r for r in self.records if r["part"] == part and statistics.bad(r)]
        return failed + self._errors(part)

    def _errors(self, part: str) -> Records:
        if part in ("tip", "impulse"):
            return [r for r in statistics.against_reference(self.records, part) if not r["more"]]
        if part == "step":
            return statistics.measured(self.records, part)
        return [
            {"of": setting, "flipped": 1 - row["same_verdict"].value}
            for setting, row in self.decisions("spread").items()
        ]

    def decisions(self, population: str) -> dict[Setting, dict[str, Any]]:
        """Every setting's decisions beside the finest's, over the same particles and trials."""
        truth = self.grasps.get((self.reference, False, population))  # type: ignore[arg-type]
        if truth is None:
            return {}
        return {
            setting: statistics.compare(cost, truth)
            for (setting, moved, name), cost in self.grasps.items()
            if name == population and not moved and setting != self.reference
        }

    def cost(self, engine: str, setting: Setting) -> float | None:
        """Wall seconds of a simulated second of a world."""
        of = Setting(**{**vars(setting), "engine": "structured", "precision": "float32"})
        name = engine if engine == "mujoco" else f"{engine} {setting.precision}"
        found = self.times.get((name, of))
        if found is None and setting.keep_contact:  # refused: drawn where it would have been
            return self.cost(engine, Setting(**{**vars(setting), "keep_contact": False}))
        return None if found is None else found["s_per_simulated_s"]

    def points(self, part: str) -> list[Point]:
        """Settings with error and cost.

        Without contact, and in how the hand closes, all engines solve the same equations: there
        MuJoCo C's error stands for the structured engine's, where that was not measured itself.
        """
        rows, found = self.errors(part), {}
        for r in rows:
            setting = r["of"]
            error = np.nan if statistics.bad(r) else r[ERRORS[part][1]]
            shared = part in ("tip", "impulse") and setting.engine == "mujoco"
            for engine in (setting.engine, *(("structured",) if shared else ())):
                cost, key = self.cost(engine, setting), (engine, setting.label)
                if cost and (key not in found or setting.engine == engine):
                    kind = figures.knob(setting)
                    found[key] = Point(engine, kind, setting.label, cost, error)
        return list(found.values())

    def machine(self) -> str:
        """Where the times come from."""
        timed = [r["run"] for r in self.records if r["part"] == "time"]
        run = self.runs[timed[-1]] if timed else self.runs[-1]
        batch = {
            v["engine"]: v["worlds"]
            for r in statistics.measured(self.records, "time")
            for v in r["engines"].values()
        }
        worlds = ", ".join(f"{e} {n:,} worlds" for e, n in batch.items())
        text = f"{run['device']}, {run['cpu']}, {run['cpus']} cores; JAX {run['jax']}, MuJoCo "
        text += f"{run['mujoco']}; {run['date'][:10]}, commit {(run['commit'] or 'unknown')[:12]}"
        return f"{text}; {worlds}" if worlds else text


def make(docs: Path) -> str:
    """Draws figures, writes CSV and fills in docs/accuracy.md from docs/data.

    Args:
      docs: The folder of the documentation.

    Returns:
      The text between the page's marks.
    """
    parts = []
    for name, title in MACHINES.items():
        files = sorted((docs / "data").glob(f"accuracy_{name}*.json"))
        if files:
            study = Study(files)
            parts.append(_section(study, name, title, docs))
            table(study, docs / "data" / f"accuracy_{name}.csv")
    text = "\n\n".join(parts) or "Not measured yet."
    fill(docs / "accuracy.md", text)
    return text


def _section(study: Study, name: str, title: str, docs: Path) -> str:
    size = "the study's full size" if name == "h200" else "the quick size, see above"
    parts = [f"### {title}", f"{study.machine()}; {size}."]
    panels = {ERRORS[p][0]: study.points(p) for p in ERRORS}
    panels = {k: v for k, v in panels.items() if v}
    if panels:
        figures.diagram(panels, docs / "figures" / f"accuracy_{name}.png", study.machine())
        parts.append(f"![Error against time](figures/accuracy_{name}.png)")
        parts.append("**Error wanted, cheapest setting, cost**\n\n" + markdown(_wanted(study)))
    lines = _lines(study.records)
    if any(lines.values()):
        figures.convergence(lines, docs / "figures" / f"convergence_{name}.png")
        parts.append(f"![Orders of convergence](figures/convergence_{name}.png)")
        parts.append("**The reference and the orders**\n\n" + markdown(_confirmed(study.records)))
    for part in ("tip", "impulse", "step"):
        rows = _errors_table(study, part)
        if len(rows) > 1:
            parts.append(f"**{ERRORS[part][0]}**\n\n" + markdown(rows))
    for population, words in POPULATIONS.items():
        rows = _decisions_table(study, population)
        if len(rows) > 1:
            parts.append(f"**Decisions: {words}**\n\n" + markdown(rows))
    rows = _presets_table(study)
    if len(rows) > 1:
        parts.append("**From preset to preset**\n\n" + markdown(rows))
    floors = _floors(study)
    if len(floors) > 1:
        parts.append("**What chaos and noise alone do**\n\n" + markdown(floors))
    return "\n\n".join(parts)


POPULATIONS = {
    "spread": "particles of every quality",
    "late": "the final particles of one run",
}


def _lines(records: Records) -> dict[str, list[tuple[float, float]]]:
    tips = statistics.against_reference(records, "tip")
    beams = statistics.measured(records, "beam")
    lines = {
        "tip in motion [mm], time step": [
            (r["of"].timestep, r["tip_rms_mm"])
            for r in tips
            if "at the reference's links" in r["more"]
        ],
        "tip in motion [mm]": [
            (1 / r["of"].links, r["tip_rms_mm"])
            for r in tips
            if "at the reference's time step" in r["more"]
        ],
        "impulse, relative, time step": [
            (r["of"].timestep, r["impulse_error"])
            for r in statistics.against_reference(records, "impulse")
            if not r["more"] and r["of"] == Setting("mujoco", timestep=r["of"].timestep)
        ],
    }
    for name in sorted({k for r in beams for k in r if k.startswith(("elastica", "arc"))}):
        lines[f"{name}, tip / length"] = [(1 / r["of"].links, r[name]) for r in beams]
    return lines


def _confirmed(records: Records) -> list[list[str]]:
    rows = [["what", "value"]]
    for part, unit in (("tip", "mm"), ("impulse", "")):
        for r in statistics.against_reference(records, part):
            for role, words in (("timestep", "time step halved"), ("links", "links doubled")):
                if role in r["more"]:
                    value = r[ERRORS[part][1]]
                    what = f"reference moves, {words}: {ERRORS[part][0]}"
                    rows.append([what, f"{value:.2g} {unit}".strip()])
    for name, value in statistics.orders(records).items():
        if value is not None:
            rows.append([f"order of convergence: {name}", f"{value:.2f}"])
    return rows


def _wanted(study: Study) -> list[list[str]]:
    rows = [["error", "wanted below", "engine", "setting", "error there", "µs a step", "cost"]]
    for part, limits in WANTED.items():
        points = study.points(part)
        for engine in dict.fromkeys(p.engine for p in points):
            for limit in limits:
                fits = [p for p in points if p.engine == engine and p.error < limit]
                if not fits:
                    row = [ERRORS[part][0], f"{limit:g}", engine, "none measured", "–", "–", "–"]
                else:
                    p = min(fits, key=lambda p: p.cost)
                    step = float(p.label.split(" ms")[0])
                    row = [ERRORS[part][0], f"{limit:g}", engine, p.label, f"{p.error:.2g}"]
                    row += [f"{1e3 * p.cost * step:.3g}", f"{p.cost:.2e}"]
                rows.append(row)
    return rows


def _number(value: float | None, form: str = ".2g") -> str:
    return "–" if value is None or not np.isfinite(value) else format(value, form)


def _errors_table(study: Study, part: str) -> list[list[str]]:
    heads = {
        "tip": ["tip_rms_mm", "tip_max_mm"],
        "impulse": ["impulse_error", "impulse_max", "grip_error", "touch_error_ms"],
        "step": ["step_median", "step_p99", "step_max", "iterations_max"],
    }
    rows = [["engine", "setting", *(h.replace("_", " ") for h in heads[part]), "cost"]]
    for r in study.errors(part):
        setting = r["of"]
        cost = study.cost(setting.engine, setting)
        if why := statistics.bad(r):
            values = [f"refused: {why.split(':')[-1].strip()}", *[""] * (len(heads[part]) - 1)]
        else:
            values = [_number(r.get(h)) for h in heads[part]]
        rows.append([setting.engine, setting.label, *values, _number(cost, ".2e")])
    return rows


def _interval(value: Interval, form: str = ".1%") -> str:
    if not np.isfinite(value.value):
        return "–"
    return f"{value.value:{form}} [{value.low:{form}}, {value.high:{form}}]"


def _row(first: list[str], c: dict[str, Any]) -> list[str]:
    return [
        *first,
        f"{c['particles']} x {c['trials']}",
        _interval(c["success"]),
        _interval(c["success_reference"]),
        _interval(c["same_verdict"]),
        _interval(c["cost_difference"], "+.3f"),
        _interval(c["rank"], ".3f"),
        f"{c['offspring_moved']:.1%}",
        f"{c['best_shared']:.0%}",
        str(c["failed"]),
    ]


_DECISION = [
    "particles x trials", "success", "the reference's", "same verdict", "mean cost, difference",
    "rank correlation", "offspring moved", "best sixth shared", "failed",
]  # fmt: skip


def _decisions_table(study: Study, population: str) -> list[list[str]]:
    rows = [["engine", "setting", *_DECISION, "cost"]]
    for setting, c in study.decisions(population).items():
        cost = study.cost(setting.engine, setting)
        rows.append([*_row([setting.engine, setting.label], c), _number(cost, ".2e")])
    for r in study.errors("decision"):
        if statistics.bad(r):
            head = [r["of"].engine, r["of"].label, "refused or failed"]
            rows.append([*head, *[""] * len(_DECISION)])
    return rows


def _presets_table(study: Study) -> list[list[str]]:
    """Decisions from preset to preset, the coarser beside the finer."""
    rows = [["presets", "population", *_DECISION]]
    names = list(PRESETS)
    for population in POPULATIONS:
        for a, b in ((0, 1), (1, 2), (0, 2)):
            costs = [study.grasps.get((PRESETS[names[i]], False, population)) for i in (a, b)]
            if costs[0] is not None and costs[1] is not None:
                what = f"{names[a]} against {names[b]}"
                rows.append(_row([what, population], statistics.compare(*costs)))
    return rows


def _floors(study: Study) -> list[list[str]]:
    """Settings against themselves with objects moved, engines against each other, other trials."""
    rows = [["comparison", "population", *_DECISION]]
    for (setting, moved, name), cost in study.grasps.items():
        plain = study.grasps.get((setting, False, name))
        if moved and plain is not None:
            what = f"{setting.engine}, {setting.label}: objects moved by 1 µm"
            rows.append(_row([what, name], statistics.compare(cost, plain)))
        own = Setting(**{**vars(setting), "engine": "structured"})
        same = study.grasps.get((own, False, name))
        if setting.engine == "mujoco" and not moved and same is not None:
            what = f"MuJoCo C against structured, {setting.label}"
            rows.append(_row([what, name], statistics.compare(cost, same)))
    for (setting, moved, name), cost in study.grasps.items():
        noise = statistics.trial_noise(cost)
        if setting == Setting() and not moved and noise is not None:
            what = "structured, standard: six trials against six others"
            values = ["–"] * len(_DECISION)
            values[5] = _interval(noise, ".3f")
            rows.append([what, name, *values])
    return rows


def table(study: Study, path: Path) -> None:
    """Writes every setting's errors and cost as CSV."""
    values: dict[tuple[str, str], dict[str, Any]] = {}
    for part, (_, key) in ERRORS.items():
        for r in study.errors(part):
            setting = r["of"]
            row = values.setdefault((setting.engine, setting.label), {})
            row |= {"engine": setting.engine, "timestep_ms": setting.timestep}
            row |= {n: getattr(setting, n) for n in ("links", "axes", "spheres", "iterations")}
            row |= {"precision": "float64" if setting.engine == "mujoco" else setting.precision}
            row |= {"wall_s_per_simulated_s": study.cost(setting.engine, setting)}
            row |= {"not_measured": statistics.bad(r), key: r.get(key)}
    names = list(dict.fromkeys(k for row in values.values() for k in row))
    with path.open("w", newline="") as file:
        writer = csv.DictWriter(file, ["label", *names], lineterminator="\n")
        writer.writeheader()
        writer.writerows({"label": label, **row} for (_, label), row in values.items())
