"""What docs/results.md states of the experiments, from docs/data alone; a test reads both."""

from pathlib import Path

import numpy as np

from codesign_jax.report.statistics import Interval, wilson
from scripts.experiments import report, study
from scripts.experiments.study import Study
from scripts.shared import statistics

SWITCHES = ("switch-1", "switch-2", "switch-4", "switch-8", "switch-16", "switch-32")
STATEMENTS = (
    "{single_2d:.0f} % of 30 runs {single_2d_interval}, concurrent {both_2d:.0f} % "
    "{both_2d_interval}",
    "{single_2d:.0f}, {one_2d:.0f} and {two_2d:.0f} % with none, one and two switches",
    "from two switches on there is no trend (p = {level:.2f})",
    "medians of {medians} simulations with 1 to 32 switches",
    "fastest of all: {median_2d:,.0f} simulations",
    "median {median_2d:,.0f} {median_2d_interval}, mean {mean_2d:,.0f} {mean_2d_interval}",
    "median {median_23d:,.0f} {median_23d_interval}, mean {mean_23d:,.0f} {mean_23d_interval}",
    "{growth:.1f} times {growth_interval} by medians, {growth_mean:.1f} times by means",
    "{converged_23d:.0f} of 30 runs converge",
    "after {median_23d:,.0f} simulations (median), one switch and a single domain after "
    "{one_median:,.0f}",
    "{single_never:.0f} of 30 runs of a single domain never",
    "{concurrent_runs:.0f} of 30 runs succeed, {one_runs:.0f} with one switch, {single_runs:.0f} "
    "in a single domain",
    "from {one_2d:.0f} % with two parameters to {one_23d:.0f} %",
    "{faster:.1f} times as fast as one switch; faster in {sooner} of 30 pairs, slower in {later}",
    "{first:.1f} % of the plane, (b) {second:.1f} %",
    "only (a) has designs below 0.1",
)


def interval(value: Interval, factor: float = 1.0, form: str = ",.0f") -> str:
    """The ends of an interval in brackets."""
    return f"[{factor * value.low:{form}}, {factor * value.high:{form}}]"


def figures(now: Path) -> dict[str, float | str]:
    """The numbers that the page states.

    Args:
      now: Folder of the experiments and the landscape.
    """
    two, many = (study.load_study(now, name) for name in ("2d", "23d"))
    assert two is not None and many is not None
    found: dict[str, float | str] = {}
    for name, strategy in (("single", "single"), ("one", "switch-1"), ("two", "switch-2")):
        found |= _success(two, f"{name}_2d", strategy)
    found |= _success(two, "both_2d", "concurrent")
    found["level"] = statistics.trend(1.0 * two.success()[2:])
    medians = [f"{_median(two, s).value:,.0f}" for s in SWITCHES]
    found["medians"] = ", ".join(medians[:-1]) + f" and {medians[-1]}"
    for name, one in (("2d", two), ("23d", many)):
        median, mean = _median(one, "concurrent"), report.mean(_simulations(one, "concurrent"))
        found |= {f"median_{name}": median.value, f"median_{name}_interval": interval(median)}
        found |= {f"mean_{name}": mean.value, f"mean_{name}_interval": interval(mean)}
    a, b = (_simulations(s, "concurrent") for s in (many, two))
    growth = statistics.ratio_of_medians(a, b)
    found |= {"growth": growth.value, "growth_interval": interval(growth, form=".1f")}
    found |= {"growth_mean": float(a.mean() / b.mean())}
    found |= _many(many) | _landscape(now)
    return found


def _many(many: Study) -> dict[str, float | str]:
    """Of the experiment with 23 parameters: speeds and successful runs, strategy by strategy.

    Raises:
      ValueError: If one switch and a single domain do not have the same median.
    """
    names = {"single": "single", "one": "switch-1", "concurrent": "concurrent"}
    speed = {name: _simulations(many, strategy) for name, strategy in names.items()}
    middle = {name: statistics.median(v).value for name, v in speed.items()}
    if middle["one"] != middle["single"]:
        raise ValueError("one switch and a single domain have different medians")
    found: dict[str, float | str] = {"one_median": middle["one"]}
    for name, strategy in names.items():
        found[f"{name}_runs"] = float(many.success()[many.strategies.index(strategy)].sum())
    found |= _success(many, "one_23d", "switch-1")
    found["converged_23d"] = float(np.isfinite(speed["concurrent"]).sum())
    found["single_never"] = float((~np.isfinite(speed["single"])).sum())
    found["faster"] = middle["one"] / middle["concurrent"]
    found["sooner"] = int((speed["concurrent"] < speed["one"]).sum())
    found["later"] = int((speed["concurrent"] > speed["one"]).sum())
    return found


def sentences(now: Path) -> list[str]:
    """`STATEMENTS` with their figures."""
    found = figures(now)
    return [s.format(**found) for s in STATEMENTS]


def _simulations(one: Study, strategy: str) -> np.ndarray:
    return one.convergence()[one.strategies.index(strategy)] * one.per_episode


def _median(one: Study, strategy: str) -> Interval:
    return statistics.median(_simulations(one, strategy))


def _landscape(now: Path) -> dict[str, float | str]:
    """Shares of the plane of the two regions below a cost of 0.5, the one with short fingers first.

    Raises:
      ValueError: If the landscape has another number of regions, or below a cost of 0.1 other ones
        than that with short fingers.
    """
    loaded = study.load(now, "landscape")
    assert loaded is not None
    (short, long), (best,) = (study.regions(loaded[0], cost) for cost in (0.5, 0.1))
    if not (best.points <= short.points).all():
        raise ValueError("the best designs are not those with short fingers")
    return {"first": 100 * short.share, "second": 100 * long.share}


def _success(one: Study, name: str, strategy: str) -> dict[str, float | str]:
    good = one.success()[one.strategies.index(strategy)]
    share = wilson(int(good.sum()), good.size)
    return {name: 100 * float(good.mean()), f"{name}_interval": interval(share, 100)}
