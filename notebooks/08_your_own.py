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
# # Bring your own hand and object
#
# A hand and an object set are TOML files and no code.  This notebook writes both, with a mesh made
# by trimesh, reads what happens with a mistake, and grasps.  `CODESIGN_FAST=1` shrinks it.

# %%
import os
import tempfile
from pathlib import Path

import jax
import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np
import trimesh

from codesign_jax import (
    InputError,
    codesign,
    make_engine,
    parameters,
    rollout,
    scene,
    use_compilation_cache,
)
from codesign_jax.report import animation

use_compilation_cache()
FAST = bool(os.environ.get("CODESIGN_FAST"))
name = "quick.toml" if FAST else "paper_spheres"
folder = Path(tempfile.mkdtemp(prefix="my-hand-"))

# %% [markdown]
# ## A hand
#
# Four fingers of a parallel gripper: two rows that face each other.  Each mount has an azimuth, a
# tilt and a distance from the axis; everything else (material, palm, wrist, parameter table,
# presets) is copied from a hand that comes with the package.

# %%
mounts = [(-25.0, 0.036), (25.0, 0.036), (155.0, 0.036), (205.0, 0.036)]
fingers = "".join(
    f"[[finger]]\nazimuth = {azimuth}\nspread = 0.0\nradius = {radius}\ntilt = 75.0\n\n"
    for azimuth, radius in mounts
)
template = (scene.library.available("hands")["pneuflex4_circle"]).read_text()
rest = template[template.index("[section]") :]
(folder / "rows.toml").write_text(
    f'name = "rows"\ndescription = "Two rows of two fingers"\n\n{fingers}{rest}'
)

# %% [markdown]
# ## An object
#
# A spindle: thick ends, a thin middle.  Any watertight mesh of 5 to 500 mm will do, as
# .stl, .obj, .ply, .off, .glb or .gltf; its mass properties follow from its volume.

# %%
height = np.linspace(-0.04, 0.04, 17)  # m
profile = 0.016 + 0.012 * np.abs(height / 0.04) ** 2
outline = np.column_stack([np.r_[0, profile, 0], np.r_[height[0], height, height[-1]]])
spindle = trimesh.creation.revolve(outline, sections=24)
spindle.export(folder / "spindle.stl")
(folder / "mine.toml").write_text(
    """
name = "mine"
description = "A spindle and a ball"

[[object]]
name = "spindle"
type = "mesh"
file = "spindle.stl"
unit = "m"
mass = 0.08
friction = 0.8

[[object]]
name = "ball"
type = "sphere"
size = [0.03]
mass = 0.08
friction = 0.8

[table]
friction = 0.5

[noise]
position = 0.01
orientation = 5.0
mass = 0.05
size = 0.02
"""
)

# %% [markdown]
# ## A mistake
#
# Files are checked when they are read, before anything is simulated, and every problem is said at
# once: the key, the value, its unit and range.

# %%
wrong = (folder / "mine.toml").read_text().replace("mass = 0.08", "mass = 80", 1)
(folder / "wrong.toml").write_text(wrong.replace("friction = 0.5", "fricton = 0.5"))
try:
    scene.load(name, object_set=folder / "wrong.toml")
except InputError as error:
    print(error)

# %% [markdown]
# ## Look at it
#
# Read both, and look at the fingers' mounts from below and at the object.

# %%
grasping = scene.load(name, hand_name=folder / "rows.toml", object_set=folder / "mine.toml")
space = parameters.design_space(grasping.hand, "2d")
engine = make_engine("structured", grasping)
shape = grasping.objects.object[0]
grid = shape.mesh.grid
print(f"{shape.name}: {len(spindle.faces)} faces, distances to {1e3 * grid.error:.2f} mm (99 %)")

# %%
design = space.params(jnp.asarray(space.from_units(np.array([75.0, 0.0]))))  # mm, mm
trials = [rollout.nominal_trial(grasping, s.name) for s in grasping.objects.object]
trials = jax.tree.map(lambda *v: jnp.stack(v), *trials)
grasps = animation.replay(grasping, engine, design, trials)
ends = grasping.phases
times = np.array([0.0, ends.approach, ends.inflate, ends.lift - 0.05])
rows = [
    animation.frames(grasping, g, times[-1:] if FAST else times, size=(220, 220)) for g in grasps
]
figure, axes = plt.subplots(figsize=(10, 5), layout="constrained")
axes.imshow(np.concatenate([np.concatenate(list(row), axis=1) for row in rows]))
axes.axis("off")
plt.show()
for s, g in zip(grasping.objects.object, grasps, strict=True):
    print(f"{s.name}: cost {float(g.outcome.cost):.2f}")

# %% [markdown]
# ## Optimise it
#
# From here everything is as for the built-in hand.  On the command line, in the folder of the two
# files: `codesign optimize --scene paper_spheres --hand rows.toml --objects mine.toml`.

# %%
particles, num_trials, episodes = (4, 2, 1) if FAST else (10, 4, 12)
optimizer = codesign.make_filter(space)
task = codesign.Task(grasping, space, num_trials, engine)
state = optimizer.init(jax.random.key(0), space.from_units(np.array([120.0, 60.0])), particles)
for e in range(episodes):
    state, info = task.episode(optimizer, state)
    print(f"episode {e + 1}: mean cost {info.selection.mean_cost:.2f}")
