"""What a gradient of whole grasps costs beside the grasps themselves."""

import time
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from codesign_jax.engines.structured import StructuredEngine
from codesign_jax.scene import Scene
from scripts.shared import work

REPETITIONS = 5
"""Runs of each program; the fastest one counts."""


def cost(scene: Scene, worlds: int, wait: Callable[[], Any] = lambda: None) -> dict[str, Any]:
    """Times of forward passes, of the reverse pass and of both, of worlds in float32.

    On a CPU they are processor time, of all threads, which other programs do not change.

    Returns:
      Seconds by name: "forward", "recorded" (the forward pass of a derivative), "reverse" and
      "value_and_gradient", and of each the time of its compile, "..._compile"; the ratios to the
      forward pass, and the part of the worlds whose gradient is finite.
    """
    fields, ctrl = work.inputs(scene, work.make_worlds(scene, worlds))
    fields, ctrl = jax.tree.map(lambda x: jnp.asarray(x, jnp.float32), (fields, ctrl))
    engine = StructuredEngine(scene)
    weights = jnp.asarray(np.random.default_rng(0).normal(size=ctrl.shape[1]), jnp.float32)

    def value(fields: Any, ctrl: jax.Array) -> jax.Array:
        return (engine.rollout(fields, ctrl).distance @ weights).sum()

    # The first one has to be compiled in whole; the others find parts of it in the process.
    programs: dict[str, tuple[Callable, tuple]] = {
        "value_and_gradient": (jax.value_and_grad(value, (0, 1)), (fields, ctrl)),
        "forward": (value, (fields, ctrl)),
        "recorded": (lambda *x: jax.vjp(value, *x), (fields, ctrl)),
    }
    clock = time.process_time if jax.default_backend() == "cpu" else time.perf_counter
    found: dict[str, Any] = {"worlds": worlds, "steps": ctrl.shape[1], "clock": clock.__name__}
    compiled = {n: _compiled(found, clock, n, *p) for n, p in programs.items()}
    _, pull = compiled["recorded"](fields, ctrl)
    one = jnp.ones((), jnp.float32)
    programs["reverse"] = (lambda pull, bar: pull(bar), (pull, one))
    compiled["reverse"] = _compiled(found, clock, "reverse", *programs["reverse"])
    wait()
    for name, (_, arguments) in programs.items():
        found[name] = min(_seconds(clock, compiled[name], arguments) for _ in range(REPETITIONS))
    for name in ("reverse", "value_and_gradient"):
        found[f"{name}_ratio"] = found[name] / found["forward"]
    _, bars = compiled["value_and_gradient"](fields, ctrl)
    each = [np.isfinite(x).reshape(worlds, -1).all(1) for x in jax.tree.leaves(bars)]
    return found | {"finite": float(np.all(each, 0).mean())}


def _compiled(
    found: dict[str, Any], clock: Callable, name: str, function: Callable, arguments: tuple
) -> Callable:
    begin = clock()
    compiled = jax.jit(function).lower(*arguments).compile()
    found[f"{name}_compile"] = clock() - begin
    jax.block_until_ready(compiled(*arguments))
    return compiled


def _seconds(clock: Callable, function: Callable, arguments: tuple) -> float:
    begin = clock()
    jax.block_until_ready(function(*arguments))
    return clock() - begin
