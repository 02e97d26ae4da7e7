"""From committed records to figures, tables and CSV."""

from pathlib import Path
from typing import Any

from scripts.accuracy import analysis, figures, presets, tables
from scripts.accuracy.results import ERRORS, Study
from scripts.shared import output
from scripts.shared.tables import fill, markdown

MACHINES = {"h200": "NVIDIA H200 and CPU cores of its host", "cpu": "2 CPU cores"}
SHORT = {"h200": "one H200", "cpu": "2 CPU cores"}


def studies(docs: Path) -> dict[str, Study]:
    """The studies that docs/data holds, by the machine's name."""
    files = {n: sorted((docs / "data").glob(f"accuracy_{n}*.json")) for n in MACHINES}
    return {n: Study(found) for n, found in files.items() if found}


def make(docs: Path, found: dict[str, Study] | None = None) -> str:
    """Draws figures, writes CSV and fills in docs/notes/accuracy.md from docs/data.

    Args:
      docs: The folder of the documentation.
      found: See `studies`, if they were read already.

    Returns:
      The text between the page's marks.
    """
    found = studies(docs) if found is None else found
    parts = []
    for name, study in found.items():
        parts.append(_section(study, name, docs))
        table(study, docs / "data" / f"accuracy_{name}.csv")
    text = "\n\n".join(parts) or "Not measured yet."
    fill(docs / "notes" / "accuracy.md", text, "results")
    return text


def make_summary(note: Path, scenes: Path, found: dict[str, Study]) -> None:
    """Fills in the tables of the presets and of the errors wanted, and the comments of their files.

    Args:
      note: The note of the study.
      scenes: Folder of the presets.
      found: See `studies`; the full size comes first.
    """
    named = {SHORT[n]: study for n, study in found.items()}
    full, *rest = named.values()
    fill(note, markdown(tables.wanted_here(full, rest[0] if rest else None)), "wanted")
    text = "\n\n".join(markdown(t) for t in (presets.presets_table(named), presets.standing(full)))
    fill(note, text, "presets")
    presets.annotate(scenes, named)


def _section(study: Study, name: str, docs: Path) -> str:
    size = "the study's full size" if name == "h200" else "the quick size, see above"
    parts = [f"### {MACHINES[name]}", f"{study.machine()}; {size}."]

    def add(title: str, rows: list[list[str]]) -> None:
        if len(rows) > 1:
            parts.append(f"**{title}**\n\n" + markdown(rows))

    panels = {ERRORS[p][0]: study.points(p) for p in ERRORS}
    panels = {k: v for k, v in panels.items() if v}
    if panels:
        figures.diagram(panels, docs / "figures" / f"accuracy_{name}.png", study.machine())
        parts.append(f"![Error against time](../figures/accuracy_{name}.png)")
        add("Error wanted, cheapest setting, cost", tables.wanted(study))
    lines = tables.lines(study.records)
    if any(lines.values()):
        figures.convergence(lines, docs / "figures" / f"convergence_{name}.png")
        parts.append(f"![Orders of convergence](../figures/convergence_{name}.png)")
        add("The reference and the orders", tables.confirmed(study.records))
    for part in ("tip", "impulse"):
        add(ERRORS[part][0], tables.errors_table(study, part))
    for population, words in tables.POPULATIONS.items():
        add(f"Decisions: {words}", tables.decisions_table(study, population))
    add("From preset to preset", tables.preset_to_preset(study))
    add("Each knob alone, against its own limit", tables.alone(study))
    add("The winner's curse: the best by a coarse setting, tested again", tables.curse(study))
    add("What a micrometre and other trials do", tables.floors(study))
    add("Trials that failed or met the solver's limit", tables.warnings(study))
    return "\n\n".join(parts)


def table(study: Study, path: Path) -> None:
    """Writes every setting's errors and cost as CSV."""
    values: dict[tuple[str, str], dict[str, Any]] = {}
    for part, (_, key) in ERRORS.items():
        for r in study.errors(part):
            setting = r["of"]
            row = values.setdefault((setting.engine, setting.label), {})
            row |= {"engine": setting.engine, "timestep_ms": setting.timestep}
            row |= {
                n: getattr(setting, n)
                for n in ("links", "axes", "surface", "damping", "iterations")
            }
            row |= {"precision": "float64" if setting.engine == "mujoco" else setting.precision}
            row |= {"wall_s_per_simulated_s": study.cost(setting.engine, setting)}
            row |= {"not_measured": analysis.bad(r), key: r.get(key)}
    names = list(dict.fromkeys(k for row in values.values() for k in row))
    rows = ({"label": label, **row} for (_, label), row in values.items())
    output.write_csv(path, ["label", *names], rows)
