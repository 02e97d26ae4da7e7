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
# # Randomise and calibrate any constant
#
# Every number of the scene, hand and object files (friction, stiffness, gravity, masses, mounts,
# time constants, ...) is data of the compiled program: a batch may have others in every world,
# without compiling again.  `CODESIGN_FAST=1` shrinks the notebook to a check that it runs.

# %%
import os
from dataclasses import replace

import jax
import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np

from codesign_jax import codesign, parameters, scene, use_compilation_cache

use_compilation_cache()
FAST = bool(os.environ.get("CODESIGN_FAST"))
grasping = scene.load("quick.toml" if FAST else "paper_spheres")
space = parameters.design_space(grasping.hand, "2d")

# %% [markdown]
# ## What there is
#
# A scene is a tree of named numbers in SI units.

# %%
leaves = jax.tree_util.tree_leaves_with_path(grasping)
print(len(leaves), "constants, for example")
for path, value in leaves[:: max(1, len(leaves) // 8)]:
    print(f"  {jax.tree_util.keystr(path)} = {value:g}")

# %% [markdown]
# ## Other numbers in every trial
#
# Leaves may have the axis (trial,). This function scales four of them, so that what follows is one
# program, compiled once.

# %%
designs = jnp.asarray(space.from_units(np.array([[60.0, -5.0], [75.0, 5.0], [95.0, 25.0]])))  # mm
trials = 12 if FAST else 180
evaluate = codesign.Task(grasping, space, trials).evaluate


def scaled(friction=1.0, stiffness=1.0, contact=1.0, palm=1.0):
    """The scene, four of its numbers times factors: numbers, or arrays of shape (trial,)."""

    def times(table, **factors):
        new = {k: getattr(table, k) * np.broadcast_to(f, trials) for k, f in factors.items()}
        return replace(table, **new)

    shapes = tuple(times(s, friction=friction) for s in grasping.objects.object)
    hand = replace(
        grasping.hand,
        material=times(grasping.hand.material, shear_modulus=stiffness),
        palm=times(grasping.hand.palm, mass=palm),
    )
    return replace(
        grasping,
        objects=replace(grasping.objects, object=shapes),
        hand=hand,
        contact=times(grasping.contact, normal_stiffness=contact),
    )


def kept(constants, seed=0):
    """Whether each grasp keeps its object, shape (design, trial)."""
    cost = evaluate(designs, jax.random.key(seed), constants).cost
    return np.asarray(cost) < codesign.SUCCESS_COST


# %% [markdown]
# ## One constant over its range
#
# The same three designs meet every friction coefficient, all in one batch. Trials take turns
# between the objects, so that neighbours, one of each, get one value.

# %%
kinds = len(grasping.objects.object)
levels = 2 if FAST else 12
given = grasping.objects.object[0].friction
values = np.linspace(0.2, 1.4, levels)
over = kept(scaled(friction=np.repeat(values, trials // levels) / given))
share = over.reshape(len(designs), levels, -1).mean(-1)

# %% [markdown]
# ## Several at once, at random
#
# Domain randomisation: every trial has its own friction, stiffness of the fingers, contact and mass
# of the palm. A design that holds here holds for reasons that do not hang on one number. (Friction,
# stiffness and masses can also be drawn by the files: `--set objects.noise.friction=0.2`.)

# %%
random = np.random.default_rng(1)
spreads = {"friction": 0.2, "stiffness": 0.15, "contact": 0.3, "palm": 0.2}
factors = {k: np.exp(s * random.standard_normal(trials)) for k, s in spreads.items()}
fixed = kept(scaled()).mean(1)
drawn = kept(scaled(**factors)).mean(1)
for design, a, b in zip(space.in_units(np.asarray(designs)), fixed, drawn, strict=True):
    print(
        f"{design[0]:.0f} mm, {design[1]:.0f} mm: keeps {a:.0%} as in the files, {b:.0%} at random"
    )

# %% [markdown]
# ## Calibrate
#
# Somebody measured how often each design keeps its object, and the friction is not known. Here the
# measurement is a simulation with a friction of 0.55 in other trials. The likelihood of each value
# follows from the shares above: kept grasps are binomial.

# %%
hidden = 0.55
seen = trials // 2
successes = kept(scaled(friction=hidden / given), seed=99)[:, :seen].sum(1)[:, None]
count = trials // levels
chance = (share * count + 1) / (count + 2)  # Laplace's rule: a few grasps never make 0 or 1
fits = (successes * np.log(chance) + (seen - successes) * np.log(1 - chance)).sum(0)
likelihood = np.exp(fits - fits.max())
print(f"most likely friction: {values[likelihood.argmax()]:.2f} (hidden: {hidden})")

# %%
figure, axes = plt.subplots(1, 3, figsize=(12, 3.4), layout="constrained")
labels = [f"{d[0]:.0f} mm, {d[1]:.0f} mm" for d in space.in_units(np.asarray(designs))]
for label, row in zip(labels, share, strict=True):
    axes[0].plot(values, row, ".-", label=label)
axes[0].set(xlabel="friction coefficient", ylabel="share of grasps kept", ylim=(-0.02, 1.02))
axes[0].legend(title="length, arm height")
place = np.arange(len(designs))
axes[1].bar(place - 0.2, fixed, 0.4, label="as in the files")
axes[1].bar(place + 0.2, drawn, 0.4, label="randomised")
axes[1].set(ylabel="share of grasps kept", ylim=(0, 1.02))
axes[1].set_xticks(place, labels)
axes[1].legend()
axes[2].plot(values, likelihood, ".-", color="C3")
axes[2].axvline(hidden, color="black", ls="--", lw=1)
axes[2].set(xlabel="friction coefficient", ylabel="likelihood, relative")
plt.show()

# %% [markdown]
# The same works for any leaf: gravity on Mars, another wrist, other mounts.  Where the outcome is a
# motion instead of a verdict, `06_gradients.py` fits constants by their derivative.
