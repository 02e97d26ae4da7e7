"""What each effect costs and decides: python -m scripts.effects [--quick] [--draw].

Measures the scene `paper_spheres` with each effect turned over, writes docs/data/effects.json and
fills in docs/effects.md and docs/notes/effects.md and draws their figure; --draw only draws.  An
effect's decisions come from MuJoCo C, or from the structured engine what C refuses; its time is
that of the structured engine, `STEPS` steps from the middle of the lift on.  About 15 minutes on
two idle cores; a run that was broken off goes on.
"""

import argparse
import dataclasses
import json
import os
import time
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from codesign_jax import rollout, use_compilation_cache
from codesign_jax import scene as scenes
from codesign_jax.codesign import SUCCESS_COST
from codesign_jax.engines import make_engine
from codesign_jax.report.statistics import wilson
from codesign_jax.scene import Scene, parameters
from codesign_jax.scene.effects import EFFECTS, ENGINES, refusals
from codesign_jax.types import failed
from scripts.shared import output, provenance, work
from scripts.shared.statistics import spearman

DOCS = Path(__file__).parents[1] / "docs"
AS_IT_IS = "as it is"
CONTACTS = ("finger_object", "palm_object", "finger_table", "palm_table", "object_table")
STEPS, ROUNDS = 20, 9


def variants(base: Scene) -> dict[str, Scene]:
    """The scene with each effect turned over, and without contacts, by what changed."""
    changes: dict[str, dict[str, Any]] = {"all contacts off": dict.fromkeys(CONTACTS, False)}
    for field in dataclasses.fields(base.effects):
        now = getattr(base.effects, field.name)
        for value in field.metadata.get("options", (not now,)):
            if value != now:
                word = {True: "on", False: "off"}.get(value, value)
                changes[f"{field.name} {word}"] = {field.name: value}
    return {AS_IT_IS: base} | {name: changed(base, **change) for name, change in changes.items()}


def changed(base: Scene, **effects: Any) -> Scene:
    return dataclasses.replace(base, effects=dataclasses.replace(base.effects, **effects))


def grasps(base: Scene, designs: int, trials: int) -> work.Worlds:
    """Designs of the 2D space around those that hold, each in the same trials.

    In the box, lengths of 45 to 150 mm and arm heights of -60 to 60 mm, about half of the grasps
    hold: leaving an effect out can change a verdict both ways.
    """
    space = parameters.design_space(base.hand, "2d")
    low, high = np.array([0.045, -0.06]), np.array([0.150, 0.06])
    chosen = low + (high - low) * np.random.default_rng(0).random((designs, 2))
    design, trial = np.indices((designs, trials)).reshape(2, -1)
    params = jax.vmap(space.params)(jnp.asarray(chosen, jnp.float32))
    drawn = rollout.sample_trials(base, jax.random.key(0), trials)
    of = lambda index: lambda v: v[index]  # noqa: E731
    return work.Worlds(jax.tree.map(of(design), params), jax.tree.map(of(trial), drawn))


def decide(variant: Scene, worlds: work.Worlds) -> tuple[np.ndarray, np.ndarray]:
    engine = "structured" if refusals(variant.effects, "mujoco") else "mujoco"
    outcome, _ = rollout.simulate(variant, make_engine(engine, variant), *worlds)
    return np.asarray(outcome.cost), np.asarray(outcome.status)


def compare(found: tuple, reference: tuple, trials: int) -> dict[str, Any]:
    """Success rate with its 95 % interval and agreement with the scene as it is."""
    (cost, status), expected = found, reference[0]
    success = (cost < SUCCESS_COST) & ~failed(status)
    rate = wilson(int(success.sum()), success.size)
    rank = float(spearman(*(c.reshape(-1, trials).mean(1) for c in (cost, expected))))
    return {
        "worlds": int(success.size),
        "success": float(success.mean()),
        "success_low": float(rate.low),
        "success_high": float(rate.high),
        "same_verdict": float(((cost < SUCCESS_COST) == (expected < SUCCESS_COST)).mean()),
        "rank_correlation": None if np.isnan(rank) else rank,
        "failed": int(failed(status).sum()),
    }


def program(variant: Scene, worlds: work.Worlds) -> tuple[Any, tuple]:
    """A compiled program of some steps, and its arguments.

    The grasps are where MuJoCo C, with spheres, has them in the middle of the lift.
    """
    plain = changed(variant, surface="spheres")
    step = round((plain.phases.inflate + plain.phases.lift) / 2 / plain.discretization.timestep)
    fields, ctrl = work.inputs(plain, worlds)
    begun = make_engine("mujoco", plain).rollout(fields, ctrl[:, :step], trajectory=True)
    fields, ctrl = work.inputs(variant, worlds)
    fields = fields._replace(start=jnp.asarray(begun.qpos[:, -1], fields.start.dtype))
    args, engine = (fields, ctrl[:, step : step + STEPS]), make_engine("structured", variant)
    run = jax.jit(lambda f, c: engine.rollout(f, c).distance[:, -1])
    return run.lower(*args).compile(), args


def measure(everything: dict[str, Scene], path: Path, *, quick: bool) -> dict[str, Any]:
    """Measures what the file does not have; what it then holds."""
    results: dict[str, Any] = json.loads(path.read_text()) if path.exists() else {"effects": {}}
    results["provenance"] = provenance.measurement()
    designs, trials = (4, 3) if quick else (24, 6)
    results["trials"], reference = trials, None
    worlds = grasps(everything[AS_IT_IS], designs, trials)
    for name, variant in everything.items():
        if reference is not None and "success" in results["effects"].get(name, {}):
            continue  # done by an earlier run
        found = decide(variant, worlds)
        reference = reference or found
        results["effects"].setdefault(name, {}).update(compare(found, reference, trials))
        print(name, results["effects"][name], flush=True)
        output.write_json(path, results)
    few = grasps(everything[AS_IT_IS], 6, trials)
    programs = {name: program(variant, few) for name, variant in everything.items()}
    times: dict[str, list[float]] = {name: [] for name in programs}
    results["load_before"] = os.getloadavg()
    for _ in range(ROUNDS + 1):  # in turn, so that a busy machine slows all alike
        for name, (run, args) in programs.items():
            begin = time.perf_counter()
            jax.block_until_ready(run(*args))
            times[name].append((time.perf_counter() - begin) / STEPS / (6 * trials))
    results["load_after"] = os.getloadavg()
    for name, seconds in times.items():
        ratios = np.array(seconds[1:]) / np.array(times[AS_IT_IS][1:])  # the first round warms up
        results["effects"][name] |= {
            "step_seconds": float(np.median(seconds[1:])),
            "ratio": float(np.median(ratios)),
            "ratio_quartiles": [float(q) for q in np.quantile(ratios, [0.25, 0.75])],
        }
    output.write_json(path, results)
    return results


def draw(results: dict[str, Any], path: Path) -> None:
    """Time of a step and success rate of the scene with each effect turned over."""
    rows = results["effects"]
    names = [*(n for n in rows if n != AS_IT_IS), AS_IT_IS][::-1]
    figure = output.new_figure(9.6, 5.6)
    left, right = figure.subplots(1, 2, sharey=True)
    for axis, field, ends in (
        (left, "ratio", lambda r: r["ratio_quartiles"]),
        (right, "success", lambda r: (r["success_low"], r["success_high"])),
    ):
        place = [k for k, n in enumerate(names) if field in rows[n]]
        value = np.array([rows[names[k]][field] for k in place])
        low, high = np.array([ends(rows[names[k]]) for k in place]).T
        # A share of 0 or 1 lies on its interval's end but for rounding.
        error = np.maximum([value - low, high - value], 0.0)
        axis.errorbar(value, place, xerr=error, fmt="o", ms=4, capsize=2)
        axis.axvline(rows[AS_IT_IS][field], color="black", lw=0.8, ls="--")
        axis.grid(axis="x", alpha=0.3)
    left.set_yticks(range(len(names)), names)
    left.set(xlabel="time of a step, relative to the scene as it is, quartiles", xlim=(0, None))
    right.set(xlabel="success rate with 95 % interval")
    output.save_figure(figure, path)


def support_table() -> list[list[str]]:
    """What each effect means and which engines have it, in words."""
    table = [["effect", "meaning", *ENGINES]]
    for name, effect in EFFECTS.items():
        cells = []
        for engine in ENGINES:
            refused = effect.refused.get(engine, {})
            words = [f"not {str(v).lower() if isinstance(v, bool) else v}" for v in refused]
            cells.append(", ".join(words) or "yes")
        table.append([f"`{name}`", effect.meaning, *cells])
    return table


def measured_table(results: dict[str, Any]) -> list[list[str]]:
    """A row for each change of the scene; what was not measured is a dash."""
    table = [["change", "µs a step", "time ×", "success (95 %)", "same verdict", "rank corr."]]
    for name, r in results["effects"].items():
        cells = ["–"] * 5
        if "ratio" in r:
            low, high = r["ratio_quartiles"]
            cells[0] = f"{r['step_seconds'] * 1e6:.1f}"
            cells[1] = f"{r['ratio']:.2f} ({low:.2f}–{high:.2f})"
        if "success" in r:
            rank = r["rank_correlation"]
            cells[2] = f"{r['success']:.3f} ({r['success_low']:.3f}–{r['success_high']:.3f})"
            cells[3:] = [f"{r['same_verdict']:.3f}", "–" if rank is None else f"{rank:.3f}"]
        table.append([name, *cells])
    return table


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--json", type=Path, default=DOCS / "data" / "effects.json")
    parser.add_argument("--quick", action="store_true", help="few grasps, few links; not for docs")
    parser.add_argument("--draw", action="store_true", help="draw from the file; measure nothing")
    options = parser.parse_args()
    use_compilation_cache()
    if options.draw:
        results = json.loads(options.json.read_text())
    else:
        links = {"discretization": {"links": 3}} if options.quick else None
        base = scenes.load("paper_spheres", overrides=links)
        results = measure(variants(base), options.json, quick=options.quick)
    if options.quick:
        return draw(results, options.json.with_suffix(".png"))
    draw(results, DOCS / "figures" / "effects.png")
    p, rows = results["provenance"], output.markdown(measured_table(results))
    load = [f"{results[k][0]:.1f}" for k in ("load_before", "load_after")]
    made = f"{results['effects'][AS_IT_IS]['worlds']} grasps, {results['trials']} trials a design; "
    made += f"{p['cpus']} cores of {p['cpu']}, jax {p['jax']}, MuJoCo {p['mujoco']}, commit "
    made += f"{p['commit']}; load of the machine while timing: {' to '.join(load)}."
    output.fill(DOCS / "notes" / "effects.md", f"{made}\n\n{rows}", "measured")
    output.fill(DOCS / "effects.md", output.markdown(support_table()), "support")


if __name__ == "__main__":
    main()
