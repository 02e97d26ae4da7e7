"""Named data that passes between the modules: parameters, trials, traces and the status bits.

Axis order of the public API is (particle, trial, time, feature).  Failure is data: nothing raises
inside jit.

>>> import numpy as np
>>> from codesign_jax import types
>>> types.failed(np.array([0, types.Status.SPEED, types.Status.SOLVER_CAP]))
array([False,  True, False])
"""

import enum
from typing import Any, NamedTuple, Protocol

import jax
import jax.numpy as jnp


class Status(enum.IntFlag):
    """Faults of a world, as bits; OK is zero.

    Every bit but those of `HARMLESS` makes the trial a failed one, see `failed`: it is not kept,
    and a mean cost excludes it or takes the maximum for it (`cost.failure`). All of these but STUCK
    are faults of the simulation; a STUCK hand does not release the object.

    Attributes:
      NONFINITE: A number of the state, or a cost of the user's own, was not finite.
      SPEED: A velocity beyond the scene's limit.
      PENETRATION: The object fell through the table.
      SOLVER_CAP: The solver stopped at its limit of iterations in a step before the verdict, with
        a residual above `newton.residual` if the engine tells it, see `Outcome`. A warning: each
        iteration lowers the convex objective, so the step taken is the best found, and to exclude
        such trials would favour hands that touch little.
      CONTACT_OVERFLOW: The engine had no room for a contact: MuJoCo C in its arena, the
        structured engine for those between fingers.
      INVALID_START: Bad model fields, or bodies deep inside one another before the first step.
      STUCK: The released object neither left the hand nor rests on the table.
      UNMOVED: The lost object is where it was put: the hand has not moved it sideways. No failure,
        but why the object was lost.

    >>> from codesign_jax import Status
    >>> Status(10)
    <Status.SPEED|SOLVER_CAP: 10>
    """

    OK = 0
    NONFINITE = 1
    SPEED = 2
    PENETRATION = 4
    SOLVER_CAP = 8
    CONTACT_OVERFLOW = 16
    INVALID_START = 32
    STUCK = 64
    UNMOVED = 128


WARNINGS = Status.SOLVER_CAP
"""Bits that warn of a trial's accuracy."""
HARMLESS = WARNINGS | Status.UNMOVED
"""Bits that do not make a trial a failed one."""

MEANINGS = {
    Status.NONFINITE: "a number of the state, or a cost of the user's own, was not finite",
    Status.SPEED: "a velocity beyond the scene's limit",
    Status.PENETRATION: "the object fell through the table",
    Status.SOLVER_CAP: "a warning only: the contact solver stopped at its limit of iterations, "
    "with a larger residual than the accuracy allows for",
    Status.CONTACT_OVERFLOW: "more contacts than the engine has room for",
    Status.INVALID_START: "bodies deep inside one another before the first step",
    Status.STUCK: "the hand did not let go: the released object neither left it nor rests on the "
    "table",
    Status.UNMOVED: "no failure: the lost object is where it was put, the hand has not moved it",
}
"""What the bits of `Status` mean, in words for readers of reports."""


_FAILURES = sum(bit for bit in Status if bit not in HARMLESS)


def random_key_problem(key: Any, name: str = "key") -> str:
    """Why a value is not one typed key, in words; empty if it is one."""
    kind = getattr(key, "dtype", None)
    if kind is None:
        got = f"a {type(key).__name__}"
    elif jnp.shape(key) or not jnp.issubdtype(kind, jax.dtypes.prng_key):
        got = f"shape {jnp.shape(key)} of {kind}"
    else:
        return ""
    return f"{name} must be one typed key from jax.random.key, got {got}"


def failed(status: Any) -> Any:
    """Whether trials failed, bool; status: int or integer array of any shape."""
    return (status & _FAILURES) != 0


class Tip(NamedTuple):
    """Sections at the tips of tapered fingers; between base and tip they change linearly.

    Attributes:
      height: Section height [m], shape (finger,).
      wall: Hull thickness [m], shape (finger,).
      width: Section width [m], shape (finger,).
    """

    height: Any
    wall: Any
    width: Any


class Params(NamedTuple):
    """Morphology and control parameters of one hand (Table I), SI units and radians.

    Attributes:
      length: Finger length x_i [m], shape (finger,); 0 of a finger that is absent.
      height: Section height h_i [m], shape (finger,).
      wall: Hull thickness d_i [m], shape (finger,).
      spread: Spread gamma between the finger pairs [rad], shape ().
      arm: Arm pose X_D after the approach: x, y, z [m], roll, pitch, yaw [rad], shape (6,).
      pressure: Chamber gauge pressure while grasping p_i [Pa], shape (finger,).
      control: Parameters of the scene's control by name [SI], shape () or (finger,); None without.
      tip: Sections at the tips of a hand whose fingers are tapered; height and wall are those at
        the base. None of a hand whose fingers are not.

    A design space makes them of the numbers that are free, given in the units of the hand file:

    >>> from codesign_jax import parameters, scene
    >>> space = parameters.design_space(scene.load("paper").hand, "2d")
    >>> hand = space.params(space.from_units([95.0, 30.0]))  # finger length and arm height, mm
    >>> hand.length.shape, round(float(hand.length[0]), 6), round(float(hand.arm[2]), 6)
    ((4,), 0.095, 0.03)
    """

    length: jax.Array
    height: jax.Array
    wall: jax.Array
    spread: jax.Array
    arm: jax.Array
    pressure: jax.Array
    control: dict[str, jax.Array] | None = None
    tip: Tip | None = None


class Trial(NamedTuple):
    """Object and noise of a trial.

    Attributes:
      shape: Index of the object in the object set, shape () int32.
      position: Offset of the object on the table: x, y [m], shape (2,).
      yaw: Rotation of the object about the vertical [rad], shape ().
      arm_tilt: Rotation of the arm frame: roll, pitch [rad], shape (2,).
      mass: Factor on the object's mass, shape ().
      size: Factor on the object's size, shape ().
      friction: Factor on the friction of all contacts, shape (); None for 1.
      stiffness: Factor on the fingers' shear modulus, shape (); None for 1.
      hand_mass: Factor on the masses of fingers and palm, shape (); None for 1.
      tilt: Rotation of the object about x and then y, before its yaw [rad], shape (2,); None for 0.
      constants: Factors on the constants of `Scene.drawn`, or shifts of them, shape (constant,);
        None for the scene's own.

    >>> from codesign_jax import rollout, scene
    >>> trial = rollout.nominal_trial(scene.load("paper"), "sphere")
    >>> int(trial.shape), float(trial.mass)
    (2, 1.0)
    """

    shape: jax.Array
    position: jax.Array
    yaw: jax.Array
    arm_tilt: jax.Array
    mass: jax.Array
    size: jax.Array
    friction: jax.Array | None = None
    stiffness: jax.Array | None = None
    hand_mass: jax.Array | None = None
    tilt: jax.Array | None = None
    constants: jax.Array | None = None


class Phased(Protocol):
    """An object with the phases of a grasp, such as a scene."""

    @property
    def num_steps(self) -> int:
        """Time steps of one grasp."""
        ...

    def last_step(self, phase: str | None = None) -> Any:
        """Index of the last time step of a phase."""
        ...


class Touch(NamedTuple):
    """Contacts of the object with each ring of the fingers, or of the palm: a map of touch.

    Fingers are tested for contact at rings, or at spheres with `effects.surface = "spheres"`. Rings
    are numbered from a finger's base to its tip, the same number on each link. The force on the
    object is `tangential - pressing * normal`; summed over the rings it equals the force in
    `Forces`. Points and vectors are in the world frame. Forces act during the step; the geometry is
    the one at its beginning. In the shapes n stands for (finger, ring), or (ring,) for the palm.

    Attributes:
      point: Point of contact [m], shape (..., n, 3); for rings that do not touch, a point between
        the ring and the object.
      normal: Unit vector from the object to the ring, shape (..., n, 3).
      gap: Distance between ring and object [m], negative in contact, shape (..., n).
      pressing: Normal force [N], at least 0, and 0 for rings that do not touch, shape (..., n).
      tangential: Friction force on the object [N], shape (..., n, 3).
    """

    point: jax.Array
    normal: jax.Array
    gap: jax.Array
    pressing: jax.Array
    tangential: jax.Array


class Forces(NamedTuple):
    """Contact forces over time steps, world frame; a step that was not taken has none.

    The forces on the object add up to its mass times its acceleration minus gravity, up to what the
    solver left (`Outcome.residual`).

    Attributes:
      finger: Force of each finger on the object [N], shape (..., finger, 3).
      palm: Force of the palm on the object [N], shape (..., 3).
      table: Force of the table on the object [N], shape (..., 3).
      grip: Sum of the normal forces of each finger on the object [N], shape (..., finger).
      finger_table: Force of the table on each finger [N], shape (..., finger, 3).
      palm_table: Force of the table on the palm [N], shape (..., 3).
      finger_finger: Sum of the normal forces of each finger on each other one and, on the diagonal,
        on itself [N], shape (..., finger, finger).
      finger_palm: Sum of the normal forces of each finger on the palm [N], shape (..., finger).
      depth: Largest depth at the step's beginning [m], 0 where nothing touches, by kind of contact
        as far as the scene has it: "finger_object", "finger_table", "palm_object", "palm_table",
        "object_table", "finger_finger", "finger_itself", "finger_palm", shape (...).
      touch: Contacts of the object ring by ring with the option `record_touch`, else None: "finger"
        and "palm", if the scene has these contacts; see `Touch`.
    """

    finger: jax.Array
    palm: jax.Array
    table: jax.Array
    grip: jax.Array
    finger_table: jax.Array
    palm_table: jax.Array
    finger_finger: jax.Array
    finger_palm: jax.Array
    depth: dict[str, jax.Array]
    touch: dict[str, Touch] | None = None


class Trace(NamedTuple):
    """A rollout's report of every time step; entry k is the state at time k * timestep.

    A world that failed stays in its last good state: the one before a step to a state that is too
    fast or not finite, and the first one below the table.  From the failure on its speed is that of
    the failed step, and its other entries repeat.

    A world that lost its object within the window of the cost is decided.  It stays where that
    happened, and its later entries repeat, unless qpos is recorded or it was asked to go on
    (`rollout.simulate`): then it is simulated to the end of the grasp, so that pictures and costs
    of one's own see all of it.  Its `Outcome` is the same.

    Attributes:
      distance: Object centre to hand centre [m], shape (time,).
      height: Object centre above the table [m], shape (time,).
      speed: Largest absolute generalized velocity [rad/s or m/s], shape (time,); not finite if any
        state is not.
      qpos: Generalized positions if they were recorded, shape (time, nq), else shape (time, 0).
      status: Bits that only the engine knows of the step taken from each state (SOLVER_CAP if it
        ended at the limit of iterations, CONTACT_OVERFLOW), shape (time,) int32, or None if it does
        not tell.
      last: The state at the end, in which a decided world stays, shape (n,), or None: positions,
        velocities, and what else a rollout that goes on from there needs, see `model.RolloutState`.
      residual: Residual of the step taken from each state, see `Outcome`, 0 of one that converged,
        shape (time,), or None if the engine does not tell.
      ctrl: Controls that a policy gave, shape (time, nu); None of those that were known beforehand.
      forces: Contact forces over the step taken from each state, if they were recorded.
      overlap: Largest overlap of two bodies as the grasp began [m], zero where there was none or
        the rollout went on from a later state, shape (); None if the engine does not tell, see
        `engines.depths`.

    An object that leaves the hand after six seconds, as its cost sees it:

    >>> import jax.numpy as jnp
    >>> from codesign_jax import Trace, cost, scene
    >>> time = jnp.arange(900) * 0.01  # s
    >>> away = jnp.where(time < 6.0, 0.02, 0.5)  # m
    >>> trace = Trace(away, jnp.full(900, 0.2), jnp.zeros(900), jnp.zeros((900, 0)))
    >>> round(float(cost.outcome(scene.load("paper"), trace).lost_time), 3)
    6.0
    """

    distance: jax.Array
    height: jax.Array
    speed: jax.Array
    qpos: jax.Array
    status: jax.Array | None = None
    last: jax.Array | None = None
    residual: jax.Array | None = None
    ctrl: jax.Array | None = None
    forces: "Forces | None" = None
    overlap: jax.Array | None = None

    def at(self, scene: Phased, phase: str | None = None) -> "Trace":
        """The trace in the last time step of a phase, without the axis time.

        A grasp goes on after the part that counts: in the scene `paper` entry -1 is one second
        after the hand was told to let go.  What a cost asks of the end of a grasp is `at` the end
        of "disturb".  Works inside `jax.jit`, `jax.vmap` and `jax.grad`, and on batches of worlds.

        Args:
          scene: The scene that was simulated, or the one that a cost receives.
          phase: "approach", "inflate", "lift", "disturb" or "ungrasp", as far as the scene has it;
            None for the last one in which losing the object costs: "disturb", or "lift" where
            `effects.disturb` is off.

        Returns:
          A trace whose arrays have lost their axis time; `last` and what comes after it are None.

        Raises:
          InputError: If the grasp has no such phase.
          ValueError: If the trace is not one of a whole grasp of the scene.

        >>> import jax.numpy as jnp
        >>> from codesign_jax import Trace, scene
        >>> released = jnp.where(jnp.arange(900) < 850, 0.02, 0.5)  # m: let go after 8.5 s
        >>> trace = Trace(released, released, released, jnp.zeros((900, 0)))
        >>> held = trace.at(scene.load("paper"), "disturb")
        >>> round(float(held.distance), 3), round(float(trace.distance[-1]), 3)
        (0.02, 0.5)
        """
        index = scene.last_step(phase)
        steps = jnp.shape(self.distance)[-1]
        if jnp.ndim(index):
            raise ValueError("the scene's phases differ between worlds: map over them by jax.vmap")
        if steps != scene.num_steps:
            raise ValueError(
                f"the trace has {steps} time steps, but a grasp of the scene {scene.num_steps}: "
                "was it simulated in another scene?"
            )
        series = (self.distance, self.height, self.speed)
        distance, height, speed = (v[..., index] for v in series)
        status = None if self.status is None else self.status[..., index]
        return Trace(distance, height, speed, self.qpos[..., index, :], status)


class Outcome(NamedTuple):
    """Result of a trial.

    Attributes:
      cost: Cost of the trial in [0, maximum], shape ().
      status: Bits of `Status`, shape () int32; the trial counts unless it `failed`.
      lost_time: First time at which the object was lost [s], infinite if never, shape ().
      bad_step: First time step of a failed world, or -1, shape () int32.
      capped: Share of the steps before the verdict in which the solver stopped at its limit of
        iterations, shape (); NaN if the engine does not tell (mjx).
      residual: Largest residual of these steps, 0 if there are none, shape (); NaN if the engine
        does not tell (mujoco, mjx). It is the norm sqrt(g' H^-1 g / s) of the forces g that the
        last Newton iteration found unbalanced, before its own step: H is the inertia with that of
        the contacts, and s the solver's scale (`newton.decrement` bounds its square). A force on
        palm and object together counts in units of their weight; one on a link, which is lighter,
        counts for more.

    The last two are None where no engine simulated the outcome.
    """

    cost: jax.Array
    status: jax.Array
    lost_time: jax.Array
    bad_step: jax.Array
    capped: jax.Array | None = None
    residual: jax.Array | None = None
