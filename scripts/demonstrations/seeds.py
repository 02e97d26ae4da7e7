"""First particles of a search by the shape of the closed hand: the check before a study.

A hand is simulated without any contact to the end of the inflation, where its hull should lie
on the object: the mean squared distance of its vertices from the object's surface, over the
trials, is smooth in the design.  Adam moves drawn particles down its gradient.  They are of use
only if whole grasps cost less with them than with the drawn ones, and by more than the gradients.
"""

from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import optax
from scipy.stats import mannwhitneyu

from codesign_jax import codesign, rollout
from codesign_jax.engines import make_engine
from codesign_jax.engines.structured import coordinates
from codesign_jax.engines.structured.laws import hull, shapes
from codesign_jax.engines.structured.laws.kinematics import kinematics
from codesign_jax.engines.structured.world_model import world_constants
from codesign_jax.model import layout
from codesign_jax.scene import Scene, load, parameters
from codesign_jax.types import Trial, failed
from scripts.demonstrations import windows
from scripts.experiments.study import load_study

PARTICLES, TRIALS, STEPS, RATE = 60, 6, 60, 0.02
"""Particles and trials of a 23D run; steps of Adam, and its rate in fractions of the ranges."""
ARMS = ("drawn", "by shape")
"""Names of the seeds as they were drawn and as they were moved."""
DEPTH = 3e-3
"""How deep in the object a hand without contact should stand, as one with contact presses [m]."""
WITHOUT = (
    *("finger_object", "palm_object", "finger_table", "palm_table"),
    *("finger_finger", "finger_palm"),
)


def gaps(scene: Scene, fields: Any, qpos: jax.Array) -> jax.Array:
    """Signed distances of the hull's vertices from the object [m], (vertex, world)."""
    hand = world_constants(scene, fields)
    state = coordinates.reset(scene, fields._replace(start=qpos))
    kin = kinematics(hand, layout(scene).axes, state)
    point = hull.vertices(scene, hand, kin).point
    local = shapes.in_object(kin.object[:, :, None, None], point)
    return shapes.signed_distance(scene, hand, local)[0].reshape(-1, qpos.shape[0])


class Surrogate:
    """The distance of closed hands from objects, in a scene without contact."""

    def __init__(self, scene_name: str, trials: Trial):
        """Prepares it; the trials are those of all particles."""
        off = {"effects": dict.fromkeys(WITHOUT, False)}
        self.scene = load(scene_name, overrides=off)
        self.engine = make_engine("structured", self.scene)
        self.space = parameters.design_space(self.scene.hand, "23d")
        self.trials = trials
        self.steps = round(self.scene.phases.inflate / self.scene.discretization.timestep)
        self.low, self.range = self.space.low, np.asarray(self.space.high) - self.space.low
        self.slopes = jax.jit(jax.value_and_grad(self._total, has_aux=True))

    def _total(self, units: jax.Array) -> tuple[jax.Array, jax.Array]:
        """Sum and values [cm^2] of particles in fractions of the ranges."""
        designs = self.low + units * self.range
        worlds = rollout.crossed(jax.vmap(self.space.params)(designs), self.trials)
        fields, ctrl, _ = rollout.prepare(self.scene, *worlds, self.scene.constants())
        last = self.engine.rollout(fields, ctrl[:, : self.steps]).last
        assert last is not None
        gap = gaps(self.scene, fields, last[:, : fields.qpos.shape[1]]) + DEPTH
        each = (1e4 * gap**2).mean(0).reshape(len(units), -1).mean(1)
        return each.sum(), each

    def descend(self, designs: jax.Array) -> tuple[np.ndarray, list[float], float]:
        """Designs after Adam's steps, the mean values on the way, and the seconds."""
        units = jnp.asarray((designs - self.low) / self.range, jnp.float32)
        adam = optax.adam(RATE)
        state, values, seconds = adam.init(units), [], 0.0
        jax.block_until_ready(self.slopes(units))  # compiled before it is timed
        for _ in range(STEPS):
            ((_, each), slope), used = windows.timed(self.slopes, units)
            seconds += used
            values.append(float(each.mean()))
            move, state = adam.update(slope, state)
            units = jnp.clip(optax.apply_updates(units, move), 0.0, 1.0)
        project = jax.jit(jax.vmap(self.space.project))
        return np.asarray(project(self.low + units * self.range)), values, seconds


def check(scene: Scene, surrogate: Surrogate) -> dict[str, Any]:
    """Costs of whole grasps of drawn particles, and of the same ones moved by shape."""
    engine, space = make_engine("structured", scene), surrogate.space
    keys = jax.random.split(jax.random.key(1), 2)
    drawn = np.asarray(space.sample(keys[0], PARTICLES))
    moved, values, seconds = surrogate.descend(drawn)
    fresh = rollout.sample_trials(scene, keys[1], TRIALS)
    judge = jax.jit(lambda d: rollout.evaluate(scene, engine, jax.vmap(space.params)(d), fresh))
    windows.timed(judge, drawn)
    found: dict[str, Any] = {"values": values, "seconds": seconds}
    for name, designs in {"drawn": drawn, "by shape": moved}.items():
        outcome, found["episode_seconds"] = windows.timed(judge, designs)
        good = ~failed(np.asarray(outcome.status))
        cost = np.where(good, outcome.cost, np.nan)
        found[name] = {
            "cost": float(np.nanmean(cost)),
            "best": float(np.nanmin(np.nanmean(cost, 1))),
            "kept": float((np.isinf(np.asarray(outcome.lost_time)) & good).mean()),
            "failed": float((~good).mean()),
        }
        print(name, found[name], flush=True)
    return found


def run(scene: Scene, runs: int = 30, episodes: int = 12) -> dict[str, Any]:
    """Runs of the particle filter from the seeds of the paper's experiment, as drawn and moved.

    Args:
      scene: The scene.
      runs: How many of the experiment's seeds.
      episodes: Episodes of each; a run that has not converged by then counts as never.
    """
    study = load_study(Path(__file__).parents[2] / "docs" / "data" / "paper_fingers", "23d")
    assert study is not None
    surrogate = Surrogate(scene.name, rollout.sample_trials(scene, jax.random.key(0), TRIALS))
    found: dict[str, Any] = {"check": check(scene, surrogate)}
    second = study.per_episode / found["check"]["episode_seconds"]  # simulations of a second
    drawn = study.data["seeds"][:runs]
    moved, values, seconds = surrogate.descend(drawn)
    space = surrogate.space
    task, optimizer = codesign.Task(scene, space, TRIALS), codesign.make_filter(space)
    many = jax.jit(jax.vmap(lambda state: task.episode(optimizer, state)))
    keys = jax.vmap(jax.random.key)(np.tile(np.arange(runs), 2))  # equal noise in both halves
    state = jax.vmap(lambda key, start: optimizer.init(key, start, PARTICLES))(
        keys, jnp.asarray(np.concatenate([drawn, moved]))
    )
    means = []
    for k in range(episodes):
        state, info = many(state)
        means.append(np.asarray(info.selection.mean_cost))
        halves = [float(np.median(half)) for half in np.split(means[-1], 2)]
        print(f"episode {k + 1}: medians of the mean costs, drawn and moved {halves}", flush=True)
    ends = [codesign.convergence_episode(m) for m in np.transpose(means)]
    needed = np.array([np.inf if e is None else e + 1.0 for e in ends]) * study.per_episode
    needed = dict(zip(ARMS, np.split(needed, 2), strict=True))
    needed["by shape"] += seconds / runs * second  # what the gradients cost counts too
    test = mannwhitneyu(needed["by shape"], needed["drawn"], alternative="less")
    both = dict(zip(ARMS, np.split(np.array(means), 2, axis=1), strict=True))
    found |= {"values": values, "seconds": seconds, "p": float(test.pvalue)}
    found["means"] = {name: mean.tolist() for name, mean in both.items()}
    found["simulations"] = {name: count.tolist() for name, count in needed.items()}
    found["median"] = {name: float(np.median(count)) for name, count in needed.items()}
    return found
