"""One side of a comparison: simulates what it is asked for with the package that PYTHONPATH names.

Reads requests from standard input, a JSON object a line, and answers each with one.  Both sides
run this file, so it uses the package's public functions alone.
"""

import json
import os
import sys
import time
import traceback
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from codesign_jax import parameters, rollout, scene
from codesign_jax.engines import make_engine

SEED = 80
"""Seed of designs and trials; no search or study draws from it."""
MICROMETRE = 1e-6
EXACT = {
    "newton": {"decrement": 1e-15, "iterations": 100},
    "solver": {"tolerance": 1e-15, "iterations": 100},
}
"""Both engines' contact solvers, solved to rounding."""
# A whole grasp in 0.6 s: the hand is at the object after 0.2 s, has closed after 0.4 s, and lifts.
HURRIED = {
    "phases": {"approach": 0.2, "inflate": 0.4, "lift": 0.6, "disturb": 0.9, "ungrasp": 1.5},
    "arm": {"start_height": 0.15},
}
GRADIENT_STEPS = 40
# Beyond half a radian a step of 10 ms the kernel's velocity products are no longer MuJoCo's.
SHORT_STEP = {"discretization": {"timestep": 0.002}}
DIFFERENCE = 1e-6
"""Step of the central differences, a share of each parameter's range."""
PROGRAMS: dict[int, Any] = {}
"""Compiled rollouts of the default scene, by the number of grasps of a call."""


def random_designs(count: int) -> list[list[float]]:
    """Uniform designs of the 23 parameters, within the limits of what can be built."""
    space = parameters.design_space(scene.load("paper").hand)
    low, high = space.box
    unit = np.random.default_rng(SEED).random((count, len(low)))
    drawn = jnp.asarray(low + (high - low) * unit, jnp.float32)
    return np.asarray(jax.jit(jax.vmap(space.project))(drawn)).tolist()


def batch(designs: Any, trials: Any) -> tuple[jax.Array, Any]:
    """Every design in every trial, design by design."""
    count = trials.yaw.shape[0]
    index = np.arange(len(designs) * count)
    crossed = jax.tree.map(lambda x: np.asarray(x)[index % count], trials)
    return jnp.asarray(designs, jnp.float32)[index // count], crossed


def compiled(designs: list[list[float]], trials: int) -> dict[str, Any]:
    """Compiles the rollout of a call of so many grasps; how long that takes [processor s].

    Each call of `verdicts` and `rate` then has this many grasps.
    """
    paper = scene.load("paper")
    space = parameters.design_space(paper.hand)
    engine = make_engine("structured", paper)

    @jax.jit
    def run(vectors: jax.Array, drawn: Any) -> Any:
        return rollout.simulate(paper, engine, jax.vmap(space.params)(vectors), drawn)[0]

    drawn = rollout.sample_trials(paper, jax.random.key(SEED), trials)
    arguments = batch(designs, drawn)
    before = time.perf_counter(), time.process_time()
    PROGRAMS[len(arguments[0])] = run.lower(*arguments).compile()
    after = time.perf_counter(), time.process_time()
    return {"seconds": after[0] - before[0], "processor_seconds": after[1] - before[1]}


def verdicts(
    designs: list[list[float]], trials: int, call: int, moved: bool, out: str
) -> dict[str, Any]:
    """Writes costs and status of every design in every trial, arrays (design, trial).

    Args:
      designs: Designs, 23 parameters in SI units.
      trials: Trials of each.
      call: Grasps of a call, as `compiled`.
      moved: Whether the objects begin a micrometre aside.
      out: The .npz file.
    """
    drawn = rollout.sample_trials(scene.load("paper"), jax.random.key(SEED), trials)
    if moved:
        drawn = drawn._replace(position=np.asarray(drawn.position) + np.float32(MICROMETRE))
    vectors, every = batch(designs, drawn)
    parts = []
    for first in range(0, len(vectors), call):
        index = np.minimum(first + np.arange(call), len(vectors) - 1)
        part = jax.tree.map(lambda x, index=index: np.asarray(x)[index], (vectors, every))
        outcome = PROGRAMS[call](jnp.asarray(part[0]), part[1])
        parts.append([np.asarray(outcome.cost), np.asarray(outcome.status)])
    cost, status = (np.concatenate(p)[: len(vectors)] for p in zip(*parts, strict=True))
    shape = len(designs), trials
    np.savez(out, cost=cost.reshape(shape), status=status.reshape(shape), position=drawn.position)
    return {}


def rate(designs: list[list[float]], trials: int) -> dict[str, float]:
    """Seconds of one call: the processor's, and on a GPU those of the clock."""
    drawn = rollout.sample_trials(scene.load("paper"), jax.random.key(SEED), trials)
    arguments = jax.block_until_ready(jax.tree.map(jnp.asarray, batch(designs, drawn)))
    clock = time.process_time if jax.default_backend() == "cpu" else time.perf_counter
    before = clock()
    jax.block_until_ready(PROGRAMS[len(arguments[0])](*arguments))
    return {"seconds": clock() - before}


def traces(worlds: int, engine: str, out: str) -> dict[str, Any]:
    """Writes the path of random grasps in `paper_spheres` in float64, (world, time, nq)."""
    spheres = scene.load("paper_spheres", overrides={**EXACT, **HURRIED, **SHORT_STEP})
    space = parameters.design_space(spheres.hand)
    low, high = space.box
    unit = np.random.default_rng(SEED).random((worlds, len(low)))
    designs = jax.vmap(space.project)(jnp.asarray(low + (high - low) * unit))
    drawn = rollout.sample_trials(spheres, jax.random.key(SEED), worlds)
    simulator = make_engine(engine, spheres)

    @jax.jit
    def run(vectors: jax.Array, drawn: Any) -> Any:
        params = jax.vmap(space.params)(vectors)
        return rollout.simulate(spheres, simulator, params, drawn, record_qpos=True)[1].qpos

    np.savez(out, qpos=run(designs, jax.tree.map(jnp.asarray, drawn)))
    return {"timestep": float(spheres.discretization.timestep)}


def gradients(designs: list[list[float]]) -> dict[str, Any]:
    """Derivatives of the default scene's distances along the design, and central differences.

    In float64, over a closing hand; a random direction for each design.
    """
    paper = scene.load("paper", overrides={**EXACT, **HURRIED})
    space = parameters.design_space(paper.hand)
    low, high = space.box
    random = np.random.default_rng(SEED)
    engine = make_engine("structured", paper)
    trials = rollout.sample_trials(paper, jax.random.key(SEED), len(designs))
    trials = jax.tree.map(jnp.asarray, trials)
    vectors = jnp.asarray(designs, float)
    along = (high - low) * random.normal(size=vectors.shape)
    weights = random.normal(size=GRADIENT_STEPS)

    def value(vector: jax.Array, trial: Any) -> jax.Array:
        trace = rollout.grasp(paper, engine, space.params(vector), trial, steps=GRADIENT_STEPS)
        return trace.distance @ weights

    slope = jax.jit(jax.vmap(jax.grad(value)))(vectors, trials)
    many = jax.jit(jax.vmap(value))
    high_side, low_side = (
        np.asarray(many(vectors + sign * DIFFERENCE * along, trials)) for sign in (1, -1)
    )
    return {
        "derivative": (np.asarray(slope) * along).sum(1).tolist(),
        "difference": ((high_side - low_side) / (2 * DIFFERENCE)).tolist(),
    }


def device() -> dict[str, str]:
    """Where this side simulates, and the package that it uses."""
    return {"backend": jax.default_backend(), "package": str(rollout.__file__)}


REQUESTS: dict[str, Callable[..., dict[str, Any] | list[Any]]] = {
    function.__name__: function
    for function in (compiled, device, gradients, random_designs, rate, traces, verdicts)
}


def serve() -> None:
    """Answers requests until standard input ends."""
    # What libraries print must not come between the answers.
    answers = os.fdopen(os.dup(1), "w", encoding="utf-8")
    os.dup2(2, 1)
    for line in sys.stdin:
        request = json.loads(line)
        try:
            answer = {"answer": REQUESTS[request.pop("request")](**request)}
        except Exception:  # the other side of the pipe decides what it means
            answer = {"error": traceback.format_exc()}
        print(json.dumps(answer), file=answers, flush=True)


if __name__ == "__main__":
    serve()
