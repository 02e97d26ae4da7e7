"""Compares the kernel at several tolerances with MuJoCo C on 2,400 grasps (400 designs x 6 trials).

python -m scripts.accuracy.tolerances --json docs/data/convergence_h200.json      # on a GPU
python -m scripts.accuracy.tolerances --json docs/data/convergence_cpu.json --tolerances 1e-6

Grasps are chaotic: the row of MuJoCo C with every object moved by a micrometre shows how much
agreement two correct simulators can have.
"""

import argparse
import json
import time
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from scipy.stats import spearmanr

from codesign_jax import control, cost, model, rollout, scene
from codesign_jax.engines.mujoco import MujocoEngine
from codesign_jax.engines.structured import StructuredEngine
from codesign_jax.engines.structured.constants import world_constants
from codesign_jax.engines.structured.kernel import Limits, Program
from codesign_jax.scene import parameters
from codesign_jax.types import Trace, failed
from scripts.shared import provenance

SCENE = scene.load("paper_spheres")
SPACE = parameters.design_space(SCENE.hand, "2d")
TRIALS = 6
LIMITS = [(100, 40, 1e-9), (24, 14, 1e-4), (24, 14, 1e-5), (24, 14, 1e-6), (50, 20, 1e-6)]
LIMITS += [(24, 14, 1e-7), (12, 10, 1e-5), (8, 8, 1e-5), (4, 6, 1e-5)]


def worlds(shift: float) -> tuple[model.ModelFields, jax.Array]:
    """Model fields and controls of a 20 x 20 grid of designs, objects moved by `shift` [m]."""
    axes = [np.linspace(a, b, 20) for a, b in zip(SPACE.low, SPACE.high, strict=True)]
    grid = np.stack(np.meshgrid(*axes, indexing="ij"), -1).reshape(-1, 2)
    trials = rollout.sample_trials(SCENE, jax.random.key(0), TRIALS)
    trials = trials._replace(position=trials.position + shift)
    params = jax.vmap(SPACE.params)(jnp.asarray(grid, jnp.float32))
    params = jax.tree.map(lambda v: jnp.repeat(v, TRIALS, 0), params)
    tile = len(grid)
    trials = jax.tree.map(lambda v: jnp.tile(v, (tile,) + (1,) * (v.ndim - 1)), trials)
    fields = jax.jit(jax.vmap(lambda p, t: model.model_fields(SCENE, p, t)))(params, trials)
    return fields, jax.jit(jax.vmap(lambda p, t: control.commands(SCENE, p, t)))(params, trials)


def outcome(trace: Any) -> tuple[np.ndarray, np.ndarray]:
    """Costs and status of a trace."""
    trace = Trace(*map(jnp.asarray, trace))
    result = jax.jit(jax.vmap(lambda t: cost.outcome(SCENE, t)))(trace)
    return np.asarray(result.cost), np.asarray(result.status)


def kernel(limits: Limits, fields: model.ModelFields, ctrl: jax.Array) -> tuple[Any, dict]:
    """Trace of the kernel, and its time, iterations and share of steps above tolerance."""
    engine, program = StructuredEngine(SCENE), Program.here(SCENE, limits, ctrl.dtype)
    run = jax.jit(lambda f, c: program.run(world_constants(SCENE, f), engine.reset(f), c))
    jax.block_until_ready(run(fields, ctrl))
    start = time.perf_counter()
    found = jax.block_until_ready(run(fields, ctrl))
    notes = {
        "seconds": time.perf_counter() - start,
        "iterations": float(found["iterations"].mean()),
        "above_tolerance": float((found["residual"] > limits.tolerance).mean()),
    }
    qpos = jnp.zeros((*ctrl.shape[:2], 0))
    return (found["distance"], found["height"], found["speed"], qpos), notes


def row(name: str, trace: Any, reference: np.ndarray, **notes: float) -> dict:
    """Agreement of a trace's costs with the reference."""
    costs, status = outcome(trace)
    mine, theirs = (c.reshape(-1, TRIALS).mean(1) for c in (costs, reference))
    found = {
        "name": name,
        "success": float((costs < 0.01).mean()),
        "same_verdict": float(((costs < 0.01) == (reference < 0.01)).mean()),
        "rank_correlation": float(spearmanr(mine, theirs).statistic),
        "mean_difference": float((costs - reference).mean()),
        "failed": int(failed(status).sum()),
        **notes,
    }
    print(json.dumps(found), flush=True)
    return found


def main() -> None:
    """Runs the comparison and writes the rows."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--json", type=Path, required=True)
    every = sorted({limits[2] for limits in LIMITS})
    parser.add_argument(
        "--tolerances", nargs="+", type=float, default=every, help="kernels of these only"
    )
    provenance.add_commit(parser)
    args = parser.parse_args()
    here, moved = worlds(0.0), worlds(1e-6)
    oracle = jax.jit(MujocoEngine(SCENE).rollout)
    reference = outcome(oracle(*here))[0]
    rows = [row("mujoco, objects moved 1 um", oracle(*moved), reference)]
    for limits in [x for x in LIMITS if x[2] in args.tolerances]:
        trace, notes = kernel(Limits(*limits), *here)
        name = "kernel {}/{}/{:g}".format(*limits)
        rows.append(row(name, trace, reference, **notes))
    result = {
        **provenance.measurement(args.commit),
        "rows": rows,
    }
    args.json.write_text(json.dumps(result, indent=1) + "\n")


if __name__ == "__main__":
    main()
