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
# # Start: one hand, one grasp, two parameters
#
# A hand is a file, a grasp is a jitted function of its parameters, and co-design moves both the
# hand's morphology and its control.  Open this file as a notebook with jupytext, or run its cells
# in an editor; `make release` writes it as dist/01_start.ipynb.  On Colab, upload that notebook,
# and the wheel from the same folder to the files of the session.  `CODESIGN_FAST=1` shrinks the
# notebook to a check that everything runs.

# %%
import importlib.util
import os
import subprocess
import sys
from pathlib import Path

if importlib.util.find_spec("codesign_jax") is None:  # a machine without it, such as Colab's
    wheels = sorted(Path().glob("codesign_jax-*.whl"))
    package = str(wheels[-1]) if wheels else "codesign-jax"
    subprocess.run([sys.executable, "-m", "pip", "install", "-q", package], check=True)

# %%
import jax
import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np

from codesign_jax import codesign, rollout, scene, use_compilation_cache
from codesign_jax.engines import make_engine
from codesign_jax.engines.base import recording
from codesign_jax.optimize import schedule
from codesign_jax.report import animation, bodies, viewer
from codesign_jax.scene import parameters

use_compilation_cache()  # compiled programs are kept: the second start takes seconds
FAST = bool(os.environ.get("CODESIGN_FAST"))

# %% [markdown]
# ## The scene, the hand and its design space
#
# `scene.load` reads the scene with its hand and its objects; every number is in a TOML file.  The
# paper's 2D design space leaves two parameters free: one length for all fingers (morphology) and
# the height of the arm while grasping (control).

# %%
grasping = scene.load("paper")
space = parameters.design_space(grasping.hand, "2d")
for name, unit, (low, high), body in zip(
    space.names,
    space.units,
    np.transpose([space.in_units(space.low), space.in_units(space.high)]),
    space.is_morphology,
    strict=True,
):
    print(f"{name}: {low:.0f} to {high:.0f} {unit} ({'morphology' if body else 'control'})")

# %% [markdown]
# ## One grasp
#
# `rollout.simulate` is a pure function of parameters and trials; the scene and the engine are
# closed over.  Worlds are the leading axis, here one of each object without noise.

# %%
engine = make_engine("structured", grasping)
design = space.from_units(np.array([100.0, 30.0]))  # mm, mm
trials = jax.tree.map(
    lambda *values: jnp.stack(values),
    *[rollout.nominal_trial(grasping, shape.name) for shape in grasping.objects.object],
)
hands = jax.tree.map(
    lambda value: jnp.broadcast_to(value, (3, *value.shape)), space.params(jnp.asarray(design))
)
simulate = jax.jit(lambda p, t: rollout.simulate(grasping, engine, p, t, record_qpos=True))
outcome, trace = simulate(hands, trials)
for shape, cost, lost in zip(grasping.objects.object, outcome.cost, outcome.lost_time, strict=True):
    print(f"{shape.name:>10}: cost {cost:.2f}, lost at {lost:.2f} s")

# %% [markdown]
# The cost falls from 3 (lost before the lift) to 0 (kept until the end of the shaking); the object
# counts as lost once it is 80 mm from the hand's centre.

# %%
time = np.arange(grasping.num_steps) * grasping.discretization.timestep
figure, axes = plt.subplots(figsize=(7, 3), layout="constrained")
for shape, distance in zip(grasping.objects.object, trace.distance, strict=True):
    axes.plot(time, 1e3 * np.asarray(distance), label=shape.name)
axes.axhline(1e3 * grasping.cost.lost_distance, color="black", ls="--", lw=1)
for end in (grasping.phases.approach, grasping.phases.inflate, grasping.phases.lift):
    axes.axvline(end, color="0.8", lw=1)
axes.axvline(grasping.phases.disturb, color="0.8", lw=1)
axes.set(xlabel="time [s]", ylabel="object to hand centre [mm]", ylim=(0, 200))
axes.legend()
plt.show()

# %% [markdown]
# And the grasp in 3D: it turns, and *forces* shows where each finger presses.  An engine that
# records forces ring by ring is another program.

# %%
hand = space.params(jnp.asarray(design))
grasps = animation.replay(grasping, recording(engine, touch=True), hand, trials)
viewer.Notebook(grasping, grasps[0])

# %% [markdown]
# The tips over the table, and what the fingers press with, in the colours of the viewer.

# %%
trial = jax.tree.map(lambda value: value[0], trials)
tips = rollout.tips(grasping, hand, trial, grasps[0].qpos)
figure, (high, strong) = plt.subplots(1, 2, figsize=(9, 3), layout="constrained")
for finger in range(grasping.num_fingers):
    style = {"color": bodies.finger_color(finger), "label": f"finger {finger}"}
    high.plot(time, 1e3 * np.asarray(tips[:, finger, 2]), **style)
    strong.plot(time, grasps[0].trace.forces.grip[:, finger], **style)
high.set(xlabel="time [s]", ylabel="tip over the table [mm]")
strong.set(xlabel="time [s]", ylabel="normal force on the object [N]")
high.legend()
plt.show()

# %% [markdown]
# ## Optimise both parameters
#
# The paper's particle filter: move, simulate, weigh, resample.  One episode is one jitted call.
# The mask says which parameters may move in which episode; here both, always.

# %%
particles, num_trials, episodes = (4, 2, 2) if FAST else (10, 3, 15)
optimizer = codesign.make_filter(space)
task = codesign.Task(grasping, space, num_trials, engine)
mask = schedule("concurrent", np.array(space.is_morphology), episodes)

state = optimizer.init(jax.random.key(0), space.from_units(np.array([110.0, 80.0])), particles)
costs = []
for e in range(episodes):
    state, info = task.episode(optimizer, state, mask[e])
    costs.append(np.asarray(info.selection.cost))
    best = info.population[info.selection.best_index]
    length, height = space.in_units(best)
    print(
        f"episode {e + 1}: mean cost {info.selection.mean_cost:.2f}, "
        f"best {info.selection.best_cost:.2f} at {length:.0f} mm, {height:.0f} mm"
    )

# %%
figure, axes = plt.subplots(figsize=(6, 3), layout="constrained")
axes.plot(np.arange(episodes) + 1, costs, ".", color="tab:blue", alpha=0.4)
axes.plot(np.arange(episodes) + 1, np.mean(costs, axis=1), color="tab:orange")
axes.axhline(codesign.CONVERGED_COST, color="black", ls="--", lw=1)
axes.set(xlabel="episode", ylabel="cost")
plt.show()

# %% [markdown]
# From here: `codesign optimize --optimizer particle-filter` does this with checkpoints and a run
# folder, `codesign evaluate --render grasp.gif` draws any design, another hand is another file.
