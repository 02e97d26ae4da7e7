"""The presets' errors and costs: tables, their place on the fronts, comments of their files."""

import re
from pathlib import Path

import numpy as np

from scripts.accuracy.results import ERRORS, Study
from scripts.accuracy.settings import PRESETS, Setting
from scripts.accuracy.tables import COST, cost_cells

_COMMENT = "# measured: "


def presets_table(studies: dict[str, Study]) -> list[list[str]]:
    """Errors of the first study and costs of all, by machine; the structured engine."""
    full = next(iter(studies.values()))
    costs = [f"{title}: {c}" if i == 0 else c for title in studies for i, c in enumerate(COST)]
    parts = [part for part in ERRORS if full.errors(part)]
    rows = [["preset", "setting", *(ERRORS[part][0] for part in parts), *costs]]
    for name, setting in PRESETS.items():
        errors = [full.error(part, setting) for part in parts]
        cells = ["–" if e is None else f"{e:.3g}" for e in errors]
        for study in studies.values():
            cells += cost_cells(study.cost("structured", setting))
        rows.append([f"`{name}`", setting.label, *cells])
    return rows


WITHOUT = "without contact between fingers"
"""What the study leaves out of the default scene."""


def standing(study: Study) -> list[list[str]]:
    """Whether the presets are on the Pareto fronts, and what beats those that are not."""
    rows = [["preset", *(ERRORS[p][0] for p in ERRORS), "in all three at once"]]
    for name, setting in PRESETS.items():
        cells = [_standing(study, setting, part) for part in ERRORS]
        every = study.beaten_by(setting, *ERRORS)
        cells.append(", ".join(s.label for s in every) or "nothing is cheaper and better")
        rows.append([f"`{name}`", *cells])
    return rows


def _standing(study: Study, setting: Setting, part: str) -> str:
    cost, error = study.cost(setting.engine, setting), study.error(part, setting)
    if not cost or not error:
        return "not measured"

    def change(other: Setting) -> tuple[float, float]:
        now = study.cost(other.engine, other), study.error(part, other)
        return (now[1] or np.nan) / error - 1, (now[0] or np.nan) / cost - 1

    drawn = {p.label for p in study.points(part) if p.engine == setting.engine}
    better = [s for s in study.beaten_by(setting, part) if s.label in drawn]
    if not better:
        return "on the front"
    (less_error, less_cost), label = min((change(s), s.label) for s in better)
    return f"beaten by {label} (cost {less_cost:+.0%}, error {less_error:+.0%})"


def comment(name: str, studies: dict[str, Study]) -> str:
    """What was measured of a preset, as comment lines of its file."""
    setting, full = PRESETS[name], next(iter(studies.values()))
    form = {"tip": "finger tip {:.3g} mm"}
    form |= {"impulse": "contact impulse {:.1%}", "decision": "verdicts that flip {:.1%}"}
    errors = {part: full.error(part, setting) for part in form}
    words = [form[part].format(e) for part, e in errors.items() if e is not None]
    costs = []
    for machine, study in studies.items():
        if cost := study.cost("structured", setting):
            seconds, rate = cost_cells(cost)
            costs.append(f"{seconds} on {machine} ({rate} grasps/s)")
    lines = [", ".join(words) + f" ({WITHOUT})"]
    if costs:
        lines.append("wall s / simulated s: " + ", ".join(costs) + f" ({WITHOUT})")
    return "".join(f"{_COMMENT}{line}\n" for line in lines)


def annotate(folder: Path, studies: dict[str, Study]) -> None:
    """Puts what was measured into the presets' files, instead of what an earlier study found.

    Args:
      folder: Folder with a .toml file for each preset.
      studies: The studies by the machine's name, the one with the errors first.
    """
    for name in PRESETS:
        path = folder / f"{name}.toml"
        kept = re.sub(f"^{_COMMENT}.*\n", "", path.read_text(), flags=re.MULTILINE)
        path.write_text(comment(name, studies) + kept)
