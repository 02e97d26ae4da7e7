"""`codesign evaluate --forces` and `--pull`: contact forces of grasps, and the force that ends one.

The pull is a force on the object's centre of mass that grows, beside its weight, slowly enough that
only its size matters.  On a test stand it is a string at the held object and a bucket.
"""

from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from codesign_jax import files, model, rollout
from codesign_jax.engines import Engine
from codesign_jax.judge import sentences
from codesign_jax.policy import ControlLoop
from codesign_jax.report.replay import Replay
from codesign_jax.runs import tables
from codesign_jax.scene import InputError, Scene
from codesign_jax.terminal import Console
from codesign_jax.types import Forces, Params, Trial

RATE = 5.0
"""How fast the pull grows [N/s]."""
MOST = 50.0
"""Largest pull [N]."""
OUT = 0.02
"""How far the object's centre is then from where the hand held it [m]."""


def columns(forces: Forces) -> dict[str, Any]:
    """Forces by the names of their columns, arrays as of one trial."""
    table = {}
    for name in ("finger", "palm", "table", "finger_table", "palm_table"):
        value = getattr(forces, name)
        each = {name: value} if value.ndim == 2 else {}
        each |= {f"{name}_{i}": value[:, i] for i in range(value.shape[1] if not each else 0)}
        for body, vector in each.items():
            table |= {f"{body}_{axis}_N": vector[:, k] for k, axis in enumerate("xyz")}
    fingers = range(forces.grip.shape[1])
    table |= {f"grip_{i}_N": forces.grip[:, i] for i in fingers}
    pairs = [(i, j) for i in fingers for j in fingers[i:]]
    table |= {f"finger_finger_{i}_{j}_N": forces.finger_finger[:, i, j] for i, j in pairs}
    table |= {f"finger_palm_{i}_N": forces.finger_palm[:, i] for i in fingers}
    return table | {f"depth_{kind}_mm": 1e3 * depth for kind, depth in forces.depth.items()}


def write(path: Path, scene: Scene, grasps: list[Replay]) -> None:
    """Writes a row for each time step of each grasp."""
    rows = []
    step = scene.discretization.timestep
    for trial, grasp in enumerate(grasps):
        named = columns(_forces(grasp))
        for k in range(len(grasp.qpos)):
            head = {"trial": trial, "object": _object(scene, grasp), "time_s": step * k}
            rows.append(head | {column: series[k] for column, series in named.items()})
    files.make_folder_of(path)
    tables.write(path, [*rows[0]], rows)


def tell(scene: Scene, grasps: list[Replay], console: Console) -> None:
    """Prints grip and depths of each grasp while a lost object counts."""
    start, end = (int(scene.steps_to(t)) for t in scene.window)
    for grasp in grasps:
        forces = jax.tree.map(lambda v: v[start:end], _forces(grasp))
        grip = " + ".join(f"{v:.2g}" for v in np.median(forces.grip, 0))
        console.print(
            f"{_object(scene, grasp):>12}: grip {grip} N by finger (median); depths: "
            f"{sentences.depths(forces)}"
        )


def _forces(grasp: Replay) -> Forces:
    assert grasp.trace is not None and grasp.trace.forces is not None
    return grasp.trace.forces


def _object(scene: Scene, grasp: Replay) -> str:
    return scene.objects.object[int(grasp.trial.shape)].name


def direction(text: str) -> np.ndarray:
    """Unit vector of what `--pull` was given: down, x, y, z, or three numbers such as 1,0,-1."""
    axes = {"down": (0, 0, -1), "x": (1, 0, 0), "y": (0, 1, 0), "z": (0, 0, 1)}
    try:
        vector = np.array(axes[text] if text in axes else text.split(","), float)
    except ValueError:
        vector = np.zeros(0)
    if vector.shape != (3,) or not np.isfinite(vector).all() or not vector.any():
        words = "must be down, x, y, z or three numbers in the world frame, such as 1,0,-1"
        raise InputError.of("syntax", f"--pull {text} {words}")
    return vector / np.linalg.norm(vector)


def pull(
    scene: Scene, engine: Engine, params: Params, trials: Trial, along: np.ndarray
) -> np.ndarray:
    """Force at which each held object has left its place [N], shape (trial,).

    The hand stands still as at the end of the lift.  What it does not hold by then is NaN, and what
    no force up to `MOST` takes is infinite.

    Args:
      along: Direction of the force on the object's centre of mass, world frame, shape (3,).
    """
    if isinstance(engine, ControlLoop):
        raise InputError.of(
            "conflict", "--pull holds the hand as key frames do: leave out --policy"
        )
    steps = int(scene.last_step("lift")) + 1
    step = scene.discretization.timestep
    hands = jax.tree.map(lambda v: jnp.repeat(v[None], len(trials.yaw), 0), params)
    lay = model.layout(scene)
    joints = lay.dofs.size
    three = np.arange(3)
    linear = 19 + 2 * joints + three  # the object's velocity in a state, see `model.RolloutState`

    def place(state: jax.Array) -> jax.Array:  # of the object, from the palm's
        return state[:, 6 + joints + three] - state[:, three]

    @jax.jit
    def run(hands: Params, trials: Trial) -> jax.Array:
        fields, ctrl = rollout.prepare(scene, hands, trials)
        begun = engine.rollout(fields, ctrl[:, :steps], trajectory=True)
        still = ctrl[:, steps - 1 : steps]
        assert begun.last is not None
        first = place(begun.last)
        mass = fields.object_mass[:, None]

        def goes_on(carry: tuple) -> jax.Array:
            return (carry[0] < MOST) & (jnp.isinf(carry[2]) & kept).any()

        def pulled(carry: tuple) -> tuple:
            # A step finds the velocities at its end, v + h a, from contacts at these: what a force
            # adds to v before it is exact.
            force, state, least_force = carry
            force = force + RATE * step
            start = state.at[:, linear].add(step * force / mass * along)
            trace = engine.rollout(fields._replace(start=start), still, trajectory=True)
            assert trace.last is not None
            out = jnp.linalg.norm(place(trace.last) - first, axis=1) > OUT
            return force, trace.last, jnp.where(out, jnp.minimum(least_force, force), least_force)

        kept = begun.distance[:, -1] < scene.cost.lost_distance
        start = jnp.zeros(()), begun.last, jnp.full_like(begun.distance[:, -1], jnp.inf)
        return jnp.where(kept, jax.lax.while_loop(goes_on, pulled, start)[2], jnp.nan)

    return np.asarray(run(hands, trials))


def in_words(force: float) -> str:
    """What `pull` found of one object."""
    if np.isnan(force):
        return "not held at the end of the lift: nothing to pull at"
    if np.isinf(force):
        return f"holds a pull of more than {MOST:g} N"
    return f"comes out at a pull of {force:.2g} N"
