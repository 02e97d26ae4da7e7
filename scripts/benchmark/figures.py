"""Draws the benchmark's figures and fills in docs/notes/performance.md from the files in docs/data.

python -m scripts.benchmark.figures

Reads docs/data/benchmark_cpu.json, benchmark_h200.json and compare_engines.json; files that are
missing are left out.
"""

import argparse
import json
from pathlib import Path
from typing import Any

import matplotlib.ticker

from scripts.benchmark import report
from scripts.shared import figures as pictures
from scripts.shared.statistics import slope
from scripts.shared.tables import fill, markdown

MACHINES = {"cpu": "benchmark_cpu.json", "h200": "benchmark_h200.json"}
COLORS = {"structured": "tab:blue", "mujoco": "tab:green", "mjx": "tab:orange", "warp": "tab:red"}
STYLES = ("-", "--", ":", "-.")


def draw(results: dict[str, Any], path: Path) -> None:
    """Rates against worlds, whole grasps and in contact; cost against links and fingers."""
    figure = pictures.new(9.6, 6.4)
    axes = figure.subplots(2, 2)
    for axis, kind, title in (
        (axes[0, 0], "grasp", "whole grasps, nominal"),
        (axes[0, 1], "window", "in contact, every step simulated"),
    ):
        _rates(axis, report.measured(results, kind), title)
    for axis, name, ticks in (
        (axes[1, 0], "links", (5, 10, 20, 40)),
        (axes[1, 1], "fingers", (2, 3, 4, 6, 8)),
    ):
        _growth(axis, results, name, ticks)
    pictures.save(figure, path)


def _rates(axis: Any, records: list[dict[str, Any]], title: str) -> None:
    lines: dict[tuple[str, str], list[tuple[int, float]]] = {}
    for r in records:
        point = r["worlds"], r["nominal_world_steps_per_s"]
        lines.setdefault((r["engine"], r["setting"]), []).append(point)
    count: dict[str, int] = {}
    for (engine, setting), points in lines.items():
        number = count[engine] = count.get(engine, -1) + 1
        x, y = zip(*sorted(points), strict=True)
        style = {"color": COLORS[engine], "ls": STYLES[number % len(STYLES)]}
        axis.loglog(x, y, marker="o", ms=4, label=f"{engine}, {setting}", **style)
    axis.set(title=title, xlabel="worlds", ylabel="world-steps/s")
    sizes = sorted({r["worlds"] for r in records})
    axis.set_xticks(sizes, [f"{n:,}" for n in sizes])
    axis.xaxis.set_minor_locator(matplotlib.ticker.NullLocator())
    if lines:
        axis.legend(frameon=False, fontsize=7)


def _growth(axis: Any, results: dict[str, Any], name: str, ticks: tuple[int, ...]) -> None:
    for engine, points in report.growth(results, name).items():
        x, y = zip(*points, strict=True)
        label = engine
        upper = [p for p in points if name != "links" or p[0] >= 10]
        if len(upper) > 1:
            label += f": {slope(*zip(*upper, strict=True)):.2f}"
        axis.loglog(x, y, marker="o", ms=4, color=COLORS[engine], label=label)
    axis.set(xlabel=name, ylabel="µs a world and step")
    axis.set_xticks(ticks, [str(t) for t in ticks])
    axis.minorticks_off()
    if axis.lines:
        axis.legend(frameon=False, fontsize=7, title="exponent")


def machine(run: dict[str, Any]) -> str:
    """One sentence about where a file's figures come from."""
    versions = f"Python {run['python']}, JAX {run['jax']}, MuJoCo {run['mujoco']}"
    versions += f", Warp {run['warp']}" if run["warp"] else ""
    place = run["cpu"] if run["platform"] == "cpu" else f"{run['device']}, {run['cpu']}"
    return (
        f"{place}, {run['cpus']} cores; {versions}; {run['date'][:10]}, "
        f"commit {(run['commit'] or 'unknown')[:12]}; load at the start {run['load']:.1f}."
    )


def omissions(results: dict[str, Any]) -> str:
    """What could not be measured, each with its reason."""
    bad = [r for r in results["records"] if "problem" in r or "skipped" in r]
    return "\n".join(["Not measured:", "", *(f"* {report.line(r)}" for r in bad)]) if bad else ""


def compared(found: dict[str, Any]) -> str:
    """Table of the cost distributions."""
    head = "engine, grasps, success, MuJoCo C, difference (95 %), same verdict, KS distance, KS p"
    rows = [[*(str(h) for h in head.split(", ")), "rank correlation"]]
    for name, c in found["against_mujoco"].items():
        low, high = c["success_difference"]["interval_95"]
        ks, rank = c["kolmogorov_smirnov"], c["spearman"]
        rows.append(
            [
                name,
                f"{c['worlds']:,}",
                f"{c['success']:.2%}",
                f"{c['success_reference']:.2%}",
                f"{low:+.2%} to {high:+.2%}",
                f"{c['same_verdict']:.2%}",
                f"{ks['distance']:.4f}",
                f"{ks['p']:.2f}",
                "–" if rank is None else f"{rank:.4f}",
            ]
        )
    note = "`mujoco, perturbed` is MuJoCo C with every object moved by a micrometre."
    return "\n\n".join([note, markdown(rows), machine(found)])


def measured(name: str, folder: Path, figures: Path) -> str:
    """What was measured on a machine; draws its figure on the way.

    Args:
      name: One of `MACHINES`.
      folder: Folder of the results.
      figures: Folder of the figures.
    """
    results = json.loads((folder / MACHINES[name]).read_text())
    picture = figures / f"performance_{name}.png"
    draw(results, picture)
    parts = [machine(results["runs"][-1]), f"![Rates and growth](../{picture.name})"]
    return "\n\n".join(p for p in (*parts, report.tables(results), omissions(results)) if p)


def main() -> None:
    """Draws the figures and fills in the page's tables."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--docs", type=Path, default=Path(__file__).parents[2] / "docs")
    docs = parser.parse_args().docs
    path, data = docs / "notes" / "performance.md", docs / "data"
    for name, file in MACHINES.items():
        if (data / file).exists():
            fill(path, measured(name, data, docs), name)
    if (data / "compare_engines.json").exists():
        fill(path, compared(json.loads((data / "compare_engines.json").read_text())), "verdicts")
    print(path)


if __name__ == "__main__":
    main()
