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
# # A cost and an optimiser of your own
#
# A cost is a function of what happened in one grasp; an optimiser is anything with `init`, `ask`
# and `tell`.  Both are plain JAX, become part of the compiled program, and work with everything
# else. `CODESIGN_FAST=1` shrinks the notebook to a check that it runs.

# %%
import dataclasses
import os

import jax
import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np

from codesign_jax import codesign, parameters, scene, use_compilation_cache
from codesign_jax.optimize import OptimizerState, Space, reflect, schedule
from codesign_jax.optimize.protocol import episode_key, summarize

use_compilation_cache()
FAST = bool(os.environ.get("CODESIGN_FAST"))
grasping = scene.load("quick.toml" if FAST else "paper_spheres")
space = parameters.design_space(grasping.hand, "2d")  # finger length and arm height

# %% [markdown]
# ## A cost: how close the object is held
#
# The paper's cost asks when the object is lost.  This one asks how near it is to the hand's centre
# from the end of the inflation to the end of the shaking, in units of the distance at which it
# counts as lost; what comes later is the release.  (`trace.at(scene, "disturb")` is one time step
# of a trace, the last one of a phase.)  The cost sees the trace of one world, arrays with the axis
# time, and the controls.  A cost that reads the trace says how much of it there is to be:
# `stop_when_lost=False` simulates a world to the end though it lost its object; with
# `stop_when_lost=True` it stops there, which is faster, and its last entry repeats.

# %%
first = grasping.last_step("inflate") + 1
shaken = grasping.last_step() + 1


def looseness(scene, trace, ctrl):
    """Mean distance of object and hand while it is to be held, over the lost distance."""
    return jnp.mean(jnp.minimum(trace.distance[first:shaken] / scene.cost.lost_distance, 2.0))


# %% [markdown]
# ## An optimiser: the cross-entropy method
#
# It draws designs from a normal distribution and moves that to the better part of them.  Its
# configuration is a pytree (bounds are arrays, the rest is static), and its state is data, so that
# runs can be saved, mapped and scanned.


# %%
@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True, eq=False)
class CrossEntropy:
    """Rubinstein (1999), with a share of the best and a floor under the spread."""

    keeps_best = False  # every episode replaces all particles

    space: Space
    share: float = dataclasses.field(default=0.3, metadata={"static": True})
    floor: float = dataclasses.field(default=0.01, metadata={"static": True})

    def _range(self):
        return jnp.asarray(self.space.high) - jnp.asarray(self.space.low)

    def init(self, key, seed_particle, num_particles):
        """All particles at the seed, a quarter of the range as first spread."""
        seed = jnp.asarray(seed_particle, float)
        memory = {"mean": seed, "spread": 0.25 * self._range()}
        return OptimizerState(jnp.tile(seed, (num_particles, 1)), jnp.int32(0), key, memory)

    def ask(self, state, mask):
        """Draws; parameters that the mask closes keep the particles' values."""
        noise = jax.random.normal(episode_key(state, 0x63656D20), state.particles.shape)
        drawn = state.memory["mean"] + state.memory["spread"] * noise
        inside = reflect(drawn, self.space.low, self.space.high)
        return self.space.constrain(jnp.where(mask, inside, state.particles))

    def tell(self, state, population, cost, mask=True):
        """Mean and spread of the best; the particles are sorted, the best one first."""
        order = jnp.argsort(jnp.where(jnp.isfinite(cost), cost, jnp.inf)).astype(jnp.int32)
        best = population[order[: max(2, round(self.share * len(cost)))]]
        spread = jnp.maximum(best.std(0), self.floor * self._range())
        memory = {"mean": best.mean(0), "spread": spread}
        new = OptimizerState(population[order], state.episode + 1, state.key, memory)
        return new, summarize(cost, jnp.ones_like(cost), order)


# %% [markdown]
# ## On one budget
#
# Everybody evaluates as many designs in the same trials, from the same start.  The particle filter
# is the paper's; `cma-es`, `pso` and `random` come from evosax.

# %%
episodes, particles, trials = (3, 4, 2) if FAST else (20, 10, 3)
names = ("particle-filter",) if FAST else ("particle-filter", "cma-es", "random")
optimizers = {name: codesign.make_optimizer(name, space) for name in names}
optimizers["cross-entropy"] = CrossEntropy(codesign.make_filter(space).space)
masks = schedule("concurrent", np.array(space.is_morphology), episodes)
start = space.from_units(np.array([130.0, 90.0]))  # mm, mm
infos = {}
task = codesign.Task(grasping, space, trials, cost=looseness, stop_when_lost=True)
for name, optimizer in optimizers.items():
    state = optimizer.init(jax.random.key(1), start, particles)
    end, infos[name] = task.run(optimizer, state, masks)
    best = int(jnp.argmin(infos[name].selection.best_cost))
    row = int(infos[name].selection.best_index[best])
    design = np.round(space.in_units(np.asarray(infos[name].population[best, row])), 1)
    print(f"{name:>15}: lowest cost {infos[name].selection.best_cost[best]:.3f} at {design} mm")

# %%
figure, axes = plt.subplots(1, 2, figsize=(10, 3.6), layout="constrained")
for name, info in infos.items():
    best = np.minimum.accumulate(np.asarray(info.selection.best_cost))
    axes[0].plot(np.arange(episodes) + 1, best, ".-", label=name)
    axes[1].plot(
        *space.in_units(np.asarray(info.population).reshape(-1, 2)).T, ".", ms=4, alpha=0.5
    )
axes[0].set(xlabel="episode", ylabel="lowest looseness so far")
axes[0].legend()
axes[1].set(xlabel="finger length [mm]", ylabel="arm height [mm]", title="designs tried")
plt.show()

# %% [markdown]
# Weights of the particle filter are 1 / (0.2 + cost): scale a cost of your own so that good designs
# lie near 0 and poor ones near 3, or change `codesign.make_filter(space, alpha=...)`.
