"""What gradients of short windows are good for: python -m scripts.demonstrations [--draw].

Two problems of the default scene, each with a gradient and without one, in the same processor
time: constants from a shake, and an object held still.  Writes docs/data/demonstrations_cpu.json
and draws docs/figures/demonstrations.png from it; the results are in docs/gradients.md.
"""

import argparse
import json
from pathlib import Path
from typing import Any

import numpy as np

from codesign_jax import scene, use_compilation_cache
from scripts.demonstrations import hold, identify
from scripts.shared import figures, output, provenance

DOCS = Path(__file__).parents[2] / "docs"
STUDIES = {"identify": identify.run, "hold": hold.run}


def main() -> None:
    """Command line."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--json", type=Path, default=DOCS / "data" / "demonstrations_cpu.json")
    parser.add_argument("--figure", type=Path, default=DOCS / "figures" / "demonstrations.png")
    parser.add_argument("--only", nargs="+", choices=STUDIES, default=list(STUDIES))
    parser.add_argument("--draw", action="store_true", help="draw from the file; measure nothing")
    provenance.add_commit(parser)
    options = parser.parse_args()
    use_compilation_cache()
    results = json.loads(options.json.read_text()) if options.json.exists() else {}
    for name in [] if options.draw else options.only:
        results[name] = STUDIES[name](scene.load("paper"))
        results[name]["provenance"] = provenance.measurement(options.commit)
        output.write_json(options.json, results)
    if {"identify", "hold"} <= set(results):
        draw(results, options.figure)


def draw(results: dict[str, Any], path: Path) -> None:
    """A panel for each study."""
    figure = figures.new(8, 3.4)
    axes = figure.subplots(1, 2)
    found = results["identify"]["seeds"]
    largest = lambda errors: 100 * np.abs(errors).max()  # noqa: E731
    columns = {
        "Gauss-Newton": [largest(s["errors"]) for s in found],
        "CMA-ES,\nequal search": [largest(s["cma_es"][0]["errors"]) for s in found],
        "CMA-ES,\nwith compiling": [largest(s["cma_es"][1]["errors"]) for s in found],
    }
    for k, values in enumerate(columns.values()):
        axes[0].semilogy(k + np.linspace(-0.15, 0.15, len(values)), values, ".")
    axes[0].axhline(2.0, color="black", lw=1, ls="--")
    axes[0].set_xticks(range(len(columns)), columns)
    axes[0].set(ylabel="largest error of five constants [%]", title="constants from a shake")
    paths = {"constant": results["hold"]["constant"]}
    paths |= {k: v["slip"] for k, v in results["hold"]["methods"].items()}
    axes[1].boxplot([1e3 * np.array(v) for v in paths.values()], tick_labels=list(paths))
    axes[1].set(ylabel="path of the object in the palm [mm]", ylim=(0, None), title="held still")
    figures.save(figure, path)


if __name__ == "__main__":
    main()
