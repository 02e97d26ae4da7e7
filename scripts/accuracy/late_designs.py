"""Late designs of the default scene at finer steps, links and meshes, and how deep fingers cross.

python -m scripts.accuracy.late_designs --json docs/data/late_designs.json

The designs are final particles of the 23-parameter searches in docs/data/paper_fingers, which were
made before fingers touched the palm.  The table of the hard cases reads the file (case 24 and 35).
"""

import argparse
import sys
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from codesign_jax import rollout
from codesign_jax.cost import particle_cost
from codesign_jax.engines.structured import StructuredEngine
from codesign_jax.scene import Scene, load, parameters
from codesign_jax.types import Params, Status, Trial, failed
from scripts.accuracy import decision
from scripts.shared import depths, output, provenance

SETTINGS: dict[str, dict[str, Any]] = {
    "h": {},
    "h/2": {"timestep": 0.005},
    "h/4": {"timestep": 0.0025},
    "20 links": {"links": 20},
    "4 x 16 points": {"hull_rings": 4, "hull_points": 16},
}
SEED = 24


def simulated(
    scene: Scene, designs: np.ndarray, trials: int, chunk: int, *, deep: bool
) -> dict[str, np.ndarray]:
    """Status, and cost of trials, shape (design, trial); and depths of the fingers at the release.

    Args:
      scene: The scene.
      designs: Designs [SI], shape (design, parameter).
      trials: Trials of a design, the same for all.
      chunk: Designs of a call.
      deep: Whether to find the depths.
    """
    engine = StructuredEngine(scene)
    drawn = rollout.sample_trials(scene, jax.random.key(SEED), trials)
    step = int(scene.last_step("disturb"))

    @jax.jit
    def run(designs: jax.Array):
        params = jax.vmap(lambda v: parameters.unflatten(scene.hand, v))(designs)
        worlds = jax.tree.map(lambda v: jnp.repeat(v, trials, 0), params)
        each = jax.tree.map(lambda v: jnp.tile(v, (len(designs), *[1] * (v.ndim - 1))), drawn)
        found, trace = rollout.simulate(scene, engine, worlds, each, record_qpos=deep)
        return found.status, found.cost, trace.qpos[:, step] if deep else None, worlds, each

    parts = []
    for first in range(0, len(designs), chunk):
        status, cost, qpos, worlds, each = jax.tree.map(
            np.asarray, run(jnp.asarray(designs[first : first + chunk], jnp.float32))
        )
        part = {"status": status, "cost": cost}
        if deep:
            part["depth"] = deepest(scene, worlds, each, qpos)
        parts.append(part)
    return {
        name: np.concatenate([p[name] for p in parts]).reshape(len(designs), trials)
        for name in parts[0]
    }


def deepest(scene: Scene, params: Params, trials: Trial, qpos: np.ndarray) -> np.ndarray:
    """How deep the fingers of hands are in one another [m], shape (world,)."""
    found = []
    for world, q in enumerate(qpos):
        mine = jax.tree.map(lambda v, world=world: v[world], (params, trials))
        at = depths.poses(depths.compiled(scene, *mine), q[None])
        found.append(depths.in_fingers(scene, mine[0], at)[0][0])
    return np.array(found)


def told(scene: Scene, found: dict[str, np.ndarray]) -> dict[str, Any]:
    """What the file keeps of a setting: a letter a trial, a text a design, and mean costs."""
    status = found["status"]
    letters = np.where(found["cost"] == 0, "k", "l")
    letters = np.where(failed(status), np.where(status & Status.STUCK, "s", "f"), letters)
    from codesign_jax.types import Outcome

    outcome = Outcome(jnp.asarray(found["cost"]), jnp.asarray(status), 0.0, 0)  # type: ignore[arg-type]
    cost = np.asarray(particle_cost(scene, outcome))
    kept = {"trials": ["".join(row) for row in letters], "cost": [round(float(c), 4) for c in cost]}
    if "depth" in found:
        kept["depth_mm"] = [[round(1e3 * float(d), 1) for d in row] for row in found["depth"]]
    return kept


def main() -> int:
    """Runs the command and returns the exit status."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--json", type=Path, required=True)
    parser.add_argument("--data", type=Path, default=Path("docs/data/paper_fingers"))
    parser.add_argument("--designs", type=int, default=60)
    parser.add_argument("--trials", type=int, default=24)
    parser.add_argument("--trials-at-h", type=int, default=96, help="a multiple of --trials")
    parser.add_argument("--chunk", type=int, default=10, help="designs of a call")
    parser.add_argument("--settings", default=",".join(SETTINGS))
    provenance.add_commit(parser)
    args = parser.parse_args()
    designs = decision.populations(args.data, args.designs)["late"]
    found: dict[str, Any] = {"designs": args.designs, **provenance.results(args.commit)}
    found["settings"] = {}
    for name in args.settings.split(","):
        scene = load("paper", overrides={"discretization": SETTINGS[name]})
        count = args.trials_at_h if name == "h" else args.trials
        made = simulated(scene, designs, count, args.chunk, deep=name == "h")
        found["settings"][name] = told(scene, made)
        output.write_json(args.json, found)
        print(name, flush=True)
    return 0


if __name__ == "__main__":
    sys.exit(main())
