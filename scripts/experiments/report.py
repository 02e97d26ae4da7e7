"""The page of committed results (Sec. VI.3): tables beside the paper's statements, and figures."""

from pathlib import Path

import numpy as np

from codesign_jax.statistics import Interval, wilson
from codesign_jax.types import WARNINGS
from scripts.experiments import pictures
from scripts.experiments.results import (
    LANDSCAPE_THRESHOLD,
    LAWS,
    RULES,
    SMALLEST,
    Results,
    Study,
    read,
    regions,
)
from scripts.experiments.simulate import BITS, PAPER_GRASPS, TOTAL_GRASPS
from scripts.shared import output, statistics
from scripts.shared.output import fill

_THRESHOLDS = (0.1, 0.5, 1.0)


def make(data: Path, folder: Path, page: Path | None = None) -> str:
    """Draws the figures of whatever results there are and writes the table.

    Returns:
      The table in Markdown.
    """
    results = read(data)
    text = tables(results)
    for law, (studies, _) in results.items():
        for study in studies.values():
            if study and len(study.strategies) > 1:
                _draw(study, folder, f"_{law}" if LAWS[law] else "")
    if page:
        fill(page, text, "results")
    if grids := {law: r.grid[0] for law, r in results.items() if r.grid}:
        pictures.draw_landscapes(grids, folder / "fig8_landscape.png")
    return text


def _draw(study: Study, folder: Path, law: str) -> None:
    """Draws an experiment's figures; `law` ends their names."""
    name = study.plan["name"]
    if name == "2d" and not law:
        pictures.draw_evolution(study, folder / "fig6_cost_evolution.png")
    number = {"2d": 7, "23d": 9}[name]
    if study.tested:
        pictures.draw_success(study, folder / f"fig{number}a_success{law}.png")
    pictures.draw_convergence(study, folder / f"fig{number}b_convergence{law}.png")


def tables(results: dict[str, Results]) -> str:
    """All tables of the page, in Markdown."""
    named = [(law, study) for law, r in results.items() for study in r.studies.values() if study]
    parts = [f"**Law `{law}`.** {details(study)}" for law, study in named]
    return "\n\n".join([comparison(results), *parts])


def comparison(results: dict[str, Results]) -> str:
    """The paper's statements beside ours, a column for each law, as a Markdown table."""
    columns = [dict(_statements(*r)) for r in results.values()]
    rows = [["the paper", *(f"here, law `{law}`" for law in results)]]
    for statement in columns[0]:
        rows.append([statement, *(column.get(statement, "not run") for column in columns)])
    return output.markdown(rows)


def _statements(studies: dict[str, Study | None], grid) -> list[tuple[str, str]]:
    """The paper's statements with what was found here."""
    rows = [_grasps_row(studies, grid)]
    for name, study in studies.items():
        rows += _rows(name, study) if study else [(f"{name} experiment", "not run")]
    if all(studies.values()):
        rows.append(_growth_row(studies["2d"], studies["23d"]))  # type: ignore[arg-type]
    rows.append(("two separate regions of success (Fig. 8)", _regions(grid) if grid else "not run"))
    return rows


def details(study: Study) -> str:
    """One line a strategy: success by both rules, convergence by both readings, failed trials."""
    name = study.plan["name"]
    lines = [
        f"{name}: {study.plan['runs']} runs a strategy, {study.episodes} of "
        f"{study.plan['episodes']} episodes; intervals of 95 %",
        "",
        "| strategy | success | success with failed trials at the maximum cost "
        "| mean cost stays below 1 "
        "| simulations until then: median [quartiles] | until it first is below 1 | failed trials "
        "| trials in which the solver met its limit |",
        "|---|---|---|---|---|---|---|---|",
    ]
    episodes = study.convergence()
    first = study.first_below()
    good = study.success()
    strict = study.success("worst")
    status = study.data["failed"].sum((1, 2))
    warning = np.array([bit in WARNINGS for bit in BITS])
    failed = status[:, ~warning].sum(1)
    capped = status[:, warning].sum(1)
    trials = study.per_episode * study.plan["runs"] * study.episodes
    for s, strategy in enumerate(study.strategies):
        cells = [
            strategy,
            *(
                _percent(wilson(int(v[s].sum()), v[s].size)) if study.tested else "not tested"
                for v in (good, strict)
            ),
            f"{int(np.isfinite(episodes[s]).sum())}/{episodes.shape[1]}",
            *(_quartiles(v[s] * study.per_episode) for v in (episodes, first)),
            f"{100 * failed[s] / trials:.2f} %",
            f"{100 * capped[s] / trials:.1f} %",
        ]
        lines.append(f"| {' | '.join(cells)} |")
    return "\n".join([*lines, "", *_against_last(study)] if len(study.strategies) > 1 else lines)


def _against_last(study: Study) -> list[str]:
    """Every strategy against the last one; runs of one number share seed and noise: pairs."""
    episodes = study.convergence()
    good = study.success()
    limit = study.episodes
    others = range(len(study.strategies) - 1)
    columns = [
        statistics.holm([statistics.mcnemar(good[s], good[-1]) for s in others]),
        statistics.holm([statistics.wilcoxon(episodes[s], episodes[-1], limit) for s in others]),
    ]
    many = f", adjusted by Holm's method for the {len(others)} comparisons of a column"
    lines = [
        f"{study.plan['name']}: p of a difference to {study.strategies[-1]}"
        f"{many if len(others) > 1 else ''}",
        "",
        "| strategy | success, paired (McNemar) | convergence, paired (Wilcoxon) |",
        "|---|---|---|",
    ]
    for s in others:
        cells = [study.strategies[s], *(_p(float(c[s])) for c in columns)]
        cells[1] = cells[1] if study.tested else "–"
        lines.append(f"| {' | '.join(cells)} |")
    return lines


def _quartiles(values: np.ndarray) -> str:
    middle, low, high = (_number(float(statistics.quantile(values, q))) for q in (0.5, 0.25, 0.75))
    return f"{middle} [{low}, {high}]"


def _rows(name: str, study: Study) -> list[tuple[str, str]]:
    paper = {"2d": 420, "23d": 6120}[name]
    success = study.success()
    episodes = study.convergence()
    ratios = ", ".join(
        f"{s} {100 * r.mean():.0f} %" for s, r in zip(study.strategies, success, strict=True)
    )
    ratios += f"; Page's trend test p {_p(statistics.trend(1.0 * success))}"
    if len(success) > 4:
        ratios += f", from two switches on p {_p(statistics.trend(1.0 * success[2:]))}"
    ratios = ratios if study.tested else "not tested: the runs have not ended"
    finite = np.minimum(episodes, study.plan["episodes"] + 1)
    medians = ", ".join(
        f"{s} {_number(float(statistics.quantile(e, 0.5)))}"
        for s, e in zip(study.strategies, episodes, strict=True)
    )
    both = [statistics.median(study.convergence(r)[-1] * study.per_episode) for r in RULES]
    converged = (
        f"{name}: {paper} simulations to convergence (concurrent)",
        f"median {_interval(both[0])}, mean {_interval(mean(episodes[-1] * study.per_episode))}; "
        f"failed trials at the maximum: median {_interval(both[1])}",
    )
    if len(study.strategies) < 3:  # a trend needs three
        return [converged]
    return [
        (
            f"{name}: success grows with more switching, concurrent best",
            ratios,
        ),
        (
            f"{name}: convergence quickens with more switching, concurrent fastest",
            f"median episodes: {medians}; Page's trend test p {_p(statistics.trend(-finite))}",
        ),
        converged,
    ]


def mean(simulations: np.ndarray) -> Interval:
    """Mean with its interval; without end where a run never converged."""
    if not np.isfinite(simulations).all():
        return Interval(np.inf, np.inf, np.inf)
    interval = statistics.bootstrap(lambda k: simulations[k].mean(-1), len(simulations))
    return Interval(*(round(v) for v in interval))


def _growth_row(two: Study, many: Study) -> tuple[str, str]:
    parameters = len(many.data["parameters"]) / len(two.data["parameters"])
    a, b = (s.convergence()[-1] * s.per_episode for s in (many, two))
    growth = statistics.ratio_of_medians(a, b)
    text = "not defined" if np.isnan(growth.value) else f"{_interval(growth, 3)} times by medians"
    if np.isfinite(a).all() and np.isfinite(b).all():
        # Of all pairs of resamples, as the runs of the two experiments are independent.
        rng = np.random.default_rng(0)
        drawn = [v[rng.integers(0, len(v), (statistics.RESAMPLES, len(v)))].mean(1) for v in (a, b)]
        low, high = np.quantile(drawn[0] / drawn[1], [0.025, 0.975])
        text += f", {_interval(Interval(a.mean() / b.mean(), low, high), 3)} by means"
    return (
        "2 to 23 parameters: 11.5 times the parameters, 14.6 times the simulations",
        f"{parameters:.1f} times the parameters, the simulations {text}",
    )


def _grasps_row(studies: dict[str, Study | None], grid) -> tuple[str, str]:
    notes = {name: s.notes for name, s in studies.items() if s}
    notes |= {"landscape": grid[1]} if grid else {}
    counts = ", ".join(f"{name} {n['grasps']:,}" for name, n in notes.items())
    total = sum(n["grasps"] for n in notes.values())
    paper = ", ".join(f"{name} {count:,}" for name, count in PAPER_GRASPS.items())
    return (
        f"grasps: {paper}; {TOTAL_GRASPS:,} in all",
        f"{counts or 'none'}; {total:,} in all",
    )


def _regions(grid) -> str:
    parts = [f"regions of at least {100 * SMALLEST:.1f} % of the landscape"]
    for threshold in _THRESHOLDS:
        components = regions(grid[0], threshold)
        shares = " and ".join(f"{100 * r.share:.1f} %" for r in components)
        word = "region" if len(components) == 1 else "regions"
        parts.append(
            f"cost < {threshold:g}: {len(components)} {word}"
            + (f" ({shares} of the landscape)" if components else "")
        )
    units = grid[0]["units"]
    names = grid[0]["parameters"]
    components = regions(grid[0], LANDSCAPE_THRESHOLD)
    for letter, region in zip("abcdefgh", components, strict=False):
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
