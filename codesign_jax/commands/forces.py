"""`codesign evaluate --forces` and `--pull`: contact forces of grasps, and the force that ends one.

The pull is a weight that grows: downwards, on the object's centre of mass, slowly enough that only
its size matters.  On a test stand it is a string at the held object and a bucket.
"""

from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from rich.console import Console

from codesign_jax import model, rollout
from codesign_jax.engines import Engine
from codesign_jax.policy import ControlLoop
from codesign_jax.report import verdicts
from codesign_jax.runs import tables
from codesign_jax.runs.choice import Case
from codesign_jax.scene import InputError, Scene
from codesign_jax.types import Forces, Params, Trace, Trial

RATE = 5.0
"""How fast the pull grows [N/s]."""
MOST = 50.0
"""Largest pull [N]."""
OUT = 0.02
"""How far the object's centre is then from where the hand held it [m]."""
_PERIOD = 0.05
"""Seconds after which it grows [s]."""


def record(case: Case, params: Params, trials: Trial) -> Trace:
    """Whole grasps of the case's design with their forces, arrays of shape (trial, time, ...)."""
    engine, count = case.make_engine(), len(trials.yaw)
    hands = jax.tree.map(lambda v: jnp.repeat(v[None], count, 0), params)

    def run(hands: Params, trials: Trial) -> Trace:
        worlds = case.scene, engine, hands, trials
        return rollout.simulate(*worlds, stop_when_lost=False, record_forces=True)[1]

    return jax.tree.map(np.asarray, jax.jit(run)(hands, trials))


def columns(forces: Forces) -> dict[str, Any]:
    """Forces by the names of their columns, arrays as of one trial."""
    found = {}
    for name in ("finger", "palm", "table", "finger_table", "palm_table"):
        value = getattr(forces, name)
        each = {name: value} if value.ndim == 2 else {}
        each |= {f"{name}_{i}": value[:, i] for i in range(value.shape[1] if not each else 0)}
        for who, vector in each.items():
            found |= {f"{who}_{axis}_N": vector[:, k] for k, axis in enumerate("xyz")}
    found |= {f"grip_{i}_N": forces.grip[:, i] for i in range(forces.grip.shape[1])}
    return found | {f"depth_{kind}_mm": 1e3 * depth for kind, depth in forces.depth.items()}


def write(path: Path, scene: Scene, trace: Trace, trials: Trial) -> None:
    """Writes a row for each time step of each trial."""
    assert trace.forces is not None
    rows, step = [], scene.discretization.timestep
    for trial in range(len(trials.yaw)):
        forces = jax.tree.map(lambda v, t=trial: v[t], trace.forces)
        name = scene.objects.object[int(trials.shape[trial])].name
        named = columns(forces)
        for k in range(trace.distance.shape[1]):
            head = {"trial": trial, "object": name, "time_s": step * k}
            rows.append(head | {column: series[k] for column, series in named.items()})
    tables.write(path, [*rows[0]], rows)


def tell(scene: Scene, trace: Trace, trials: Trial, console: Console) -> None:
    """Prints grip and depths of each trial while a lost object counts."""
    assert trace.forces is not None
    start, end = (int(scene.steps_to(t)) for t in scene.window)
    for trial in range(len(trials.yaw)):
        forces = jax.tree.map(lambda v, t=trial: v[t, start:end], trace.forces)
        name = scene.objects.object[int(trials.shape[trial])].name
        grip = " + ".join(f"{v:.2g}" for v in np.median(forces.grip, 0))
        console.print(
            f"{name:>12}: grip {grip} N by finger (median); depths: {verdicts.depths(forces)}"
        )


def pull(scene: Scene, engine: Engine, params: Params, trials: Trial) -> np.ndarray:
    """Pull downwards at which each held object has left its place [N], shape (trial,).

    The hand stands still as at the end of the lift.  What it does not hold by then is NaN, and what
    no pull up to `MOST` takes is infinite.

    Args:
      trials: Trials with leading axis (trial,).

    Raises:
      InputError: If the scene has no gravity, or a policy commands the hand.
    """
    if not scene.effects.gravity:
        raise InputError(["--pull is a weight, and effects.gravity is off"])
    if isinstance(engine, ControlLoop):
        raise InputError(["--pull holds the hand as key frames do: leave out --policy"])
    held = int(scene.last_step("lift")) + 1
    steps = max(1, round(_PERIOD / scene.discretization.timestep))
    count = round(MOST / RATE / steps / scene.discretization.timestep)
    hands = jax.tree.map(lambda v: jnp.repeat(v[None], len(trials.yaw), 0), params)

    @jax.jit
    def run(hands: Params, trials: Trial) -> tuple[jax.Array, jax.Array]:
        fields, ctrl, _ = rollout.prepare(scene, hands, trials, scene.constants())
        begun = engine.rollout(fields, ctrl[:, :held], trajectory=True)
        assert begun.last is not None
        still = jnp.repeat(ctrl[:, held - 1 : held], steps, 1)
        body = model.layout(scene).object

        def period(state: jax.Array, force: jax.Array) -> tuple[jax.Array, jax.Array]:
            mass = fields.body_mass.at[:, body].add(force / scene.gravity)
            trace = engine.rollout(
                fields._replace(body_mass=mass, start=state), still, trajectory=True
            )
            assert trace.last is not None
            return trace.last, trace.distance[:, -1]

        force = RATE * steps * scene.discretization.timestep * jnp.arange(1, count + 1)
        return begun.distance[:, -1], jax.lax.scan(period, begun.last, force)[1].T

    first, distance = map(np.asarray, run(hands, trials))
    out = distance > first[:, None] + OUT
    force = RATE * steps * scene.discretization.timestep * np.arange(1, count + 1)
    found = np.where(out.any(1), force[out.argmax(1)], np.inf)
    return np.where(first < scene.cost.lost_distance, found, np.nan)


def in_words(force: float) -> str:
    """What `pull` found of one object."""
    if np.isnan(force):
        return "not held at the end of the lift: nothing to pull at"
    if np.isinf(force):
        return f"holds a pull of more than {MOST:g} N"
    return f"comes out at a pull of {force:.2g} N"
