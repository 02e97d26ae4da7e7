"""Fills in README's table of rates, and says which of README's figures are not in docs/data.

python -m scripts.front_page

Every number of README's text stands in a sentence of `STATEMENTS`, filled in with what docs/data
has and rounded as the sentence says, or in a name of `NAMES`.  A test fails where one does not.
"""

import json
import re
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from codesign_jax.optimize import DEFAULT, PAPER
from codesign_jax.report.verdicts import RELIABLE
from codesign_jax.types import failed
from scripts.accuracy.budget_report import Budget
from scripts.experiments import study
from scripts.search import report as search
from scripts.shared.tables import fill, markdown

ROOT = Path(__file__).parents[1]
MARK = "rates"
CASE = "paper"
"""The default scene, in the files of `scripts.benchmark.grasps`."""
MACHINES = {"2 CPU cores": "grasps_cpu.json", "one H200": "grasps_h200.json"}

BATCHES = {60: ", an episode of a 2D run", 360: ", an episode of a 23D run"}

STATEMENTS = (
    "{ours_good:.0f} of {ours_runs:.0f} of its runs keep 95 % of fresh grasps after "
    "{ours_grasps:,.0f} simulated ones, {filter_share:.0f} % of the paper's (`--optimizer "
    "particle-filter`) after {filter_grasps:,.0f}",
    "both at once succeeds in {success_2d_concurrent:.0f} of {runs:.0f} runs, one alone in "
    "{success_2d_single:.0f}",
    "keep {kept_2d:.0f} % of fresh grasps",
    "{success_23d_concurrent:.0f} of {runs:.0f} runs succeed, one alone {success_23d_single:.0f}, "
    "and the best designs keep {kept_23d:.0f} %",
    "{flips:.1f} % of fresh grasps of the best designs with {parameters:.0f} parameters, of which "
    "they keep {kept_finely:.0f} %",
    "With {parameters:.0f} parameters",
    "takes {converged_2d:,.0f} simulated grasps with two parameters ({paper_2d:,.0f} in the paper) "
    "and {converged_23d:,.0f} with {parameters:.0f} ({paper_23d:,.0f})",
    "takes {install_seconds:.0f} seconds or more and {install_gb:.1f} GB",
    "{c_ratio:.0f} times as many grasps a second as MuJoCo C on two cores",
    "in place of the hull {c_ratio_here:.0f} times as many",
    "{few_faster:.1f} and {many_faster:.1f} times as fast with {few:,.0f} and {many:,.0f} grasps",
    "{fast_rate:.1f} times the rate of `standard`",
    "{compared:,.0f} of {same:,.0f} verdicts",
    "{c_differs:.1f} % of {c_trials:.0f} verdicts differ",
)
NAMES = (
    "IROS 2017",
    "H100 and H200",
    "an H200",
    "an H100",
    "CUDA 13",
    "CUDA 12",
    "jax[cuda13]<0.13",
    "`cuda12`",
    "compute capability 8.0",
    "x86-64",
    "Python 3.11, 3.12 and 3.13",
    "WSL2",
    "3D",
    "10 ms",
    "1 ms",
    "10 links",
    "24 fresh grasps",
    "at least 95 %",
    "20 links",
    "Apache-2.0",
    "--seeds 0-29",
)
"""Numbers that were not measured: names, and settings that the presets' files have."""


def _json(path: Path) -> Any:
    return json.loads(path.read_text(encoding="utf-8"))


def _experiments(data: Path) -> Iterator[tuple[str, float]]:
    """Convergence and success with the default scene: 30 runs a strategy."""
    for name, paper in (("2d", 420), ("23d", 6120)):
        now = study.load_study(data / "experiments", name)
        assert now is not None, f"docs/data has no {name} of the default scene"
        for strategy, good in zip(now.strategies, now.success(), strict=True):
            yield f"success_{name}_{strategy}", float(good.sum())
            yield "runs", float(good.size)
            yield "parameters", float(now.data["final_particles"].shape[-1])
        episodes = np.median(now.convergence()[now.strategies.index("concurrent")])
        yield f"converged_{name}", float(episodes * now.per_episode)
        yield f"paper_{name}", float(paper)


def _fresh(data: Path) -> Iterator[tuple[str, float]]:
    """What the winners keep of fresh trials, and how many verdicts `reference` changes [%]."""
    with np.load(data / "experiments" / "fresh.npz", allow_pickle=False) as file:
        for name in ("2d", "23d"):
            place = [str(s) for s in file[f"{name}|strategies"]].index("concurrent")
            kept, good = _verdicts(file, name, "standard", place)
            yield f"kept_{name}", 100 * float(kept[good].mean())
            if f"{name}|reference|cost" in file:
                other, fine = _verdicts(file, name, "reference", place)
                both = good & fine
                yield "flips", 100 * float((kept != other)[both].mean())
                yield "kept_finely", 100 * float(other[fine].mean())


def _searches(data: Path) -> Iterator[tuple[str, float]]:
    """Runs of the default search and of the filter whose design keeps 95 % in the end."""
    rows = search.merged([_json(path) for path in sorted((data / "search").glob("*.json"))])
    for name, optimizer in (("ours", DEFAULT), ("filter", PAPER)):
        case = optimizer, "23d", None
        [found] = [r for r in rows if (r["optimizer"], r["preset"], r.get("objects")) == case]
        good = np.array(found["kept"][-1]) >= RELIABLE
        yield f"{name}_good", float(good.sum())
        yield f"{name}_runs", float(good.size)
        yield f"{name}_share", 100 * float(good.mean())
        yield f"{name}_grasps", float(found["grasps"][-1])


def _verdicts(file: Any, name: str, label: str, place: int) -> tuple[np.ndarray, np.ndarray]:
    """Whether each trial kept its object, and whether it did not fail."""
    good = ~np.asarray(failed(file[f"{name}|{label}|status"][place]))
    return file[f"{name}|{label}|cost"][place] < 0.01, good


def _engines(data: Path) -> Iterator[tuple[str, float]]:
    """Against MuJoCo C: verdicts, and rates with spheres; the preset `fast` against `standard`."""
    same = _json(data / "compare_engines.json")["against_mujoco"]["structured"]
    yield "same", float(same["worlds"])
    yield "compared", round(same["worlds"] * same["same_verdict"])
    records = [r for r in _json(data / "benchmark_cpu.json")["records"] if r["kind"] == "grasp"]
    rates = {}
    for engine, setting in (("structured", "default"), ("mujoco", "documented")):
        found = [r for r in records if (r["engine"], r["setting"]) == (engine, setting)]
        rates[engine] = [r["grasps_per_s"] for r in found if "grasps_per_s" in r]
    yield "c_ratio", min(rates["structured"]) / max(rates["mujoco"])
    budget = Budget(_json(data / "budget.json"))
    c, ours = "spheres, MuJoCo C", "spheres"
    cpu = {name: rate["grasps_per_s"] for name, rate in budget.rates["cpu"].items()}
    yield "c_ratio_here", cpu[ours] / cpu[c]
    yield "fast_rate", cpu["fast"] / cpu["standard"]
    beside = budget.compared(c, ours)
    assert beside is not None
    yield "c_trials", float(budget.costs[c].size)
    yield "c_differs", 100 * beside["flipped"].value


def _kernel(data: Path) -> Iterator[tuple[str, float]]:
    """How much faster whole grasps of the default scene are with today's kernel, on a GPU.

    Two comparisons, each in one run: of another kernel, and of effects that came later.
    """
    files = ("before_after_h100.json", "before_after_effects_h100.json")
    records = [_json(data / name)["records"] for name in files]
    for name, worlds in (("few", 60), ("many", 1728)):
        faster = 1.0
        for rows in records:
            whole = [r for r in rows if r["case"] == "hull and fingers, whole grasps"]
            seconds = {r["state"]: r["median_s"] for r in whole if r["worlds"] == worlds}
            faster *= seconds["before"] / seconds["after"]
        yield name, worlds
        yield f"{name}_faster", faster


def figures(data: Path) -> dict[str, float]:
    """The numbers that README states, from docs/data alone."""
    install = _json(data / "install.json")
    found = {"install_seconds": install["seconds"], "install_gb": install["disk_gb"]}
    parts = (_experiments, _fresh, _searches, _engines, _kernel)
    return found | {name: value for part in parts for name, value in part(data)}


def table(data: Path) -> str:
    """Grasps a second of the default scene, by batch and machine, as a Markdown table."""
    records: dict[str, dict[tuple[str, int], dict[str, Any]]] = {}
    for machine, name in MACHINES.items():
        found = _json(data / name)["records"] if (data / name).exists() else []
        records[machine] = {(r["case"], r["worlds"]): r for r in found}
    rows = [["batch", *(f"{machine}: grasps a second" for machine in MACHINES)]]
    for size in sorted({n for found in records.values() for case, n in found if case == CASE}):
        cells = [_cell(found.get((CASE, size))) for found in records.values()]
        rows.append([f"{size:,} grasps{BATCHES.get(size, '')}", *cells])
    return markdown(rows)


def _cell(record: dict[str, Any] | None) -> str:
    if record is None:
        return "–"
    rate = float(f"{record['grasps_per_s']:.2g}")
    return f"{rate:,.0f} ({record['best_s']:#.2g} s a batch)"


def words(readme: str) -> str:
    """The text of a page without code, link targets and tables that are filled in, on one line."""
    text = re.sub(r"<!-- (\w+):begin -->.*?<!-- \1:end -->", " ", readme, flags=re.S)
    text = re.sub(r"^```.*?^```", " ", text, flags=re.S | re.M)
    text = re.sub(r"\]\([^)]*\)", "]", text)
    return re.sub(r"[\s>|]+", " ", text)


def sentences(data: Path) -> list[str]:
    """`STATEMENTS` with their figures."""
    found = figures(data)
    return [s.format(**found) for s in STATEMENTS]


def unexplained(readme: str, stated: list[str]) -> list[str]:
    """Numbers of a page that stand in no statement and in no name, each with what is around it."""
    text = words(readme)
    for known in (*stated, *NAMES):
        text = text.replace(known, " ")
    return [text[max(0, m.start() - 30) : m.end() + 20] for m in re.finditer(r"\d[\d,.]*", text)]


def main() -> int:
    """Fills in the tables; exit status 1 if README states what docs/data does not have."""
    data = ROOT / "docs" / "data"
    for page in (ROOT / "README.md", ROOT / "docs" / "performance.md"):
        fill(page, table(data), MARK)
    readme, stated = (ROOT / "README.md").read_text(encoding="utf-8"), sentences(data)
    missing = [s for s in stated if s not in words(readme)]
    other = unexplained(readme, stated)
    for where, found in (("README", missing), ("docs/data", other)):
        print("".join(f"not in {where}: {text}\n" for text in found), end="")
    return int(bool(missing or other))


if __name__ == "__main__":
    sys.exit(main())
