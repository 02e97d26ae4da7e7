"""Success, convergence and regions of committed results (Sec. VI.3): figures 6 to 9 and tables."""

import dataclasses
import json
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import QuadMesh
from scipy import ndimage

from codesign_jax.codesign import CONVERGED_COST, SUCCESS_COST, convergence_episode
from codesign_jax.report import figures
from codesign_jax.statistics import Interval, wilson
from codesign_jax.types import WARNINGS
from scripts.experiments.simulate import BITS, PAPER_GRASPS, TOTAL_GRASPS
from scripts.shared import output, statistics
from scripts.shared.output import fill

RULES = ("exclude", "worst")
"""Rules for failed trials under which results are evaluated; see `cost.particle_cost`."""


@dataclasses.dataclass(frozen=True)
class Study:
    """The committed results of an experiment on strategies.

    Attributes:
      plan: Sizes; see `simulate.Strategies`.
      notes: Provenance.
      data: Arrays; see `simulate.of_strategies`.
    """

    plan: dict[str, Any]
    notes: dict[str, Any]
    data: dict[str, np.ndarray]

    @property
    def strategies(self) -> list[str]:
        return [str(s) for s in self.data["strategies"]]

    @property
    def per_episode(self) -> int:
        return self.plan["particles"] * self.plan["trials"]

    @property
    def tested(self) -> bool:
        """Whether the final test was made; an experiment that was stopped before has none."""
        return not np.isnan(self.data["test_exclude"]).all()

    @property
    def episodes(self) -> int:
        return self.data["mean"].shape[-1]

    def success(self, rule: str = "exclude") -> np.ndarray:
        """Whether any final particle's mean test cost is below 0.01, bool, (strategy, run)."""
        return np.any(self.data[f"test_{rule}"] < SUCCESS_COST, axis=-1)

    def convergence(self, rule: str = "exclude") -> np.ndarray:
        """Episodes simulated when the mean cost is below 1.0 for good, (strategy, run).

        The episode that converged is counted; infinite where a run did not converge.
        """

        def count(means: np.ndarray) -> float:
            episode = convergence_episode(means)
            return np.inf if episode is None else episode + 1.0

        return np.apply_along_axis(count, -1, self.data[f"mean_{rule}"])

    def first_below(self, rule: str = "exclude") -> np.ndarray:
        """Episodes simulated when the mean cost is below 1.0 for the first time, (strategy, run).

        The paper's "converged" may be read so as well; infinite where a run never got there.
        """
        below = self.data[f"mean_{rule}"] < CONVERGED_COST
        return np.where(below.any(-1), below.argmax(-1) + 1.0, np.inf)


def load(folder: Path, name: str) -> tuple[dict[str, np.ndarray], dict[str, Any]] | None:
    """Reads NAME.npz and NAME.json of a folder; None where there are none."""
    path = folder / f"{name}.npz"
    if not path.exists():
        return None
    with np.load(path, allow_pickle=False) as file:
        data = {key: file[key] for key in file.files}
    return data, json.loads((folder / f"{name}.json").read_text())


def load_study(folder: Path, name: str) -> Study | None:
    """Reads an experiment on strategies; None where its files are missing."""
    loaded = load(folder, name)
    if loaded is None:
        return None
    data, notes = loaded
    return Study(notes["settings"]["plan"], notes, data)


class Results(NamedTuple):
    """The experiments by one law of the fingers' section.

    Attributes:
      studies: Experiments on strategies by name, None where one was not made.
      grid: Arrays and notes of the landscape; None likewise.
    """

    studies: dict[str, Study | None]
    grid: tuple[dict[str, np.ndarray], dict[str, Any]] | None


LAWS = {"chamber": "", "elements": "elements"}
"""Laws of the section, and the folders of their results."""


def read(data: Path) -> dict[str, Results]:
    """Results by each law that a folder has some of."""
    folders = {law: data / folder for law, folder in LAWS.items()}
    every = {
        law: Results({n: load_study(folder, n) for n in ("2d", "23d")}, load(folder, "landscape"))
        for law, folder in folders.items()
    }
    return {law: r for law, r in every.items() if any(r.studies.values()) or r.grid}


class Region(NamedTuple):
    """A connected region of the landscape.

    Attributes:
      share: Its part of the grid's points.
      centre: Mean of its points in the parameters' units, shape (2,).
      low: Lower ends, shape (2,).
      high: Upper ends, shape (2,).
      mean: Mean cost in it.
      points: Its points, bool, shape (point, point).
    """

    share: float
    centre: np.ndarray
    low: np.ndarray
    high: np.ndarray
    mean: float
    points: np.ndarray


SMALLEST = 0.005
"""Least share of the landscape that is called a region; smaller parts come and go with trials."""


def regions(
    data: dict[str, np.ndarray], threshold: float, rule: str = "exclude", smallest: float = SMALLEST
) -> list[Region]:
    """Connected components with cost below a threshold, largest first; points meet at edges.

    Components below `smallest` are left out.
    """
    cost = data[rule]
    labels, count = ndimage.label(cost < threshold)  # type: ignore[misc]
    axes = np.meshgrid(data["first_axis"], data["second_axis"], indexing="ij")
    parts = []
    for label in range(1, count + 1):
        points = labels == label
        where = np.stack([a[points] for a in axes])
        mean = float(cost[points].mean())
        parts.append(
            Region(float(points.mean()), where.mean(1), where.min(1), where.max(1), mean, points)
        )
    return sorted((r for r in parts if r.share >= smallest), key=lambda r: -r.share)


# --- figures --------------------------------------------------------------------------------------

LABELS = {"single": "s.d.", "concurrent": "conc."}
_COLORS = {"exclude": "tab:blue", "worst": "tab:orange"}
_RULE_LABELS = {"exclude": "failed trials excluded", "worst": "failed trials cost the maximum"}

COST_MAXIMUM = 3.0
"""Cost of a grasp that never holds the object (Sec. IV.3): the dark end of the landscape."""
LANDSCAPE_THRESHOLD = CONVERGED_COST
"""Cost below which a point of the landscape belongs to a region."""


def label(strategy: str) -> str:
    """The paper's name of a strategy: s.d., the number of switches, or conc."""
    return LABELS.get(strategy, strategy.removeprefix("switch-"))


def typical_run(study: Study) -> int:
    """Run of the last strategy whose convergence is the median one."""
    episodes = study.convergence()[-1]
    return int(np.argsort(episodes, kind="stable")[(len(episodes) - 1) // 2])


def draw_evolution(study: Study, path: Path) -> Path:
    """Draws Fig. 6: the particle costs of the run that converges at the median speed."""
    run = typical_run(study)
    title = f"{study.strategies[-1]}, run {run} of {study.plan['runs']}"
    costs = study.data["particle_cost"][run].astype(float)
    path.parent.mkdir(parents=True, exist_ok=True)
    return figures.save(figures.cost_evolution(costs, title=title), path)


def draw_success(study: Study, path: Path) -> Path:
    """Draws Figs. 7a and 9a: the ratio of successful runs with Wilson's 95 % intervals."""
    figure, axes = _axes()
    for offset, rule in zip((-0.18, 0.18), RULES, strict=True):
        rates = [wilson(int(s.sum()), s.size) for s in study.success(rule)]
        value, low, high = np.array(rates).T
        at = np.arange(len(rates)) + offset
        axes.bar(at, value, 0.36, color=_COLORS[rule], alpha=0.75, label=_RULE_LABELS[rule])
        axes.errorbar(at, value, [value - low, high - value], fmt="none", color="black", capsize=3)
    axes.set(ylabel="ratio of successful runs", ylim=(0, 1.2), yticks=np.linspace(0, 1, 6))
    _strategies(axes, study)
    axes.legend(frameon=False, fontsize=8, loc="upper center", ncols=2)  # above the bars
    return output.save_figure(figure, path)


def draw_convergence(study: Study, path: Path) -> Path:
    """Draws Figs. 7b and 9b: median episodes to convergence, with the quartiles.

    Runs that did not converge take part as slower than all others; above the upper line is where
    they are.  Hollow dots are medians of the converged runs alone, whose number
    stands under the strategy.
    """
    figure, axes = _axes()
    episodes = study.convergence()
    limit = study.plan["episodes"]
    never = 1.08 * limit
    low, middle, high = (
        np.minimum(statistics.quantile(episodes, q), never) for q in (0.25, 0.5, 0.75)
    )
    at = np.arange(len(episodes))
    axes.errorbar(at, middle, [middle - low, high - middle], fmt="o", capsize=4, label="all runs")
    converged = np.isfinite(episodes)
    alone = [
        np.median(e[c]) if c.any() else np.nan for e, c in zip(episodes, converged, strict=True)
    ]
    axes.plot(at, alone, "o", mfc="none", color="tab:orange", ms=9, label="converged runs alone")
    axes.axhline(limit, color="black", lw=1, ls="--")
    axes.text(len(at) - 0.55, limit, "not converged", ha="right", va="bottom", fontsize=8)
    axes.set(ylabel="episodes until converged", ylim=(0, 1.15 * limit), xlim=(-0.5, len(at) - 0.5))
    _strategies(axes, study, [f"{n}/{episodes.shape[1]}" for n in converged.sum(1)])
    axes.legend(frameon=False, fontsize=8, loc="best")
    return output.save_figure(figure, path)


def draw_landscapes(grids: dict[str, dict[str, np.ndarray]], path: Path) -> Path:
    """Draws Fig. 8 by each law side by side: white where the cost is low, regions in lines."""
    figure = output.new_figure(5.0 * len(grids) + 0.4, 4.4)
    panels = figure.subplots(1, len(grids), squeeze=False)[0]
    for axes, (law, data) in zip(panels, grids.items(), strict=True):
        image = _landscape(axes, data)
        axes.set_title(f"law of the section: {law}", fontsize=10)
    figure.colorbar(image, ax=panels, label="mean cost")
    return output.save_figure(figure, path)


def _landscape(axes: Axes, data: dict[str, np.ndarray]) -> QuadMesh:
    x = data["first_axis"]
    y = data["second_axis"]
    most = float(data["exclude"].max())
    look = {"cmap": "gray_r", "shading": "nearest", "vmin": 0, "vmax": max(most, COST_MAXIMUM)}
    image = axes.pcolormesh(x, y, data["exclude"].T, **look)
    for letter, region in zip("abcdefgh", regions(data, LANDSCAPE_THRESHOLD), strict=False):
        if not region.points.all():
            axes.contour(x, y, region.points.T.astype(float), [0.5], colors="tab:red", linewidths=1)
        # Inside the region, also where its mean lies outside.
        inside = np.argwhere(region.points)
        axis = np.stack([x[inside[:, 0]], y[inside[:, 1]]], -1)
        scale = np.array([np.ptp(x), np.ptp(y)])
        nearest = axis[np.argmin((((axis - region.centre) / scale) ** 2).sum(1))]
        axes.text(nearest[0], nearest[1], f"({letter})", color="tab:red", ha="center", va="center")
    names = data["parameters"]
    units = data["units"]
    axes.set(xlabel=f"{names[0]} [{units[0]}]", ylabel=f"{names[1]} [{units[1]}]")
    return image


def _axes(width: float = 6.0, height: float = 3.4):
    figure = output.new_figure(width, height)
    return figure, figure.add_subplot()


def _strategies(axes, study: Study, below: list[str] | None = None) -> None:
    labels = [label(s) for s in study.strategies]
    if below:
        labels = [f"{name}\n{text}" for name, text in zip(labels, below, strict=True)]
    axes.set_xticks(range(len(labels)), labels)
    axes.set_xlabel("strategy (s.d.: single domain; number of switches; conc.: concurrent)")


# --- tables ---------------------------------------------------------------------------------------

_THRESHOLDS = (0.1, 0.5, 1.0)


def make(data: Path, pictures: Path, page: Path | None = None) -> str:
    """Draws the figures of whatever results there are and writes the table.

    Returns:
      The table in Markdown.
    """
    results = read(data)
    text = tables(results)
    for law, (studies, _) in results.items():
        for study in studies.values():
            if study and len(study.strategies) > 1:
                _draw(study, pictures, f"_{law}" if LAWS[law] else "")
    if page:
        fill(page, text, "results")
    if grids := {law: r.grid[0] for law, r in results.items() if r.grid}:
        draw_landscapes(grids, pictures / "fig8_landscape.png")
    return text


def _draw(study: Study, pictures: Path, law: str) -> None:
    """Draws an experiment's figures; `law` ends their names."""
    name = study.plan["name"]
    if name == "2d" and not law:
        draw_evolution(study, pictures / "fig6_cost_evolution.png")
    number = {"2d": 7, "23d": 9}[name]
    if study.tested:
        draw_success(study, pictures / f"fig{number}a_success{law}.png")
    draw_convergence(study, pictures / f"fig{number}b_convergence{law}.png")


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
