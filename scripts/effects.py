"""What each effect costs and decides: python -m scripts.effects [--quick] [--page].

Measures the default scene with each effect turned over, on designs that searches recommend,
writes docs/data/effects.json and fills in docs/effects.md; --page only fills in.  Times are of
`STEPS` steps from the middle of the lift on.  About 15 minutes on two idle cores.
"""

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
from codesign_jax.scene import Effects, Scene, parameters, silicones
from codesign_jax.scene.effects import EFFECTS, ENGINES, refusals
from codesign_jax.types import failed
from scripts.shared import output, provenance, work
from scripts.shared.statistics import two_way

DOCS = Path(__file__).parents[1] / "docs"
PAGE = DOCS / "effects.md"
DATA = DOCS / "data" / "effects.json"
AS_IT_IS = "as it is"
STEPS = 20
ROUNDS = 9
TIMED = 6
"""Time steps of a call, calls of each program, and designs whose grasps are timed."""


def variants(base: Scene) -> dict[str, Scene]:
    """The scene with each effect turned over, by what changed."""
    changes: dict[str, dict[str, Any]] = {}
    for field in dataclasses.fields(base.effects):
        now = getattr(base.effects, field.name)
        for value in field.metadata.get("options", (not now,)):
            if value != now:
                word = {True: "on", False: "off"}.get(value, value)
                changes[f"{field.name} {word}"] = {field.name: value}
    by_change = {AS_IT_IS: base} | {
        name: changed(base, **change) for name, change in changes.items()
    }
    return {n: v for n, v in by_change.items() if not refusals(v.effects, "structured")}


def changed(base: Scene, **effects: Any) -> Scene:
    if "neo_hookean" in effects:  # a modulus belongs to its law
        base = silicones.under(base, neo_hookean=effects["neo_hookean"])
    return dataclasses.replace(base, effects=dataclasses.replace(base.effects, **effects))


def grasps(base: Scene, designs: int, trials: int) -> work.Worlds:
    """What searches recommend in their first seeds, each design in the same trials."""
    space = parameters.design_space(base.hand, "23d")
    params = jax.vmap(space.params)(jnp.asarray(work.winners()[:designs], jnp.float32))
    drawn = rollout.sample_trials(base, jax.random.key(0), trials)
    return work.Worlds(*rollout.crossed(base, params, drawn)[1:])


def decide(variant: Scene, worlds: work.Worlds) -> tuple[np.ndarray, np.ndarray]:
    """Which grasps are kept, and where they are in the middle of the lift, shape (world, nq)."""
    engine = make_engine("structured", variant)
    step = middle(variant)

    @jax.jit
    def run(params: Any, trials: Any) -> tuple[Any, Any]:
        outcome, trace = rollout.simulate(variant, engine, params, trials, record_qpos=True)
        return outcome, trace.qpos[:, step - 1]

    outcome, qpos = run(*worlds)
    kept = (np.asarray(outcome.cost) < SUCCESS_COST) & ~failed(np.asarray(outcome.status))
    return kept, np.asarray(qpos)


def middle(scene: Scene) -> int:
    """The time step in the middle of the lift."""
    ends = scene.phase_ends
    return int(scene.steps_to((ends["inflate"] + ends["lift"]) / 2))


def program(variant: Scene, worlds: work.Worlds, start: np.ndarray) -> tuple[Any, tuple]:
    """A compiled program of some steps from the middle of the lift on, and its arguments."""
    fields, ctrl = work.inputs(variant, worlds)
    fields = fields._replace(start=jnp.asarray(start, fields.start.dtype))
    step = middle(variant)
    engine = make_engine("structured", variant)
    args = (fields, ctrl[:, step : step + STEPS])
    run = jax.jit(lambda f, c: engine.rollout(f, c).distance[:, -1])
    return run.lower(*args).compile(), args


def measure(everything: dict[str, Scene], path: Path, *, commit: str | None, quick: bool) -> None:
    """Measures all and writes the file."""
    designs, trials = (6, 3) if quick else (30, 12)
    results: dict[str, Any] = {"designs": designs, "trials": trials, "effects": {}}
    results["intervals"] = "over designs and trials"
    results["provenance"] = provenance.measurement(commit)
    # Processes that are bound to some of the cores leave the others to other programs.
    results["machine_cpus"] = os.cpu_count()
    worlds = grasps(everything[AS_IT_IS], designs, trials)
    few = jax.tree.map(lambda v: np.asarray(v)[: TIMED * trials], worlds)
    programs = {}
    expected = None
    for name, variant in everything.items():
        kept, start = decide(variant, worlds)
        expected = kept if expected is None else expected
        [rate] = two_way(lambda k: [float(k.mean())], kept.reshape(designs, trials))
        shares = {"success": rate.value, "success_low": rate.low, "success_high": rate.high}
        results["effects"][name] = shares | {"same_verdict": float((kept == expected).mean())}
        print(name, results["effects"][name], flush=True)
        programs[name] = program(variant, few, start[: TIMED * trials])
    times: dict[str, list[float]] = {name: [] for name in programs}
    load = [os.getloadavg()[0]]
    for _ in range(ROUNDS + 1):  # in turn, so that a busy machine slows all alike
        for name, (run, args) in programs.items():
            begin = time.perf_counter()
            jax.block_until_ready(run(*args))
            times[name].append((time.perf_counter() - begin) / STEPS / (TIMED * trials))
    results["load"] = [*load, os.getloadavg()[0]]
    for name, seconds in times.items():
        ratios = np.array(seconds[1:]) / np.array(times[AS_IT_IS][1:])  # the first round warms up
        results["effects"][name] |= {
            "step_seconds": float(np.median(seconds[1:])),
            "ratio": float(np.median(ratios)),
            "ratio_quartiles": [float(q) for q in np.quantile(ratios, [0.25, 0.75])],
        }
    output.write_json(path, results)


def support_table() -> list[list[str]]:
    """What each effect means and which engines have it, in words."""
    table = [["effect", "meaning", *ENGINES]]
    options = {f.name: f.metadata.get("options") for f in dataclasses.fields(Effects)}
    for name, effect in EFFECTS.items():
        values = {v: v for v in options[name] or ()} or {True: "true", False: "false"}
        cells = []
        for engine in ENGINES:
            refused = effect.refused.get(engine, {})
            hull = "hull" in EFFECTS["surface"].refused.get(engine, {})
            idle = hull and "with the hull" in effect.meaning
            if refused:
                cells.append("only " + ", ".join(w for v, w in values.items() if v not in refused))
            else:
                cells.append("no hull" if idle else "yes")
        table.append([f"`{name}`", effect.meaning, *cells])
    return table


def measured(results: dict[str, Any]) -> str:
    """What measured, and a row for each change of the scene."""
    table = [["change", "same verdicts", "success (95 %)", "time of a step (quartiles)"]]
    for name, r in results["effects"].items():
        if r["success_high"] < 0.02:  # nothing is held: there is no grasp to time
            continue
        low, high = r["ratio_quartiles"]
        cells = [f"{100 * r['same_verdict']:.1f} %", f"{100 * r['success']:.1f} %"]
        cells[1] += f" ({100 * r['success_low']:.1f} to {100 * r['success_high']:.1f})"
        table.append([name, *cells, f"× {r['ratio']:.2f} ({low:.2f} to {high:.2f})"])
    p = results["provenance"]
    load = results["load"]
    caption = (
        f"{results['designs']} designs in {results['trials']} trials each; intervals of success "
        f"{results['intervals']}; {p['cpus']} of the machine's {results['machine_cpus']} cores, "
        f"jax {p['jax']}; timed while other programs used the machine (load average "
        f"{max(load):.0f})."
    )
    return f"{caption}\n\n{output.markdown(table)}"


def main() -> None:
    parser = provenance.parser(__doc__)
    parser.add_argument("--json", type=Path, default=DATA)
    parser.add_argument("--quick", action="store_true", help="few grasps, few links; not for docs")
    parser.add_argument("--page", action="store_true", help="fill in the page and measure nothing")
    options = parser.parse_args()
    use_compilation_cache()
    if not options.page:
        links = {"discretization": {"links": 3}} if options.quick else None
        base = scenes.load("paper", overrides=links)
        measure(variants(base), options.json, commit=options.commit, quick=options.quick)
    if not options.quick:
        output.fill(PAGE, measured(json.loads(options.json.read_text())), "measured")
        output.fill(PAGE, output.markdown(support_table()), "support")


if __name__ == "__main__":
    main()
