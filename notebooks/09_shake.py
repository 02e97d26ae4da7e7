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

# %% [markdown]
# # Five constants from a shake
#
# Fingers hold an object and are shaken.  From where all bodies are after windows of 0.2 s the
# fingers' shear modulus, the gain of their pressures, friction, stiffness of contact and the
# object's mass are found at once: windows so short that the gradient through contact means
# something.  The scene is `paper`, with hull and contact between fingers.  `CODESIGN_FAST=1`
# shrinks it.

# %%
import os
from dataclasses import replace

import jax
import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np

from codesign_jax import make_engine, model, parameters, rollout, scene, use_compilation_cache

use_compilation_cache()
FAST = bool(os.environ.get("CODESIGN_FAST"))

# %%
size = {"links": 2, "hull_rings": 1, "hull_points": 4} if FAST else {"links": 10}
grasping = scene.load("paper", overrides={"discretization": size})
engine = make_engine("structured", grasping)
space = parameters.design_space(grasping.hand, "2d")  # finger length and arm height
count = 6 if FAST else 24
trials = rollout.sample_trials(grasping, jax.random.key(0), count)
hands = jax.tree.map(lambda v: jnp.stack([v] * count), space.params(space.default()))
fields, ctrl = rollout.prepare(grasping, hands, trials)

# %% [markdown]
# ## Windows
#
# `last` is the state at the end of a rollout, and another one begins there: `start=`.  Each hand is
# shaken for 0.3 s; then 0.2 s are measured, with a step of the pressures of 10 %, up or down.

# %%
begin = 480
steps = 20
state = jax.jit(engine.rollout)(fields, ctrl[:, :begin]).last
sign = np.where(np.arange(count) % 2, -1.0, 1.0)[:, None, None]
window = ctrl[:, begin : begin + steps].at[:, :, 6:].multiply(1 + 0.1 * sign)
names = "shear modulus", "pressure gain", "friction", "contact stiffness", "object mass"


def ends(logs):
    """Positions of all bodies at the end, of factors exp(logs) on the constants, (world, 5)."""
    modulus, gain, friction, stiffness, mass = jnp.exp(logs).T
    scaled_trials = trials._replace(
        stiffness=modulus * trials.stiffness,
        friction=friction * trials.friction,
        mass=mass * trials.mass,
    )
    contact = grasping.contact
    contact = replace(contact, normal_stiffness=stiffness * contact.normal_stiffness)
    new, _ = rollout.prepare(replace(grasping, contact=contact), hands, scaled_trials)
    driven = window.at[:, :, 6:].multiply(gain[:, None, None])
    return engine.rollout(new._replace(start=state), driven).last[:, : fields.qpos.shape[1]]


# %% [markdown]
# ## The measurement
#
# Noise of 0.1 mm and 2 mrad; a quaternion's components have half of an angle's.

# %%
joints = model.layout(grasping).dofs.size
sigma = np.array([1e-4] * 3 + [2e-3] * (3 + joints) + [1e-4] * 3 + [1e-3] * 4, np.float32)
truth = jax.jit(ends)(jnp.zeros((count, 5)))
measured = truth + sigma * jax.random.normal(jax.random.key(1), truth.shape)

# %% [markdown]
# ## Gauss-Newton by reverse passes
#
# A reverse pass with random signs s as cotangent is J's, and the mean of (J's)(J's)' is J'J.  Five
# of them, over all windows, and one with the residuals make an iteration, whatever the number of
# measurements.  Of steps with several dampings the best is taken.


# %%
def residuals(logs):
    """Of the logarithms of each world, in standard deviations."""
    return (ends(logs) - measured) / sigma


@jax.jit
def linearized(logs, key):
    """Half of the sum of squares, its gradient, and an estimate of J'J."""
    misfits, pull = jax.vjp(residuals, jnp.tile(logs, (count, 1)))
    signs = jax.random.rademacher(key, (5, *misfits.shape), misfits.dtype)
    [bars] = jax.vmap(pull)(jnp.concatenate([misfits[None], signs]))
    matrix = jnp.einsum("pwi,pwj->ij", bars[1:], bars[1:]) / 5
    return (misfits**2).sum() / 2, bars[0].sum(0), matrix


@jax.jit
def losses(tried):
    """Of several candidates, (candidate, 5)."""
    return jax.vmap(lambda x: (residuals(jnp.tile(x, (count, 1))) ** 2).sum() / 2)(tried)


logs = np.log(np.array([1.3, 0.7, 1.5, 0.7, 1.2], np.float32))  # wrong by 20 to 50 %
history = [logs]
for k in range(3 if FAST else 10):
    loss, slope, matrix = (np.asarray(v, float) for v in linearized(logs, jax.random.key(k)))
    scale = np.diag(np.diag(matrix))
    moves = [np.linalg.solve(matrix + d * scale, slope) for d in 10.0 ** np.arange(-4, 3)]
    tried = np.stack([logs, *(logs - m for m in moves)]).astype(np.float32)
    logs = tried[np.nanargmin(losses(tried))]
    history.append(logs)
    print(f"iteration {k}: half the sum of squares {loss:.0f}")
for name, value in zip(names, np.expm1(logs), strict=True):
    print(f"{name}: {100 * value:+.2f} %")

# %%
figure, axis = plt.subplots(figsize=(6, 3.4), layout="constrained")
axis.plot(np.exp(history), label=names)
axis.axhline(1, color="black", lw=1, ls="--")
axis.set(xlabel="iteration", ylabel="found / true")
axis.legend(fontsize=8)
plt.show()

# %% [markdown]
# Windows of 20 steps are short enough for contact; over the 9 s of a grasp the same derivatives are
# noise.  The docs' `gradients.md` has the figures, also of CMA-ES on the same problem.
