"""From committed results to figures and the table of the paper's statements beside ours."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from codesign_jax.report.statistics import Interval, wilson
from codesign_jax.types import WARNINGS
from scripts.experiments import figures, grasp_types
from scripts.experiments.plan import PAPER_GRASPS, TOTAL_GRASPS
from scripts.experiments.results import BITS
from scripts.experiments.study import RULES, Study, joined, load, load_study, regions
from scripts.shared import statistics
from scripts.shared.tables import fill

Loaded = tuple[dict[str, np.ndarray], dict[str, Any]]
"""Arrays and provenance of a landscape, see `study.load`."""

_THRESHOLDS = (0.1, 0.5, 1.0)
_HEAD = "| the paper | here |\n|---|---|"


def make(
    data: Path, pictures: Path, page: Path | None = None, touching: Sequence[Path] = ()
) -> str:
    """Draws the figures of whatever results there are and writes the table.

    Args:
      data: Folder of the results.
      pictures: Folder of the figures.
      page: Markdown page whose text between the marks is replaced; None for none.
      touching: Folders of the experiments with contact between fingers. Those that are complete
        have figures of their own, as has the landscape of the first folder; the first grasp types
        of them go before those of `data`.

    Returns:
      The table in Markdown.
    """
    studies = {name: load_study(data, name) for name in ("2d", "23d")}
    grids = {folder: load(folder, "landscape") for folder in (data, *touching)}
    types = {folder: load(folder, "types") for folder in grids}
    grid = grids[data]
    others = [found for folder in touching if (found := grids[folder])]
    text = "\n\n".join([comparison(studies, grid), *(details(s) for s in studies.values() if s)])
    for name, study in studies.items():
        found = [load_study(folder, name) for folder in touching]
        if study:
            _draw(name, study, pictures, "")
            for other in joined([s for s in found if s], study.strategies):
                text += f"\n\n{with_fingers(study, other)}"
                if other.tested and other.strategies == study.strategies:
                    _draw(name, other, pictures, "_fingers")
    if grid and others:
        text += f"\n\n{landscapes(grid, others)}"
    _draw_landscape(grid, types[data], pictures / "fig8_landscape.png")
    for folder in touching[:1]:
        _draw_landscape(grids[folder], types[folder], pictures / "fig8_landscape_fingers.png")
    if page:
        fill(page, text, "results")
    for folder in (*touching, data):
        shown, found = grids[folder], types[folder]
        if not (shown and found):
            continue
        table = grasp_types.describe(shown[0], found[0])
        if page:
            fill(page, table, "types")
        text += f"\n\n{table}"
        break
    return text


def _draw(name: str, study: Study, pictures: Path, suffix: str) -> None:
    """Draws the figures of an experiment on strategies."""
    if name == "2d":
        figures.evolution(study, pictures / f"fig6_cost_evolution{suffix}.png")
    number = {"2d": 7, "23d": 9}[name]
    figures.success(study, pictures / f"fig{number}a_success{suffix}.png")
    figures.convergence(study, pictures / f"fig{number}b_convergence{suffix}.png")


def _draw_landscape(grid: Loaded | None, types: Loaded | None, path: Path) -> None:
    """Draws a landscape, if there is one, with its grasp types, if they were found."""
    if grid:
        figures.landscape(grid[0], path, types=types[0]["type"] if types else None)


def landscapes(plain: Loaded, touching: Sequence[Loaded]) -> str:
    """The landscape without contact between fingers beside those with it, as a Markdown table."""
    lines = [
        "| landscape | trials a design | regions | correlation with the first |",
        "|---|---|---|---|",
    ]
    for k, grid in enumerate((plain, *touching)):
        data, notes = grid
        how = "with contact between fingers" if k else "without contact between fingers"
        trials = notes["grasps"] // data["exclude"].size  # fewer than planned if it was stopped
        alike = np.corrcoef(data["exclude"].ravel(), plain[0]["exclude"].ravel())[0, 1]
        cells = f"{how}, commit {notes['commit']}", str(trials), _regions(grid), f"{alike:.3f}"
        lines.append(f"| {' | '.join(cells)} |")
    return "\n".join(lines)


def comparison(studies: dict[str, Study | None], grid) -> str:
    """The paper's statements beside ours, as a Markdown table."""
    rows = [_grasps_row(studies, grid)]
    for name, study in studies.items():
        rows += _rows(name, study) if study else [(f"{name} experiment", "not run")]
    if all(studies.values()):
        rows.append(_growth_row(studies["2d"], studies["23d"]))  # type: ignore[arg-type]
    rows.append(("two separate regions of success (Fig. 8)", _regions(grid) if grid else "not run"))
    return "\n".join([_HEAD, *(f"| {a} | {b} |" for a, b in rows)])


def details(study: Study) -> str:
    """One line a strategy: success by both rules, convergence by both readings, failed trials."""
    name = study.plan["name"]
    lines = [
        f"{name}: {study.plan['runs']} runs a strategy; intervals of 95 %",
        "",
        "| strategy | success | failed trials at the maximum | mean cost stays below 1 "
        "| simulations until then: median [quartiles] | until it first is below 1 | failed trials "
        "| trials in which the solver met its limit |",
        "|---|---|---|---|---|---|---|---|",
    ]
    episodes, first = study.convergence(), study.first_below()
    good, strict = study.success(), study.success("worst")
    status = study.data["failed"].sum((1, 2))
    warning = np.array([bit in WARNINGS for bit in BITS])
    failed, capped = status[:, ~warning].sum(1), status[:, warning].sum(1)
    trials = study.per_episode * study.plan["runs"] * study.episodes
    for s, strategy in enumerate(study.strategies):
        cells = [
            figures.label(strategy),
            *(_percent(wilson(int(v[s].sum()), v[s].size)) for v in (good, strict)),
            f"{int(np.isfinite(episodes[s]).sum())}/{episodes.shape[1]}",
            *(_quartiles(v[s] * study.per_episode) for v in (episodes, first)),
            f"{100 * failed[s] / trials:.2f} %",
            f"{100 * capped[s] / trials:.1f} %",
        ]
        lines.append(f"| {' | '.join(cells)} |")
    return "\n".join([*lines, "", *_against_last(study)] if len(study.strategies) > 1 else lines)


def _against_last(study: Study) -> list[str]:
    """Every strategy against the last one, by tests that use the pairing of the runs or do not.

    Runs of one number share seed particle and noise, so they are pairs; the tests that ignore it
    show how much hangs on that.
    """
    episodes, good = study.convergence(), study.success()
    limit, others = study.episodes, range(len(study.strategies) - 1)
    tests = (
        [statistics.mcnemar(good[s], good[-1]) for s in others],
        [statistics.fisher(good[s], good[-1]) for s in others],
        [statistics.wilcoxon(episodes[s], episodes[-1], limit) for s in others],
        [statistics.mann_whitney(episodes[s], episodes[-1]) for s in others],
    )
    columns = [statistics.holm(p) for p in tests]
    many = f", adjusted by Holm's method for the {len(others)} comparisons of a column"
    lines = [
        f"{study.plan['name']}: p of a difference to {study.strategies[-1]}"
        f"{many if len(others) > 1 else ''}",
        "",
        "| strategy | success, paired (McNemar) | unpaired (Fisher) "
        "| convergence, paired (Wilcoxon) | unpaired (Mann-Whitney) |",
        "|---|---|---|---|---|",
    ]
    for s in others:
        cells = [figures.label(study.strategies[s]), *(_p(float(c[s])) for c in columns)]
        lines.append(f"| {' | '.join(cells)} |")
    return lines


def with_fingers(plain: Study, touching: Study) -> str:
    """Experiments without and with contact between fingers, over the episodes that both have.

    Of one that is complete also what `details` tells.
    """
    count = min(plain.episodes, touching.episodes)
    lines = [
        f"{plain.plan['name']}, the first {count} episodes "
        f"({count * plain.per_episode:,} simulations), contact between fingers by commit "
        f"{touching.notes.get('commit')}: mean cost stays below 1",
        "",
        "| strategy | without contact between fingers | median simulations [quartiles] "
        "| with it | median simulations [quartiles] |",
        "|---|---|---|---|---|",
    ]
    both = [
        (v.per_episode, dict(zip(v.strategies, v.convergence(episodes=count), strict=True)))
        for v in (plain, touching)
    ]
    for strategy in touching.strategies:
        cells = [figures.label(strategy)]
        for per_episode, episodes in both:
            each = episodes[strategy]
            cells += [f"{int(np.isfinite(each).sum())}/{each.size}"]
            cells += [_quartiles(each * per_episode)]
        lines.append(f"| {' | '.join(cells)} |")
    if not touching.tested:
        return "\n".join(lines)
    if touching.strategies[-1] == plain.strategies[-1]:  # the paper's statements are of that one
        rows = [f"| {a} | {b} |" for a, b in _rows(plain.plan["name"], touching)]
        lines += ["", _HEAD.replace("here", "here, with contact between fingers"), *rows]
    return "\n".join([*lines, "", f"With contact between fingers, {details(touching)}"])


def _quartiles(values: np.ndarray) -> str:
    middle, low, high = (_number(float(statistics.quantile(values, q))) for q in (0.5, 0.25, 0.75))
    return f"{middle} [{low}, {high}]"


def _rows(name: str, study: Study) -> list[tuple[str, str]]:
    paper = {"2d": 420, "23d": 6120}[name]
    success, episodes = study.success(), study.convergence()
    ratios = ", ".join(
        f"{figures.label(s)} {100 * r.mean():.0f} %"
        for s, r in zip(study.strategies, success, strict=True)
    )
    finite = np.minimum(episodes, study.plan["episodes"] + 1)
    medians = ", ".join(
        f"{figures.label(s)} {_number(float(statistics.quantile(e, 0.5)))}"
        for s, e in zip(study.strategies, episodes, strict=True)
    )
    both = [statistics.median(study.convergence(r)[-1] * study.per_episode) for r in RULES]
    converged = (
        f"{name}: {paper} simulations to convergence (concurrent)",
        f"{_interval(both[0])}; failed trials at the maximum: {_interval(both[1])}",
    )
    if len(study.strategies) < 3:  # a trend needs three
        return [converged]
    return [
        (
            f"{name}: success grows with more switching, concurrent best",
            f"{ratios}; Page's trend test p {_p(statistics.trend(1.0 * success))}",
        ),
        (
            f"{name}: convergence quickens with more switching, concurrent fastest",
            f"median episodes: {medians}; Page's trend test p {_p(statistics.trend(-finite))}",
        ),
        converged,
    ]


def _growth_row(two: Study, many: Study) -> tuple[str, str]:
    parameters = len(many.data["parameters"]) / len(two.data["parameters"])
    growth = statistics.ratio_of_medians(
        many.convergence()[-1] * many.per_episode, two.convergence()[-1] * two.per_episode
    )
    text = "not defined" if np.isnan(growth.value) else _interval(growth, 3)
    return (
        "2 to 23 parameters: 11.5 times the parameters, 14.6 times the simulations",
        f"{parameters:.1f} times the parameters, {text} times the simulations",
    )


def _grasps_row(studies: dict[str, Study | None], grid) -> tuple[str, str]:
    notes = {name: s.notes for name, s in studies.items() if s}
    notes |= {"landscape": grid[1]} if grid else {}
    counts = ", ".join(f"{name} {n['grasps']:,}" for name, n in notes.items())
    total = sum(n["grasps"] for n in notes.values())
    minutes = sum(n["wall_seconds"] for n in notes.values()) / 60
    paper = ", ".join(f"{name} {count:,}" for name, count in PAPER_GRASPS.items())
    return (
        f"grasps: {paper}; {TOTAL_GRASPS:,} in all",
        f"{counts or 'none'}; {total:,} in all, in {minutes:.1f} minutes",
    )


def _regions(grid) -> str:
    parts = []
    for threshold in _THRESHOLDS:
        found = regions(grid[0], threshold)
        shares = ", ".join(f"{100 * r.share:.1f} %" for r in found)
        parts.append(f"cost < {threshold:g}: {len(found)}" + (f" ({shares})" if found else ""))
    units, names = grid[0]["units"], grid[0]["parameters"]
    found = regions(grid[0], figures.LANDSCAPE_THRESHOLD)
    for letter, region in zip("abcdefgh", found, strict=False):
        ends = ", ".join(
            f"{names[i]} {region.low[i]:.0f} to {region.high[i]:.0f} {units[i]}" for i in (0, 1)
        )
        parts.append(f"({letter}) {ends}")
    return "; ".join(parts)


def _percent(rate: Interval) -> str:
    return f"{100 * rate.value:.0f} % [{100 * rate.low:.0f}, {100 * rate.high:.0f}]"


def _interval(value: Interval, digits: int = 10) -> str:
    middle, low, high = (_number(v, digits) for v in value)
    return f"{middle} [{low}, {high}]"


def _number(value: float, digits: int = 10) -> str:
    return "never" if np.isposinf(value) else f"{value:,.{digits}g}"


def _p(value: float) -> str:
    return "< 0.001" if value < 1e-3 else f"= {value:.3f}"
