"""Simulates random particles of the whole parameter table and counts the worlds that fail.

python -m scripts.random_particles --worlds 100000 --json docs/data/random_particles.json

The file is written after every chunk, so that what was simulated before an interruption is kept.
"""

import argparse
import json
import time
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np

from codesign_jax import rollout, scene, types
from codesign_jax.batch import LIMIT
from codesign_jax.engines.structured import StructuredEngine
from codesign_jax.scene import parameters
from codesign_jax.types import Status
from scripts.shared import output, provenance


def particles(space: parameters.DesignSpace, seed: int, count: int) -> jax.Array:
    """Uniform particles of the table under the pressure limit, shape (particle, parameter)."""
    low, high = np.array(space.low), np.array(space.high)
    unit = np.random.default_rng(seed).random((count, len(low)))
    return jax.vmap(space.project)(jnp.asarray(low + (high - low) * unit, jnp.float32))


def main() -> None:
    """Runs the particles chunk by chunk and writes counts and rates."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--worlds", type=int, default=100_000)
    parser.add_argument("--chunk", type=int, default=LIMIT)
    parser.add_argument("--scene", default="paper")
    parser.add_argument("--iterations", type=int, default=24)
    parser.add_argument("--evaluations", type=int, default=14)
    provenance.add_commit(parser)
    parser.add_argument("--json", type=Path, required=True)
    args = parser.parse_args()
    the_scene = scene.load(args.scene)
    space = parameters.design_space(the_scene.hand)
    engine = StructuredEngine(
        the_scene, iterations=args.iterations, evaluations=args.evaluations, tolerance=1e-6
    )

    @jax.jit
    def run(designs: jax.Array, key: jax.Array):
        trials = rollout.sample_trials(the_scene, key, designs.shape[0])
        return rollout.simulate(the_scene, engine, jax.vmap(space.params)(designs), trials)[0]

    chunks = -(-args.worlds // args.chunk)
    seconds, status, cost, failures, result = [], [], [], [], {}
    for c in range(chunks):
        designs = particles(space, c, args.chunk)
        start = time.perf_counter()
        result = jax.block_until_ready(run(designs, jax.random.key(c)))
        seconds.append(time.perf_counter() - start)
        status.append(np.asarray(result.status))
        cost.append(np.asarray(result.cost))
        print(
            f"chunk {c + 1}/{chunks}: {seconds[-1]:.1f} s, failed {types.failed(status[-1]).sum()}"
        )
        for world in np.flatnonzero(types.failed(status[-1]))[:100]:
            bits = Status(int(status[-1][world]))
            bad = int(result.bad_step[world])
            failures.append({"chunk": c, "world": int(world), "status": bits.name, "step": bad})
        result = summary(args, the_scene, status, cost, seconds) | {"failures": failures}
        output.write_json(args.json, result, indent=2)
    print(json.dumps(result | {"failures": len(failures)}, indent=2))


def summary(args, the_scene, status: list, cost: list, seconds: list) -> dict:
    """Counts and rates of the chunks so far, with their provenance."""
    bits, costs = np.concatenate(status), np.concatenate(cost)
    steady = float(np.median(seconds[1:] or seconds))
    return {
        **provenance.measurement(args.commit),
        "scene": args.scene,
        "worlds": int(bits.size),
        "steps_per_world": the_scene.num_steps,
        "iterations": args.iterations,
        "evaluations": args.evaluations,
        "failed": {s.name: int((bits & s != 0).sum()) for s in Status if s},
        "kept_to_the_end": float((costs == 0).mean()),
        "first_chunk_with_compile_s": seconds[0],
        "world_steps_per_s": args.chunk * the_scene.num_steps / steady,
        "grasps_per_s": args.chunk / steady,
        "chunk": args.chunk,
    }


if __name__ == "__main__":
    main()
