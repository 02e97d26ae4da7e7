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
# # Gradients and identification: a material from a motion
#
# A rollout has exact derivatives by designs, controls and every physical constant.  Here a finger's
# shear modulus and damping are found from the motion of its tip after a step of pressure.  The
# "measurement" is MuJoCo C in float64 with another material, plus noise.  `CODESIGN_FAST=1` shrinks
# it.

# %%
import dataclasses
import os

import jax
import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np
import optax

from codesign_jax import make_engine, model, parameters, rollout, scene, use_compilation_cache

use_compilation_cache()
FAST = bool(os.environ.get("CODESIGN_FAST"))

# %% [markdown]
# ## One finger that touches nothing
#
# It is clamped to a bench and bends in its plane: effects that are off are not in the program.

# %%
off = ("finger_object", "finger_table", "palm_object", "palm_table", "disturb", "ungrasp")
off += ("wrist", "twist", "lateral_bending")
step, duration = (0.01, 0.4) if FAST else (0.005, 1.0)  # s
size = {"links": 2 if FAST else 4, "timestep": step}
whole = scene.load(
    "paper_spheres",
    overrides={
        "effects": dict.fromkeys(off, False) | {"friction": "none"},
        "discretization": size,
    },
)
finger = dataclasses.replace(whole.hand, finger=whole.hand.finger[:1])
bench = dataclasses.replace(whole, hand=finger)

space = parameters.design_space(bench.hand)
hand = space.params(space.default())
trial = rollout.nominal_trial(bench)
time = np.arange(round(duration / step)) * step
ctrl = np.zeros((len(time), 7), np.float32)  # six of the arm, one chamber
ctrl[:, 2] = bench.arm.start_height  # m
ctrl[: len(time) // 2, 6] = 60e3  # Pa: on, then off
ctrl = jnp.asarray(ctrl)

# %% [markdown]
# ## The measurement
#
# 70 kPa and 12 ms are what the fit has to find; the noise is 0.3 mm.

# %%
truth = np.log([70e3, 0.012])  # logarithms of shear modulus [Pa] and damping time [s]
bends = model.layout(bench).dofs[0, :, 0]  # places of the joints' angles among the positions


def tips(engine, logs):
    """Tip along and above the unbent finger [m], shape (time, 2), of logarithms of a material."""
    numbers = {"shear_modulus": jnp.exp(logs[0]), "damping_time": jnp.exp(logs[1])}
    material = dataclasses.replace(bench.hand.material, **numbers)
    other = dataclasses.replace(bench, hand=dataclasses.replace(bench.hand, material=material))
    fields = jax.tree.map(lambda v: jnp.asarray(v)[None], model.model_fields(other, hand, trial))
    trace = engine.rollout(fields, ctrl[None], trajectory=True)
    # Joints are in the middle of the segments: half a one before the first, half behind the last.
    segment = hand.length[0] / len(bends)
    angle = jnp.cumsum(trace.qpos[0][:, bends], 1)
    reach = segment * jnp.ones(len(bends)).at[-1].set(0.5)
    along = segment / 2 + (reach * jnp.cos(angle)).sum(1)
    return jnp.stack([along, -(reach * jnp.sin(angle)).sum(1)], 1)


measured = jax.jit(lambda logs: tips(make_engine("mujoco", bench), logs))(truth)
measured += 3e-4 * jax.random.normal(jax.random.key(0), measured.shape)

# %% [markdown]
# ## The gradient
#
# `jax.value_and_grad` through the rollout: the kernel simulates forward, and one backward pass
# gives the derivative by both numbers, whatever their count.

# %%
engine = make_engine("structured", bench)
variance = jnp.var(measured, axis=0).mean()


def misfit(logs):
    """Mean squared error of the tip over its variance, of logarithms of a material."""
    predicted = tips(engine, logs)
    return jnp.mean((predicted - measured) ** 2) / variance, predicted


gradient = jax.jit(jax.value_and_grad(misfit, has_aux=True))
moduli = np.geomspace(40e3, 110e3, 3 if FAST else 9)
along = [gradient(jnp.array([np.log(modulus), truth[1]])) for modulus in moduli]
values = np.array([float(value) for (value, _), _ in along])
slopes = np.array([float(slope[0]) for _, slope in along])  # by the logarithm
print("misfit:", np.round(values, 4), "\nslope: ", np.round(slopes, 3))

# %% [markdown]
# ## The fit
#
# Adam on the logarithms, whose signs and scales need no thought.

# %%
steps = 6 if FAST else 60
adam = optax.adam(optax.cosine_decay_schedule(0.12, steps), b1=0.8, b2=0.95)
logs = jnp.log(jnp.array([50e3, 0.006]))
memory = adam.init(logs)
history = []
first = None
for _ in range(steps):
    (value, last), slope = gradient(logs)
    first = last if first is None else first
    history.append([*jnp.exp(logs).tolist(), float(value)])
    update, memory = adam.update(slope, memory)
    logs = optax.apply_updates(logs, update)
history = np.array(history)
names = ("shear modulus", "damping time")
true = np.exp(truth)
for name, target, value in zip(names, true, history[-1], strict=False):
    print(f"{name}: found {value:.4g}, true {target:.4g} ({100 * (value / target - 1):+.1f} %)")

# %%
figure, axes = plt.subplots(1, 3, figsize=(12, 3.4), layout="constrained")
axes[0].plot(time, 1e3 * np.asarray(measured)[:, 1], ".", color="0.6", label="measured")
axes[0].plot(time, 1e3 * np.asarray(first)[:, 1], "--", color="C0", label="guess")
axes[0].plot(time, 1e3 * np.asarray(last)[:, 1], color="C0", label="fitted")
axes[0].set(xlabel="time [s]", ylabel="tip height [mm]")
axes[0].legend()
axes[1].plot(1e-3 * moduli, values, "o", color="C1")
for modulus, value, slope in zip(moduli, values, slopes, strict=True):
    ends = np.array([0.92, 1.08])
    axes[1].plot(1e-3 * modulus * ends, value + slope * np.log(ends), color="C1")
axes[1].axvline(1e-3 * true[0], color="black", lw=1, ls="--")
axes[1].set(xlabel="shear modulus [kPa]", ylabel="misfit", title="values and their derivatives")
axes[2].plot(history[:, 0] / true[0], label="shear modulus")
axes[2].plot(history[:, 1] / true[1], label="damping time")
axes[2].axhline(1, color="black", lw=1, ls="--")
axes[2].set(xlabel="gradient step", ylabel="found / true")
axes[2].legend()
plt.show()

# %% [markdown]
# Through contact a derivative exists too and is exact, but means less: a grasp that slips a step
# later is a jump in the cost, which no slope foretells.  The docs' `gradients.md` says where it
# helps.
