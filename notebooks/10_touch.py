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
# # Hold an object by touch
#
# Objects of 100 g to 1 kg look alike: a hand that does not know which one it has presses hard
# enough for the heaviest that it can hold.  Here a small policy feels what the fingers carry and
# presses as hard as that needs.  It is trained on `codesign_jax.env` by CMA-ES and compared with
# the best pressures over time, found by the same search with as many grasps, in the same fresh
# trials.  `CODESIGN_FAST=1` shrinks the notebook to a check that it runs.

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
# An action multiplies the pressures of the key frames by 0 to 2, as in every environment.  A grasp
# earns the share of the time that counts in which it holds the object, and half of that if it takes
# all the pressure that the walls stand.


# %%
class Touch(env.GraspEnv):
    """Its observation is (finger, feature), flat: four of time, then what each finger feels."""

    def observe(self, seen):
        ones = jnp.ones(self.scene.num_fingers)
        forces = seen.forces
        lifted = seen.phase == 2
        shaken = seen.phase > 2
        times = ones, ones * lifted, ones * shaken, ones * shaken * seen.phase_time  # ever stronger
        carried = (forces.finger.sum(0) + forces.palm)[2]  # by the hand [N]
        bend = 0.5 * seen.joint[..., 0].sum(-1)
        felt = 0.2 * ones * carried, 0.2 * forces.finger[:, 2], 0.05 * forces.grip, bend
        return jnp.stack([*times, *felt], 1).ravel()

    def reward(self, before, command, after, held):
        return held * (1.0 - 0.5 * (command.pressure / self.limit).mean())


task = Touch(grasping, hand, period=0.1)
fingers = grasping.num_fingers
features = task.observation_size // fingers


def policy(weights, obs, felt):
    """Each finger's own pressure for closing, lifting and shaking, and what all do by touch."""
    times = weights[: 4 * fingers].reshape(fingers, 4)
    touch = weights[4 * fingers :]
    now, before = (v.reshape(fingers, features) for v in (obs, felt))
    return jnp.tanh((now[:, :4] * times).sum(1) + before[:, 4 : 4 + len(touch)] @ touch)


# %% [markdown]
# ## Training
#
# An episode is a scan over the actions, a generation one batch of (candidate, trial) grasps.  What
# is felt is averaged over some tenths of a second: the shaking adds to what the fingers carry.  The
# first search finds pressures over time.  Two go on from its best, with the same random numbers:
# one by time alone, one that may feel as well.


# %%
def score(weights, start):
    """Reward and share held of each grasp."""

    def step(carry, _):
        state, felt, going = carry
        felt = felt + 0.3 * (state.obs - felt)
        action = jax.vmap(lambda o, f: policy(weights, o, f))(state.obs, felt)
        after = jax.vmap(task.step)(state, action)
        earned = jnp.stack([after.reward, after.metrics["held"]]) * going
        return (after, felt, going * (1.0 - after.done)), earned

    first = start, 0.0 * start.obs, jnp.ones(len(start.reward))
    return jax.lax.scan(step, first, length=task.episode_length)[1].sum(0)


reset = jax.jit(jax.vmap(task.reset))
judge = jax.jit(score)
evaluate = jax.jit(lambda every, start: jax.vmap(score, (0, None))(every, start)[:, 0].mean(1))
trials, candidates, generations = (3, 4, 1) if FAST else (96, 24, 45)


def train(weights, seed):
    """The mean of the last generation."""
    search = CMA_ES(population_size=candidates, solution=weights)
    hyperparameters = search.default_params.replace(std_init=0.2)
    state = search.init(jax.random.key(seed), weights, hyperparameters)
    for key in jax.random.split(jax.random.key(seed), generations):
        start = reset(jax.random.split(key, trials))  # new objects and noise
        population, state = search.ask(key, state, hyperparameters)
        reward = evaluate(population, start)
        state, _ = search.tell(key, population, -reward, state, hyperparameters)
    return state.mean


first = train(jnp.zeros(4 * fingers), 1)
results = {}
fresh = reset(jax.random.split(jax.random.key(99), 6 if FAST else 768))
for name, more in (("by time", 0), ("by touch", features - 4)):
    weights = train(jnp.append(first, jnp.zeros(more)), 2)
    results[name] = reward, held = np.asarray(judge(weights, fresh))
    print(f"{name}: reward {reward.mean():.3f}, held {100 * held.mean():.0f} % of the time")
gain = results["by touch"][0] - results["by time"][0]
error = 1.96 * gain.std() / np.sqrt(len(gain))
print(f"by touch {gain.mean():+.3f} +- {error:.3f} (95 %), {len(gain)} fresh trials of both")

# %%
mass = grasping.objects.object[0].mass * np.asarray(fresh.data.trial.mass)  # kg, of all alike
few = np.array_split(np.argsort(mass), 2 if FAST else 12)
figure, (left, right) = plt.subplots(1, 2, figsize=(9, 3), layout="constrained")
for name, (reward, held) in results.items():
    pressure = 2 * (1 - reward.astype(float) / np.maximum(held, 1e-6))  # while it is held
    centre = [1000 * mass[k].mean() for k in few]
    left.plot(centre, [held[k].mean() for k in few], "o-", label=name)
    right.plot(centre, [pressure[k][held[k] > 0].mean() for k in few], "o-", label=name)
left.set(xlabel="mass [g]", ylabel="share of the time held")
right.set(xlabel="mass [g]", ylabel="pressure over the limit")
left.legend()
plt.show()
