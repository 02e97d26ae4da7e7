"""Commands over a grasp: key frames, the disturbance that any of them gets, and the air supply.

>>> import jax
>>> from codesign_jax import control, parameters, rollout, scene
>>> grasping = scene.load("paper")
>>> space = parameters.design_space(grasping.hand, "2d")
>>> hand, trial = space.params(space.default()), rollout.nominal_trial(grasping)
>>> controls = jax.jit(control.commands, static_argnums=0)(grasping, hand, trial)
>>> controls.shape, round(float(controls[400, 6]))  # after 4 s the first chamber has [Pa]
((900, 10), 120000)
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from codesign_jax.scene import Scene, key_frames
from codesign_jax.types import Params, Trial


class Plan(NamedTuple):
    """Commands of the key frames over a grasp, and additions that apply to any command.

    Attributes:
      pose: Pose of the arm frame: x, y, z [m], roll, pitch, yaw [rad], shape (time, 6); positive
        pitch points the fingers towards +x.
      pressure: Wanted pressure of each finger [Pa], shape (time, finger).
      shake: Roll and pitch [rad], then x, y, z [m] that the disturbance adds, shape (time, 5).
      tilt: Roll and pitch of the trial's noise [rad], shape (2,).
      params: Parameters of the hand.
    """

    pose: jax.Array
    pressure: jax.Array
    shake: jax.Array
    tilt: jax.Array
    params: Params


def commands(scene: Scene, params: Params, trial: Trial) -> jax.Array:
    """Returns the controls of one grasp, shape (time, nu).

    The columns are the actuators' order: arm frame x, y, z [m], roll, yaw, pitch [rad] (the order
    of the wrist hinges, see `model`), then one pressure [Pa] a finger.  Row k is held from time k h
    to (k+1) h.  While the object settles the arm waits at the first key frame.

    Args:
      scene: The scene; its numbers may be traced.
      params: Parameters of one hand.
      trial: Its trial; the arm frame carries the trial's roll and pitch noise.
    """
    planned = plan(scene, params, trial)
    pressure = planned.pressure
    if scene.effects.pressure_dynamics:
        pressure = supplied(scene, pressure)[0]
    return actuated(planned.pose, pressure, planned.shake, planned.tilt)


def plan(scene: Scene, params: Params, trial: Trial) -> Plan:
    """The key frames over the time steps of a grasp; arguments as in `commands`."""
    time = np.arange(scene.num_steps) * scene.discretization.timestep - scene.phases.settle
    place = _place(scene, params, time)
    pose = _between(place, key_frames.poses(scene, params))
    pressure = jnp.zeros((len(time), scene.num_fingers), jnp.result_type(params.pressure))
    for value, factors in key_frames.pressures(scene, params):
        pressure = pressure + value * _between(place, factors)
    shake = jnp.stack([*_rotation(scene, time), *_transport(scene, time)], 1)
    return Plan(pose, pressure, shake, trial.arm_tilt, params)


def actuated(pose: jax.Array, pressure: jax.Array, shake: jax.Array, tilt: jax.Array) -> jax.Array:
    """Controls, shape (time, nu), from what `Plan` has of as many time steps."""
    roll, pitch, yaw = pose.T[3:]
    place = pose[:, :3] + shake[:, 2:]
    # Positive pitch points the fingers towards +x, so that Table I's x = -20 mm with 15 degrees
    # aims the hand at the object [ours]; the wrist's hinge turns about +y, which points them
    # towards -x.
    roll = roll + tilt[0] + shake[:, 0]
    pitch = shake[:, 1] - pitch + tilt[1]
    return jnp.concatenate([place, jnp.stack([roll, yaw, pitch], 1), pressure], 1)


def _place(scene: Scene, params: Params, time: np.ndarray) -> tuple[jax.Array, ...]:
    """Between which key frames times are, and the share of the way, each of shape (time,)."""
    at = key_frames.times(scene, params)
    now = jnp.asarray(time, at.dtype)
    reached = (at <= now[:, None]).sum(1)
    before = jnp.maximum(reached - 1, 0)
    after = jnp.minimum(reached, len(at) - 1)
    span = at[after] - at[before]
    share = (now - at[before]) / jnp.where(span > 0, span, 1.0)
    holds = np.array([frame.interpolation == "held" for frame in scene.control.frame])
    if holds.any():
        share = jnp.where(jnp.asarray(holds)[before], 0.0, share)
    return before, after, share


def _between(place: tuple[jax.Array, ...], knots: jax.Array) -> jax.Array:
    """Interpolates values at the key frames, shape (frame, n), to (time, n)."""
    before, after, share = place
    return knots[before] + share[:, None] * (knots[after] - knots[before])


def supplied(
    scene: Scene, commanded: jax.Array, start: jax.Array | None = None
) -> tuple[jax.Array, jax.Array]:
    """Chamber pressures that the air supply reaches from the commanded ones, both (time, finger).

    tau dp/dt = min(commanded, maximum) - p with |dp/dt| <= rate, from the first commanded pressure
    on.  `commanded` is held over each time step, over which the lag is solved exactly.  The
    chamber's volume does not enter, so pressures are known beforehand and cost a step nothing.

    Args:
      commanded: Commanded pressures [Pa].
      start: Pressures at the beginning, shape (finger,), instead of the first commanded ones.

    Returns:
      The pressures, and those at the end of the last step, shape (finger,).
    """
    p = scene.pneumatics
    h = scene.discretization.timestep
    lagging = p.lag > 0
    gain = jnp.where(lagging, -jnp.expm1(-h / jnp.where(lagging, p.lag, 1.0)), 1.0)
    target = reachable(scene, commanded)

    def step(now: jax.Array, goal: jax.Array) -> tuple[jax.Array, jax.Array]:
        return now + jnp.clip(gain * (goal - now), -p.rate * h, p.rate * h), now

    end, pressures = jax.lax.scan(step, target[0] if start is None else start, target)
    return pressures, end


def reachable(scene: Scene, commanded: jax.Array) -> jax.Array:
    """Commanded pressures [Pa] as far as the air supply has them."""
    return jnp.minimum(commanded, scene.pneumatics.maximum)


def _rotation(scene: Scene, time: np.ndarray) -> tuple[jax.Array, jax.Array]:
    """Roll and pitch that the disturbance adds [rad], each of shape (time,).

    A sine whose amplitude grows linearly over the phase; whole periods alternate between roll and
    pitch. Afterwards the arm returns linearly to its nominal pose while the chambers deflate.
    """
    if not scene.effects.disturb:
        return jnp.zeros(len(time)), jnp.zeros(len(time))
    p = scene.phases
    arm = scene.arm
    inside = jnp.clip(time, p.lift, p.disturb) - p.lift
    growth = jnp.deg2rad(arm.shake_amplitude) * inside / (p.disturb - p.lift)
    period = arm.shake_frequency * inside
    angle = growth * jnp.sin(2 * np.pi * period)
    angle = angle * jnp.clip(1 - (time - p.disturb) / p.deflate_time, 0, 1)
    odd = jnp.floor(period).astype(int) % 2 == 1
    return jnp.where(odd, 0.0, angle), jnp.where(odd, angle, 0.0)


def _transport(scene: Scene, time: np.ndarray) -> list[jax.Array]:
    """Displacement along the world's x, y, z that the disturbance adds [m], each of shape (time,).

    Each axis has a third of the phase, T: the arm accelerates by +a for T/4, by -a for T/2 and by
    +a for T/4, which brings it back to rest where it began, over a distance of a T^2/16.
    """
    if not scene.effects.disturb:
        return [jnp.zeros(len(time))] * 3
    p = scene.phases
    third = (p.disturb - p.lift) / 3
    displacements = []
    for k in range(3):
        now = jnp.clip(time - p.lift - k * third, 0, third)
        turns = (1.0, 0.0), (-2.0, 0.25), (2.0, 0.75)  # changes of acceleration over a, and when
        squares = [change * jnp.maximum(now - at * third, 0) ** 2 for change, at in turns]
        displacements.append(scene.arm.shake_acceleration / 2 * sum(squares))
    return displacements
