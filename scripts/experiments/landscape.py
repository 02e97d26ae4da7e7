"""The cost on a grid of two parameters, some points in a call."""

from pathlib import Path

import jax
import numpy as np
from rich.console import Console

from codesign_jax import batch
from codesign_jax.commands import calls
from codesign_jax.commands.calls import Calls, Meter, Trials
from codesign_jax.engines import make_engine
from codesign_jax.scene import InputError, Scene
from codesign_jax.scene.parameters import DesignSpace, design_space
from scripts.experiments.plan import Landscape
from scripts.experiments.strategies import Arrays

STREAM_GRID = 0x67726964
"""Stream of the noise of the grid's trials ("grid")."""


def grid(space: DesignSpace, points: int) -> np.ndarray:
    """Returns the designs of a regular grid, shape (points, points, 2), first parameter first."""
    if space.num_parameters != 2:
        raise ValueError(f"a landscape needs two parameters, got {space.names}")
    axes = [np.linspace(a, b, points) for a, b in zip(space.low, space.high, strict=True)]
    designs = np.stack(np.meshgrid(*axes, indexing="ij"), -1).astype(np.float32)
    return np.asarray(jax.vmap(jax.vmap(space.project))(designs))


def simulate(
    plan: Landscape,
    scene: Scene,
    engine: str,
    part: Path,
    *,
    seed: int,
    chunk: int,
    devices: int | None,
    console: Console,
) -> tuple[Arrays, int]:
    """Simulates every point in the same trials; the same call goes on where it stopped.

    Returns:
      `designs` (point, point, parameter), `trial_cost` and `status` (point, point, trial); and how
      many grasps were found in the file.
    """
    space = design_space(scene.hand, plan.preset)
    designs = grid(space, plan.points)
    flat = designs.reshape(-1, designs.shape[-1])
    trials = Trials(scene, engine, space, plan.trials, seed, (STREAM_GRID,))
    most = max(1, chunk // plan.trials)
    size = calls.equal(len(flat), min(most, -(-len(flat) // len(batch.take(devices)))))
    run = Calls(trials, make_engine(engine, scene), size, part, flat, devices=devices)
    if run.refused:
        raise InputError([f"{part} {run.refused}: choose another --out, or delete it"])
    with Meter(plan.name, plan.grasps, console) as meter:
        outcome = run(flat, meter)
    shape = (plan.points, plan.points, plan.trials)
    found = {"trial_cost": outcome.cost, "status": outcome.status.astype(np.uint8)}
    found = {name: values.reshape(shape) for name, values in found.items()}
    return {"designs": designs, **found}, run.found * plan.trials
