"""What each effect costs and decides: python -m scripts.effects [--quick] [--draw].

Measures the paper's scene with each effect turned over, writes docs/data/effects.json and
fills in docs/effects.md and docs/notes/effects.md and draws their figure; --draw only draws.  An
effect's decisions come from MuJoCo C, its program and time from the structured engine.  About 15
minutes on two idle cores.
"""

import argparse
import json
import os
import time
from pathlib import Path
from typing import Any

import numpy as np

from codesign_jax import scene
from codesign_jax.commands import common
from scripts.effects import page as effects_page
from scripts.effects import study as effects
from scripts.shared import output, provenance

DOCS = Path(__file__).parents[2] / "docs"
AS_IT_IS = effects_page.REFERENCE


def main() -> None:
    """Measures, stores and draws."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--json", type=Path, default=DOCS / "data" / "effects.json")
    parser.add_argument("--page", type=Path, default=DOCS / "effects.md")
    parser.add_argument("--note", type=Path, default=DOCS / "notes" / "effects.md")
    parser.add_argument("--quick", action="store_true", help="few grasps, few links; not for docs")
    parser.add_argument("--draw", action="store_true", help="draw from the file; measure nothing")
    common.use_compilation_cache()  # a run that was broken off need not compile again
    both = ["decisions", "programs"]
    parser.add_argument("--parts", nargs="*", choices=both, default=both, help="measure these only")
    parser.add_argument(
        "--minutes", type=float, default=60, help="compile no new program after this time"
    )
    options = parser.parse_args()
    if not options.draw:
        _measure(options.json, options.parts, options.minutes, quick=options.quick)
        if set(options.parts) != set(both):
            return
    results = json.loads(options.json.read_text(encoding="utf-8"))
    figure = options.json.with_suffix(".png") if options.quick else DOCS / "figures" / "effects.png"
    effects_page.draw(results, figure)
    if not options.quick:
        effects_page.write(results, options.page, options.note)


def _measure(path: Path, parts: list[str], minutes: float, *, quick: bool) -> None:
    overrides = {"discretization": {"links": 3}} if quick else None
    base = scene.load("paper_spheres", overrides=overrides)
    everything = {AS_IT_IS: base, **effects.variants(base)}
    results: dict[str, Any] = {"effects": {}}
    if path.exists():
        results = json.loads(path.read_text(encoding="utf-8"))
    results["provenance"] = provenance.measurement()
    if "decisions" in parts:
        _decisions(everything, results, path, quick=quick)
    if "programs" in parts:
        _programs(everything, results, path, minutes, quick=quick)


def _decisions(
    everything: dict[str, scene.Scene], results: dict[str, Any], path: Path, *, quick: bool
) -> None:
    designs, trials = (4, 3) if quick else (24, 6)
    worlds = effects.grasps(everything[AS_IT_IS], designs, trials)
    results["trials"], reference = trials, None
    for name, variant in everything.items():
        if reference is not None and "success" in results["effects"].get(name, {}):
            continue  # done by an earlier run
        found = effects.decide(variant, worlds)
        reference = reference or found
        record = effects.compare(found, reference, trials)
        results["effects"].setdefault(name, {}).update(record)
        print(name, record["success"], record["same_verdict"], flush=True)
        output.write_json(path, results)


def _programs(
    everything: dict[str, scene.Scene],
    results: dict[str, Any],
    path: Path,
    minutes: float,
    *,
    quick: bool,
) -> None:
    begin = time.perf_counter()
    worlds = effects.grasps(everything[AS_IT_IS], 2 if quick else 6, 3 if quick else 6)
    programs, compiled = {}, {}
    for name, variant in everything.items():
        at = effects.lifting(variant, worlds)
        new = time.perf_counter() - begin < 60 * minutes
        program = effects.compile_steps(variant, worlds, at, compiled, new=new)
        if program.run is not None:
            programs[name] = program
        results["effects"].setdefault(name, {}).update(program.record)
        print(name, program.record, flush=True)
    results["load_before"] = os.getloadavg()
    times = effects.measure(programs, 9)
    results["load_after"] = os.getloadavg()
    for name, seconds in times.items():
        ratios = np.array(seconds) / np.array(times[AS_IT_IS])
        results["effects"][name] |= {
            "step_seconds": float(np.median(seconds)),
            "step_seconds_quartiles": [float(q) for q in np.quantile(seconds, [0.25, 0.75])],
            "ratio": float(np.median(ratios)),
            "ratio_quartiles": [float(q) for q in np.quantile(ratios, [0.25, 0.75])],
        }
    output.write_json(path, results)


if __name__ == "__main__":
    main()
