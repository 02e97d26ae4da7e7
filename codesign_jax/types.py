"""Named data that passes between the modules: parameters, trials, traces and the status bits.

Axis order of the public API is (particle, trial, time, feature).  Failure is data: nothing raises
inside jit.
"""

import enum
from typing import NamedTuple

import jax


class Status(enum.IntFlag):
    """Why a world failed, as bits; OK is zero."""

    OK = 0
    NONFINITE = 1
    SPEED = 2
    PENETRATION = 4
    SOLVER_CAP = 8
    CONTACT_OVERFLOW = 16
    INVALID_START = 32
    STUCK = 64


class Params(NamedTuple):
    """Morphology and control parameters of one hand (Table I), SI units and radians.

    Attributes:
      length: Finger length x_i [m], shape (finger,).
      height: Section height h_i [m], shape (finger,).
      wall: Hull thickness d_i [m], shape (finger,).
      spread: Spread gamma between the finger pairs [rad], shape ().
      arm: Arm pose X_D after the approach: x, y, z [m], roll, pitch, yaw [rad], shape (6,).
      pressure: Chamber gauge pressure while grasping p_i [Pa], shape (finger,).
    """

    length: jax.Array
    height: jax.Array
    wall: jax.Array
    spread: jax.Array
    arm: jax.Array
    pressure: jax.Array


class Trial(NamedTuple):
    """One trial's object and noise.

    Attributes:
      shape: Index of the object in the object set, shape () int32.
      position: Offset of the object on the table: x, y [m], shape (2,).
      yaw: Rotation of the object about the vertical [rad], shape ().
      arm_tilt: Rotation of the arm frame: roll, pitch [rad], shape (2,).
      mass: Factor on the object's mass, shape ().
      size: Factor on the object's size, shape ().
    """

    shape: jax.Array
    position: jax.Array
    yaw: jax.Array
    arm_tilt: jax.Array
    mass: jax.Array
    size: jax.Array


class Trace(NamedTuple):
    """What a rollout reports of every time step; entry k describes the state at time k * timestep.

    Attributes:
      distance: Object centre to hand centre [m], shape (time,).
      height: Object centre above the table [m], shape (time,).
      speed: Largest absolute generalized velocity [rad/s or m/s], shape (time,); not finite if any
        state is not.
      qpos: Generalized positions if trajectories were asked for, shape (time, nq), else shape
        (time, 0).
    """

    distance: jax.Array
    height: jax.Array
    speed: jax.Array
    qpos: jax.Array


class Outcome(NamedTuple):
    """Result of a trial.

    Attributes:
      cost: Cost of the trial in [0, maximum], shape ().
      status: Bits of `Status`, shape () int32; 0 if the trial counts.
      lost_time: First time at which the object was lost [s], infinite if never, shape ().
      bad_step: First time step of a failed world, or -1, shape () int32.
    """

    cost: jax.Array
    status: jax.Array
    lost_time: jax.Array
    bad_step: jax.Array
