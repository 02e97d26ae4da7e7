"""The energy audit: what simulated worlds gain beyond the work of chambers, wrist and arm.

A hand and its object have kinetic energy, that of gravity, of the fingers' springs, of contacts'
springs and of the friction that these hold. Dampers and sliding only take from it, so that it may
grow by the work of the chambers and of the arm, which moves the wrist's springs, and by no more.
The audit reads a path only, and so holds for every engine, law and time step.

A step leaves velocities v and the place q that they led to: they are those of the middle of the
step, where the audit takes the energy, at q - h v / 2. A step's force -K q - C v - A a of a spring
and damper, see `model.layout.implicit_spring`, is -K times the mean of both middles, -C times the
mean velocity, and -(A - h C / 2 - h^2 K / 4) a, which is an inertia. With its kinetic energy the
balance of linear springs and dampers is exact at any step, but for what dampers take.
"""

from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from codesign_jax import rollout
from codesign_jax.engines.structured import StructuredEngine, coordinates, forces
from codesign_jax.engines.structured.lanes import apply_columns, cross, dot
from codesign_jax.engines.structured.laws import inertia, integration
from codesign_jax.engines.structured.laws import kinematics as kin
from codesign_jax.engines.structured.world_model import WorldModel, world_constants
from codesign_jax.model import joint_axes
from codesign_jax.model.layout import sections_grow
from codesign_jax.scene import Scene, load, parameters


class Path(NamedTuple):
    """States before every step; `StructuredEngine.states` has them by these names."""

    qpos: Any  # Shape (world, time, nq)
    qvel: Any  # Shape (world, time, nv)
    held: Any = None  # Friction that contacts hold, (world, time, n); None for none


class Audit(NamedTuple):
    """What worlds gain from the middle of each step to that of the next one.

    Attributes:
      gain: Energy beyond the work done [J], shape (world, time - 1).
      stored: Kinetic energy and that of the fingers' springs [J], in the middle of each step before
        the states, shape (world, time): what a gain is compared with.
    """

    gain: np.ndarray
    stored: np.ndarray

    def rise(self, first: int = 0, steps: int | None = None, settle: int = 0) -> np.ndarray:
        """Largest gain over consecutive steps [J], any number or at most `steps`, shape (world,).

        Args:
          first: The first step that counts.
          steps: Largest number of steps.
          settle: A gain that is gone within so many further steps does not count.
        """
        total = np.cumsum(np.pad(self.gain[:, first:], ((0, 0), (1, 0))), axis=1)
        length = total.shape[1]
        later = (np.pad(total, ((0, 0), (0, n)), "edge")[:, n:] for n in range(settle + 1))
        left = np.min([*later], axis=0)
        spans = range(1, length if steps is None else min(steps + 1, length))
        if steps is None:
            return (left - np.minimum.accumulate(total, 1)).max(1)
        return np.max([(left[:, n:] - total[:, : length - n]).max(1) for n in spans], axis=0)


def audit(scene: Scene, fields: Any, ctrl: Any, path: Path) -> Audit:
    """Audits paths.

    Args:
      scene: The scene, with a wrist and without `effects.air_mass`: an arm without a wrist does
        work that a path does not tell, and the air of sealed chambers stores energy.
      fields: Model fields of the worlds.
      ctrl: Their controls, shape (world, time, nu).
      path: Their paths.

    Raises:
      ValueError: If the scene has effects whose work cannot be told from a path.
    """
    if scene.effects.air_mass or not scene.effects.wrist:
        raise ValueError("an energy audit needs effects.wrist and no effects.air_mass")
    run = jax.jit(partial(_world, scene))
    worlds = []
    for k in range(len(ctrl)):
        held = () if path.held is None else (jnp.asarray(path.held[k]),)
        world = jax.tree.map(lambda v, k=k: jnp.asarray(v[k]), fields)
        rows = (jnp.asarray(v[k]) for v in (ctrl, path.qpos, path.qvel))
        worlds.append([np.asarray(v, float) for v in run(world, *rows, *held)])
    at_mid, carried, stored = (np.stack(v) for v in zip(*worlds, strict=True))
    return Audit(carried[:, 1:] - at_mid[:, :-1], stored)


def _world(scene: Scene, fields: Any, ctrl: Any, qpos: Any, qvel: Any, *held: Any) -> tuple:
    """Energies of a world in the middles of steps, shape (time,).

    That with the controls of the step that follows, that with those of the step before it and less
    the wrist's work in between, and the kinetic one with that of the springs.
    """
    times = len(qpos)
    hand = world_constants(scene, jax.tree.map(lambda v: jnp.repeat(v[None], times, 0), fields))
    state = coordinates.make(scene, qpos, qvel, jnp.zeros_like(qvel), *held)
    state = integration.before(state, scene.discretization.timestep / 2)
    kinetic, height = _bodies(hand, kin.kinematics(hand, joint_axes(scene), state), state)
    other = kinetic
    if scene.effects.gravity:
        other = other + hand.step_numbers["gravity"][0] * height
    h = scene.discretization.timestep
    joints_of = (*_implicit(scene, hand, state.finger, ctrl), state.finger_vel)
    wrists_of = (hand.wrist_armature, hand.wrist_damping, hand.wrist_stiffness, state.wrist_vel)
    for armature, damping, stiffness, rate in (joints_of, wrists_of):
        left = (armature - h * damping / 2 - h**2 * stiffness / 4) * rate**2 / 2
        other = other + left.reshape(-1, times).sum(0)
    constants = _joints(scene, hand)
    q = jnp.moveaxis(state.finger, 1, 0)

    def joints(pressure: jax.Array) -> jax.Array:
        return inertia.joint_energy(constants, pressure, q).sum((0, 1))

    def contacts(pressure: jax.Array) -> jax.Array:
        return forces.contact_energy(scene, hand, state, pressure.T)

    pressure = ctrl[:, 6:].T
    springs = joints(jnp.zeros_like(pressure))
    before = jnp.roll(pressure, 1, 1)
    wrist = state.wrist[:, 0]
    last = jnp.roll(wrist, 1, 1)
    arm = jnp.roll(ctrl[:, :6].T, 1, 1)
    work = (hand.wrist_stiffness[:, 0] * (arm - (wrist + last) / 2) * (wrist - last)).sum(0)
    # Sections that grow press on what they touch: that is work of the chambers.
    touching = contacts(pressure)
    touched = contacts(before) if sections_grow(scene) else touching
    at_mid = other + touching + joints(pressure)
    return at_mid, other + touched + joints(before) - work, kinetic + springs


def _implicit(scene: Scene, hand: WorldModel, angles: Any, ctrl: Any) -> list[Any]:
    """Armature, damping and implicit stiffness of the joints, shape (link, axis, finger, time)."""
    if hand.law is None:
        return [hand.armature, hand.damping, hand.stiffness]
    first = (jnp.moveaxis(v, 1, 0) for v in (hand.stiffness, hand.damping, hand.armature, angles))
    *constants, q = first
    law = jnp.moveaxis(hand.law, 1, 0)
    springs = inertia.section_springs(scene, constants, law, ctrl[:, 6:].T, q)
    values = springs.armature, springs.damping, springs.stiffness
    return [jnp.moveaxis(v, 0, 1) for v in values]


def _bodies(hand: WorldModel, kinematics: kin.Kinematics, state: kin.State) -> tuple:
    """Kinetic energy of all bodies [J], and the sum of their masses times heights [kg m]."""
    k = kinematics
    links = inertia.Body(
        hand.mass,
        k.origin + apply_columns(k.link, jnp.moveaxis(hand.centre, 1, 0)),
        inertia.principal_tensor(k.link, jnp.moveaxis(hand.inertia, 1, 0)),
    )
    palm = inertia.Body(
        hand.palm_mass,
        k.place + apply_columns(k.palm, hand.palm_centre),
        inertia.turned_tensor(k.palm, hand.palm_inertia),
    )
    tensor = inertia.principal_tensor(k.object, hand.object_inertia)
    grasped = inertia.Body(hand.object_mass, jnp.zeros_like(state.position), tensor)
    kinetic = 0.0
    height = 0.0
    for body, vel in ((links, k.vel), (palm, k.palm_vel), (grasped, k.object_vel)):
        point = vel[3:] + cross(vel[:3], body.centre)
        spin = dot(vel[:3], apply_columns(body.tensor, vel[:3]))
        energy = (body.mass * dot(point, point) + spin) / 2
        kinetic = kinetic + energy.reshape(-1, energy.shape[-1]).sum(0)
        lifted = body.mass * (body.centre[2] + state.position[2])
        height = height + lifted.reshape(-1, lifted.shape[-1]).sum(0)
    return kinetic, height


def _joints(scene: Scene, hand: WorldModel) -> dict[str, jax.Array]:
    """What `inertia.joint_energy` takes, of all joints: shapes (..., link, finger, world)."""
    constants = {"stiffness": jnp.moveaxis(hand.stiffness, 1, 0), "gain": hand.gain}
    if hand.law is not None:
        constants["law"] = jnp.moveaxis(hand.law, 1, 0)
    elif scene.effects.neo_hookean:
        assert hand.section is not None
        constants["section"] = jnp.moveaxis(hand.section, 1, 0)
    if hand.threshold is not None:
        constants["threshold"] = jnp.moveaxis(hand.threshold, 1, 0)
    return constants


CONTACTS = "finger_object palm_object finger_table palm_table finger_finger finger_palm"
CONTACTS += " finger_itself friction_memory"
FREE = {
    **{f"effects.{name}": False for name in CONTACTS.split()},
    "phases.approach": 0.1,
    "phases.inflate": 0.5,
    "phases.lift": 0.6,
    "phases.disturb": 1.6,
    "phases.ungrasp": 2.4,
    "phases.deflate_time": 0.05,
}
"""A hand in the air that nothing touches: inflated, shaken from 0.6 to 1.6 s, and emptied in 50 ms,
as in a task that uses a snap."""

THIN = {
    "length": ((46.9, 179.3, 153.8, 178.6), (82.2, 176.2, 179.5, 160.9)),
    "height": ((23.47, 16.50, 16.48, 16.85), (17.99, 16.40, 23.05, 16.33)),
    "wall": ((3.17, 2.0, 2.0, 2.0), (4.38, 2.0, 3.0, 2.0)),
    "pressure": ((114.1, 51.1, 56.6, 51.1), (13.0, 51.8, 85.3, 55.1)),
    "spread": (92.2, 86.7),
    "arm_roll": (-8.4, 10.1),
    "arm_yaw": (45.2, -16.1),
    "arm_pitch": (0.1, -14.8),
}
"""Two hands with long, thin fingers, in the units of the hand's file [mm, kPa, degrees]: explicit
velocity products give them 38 and 40 J after the release, where they have 1.5 J."""


def thin_designs(scene: Scene) -> np.ndarray:
    """The hands of `THIN` as designs of a scene with four fingers, shape (2, 23)."""
    space = parameters.design_space(scene.hand)
    values = np.zeros((2, len(space.names)))
    for k, name in enumerate(space.names):
        field, _, finger = name.partition("[")
        given = np.array(THIN.get(field, (0.0, 0.0)))
        values[:, k] = given[:, int(finger[:-1])] if finger else given
    return np.asarray(space.from_units(values))


class Rise(NamedTuple):
    """What worlds gained at most, and the bound."""

    name: str
    gained: float  # Largest rise over the energy that fingers and bodies had before it
    bound: float


FREE_BOUND = 0.05
"""Largest rise of a free hand over its energy at the release [chosen]: 0.4 % is the most that 60
thin hands gain (docs/data/free_motion.json), and 2,700 % what the two of `THIN` gain with explicit
velocity products."""


def rises(accuracy: str = "standard") -> list[Rise]:
    """The audit as lines of a table: hands with thin fingers in the air."""
    scene = load("paper", accuracy=accuracy, overrides=FREE)
    designs = thin_designs(scene)
    measured = simulated(scene, designs)
    first = round(scene.phases.disturb / scene.discretization.timestep)
    gained = measured.rise(first) / measured.stored[:, first]
    return [Rise(f"thin fingers in the air, {accuracy}", float(gained.max()), FREE_BOUND)]


def simulated(scene: Scene, designs: np.ndarray, seed: int = 3) -> Audit:
    """The audit of designs, each in one trial, by the structured engine."""
    engine = StructuredEngine(scene)
    space = parameters.design_space(scene.hand)
    params = jax.vmap(space.params)(jnp.asarray(designs, jnp.zeros(0).dtype))
    trials = rollout.sample_trials(scene, jax.random.key(seed), len(designs))
    fields, ctrl = rollout.prepare(scene, params, trials, engine)
    series = jax.jit(lambda f, c: engine.states(f, c, trajectory=True)[1])(fields, ctrl)
    return audit(scene, fields, ctrl, Path(series["qpos"], series["qvel"], series.get("held")))
