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
# # Co-design in 2D: why both domains at once
#
# The paper's experiment with two parameters, on one page: the cost over finger length (morphology)
# and arm height (control), and how three strategies move over it.  Two of them may change one
# domain only.  `CODESIGN_FAST=1` shrinks everything to a check that it runs.

# %%
import os
from functools import partial

import jax
import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np

from codesign_jax import codesign, parameters, scene, use_compilation_cache
from codesign_jax.optimize import schedule

use_compilation_cache()  # compiled programs are kept: the second start takes seconds
FAST = bool(os.environ.get("CODESIGN_FAST"))
grasping = scene.load("quick.toml" if FAST else "paper_spheres")
space = parameters.design_space(grasping.hand, "2d")

# %% [markdown]
# ## The landscape
#
# Every point of a grid in the same trials: common random numbers compare designs, not luck.  All
# grasps are one batch.  (`codesign landscape` does this with a progress bar and a file.)

# %%
points, trials = (6, 2) if FAST else (16, 3)
lengths, heights = (np.linspace(*ends, points) for ends in zip(space.low, space.high, strict=True))
grid = np.stack(np.meshgrid(lengths, heights, indexing="ij"), -1).reshape(-1, 2)
task = codesign.Task(grasping, space, trials)
landscape = task.evaluate(jnp.asarray(grid), jax.random.key(0)).cost.mean(1)
landscape = landscape.reshape(points, points)
print(f"{grid.shape[0] * trials} grasps; {np.mean(landscape < 0.01):.0%} of the designs keep all")

# %% [markdown]
# ## Three strategies, one batch
#
# A strategy is a mask: which parameters may move in which episode.  `Task.run` is a whole
# optimisation as one function of start state and masks, so `jax.vmap` runs the three strategies,
# each with several seeds, together.  All start at one design that drops everything.

# %%
strategies = ("concurrent", "morphology", "control")
seeds, episodes, particles = (1, 3, 4) if FAST else (3, 24, 10)
optimizer = codesign.make_filter(space)
start = space.from_units(np.array([150.0, 110.0]))  # mm, mm
masks = [schedule(name, np.array(space.is_morphology), episodes) for name in strategies]
masks = jnp.asarray(np.repeat(masks, seeds, axis=0))
keys = jax.vmap(jax.random.key)(jnp.tile(jnp.arange(seeds), len(strategies)))
states = jax.vmap(lambda key: optimizer.init(key, start, particles))(keys)
ends, infos = jax.jit(jax.vmap(partial(task.run, optimizer)))(states, masks)


def by_strategy(values):
    """Arrays with leading axis (strategy * seed,) as (strategy, seed, ...)."""
    return np.asarray(values).reshape(len(strategies), seeds, *values.shape[1:])


means = by_strategy(infos.selection.mean_cost)
paths = by_strategy(infos.population.mean(2))
for name, mean in zip(strategies, means, strict=True):
    convergence = [codesign.convergence_episode(m) for m in mean]
    print(
        f"{name:>10}: converged from episode {[None if e is None else e + 1 for e in convergence]}"
    )

# %% [markdown]
# The line of each run is the mean of its particles.  Who may move in one direction only finds a
# good design only if one lies in that direction; moving both finds the valley.

# %%
figure, (left, right) = plt.subplots(1, 2, figsize=(10, 4), layout="constrained")
shown = left.pcolormesh(
    *(space.in_units(np.stack([lengths, heights], -1)).T),
    landscape.T,
    cmap="gray_r",
    vmin=0,
    vmax=3,
)
figure.colorbar(shown, label="mean cost")
for name, path, mean, color in zip(strategies, paths, means, ("C0", "C1", "C2"), strict=True):
    for k in range(seeds):
        label = name if k == 0 else None
        left.plot(*space.in_units(path[k]).T, ".-", color=color, ms=3, lw=1, label=label)
        right.plot(np.arange(episodes) + 1, mean[k], color=color, lw=1, label=label)
left.plot(*space.in_units(start), "*", color="C3", ms=14, zorder=5, label="start")
left.set(xlabel="finger length [mm]", ylabel="arm height [mm]")
left.legend(loc="upper left")
right.axhline(codesign.CONVERGED_COST, color="black", ls="--", lw=1)
right.set(xlabel="episode", ylabel="mean cost of the particles", xlim=(1, episodes))
plt.show()

# %% [markdown]
# On the command line, with checkpoints, final tests and run folders: `codesign optimize
# --optimizer particle-filter --schedule concurrent,morphology,control --seeds 0-9`.
