"""`codesign replay` of a failed world: simulated again, and its last good state in MuJoCo C."""

from collections import Counter
from pathlib import Path

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from codesign_jax import model, rollout, runs
from codesign_jax.commands import common
from codesign_jax.engines import make_engine
from codesign_jax.export import grasps, plain
from codesign_jax.runs import failures
from codesign_jax.runs.failures import Failure
from codesign_jax.scene import Scene
from codesign_jax.scene.parameters import DesignSpace, design_space
from codesign_jax.types import MEANINGS, Status, Trace

MOST = 10
"""Failed worlds that a list shows."""


def main(path: Path, engine: str | None) -> int:
    """Replays a failed world; returns the exit status."""
    failure = failures.load(path)
    scene, settings = runs.read_run(path.resolve().parent.parent)
    name = engine or settings.engine
    common.check_engine(name)
    space = design_space(scene.hand, settings.preset)
    h = scene.discretization.timestep
    print(runs.describe(space, failure.design))
    print(f"recorded by {settings.engine}: {_verdict(failure.status, failure.bad_step, h)}")
    for bit in Status(failure.status):
        print(f"  {bit.name}: {MEANINGS[bit]}")
    numbers = zip(("--episode", "--particle", "--trial"), failure.place, strict=True)
    place = " ".join(f"{flag} {number}" for flag, number in numbers)
    print(f"in 3D: codesign replay {path.parent.parent} {place}")
    _again(scene, space, failure, name)
    if failure.state.size:
        _one_step(scene, space, failure)
    return 0


def show_list(folder: Path) -> None:
    """Prints the first failed worlds of a run folder."""
    scene, _ = runs.read_run(folder)
    found = sorted((folder / failures.FOLDER).glob("*.npz"))
    for path in found[:MOST]:
        failure = failures.load(path)
        verdict = _verdict(failure.status, failure.bad_step, scene.discretization.timestep)
        print(f"failed world {path}: {verdict}")
    if found[MOST:]:
        print(f"and {len(found) - MOST} more in {folder / failures.FOLDER}")


def _verdict(status: int, bad_step: int, h: float) -> str:
    when = f", first bad step {bad_step} ({bad_step * h:.2f} s)" if bad_step >= 0 else ""
    return runs.status_names(status) + when


def _world(scene: Scene, space: DesignSpace, failure: Failure):
    return space.params(jnp.asarray(failure.design)), jax.tree.map(jnp.asarray, failure.trial)


def _again(scene: Scene, space: DesignSpace, failure: Failure, name: str) -> None:
    engine = make_engine(name, scene)
    worlds = jax.tree.map(lambda v: v[None], _world(scene, space, failure))
    run = jax.jit(lambda p, t: rollout.simulate(scene, engine, p, t))
    outcome, trace = jax.tree.map(lambda v: np.asarray(v)[0], run(*worlds))
    h = scene.discretization.timestep
    print(f"again in {name}: {_verdict(int(outcome.status), int(outcome.bad_step), h)}")
    if outcome.bad_step < 0:
        print(
            f"  cost {outcome.cost:.3f}, largest speed {np.nanmax(trace.speed):.3g}; at the end "
            f"{_where(trace, -1)}"
        )
        return
    first = max(int(outcome.bad_step) - 3, 0)
    for k in range(first, int(outcome.bad_step) + 1):
        print(f"  step {k}: speed {trace.speed[k]:.4g}, {_where(trace, k)}")


def _where(trace: Trace, k: int) -> str:
    return (
        f"object {trace.height[k]:.4f} m above the table, {trace.distance[k]:.4f} m from the hand"
    )


def _one_step(scene: Scene, space: DesignSpace, failure: Failure) -> None:
    """Takes the step after the last good state in MuJoCo C: is it the state or the engine?"""
    state = model.split(scene, failure.state)
    if not np.isfinite([*state.qpos, *state.qvel]).all():
        print("the world was not finite from its start")
        return
    data = _last_state(scene, space, failure)
    before, acc = np.abs(data.qvel).max(), np.abs(data.qacc).max()
    after = np.abs(data.qvel + data.model.opt.timestep * data.qacc).max()
    # A world that is STUCK went on to its end: no step of it was bad.
    when = "last good state" if failure.bad_step >= 0 else "state at the end"
    print(
        f"{when}: speed {before:.4g}, {_contacts(data)}; "
        f"MuJoCo C goes on with an acceleration of {acc:.4g} to a speed of {after:.4g}"
    )
    for difference in plain.differences(scene):
        print(f"  in MuJoCo C {difference}")


def _last_state(scene: Scene, space: DesignSpace, failure: Failure) -> mujoco.MjData:
    """The last good state in MuJoCo C, with the controls of the step that follows it."""
    params, trial = jax.tree.map(np.asarray, _world(scene, space, failure))
    data = mujoco.MjData(grasps.world(scene, params, trial))
    state = model.split(scene, failure.state)
    data.qpos[:], data.qvel[:] = state.qpos, state.qvel
    controls = grasps.timed_controls(scene, params, trial)[:, 1:]
    # Entry k of a trace is the state before step k, so that step k - 1 led to a bad state k.
    step = failure.bad_step - 1 if failure.bad_step >= 0 else len(controls) - 1
    data.ctrl[:] = controls[np.clip(step, 0, len(controls) - 1)]
    mujoco.mj_forward(data.model, data)
    return data


def _contacts(data: mujoco.MjData) -> str:
    """How many contacts there are, between what, and how deep the deepest is."""
    if not data.ncon:
        return "no contact"
    names = {0: "table", data.model.body("object").id: "object"}
    pairs = data.model.geom_bodyid[data.contact.geom]
    kinds = Counter(tuple(sorted(names.get(int(b), "hand") for b in pair)) for pair in pairs)
    listed = ", ".join(f"{n} of {a} and {b}" for (a, b), n in sorted(kinds.items()))
    depth = -min(data.contact.dist.min(), 0.0)
    return f"contacts: {listed}, deepest {1e3 * depth:.2f} mm"
