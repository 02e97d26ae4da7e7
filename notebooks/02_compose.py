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
# # Compose: vmap, grad and scan over whole grasps
#
# A rollout is a JAX function: the default engine runs it in one kernel and composes with JAX's
# transformations.  `jax.vmap` makes a larger batch of it, `jax.grad` stores the states of the
# steps and pulls a cotangent back through them without a solver iteration, and a whole
# optimisation is one `jax.lax.scan`.  `CODESIGN_FAST=1` shrinks what follows to a check that
# everything runs.

# %%
import dataclasses
import os

import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import Mesh, PartitionSpec

from codesign_jax import codesign, rollout, scene, use_compilation_cache
from codesign_jax.engines import make_engine
from codesign_jax.optimize import schedule
from codesign_jax.scene import parameters

use_compilation_cache()  # compiled programs are kept: the second start takes seconds
FAST = bool(os.environ.get("CODESIGN_FAST"))

# %% [markdown]
# A short grasp with few links: the hand comes down, closes and lifts.

# %%
effects = ("disturb", "ungrasp", "palm_object", "palm_table", "finger_table", "twist")
grasping = scene.load(
    "paper_spheres",  # contact between fingers on the skinned hull has no derivative
    overrides={
        "discretization": {"links": 2},
        "effects": dict.fromkeys(effects, False),
        "phases": {"approach": 0.5, "inflate": 0.8, "lift": 1.2},
    },
)
engine = make_engine("structured", grasping)
space = parameters.design_space(grasping.hand, "2d")  # finger length and arm height
trials = rollout.sample_trials(grasping, jax.random.key(0), 2)

# %% [markdown]
# ## vmap
#
# The distance between object and hand at the end of the lift, of one design in one trial.  Mapped
# over trials and over designs it is a table, and all of its grasps are simulated in one batch.


# %%
def distance(design, trial):
    """Distance of object and hand when the object is lifted [m]."""
    trace = rollout.grasp(grasping, engine, space.params(design), trial, stop_when_lost=False)
    return trace.at(grasping, "lift").distance


designs = jnp.asarray([[0.09, 0.03], [0.11, 0.05], [0.13, 0.07]])
over_trials = jax.vmap(distance, in_axes=(None, 0))
table = jax.jit(jax.vmap(over_trials, in_axes=(0, None)))(designs, trials)
print("distance [mm], a row for each design:\n", np.round(1e3 * np.asarray(table), 1))

# %% [markdown]
# ## grad and value_and_grad
#
# The first gradient compiles for some 30 s, and is kept for the next start.
# With `jax.vmap` around it each design gets its own.  `jax.checkpoint` forgets the stored states
# and simulates again when the gradient needs them: less memory for twice the kernel's time.

# %%
hold = jax.checkpoint(lambda design: over_trials(design, trials).mean())
value, slope = jax.jit(jax.vmap(jax.value_and_grad(hold)))(designs[:1] if FAST else designs)
for d, s in zip(value, slope, strict=False):
    print(
        f"{1e3 * d:.1f} mm; by the length {s[0]:+.2f} mm/mm, by the arm's height {s[1]:+.2f} mm/mm"
    )

# %% [markdown]
# ## shard_map
#
# Worlds do not depend on each other, so devices can share them; here all that there are.

# %%
mesh = Mesh(np.array(jax.devices()), ("device",))
shared = jax.shard_map(
    jax.vmap(lambda t: distance(designs[0], t)),
    mesh=mesh,
    in_specs=PartitionSpec("device"),
    out_specs=PartitionSpec("device"),
    check_vma=False,
)
many = rollout.sample_trials(grasping, jax.random.key(1), 2 * len(jax.devices()))
print(jax.jit(shared)(many))

# %% [markdown]
# ## An optimisation as one program, and many seeds of it in one batch
#
# `Task.run` is a `jax.lax.scan` over episodes: the same numbers as the loop of
# `notebooks/01_start.py`.  Mapped over start states it runs a seed in each.

# %%
seeds, episodes, particles = (2, 2, 3) if FAST else (5, 10, 10)
optimizer = codesign.make_filter(space)
task = codesign.Task(grasping, space, trials=2)
masks = schedule("concurrent", np.array(space.is_morphology), episodes)
start = space.from_units(np.array([60.0, 80.0]))  # mm, mm
states = [optimizer.init(jax.random.key(k), start, particles) for k in range(seeds)]
batch = jax.tree.map(lambda *v: jnp.stack(v), *states)
ends, infos = jax.jit(jax.vmap(lambda state: task.run(optimizer, state, masks)))(batch)
print("mean cost, a row for each seed:\n", np.round(np.asarray(infos.selection.mean_cost), 2))

# %% [markdown]
# ## A cost of one's own
#
# Any function of the scene, the trace of a world and its controls; here how high the object is at
# the end of the lift.  (In a scene that is shaken too, ask for the trace at the end of "disturb":
# the last entry of a whole grasp comes after the release.)  With `stop_when_lost=False` a world is
# simulated to the end though it lost its object.


# %%
def height_missing(scene, trace, ctrl):
    """How far the object stays below 0.2 m [m]."""
    return jnp.maximum(0.2 - trace.at(scene, "lift").height, 0.0)


lifting = dataclasses.replace(task, cost=height_missing, stop_when_lost=False)
print(lifting.evaluate(designs, jax.random.key(0)).cost)

# %% [markdown]
# ## Another optimiser
#
# CMA-ES, a particle swarm and random search have the particle filter's interface, and so may one of
# your own (`optimize.Optimizer`).  Here CMA-ES minimises the cost above, with as many grasps as the
# particle filter had; its particles are the best designs so far, the best one first.

# %%
searcher = codesign.make_optimizer("cma-es", space)  # evosax's
begin = searcher.init(jax.random.key(0), start, particles)
end, info = lifting.run(searcher, begin, masks)
print("mean cost of each episode [m]:", np.round(np.asarray(info.selection.mean_cost), 3))
print("best design [mm]:", np.round(space.in_units(np.asarray(end.particles[0])), 1))
