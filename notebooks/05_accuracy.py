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
# # Accuracy against time
#
# A finer simulation is nearer to the truth and takes longer. Here the same grasps are simulated
# with several time steps and numbers of links, and held against the accuracy `reference`, 1 ms and
# 20 links. The docs' `accuracy.md` is the large version of this page, which also holds the
# reference against MuJoCo C and closed forms. `CODESIGN_FAST=1` shrinks it.

# %%
import os
import time

import jax
import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np

from codesign_jax import codesign, make_engine, parameters, scene, use_compilation_cache

use_compilation_cache()
FAST = bool(os.environ.get("CODESIGN_FAST"))
name = "quick.toml" if FAST else "paper_spheres"

# %% [markdown]
# ## What is compared
#
# Random designs of the 2D space in the same trials.  Contact is chaotic: a grasp at the edge may
# end either way after the slightest change, so single grasps differ between any two settings, and
# two numbers count: how many verdicts differ, and by how much the mean cost of a design does.

# %%
count, trials = (6, 2) if FAST else (20, 3)
space = parameters.design_space(scene.load(name).hand, "2d")
middle = space.from_units(np.array([[70.0, 0.0]]))  # mm, mm: where some grasps hold
width = space.from_units(np.array([[40.0, 30.0]]))
designs = middle + width * np.random.default_rng(0).uniform(-1, 1, (count, 2))


def costs(engine, step, links, calls=2):
    """Costs of all grasps, shape (design, trial), and the seconds of the last call."""
    sizes = {"timestep": 1e-3 * step, "links": links}
    chosen = scene.load(name, overrides={"discretization": sizes})
    task = codesign.Task(chosen, space, trials, make_engine(engine, chosen))
    for _ in range(calls):  # the first one compiles
        start = time.perf_counter()
        design_costs = np.asarray(task.evaluate(jnp.asarray(designs), jax.random.key(1)).cost)
    return design_costs, time.perf_counter() - start


# %% [markdown]
# ## Settings: time step [ms], links of a finger
#
# The presets of `--accuracy` have 20 ms and 6 links (`fast`), 10 ms and 10 (`standard`), 5 ms and
# 10 (`fine`), 1 ms and 20 (`reference`).

# %%
settings = [("structured", 10, 2), ("mujoco", 10, 2)]
if not FAST:
    steps = (10, 5, 2.5)
    links = (5, 10)
    settings = [("structured", h, n) for h in steps for n in links] + [("mujoco", 10, 10)]
reference, _ = costs(*(("mujoco", 5, 2) if FAST else ("structured", 1, 20)), calls=1)
results = []
for engine, step, links in settings:
    result, seconds = costs(engine, step, links)
    flips = np.mean((result < 0.01) != (reference < 0.01))
    bias = np.abs(result.mean(1) - reference.mean(1)).mean()
    results.append((engine, step, links, 1e3 * seconds / result.size, flips, bias))
    print(
        f"{engine:>10} {step:>4} ms, {links:>2} links: {results[-1][3]:6.1f} ms a grasp, "
        f"{flips:.0%} of the verdicts differ, a design's mean cost by {bias:.2f}"
    )

# %%
figure, axes = plt.subplots(1, 2, figsize=(10, 3.6), layout="constrained")
for engine, step, links, cost_ms, flips, bias in results:
    marker = "s" if engine == "mujoco" else "o"
    color = f"C{[2, 5, 10, 20].index(links)}"
    for axis, value in zip(axes, (flips, bias), strict=True):
        axis.plot(cost_ms, value, marker, color=color)
        axis.annotate(f"{step:g} ms, {links}", (cost_ms, value), (4, 4), textcoords="offset points")
for axis, label in zip(
    axes, ("share of verdicts that differ", "error of a mean cost"), strict=True
):
    axis.set(xlabel="wall time of a grasp [ms]", ylabel=label, xscale="log")
    axis.margins(x=0.25, y=0.15)
    axis.set_ylim(bottom=0)
axes[0].set_title("circles: structured, squares: MuJoCo C")
plt.show()

# %% [markdown]
# What an optimiser picks is off by more than an average design, because it also picks what the
# errors favour: test a winner with `codesign evaluate --run RUN --accuracy reference --trials 150`.
