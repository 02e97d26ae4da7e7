"""Particles x trials in one batch: noise, commands, model fields, engine and cost put together."""

import jax
import jax.numpy as jnp
import numpy as np

from codesign_jax import control, cost, model, parameters, schema
from codesign_jax.engines import Engine
from codesign_jax.scene import Scene
from codesign_jax.start import invalid_start
from codesign_jax.types import Outcome, Params, Trace, Trial


def sample_trials(scene: Scene, key: jax.Array, num_trials: int) -> Trial:
    """Draws objects and noise of trials (paper Sec. VI.2); shapes take turns in the set's order.

    Args:
      scene: The scene.
      key: Typed key; trial t draws from fold_in(key, t), so that more trials do not change earlier
        ones.
      num_trials: Number of trials.

    Returns:
      Trials with leading axis (trial,).
    """
    index = jnp.arange(num_trials)
    noise = scene.objects.noise

    def draw(t: jax.Array) -> Trial:
        z = jax.random.normal(jax.random.fold_in(key, t), (7,))
        angles = np.deg2rad(noise.orientation) * z[2:5]
        return Trial(
            shape=t % len(scene.objects.object),
            position=noise.position * z[:2],
            yaw=angles[0],
            arm_tilt=angles[1:],
            mass=1.0 + noise.mass * z[5],
            size=1.0 + noise.size * z[6],
        )

    return jax.vmap(draw)(index)


def nominal_trial(scene: Scene, shape: int | str = 0) -> Trial:
    """Returns a trial without noise for an object of the set, by index or name.

    Raises:
      SceneError: If the set has no such object.
    """
    names = [s.name for s in scene.objects.object]
    if shape not in names and shape not in range(len(names)):
        hint = schema.nearest(str(shape), names)
        raise schema.SceneError([f"object {shape!r} unknown in {scene.objects.name}; {hint}"])
    index = names.index(shape) if isinstance(shape, str) else shape
    zero, one = jnp.zeros(()), jnp.ones(())
    return Trial(jnp.int32(index), jnp.zeros(2), zero, jnp.zeros(2), one, one)


def simulate(
    scene: Scene, engine: Engine, params: Params, trials: Trial, *, trajectory: bool = False
) -> tuple[Outcome, Trace]:
    """Simulates a batch of worlds; jit it, with scene and engine closed over.

    Args:
      scene: The scene.
      engine: The engine.
      params: Parameters with leading axis (world,).
      trials: Trials with leading axis (world,).
      trajectory: Whether the trace holds qpos of every step.

    Returns:
      Outcome and trace with leading axis (world,).

    Raises:
      SceneError: If a parameter is out of its range by a factor between units, such as
        millimetres given for metres; not inside a program that is being traced.
    """
    parameters.refuse_unit_slips(params)
    fields = jax.vmap(lambda p, t: model.model_fields(scene, p, t))(params, trials)
    ctrl = jax.vmap(lambda p, t: control.commands(scene, p, t))(params, trials)
    trace = engine.rollout(fields, ctrl, trajectory=trajectory)
    initial = invalid_start(scene, fields)
    return jax.vmap(lambda t, i: cost.outcome(scene, t, i))(trace, initial), trace


def evaluate(scene: Scene, engine: Engine, params: Params, trials: Trial) -> Outcome:
    """Evaluates all particles in all trials as one batch of particle * trial worlds.

    Args:
      scene: The scene.
      engine: The engine.
      params: Parameters with leading axis (particle,).
      trials: Trials with leading axis (trial,): common random numbers, every particle meets the
        same ones.

    Returns:
      Outcomes, every array of shape (particle, trial).
    """
    return evaluate_to_end(scene, engine, params, trials)[0]


def evaluate_to_end(
    scene: Scene, engine: Engine, params: Params, trials: Trial
) -> tuple[Outcome, jax.Array | None]:
    """As `evaluate`, with the states at the end, shape (particle, trial, nq + nv).

    They are None if the engine does not tell them.
    """
    particles, count = params.length.shape[0], trials.yaw.shape[0]
    worlds_p = jax.tree.map(lambda v: jnp.repeat(v, count, axis=0), params)
    worlds_t = jax.tree.map(lambda v: jnp.tile(v, (particles,) + (1,) * (v.ndim - 1)), trials)
    result, trace = simulate(scene, engine, worlds_p, worlds_t)
    return jax.tree.map(lambda v: v.reshape(particles, count, *v.shape[1:]), (result, trace.last))
