# ---
# jupyter:
#   jupytext:
#     formats: ipynb,py:percent
#     text_representation:
#       extension: .py
#       format_name: percent
#   kernelspec:
#     display_name: Python 3
#     language: python
#     name: python3
# ---

# %% [markdown]
# # Close a hand by touch
#
# Objects of 50 to 500 g look alike: a hand that does not know which one it has presses hard enough
# for the heaviest.  Here a small policy feels what the fingers carry and presses as hard as that
# needs.  It is trained on `codesign_jax.env` by CMA-ES, and compared with the best pressures that
# feel nothing, found by the same search, in the same trials.  `CODESIGN_FAST=1` shrinks the
# notebook to a check that it runs.
#
# Brax's trainers take the environment as it is (`tests/test_env.py`), but the PPO of brax 0.14.2
# calls `jax.device_put_replicated`, which JAX 0.10 no longer has.

# %%
import os

import jax
import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np
from evosax.algorithms import CMA_ES

from codesign_jax import env, parameters, scene, use_compilation_cache

use_compilation_cache()
FAST = bool(os.environ.get("CODESIGN_FAST"))
noise = {"mass_range": 10.0, "position": 0.002, "orientation": 2.0}
changes = {"objects": {"noise": noise}, "effects": {"ungrasp": False}}
if not FAST:  # a short grasp
    changes["phases"] = {"approach": 0.8, "inflate": 1.6, "lift": 2.2, "disturb": 4.0}
grasping = scene.load("quick.toml" if FAST else "paper_spheres", overrides=changes)
space = parameters.design_space(grasping.hand)
good = {"length": 86, "height": 24.5, "wall": 5, "spread": 55, "arm_z": 58, "pressure": 120}
design = [
    good.get(n.split("[")[0], v)
    for n, v in zip(space.names, space.in_units(space.default()), strict=True)
]
hand = space.params(space.default() if FAST else space.from_units(np.array(design)))


# %% [markdown]
# ## The task
#
# An action multiplies the pressures of the key frames by 0 to 2.  A grasp earns the share of the
# time that counts in which it holds the object, and half of that if it takes all the pressure that
# the walls stand.


# %%
class Touch(env.GraspEnv):
    """Its observation is (finger, feature), flat: times and what each finger feels."""

    def observe(self, seen):
        one = jnp.ones(self.scene.num_fingers)
        forces = seen.forces
        carried = (forces.finger.sum(0) + forces.palm)[2]
        closed, lifted = (seen.phase >= k for k in (1, 2))
        bend = seen.joint[..., 0].sum(-1)
        table = forces.table[2]
        each = [one, one * closed, one * lifted, one * carried, forces.grip]
        return jnp.stack([*each, forces.finger[:, 2], bend, one * table], 1).ravel()

    def act(self, seen, action):
        return seen.plan._replace(pressure=seen.plan.pressure * (1.0 + action))

    def reward(self, before, command, after, held):
        return held * (1.0 - 0.5 * (command.pressure / self.limit).mean())


task = Touch(grasping, hand, period=0.1)
fingers = grasping.num_fingers
features = task.observation_size // fingers


def by_time(weights, obs):
    """Pressures of each finger in the phases, whatever is felt."""
    return jnp.tanh((obs.reshape(fingers, features)[:, :3] * weights.reshape(fingers, 3)).sum(1))


def by_touch(weights, obs):
    """The same, and one linear unit for all fingers of what each of them feels."""
    phases, felt = weights[: 3 * fingers].reshape(fingers, 3), weights[3 * fingers :]
    each = obs.reshape(fingers, features)
    return jnp.tanh((each[:, :3] * phases).sum(1) + each[:, 3:] @ felt)


# %% [markdown]
# ## Training
#
# An episode is a scan over the actions, a generation one batch of (candidate, trial) grasps.  The
# search by touch goes on from the best that the one by time has found.


# %%
def score(policy, weights, start):
    """Mean reward and mean share held of grasps under a policy."""

    def step(carry, _):
        state, going = carry
        after = jax.vmap(task.step)(state, jax.vmap(lambda o: policy(weights, o))(state.obs))
        earned = jnp.stack([after.reward, after.metrics["held"]]) * going
        return (after, going * (1.0 - after.done)), earned

    going = jnp.ones(len(start.reward))
    return jax.lax.scan(step, (start, going), length=task.length)[1].sum(0).mean(1)


reset = jax.jit(jax.vmap(task.reset))
trials, candidates, generations = (3, 4, 1) if FAST else (96, 12, 25)


def train(policy, start_weights):
    """The mean of the last generation, and the mean rewards of all of them."""
    search = CMA_ES(population_size=candidates, solution=start_weights)
    how, mean = search.default_params, []
    state = search.init(jax.random.key(0), start_weights, how)
    evaluate = jax.jit(jax.vmap(lambda w, s: score(policy, w, s), (0, None)))
    for key in jax.random.split(jax.random.key(5), generations):
        start = reset(jax.random.split(key, trials))  # new objects and noise
        population, state = search.ask(key, state, how)
        reward = evaluate(population, start)[:, 0]
        state, _ = search.tell(key, population, -reward, state, how)
        mean.append(float(reward.mean()))
    return state.mean, mean


fresh = reset(jax.random.split(jax.random.key(99), 6 if FAST else 384))
found, curves = {}, {}
weights = jnp.zeros(3 * fingers)
for name, policy, more in (("by time", by_time, 0), ("by touch", by_touch, features - 3)):
    weights, curves[name] = train(policy, jnp.append(weights, jnp.zeros(more)))
    reward, held = jax.jit(lambda w, s, policy=policy: score(policy, w, s))(weights, fresh)
    found[name] = float(reward), float(held)
    print(f"{name}: reward {reward:.3f}, held {100 * held:.0f} % of the time, in fresh trials")

# %%
for name, curve in curves.items():
    plt.plot(curve, label=f"{name}: {found[name][0]:.3f} in fresh trials")
plt.xlabel("generation")
plt.ylabel("mean reward of the candidates")
plt.legend()
plt.show()
