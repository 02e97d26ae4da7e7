"""Material of the fingers from a measured tip trajectory, by gradients through the simulation.

`notebooks/06_gradients.py` fits one. All stiffnesses of a finger are proportional to its shear
modulus:

>>> import jax
>>> from codesign_jax import fit, model, parameters, rollout, scene
>>> bench = scene.load("paper_spheres")
>>> space = parameters.design_space(bench.hand, "2d")
>>> hand, trial = space.params(space.default()), rollout.nominal_trial(bench)
>>> fields = jax.jit(model.model_fields, static_argnums=0)(bench, hand, trial)
>>> twice = fit.Material(2 * bench.hand.material.shear_modulus, bench.hand.material.damping_time)
>>> first = model.layout(bench).dofs[0, 0, 0]
>>> stiffer = fit.with_material(bench, fields, twice).jnt_stiffness[first]
>>> round(float(stiffer / fields.jnt_stiffness[first]), 4)
2.0
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import optax

from codesign_jax.engines.structured import StructuredEngine
from codesign_jax.engines.structured.coordinates import reset
from codesign_jax.engines.structured.laws.kinematics import kinematics
from codesign_jax.engines.structured.world_model import apply_columns, world_constants
from codesign_jax.model import ModelFields, layout
from codesign_jax.model.layout import implicit_damping
from codesign_jax.scene import Scene


class Material(NamedTuple):
    """What the fit moves.

    Attributes:
      shear_modulus: G [Pa], shape ().
      damping_time: Kelvin-Voigt time beta [s], shape ().
    """

    shear_modulus: jax.Array
    damping_time: jax.Array


class Fit(NamedTuple):
    """A fit step by step.

    Attributes:
      material: The fitted material.
      history: The material before each step, arrays of shape (step,).
      loss: Mean squared tip error before each step over the variance of the measured tips, shape
        (step,).
    """

    material: Material
    history: Material
    loss: jax.Array


def with_material(scene: Scene, fields: ModelFields, material: Material) -> ModelFields:
    """Model fields of one world, its fingers made of another material than the scene's.

    All finger stiffnesses are proportional to G and all dampings are beta times the stiffness, to
    which the linearly implicit integration adds the time step (see docs/physics.md).
    """
    dofs, h = layout(scene).dofs, scene.discretization.timestep
    scale = material.shear_modulus / scene.hand.material.shear_modulus
    stiffness = fields.jnt_stiffness[dofs] * scale
    damping = implicit_damping(scene, stiffness, material.damping_time * stiffness)
    return fields._replace(
        jnt_stiffness=fields.jnt_stiffness.at[dofs].set(stiffness),
        dof_damping=fields.dof_damping.at[dofs].set(damping),
        dof_armature=fields.dof_armature.at[dofs].set(h * damping),
    )


def tip_positions(scene: Scene, fields: ModelFields, qpos: jax.Array) -> jax.Array:
    """Positions of the finger tips' bottom layers in the world [m], shape (time, finger, 3).

    Args:
      scene: The scene.
      fields: Model fields of one world.
      qpos: Generalized positions, shape (time, nq).
    """
    world = jax.tree.map(lambda v: v[None], fields)
    hand = world_constants(scene, world)
    # Times stand in for worlds: all of them see the same hand.
    still = jnp.zeros((len(qpos), world.dof_damping.shape[-1]), qpos.dtype)
    state = reset(scene, world._replace(start=jnp.concatenate([qpos, still], 1)))
    kin = kinematics(hand, layout(scene).axes, state)
    half = jnp.zeros_like(kin.origin[:, -1]).at[0].set(0.5 * hand.offset[-1])
    tip = kin.origin[:, -1] + apply_columns(kin.link[:, :, -1], half) + state.position
    return jnp.moveaxis(tip, 0, -1).swapaxes(0, 1)


def simulate_tips(
    engine: StructuredEngine, fields: ModelFields, ctrl: jax.Array, material: Material
) -> jax.Array:
    """Tip positions of one world under controls (time, nu), shape (time, finger, 3)."""
    fields = with_material(engine.scene, fields, material)
    trace = engine.rollout(jax.tree.map(lambda v: v[None], fields), ctrl[None], trajectory=True)
    return tip_positions(engine.scene, fields, trace.qpos[0])


def fit_material(
    engine: StructuredEngine,
    fields: ModelFields,
    ctrl: jax.Array,
    measured: jax.Array,
    guess: Material,
    *,
    steps: int = 120,
    rate: float = 0.1,
) -> Fit:
    """Fits the material to measured tips by Adam on its logarithms.

    Args:
      engine: The engine.
      fields: Model fields of one world; the material in them does not matter.
      ctrl: Controls, shape (time, nu).
      measured: Tip positions at every time step [m], shape (time, finger, 3).
      guess: Where to start.
      steps: Gradient steps; the rate falls to zero along a cosine.
      rate: First step in the logarithm of a parameter.
    """
    variance = jnp.mean(jnp.var(measured, axis=0))
    optimizer = optax.adam(optax.cosine_decay_schedule(rate, steps), b1=0.8, b2=0.95)

    def loss(logs: Material) -> jax.Array:
        tips = simulate_tips(engine, fields, ctrl, jax.tree.map(jnp.exp, logs))
        return jnp.mean((tips - measured) ** 2) / variance

    def step(carry: tuple, _: None):
        logs, state = carry
        value, slope = jax.value_and_grad(loss)(logs)
        update, state = optimizer.update(slope, state)
        return (optax.apply_updates(logs, update), state), (jax.tree.map(jnp.exp, logs), value)

    @jax.jit
    def run(logs: Material):
        return jax.lax.scan(step, (logs, optimizer.init(logs)), None, length=steps)

    (logs, _), (history, values) = run(jax.tree.map(jnp.log, guess))
    return Fit(jax.tree.map(jnp.exp, logs), history, values)
